"""Alignment of hand-held brackets: sub-pixel, with a standard error and a verdict a frame.

Two exposures of one scene differ by a monotone map of their codes: the response and the ratio
of exposures where they are known, else the map that matches the ranks of commonly exposed
pixels. After it both are compared where neither is clipped or black, local means removed.

For frames one and two exposures apart:

1. start: masked normalised cross-correlation (Padfield 2012) on a small level, at several
   rotations; its best peaks are refined and the best of them kept, another as good is
   ambiguity and said so;
2. a pyramid of Gauss-Newton steps (Lucas and Kanade 1981). Normal equations are summed per
   tile, and the motion is fitted to the tiles with redescending weights: what moves by itself,
   and borders that stay, are outliers.

Then all frames together: the tiles of all pairs are the observations
T_j(y_k) = T_i(x_k) of the transforms T to the reference. A tile's covariance is H^-1 + tau^2,
tau^2 from the scatter between tiles (DerSimonian and Laird 1986); the standard error is the
sandwich over tiles. The model (shift; shift and rotation; homography) is the one with the
least BIC.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.frames import KINDS, check_frames
from chromeball.hdr.match import (
    LEAST_TILES,
    MODELS,
    OUTLIER,
    Float,
    Mask,
    Pair,
    apply,
    best_channel,
    exponential,
    fields,
    inverse_of,
    match,
    plane,
    pyramid,
    scatter,
)
from chromeball.scene.errors import UserError

#: pixels of the finest level that is compared; larger frames are averaged down to it
FINEST = 1_000_000
#: error (pixels of the finest level) that interpolation leaves: the largest of known shifts
INTERPOLATION = 0.01
#: verdict: largest standard error and disagreement of halves (pixels of the frame), fewest
#: tiles that agree, least share of the tiles that do
MOST_SIGMA, MOST_SPLIT, LEAST_SHARE = 0.3, 1.0, 0.3


@dataclass(frozen=True)
class Alignment:
    """Where each frame's pixels lie in the reference frame.

    ``transforms`` (P, 3, 3): frame to reference, pixel centres at integers, ``model`` one of
    shift, rotation, homography. ``sigma`` (P,): standard error in pixels, rms over the tiles
    that measure the frame (infinite where none does). ``residual`` (P,): robust scatter of its
    tiles in pixels. ``split`` (P,): rms distance in pixels between the transforms of two
    disjoint halves of the tiles. ``tiles`` (P,): tiles that agree. ``flags`` (P,): empty, or
    why the frame's transform is not to be trusted. ``displacement`` (P,): the farthest that a
    corner of the picture moves, in pixels.
    """

    reference: int
    model: str
    transforms: Float
    sigma: Float
    residual: Float
    split: Float
    tiles: NDArray[np.int64]
    displacement: Float
    flags: tuple[str, ...]

    @property
    def confident(self) -> Mask:
        """(P,): frames without a flag."""
        return np.array([not flag for flag in self.flags])


def align(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    log_exposure: Float | None = None,
    *,
    reference: int | None = None,
    models: Sequence[str] = ("shift", "rotation", "homography"),
) -> Alignment:
    """Find the motion of every frame (H, W, C), uint8, uint16 or float32, to the reference.

    `exposures` (P,) order the frames; with `log_exposure` (C, codes), the response of frames
    of codes, they give the map between the codes too. Without it the map is measured, so no
    response is needed. `reference` is the best exposed frame unless given. `models` are those
    that may be chosen.

    Raises
    ------
    UserError
        No frames, frames of different shapes, exposures that do not fit, frames under 32
        pixels a side.

    """
    _refuse(frames, exposures, log_exposure, reference, models)
    P, (height, width) = len(frames), frames[0].shape[:2]
    order = np.argsort(exposures, kind="stable")
    channel = best_channel(frames, order)
    factor = max(1, int(np.ceil(np.sqrt(height * width / FINEST))))
    white = None
    curve = None
    if log_exposure is not None:
        white = log_exposure.shape[1] - 1.0
        curve = np.interp(
            np.arange(256) * white / 255, np.arange(white + 1), log_exposure[channel]
        )
    elif frames[0].dtype != np.uint8:
        white = max(float(f.max()) for f in frames)
    root = log_exposure is None
    pyramids = [pyramid(plane(f, channel, factor, white, root=root)) for f in frames]
    exposed = np.array([levels[0].valid.mean() for levels in pyramids])
    chosen = int(np.argmax(exposed)) if reference is None else reference

    def pair(i: int, j: int, guess: Float | None) -> Pair:
        known = None
        if curve is not None:
            known = (curve, float(np.log(exposures[j] / exposures[i])))
        return match(i, j, pyramids[i], pyramids[j], known, guess, factor, models)

    pairs = [pair(int(i), int(j), None) for i, j in pairwise(order)]
    for k in range(P - 2):
        sound = not (pairs[k].flag or pairs[k + 1].flag)
        guess = pairs[k + 1].M @ pairs[k].M if sound else None
        pairs.append(pair(int(order[k]), int(order[k + 2]), guess))
    return _joint(pairs, P, chosen, order, (height, width), factor, models)


def is_needed(alignment: Alignment, tolerance: float = 0.15) -> bool:
    """Whether any frame that could be measured moved by more than `tolerance` pixels.

    A corner's motion counts only beyond two standard errors, so noise is not motion.
    """
    seen = np.isfinite(alignment.sigma)
    moved = alignment.displacement - 2 * np.where(seen, alignment.sigma, 0)
    return bool(np.any(seen & alignment.confident & (moved > tolerance)))


def warp(
    frame: NDArray[Any], transform: Float, white: float | None = None
) -> tuple[NDArray[Any], Mask]:
    """Resample a frame (H, W, C) to the reference; also (H, W) bool, where it has pixels.

    Catmull-Rom cubic (Keys 1981), held within the range of the four nearest pixels: no code
    appears that is not between its neighbours, and edges do not ring. Where one of these four
    is clipped (`white`: 255, 65535, or the frame's largest float) the result is clipped, where
    one is zero it is zero. Whole-pixel shifts copy pixels. Pixels from outside are zero.

    Noise: the variance of independent pixels falls by the sum of squared weights, to 0.41 at
    half a pixel in both directions and to 0.66 on average over all fractions; neighbours
    become correlated.

    Raises
    ------
    UserError
        A transform that is singular or sends part of the picture to infinity.

    """
    if frame.ndim != 3 or str(frame.dtype) not in KINDS:
        raise UserError("frames to warp are (H, W, C) of 8-bit, 16-bit or float values")
    if transform.shape != (3, 3) or not np.all(np.isfinite(transform)):
        raise UserError("a transform is 3 x 3 finite numbers")
    if abs(np.linalg.det(transform)) < 1e-9:
        raise UserError("the transform is singular: the picture would be a line")
    height, width = frame.shape[:2]
    inverse = np.linalg.inv(transform)
    inverse = np.ascontiguousarray(inverse / inverse[2, 2])
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]).T
    if np.any((inverse @ corners)[2] < 1e-3):
        raise UserError("the transform sends part of the picture to infinity")
    frame = np.ascontiguousarray(frame)
    if frame.dtype == np.uint8:
        return kernel.warp_u8(frame, inverse, 255.0 if white is None else white)
    if frame.dtype == np.uint16:
        return kernel.warp_u16(frame, inverse, 65535.0 if white is None else white)
    return kernel.warp_f32(frame, inverse, float(frame.max()) if white is None else white)


# all frames ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Observations:
    """Tiles of all pairs: x in frame i, y in frame j; (n, ...); `edge` numbers the pair."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    edge: NDArray[np.int64]
    x: Float
    y: Float
    cov: Float

    def part(self, keep: Mask) -> _Observations:
        return _Observations(
            self.i[keep],
            self.j[keep],
            self.edge[keep],
            self.x[keep],
            self.y[keep],
            self.cov[keep],
        )


@dataclass(frozen=True)
class _Joint:
    T: Float  # (P, 3, 3)
    cov: Float  # (P, k, k) of the parameters of each frame
    e: Float  # (n, 2)
    W: Float  # (n, 2, 2)
    robust: Float  # (n,)


def _observations(pairs: Sequence[Pair]) -> _Observations:
    columns: list[list[Any]] = [[], [], [], [], [], []]
    for number, pair in enumerate(pairs):
        cov = inverse_of(pair.tiles.H)
        u = np.einsum("nij,nj->ni", cov, pair.tiles.b)
        near = np.hypot(*u.T) < 4 * np.sqrt(np.prod(np.ptp(pair.tiles.x, axis=0) + 1)) / 4
        n = int(near.sum())
        x = pair.tiles.x[near]
        row = (
            np.full(n, pair.i),
            np.full(n, pair.j),
            np.full(n, number),
            x,
            apply(pair.M, x + u[near]),
            cov[near],
        )
        for column, value in zip(columns, row, strict=True):
            column.append(value)
    return _Observations(*(np.concatenate(column) for column in columns))


def _solve(
    seen: _Observations,
    T: Float,
    free: NDArray[np.int64],
    count: int,
    frame: tuple[Float, float],
    fixed: tuple[Float, Float] | None = None,
) -> _Joint:
    """Gauss-Newton on T_i(x) = T_j(y) over the frames `free`, `count` parameters each."""
    centre, scale = frame
    n, size = len(seen.x), len(free) * count
    moved_by = T.copy()
    place = np.full(len(moved_by), -1)
    place[free] = np.arange(len(free))
    robust = np.ones(n) if fixed is None else fixed[1]
    precision = inverse_of(seen.cov) if fixed is None else fixed[0]

    def positions(at: NDArray[np.int64], x: Float) -> Float:
        flat = np.concatenate([x, np.ones((n, 1))], axis=1)
        moved = np.einsum("nij,nj->ni", moved_by[at], flat)
        return moved[:, :2] / moved[:, 2:]

    normal, pulled, e = np.eye(size), np.zeros((2 * n, size)), np.zeros((n, 2))
    for step in range(12 if fixed is None else 4):
        xi, yj = positions(seen.i, seen.x), positions(seen.j, seen.y)
        e = yj - xi
        if fixed is None:
            for number in np.unique(seen.edge):
                mine = seen.edge == number
                tau2 = scatter(e[mine], seen.cov[mine])
                precision[mine] = inverse_of(seen.cov[mine] + tau2 * np.eye(2))
            chi2 = np.einsum("ni,nij,nj->n", e, precision, e)
            robust = (1 + chi2 / (OUTLIER * max(1, 8 >> step))) ** -2
        slots = np.zeros((n, 2, len(free), count))
        for at, points, sign in ((seen.i, xi, 1.0), (seen.j, yj, -1.0)):
            moves = place[at] >= 0
            slots[np.flatnonzero(moves), :, place[at][moves]] += sign * fields(
                points[moves], centre, scale, count
            )
        J = slots.reshape(n, 2, size)
        pulled = ((precision * robust[:, None, None]) @ J).reshape(2 * n, size)
        normal = pulled.T @ J.reshape(2 * n, size)
        normal += 1e-10 * np.trace(normal) / size * np.eye(size)
        p = np.linalg.solve(normal, pulled.T @ e.reshape(2 * n)).reshape(-1, count)
        for number, part in zip(free, p, strict=True):
            moved_by[number] = exponential(part, centre, scale) @ moved_by[number]
            moved_by[number] /= moved_by[number, 2, 2]
    score = np.einsum("nij,ni->nj", pulled.reshape(n, 2, size), e)
    inverse = np.linalg.inv(normal)
    # errors of neighbouring tiles, and of a place in several pairs, are one error
    _, cell = np.unique(_cells(seen.x, scale), axis=0, return_inverse=True)
    cluster = np.zeros((int(cell.max()) + 1, size))
    np.add.at(cluster, cell.reshape(-1), score)
    whole = inverse @ (cluster.T @ cluster) @ inverse
    cov = np.zeros((len(moved_by), count, count))
    for k, number in enumerate(free):
        cov[number] = whole[k * count : (k + 1) * count, k * count : (k + 1) * count]
    return _Joint(moved_by, cov, e, precision, robust)


def _tree(pairs: Sequence[Pair], P: int, reference: int) -> tuple[Float, Mask]:
    """First transforms by the best pairs, and which frames unflagged ones reach."""
    T = np.repeat(np.eye(3)[None], P, axis=0)
    reached = np.arange(P) == reference
    sound = reached.copy()
    while not reached.all():
        # sound pairs first, then neighbours (they come first), by correlation
        edges = [p for p in pairs if reached[p.i] != reached[p.j]]
        edge = max(edges, key=lambda p: (sound[p.i] | sound[p.j], not p.flag, p.ncc))
        M = edge.M if np.all(np.isfinite(edge.M)) else np.eye(3)
        if reached[edge.j]:
            new, old, T[edge.i] = edge.i, edge.j, T[edge.j] @ M
        else:
            new, old, T[edge.j] = edge.j, edge.i, T[edge.i] @ np.linalg.inv(M)
        reached[new] = True
        sound[new] = sound[old] and not edge.flag
    return T / T[:, 2:, 2:], sound


def _joint(
    pairs: Sequence[Pair],
    P: int,
    reference: int,
    order: NDArray[np.int64],
    shape: tuple[int, int],
    factor: int,
    models: Sequence[str],
) -> Alignment:
    height, width = shape
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    frame = centre, float(np.hypot(height, width) / 2)
    transforms, sound = _tree(pairs, P, reference)
    used = [p for p in pairs if not p.flag and sound[p.i] and sound[p.j]]
    free = np.flatnonzero(sound & (np.arange(P) != reference))
    sigma, split, residual = (np.full(P, np.inf) for _ in range(3))
    tiles = np.zeros(P, np.int64)
    share = np.zeros(P)
    name = next(m for m in MODELS if m in models)
    if len(free):
        seen = _observations(used)
        name, joint = _best_model(seen, transforms, free, frame, models)
        transforms = joint.T
        count = MODELS[name]
        halves = [
            _solve(seen.part(_half(seen.x, frame[1]) == k), transforms, free, count, frame).T
            for k in (0, 1)
        ]
        agree = joint.robust > 0.25
        for number in free:
            mine = (seen.i == number) | (seen.j == number)
            points = np.where((seen.i == number)[:, None], seen.x, seen.y)[mine]
            F = fields(apply(transforms[number], points), *frame, count)
            variance = np.einsum("nij,jk,nik->n", F, joint.cov[number], F)
            apart = apply(halves[0][number], points) - apply(halves[1][number], points)
            split[number] = np.sqrt(np.mean((apart**2).sum(axis=1)))
            # halves differ by twice the error of the whole
            spread = max(float(variance.mean()), split[number] ** 2 / 4)
            sigma[number] = np.sqrt(spread + (INTERPOLATION * factor) ** 2)
            tiles[number], share[number] = (
                (agree & mine).sum(),
                (agree & mine).sum() / mine.sum(),
            )
            weight = joint.robust[mine] * np.trace(joint.W[mine], axis1=1, axis2=2)
            squares = (joint.e[mine] ** 2).sum(axis=1)
            residual[number] = np.sqrt((weight @ squares) / weight.sum())
    for k in np.flatnonzero(~sound).tolist():
        # nothing known: as the nearest exposure that is known
        known = min(
            np.flatnonzero(sound).tolist(), key=lambda m: abs(_rank(order, k) - _rank(order, m))
        )
        transforms[k] = transforms[known]
    sigma[reference] = split[reference] = residual[reference] = 0.0
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
    moved = np.array([np.hypot(*(apply(t, corners) - corners).T).max() for t in transforms])
    flags = [""] * P
    for k in range(P):
        if k == reference:
            continue
        if not sound[k]:
            mine = [p for p in pairs if k in (p.i, p.j) and p.flag]
            reasons = [p.flag for p in mine if abs(_rank(order, p.i) - _rank(order, p.j)) == 1]
            flags[k] = (reasons or ["it links to the reference by doubtful frames only"])[0]
        elif sigma[k] > MOST_SIGMA:
            flags[k] = f"its standard error is {sigma[k]:.2f} pixels"
        elif split[k] > MOST_SPLIT:
            flags[k] = f"two halves of the picture differ by {split[k]:.2f} pixels"
        elif tiles[k] < LEAST_TILES or share[k] < LEAST_SHARE:
            flags[k] = f"only {tiles[k]} tiles ({share[k]:.0%}) agree on a motion"
    return Alignment(
        reference, name, transforms, sigma, residual, split, tiles, moved, tuple(flags)
    )


def _best_model(
    seen: _Observations,
    T: Float,
    free: NDArray[np.int64],
    frame: tuple[Float, float],
    models: Sequence[str],
) -> tuple[str, _Joint]:
    """The model of least BIC; noise and scatter are those of the richest."""
    n = len(seen.x)
    names = [m for m in MODELS if m in models]
    names = [m for m in names if 2 * n > 3 * MODELS[m] * len(free)] or names[:1]
    rich = _solve(seen, T, free, MODELS[names[-1]], frame)
    criteria: dict[str, float] = {}
    for name in names:
        start = _restricted(rich.T, name, frame[0])
        fit = _solve(seen, start, free, MODELS[name], frame, (rich.W, rich.robust))
        chi2 = np.einsum("ni,nij,nj->n", fit.e, fit.W, fit.e)
        criteria[name] = float(rich.robust @ chi2) + MODELS[name] * len(free) * np.log(2 * n)
    best = min(criteria, key=lambda m: criteria[m])
    if best == names[-1]:
        return best, rich
    start = _restricted(rich.T, best, frame[0])
    return best, _solve(seen, start, free, MODELS[best], frame)


def _restricted(T: Float, model: str, centre: Float) -> Float:
    """The transforms (P, 3, 3) of the model that move the centre as T do."""
    if model == "homography":
        return T
    out = np.repeat(np.eye(3)[None], len(T), axis=0)
    around = centre + np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1.0]])
    for k, t in enumerate(T):
        moved = apply(t, around)
        right, down = moved[1] - moved[3], moved[2] - moved[4]
        angle = np.arctan2(right[1] - down[0], right[0] + down[1]) if model != "shift" else 0.0
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, -s], [s, c]])
        out[k, :2, :2], out[k, :2, 2] = R, moved[0] - R @ centre
    return out


def _half(x: Float, scale: float) -> NDArray[np.int64]:
    """0 or 1 by a chessboard over the picture."""
    return _cells(x, scale).sum(axis=1) % 2


def _cells(x: Float, scale: float) -> NDArray[np.int64]:
    return np.floor(x / (scale / 8)).astype(np.int64)


def _rank(order: NDArray[np.int64], frame: int) -> int:
    return int(np.flatnonzero(order == frame)[0])


def _refuse(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    log_exposure: Float | None,
    reference: int | None,
    models: Sequence[str],
) -> None:
    check_frames(frames, exposures, log_exposure)
    if min(frames[0].shape[:2]) < 32:
        raise UserError("pictures under 32 pixels a side are too small to be aligned")
    if reference is not None and not 0 <= reference < len(frames):
        raise UserError(f"there is no frame {reference} to be the reference")
    if not models or any(m not in MODELS for m in models):
        raise UserError(f"a model is one of {', '.join(MODELS)}")
