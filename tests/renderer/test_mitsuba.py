"""Our composites against plate + (with - without) of two pictures of Mitsuba 3.

Both render each picture a few times over, with independent seeds; a scene agrees when the means
over regions of the picture do within the noise that this shows. Each test then holds that the
same comparison would have told a picture that is one percent brighter.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ttest_ind

from chromeball.bench import mitsuba_peer as peer
from chromeball.renderer.composite import CapturedSet, Compositor, Integrator
from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.lights import area_lights
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Instance, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import box, sphere
from chromeball.renderer.world import world
from chromeball.scene.camera import CameraModel
from chromeball.scene.manifest import parse_scene
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import StandInMesh

pytest.importorskip("mitsuba", reason="the peer is not installed: uv sync --group dev")

SIZE = (48, 36)
FOV = 0.75
EYE = np.array([0.4, 2.2, 3.4])
POSE = Pose.look_at(EYE, np.array([0.0, 0.25, 0.0]))
FLOOR_ALBEDO = 0.5
SEEDS = range(8)
SAMPLES = 64
#: Chance that a scene that is alike fails, by Bonferroni's bound over its regions.
RISK = 1e-3

type Pictures = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """Objects with our material and Mitsuba's, and lights with Mitsuba's entry."""

    objects: list[tuple[Mesh, dict[str, Any]]]
    lights: list[tuple[DeltaLight | Instance, dict[str, Any]]] = field(default_factory=list)
    #: radiance of the map below its horizon: the floor's own, or black
    lit_floor: bool = False


def sky(below: float) -> NDArray[np.float32]:
    """A bright and two dim lobes above the horizon, `below` under it: (32, 64, 3)."""
    y, x = np.mgrid[0:32, 0:64] + 0.5
    polar, lon = y / 32 * math.pi, (x / 64 - 0.5) * 2 * math.pi
    d = np.stack(
        [-np.sin(polar) * np.sin(lon), np.cos(polar), np.sin(polar) * np.cos(lon)], axis=-1
    )
    found = np.full((32, 64, 3), 0.2)
    for to, power, colour in (
        ((0.6, 0.7, 0.3), 60, (12, 10, 7)),
        ((-0.8, 0.4, 0.4), 8, (0.5, 0.8, 1.2)),
        ((0.1, 0.5, -0.9), 20, (0.6, 1.5, 0.6)),
    ):
        u = np.array(to) / np.linalg.norm(to)
        found += np.maximum(d @ u, 0)[..., None] ** power * np.array(colour)
    found[16:] = below
    return found.astype(np.float32)


def floor_irradiance(pixels: NDArray[np.float32]) -> NDArray[np.float64]:
    """Of an upward normal under the bilinear map, by the midpoint rule, (3,)."""
    height, fine = len(pixels), 64
    theta = (np.arange(height // 2 * fine) + 0.5) / (height * fine) * math.pi
    v = np.maximum(theta / math.pi * height - 0.5, 0)
    row = v.astype(int)
    b = (v - row)[:, None]
    ring = (1 - b) * pixels.mean(axis=1)[row] + b * pixels.mean(axis=1)[row + 1]
    weight = 2 * math.pi * np.sin(theta) * np.cos(theta) * math.pi / (height * fine)
    return np.einsum("r,rc->c", weight, ring.astype(float))


def light_over_floor(lit: bool) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The map, and the radiance of the floor under it, (3,)."""
    radiance = np.zeros(3)
    pixels = sky(0)
    for _ in range(4):
        radiance = FLOOR_ALBEDO / math.pi * floor_irradiance(pixels)
        if lit:
            pixels[16:] = radiance
    return pixels, radiance


def floor() -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    corners = np.array([[-9, 0, 9], [9, 0, 9], [9, 0, -9], [-9, 0, -9]], np.float32)
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def ours(scene: Scene, bounces: int, integrator: Integrator = "path") -> Pictures:
    pixels, radiance = light_over_floor(scene.lit_floor)
    corners, faces = floor()
    captured = CapturedSet(
        pixels,
        np.array([0.0, 1.0, 0.0]),
        StandInMesh(corners, corners, faces, np.zeros(2, np.uint8)),
    )
    plate = np.broadcast_to(radiance, (SIZE[1], SIZE[0], 3)).astype(np.float32)

    def picture(seed: int) -> NDArray[np.float32]:
        job = Compositor(
            [mesh for mesh, _ in scene.objects]
            + [light for light, _ in scene.lights if isinstance(light, Instance)],
            captured,
            corner_rays(CameraModel.pinhole(SIZE, FOV, POSE)),
            EYE,
            plate,
            bounces=bounces,
            seed=seed,
            samples=SAMPLES,
            integrator=integrator,
            filtered=False,
            lights=[light for light, _ in scene.lights if isinstance(light, DeltaLight)],
        )
        job.add(SAMPLES)
        return job.result().rgb

    return repeated(picture)


def set_alone(lit: bool) -> dict[str, Any]:
    corners, faces = floor()
    return {
        "sky": peer.environment(light_over_floor(lit)[0]),
        "floor": peer.shape("floor", Mesh.of(corners, faces), peer.diffuse(FLOOR_ALBEDO)),
    }


def pictures(parts: dict[str, Any], depth: int) -> Pictures:
    """Mitsuba's, of paths of `depth` edges: 2 is direct light, -1 all."""
    scene = peer.scene(peer.pinhole(SIZE, FOV, POSE, "multijitter"), parts, depth)
    return repeated(lambda seed: peer.render(scene, SAMPLES, seed))


@functools.cache
def without(lit: bool, depth: int) -> Pictures:
    found = pictures(set_alone(lit), depth)
    radiance = light_over_floor(lit)[1]
    np.testing.assert_allclose(found.mean(axis=(0, 1, 2)), radiance, rtol=1e-3)
    return found


def mitsubas(scene: Scene, depth: int) -> Pictures:
    """Plate + (with - without).

    One seed for both: where no path meets an object they are the same, bit for bit.
    """
    peer.load("scalar_rgb")
    added = {
        f"object{k}": peer.shape(f"object{k}", mesh, bsdf)
        for k, (mesh, bsdf) in enumerate(scene.objects)
    } | {f"light{k}": entry for k, (_, entry) in enumerate(scene.lights)}
    after = pictures(set_alone(scene.lit_floor) | added, depth)
    return light_over_floor(scene.lit_floor)[1] + after - without(scene.lit_floor, depth)


def repeated(picture: Callable[[int], NDArray[np.float32]]) -> Pictures:
    return np.array([picture(seed) for seed in SEEDS], float)


def chance(a: Pictures, b: Pictures, pixels: NDArray[np.bool_] | None = None) -> float:
    """Bonferroni's bound of the chance that pictures alike differ so: Welch's t, 16 regions."""
    regions = np.arange(SIZE[1])[:, None] // 9 * 4 + np.arange(SIZE[0]) // 12
    keep = np.ones(regions.shape, bool) if pixels is None else pixels
    p: list[float] = []
    for region in range(16):
        inside = keep & (regions == region)
        if inside.sum() < 20:
            continue
        x, y = (pictures[:, inside].mean(axis=1) for pictures in (a, b))
        p += np.asarray(ttest_ind(x, y, equal_var=False))[1].tolist()
    return min(1.0, len(p) * min(p))


def check(a: Pictures, b: Pictures, pixels: NDArray[np.bool_] | None = None) -> None:
    assert chance(a, b, pixels) > RISK
    assert chance(a, 1.01 * b, pixels) < RISK


def ball(material: Material, at: tuple[float, float, float], size: float = 1.0) -> Mesh:
    vertices, faces, normals = sphere(24, 48)
    mesh = Mesh.of(vertices, faces, normals=normals, material=material)
    return mesh.placed(Pose(np.eye(3), np.array(at)), size)


def block(color: tuple[float, float, float]) -> Mesh:
    vertices, faces, _ = box()
    mesh = Mesh.of(vertices, faces, material=Material.diffuse(color))
    return mesh.placed(
        Pose.from_rotation_vector(np.array([0, 0.5, 0]), np.array([0.9, 0, -0.3])), 0.6
    )


RED, BLUE = (0.7, 0.3, 0.2), (0.2, 0.4, 0.8)
MATT = [
    (ball(Material.diffuse(RED), (-0.3, 0, 0)), peer.diffuse(RED)),
    (block(BLUE), peer.diffuse(BLUE)),
]


def objects_cover() -> NDArray[np.bool_]:
    """Pixels that show an object at all."""
    alone = CapturedSet(sky(0), np.array([0.0, 1.0, 0.0]))
    rays = corner_rays(CameraModel.pinhole(SIZE, FOV, POSE))
    plate = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    job = Compositor([mesh for mesh, _ in MATT], alone, rays, EYE, plate)
    job.add(16)
    return job.result().alpha > 0


def test_direct_light() -> None:
    scene = Scene(MATT)
    truth = mitsubas(scene, 2)
    check(ours(scene, 0), truth)
    check(ours(scene, 0, "direct"), truth)


def test_one_bounce_between_objects_and_floor() -> None:
    """On the floor, where both follow the same paths: the map's own floor is black."""
    scene = Scene(MATT)
    floor_alone = ~objects_cover()
    truth = mitsubas(scene, 3)
    check(ours(scene, 1), truth, floor_alone)
    check(ours(scene, 1, "direct"), truth, floor_alone)


def test_all_light() -> None:
    scene = Scene(MATT, lit_floor=True)
    check(ours(scene, 8), mitsubas(scene, -1))


def test_a_rough_metal() -> None:
    """So rough that the facets do not light each other: Mitsuba leaves that out."""
    color, roughness = (0.9, 0.6, 0.3), 0.15
    material = Material(color, metallic=1.0, roughness=roughness)
    other = {
        "type": "principled",
        "base_color": peer.rgb(color),
        "metallic": 1.0,
        "roughness": roughness,
    }
    scene = Scene([(ball(material, (-0.3, 0, 0)), other)], lit_floor=True)
    check(ours(scene, 8), mitsubas(scene, -1))


@pytest.mark.parametrize("roughness", [0.3, 0.6])
def test_a_rougher_metal_reflects_once_as_mitsubas(roughness: float) -> None:
    """Point by point, apart from what is known to differ.

    Mitsuba takes the shadows of the two directions as independent, we as correlated with height
    (Heitz 2014); we add what facets send on to each other, which at a fixed outgoing direction
    is one function of the incoming (Kulla and Conty 2017), whatever the azimuth.
    """
    mi = peer.load("scalar_rgb")
    alpha, cos_o = roughness**2, 0.8
    conductor = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": alpha,
        "specular_reflectance": peer.rgb(0.8),
    }
    bsdf = mi.load_dict(conductor)
    met = mi.SurfaceInteraction3f()
    out = np.array([math.sqrt(1 - cos_o**2), cos_o, 0.0])
    met.wi = [out[0], out[2], out[1]]
    corners, faces = floor()
    metal = Material((0.8, 0.8, 0.8), metallic=1.0, roughness=roughness, specular=0.0)
    mine = world([Mesh.of(corners, faces, material=metal)], [])
    for cos_i in (0.4, 0.7, 0.95):
        phi = math.pi + np.linspace(-1.2, 1.2, 9)  # about the mirrored direction
        sin_i = math.sqrt(1 - cos_i**2)
        wi = np.stack(
            [sin_i * np.cos(phi), np.full_like(phi, cos_i), sin_i * np.sin(phi)], axis=-1
        ).astype(np.float32)
        found = mine.evaluate(tuple(out), tuple(-out), wi)[:, 0, 0]
        once = np.array(
            [bsdf.eval(mi.BSDFContext(), met, [*map(float, w[[0, 2, 1]])])[0] for w in wi]
        )
        lam_o, lam_i = (
            0.5 * (math.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) for c in (cos_o, cos_i)
        )
        rest = found - once * (1 + lam_o) * (1 + lam_i) / (1 + lam_o + lam_i)
        assert rest.min() > 0
        assert np.ptp(rest) < 1e-4 * found.max()


def test_a_smooth_glass_ball_and_its_caustic() -> None:
    glass = ball(Material.glass((1.0, 1.0, 1.0)), (-0.3, 0, 0))
    other = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    scene = Scene([(glass, other)], lit_floor=True)
    check(ours(scene, 8), mitsubas(scene, -1))


def test_light_caught_in_a_cut_glass_gets_out() -> None:
    """Between flat facets it may be reflected hundreds of times: a white world stays white."""
    vertices, faces, _ = sphere(24, 48)
    glass = Mesh.of(vertices, faces, material=Material.glass((1.0, 1.0, 1.0)))
    white = CapturedSet(np.ones((8, 16, 3), np.float32), np.array([0.0, 1.0, 0.0]))
    rays = corner_rays(CameraModel.pinhole(SIZE, 0.4, POSE))
    job = Compositor([glass], white, rays, EYE, samples=128)
    job.add(128)
    assert job.result().rgb.mean() == pytest.approx(1, abs=1e-5)


def point() -> tuple[DeltaLight, dict[str, Any]]:
    place, intensity = (-1.0, 1.6, 1.0), (1.5, 1.2, 0.9)
    entry = {"type": "point", "position": list(place), "intensity": peer.rgb(intensity)}
    return DeltaLight(place, intensity), entry


def spot() -> tuple[DeltaLight, dict[str, Any]]:
    """Its edge is sharp: the ramps differ."""
    place, aim, intensity = (1.2, 2.0, 0.6), np.array([0.0, 0.3, 0.0]), (3.0, 3.0, 4.0)
    to = (aim - place) / np.linalg.norm(aim - place)
    inner, outer = 19.9, 20.0
    light = DeltaLight(
        place,
        intensity,
        (float(to[0]), float(to[1]), float(to[2])),
        math.cos(math.radians(inner)),
        math.cos(math.radians(outer)),
    )
    entry = {
        "type": "spot",
        "to_world": peer.looking(place, aim),
        "intensity": peer.rgb(intensity),
        "cutoff_angle": outer,
        "beam_width": inner,
    }
    return light, entry


def area() -> tuple[Instance, dict[str, Any]]:
    text = """
name = "lit"
[[light]]
name = "panel"
kind = "area"
position = [-1.2, 1.5, 0.4]
look_at = [0, 0.2, 0]
size = [0.6, 0.4]
radiance = [6, 5, 4]
[[view]]
name = "main"
size = [48, 36]
"""
    (panel,) = area_lights(parse_scene(text))
    entry = {
        "type": "rectangle",
        "to_world": peer.looking((-1.2, 1.5, 0.4), (0, 0.2, 0), (0.3, 0.2, 1)),
        "emitter": {"type": "area", "radiance": peer.rgb((6, 5, 4))},
        "bsdf": peer.diffuse(0.0),
    }
    return panel, entry


@pytest.mark.parametrize("light", [point, spot, area])
def test_a_synthetic_light(
    light: Callable[[], tuple[DeltaLight | Instance, dict[str, Any]]],
) -> None:
    peer.load("scalar_rgb")
    scene = Scene(MATT, [light()])
    truth = mitsubas(scene, 2)
    check(ours(scene, 0), truth)
    check(ours(scene, 0, "direct"), truth)
