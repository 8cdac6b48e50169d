"""Where :mod:`chromeball.calibrate.match` begins: lenses of many fields of view, each posed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.pose import start_poses
from chromeball.calibrate.resection import Evidence, focals
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: Horizontal fields of view that are tried, degrees.
FIELDS_OF_VIEW = np.geomspace(6, 140, 22)


def candidates(lens: CameraModel) -> list[CameraModel]:
    """The lens with other focal lengths."""
    cameras: list[CameraModel] = []
    n = focals(lens)
    for degrees in FIELDS_OF_VIEW:
        values = lens.intrinsics.copy()
        values[:n] *= lens.size[0] / (2 * math.tan(math.radians(degrees) / 2) * values[0])
        cameras.append(replace(lens, intrinsics=values))
    return cameras


def starts(camera: CameraModel, evidence: Evidence) -> list[Pose]:
    """Poses camera_from_world by the points, or else by the lines."""
    if len(evidence.points) >= 4:
        rays = camera.unproject(evidence.pixels)
        if np.isfinite(rays).all() and (poses := start_poses(evidence.points, rays)):
            return poses
    if not len(evidence.axes):
        return []
    turn = _turn_of_lines(camera, evidence)
    if turn is None:
        return []
    # r x (R p + t) = 0 for every point
    rays = camera.unproject(evidence.pixels)
    if not np.isfinite(rays).all():
        return []
    cross = np.cross(np.eye(3), rays[:, None, :])  # rows of [r]
    turned = evidence.points @ turn.T
    right = -np.einsum("nij,nj->ni", cross, turned)
    shift = np.linalg.lstsq(cross.reshape(-1, 3), right.ravel(), rcond=None)[0]
    return [Pose(turn, shift)]


def _turn_of_lines(camera: CameraModel, evidence: Evidence) -> Array | None:
    """The rotation of camera_from_world by the vanishing points of two axes or three."""
    rays = camera.unproject(evidence.ends)
    if not np.isfinite(rays).all():
        return None
    normals = np.cross(rays[:, 0], rays[:, 1])
    columns = np.full((3, 3), np.nan)
    for axis in range(3):
        own = normals[evidence.axes == axis]
        if len(own) >= 2:
            columns[:, axis] = np.linalg.svd(own)[2][2]
    known = np.isfinite(columns[0])
    if known.sum() < 2:
        return None
    turn = np.where(known, columns, 0.0)
    # Signs: in the picture, too, the second end lies farther along the axis.
    middle = camera.unproject(evidence.ends.mean(axis=1))
    _, by_point = camera.project_with_jacobian(middle)
    w = np.einsum("mij,mj->mi", by_point, turn.T[evidence.axes])
    forth = (w * (evidence.ends[:, 1] - evidence.ends[:, 0])).sum(axis=1)
    for axis in np.flatnonzero(known).tolist():
        if forth[evidence.axes == axis].sum() < 0:
            turn[:, axis] *= -1
    if not known.all():
        missing = int(np.flatnonzero(~known)[0])
        turn[:, missing] = np.cross(turn[:, (missing + 1) % 3], turn[:, (missing + 2) % 3])
    u, _, vt = np.linalg.svd(turn)
    if np.linalg.det(u @ vt) < 0:
        raise UserError(
            "the lines' axes are left-handed: of each line the second end lies farther along "
            "its axis, and x, y, z are right-handed with y up"
        )
    return np.asarray(u @ vt, float)
