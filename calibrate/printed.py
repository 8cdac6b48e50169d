"""A target as it was found to be printed, drawn for patches to be compared with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.patch import Board
from chromeball.calibrate.target import Target

#: Half of the window of patches in squares: all of it on the four squares about the corner, or
#: up to the width of the joints between tags.
REACH = 0.45


@dataclass(frozen=True)
class Printed:
    """The board as the picture shows it: ``target`` in the layout that was read, and whether
    black and white are exchanged, as for a chessboard whose first square is white.
    """  # noqa: D205

    target: Target
    inverted: bool


def board_of(printed: Printed, pitch: float) -> Board:
    """The drawing for a picture in which a square is about `pitch` pixels wide."""
    target = printed.target
    reach = min(REACH, target.spacing) if isinstance(target, AprilGrid) else REACH
    cells = _cells(target)
    if printed.inverted:
        cells = np.asarray(255 - cells, np.uint8)
    return Board.of(cells, target.cells_per_square, reach, pitch)


@cache
def _cells(target: Target) -> NDArray[np.uint8]:
    return target.cells()
