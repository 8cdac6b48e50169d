"""Corners of a target in photographs, each with its identity, to a small part of a pixel.

A chessboard is found whole: the classic detector, the sector-based one where that fails. Of a
ChArUco board any part is enough; corners whose markers were not read are predicted from their
neighbours and kept if the picture shows the board there. A chessboard's corners are refined by
Foerstner's gradient method in a window scaled to the local pitch, a ChArUco board's by fitting
the rendered board (:mod:`chromeball.calibrate.patch`), circles by their centroids
(:mod:`chromeball.calibrate.circles`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.circles import detect_circles
from chromeball.calibrate.patch import BLURS, LEAST_CORRELATION, Board, fit_corner
from chromeball.calibrate.target import Charuco, Chessboard, CircleGrid, Target
from chromeball.scene.errors import UserError
from chromeball.scene.image import Image, read_image, to_display

#: Half of the refinement window on a chessboard, in pitches.
WINDOW = 0.30
#: Fewest corners that place a board well enough to be worth a view.
FEWEST = 8
#: Larger pictures are searched at this width first; refinement is always at full size.
SEARCH_WIDTH = 1600


@dataclass(frozen=True)
class Detection:
    """What one picture shows of the target.

    ``corners`` is (rows, columns, 2) in pixels, NaN where not found; ``size`` is width and
    height; ``blur`` the standard deviation of the edges' spread in pixels, NaN without a board;
    ``usable`` says that the view may enter a calibration, ``verdict`` why or why not.
    """

    file: Path
    size: tuple[int, int]
    corners: NDArray[np.float64]
    blur: float
    usable: bool
    verdict: str

    @property
    def count(self) -> int:
        """How many corners were found."""
        return int(np.isfinite(self.corners[..., 0]).sum())


def detect_files(
    files: Sequence[str | os.PathLike[str]],
    target: Target,
    progress: Callable[[Detection], object] | None = None,
) -> list[Detection]:
    """Look for `target` in every picture; `progress` hears of each.

    Raises
    ------
    UserError
        When a picture cannot be read, the sizes differ, or no picture shows the board.

    """
    detections: list[Detection] = []
    for file in files:
        image = read_image(file)
        if detections and image.size != detections[0].size:
            raise UserError(
                "this picture is {}x{}, {} is {}x{}: pictures of one lens have one size".format(
                    *image.size, detections[0].file, *detections[0].size
                ),
                file=file,
            )
        detection = judge(Path(file), grey(image), target)
        detections.append(detection)
        if progress is not None:
            progress(detection)
    if not any(detection.usable for detection in detections):
        names = (
            detections[0].file if len(detections) == 1 else f"any of {len(detections)} pictures"
        )
        raise UserError(
            f"the board {target.spec} was not seen in {names}: "
            "check its counts (a chessboard's are inner corners), focus and light"
        )
    return detections


def judge(file: Path, picture: NDArray[np.uint8], target: Target) -> Detection:
    """Detect in one grey picture and say what came of it."""
    size = (picture.shape[1], picture.shape[0])
    corners, blur = detect_with_blur(picture, target)
    found = np.argwhere(np.isfinite(corners[..., 0]))
    if not len(found):
        return Detection(file, size, corners, float("nan"), False, "no board")
    verdict = f"{len(found)} of {target.count} corners, blur {blur:.1f} px"
    spread = np.linalg.matrix_rank(found - found.mean(axis=0)) if len(found) > 1 else 0
    if len(found) < FEWEST or spread < 2:
        reason = "too few" if len(found) < FEWEST else "all in a line"
        return Detection(file, size, corners, blur, False, f"{verdict}: {reason}")
    return Detection(file, size, corners, blur, True, verdict)


def grey(image: Image) -> NDArray[np.uint8]:
    """8-bit luma, (H, W); linear pictures are encoded, their 99th percentile near white."""
    pixels: NDArray[Any] = image.pixels[..., : 3 if image.pixels.shape[2] >= 3 else 1]
    if image.linear:
        linear = np.nan_to_num(pixels.astype(np.float32), posinf=0, neginf=0)
        codes = to_display(linear, 0.9 / max(float(np.percentile(linear, 99)), 1e-12))
    elif pixels.dtype == np.uint16:
        codes = np.round(pixels / 257.0).astype(np.uint8)
    else:
        codes = pixels
    if codes.shape[2] == 1:
        return np.ascontiguousarray(codes[..., 0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(codes), cv2.COLOR_RGB2GRAY), np.uint8)


def detect(picture: NDArray[np.uint8], target: Target) -> NDArray[np.float64]:
    """Corners of `target` in a grey picture, (rows, columns, 2), NaN where not found."""
    return detect_with_blur(picture, target)[0]


def detect_with_blur(
    picture: NDArray[np.uint8], target: Target
) -> tuple[NDArray[np.float64], float]:
    """As :func:`detect`, and the spread of edges, one standard deviation in pixels."""
    if min(picture.shape) < 24:  # the detectors' filters need some room
        return np.full((target.rows, target.columns, 2), np.nan), np.nan
    if isinstance(target, Charuco):
        return _detect_charuco(picture, target)
    if isinstance(target, CircleGrid):
        return detect_circles(picture, target)
    corners = _detect_chessboard(picture, target)
    return corners, _edge_blur(picture, corners)


# ---- chessboard


def _detect_chessboard(picture: NDArray[np.uint8], target: Chessboard) -> NDArray[np.float64]:
    count = (target.columns, target.rows)
    missing = np.full((target.rows, target.columns, 2), np.nan)
    for factor in _search_scales(picture):
        small = _shrink(picture, factor)
        found, corners = cv2.findChessboardCorners(
            small, count, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not found:
            found, corners = cv2.findChessboardCornersSB(
                small, count, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
            )
        if found:
            grid = corners.reshape(target.rows, target.columns, 2).astype(float)
            return _refine(picture, (grid + 0.5) / factor - 0.5, WINDOW)
    return missing


def _search_scales(picture: NDArray[np.uint8]) -> list[float]:
    width = max(picture.shape)
    return [1.0] if width <= SEARCH_WIDTH else [SEARCH_WIDTH / width, 1.0]


def _shrink(picture: NDArray[np.uint8], factor: float) -> NDArray[Any]:
    if factor == 1:
        return picture
    return cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def _edge_blur(picture: NDArray[np.uint8], corners: NDArray[np.float64]) -> float:
    """Spread of the squares' edges, one standard deviation in pixels, median over the board.

    A step blurred by a Gaussian has contrast / largest slope = sqrt(2 pi) sigma.
    """
    sigmas: list[float] = []
    for a, b in ((corners[:, :-1], corners[:, 1:]), (corners[:-1], corners[1:])):
        middle, along = (a + b) / 2, b - a
        length = np.linalg.norm(along, axis=-1)
        for m, d, n in zip(
            middle.reshape(-1, 2), along.reshape(-1, 2), length.ravel(), strict=True
        ):
            if not np.isfinite(n) or n < 8:
                continue
            half = min(0.35 * n, 20.0)
            s = np.arange(-half, half + 0.125, 0.25)
            normal = np.array([-d[1], d[0]]) / n
            profile = _sample(picture, m + s[:, None] * normal)
            slope = np.abs(np.diff(profile)).max() / 0.25
            contrast = np.ptp(profile)
            if contrast > 16:
                sigmas.append(float(contrast / (np.sqrt(2 * np.pi) * slope)))
    return float(np.median(sigmas)) if sigmas else float("nan")


# ---- ChArUco


def _detect_charuco(
    picture: NDArray[np.uint8], target: Charuco
) -> tuple[NDArray[np.float64], float]:
    """Corners, and the blur that renders the board most like the picture."""
    grid = np.full((target.rows, target.columns, 2), np.nan)
    corners, ids = _read_markers(picture, target)
    if ids is None or len(ids) < grid.size // 4:
        # Blurred markers are read again with their edges raised; that is for reading alone.
        soft = cv2.GaussianBlur(picture, (0, 0), 2.5)
        again = _read_markers(
            np.asarray(cv2.addWeighted(picture, 3, soft, -2, 0), np.uint8), target
        )
        if again[1] is not None and (ids is None or len(again[1]) > len(ids)):
            corners, ids = again
    if ids is None or len(ids) < 6:
        return grid, np.nan
    grid.reshape(-1, 2)[ids.ravel()] = corners.reshape(-1, 2)
    board = Board(target.cells(), target.cells_per_square)
    sigma = _fit_blur(picture, board, grid, BLURS)
    while True:
        found = np.isfinite(grid[..., 0]).sum()
        grid = _fit_patches(picture, board, grid, sigma)
        if np.isfinite(grid[..., 0]).sum() <= found:
            break
    # Once more, from neighbours that are all well placed now.
    k = BLURS.index(sigma)
    sigma = _fit_blur(picture, board, grid, BLURS[max(0, k - 1) : k + 2])
    return _fit_patches(picture, board, grid, sigma), sigma


def _fit_blur(
    picture: NDArray[np.uint8],
    board: Board,
    grid: NDArray[np.float64],
    blurs: tuple[float, ...],
) -> float:
    """The one of `blurs` whose patches correlate best, over a few corners of `grid`."""
    found = np.argwhere(np.isfinite(grid[..., 0])).tolist()
    places: list[tuple[int, int, NDArray[np.float64]]] = []
    for row, column in found[:: max(1, len(found) // 6)]:
        if (h := _neighbourhood(grid, row, column)) is not None:
            places.append((row, column, h))
    scores = [
        sum(fit_corner(picture, board, (r, c), h, sigma)[1] for r, c, h in places)
        for sigma in blurs
    ]
    return blurs[int(np.argmax(scores))]


def _fit_patches(
    picture: NDArray[np.uint8], board: Board, grid: NDArray[np.float64], sigma: float
) -> NDArray[np.float64]:
    """Every corner with found neighbours fitted where they predict it; NaN where not seen."""
    fitted = np.full_like(grid, np.nan)
    for row, column in np.ndindex(grid.shape[:2]):
        h = _neighbourhood(grid, row, column)
        if h is None:
            continue
        place, correlation = fit_corner(picture, board, (row, column), h, sigma)
        if correlation > LEAST_CORRELATION:
            fitted[row, column] = place
    return fitted


def _read_markers(picture: NDArray[np.uint8], target: Charuco) -> tuple[Any, Any]:
    """OpenCV's ChArUco detector, tuned to keep blurred, small and partly hidden markers."""
    aruco: Any = cv2.aruco
    search = aruco.DetectorParameters()
    search.adaptiveThreshWinSizeMin = 5
    search.adaptiveThreshWinSizeMax = max(25, min(picture.shape) // 12 | 1)
    search.adaptiveThreshWinSizeStep = max(8, (search.adaptiveThreshWinSizeMax - 5) // 5)
    search.minMarkerPerimeterRate = 0.01
    search.polygonalApproxAccuracyRate = 0.05
    search.minOtsuStdDev = 3.0
    search.perspectiveRemovePixelPerCell = 8
    search.perspectiveRemoveIgnoredMarginPerCell = 0.25
    corner = aruco.CharucoParameters()
    corner.minMarkers = 1
    corner.tryRefineMarkers = True
    detector = aruco.CharucoDetector(target.board(), corner, search)
    corners, ids, _, _ = detector.detectBoard(picture)
    return corners, ids


def _neighbourhood(
    grid: NDArray[np.float64], row: int, column: int
) -> NDArray[np.float64] | None:
    """Homography from (column, row, 1) to pixels by the nearest found corners but this one."""
    found = np.argwhere(np.isfinite(grid[..., 0]))
    distance = np.abs(found - [row, column]).max(axis=1)
    found = found[(distance > 0) & (distance <= 3)]
    distance = np.hypot(*(found - [row, column]).T)
    near = found[np.argsort(distance, kind="stable")[:12]]
    if len(near) < 5 or np.linalg.matrix_rank(near - near.mean(axis=0)) < 2:
        return None
    found_pixels = grid[near[:, 0], near[:, 1]]
    h: Any = cv2.findHomography(near[:, ::-1].astype(float), found_pixels)[0]
    return None if h is None or abs(np.linalg.det(h)) < 1e-12 else np.asarray(h, float)


# ---- common


def _refine(
    picture: NDArray[np.uint8], grid: NDArray[np.float64], window: float
) -> NDArray[np.float64]:
    """Foerstner's corner, `window` local pitches (2 to 15 pixels) to each side."""
    refined = grid.copy()
    height, width = picture.shape
    # The window stays inside the picture: repeated border pixels would pull the corner.
    room = np.minimum(grid, [width - 1, height - 1] - grid).min(axis=-1) - 1
    found = np.isfinite(grid[..., 0]) & (room >= 2)
    refined[~found] = np.nan
    half = np.clip(np.round(window * _pitch(grid)), 2, 15)
    half = np.where(found, np.minimum(half, np.floor(room)), 0).astype(int)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
    for w in np.unique(half[found]):
        chosen = found & (half == w)
        points = np.ascontiguousarray(grid[chosen], np.float32).reshape(-1, 1, 2)
        result = cv2.cornerSubPix(picture, points, (int(w), int(w)), (-1, -1), stop)
        refined[chosen] = np.asarray(result, float).reshape(-1, 2)
    return refined


def _pitch(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance to the nearest found neighbour in the row or column, the median where none."""
    nearest = np.full(grid.shape[:2], np.inf)
    across = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    down = np.linalg.norm(np.diff(grid, axis=0), axis=-1)
    for gap, sides in (
        (across, (nearest[:, :-1], nearest[:, 1:])),
        (down, (nearest[:-1], nearest[1:])),
    ):
        for side in sides:
            np.fmin(side, gap, out=side)
    known = np.isfinite(nearest)
    typical = float(np.median(nearest[known])) if known.any() else 20.0
    return np.where(known, nearest, typical)


def _sample(picture: NDArray[np.uint8], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bilinear values at (N, 2) pixels."""
    x, y = (np.ascontiguousarray(points[:, i : i + 1], np.float32) for i in range(2))
    values = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, float).ravel()
