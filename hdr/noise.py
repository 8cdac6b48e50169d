"""How noisy a pixel is: variance as a function of exposure, given or measured.

Codes: var ln X(z) = (g'(z) n)^2 + a / X + b / X^2. Quantisation, JPEG and the camera's own
processing are constant in code units (n); photons (a) and the sensor's electronics (b) are not.
Linear values: var x = a x + b (Foi et al. 2008), x a share of white.

A bracket shows its own noise. The frames' residuals against their weighted mean,
r_j = y_j - mean, have E r_j^2 = v_j (1 - h_j), h_j = w_j / sum w the leverage; so
r_j^2 / (1 - h_j) estimates v_j, and the coefficients, none negative, are a weighted least
squares over the levels (Granados et al. 2010 calibrate likewise; Hasinoff et al. 2010 for the
model). Outliers (motion, misalignment, an edge) are cut at three standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr.response_file import Response

type Float = NDArray[np.float64]

#: fewer residuals than this measure no noise
LEAST_RESIDUALS = 2000
#: E min(u^2, 9) of a standard normal u
_CUT_MEAN = 0.99502
#: linear noise is not taken for less than this share of white (float pictures without any)
LEAST_READ = 1e-14
#: the share of a residual's variance that the mean must leave it
_LEAST_FREEDOM = 0.1


@dataclass(frozen=True)
class CodeNoise:
    """Per channel (C,): `code` n in codes, `shot` a and `read` b in units of X at its scale."""

    code: Float
    shot: Float
    read: Float

    @classmethod
    def of(cls, response: Response) -> CodeNoise:
        """The constant code noise that the response was solved with."""
        zero = np.zeros_like(response.code_noise)
        return cls(response.code_noise, zero, zero)


@dataclass(frozen=True)
class Fit:
    """Residuals against the noise model: chi-square over its degrees of freedom.

    ``chi_square`` (C,) over all samples, ``by_range`` (3, C) over thirds of the samples by
    brightness, dark first; NaN where no sample is measured twice. Outliers beyond five
    standard deviations are left out and counted in ``outliers`` (C,), a share.
    """

    chi_square: Float
    by_range: Float
    outliers: Float


def lattice(shape: tuple[int, int], count: int = 12_000) -> tuple[slice, slice]:
    """Rows and columns of about `count` pixels spread over a picture.

    Steps are odd, so that all four parities of a mosaic are met.
    """
    step = max(1, int(math.sqrt(shape[0] * shape[1] / count))) | 1
    return slice(step // 2, None, step), slice(step // 2, None, step)


def slopes(g: Float) -> Float:
    """g'(z), to the next code: the lowest code is open below, and its g says little."""
    rise = np.diff(g, axis=-1)
    return np.concatenate([rise, rise[..., -1:]], axis=-1)


def measure_codes(
    samples: Sequence[NDArray[Any]], exposures: Float, response: Response
) -> CodeNoise | None:
    """Noise of a bracket of codes from `samples`, one (N, C) a frame.

    None where a channel has too few samples that are measured twice.
    """
    N = response.log_exposure.shape[1]
    found: list[Float] = []
    for c, g in enumerate(response.log_exposure):
        z = np.stack([frame[:, c] for frame in samples]).astype(np.intp)
        slope = slopes(g)
        basis = np.stack([slope**2, np.exp(-g), np.exp(-2 * g)], axis=1)
        margin = 3 * max(1, (N - 1) // 255)
        usable = unsaturated(z, N - margin) & (z > margin)
        y = g[z] - np.log(exposures)[:, None]
        start = np.array([max(response.code_noise[c], 12**-0.5) ** 2, 0.0, 0.0])
        theta = _measure(y, usable, basis[z], start, (slope**2 / 12)[z])
        if theta is None:
            return None
        found.append(theta)
    n, a, b = np.array(found).T
    return CodeNoise(np.sqrt(n), a, b)


def measure_linear(x: Float, exposures: Float, usable: NDArray[np.bool_]) -> Float | None:
    """(a, b) of var x = a x + b, from x (P, N), shares of white; None if there is too little.

    `usable` (P, N): unsaturated.
    """
    t = exposures[:, None]
    T = np.where(usable, t, 0).sum(axis=0)
    E = np.where(usable, x, 0).sum(axis=0) / np.maximum(T, 1e-300)
    level = np.maximum(E, 0) * t  # the exposure, not the noisy value
    basis = np.stack([level, np.ones_like(level)], axis=2) / t[..., None] ** 2
    start = np.array([3.5e-6, 3.9e-9])
    floor = LEAST_READ / t**2 * np.ones_like(level)
    found = _measure(x / t, usable, basis, start, floor)
    return None if found is None else np.array([found[0], max(found[1], LEAST_READ)])


def chi_square(residual: Float, variance: Float, usable: NDArray[np.bool_]) -> Fit:
    """Reduced chi-square of y_j = mean + noise; all (P, N, C), `residual` is y itself."""
    channels = residual.shape[2]
    whole, thirds = np.full(channels, np.nan), np.full((3, channels), np.nan)
    outliers = np.zeros(channels)
    for c in range(channels):
        u2, mean, keep = _studentised(residual[..., c], variance[..., c], usable[..., c])
        if not keep.any():
            continue
        inside = keep & (u2 < 25)
        outliers[c] = 1 - inside.sum() / keep.sum()
        if not inside.any():
            continue
        whole[c] = u2[inside].mean()
        level = np.broadcast_to(mean, u2.shape)
        cuts = np.quantile(level[inside], [1 / 3, 2 / 3])
        third = np.digitize(level, cuts)
        for k in range(3):
            chosen = inside & (third == k)
            thirds[k, c] = u2[chosen].mean() if chosen.any() else np.nan
    return Fit(whole, thirds, outliers)


def unsaturated(values: NDArray[Any], limit: Any) -> NDArray[np.bool_]:
    """Decided jointly: below `limit` here and in all shorter exposures; axis 0 sorted."""
    return np.logical_and.accumulate(values < limit, axis=0)


def _studentised(
    y: Float, v: Float, usable: NDArray[np.bool_]
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Squared residuals over their variance (P, N), weighted means (N,), which count."""
    w = np.where(usable, 1 / v, 0.0)
    total = w.sum(axis=0)
    total[total <= 0] = np.inf
    mean = (w * np.where(usable, y, 0)).sum(axis=0) / total
    freedom = 1 - w / total
    keep = usable & (freedom > _LEAST_FREEDOM)
    u2 = np.where(keep, (y - mean) ** 2 / (v * np.where(keep, freedom, 1)), 0.0)
    return u2, mean, keep


def _measure(
    y: Float, usable: NDArray[np.bool_], basis: Float, start: Float, floor: Float
) -> Float | None:
    """Coefficients, none negative, of v = basis @ theta; basis (P, N, k)."""
    from scipy.optimize import nnls

    theta = start
    for _ in range(5):
        v = np.maximum(basis @ theta, floor)
        u2, _, keep = _studentised(y, v, usable)
        if keep.sum() < LEAST_RESIDUALS:
            return None
        ratio = np.minimum(u2[keep], 9) / _CUT_MEAN
        rows = basis[keep] / v[keep][:, None]
        scale = np.maximum(np.sqrt(np.mean(rows**2, axis=0)), 1e-300)
        rows /= scale
        # normal equations of a handful of unknowns, their columns scaled to one
        theta = nnls(rows.T @ rows / len(rows), rows.T @ ratio / len(rows))[0] / scale
    return theta
