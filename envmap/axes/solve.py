"""World axes with their uncertainty, from any mix of observations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from chromeball.envmap.align import REFUSE_TILT, RectangleState
from chromeball.envmap.axes.fit import (
    angle,
    best_of,
    chi_square,
    covariance_of,
    culprits_of,
    limit,
    without,
)
from chromeball.envmap.axes.observations import (
    Array,
    Bearing,
    Observation,
    Rectangle,
    Vertical,
    check,
    named,
    open_axis,
)
from chromeball.envmap.axes.start import starts_of
from chromeball.envmap.axes.terms import State, Term, outcome, term_of
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose


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
    check(camera, observations, camera_height, click)
    given = named(observations)
    terms = [term_of(name, camera, o, click) for name, o in given]
    rectangle = next((o for _, o in given if isinstance(o, Rectangle)), None)
    heading = rectangle is not None and any(isinstance(o, Bearing) for _, o in given)
    starts = starts_of(camera, [o for _, o in given])
    upwards = {
        name: np.diff(camera.unproject(np.asarray(o.points, float)), axis=0)[0]
        for name, o in given
        if isinstance(o, Vertical)
    }
    best, others = best_of(terms, starts, heading, np.array([*upwards.values()]).reshape(-1, 3))
    for name, edge in upwards.items():
        if edge @ best.turn[:, 1] < 0:
            raise UserError(f"{name}: its first point is the upper one; give the lower first")
    warnings: list[str] = []
    used = list(range(len(terms)))
    chi, freedom = chi_square(terms, best, heading)
    if freedom > 0 and chi > limit(freedom):
        culprits = culprits_of(terms, best, heading)
        if len(culprits) == 1:
            k = culprits[0]
            best = without(terms, k, best, heading)[0]
            used.remove(k)
            off = outcome(terms[k], best, False)
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
        chi, freedom = chi_square([terms[k] for k in used], best, heading)
    if others:
        warnings.append(
            "a second attitude fits as well, tilted by "
            f"{math.degrees(angle(best.turn[:, 1], others[0].turn[:, 1])):.0f} degrees; the "
            "one nearer to an upright camera was taken"
        )
    kept = [terms[k] for k in used]
    covariance = covariance_of(kept, best, heading)
    # contradictions make the errors larger than the clicks say
    excess = max(1.0, math.sqrt(chi / freedom)) if freedom > 0 else 1.0
    sigma_tilt = excess * math.sqrt(covariance[0, 0] + covariance[2, 2])
    sigma_yaw = excess * math.sqrt(covariance[1, 1])
    for sigma, what in ((sigma_tilt, "tilt"), (sigma_yaw, "heading")):
        if not sigma < REFUSE_TILT * max(click, 1.0):
            raise UserError(open_axis(what, f"to {math.degrees(sigma):.0f} degrees only"))
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
        terms=tuple(outcome(t, best, k in used) for k, t in enumerate(terms)),
        residual=float(np.sqrt(np.mean(np.concatenate(angles) ** 2))),
        sigma_tilt=sigma_tilt,
        sigma_yaw=sigma_yaw,
        sigma_height=sigma_height,
        chi_square=chi,
        freedom=freedom,
        warnings=(*warnings, *disagreement),
    )


def _placed(
    best: State,
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
