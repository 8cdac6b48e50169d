"""Cameras that did not look at the same moment: time offsets and rolling shutters.

A board that moves while unsynchronised cameras see it stands elsewhere for each of them. Lenses
are frozen here: free ones would absorb what the clocks do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.rig_motion import (
    Array,
    Motion,
    Seen,
    Unknowns,
    adjust_motion,
    errors,
    linearise,
)
from chromeball.calibrate.rig_solve import (
    CAUCHY,
    FEWEST_CORNERS,
    LEAST_SHARE,
    OUTLIER,
    RigEstimate,
    deviation,
    distance,
)

#: Rolling shutters are believed when they leave less than this share of the held-out error.
WORTH_ROLLING = 0.97


@dataclass(frozen=True)
class Sync:
    """Time offsets of cameras, and how well they are known.

    ``motion`` is the rig with its moving board, ``used`` (N,) the corners of ``seen`` that fit,
    ``sigma`` (C,) deviations of a coordinate. ``covariance`` (6 (C - 1), 6 (C - 1)) of the
    cameras' poses, exp(w) R and t + dt, as instants scatter and the session's halves differ
    where that is more than the corners' noise; ``offset_errors`` and ``readout_errors`` (C,)
    standard errors in seconds, by the corners' noise or by how the halves differ, whichever is
    more: clocks that jitter are not the corners' noise. ``held_out`` are median distances over
    halves of the session whose board poses alone are fitted: without offsets, with them, and
    with read-outs; ``rolling`` says that read-outs were worth it. ``rms_before`` and ``rms``
    per corner over all corners.
    """

    motion: Motion
    seen: Seen
    used: NDArray[np.bool_]
    sigma: Array
    covariance: Array
    offset_errors: Array
    readout_errors: Array
    held_out: tuple[float, float, float]
    rolling: bool
    rms_before: float
    rms: float


def synchronise(
    rig: RigEstimate, corners: Array, board: Array, stamps: Array, share: Array
) -> Sync:
    """Time offsets from a `rig` of frozen lenses solved as if all cameras looked at once.

    `corners` (C, F, rows, columns, 2), `stamps` (C, F) seconds, `share` (C,) the cameras'
    deviations of a corner in proportion to each other.
    """
    middle = board.mean(axis=(0, 1))
    rig = replace(rig, board_translations=rig.board_translations + rig.board_rotations @ middle)
    saw = np.isfinite(corners[..., 0]).any(axis=(2, 3))
    heights = np.array([camera.size[1] for camera in rig.cameras], float)
    seen = Seen.of(corners, board, heights)
    start = Motion.begin(rig, stamps, saw)
    still = _robust(start, seen, Unknowns(True, False, False), share, rounds=2)
    late = _follow(start, seen, saw, Unknowns(True, True, False), share)
    rolled = _follow(late, seen, saw, Unknowns(True, True, True), share)
    tests = [
        _halves(still, seen, Unknowns(True, False, False), share),
        _halves(late, seen, Unknowns(True, True, False), share),
        _halves(rolled, seen, Unknowns(True, True, True), share),
    ]
    held_out = (tests[0][0], tests[1][0], tests[2][0])
    rolling = held_out[2] < WORTH_ROLLING * held_out[1]
    first, second = tests[2 if rolling else 1][1]
    unknowns = Unknowns(True, True, rolling)
    motion = rolled if rolling else late
    used = np.zeros(len(seen.pixel), bool)
    sigma = _scale(motion, seen, share)
    for _ in range(10):
        fits = distance(errors(motion, seen)) < OUTLIER * sigma[seen.camera]
        fits = _whole_views(fits, seen)
        if (fits == used).all():
            break
        used = fits
        chosen = seen.only(used)
        motion = adjust_motion(motion, chosen, unknowns, sigma)
        relative = errors(motion, chosen) / share[chosen.camera, None]
        placed = np.unique(motion.base[chosen.camera, chosen.frame])
        free = unknowns.count(len(share)) + 6 * len(placed)
        sigma = share * deviation(relative, free)
    covariance = linearise(motion, seen.only(used), unknowns, sigma)[1].covariance()
    cameras = len(share)
    poses, offsets = 6 * (cameras - 1), cameras - 1
    covariance[:poses, :poses] *= _excess(first, second, covariance[:poses, :poses]) ** 2
    spread = np.sqrt(np.diag(covariance))
    return Sync(
        motion, seen, used, sigma, covariance[:poses, :poses],
        np.maximum(
            np.concatenate([[0.0], spread[poses : poses + offsets]]),
            np.abs(first.offsets - second.offsets) / 2,
        ),
        np.maximum(
            spread[poses + offsets :][:cameras] if rolling else np.zeros(cameras),
            np.abs(first.readout - second.readout) / 2,
        ),
        held_out, rolling, rms(errors(still, seen)), rms(errors(motion, seen)),
    )  # fmt: skip


def _excess(first: Motion, second: Motion, covariance: Array) -> float:
    """How many times more than predicted the poses of two halves of the session differ.

    What the parabolas miss of the motion is shared by many instants, and shows only here. The
    difference of two halves has four times the variance of the whole; never less than one.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(
        first.rig.rotations @ np.swapaxes(second.rig.rotations, 1, 2)
    ).as_rotvec()
    shift = first.rig.translations - second.rig.translations
    off = np.concatenate([turn, shift], axis=1)[1:].ravel() / 2
    return max(1.0, math.sqrt(float((off**2 / np.diag(covariance)).mean())))


def rms(error: Array) -> float:
    """Root mean square distance of residuals (N, 2)."""
    return math.sqrt(float((error**2).sum(axis=-1).mean()))


def _follow(
    motion: Motion, seen: Seen, saw: NDArray[np.bool_], unknowns: Unknowns, share: Array
) -> Motion:
    """Cauchy's estimate, frames told from the instants that turn out nearest to them."""
    for _ in range(4):
        motion = _robust(motion, seen, unknowns, share, rounds=1)
        again = motion.rebased(saw)
        if (again.base == motion.base).all():
            break
        motion = again
    return _robust(motion, seen, unknowns, share, rounds=1)


def _robust(
    motion: Motion, seen: Seen, unknowns: Unknowns, share: Array, rounds: int
) -> Motion:
    for _ in range(rounds):
        sigma = _scale(motion, seen, share)
        motion = adjust_motion(
            motion, seen, unknowns, sigma, scale=CAUCHY, steps=12, least_gain=1e-4
        )
    return motion


def _scale(motion: Motion, seen: Seen, share: Array) -> Array:
    """Deviations of a coordinate (C,) in proportion to `share`, by the median distance."""
    relative = distance(errors(motion, seen)) / share[seen.camera]
    return share * max(float(np.median(relative)) / math.sqrt(2 * math.log(2)), 1e-9)


def _halves(
    motion: Motion, seen: Seen, unknowns: Unknowns, share: Array
) -> tuple[float, tuple[Motion, Motion]]:
    """Median distance over halves of the session, the shared unknowns from the other half, and
    what each half says.
    """  # noqa: D205
    instants = motion.instants[motion.base[seen.camera, seen.frame]]
    early = instants < np.median(np.unique(instants))
    left, said = list[Array](), list[Motion]()
    for half in (early, ~early):
        learnt = _robust(motion, seen.only(half), unknowns, share, rounds=1)
        tested = seen.only(~half)
        fitted = _robust(learnt, tested, Unknowns(False, False, False), share, rounds=1)
        # Where the other half's cameras do not see a board at all, it is infinitely far.
        left.append(np.nan_to_num(distance(errors(fitted, tested)), nan=math.inf))
        said.append(learnt)
    return float(np.median(np.concatenate(left))), (said[0], said[1])


def _whole_views(fits: NDArray[np.bool_], seen: Seen) -> NDArray[np.bool_]:
    """Without the views of which too few corners fit."""
    _, view = np.unique(np.stack([seen.camera, seen.frame]), axis=1, return_inverse=True)
    counts, found = np.bincount(view, fits), np.bincount(view)
    keep = (counts >= FEWEST_CORNERS) & (counts >= LEAST_SHARE * found)
    return fits & keep[view]
