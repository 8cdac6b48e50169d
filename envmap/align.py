"""World axes and scale from four clicked corners of a rectangle (seeds.md F3, F4).

Felinto, Zang and Velho 2013, sections 5.1 and 5.2: cross products of the four rays give the
axes in closed form; least squares on the angles between rays and corners then removes what
the clicks' noise has tilted. The rectangle may lie on any plane that the camera looks at.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

#: Standard error of the tilt for clicks good to a pixel: warn above, refuse above.
WARN_TILT = math.radians(1.5)
REFUSE_TILT = math.radians(20)


@dataclass(frozen=True)
class Alignment:
    """Axes, scale and their uncertainty.

    ``world_from_camera`` turns the clicked picture's camera axes to the world: origin in the
    middle of the rectangle, +X from the first corner to the second, +Y away from the plane
    towards the camera, metres. ``corners`` (4, 3) world metres. ``residual`` is the rms angle
    in radians between rays and fitted corners. ``sigma_tilt``, ``sigma_yaw`` (radians) and
    ``sigma_height`` (metres) are standard errors for ``click`` pixels of noise a coordinate.
    ``disagreement`` is the given depth over the fitted one minus 1, where both sides are
    given; ``warnings`` are for the user.
    """

    world_from_camera: Pose
    corners: Array
    width: float
    depth: float
    camera_height: float
    residual: float
    sigma_tilt: float
    sigma_yaw: float
    sigma_height: float
    disagreement: float | None
    warnings: tuple[str, ...]


def align(
    camera: CameraModel,
    points: ArrayLike,
    *,
    width: float | None = None,
    depth: float | None = None,
    camera_height: float | None = None,
    click: float = 1.0,
    any_plane: bool = False,
) -> Alignment:
    """Solve for the axes from `points` (4, 2), pixels in the camera's picture, in order.

    One length fixes the scale: `width` (first to second corner) before `camera_height` before
    `depth` (second to third). `any_plane` allows walls and ceilings.

    Raises
    ------
    UserError
        Corners outside the picture, out of order, collinear, above the horizon; no length.

    """
    q = np.asarray(points, float)
    if q.shape != (4, 2):
        raise UserError(f"four corners are needed, each x,y; there are {q.size / 2:g}")
    for value, name in ((width, "width"), (depth, "depth"), (camera_height, "camera height")):
        if value is not None and not 0 < value < math.inf:
            raise UserError(f"the {name} must be positive metres, not {value:g}")
    if width is None and depth is None and camera_height is None:
        raise UserError(
            "give the rectangle's width or depth, or the camera's height, in metres"
        )
    size = np.array(camera.size)
    d = camera.unproject(q)
    outside = ~np.isfinite(d).all(axis=1) | ((q < -0.5) | (q > size - 0.5)).any(axis=1)
    if outside.any():
        k = int(np.argmax(outside))
        raise UserError(
            f"corner {k + 1} ({q[k, 0]:g}, {q[k, 1]:g}) lies outside what the lens sees"
        )
    check_order(d)
    rotation = closed_form(d)
    up = rotation[:, 1]
    # camera y points down, so that a camera held upright has up . y < 0
    if not any_plane and up[1] > math.sin(math.radians(10)):
        raise UserError(
            "the rectangle lies above the horizon: click one on the floor, "
            "or allow any plane for a wall or ceiling"
        )
    p = -d / (d @ up)[:, None]  # on the plane at height 1
    if ((d @ up) > -1e-9).any():
        raise UserError("a corner lies on or above the horizon of the plane of the others")
    state = RectangleState.of(rotation, p)
    state, residuals, jacobian = _fit(state, d)
    noise = click_covariance(camera, q, d) * click**2
    gain = np.linalg.pinv(jacobian)
    covariance = gain @ noise @ gain.T
    sigma_tilt = float(np.sqrt(covariance[0, 0] + covariance[2, 2]))
    sigma_yaw = float(np.sqrt(covariance[1, 1]))
    if not sigma_tilt < REFUSE_TILT * max(click, 1.0):
        raise UserError(
            f"the corners are nearly on one line, or too close together: one pixel would tilt "
            f"the floor by {math.degrees(sigma_tilt):.0f} degrees; click a larger rectangle"
        )
    # lengths are in camera heights so far
    if width is not None:
        scale = width / state.width
        relative = np.sqrt(covariance[5, 5]) / state.width
    elif camera_height is not None:
        scale, relative = camera_height, 0.0
    else:
        assert depth is not None
        scale = depth / abs(state.depth)
        relative = np.sqrt(covariance[6, 6]) / abs(state.depth)
    disagreement = None
    if width is not None and depth is not None:
        disagreement = depth / (abs(state.depth) * scale) - 1
    warnings: list[str] = []
    if sigma_tilt > WARN_TILT * click:
        warnings.append(
            f"a small rectangle: a click {click:g} px off tilts the floor by about "
            f"{math.degrees(sigma_tilt):.1f} degrees; a larger one would be safer"
        )
    if disagreement is not None and abs(disagreement) > 0.1:
        warnings.append(
            f"width and depth disagree: for this width the picture shows a depth of "
            f"{abs(state.depth) * scale:.3g} m, not {depth:g} m"
        )
    if camera_height is not None and width is not None:
        other = scale
        if abs(camera_height / other - 1) > 0.1:
            warnings.append(
                f"width and camera height disagree: for this width the camera stands "
                f"{other:.3g} m high, not {camera_height:g} m"
            )
    corners = state.corners() * scale
    middle = corners.mean(axis=0)  # relative to the camera, in world axes
    return Alignment(
        world_from_camera=Pose(state.rotation.T, -middle),
        corners=corners - middle,
        width=state.width * scale,
        depth=abs(state.depth) * scale,
        camera_height=scale,
        residual=float(np.sqrt(np.mean(np.sum(residuals.reshape(4, 2) ** 2, axis=1)))),
        sigma_tilt=sigma_tilt,
        sigma_yaw=sigma_yaw,
        sigma_height=float(scale * relative),
        disagreement=disagreement,
        warnings=tuple(warnings),
    )


@dataclass(frozen=True)
class RectangleState:
    """The camera one unit above the plane: camera_from_world, the middle's x and z, sides.

    ``depth`` is signed: positive when the corners run so that it lies along +Z. ``plane``
    turns the rectangle's own axes (y is its normal) to the world's, for walls and ceilings.
    """

    rotation: Array
    middle: Array
    width: float
    depth: float
    plane: Array = field(default_factory=lambda: np.eye(3))

    @classmethod
    def of(cls, rotation: Array, p: Array) -> RectangleState:
        """From camera_from_rectangle and the corners (4, 3) in the camera's axes."""
        w = p @ rotation  # camera to world axes
        x, z = w[:, 0], w[:, 2]
        return cls(
            rotation,
            np.array([x.mean(), z.mean()]),
            float((x[1] - x[0] + x[2] - x[3]) / 2),
            float((z[3] - z[0] + z[2] - z[1]) / 2),
        )

    def corners(self) -> Array:
        """World axes, relative to the camera, (4, 3)."""
        x = self.middle[0] + self.width / 2 * _X
        z = self.middle[1] + self.depth / 2 * _Z
        return np.stack([x, np.full(4, -1.0), z], axis=1)

    def moved(self, step: Array) -> RectangleState:
        """By a rotation vector, then the middle's two, then the sides' changes, (7,)."""
        turn = Pose.from_rotation_vector(step[:3], np.zeros(3)).rotation
        return self.with_rotation(self.rotation @ turn, step[3:])

    def with_rotation(self, rotation: Array, step: Array) -> RectangleState:
        """Turned as given, the middle and the sides moved by `step` (4,)."""
        return replace(
            self,
            rotation=rotation,
            middle=self.middle + step[:2],
            width=float(self.width + step[2]),
            depth=float(self.depth + step[3]),
        )


_X = np.array([-1.0, 1.0, 1.0, -1.0])
_Z = np.array([-1.0, -1.0, 1.0, 1.0])


def check_order(d: Array) -> None:
    """Corners must run once around: all triple products of neighbours have one sign."""
    triples: list[float] = []
    for i in range(4):
        a, b, c = d[i], d[(i + 1) % 4], d[(i + 2) % 4]
        sides = np.linalg.norm(np.cross(a, b)), np.linalg.norm(np.cross(b, c))
        if min(sides) < 1e-9:
            raise UserError(f"corners {i + 1} and {(i + 1) % 4 + 1} are the same point")
        triples.append(float(np.dot(np.cross(a, b), c) / (sides[0] * sides[1])))
    if min(abs(t) for t in triples) < 1e-4:
        raise UserError("three corners lie on one line: they are no rectangle")
    positive = sum(t > 0 for t in triples)
    if positive == 2:
        raise UserError(
            "the corners' outline crosses itself: give them in order around the rectangle"
        )
    if positive in (1, 3):
        k = int(np.argmin(triples) if positive == 3 else np.argmax(triples))
        raise UserError(
            f"corner {(k + 1) % 4 + 1} lies inside the other three: no rectangle looks like it"
        )


def closed_form(d: Array) -> Array:
    """camera_from_world from the rays: vanishing directions of both pairs of sides."""
    v1 = unit(np.cross(np.cross(d[0], d[1]), np.cross(d[3], d[2])))
    v2 = unit(np.cross(np.cross(d[1], d[2]), np.cross(d[0], d[3])))
    n = unit(np.cross(v1, v2))
    if d.sum(axis=0) @ n > 0:
        n = -n
    # symmetric orthogonalisation: move both equally until they stand at right angles
    if v1 @ v2 < 0:
        v2 = -v2
    plus, minus = unit(v1 + v2), unit(v1 - v2)
    x = (plus + minus) / math.sqrt(2)
    height = np.where(np.abs(d @ n) < 1e-12, np.nan, d @ n)
    p = -d / height[:, None]
    if (p[1] - p[0]) @ x < 0:
        x = -x
    return np.stack([x, n, np.cross(x, n)], axis=1)


def _fit(state: RectangleState, d: Array) -> tuple[RectangleState, Array, Array]:
    """Gauss-Newton with halved steps on the angles between rays and corners, 8 against 7."""
    bases = np.stack([tangents(ray) for ray in d])  # (4, 3, 2)

    def residuals(s: RectangleState) -> Array:
        return rectangle_angles(s, d)

    def jacobian(s: RectangleState) -> Array:
        # of the unit corner, which is the angle's to first order
        w = s.corners()
        c = w @ s.rotation.T
        norm = np.linalg.norm(c, axis=1)
        dw = np.zeros((4, 3, 7))
        for k, axis in enumerate(np.eye(3)):
            dw[:, :, k] = np.cross(axis, w)
        dw[:, 0, 3] = dw[:, 2, 4] = 1
        dw[:, 0, 5], dw[:, 2, 6] = _X / 2, _Z / 2
        dc = np.einsum("ij,njk->nik", s.rotation, dw)
        unit = c / norm[:, None]
        dc = (dc - unit[:, :, None] * np.einsum("ni,nik->nk", unit, dc)[:, None, :]) / norm[
            :, None, None
        ]
        return np.einsum("nij,nik->njk", bases, dc).reshape(8, 7)

    r = residuals(state)
    for _ in range(50):
        step = -np.linalg.lstsq(jacobian(state), r, rcond=None)[0]
        while True:
            trial = state.moved(step)
            moved = residuals(trial)
            if moved @ moved <= r @ r or np.abs(step).max() < 1e-12:
                break
            step = step / 2
        if moved @ moved <= r @ r:
            state, r = trial, moved
        if np.abs(step).max() < 1e-10:
            break
    return state, r, jacobian(state)


def rectangle_angles(state: RectangleState, d: Array) -> Array:
    """Angles (8,) from the rays `d` (4, 3) to the corners, along both tangents of each."""
    bases = np.stack([tangents(ray) for ray in d])
    c = state.corners() @ state.rotation.T
    c = c / np.linalg.norm(c, axis=1, keepdims=True)
    off = np.einsum("ijk,ij->ik", bases, c)
    sine = np.linalg.norm(off, axis=1)
    angle = np.arctan2(sine, np.sum(c * d, axis=1))
    return (off * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 1)[:, None]).ravel()


def click_covariance(camera: CameraModel, q: Array, d: Array) -> Array:
    """Covariance of the eight angles for one pixel of noise, by the camera's Jacobian."""
    _, dq_dd = camera.project_with_jacobian(d)
    covariance = np.zeros((8, 8))
    for k in range(4):
        inverse = np.linalg.pinv(dq_dd[k] @ tangents(d[k]))  # d angle / d pixel
        covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = inverse @ inverse.T
    return covariance


def tangents(d: Array) -> Array:
    """Two unit vectors at right angles to d, (3, 2)."""
    side = np.eye(3)[int(np.argmin(np.abs(d)))]
    a = unit(np.asarray(np.cross(d, side), float))
    return np.stack([a, np.cross(d, a)], axis=1)


def unit(v: Array) -> Array:
    """Of length 1; refuses what has none."""
    norm = float(np.linalg.norm(v))
    if norm < 1e-12:
        raise UserError("the corners are on one line: they are no rectangle")
    return v / norm


# ---- align.json


def alignment_json(
    alignment: Alignment, picture: str | None, points: Sequence[Sequence[float]]
) -> dict[str, object]:
    """The content of align.json."""
    return {
        "world_from_camera": alignment.world_from_camera.matrix(),
        "corners": alignment.corners,
        "width": alignment.width,
        "depth": alignment.depth,
        "camera_height": alignment.camera_height,
        "residual": alignment.residual,
        "sigma_tilt": alignment.sigma_tilt,
        "sigma_yaw": alignment.sigma_yaw,
        "sigma_height": alignment.sigma_height,
        "disagreement": alignment.disagreement,
        "picture": picture,
        "points": points,
    }


def read_alignment(path: str | os.PathLike[str]) -> tuple[Pose, str | None]:
    """``world_from_camera`` of the clicked picture, and its name, from align.json."""
    value = read_json(path)
    try:
        matrix = np.array(value["world_from_camera"], float)
        if matrix.shape != (4, 4):
            raise ValueError(f"world_from_camera is {matrix.shape}, not 4x4")
        return Pose.from_matrix(matrix), value.get("picture")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"not an align.json: {error}", file=path) from error
