"""Targets: the specification a person types, and boards that OpenCV draws and finds."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chromeball.calibrate.target import Charuco, Chessboard, parse_target
from chromeball.scene.errors import UserError


def test_parse() -> None:
    assert parse_target("chessboard:9x6:0.025") == Chessboard(9, 6, 0.025)
    charuco = parse_target("charuco:9x6:0.04:0.03:DICT_4x4_50")
    assert charuco == Charuco(9, 6, 0.04, 0.03, "4X4_50")
    assert (charuco.columns, charuco.rows) == (8, 5)
    np.testing.assert_allclose(charuco.points()[4, 7], [0.28, 0.16, 0])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("", "is no target"),
        ("chessboard:9x6", "is no target"),
        ("rings:9x6:0.1", "is no target"),
        ("chessboard:9by6:0.025", "is no count"),
        ("chessboard:2x6:0.025", "3x3 inner corners"),
        ("chessboard:9x6:wide", "no length in metres"),
        ("chessboard:9x6:nan", "no sensible length"),
        ("charuco:9x6:0.03:0.04:4X4_50", "smaller than its square"),
        ("charuco:9x6:0.04:0.03:3X3_50", "no dictionary '3X3_50'"),
        ("charuco:20x20:0.04:0.03:4X4_50", "has 50 markers, the board needs 200"),
    ],
)
def test_bad_specification(spec: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        parse_target(spec)


@given(st.text(max_size=40) | st.from_regex(r"(chessboard|charuco|a?circles):\w+:[\w.:]*"))
def test_fuzzed_specification(spec: str) -> None:
    try:
        target = parse_target(spec)
    except UserError:
        return
    assert parse_target(target.spec) == target


def test_cells_are_opencvs_board() -> None:
    """Two routes to the picture: our cells, and OpenCV's drawing at 10 pixels a cell."""
    target = Charuco(9, 6, 0.04, 0.03, "4X4_50")
    cells = target.cells()
    assert cells.shape == (48, 72)
    drawn = target.board().generateImage((720, 480), marginSize=0)
    np.testing.assert_array_equal(drawn[5::10, 5::10], cells)


def test_corners_lie_where_the_cells_meet() -> None:
    target = Charuco(7, 5, 0.05, 0.035, "5X5_100")
    n, scale = target.cells_per_square, 4
    picture = np.pad(
        np.kron(target.cells(), np.ones((scale, scale), np.uint8)), 80, constant_values=255
    )
    aruco: Any = cv2.aruco
    corners, ids, _, _ = aruco.CharucoDetector(target.board()).detectBoard(picture)
    assert len(ids) == 24
    found = corners.reshape(-1, 2)[np.argsort(ids.ravel())]
    expected = (target.points()[..., :2].reshape(-1, 2) / target.square + 1) * n * scale + 79.5
    assert np.abs(found - expected).max() < 0.25


def test_incommensurate_marker() -> None:
    with pytest.raises(UserError, match="no common measure"):
        Charuco(9, 6, 0.04, 0.030123457, "4X4_50").cells()


def test_chessboard_cells() -> None:
    cells = Chessboard(4, 3, 0.1).cells()
    assert cells.shape == (4, 5)
    assert (cells[:-1] != cells[1:]).all()
    assert (cells[:, :-1] != cells[:, 1:]).all()
