"""Open Image Denoise on what is kept and added."""

from __future__ import annotations

import numpy as np
import pytest

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.denoise import denoise
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import SUPPORT, StandInMesh


def test_noise_goes_and_the_plate_stays() -> None:
    pytest.importorskip("pyoidn", reason="the extra `denoise` is not installed")
    v = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    floor = StandInMesh(v, v, faces, np.full(2, SUPPORT, np.uint8))
    sky = np.full((32, 64, 3), 0.3, np.float32)
    sky[5:9, 20:30] = 12
    shell = sphere(64, 128)
    ball = Mesh.of(shell[0], shell[1], 0.6, normals=shell[2]).placed(Pose.identity(), 0.6)
    view = CameraModel.pinhole(
        (96, 72), 1.2, Pose.look_at(np.array([0, 1.4, 1.9]), np.array([0, 0.2, 0.0]))
    )
    plate = np.random.default_rng(0).uniform(0.3, 0.5, (72, 96, 3)).astype(np.float32)

    def job(seed: int, samples: int) -> Compositor:
        made = Compositor(
            [ball],
            CapturedSet(sky, np.array([0.0, 1.0, 0.0]), floor),
            corner_rays(view),
            view.world_from_camera.translation,
            plate,
            bounces=1,
            seed=seed,
        )
        made.add(samples)
        return made

    true, noisy = job(1, 256).result(), job(0, 8).result()
    clean = denoise(noisy, plate)

    def error(rgb: np.ndarray) -> float:
        return float(np.sqrt(np.mean((rgb - true.rgb) ** 2)))

    assert error(clean.rgb) < 0.8 * error(noisy.rgb)
    kept = ~noisy.changed
    assert kept.any()
    assert (clean.rgb[kept] == plate[kept]).all()
