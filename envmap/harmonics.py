"""Real spherical harmonics of a map, and the irradiance that they give.

Y_lm are orthonormal, in the order (0, 0), (1, -1), (1, 0), (1, 1), (2, -2) ..., with signs as
in Ramamoorthi and Hanrahan 2001 (no Condon-Shortley phase): Y_1-1, Y_10, Y_11 go with y, z, x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

type Array = NDArray[np.float64]

#: The highest order that is offered.
MAX_ORDER = 4


@dataclass(frozen=True)
class Harmonics:
    """A map's light in spherical harmonics.

    ``radiance`` ((order + 1)^2, 3) coefficients of L; ``irradiance``, the same times the
    clamped cosine's (:func:`cosine_factors`) and the window's; ``window``: lambda of
    1 / (1 + lambda l^2 (l + 1)^2), 0 for none; ``lowest``: the smallest irradiance over all
    normals and channels, over the mean one; ``error``: RMS error of irradiance over normals,
    relative to the mean.
    """

    order: int
    radiance: Array
    irradiance: Array
    window: float
    lowest: float
    error: float

    def irradiance_on(self, normals: ArrayLike) -> Array:
        """Irradiance on unit `normals`, (..., 3) -> (..., 3)."""
        return sh_basis(normals, self.order) @ self.irradiance


def sh_basis(d: ArrayLike, order: int = 2) -> Array:
    """Y_00 .. Y_nn at unit directions, ``(..., 3) -> (..., (order + 1)^2)``.

    By the recurrences of the associated Legendre functions (Sloan 2013, without its phase).
    """
    v = np.asarray(d, float)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    result = np.empty((*v.shape[:-1], (order + 1) ** 2))
    cosine, sine = np.ones_like(x), np.zeros_like(x)  # sin^m cos(m phi), sin^m sin(m phi)
    p_mm = np.ones_like(x)  # P_mm / sin^m theta
    for m in range(order + 1):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            p_mm = p_mm * (2 * m - 1)
        below, here = np.zeros_like(x), p_mm
        for n in range(m, order + 1):
            if n > m:
                # (n - m) P_nm = (2n - 1) z P_n-1,m - (n + m - 1) P_n-2,m
                below, here = (
                    here,
                    ((2 * n - 1) * z * here - (n + m - 1) * below) / (n - m),
                )
            ratio = math.factorial(n - m) / math.factorial(n + m)
            norm = math.sqrt((2 * n + 1) / (4 * math.pi) * ratio * (2 if m else 1))
            middle = n * n + n
            result[..., middle + m] = norm * here * cosine
            if m:
                result[..., middle - m] = norm * here * sine
    return result


def cosine_factors(order: int) -> Array:
    """Convolution with the clamped cosine (Ramamoorthi and Hanrahan 2001, eq. 8) per Y_lm."""
    factors: list[float] = []
    for n in range(order + 1):
        if n == 1:
            a = 2 * math.pi / 3
        elif n % 2:
            a = 0.0
        else:
            half = n // 2
            a = 2 * math.pi * (-1) ** (half - 1) / ((n + 2) * (n - 1))
            a *= math.factorial(n) / (2**n * math.factorial(half) ** 2)
        factors += [a] * (2 * n + 1)
    return np.array(factors)


def sh_irradiance(coefficients: ArrayLike, normals: ArrayLike) -> Array:
    """Irradiance on `normals` (..., 3) of radiance given by ((order + 1)^2, 3) coefficients."""
    c = np.asarray(coefficients, float)
    order = math.isqrt(len(c)) - 1
    return (sh_basis(normals, order) * cosine_factors(order)) @ c
