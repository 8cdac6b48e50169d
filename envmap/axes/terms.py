"""Observations as angles that vanish at the right axes, with their covariance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from chromeball.envmap.align import (
    RectangleState,
    click_covariance,
    rectangle_angles,
    tangents,
    unit,
)
from chromeball.envmap.axes.observations import (
    BEARING,
    LEVEL,
    PLUMB,
    SUN,
    Array,
    Bearing,
    Horizon,
    Observation,
    Rectangle,
    Vertical,
    direction,
    points_of,
)
from chromeball.scene.camera import CameraModel


@dataclass(frozen=True)
class Term:
    """What came of one observation.

    ``residual`` is its rms angle, ``sigma`` what it was expected to be, radians; ``used`` is
    False for one that contradicts all others and was left out.
    """

    name: str
    residual: float
    sigma: float
    used: bool


@dataclass(frozen=True)
class State:
    """``turn`` is camera_from_world; ``north`` the azimuth of -Z; the rectangle as it lies."""

    turn: Array
    north: float
    rectangle: RectangleState | None


@dataclass(frozen=True)
class TermOf:
    """An observation's angles in a state, and their covariance."""

    name: str
    angles: Callable[[State], Array]
    spread: Callable[[State], Array]  # covariance of the angles, for the clicks' noise


def term_of(name: str, camera: CameraModel, o: Observation, click: float) -> TermOf:
    """The term of an observation; `click` is the noise in pixels."""
    q = np.asarray(points_of(o), float)
    d = camera.unproject(q)
    # how a ray moves with its pixel, (N, 3, 2)
    _, dq_dd = camera.project_with_jacobian(d)
    per_pixel = click * np.stack(
        [
            tangents(ray) @ np.linalg.pinv(j @ tangents(ray))
            for ray, j in zip(d, dq_dd, strict=True)
        ]
    )
    match o:
        case Rectangle():
            covariance = click_covariance(camera, q, d) * click**2

            def corners(s: State) -> Array:
                assert s.rectangle is not None
                return rectangle_angles(s.rectangle, d)

            return TermOf(name, corners, lambda s: covariance)
        case Vertical():
            a, b = d
            normal = unit(np.asarray(np.cross(a, b)))
            sine = float(np.linalg.norm(np.cross(a, b)))

            def edge(s: State) -> Array:
                return np.arcsin(np.clip([normal @ s.turn[:, 1]], -1, 1))

            def edge_spread(s: State) -> Array:
                u = s.turn[:, 1]
                moves = (
                    np.cross(b, u) @ per_pixel[0] / sine,
                    np.cross(u, a) @ per_pixel[1] / sine,
                )
                return np.array([[sum(float(m @ m) for m in moves) + PLUMB**2]])

            return TermOf(name, edge, edge_spread)
        case Horizon():

            def level(s: State) -> Array:
                return np.arcsin(np.clip([d[0] @ s.turn[:, 1]], -1, 1))

            def level_spread(s: State) -> Array:
                move = s.turn[:, 1] @ per_pixel[0]
                return np.array([[float(move @ move) + LEVEL**2]])

            return TermOf(name, level, level_spread)
        case Bearing(elevation=None):

            def side(s: State) -> Array:
                return s.turn @ direction(o.azimuth - s.north + math.pi / 2, 0.0)

            def bearing(s: State) -> Array:
                return np.arcsin(np.clip([d[0] @ side(s)], -1, 1))

            def bearing_spread(s: State) -> Array:
                move = side(s) @ per_pixel[0]
                return np.array([[float(move @ move) + BEARING**2]])

            return TermOf(name, bearing, bearing_spread)
        case Bearing(elevation=float(elevation)):
            basis = tangents(d[0])
            covariance = basis.T @ per_pixel[0] @ per_pixel[0].T @ basis + SUN**2 * np.eye(2)

            def sun(s: State) -> Array:
                w = s.turn @ direction(o.azimuth - s.north, elevation)
                off = basis.T @ w
                sine = float(np.linalg.norm(off))
                return off * (math.atan2(sine, float(w @ d[0])) / sine if sine > 0 else 1.0)

            return TermOf(name, sun, lambda s: covariance)
        case _:
            raise AssertionError(o)


def outcome(term: TermOf, state: State, used: bool) -> Term:
    """What an observation came to."""
    r, spread = term.angles(state), term.spread(state)
    rms, sigma = math.sqrt(float(np.mean(r**2))), math.sqrt(float(np.trace(spread)) / len(r))
    return Term(term.name, rms, sigma, used)
