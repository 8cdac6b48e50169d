"""Lens calibration beside OpenCV's, on real pictures when they are here and on virtual ones."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench import (
    calibrate_fisheye,
    calibrate_rig,
    calibrate_targets,
    calibrate_tracker,
    calibrate_vignette,
    calibrate_wand,
)
from bench.row import Row
from chromeball.calibrate.choose import pose_errors
from chromeball.calibrate.detect import detect
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.target import Chessboard, CircleGrid
from chromeball.calibrate.virtual import board_poses, photograph, project
from chromeball.scene.camera import CameraModel

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/calibrate/opencv_stereo"
BOARD = Chessboard(9, 6, 0.025)
FOLDS = 4


def rows(quick: bool) -> list[Row]:
    """CPU seconds and errors of ours and of OpenCV's, interleaved."""
    count = 2 if quick else 8
    return [
        *_circles(count),
        *(_left() if DATA.is_dir() else []),
        *calibrate_fisheye.rows(quick),
        *calibrate_rig.rows(quick),
        *calibrate_targets.rows(quick),
        *calibrate_tracker.rows(quick),
        *calibrate_vignette.rows(quick),
        *calibrate_wand.rows(quick),
    ]


def _left() -> list[Row]:
    """OpenCV's left camera: detection and solution, error on views left out."""
    paths = sorted(DATA.glob("left[01]*.jpg"))
    pictures = [np.asarray(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE), np.uint8) for p in paths]
    size = (pictures[0].shape[1], pictures[0].shape[0])
    start = time.process_time()
    ours = np.array([detect(picture, BOARD) for picture in pictures])
    calibrate_lens(ours, BOARD, size, "opencv5")
    our_seconds = time.process_time() - start
    start = time.process_time()
    theirs = np.array([_opencv_corners(picture) for picture in pictures])
    _opencv_lens(theirs, size)
    their_seconds = time.process_time() - start

    what = f"{len(pictures)} real pictures {size[0]}x{size[1]}, held-out RMS per corner"
    return [
        Row("calibrate", what, "chromeball", our_seconds,
            _held_out(ours, size, False), "px", "opencv5, bow, outliers rejected"),
        Row("calibrate", what, "cv2.calibrateCamera", their_seconds,
            _held_out(theirs, size, True), "px", "its corners, 11 x 11 window"),
        Row("calibrate", what, "cv2.calibrateCamera, our corners", their_seconds,
            _held_out(ours, size, True), "px", "seconds with its own corners"),
    ]  # fmt: skip


def _held_out(corners: NDArray[np.float64], size: tuple[int, int], opencv: bool) -> float:
    """RMS per corner over views left out in turn, their poses alone fitted."""
    errors: list[float] = []
    for fold in range(FOLDS):
        out = np.arange(len(corners)) % FOLDS == fold
        if opencv:
            matrix, k = _opencv_lens(corners[~out], size)
            points = BOARD.points().reshape(-1, 3)
            for view in corners[out].reshape(-1, len(points), 2):
                _, r, t = cv2.solvePnP(points, view, matrix, k)
                seen = cv2.projectPoints(points, r, t, matrix, k)[0].reshape(-1, 2)
                errors.append(float(((seen - view) ** 2).sum(axis=1).mean()))
        else:
            lens = calibrate_lens(corners[~out], BOARD, size, "opencv5")
            errors.extend((pose_errors(lens, corners[out], BOARD) ** 2).tolist())
    return float(np.sqrt(np.mean(errors)))


def _opencv_corners(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    _, corners = cv2.findChessboardCorners(picture, (BOARD.columns, BOARD.rows))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    fine = cv2.cornerSubPix(picture, corners, (11, 11), (-1, -1), stop)
    return np.asarray(fine, float).reshape(BOARD.rows, BOARD.columns, 2)


def _opencv_lens(corners: NDArray[np.float64], size: tuple[int, int]) -> tuple[Any, Any]:
    cv: Any = cv2
    points = BOARD.points().reshape(-1, 3).astype(np.float32)
    views = [view.reshape(-1, 1, 2).astype(np.float32) for view in corners]
    _, matrix, k, _, _ = cv.calibrateCamera([points] * len(views), views, size, None, None)
    return matrix, k


def _circles(count: int) -> list[Row]:
    """Centres of an asymmetric grid of circles whose places are known."""
    values = np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008])
    camera = CameraModel("LENSMODEL_OPENCV4", values, (640, 480))
    board = CircleGrid(4, 11, 0.02, asymmetric=True)
    poses = board_poses(board, camera, count, seed=3, size=0.5)
    truth = project(board, camera, poses)
    column, row = board.places().T
    pictures = [photograph(board, camera, p, blur=1.0, seed=i) for i, p in enumerate(poses)]
    cv: Any = cv2
    seconds, found = [0.0, 0.0], np.full((2, *truth.shape), np.nan)
    for i, picture in enumerate(pictures):
        start = time.process_time()
        found[0, i] = detect(picture, board)
        seconds[0] += time.process_time() - start
        start = time.process_time()
        seen, centres = cv.findCirclesGrid(
            picture, (board.across, board.down), flags=cv.CALIB_CB_ASYMMETRIC_GRID
        )
        seconds[1] += time.process_time() - start
        if seen:
            found[1, i, row, column] = centres.reshape(-1, 2)
    square = ((found - truth) ** 2).sum(axis=-1)[:, :, row, column]
    what = f"circles of {count} asymmetric grids 640x480, blur 1 px"
    return [
        Row("calibrate", what, tool, cpu, float(np.sqrt(np.nanmean(errors))), "px",
            f"{np.isfinite(errors).mean():.0%} found")
        for tool, cpu, errors in zip(
            ("chromeball", "cv2.findCirclesGrid"), seconds, square, strict=True
        )
        if np.isfinite(errors).any()
    ]  # fmt: skip
