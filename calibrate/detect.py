"""Corners of a target in photographs, each with its identity, to a small part of a pixel.

A chessboard is found whole: the classic detector, the sector-based one where that fails. Of a
ChArUco board or an AprilGrid any part is enough (:mod:`chromeball.calibrate.coded`). Corners
are measured by fitting the rendered board (:mod:`chromeball.calibrate.patch`), a chessboard's
after Foerstner's gradient method in a window scaled to the local pitch; circles by their
centroids (:mod:`chromeball.calibrate.circles`).
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

from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.circles import detect_circles
from chromeball.calibrate.coded import REACH, find_coded, is_mirrored
from chromeball.calibrate.grow import Found, grow, likeness
from chromeball.calibrate.patch import Board
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

    ``corners`` is (rows, columns, 2) in pixels, NaN where not found; ``sigma`` (rows, columns)
    the standard error of a coordinate from the picture's noise, NaN where it is not known;
    ``size`` is width and height; ``blur`` the standard deviation of the edges' spread in
    pixels, NaN without a board; ``usable`` says that the view may enter a calibration,
    ``verdict`` why or why not.
    """

    file: Path
    size: tuple[int, int]
    corners: NDArray[np.float64]
    sigma: NDArray[np.float64]
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
    seen = look(picture, target)

    def verdict(usable: bool, text: str) -> Detection:
        return Detection(file, size, seen.corners, seen.sigma, seen.blur, usable, text)

    found = np.argwhere(np.isfinite(seen.corners[..., 0]))
    if not len(found):
        if isinstance(target, Charuco | AprilGrid) and is_mirrored(picture, target):
            return verdict(False, "the board is seen in a mirror: flip the picture")
        return verdict(False, "no board")
    text = f"{len(found)} of {target.count} corners, blur {seen.blur:.1f} px"
    spread = np.linalg.matrix_rank(found - found.mean(axis=0)) if len(found) > 1 else 0
    if len(found) < FEWEST or spread < 2:
        reason = "too few" if len(found) < FEWEST else "all in a line"
        return verdict(False, f"{text}: {reason}")
    return verdict(True, text)


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


@dataclass(frozen=True)
class Seen:
    """``corners`` (rows, columns, 2), ``sigma`` (rows, columns) and ``blur`` as of a
    :class:`Detection`.
    """  # noqa: D205

    corners: NDArray[np.float64]
    sigma: NDArray[np.float64]
    blur: float


def detect(picture: NDArray[np.uint8], target: Target) -> NDArray[np.float64]:
    """Corners of `target` in a grey picture, (rows, columns, 2), NaN where not found."""
    return look(picture, target).corners


def look(picture: NDArray[np.uint8], target: Target) -> Seen:
    """As :func:`detect`, with standard errors and the spread of edges."""
    shape = (target.rows, target.columns)
    nothing = np.full(shape, np.nan)
    if min(picture.shape) < 24:  # the detectors' filters need some room
        return Seen(np.full((*shape, 2), np.nan), nothing, np.nan)
    if isinstance(target, CircleGrid):
        corners, blur = detect_circles(picture, target)
        return Seen(corners, nothing, blur)
    if isinstance(target, Chessboard):
        found = _fit_chessboard(picture, target, _detect_chessboard(picture, target))
    else:
        found = find_coded(picture, target)
    return Seen(found.pixels.reshape(*shape, 2), found.sigma.reshape(shape), found.blur)


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


def _fit_chessboard(
    picture: NDArray[np.uint8], target: Chessboard, grid: NDArray[np.float64]
) -> Found:
    """The rendered board fitted to corners (rows, columns, 2) that are nearly right."""
    places = target.points()[..., :2].reshape(-1, 2) / target.square
    seen = np.isfinite(grid[..., 0]).ravel()
    known, pixels = places[seen], grid.reshape(-1, 2)[seen]
    pitch = float(np.median(_pitch(grid))) if seen.any() else 1.0
    # The first square may be black or white.
    boards = [
        Board.of(cells, 1, REACH, pitch) for cells in (target.cells(), 255 - target.cells())
    ]
    board = max(boards, key=lambda b: likeness(picture, b, places, known, pixels))
    return grow(picture, board, places, known, pixels)


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
