"""From the first camera's axes to those of the room: upright, on the floor, or as surveyed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.wand_result import WandRig
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: Three places on the floor, the least sine of the angle at the first.
LEAST_SINE = 0.1


def upright(rig: WandRig) -> WandRig:
    """The reference camera at the origin, level, looking along -z: up is its up."""
    return rig.moved(Pose(np.diag([1.0, -1, -1]), np.zeros(3)), unit=rig.unit)


def on_floor(rig: WandRig, frames: tuple[int, int, int]) -> WandRig:
    """The light lay on the floor at three `frames`: the origin, along +x, and elsewhere.

    +y is up, to the side where the cameras are; a wand lies there with its first light.
    """
    count = len(rig.points)
    if any(not 0 <= f < count for f in frames):
        raise UserError(f"--floor: frames are numbered from 0 to {count - 1}")
    points = rig.points[list(frames), 0]
    if not np.isfinite(points).all():
        lost = [f for f, p in zip(frames, points, strict=True) if not np.isfinite(p).all()]
        raise UserError(f"--floor: in frame {lost[0]} two cameras must see the light")
    origin, along, aside = points
    x, other = along - origin, aside - origin
    y = np.cross(x, other)
    if np.linalg.norm(y) < LEAST_SINE * np.linalg.norm(x) * np.linalg.norm(other):
        raise UserError("--floor: the three places must not lie in a line")
    x /= np.linalg.norm(x)
    y /= np.linalg.norm(y)
    if np.median((rig.centres - origin) @ y) < 0:
        y = -y
    turn: NDArray[np.float64] = np.stack([x, y, np.cross(x, y)])
    return rig.moved(Pose(turn, -turn @ origin), unit=rig.unit)


def as_surveyed(rig: WandRig, centres: NDArray[np.float64]) -> tuple[WandRig, float]:
    """The rig nearest to known camera centres (C, 3), metres; and the RMS of what is left."""
    if len(centres) < 3:
        raise UserError("three centres or more place a rig in a room; give --distance for two")
    rotation, shift, factor = similarity(rig.centres, centres)
    moved = rig.moved(Pose(rotation, shift), factor, "m")
    left = moved.centres - centres
    return moved, float(np.sqrt((left**2).sum(axis=1).mean()))


def similarity(
    points: NDArray[np.float64], targets: NDArray[np.float64], *, scaled: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Rotation, shift and factor that take `points` (N, 3) nearest to `targets`.

    The least squares of Umeyama 1991; the factor is one unless `scaled`.
    """
    here, there = points.mean(axis=0), targets.mean(axis=0)
    a, b = points - here, targets - there
    u, s, vt = np.linalg.svd(b.T @ a)
    if s[1] < 1e-6 * s[0]:
        raise UserError("the cameras stand in a line, which leaves a turn about it open")
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    factor = float((s * sign).sum() / (a**2).sum()) if scaled else 1.0
    return rotation, there - factor * rotation @ here, factor
