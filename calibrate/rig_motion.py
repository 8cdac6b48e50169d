"""Least squares for a rig before a board that moves while its cameras look.

The board's motion is interpolated between the instants, positions in space and turns on SO(3),
by the parabola through an instant and its neighbours; each corner is seen at its own moment,
its frame's time stamp plus its camera's offset plus its row's share of the read-out. Source:
Furgale et al. 2013 for calibration in continuous time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import bow_shape, gradients
from chromeball.calibrate.arrow import cauchy, descend
from chromeball.calibrate.rig_solve import RigEstimate

#: Instants farther apart than so many typical intervals do not tell how the board moved.
WIDEST_GAP = 2.5

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """A rig before a board that moves.

    ``rig`` as without time, its board poses at ``instants`` (F,), seconds, of the board's
    middle. A camera's frame was taken at ``stamps`` (C, F) + ``offsets`` (C,), its rows over
    ``readout`` (C,) seconds around that. ``base`` (C, F) is the instant nearest to a frame;
    ``before`` and ``after`` (F,) are the neighbours that tell the motion around an instant, the
    instant itself where none is near enough.
    """

    rig: RigEstimate
    instants: Array
    stamps: Array
    offsets: Array
    readout: Array
    base: NDArray[np.intp]
    before: NDArray[np.intp]
    after: NDArray[np.intp]

    @classmethod
    def begin(cls, rig: RigEstimate, stamps: Array, seen: NDArray[np.bool_]) -> Motion:
        """From a rig solved as if all looked at once, and which frames (C, F) saw the board."""
        instants = np.full(stamps.shape[1], np.nan)
        placed, timed = seen.any(axis=0), np.isfinite(stamps).any(axis=0)
        instants[timed] = np.nanmean(stamps[:, timed], axis=0)
        instants[placed] = np.nanmean(np.where(seen, stamps, np.nan)[:, placed], axis=0)
        base = np.tile(np.arange(len(instants)), (len(stamps), 1))
        before, after = _neighbours(instants, placed)
        none = np.zeros(len(stamps))
        return cls(rig, instants, stamps, none, none, base, before, after)

    def rebased(self, seen: NDArray[np.bool_]) -> Motion:
        """Each frame that saw the board (C, F) told from the instant nearest to it now."""
        moments = self.stamps + self.offsets[:, None]
        timed = np.flatnonzero(np.isfinite(self.instants))
        base = self.base.copy()
        far = np.abs(moments[seen][:, None] - self.instants[timed])
        base[seen] = timed[far.argmin(axis=1)]
        # An instant that no frame had been told from begins with the board of one that is now.
        rotations = self.rig.board_rotations.copy()
        translations = self.rig.board_translations.copy()
        known = set(self.base[seen].tolist())
        for old, new in zip(self.base[seen].tolist(), base[seen].tolist(), strict=True):
            if new not in known:
                rotations[new], translations[new] = rotations[old], translations[old]
        used = np.isin(np.arange(len(self.instants)), base[seen])
        before, after = _neighbours(self.instants, used)
        rig = replace(self.rig, board_rotations=rotations, board_translations=translations)
        return replace(self, rig=rig, base=base, before=before, after=after)


def _neighbours(
    instants: Array, used: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The instants before and after each of those `used`, themselves where none is near."""
    index = np.arange(len(instants))
    before, after = index.copy(), index.copy()
    order = index[used][np.argsort(instants[used], kind="stable")]
    if len(order) > 1:
        gaps = np.diff(instants[order])
        near = (gaps > 0) & (gaps < WIDEST_GAP * np.median(gaps))
        before[order[1:][near]], after[order[:-1][near]] = order[:-1][near], order[1:][near]
    return before, after


@dataclass(frozen=True)
class Seen:
    """N corners of all cameras: which camera, frame, point of the board, and where.

    ``row`` is the height in the picture, -1/2 to 1/2 from top to bottom.
    """

    camera: NDArray[np.intp]
    frame: NDArray[np.intp]
    point: Array
    shape: Array
    pixel: Array
    row: Array

    @classmethod
    def of(cls, corners: Array, board: Array, heights: Array) -> Seen:
        """All of `corners` (C, F, rows, columns, 2); the board's middle is its origin."""
        c, v, r, k = np.nonzero(np.isfinite(corners[..., 0]))
        pixel = corners[c, v, r, k]
        middle = board.mean(axis=(0, 1))
        row = (pixel[:, 1] + 0.5) / heights[c] - 0.5
        return cls(c, v, board[r, k] - middle, bow_shape(board)[r, k], pixel, row)

    def only(self, chosen: NDArray[np.bool_]) -> Seen:
        """Some of them."""
        return Seen(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Unknowns:
    """Which shared unknowns there are: rig poses always, offsets, read-outs and the bow."""

    poses: bool
    offsets: bool
    readout: bool

    def count(self, cameras: int) -> int:
        """Shared unknowns of so many cameras."""
        each = 6 * self.poses + 1 * self.offsets
        return each * (cameras - 1) + cameras * self.readout + 2 * self.poses


@dataclass(frozen=True)
class Normal:
    """Sparse normal equations, the shared unknowns first, then six for each instant.

    ``scores`` (F, unknowns) are the parts of the gradient that each instant's corners have.
    """

    matrix: Any
    gradient: Array
    shared: int
    scores: Any

    def step(self, damping: float) -> tuple[Array, Array] | None:
        """Change of the shared (s,) and local (F, 6) unknowns; None where singular."""
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import splu

        diagonal = self.matrix.diagonal()
        try:
            solver = splu((self.matrix + diags_array(damping * diagonal + 1e-12)).tocsc())
        except RuntimeError:  # its word for a singular matrix
            return None
        change = solver.solve(-self.gradient)
        if not np.isfinite(change).all():
            return None
        return change[: self.shared], change[self.shared :].reshape(-1, 6)

    def covariance(self) -> Array:
        """Of the shared unknowns, (s, s), for unit weights; instants, not corners, are random.

        What a parabola misses of the motion moves all corners of an instant at once: from the
        corners' noise alone errors would come out many times too small. The errors are those
        of scores that scatter from instant to instant (Liang and Zeger 1986), where larger.
        """
        from scipy.sparse.linalg import splu

        size = self.matrix.shape[0]
        unit = np.zeros((size, self.shared))
        unit[: self.shared] = np.eye(self.shared)
        columns = np.asarray(splu(self.matrix.tocsc()).solve(unit), float)
        noise = columns[: self.shared]
        moves = self.scores @ columns
        scatter = np.sqrt((moves**2).sum(axis=0) / np.diag(noise))
        larger = np.maximum(scatter, 1.0)
        return larger[:, None] * noise * larger


def adjust_motion(
    motion: Motion,
    seen: Seen,
    unknowns: Unknowns,
    sigma: Array,
    *,
    scale: float = math.inf,
    steps: int = 40,
    least_gain: float = 1e-8,
) -> Motion:
    """The motion of least cost, from a start; `sigma` (C,) deviations of a coordinate."""
    return descend(
        motion,
        lambda at: linearise(at, seen, unknowns, sigma, scale),
        lambda at, shared, poses: _moved(at, unknowns, shared, poses),
        steps=steps,
        least_gain=least_gain,
    )


def errors(motion: Motion, seen: Seen) -> Array:
    """Projected minus observed, (N, 2)."""
    rotations, middles, *_ = _poses(motion, seen)
    found = np.full(seen.pixel.shape, np.nan)
    bowed = _bowed(motion, seen)
    rig = np.einsum("nij,nj->ni", rotations, bowed) + middles
    for c, camera in enumerate(motion.rig.cameras):
        n = seen.camera == c
        points = rig[n] @ motion.rig.rotations[c].T + motion.rig.translations[c]
        found[n] = gradients(camera, points)[0] - seen.pixel[n]
    return found


def linearise(
    motion: Motion, seen: Seen, unknowns: Unknowns, sigma: Array, scale: float = math.inf
) -> tuple[float, Normal]:
    """Cost and normal equations; poses change as exp(w) R, t + dt."""
    from scipy.sparse import csr_array

    rig = motion.rig
    rotations, middles, turns, shifts, by_time = _poses(motion, seen)
    bowed = _bowed(motion, seen)
    turned = np.einsum("nij,nj->ni", rotations, bowed)
    in_rig = turned + middles
    count, cameras, instants = len(in_rig), len(rig.cameras), len(motion.instants)
    s = unknowns.count(cameras)
    error, by_rig = np.zeros((count, 2)), np.zeros((count, 2, 3))
    values: list[Array] = []
    columns: list[NDArray[np.intp]] = []

    def put(rows: Any, block: Array, at: NDArray[np.intp]) -> None:
        """Derivatives (n, 2, m) of corners `rows` by unknowns `at` (n, m)."""
        whole, where = np.zeros((count, *block.shape[1:])), np.zeros((count, at.shape[1]), int)
        whole[rows], where[rows] = block, at
        values.append(whole)
        columns.append(np.repeat(where[:, None], 2, axis=1))

    index = np.arange(count)
    for c, camera in enumerate(rig.cameras):
        n = index[seen.camera == c]
        in_camera = in_rig[n] @ rig.rotations[c].T
        q, by_point, _ = gradients(camera, in_camera + rig.translations[c])
        error[n], by_rig[n] = (q - seen.pixel[n]) / sigma[c], by_point @ rig.rotations[c]
        if c and unknowns.poses:
            block = np.concatenate([np.cross(in_camera[:, None], by_point), by_point], axis=-1)
            put(n, block / sigma[c], np.tile(np.arange(6) + 6 * (c - 1), (len(n), 1)))
    by_rig /= sigma[seen.camera, None, None]
    by_turn = np.cross(turned[:, None], by_rig)
    at = 6 * (cameras - 1) * unknowns.poses
    by_moment = (by_turn @ by_time[0][..., None] + by_rig @ by_time[1][..., None])[..., 0]
    if unknowns.offsets:
        late = index[seen.camera > 0]
        put(late, by_moment[late, :, None], (at + seen.camera[late] - 1)[:, None])
        at += cameras - 1
    if unknowns.readout:
        put(index, (by_moment * seen.row[:, None])[..., None], (at + seen.camera)[:, None])
        at += cameras
    if unknowns.poses:
        by_bow = (by_rig @ rotations[:, :, 2:]) * seen.shape[:, None]
        put(index, by_bow, np.tile(np.arange(at, at + 2), (count, 1)))
    v = motion.base[seen.camera, seen.frame]
    for who, turn, shift in zip(
        (v, motion.before[v], motion.after[v]), turns, shifts, strict=True
    ):
        block = np.concatenate([by_turn @ turn, by_rig * shift[:, None, None]], axis=-1)
        put(index, block, s + 6 * who[:, None] + np.arange(6))
    cost, weight = cauchy((error**2).sum(axis=-1), np.ones(count, bool), scale)
    data, column = np.concatenate(values, axis=-1), np.concatenate(columns, axis=-1)
    width = data.shape[-1]
    starts = np.arange(0, 2 * count * width + 1, width)
    size = s + 6 * instants
    j = csr_array((data.ravel(), column.ravel(), starts), shape=(2 * count, size))
    w = np.repeat(weight, 2)
    matrix = (j.T @ j.multiply(w[:, None]).tocsr()).tocsr()
    score = j.multiply((w * error.ravel())[:, None]).tocsr()
    who = csr_array(
        (np.ones(2 * count), (np.repeat(v, 2), np.arange(2 * count))), (instants, 2 * count)
    )
    scores = who @ score
    gradient = np.asarray(scores.sum(axis=0), float).ravel()
    return cost if math.isfinite(cost) else math.inf, Normal(
        _held(matrix, np.setdiff1d(np.arange(instants), v), s), gradient, s, scores
    )


def _held(matrix: Any, unseen: NDArray[np.intp], first: int) -> Any:
    """Instants without corners held by a unit weight."""
    from scipy.sparse import diags_array

    diagonal = np.zeros(matrix.shape[0])
    diagonal[first + (6 * unseen[:, None] + np.arange(6)).ravel()] = 1.0
    return matrix + diags_array(diagonal)


def _bowed(motion: Motion, seen: Seen) -> Array:
    return seen.point + (seen.shape @ motion.rig.bow)[:, None] * [0.0, 0, 1]


def _poses(
    motion: Motion, seen: Seen
) -> tuple[Array, Array, tuple[Array, ...], tuple[Array, ...], tuple[Array, Array]]:
    """Pose of the board at each corner's moment, and how it depends on what is unknown.

    Rotations (N, 3, 3), middles (N, 3); for the instant, the one before and the one after it
    d turn / d turn (N, 3, 3) and d middle / d middle (N,); d turn and d middle / d time (N, 3).
    """
    from scipy.spatial.transform import Rotation

    v = motion.base[seen.camera, seen.frame]
    before, after = motion.before[v], motion.after[v]
    stamp = motion.stamps[seen.camera, seen.frame]
    t = stamp + motion.offsets[seen.camera] + motion.readout[seen.camera] * seen.row
    t = t - motion.instants[v]
    times = motion.instants
    a, b, a_slope, b_slope = _weights(t, times[v] - times[before], times[after] - times[v])
    r, m = motion.rig.board_rotations, motion.rig.board_translations
    here = r[v]
    back = np.swapaxes(here, 1, 2)
    to_after = Rotation.from_matrix(back @ r[after]).as_rotvec()
    to_before = Rotation.from_matrix(back @ r[before]).as_rotvec()
    phi = a[:, None] * to_after + b[:, None] * to_before
    rotations = here @ Rotation.from_rotvec(phi).as_matrix()
    step_after, step_before = m[after] - m[v], m[before] - m[v]
    middles = m[v] + a[:, None] * step_after + b[:, None] * step_before
    left = here @ left_jacobian(phi)
    turn_after = a[:, None, None] * left @ np.linalg.inv(left_jacobian(to_after)) @ back
    turn_before = b[:, None, None] * left @ np.linalg.inv(left_jacobian(to_before)) @ back
    by_phi = a_slope[:, None] * to_after + b_slope[:, None] * to_before
    turn_rate = (left @ by_phi[..., None])[..., 0]
    rate = a_slope[:, None] * step_after + b_slope[:, None] * step_before
    turns = (np.eye(3) - turn_after - turn_before, turn_before, turn_after)
    return rotations, middles, turns, (1 - a - b, b, a), (turn_rate, rate)


def _weights(t: Array, back: Array, ahead: Array) -> tuple[Array, Array, Array, Array]:
    """Weights of the instants after and before at `t` (N,), and their derivatives.

    A parabola where both are there (`back` and `ahead` seconds away), a line where one is,
    and rest where none is.
    """
    both, only_after, only_before = (
        (back > 0) & (ahead > 0),
        (back <= 0) & (ahead > 0),
        (back > 0) & (ahead <= 0),
    )
    h, k = np.where(back > 0, back, 1.0), np.where(ahead > 0, ahead, 1.0)
    a = np.where(both, t * (t + h) / (k * (k + h)), np.where(only_after, t / k, 0.0))
    b = np.where(both, t * (t - k) / (h * (k + h)), np.where(only_before, -t / h, 0.0))
    a_slope = np.where(both, (2 * t + h) / (k * (k + h)), np.where(only_after, 1 / k, 0.0))
    b_slope = np.where(both, (2 * t - k) / (h * (k + h)), np.where(only_before, -1 / h, 0.0))
    return a, b, a_slope, b_slope


def left_jacobian(v: Array) -> Array:
    """J with exp(v + dv) = exp(J dv) exp(v), (N, 3, 3) (Sola et al. 2018, eq. 145)."""
    angle = np.linalg.norm(v, axis=-1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    x, y, z, zero = v[:, 0], v[:, 1], v[:, 2], np.zeros(len(v))
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    first = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + first * cross + second * cross @ cross


def _moved(motion: Motion, unknowns: Unknowns, shared: Array, poses: Array) -> Motion:
    from scipy.spatial.transform import Rotation

    rig, cameras = motion.rig, len(motion.rig.cameras)
    rotations, translations, bow = rig.rotations, rig.translations, rig.bow
    offsets, readout = motion.offsets, motion.readout
    at = 0
    if unknowns.poses:
        at = 6 * (cameras - 1)
        change = np.concatenate([np.zeros((1, 6)), shared[:at].reshape(-1, 6)])
        rotations = Rotation.from_rotvec(change[:, :3]).as_matrix() @ rotations
        translations = translations + change[:, 3:]
        bow = bow + shared[-2:]
    if unknowns.offsets:
        offsets = offsets + np.concatenate([[0.0], shared[at : at + cameras - 1]])
        at += cameras - 1
    if unknowns.readout:
        readout = readout + shared[at : at + cameras]
    turns = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    return replace(
        motion,
        rig=replace(
            rig,
            rotations=rotations,
            translations=translations,
            bow=bow,
            board_rotations=turns @ rig.board_rotations,
            board_translations=rig.board_translations + poses[:, 3:],
        ),
        offsets=offsets,
        readout=readout,
    )
