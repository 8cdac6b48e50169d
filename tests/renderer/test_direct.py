"""The direct integrator against closed forms and against the path integrator."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import box, sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT, StandInMesh

SIZE = (48, 36)


def ball(centre: tuple[float, float, float], radius: float, kind: Kind = Kind.DIFFUSE) -> Mesh:
    vertices, faces, normals = sphere()
    mesh = Mesh.of(vertices, faces, 0.6, kind=kind, normals=normals)
    at = np.array(centre) - np.array([0, radius, 0])
    return mesh.placed(Pose(np.eye(3), at), 2 * radius)


def floor(half: float = 5.0) -> StandInMesh:
    v = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32) * half
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return StandInMesh(v, v, faces, np.full(2, SUPPORT, np.uint8))


def room() -> StandInMesh:
    """A box seen from inside, 4 x 2.5 x 4 m, whose floor receives, with a block in a corner."""
    vertices, faces, _ = box()
    walls = (vertices * np.array([4, 2.5, 4])).astype(np.float32)
    block = (vertices * np.array([0.8, 0.6, 0.8]) + np.array([-1.2, 0, -0.6])).astype(
        np.float32
    )
    low = (walls[faces][:, :, 1] == 0).all(axis=1)
    surface = np.concatenate(
        [np.where(low, SUPPORT, ENVIRONMENT), np.full(len(faces), SUPPORT)]
    )
    v = np.concatenate([walls, block])
    f = np.concatenate([faces[:, ::-1], faces + np.uint32(len(walls))])
    return StandInMesh(v, v, np.ascontiguousarray(f), surface.astype(np.uint8))


def window_light(height: int = 64) -> NDArray[np.float32]:
    """A dim warm surrounding with a bright window and a small lamp."""
    sky = np.full((height, 2 * height, 3), 0.2, np.float32) * np.array(
        [1, 0.9, 0.7], np.float32
    )
    sky[height // 6 : height // 3, height // 3 : height] += np.array([3, 4, 6], np.float32)
    sky[height // 4, 3 * height // 2] += np.float32(300)
    return sky


def view_from(place: tuple[float, ...], size: tuple[int, int] = SIZE) -> CameraModel:
    up = np.array([0.0, 1.0, 1e-3])
    return CameraModel.pinhole(
        size, 0.9, Pose.look_at(np.array(place), np.array([0.0, 0.2, 0.0]), up)
    )


def compositor(
    objects: list[Mesh],
    stand_in: StandInMesh | None,
    environment: NDArray[np.float32],
    integrator: Any = "direct",
    seed: int = 0,
    plate: NDArray[np.float32] | None = None,
    filtered: bool = False,
    view: CameraModel | None = None,
    bounces: int = 0,
    **options: Any,
) -> Compositor:
    view = view or view_from((0.0, 1.4, 1.9))
    return Compositor(
        objects,
        CapturedSet(environment, np.array([0.0, 1.0, 0.0]), stand_in),
        corner_rays(view),
        view.world_from_camera.translation,
        plate,
        bounces=bounces,
        seed=seed,
        integrator=integrator,
        filtered=filtered,
        **options,
    )


def test_without_objects_the_plate_keeps_its_bits() -> None:
    plate = np.random.default_rng(0).uniform(0, 1, (SIZE[1], SIZE[0], 3)).astype(np.float32)
    job = compositor([], floor(), window_light(), plate=plate)
    job.add(4)
    result = job.result()
    assert result.rgb.tobytes() == plate.tobytes()
    assert not result.changed.any()


def test_the_filter_does_not_touch_what_no_object_can_reach() -> None:
    plate = np.random.default_rng(0).uniform(0, 1, (SIZE[1], SIZE[0], 3)).astype(np.float32)
    job = compositor(
        [ball((0, 0.3, 0), 0.1)], floor(), window_light(), plate=plate, filtered=True
    )
    job.add(4)
    result = job.result()
    kept = ~result.changed
    assert 0.2 < kept.mean() < 0.95
    assert (result.rgb[kept] == plate[kept]).all()


@pytest.mark.parametrize("bounces", [0, 1])
@pytest.mark.parametrize("where", ["floor", "room"])
def test_direct_and_path_agree(where: str, bounces: int) -> None:
    objects = [ball((0.1, 0.25, 0.2), 0.25), ball((-0.5, 0.15, 0.6), 0.15)]
    stand_in = floor() if where == "floor" else room()
    environment = window_light()
    truth = compositor(objects, stand_in, environment, "path", samples=1024, bounces=bounces)
    truth.add(1024)
    fast = compositor(objects, stand_in, environment, seed=3, bounces=bounces)
    fast.add(512)
    a, b = truth.result(), fast.result()
    assert float(np.abs(a.alpha - b.alpha).max()) < 0.05
    # the means of all that changes agree: no bias
    solid = (a.alpha == 1) & (b.alpha == 1)
    ground = (a.alpha == 0) & (b.alpha == 0)
    assert b.objects.sum() == pytest.approx(a.objects.sum(), rel=5e-3)
    assert b.quotient[ground].mean() == pytest.approx(a.quotient[ground].mean(), rel=1e-3)
    # and every pixel does, within the noise of both and the grain of the list
    shadow = np.abs(b.quotient - a.quotient)[ground].mean(axis=1)
    assert float(np.quantile(shadow, 0.99)) < 0.05  # edges of the lamp's shadow
    light = np.abs(b.rgb / a.rgb - 1)[solid].mean(axis=1)
    assert float(np.quantile(light, 0.95)) < 0.06


def test_all_shadow_of_a_ball_near_the_floor() -> None:
    """Pixels beside the ball, too; lists of other seeds are others, so that errors go."""
    r, h, even = 0.3, 0.31, np.ones((16, 32, 3), np.float32)
    view = view_from((0.0, 1.4, 1.9))
    corners, eye = corner_rays(view), np.asarray(view.world_from_camera.translation)
    u = (np.arange(8)[:, None, None, None, None] + 0.5) / 8
    v = (np.arange(8)[None, :, None, None, None] + 0.5) / 8
    above = (1 - u) * corners[:-1, :-1] + u * corners[:-1, 1:]
    below = (1 - u) * corners[1:, :-1] + u * corners[1:, 1:]
    d = (1 - v) * above + v * below
    x = eye - eye[1] / d[..., 1:2] * d
    distance = np.linalg.norm(np.array([0, h, 0]) - x, axis=-1)
    blocked = ((r / distance) ** 2 * h / distance).mean(axis=(0, 1))
    ratios: list[float] = []
    for seed in range(6):
        job = compositor([ball((0, h, 0), r)], floor(), even, seed=seed)
        job.add(512)
        seen = job.result()
        ground = seen.alpha == 0
        ratios.append((1 - seen.quotient[..., 0][ground].mean()) / blocked[ground].mean())
    error = np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    assert error < 2e-3
    assert abs(np.mean(ratios) - 1) < 4e-3 + 3 * error  # the middles of 32 passes


def panel_beside(half: float) -> tuple[StandInMesh, NDArray[np.float32], NDArray[np.float64]]:
    """A lit panel of 2 x 1 m on a floor, seen by a probe 1.5 m before it: nearly all light."""
    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]) * half
    panel = np.array([[-1, 0, 1], [-1, 0, -1], [-1, 1, -1], [-1, 1, 1]])
    v = np.concatenate([corners, panel]).astype(np.float32)
    f = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.uint32)
    surface = np.array([SUPPORT, SUPPORT, ENVIRONMENT, ENVIRONMENT], np.uint8)
    h, probe = 128, np.array([0.5, 1.0, 0.0])
    theta = (np.arange(h)[:, None] + 0.5) * np.pi / h
    phi = (np.arange(2 * h)[None] + 0.5) * np.pi / h - np.pi
    x, y, z = -np.sin(phi) * np.sin(theta), np.cos(theta), np.cos(phi) * np.sin(theta)
    t = 1.5 / np.maximum(-x, 1e-6)
    lit = (x < 0) & (abs(1 + t * y - 0.5) < 0.5) & (abs(t * z) < 1)
    sky = np.where(lit[..., None], 10, 0.02) * np.ones(3)
    return StandInMesh(v, v, f, surface), sky.astype(np.float32), probe


@pytest.mark.parametrize("integrator", ["path", "direct"])
@pytest.mark.parametrize("half", [3.0, 30.0])
def test_a_screen_before_a_panel_takes_all_light(integrator: str, half: float) -> None:
    """Light that is near, which no lamp stands for; irradiance that varies from cm to cm."""
    stand_in, sky, probe = panel_beside(half)
    vertices, faces, _ = box()
    screen = Mesh.of(vertices, faces, 0.0).placed(
        Pose(np.eye(3), np.array([-0.93, 0, 0])), np.array([0.04, 1.1, 2.4])
    )
    eye = np.array([0.4, 1.6, 1.6])
    view = CameraModel.pinhole(SIZE, 0.8, Pose.look_at(eye, np.array([-0.5, 0, 0])))
    plate = np.ones((SIZE[1], SIZE[0], 3), np.float32)
    job = Compositor(
        [screen],
        CapturedSet(sky, probe, stand_in),
        corner_rays(view),
        eye,
        plate,
        bounces=0,
        samples=128,
        integrator=integrator,  # type: ignore[arg-type]
        filtered=False,
    )
    job.add(128)
    seen = job.result()
    corners = corner_rays(view)
    d = corners[:-1, :-1] + corners[1:, 1:]
    x = eye - eye[1] / d[..., 1:2] * d
    q = seen.quotient.mean(axis=2)
    shadow = (seen.alpha == 0) & (abs(x[..., 2]) < 0.5) & (x[..., 0] < 0)
    for low, high in ((-0.85, -0.7), (-0.7, -0.4), (-0.4, 0)):
        part = shadow & (x[..., 0] > low) & (x[..., 0] < high)
        assert part.sum() > 15
        # what is left comes from the dim rest of the world
        assert -0.02 < q[part].mean() < 0.03


def test_light_that_the_set_hides_from_the_probe_alone_reaches_an_object() -> None:
    """Above the probe an object sees past the floor's edge what no lamp stands for."""
    even = np.ones((64, 128, 3), np.float32)
    for half in (1.0, 5.0):
        eye, there = np.array([0, 1.4, 1.9]), np.array([0, 1.2, 0])
        view = CameraModel.pinhole(SIZE, 0.5, Pose.look_at(eye, there))
        job = compositor([ball((0, 1.2, 0), 0.3)], floor(half), even, view=view)
        job.add(256)
        seen = job.result()
        assert seen.objects[seen.alpha == 1].mean() == pytest.approx(0.6, rel=5e-3)


def test_depth_of_edges_is_that_of_what_they_show() -> None:
    jobs = [
        compositor([ball((0, 0.3, 0), 0.3)], floor(), window_light(), integrator=integrator)
        for integrator in ("path", "direct")
    ]
    for job in jobs:
        job.add(64)
    path, direct = (job.result() for job in jobs)
    solid = path.alpha > 0.05
    assert np.abs(direct.depth / path.depth - 1)[solid].max() < 0.08


def test_shadow_of_a_ball_under_an_even_sky_is_its_form_factor() -> None:
    # irradiance blocked by a sphere above the horizon: (r / d)^2 cos (Howell, B-44)
    r, h = 0.3, 0.8
    plate = np.ones((SIZE[1], SIZE[0], 3), np.float32)
    view = view_from((0.0, 2.4, 0.5))
    job = compositor([ball((0, h, 0), r)], floor(), np.zeros((4, 8, 3), np.float32), "ao",
                     plate=plate, view=view)  # fmt: skip
    job.add(256)
    result = job.result()
    ground = result.alpha == 0
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    rays = view.rays(np.stack([x, y], axis=-1))
    o = view.world_from_camera.translation
    p = o + rays * (-o[1] / rays[..., 1:2])
    d = np.hypot(np.hypot(p[..., 0], p[..., 2]), h)
    expected = 1 - (r / d) ** 2 * (h / d)
    away = ground & (np.asarray(d) > 1.05 * h)
    error = result.quotient[..., 0][away] - expected[away]
    assert float(np.sqrt(np.mean(error**2))) < 6e-3
    assert abs(float(error.mean())) < 1e-3


def test_a_sun_loses_no_energy_and_throws_no_sparks() -> None:
    sky = np.full((64, 128, 3), 0.05, np.float32)
    sky[12, 70] = 1e5
    plate = np.ones((SIZE[1], SIZE[0], 3), np.float32)
    job = compositor([ball((0, 0.3, 0), 0.3)], floor(), sky, plate=plate)
    job.add(16)
    truth = compositor([ball((0, 0.3, 0), 0.3)], floor(), sky, "path", plate=plate)
    truth.add(1024)
    a, b = truth.result(), job.result()
    solid = (a.alpha == 1) & (b.alpha == 1)
    assert b.rgb[solid].mean() == pytest.approx(a.rgb[solid].mean(), rel=0.01)
    assert b.rgb.max() < 1.05 * a.rgb.max()
    ground = (a.alpha == 0) & (b.alpha == 0)
    assert b.quotient[ground].mean() == pytest.approx(a.quotient[ground].mean(), abs=4e-3)


def test_the_filter_lowers_the_error_and_gives_way_to_samples() -> None:
    objects = [ball((0.1, 0.25, 0.2), 0.25)]
    truth = compositor(objects, floor(), window_light(), seed=9)
    truth.add(1024)
    true = truth.picture()

    def error(samples: int, filtered: bool) -> float:
        job = compositor(objects, floor(), window_light(), filtered=filtered)
        job.add(samples)
        return float(np.sqrt(np.mean((job.picture() - true) ** 2)))

    assert error(4, True) < 0.6 * error(4, False)
    assert error(512, True) < 1.3 * error(512, False)


def test_the_error_that_is_said_is_the_error() -> None:
    objects = [ball((0.1, 0.25, 0.2), 0.25)]
    truth = compositor(objects, floor(), window_light(), seed=9)
    truth.add(1024)
    job = compositor(objects, floor(), window_light())
    job.add(32)
    result = job.result()
    true = np.abs(result.rgb - truth.picture()).mean(axis=2)[result.changed]
    said = result.standard_error[result.changed]
    assert 0.4 < float(np.sqrt(np.mean(true**2)) / np.sqrt(np.mean(said**2))) < 2


@pytest.mark.parametrize("kind", [Kind.MIRROR, Kind.GLASS])
def test_a_mirror_shows_the_set_and_glass_lets_light_through(kind: Kind) -> None:
    objects = [ball((0.1, 0.25, 0.2), 0.25, kind)]
    truth = compositor(objects, floor(), window_light(), "path")
    truth.add(256)
    job = compositor(objects, floor(), window_light(), seed=2)
    job.add(256)
    a, b = truth.result(), job.result()
    solid = (a.alpha == 1) & (b.alpha == 1)
    assert np.median(b.rgb[solid]) == pytest.approx(np.median(a.rgb[solid]), rel=6e-3)
    # the lamp's own picture is a point that few samples meet
    assert b.objects.sum() == pytest.approx(a.objects.sum(), rel=0.04)


def test_moving_an_object_is_building_it_there() -> None:
    pose = Pose.from_rotation_vector(np.array([0.0, 0.5, 0.0]), np.array([0.2, 0.1, 0.1]))
    vertices, faces, normals = box()
    block = Mesh.of(vertices * np.float32(0.3), faces, 0.5, normals=normals)
    moved = compositor([block], floor(), window_light())
    moved.add(2)
    moved.move(0, pose)
    moved.add(4)
    built = compositor([block.placed(pose)], floor(), window_light())
    built.add(4)
    difference = np.abs(moved.picture() - built.picture()).max(axis=2)
    assert float(np.quantile(difference, 0.98)) < 1e-3


def test_ambient_occlusion_needs_a_plate() -> None:
    with pytest.raises(UserError, match="plate"):
        compositor([], floor(), window_light(), "ao")


def test_threads_do_not_change_the_picture() -> None:
    program = (
        "import sys; sys.path.insert(0, 'tests/renderer')\n"
        "import hashlib, test_direct as t\n"
        "ball, light = t.ball((0, .3, 0), .3), t.window_light()\n"
        "j = t.compositor([ball], t.room(), light, filtered=True)\n"
        "j.add(3); j.add(5)\n"
        "print(hashlib.sha256(j.picture().tobytes()).hexdigest())"
    )
    found = {
        subprocess.run(
            [*prefix, sys.executable, "-c", program], capture_output=True, text=True, check=True
        ).stdout
        for prefix in ([], ["taskset", "-c", "0"])
    }
    assert len(found) == 1


@pytest.mark.parametrize("mode", ["quotient", "difference"])
def test_what_is_kept_and_what_is_added_make_the_picture(mode: str) -> None:
    plate = np.random.default_rng(0).uniform(0.1, 1, (SIZE[1], SIZE[0], 3)).astype(np.float32)
    job = compositor(
        [ball((0, 0.3, 0), 0.3)], floor(), window_light(), plate=plate, filtered=True, mode=mode
    )
    job.add(4)
    result = job.result()
    np.testing.assert_allclose(result.kept * plate + result.added, result.rgb, atol=2e-6)


def test_a_point_light_adds_what_path_says_and_its_shadow_is_sharp() -> None:
    lamp = DeltaLight((0.8, 1.2, 0.6), (1.5, 1.4, 1.0))
    objects = [ball((0.0, 0.3, 0.0), 0.25)]
    truth = compositor(objects, floor(), window_light(), "path", lights=[lamp])
    truth.add(512)
    job = compositor(objects, floor(), window_light(), lights=[lamp])
    job.add(64)
    a, b = truth.result(), job.result()
    assert b.objects.sum() == pytest.approx(a.objects.sum(), rel=0.01)
    ground = (a.alpha == 0) & (b.alpha == 0)
    assert a.quotient[ground].max() > 1.1
    assert b.quotient[ground].mean() == pytest.approx(a.quotient[ground].mean(), rel=4e-3)
    assert float(np.quantile(np.abs(b.quotient - a.quotient)[ground], 0.95)) < 0.04


def test_a_pane_and_a_cut_out_let_the_plate_through() -> None:
    v = np.array([[-0.5, 0.2, 0.6], [0.5, 0.2, 0.6], [0.5, 0.9, 0.6], [-0.5, 0.9, 0.6]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    pane = Material((0.9, 0.6, 0.3), roughness=0.0, transmission=1.0, thin=True)
    half = Material((0.8, 0.2, 0.2), specular=0.0, alpha=0.5, alpha_mode="blend")
    for material in (pane, half):
        mesh = Mesh.of(v, faces, material=material)
        truth = compositor([mesh], floor(), window_light(), "path")
        truth.add(256)
        job = compositor([mesh], floor(), window_light())
        job.add(128)
        a, b = truth.picture(), job.picture()
        changed = truth.result().changed
        assert changed.mean() > 0.1
        # what the pane mirrors onto the floor is left to path
        assert b[changed].mean(axis=0) == pytest.approx(a[changed].mean(axis=0), rel=0.02)
