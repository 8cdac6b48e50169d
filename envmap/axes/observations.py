"""What is clicked of the world's axes, and its checks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Plane = Literal["floor", "ceiling", "wall"]

#: What the world itself errs by, radians: edges that are built plumb, a sea or a far plain,
#: the middle of a glaring sun, a bearing from a map.
PLUMB, LEVEL, SUN, BEARING = (math.radians(v) for v in (0.15, 0.1, 0.1, 0.25))


@dataclass(frozen=True)
class Rectangle:
    """Corners (4, 2) px in order around; ``width`` is the first side, ``depth`` the second.

    Its first side runs along +X; on a wall that side is level.
    """

    points: Array
    plane: Plane = "floor"
    width: float | None = None
    depth: float | None = None


@dataclass(frozen=True)
class Vertical:
    """Two points (2, 2) px of a vertical edge, the lower one first."""

    points: Array


@dataclass(frozen=True)
class Horizon:
    """A point (2,) px that is level with the camera and far away."""

    point: Array


@dataclass(frozen=True)
class Bearing:
    """A point (2,) px whose azimuth is known: radians clockwise from north.

    With an ``elevation`` its height is known, too: the sun.
    """

    point: Array
    azimuth: float
    elevation: float | None = None


type Observation = Rectangle | Vertical | Horizon | Bearing


def named(observations: Sequence[Observation]) -> list[tuple[str, Observation]]:
    """Names with numbers from 1: vertical 2, horizon 1, sun, bearing 1, rectangle."""
    counts = dict.fromkeys(("vertical", "horizon", "bearing", "sun", "rectangle"), 0)
    named: list[tuple[str, Observation]] = []
    for o in observations:
        match o:
            case Rectangle():
                kind = "rectangle"
            case Vertical():
                kind = "vertical"
            case Horizon():
                kind = "horizon"
            case Bearing():
                kind = "bearing" if o.elevation is None else "sun"
        counts[kind] += 1
        single = kind in ("rectangle", "sun") and counts[kind] == 1
        named.append((kind if single else f"{kind} {counts[kind]}", o))
    return named


def points_of(o: Observation) -> Array:
    """The clicked points, (N, 2) px."""
    return np.atleast_2d(o.points if isinstance(o, Rectangle | Vertical) else o.point)


def check(
    camera: CameraModel,
    observations: Sequence[Observation],
    camera_height: float | None,
    click: float,
) -> None:
    """Refuse points off the picture, lengths that are none, and what gives no heading."""
    if not 0 < click < 1000:
        raise UserError(f"a click's noise of {click:g} px is none")
    rectangles = [o for o in observations if isinstance(o, Rectangle)]
    if len(rectangles) > 1:
        raise UserError("one rectangle gives the axes; there are several")
    lengths = [("camera height", camera_height)]
    lengths += [(n, getattr(o, n)) for o in rectangles for n in ("width", "depth")]
    for name, value in lengths:
        if value is not None and not 0 < value < math.inf:
            raise UserError(f"the {name} must be positive metres, not {value:g}")
    size = np.array(camera.size)
    for name, o in named(observations):
        q = np.asarray(points_of(o), float)
        shape = {"Rectangle": (4, 2), "Vertical": (2, 2)}.get(type(o).__name__, (1, 2))
        if q.shape != shape:
            raise UserError(f"{name} needs {shape[0]} points x,y, not {q.size / 2:g}")
        outside = ~np.isfinite(camera.unproject(q)).all(axis=1)
        outside |= ((q < -0.5) | (q > size - 0.5)).any(axis=1)
        if outside.any():
            x, y = q[int(np.argmax(outside))]
            raise UserError(f"{name}: ({x:g}, {y:g}) lies outside what the lens sees")
        if isinstance(o, Vertical) and np.linalg.norm(np.cross(*camera.unproject(q))) < 1e-6:
            raise UserError(f"{name}: its two points are one, or opposite")
        if isinstance(o, Bearing) and o.elevation is not None and o.elevation < 0:
            raise UserError(
                f"the sun was {-math.degrees(o.elevation):.1f} degrees below the horizon at "
                "that time and place; check the time's zone, and east from west"
            )
    kinds = {type(o) for o in observations}
    if not kinds & {Rectangle, Bearing}:
        raise UserError(open_axis("heading", "by nothing"))


def open_axis(axis: str, how: str) -> str:
    """What to do where an axis is open; `how` far it is fixed."""
    if axis == "heading":
        return (
            f"the heading about the vertical is fixed {how}: add a rectangle, the sun with its "
            "time and place, or a point to the north (any point may be called north)"
        )
    return (
        f"the tilt is fixed {how}: add vertical edges that lie apart, points of the horizon, "
        "or a larger rectangle"
    )


def pairs(points: ArrayLike) -> list[Vertical]:
    """Verticals of points taken two by two, (2 N, 2)."""
    q = np.atleast_2d(np.asarray(points, float))
    if len(q) % 2:
        raise UserError(f"verticals are pairs of points: {len(q)} points are none")
    return [Vertical(np.stack(two)) for two in itertools.batched(q, 2, strict=True)]


def direction(azimuth: float, elevation: float) -> Array:
    """World direction of an azimuth clockwise from -Z; +X is east when -Z is north."""
    level = math.cos(elevation)
    return np.array(
        [level * math.sin(azimuth), math.sin(elevation), -level * math.cos(azimuth)]
    )
