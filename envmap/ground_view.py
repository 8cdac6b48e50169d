"""The view straight down, and a hand-held shot of the ground placed in it (seeds.md F2).

The ground is a plane: rays from the panorama's place and from the shot's, which was taken
elsewhere, are one homography apart (Hartley and Zisserman 2004, 13.1). Features that both see
around the hole say it; consensus by MAGSAC++ (Barath et al. 2020), then least squares in the
shot's pixels with standard errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.mapping import Lens, Mapping, Radial
from chromeball.envmap.stitch.features import find, match
from chromeball.envmap.stitch.lens import pixel_focal
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
type Mask = NDArray[np.bool_]

#: Looking down, +Z at the top, as a lat-long's lower edge unrolls.
WORLD_FROM_DOWN = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
#: How far from the consensus a feature may lie, pixels of the shot.
THRESHOLD = 3.0
#: Features that must agree, and their share of all matches.
LEAST, SHARE = 12, 0.15
#: Standard error within the hole above which the place is refused, radians.
REFUSE = math.radians(2.0)
#: The shot's longer side is made this large for its features.
SEARCHED = 1400
LIMIT = 4000


@dataclass(frozen=True)
class Placed:
    """``homography`` (3, 3): a ray of the shot is ``homography @ d`` for a world direction d.

    ``residual`` median of the inliers and ``rms``, shot pixels; ``sigma`` the largest standard
    error of the place on the hole's edge, radians, and ``condition`` of the solve; both are NaN
    for four pairs, which leave nothing over. ``points`` (M, 2) the inliers in the view.
    """

    homography: Array
    residual: float
    rms: float
    sigma: float
    condition: float
    matches: int
    inliers: int
    points: Array


@dataclass(frozen=True)
class OnGround:
    """The shot's camera as if it stood where the panorama was taken: rays pass the plane."""

    camera: CameraModel
    homography: Array

    def project(self, directions: ArrayLike, /) -> Array:
        """World directions (..., 3) to pixels (..., 2), NaN above the horizon or unseen."""
        d = np.asarray(directions, float)
        ray = d @ self.homography.T
        seen = d[..., 1] < 0
        if self.camera.max_angle <= math.pi / 2 or self.camera.model == "pinhole":
            seen &= ray[..., 2] > 0
        with np.errstate(invalid="ignore", divide="ignore"):
            q = self.camera.project(np.where(seen[..., None], ray, [0.0, 0.0, 1.0]))
        q[~seen] = np.nan
        return q

    def unproject(self, pixels: ArrayLike, /) -> Array:
        """Pixels (..., 2) to unit world directions (..., 3), NaN where they miss the ground."""
        d = self.camera.unproject(pixels) @ np.linalg.inv(self.homography).T
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            d[~(d[..., 1] < 0)] = np.nan
        return d

    def mapping(self) -> Mapping:
        """For `warp`: directions are the world's."""
        return Lens(self.camera.size, np.eye(3), camera=self)


def down_view(reach: float, density: float) -> CameraModel:
    """A perspective camera that sees `reach` radians to all sides, `density` px a radian."""
    half = max(64, math.ceil(density * math.tan(reach)))
    return CameraModel.pinhole((2 * half, 2 * half), 2 * reach)


def down_mapping(view: CameraModel) -> Mapping:
    """The view's mapping, turned to look down."""
    f, _, cx, cy = (float(value) for value in view.intrinsics)
    corner = math.atan(math.hypot(*view.size) / (2 * f))
    # perspective as one more r(theta): in closed form, where an arbitrary lens needs tables
    mapping = Radial(
        view.size,
        focal=(f, f),
        centre=(cx, cy),
        radius=np.tan,
        angle=np.arctan,
        max_angle=corner,
    )
    return mapping.turned(WORLD_FROM_DOWN)


def place(
    shot: Picture,
    camera: CameraModel,
    ground: Picture,
    view: CameraModel,
    edge: Array,
    *,
    valid: Mask | None = None,
    seen: Mask | None = None,
) -> Placed:
    """Place a `shot` (H, W, 3) of `camera` by features against the `ground` in the `view`.

    `valid` (H, W) what counts of the shot, `seen` of the ground; `edge` (N, 3) world
    directions on the hole's edge.

    Raises
    ------
    UserError
        When too few features agree, or they do not fix the place.

    """
    import cv2

    scale = min(1.0, SEARCHED / max(camera.size))
    small = camera.scaled(scale)
    resized = cv2.resize(shot, small.size, interpolation=cv2.INTER_AREA)
    picture = np.asarray(resized, np.float32)
    usable: Mask | None = None
    if valid is not None:
        kept = cv2.resize(valid.astype(np.uint8), small.size, interpolation=cv2.INTER_NEAREST)
        usable = np.asarray(kept) > 0
    first, second = find(ground, seen, LIMIT), find(picture, usable, LIMIT)
    pairs = match(first, second)
    world = view.unproject(first.pixels[pairs[:, 0]]) @ WORLD_FROM_DOWN.T
    q = second.pixels[pairs[:, 1]]
    ahead = small.unproject(q)
    good = np.isfinite(ahead).all(axis=1) & (ahead[:, 2] > 0.1)
    if good.sum() < LEAST:
        raise UserError(
            f"the shot shares {int(good.sum())} features with the ground around the hole, "
            f"{LEAST} are needed: take in more of the ground about it, or click four points "
            "with --points"
        )
    world, q, ahead = world[good], q[good], ahead[good]
    focal = pixel_focal(small)
    flat, tangent = _tangent(world @ WORLD_FROM_DOWN), _tangent(ahead)
    cv2.setRNGSeed(1)
    found, mask = cv2.findHomography(
        flat, focal * tangent, cv2.USAC_MAGSAC, THRESHOLD, maxIters=20000, confidence=0.9999
    )
    result: Any = found  # None where there is no consensus at all, whatever the stubs say
    inside = np.zeros(len(q), bool) if result is None else np.asarray(mask).ravel() > 0
    if inside.sum() < max(LEAST, SHARE * len(q)):
        raise UserError(
            f"of {len(q)} features only {int(inside.sum())} agree on one plane: is it a shot "
            "of this ground, and flat? Four points can be clicked with --points"
        )
    start = np.diag([1 / focal, 1 / focal, 1]) @ result @ WORLD_FROM_DOWN.T
    # the sign that puts the features ahead of the camera
    start *= np.sign(np.median((world[inside] @ start.T)[:, 2]))
    return _refined(start, world[inside], q[inside] / scale, camera, edge, len(q), scale)


def place_by_points(
    pixels: ArrayLike, world: ArrayLike, camera: CameraModel, edge: Array
) -> Placed:
    """Place a shot by clicked pairs (N, 2) of its pixels and (N, 3) directions, N >= 4.

    Raises
    ------
    UserError
        When three of them lie on a line, or above the horizon.

    """
    q, d = np.asarray(pixels, float), np.asarray(world, float)
    if len(q) < 4 or len(q) != len(d):
        raise UserError(f"four pairs of points or more are needed, not {len(q)}")
    if (d[:, 1] >= 0).any():
        raise UserError("a point of the panorama lies above its horizon: click on the ground")
    ahead = camera.unproject(q)
    if not np.isfinite(ahead).all() or (ahead[:, 2] <= 0).any():
        raise UserError("a point lies outside what the shot's lens sees")
    flat, tangent = _tangent(d @ WORLD_FROM_DOWN), _tangent(ahead)
    rows: list[Array] = []
    for (x, y), (u, v) in zip(flat, tangent, strict=True):
        p = np.array([x, y, 1.0])
        rows += [np.r_[p, 0, 0, 0, -u * p], np.r_[0, 0, 0, p, -v * p]]
    _, s, vt = np.linalg.svd(np.array(rows))
    start = vt[-1].reshape(3, 3)
    if s[7] < 1e-5 * s[0] or np.linalg.cond(start) > 1e5:
        raise UserError("three of the points lie nearly on one line: click a wide quadrangle")
    start = start @ WORLD_FROM_DOWN.T
    depth = (d @ start.T)[:, 2]
    start *= np.sign(np.median(depth))
    if (d @ start.T)[:, 2].min() <= 0:
        raise UserError("the points' orders do not fit: is each pair one place?")
    return _refined(start, d, q, camera, edge, len(q), 1.0)


def _tangent(rays: Array) -> Array:
    return rays[:, :2] / rays[:, 2:]


def _refined(
    start: Array,
    world: Array,
    pixels: Array,
    camera: CameraModel,
    edge: Array,
    matches: int,
    scale: float,
) -> Placed:
    """Least squares in the shot's pixels, soft beyond one pixel of the searched picture."""
    from scipy.optimize import least_squares

    base = start / np.linalg.norm(start)

    def place_of(h: Array) -> Array:
        return camera.project(world @ h.reshape(3, 3).T)

    def error(h: Array) -> Array:
        return np.nan_to_num(place_of(h) - pixels, nan=1e3).ravel()

    solved = least_squares(error, base.ravel(), loss="soft_l1", f_scale=1 / scale, x_scale=0.1)
    h = solved.x / np.linalg.norm(solved.x)
    left = np.linalg.norm(error(h).reshape(-1, 2), axis=1)
    jacobian = _slopes(place_of, h)
    # the ninth, the scale, changes nothing
    across = np.linalg.svd(h[None])[2][1:]
    reduced = jacobian @ across.T
    singular = np.linalg.svd(reduced, compute_uv=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else math.inf
    homography = h.reshape(3, 3)
    sigma = math.nan
    if len(left) > 4:
        dof = 2 * len(left) - 8
        # a robust scale, so that what MAGSAC let in does not blow it up
        spread = max(float(np.median(left)) / 1.1774, 1e-3) ** 2 * 2 * len(left) / dof
        covariance = spread * np.linalg.pinv(reduced.T @ reduced)
        sigma = _edge_error(homography, covariance, across, edge)
    if not condition < 1e9 or np.linalg.cond(homography) > 1e4 or sigma > REFUSE:
        raise UserError(
            "what shot and panorama share does not fix the shot's place (it would be "
            f"{math.degrees(sigma):.1f} degrees off at the hole's edge): take in ground on all "
            "sides of the hole, or click four points with --points"
        )
    return Placed(
        homography=homography,
        residual=float(np.median(left)),
        rms=float(np.sqrt(np.mean(left**2))),
        sigma=sigma,
        condition=condition,
        matches=matches,
        inliers=len(left),
        points=world,
    )


def _slopes(what: Callable[[Array], Array], h: Array) -> Array:
    """Central differences of pixels (N, 2) by the nine numbers, (2 N, 9)."""
    columns = [(what(h + step) - what(h - step)).ravel() / 2e-6 for step in 1e-6 * np.eye(9)]
    return np.nan_to_num(np.stack(columns, axis=1))


def _edge_error(homography: Array, covariance: Array, across: Array, edge: Array) -> float:
    """Largest standard error, radians, of the world direction a ray belongs to.

    d ~ H^-1 r, so that a change dH moves it by -H^-1 dH d, across d.
    """
    inverse = np.linalg.inv(homography)
    some = edge[:: max(1, len(edge) // 64)]
    worst = 0.0
    for d in some:
        slope = -np.einsum("ab,kbc,c->ak", inverse, across.reshape(-1, 3, 3), d)
        slope = (np.eye(3) - np.outer(d, d)) @ slope
        worst = max(worst, float(np.trace(slope @ covariance @ slope.T)))
    return math.sqrt(worst)
