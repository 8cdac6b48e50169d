"""The captured set as material of the picture: real things removed, geometry moved."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Composite, Compositor, Integrator
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import box, sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT, StandInMesh

ORIGIN = np.array([0.0, 1.0, 0.0])
EYE = np.array([0.0, 1.4, 3.0])
VIEW = CameraModel.pinhole(
    (48, 36), math.radians(45), Pose.look_at(EYE, np.array([0.0, 0.3, 0.0]))
)
CORNERS = np.array([[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], np.float32)
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
FLOOR = StandInMesh(CORNERS, CORNERS, QUAD, np.full(2, SUPPORT, np.uint8))


@pytest.mark.parametrize("integrator", ["path", "direct"])
@pytest.mark.parametrize("shape", [box, sphere])
def test_a_real_thing_that_a_synthetic_one_covers_is_gone(
    integrator: Integrator, shape: object
) -> None:
    """Seeds F7: it has no stand-in, so nothing of it comes through where it is covered.

    Whatever the photograph shows there, the covered pixels are the same, bit for bit; of it
    that looks out from behind the object the photograph remains.
    """
    vertices, faces, normals = box() if shape is box else sphere()
    thing = Mesh.of(vertices, faces, 0.6, normals=normals)
    sky = np.full((16, 32, 3), 0.7, np.float32)
    rng = np.random.default_rng(3)
    plain = np.full((36, 48, 3), 0.4, np.float32)
    busy = plain.copy()
    busy[8:30, 14:38] = rng.uniform(0, 30, (22, 24, 3)).astype(np.float32)  # a shiny real thing
    found: list[Composite] = []
    for plate in (plain, busy):
        job = Compositor(
            [thing],
            CapturedSet(sky, ORIGIN, FLOOR),
            corner_rays(VIEW),
            EYE,
            plate,
            integrator=integrator,
            samples=32,
        )
        job.add(32)
        found.append(job.result())
    covered = found[0].alpha == 1
    assert 100 < covered.sum() < covered.size / 2
    np.testing.assert_array_equal(found[0].rgb[covered], found[1].rgb[covered])
    outside = (found[1].alpha == 0) & (busy != plain).any(axis=2)
    assert outside.any()
    quotient = found[0].rgb[outside] / plain[outside]
    np.testing.assert_allclose(found[1].rgb[outside], busy[outside] * quotient, rtol=1e-4)


def test_moved_geometry_gives_the_light_it_was_captured_with() -> None:
    """Seeds F8, two routes: a wall that was moved, and a map captured after it was moved.

    The wall carries a bright patch and a dark one. It is turned and brought nearer; the second
    set stands there from the beginning, and its map is what the first looks like from the
    probe's place.
    """
    wall = np.array([[-2, 0, -3], [2, 0, -3], [2, 3, -3], [-2, 3, -3]], np.float32)
    turned = Pose.from_rotation_vector(np.array([0.0, 0.35, 0.0]), np.array([0.4, 0.2, 1.2]))
    there = turned.apply(wall.astype(float)).astype(np.float32)
    faces = np.concatenate([QUAD, QUAD + 4])
    kinds = np.array([SUPPORT] * 2 + [ENVIRONMENT] * 2, np.uint8)
    sky = np.full((256, 512, 3), 0.3, np.float32)
    latlong = CameraModel.latlong((512, 256))
    x, y = np.meshgrid(np.arange(512.0), np.arange(256.0))
    d = latlong.rays(np.stack([x, y], axis=-1))
    on_wall = ORIGIN + d * (-3 / np.where(d[..., 2] < 0, d[..., 2], -1e-9))[..., None]
    inside = (
        (d[..., 2] < 0) & (np.abs(on_wall[..., 0]) < 2) & (np.abs(on_wall[..., 1] - 1.5) < 1.5)
    )
    sky[inside & (on_wall[..., 0] < 0)] = [9, 6, 3]
    sky[inside & (on_wall[..., 0] >= 0)] = 0.05
    moved = StandInMesh(
        np.concatenate([CORNERS, there]), np.concatenate([CORNERS, wall]), faces, kinds
    )
    rays = corner_rays(latlong.posed(Pose(latlong.world_from_camera.rotation, ORIGIN)))
    seen = Compositor([], CapturedSet(sky, ORIGIN, moved), rays, ORIGIN, plate_samples=16).plate
    fixed = StandInMesh(moved.vertices, moved.vertices, faces, kinds)
    thing = Mesh.of(*box()[:2], material=Material.diffuse((0.5, 0.5, 0.5)))
    results: list[NDArray[np.float32]] = []
    light: list[NDArray[np.float64]] = []
    for captured in (CapturedSet(sky, ORIGIN, moved), CapturedSet(seen, ORIGIN, fixed)):
        plate = np.full((36, 48, 3), 0.5, np.float32)
        job = Compositor([thing], captured, corner_rays(VIEW), EYE, plate, samples=256)
        points = [np.array([px, 0.0, -0.8]) for px in (-1.0, 0.0, 1.0)]
        light.append(np.stack([job.irradiance(p, np.array([0.0, 1.0, 0.0])) for p in points]))
        job.add(256)
        results.append(job.result().rgb)
    # the solver's few hundred samples are right to a few per cent
    exact = np.stack([_wall_light(turned, p) for p in points])
    np.testing.assert_allclose(light[0], exact, rtol=0.05)
    np.testing.assert_allclose(light[1], exact, rtol=0.05)
    assert np.abs(results[0] - results[1]).mean() / results[1].mean() < 0.02
    assert results[0].mean() / results[1].mean() == pytest.approx(1, abs=0.01)


def _wall_light(pose: Pose, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The irradiance (3,) of a floor's point, by quadrature over the hemisphere."""
    u, v = np.meshgrid(*[(np.arange(1200) + 0.5) / 1200] * 2)
    r, phi = np.sqrt(u), 2 * math.pi * v
    d = np.stack([r * np.cos(phi), np.sqrt(1 - u), r * np.sin(phi)], axis=-1) @ pose.rotation
    o = pose.rotation.T @ (x - pose.translation)
    t = (-3 - o[2]) / d[..., 2]
    q = o + t[..., None] * d
    wall = (t > 0) & (np.abs(q - [0, 1.5, -3]) < [2, 1.5, 1]).all(axis=-1)
    left = q[..., 0] < 0
    radiance = np.full(d.shape, 0.3)
    radiance[wall & left], radiance[wall & ~left] = [9, 6, 3], 0.05
    return math.pi * radiance.mean(axis=(0, 1))
