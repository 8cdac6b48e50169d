"""Many objects, long objects, lamps among them: the same light, whatever is sampled."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Instance, Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import box, sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import SUPPORT, StandInMesh

WHITE = np.ones((32, 64, 3), np.float32)


def floor(half: float) -> StandInMesh:
    v = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32) * np.float32(
        half
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return StandInMesh(v, v, faces, np.full(2, SUPPORT, np.uint8))


def view(
    at: tuple[float, ...],
    target: tuple[float, ...],
    fov: float,
    size: tuple[int, int] = (32, 24),
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    up = np.array([0.0, 1.0, 1e-3])
    camera = CameraModel.pinhole(size, fov, Pose.look_at(np.array(at), np.array(target), up))
    return corner_rays(camera), camera.world_from_camera.translation


def ball(material: Material) -> Mesh:
    vertices, faces, normals = sphere(32, 64)
    return Mesh.of(vertices, faces, normals=normals, material=material)


def test_a_hundred_objects_cast_the_shadow_of_the_one_mesh_that_they_make() -> None:
    rng = np.random.default_rng(0)
    vertices, faces, _ = box()
    cube = Mesh.of(vertices, faces, 0.1)
    poses = [
        Pose(np.eye(3), np.array([x, rng.uniform(0.05, 0.5), z]))
        for x, z in rng.uniform(-2, 2, (100, 2))
    ]
    apart = [Instance(cube, pose, 0.1) for pose in poses]
    joined = Mesh.join([cube.placed(pose, 0.1) for pose in poses])
    rays, at = view((0, 3, 5), (0, 0, 0), 0.9)
    sky = np.full((32, 64, 3), 0.4, np.float32)
    sky[5:8, 10:14] = 15
    pictures, errors = [], []
    for objects in (apart, [joined]):
        job = Compositor(
            objects, CapturedSet(sky, np.zeros(3), floor(4)), rays, at, samples=256
        )
        job.add(256)
        pictures.append(job.result())
        errors.append(job.result().relative_error())
    one, other = pictures
    np.testing.assert_allclose(one.alpha, other.alpha, atol=0.01)
    sigma = np.hypot(one.standard_error, other.standard_error)
    difference = np.abs(one.rgb - other.rgb).mean(axis=2)
    assert (difference < 5 * sigma + 1e-3).mean() > 0.99
    assert abs((one.rgb - other.rgb).mean()) < 2e-3
    # spheres of their own aim better than one around all
    assert errors[0] < errors[1]


def test_a_rods_own_spheres_aim_better_than_one_around_it() -> None:
    """Its shadow in even light, where nothing but the spheres is aimed at."""
    vertices, faces, _ = box()
    rod = Mesh.of(vertices, faces, 0.0)
    # finely divided along its length, so that it has parts
    parts = Mesh.join(
        [
            rod.placed(Pose(np.eye(3), np.array([x, 0.5, 0.0])), (0.125, 0.05, 0.05))
            for x in (np.arange(32) - 15.5) * 0.125
        ]
    )
    whole = rod.placed(Pose(np.eye(3), np.array([0, 0.5, 0.0])), (4, 0.05, 0.05))
    rays, at = view((0, 1.2, 1.5), (0, 0, 0), 0.5)
    results = []
    for mesh in (parts, whole):
        job = Compositor([mesh], CapturedSet(WHITE, np.zeros(3), floor(4)), rays, at)
        job.add(128)
        results.append(job.result())
    bare = (results[0].alpha == 0) & (results[1].alpha == 0)
    Q = [r.quotient[bare].mean() for r in results]
    assert Q[0] == pytest.approx(Q[1], abs=2e-3)
    noise = [r.standard_error[bare].mean() for r in results]
    assert noise[0] < 0.6 * noise[1]


@pytest.mark.parametrize("radius", [0.02, 0.3])
def test_a_lamp_among_the_objects_lights_the_floor(radius: float) -> None:
    height, shine = 1.0, 0.5 / radius**2
    lamp = ball(
        Material(specular=0.0, base_color=(0.0, 0.0, 0.0), emission=(shine, shine, shine))
    )
    rays, at = view((0.6, 0.2, 0), (0, 0, 0), 0.004)
    pose = Pose(np.eye(3), np.array([0, height - radius, 0]))
    captured = CapturedSet(WHITE, np.array([0, 0.5, 0.5]), floor(5))
    job = Compositor([Instance(lamp, pose, 2 * radius)], captured, rays, at, samples=64)
    job.add(64)
    result = job.result()
    # of the even sky's pi it takes the share sin^2 of its half angle, and gives its own
    expected = 1 + (shine - 1) * (radius / height) ** 2
    np.testing.assert_allclose(result.quotient, expected, rtol=0.02)
    assert result.relative_error() < 0.02


def test_objects_are_lit_by_lamps_as_in_the_reference() -> None:
    lamp = ball(
        Material(specular=0.0, base_color=(0.0, 0.0, 0.0), emission=(300.0, 200.0, 100.0))
    )
    glossy = ball(Material((0.6, 0.6, 0.6), roughness=0.4))
    objects = [
        Instance(lamp, Pose(np.eye(3), np.array([0.8, 1.2, 0.8])), 0.05),
        Instance(glossy, Pose.identity()),
    ]
    rays, at = view((0, 0.5, 3), (0, 0.5, 0), 0.5, (24, 24))
    sky = np.full((8, 16, 3), 0.1, np.float32)
    meshes = [i.mesh.placed(i.pose, i.scale) for i in objects]
    truth = path_trace(Mesh.join(meshes), rays, at, spp=512, max_bounces=4, environment=sky)
    job = Compositor(objects, CapturedSet(sky, np.zeros(3)), rays, at, bounces=3, samples=256)
    job.add(256)
    result = job.result()
    full = result.alpha == 1
    assert result.rgb[full].mean() == pytest.approx(truth[full].mean(), rel=0.01)
    relative = np.abs(result.rgb - truth)[full] / truth[full]
    assert np.median(relative) < 0.03


def test_glass_gathers_light_on_the_floor_and_its_shadow_is_not_black() -> None:
    """Energy of a caustic: in even light, clear glass leaves the floor as bright as it was."""
    clear = ball(Material.glass((1.0, 1.0, 1.0)))
    rays, at = view((1.5, 1.5, 2), (0, 0, 0), 0.5)
    pose = Pose(np.eye(3), np.array([0, 0.2, 0]))
    captured = CapturedSet(WHITE, np.array([0, 1.0, 0]), floor(40))
    job = Compositor([Instance(clear, pose, 0.6)], captured, rays, at, samples=256, bounces=8)
    job.add(256)
    Q = job.result().quotient
    assert np.median(np.abs(Q - 1)) < 0.02
    assert Q.mean() == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("pane", ["clear", "tinted", "alpha"])
def test_a_pane_before_a_floor_dims_it_and_its_light(pane: str) -> None:
    """A large pane over a floor under an even sky, seen from below and from above."""
    n = 1.5
    material = {
        "clear": Material((1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, thin=True, ior=n),
        "tinted": Material((0.5, 0.7, 0.9), roughness=0.0, transmission=1.0, thin=True, ior=n),
        "alpha": Material((0.0, 0.0, 0.0), specular=0.0, alpha=0.3, alpha_mode="blend"),
    }[pane]
    vertices, faces, _ = box()
    sheet = Mesh.of(vertices[:4] - [0, 0, 0], faces[:2], material=material)
    at_height = Pose(np.eye(3), np.array([0, 0.5, 0.0]))
    rays, at = view((0.0, 0.3, 0.2), (0, 0, 0), 0.2, (8, 8))
    captured = CapturedSet(WHITE, np.array([0, 0.3, 0]), floor(3))
    job = Compositor(
        [Instance(sheet, at_height, 40.0)], captured, rays, at, samples=512, bounces=0
    )
    job.add(512)
    Q = job.result().quotient.mean(axis=(0, 1))

    def passed(cos: NDArray[np.float64]) -> NDArray[np.float64]:
        if pane == "alpha":
            return np.full((len(cos), 3), 0.7)
        t = np.sqrt(1 - (1 - cos**2) / n**2)
        R = 0.5 * (((cos - n * t) / (cos + n * t)) ** 2 + ((n * cos - t) / (n * cos + t)) ** 2)
        return (1 - 2 * R / (1 + R))[:, None] * np.array(material.base_color)

    cos = (np.arange(4000) + 0.5) / 4000
    through = (2 * cos[:, None] * passed(cos)).mean(0)
    # the sheet's lower side reflects the floor, which the map shows as white as the sky
    mirrored = (
        0.0
        if pane == "alpha"
        else 1 - (2 * cos[:, None] * passed(cos)).mean(0) / np.array(material.base_color)
    )
    np.testing.assert_allclose(Q, through + mirrored, atol=0.015)


def test_tiny_and_huge_scenes_far_from_the_origin_look_like_the_one_of_metres() -> None:
    pictures = []
    for scale, offset in ((1.0, 0.0), (1e-3, 0.0), (1e5, 0.0), (1.0, 1e5), (1e-3, 2.0)):
        shift = np.array([offset, 0.5 * offset, -offset])
        ground = floor(4 * scale)
        moved = (ground.vertices + shift).astype(np.float32)
        stand_in = StandInMesh(moved, moved, ground.faces, ground.surface)
        objects = [
            Instance(ball(Material.diffuse((0.5, 0.5, 0.5))), Pose(np.eye(3), shift), scale)
        ]
        rays, at = view((0, 1.5, 3), (0, 0.3, 0), 0.6)
        origin = np.array([0, 1.0, 0]) * scale + shift
        sky = np.full((32, 64, 3), 0.3, np.float32)
        sky[6:8, 20:23] = 40
        job = Compositor(objects, CapturedSet(sky, origin, stand_in), rays, at * scale + shift)
        job.add(64)
        pictures.append(job.result().rgb)
    for other in pictures[1:]:
        assert np.isfinite(other).all()
        error = np.abs(other - pictures[0])
        assert error.mean() < 0.012 * pictures[0].mean()
        assert (other - pictures[0]).mean() == pytest.approx(0, abs=2e-3)
    assert math.isfinite(pictures[0].max())
