"""The world of instances: transforms, hits, rays that clear their face, textures, moving."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.material import Material, Texture, Wrap
from chromeball.renderer.mesh import Instance, Kind, Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import box, sphere
from chromeball.renderer.world import world
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

WHITE = np.ones((16, 32, 3), np.float32)


def hits(
    objects: list[Mesh | Instance], origins: NDArray[Any], directions: NDArray[Any]
) -> NDArray[np.float32]:
    """Rows of t, p (3), face normal (3), shading normal (3), start (3), instance, face."""
    return world(objects).hits(
        np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32)
    )[:, 0]


def rotation(seed: int) -> NDArray[np.float64]:
    axis = np.random.default_rng(seed).normal(size=3)
    return Pose.from_rotation_vector(axis, np.zeros(3)).rotation


def ball() -> Mesh:
    vertices, faces, normals = sphere(24, 48)
    return Mesh.of(vertices, faces, normals=normals)


@pytest.mark.parametrize("scale", [1.0, (0.3, 2.0, 1.0), (-1.0, 1.0, 1.0)])
def test_an_instance_is_the_mesh_with_its_vertices_moved(
    scale: float | tuple[float, float, float],
) -> None:
    pose = Pose(rotation(1), np.array([0.3, -0.2, 0.5]))
    rng = np.random.default_rng(2)
    d = rng.normal(size=(4000, 3))
    origins = pose.translation + np.array([0, 0.2, 0]) - 3 * d + 0.3 * rng.normal(size=d.shape)
    moved = hits([Instance(ball(), pose, scale)], origins, d)
    baked = hits([ball().placed(pose, scale)], origins, d)
    met = np.isfinite(moved[:, 0])
    assert met.sum() > 1500
    both = met & np.isfinite(baked[:, 0])
    assert (met != np.isfinite(baked[:, 0])).sum() <= 2  # rays through an edge
    near = both & (moved[:, 14] == baked[:, 14])
    assert near.sum() > 0.99 * both.sum()
    np.testing.assert_allclose(moved[near, 1:7], baked[near, 1:7], atol=1e-4)
    # a stretched smooth normal is interpolated before or after it is made a unit
    loose = 0.1 if np.ptp(np.abs(scale)) else 1e-4
    np.testing.assert_allclose(moved[near, 7:10], baked[near, 7:10], atol=loose)
    # the normals stand on the surface: their angle to the ray is below 90 degrees
    assert ((moved[met, 4:7] * d[met]).sum(1) < 0).all()


@settings(max_examples=60, deadline=None)
@given(
    size=st.floats(-3, 5),
    far=st.floats(-3, 5),
    seed=st.integers(0, 2**31),
    stretch=st.floats(0.05, 20),
)
def test_rays_clear_their_face_at_any_scale_and_place(
    size: float, far: float, seed: int, stretch: float
) -> None:
    """Convex, closed: a ray that leaves outwards meets nothing, one inwards meets the back."""
    rng = np.random.default_rng(seed)
    side, distance = 10.0**size, 10.0 ** max(far, size - 3)
    if distance > 3e3 * side:
        distance = 3e3 * side  # beyond, floats have no room left for the object itself
    vertices, faces, _ = box()
    at = rng.normal(size=3) * distance
    thing = Instance(
        Mesh.of(vertices, faces), Pose(rotation(seed), at), (side, side * stretch, side)
    )
    middle = at + thing.pose.rotation @ [0, 0.5 * side * stretch, 0]
    d = rng.normal(size=(3000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    span = side * max(1.0, stretch)
    first = hits([thing], middle - 3 * span * d, d)
    met = np.isfinite(first[:, 0])
    assert met.mean() > 0.9
    n, start = first[met, 4:7].astype(float), first[met, 10:13]
    # directions of the hemisphere, most of them grazing
    out = rng.normal(size=n.shape)
    out -= (out * n).sum(1, keepdims=True) * n
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    out += n * 10.0 ** rng.uniform(-3, 1, (len(n), 1))
    again = hits([thing], start, out)
    assert not np.isfinite(again[:, 0]).any()
    # nor does it lie farther off than rounding asks for
    off = np.abs(((start - first[met, 1:4]) * n).sum(1))
    assert off.max() < 2e-5 * (distance + span)


def test_degenerate_and_duplicate_triangles_make_no_nan() -> None:
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 0, 1], [0.5, 0, 0], [1e-30, 0, 1e-30], [1, 1e-7, 1]]
    )
    faces = np.array([[0, 2, 1], [0, 2, 1], [0, 3, 1], [0, 0, 1], [0, 4, 1], [1, 2, 5]])
    thing = Mesh.of(vertices, faces, 0.5, normals=np.zeros_like(vertices))
    camera = CameraModel.pinhole(
        (16, 16), 1.0, Pose.look_at(np.array([0.4, 1, 0.4]), np.array([0.4, 0, 0.41]))
    )
    rays, at = corner_rays(camera), camera.world_from_camera.translation
    L = path_trace(thing, rays, at, spp=16, environment=WHITE)
    assert np.isfinite(L).all()
    job = Compositor([thing], CapturedSet(WHITE, np.zeros(3)), rays, at)
    job.add(8)
    assert np.isfinite(job.result().rgb).all()


def test_instances_share_a_mesh_and_each_can_be_moved() -> None:
    mesh = ball()
    places = [np.array([x, 0.0, 0.0]) for x in (-2, 0, 2)]
    objects = [Instance(mesh, Pose(np.eye(3), p)) for p in places]
    built = world(objects)
    down = np.tile(np.array([0, -1, 0], np.float32), (4, 1))
    above = np.array([[x, 5, 0.01] for x in (-2, 0, 2, 4)], np.float32)
    found = built.hits(above, down)[:, 0]
    np.testing.assert_array_equal(found[:3, 13], [0, 1, 2])
    assert np.isinf(found[3, 0])


def test_a_moved_object_is_where_a_new_compositor_puts_it() -> None:
    mesh = ball()
    camera = CameraModel.pinhole(
        (32, 24), 0.9, Pose.look_at(np.array([0.0, 1, 4]), np.array([0, 0.4, 0.0]))
    )
    rays, at = corner_rays(camera), camera.world_from_camera.translation
    captured = CapturedSet(WHITE * 0.5, np.zeros(3))
    here, there = Pose.identity(), Pose(rotation(3), np.array([0.5, 0.1, -0.5]))
    job = Compositor([Instance(mesh, here)], captured, rays, at)
    job.add(4)
    before = job.result().rgb
    job.move(0, there, 0.7)
    job.add(4)
    fresh = Compositor([Instance(mesh, there, 0.7)], captured, rays, at)
    fresh.add(4)
    assert job.result().rgb.tobytes() == fresh.result().rgb.tobytes()
    assert (job.result().rgb != before).any()
    with pytest.raises(IndexError):
        job.move(1, there)


def quad(material: Material, turned: bool = False) -> Mesh:
    """Facing +z, x and y in -1..1; u along x, v along -y."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]])
    if turned:
        uv[:, 0] = 1 - uv[:, 0]
    return Mesh.of(corners, np.array([[0, 1, 2], [0, 2, 3]]), uv=uv, material=material)


def looking_at_quad(size: int = 32) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    at = np.array([0.0, 0.0, 4.0])
    fov = 2 * math.atan(0.25)
    camera = CameraModel.pinhole((size, size), fov, Pose.look_at(at, np.zeros(3)))
    return corner_rays(camera), at


def test_a_texture_lies_where_its_uv_say() -> None:
    pixels = np.random.default_rng(0).uniform(0, 1, (4, 4, 3)).astype(np.float32)
    shine = Material(
        specular=0.0,
        emission=(2.0, 2.0, 2.0),
        base_color=(0.0, 0.0, 0.0),
        emission_texture=Texture(np.repeat(np.repeat(pixels, 16, 0), 16, 1)),
    )
    rays, at = looking_at_quad()
    L = path_trace(quad(shine), rays, at, spp=4, max_bounces=0)
    blocks = L.reshape(4, 8, 4, 8, 3)[:, 2:6, :, 2:6].mean((1, 3))
    np.testing.assert_allclose(blocks, 2 * pixels, rtol=1e-3)


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_textures_wrap_as_they_say(wrap: Wrap) -> None:
    row = np.linspace(0.1, 0.9, 8, dtype=np.float32)
    texture = Texture(np.broadcast_to(row[None, :, None], (8, 8, 1)).copy(), (wrap, wrap))
    shine = Material(specular=0.0, emission=(1.0, 1.0, 1.0), emission_texture=texture)
    mesh = quad(shine)
    wide = Mesh(
        mesh.vertices, mesh.faces, mesh.material, mesh.materials, uv=np.asarray(mesh.uv) * 3 - 1
    )
    rays, at = looking_at_quad(24)
    L = path_trace(wide, rays, at, spp=256, max_bounces=0)[12, :, 0]
    middle = L[8:16]
    np.testing.assert_allclose(middle[1:-1], row[1:-1], atol=0.01)
    left = {"repeat": L[8:16], "clamp": np.full(8, row[0]), "mirror": L[8:16][::-1]}[wrap]
    np.testing.assert_allclose(L[1:7], left[1:-1], atol=0.01)


@pytest.mark.parametrize("turned", [False, True])
def test_a_normal_map_bends_the_normal_along_growing_u(turned: bool) -> None:
    bend = math.radians(20)
    n = np.array([math.sin(bend), 0, math.cos(bend)])
    bump = Texture(np.broadcast_to((n * 0.5 + 0.5).astype(np.float32), (2, 2, 3)).copy())
    mesh = quad(Material.diffuse((0.5, 0.5, 0.5)), turned)
    bumpy = Mesh.of(
        mesh.vertices,
        mesh.faces,
        uv=mesh.uv,
        material=Material(specular=0.0, normal_texture=bump),
    )
    for side in (1.0, -1.0):
        found = hits([bumpy], np.array([[0.1, 0.2, side]]), np.array([[0.0, 0, -side]]))
        # seen from behind, the same relief
        expected = side * np.array([-n[0] if turned else n[0], 0, n[2]])
        np.testing.assert_allclose(found[0, 7:10], expected, atol=1e-5)


@pytest.mark.parametrize("mode", ["mask", "blend"])
def test_alpha_lets_the_plate_through_and_light_as_well(
    mode: Literal["mask", "blend"],
) -> None:
    leaf = np.ones((8, 8, 4), np.float32)
    leaf[..., 3] = np.where(np.arange(8) < 4, 0.25, 0.75)[None, :]
    material = Material(
        (0.0, 0.0, 0.0), specular=0.0, alpha_mode=mode, base_color_texture=Texture(leaf)
    )
    rays, at = looking_at_quad(32)
    plate = np.random.default_rng(1).uniform(0.2, 1, (32, 32, 3)).astype(np.float32)
    job = Compositor([quad(material)], CapturedSet(WHITE, np.zeros(3)), rays, at, plate)
    job.add(256)
    result = job.result()
    left, right = (0.0, 1.0) if mode == "mask" else (0.25, 0.75)
    assert result.alpha[:, 3:13].mean() == pytest.approx(left, abs=0.01)
    assert result.alpha[:, 19:29].mean() == pytest.approx(right, abs=0.01)
    np.testing.assert_allclose(result.rgb[:, 3:13], (1 - left) * plate[:, 3:13], atol=0.12)
    if mode == "mask":  # no chance in it: the plate's bits
        assert (result.rgb[:, 3:13] == plate[:, 3:13]).all()
    shadow = path_trace(
        Mesh.join(
            [
                quad(material),
                quad(Material.diffuse((1.0, 1.0, 1.0))).placed(
                    Pose(np.eye(3), np.array([0, 0, -1e-3]))
                ),
            ]
        ),
        rays,
        at,
        spp=256,
        max_bounces=1,
        environment=WHITE,
    )
    # seen and lit through the same share
    assert shadow[:, 3:13].mean() == pytest.approx((1 - left) ** 2, abs=0.02)


def test_environments_that_are_no_light_are_refused_with_their_count() -> None:
    sky = WHITE.copy()
    sky[3, 4, 1] = np.nan
    sky[3, 5] = -1
    sky[0, 0, 2] = np.inf
    sky[0, 1, 2] = np.inf
    with pytest.raises(UserError, match="1 NaN and 2 infinite and 1 negative pixels of 512"):
        CapturedSet(sky, np.zeros(3))
    with pytest.raises(UserError, match="environment of shape"):
        CapturedSet(np.zeros((0, 4, 3), np.float32), np.zeros(3))


@pytest.mark.parametrize(
    "sky", [np.full((1, 1, 3), 0.7), np.zeros((8, 16, 3)), np.ones((1, 2, 3))]
)
def test_one_pixel_and_black_environments_are_light_too(sky: NDArray[np.float64]) -> None:
    rays, at = looking_at_quad(8)
    thing = quad(Material.diffuse((1.0, 1.0, 1.0)))
    job = Compositor([thing], CapturedSet(sky.astype(np.float32), np.zeros(3)), rays, at)
    job.add(64)
    np.testing.assert_allclose(job.result().rgb, sky[0, 0, 0], atol=0.02)


def test_a_singular_scale_is_refused() -> None:
    with pytest.raises(UserError, match="scale is"):
        Instance(ball(), Pose.identity(), (1.0, 0.0, 1.0))


def test_of_makes_one_material_of_equal_faces() -> None:
    vertices, faces, _ = box()
    kinds = np.where(np.arange(12) < 4, Kind.DIFFUSE, Kind.MIRROR)
    mesh = Mesh.of(vertices, faces, (0.25, 0.5, 0.75), kind=kinds)
    assert len(mesh.materials) == 2
    assert mesh.materials[mesh.material[0]] == Material.diffuse((0.25, 0.5, 0.75))
    assert mesh.materials[mesh.material[11]] == Material.mirror((0.25, 0.5, 0.75))
    joined = Mesh.join([mesh, mesh])
    assert len(joined.materials) == 2
    np.testing.assert_array_equal(joined.material, np.tile(mesh.material, 2))
