"""Surfaces: furnace by two routes, reciprocity, densities, closed forms of glass and coats."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer import core
from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.material import Material, Texture
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import sphere
from chromeball.renderer.world import world
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

WHITE = (1.0, 1.0, 1.0)
#: One of every kind that loses nothing.
LOSSLESS = {
    "diffuse": Material.diffuse(WHITE),
    "mirror": Material.mirror(WHITE),
    "metal": Material(WHITE, metallic=1.0, roughness=0.5),
    "rough metal": Material(WHITE, metallic=1.0, roughness=1.0),
    "plastic": Material(WHITE, roughness=0.4),
    "polished plastic": Material(WHITE, roughness=0.0),
    "rough plastic": Material(WHITE, roughness=1.0, ior=1.8),
    "half metal": Material(WHITE, metallic=0.5, roughness=0.3),
    "coated": Material(WHITE, roughness=0.8, clearcoat=1.0),
    "rough coat": Material(WHITE, roughness=0.3, clearcoat=0.6, clearcoat_roughness=0.5),
    "coated metal": Material(WHITE, metallic=1.0, roughness=0.2, clearcoat=1.0),
    "glass": Material.glass(WHITE),
    "frosted glass": Material(WHITE, roughness=0.5, transmission=1.0),
    "rough glass": Material(WHITE, roughness=0.9, transmission=1.0, ior=1.7),
    "part glass": Material(WHITE, roughness=0.4, transmission=0.4),
    "thin glass": Material(WHITE, roughness=0.0, transmission=1.0, thin=True),
    "frosted sheet": Material(WHITE, roughness=0.6, transmission=1.0, thin=True),
    "part thin": Material(WHITE, roughness=0.0, transmission=0.5, thin=True),
}
LOSSY = {
    "red plastic": Material((0.8, 0.2, 0.1), roughness=0.35),
    "gold": Material((0.9, 0.6, 0.2), metallic=1.0, roughness=0.45),
    "car": Material(
        (0.3, 0.05, 0.05), metallic=0.4, roughness=0.5, clearcoat=1.0, clearcoat_roughness=0.1
    ),
}
ANGLES = (0.05, 0.4, 0.8, 1.2, 1.45)


def floor(material: Material) -> core.World:
    """The plane y = 0 of that material."""
    v = np.array([[-9, 0, 9], [9, 0, 9], [9, 0, -9], [-9, 0, -9]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return world([Mesh.of(v, faces, material=material)])


def towards(angle: float, turn: float = 0.3) -> NDArray[np.float64]:
    """The direction that leaves the floor at an angle from its normal."""
    s = math.sin(angle)
    return np.array([s * math.cos(turn), math.cos(angle), s * math.sin(turn)])


def triple(v: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def evaluate(
    built: core.World, wo: NDArray[np.float64], wi: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """F cos (N, 3) and density (N,)."""
    out = built.evaluate(triple(wo), triple(-wo), np.ascontiguousarray(wi, np.float32))[:, 0]
    return out[:, :3].astype(float), out[:, 3].astype(float)


def grid(n: int = 600) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions over the sphere, finest about its poles, and their solid angles (N, 1)."""
    polar = (np.arange(n) + 0.5) / n * math.pi
    phi = (np.arange(n) + 0.5) / n * 2 * math.pi
    polar, phi = (a.ravel() for a in np.meshgrid(polar, phi, indexing="ij"))
    r = np.sin(polar)
    area = 2 * math.pi / n * 2 * math.sin(math.pi / (2 * n)) * r
    return np.stack([r * np.cos(phi), np.cos(polar), r * np.sin(phi)], axis=1), area[:, None]


def certain(material: Material) -> bool:
    """Whether a part of the light goes in certain directions, which no quadrature sees."""
    coat = material.clearcoat > 0 and material.clearcoat_roughness < 0.02
    return (material.roughness < 0.02 and material.specular + material.metallic > 0) or coat


def sampled(built: core.World, wo: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """All light sent to `wo` out of an even white world, by sampling; passing light too."""
    rows = built.scatter(triple(wo), triple(-wo), count, 1)[:, 0].astype(float)
    pass_ = built.transmittance(np.array([wo], np.float32), np.array([-wo], np.float32))[0, 0]
    return rows[:, 3:6].mean(axis=0) + pass_


@pytest.mark.parametrize("name", LOSSLESS)
def test_a_white_furnace_gets_all_its_energy_back(name: str) -> None:
    material = LOSSLESS[name]
    built = floor(material)
    # a coat over gloss takes what it takes on the darker of both ways: no more than this
    loss = 0.045 if material.clearcoat else 0.01
    for angle in ANGLES:
        wo = towards(angle)
        albedo = sampled(built, wo, 16384)
        assert 1 - loss < albedo.min(), angle
        assert albedo.max() < 1.005, angle
        if not certain(material) and material.roughness > 0.2:
            wi, area = grid()
            f, _ = evaluate(built, wo, wi)
            np.testing.assert_allclose((f * area).sum(0), albedo, atol=0.01)


@pytest.mark.parametrize("inside", [0.05, 0.5, 0.7])
@pytest.mark.parametrize("roughness", [0.0, 0.3, 0.8])
def test_glass_loses_nothing_from_inside_either(inside: float, roughness: float) -> None:
    built = floor(Material(WHITE, roughness=roughness, transmission=1.0))
    wo = towards(inside) * [1, -1, 1]
    albedo = sampled(built, wo, 16384)
    np.testing.assert_allclose(albedo, 1, atol=0.012)


@pytest.mark.parametrize("name", LOSSY)
def test_no_surface_gives_more_than_it_gets(name: str) -> None:
    built = floor(LOSSY[name])
    for angle in ANGLES:
        albedo = sampled(built, towards(angle), 4096)
        assert albedo.min() > 0
        assert albedo.max() < 1


@pytest.mark.parametrize(
    "name",
    ["metal", "rough metal", "plastic", "rough plastic", "half metal", "coated", "rough coat",
     "coated metal", "frosted sheet"],
)  # fmt: skip
def test_reflection_is_reciprocal(name: str) -> None:
    material = LOSSLESS[name]
    built = floor(material)
    rng = np.random.default_rng(0)
    for _ in range(40):
        a, b = (towards(math.acos(rng.uniform(0.05, 1)), rng.uniform(0, 6.3)) for _ in "ab")
        there, _ = evaluate(built, a, b[None])
        back, _ = evaluate(built, b, a[None])
        # the sheet's compensation of lost energy looks at one direction alone
        rtol = 0.2 if name == "frosted sheet" else 2e-3
        np.testing.assert_allclose(there / b[1], back / a[1], rtol=rtol, atol=1e-6)


@pytest.mark.parametrize(
    "material",
    [*LOSSLESS.values(), *LOSSY.values()],
    ids=[*LOSSLESS, *LOSSY],
)
def test_samples_lie_as_their_density_says(material: Material) -> None:
    """Where the samples fall, against the density integrated over cells of the sphere."""
    if material.roughness < 0.02 and material.transmission == 1:
        return  # nothing but certain directions
    built, wo = floor(material), towards(0.9)
    count = 65536
    rows = built.scatter(triple(wo), triple(-wo), count, 3)[:, 0].astype(float)
    spread = rows[(rows[:, 6] > 0)]
    if not len(spread):
        return
    _, density = evaluate(built, wo, spread[:, :3])
    np.testing.assert_allclose(density, spread[:, 6], rtol=2e-2)
    wi, area = grid(800)
    f, density = evaluate(built, wo, wi)
    lost = (rows[:, 3:6] == 0).all(axis=1).mean()  # directions below the surface
    share = len(spread) / count
    assert share <= (density @ area)[0] + 0.01 <= share + lost + 0.02
    cells = 8

    def cell(d: NDArray[np.float64]) -> NDArray[np.int64]:
        row = np.clip(((d[:, 1] + 1) / 2 * cells).astype(int), 0, cells - 1)
        turn = np.arctan2(d[:, 2], d[:, 0]) / (2 * math.pi) + 0.5
        return row * cells + np.clip((turn * cells).astype(int), 0, cells - 1)

    expected = np.bincount(cell(wi), density * area[:, 0], cells * cells)
    found = np.bincount(cell(spread[:, :3]), minlength=cells * cells) / count
    # five standard errors of a count, and the quadrature's own error in a narrow lobe
    np.testing.assert_array_less(
        np.abs(found - expected), 5 * np.sqrt(expected / count) + 0.01 * expected + 1e-3
    )
    # and the light that they carry: two routes to one integral
    light = 1.0 + wi[:, :1] + 0.5 * wi[:, 1:2] ** 2
    by_grid = (f * light * area).sum(0)
    wi = spread[:, :3]
    carried = spread[:, 3:6] * (1.0 + wi[:, :1] + 0.5 * wi[:, 1:2] ** 2)
    np.testing.assert_allclose(carried.sum(0) / count, by_grid, rtol=0.03, atol=0.01)


def test_without_specular_it_is_lambert_exactly() -> None:
    built, wi = floor(Material((0.6, 0.3, 0.1), specular=0.0)), grid(20)[0]
    f, density = evaluate(built, towards(0.5), wi)
    cos = np.maximum(wi[:, 1:2], 0) / math.pi
    np.testing.assert_allclose(f, cos * [0.6, 0.3, 0.1], atol=1e-6)
    np.testing.assert_allclose(density, cos[:, 0], atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_a_thin_sheet_reflects_between_its_sides(angle: float) -> None:
    ior, color = 1.5, (0.9, 0.5, 0.2)
    built = floor(Material(color, roughness=0.0, transmission=1.0, thin=True, ior=ior))
    cos_i = math.cos(angle)
    cos_t = math.sqrt(1 - (math.sin(angle) / ior) ** 2)
    s = (cos_i - ior * cos_t) / (cos_i + ior * cos_t)
    p = (ior * cos_i - cos_t) / (ior * cos_i + cos_t)
    R, seen, passed = (s * s + p * p) / 2, 0.0, 1.0
    R1, T1 = R, 1 - R
    for k in range(60):  # the series itself
        seen += R1 if k == 0 else T1 * T1 * R1 ** (2 * k - 1)
    passed = 1 - seen
    wo = towards(angle)
    row = built.scatter(triple(wo), triple(-wo), 1, 0)[0, 0]
    np.testing.assert_allclose(row[3:6], seen, rtol=1e-4)
    np.testing.assert_allclose(row[:3], wo * [-1, 1, -1], atol=1e-6)
    through = built.transmittance(np.array([wo], np.float32), np.array([-wo], np.float32))
    np.testing.assert_allclose(through[0, 0], passed * np.array(color), rtol=1e-4)


def test_a_smooth_coat_reflects_four_percent_straight_on() -> None:
    built = floor(Material((0.0, 0.0, 0.0), specular=0.0, clearcoat=0.5))
    wo = towards(0.0)
    assert sampled(built, wo, 4096).max() == pytest.approx(0.5 * 0.04, rel=0.01)


def ball(material: Material) -> Mesh:
    vertices, faces, normals = sphere()
    return Mesh.of(vertices, faces, normals=normals, material=material)


def view(size: int = 24) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    at = np.array([0.0, 0.5, 3.0])
    pose = Pose.look_at(at, np.array([0, 0.5, 0.0]))
    return corner_rays(CameraModel.pinhole((size, size), 0.5, pose)), at


@pytest.mark.parametrize("name", LOSSLESS)
def test_white_balls_vanish_in_a_white_world_in_both_integrators(name: str) -> None:
    rays, at = view(16)
    white = np.ones((8, 16, 3), np.float32)
    thing = ball(LOSSLESS[name])
    loss = 0.04 if LOSSLESS[name].clearcoat else 0.012
    L = path_trace(thing, rays, at, spp=128, max_bounces=60, environment=white)
    assert L.mean() == pytest.approx(1 - loss / 2, abs=loss / 2 + 3e-3)
    job = Compositor([thing], CapturedSet(white, np.zeros(3)), rays, at, bounces=40)
    job.add(128)
    result = job.result()
    assert result.rgb.mean() == pytest.approx(1 - loss / 2, abs=loss / 2 + 3e-3)


@pytest.mark.parametrize("name", ["car", "gold", "red plastic"])
def test_both_integrators_agree_under_a_sun(name: str) -> None:
    sky = np.full((32, 64, 3), 0.3, np.float32)
    sky[8:10, 20:23] = 60
    rays, at = view()
    thing = ball(LOSSY[name])
    truth = path_trace(thing, rays, at, spp=1024, max_bounces=3, environment=sky)
    job = Compositor([thing], CapturedSet(sky, np.zeros(3)), rays, at, bounces=3)
    job.add(256)
    result = job.result()
    full = result.alpha == 1
    assert result.rgb[full].mean() == pytest.approx(truth[full].mean(), rel=0.02)
    error = np.abs(result.rgb - truth)[full].mean() / truth[full].mean()
    assert error < 0.05


def test_roughness_zero_is_the_limit_of_small_roughness() -> None:
    sky = np.random.default_rng(0).uniform(0.2, 1, (8, 16, 3)).astype(np.float32)
    rays, at = view()
    for material in (
        Material((0.9, 0.7, 0.5), metallic=1.0, roughness=0.0),
        Material(WHITE, transmission=1.0, roughness=0.0),
        Material(WHITE, roughness=0.0),
    ):
        smooth, rough = (
            path_trace(ball(replace(material, roughness=r)), rays, at, spp=256, environment=sky)
            for r in (0.0, 0.03)
        )
        assert np.abs(smooth - rough).mean() < 0.01
        assert smooth.mean() == pytest.approx(rough.mean(), rel=2e-3)


def test_a_roughness_texture_makes_gloss_where_it_says() -> None:
    pixels = np.zeros((4, 4, 3), np.float32)
    pixels[..., 1] = np.where(np.arange(4) < 2, 1.0, 0.25)[None]
    pixels[..., 2] = 1.0
    material = Material(
        (0.8, 0.8, 0.8), metallic=1.0, roughness=1.0,
        metallic_roughness_texture=Texture(pixels, ("clamp", "clamp")),
    )  # fmt: skip
    v = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    built = world([Mesh.of(v, faces, uv=uv, material=material)])
    down, up = (0.0, -1.0, 0.0), np.array([[0, 1, 0], [0.6, 0.8, 0]], np.float32)
    for x, roughness in ((-0.9, 1.0), (0.9, 0.25)):
        there = built.evaluate((x, 1.0, 0.1), down, up)
        even = replace(material, roughness=roughness, metallic_roughness_texture=None)
        np.testing.assert_allclose(
            there, floor(even).evaluate((x, 1.0, 0.1), down, up), rtol=1e-4
        )


def test_the_words_of_kind_are_materials() -> None:
    for kind, material in (
        (Kind.DIFFUSE, Material.diffuse((0.5, 0.5, 0.5))),
        (Kind.MIRROR, Material.mirror((0.5, 0.5, 0.5))),
        (Kind.GLASS, Material.glass((0.5, 0.5, 0.5))),
    ):
        vertices, faces, _ = sphere(4, 8)
        assert Mesh.of(vertices, faces, 0.5, kind=kind).materials == (material,)
