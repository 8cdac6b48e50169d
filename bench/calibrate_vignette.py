"""Fall-off from virtual boards and flat fields whose truth is known; no peer measures it."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.vignette import solve
from chromeball.calibrate.vignette_board import board_samples
from chromeball.calibrate.vignette_data import Picture
from chromeball.calibrate.vignette_field import flat_samples
from chromeball.calibrate.virtual import board_poses, photograph, project
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import srgb_decode, srgb_encode
from chromeball.scene.vignette import Vignette

SIZE = (640, 480)
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4", np.array([500.0, 503, 316, 243, -0.2, 0.06, 0.0005, -0.0006]), SIZE
)
TRUTH = Vignette.of([-0.35, 0.05], SIZE, (326.0, 234.0))
BOARD = Chessboard(9, 6, 0.03)


def rows(quick: bool) -> list[Row]:
    """CPU seconds and RMS error of V where it was measured."""
    return [_boards(8 if quick else 24), _field()]


def _boards(count: int) -> Row:
    rng = np.random.default_rng(0)
    poses = board_poses(BOARD, CAMERA, count, seed=1, size=0.75)
    pictures: list[Picture] = []
    for k, pose in enumerate(poses):
        sheet = photograph(BOARD, CAMERA, pose, seed=k, noise=0.0) / 255 * 0.8
        x, y = (CAMERA.pixel_grid() / SIZE - 0.5).transpose(2, 0, 1)
        light = np.exp(rng.normal(0, 0.04) * x + rng.normal(0, 0.04) * y)
        code = 255 * srgb_encode(sheet * light * TRUTH.picture()) + rng.normal(0, 1, x.shape)
        code = np.clip(np.round(code), 0, 255)
        pictures.append(
            Picture(str(k), srgb_decode(code / 255).astype(np.float32), code >= 250)
        )
    corners = list(project(BOARD, CAMERA, poses))
    start = time.process_time()
    samples = board_samples(pictures, corners, BOARD, [0.8] * count).samples
    found = solve(samples, SIZE, source="board", centre=(316.0, 243.0)).vignette
    seconds = time.process_time() - start
    what = f"fall-off by {count} boards 640x480, uneven light"
    return _row(what, seconds, found, samples.pixels)


def _field() -> Row:
    rng = np.random.default_rng(0)
    turns = [0.0, math.pi / 2, math.pi]
    x, y = (CAMERA.pixel_grid() / SIZE - 0.5).transpose(2, 0, 1)
    pictures: list[Picture] = []
    for turn in turns:
        u = math.cos(turn) * x - math.sin(turn) * y * SIZE[1] / SIZE[0]
        value = 0.6 * TRUTH.picture() * np.exp(0.15 * u) * (1 + rng.normal(0, 0.01, x.shape))
        pictures.append(Picture(str(turn), value.astype(np.float32), np.zeros(x.shape, bool)))
    start = time.process_time()
    samples = flat_samples(pictures, turns).samples
    found = solve(samples, SIZE, source="flat").vignette
    seconds = time.process_time() - start
    return _row(
        "fall-off by 3 turned flat fields with a gradient", seconds, found, samples.pixels
    )


def _row(what: str, seconds: float, found: Vignette, q: NDArray[Any]) -> Row:
    c = np.array(found.centre)
    off = found.at(q) / TRUTH.at(q) / found.at(c) * TRUTH.at(c) - 1
    told = float(np.sqrt((found.sigma_at(q) ** 2).mean()))
    note = f"standard error {100 * told:.2g} %; no peer"
    error = 100 * float(np.sqrt((off**2).mean()))
    return Row("calibrate", what, "chromeball", seconds, error, "% RMS", note)
