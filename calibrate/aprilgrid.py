"""Boards of square markers: their codes, and Kalibr's AprilGrid.

An AprilGrid (Furgale et al., Kalibr) is a grid of AprilTags 36h11 whose corners are joined by
small black squares, so that every corner of a tag looks like a chessboard's. Its points are the
tags' corners.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Cells of :meth:`AprilGrid.cells` along a tag: a whole number for each bit of 8 or of 10.
CELLS = 80


@dataclass(frozen=True)
class Code:
    """Markers of one kind: ``bits`` (K, b, b), True is white; ``border`` black cells around."""

    bits: NDArray[np.bool_]
    border: int

    @property
    def cells(self) -> int:
        """Cells along a marker's side."""
        return int(self.bits.shape[1]) + 2 * self.border


@dataclass(frozen=True)
class AprilGrid:
    """Kalibr's board: ``across`` x ``down`` tags of side ``square`` metres.

    ``spacing`` is the gap between tags in sides of a tag, ``border`` the width of a tag's black
    rim in bits: 2 on Kalibr's own boards, 1 on others. Tag 0 is at the lower left, numbers run
    to the right and then up; the board's first corner is at the upper left.
    """

    across: int
    down: int
    square: float
    spacing: float
    border: int = 2

    @property
    def columns(self) -> int:
        """Corners in a row, two for each tag."""
        return 2 * self.across

    @property
    def rows(self) -> int:
        """Corners in a column."""
        return 2 * self.down

    @property
    def count(self) -> int:
        """How many corners there are."""
        return self.rows * self.columns

    @property
    def spec(self) -> str:
        """As a person types it."""
        tail = "" if self.border == 2 else f":{self.border}"
        return f"aprilgrid:{self.across}x{self.down}:{self.square!r}:{self.spacing!r}{tail}"

    def points(self) -> NDArray[np.float64]:
        """Corners on the board, (rows, columns, 3), metres; their distances alternate."""
        x, y = np.meshgrid(self._line(self.across), self._line(self.down))
        return np.asarray(np.stack([x, y, np.zeros_like(x)], axis=-1) * self.square, float)

    def _line(self, tags: int) -> NDArray[np.float64]:
        line = np.arange(tags)[:, None] * (1 + self.spacing) + [0.0, 1]
        return np.asarray(line, float).ravel()

    def outlines(self) -> NDArray[np.float64]:
        """The tags' corners in sides of a tag, (K, 4, 2), clockwise from the upper left."""
        number = np.arange(self.across * self.down)
        row = self.down - 1 - number // self.across
        first = np.stack([number % self.across, row], axis=-1) * (1 + self.spacing)
        return np.asarray(first[:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), float)

    def code(self) -> Code:
        """The tags as the board shows them."""
        import cv2

        aruco: Any = cv2.aruco
        family = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
        # OpenCV keeps the tags upside down.
        bits = [
            family.generateImageMarker(i, 8)[6:0:-1, 6:0:-1] > 0
            for i in range(self.across * self.down)
        ]
        return Code(np.array(bits), self.border)

    @property
    def cells_per_square(self) -> int:
        """How many cells of :meth:`cells` a tag is wide."""
        return CELLS

    def cells(self) -> NDArray[np.uint8]:
        """The board with a tag's width of paper around it, 0 black, 255 white.

        An edge within a cell makes it grey, so that it is where it should be.
        """
        lines = [self._line(tags) for tags in (self.down, self.across)]
        high, wide = (round((line[-1] + 2) * CELLS) for line in lines)
        paper = np.ones((high, wide))
        code = self.code()
        bit = CELLS / code.cells
        for bits, outline in zip(code.bits, self.outlines(), strict=True):
            top_left = (outline[0] + 1) * CELLS
            tag = np.zeros((code.cells, code.cells))
            tag[self.border : -self.border, self.border : -self.border] = bits
            y, x = (
                [_covered(n, top_left[axis] + i * bit, bit) for i in range(code.cells)]
                for n, axis in ((high, 1), (wide, 0))
            )
            window = np.s_[
                int(top_left[1]) : math.ceil(top_left[1]) + CELLS + 1,
                int(top_left[0]) : math.ceil(top_left[0]) + CELLS + 1,
            ]
            across, down = np.array(x)[:, window[1]], np.array(y)[:, window[0]]
            paper[window] -= down.T @ (1 - tag) @ across
        gap = self.spacing * CELLS
        joints = [np.append(line[::2] - self.spacing, line[-1]) for line in lines]
        vertical, horizontal = (
            np.sum([_covered(n, (at + 1) * CELLS, gap) for at in joint], axis=0)
            for n, joint in zip((high, wide), joints, strict=True)
        )
        paper -= np.outer(vertical, horizontal)
        return np.round(255 * np.clip(paper, 0, 1)).astype(np.uint8)


def _covered(count: int, start: float, width: float) -> NDArray[np.float64]:
    """How much of each of `count` unit cells lies in [start, start + width]."""
    cell = np.arange(count)
    return np.clip(np.minimum(cell + 1, start + width) - np.maximum(cell, start), 0, 1)
