"""Boards of markers, ChArUco and AprilGrid: whatever part of one a picture shows, by name.

Markers are read (:mod:`chromeball.calibrate.markers`), those that agree on one board place it,
and all of its corners are followed from there (:mod:`chromeball.calibrate.grow`). A board of
another make is tried where the expected one is not there: printed white on black, in the layout
of older OpenCV, with tags of another rim.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.aprilgrid import AprilGrid, Code
from chromeball.calibrate.grow import Found, grow
from chromeball.calibrate.markers import Markers, consistent, read_markers
from chromeball.calibrate.printed import Printed, board_of
from chromeball.calibrate.target import Charuco

#: Larger pictures are searched at this width first; corners are always fitted at full size.
SEARCH_WIDTH = 1600
#: A marker alone is believed when its code is as clear as this, several when they agree.
CLEAR = 0.9
#: Fewest corners that show that the board is there.
FEWEST = 4

type Coded = Charuco | AprilGrid


def find_coded(picture: NDArray[np.uint8], target: Coded) -> tuple[Found, Printed]:
    """Corners of `target` in the order of its points, and how it was printed."""
    # In whole numbers, so that no picture is read otherwise for a length's last bit.
    unit = _in_whole_numbers(target)
    places = unit.points()[..., :2].reshape(-1, 2) / unit.square
    for inverted in (False, True):
        shown = np.asarray(255 - picture, np.uint8) if inverted else picture
        for kind, markers in _boards(shown, unit, thorough=not inverted):
            known = kind.outlines()[markers.numbers].reshape(-1, 2)
            sides = np.linalg.norm(np.diff(markers.outlines, axis=1), axis=-1).mean()
            printed = Printed(kind, inverted)
            board = board_of(printed, float(sides) / _side(kind))
            found = grow(picture, board, places, known, markers.outlines.reshape(-1, 2))
            if np.isfinite(found.sigma).sum() >= FEWEST:
                return found, Printed(_in_metres(kind, target), inverted)
    empty = np.full((len(places), 2), np.nan)
    return Found(empty, empty[:, 0], np.nan), Printed(target, False)


def _in_whole_numbers(target: Coded) -> Coded:
    """The board in a unit in which square and marker are whole numbers."""
    if isinstance(target, AprilGrid):
        return replace(target, square=1.0)
    share = Fraction(repr(target.marker)) / Fraction(repr(target.square))
    return replace(target, square=float(share.denominator), marker=float(share.numerator))


def _in_metres(kind: Coded, target: Coded) -> Coded:
    """The layout of `kind` in the lengths of `target`."""
    if isinstance(kind, Charuco) and isinstance(target, Charuco):
        return replace(kind, square=target.square, marker=target.marker)
    return replace(kind, square=target.square)


def is_mirrored(picture: NDArray[np.uint8], target: Coded) -> bool:
    """Whether the board can be read in a mirror."""
    mirrored = np.ascontiguousarray(picture[:, ::-1])
    return bool(np.isfinite(find_coded(mirrored, target)[0].sigma).any())


def read_board(
    picture: NDArray[np.uint8], target: Coded, thorough: bool = True
) -> tuple[Markers, float]:
    """The markers of `target` that agree on one board, and the sum of their scores.

    A large picture is searched small, and if `thorough` then at full size.
    """
    scale = min(1.0, SEARCH_WIDTH / max(picture.shape))
    for factor in [scale, 1.0] if thorough and scale < 1 else [scale]:
        small = picture
        if factor < 1:
            shrunk = cv2.resize(
                picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA
            )
            small = np.asarray(shrunk, np.uint8)
        markers = read_markers(small, _code(target), isinstance(target, AprilGrid))
        agree = consistent(markers, target.outlines())
        scores = markers.scores[agree]
        if len(scores) > 1 or (scores > CLEAR).any():
            outlines = (markers.outlines[agree] + 0.5) / factor - 0.5
            return Markers(markers.numbers[agree], outlines, scores), float(scores.sum())
    return Markers(np.zeros(0, int), np.zeros((0, 4, 2)), np.zeros(0)), 0.0


def _boards(
    picture: NDArray[np.uint8], target: Coded, thorough: bool
) -> list[tuple[Coded, Markers]]:
    """The board as it was named and as it may have been printed, the best read first."""
    markers, score = read_board(picture, target, thorough)
    if score > CLEAR * max(len(markers.numbers), 0.75 * len(_code(target).bits)):
        return [(target, markers)]
    read = [(score, target, markers)]
    for kind in _others(target):
        markers, score = read_board(picture, kind, thorough=False)
        read.append((score, kind, markers))
    read.sort(key=lambda board: -board[0])
    return [(kind, markers) for score, kind, markers in read if score]


def _others(target: Coded) -> list[Coded]:
    if isinstance(target, AprilGrid):
        return [replace(target, border=3 - target.border)]
    # Older OpenCV began a board with an even number of rows with a marker.
    return [replace(target, legacy=not target.legacy)] if target.down % 2 == 0 else []


def _side(target: Coded) -> float:
    """A marker's side in squares."""
    return 1.0 if isinstance(target, AprilGrid) else target.marker / target.square


@cache
def _code(target: Coded) -> Code:
    return target.code()
