"""The emulated cameras of the set: where they truly stand and what lenses they truly have."""

from __future__ import annotations

import math

import numpy as np

from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

#: The light probe: a 190-degree equisolid fisheye on a turntable, two shots half a turn apart.
PROBE_FOV = math.radians(190)
PROBE_PLACE = np.array([0.12, 1.05, 1.35])
PROBE_YAWS = {"front": 0.0, "back": 180.0}

#: The view camera: a lens with strong barrel distortion and a decentred principal point.
VIEW_SIZE = (640, 480)
VIEW_INTRINSICS = np.array(
    [560.0, 561.5, 316.3, 243.8, -0.195, 0.062, 0.0011, -0.0007, -0.004, 0.11, 0.021, 0.003]
)
VIEW_PLACE = np.array([1.15, 1.45, 2.75])


def turned(pose: Pose, yaw: float) -> Pose:
    """`pose` turned about the vertical through its place by `yaw` degrees."""
    about_y = Pose.from_rotation_vector([0, math.radians(yaw), 0], [0, 0, 0])
    return Pose(about_y.rotation @ pose.rotation, pose.translation)


def probe_camera(name: str, size: int) -> CameraModel:
    """The probe as it stands for the shot of that name, `size` x `size` pixels."""
    aim = PROBE_PLACE + [0.08, 0.0, -1.0]
    tilt = Pose.from_rotation_vector([0.015, 0, 0.03], [0, 0, 0])
    level = Pose.look_at(PROBE_PLACE, aim)
    pose = turned(Pose(level.rotation @ tilt.rotation, PROBE_PLACE), PROBE_YAWS[name])
    return CameraModel.fisheye(
        "equisolid", (size, size), PROBE_FOV, radius=0.48 * size, pose=pose
    )


def view_camera() -> CameraModel:
    """The view camera where it photographs the plate."""
    pose = Pose.look_at(VIEW_PLACE, [0.02, 0.25, 0.0])
    return CameraModel("LENSMODEL_OPENCV8", VIEW_INTRINSICS, VIEW_SIZE, pose)
