"""Stand-in geometry: time of a floor-only scene and of the light-depth map."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from chromeball.bench.row import Row
from chromeball.scene.manifest import StandIn
from chromeball.stand_in.depth import distance_map
from chromeball.stand_in.panorama import panorama
from chromeball.stand_in.ply import read_stand_in, write_stand_in
from chromeball.stand_in.primitives import build_mesh, build_piece


def rows(quick: bool) -> list[Row]:
    """A floor drawn and written, and distances to a room against the analytic slabs."""
    repeats = 3 if quick else 10
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "floor.ply"
        entry = StandIn(name="floor", kind="plane", size=(4.0, 4.0))
        floor = _best(lambda: write_stand_in(target, build_mesh([build_piece(entry)])), repeats)
        corners = read_stand_in(target).vertices
    off = float(np.abs(np.abs(corners) - [2, 0, 2]).max())
    width = 512 if quick else 1024
    low, high = np.array([-2.0, 0.0, -3.0]), np.array([3.0, 2.6, 1.5])
    room = StandIn(
        name="room",
        kind="room",
        corners=[(-2.0, -3.0), (-2.0, 1.5), (3.0, 1.5), (3.0, -3.0)],
        height=2.6,
    )
    mesh = build_mesh([build_piece(room)])
    origin = np.array([0.3, 1.2, -0.4])
    camera = panorama((width, width // 2), origin)
    seconds = _best(lambda: distance_map(mesh, camera), repeats)
    rays = camera.rays(camera.pixel_grid())
    exact = np.maximum((low - origin) / rays, (high - origin) / rays).min(axis=-1)
    error = float(np.abs(distance_map(mesh, camera) / exact - 1).max())
    return [
        Row("stand_in", "floor-only scene, 2 triangles", "chromeball", floor, off, "corner, m"),
        Row(
            "stand_in",
            f"light-depth map {width} x {width // 2}, 12 triangles",
            "chromeball",
            seconds,
            error,
            "largest relative error of the distance",
        ),
    ]


def _best(work: Callable[[], object], repeats: int) -> float:
    """CPU seconds of the fastest of `repeats` runs."""
    times: list[float] = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)
