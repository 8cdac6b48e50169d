"""Outlines: area and winding are kept by triangulation, what cannot be filled is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.scene.errors import UserError
from chromeball.stand_in import outline


def turns(ring: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Areas by the cross product in space: the y component of the floor's normal."""
    points = np.stack([ring[:, 0], np.zeros(len(ring)), ring[:, 1]], axis=1)[triangles]
    return np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])[:, 1] / 2


def star(radii: list[float], shift: float) -> NDArray[np.float64]:
    """A simple polygon, concave as radii will have it."""
    angle = np.arange(len(radii)) * (2 * np.pi / len(radii)) + shift
    return np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@settings(deadline=None, max_examples=200)
@given(
    st.lists(st.floats(0.05, 20), min_size=3, max_size=40),
    st.floats(0, 6.3),
    st.booleans(),
    st.floats(1e-3, 1e3),
)
def test_triangles_fill_any_star(
    radii: list[float], shift: float, flipped: bool, scale: float
) -> None:
    drawn = star(radii, shift) * scale
    given_area = abs(outline.area(drawn))
    ring = outline.ring("polygon", drawn[::-1] if flipped else drawn)
    triangles = outline.triangulate(ring)
    areas = turns(ring, triangles)
    assert len(triangles) == len(ring) - 2
    assert (areas > 0).all()
    np.testing.assert_allclose(areas.sum(), given_area, rtol=1e-6)
    # each side of the ring belongs to one triangle, each diagonal to two, once each way
    edges = {(int(t[k]), int(t[k - 2])) for t in triangles for k in range(3)}
    assert len(edges) == 3 * len(triangles)
    assert {(i, (i + 1) % len(ring)) for i in range(len(ring))} <= edges


def test_spiral_is_filled() -> None:
    turn = np.linspace(0.5, 16, 80)
    arm = np.stack([turn * np.cos(turn), turn * np.sin(turn)], axis=1)
    ring = outline.ring("polygon", np.concatenate([arm, 0.9 * arm[::-1]]))
    areas = turns(ring, outline.triangulate(ring))
    assert (areas > 0).all()
    np.testing.assert_allclose(areas.sum(), outline.area(ring), rtol=1e-12)


@pytest.mark.parametrize("flip", [1, -1])
def test_the_first_point_stays_first_and_the_normal_points_up(flip: int) -> None:
    corners = np.array([[0.0, 0], [0, 3], [2, 3], [2, 0]])
    ring = outline.ring("polygon", np.roll(corners[::flip], 1, axis=0))
    assert outline.area(ring) == pytest.approx(6)
    np.testing.assert_array_equal(ring[0], np.roll(corners[::flip], 1, axis=0)[0])


def test_corners_on_a_straight_side_are_left_out() -> None:
    ring = outline.ring("polygon", [[0, 0], [0, 1], [0, 2], [2, 2], [2, 1], [2, 0]])
    assert ring.tolist() == [[0, 0], [0, 2], [2, 2], [2, 0]]


@settings(deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3), st.floats(0.01, 10), st.floats(0.01, 10))
def test_square_rectangle_and_circle_are_found_again(
    place: tuple[float, float, float], width: float, depth: float
) -> None:
    x, z, turn = place
    u, v = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    a = np.array([x, z])
    square = outline.ring("square", [a, a + width * (u + v)])
    assert outline.area(square) == pytest.approx(width**2, rel=1e-9)
    for corner in (a, a + width * u, a + width * v, a + width * (u + v)):
        assert np.linalg.norm(square - corner, axis=1).min() < 1e-9
    # the third point may slide along the opposite side (Felinto et al., 6.1.3)
    rectangle = outline.ring("rectangle", [a, a + width * u, a + 0.3 * width * u - depth * v])
    assert outline.area(rectangle) == pytest.approx(width * depth, rel=1e-9)
    for corner in (a, a + width * u, a - depth * v, a + width * u - depth * v):
        assert np.linalg.norm(rectangle - corner, axis=1).min() < 1e-9
    angles = turn + np.array([0, 1.0, 2.5])
    on_rim = a + width * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    circle = outline.ring("circle", on_rim)
    np.testing.assert_allclose(np.linalg.norm(circle - a, axis=1), width, rtol=1e-7)
    np.testing.assert_allclose(circle[0], on_rim[0], atol=1e-7 * (width + 10))
    n = outline.CIRCLE_SIDES
    expected = n / 2 * np.sin(2 * np.pi / n) * width**2
    assert outline.area(circle) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("kind", "points", "message"),
    [
        ("polygon", [[0, 0], [1, 1], [1, 0], [0, 1]], "sides 1 and 3 of the outline cross"),
        ("polygon", [[0, 0], [4, 0], [4, 4], [2, 0], [0, 4]], "sides 1 and 3"),
        ("polygon", [[0, 0], [2, 0], [1, 0], [1, 1]], "folds back on itself at point 2"),
        ("polygon", [[0, 0], [1, 0], [2, 0]], "folds back|lie on a line"),
        ("polygon", [[0, 0], [1, 0], [1, 1], [0, 0]], "points 1 and 4 are the same"),
        ("polygon", [[0, 0], [1, 0]], "at least 3 points, not 2"),
        ("polygon", [[0, 0], [1, 0], [np.nan, 1]], "not finite"),
        ("square", [[1, 1], [1, 1]], "are the same point"),
        ("square", [[1, 1], [1, 2], [2, 2]], "drawn by 2 points, not 3"),
        ("rectangle", [[0, 0], [0, 0], [1, 1]], "first two points of the rectangle"),
        ("rectangle", [[0, 0], [1, 0], [3, 0]], "lies on its first side"),
        ("circle", [[0, 0], [1, 1], [2, 2]], "lie on a line"),
        ("circle", [[0, 0], [1, 1], [0, 0]], "lie on a line"),
        ("oval", [[0, 0]], "unknown outline 'oval'"),
    ],
)
def test_what_is_no_outline_is_refused(
    kind: str, points: list[list[float]], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        outline.ring(kind, points)


@settings(deadline=None, max_examples=300)
@given(
    st.sampled_from([*outline.OUTLINES]),
    st.lists(st.tuples(st.integers(-4, 4), st.integers(-4, 4)), min_size=1, max_size=9),
)
def test_any_points_give_a_filled_outline_or_one_line(
    kind: str, points: list[tuple[int, int]]
) -> None:
    """Small integers hit every degenerate case: shared points, touching and collinear sides."""
    try:
        ring = outline.ring(kind, np.array(points, float))
    except UserError:
        return
    areas = turns(ring, outline.triangulate(ring))
    assert (areas > 0).all()
    np.testing.assert_allclose(areas.sum(), outline.area(ring), rtol=1e-9)
