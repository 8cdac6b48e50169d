"""Drawing on the map: known places are clicked in a known map and found again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import StandIn
from chromeball.stand_in.panorama import panorama
from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT
from chromeball.stand_in.primitives import (
    Piece,
    build_mesh,
    build_piece,
    floor_points,
    height_above,
    metres_per_pixel,
)

ORIGIN = np.array([0.3, 1.4, -0.2])
MAP = panorama((1024, 512), ORIGIN)
L_SHAPE = [(-2.0, -2.0), (-2.0, 2.0), (0.0, 2.0), (0.0, 0.0), (2.0, 0.0), (2.0, -2.0)]


def clicks(places: NDArray[np.float64]) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in MAP.project_world(places)]


def on_floor(corners: list[tuple[float, float]]) -> NDArray[np.float64]:
    return np.array([[x, 0, z] for x, z in corners])


def volume(piece: Piece) -> float:
    """By the divergence theorem; a face in y = 0 adds nothing when x, z flux is not taken."""
    a, b, c = np.moveaxis(piece.vertices[piece.faces], 1, 0)
    flux = np.cross(b - a, c - a)[:, 1] / 2 * (a + b + c)[:, 1] / 3
    return float(flux.sum())


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(-8, 8), st.floats(-8, 8)), min_size=1, max_size=8, unique=True)
)
def test_clicked_floor_points_are_found_again(places: list[tuple[float, float]]) -> None:
    found = floor_points(MAP, np.array(clicks(on_floor(places))))
    np.testing.assert_allclose(found, np.array(places), atol=1e-9)


@settings(deadline=None)
@given(st.floats(-6, 6), st.floats(-6, 6), st.floats(0.05, 5))
def test_clicked_height_is_found_again(x: float, z: float, height: float) -> None:
    if np.hypot(x - ORIGIN[0], z - ORIGIN[2]) < 0.2:
        x += 1  # straight under the map nothing can be seen above
    pixel = clicks(np.array([[x, height, z]]))[0]
    found, miss = height_above(MAP, np.array([x, z]), list(pixel))
    assert found == pytest.approx(height, abs=1e-8)
    assert miss < 1e-8


def test_a_click_beside_the_vertical_says_by_how_much() -> None:
    corner = np.array([ORIGIN[0], ORIGIN[2] + 3.0])
    pixel = clicks(np.array([[ORIGIN[0] + 0.1, 2.0, ORIGIN[2] + 3.0]]))[0]
    height, miss = height_above(MAP, corner, list(pixel))
    # the ray passes the vertical at the foot of the perpendicular in plan
    assert miss == pytest.approx(3 * 0.1 / np.hypot(3, 0.1))
    assert height == pytest.approx(ORIGIN[1] + 0.6 * 9 / (9 + 0.01))


def test_metres_per_pixel_is_the_derivative() -> None:
    corner = np.array([[ORIGIN[0], ORIGIN[2] + 4.0]])
    x, y = clicks(np.array([[corner[0, 0], 0, corner[0, 1]]]))[0]
    moved = floor_points(MAP, [[x, y - 0.005], [x, y + 0.005]])
    slope = np.linalg.norm(moved[0] - moved[1]) / 0.01
    assert metres_per_pixel(MAP, corner) == pytest.approx(slope, rel=1e-4)


def test_box_points_outward_room_inward() -> None:
    corners = on_floor(L_SHAPE)
    top = clicks(corners[:1] + np.array([0, 2.5, 0]))[0]
    box = build_piece(
        StandIn(name="b", kind="box", points=clicks(corners), height_point=top), MAP
    )
    assert box.height == pytest.approx(2.5)
    assert volume(box) == pytest.approx(12 * 2.5)
    a, b, c = np.moveaxis(box.vertices[box.faces], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert areas.sum() == pytest.approx(12 + 16 * 2.5)  # open below
    assert (box.surface == SUPPORT).all()
    room = build_piece(StandIn(name="r", kind="room", points=clicks(corners), height=2.5), MAP)
    assert volume(room) == pytest.approx(-12 * 2.5)
    low = (room.vertices[room.faces][:, :, 1] == 0).all(axis=1)
    assert (room.surface[low] == SUPPORT).all()
    assert (room.surface[~low] == ENVIRONMENT).all()
    # closed: every edge is used once in each direction
    edges = [(int(f[k]), int(f[k - 2])) for f in room.faces for k in range(3)]
    assert len(set(edges)) == len(edges)
    assert {(j, i) for i, j in edges} == set(edges)


def test_box_walls_join_its_top() -> None:
    piece = build_piece(StandIn(name="b", kind="box", corners=L_SHAPE, height=1))
    edges = [(int(f[k]), int(f[k - 2])) for f in piece.faces for k in range(3)]
    single = {(i, j) for i, j in edges if (j, i) not in edges}
    ground = len(piece.vertices) // 2
    assert len(single) == 6
    assert all(i < ground and j < ground for i, j in single)  # only the bottom is open


def test_plane_lies_about_the_origin_and_looks_up() -> None:
    piece = build_piece(StandIn(name="p", kind="plane", size=(4.0, 2.0), surface="environment"))
    assert np.abs(piece.vertices).max(axis=0).tolist() == [2, 0, 1]
    a, b, c = np.moveaxis(piece.vertices[piece.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    assert (normals[:, 1] > 0).all()
    assert normals[:, 1].sum() / 2 == 8
    assert (piece.surface == ENVIRONMENT).all()


def test_pieces_become_one_mesh_that_remembers_where_it_was_drawn() -> None:
    pieces = [
        build_piece(StandIn(name="a", kind="plane", size=(9.0, 9.0))),
        build_piece(StandIn(name="b", kind="polygon", corners=L_SHAPE, surface="environment")),
        build_piece(StandIn(name="c", kind="box", corners=L_SHAPE[:3], height=0.5)),
    ]
    mesh = build_mesh(pieces)
    np.testing.assert_array_equal(mesh.vertices, mesh.original)
    start = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    faces = np.concatenate([p.vertices[p.faces] for p in pieces])
    np.testing.assert_allclose(mesh.triangles(), faces, atol=1e-6)
    assert mesh.faces.max() == start[-1] - 1


def test_outline_of_a_drawn_rectangle() -> None:
    corners = on_floor([(1.0, 1.0), (3.0, 1.0), (2.5, 2.0)])
    piece = build_piece(
        StandIn(name="p", kind="polygon", outline="rectangle", points=clicks(corners)), MAP
    )
    assert sorted(map(tuple, piece.vertices[:, [0, 2]].round(6).tolist())) == [
        (1, 1), (1, 2), (3, 1), (3, 2)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"kind": "plane"}, "a plane needs size"),
        ({"kind": "plane", "size": (1, 1), "corners": L_SHAPE}, "takes size alone"),
        ({"kind": "plane", "size": (1, 1), "height": 1}, "a plane is flat"),
        ({"kind": "polygon", "corners": L_SHAPE, "height": 1}, "a polygon is flat"),
        ({"kind": "polygon", "size": (1, 1)}, "size is for a plane"),
        ({"kind": "polygon"}, "needs points"),
        ({"kind": "polygon", "corners": L_SHAPE, "points": L_SHAPE}, "not both"),
        ({"kind": "box", "corners": L_SHAPE}, "a box needs height"),
        (
            {"kind": "room", "corners": L_SHAPE, "height": 1, "height_point": (1, 1)},
            "a room needs height .* not both",
        ),
        ({"kind": "box", "corners": L_SHAPE, "height_point": (1, 1)}, "add --env env.exr"),
        ({"kind": "polygon", "points": L_SHAPE}, "add --env env.exr"),
    ],
)
def test_keys_that_do_not_fit_are_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=rf"^stand_in 'x': .*{message}"):
        build_piece(StandIn(name="x", **keys))


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        ([(10, 300), (20, 255.4)], r"point 2 \(x 20, y 255.4\) does not lie below the horizon"),
        ([(10, 100)], "point 1 .* never meets the floor"),
        ([(10, 300), (1024, 300)], "point 2 .* is outside the map"),
        ([(10, 512)], "outside the map"),
        ([(np.nan, 300)], "outside the map"),
    ],
)
def test_pixels_that_see_no_floor_are_refused(
    pixels: list[tuple[float, float]], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        floor_points(MAP, np.array(pixels))


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ([0.3, 3, -4], "looks away from the first corner"),
        ([0.3, -0.5, 3], "below the floor"),
        ([0.3, 1, -0.2], "straight up or down"),
    ],
)
def test_height_points_that_give_no_height_are_refused(
    place: list[float], message: str
) -> None:
    pixel = clicks(np.array([place]))[0]
    with pytest.raises(UserError, match=message):
        height_above(MAP, np.array([0.3, 3.0]), list(pixel))
