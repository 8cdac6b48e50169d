"""World axes from any mix of what a picture shows of them (seeds.md F3, F4, F15).

A rectangle on floor, ceiling or wall, vertical edges, the horizon, the sun at a known time and
place, a point of known bearing: one weighted least squares on angles, for whatever lens. Each
observation is weighted by the clicks' noise as the lens turns it to an angle, and by how plumb,
level or sharp such things are in the world.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.align import (
    REFUSE_TILT,
    RectangleState,
    check_order,
    click_covariance,
    closed_form,
    rectangle_angles,
    tangents,
    unit,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]
type Plane = Literal["floor", "ceiling", "wall"]

#: What the world itself errs by, radians: edges that are built plumb, a sea or a far plain,
#: the middle of a glaring sun, a bearing from a map.
PLUMB, LEVEL, SUN, BEARING = (math.radians(v) for v in (0.15, 0.1, 0.1, 0.25))
#: Standard errors beyond which an observation contradicts the others.
CONTRADICTION = 4.0


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
class Axes:
    """World axes with their uncertainty.

    ``world_from_camera``: +Y up; +X along the rectangle's first side, or east where there is
    none. The origin is the rectangle's middle, or the floor below the camera, or the camera
    where no length is known (``scaled`` False). ``north`` is the azimuth of -Z, radians, None
    where nothing says. ``corners`` (4, 3) metres. Standard errors in radians and metres hold
    for the noise given; ``chi_square`` over ``freedom`` tells whether the clicks obey it.
    """

    world_from_camera: Pose
    scaled: bool
    north: float | None
    corners: Array | None
    width: float | None
    depth: float | None
    camera_height: float | None
    terms: tuple[Term, ...]
    residual: float
    sigma_tilt: float
    sigma_yaw: float
    sigma_height: float
    chi_square: float
    freedom: int
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _State:
    """``turn`` is camera_from_world; ``north`` the azimuth of -Z; the rectangle as it lies."""

    turn: Array
    north: float
    rectangle: RectangleState | None


@dataclass(frozen=True)
class _Term:
    name: str
    angles: Callable[[_State], Array]
    spread: Callable[[_State], Array]  # covariance of the angles, for the clicks' noise


def solve_axes(
    camera: CameraModel,
    observations: Sequence[Observation],
    *,
    camera_height: float | None = None,
    click: float = 1.0,
) -> Axes:
    """Solve for the axes; `click` is the noise of a click in pixels a coordinate.

    `camera_height`, metres above the floor, gives the scale where no side of a rectangle does.

    Raises
    ------
    UserError
        When a point lies outside what the lens sees, a length is none, or an axis is open: the
        message says which.

    """
    _check(camera, observations, camera_height, click)
    given = _named(observations)
    terms = [_term(name, camera, o, click) for name, o in given]
    rectangle = next((o for _, o in given if isinstance(o, Rectangle)), None)
    heading = rectangle is not None and any(isinstance(o, Bearing) for _, o in given)
    starts = _starts(camera, [o for _, o in given])
    upwards = {
        name: np.diff(camera.unproject(np.asarray(o.points, float)), axis=0)[0]
        for name, o in given
        if isinstance(o, Vertical)
    }
    best, others = _best(terms, starts, heading, np.array([*upwards.values()]).reshape(-1, 3))
    for name, edge in upwards.items():
        if edge @ best.turn[:, 1] < 0:
            raise UserError(f"{name}: its first point is the upper one; give the lower first")
    warnings: list[str] = []
    used = list(range(len(terms)))
    chi, freedom = _chi(terms, best, heading)
    if freedom > 0 and chi > _limit(freedom):
        culprits = _culprits(terms, best, heading)
        if len(culprits) == 1:
            k = culprits[0]
            best = _without(terms, k, best, heading)[0]
            used.remove(k)
            off = _term_of(terms[k], best, False)
            warnings.append(
                f"{off.name} contradicts the others by {math.degrees(off.residual):.2f} "
                f"degrees ({off.residual / off.sigma:.0f} standard errors) and is left out"
            )
        elif culprits:
            names = " or ".join(terms[k].name for k in culprits)
            warnings.append(f"the observations contradict each other: {names} is wrong")
        else:
            warnings.append(
                f"the observations contradict each other by {math.sqrt(chi / freedom):.1f} "
                "standard errors, and no single one is to blame"
            )
        chi, freedom = _chi([terms[k] for k in used], best, heading)
    if others:
        warnings.append(
            "a second attitude fits as well, tilted by "
            f"{math.degrees(_angle(best.turn[:, 1], others[0].turn[:, 1])):.0f} degrees; the "
            "one nearer to an upright camera was taken"
        )
    kept = [terms[k] for k in used]
    covariance = _covariance(kept, best, heading)
    # contradictions make the errors larger than the clicks say
    excess = max(1.0, math.sqrt(chi / freedom)) if freedom > 0 else 1.0
    sigma_tilt = excess * math.sqrt(covariance[0, 0] + covariance[2, 2])
    sigma_yaw = excess * math.sqrt(covariance[1, 1])
    for sigma, what in ((sigma_tilt, "tilt"), (sigma_yaw, "heading")):
        if not sigma < REFUSE_TILT * max(click, 1.0):
            raise UserError(_open(what, f"to {math.degrees(sigma):.0f} degrees only"))
    placed = _placed(best, rectangle, camera_height, covariance, heading, excess)
    pose, corners, scale, sigma_height = placed
    fitted = best.rectangle
    disagreement = _lengths(rectangle, fitted, scale, camera_height)
    angles = [t.angles(best) for t in kept]
    return Axes(
        world_from_camera=pose,
        scaled=scale is not None,
        north=best.north if any(isinstance(o, Bearing) for _, o in given) else None,
        corners=corners,
        width=fitted.width * scale if fitted and scale else None,
        depth=abs(fitted.depth) * scale if fitted and scale else None,
        camera_height=float(pose.translation[1]) if scale else None,
        terms=tuple(_term_of(t, best, k in used) for k, t in enumerate(terms)),
        residual=float(np.sqrt(np.mean(np.concatenate(angles) ** 2))),
        sigma_tilt=sigma_tilt,
        sigma_yaw=sigma_yaw,
        sigma_height=sigma_height,
        chi_square=chi,
        freedom=freedom,
        warnings=(*warnings, *disagreement),
    )


# ---- what is asked


def _named(observations: Sequence[Observation]) -> list[tuple[str, Observation]]:
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


def _points(o: Observation) -> Array:
    return np.atleast_2d(o.points if isinstance(o, Rectangle | Vertical) else o.point)


def _check(
    camera: CameraModel,
    observations: Sequence[Observation],
    camera_height: float | None,
    click: float,
) -> None:
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
    for name, o in _named(observations):
        q = np.asarray(_points(o), float)
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
        raise UserError(_open("heading", "by nothing"))


def _open(axis: str, how: str) -> str:
    if axis == "heading":
        return (
            f"the heading about the vertical is fixed {how}: add a rectangle, the sun with its "
            "time and place, or a point to the north (any point may be called north)"
        )
    return (
        f"the tilt is fixed {how}: add vertical edges that lie apart, points of the horizon, "
        "or a larger rectangle"
    )


# ---- the terms


def _term(name: str, camera: CameraModel, o: Observation, click: float) -> _Term:
    q = np.asarray(_points(o), float)
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

            def corners(s: _State) -> Array:
                assert s.rectangle is not None
                return rectangle_angles(s.rectangle, d)

            return _Term(name, corners, lambda s: covariance)
        case Vertical():
            a, b = d
            normal = unit(np.asarray(np.cross(a, b)))
            sine = float(np.linalg.norm(np.cross(a, b)))

            def edge(s: _State) -> Array:
                return np.arcsin(np.clip([normal @ s.turn[:, 1]], -1, 1))

            def edge_spread(s: _State) -> Array:
                u = s.turn[:, 1]
                moves = (
                    np.cross(b, u) @ per_pixel[0] / sine,
                    np.cross(u, a) @ per_pixel[1] / sine,
                )
                return np.array([[sum(float(m @ m) for m in moves) + PLUMB**2]])

            return _Term(name, edge, edge_spread)
        case Horizon():

            def level(s: _State) -> Array:
                return np.arcsin(np.clip([d[0] @ s.turn[:, 1]], -1, 1))

            def level_spread(s: _State) -> Array:
                move = s.turn[:, 1] @ per_pixel[0]
                return np.array([[float(move @ move) + LEVEL**2]])

            return _Term(name, level, level_spread)
        case Bearing(elevation=None):

            def side(s: _State) -> Array:
                return s.turn @ direction(o.azimuth - s.north + math.pi / 2, 0.0)

            def bearing(s: _State) -> Array:
                return np.arcsin(np.clip([d[0] @ side(s)], -1, 1))

            def bearing_spread(s: _State) -> Array:
                move = side(s) @ per_pixel[0]
                return np.array([[float(move @ move) + BEARING**2]])

            return _Term(name, bearing, bearing_spread)
        case Bearing(elevation=float(elevation)):
            basis = tangents(d[0])
            covariance = basis.T @ per_pixel[0] @ per_pixel[0].T @ basis + SUN**2 * np.eye(2)

            def sun(s: _State) -> Array:
                w = s.turn @ direction(o.azimuth - s.north, elevation)
                off = basis.T @ w
                sine = float(np.linalg.norm(off))
                return off * (math.atan2(sine, float(w @ d[0])) / sine if sine > 0 else 1.0)

            return _Term(name, sun, lambda s: covariance)
        case _:
            raise AssertionError(o)


def direction(azimuth: float, elevation: float) -> Array:
    """World direction of an azimuth clockwise from -Z; +X is east when -Z is north."""
    level = math.cos(elevation)
    return np.array(
        [level * math.sin(azimuth), math.sin(elevation), -level * math.cos(azimuth)]
    )


def _term_of(term: _Term, state: _State, used: bool) -> Term:
    r, spread = term.angles(state), term.spread(state)
    rms, sigma = math.sqrt(float(np.mean(r**2))), math.sqrt(float(np.trace(spread)) / len(r))
    return Term(term.name, rms, sigma, used)


# ---- where to start


#: A rectangle's own axes (its sides x and z, its normal y towards the camera) in the world.
_PLANES: dict[Plane, tuple[Array, ...]] = {
    "floor": (np.eye(3),),
    "ceiling": (np.diag([1.0, -1.0, -1.0]),),
    "wall": (
        np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
        np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    ),
}


def _starts(camera: CameraModel, observations: Sequence[Observation]) -> list[_State]:
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
            turn = own @ plane.T
            ups.append((turn[:, 1], turn, replace(state, plane=plane)))
    else:
        ups = [(u, None, None) for u in _likely_ups(camera, observations)]
    starts: list[_State] = []
    for up, turn, state in ups:
        north = 0.0
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
        starts.append(_State(turn, north, state))
    return starts


def _likely_ups(camera: CameraModel, observations: Sequence[Observation]) -> list[Array]:
    """Directions of up to start from, camera axes: minima over a lattice, far apart."""
    from chromeball.envmap.irradiance import spread_directions

    ups = spread_directions(800)
    cost = 1e-3 * (1 + ups[:, 1])  # all else alike, upright: camera y points down
    for o in observations:
        d = camera.unproject(np.asarray(_points(o), float))
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


def _best(
    terms: Sequence[_Term],
    starts: Sequence[_State],
    heading: bool,
    edges: Array,
) -> tuple[_State, list[_State]]:
    """The best attitude, and others that fit as well though they are tilted against it.

    `edges` (N, 3) lead up along clicked verticals, camera axes. Where nothing else tells up
    from down, the camera is upright.
    """
    cost = [float(np.sum(_whitened(terms, s) ** 2)) for s in starts]
    refined: list[tuple[float, _State]] = []
    for k in np.argsort(cost):
        state = _refine(terms, starts[int(k)], heading)
        refined.append((float(np.sum(_whitened(terms, state) ** 2)), state))
    least = min(c for c, _ in refined)
    equal = [s for c, s in refined if c < least + 9]
    # edges lead up, and camera y points down
    equal.sort(key=lambda s: (int((edges @ s.turn[:, 1] < 0).sum()), float(s.turn[1, 1])))
    best = equal[0]
    upright = len(edges) > 0 or best.turn[1, 1] < -0.3
    others = [
        s
        for s in equal
        if math.radians(3) < _angle(s.turn[:, 1], best.turn[:, 1])
        and not (upright and s.turn[:, 1] @ best.turn[:, 1] < -0.99)
        and (edges @ s.turn[:, 1] >= 0).all()
    ]
    return best, others


# ---- least squares


def _weights(terms: Sequence[_Term], state: _State) -> list[Array]:
    """What turns each term's angles into standard errors."""
    return [np.linalg.inv(np.linalg.cholesky(term.spread(state))) for term in terms]


def _whitened(
    terms: Sequence[_Term], state: _State, weights: Sequence[Array] | None = None
) -> Array:
    """Angles over their standard errors."""
    weights = _weights(terms, state) if weights is None else weights
    return np.concatenate(
        [w @ term.angles(state) for w, term in zip(weights, terms, strict=True)]
    )


def _moved(state: _State, step: Array, heading: bool) -> _State:
    turn = state.turn @ Pose.from_rotation_vector(step[:3], np.zeros(3)).rotation
    north = state.north + (step[3] if heading else 0.0)
    rectangle = state.rectangle
    if rectangle is not None:
        own = turn @ rectangle.plane
        rectangle = rectangle.with_rotation(own, step[3 + heading :])
    return _State(turn, float(north), rectangle)


def _unknowns(state: _State, heading: bool) -> int:
    return 3 + heading + (4 if state.rectangle is not None else 0)


def _jacobian(terms: Sequence[_Term], state: _State, heading: bool) -> Array:
    """Central differences of the whitened angles."""
    weights = _weights(terms, state)
    columns: list[Array] = []
    for step in 1e-6 * np.eye(_unknowns(state, heading)):
        ahead = _whitened(terms, _moved(state, step, heading), weights)
        behind = _whitened(terms, _moved(state, -step, heading), weights)
        columns.append((ahead - behind) / 2e-6)
    return np.stack(columns, axis=1)


def _refine(terms: Sequence[_Term], state: _State, heading: bool) -> _State:
    """Gauss-Newton with damping (Levenberg, Marquardt)."""
    damping = 1e-3
    r = _whitened(terms, state)
    for _ in range(60):
        j, weights = _jacobian(terms, state, heading), _weights(terms, state)
        normal = j.T @ j
        diagonal = np.diag(np.maximum(np.diag(normal), 1e-9))
        for _ in range(12):
            step = -np.linalg.solve(normal + damping * diagonal, j.T @ r)
            step *= min(1.0, 0.5 / max(float(np.abs(step[:3]).max()), 1e-300))
            trial = _moved(state, step, heading)
            moved = _whitened(terms, trial, weights)
            if moved @ moved <= r @ r:
                state, r = trial, _whitened(terms, trial)
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
        else:
            break
        if np.abs(step).max() < 1e-10:
            break
    return state


def _covariance(terms: Sequence[_Term], state: _State, heading: bool) -> Array:
    """Of the unknowns; refuses with the open axis's name."""
    j = _jacobian(terms, state, heading)
    scale = np.linalg.norm(j, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, s, vt = np.linalg.svd(j / scale, full_matrices=True)
    full = np.zeros(j.shape[1])
    full[: len(s)] = s
    open_ = vt[full < 1e-7 * full.max()] / scale
    for v in open_:
        tilt, yaw = float(np.hypot(v[0], v[2])), abs(float(v[1]))
        raise UserError(_open("heading" if yaw > 20 * tilt else "tilt", "by nothing"))
    inverse = vt.T @ np.diag(1 / full**2) @ vt
    return inverse / np.outer(scale, scale)


def _chi(terms: Sequence[_Term], state: _State, heading: bool) -> tuple[float, int]:
    r = _whitened(terms, state)
    return float(r @ r), len(r) - _unknowns(state, heading)


def _limit(freedom: int) -> float:
    """Chi-square that 1 in 10000 exceeds (Wilson and Hilferty 1931)."""
    return freedom * (1 - 2 / (9 * freedom) + 3.719 * math.sqrt(2 / (9 * freedom))) ** 3


def _without(
    terms: Sequence[_Term], k: int, state: _State, heading: bool
) -> tuple[_State, float, int]:
    rest = [t for i, t in enumerate(terms) if i != k]
    state = _refine(rest, state, heading)
    return state, *_chi(rest, state, heading)


def _culprits(terms: Sequence[_Term], best: _State, heading: bool) -> list[int]:
    """Observations without which the rest agree, the rectangle excepted; those that are alike.

    One is clearly to blame when no other's removal explains nearly as much.
    """
    found: list[tuple[float, int]] = []
    for k, term in enumerate(terms):
        if term.name == "rectangle":
            continue
        rest = [t for i, t in enumerate(terms) if i != k]
        try:
            state, chi, freedom = _without(terms, k, best, heading)
            _covariance(rest, state, heading)
        except (UserError, np.linalg.LinAlgError):
            continue  # without it an axis is open: it cannot be judged
        if chi <= (_limit(freedom) if freedom > 0 else 1e-9 + 0.0):
            found.append((chi, k))
    found.sort()
    if not found:
        return []
    return [k for chi, k in found if chi < found[0][0] + CONTRADICTION**2]


# ---- lengths


def _placed(
    best: _State,
    rectangle: Rectangle | None,
    camera_height: float | None,
    covariance: Array,
    heading: bool,
    excess: float,
) -> tuple[Pose, Array | None, float | None, float]:
    """World pose, corners, metres per unit of the rectangle, standard error of the height."""
    rotation, fitted = best.turn.T, best.rectangle
    if rectangle is None or fitted is None:
        height = camera_height or 0.0
        return Pose(rotation, np.array([0, height, 0])), None, camera_height, 0.0
    k = 5 + heading  # after the turn, the heading and the middle: width, depth
    relative = 0.0
    if rectangle.width is not None:
        scale = rectangle.width / fitted.width
        relative = math.sqrt(covariance[k, k]) / fitted.width
    elif camera_height is not None and rectangle.plane == "floor":
        scale = camera_height
    elif rectangle.depth is not None:
        scale = rectangle.depth / abs(fitted.depth)
        relative = math.sqrt(covariance[k + 1, k + 1]) / abs(fitted.depth)
    else:
        raise UserError(
            "give the rectangle's width or depth"
            + (", or the camera's height, in metres" if rectangle.plane == "floor" else "")
        )
    corners = fitted.corners() @ fitted.plane.T * scale
    middle = corners.mean(axis=0)
    pose = Pose(rotation, -middle)
    return pose, corners - middle, scale, excess * scale * relative


def _lengths(
    rectangle: Rectangle | None,
    fitted: RectangleState | None,
    scale: float | None,
    camera_height: float | None,
) -> list[str]:
    """Lengths that were given and do not fit each other."""
    if rectangle is None or fitted is None or scale is None:
        if scale is None:
            return ["no length is known: the world's origin is the camera, its scale is free"]
        return []
    warnings: list[str] = []
    depth = abs(fitted.depth) * scale
    given = rectangle.depth if rectangle.width is not None else None
    if given is not None and abs(given / depth - 1) > 0.1:
        warnings.append(
            f"width and depth disagree: for this width the picture shows a depth of "
            f"{depth:.3g} m, not {given:g} m"
        )
    height = camera_height if rectangle.plane == "floor" else None
    if height is not None and abs(height / scale - 1) > 0.1:
        warnings.append(
            f"width and camera height disagree: for this width the camera stands "
            f"{scale:.3g} m high, not {height:g} m"
        )
    return warnings


def _angle(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def pairs(points: ArrayLike) -> list[Vertical]:
    """Verticals of points taken two by two, (2 N, 2)."""
    q = np.atleast_2d(np.asarray(points, float))
    if len(q) % 2:
        raise UserError(f"verticals are pairs of points: {len(q)} points are none")
    return [Vertical(np.stack(two)) for two in itertools.batched(q, 2, strict=True)]


def axes_json(axes: Axes, picture: str | None, points: ArrayLike | None) -> dict[str, object]:
    """The content of align.json; what a rectangle alone gives is null without one."""
    return {
        "world_from_camera": axes.world_from_camera.matrix(),
        "corners": axes.corners,
        "width": axes.width,
        "depth": axes.depth,
        "camera_height": axes.camera_height,
        "residual": axes.residual,
        "sigma_tilt": axes.sigma_tilt,
        "sigma_yaw": axes.sigma_yaw,
        "sigma_height": axes.sigma_height,
        "disagreement": None,
        "picture": picture,
        "points": points,
        "north": axes.north,
        "chi_square": axes.chi_square,
        "freedom": axes.freedom,
        "used": [
            {"name": t.name, "residual": t.residual, "sigma": t.sigma, "used": t.used}
            for t in axes.terms
        ],
    }
