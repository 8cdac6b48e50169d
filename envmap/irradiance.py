"""Diffuse irradiance of a map: the exact cosine integral, and harmonics with their error."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap import convolve_kernel
from chromeball.envmap.harmonics import MAX_ORDER, Harmonics, cosine_factors, sh_basis
from chromeball.envmap.lights import Survey, survey
from chromeball.envmap.mapping import LatLong
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

#: Cells, down and across, that maps are reduced to at most; each keeps its energy's place.
ROWS, COLUMNS = 512, 1024


def irradiance(radiance: NDArray[np.float32], normals: ArrayLike) -> Array:
    """E = integral of L cos dOmega on unit `normals` (..., 3) -> (..., 3), of a map (H, W, 3).

    Raises
    ------
    UserError
        When the map is black, or a pixel is negative or not finite.

    """
    return irradiance_of(survey(radiance, ROWS, COLUMNS), normals)


def irradiance_of(sky: Survey, normals: ArrayLike) -> Array:
    """As :func:`irradiance`, of a map that was surveyed before."""
    n = np.asarray(normals, float)
    flat = np.ascontiguousarray(n.reshape(-1, 3))
    return convolve_kernel.irradiance(sky.cells, flat).reshape(n.shape)


def irradiance_map(radiance: NDArray[np.float32], width: int = 64) -> NDArray[np.float32]:
    """Irradiance on the normals of a lat-long map (width / 2, width, 3)."""
    d = LatLong((width, width // 2)).directions()
    return irradiance(radiance, d).astype(np.float32)


def harmonics(
    radiance: NDArray[np.float32], order: int = 2, *, window: bool = False
) -> Harmonics:
    """Harmonics of a lat-long map (H, W, 3), order 0 to 4.

    With `window` the coefficients are damped by 1 / (1 + lambda l^2 (l + 1)^2) (Sloan 2008),
    with the smallest lambda for which no irradiance is negative.

    Raises
    ------
    UserError
        When the map is black, a pixel is negative or not finite, or for another order.

    """
    if not 0 <= order <= MAX_ORDER:
        raise UserError(f"order {order}: harmonics are offered from 0 to {MAX_ORDER}")
    sky = survey(radiance, ROWS, COLUMNS)
    coefficients = _project(sky, order)
    normals = spread_directions(2048)
    truth = irradiance_of(sky, normals)
    basis = sh_basis(normals, order)
    factors = cosine_factors(order)
    bands = np.array([n for n in range(order + 1) for _ in range(2 * n + 1)])
    damping = (bands * (bands + 1.0)) ** 2

    def damped(strength: float) -> Array:
        return coefficients * (factors / (1 + strength * damping))[:, None]

    strength = 0.0
    if window and (basis @ damped(0.0)).min() < 0:
        low, high = 1e-6, 1e3
        for _ in range(60):
            middle = math.sqrt(low * high)
            if (basis @ damped(middle)).min() < 0:
                low = middle
            else:
                high = middle
        strength = high
    own = basis @ damped(strength)
    mean = truth.mean()
    return Harmonics(
        order=order,
        radiance=coefficients / (1 + strength * damping)[:, None],
        irradiance=damped(strength),
        window=strength,
        lowest=float(own.min() / mean),
        error=float(np.sqrt(np.mean((own - truth) ** 2)) / mean),
    )


def _project(sky: Survey, order: int) -> Array:
    """Integrals of L Y_lm, ((order + 1)^2, 3), each cell at its channel's centroid."""
    result = np.zeros(((order + 1) ** 2, 3))
    for row in sky.cells:  # a row at a time: memory
        m = row.reshape(-1, 4, 3)
        length = np.linalg.norm(m[:, 1:], axis=1)
        d = m[:, 1:] / np.where(length > 0, length, 1)[:, None]
        for c in range(3):
            result[:, c] += m[:, 0, c] @ sh_basis(d[..., c], order)
    return result


def spread_directions(count: int) -> Array:
    """Unit directions (count, 3) evenly over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    phi = k * math.pi * (3 - math.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), z, r * np.sin(phi)], axis=1)
