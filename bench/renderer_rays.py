"""Rays of ours beside a bare Embree loop over the same rays."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from chromeball.bench.renderer_scenes import data_mesh, hotel
from chromeball.bench.row import Row
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.ray_bench import RayBench
from chromeball.renderer.world import triple

type Work = Callable[[], object]


def rows(quick: bool) -> list[Row]:
    """Shadow rays one by one, primary rays sixteen side by side."""
    solid = Mesh.join([data_mesh("spot"), data_mesh("knot")])
    bench = RayBench(solid.vertices, solid.faces)
    turns = 3 if quick else 9
    return _shadow_rows(bench, 128 if quick else 256, turns) + _primary_rows(bench, 4 * turns)


def _shadow_rows(bench: RayBench, side: int, turns: int) -> list[Row]:
    """From a floor past the cow and the knot."""
    rng = np.random.default_rng(0)
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
    ours, bare = _by_turns(
        lambda: bench.shadow_ours(points, normals, lights, irradiance),
        lambda: bench.shadow_bare(origins, flat, visible),
        turns,
    )
    cos = (directions * normals[:, None]).sum(axis=2)
    distance = np.linalg.norm(directions, axis=2)
    expected = (visible.reshape(cos.shape) * cos / distance**3).sum(axis=1)
    wrong = float(np.abs(irradiance - expected).max() / expected.max())
    what = f"{len(flat) / 1e6:.1f} M shadow rays, 200,000 triangles"
    return _pair(what, len(flat), ours, bare, wrong, "relative error of the irradiance")


def _primary_rows(bench: RayBench, turns: int) -> list[Row]:
    """Of the camera of ``data/render``, in packets."""
    camera = hotel("direct").camera
    corners, (width, height) = corner_rays(camera), camera.size
    eye = triple(camera.world_from_camera.translation)
    c = corners.astype(float)
    d = c[:-1, :-1] + c[:-1, 1:] + c[1:, :-1] + c[1:, 1:]
    d /= np.linalg.norm(d, axis=2, keepdims=True)
    blocks = d.reshape(height // 4, 4, width // 4, 4, 3).transpose(0, 2, 4, 1, 3)
    packets = np.ascontiguousarray(blocks.reshape(-1, 3, 16), np.float32)
    found, expected = (np.empty(width * height, np.float32) for _ in range(2))
    ours, bare = _by_turns(
        lambda: bench.look_ours(corners, eye, found),
        lambda: bench.look_bare(eye, packets, expected),
        turns,
    )
    met = np.isfinite(found) & np.isfinite(expected)
    wrong = float(np.quantile(np.abs(found[met] / expected[met] - 1), 0.999))
    what = f"{width * height:,} primary rays, 200,000 triangles"
    return _pair(what, width * height, ours, bare, wrong, "99.9 % of distances, relative")


def _by_turns(a: Work, b: Work, turns: int) -> tuple[float, float]:
    """The least CPU seconds of each."""
    least = [math.inf, math.inf]
    for _ in range(turns):
        for k, work in enumerate((a, b)):
            start = time.process_time()
            work()
            least[k] = min(least[k], time.process_time() - start)
    return least[0], least[1]


def _pair(what: str, rays: int, ours: float, bare: float, wrong: float, unit: str) -> list[Row]:
    def rate(seconds: float) -> str:
        return f"{rays / seconds / 1e6:.1f} Mrays a CPU s"

    note = f"{rate(ours)}, {bare / ours:.0%} of the bare loop; our rays are made as well"
    return [
        Row("renderer", what, "chromeball", ours, wrong, unit, note),
        Row("renderer", what, "bare Embree loop", bare, 0.0, unit, rate(bare)),
    ]
