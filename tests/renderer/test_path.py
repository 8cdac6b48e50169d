"""The reference integrator against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import PRIMITIVES, box, sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from tests.renderer.threads import printed_by_threads


def rectangle(
    centre: tuple[float, float, float],
    u: tuple[float, float, float],
    v: tuple[float, float, float],
    albedo: float,
    emission: float = 0.0,
) -> Mesh:
    c, a, b = np.array(centre), np.array(u), np.array(v)
    corners = np.array([c - a - b, c + a - b, c + a + b, c - a + b], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return Mesh.of(corners, faces, albedo, emission)


def pinhole(
    position: tuple[float, ...], target: tuple[float, ...], fov: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    up = np.array([0.0, 1.0, 0.01])
    pose = Pose.look_at(np.array(position), np.array(target), up)
    return corner_rays(CameraModel.pinhole((32, 32), fov, pose)), np.array(position)


@pytest.mark.parametrize("albedo", [0.0, 0.3, 0.8])
def test_a_closed_box_that_shines_is_a_furnace(albedo: float) -> None:
    vertices, faces, _ = box()
    mesh = Mesh.of(vertices, faces, albedo, 0.5)
    rays = corner_rays(CameraModel.latlong((48, 24)))
    L = path_trace(mesh, rays, (0.1, 0.4, 0.2), spp=128, max_bounces=80)
    assert L.mean() == pytest.approx(0.5 / (1 - albedo), rel=5e-3)


@pytest.mark.parametrize("kind", list(Kind))
def test_a_white_sphere_is_invisible_in_a_white_world(kind: Kind) -> None:
    vertices, faces, normals = sphere()
    mesh = Mesh.of(vertices, faces, 1, kind=kind, normals=normals)
    rays, origin = pinhole((0, 0.5, 3), (0, 0.5, 0), 0.5)
    white = np.ones((32, 64, 3), np.float32)
    L = path_trace(mesh, rays, origin, spp=64, max_bounces=60, environment=white)
    assert L.mean() == pytest.approx(1, abs=1e-3)
    if kind is not Kind.DIFFUSE:  # no light sampling, no noise
        np.testing.assert_allclose(L, 1, atol=1e-5)


def test_direct_light_of_a_rectangle_is_its_form_factor() -> None:
    a, h, emission, albedo = 0.4, 1.3, 5.0, 0.6
    mesh = Mesh.join(
        [
            rectangle((0, 0, 0), (2, 0, 0), (0, 0, 2), albedo),
            rectangle((0, h, 0), (a, 0, 0), (0, 0, a), 0.0, emission),
        ]
    )
    rays, origin = pinhole((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 0.01)
    # four quarters, each seen from below its corner (Howell, C-11)
    x = a / h
    corner = 2 * x / math.sqrt(1 + x * x) * math.atan(x / math.sqrt(1 + x * x)) / (2 * math.pi)
    L = path_trace(mesh, rays, origin, spp=256, max_bounces=1)
    assert L.mean() == pytest.approx(albedo * emission * 4 * corner, rel=2e-3)


def test_direct_light_of_the_sky_is_its_irradiance() -> None:
    mesh = rectangle((0, 0, 0), (2, 0, 0), (0, 0, 2), 0.5)
    rows = np.cos(np.linspace(0, math.pi, 65))
    up = 0.5 * (rows[1:] + rows[:-1])
    sky = np.broadcast_to(np.maximum(up, 0)[:, None, None], (64, 128, 3)).astype(np.float32)
    sky = np.ascontiguousarray(sky)
    sky[10, 70] = 3e4  # a sun of one texel
    rays, origin = pinhole((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 0.1)
    L = path_trace(mesh, rays, origin, spp=256, max_bounces=1, environment=sky)
    # integral of cos * cos over the hemisphere is 2 pi / 3; the sun as its bilinear tent
    area = np.pi / 64 * 2 * np.pi / 128 * np.sin(np.pi * 10.5 / 64)
    sun = 3e4 * area * math.cos(math.pi * 10.5 / 64)
    assert L.mean() == pytest.approx(0.5 * (2 * math.pi / 3 + sun) / math.pi, rel=1e-2)


def test_a_mirror_shows_the_mirrored_direction() -> None:
    rng = np.random.default_rng(1)
    sky = rng.uniform(0, 1, (64, 128, 3)).astype(np.float32)
    vertices, faces, _ = box()
    mesh = Mesh.of(vertices, faces, 0.9, kind=Kind.MIRROR).placed(
        Pose.identity(), (10.0, 0.01, 10.0)
    )
    rays, origin = pinhole((0, 2, 1), (0, 0, 0), 0.4)
    L = path_trace(mesh, rays, origin, spp=64, max_bounces=1, environment=sky)
    direct = path_trace(
        Mesh.empty(), rays * np.array([1, -1, 1], np.float32), origin, spp=64, environment=sky
    )
    np.testing.assert_allclose(L, 0.9 * direct, rtol=1e-3)


def test_glass_without_contrast_is_invisible() -> None:
    rng = np.random.default_rng(2)
    sky = rng.uniform(0, 1, (64, 128, 3)).astype(np.float32)
    vertices, faces, normals = sphere()
    mesh = Mesh.of(vertices, faces, 1, kind=Kind.GLASS, ior=1, normals=normals)
    rays, origin = pinhole((0, 0.5, 3), (0, 0.5, 0), 0.5)
    L = path_trace(mesh, rays, origin, spp=16, environment=sky)
    empty = path_trace(Mesh.empty(), rays, origin, spp=16, environment=sky)
    np.testing.assert_allclose(L, empty, rtol=2e-4)


def test_pixels_outside_the_lens_are_black() -> None:
    camera = CameraModel.fisheye("equisolid", (40, 40), math.pi)
    L = path_trace(
        Mesh.empty(),
        corner_rays(camera),
        (0, 0, 0),
        environment=np.ones((8, 16, 3), np.float32),
    )
    assert (L[0, 0] == 0).all()
    np.testing.assert_allclose(L[20, 20], 1, rtol=1e-5)


def test_a_seed_gives_one_picture_on_any_number_of_threads() -> None:
    code = (
        "import hashlib\n"
        "import numpy as np\n"
        "from chromeball.renderer.mesh import Mesh\n"
        "from chromeball.renderer.path import corner_rays, path_trace\n"
        "from chromeball.renderer.primitives import box\n"
        "from chromeball.scene.camera import CameraModel\n"
        "v, f, _ = box()\n"
        "rays = corner_rays(CameraModel.latlong((96, 48)))\n"
        "L = path_trace(Mesh.of(v, f, .5, 1), rays, (0, .5, 0), seed=5)\n"
        "print(hashlib.sha1(L.tobytes()).hexdigest())\n"
    )
    assert len(printed_by_threads(code)) == 1
    vertices, faces, _ = box()
    mesh = Mesh.of(vertices, faces, 0.5, 1)
    rays = corner_rays(CameraModel.latlong((16, 8)))
    first, other = (path_trace(mesh, rays, (0, 0.5, 0), spp=4, seed=s) for s in (1, 2))
    assert (first != other).any()


@pytest.mark.parametrize("name", list(PRIMITIVES))
def test_primitives_are_closed_and_face_outwards(name: str) -> None:
    vertices, faces, normals = PRIMITIVES[name]()
    a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
    volume = (np.cross(a, b) * c).sum() / 6
    assert volume == pytest.approx(
        {"sphere": math.pi / 6, "box": 1, "cylinder": math.pi / 4}[name], rel=1e-3
    )
    assert vertices[:, 1].min() == 0
    assert vertices[:, 1].max() == 1
    if normals is not None:
        n = np.cross(b - a, c - a)
        for k in range(3):
            assert ((n * normals[faces[:, k]]).sum(axis=1) > 0).all()


def test_broken_meshes_are_refused() -> None:
    vertices, faces, _ = box()
    bad = vertices.copy()
    bad[3, 1] = np.nan
    with pytest.raises(UserError, match="vertices of vertex 3 are NaN"):
        Mesh.of(bad, faces)
    wrong = faces.copy()
    wrong[2, 0] = 8
    with pytest.raises(UserError, match="a face names vertex 8, the mesh has 8"):
        Mesh.of(vertices, wrong)
    with pytest.raises(UserError, match="albedo of face 3 are NaN or infinite"):
        Mesh.of(vertices, faces, np.where(np.arange(12) == 3, np.inf, 0.5)[:, None])
    good = Mesh.of(vertices, faces)
    with pytest.raises(UserError, match="names material 1, the mesh has 1"):
        replace(good, material=np.ones(12, np.uint16))
