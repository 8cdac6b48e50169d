"""Factors that explain a ratio of seen to predicted light, robustly and not below zero.

For each channel y_b = p_b sum_k A_bk s_k, s >= 0, with a Gaussian prior s_k ~ (g, spread).
Iterated least squares: Huber's weights first, whose solution is unique, then Tukey's (1977),
which leave out what the model cannot explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

_HUBER, _TUKEY = 1.345, 4.685
#: No measurement is better than this part of its value.
FLOOR = 0.002


@dataclass(frozen=True)
class Fit:
    """Factors ``s`` (K, 3) and their standard errors ``sigma`` (K, 3).

    ``weight`` (N,): Tukey's, 0 where a block is left out; ``scale``: by how much the residuals
    exceed the blocks' own uncertainty; ``resolution`` (K,): the part of each factor that the
    blocks, not the prior, decided, luminance's; ``condition`` of the blocks' own system.
    """

    s: Array
    sigma: Array
    weight: Array
    scale: float
    resolution: Array
    condition: float


@dataclass(frozen=True)
class Blocks:
    """``seen`` and ``predicted`` (N, 3) radiance of pieces of frames, ``sigma`` (N, 3)."""

    seen: Array
    predicted: Array
    sigma: Array


def fit(blocks: Blocks, design: Array, prior: Array | None, spread: float) -> Fit:
    """Factors of `design` (N, K, 3), near `prior` (3,) within `spread` (none: no prior).

    Raises
    ------
    UserError
        When there are fewer blocks than one model can do with.

    """
    n, k = design.shape[:2]
    if n < 4:
        raise UserError("too little of the frame shows what the map holds")
    # a channel's system in one piece, which is what BLAS is fast on
    scaled = np.moveaxis(design, 2, 0) * (blocks.predicted / blocks.sigma).T[..., None]
    a = np.ascontiguousarray(scaled)
    y = blocks.seen / blocks.sigma
    precision = 0.0 if prior is None else spread**-2
    centre = np.zeros(3) if prior is None else prior
    if k == 1 and prior is None:  # where the iteration begins does matter: a crowd may walk by
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.nanmedian(np.where(a[..., 0] > 0, y.T / a[..., 0], np.nan), axis=1)[None]
    elif prior is None:
        s = _solve(a, y, np.ones(n), 0.0, centre)
    else:
        s = np.tile(prior, (k, 1))
    scale, weight = 1.0, np.ones(n)
    for step in range(10):
        left = _length(y - (a @ s.T[..., None])[..., 0].T)
        scale = _scale_of(left)
        u = left / scale
        weight = (
            np.minimum(1, _HUBER / np.maximum(u, 1e-12))
            if step < 6
            else np.maximum(1 - (u / _TUKEY) ** 2, 0) ** 2
        )
        # the prior is weighed against the noise that there is
        s = _solve(a, y, weight, precision * scale**2, centre)
    covariance, resolution, condition = [], np.ones(k), 1.0
    for c in range(3):
        h = (a[c] * weight[:, None]).T @ a[c] / scale**2
        inverse = np.linalg.pinv(h + precision * np.eye(k), hermitian=True)
        covariance.append(np.sqrt(np.maximum(np.diag(inverse), 0)))
        if c == 1:
            resolution = np.clip(np.diag(inverse @ h), 0, 1)
            own = np.sqrt(np.maximum(np.diag(h), 1e-300))
            known = resolution > 0.5
            if known.any():
                condition = float(
                    np.linalg.cond((h / np.outer(own, own))[np.ix_(known, known)])
                )
    return Fit(s, np.stack(covariance, axis=1), weight, scale, resolution, condition)


def residuals(blocks: Blocks, design: Array, s: Array) -> Array:
    """Of each block (N,), in units of its own uncertainty."""
    model = np.einsum("nkc,kc->nc", design * blocks.predicted[:, None, :], s)
    return _length((blocks.seen - model) / blocks.sigma)


def _length(r: Array) -> Array:
    return np.sqrt((r**2).mean(axis=1))


def _scale_of(left: Array) -> float:
    """Robust, at least 1: three channels' residuals have a median length near 0.89 sigma."""
    return max(float(np.median(left)) / 0.89, 1.0)


def _solve(a: Array, y: Array, weight: Array, precision: float, centre: Array) -> Array:
    """Of systems (3, N, K) and values (N, 3); not below zero, (K, 3)."""
    from scipy.optimize import nnls

    k = a.shape[2]
    s = np.zeros((k, 3))
    for c in range(3):
        rows = a[c] * weight[:, None]
        h = rows.T @ a[c] + precision * np.eye(k)
        b = rows.T @ y[:, c] + precision * centre[c]
        s[:, c] = np.linalg.lstsq(h, b, rcond=1e-12)[0]
        if (s[:, c] < 0).any():  # as a system of K rows with the same normal equations
            values, axes = np.linalg.eigh(h)
            root = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
            s[:, c] = nnls(root[:, None] * axes.T, (axes.T @ b) / root)[0]
    return s
