"""Where a calibrated camera stood, from points whose place in the world is known.

The start is a perspective-n-point solution on unprojected rays, turned so that their mean is
the axis (it holds for fisheyes beyond 90 degrees); then Levenberg-Marquardt on pixels through
the whole lens model. Four points of a plane fit two poses almost equally well (Schweighofer and
Pinz 2006): both are refined and judged by the floor they must stand above and by their error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.calibrate.resection import POSE, Evidence, Fit, refine
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose


@dataclass(frozen=True)
class PoseEstimate:
    """A pose with how well it is known.

    ``residuals`` (N, 2) projected minus clicked, pixels; ``rms`` over points, pixels.
    ``covariance`` (6, 6) of the rotation (radians about the camera's x, y, z: pitch, yaw, roll)
    and of the position (world, metres), for clicks with a standard deviation of ``sigma``
    pixels. ``rival_rms`` is the error of the other pose that a plane allows, if it too stands
    above the floor; ``ambiguous`` says that the clicks cannot tell the two apart.
    """

    world_from_camera: Pose
    residuals: NDArray[np.float64]
    rms: float
    sigma: float
    covariance: NDArray[np.float64]
    rival_rms: float | None
    ambiguous: bool

    @property
    def sigma_rotation(self) -> NDArray[np.float64]:
        """Standard errors of pitch, yaw and roll, radians, (3,)."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def sigma_position(self) -> NDArray[np.float64]:
        """Standard errors of the position along the world's axes, metres, (3,)."""
        return np.sqrt(np.diag(self.covariance)[3:])


def solve_pose(
    camera: CameraModel,
    points: ArrayLike,
    pixels: ArrayLike,
    *,
    sigma: float = 0.5,
    above_floor: bool = True,
) -> PoseEstimate:
    """Pose of `camera` that sees world `points` (N, 3) at `pixels` (N, 2).

    `sigma` is the standard deviation of a click in pixels; with `above_floor` only positions
    with y > 0 are accepted.

    Raises
    ------
    UserError
        For fewer than four points, points or pixels in a line, pixels that the lens does not
        see, or clicks that no camera above the floor can have seen.

    """
    p, q = np.asarray(points, float), np.asarray(pixels, float)
    if p.ndim != 2 or p.shape[1] != 3 or q.shape != (len(p), 2):
        raise UserError(f"{len(p)} world points need as many pixels, not {len(q)}")
    if len(p) < 4:
        raise UserError(f"a pose needs four points or more, not {len(p)}")
    if not (np.isfinite(p).all() and np.isfinite(q).all()):
        raise UserError("points and pixels must be finite")
    if _flatness(p) < 2:
        raise UserError("the world points lie in a line; they must span a plane")
    rays = camera.unproject(q)
    if not np.isfinite(rays).all():
        x, y = q[~np.isfinite(rays).all(axis=1)][0]
        raise UserError(f"the lens does not see pixel {x:g},{y:g}")
    _check_spread(q)
    width, height = camera.size
    if outside := [(x, y) for x, y in q if not (-0.5 <= x < width and -0.5 <= y < height)]:
        x, y = outside[0]
        raise UserError(f"pixel {x:g},{y:g} lies outside the picture of {width}x{height}")

    clicks = Evidence(p, q)
    fits = [
        fit for start in start_poses(p, rays) if (fit := refine(camera, start, clicks, POSE))
    ]
    if not fits:
        raise UserError("no pose fits these points: check their order and the camera's model")
    fits.sort(key=lambda fit: fit.cost)
    standing = [fit for fit in fits if not above_floor or fit.pose.inverse().translation[1] > 0]
    if not standing:
        raise UserError(
            "the camera would stand below the floor: click the points in the order of the "
            "world points, and not mirrored"
        )
    pose, residuals = standing[0].pose, standing[0].rows.reshape(-1, 2)
    rms = _rms(residuals)
    tolerance = max(10 * sigma, 0.01 * math.hypot(width, height))
    if rms > tolerance:
        raise UserError(
            f"the pixels miss the points by {rms:.1f} px: check their order, the rectangle's "
            "sides and the camera's model"
        )
    distinct = [fit for fit in standing[1:] if not _same(fit.pose, pose)]
    rival = _rms(distinct[0].rows.reshape(-1, 2)) if distinct else None
    # The pose is ambiguous when the clicks' noise could swap the two: within 3 sigma.
    excess = math.inf if rival is None else len(p) * (rival**2 - rms**2) / sigma**2
    return PoseEstimate(
        world_from_camera=pose.inverse(),
        residuals=residuals,
        rms=rms,
        sigma=sigma,
        covariance=_covariance(standing[0], sigma),
        rival_rms=rival,
        ambiguous=excess < 9,
    )


def start_poses(points: NDArray[np.float64], rays: NDArray[np.float64]) -> list[Pose]:
    """Poses ``camera_from_world`` for points (N, 3) seen along unit `rays` (N, 3).

    Two for points in a plane, the better one first; none where the rays spread over 85 degrees
    from their mean or the solver fails.
    """
    seen = on_plane(rays)
    if seen is None:
        return []
    plane, turn = seen
    flat = _flatness(points) == 2
    method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            np.ascontiguousarray(points), plane, np.eye(3), np.zeros(4), flags=method
        )
    except cv2.error:  # the solver's own word for a degenerate configuration
        return []
    poses: list[Pose] = []
    for r, t in zip(rotations, translations, strict=True):
        if np.isfinite(r).all() and np.isfinite(t).all():
            there = Pose.from_rotation_vector(np.ravel(r), np.ravel(t))
            poses.append(Pose(turn.T, np.zeros(3)) @ there)
    return poses


def _covariance(fit: Fit, sigma: float) -> NDArray[np.float64]:
    """Of (rotation about the camera's axes, position in the world).

    The state is exp(w) (R p + t) + dt: the position -R' t moves by -R' dt.
    """
    normal = fit.jacobian.T @ fit.jacobian
    condition = float(np.linalg.cond(normal / np.sqrt(np.outer(*[np.diag(normal)] * 2))))
    if not condition < 1e12:
        raise UserError("the points do not determine the pose: they are too close together")
    change = np.zeros((6, 6))
    change[:3, :3] = -np.eye(3)
    change[3:, 3:] = -fit.pose.rotation.T
    return sigma**2 * change @ np.linalg.inv(normal) @ change.T


def _check_spread(q: NDArray[np.float64]) -> None:
    spread = np.linalg.svd(q - q.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0] or spread[0] == 0:
        raise UserError("the pixels lie in a line; the points must be seen as an area")
    gaps = np.linalg.norm(q[:, None] - q[None], axis=-1) + np.diag(np.full(len(q), np.inf))
    if gaps.min() < 1:
        i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
        raise UserError(f"points {i + 1} and {j + 1} were clicked at the same pixel")


def on_plane(
    rays: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Where `rays` (N, 3), turned so that their mean is the axis, cross z = 1; and the turn.

    None where they spread over 85 degrees.
    """
    axis = rays.mean(axis=0)
    if np.linalg.norm(axis) < 1e-6:
        return None
    turn = _turn_to_z(axis / np.linalg.norm(axis))
    turned = rays @ turn.T
    if turned[:, 2].min() < math.cos(math.radians(85)):
        return None
    return np.ascontiguousarray(turned[:, :2] / turned[:, 2:]), turn


def _flatness(p: NDArray[np.float64]) -> int:
    """1 for points in a line, 2 in a plane, 3 in space; 0 for one point."""
    spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    return int((spread > 1e-6 * max(spread[0], 1e-300)).sum())


def _turn_to_z(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation that takes the unit `axis` to +Z."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis])


def _same(a: Pose, b: Pose) -> bool:
    return bool(
        np.allclose(a.rotation, b.rotation, atol=1e-5)
        and np.allclose(
            a.translation, b.translation, atol=1e-5 * float(np.linalg.norm(b.translation))
        )
    )


def _rms(residuals: NDArray[np.float64]) -> float:
    """Root mean square over points of the distance, pixels."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
