"""Corners of a target in photographs, each with its identity, to a small part of a pixel.

A chessboard is found whole: the classic detector, the sector-based one where that fails. Of a
ChArUco board or an AprilGrid any part is enough (:mod:`chromeball.calibrate.coded`). Corners
are measured by fitting the rendered board (:mod:`chromeball.calibrate.patch`), a chessboard's
after Foerstner's gradient method in a window scaled to the local pitch; circles by their
centroids (:mod:`chromeball.calibrate.circles`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.circles import detect_circles
from chromeball.calibrate.coded import find_coded, is_mirrored
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.grow import Found, likeness, refit
from chromeball.calibrate.printed import Printed, board_of
from chromeball.calibrate.target import Charuco, Chessboard, CircleGrid, Target
from chromeball.scene.image import Image, read_image, to_display

#: Half of the refinement window on a chessboard, in pitches.
WINDOW = 0.30
#: Fewest corners that place a board well enough to be worth a view.
FEWEST = 8
#: Larger pictures are searched at this width first; refinement is always at full size.
SEARCH_WIDTH = 1600
#: So many pictures are looked at for a board of other counts.
TRIED = 4


def counts_hint(files: Sequence[str | os.PathLike[str]], target: Target) -> str:
    """What to check of a board's counts that was not seen."""
    seen = board_counts(files) if isinstance(target, Chessboard) else None
    if isinstance(target, Chessboard) and seen and set(seen) != {target.columns, target.rows}:
        return f"{_there(seen, target)}; else check its counts"
    return "check its counts (a chessboard's are inner corners)"


def larger_board(files: Sequence[str | os.PathLike[str]], target: Target) -> str:
    """Told if the pictures show a larger chessboard than `target`, else nothing.

    Any part of a board calibrates a lens; a rig's cameras must see the same one.
    """
    if not isinstance(target, Chessboard):
        return ""
    seen = board_counts(files)
    counts = (max(target.columns, target.rows), min(target.columns, target.rows))
    larger = seen is not None and seen != counts and min(np.subtract(seen, counts)) >= 0
    return _there(seen, target) if seen and larger else ""


def _there(seen: tuple[int, int], target: Chessboard) -> str:
    return (
        f"a chessboard of {seen[0]}x{seen[1]} inner corners is there: write "
        f"chessboard:{seen[0]}x{seen[1]}:{target.square!r}"
    )


def board_counts(files: Sequence[str | os.PathLike[str]]) -> tuple[int, int] | None:
    """Inner corners of the chessboard in most of some of the pictures, the larger first."""
    some = list(files)[:: max(1, len(files) // TRIED)][:TRIED]
    shown = [counts for f in some if (counts := other_counts(grey(read_image(f)))) is not None]
    most = max(shown, key=shown.count, default=None)
    return most if most is not None and shown.count(most) > len(some) / 2 else None


def other_counts(picture: NDArray[np.uint8]) -> tuple[int, int] | None:
    """Columns and rows of inner corners, the larger first, of whatever chessboard is there."""
    if min(picture.shape) < 24:
        return None
    small = _shrink(picture, _search_scales(picture)[0])
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    found, _, kinds = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    return (max(kinds.shape), min(kinds.shape)) if found else None


def judge(file: Path, picture: NDArray[np.uint8], target: Target) -> Detection:
    """Detect in one grey picture and say what came of it."""
    size = (picture.shape[1], picture.shape[0])
    seen = look(picture, target)

    def verdict(usable: bool, text: str) -> Detection:
        return Detection(
            file, size, seen.corners, seen.sigma, seen.blur, usable, text, seen.printed
        )

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
    """``corners`` (rows, columns, 2), ``sigma`` (rows, columns), ``blur`` and ``printed`` as of
    a :class:`Detection`.
    """  # noqa: D205

    corners: NDArray[np.float64]
    sigma: NDArray[np.float64]
    blur: float
    printed: Printed


def detect(picture: NDArray[np.uint8], target: Target) -> NDArray[np.float64]:
    """Corners of `target` in a grey picture, (rows, columns, 2), NaN where not found."""
    return look(picture, target).corners


def look(picture: NDArray[np.uint8], target: Target) -> Seen:
    """As :func:`detect`, with standard errors and the spread of edges."""
    shape = (target.rows, target.columns)
    nothing, plain = np.full(shape, np.nan), Printed(target, False)
    if min(picture.shape) < 24:  # the detectors' filters need some room
        return Seen(np.full((*shape, 2), np.nan), nothing, np.nan, plain)
    if isinstance(target, CircleGrid):
        corners, blur = detect_circles(picture, target)
        return Seen(corners, nothing, blur, plain)
    if isinstance(target, Chessboard):
        found, printed = _fit_chessboard(picture, target, _detect_chessboard(picture, target))
    else:
        found, printed = find_coded(picture, target)
    return Seen(
        found.pixels.reshape(*shape, 2), found.sigma.reshape(shape), found.blur, printed
    )


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
) -> tuple[Found, Printed]:
    """The rendered board fitted to corners (rows, columns, 2) that are nearly right."""
    places = target.points()[..., :2].reshape(-1, 2) / target.square
    found = grid.reshape(-1, 2)
    pitch = float(np.median(_pitch(grid)))
    # The first square may be black or white.
    printed = max(
        (Printed(target, False), Printed(target, True)),
        key=lambda p: likeness(picture, board_of(p, pitch), places, found),
    )
    return refit(picture, board_of(printed, pitch), places, found), printed


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
