"""Virtual rigs around boards that they see in part: truth for tests and benchmarks."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

SIZE = (1280, 960)
#: A board is found when so many of its corners lie inside the picture.
FOUND = 12
#: A board is read when it is turned away from the ray to it by less than this.
LARGEST_TILT = math.radians(70)


def ring(count: int, *, wide: Collection[int] = (), seed: int = 0) -> list[CameraModel]:
    """`count` cameras 1.2 m from the middle and looking at it, posed in world axes.

    Those in `wide` are fisheyes of 190 degrees, the others about 70 degrees across with
    OpenCV's distortion.
    """
    rng = np.random.default_rng(seed)
    cameras: list[CameraModel] = []
    for c in range(count):
        angle = 2 * math.pi * c / count
        place = [1.2 * math.sin(angle), rng.uniform(-0.1, 0.1), -1.2 * math.cos(angle)]
        pose = Pose.look_at(place, rng.uniform(-0.1, 0.1, 3))
        f, middle = rng.uniform(850, 1000), [640, 480] + rng.uniform(-10, 10, 2)
        if c in wide:
            k = [290.0, 291.0, *middle, -0.02, 0.01, -0.004, 0.0006]
            cameras.append(CameraModel("kb4", np.array(k), SIZE, pose, math.radians(95)))
            continue
        low, high = [-0.12, 0.02, -5e-4, -5e-4], [-0.05, 0.06, 5e-4, 5e-4]
        k = [f, 1.002 * f, *middle, *rng.uniform(low, high)]
        cameras.append(CameraModel("LENSMODEL_OPENCV4", np.array(k), SIZE, pose))
    return cameras


def scattered_boards(
    target: Target, cameras: Sequence[CameraModel], count: int, *, seed: int = 0
) -> list[Pose]:
    """Poses world_from_board about the middle, each seen by two cameras or more."""
    rng = np.random.default_rng([seed, 1])
    middle = target.points().mean(axis=(0, 1))
    poses: list[Pose] = []
    while len(poses) < count:
        turn = rng.normal(size=3) * [0.35, 1.8, 0.35]
        rotation = Pose.from_rotation_vector(turn, np.zeros(3)).rotation
        place = rng.uniform([-0.35, -0.3, -0.35], [0.35, 0.3, 0.35])
        pose = Pose(rotation, place - rotation @ middle)
        seen = sum(np.isfinite(see(target, camera, pose)).any() for camera in cameras)
        if seen > 1:
            poses.append(pose)
    return poses


def see(target: Target, camera: CameraModel, board: Pose) -> NDArray[np.float64]:
    """Corners (rows, columns, 2) in the picture, NaN beside it; all NaN when too few."""
    points = board.apply(target.points())
    pixels = camera.project(camera.world_from_camera.inverse().apply(points))
    ray = points.mean(axis=(0, 1)) - camera.world_from_camera.translation
    with np.errstate(invalid="ignore"):
        inside = ((pixels > 5) & (pixels < np.array(camera.size) - 6)).all(axis=-1)
    facing = ray @ board.rotation[:, 2] / np.linalg.norm(ray) > math.cos(LARGEST_TILT)
    if not facing or inside.sum() < FOUND:
        return np.full(pixels.shape, np.nan)
    return np.where(inside[..., None], pixels, np.nan)


def observe(
    target: Target,
    cameras: Sequence[CameraModel],
    boards: Sequence[Pose],
    *,
    noise: float = 0.2,
    outliers: float = 0.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Corners (C, F, rows, columns, 2) with `noise` pixels deviation of a coordinate.

    A share of `outliers` is 5 to 40 pixels off.
    """
    rng = np.random.default_rng([seed, 2])
    corners = np.array([[see(target, camera, b) for b in boards] for camera in cameras])
    corners += rng.normal(0, noise, corners.shape)
    wrong = rng.random(corners.shape[:-1]) < outliers
    far, turn = rng.uniform(5, 40, wrong.shape), rng.uniform(0, 2 * math.pi, wrong.shape)
    off = np.stack([far * np.cos(turn), far * np.sin(turn)], axis=-1)
    return np.where(wrong[..., None], corners + off, corners)


def waved_board(target: Target, time: float, seed: int = 0, *, turns: float = 1.0) -> Pose:
    """Where a board carried about by hand is at `time` seconds, world_from_board.

    Its middle moves about the origin at some 0.3 m/s; `turns` scales how it turns.
    """
    rng = np.random.default_rng([seed, 3])
    phase, rate = rng.uniform(0, 2 * math.pi, 6), rng.uniform(0.8, 1.6, 6)
    wave = np.sin(rate * time + phase)
    rotation = Pose.from_rotation_vector(
        wave[:3] * turns * np.array([0.35, 0.5, 0.25]), np.zeros(3)
    ).rotation
    place = wave[3:] * np.array([0.2, 0.15, 0.15])
    return Pose(rotation, place - rotation @ target.points().mean(axis=(0, 1)))
