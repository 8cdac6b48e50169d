"""Objects mirrored in glossy support surfaces (seeds P17)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Composite, Compositor, Gloss
from chromeball.renderer.core import World
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import sphere
from chromeball.renderer.world import triple, world
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import SUPPORT, StandInMesh

ORIGIN = np.array([0.0, 1.0, 0.0])
EYE = np.array([0.0, 0.9, 2.5])
SIZE = (64, 48)
VIEW = CameraModel.pinhole(SIZE, math.radians(45), Pose.look_at(EYE, np.array([0.0, 0, 0.5])))
CORNERS = np.array([[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], np.float32)
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
FLOOR = StandInMesh(CORNERS, CORNERS, QUAD, np.full(2, SUPPORT, np.uint8))
CENTRE, RADIUS = np.array([0.0, 0.6, 0.0]), 0.4


def ball(emission: float, radius: float = RADIUS, centre: NDArray[np.float64] = CENTRE) -> Mesh:
    vertices, faces, normals = sphere(48, 96)
    mesh = Mesh.of(vertices, faces, 0.0, emission, normals=normals)
    return mesh.placed(Pose(np.eye(3), centre - [0, radius, 0]), 2 * radius)


def composite(
    things: list[Mesh],
    sky: NDArray[np.float32],
    gloss: Gloss | None,
    samples: int = 32,
    plate: float = 0.0,
) -> Composite:
    job = Compositor(
        things,
        CapturedSet(sky, ORIGIN, FLOOR),
        corner_rays(VIEW),
        EYE,
        np.full((SIZE[1], SIZE[0], 3), plate, np.float32),
        samples=samples,
        gloss=gloss,
    )
    job.add(samples)
    return job.result()


def even(radiance: float) -> NDArray[np.float32]:
    return np.full((16, 32, 3), radiance, np.float32)


def rays() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places on the floor and directions to them, of each pixel's middle."""
    d = VIEW.rays(VIEW.pixel_grid())
    assert (d[..., 1] < 0).all()
    return EYE - d * (EYE[1] / d[..., 1])[..., None], d


def miss(o: NDArray[np.float64], d: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each ray from the ball's middle."""
    to = CENTRE - o
    along = np.maximum((to * d).sum(axis=-1), 0)
    return np.asarray(np.linalg.norm(to - along[..., None] * d, axis=-1))


def fresnel(reflectance: float, cos: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(reflectance + (1 - reflectance) * (1 - cos) ** 5)


def test_without_roughness_it_is_a_mirror() -> None:
    """Where the mirrored ray meets the ball Fresnel's share of the change is added."""
    r = composite([ball(5.0)], even(1.0), Gloss(0.3, 0.0))
    x, d = rays()
    mirrored = miss(x, d * [1, -1, 1])
    free = r.alpha == 0
    inside, outside = free & (mirrored < RADIUS - 0.03), free & (mirrored > RADIUS + 0.03)
    assert inside.sum() > 100
    expected = fresnel(0.3, -d[..., 1]) * (5 - 1)
    np.testing.assert_allclose(r.rgb[inside, 0], expected[inside], rtol=0.03)
    assert (r.objects[outside] == 0).all()
    np.testing.assert_allclose(r.rgb[inside], r.objects[inside], rtol=1e-5)


@pytest.mark.parametrize("roughness", [0.15, 0.4, 0.9])
def test_a_dome_that_shines_is_mirrored_by_the_albedo(roughness: float) -> None:
    """All directions see the object; the albedo is the surface's own, by quadrature."""
    dome = ball(2.0, 30.0, np.array([0.0, 0.0, 0.0]))
    r = composite([dome], even(0.5), Gloss(0.2, roughness), 64)
    assert (r.alpha[16:] == 0).all()
    _, d = rays()
    table = _varnished(0.2, roughness)
    for y, x in ((20, 10), (32, 32), (44, 50)):
        direction = d[y, x]
        got = r.rgb[y - 3 : y + 4, x - 3 : x + 4, 0].mean()
        assert got == pytest.approx(1.5 * _albedo(table, direction), rel=0.03)


def _varnished(reflectance: float, roughness: float) -> World:
    """A black floor with the same gloss, as an object of its own."""
    root = math.sqrt(reflectance)
    ior = (1 + root) / (1 - root)
    varnish = Material((0.0, 0.0, 0.0), metallic=0.0, roughness=roughness, ior=ior)
    return world([Mesh.of(CORNERS, QUAD, material=varnish)])


def _albedo(floor: World, d: NDArray[np.float64]) -> float:
    u, v = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(800) + 0.5) / 800)
    r, phi = np.sqrt(1 - u**2), 2 * math.pi * v
    wi = np.stack([r * np.cos(phi), u, r * np.sin(phi)], axis=-1).reshape(-1, 3)
    f = floor.evaluate((0.0, 1.0, 0.0), triple(d), wi.astype(np.float32))
    return float(f[:, 0, 0].mean() * 2 * math.pi)


def test_an_object_that_hides_a_lamp_takes_its_highlight() -> None:
    """The sun's lobe, f cos times its irradiance, is missing where the ball hides it."""
    sky = np.zeros((128, 256, 3), np.float32)
    row, column = 50, 0  # behind the ball as the camera sees it, towards -Z
    sky[row, column] = 4e3
    lat, lon = (0.5 - (row + 0.5) / 128) * math.pi, ((column + 0.5) / 256 - 0.5) * 2 * math.pi
    sun = np.array(
        [-math.sin(lon) * math.cos(lat), math.sin(lat), math.cos(lon) * math.cos(lat)]
    )
    r = composite([ball(0.0)], sky, Gloss(0.3, 0.3), 64, plate=50.0)
    x, d = rays()
    hidden = (miss(x, np.broadcast_to(sun, x.shape)) < RADIUS - 0.06) & (r.alpha == 0)
    assert hidden.sum() > 30
    table = _varnished(0.3, 0.3)
    texel = (2 * math.pi / 256) * (math.pi / 128) * math.cos(lat)
    to_sun = sun[None].astype(np.float32)
    f = [
        table.evaluate((0.0, 1.0, 0.0), triple(d[y, k]), to_sun)[0, 0, 0]
        for y, k in np.argwhere(hidden)
    ]
    expected = -4e3 * texel * np.array(f)
    got = r.objects[hidden, 0]
    assert expected.min() < -1
    np.testing.assert_allclose(got, expected, rtol=0.1, atol=0.02 * abs(expected.min()))


def test_what_mirrors_nothing_keeps_its_bits() -> None:
    rng = np.random.default_rng(0)
    plate = rng.uniform(0.1, 1, (SIZE[1], SIZE[0], 3)).astype(np.float32)
    small = [ball(3.0, 0.05, np.array([0.0, 0.06, -1.0]))]
    found: list[Composite] = []
    for gloss in (None, Gloss(0.04, 0.0)):
        job = Compositor(
            small,
            CapturedSet(even(1.0), ORIGIN, FLOOR),
            corner_rays(VIEW),
            EYE,
            plate,
            samples=16,
            gloss=gloss,
        )
        job.add(16)
        found.append(job.result())
    plain, glossy = found
    differs = (plain.rgb != glossy.rgb).any(axis=2)
    assert 0 < (differs & (plain.alpha == 0)).sum() < 0.05 * differs.size
    away = ~glossy.changed
    assert (glossy.rgb[away] == plate[away]).all()


def test_gloss_is_refused_where_it_would_not_be_shown() -> None:
    with pytest.raises(UserError, match="take path"):
        Compositor(
            [],
            CapturedSet(even(1.0), ORIGIN, FLOOR),
            corner_rays(VIEW),
            EYE,
            integrator="direct",
            gloss=Gloss(),
        )
    with pytest.raises(UserError, match=r"0 to 0\.9"):
        Gloss(1.0)
    with pytest.raises(UserError, match="0 to 1"):
        Gloss(0.1, -1.0)
