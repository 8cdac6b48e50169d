"""Bundle adjustment over the rotations of all frames and their shared lens, on the sphere.

A match says R_i u(p; lens) = R_j u(q; lens) for pixels p, q. The residual is the difference of
the two unit directions, in units of the pixels' own angles; rotations move on their manifold,
R <- exp(w) R. Gauss-Newton with Levenberg's damping; Geman and McClure's weights (1987), whose
scale shrinks from all matches to those that agree. A tracker's rotations are observations as
well, with weights of the same kind: one that flipped cannot bend the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.stitch.lens import (
    KNOWN,
    Freedom,
    moved,
    pixel_angle,
    rays,
    unknowns,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: The scatter of good features in pixels; robust scales go no lower.
FEATURE = 0.3
#: The robust scale in medians of the residuals where their tail is long (the 80th percentile
#: over the median; 1.52 for noise): the better half counts. A match ends at REACH scales.
HALF, TAIL = 0.4, 1.75
REACH = 2.5
ITERATIONS = 50
#: Steps below it end the iteration, radians.
SETTLED = 3e-7


@dataclass(frozen=True)
class Matches:
    """Matches of all pairs in one list.

    ``frames`` (M, 2) indices; ``first``, ``second`` (M, 2) pixels; ``sigma`` (M,) relative
    uncertainty of each (1 for a small feature).
    """

    frames: NDArray[np.int64]
    first: Array
    second: Array
    sigma: Array


@dataclass(frozen=True)
class Adjusted:
    """What the adjustment found.

    ``rotations`` (N, 3, 3) world_from_camera; ``camera`` the shared lens; ``inliers`` (M,);
    ``residuals`` (M,) in pixels of the frames, unweighted; ``sigma`` (N,) standard error of
    each rotation against the mean of all, radians (per axis, worst), the tracker's for a frame
    without matches, infinite without one; ``lens_sigma`` of the
    lens's unknowns; ``condition`` of the normal equations, gauge left out; ``prior_residual``
    (N,) angle from the tracker's rotation, radians, NaN where there is none.
    """

    rotations: Array
    camera: CameraModel
    inliers: NDArray[np.bool_]
    residuals: Array
    sigma: Array
    lens_sigma: Array
    condition: float
    prior_residual: Array
    iterations: int


def exp(w: Array) -> Array:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), Rodrigues."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    k = cross(w)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + a * k + b * (k @ k)


def cross(v: Array) -> Array:
    """The matrices [v]x, (..., 3) -> (..., 3, 3)."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack(
        [np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2
    )


def log(rotation: Array) -> Array:
    """Rotation vectors (N, 3) of rotations (N, 3, 3)."""
    return np.array([Pose(r, np.zeros(3)).rotation_vector() for r in rotation]).reshape(-1, 3)


def angle_between(a: Array, b: Array) -> Array:
    """Angles between rotations, radians, (..., 3, 3) -> (...)."""
    # |A - B|^2 = 8 sin^2(t / 2): exact for small angles, where the trace cancels
    half = np.linalg.norm(a - b, axis=(-2, -1)) / math.sqrt(8)
    return np.asarray(2 * np.arcsin(np.clip(half, 0, 1)))


def adjust(
    matches: Matches,
    start: Array,
    camera: CameraModel,
    *,
    freedom: Freedom = KNOWN,
    prior: Array | None = None,
    prior_sigma: Array | None = None,
) -> Adjusted:
    """Rotations of all frames, and the lens as far as `freedom` says, from `matches`.

    `start` (N, 3, 3) are world_from_camera; `prior` the tracker's, with `prior_sigma` (N,)
    radians an axis (infinite where there is none). Without priors the first frame stays.

    Raises
    ------
    ValueError
        When there is no match.

    """
    if len(matches.frames) == 0:
        raise ValueError("no matches")
    count, size = len(start), 3 * len(start)
    rotations, lens = start.copy(), camera
    known = np.zeros(count, bool) if prior_sigma is None else np.isfinite(prior_sigma)
    lens_prior = freedom.sigmas(float(camera.intrinsics[0])) if freedom.count else np.zeros(0)
    problem = _Problem(matches, freedom, camera)
    damping, scale, iteration = 1e-9, math.inf, 0
    e, jacobian = problem.residuals(rotations, lens)
    for iteration in range(1, ITERATIONS + 1):  # noqa: B007
        norm = np.linalg.norm(e, axis=1)
        # from all matches to the half that agrees best, step by step
        middle, most = np.percentile(norm, [50, 80])
        floor = max((HALF if most > TAIL * middle else 1.0) * float(middle), FEATURE)
        scale = min(max(0.8 * scale, floor), max(float(middle), FEATURE))
        weight = 1 / (1 + (norm / (2 * scale)) ** 2) ** 2 / scale**2
        hessian, gradient = problem.normal(e, jacobian, weight, count)
        if freedom.count:
            hessian[size:, size:] += np.diag(1 / lens_prior**2)
            gradient[size:] += unknowns(lens, freedom, camera) / lens_prior**2
        if prior is not None and prior_sigma is not None and known.any():
            _add_prior(hessian, gradient, rotations, prior, prior_sigma, known)
        else:
            hessian[:3, :3] += np.eye(3) * float(np.trace(hessian)) / size
        before = _cost(norm, scale)
        while True:
            step = _solve(hessian, gradient, damping)
            trial = _orthonormal(exp(step[:size].reshape(-1, 3)) @ rotations)
            trial_lens = moved(lens, freedom, step[size:]) if freedom.count else lens
            tried = problem.residuals(trial, trial_lens)
            after = _cost(np.linalg.norm(tried[0], axis=1), scale)
            if after <= before * (1 + 1e-6) or damping > 1e4:
                break
            damping = max(damping, 1e-6) * 10
        damping = max(damping / 10, 1e-9)
        rotations, lens = trial, trial_lens
        e, jacobian = tried
        if float(np.abs(step[:size]).max()) < SETTLED and scale <= 1.01 * floor:
            break
    told = np.full(count, math.inf) if prior_sigma is None else prior_sigma
    return _summary(
        problem, rotations, lens, scale, prior, told, iteration, freedom, lens_prior
    )


def _add_prior(
    hessian: Array,
    gradient: Array,
    rotations: Array,
    prior: Array,
    sigma: Array,
    known: NDArray[np.bool_],
) -> None:
    """The tracker's rotations as observations; one that is far off loses its weight."""
    off = log(rotations[known] @ np.swapaxes(prior[known], 1, 2))
    far = np.linalg.norm(off, axis=1) / (sigma[known] * math.sqrt(3))
    for i, d, times in zip(np.flatnonzero(known), off, far, strict=True):
        weight = 1 / (1 + (times / 2.5) ** 2) ** 2 / float(sigma[i]) ** 2
        at = slice(3 * i, 3 * i + 3)
        hessian[at, at] += weight * np.eye(3)
        gradient[at] += weight * d


class _Problem:
    """Residuals and normal equations of one set of matches."""

    def __init__(self, matches: Matches, freedom: Freedom, camera: CameraModel) -> None:
        order = np.lexsort((matches.frames[:, 1], matches.frames[:, 0]))
        self.order = order
        self.frames = matches.frames[order]
        self.first, self.second = matches.first[order], matches.second[order]
        self.sigma, self.freedom = matches.sigma[order], freedom
        self.width = self._widths(camera)
        self.starts = np.flatnonzero(
            np.r_[True, (np.diff(self.frames, axis=0) != 0).any(axis=1)]
        )

    def _widths(self, lens: CameraModel) -> Array:
        a, b = pixel_angle(lens, self.first), pixel_angle(lens, self.second)
        return np.sqrt((a**2 + b**2) / 2)

    def pixels_off(self, rotations: Array, lens: CameraModel) -> Array:
        """Distance of the two ends in pixels, (M,), in the order of the matches."""
        a = np.einsum("mab,mb->ma", rotations[self.frames[:, 0]], lens.unproject(self.first))
        b = np.einsum("mab,mb->ma", rotations[self.frames[:, 1]], lens.unproject(self.second))
        result = np.empty(len(a))
        result[self.order] = np.linalg.norm(a - b, axis=1) / self._widths(lens)
        return result

    def residuals(self, rotations: Array, lens: CameraModel) -> tuple[Array, Array]:
        """Weighted differences (M, 3) and their derivatives (M, 3, 6 + P), sorted by pair."""
        u, du = rays(lens, self.freedom, self.first)
        v, dv = rays(lens, self.freedom, self.second)
        of_a, of_b = rotations[self.frames[:, 0]], rotations[self.frames[:, 1]]
        a, b = np.einsum("mab,mb->ma", of_a, u), np.einsum("mab,mb->ma", of_b, v)
        unit = 1 / (self.width * self.sigma)
        parts = [-cross(a), cross(b)]
        if self.freedom.count:
            parts.append(of_a @ du - of_b @ dv)
        jacobian = np.concatenate(parts, axis=2) * unit[:, None, None]
        e = (a - b) * unit[:, None]
        lost = ~np.isfinite(e).all(axis=1)  # outside the lens as it is now
        e[lost], jacobian[lost] = 1e3, 0.0
        return e, jacobian

    def normal(
        self, e: Array, jacobian: Array, weight: Array, count: int
    ) -> tuple[Array, Array]:
        """J' W J and J' W e, summed block by block over pairs of frames."""
        p = self.freedom.count
        weighted = jacobian * weight[:, None, None]
        block = np.matmul(np.swapaxes(weighted, 1, 2), jacobian)
        slope = np.matmul(np.swapaxes(weighted, 1, 2), e[..., None])[..., 0]
        blocks = np.add.reduceat(block, self.starts, axis=0)
        slopes = np.add.reduceat(slope, self.starts, axis=0)
        size = 3 * count
        hessian, gradient = np.zeros((size + p, size + p)), np.zeros(size + p)
        for (i, j), one, s in zip(self.frames[self.starts], blocks, slopes, strict=True):
            at = np.r_[3 * i : 3 * i + 3, 3 * j : 3 * j + 3, size : size + p]
            hessian[np.ix_(at, at)] += one
            gradient[at] += s
        return hessian, gradient


def _cost(norm: Array, scale: float) -> float:
    """Geman and McClure's: r^2 / (1 + r^2), r = norm / (2 scale)."""
    r2 = (norm / (2 * scale)) ** 2
    return float((r2 / (1 + r2)).sum())


def _solve(hessian: Array, gradient: Array, damping: float) -> Array:
    from scipy.linalg import cho_factor, cho_solve

    diagonal = np.diag(hessian)
    # unknowns of very different size: radians and distortion
    unit = 1 / np.sqrt(np.maximum(diagonal, 1e-12 * float(diagonal.max())))
    scaled = hessian * unit[:, None] * unit[None, :]
    scaled[np.diag_indices_from(scaled)] += damping + 1e-12
    return -unit * cho_solve(cho_factor(scaled), unit * gradient)


def _orthonormal(rotations: Array) -> Array:
    u, _, vt = np.linalg.svd(rotations)
    return u @ vt


def _summary(
    problem: _Problem,
    rotations: Array,
    lens: CameraModel,
    scale: float,
    prior: Array | None,
    prior_sigma: Array,
    iterations: int,
    freedom: Freedom,
    lens_prior: Array,
) -> Adjusted:
    count, size = len(rotations), 3 * len(rotations)
    e, jacobian = problem.residuals(rotations, lens)
    norm = np.linalg.norm(e, axis=1)
    alive = norm < REACH * scale
    # the sandwich A^-1 B A^-1 (Huber 1967): true whatever the residuals' distribution is
    q = (norm / (2 * scale)) ** 2
    weight = 1 / (1 + q) ** 2
    bent = np.einsum("mka,mk->ma", jacobian, e)[:, None]  # J' e as a row
    hessian, _ = problem.normal(e, jacobian, weight, count)
    curved, _ = problem.normal(e[:, :1], bent, (1 + q) ** -3 / scale**2, count)
    middle, _ = problem.normal(e[:, :1], bent, weight**2, count)
    if float(np.linalg.eigvalsh(hessian - curved)[3:].min(initial=1.0)) > 0:
        hessian = hessian - curved
    if freedom.count:
        hessian[size:, size:] += np.diag(float(np.mean(weight * norm**2)) / 2 / lens_prior**2)
    linked = np.bincount(problem.frames[alive].ravel(), minlength=count) > 0
    # free network: errors against the mean of all rotations, which the matches leave open;
    # frames without matches take no part
    gauge = np.zeros((size + freedom.count, 3))
    gauge[:size] = np.kron(linked[:, None], np.eye(3))
    free = np.diag(hessian) > 0
    free[:size] &= np.repeat(linked, 3)
    unit = np.where(free, 1 / np.sqrt(np.where(free, np.diag(hessian), 1)), 0)
    scaled = hessian * unit[:, None] * unit[None, :]
    values, vectors = np.linalg.eigh(scaled)
    lost = int((~free).sum()) + 3  # and the gauge
    kept = values > 1e-10 * values[-1]
    kept[:lost] = False
    positive = values[lost:]
    condition = (
        float(positive[-1] / max(positive[0], 1e-18 * positive[-1]))
        if len(positive)
        else math.inf
    )
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    inverse = inverse * unit[:, None] * unit[None, :]
    covariance = inverse @ middle @ inverse
    project = np.eye(len(gauge)) - gauge @ np.linalg.pinv(gauge)
    covariance = project @ covariance @ project.T
    spread = np.sqrt(np.maximum(np.diag(covariance), 0))
    known = np.isfinite(prior_sigma)
    off = np.full(count, np.nan)
    if prior is not None:
        off[known] = angle_between(rotations[known], prior[known])
    inliers = np.empty(len(alive), bool)
    inliers[problem.order] = alive
    return Adjusted(
        rotations=rotations,
        camera=lens,
        inliers=inliers,
        residuals=problem.pixels_off(rotations, lens),
        sigma=np.where(linked, spread[:size].reshape(-1, 3).max(axis=1), prior_sigma),
        lens_sigma=spread[size:],
        condition=condition,
        prior_residual=off,
        iterations=iterations,
    )
