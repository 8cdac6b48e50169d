"""Point, spot and sun: what they add to the set and to objects, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Composite, Compositor
from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.lights import delta_lights
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.manifest import parse_scene
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import StandInMesh

SIZE = (48, 36)
CORNERS = np.array([[-6, 0, 6], [6, 0, 6], [6, 0, -6], [-6, 0, -6]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
FLOOR = StandInMesh(CORNERS, CORNERS, FACES, np.zeros(2, np.uint8))
#: Over a floor alone an even sky of 1 gives an irradiance of pi.
SKY = np.ones((8, 16, 3), np.float32)
EYE = np.array([0.0, 2.0, 4.0])
CAMERA = CameraModel.pinhole(
    SIZE, math.radians(50), Pose.look_at(EYE, np.array([0.0, 0.2, 0.0]))
)
PLATE = np.random.default_rng(7).uniform(0.2, 1, (SIZE[1], SIZE[0], 3)).astype(np.float32)
LAMP = DeltaLight((0.3, 1.5, 0.2), (4.0, 2.0, 1.0))


def composite(
    objects: list[Mesh], lights: list[DeltaLight], spp: int = 64, floor: StandInMesh = FLOOR
) -> Composite:
    captured = CapturedSet(SKY, np.array([0.0, 1.0, 0.0]), floor)
    job = Compositor(
        objects, captured, corner_rays(CAMERA), EYE, PLATE, lights=lights, samples=spp
    )
    job.add(spp)
    return job.result()


def floor_points() -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where the pixels' centres meet the floor, (H, W, 3), and which do."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    d = CAMERA.rays(np.stack([x, y], axis=-1).astype(float))
    t = -EYE[1] / np.where(d[..., 1] < 0, d[..., 1], -1e-9)
    points = EYE + t[..., None] * d
    return points, (d[..., 1] < 0) & (np.abs(points[..., [0, 2]]).max(axis=-1) < 5.5)


@pytest.mark.parametrize(
    "light",
    [
        LAMP,
        DeltaLight((0.3, 1.5, 0.2), (4.0, 2.0, 1.0), (0.0, -1.0, 0.0), 0.95, 0.8),
        DeltaLight(None, (0.5, 1.0, 2.0), (0.6, -0.8, 0.0)),
    ],
    ids=["point", "spot", "sun"],
)
def test_a_light_brightens_the_floor_as_its_irradiance_says(light: DeltaLight) -> None:
    """Q = 1 + E cos / pi, without noise, and the sky's pixels keep their bits."""
    found = composite([], [light])
    points, on_floor = floor_points()
    if light.position is None:
        cosine = np.full(points.shape[:2], 0.8)
    else:
        to = np.array(light.position) - points
        cosine = to[..., 1] / np.linalg.norm(to, axis=-1)
    expected = 1 + light.irradiance(points) * cosine[..., None] / math.pi
    # the mean over a pixel differs a little from its centre
    np.testing.assert_allclose(
        found.quotient[on_floor], expected[on_floor], rtol=0.02, atol=0.01
    )
    above = ~on_floor & (points[..., 2] > 0)
    np.testing.assert_array_equal(found.rgb[:5], PLATE[:5])
    assert not above.any() or not found.changed[above].any()


def test_shadows_and_lit_objects_are_those_of_the_path_tracer() -> None:
    """The same floor and ball as triangles, all of them synthetic there."""
    vertices, faces, normals = sphere(48, 96)
    ball = Mesh.of(vertices * 0.8, faces, 0.6, normals=normals)
    wide = 50 * CORNERS
    floor = Mesh.of(wide, FACES, 0.5)
    rays = corner_rays(CAMERA)
    both = Mesh.join([floor, ball])
    with_ = path_trace(both, rays, EYE, spp=1024, environment=SKY, lights=[LAMP])
    without = path_trace(floor, rays, EYE, spp=256, environment=SKY)
    _, on_floor = floor_points()
    light = np.full((256, 512, 3), 0.5, np.float32)  # the floor's own radiance, below
    light[:128] = 1
    set_ = StandInMesh(wide, wide, FACES, np.zeros(2, np.uint8))
    captured = CapturedSet(light, np.array([0.0, 1.0, 0.0]), set_)
    job = Compositor([ball], captured, rays, EYE, without, lights=[LAMP], samples=256)
    job.add(256)
    found = job.result()
    inside = on_floor & (found.alpha == 0)
    assert found.rgb[inside].mean() / with_[inside].mean() == pytest.approx(1, abs=0.002)
    np.testing.assert_allclose(found.rgb[inside], with_[inside], rtol=0.06)
    on_ball = found.alpha == 1
    assert on_ball.sum() > 20
    assert found.rgb[on_ball].mean() / with_[on_ball].mean() == pytest.approx(1, abs=0.005)


def test_the_set_stands_in_the_way_of_a_lamp_and_only_support_in_that_of_a_sun() -> None:
    """A wall at x = 1 between light and floor; a wall that only emits stops no sun."""
    wall = np.array([[1, 0, -6], [1, 0, 6], [1, 5, 6], [1, 5, -6]], np.float32)
    vertices = np.concatenate([CORNERS, wall])
    faces = np.concatenate([FACES, FACES + 4])
    sun = DeltaLight(None, (1.0, 1.0, 1.0), (-0.8, -0.6, 0.0))
    lamp = DeltaLight((3.0, 2.0, 0.0), (9.0, 9.0, 9.0))
    points, on_floor = floor_points()
    left = on_floor & (points[..., 0] < 0.8) & (points[..., 0] > -2)
    for surface, light, lit in (
        (0, sun, False),
        (1, sun, True),
        (0, lamp, False),
        (1, lamp, False),
    ):
        kinds = np.array([0, 0, surface, surface], np.uint8)
        set_ = StandInMesh(vertices, vertices, faces, kinds)
        found = composite([], [light], 8, set_)
        assert (found.quotient[left].max() > 1.01) == lit
        assert (found.quotient[left].min() > 1.01) == lit


def test_lights_can_be_replaced_with_the_objects() -> None:
    captured = CapturedSet(SKY, np.array([0.0, 1.0, 0.0]), FLOOR)
    job = Compositor([], captured, corner_rays(CAMERA), EYE, PLATE, lights=[LAMP])
    job.add(4)
    lit = job.result().rgb
    job.place([])
    job.add(4)
    np.testing.assert_array_equal(job.result().rgb, lit)
    job.place([], [])
    job.add(4)
    np.testing.assert_array_equal(job.result().rgb, PLATE)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.01, 89), st.floats(0, 1), st.floats(0, 180))
def test_a_spot_is_full_inside_dark_outside_and_falls_in_between(
    angle: float, share: float, off: float
) -> None:
    inner = angle * share
    text = (
        'name = "s"\n[[light]]\nname = "l"\nkind = "spot"\nposition = [1, 2, 3]\n'
        "look_at = [1, 2, 8]\nintensity = [3, 3, 3]\n"
        f"angle = {angle!r}\ninner_angle = {inner!r}\n"
    )
    (light,) = delta_lights(parse_scene(text))
    t = math.radians(off)
    x = np.array([1, 2, 3]) + 2 * np.array([math.sin(t), 0, math.cos(t)])
    E = light.irradiance(x[None])[0, 0]
    assert 0 <= E <= 0.75 * (1 + 1e-9)
    if off < inner - 0.01:
        assert pytest.approx(0.75) == E
    if off > angle + 0.01:
        assert E == 0
