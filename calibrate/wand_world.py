"""From the first camera's axes to those of the room: upright, on the floor, or as surveyed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.wand_result import WandRig
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: Three places on the floor, the least sine of the angle at the first.
LEAST_SINE = 0.1
#: Surveyed centres that miss by more of the rig's size are others: a tape is good to one per
#: cent, a guess at where the lens's centre lies to five.
WORST_SURVEY = 0.15
DOUBTFUL_SURVEY = 0.05
#: Another reading of the centres is named if it leaves less than this share of the misfit.
FAR_BETTER = 0.2
#: All orders of so many centres are tried.
MOST_ORDERED = 7


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


@dataclass(frozen=True)
class Survey:
    """How far the cameras stand from where they were surveyed, metres.

    ``misses`` (C,) of each camera, ``rms`` of all; ``doubtful`` is the camera without which
    the others fit far better, if there is one.
    """

    misses: NDArray[np.float64]
    rms: float
    doubtful: int | None


def as_surveyed(rig: WandRig, centres: NDArray[np.float64]) -> tuple[WandRig, Survey]:
    """The rig nearest to known camera centres (C, 3), metres; and how well they fit.

    Raises
    ------
    UserError
        When the centres are those of other cameras, in another order, or mirrored.

    """
    if len(centres) < 3:
        raise UserError("three centres or more place a rig in a room; give --distance for two")
    rms = _misfit(rig.centres, centres)
    size = float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))
    why = _other_reading(rig, centres, rms) if rms > DOUBTFUL_SURVEY * size else ""
    if why or rms > WORST_SURVEY * size:
        named = ", ".join(rig.names)
        why = why or f"write a line of x y z in metres for each of {named}, in this order"
        raise UserError(
            f"--centres: the cameras do not stand so, {rms:.3g} m (RMS) are left of a rig of "
            f"{size:.3g} m radius: {why}"
        )
    rotation, shift, factor = similarity(rig.centres, centres)
    moved = rig.moved(Pose(rotation, shift), factor, "m")
    misses = np.linalg.norm(moved.centres - centres, axis=1)
    return moved, Survey(misses, rms, _doubtful(rig.centres, centres, rms))


def _misfit(points: NDArray[np.float64], targets: NDArray[np.float64]) -> float:
    """RMS distance, in the unit of `targets`, after the nearest similarity."""
    rotation, shift, factor = similarity(points, targets)
    left = factor * points @ rotation.T + shift - targets
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def _other_reading(rig: WandRig, centres: NDArray[np.float64], rms: float) -> str:
    """The reading of centres that fits far better, or nothing."""
    if len(centres) > 3 and _misfit(rig.centres, centres * [1, 1, -1]) < FAR_BETTER * rms:
        return "they fit mirrored; write x y z in right-handed axes"
    if (camera := _doubtful(rig.centres, centres, rms)) is not None:
        return f"all but {rig.names[camera]} fit; check its line"
    if len(centres) <= MOST_ORDERED:
        orders = [list(order) for order in permutations(range(len(centres)))]
        errors = [_misfit(rig.centres, centres[order]) for order in orders]
        best = int(np.argmin(errors))
        if errors[best] < FAR_BETTER * rms:
            lines = ", ".join(
                f"line {at + 1} is {name}'s"
                for name, at in zip(rig.names, orders[best], strict=True)
            )
            return f"they would fit in another order: {lines}"
    return ""


def _doubtful(
    points: NDArray[np.float64], targets: NDArray[np.float64], rms: float
) -> int | None:
    """The one point without which all others fit far better; it takes five to tell."""
    count = len(points)
    if count < 5:
        return None
    kept = [np.arange(count) != c for c in range(count)]
    errors = [_misfit(points[k], targets[k]) for k in kept]
    best = int(np.argmin(errors))
    return best if errors[best] < FAR_BETTER * rms else None


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
