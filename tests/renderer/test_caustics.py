"""Light that mirrors and glass throw onto the set, by photons: closed forms and two routes."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Composite, Compositor
from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import box, sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT, StandInMesh
from tests.renderer.threads import printed_by_threads

ORIGIN = np.array([0.0, 1.0, 0.0])
EYE = np.array([0.0, 3.0, 0.01])
SIZE = (64, 48)
#: looks straight down at the floor
VIEW = CameraModel.pinhole(SIZE, 1.0, Pose.look_at(EYE, np.zeros(3)))
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
CORNERS = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
FLOOR = StandInMesh(5 * CORNERS, 5 * CORNERS, QUAD, np.full(2, SUPPORT, np.uint8))
H, W = 128, 256


def sky(lamp: float, row: int = 24, column: int = 64, size: int = 1) -> NDArray[np.float32]:
    """A dim sky with a lamp towards +X, 57 degrees up for row 24."""
    dim = np.full((H, W, 3), 0.02, np.float32)
    dim[row : row + size, column : column + size] = lamp
    return dim


def slab(kind: Kind, at: tuple[float, float, float], size: tuple[float, float, float]) -> Mesh:
    vertices, faces, _ = box()
    mesh = Mesh.of(vertices, faces, 0.9 if kind is Kind.MIRROR else 1.0, kind=kind, ior=1.5)
    return mesh.placed(Pose(np.eye(3), np.array(at)), size)


def ball(kind: Kind, centre: tuple[float, float, float], radius: float) -> Mesh:
    vertices, faces, normals = sphere()
    mesh = Mesh.of(vertices, faces, 1.0, kind=kind, ior=1.5, normals=normals)
    at = np.array(centre) - np.array([0, radius, 0])
    return mesh.placed(Pose(np.eye(3), at), 2 * radius)


def composite(
    objects: list[Mesh],
    environment: NDArray[np.float32],
    samples: int,
    *,
    photons: float = 0.25,
    stand_in: StandInMesh = FLOOR,
    lights: tuple[DeltaLight, ...] = (),
    seed: int = 0,
    bounces: int = 4,
) -> Composite:
    job = Compositor(
        objects,
        CapturedSet(environment, ORIGIN, stand_in),
        corner_rays(VIEW),
        EYE,
        np.full((SIZE[1], SIZE[0], 3), 0.3, np.float32),
        samples=samples,
        lights=lights,
        photons=photons,
        seed=seed,
        bounces=bounces,
    )
    job.add(samples)
    return job.result()


def where(x: tuple[float, float], z: tuple[float, float]) -> NDArray[np.bool_]:
    """The pixels that show this part of the floor."""
    d = VIEW.rays(VIEW.pixel_grid())
    p = EYE + d * (-EYE[1] / d[..., 1])[..., None]
    inside = (p[..., 0] > x[0]) & (p[..., 0] < x[1]) & (p[..., 2] > z[0]) & (p[..., 2] < z[1])
    assert inside.sum() > 20
    return np.asarray(inside)


def test_a_flat_mirror_throws_the_sun_s_own_irradiance() -> None:
    """An upright mirror sends the sun down as steeply as it came: 0.9 of it once more."""
    mirror = slab(Kind.MIRROR, (-0.5, 0, 0), (0.02, 1, 1))
    q = composite([mirror], sky(3e4), 32).quotient
    # 57 degrees up: the spot reaches 0.64 m before the mirror
    lit = where((-0.35, -0.05), (-0.4, 0.4))
    assert q[lit].mean() == pytest.approx(1.9, abs=0.02)
    assert q[lit].std() < 0.25
    assert q[where((0.5, 1.2), (-0.5, 0.5))].mean() == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("by_map", [True, False])
def test_a_pane_lets_through_what_fresnel_says(by_map: bool) -> None:
    """At normal incidence 2 n / (n^2 + 1), all reflections between its faces counted."""
    pane = slab(Kind.GLASS, (0, 0.9, 0), (1, 0.05, 1))
    environment = np.full((H, W, 3), 1e-3, np.float32)
    lights: tuple[DeltaLight, ...] = ()
    expected = 2 * 1.5 / (1.5**2 + 1)
    if by_map:
        environment[0] = 2e5
    else:
        down = (0.0, -1.0, 0.0)
        lights = (DeltaLight(None, (50.0, 50.0, 50.0), down),)
    shadow = Compositor(
        [pane],
        CapturedSet(environment, ORIGIN, FLOOR),
        corner_rays(VIEW.posed(_low())),
        _low().translation,
        np.full((SIZE[1], SIZE[0], 3), 0.3, np.float32),
        samples=32,
        lights=lights,
        photons=2.0,
        bounces=0,  # the floor does not light the pane
    )
    shadow.add(32)
    q = shadow.result().quotient[12:36, 20:44].mean()
    if by_map:
        assert q == pytest.approx(expected, abs=0.02)
    else:  # beside what the dim sky gives
        without = shadow.irradiance(np.array([0, 1e-3, 0]), np.array([0.0, 1.0, 0.0])).mean()
        assert (q - 1) * without == pytest.approx(50 * expected, rel=0.02)


def _low() -> Pose:
    """Below the pane, looking at the floor."""
    return Pose.look_at(np.array([0.0, 0.8, 0.01]), np.zeros(3))


def test_a_point_light_in_a_mirror_is_its_image() -> None:
    """The image stands as far behind the mirror: intensity times cosine over distance^2."""
    mirror = slab(Kind.MIRROR, (-0.5, 0, 0), (0.02, 1, 1))
    lamp = DeltaLight((0.5, 1.0, 0.0), (3.0, 3.0, 3.0), (0.0, -1.0, 0.0))
    env = np.full((H, W, 3), 0.01, np.float32)
    job_q = composite([mirror], env, 32, lights=(lamp,), bounces=0, photons=4.0).quotient
    spot = where((0, 0.4), (-0.3, 0.3))
    p = _on_floor(VIEW, EYE, VIEW.pixel_grid())[spot]
    own = 3 / (1 + (p[:, 0] - 0.5) ** 2 + p[:, 1] ** 2) ** 1.5
    image = 0.9 * 3 / (1 + (p[:, 0] + 1.48) ** 2 + p[:, 1] ** 2) ** 1.5
    sky = math.pi * 0.01
    got = (job_q[spot].mean(axis=1) - 1) * sky
    assert got.mean() == pytest.approx((own + image).mean(), rel=0.01)


def _sets() -> dict[str, StandInMesh]:
    ceiling = 5 * CORNERS + np.array([0, 4, 0], np.float32)
    v = np.concatenate([FLOOR.vertices, ceiling]).astype(np.float32)
    faces = np.concatenate([QUAD, QUAD + 4])
    kinds = np.array([SUPPORT] * 2 + [ENVIRONMENT] * 2, np.uint8)
    return {"far": FLOOR, "ceiling": StandInMesh(v, v, faces, kinds)}


@pytest.mark.parametrize("place", ["far", "ceiling"])
@pytest.mark.parametrize("kind", [Kind.MIRROR, Kind.GLASS])
def test_photons_find_what_paths_from_the_set_find(kind: Kind, place: str) -> None:
    """A wide lamp, where both converge."""
    environment = sky(4.0, 16, 56, 20)
    stand_in = _sets()[place]
    thing = [ball(kind, (0, 0.4, 0), 0.3)]
    old = composite(thing, environment, 256, photons=0.0, stand_in=stand_in)
    new = composite(thing, environment, 64, stand_in=stand_in, seed=3)
    for x, z in (((-1.5, 1.5), (-1.1, 1.1)), ((-0.9, -0.4), (-0.3, 0.3)), ((0, 1), (-1, 1))):
        part = where(x, z) & (old.alpha == 0) & (new.alpha == 0)
        count = part.sum()
        noise = np.hypot(*(np.sqrt((r.standard_error[part] ** 2).sum()) for r in (old, new)))
        apart = (new.rgb[part] - old.rgb[part]).mean(axis=1).sum()
        mean = old.rgb[part].mean(axis=1).sum()
        assert count > 20
        assert noise < 0.01 * mean
        assert abs(apart) < 4 * noise + 2e-3 * mean


def test_photons_leave_far_less_noise() -> None:
    thing, environment = [ball(Kind.GLASS, (0, 0.4, 0), 0.3)], sky(2e3, 24, 64, 2)
    truth = composite(thing, environment, 128, seed=7)
    spot = where((-0.9, -0.1), (-0.4, 0.4)) & (truth.alpha == 0)
    runs = [composite(thing, environment, 16, photons=n).rgb for n in (0.0, 0.25)]
    error = [np.sqrt(((rgb - truth.rgb)[spot] ** 2).mean()) for rgb in runs]
    assert error[1] < 0.2 * error[0]


def test_photons_of_a_lamp_among_the_objects() -> None:
    corners = (0.15 * CORNERS + np.array([0.3, 1.2, 0])).astype(np.float32)
    lamp = Mesh.of(corners, QUAD, 0.0, 30.0)
    things = [ball(Kind.GLASS, (0, 0.4, 0), 0.25), lamp]
    environment = np.full((H, W, 3), 0.2, np.float32)
    old = composite(things, environment, 256, photons=0.0)
    new = composite(things, environment, 64, seed=2)
    part = where((-0.6, 0.6), (-0.6, 0.6)) & (old.alpha == 0) & (new.alpha == 0)
    noise = np.hypot(*(np.sqrt((r.standard_error[part] ** 2).sum()) for r in (old, new)))
    mean = old.rgb[part].mean(axis=1).sum()
    apart = (new.rgb[part] - old.rgb[part]).mean(axis=1).sum()
    assert abs(apart) < 4 * noise + 2e-3 * mean
    assert noise < 0.02 * mean


def test_a_glass_ball_gathers_the_flux_that_its_rays_carry() -> None:
    """Under a sun overhead; the flux on a disc below against rays traced in its plane."""
    eye, reach, radius, height = np.array([0.0, 1.6, 2.2]), 0.4, 0.3, 0.8
    view = CameraModel.pinhole((96, 96), 0.4, Pose.look_at(eye, np.zeros(3)))
    sun = DeltaLight(None, (10.0, 10.0, 10.0))
    job = Compositor(
        [ball(Kind.GLASS, (0, height, 0), radius)],
        CapturedSet(np.full((H, W, 3), 1e-3, np.float32), ORIGIN, FLOOR),
        corner_rays(view),
        eye,
        np.full((96, 96, 3), 0.3, np.float32),
        samples=32,
        lights=(sun,),
        bounces=0,
    )
    job.add(32)
    grid = view.pixel_grid()
    x = _on_floor(view, eye, grid)
    u, v = (_on_floor(view, eye, grid + np.array(o)) - x for o in ((1, 0), (0, 1)))
    area = np.abs(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
    disc = (x**2).sum(axis=2) < reach**2
    assert area[disc].sum() == pytest.approx(math.pi * reach**2, rel=0.01)
    r = job.result()
    assert (r.alpha[disc] == 0).all()
    E = job.irradiance(np.array([0, 1e-3, 0]), np.array([0.0, 1.0, 0.0])).mean()
    flux = ((r.quotient.mean(axis=2) - 1) * E * area)[disc].sum()
    open_sky = 10 * math.pi * (reach**2 - radius**2)
    within = 10 * math.pi * radius**2 * _through_ball(1.5, radius, height, reach)
    assert within > 0.5 * open_sky
    assert flux - open_sky == pytest.approx(within, rel=0.03)


def _on_floor(
    view: CameraModel, eye: NDArray[np.float64], pixel: NDArray[np.float64]
) -> NDArray[np.float64]:
    d = view.rays(pixel)
    return np.asarray((eye - d * (eye[1] / d[..., 1])[..., None])[..., [0, 2]])


def _through_ball(n: float, radius: float, height: float, reach: float) -> float:
    """The share of light from above that a glass ball sends to a disc on the floor below it."""
    b = np.sqrt((np.arange(200000) + 0.5) / 200000)  # equal areas of the beam
    i = np.arcsin(b)
    t = np.arcsin(b / n)
    s = (np.cos(i) - n * np.cos(t)) / (np.cos(i) + n * np.cos(t))
    p = (n * np.cos(i) - np.cos(t)) / (n * np.cos(i) + np.cos(t))
    R = 0.5 * (s**2 + p**2)
    share, total = (1 - R) ** 2, np.zeros_like(b)
    # angles from straight up, of the place on the ball and of the way the light goes
    place, way = math.pi + i - 2 * t, math.pi + 2 * (i - t)
    for _ in range(6):
        down = np.cos(way) < -1e-6
        fall = height + radius * np.cos(place)
        at = radius * np.sin(place) + fall * np.where(down, np.sin(way) / -np.cos(way), 0)
        total += np.where(down & (np.abs(at) < reach), share, 0)
        share, place, way = share * R, place + math.pi - 2 * t, way + math.pi - 2 * t
    return float(total.mean())


def test_pictures_with_photons_do_not_depend_on_threads_nor_passes() -> None:
    thing = [ball(Kind.GLASS, (0, 0.4, 0), 0.3)]
    script = (
        "import sys, hashlib\n"
        f"sys.path.insert(0, {os.path.dirname(__file__)!r})\n"
        "from test_caustics import *\n"
        "r = composite([ball(Kind.GLASS, (0, 0.4, 0), 0.3)], sky(3e4), 3)\n"
        "print(hashlib.sha1(r.rgb.tobytes()).hexdigest())\n"
    )
    assert len(printed_by_threads(script)) == 1
    runs: list[bytes] = []
    for passes in ([20], [4, 16], [16, 4]):
        job = Compositor(
            thing,
            CapturedSet(sky(3e4), ORIGIN, FLOOR),
            corner_rays(VIEW),
            EYE,
            np.full((SIZE[1], SIZE[0], 3), 0.3, np.float32),
            samples=32,
        )
        for count in passes:
            job.add(count)
        runs.append(job.result().rgb.tobytes())
    assert runs[0] == runs[1] == runs[2]


def test_a_moved_mirror_throws_its_light_elsewhere() -> None:
    vertices, faces, _ = box()
    mirror = Mesh.of(vertices, faces, 0.9, kind=Kind.MIRROR)
    there = Pose(np.eye(3), np.array([0.4, 0, 0.3]))
    options = (CapturedSet(sky(3e4), ORIGIN, FLOOR), corner_rays(VIEW), EYE)
    plate = np.full((SIZE[1], SIZE[0], 3), 0.3, np.float32)
    moved = Compositor([mirror], *options, plate, samples=8)
    moved.add(2)
    moved.move(0, there, (0.02, 1, 1))
    fresh = Compositor([mirror.placed(there, (0.02, 1, 1))], *options, plate, samples=8)
    for job in (moved, fresh):
        job.add(8)
    lit = where((0.65, 0.95), (0, 0.6))
    for job in (moved, fresh):
        assert job.result().quotient[lit].mean() == pytest.approx(1.9, abs=0.05)
    np.testing.assert_allclose(
        moved.result().quotient[lit].mean(), fresh.result().quotient[lit].mean(), rtol=0.02
    )
