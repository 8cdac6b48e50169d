"""Attitudes worth refining: from a rectangle in closed form, or from all directions of up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from chromeball.envmap.align import RectangleState, check_order, closed_form, unit
from chromeball.envmap.axes.observations import (
    Array,
    Bearing,
    Horizon,
    Observation,
    Plane,
    Rectangle,
    Vertical,
    points_of,
)
from chromeball.envmap.axes.terms import State
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: A rectangle's own axes (its sides x and z, its normal y towards the camera) in the world.
_PLANES: dict[Plane, tuple[Array, ...]] = {
    "floor": (np.eye(3),),
    "ceiling": (np.diag([1.0, -1.0, -1.0]),),
    "wall": (
        np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
        np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    ),
}


def starts_of(camera: CameraModel, observations: Sequence[Observation]) -> list[State]:
    """Attitudes worth refining, from a rectangle or from all directions of up."""
    rectangle = next((o for o in observations if isinstance(o, Rectangle)), None)
    bearing = next((o for o in observations if isinstance(o, Bearing)), None)
    ups: list[tuple[Array, Array | None, RectangleState | None]] = []
    if rectangle is not None:
        d = camera.unproject(np.asarray(rectangle.points, float))
        check_order(d)
        own = closed_form(d)
        if ((d @ own[:, 1]) > -1e-9).any():
            raise UserError("a corner lies on or beyond the horizon of the others' plane")
        state = RectangleState.of(own, -d / (d @ own[:, 1])[:, None])
        for plane in _PLANES[rectangle.plane]:
            placed = own @ plane.T
            ups.append((placed[:, 1], placed, replace(state, plane=plane)))
    else:
        ups = [(u, None, None) for u in _likely_ups(camera, observations)]
    starts: list[State] = []
    for up, found, lying in ups:
        turn, north = found, 0.0
        if bearing is not None:
            d = camera.unproject(np.atleast_2d(bearing.point))[0]
            if turn is None:
                flat = d - (d @ up) * up
                if np.linalg.norm(flat) < 1e-3:
                    continue
                z = -unit(flat)
                ahead = np.stack([np.cross(up, z), up, z], axis=1)  # -Z at the point
                about = np.array([0, bearing.azimuth, 0])
                turn = ahead @ Pose.from_rotation_vector(about, np.zeros(3)).rotation
            else:
                w = d @ turn
                north = bearing.azimuth - math.atan2(w[0], -w[2])
        assert turn is not None
        starts.append(State(turn, north, lying))
    return starts


def _likely_ups(camera: CameraModel, observations: Sequence[Observation]) -> list[Array]:
    """Directions of up to start from, camera axes: minima over a lattice, far apart."""
    from chromeball.envmap.irradiance import spread_directions

    ups = spread_directions(800)
    cost = 1e-3 * (1 + ups[:, 1])  # all else alike, upright: camera y points down
    for o in observations:
        d = camera.unproject(np.asarray(points_of(o), float))
        match o:
            case Vertical():
                cost += (ups @ unit(np.asarray(np.cross(*d), float))) ** 2
                cost += np.where(ups @ (d[1] - d[0]) < 0, 0.5, 0.0)
            case Horizon():
                cost += (ups @ d[0]) ** 2
            case Bearing(elevation=float(elevation)):
                cost += (ups @ d[0] - math.sin(elevation)) ** 2
            case _:
                pass
    found: list[Array] = []
    for k in np.argsort(cost):
        if all(ups[k] @ other < math.cos(math.radians(20)) for other in found):
            found.append(ups[k])
        if len(found) == 5:
            break
    return found
