"""Least squares for cameras of any models on one rig before a board that may be bowed.

Shared unknowns are the intrinsics, the cameras' poses on the rig (the first stands at its
origin) and the bow; local ones a board pose for each instant. A corner's derivatives touch its
own camera's unknowns alone, so that the equations are put together camera by camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import bow_shape, gradients
from chromeball.calibrate.arrow import Arrowhead, cauchy, descend
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: Weak knowledge: deviations of distortion terms, and of the bow in widths of the board.
K_DEVIATION = 1.0
BOW_DEVIATION = 0.05
#: A corner farther off than this many deviations of a coordinate is no corner.
OUTLIER = 4.0
#: A view of which fewer corners than this share fit was misread, and counts for nothing.
LEAST_SHARE = 0.4
FEWEST_CORNERS = 6
#: Cauchy's scale in deviations, for 95 % of least squares' efficiency.
CAUCHY = 2.4


@dataclass(frozen=True)
class RigEstimate:
    """C cameras before F poses of a board, p_camera = C (R (p + bow) + t) + d.

    ``rotations`` (C, 3, 3) and ``translations`` (C, 3) are camera_from_rig, the first the
    identity; ``board_rotations`` (F, 3, 3) and ``board_translations`` (F, 3) rig_from_board,
    of any value where no camera saw the board. ``bow`` (2,) as in
    :class:`chromeball.calibrate.adjust.Estimate`.
    """

    cameras: tuple[CameraModel, ...]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    bow: NDArray[np.float64]
    board_rotations: NDArray[np.float64]
    board_translations: NDArray[np.float64]


@dataclass(frozen=True)
class Layout:
    """Where each camera's free intrinsics, its pose and the bow stand among the unknowns.

    ``free`` says which intrinsics are unknown, (k,) for each camera; ``lens`` and ``pose``
    hold their columns; ``count`` is that of all shared unknowns.
    """

    free: tuple[NDArray[np.bool_], ...]
    lens: tuple[NDArray[np.intp], ...]
    pose: tuple[NDArray[np.intp], ...]
    bow: NDArray[np.intp]
    count: int

    @classmethod
    def of(cls, free: tuple[NDArray[np.bool_], ...], *, bow: bool) -> Layout:
        """Of cameras whose `free` intrinsics are unknown, (k,) each, with or without a bow."""
        lens: list[NDArray[np.intp]] = []
        pose: list[NDArray[np.intp]] = []
        at = 0
        for c, chosen in enumerate(free):
            lens.append(np.arange(at, at + int(chosen.sum())))
            at += len(lens[-1])
            pose.append(np.arange(at, at + (6 if c else 0)))
            at += len(pose[-1])
        bows = np.arange(at, at + (2 if bow else 0))
        return cls(free, tuple(lens), tuple(pose), bows, at + len(bows))


def residuals(
    estimate: RigEstimate, board: NDArray[np.float64], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Projected minus observed, (C, F, rows, columns, 2); NaN where there is no corner."""
    bowed = board + (bow_shape(board) @ estimate.bow)[..., None] * [0.0, 0, 1]
    error = np.full(corners.shape, np.nan)
    for c, camera in enumerate(estimate.cameras):
        v = np.flatnonzero(np.isfinite(corners[c, ..., 0]).any(axis=(1, 2)))
        rig = np.einsum("vij,rcj->vrci", estimate.board_rotations[v], bowed)
        rig += estimate.board_translations[v, None, None]
        points = rig @ estimate.rotations[c].T + estimate.translations[c]
        error[c, v] = gradients(camera, points)[0] - corners[c, v]
    return error


def adjust_rig(
    estimate: RigEstimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
    layout: Layout,
    sigma: NDArray[np.float64],
    *,
    scale: float = math.inf,
    steps: int = 30,
    least_gain: float = 1e-10,
) -> RigEstimate:
    """The estimate of least cost, from a start.

    Parameters
    ----------
    estimate
        The start.
    board
        Corners on the flat board, (rows, columns, 3), metres.
    corners
        Observed pixels, (C, F, rows, columns, 2).
    used
        Which of them count, (C, F, rows, columns).
    layout
        What is unknown.
    sigma
        Deviation of a corner's coordinate in each camera, (C,).
    scale
        Cauchy's in deviations; infinite for least squares.
    steps, least_gain
        As :func:`chromeball.calibrate.arrow.descend` has them.

    """
    return descend(
        estimate,
        lambda at: linearise(at, board, corners, used, layout, sigma, scale),
        lambda at, shared, poses: _moved(at, layout, shared, poses),
        steps=steps,
        least_gain=least_gain,
    )


def linearise(
    estimate: RigEstimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
    layout: Layout,
    sigma: NDArray[np.float64],
    scale: float = math.inf,
) -> tuple[float, Arrowhead]:
    """Cost and normal equations; poses change as exp(w) R, t + dt.

    Instants of which no corner is used are held by a unit weight, and stay.
    """
    shape = bow_shape(board)
    bowed = board + (shape @ estimate.bow)[..., None] * [0.0, 0, 1]
    system = Arrowhead.empty(layout.count, corners.shape[1], 6)
    unseen = ~used.any(axis=(0, 2, 3))
    system.local[unseen] = np.eye(6)
    cost, rows = 0.0, 2 * bowed[..., 0].size
    for c, camera in enumerate(estimate.cameras):
        v = np.flatnonzero(used[c].any(axis=(1, 2)))
        counts = used[c, v]
        turned = np.einsum("vij,rcj->vrci", estimate.board_rotations[v], bowed)
        rig = turned + estimate.board_translations[v, None, None]
        in_camera = rig @ estimate.rotations[c].T
        q, by_point, by_intrinsics = gradients(camera, in_camera + estimate.translations[c])
        error = np.where(counts[..., None], q - corners[c, v], 0.0) / sigma[c]
        part_cost, weight = cauchy((error**2).sum(axis=-1), counts, scale)
        cost += part_cost
        by_rig = by_point @ estimate.rotations[c]
        parts = [by_intrinsics[..., layout.free[c]]]
        if len(layout.pose[c]):
            parts += [np.cross(in_camera[..., None, :], by_point), by_point]
        if len(layout.bow):
            normals = estimate.board_rotations[v, None, None, :, 2, None]
            parts.append((by_rig @ normals) * shape[:, :, None])
        shared = np.concatenate(parts, axis=-1) / sigma[c]
        local = np.concatenate([np.cross(turned[..., None, :], by_rig), by_rig], axis=-1)
        local /= sigma[c]
        shared[~counts], local[~counts] = 0.0, 0.0
        part = Arrowhead.of(
            shared.reshape(len(v), rows, shared.shape[-1]),
            local.reshape(len(v), rows, 6),
            error.reshape(len(v), rows),
            np.repeat(weight.reshape(len(v), -1), 2, axis=1),
        )
        columns = np.concatenate([layout.lens[c], layout.pose[c], layout.bow])
        system.include(part, columns, v)
    precision, value = _knowledge(estimate, board, layout)
    system.know(precision, value)
    cost += float(precision @ value**2)
    return cost if math.isfinite(cost) else math.inf, system


def robust(
    estimate: RigEstimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    layout: Layout,
    share: NDArray[np.float64],
    rounds: int = 4,
) -> RigEstimate:
    """Cauchy's estimate, its scale renewed from the residuals.

    `share` (C,) are the cameras' deviations of a corner in proportion to each other. They stay:
    deviations of their own would let one camera fit itself perfectly and forget the others.
    """
    for _ in range(rounds):
        error = residuals(estimate, board, corners)
        sigma = robust_sigma(error, share)
        # A misread board may lie where its lens does not see at all.
        seen = np.isfinite(error[..., 0])
        estimate = adjust_rig(
            estimate, board, corners, seen, layout, sigma,
            scale=CAUCHY, steps=12, least_gain=1e-4,
        )  # fmt: skip
    return estimate


def settle(
    estimate: RigEstimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    layout: Layout,
    share: NDArray[np.float64],
) -> tuple[RigEstimate, NDArray[np.bool_], NDArray[np.float64]]:
    """Least squares on the corners that fit, until they stay the same.

    Returns the estimate, the corners used (C, F, rows, columns) and the deviations of a
    coordinate (C,), in proportion to `share`, freed from the fitted unknowns. Views that do not
    fit go whole.
    """
    found = np.isfinite(corners[..., 0])
    used = np.zeros(found.shape, bool)
    sigma = robust_sigma(residuals(estimate, board, corners), share)
    for _ in range(10):
        error = distance(residuals(estimate, board, corners))
        fits = fitting(error < OUTLIER * sigma[:, None, None, None], found)
        if (fits == used).all():
            break
        used = fits
        if not used.any(axis=(1, 2, 3)).all():
            break
        estimate = adjust_rig(estimate, board, corners, used, layout, sigma)
        error = residuals(estimate, board, corners) / share[:, None, None, None, None]
        unknowns = layout.count + 6 * int(used.any(axis=(0, 2, 3)).sum())
        sigma = share * deviation(error[used], unknowns)
    return estimate, used, sigma


def fitting(good: NDArray[np.bool_], found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Corners that are `good`, of views (C, F, ...) of which enough are."""
    fits = good & found
    counts = fits.sum(axis=(2, 3))
    keep = (counts >= FEWEST_CORNERS) & (counts >= LEAST_SHARE * found.sum(axis=(2, 3)))
    return fits & keep[..., None, None]


def deviation(error: NDArray[np.float64], unknowns: int) -> float:
    """Deviation of a coordinate from residuals (N, 2), freed from the fitted unknowns."""
    if error.size <= unknowns:
        raise UserError("after outlier rejection too few corners are left: check the pictures")
    return max(math.sqrt(float((error**2).sum()) / (error.size - unknowns)), 1e-9)


def robust_sigma(error: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Deviations of a coordinate (C,) in proportion to `share`, by the median distance."""
    relative = distance(error) / share[:, None, None, None]
    return share * max(float(np.nanmedian(relative)) / math.sqrt(2 * math.log(2)), 1e-9)


def distance(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Length of residuals (..., 2)."""
    return np.hypot(error[..., 0], error[..., 1])


def _knowledge(
    estimate: RigEstimate, board: NDArray[np.float64], layout: Layout
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inverse variances of weak knowledge that distortion and bow are small, and values."""
    precision, value = np.zeros(layout.count), np.zeros(layout.count)
    for camera, free, columns in zip(estimate.cameras, layout.free, layout.lens, strict=True):
        weak = np.zeros(len(free))
        weak[4:] = 1 / K_DEVIATION**2
        precision[columns], value[columns] = weak[free], camera.intrinsics[free]
    if len(layout.bow):
        width = float(np.ptp(board[..., :2], axis=(0, 1)).max())
        precision[layout.bow] = 1 / (BOW_DEVIATION * width) ** 2
        value[layout.bow] = estimate.bow
    return precision, value


def _moved(
    estimate: RigEstimate,
    layout: Layout,
    shared: NDArray[np.float64],
    poses: NDArray[np.float64],
) -> RigEstimate | None:
    """The estimate after a step; None where a camera would be impossible."""
    from scipy.spatial.transform import Rotation

    cameras: list[CameraModel] = []
    change = np.zeros((len(estimate.cameras), 6))
    for c, camera in enumerate(estimate.cameras):
        intrinsics = camera.intrinsics.copy()
        intrinsics[layout.free[c]] += shared[layout.lens[c]]
        if intrinsics[: 2 if len(intrinsics) > 3 else 1].min() <= 0:
            return None
        cameras.append(replace(camera, intrinsics=intrinsics))
        if len(layout.pose[c]):
            change[c] = shared[layout.pose[c]]
    bow = estimate.bow + (shared[layout.bow] if len(layout.bow) else 0.0)
    return RigEstimate(
        cameras=tuple(cameras),
        rotations=Rotation.from_rotvec(change[:, :3]).as_matrix() @ estimate.rotations,
        translations=estimate.translations + change[:, 3:],
        bow=bow,
        board_rotations=Rotation.from_rotvec(poses[:, :3]).as_matrix()
        @ estimate.board_rotations,
        board_translations=estimate.board_translations + poses[:, 3:],
    )
