"""The renderer's scenes: a real room's light, a made sky with a sun, a room with depth."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.bench import mitsuba_peer as peer
from chromeball.renderer.composite import CapturedSet, Compositor, Integrator
from chromeball.renderer.material import Color, Material
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import box, sphere
from chromeball.renderer.scene import read_mesh
from chromeball.renderer.world import world
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import read_rgb
from chromeball.scene.manifest import StandIn
from chromeball.scene.pose import Pose
from chromeball.stand_in.depth import distance_map
from chromeball.stand_in.panorama import panorama
from chromeball.stand_in.ply import SUPPORT, StandInMesh
from chromeball.stand_in.primitives import build_mesh, build_piece

DATA = Path(__file__).resolve().parents[2] / "shared/data/render"
#: The data's axes, z up, to ours: its map's middle, +X, is our +Z.
TURN = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])

type Picture = NDArray[np.float32]
type Variant = Literal["direct", "diffuse", "mg"]
WORDS: dict[Variant, str] = {
    "direct": "direct light",
    "diffuse": "one bounce",
    "mg": "mirror and glass",
}


@dataclass(frozen=True)
class Setting:
    """A scene for ours and, with ``surfaces`` (one an object), for Mitsuba.

    ``depth``: edges of Mitsuba's paths, 2 is direct light. Without ``plate`` the captured set
    itself is seen.
    """

    what: str
    objects: list[Mesh]
    captured: CapturedSet
    camera: CameraModel
    bounces: int
    plate: Picture | None = None
    surfaces: list[peer.Entry] | None = None
    depth: int = 2

    def name(self) -> str:
        """For files."""
        return "".join(c if c.isalnum() else "-" for c in self.what)

    def job(
        self,
        seed: int,
        samples: int,
        *,
        integrator: Integrator = "path",
        filtered: bool = True,
    ) -> Compositor:
        """Ours; like Mitsuba, mirrors and glass see the map."""
        return Compositor(
            self.objects,
            self.captured,
            corner_rays(self.camera),
            self.camera.world_from_camera.translation,
            self.plate,
            bounces=self.bounces,
            seed=seed,
            samples=samples,
            integrator=integrator,
            filtered=filtered,
            reflect="map",
        )

    def floor(self) -> Mesh:
        """The stand-in as a mesh."""
        stand_in = self.captured.stand_in
        assert stand_in is not None
        return Mesh.of(stand_in.vertices, stand_in.faces)

    def coverage(self) -> Picture:
        """(H, W) share of each pixel that objects cover, by 4 x 4 rays."""
        rays = corner_rays(self.camera)[:-1, :-1]
        right, down = (np.gradient(rays, axis=k).astype(np.float32) for k in (1, 0))
        eye = np.zeros_like(rays).reshape(-1, 3)
        scene = world(self.objects, about=self.camera.world_from_camera.translation)
        found = np.zeros(rays.shape[:2], np.float32)
        for v in (np.arange(4) + np.float32(0.5)) / 4:
            for u in (np.arange(4) + np.float32(0.5)) / 4:
                d = (rays + u * right + v * down).reshape(-1, 3).astype(np.float32)
                d /= np.linalg.norm(d, axis=1, keepdims=True)
                hits = scene.hits(eye, np.ascontiguousarray(d))
                found += np.isfinite(hits.reshape(len(d), -1)[:, 0]).reshape(found.shape) / 16
        return found


def hotel(variant: Variant) -> Setting:
    """200,000 triangles of ``data/render`` on a floor in a real room's light, 640 x 480."""
    scene: dict[str, Any] = json.loads((DATA / "scene.json").read_text())
    materials, view = scene["variants"][variant], scene["camera"]
    ground = data_mesh("floor")
    floor = StandInMesh(
        ground.vertices,
        ground.vertices,
        ground.faces,
        np.full(len(ground.faces), SUPPORT, np.uint8),
    )
    size = (int(view["width"]), int(view["height"]))
    pose = Pose.look_at(TURN @ np.array(view["position"]), TURN @ np.array(view["target"]))
    angle = 2 * math.atan(math.tan(math.radians(view["vfov_deg"]) / 2) * size[0] / size[1])
    return Setting(
        f"composite 640x480, {WORDS[variant]}",
        [data_mesh(name, *materials[name]) for name in ("spot", "knot")],
        CapturedSet(read_rgb(DATA / "hotel_room.exr"), np.array([0.0, 1.0, 0.0]), floor),
        CameraModel.pinhole(size, angle, pose),
        min(int(materials["indirect_bounces"]), 4),
        read_rgb(DATA / "plate.exr"),
        [_mitsubas(*materials[name]) for name in ("spot", "knot")],
        {"direct": 2, "diffuse": 3, "mg": 10}[variant],
    )


def of_size(setting: Setting, width: int, height: int) -> Setting:
    """The same view in so many pixels, over a grey plate."""
    old = setting.camera
    camera = CameraModel.pinhole((width, height), fov(old), old.world_from_camera)
    return replace(setting, camera=camera, plate=np.full((height, width, 3), 0.3, np.float32))


def fov(camera: CameraModel) -> float:
    """A pinhole's horizontal angle of view."""
    return 2 * math.atan(camera.size[0] / 2 / float(camera.intrinsics[0]))


def data_mesh(name: str, kind: str = "diffuse", value: Any = 0.4) -> Mesh:
    """A mesh of ``data/render`` with a material of its scene file."""
    vertices, faces, _ = read_mesh(DATA / f"{name}.ply")
    color, ior = (value, 1.5) if kind != "glass" else (1.0, value)
    turned = (vertices @ TURN.T).astype(np.float32)
    return Mesh.of(turned, faces, color, kind=Kind[kind.upper()], ior=ior)


def outdoors() -> Setting:
    """A blue sky with a sun of half a degree, 1e5 times as bright, over a wide matt ground."""
    d = _directions(1024)
    sky = (1.5 - np.maximum(d[..., 1:2], 0)) * np.array([0.35, 0.55, 1.0])
    to_sun = np.array([-0.55, 0.6, -0.35]) / np.linalg.norm([0.55, 0.6, 0.35])
    angle = np.arccos(np.clip(d @ to_sun, -1, 1))
    texel = math.pi / 1024
    disc = np.clip((math.radians(0.25) - angle) / texel + 0.5, 0, 1)
    sky += disc[..., None] * 1e5 * np.array([1.0, 0.9, 0.75])
    sky *= 0.25  # an exposure in which the ground is neither black nor white
    cosine = np.maximum(d[..., 1:2], 0) * texel**2 * np.sqrt(1 - d[..., 1:2] ** 2)
    sky[512:] = 0.4 / math.pi * (sky * cosine).sum(axis=(0, 1))
    corners = 30 * np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    ground = StandInMesh(corners, corners, faces, np.full(2, SUPPORT, np.uint8))
    red, gold, grey = (0.6, 0.12, 0.08), (0.9, 0.7, 0.35), (0.5, 0.5, 0.5)
    plastic = {"type": "principled", "roughness": 0.3, "specular": 0.5}
    metal = {"type": "principled", "roughness": 0.3, "metallic": 1.0}
    return Setting(
        "outdoors, sun of 1e5 times the sky, 640x480",
        [
            _bumpy(Material(red, roughness=0.3), (-0.55, 0.0, 0.0)),
            _ball(Material(gold, metallic=1.0, roughness=0.3), (0.45, 0.0, 0.5), 0.6),
            _block(grey, (0.75, 0.0, -0.5)),
        ],
        CapturedSet(sky.astype(np.float32), np.array([0.0, 1.5, 0.0]), ground),
        _looking((0.3, 1.7, 3.6), (0.05, 0.35, 0.0)),
        0,
        None,
        [
            plastic | {"base_color": peer.rgb(red)},
            metal | {"base_color": peer.rgb(gold)},
            peer.diffuse(grey),
        ],
    )


def room() -> Setting:
    """A room of 5 x 4.5 x 2.6 m lit by a window, its light laid on the walls; matt objects."""
    entry = StandIn(
        name="room",
        kind="room",
        corners=[(-2.0, -3.0), (-2.0, 1.5), (3.0, 1.5), (3.0, -3.0)],
        height=2.6,
    )
    mesh, origin = build_mesh([build_piece(entry)]), np.array([0.3, 1.2, -0.4])
    d = _directions(512)
    distance = distance_map(mesh, panorama((1024, 512), origin))
    x, y, z = np.moveaxis(origin + distance[..., None] * d, -1, 0)
    light = np.full((512, 1024, 3), (0.30, 0.28, 0.25))  # walls
    light[y < 1e-3] = 0.2, 0.15, 0.1
    light[y > 2.6 - 1e-3] = 0.4, 0.4, 0.4
    light[(x < -2 + 1e-3) & (y > 0.9) & (y < 2.2) & (abs(z + 0.8) < 0.8)] = 18, 20, 24
    return Setting(
        "room with a light-depth map, one bounce, 640x480",
        [
            _bumpy(Material.diffuse((0.7, 0.5, 0.3)), (0.2, 0.0, -1.3)),
            _ball(Material.diffuse((0.3, 0.5, 0.7)), (1.2, 0.0, -1.0), 0.5),
            _block((0.6, 0.6, 0.6), (0.5, 0.0, -2.2)),
        ],
        CapturedSet(light.astype(np.float32), origin, mesh),
        _looking((0.9, 1.5, 1.2), (0.5, 0.3, -1.4)),
        1,
    )


def _mitsubas(kind: str, value: Any) -> peer.Entry:
    match kind:
        case "mirror":
            conductor = {"type": "conductor", "material": "none"}
            return conductor | {"specular_reflectance": peer.rgb(value)}
        case "glass":
            return {"type": "dielectric", "int_ior": value, "ext_ior": 1.0}
        case _:
            return peer.diffuse(value)


def _directions(height: int) -> NDArray[np.float64]:
    """(height, 2 height, 3) of a lat-long map's pixels."""
    camera = panorama((2 * height, height), np.zeros(3))
    return camera.rays(camera.pixel_grid())


def _looking(place: Color, target: Color) -> CameraModel:
    return CameraModel.pinhole((640, 480), 0.7, Pose.look_at(np.array(place), np.array(target)))


def _bumpy(material: Material, at: Color) -> Mesh:
    """100,000 triangles about 1 m high."""
    v, faces, _ = sphere(158, 316)
    x, y, z = 14 * v.T
    v = v * (1 + 0.06 * np.sin(x) * np.sin(y) * np.sin(z + 1))[:, None]
    v[:, 1] -= v[:, 1].min()
    return Mesh.of(v + np.array(at), faces, material=material)


def _ball(material: Material, at: Color, size: float) -> Mesh:
    vertices, faces, normals = sphere(64, 128)
    mesh = Mesh.of(vertices, faces, normals=normals, material=material)
    return mesh.placed(Pose(np.eye(3), np.array(at)), size)


def _block(color: Color, at: Color) -> Mesh:
    vertices, faces, _ = box()
    mesh = Mesh.of(vertices, faces, material=Material.diffuse(color))
    return mesh.placed(Pose.from_rotation_vector([0, 0.5, 0], at), 0.5)
