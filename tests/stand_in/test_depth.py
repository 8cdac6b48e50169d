"""The light-depth map: analytic rooms, a plain reference, energy, and no holes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import StandIn
from chromeball.stand_in.depth import coverage, distance_map, row_solid_angles, shrink
from chromeball.stand_in.panorama import overlay, panorama
from chromeball.stand_in.ply import StandInMesh
from chromeball.stand_in.primitives import build_mesh, build_piece


def mesh_of(*entries: StandIn) -> StandInMesh:
    return build_mesh([build_piece(entry) for entry in entries])


def soup(triangles: NDArray[np.float64]) -> StandInMesh:
    count = len(triangles)
    vertices = triangles.reshape(-1, 3).astype(np.float32)
    return StandInMesh(
        vertices,
        vertices,
        np.arange(3 * count, dtype=np.uint32).reshape(-1, 3),
        np.zeros(count, np.uint8),
    )


def moller_trumbore(
    mesh: StandInMesh, origin: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The plain reference: Moeller and Trumbore 1997, every ray against every face."""
    nearest = np.full(rays.shape[:-1], np.inf)
    for a, b, c in mesh.triangles():
        e1, e2, s = b - a, c - a, origin - a
        p = np.cross(rays, e2)
        determinant = p @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (p @ s) / determinant
            q = np.cross(s, e1)
            v = (rays @ q) / determinant
            t = (q @ e2) / determinant
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        nearest = np.where(met & (t < nearest), t, nearest)
    return nearest


def test_room_is_the_slab_distance_and_has_no_hole() -> None:
    low, high = np.array([-2.0, 0, -3]), np.array([3.0, 2.6, 1.5])
    room = StandIn(name="r", kind="room", corners=[(-2, -3), (-2, 1.5), (3, 1.5), (3, -3)],
                   height=2.6)  # fmt: skip
    mesh = mesh_of(room)
    for origin in np.random.default_rng(1).uniform(low + 0.05, high - 0.05, (4, 3)):
        camera = panorama((256, 128), origin)
        rays = camera.rays(camera.pixel_grid())
        exact = np.maximum((low - origin) / rays, (high - origin) / rays).min(axis=-1)
        np.testing.assert_allclose(distance_map(mesh, camera), exact, rtol=1e-5)


def test_no_ray_slips_between_the_faces_of_a_closed_mesh() -> None:
    """Vertices and edges are aimed at on purpose: the origin shares planes with the edges."""
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    corners = [(2 * math.cos(a), 2 * math.sin(a)) for a in angles]
    mesh = mesh_of(StandIn(name="r", kind="room", corners=corners, height=2.0))
    for width in (64, 96, 192):
        distance = distance_map(mesh, panorama((width, width // 2), np.array([0, 1.0, 0])))
        assert np.isfinite(distance).all()


def test_agrees_with_the_plain_reference_on_any_triangles() -> None:
    random = np.random.default_rng(2)
    triangles = random.normal(size=(700, 1, 3)) * 3 + random.normal(size=(700, 3, 3)) * 0.7
    mesh = soup(triangles)
    camera = panorama((128, 64), np.array([0.1, 0.2, 0.3]))
    expected = moller_trumbore(
        mesh, camera.world_from_camera.translation, camera.rays(camera.pixel_grid())
    )
    found = distance_map(mesh, camera)
    differing = np.isfinite(expected) != np.isfinite(found)
    assert differing.sum() <= 2  # a ray that grazes an edge may fall on either side
    both = np.isfinite(expected) & np.isfinite(found)
    assert 0.2 < both.mean() < 1
    close = np.isclose(found[both], expected[both], rtol=1e-4)
    assert (~close).sum() <= 2


def test_floor_covers_its_solid_angle() -> None:
    width, depth, height = 4.0, 3.0, 1.2
    mesh = mesh_of(StandIn(name="f", kind="plane", size=(width, depth)))
    camera = panorama((1024, 512), np.array([0, height, 0]))
    distance = distance_map(mesh, camera)
    figures = coverage(distance)
    a, b = width / 2, depth / 2
    exact = 4 * math.atan(a * b / (height * math.sqrt(a * a + b * b + height * height)))
    assert figures["solid_angle"] == pytest.approx(exact, rel=2e-3)
    rays = camera.rays(camera.pixel_grid())
    met = np.isfinite(distance)
    np.testing.assert_allclose(distance[met], (height / -rays[..., 1])[met], rtol=1e-6)
    assert not met[:256].any()


def test_what_is_not_met_is_infinite_and_edge_on_faces_cover_nothing() -> None:
    """The floor seen from within its own plane is a line."""
    mesh = mesh_of(StandIn(name="f", kind="plane", size=(2.0, 2.0)))
    distance = distance_map(mesh, panorama((64, 32), np.array([5.0, 0, 0])))
    assert np.isposinf(distance).all()
    assert coverage(distance) == {
        "solid_angle": 0.0, "sphere_share": 0.0, "distance_min": None, "distance_max": None
    }  # fmt: skip


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_size_does_not_matter(scale: float) -> None:
    random = np.random.default_rng(3)
    triangles = random.normal(size=(50, 3, 3))
    camera = panorama((64, 32), np.zeros(3))
    small = distance_map(soup(triangles), camera)
    large = distance_map(soup(triangles * scale), camera)
    np.testing.assert_allclose(large, small * scale, rtol=1e-4)


def test_shrinking_keeps_the_light() -> None:
    rgb = np.random.default_rng(4).exponential(size=(64, 128, 3)).astype(np.float32)
    rgb[3, 5] = 1e5
    small = shrink(rgb, 32)
    assert small.shape == (16, 32, 3)
    before = np.einsum("h,hwc->c", row_solid_angles(64, 128), rgb.astype(float))
    after = np.einsum("h,hwc->c", row_solid_angles(16, 32), small.astype(float))
    np.testing.assert_allclose(after, before, rtol=1e-6)
    np.testing.assert_allclose(row_solid_angles(64, 128).sum() * 128, 4 * math.pi)
    for width in (48, 0, 256, 1):
        with pytest.raises(UserError, match=rf"width {width} does not fit a map 128"):
            shrink(rgb, width)


def test_overlay_draws_edges_where_they_are_seen() -> None:
    origin = np.array([0.2, 1.5, 0.1])
    camera = panorama((512, 256), origin)
    box = StandIn(name="b", kind="box", corners=[(1, 1), (1, 2), (2, 2), (2, 1)], height=1.0)
    wall = StandIn(
        name="w", kind="room", corners=[(-4, -4), (-4, 4), (4, 4), (4, -4)], height=3
    )
    picture = overlay(np.full((256, 512, 3), 0.3, np.float32), camera, mesh_of(box, wall))
    assert picture.shape == (256, 512, 3)
    drawn = (picture != picture[0, 0]).any(axis=2)
    for end, other, colour in (
        ((1, 0, 1), (1, 1, 1), (60, 255, 60)),
        ((4, 0, 4), (4, 3, 4), (60, 160, 255)),
        ((-4, 0, -4), (4, 0, -4), (60, 255, 60)),  # behind: crosses the seam
    ):
        for share in (0.1, 0.5, 0.9):
            point = np.array(end) * (1 - share) + np.array(other) * share
            x, y = np.rint(camera.project_world(point)).astype(int)
            assert tuple(picture[y, x % 512]) == colour
    # the diagonals of the ceiling are no edges
    for corner in ([2, 3, 2], [2, 3, -2]):
        x, y = np.rint(camera.project_world(corner)).astype(int)
        assert not drawn[y - 2 : y + 3, x - 2 : x + 3].any()
    assert 0.005 < drawn.mean() < 0.1
