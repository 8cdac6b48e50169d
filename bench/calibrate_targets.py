"""Corners of boards with markers beside OpenCV's, on pictures whose corners are known."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.detect import detect
from chromeball.calibrate.target import Charuco, Target
from chromeball.calibrate.virtual import board_poses, photograph, project
from chromeball.scene.camera import CameraModel

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/calibrate/ccrs_single"
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)
CHARUCO = Charuco(9, 6, 0.04, 0.03, "4X4_50")
GRID = AprilGrid(6, 6, 0.088, 0.3)

type Detector = Callable[[NDArray[np.uint8]], NDArray[np.float64]]


def rows(quick: bool) -> list[Row]:
    """CPU seconds, errors and shares of the corners found."""
    count = 2 if quick else 8
    found: list[Row] = []
    for blur in (1.0, 2.5):
        found += _virtual(CHARUCO, "ChArUco", blur, count, _opencv_charuco)
    found += _virtual(GRID, "AprilGrid", 1.0, count, _opencv_tags)
    return found + _real()


def _virtual(board: Target, name: str, blur: float, count: int, theirs: Detector) -> list[Row]:
    poses = board_poses(board, CAMERA, count, seed=3, size=0.6)
    truth = project(board, CAMERA, poses)
    pictures = [photograph(board, CAMERA, p, blur=blur, seed=i) for i, p in enumerate(poses)]
    tools: dict[str, Detector] = {
        "chromeball": lambda picture: detect(picture, board),
        f"cv2.aruco, {name}": theirs,
    }
    seconds = dict.fromkeys(tools, 0.0)
    corners: dict[str, list[NDArray[np.float64]]] = {tool: [] for tool in tools}
    for picture in pictures:
        for tool, detector in tools.items():
            start = time.process_time()
            corners[tool].append(detector(picture))
            seconds[tool] += time.process_time() - start
    what = f"corners of {count} {name} pictures 640x480, blur {blur:g} px"
    rows: list[Row] = []
    for tool, grids in corners.items():
        miss = np.linalg.norm(np.array(grids) - truth, axis=-1)
        error = float(np.sqrt(np.nanmean(miss**2))) if np.isfinite(miss).any() else np.nan
        share, good = float(np.isfinite(miss).mean()), float((miss < 0.1).mean())
        note = f"{share:.0%} found, {good:.0%} to 0.1 px"
        rows.append(Row("calibrate", what, tool, seconds[tool], error, "px", note))
    return rows


def _real() -> list[Row]:
    """Kalibr's board in real fisheye pictures: the error is the share not found."""
    rows: list[Row] = []
    for name in ("euroc.png", "tum_vi_with_chart.png"):
        if not (DATA / name).is_file():
            continue
        picture = np.asarray(cv2.imread(str(DATA / name), cv2.IMREAD_GRAYSCALE), np.uint8)
        for tool, detector in (
            ("chromeball", lambda picture: detect(picture, GRID)),
            ("cv2.aruco, AprilGrid", _opencv_tags),
        ):
            start = time.process_time()
            corners = detector(picture)
            seconds = time.process_time() - start
            lost = int(np.isnan(corners[..., 0]).sum())
            rows.append(
                Row("calibrate", f"corners not found of Kalibr's board, {name}", tool, seconds,
                    float(lost), "corners", f"of {GRID.count}")
            )  # fmt: skip
    return rows


def _opencv_charuco(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    aruco: Any = cv2.aruco
    grid = np.full((CHARUCO.rows, CHARUCO.columns, 2), np.nan)
    corners, ids, _, _ = aruco.CharucoDetector(CHARUCO.board()).detectBoard(picture)
    if ids is not None:
        grid.reshape(-1, 2)[ids.ravel()] = corners.reshape(-1, 2)
    return grid


def _opencv_tags(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Tags with rims of two bits, their corners refined."""
    aruco: Any = cv2.aruco
    search = aruco.DetectorParameters()
    search.markerBorderBits = 2
    search.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    family = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    found, ids, _ = aruco.ArucoDetector(family, search).detectMarkers(picture)
    grid = np.full((GRID.rows, GRID.columns, 2), np.nan)
    for outline, number in zip(found, [] if ids is None else ids.ravel(), strict=True):
        if number >= GRID.across * GRID.down:
            continue
        row, column = GRID.down - 1 - number // GRID.across, number % GRID.across
        # OpenCV's first corner is the lower right one.
        lower, upper = 2 * row + 1, 2 * row
        right, left = 2 * column + 1, 2 * column
        grid[[lower, lower, upper, upper], [right, left, left, right]] = outline[0]
    return grid
