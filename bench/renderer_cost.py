"""What frames of the direct integrator cost: loading, moving objects, and curves."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from chromeball.bench.race import Truth
from chromeball.bench.renderer_scenes import Setting, hotel, of_size
from chromeball.bench.row import Point, Row
from chromeball.renderer.composite import Compositor
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.primitives import sphere
from chromeball.scene.pose import Pose

_NO_ERROR = (math.nan, "")
#: Shadow rays that a sample of the set stands for.
_RAYS_A_SAMPLE = 2


def rows(setting: Setting, truth: Truth, quick: bool) -> list[Row]:
    """First composite, moving frames, then against threads, pixels, samples and triangles."""
    found = _load_rows() + _frame_rows(setting, truth, quick)
    return (
        found
        + _size_rows(setting, quick)
        + _sample_rows(setting, quick)
        + _triangle_rows(quick)
    )


def _load_rows() -> list[Row]:
    """From files to the first composite in a fresh process, Python's imports apart."""
    found: list[Row] = []
    available = sorted(os.sched_getaffinity(0))
    for cores in (1, 2):
        if cores > len(available):
            continue
        code = "from chromeball.bench.renderer_cost import fresh; fresh()"
        done = subprocess.run(
            ["taskset", "-c", ",".join(map(str, available[:cores]))]
            + [sys.executable, "-c", code],
            check=True,
            capture_output=True,
            text=True,
        )
        told = json.loads(done.stdout)
        note = (
            f"{cores} core(s), {told['wall']:.2f} s by the clock, of the CPU "
            f"{told['built']:.2f} s until the scene stands; memory grows by "
            f"{told['grown']:.0f} MB over {told['imports']:.0f} MB of Python and its imports"
        )
        what = "files to first composite, 200,000 triangles, fresh process"
        found.append(Row("renderer", what, "chromeball", told["cpu"], *_NO_ERROR, note))
        point = Point("threads", cores, told["frame_wall"], "s by the clock")
        note = f"{cores} thread(s), 4 samples: {1 / told['frame_wall']:.1f} frames a second"
        what = "frame against threads"
        found.append(
            Row("renderer", what, "chromeball", told["frame"], *_NO_ERROR, note, point)
        )
    return found


def fresh() -> None:
    """What a fresh process needs for its first composite and later frames, JSON on stdout."""
    before = _peak_memory()
    cpu, wall = time.process_time(), time.perf_counter()
    job = hotel("direct").job(0, 4, integrator="direct")
    built = time.process_time() - cpu
    job.add(4)
    job.picture()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    grown = _peak_memory() - before
    frames = [_frame(job, 4) for _ in range(12)]
    told = {"cpu": cpu, "wall": wall, "built": built}
    told |= {"frame": min(f[0] for f in frames), "frame_wall": min(f[1] for f in frames)}
    print(json.dumps(told | {"grown": grown, "imports": before}))


def _peak_memory() -> float:
    """MB of this process; getrusage's would begin with its parent's."""
    status = Path("/proc/self/status").read_text().split()
    return int(status[status.index("VmHWM:") + 1]) / 1024


def _frame(job: Compositor, samples: int) -> tuple[float, float]:
    """CPU seconds and seconds by the clock of one frame from nothing."""
    cpu, wall = time.process_time(), time.perf_counter()
    job.restart()
    job.add(samples)
    job.picture()
    return time.process_time() - cpu, time.perf_counter() - wall


def _frame_rows(setting: Setting, truth: Truth, quick: bool) -> list[Row]:
    """Frames while an object moves, and the thesis's car: 32 light samples a pixel.

    The frames a second are by the clock, on all cores that this process may use. The last frame
    has the object where the converged picture has it.
    """
    found: list[Row] = []
    count, cores = 5 if quick else 40, len(os.sched_getaffinity(0))
    car = 32 // _RAYS_A_SAMPLE
    for title, samples in (
        ("interactive frame, 640x480, 200,000 triangles", 1),
        ("interactive frame, 640x480, 200,000 triangles", 2),
        ("the thesis's set-up: 200,000 triangles, 32 light samples, 640x480", car),
    ):
        job = setting.job(0, samples, integrator="direct")
        picture, times = job.plate, np.empty((count, 2))
        for k in range(count):
            pose = Pose(np.eye(3), np.array([0.002 * (count - 1 - k), 0.0, 0.0]))
            start = time.process_time(), time.perf_counter()
            job.move(0, pose)
            job.add(samples)
            picture = job.picture()
            times[k] = time.process_time() - start[0], time.perf_counter() - start[1]
        cpu, wall = times.T
        note = (
            f"{samples} samples, up to {_RAYS_A_SAMPLE * samples} shadow rays a pixel, object "
            f"moved each frame: {1 / wall.min():.1f} frames a second on {cores} threads at "
            f"best, {1 / np.median(wall):.1f} in the median (load {os.getloadavg()[0]:.1f}), "
            f"{cores / cpu.min():.1f} by CPU time"
        )
        error = truth.error(picture)
        row = Row("renderer", title, "chromeball", cpu.min(), error, "8-bit codes", note)
        found.append(row)
    return found


def _size_rows(setting: Setting, quick: bool) -> list[Row]:
    """What a frame costs with the number of pixels."""
    found: list[Row] = []
    sizes = [(160, 120), (320, 240), (640, 480), (1280, 960), (1920, 1440)]
    for width, height in sizes[:3] if quick else sizes:
        job = of_size(setting, width, height).job(0, 4, integrator="direct")
        seconds = _least(job, 4, quick)
        note = f"{width}x{height}, 4 samples, {seconds / (width * height) * 1e9:.0f} ns a pixel"
        found.append(_on_curve("pixels", width * height, seconds, note))
    return _with_exponent(found)


def _sample_rows(setting: Setting, quick: bool) -> list[Row]:
    """What a frame costs with the number of samples."""
    job = setting.job(0, 32, integrator="direct")
    found: list[Row] = []
    for samples in (1, 2, 4, 8, 16, 32):
        seconds = _least(job, samples, quick)
        note = f"{samples} samples, {job.rays_traced / 1e6:.2f} M rays"
        found.append(_on_curve("samples", samples, seconds, note))
    return _with_exponent(found)


def _triangle_rows(quick: bool) -> list[Row]:
    """What a frame costs with the number of triangles: spheres that look alike."""
    found: list[Row] = []
    for rings in (16, 50, 158, 500) if quick else (16, 50, 158, 500, 1581):
        vertices, faces, normals = sphere(rings, 2 * rings)
        ball = Mesh.of(vertices * np.float32(1.2), faces, 0.5, normals=normals)
        start = time.process_time()
        setting = replace(hotel("direct"), objects=[ball])
        job = setting.job(0, 4, integrator="direct")
        built = time.process_time() - start
        seconds = _least(job, 4, quick)
        rate = job.rays_traced / seconds / 1e6
        note = f"{len(faces):,} triangles, {built:.2f} s to build, {rate:.1f} Mrays a CPU s"
        found.append(_on_curve("triangles", len(faces), seconds, note))
    return _with_exponent(found)


def _least(job: Compositor, samples: int, quick: bool) -> float:
    """CPU seconds of the fastest of a few frames."""
    return min(_frame(job, samples)[0] for _ in range(3 if quick else 7))


def _on_curve(along: str, at: int, seconds: float, note: str) -> Row:
    what, point = f"frame against {along}", Point(along, at, seconds)
    return Row("renderer", what, "chromeball", seconds, *_NO_ERROR, note, point)


def _with_exponent(curve: list[Row]) -> list[Row]:
    """The rows, the last with the exponent of the power law through all of them."""
    points = np.log([[r.point.at, r.point.seconds] for r in curve if r.point])
    exponent = float(np.polyfit(points[:, 0], points[:, 1], 1)[0])
    last = curve[-1]
    assert last.point is not None
    note = f"{last.note}; over the curve time grows as {last.point.along}^{exponent:.2f}"
    return [*curve[:-1], replace(last, note=note)]
