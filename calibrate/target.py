"""Calibration targets: what they are called, where their corners lie, what they look like.

A target's corners form a grid of shape (rows, columns) in metres: x along a row, y down the
columns as the board is looked at, z = 0, the first inner corner of the upper left at the
origin. That is the board mrcal knows. An asymmetric grid of circles has a circle at every
second place of such a grid.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from math import gcd
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.aprilgrid import AprilGrid, Code
from chromeball.scene.errors import UserError

FORMS = (
    "chessboard:9x6:0.025, charuco:9x6:0.04:0.03:4X4_50, aprilgrid:6x6:0.088:0.3, "
    "circles:7x5:0.04 or acircles:4x11:0.02"
)


@dataclass(frozen=True)
class Chessboard:
    """A chessboard of ``columns`` x ``rows`` inner corners; ``square`` in metres."""

    columns: int
    rows: int
    square: float

    @property
    def spec(self) -> str:
        """As a person types it."""
        return f"chessboard:{self.columns}x{self.rows}:{self.square!r}"

    def points(self) -> NDArray[np.float64]:
        """Corners on the board, (rows, columns, 3), metres."""
        return _grid(self.rows, self.columns, self.square)

    @property
    def count(self) -> int:
        """How many corners there are."""
        return self.rows * self.columns

    def cells(self) -> NDArray[np.uint8]:
        """The board itself, one cell a square, (rows + 1, columns + 1), 0 black, 255 white."""
        y, x = np.indices((self.rows + 1, self.columns + 1))
        return np.where((x + y) % 2, 255, 0).astype(np.uint8)

    @property
    def cells_per_square(self) -> int:
        """How many cells of :meth:`cells` a square is wide."""
        return 1


@dataclass(frozen=True)
class Charuco:
    """A ChArUco board, Garrido-Jurado's markers in the white squares of a chessboard.

    ``across`` x ``down`` squares, of which (across - 1) x (down - 1) inner corners follow;
    ``square`` and ``marker`` side in metres; ``dictionary`` as ``4X4_50``. ``legacy`` is the
    layout of OpenCV before 4.6: with an even number of rows the upper left square is white.
    """

    across: int
    down: int
    square: float
    marker: float
    dictionary: str
    legacy: bool = False

    @property
    def columns(self) -> int:
        """Inner corners in a row."""
        return self.across - 1

    @property
    def rows(self) -> int:
        """Inner corners in a column."""
        return self.down - 1

    @property
    def spec(self) -> str:
        """As a person types it."""
        return (
            f"charuco:{self.across}x{self.down}:{self.square!r}:{self.marker!r}"
            f":{self.dictionary}"
        )

    def points(self) -> NDArray[np.float64]:
        """Corners on the board, (rows, columns, 3), metres."""
        return _grid(self.rows, self.columns, self.square)

    @property
    def count(self) -> int:
        """How many corners there are."""
        return self.rows * self.columns

    def board(self) -> Any:
        """The same board for OpenCV's detector."""
        import cv2

        known: Any = cv2.aruco
        dictionary = known.getPredefinedDictionary(getattr(known, f"DICT_{self.dictionary}"))
        board = known.CharucoBoard(
            (self.across, self.down), self.square, self.marker, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board

    def outlines(self) -> NDArray[np.float64]:
        """The markers' corners in squares from the first inner corner, (K, 4, 2), clockwise."""
        corners = np.array(self.board().getObjPoints(), float)
        return corners[..., :2] / self.square - 1

    def code(self) -> Code:
        """The markers in the order of :meth:`outlines`."""
        board = self.board()
        family, side = board.getDictionary(), self._bits()
        bits = [
            family.generateImageMarker(int(i), side)[1:-1, 1:-1] > 0
            for i in board.getIds().ravel()
        ]
        return Code(np.array(bits), 1)

    @property
    def cells_per_square(self) -> int:
        """How many cells of :meth:`cells` a square is wide.

        Raises
        ------
        UserError
            When square, marker and bit have no common measure of at least square / 256.

        """
        return _common_measure(self.square, self.marker, self._bits())[0]

    def cells(self) -> NDArray[np.uint8]:
        """The board itself as a fine grid, 0 black, 255 white.

        (down * n, across * n) with n = :attr:`cells_per_square`; every edge of a square and of
        a marker's bit falls on an edge of the grid, so that the board is reproduced exactly.
        """
        board = self.board()
        n, bit = _common_measure(self.square, self.marker, self._bits())
        grid = np.zeros((self.down * n, self.across * n), np.uint8)
        bits = self._bits()
        inset = (n - bits * bit) // 2
        for number, outline in zip(board.getIds().ravel(), board.getObjPoints(), strict=True):
            column, row = (int(v) for v in np.mean(outline, axis=0)[:2] // self.square)
            square = grid[row * n : (row + 1) * n, column * n : (column + 1) * n]
            square[:] = 255
            marker = board.getDictionary().generateImageMarker(int(number), bits)
            square[inset : n - inset, inset : n - inset] = np.kron(
                marker, np.ones((bit, bit), np.uint8)
            )
        return grid

    def _bits(self) -> int:
        """Bits along a marker's side, its black border included."""
        return int(self.board().getDictionary().markerSize) + 2


@dataclass(frozen=True)
class CircleGrid:
    """Dark discs on white paper, ``across`` x ``down`` of them; ``square`` in metres.

    On a symmetric grid ``square`` is the distance of neighbours. On an asymmetric one, as
    OpenCV counts it, every second row is shifted by ``square``, rows are ``square`` apart and
    the discs of a row twice that. Half a turn changes neither a symmetric grid nor an
    asymmetric one with an even number of rows; for a single lens that does not matter.
    """

    across: int
    down: int
    square: float
    asymmetric: bool = False

    @property
    def columns(self) -> int:
        """Places in a row, with or without a disc."""
        return self.across * (2 if self.asymmetric else 1)

    @property
    def rows(self) -> int:
        """Places in a column."""
        return self.down

    @property
    def count(self) -> int:
        """How many discs there are."""
        return self.across * self.down

    @property
    def pitch(self) -> float:
        """Distance of nearest discs in units of ``square``."""
        return math.sqrt(2) if self.asymmetric else 1.0

    @property
    def spec(self) -> str:
        """As a person types it."""
        kind = "acircles" if self.asymmetric else "circles"
        return f"{kind}:{self.across}x{self.down}:{self.square!r}"

    def points(self) -> NDArray[np.float64]:
        """Places on the board, (rows, columns, 3), metres."""
        return _grid(self.rows, self.columns, self.square)

    def places(self) -> NDArray[np.int_]:
        """Column and row of each disc in :meth:`points`, row by row, (count, 2)."""
        y, x = np.indices((self.down, self.across))
        column = 2 * x + y % 2 if self.asymmetric else x
        return np.stack([column, y], axis=-1).reshape(-1, 2)

    @property
    def cells_per_square(self) -> int:
        """How many cells of :meth:`cells` a square is wide."""
        return 64

    def cells(self) -> NDArray[np.uint8]:
        """The board drawn, discs half as wide as their distance, 0 black, 255 white.

        ((rows + 1) * n, (columns + 1) * n) with n = :attr:`cells_per_square`.
        """
        n = self.cells_per_square
        grid = np.full(((self.rows + 1) * n, (self.columns + 1) * n), 255, np.uint8)
        radius = 0.25 * self.pitch * n
        y, x = np.indices((2 * n, 2 * n)) + 0.5 - n
        disc = np.hypot(x, y) < radius
        for column, row in self.places().tolist():
            grid[row * n : (row + 2) * n, column * n : (column + 2) * n][disc] = 0
        return grid


type Target = Chessboard | Charuco | AprilGrid | CircleGrid


def parse_target(spec: str) -> Target:
    """Read ``chessboard:9x6:0.025``, ``charuco:9x6:0.04:0.03:4X4_50``, ``circles:7x5:0.04``.

    A chessboard is counted in inner corners, a ChArUco board in squares, across x down; sizes
    are metres. ``aprilgrid:6x6:0.088:0.3`` is Kalibr's: tags, side of a tag, gap in sides of a
    tag; with ``:1`` behind it the tags' rims are one bit wide, not two. ``acircles:4x11:0.02``
    is OpenCV's asymmetric grid of circles.

    Raises
    ------
    UserError
        With what is wrong with the specification.

    """
    kind, *fields = spec.split(":")
    match kind, fields:
        case "chessboard", [count, square]:
            columns, rows = _count(spec, count)
            if min(columns, rows) < 3:
                raise UserError(f"{spec}: a chessboard needs 3x3 inner corners or more")
            return Chessboard(columns, rows, _length(spec, square))
        case "charuco", [count, square, marker, dictionary]:
            across, down = _count(spec, count)
            if min(across, down) < 3:
                raise UserError(f"{spec}: a ChArUco board needs 3x3 squares or more")
            side, inner = _length(spec, square), _length(spec, marker)
            if inner >= side:
                raise UserError(f"{spec}: the marker must be smaller than its square")
            name = _dictionary(spec, dictionary, across * down // 2)
            return Charuco(across, down, side, inner, name)
        case "aprilgrid", [count, side, spacing, *border]:
            return _aprilgrid(spec, count, side, spacing, border)
        case (("circles" | "acircles"), [count, spacing]):
            across, down = _count(spec, count)
            least = 2 if kind == "acircles" else 3
            if across < least or down < 3:
                raise UserError(f"{spec}: a grid of circles needs {least}x3 or more")
            return CircleGrid(across, down, _length(spec, spacing), kind == "acircles")
        case _:
            raise UserError(f"{spec!r} is no target; write {FORMS}")


def _aprilgrid(spec: str, count: str, side: str, spacing: str, border: list[str]) -> AprilGrid:
    across, down = _count(spec, count)
    if not 4 <= across * down <= 587 or min(across, down) < 1:
        raise UserError(f"{spec}: an AprilGrid has 4 to 587 tags")
    try:
        gap = float(spacing)
    except ValueError as error:
        raise UserError(
            f"{spec}: {spacing!r} is no ratio of gap and tag, such as 0.3"
        ) from error
    if not 0.05 <= gap <= 1:
        raise UserError(f"{spec}: the gap is 0.05 to 1 tag wide, not {spacing}")
    if border not in ([], ["1"], ["2"]):
        raise UserError(f"{spec}: a tag's rim is 1 or 2 bits wide")
    return AprilGrid(across, down, _length(spec, side), gap, int(border[0]) if border else 2)


def _grid(rows: int, columns: int, square: float) -> NDArray[np.float64]:
    y, x = np.indices((rows, columns))
    return np.stack([x * square, y * square, np.zeros_like(x)], axis=-1).astype(float)


def _count(spec: str, text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", text, re.ASCII)
    if not found:
        raise UserError(f"{spec}: {text!r} is no count across x down, such as 9x6")
    return int(found[1]), int(found[2])


def _length(spec: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise UserError(f"{spec}: {text!r} is no length in metres") from error
    if not 1e-6 <= value <= 1e3:
        raise UserError(f"{spec}: {text!r} is no sensible length in metres")
    return value


def _dictionary(spec: str, text: str, markers: int) -> str:
    import cv2

    name = text.upper().removeprefix("DICT_")
    known: Any = cv2.aruco
    # OpenCV spells some names twice, 36h11 and 36H11; the upper-case one is enough.
    names = {n.removeprefix("DICT_").upper() for n in dir(known) if n.startswith("DICT_")}
    if name not in names:
        raise UserError(f"{spec}: no dictionary {text!r}; known: {', '.join(sorted(names))}")
    size = len(known.getPredefinedDictionary(getattr(known, f"DICT_{name}")).bytesList)
    if size < markers:
        raise UserError(f"{spec}: {name} has {size} markers, the board needs {markers}")
    return name


def _common_measure(square: float, marker: float, bits: int) -> tuple[int, int]:
    """Cells to a square and to a bit, so that bit and margin are whole numbers of cells."""
    s, m = Fraction(repr(square)), Fraction(repr(marker))
    bit, margin = m / bits, (s - m) / 2
    cell = Fraction(
        gcd(bit.numerator * margin.denominator, margin.numerator * bit.denominator),
        bit.denominator * margin.denominator,
    )
    if s / cell > 256:
        raise UserError(
            f"a square of {square} m and bits of {float(bit):.6g} m have no common measure; "
            "choose the marker's side as a simple fraction of the square"
        )
    return int(s / cell), int(bit / cell)
