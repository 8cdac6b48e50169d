"""The compositor against closed forms, and against the reference integrator."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import box, sphere
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT, StandInMesh

WHITE = np.ones((32, 64, 3), np.float32)
SIZE = (32, 24)


def ball(centre: tuple[float, ...], radius: float, color: float, kind: Kind) -> Mesh:
    vertices, faces, normals = sphere()
    mesh = Mesh.of(vertices, faces, color, kind=kind, normals=normals)
    at = np.array(centre) - np.array([0, radius, 0])
    return mesh.placed(Pose(np.eye(3), at), 2 * radius)


def floor(half: float = 5.0, surface: int = SUPPORT) -> StandInMesh:
    v = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32) * half
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return StandInMesh(v, v, faces, np.full(2, surface, np.uint8))


def camera(
    place: tuple[float, ...],
    target: tuple[float, ...],
    fov: float,
    size: tuple[int, int] = SIZE,
) -> CameraModel:
    up = np.array([0.0, 1.0, 1e-3])
    return CameraModel.pinhole(size, fov, Pose.look_at(np.array(place), np.array(target), up))


def compositor(
    objects: list[Mesh],
    environment: NDArray[np.float32],
    stand_in: StandInMesh | None,
    view: CameraModel,
    origin: tuple[float, ...] = (0.0, 1.0, 0.0),
    plate: NDArray[np.float32] | None = None,
    **options: int,
) -> Compositor:
    return Compositor(
        objects,
        CapturedSet(environment, np.array(origin), stand_in),
        corner_rays(view),
        view.world_from_camera.translation,
        plate,
        bounces=options.get("bounces", 4),
        samples=options.get("samples", 64),
        seed=options.get("seed", 0),
    )


def noise_plate(size: tuple[int, int] = SIZE) -> NDArray[np.float32]:
    shape = (size[1], size[0], 3)
    return np.random.default_rng(4).uniform(0.1, 1, shape).astype(np.float32)


def test_irradiance_of_an_even_sky_is_pi_and_of_a_sun_its_cosine() -> None:
    view = camera((0, 1, 2), (0, 0, 0), 0.6)
    up = np.array([0.0, 1.0, 0.0])
    even = compositor([], WHITE, None, view).irradiance(np.zeros(3), up)
    np.testing.assert_allclose(even, math.pi, rtol=1e-3)
    sky = np.zeros((64, 128, 3), np.float32)
    sky[12, 70] = [1e5, 5e4, 1e4]
    latitude = np.pi * 12.5 / 64
    solid_angle = 2 * np.pi / 128 * (math.cos(math.pi * 12 / 64) - math.cos(math.pi * 13 / 64))
    sun = compositor([], sky, None, view).irradiance(np.zeros(3), up)
    np.testing.assert_allclose(sun, sky[12, 70] * solid_angle * math.cos(latitude), rtol=3e-3)


def test_without_objects_the_plate_is_untouched_bit_for_bit() -> None:
    plate = noise_plate()
    view = camera((0, 1, 2), (0, 0, 0), 0.6)
    job = compositor([], WHITE, floor(), view, plate=plate)
    job.add(8)
    result = job.result()
    assert result.rgb.tobytes() == plate.tobytes()
    assert not result.changed.any()
    assert (result.quotient == 1).all()


def test_what_the_object_cannot_reach_keeps_its_bits() -> None:
    plate = noise_plate()
    view = camera((0, 2, 4), (0, 0.5, 0), 1.2)
    w = np.array([[-9, 0, -3], [9, 0, -3], [9, 9, -3], [-9, 9, -3]], np.float32)
    wall = StandInMesh(
        w,
        w,
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        np.full(2, ENVIRONMENT, np.uint8),
    )
    ground = floor(2.9)
    stand_in = StandInMesh(
        np.concatenate([ground.vertices, wall.vertices]),
        np.concatenate([ground.original, wall.original]),
        np.concatenate([ground.faces, wall.faces + np.uint32(4)]),
        np.concatenate([ground.surface, wall.surface]),
    )
    job = compositor(
        [ball((0, 0.3, 0), 0.3, 0.4, Kind.DIFFUSE)], WHITE, stand_in, view, plate=plate
    )
    job.add(32)
    result = job.result()
    kept = ~result.changed
    assert 0.05 < kept.mean() < 0.95
    assert (result.rgb[kept] == plate[kept]).all()
    assert (result.rgb[result.changed] != plate[result.changed]).any()
    # rows that see the wall alone
    assert kept[0].all()
    assert (result.quotient[kept] == 1).all()
    assert result.standard_error[kept].max() == 0


@pytest.mark.parametrize(("radius", "height"), [(0.1, 1.0), (0.4, 0.8), (0.5, 0.6)])
def test_a_black_sphere_takes_its_form_factor(radius: float, height: float) -> None:
    view = camera((0.6, 0.25, 0), (0, 0, 0), 0.004)
    job = compositor(
        [ball((0, height, 0), radius, 0.0, Kind.DIFFUSE)], WHITE, floor(), view, samples=256
    )
    job.add(256)
    Q = job.result().quotient[12, 16]
    # below a sphere's middle it blocks the share sin^2 of its half angle
    expected = 1 - (radius / height) ** 2
    np.testing.assert_allclose(Q, expected, atol=0.01)


@pytest.mark.parametrize("positional", [True, False])
def test_light_comes_from_its_place(positional: bool) -> None:
    """A lamp seen at 45 degrees from the origin, on a ceiling at 3 m or infinitely far."""
    sky = np.full((128, 256, 3), 1e-4, np.float32)
    sky[32, 64] = 1e4  # 45 degrees up, towards +X
    origin = (0.0, 1.0, 0.0)
    ceiling = np.array([[-9, 3, 9], [9, 3, 9], [9, 3, -9], [-9, 3, -9]], np.float32)
    ground = floor(9)
    stand_in = ground
    if positional:
        vertices = np.concatenate([ground.vertices, ceiling])
        stand_in = StandInMesh(
            vertices,
            vertices,
            np.concatenate([ground.faces, ground.faces + np.uint32(4)]),
            np.repeat(np.array([SUPPORT, ENVIRONMENT], np.uint8), 2),
        )
    object_at = np.array([0.0, 1.0, 0.5])
    u = (64 + 0.5) / 256
    lon = (u - 0.5) * 2 * math.pi
    lat = (0.5 - 32.5 / 128) * math.pi
    w = np.array([-math.sin(lon) * math.cos(lat), math.sin(lat), math.cos(lon) * math.cos(lat)])
    if positional:
        lamp = np.array(origin) + w * (2.0 / w[1])
        along = object_at - lamp
    else:
        along = -w
    shadow = object_at + along * (object_at[1] / -along[1])
    view = camera((-0.5, 2.5, 0.3), (-0.8, 0, 0.4), 1.2, (96, 72))
    job = compositor(
        [ball(tuple(object_at), 0.08, 0.0, Kind.DIFFUSE)], sky, stand_in, view, origin
    )
    job.add(16)
    result = job.result()
    dark = (result.quotient[..., 1] < 0.5) & (result.alpha == 0)
    assert dark.sum() > 10
    found = np.argwhere(dark).mean(axis=0)[::-1]
    np.testing.assert_allclose(found, view.project_world(shadow), atol=1.0)


def test_a_white_object_in_a_white_world_is_exactly_1() -> None:
    view = camera((0, 0.5, 3), (0, 0.5, 0), 0.5)
    for kind in Kind:
        job = compositor([ball((0, 0.5, 0), 0.5, 1.0, kind)], WHITE, None, view)
        job.add(16)
        result = job.result()
        assert result.alpha.max() == 1
        np.testing.assert_allclose(result.rgb[result.alpha == 1], 1, atol=2e-3)


def test_a_mirror_shows_the_map_by_place() -> None:
    """A mirror on the floor shows a wall where it stands."""
    rng = np.random.default_rng(3)
    sky = np.repeat(np.repeat(rng.uniform(0.2, 1, (8, 16, 3)), 16, 0), 16, 1)
    sky = sky.astype(np.float32)
    w = np.array([[-9, -9, -4], [9, -9, -4], [9, 9, -4], [-9, 9, -4]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    wall = StandInMesh(w, w, faces, np.full(2, ENVIRONMENT, np.uint8))
    vertices, triangles, _ = box()
    mirror = Mesh.of(vertices, triangles, 0.8, kind=Kind.MIRROR).placed(
        Pose(np.eye(3), np.array([0, -0.1, 0])), (3, 0.1, 3)
    )
    view = camera((0.3, 0.8, 1.2), (0, 0, 0), 0.3)
    job = compositor([mirror], sky, wall, view)
    job.add(1)
    result = job.result()
    # the same from the mirrored camera, without the mirror
    ray = view.rays(view.pixel_grid()) * [1, -1, 1]
    place = view.world_from_camera.translation * [1, -1, 1]
    q = place + ray * ((-4 - place[2]) / ray[..., 2])[..., None]
    pixel = CameraModel.latlong((256, 128)).project_world(q - np.array([0.0, 1.0, 0.0]))
    x, y = np.rint(pixel).astype(int).transpose(2, 0, 1)
    edge = np.minimum(pixel % 16, 16 - pixel % 16).min(axis=2)
    inside = (result.alpha == 1) & (edge > 2) & (edge < 14)
    assert inside.sum() > 200
    np.testing.assert_allclose(result.rgb[inside], 0.8 * sky[y, x][inside], rtol=1e-3)


def test_glass_without_contrast_is_invisible() -> None:
    rng = np.random.default_rng(5)
    sky = rng.uniform(0.5, 1, (16, 32, 3)).astype(np.float32)
    vertices, faces, normals = sphere()
    glass = Mesh.of(vertices, faces, 1, kind=Kind.GLASS, ior=1, normals=normals).placed(
        Pose(np.eye(3), np.array([0, 0.1, 0]))
    )
    view = camera((0, 1, 3), (0, 0.4, 0), 0.8)
    job = compositor([glass], sky, floor(), view, samples=256)
    job.add(256)
    result = job.result()
    assert result.alpha.max() == 1
    np.testing.assert_allclose(result.quotient, 1, atol=1e-3)
    np.testing.assert_allclose(result.rgb, job.plate, rtol=0.1)  # the plate's own noise


def closed_room() -> tuple[Mesh, StandInMesh]:
    vertices, faces, _ = box()
    shell = Mesh.of(vertices, faces, (0.6, 0.5, 0.4)).placed(Pose.identity(), (4, 2.5, 4))
    lamp = np.array([[-1, 2.49, -1], [1, 2.49, -1], [1, 2.49, 1], [-1, 2.49, 1]], np.float32)
    quad = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    room = Mesh.join([shell, Mesh.of(lamp, quad, 0.0, (8.0, 7.0, 6.0))])
    low = shell.vertices[shell.faces][..., 1].max(axis=1) == 0
    surface = np.where(low, SUPPORT, ENVIRONMENT).astype(np.uint8)
    return room, StandInMesh(shell.vertices, shell.vertices, shell.faces, surface)


def test_composite_is_the_photograph_with_the_object() -> None:
    room, stand_in = closed_room()
    origin = np.array([0.3, 1.1, 0.6])
    view = camera((1.2, 1.3, 1.6), (0, 0.2, 0), 0.8)
    rays, place = corner_rays(view), view.world_from_camera.translation
    white = ball((0, 0.35, 0), 0.35, 1, Kind.DIFFUSE)
    objects = [Mesh.of(white.vertices, white.faces, (0.8, 0.3, 0.2), normals=white.normals)]
    pose = Pose(WORLD_FROM_LATLONG.rotation, origin)
    around = corner_rays(CameraModel.latlong((256, 128), pose))
    env = path_trace(room, around, origin, spp=64, seed=1, max_bounces=16)
    plate = path_trace(room, rays, place, spp=2048, seed=2, max_bounces=16)
    full = Mesh.join([room, *objects])
    truth = path_trace(full, rays, place, spp=2048, seed=3, max_bounces=16)
    changed = np.abs(truth - plate).max(axis=2) > 0.05 * plate.max(axis=2)
    assert changed.sum() > 120
    captured = CapturedSet(env, origin, stand_in)
    for mode in ("quotient", "difference"):
        job = Compositor(objects, captured, rays, place, plate, samples=256, mode=mode)
        job.add(256)
        result = job.result()
        error = (result.rgb - truth)[changed] / truth[changed]
        assert np.median(np.abs(error)) < 0.02
        assert abs(np.median(error)) < 0.01
        assert result.clipped == 0


def test_passes_add_up_and_a_seed_decides() -> None:
    view = camera((0, 1, 2), (0, 0.3, 0), 0.8)
    objects = [ball((0, 0.3, 0), 0.3, 0.5, Kind.DIFFUSE)]
    runs: list[NDArray[np.float32]] = []
    for passes, seed in (([16], 0), ([4, 12], 0), ([16], 1)):
        job = compositor(objects, WHITE, floor(), view, seed=seed)
        for count in passes:
            job.add(count)
        runs.append(job.result().rgb)
    assert runs[0].tobytes() == runs[1].tobytes()
    assert runs[0].tobytes() != runs[2].tobytes()


def test_layers_are_what_they_say() -> None:
    view = camera((0, 1, 2), (0, 0.3, 0), 0.8)
    job = compositor([ball((0, 0.3, 0), 0.3, 0.5, Kind.DIFFUSE)], WHITE, floor(), view)
    job.add(64)
    r = job.result()
    floor_only = r.alpha == 0
    np.testing.assert_allclose(
        r.rgb[floor_only], (job.plate * r.quotient)[floor_only], rtol=1e-4
    )
    full = r.alpha == 1
    np.testing.assert_allclose(r.rgb[full], r.objects[full], rtol=1e-5)
    # the middle of the picture sees the ball's near side
    assert r.depth[12, 16] == pytest.approx(math.hypot(0.7, 2) - 0.3, abs=0.05)
    assert 0 < r.relative_error() < 0.05
    before = r.relative_error()
    job.add(192)
    assert job.result().relative_error() < 0.7 * before


def test_a_stand_in_that_was_moved_keeps_its_light() -> None:
    """A bright patch on a wall goes along when the wall does (seeds F8, F12)."""
    sky = np.full((64, 128, 3), 0.1, np.float32)
    sky[28:36, 60:68] = 5  # straight ahead, +Z
    w = np.array([[-9, -9, 4], [9, -9, 4], [9, 9, 4], [-9, 9, 4]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    moved = w + np.array([0, 2, 0], np.float32)
    wall = StandInMesh(moved, w, faces, np.full(2, ENVIRONMENT, np.uint8))
    view = camera((0, 1, 0), (0, 1, 4), 1.4, (40, 60))
    job = compositor([], sky, wall, view)
    bright = np.argwhere(job.plate[..., 0] > 2).mean(axis=0)[::-1]
    expected = view.project_world(np.array([0.0, 3.0, 4.0]))
    np.testing.assert_allclose(bright, expected, atol=1.0)


def test_refined_samples_are_as_many_and_change_no_mean() -> None:
    view = camera((0, 2, 4), (0, 0.3, 0), 0.9, (64, 48))
    thing = [ball((0, 0.5, 0), 0.5, 0.5, Kind.DIFFUSE)]
    sky = np.full((32, 64, 3), 0.2, np.float32)
    sky[6:9, 40:44] = 20.0
    even = compositor(thing, sky, floor(), view, samples=256)
    even.add(512)
    steered = compositor(thing, sky, floor(), view, samples=256, seed=5)
    for _ in range(8):
        steered.refine(16)
    assert steered.samples == 128
    a, b = even.result(), steered.result()
    # each region's mean agrees within what its standard errors allow, at 4 sigma
    for region in (a.alpha == 1, a.changed & (a.alpha == 0)):
        count = region.sum()
        error = np.hypot(
            np.sqrt((a.standard_error[region] ** 2).sum()),
            np.sqrt((b.standard_error[region] ** 2).sum()),
        )
        difference = (b.rgb[region] - a.rgb[region]).mean(axis=1).sum()
        assert count > 100
        assert abs(difference) < 4 * error + 1e-4 * a.rgb[region].mean(axis=1).sum()


def test_refining_gives_less_noise_than_even_samples_of_the_same_number() -> None:
    view = camera((0, 2, 6), (0, 0.3, 0), 0.9, (64, 48))
    thing = [ball((0, 0.5, 0), 0.5, 0.5, Kind.DIFFUSE)]
    even = compositor(thing, WHITE, floor(), view, samples=64)
    even.add(64)
    steered = compositor(thing, WHITE, floor(), view, samples=64)
    for _ in range(8):
        steered.refine(8)
    assert steered.samples == even.samples
    assert steered.result().relative_error() < 0.8 * even.result().relative_error()


def test_refining_without_objects_leaves_the_plate() -> None:
    plate = noise_plate()
    job = compositor([], WHITE, floor(), camera((0, 1, 2), (0, 0, 0), 0.6), plate=plate)
    for _ in range(3):
        job.refine(8)
    assert job.result().rgb.tobytes() == plate.tobytes()


def test_another_camera_and_other_objects_give_what_a_new_compositor_gives() -> None:
    near, far = camera((0, 1, 2), (0, 0.3, 0), 0.8), camera((1, 1, 3), (0, 0, 0), 0.6, (20, 10))
    small = [ball((0, 0.3, 0), 0.3, 0.5, Kind.DIFFUSE)]
    large = [ball((0.2, 0.5, 0), 0.5, 0.9, Kind.MIRROR)]
    used = compositor(small, WHITE, floor(), near, seed=3)
    used.add(4)
    used.look(corner_rays(far), far.world_from_camera.translation)
    used.place(large)
    fresh = compositor(large, WHITE, floor(), far, seed=3)
    for job in (used, fresh):
        job.add(8)
    assert used.samples == fresh.samples == 8
    assert used.plate.tobytes() == fresh.plate.tobytes()
    assert used.result().rgb.tobytes() == fresh.result().rgb.tobytes()
    assert used.result().changed.any()
