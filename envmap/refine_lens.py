"""The lens of a probe's shots from their overlap: its field of view, and each circle's centre.

What a rim sees, the other rims see, too: where the angle of the rim is taken wrong, the same
things stand in the map twice or not at all. The field of view is searched first, together with
the turns; then focal length, centres and turns are solved for at once, by least squares of log
luminance with a smooth ratio of each pair (harmonics of order 2) projected out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.harmonics import sh_basis
from chromeball.envmap.mapping import LatLong, Radial
from chromeball.envmap.probe import Shot, refined
from chromeball.envmap.refine import Refined
from chromeball.scene.color import luminance
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

_SCALES = np.exp(np.linspace(-0.14, 0.14, 15))  # of the angle at the rim
_REACH = math.radians(6)
_COARSE = 384  # pixels across, of the search
_CENTRE = 0.015  # how far a centre may lie from where it was said, in radii: prior's sigma
_RIM = 0.985  # of the circle's radius: beyond it the picture is no longer sharp
_SAMPLES = 12000
_SHARED = 0.5  # correlation below which the overlap is not believed


@dataclass(frozen=True)
class Lenses:
    """Refined lenses.

    ``fov`` across the circles and its standard error, radians; ``centres`` (N, 2) pixels and
    their standard errors; ``correlation`` of the shots where they overlap.
    """

    shots: list[Shot]
    rotations: list[Array]
    fov: float
    fov_sigma: float
    centres: Array
    centre_sigma: Array
    correlation: float


def refine_lenses(shots: Sequence[Shot], rotations: Sequence[Array], fixed: int = 0) -> Lenses:
    """One lens for all shots: focal length, the circles' centres, and the shots' turns.

    The radius of each image circle is kept, in pixels: the angle at its rim changes.

    Raises
    ------
    UserError
        When a shot has no image circle, or the shots show too little in common.

    """
    if len(shots) < 2:
        raise UserError("a lens is refined from what two shots or more see together")
    if not all(isinstance(shot.mapping, Radial) for shot in shots):
        raise UserError("only fisheyes with an image circle are refined from their overlap")
    found: list[tuple[float, list[Shot], list[Array], Refined]] = []
    for scale in _SCALES:
        trial = [_scaled(shot, float(scale)) for shot in shots]
        if max(_radial(shot).max_angle for shot in trial) < math.pi * 0.995:
            turned, result = refined(trial, rotations, fixed, _COARSE, _REACH, insist=True)
            found.append((result.significance, trial, turned, result))
    if not found:
        raise UserError("the circles already see all around; their angle cannot be refined")
    _, best, turns, result = max(found, key=lambda entry: entry[0])
    if result.correlation[1] < _SHARED:
        raise UserError(
            "the lens cannot be refined: what the shots share is too plain, or differs "
            f"(correlation {result.correlation[1]:.2f})"
        )
    return _solve(best, turns, fixed)


def _radial(shot: Shot) -> Radial:
    assert isinstance(shot.mapping, Radial)
    return shot.mapping


def _scaled(shot: Shot, scale: float) -> Shot:
    """The angle at the rim times `scale`, by another focal length."""
    lens = _radial(shot)
    rim = float(lens.radius(np.array([lens.max_angle * scale]))[0])
    return replace(shot, mapping=_with_focal(lens, lens.rim / rim))


def _with_focal(lens: Radial, factor: float) -> Radial:
    """Another focal length; the circle's radius in pixels stays."""
    angle = float(lens.angle(np.array([lens.rim / factor]))[0])
    focal = (lens.focal[0] * factor, lens.focal[1] * factor)
    return replace(lens, focal=focal, max_angle=angle)


def _solve(shots: Sequence[Shot], rotations: Sequence[Array], fixed: int) -> Lenses:
    """Least squares over ln focal length, centres and turns."""
    import cv2
    from scipy.optimize import least_squares

    count = len(shots)
    lenses = [_radial(shot) for shot in shots]
    radii = np.array([lens.rim * abs(lens.focal[0]) for lens in lenses])
    pictures: list[NDArray[np.float32]] = []
    for shot in shots:
        y = luminance(shot.radiance).astype(np.float32)
        floor = 1e-3 * float(np.median(y[y > 0])) if (y > 0).any() else 1.0
        pictures.append(
            np.asarray(cv2.GaussianBlur(np.log(y + floor), (0, 0), 1.5), np.float32)
        )
    free = [k for k in range(count) if k != fixed]

    def unpacked(p: Array) -> tuple[float, Array, list[Array]]:
        turns = list(rotations)
        for n, k in enumerate(free):
            vector = p[1 + 2 * count + 3 * n : 4 + 2 * count + 3 * n]
            turns[k] = Pose.from_rotation_vector(vector, np.zeros(3)).rotation @ rotations[k]
        return math.exp(p[0]), p[1 : 1 + 2 * count].reshape(count, 2) * radii[:, None], turns

    def sampled(k: int, p: Array, d: Array) -> tuple[Array, Array]:
        """Log luminance of shot k in directions d, and how far out they lie, 1 at the rim."""
        factor, shifts, turns = unpacked(p)
        lens = lenses[k]
        local = d @ turns[k]
        theta = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        phi = np.arctan2(local[:, 1], local[:, 0])
        r = factor * lens.radius(np.minimum(theta, math.pi * 0.99))
        x = lens.centre[0] + shifts[k, 0] + lens.focal[0] * r * np.cos(phi)
        y = lens.centre[1] + shifts[k, 1] + lens.focal[1] * r * np.sin(phi)
        rows = np.zeros((2, -(-len(d) // 1024) * 1024), np.float32)
        rows[0, : len(d)], rows[1, : len(d)] = x, y
        maps = rows.reshape(2, -1, 1024)
        got = cv2.remap(pictures[k], maps[0], maps[1], cv2.INTER_CUBIC)
        return np.asarray(got, float).reshape(-1)[: len(d)], r / lens.rim

    start = np.zeros(1 + 2 * count + 3 * len(free))
    grid = LatLong((1024, 512))
    d = grid.directions().reshape(-1, 3)
    rng = np.random.default_rng(0)
    d = d[rng.random(len(d)) < grid.solid_angles().reshape(-1) / grid.solid_angles().max()]
    inside = [sampled(k, start, d)[1] < _RIM for k in range(count)]
    pairs: list[tuple[int, int, Array, Array]] = []
    for i in range(count):
        for j in range(i + 1, count):
            both = np.flatnonzero(inside[i] & inside[j])
            if len(both) > 500:
                both = rng.permutation(both)[:_SAMPLES]
                smooth, _ = np.linalg.qr(sh_basis(d[both]))
                pairs.append((i, j, d[both], smooth))
    if not pairs:
        raise UserError("no two circles overlap enough to refine their lens")

    def differences(p: Array) -> list[Array]:
        result: list[Array] = []
        for i, j, there, smooth in pairs:
            r = sampled(i, p, there)[0] - sampled(j, p, there)[0]
            result.append(r - smooth @ (smooth.T @ r))
        return result

    first = np.concatenate(differences(start))
    noise = 1.4826 * float(np.median(np.abs(first))) + 1e-9

    def residuals(p: Array) -> Array:
        prior = p[1 : 1 + 2 * count] / _CENTRE
        return np.concatenate([*(r / noise for r in differences(p)), prior])

    fit = least_squares(
        residuals, start, loss="soft_l1", diff_step=1e-4, x_scale=0.003, max_nfev=40
    )
    # neighbouring samples err together: some six pixels across are one
    data = len(first)
    pixel = radii.mean() / max(lens.max_angle for lens in lenses)  # pixels a radian
    shared = sum(float(len(there)) for _, _, there, _ in pairs) / len(d) * 4 * math.pi
    independent = min(1.0, shared * (pixel / 6) ** 2 / data)
    spread = float(np.mean(np.minimum(fit.fun[:data] ** 2, 9))) / independent
    normal = fit.jac.T @ fit.jac
    covariance = np.linalg.pinv(normal, hermitian=True) * spread
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0))
    factor, shifts, turns = unpacked(fit.x)
    solved = [
        replace(
            shot,
            mapping=replace(
                _with_focal(lens, factor),
                centre=(lens.centre[0] + shift[0], lens.centre[1] + shift[1]),
            ),
        )
        for shot, lens, shift in zip(shots, lenses, shifts, strict=True)
    ]
    ends = [
        float(lens.angle(np.array([lens.rim / math.exp(fit.x[0] + step)]))[0])
        for lens in lenses[:1]
        for step in (-sigma[0], sigma[0])
    ]
    ab = aa = bb = 0.0
    for i, j, there, smooth in pairs:
        a, b = (sampled(k, fit.x, there)[0] for k in (i, j))
        a, b = (v - smooth @ (smooth.T @ v) for v in (a, b))
        ab, aa, bb = ab + float(a @ b), aa + float(a @ a), bb + float(b @ b)
    return Lenses(
        shots=solved,
        rotations=turns,
        fov=2 * _radial(solved[0]).max_angle,
        fov_sigma=ends[0] - ends[1],
        centres=np.array([_radial(shot).centre for shot in solved]),
        centre_sigma=sigma[1 : 1 + 2 * count].reshape(count, 2) * radii[:, None],
        correlation=ab / math.sqrt(aa * bb) if aa > 0 and bb > 0 else 0.0,
    )
