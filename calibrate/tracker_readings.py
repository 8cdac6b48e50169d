"""Other readings of a tracker's log, tried where it does not fit the pictures as it stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.tracker_log import ANGLES, TrackerLog

#: So many times farther than asked the delay is searched.
FARTHER = 6.0


def alternatives(
    log: TrackerLog, delay: float | None, search: float
) -> Iterator[tuple[str, TrackerLog, float | None, float]]:
    """What else `log` may be: in words, as it would be, with which delay and search.

    The words have places for the ``delay`` that is found, and twice as far a ``search``.
    """
    if log.times is not None and delay is not None:
        yield (
            f"the log does not fit the pictures with the delay {delay:g} s that was given, but "
            "with {delay:.3f} s it does: leave --delay out, it is estimated",
            log, None, search,
        )  # fmt: skip
    if log.times is not None:
        yield (
            "the log fits the pictures with a delay of {delay:.3f} s, farther than was "
            "searched: add --search {search:.2g}",
            log, None, FARTHER * search,
        )  # fmt: skip
    for words, other in _readings(log):
        yield f"the log fits the pictures only if {words}", other, delay, search


def _readings(log: TrackerLog) -> Iterator[tuple[str, TrackerLog]]:
    """In words, with what to do; and the log so read."""
    turned = np.swapaxes(log.rotations, 1, 2)
    back = -(turned @ log.positions[..., None])[..., 0]
    signs = (
        "change the signs of qx, qy and qz" if log.angles is None else "write their inverses"
    )
    yield (
        f"its turns are tracker to sensor, not sensor to tracker: {signs}",
        replace(log, rotations=turned),
    )
    yield (
        "its poses are tracker to sensor, not sensor to tracker: invert each of them",
        replace(log, rotations=turned, positions=back),
    )
    yield (
        "its axes are left-handed, or the pictures mirrored: change the signs of x, y and z, "
        "or mirror the pictures back",
        replace(log, positions=-log.positions),
    )
    yield from _quaternions(log) if log.angles is None else _angles(log, log.angles)


def _quaternions(log: TrackerLog) -> Iterator[tuple[str, TrackerLog]]:
    """Real part first or last, each way round."""
    from scipy.spatial.transform import Rotation

    wxyz = Rotation.from_matrix(log.rotations).as_quat()[:, [3, 0, 1, 2]]
    for step, named, holds in (
        (1, "qw, qx, qy, qz", "x, y, z, w"),
        (-1, "qx, qy, qz, qw", "w, x, y, z"),
    ):
        read = Rotation.from_quat(np.roll(wxyz, step, axis=1)[:, [1, 2, 3, 0]])
        words = f"the columns that are named {named} hold {holds}: name them so"
        yield words, replace(log, rotations=read.as_matrix())
        also = f"{words}, and change the signs of the last three of w, x, y, z"
        yield also, replace(log, rotations=read.inv().as_matrix())


def _angles(log: TrackerLog, angles: NDArray[np.float64]) -> Iterator[tuple[str, TrackerLog]]:
    """Other columns, radians, and turns about fixed axes."""
    from scipy.spatial.transform import Rotation

    for order in permutations(range(3)):
        if order != (0, 1, 2):
            read = Rotation.from_euler("ZYX", angles[:, order], degrees=True)
            right = ", ".join(ANGLES[order.index(k)] for k in range(3))
            words = f"the columns {', '.join(ANGLES)} hold {right}: name them so"
            yield words, replace(log, rotations=read.as_matrix())
    radians = Rotation.from_euler("ZYX", angles)
    yield "its angles are radians: write degrees", replace(log, rotations=radians.as_matrix())
    fixed = Rotation.from_euler("zyx", angles, degrees=True)
    yield (
        "its angles turn about axes that stay, z, y and x, or in the order x, y, z: write "
        "quaternions",
        replace(log, rotations=fixed.as_matrix()),
    )
