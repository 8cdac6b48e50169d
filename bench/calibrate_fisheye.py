"""Fisheyes beside OpenCV's and mrcal's models, on the same corners, with no focal guess."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.calibrate.choose import pose_errors, view_errors
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.search import detect_files
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.view_poses import pose_residuals
from chromeball.calibrate.virtual import project, surrounding_poses
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/calibrate"
BOARD = Chessboard(9, 6, 0.08)
FOLDS = 4
TRUTH = np.array([290.0, 291, 655, 470, -0.02, 0.01, -0.004, 0.0006])

type Corners = NDArray[np.float64]
#: Corners and size -> a lens, and a lens and left-out corners -> RMS of each view.
type Peer = tuple[Callable[[Corners, tuple[int, int]], Any], Callable[[Any, Corners], Corners]]


def rows(quick: bool) -> list[Row]:
    """Truth error of a virtual lens of 190 degrees, and real pictures left out."""
    if not DATA.is_dir():
        return _virtual(2 if quick else 6)
    real = [*_real("camodocal", "camodocal/*.png", BOARD)]
    ocam = "ocam/test_images"
    real += _real("OCamCalib fish_1", f"{ocam}/fish_1/*.*g", Chessboard(8, 6, 0.0325))
    real += _real("OCamCalib fish_2", f"{ocam}/fish_2/*.*g", Chessboard(8, 6, 0.117))
    return [*_virtual(2 if quick else 6), *real, *([] if quick else _figueroa())]


def _virtual(seeds: int) -> list[Row]:
    """RMS in the field up to 95 degrees, the best turn taken out."""
    camera = CameraModel("kb4", TRUTH, (1280, 960), max_angle=math.radians(95))
    poses = surrounding_poses(BOARD, camera, 20, seed=1)
    pixels = camera.pixel_grid()[::40, ::40].reshape(-1, 2)
    rays = camera.unproject(pixels)
    pixels, rays = pixels[np.isfinite(rays[:, 0])], rays[np.isfinite(rays[:, 0])]
    what = f"virtual fisheye of 190 degrees, noise 0.2 px, {seeds} seeds, RMS from the truth"
    found: list[Row] = []
    for name in ("kb4", "opencv8", "splined"):
        seconds, errors = math.inf, list[float]()
        for seed in range(seeds):
            corners = project(BOARD, camera, poses, noise=0.2, seed=seed)
            start = time.process_time()
            try:
                lens = calibrate_lens(corners, BOARD, camera.size, name)
            except UserError:
                continue
            seconds = min(seconds, time.process_time() - start)
            seen = lens.camera.unproject(pixels)
            reached = np.isfinite(seen).all(axis=1)
            u, _, vt = np.linalg.svd(seen[reached].T @ rays[reached])
            miss = lens.camera.project(rays @ (u @ vt).T) - pixels
            errors.append(float(np.sqrt((miss**2).sum(axis=1).mean())))
        tool = "chromeball kb4" if name == "kb4" else f"mrcal {name}, our start"
        error = float(np.mean(errors)) if errors else math.nan
        found.append(
            Row("calibrate", what, tool, seconds if errors else math.nan, error, "px",
                f"{len(errors)} of {seeds} solved; NaN: does not reach the field")
        )  # fmt: skip
    return found


def _real(name: str, pictures: str, board: Chessboard) -> list[Row]:
    detections = [d for d in detect_files(sorted(DATA.glob(pictures)), board) if d.usable]
    corners = np.array([d.corners for d in detections])
    return _held_out(
        f"{name}, {len(corners)} real pictures", corners, board, detections[0].size
    )


def _figueroa() -> list[Row]:
    """The corners that mrcal's own published solution used."""
    import mrcal

    path = DATA / "mrcal_figueroa/opencv8-0.cameramodel"
    model: Any = mrcal.cameramodel(str(path))
    inputs = model.optimization_inputs()
    seen = np.array(inputs["observations_board"], float)
    corners = np.where(seen[..., 2:] > 0, seen[..., :2], np.nan)
    board = Chessboard(10, 10, float(inputs["calibration_object_spacing"]))
    width, height = (int(n) for n in inputs["imagersizes"][0])
    name = f"mrcal's figueroa, {len(corners)} views of corners"
    return _held_out(name, corners, board, (width, height))


def _held_out(
    name: str, corners: Corners, board: Chessboard, size: tuple[int, int]
) -> list[Row]:
    """Held-out RMS per corner, poses of left-out views alone fitted; all from our corners."""
    cv: Any = cv2
    skew, checked = cv.CALIB_FIX_SKEW, cv.CALIB_FIX_SKEW | cv.CALIB_CHECK_COND
    peers: dict[str, Peer] = {
        "chromeball kb4": _ours("kb4", board),
        "chromeball kb4_decentred": _ours("kb4_decentred", board),
        "mrcal opencv8, our start": _ours("opencv8", board),
        "mrcal splined, our start": _ours("splined", board),
        "cv2.fisheye": _opencv(skew, board),
        "cv2.fisheye, CHECK_COND": _opencv(checked, board),
    }
    what = f"{name}, held-out RMS per corner"
    found: list[Row] = []
    for tool, (solve, judge) in peers.items():
        start, note = time.process_time(), "no focal guess"
        try:
            solve(corners, size)
            seconds, errors = time.process_time() - start, list[float]()
            for fold in range(FOLDS):
                out = np.arange(len(corners)) % FOLDS == fold
                errors.extend(judge(solve(corners[~out], size), corners[out]).tolist())
            posed = np.array(errors)[np.isfinite(errors)]
            error = float(np.sqrt(np.mean(posed**2))) if len(posed) else math.nan
            lost = len(errors) - len(posed)
            note += f"; no pose for {lost} of {len(errors)} views" if lost else ""
        except (cv2.error, UserError):
            seconds, error, note = time.process_time() - start, math.nan, f"{note}: fails"
        found.append(Row("calibrate", what, tool, seconds, error, "px", note))
    return found


def _ours(model: str, board: Chessboard) -> Peer:
    return (
        lambda corners, size: calibrate_lens(corners, board, size, model),
        lambda lens, corners: pose_errors(lens, corners, board),
    )


def _opencv(flags: int, board: Chessboard) -> Peer:
    """Its lens, judged with our poses: the formula is the same, ours goes beyond 90 degrees."""
    fisheye: Any = cv2.fisheye

    def solve(corners: Corners, size: tuple[int, int]) -> CameraModel:
        seen = [np.isfinite(view[..., 0]) for view in corners]
        points = [board.points()[found].reshape(1, -1, 3) for found in seen]
        views = [v[found].reshape(1, -1, 2) for v, found in zip(corners, seen, strict=True)]
        _, matrix, k, _, _ = fisheye.calibrate(
            points, views, size, np.zeros((3, 3)), np.zeros(4), flags=flags
        )
        core = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
        return CameraModel("kb4", np.array([*core, *np.ravel(k)]), size)

    def judge(camera: CameraModel, corners: Corners) -> Corners:
        return view_errors(pose_residuals(camera, corners, board), corners)

    return solve, judge
