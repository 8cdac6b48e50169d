"""Photograph the set: radiance for the emulated probe, pictures of the view camera, the truth.

    python -m chromeball.examples.atrium.photograph FOLDER [--samples 128] [--probe-size 640]

``set/``           what reaches the probe's sensor, scene-linear, one EXR a shot
``photographs/``   plate bracket and calibration pictures, 8 bits through the emulated sensor
``truth/``         what no stage may read: response, cameras, the light around the probe, the
                   photographs in which the objects of scene.toml truly stand in the room
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.acquire.emulate.sensor import Sensor
from chromeball.calibrate.target import Charuco, parse_target
from chromeball.examples.atrium.cameras import (
    PROBE_PLACE,
    PROBE_YAWS,
    probe_camera,
    view_camera,
)
from chromeball.examples.atrium.room import CARPET, quads, room
from chromeball.renderer.gather import LitSet, light_set
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.scene import object_meshes
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.image import Exposure, write_exr, write_picture
from chromeball.scene.manifest import parse_time, read_scene
from chromeball.scene.pose import Pose
from chromeball.scene.record import write_json

SENSOR = Sensor()
BOARD_VIEWS = 15


def radiance(lit: LitSet, camera: CameraModel, samples: int) -> NDArray[np.float32]:
    """Full light transport to every pixel of `camera`, (H, W, 3)."""
    origin = camera.world_from_camera.translation
    return lit.radiance(corner_rays(camera), origin, spp=samples, seed=7)


def board(target: Charuco, pose: Pose) -> Mesh:
    """The calibration board as quadrilaterals, one a run of equal cells, with a white rim.

    `pose` is world_from_board, metres, the board's z pointing away from its viewer.
    """
    cells = np.pad(target.cells() > 127, target.cells_per_square // 2, constant_values=True)
    side = target.square / target.cells_per_square
    corners: list[NDArray[np.float64]] = []
    white: list[bool] = []
    for y, row in enumerate(cells):
        edges = np.flatnonzero(np.diff(row, prepend=~row[0], append=~row[-1]))
        for x0, x1 in pairwise(edges):
            corners.append(
                np.array([[x0, y + 1, 0], [x1, y + 1, 0], [x1, y, 0], [x0, y, 0]]) * side
            )
            white.append(bool(row[x0]))
    middle = np.array([cells.shape[1] * side / 2, cells.shape[0] * side / 2, 0])
    albedo = np.where(np.array(white)[:, None], 0.82, 0.04) * np.ones(3)
    return quads(pose.apply(np.array(corners) - middle), albedo)


def board_poses(camera: CameraModel, count: int) -> list[Pose]:
    """Poses of the board before the camera, in the world: all over the picture, well tilted."""
    rng = np.random.default_rng(11)
    width, height = camera.size
    poses: list[Pose] = []
    for i in range(count):
        u = width * (0.5 + 0.30 * math.cos(2.4 * i) * min(1.0, i / 4))
        v = height * (0.5 + 0.30 * math.sin(2.4 * i) * min(1.0, i / 4))
        ray = camera.unproject([u, v])
        tilt = [rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7), rng.uniform(-0.3, 0.3)]
        camera_from_board = Pose.from_rotation_vector(tilt, ray * rng.uniform(0.7, 1.15))
        poses.append(camera.world_from_camera @ camera_from_board)
    return poses


def smooth(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Without the noise of single pixels, to tell what the objects change."""
    import cv2

    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.5), np.float32)


def photograph_bracket(
    picture: NDArray[np.float32], times: list[float], stem: Path, rng: np.random.Generator
) -> None:
    """A bracket of one camera as PNG files ``stem_0.png`` ... with their exposure times."""
    for i, seconds in enumerate(times):
        codes = SENSOR.expose(picture, seconds, rng)
        write_picture(f"{stem}_{i}.png", codes, exposure=Exposure(time=seconds))


def photograph(folder: Path, samples: int, probe_size: int) -> None:
    """Make everything that a visit to the set would bring home."""
    scene = read_scene(folder / "scene.toml")
    plate_times = [parse_time(t) for t in scene.find_bracket("plate").times]
    rng = np.random.default_rng(3)
    view = view_camera()
    start = time.perf_counter()

    def say(what: str) -> None:
        print(f"[{time.perf_counter() - start:5.1f} s] {what}", file=sys.stderr)

    empty = light_set(room())
    full = light_set(Mesh.join([room(), *object_meshes(scene, folder)]))
    say("the light in the room, without and with the objects")

    for name in PROBE_YAWS:
        camera = probe_camera(name, probe_size)
        write_exr(folder / "set" / f"{name}.exr", radiance(empty, camera, samples // 4))
        say(f"set/{name}.exr")

    plate = radiance(empty, view, samples)
    photograph_bracket(plate, plate_times, folder / "photographs/plate", rng)
    say("photographs/plate_*.png")

    target = parse_target(scene.calibrate.target or "" if scene.calibrate else "")
    assert isinstance(target, Charuco)
    for i, pose in enumerate(board_poses(view, BOARD_VIEWS)):
        picture = radiance(empty.with_mesh(board(target, pose)), view, max(4, samples // 32))
        codes = SENSOR.expose(picture, 1 / 25, rng)
        write_picture(folder / f"photographs/board_{i:02d}.png", codes)
    say("photographs/board_*.png")

    with_objects = radiance(full, view, samples)
    photograph_bracket(with_objects, plate_times, folder / "truth/objects", rng)
    difference = np.abs(smooth(with_objects) - smooth(plate)).max(axis=2)
    changed = difference > 0.03 * smooth(plate).max(axis=2)
    write_picture(folder / "truth/changed.png", 255 * changed.astype(np.uint8))
    say("truth/objects_*.png, the photographs with the objects")

    around = CameraModel.latlong((512, 256), Pose(WORLD_FROM_LATLONG.rotation, PROBE_PLACE))
    write_exr(folder / "truth/env.exr", radiance(empty, around, samples // 4))
    view.write(folder / "truth/view.cameramodel")
    front = probe_camera("front", probe_size)
    front.write(folder / "truth/front.cameramodel")
    write_json(
        folder / "truth/truth.json",
        {
            "log_exposure": SENSOR.log_exposure(),
            "middle": SENSOR.middle,
            "carpet": CARPET,
            "times": plate_times,
            "changed_pixels": int(changed.sum()),
        },
    )
    say("truth/")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Photograph the virtual set.")
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--samples",
        type=int,
        default=128,
        help="paths a pixel of the view camera; the probe takes a quarter",
    )
    parser.add_argument("--probe-size", type=int, default=640, help="pixels of the probe")
    arguments = parser.parse_args()
    photograph(arguments.folder, arguments.samples, arguments.probe_size)
