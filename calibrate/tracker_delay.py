"""A log's delay to the pictures, roughly: by how far both turned between views."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.hand_eye import Frames
from chromeball.calibrate.tracker_log import TrackerLog, reached, sample
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

#: The delay is searched so far to both sides, seconds, in steps of so much.
SEARCH, STEP = 0.5, 0.01


def search_delay(
    log: TrackerLog, clock: Array, boards: Frames, window: float, search: float
) -> float:
    """The delay at which the angles between views are most alike for tracker and pictures.

    The angle of a turn does not depend on X and Z.
    """
    i, j = np.triu_indices(len(clock), 1)
    if len(i) > 4000:
        chosen = np.random.default_rng(0).choice(len(i), 4000, replace=False)
        i, j = i[chosen], j[chosen]
    seen = _angles(boards.rotations, i, j)
    best, least = 0.0, math.inf
    reach = 0
    for delay in sorted(np.arange(-search, search + STEP / 2, STEP).tolist(), key=abs):
        inside = reached(log, clock + delay, window)
        both = inside[i] & inside[j]
        if inside.sum() < 3 or inside.sum() < 0.8 * reach:
            continue
        reach = max(reach, int(inside.sum()))
        turned = np.zeros((len(clock), 3, 3))
        turned[inside] = sample(log, clock[inside] + delay, window).rotations
        told = _angles(turned, i[both], j[both])
        error = float(np.median(np.abs(told - seen[both])))
        if error < least - 1e-9:
            best, least = delay, error
    if not math.isfinite(least):
        raise UserError(
            "the log covers fewer than three of the pictures: are the clocks of both the same?"
        )
    return best


def _angles(rotations: Array, i: NDArray[np.intp], j: NDArray[np.intp]) -> Array:
    trace = np.einsum("pij,pij->p", rotations[i], rotations[j])
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))
