"""Views that repeat others, and the views that differ most."""

from __future__ import annotations

import numpy as np

from chromeball.calibrate.convert import converted
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.views import repeated_views, spread_views
from chromeball.calibrate.virtual import board_poses, project
from chromeball.scene.camera import CameraModel

BOARD = Chessboard(9, 6, 0.025)
SIZE = (640, 480)
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4", np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]), SIZE
)
CORNERS = project(BOARD, CAMERA, board_poses(BOARD, CAMERA, 12, seed=1), noise=0.1)


def test_repeats() -> None:
    still = CORNERS[[0, 1, 0, 2, 1, 1]] + np.random.default_rng(0).normal(0, 0.1, (6, 6, 9, 2))
    assert repeated_views(still, SIZE).tolist() == [-1, -1, 0, -1, 1, 1]
    assert (repeated_views(CORNERS, SIZE) == -1).all()


def test_a_view_that_shows_more_is_no_repeat() -> None:
    part = CORNERS[[0, 0, 0]].copy()
    part[0, :, 5:] = np.nan
    assert repeated_views(part, SIZE).tolist() == [-1, -1, 1]


def test_spread_views_leave_the_crowd_out() -> None:
    """Of 40 like views and 11 others the others are all chosen."""
    crowd = CORNERS[:1] + np.random.default_rng(0).normal(0, 2, (40, 1, 1, 2))
    chosen = spread_views(np.concatenate([crowd, CORNERS[1:]]), 14)
    assert chosen.sum() == 14
    assert chosen[40:].all()
    assert spread_views(CORNERS, 20).all()


def test_converted_lenses_see_the_same() -> None:
    """OpenCV's four terms hold in eight; a fisheye comes near and says how near."""
    pixels = CAMERA.pixel_grid()[::20, ::20].reshape(-1, 2)
    rays = CAMERA.unproject(pixels)
    for model, most in (("LENSMODEL_OPENCV8", 0.01), ("kb4_decentred", 0.1)):
        camera, rms = converted(CAMERA, model, rays)
        miss = np.linalg.norm(camera.project(rays) - pixels, axis=-1)
        assert np.sqrt(np.mean(miss**2)) < most
        assert abs(rms - np.sqrt(np.mean(miss**2))) < 0.2 * most
