"""The renderer: shadow rays beside a bare Embree loop, and time against error.

The scene of ``data/render`` (200,000 triangles on a floor in a real room's light, 640 x 480)
is compared with its own converged picture; the error is the RMS difference in 8-bit sRGB codes.
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.bench.row import Row
from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.scene import read_mesh
from chromeball.renderer.shadow_bench import ShadowBench
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import srgb_encode
from chromeball.scene.image import read_rgb
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import SUPPORT, StandInMesh

DATA = Path(__file__).resolve().parents[2] / "shared/data/render"
#: The scene's axes, z up, to ours: its map's middle, +X, is our +Z.
TURN = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def rows(quick: bool) -> list[Row]:
    """Shadow rays, then the scene in direct light at a few sample counts."""
    if not DATA.is_dir():
        return []
    scene: dict[str, Any] = json.loads((DATA / "scene.json").read_text())
    return shadow_rows(quick) + [
        row for variant in ("direct",) for row in composite_rows(scene, variant, quick)
    ]


def shadow_rows(quick: bool) -> list[Row]:
    """Shadow rays from a floor past the cow and the knot, ours and Embree's alone."""
    solid = Mesh.join([_mesh("spot", "diffuse", 0.5), _mesh("knot", "diffuse", 0.5)])
    bench = ShadowBench(solid.vertices, solid.faces)
    rng = np.random.default_rng(0)
    side = 128 if quick else 256
    x, z = np.meshgrid(np.linspace(-1.5, 1.5, side), np.linspace(-1.5, 1.5, side))
    points = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3).astype(np.float32)
    normals = np.broadcast_to(np.array([0, 1, 0], np.float32), points.shape).copy()
    lights = rng.normal(size=(32, 3)).astype(np.float32)
    lights = lights / np.linalg.norm(lights, axis=1, keepdims=True) * np.float32(4)
    lights[:, 1] = np.abs(lights[:, 1]) + np.float32(0.2)
    lift = np.float32(1e-5) * np.abs(points).max(axis=1, keepdims=True) + np.float32(1e-5)
    starts = np.asarray(points + normals * lift, np.float32)
    directions = lights[None] - starts[:, None]
    origins = np.repeat(starts, len(lights), axis=0)
    flat = np.ascontiguousarray(directions.reshape(-1, 3), np.float32)
    visible = np.empty(len(flat), np.float32)
    irradiance = np.empty(len(points), np.float32)
    ours, bare = math.inf, math.inf
    for _ in range(3 if quick else 7):
        start = time.process_time()
        bench.bare(origins, flat, visible)
        middle = time.process_time()
        bench.ours(points, normals, lights, irradiance)
        bare, ours = min(bare, middle - start), min(ours, time.process_time() - middle)
    cos = (directions * normals[:, None]).sum(axis=2)
    distance = np.linalg.norm(directions, axis=2)
    expected = (visible.reshape(cos.shape) * cos / distance**3).sum(axis=1)
    wrong = float(np.abs(irradiance - expected).max() / expected.max())
    what = f"{len(flat) / 1e6:.1f} M shadow rays, 200,000 triangles"

    def rate(seconds: float) -> str:
        return f"{len(flat) / seconds / 1e6:.1f} Mrays a CPU s"

    unit = "relative error of the irradiance"
    note = f"{rate(ours)}, {bare / ours:.0%} of the bare loop; ray made and shaded as well"
    return [
        Row("renderer", what, "chromeball", ours, wrong, unit, note),
        Row("renderer", what, "bare Embree loop", bare, 0.0, unit, rate(bare)),
    ]


def composite_rows(scene: dict[str, Any], variant: str, quick: bool) -> list[Row]:
    """One variant of the comparison scene against its own converged picture."""
    reference = _compositor(scene, variant, 1, 128)
    _passes(reference, 32 if quick else 128)
    truth = _codes(reference.result().rgb)
    found: list[Row] = []
    for spp in (1, 4) if quick else (1, 4, 16):
        start = time.process_time()
        job = _compositor(scene, variant, 0, spp)
        loaded = time.process_time() - start
        _passes(job, spp)
        seconds = time.process_time() - start
        error = float(np.sqrt(np.mean((_codes(job.result().rgb) - truth) ** 2)))
        note = f"{spp} spp, of that {loaded:.2f} s to load"
        what = f"composite 640x480, {variant}"
        found.append(Row("renderer", what, "chromeball", seconds, error, "8-bit codes", note))
    return found


def _passes(job: Compositor, samples: int) -> None:
    while job.samples < samples:
        job.refine(min(16, samples - job.samples))


def _codes(rgb: NDArray[np.float32]) -> NDArray[Any]:
    return 255 * srgb_encode(np.clip(rgb, 0, 1))


def _mesh(name: str, kind: str, value: Any) -> Mesh:
    vertices, faces, _ = read_mesh(DATA / f"{name}.ply")
    color, ior = (value, 1.5) if kind != "glass" else (1.0, value)
    turned = (vertices @ TURN.T).astype(np.float32)
    return Mesh.of(turned, faces, color, kind=Kind[kind.upper()], ior=ior)


def _compositor(scene: dict[str, Any], variant: str, seed: int, samples: int) -> Compositor:
    materials = scene["variants"][variant]
    view = scene["camera"]
    size = (int(view["width"]), int(view["height"]))
    place = TURN @ np.array(view["position"])
    pose = Pose.look_at(place, TURN @ np.array(view["target"]))
    fov = 2 * math.atan(math.tan(math.radians(view["vfov_deg"]) / 2) * size[0] / size[1])
    ground = _mesh("floor", "diffuse", 0.4)
    surface = np.full(len(ground.faces), SUPPORT, np.uint8)
    floor = StandInMesh(ground.vertices, ground.vertices, ground.faces, surface)
    captured = CapturedSet(read_rgb(DATA / "hotel_room.exr"), np.array([0.0, 1.0, 0.0]), floor)
    return Compositor(
        [_mesh(name, *materials[name]) for name in ("spot", "knot")],
        captured,
        corner_rays(CameraModel.pinhole(size, fov, pose)),
        place,
        read_rgb(DATA / "plate.exr"),
        bounces=min(int(materials["indirect_bounces"]), 4),
        seed=seed,
        samples=samples,
    )
