"""Final gathering against the path integrator and against closed forms."""

import numpy as np
import pytest

from chromeball.examples.atrium.cameras import view_camera
from chromeball.examples.atrium.room import room
from chromeball.renderer.gather import light_set, tessellate
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import box


def closed_box(albedo: float, emission: float) -> Mesh:
    vertices, faces, _ = box()
    return Mesh.of(vertices, faces[:, ::-1], albedo=albedo, emission=emission)


def test_tessellation_keeps_area_materials_and_small_triangles() -> None:
    mesh = room()
    divided, lit, inward = tessellate(mesh, 0.4)

    def area(m: Mesh) -> np.ndarray:
        a, b, c = np.moveaxis(m.vertices[m.faces].astype(float), 1, 0)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    assert area(divided).sum() == pytest.approx(area(mesh).sum(), rel=1e-5)
    power = (area(divided)[:, None] * divided.emission()).sum(0)
    np.testing.assert_allclose(power, (area(mesh)[:, None] * mesh.emission()).sum(0), rtol=1e-4)
    corners = divided.vertices[divided.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() <= 0.4 + 1e-5
    assert np.linalg.norm(inward - divided.vertices, axis=1).max() <= 0.04 * 0.4 + 1e-6
    assert lit.any()
    whole, none, _ = tessellate(mesh, 100.0)
    assert not none.any()
    np.testing.assert_array_equal(whole.faces, mesh.faces)


def test_furnace() -> None:
    # A closed box that shines e everywhere and reflects a holds the radiance e / (1 - a).
    lit = light_set(closed_box(0.5, 1.0), edge=0.2, spp=64, max_bounces=40)
    known = lit.irradiance[np.isfinite(lit.irradiance).all(axis=1)]
    assert known.mean() == pytest.approx(np.pi * 2.0, rel=5e-3)
    rays = np.random.default_rng(0).normal(size=(5, 5, 3)).astype(np.float32)
    L = lit.radiance(rays, np.array([0.1, 0.4, 0.0]), spp=256)
    assert L.mean() == pytest.approx(2.0, rel=5e-3)


def test_room_against_path_integrator() -> None:
    mesh, camera = room(), view_camera().scaled(0.1)
    rays, origin = corner_rays(camera), camera.world_from_camera.translation
    lit = light_set(mesh, spp=128, seed=3)
    gathered = lit.radiance(rays, origin, spp=128)
    followed = path_trace(mesh, rays, origin, spp=256, max_bounces=12)

    def blocks(picture: np.ndarray) -> np.ndarray:
        return picture.reshape(4, 12, 4, 16, 3).mean((1, 3))

    np.testing.assert_allclose(blocks(gathered), blocks(followed), rtol=0.02)
    assert gathered.mean() == pytest.approx(followed.mean(), rel=3e-3)


def test_added_mesh_is_seen_and_the_light_stays() -> None:
    lit = light_set(room(), spp=8)
    vertices, faces, normals = box()
    more = lit.with_mesh(Mesh.of(vertices, faces, 0.8, normals=normals))
    assert len(more.irradiance) == len(more.mesh.vertices)
    np.testing.assert_array_equal(more.irradiance[: len(lit.irradiance)], lit.irradiance)
    assert np.isnan(more.irradiance[len(lit.irradiance) :]).all()
