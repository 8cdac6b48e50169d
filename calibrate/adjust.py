"""Least squares for one camera of any model before a board that may be bowed.

Unknowns are the intrinsics, the bow, the travel of the entrance pupil and a pose for each view.
Derivatives are exact, through the camera's own; the poses meet only in what all views share
(:mod:`chromeball.calibrate.arrow`).
Weights are Cauchy's where corners may be wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.arrow import Arrowhead, cauchy, descend
from chromeball.scene.camera import CameraModel, sees_behind
from chromeball.scene.errors import UserError


@dataclass(frozen=True)
class Estimate:
    """A camera before V views of a board: p_camera = R (p + bow) + t.

    ``rotations`` (V, 3, 3) and ``translations`` (V, 3); ``bow`` (2,), the deflection of the
    board's middle, metres, along x and y: z = b_x (1 - x^2) + b_y (1 - y^2) with -1 and 1 at
    the edges, as mrcal has it. ``pupil`` (2,): the entrance pupil of a wide lens travels along
    the axis with the angle, s = e_1 theta^2 + e_2 theta^4 metres, which near boards show and
    far scenes do not (the E of Gennery's CAHVORE, 2006).
    """

    camera: CameraModel
    bow: NDArray[np.float64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    pupil: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    def views(self, chosen: NDArray[Any]) -> Estimate:
        """The same camera before some of the views."""
        return replace(
            self, rotations=self.rotations[chosen], translations=self.translations[chosen]
        )


def gradients(
    camera: CameraModel, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (..., 2), d pixel / d point (..., 2, 3), d pixel / d intrinsics (..., 2, k).

    Pixels are NaN where the lens does not see.
    """
    if camera.model.startswith("LENSMODEL_"):
        import mrcal

        solver: Any = mrcal
        values = solver.project(points, camera.model, camera.intrinsics, get_gradients=True)
        q, by_point, by_intrinsics = (np.array(v, float) for v in values)
        if not sees_behind(camera.model):
            q[points[..., 2] <= 0] = np.nan
        return q, by_point, by_intrinsics
    q, by_point = camera.project_with_jacobian(points)
    k = camera.intrinsics
    two = len(k) > 3
    focal, centre = (k[:2], k[2:4]) if two else (k[[0, 0]], k[1:3])
    from_centre = (q - centre) / focal
    by_intrinsics = np.zeros((*q.shape, len(k)))
    if two:
        by_intrinsics[..., [0, 1], [0, 1]] = from_centre
    else:
        by_intrinsics[..., 0] = from_centre
    first = 2 if two else 1
    by_intrinsics[..., [0, 1], [first, first + 1]] = 1
    if not camera.model.startswith("kb4"):
        return q, by_point, by_intrinsics
    rho = np.hypot(points[..., 0], points[..., 1])
    theta = np.arctan2(rho, points[..., 2])
    along = points[..., :2] / np.where(rho > 0, rho, 1)[..., None]
    powers = theta[..., None] ** np.array([3, 5, 7, 9])
    by_intrinsics[..., 4:8] = (focal * along)[..., None] * powers[..., None, :]
    if camera.model == "kb4_decentred":
        u, v = np.moveaxis(theta[..., None] * along, -1, 0)
        both = 2 * u * v
        by_intrinsics[..., 8] = focal * np.stack([both, u**2 + 3 * v**2], axis=-1)
        by_intrinsics[..., 9] = focal * np.stack([3 * u**2 + v**2, both], axis=-1)
    return q, by_point, by_intrinsics


def camera_points(estimate: Estimate, board: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corners as the entrance pupil sees them, in camera axes, (V, rows, columns, 3)."""
    bowed = board + (bow_shape(board) @ estimate.bow)[..., None] * [0.0, 0, 1]
    points = _turned(estimate, bowed) + estimate.translations[:, None, None]
    return _from_pupil(points, estimate.pupil)[0]


def residuals(
    estimate: Estimate, board: NDArray[np.float64], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Projected minus observed, (V, rows, columns, 2)."""
    return gradients(estimate.camera, camera_points(estimate, board))[0] - corners


def adjust(
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
    *,
    free: NDArray[np.bool_],
    precision: NDArray[np.float64],
    scale: float = math.inf,
    steps: int = 30,
    least_gain: float = 1e-10,
) -> Estimate:
    """The estimate of least cost, from a start.

    Parameters
    ----------
    estimate
        The start; returned as it is where the lens does not see some corner at all.
    board
        Corners on the flat board, (rows, columns, 3), metres.
    corners
        Observed pixels, (V, rows, columns, 2).
    used
        Which of them count, (V, rows, columns).
    free
        Which of the intrinsics, the bows and the pupil's terms are unknown, (k + 4,).
    precision
        Weak knowledge that they are near zero: the inverse variance, times that of a corner.
    scale
        Cauchy's: a corner this many pixels off counts half; infinite for least squares.
    steps
        The most steps.
    least_gain
        The relative gain of the cost below which a step is the last.

    """
    return descend(
        estimate,
        lambda at: _linearise(at, board, corners, used, free, precision, scale),
        lambda at, shared, poses: _moved(at, free, shared, poses),
        steps=steps,
        least_gain=least_gain,
    )


def covariance(
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
    precision: NDArray[np.float64],
    free: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], float]:
    """Covariance (k + 4, k + 4) of intrinsics, bow and pupil for corners of deviation 1 pixel.

    It is the block of (J'J)^-1 over all unknowns, zero for those not `free`. With it comes the
    condition of the reduced normal equations, scaled to a unit diagonal.

    Raises
    ------
    UserError
        When they are singular.

    """
    _, system = _linearise(estimate, board, corners, used, free, precision, math.inf)
    inverse, condition = system.covariance()
    if not condition < 1e13:
        raise UserError(
            "these pictures do not determine the lens: take more, with the board tilted and "
            "all over the picture"
        )
    whole = np.zeros((len(free), len(free)))
    whole[np.ix_(free, free)] = inverse
    return whole, condition


def derivatives(
    estimate: Estimate, board: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (V, rows, columns, 2) of the board's corners and how they move.

    With intrinsics, bow and pupil, (V, rows, columns, 2, k + 4); with the view's pose,
    exp(w) R and t + dt, (V, rows, columns, 2, 6).
    """
    shape = bow_shape(board)
    bowed = board + (shape @ estimate.bow)[..., None] * [0.0, 0, 1]
    turned = _turned(estimate, bowed)
    points, by_travel, of_point = _from_pupil(
        turned + estimate.translations[:, None, None], estimate.pupil
    )
    q, by_seen, by_intrinsics = gradients(estimate.camera, points)
    # p' = p - s(p) e_z: d q / d p = d q / d p' - (d q / d p') e_z ds/dp
    by_z = by_seen[..., 2]
    by_point = by_seen - by_z[..., None] * of_point[..., None, :]
    by_pupil = -by_z[..., None] * by_travel[..., None, :]
    # d pixel / d bow = d pixel / d point R e_z (1 - x^2)
    normals = estimate.rotations[:, None, None, :, 2, None]
    by_bow = (by_point @ normals) * shape[:, :, None]
    shared = np.concatenate([by_intrinsics, by_bow, by_pupil], axis=-1)
    by_turn = np.cross(turned[..., None, :], by_point)
    return q, shared, np.concatenate([by_turn, by_point], axis=-1)


# ---- the normal equations


def _linearise(
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
    free: NDArray[np.bool_],
    precision: NDArray[np.float64],
    scale: float,
) -> tuple[float, Arrowhead]:
    """Cost, and J'J and J'e over the free unknowns; a pose's change is exp(w) R, t + dt."""
    q, by_shared, pose = derivatives(estimate, board)
    views = len(corners)
    error = np.where(used[..., None], q - corners, 0.0)
    square = (error**2).sum(axis=-1)
    cost, weight = cauchy(square, used, scale)
    shared = by_shared[..., free]
    unused = ~used
    shared[unused], pose[unused] = 0.0, 0.0

    rows = 2 * used[0].size
    system = Arrowhead.of(
        shared.reshape(views, rows, int(free.sum())),
        pose.reshape(views, rows, 6),
        error.reshape(views, rows),
        np.repeat(weight.reshape(views, -1), 2, axis=1),
    )
    value = np.concatenate([estimate.camera.intrinsics, estimate.bow, estimate.pupil])[free]
    known = precision[free]
    system.know(known, value)
    cost += float(known @ value**2)
    return cost if math.isfinite(cost) else math.inf, system


def _moved(
    estimate: Estimate,
    free: NDArray[np.bool_],
    shared: NDArray[np.float64],
    poses: NDArray[np.float64],
) -> Estimate | None:
    """The estimate after a step; None where the camera would be impossible."""
    from scipy.spatial.transform import Rotation

    change = np.zeros(len(free))
    change[free] = shared
    intrinsics = estimate.camera.intrinsics + change[:-4]
    if intrinsics[: 2 if len(intrinsics) > 3 else 1].min() <= 0:
        return None
    return Estimate(
        camera=replace(estimate.camera, intrinsics=intrinsics),
        bow=estimate.bow + change[-4:-2],
        pupil=estimate.pupil + change[-2:],
        rotations=Rotation.from_rotvec(poses[:, :3]).as_matrix() @ estimate.rotations,
        translations=estimate.translations + poses[:, 3:],
    )


def _turned(estimate: Estimate, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """R p for every view, (V, rows, columns, 3)."""
    return np.einsum("vij,rcj->vrci", estimate.rotations, points)


def _from_pupil(
    points: NDArray[np.float64], pupil: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Points (..., 3) less the travel s, and ds / d pupil (..., 2), ds / d point (..., 3)."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    rho = np.hypot(x, y)
    theta = np.arctan2(rho, z)
    powers = np.stack([theta**2, theta**4], axis=-1)
    slope = 2 * pupil[0] * theta + 4 * pupil[1] * theta**3
    # d theta / d p = (z x / rho, z y / rho, -rho) / |p|^2; on the axis the slope is zero.
    away = np.where(rho > 0, rho, 1.0)
    by_theta = np.stack([z * x / away, z * y / away, -rho], axis=-1)
    square = np.where(rho > 0, rho**2 + z**2, 1.0)
    seen = points - (powers @ pupil)[..., None] * [0.0, 0, 1]
    return seen, powers, (slope / square)[..., None] * by_theta


def bow_shape(board: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 - x^2 and 1 - y^2, (rows, columns, 2)."""
    low, high = board.min(axis=(0, 1))[:2], board.max(axis=(0, 1))[:2]
    place = (2 * board[..., :2] - low - high) / np.where(high > low, high - low, 1)
    return np.asarray(1 - place**2, float)
