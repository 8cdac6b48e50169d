"""Virtual photographs of targets and their projected corners, through any camera model.

Truth for tests and benchmarks.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose


def photograph(
    target: Target,
    camera: CameraModel,
    camera_from_board: Pose,
    *,
    blur: float = 0.8,
    noise: float = 2.0,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """The board with a white rim on grey as the camera's codes, (H, W).

    `blur` is the standard deviation of the lens's spread in pixels, `noise` that of the codes.
    """
    fine = 3
    n = target.cells_per_square
    rim = max(n // 2, 1)
    board = np.pad(target.cells(), rim, constant_values=255)
    # Cells of about half a pixel, interpolated, so that edges are where they should be.
    near = camera.project(camera_from_board.apply(target.points()))
    pitch = float(np.nanmedian(np.linalg.norm(np.diff(near, axis=1), axis=-1)))
    parts = max(1, round(2 * pitch / n)) if np.isfinite(pitch) else 1
    board = np.kron(board, np.ones((parts, parts), np.uint8))
    n, rim = n * parts, rim * parts
    rays = camera.unproject(camera.pixel_grid())
    width, height = camera.size
    # Rays are smooth, so that between pixel centres they are interpolated.
    x, y = np.meshgrid(
        (np.arange(width * fine) + 0.5) / fine - 0.5,
        (np.arange(height * fine) + 0.5) / fine - 0.5,
    )
    rays = np.stack(
        [
            cv2.remap(
                np.ascontiguousarray(rays[..., i]).astype(np.float32),
                x.astype(np.float32),
                y.astype(np.float32),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            for i in range(3)
        ],
        axis=-1,
    ).astype(float)
    board_from_camera = camera_from_board.inverse()
    d, o = board_from_camera.rotate(rays), board_from_camera.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -o[2] / d[..., 2]
        place = o[:2] + distance[..., None] * d[..., :2]
        cell = (place / target.square + 1) * n + rim
        hit = (distance > 0) & (cell >= 0).all(axis=-1)
        hit &= (cell < board.shape[::-1]).all(axis=-1)
    column, row = (np.where(hit, cell[..., i] - 0.5, 0).astype(np.float32) for i in range(2))
    codes = cv2.remap(
        board.astype(np.float32), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    shade = np.where(hit, 30 + codes * (190 / 255), 110.0)
    picture = cv2.resize(
        cv2.GaussianBlur(shade, (0, 0), blur * fine), camera.size, interpolation=cv2.INTER_AREA
    )
    picture = np.asarray(picture) + np.random.default_rng(seed).normal(
        0, noise, (height, width)
    )
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def board_poses(
    target: Target, camera: CameraModel, count: int, seed: int = 0, size: float = 0.55
) -> list[Pose]:
    """Poses of boards all over the picture, tilted up to 40 degrees, all of them in it."""
    rng = np.random.default_rng(seed)
    points = target.points().reshape(-1, 3)
    middle = points.mean(axis=0)
    half = np.linalg.norm(camera.unproject(np.array([[0.0, 0], camera.size]))[0, :2])
    reach = target.square * (target.columns + 1) / (2 * half * size)
    poses: list[Pose] = []
    while len(poses) < count:
        q = rng.uniform([0.2, 0.2], [0.8, 0.8]) * camera.size
        ray = camera.unproject(q)
        turn = Pose.from_rotation_vector(rng.uniform(-0.7, 0.7, 3) * [1, 1, 0.6], np.zeros(3))
        distance = reach * rng.uniform(0.8, 1.3)
        pose = Pose(turn.rotation, distance * ray - turn.rotation @ middle)
        seen = camera.project(pose.apply(points))
        if (seen > 6).all() and (seen < np.array(camera.size) - 7).all():
            poses.append(pose)
    return poses


def surrounding_poses(
    target: Target, camera: CameraModel, count: int, seed: int = 0
) -> list[Pose]:
    """Poses of boards in all directions that a fisheye sees, facing it but for 40 degrees.

    Their middles are half a board's diagonal to one and a half away; all corners are seen.
    """
    rng = np.random.default_rng(seed)
    points = target.points().reshape(-1, 3)
    middle, diagonal = points.mean(axis=0), float(np.linalg.norm(np.ptp(points, axis=0)))
    poses: list[Pose] = []
    while len(poses) < count:
        theta, phi = camera.max_angle * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        axis = np.array([-np.sin(phi), np.cos(phi), 0])
        turn = Pose.from_rotation_vector(theta * axis, np.zeros(3)).rotation
        tilt = Pose.from_rotation_vector(rng.uniform(-0.7, 0.7, 3), np.zeros(3)).rotation
        away = np.array([0, 0, diagonal * rng.uniform(0.5, 1.5)])
        pose = Pose(turn @ tilt, turn @ (away - tilt @ middle))
        seen = camera.project(pose.apply(points))
        if (seen > 6).all() and (seen < np.array(camera.size) - 7).all():
            poses.append(pose)
    return poses


def project(
    target: Target,
    camera: CameraModel,
    poses: list[Pose],
    *,
    noise: float = 0.0,
    seed: int = 0,
    bow: float = 0.0,
    pupil: float = 0.0,
) -> NDArray[np.float64]:
    """Corners (V, rows, columns, 2) of a board bowed by `bow` metres along its rows.

    `noise` is the standard deviation of a coordinate in pixels; the entrance pupil travels by
    `pupil` metres times the square of the angle from the axis.
    """
    points = target.points()
    x = np.linspace(-1, 1, target.columns)
    points[..., 2] += bow * (1 - x**2)
    seen = np.array([pose.apply(points) for pose in poses])
    theta = np.arctan2(np.hypot(seen[..., 0], seen[..., 1]), seen[..., 2])
    seen[..., 2] -= pupil * theta**2
    corners = camera.project(seen)
    return corners + np.random.default_rng(seed).normal(0, noise, corners.shape)
