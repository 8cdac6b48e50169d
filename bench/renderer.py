"""The renderer: shadow rays beside a bare Embree loop, and time against error.

The scene of ``data/render`` (200,000 triangles on a floor in a real room's light, 640 x 480)
is compared with its own converged picture; the error is the RMS difference in 8-bit sRGB codes.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from chromeball.bench import mitsuba_peer as peer
from chromeball.bench import renderer_mitsuba
from chromeball.bench.renderer_mitsuba import Picture, cached, code_version, codes, rms
from chromeball.bench.row import Row
from chromeball.renderer.composite import CapturedSet, Compositor, Integrator
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import sphere
from chromeball.renderer.scene import read_mesh
from chromeball.renderer.shadow_bench import ShadowBench
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import read_rgb
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import SUPPORT, StandInMesh

DATA = Path(__file__).resolve().parents[2] / "shared/data/render"
WORDS = {"direct": "direct light", "diffuse": "one bounce", "mg": "mirror and glass"}
#: The scene's axes, z up, to ours: its map's middle, +X, is our +Z.
TURN = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def rows(quick: bool) -> list[Row]:
    """Shadow rays, then the scene's variants at a few sample counts, then what it costs."""
    if not DATA.is_dir():
        return []
    scene: dict[str, Any] = json.loads((DATA / "scene.json").read_text())
    found = shadow_rows(quick) + load_rows()
    for variant in ("direct", "diffuse"):
        found += direct_rows(scene, variant, quick) + mitsuba_rows(scene, variant, quick)
    found += path_rows(scene, "mg", quick) + mitsuba_rows(scene, "mg", quick)
    found += bias_rows(scene, quick) + frame_rows(scene, quick)
    return found + triangle_rows(scene, quick) + size_rows(scene, quick)


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


def direct_rows(scene: dict[str, Any], variant: str, quick: bool) -> list[Row]:
    """The direct integrator against its own converged, unfiltered picture of another seed.

    That its mean is right is the matter of :func:`bias_rows`. The time is that of a frame; the
    scene is loaded, the lists of lamps are drawn.
    """
    count = 64 if quick else 512

    def converged() -> Picture:
        reference = _compositor(scene, variant, 1, 16, integrator="direct", filtered=False)
        reference.add(count)
        return reference.picture()

    truth = codes(cached(f"direct-{variant}", [code_version(), scene, count], converged))
    job = _compositor(scene, variant, 0, 16, integrator="direct")
    what = f"composite 640x480, {WORDS[variant]}"
    found: list[Row] = []
    for samples in (2, 3, 4, 8, 16):
        seconds, picture = math.inf, job.plate
        for _ in range(2 if quick else 5):
            job.restart()
            start = time.process_time()
            job.add(samples)
            picture = job.picture()
            seconds = min(seconds, time.process_time() - start)
        error = rms(codes(picture) - truth)
        note = f"direct integrator, {samples} samples, {job.rays_traced / 1e6:.2f} M rays"
        found.append(Row("renderer", what, "chromeball", seconds, error, "8-bit codes", note))
    return found


def path_rows(scene: dict[str, Any], variant: str, quick: bool) -> list[Row]:
    """Mirror and glass by the path integrator, against a long run of another seed."""
    count = 16 if quick else 512

    def converged() -> Picture:
        reference = _compositor(scene, variant, 1, 128)
        _passes(reference, count)
        return reference.picture()

    truth = codes(cached(f"path-{variant}", [code_version(), scene, count], converged))
    found: list[Row] = []
    for spp in (4,) if quick else (4, 16, 64):
        job = _compositor(scene, variant, 0, spp)
        start = time.process_time()
        _passes(job, spp)
        error = rms(codes(job.picture()) - truth)
        seconds = time.process_time() - start
        what = f"composite 640x480, {WORDS[variant]}"
        note = f"path integrator, {spp} samples"
        found.append(Row("renderer", what, "chromeball", seconds, error, "8-bit codes", note))
    return found


def bias_rows(scene: dict[str, Any], quick: bool) -> list[Row]:
    """Mean quotient of the floor, direct against path, where the objects change it."""
    found: list[Row] = []
    for variant, what in (("direct", "direct light"), ("diffuse", "one bounce")):
        truth = _compositor(scene, variant, 1, 16)
        truth.add(8 if quick else 32)
        start = time.process_time()
        job = _compositor(scene, variant, 0, 16, integrator="direct")
        job.add(16)
        seconds = time.process_time() - start
        a, b = truth.result(), job.result()
        floor = (a.alpha == 0) & (b.alpha == 0) & b.changed
        bias = float(b.quotient[floor].mean() / a.quotient[floor].mean()) - 1
        noise = float(np.sqrt(np.mean(a.standard_error[floor] ** 2) / floor.sum()))
        noise /= float(a.rgb[floor].mean())
        note = f"of {b.quotient[floor].mean():.3f}; the path's own noise {noise:.1e}"
        found.append(
            Row(
                "renderer",
                f"mean floor ratio, {what}",
                "chromeball direct",
                seconds,
                abs(bias),
                "of the path integrator's",
                note,
            )
        )
    return found


def mitsuba_rows(scene: dict[str, Any], variant: str, quick: bool) -> list[Row]:
    """Tuned Mitsuba on the same scene, straight after ours."""
    materials = scene["variants"][variant]
    size, fov, pose = _camera(scene)
    job = _compositor(scene, variant, 0, 16)
    job.add(16)

    def surface(kind: str, value: Any) -> peer.Entry:
        match kind:
            case "mirror":
                conductor = {"type": "conductor", "material": "none"}
                return conductor | {"specular_reflectance": peer.rgb(value)}
            case "glass":
                return {"type": "dielectric", "int_ior": value, "ext_ior": 1.0}
            case _:
                return peer.diffuse(value)

    same = renderer_mitsuba.Scene(
        f"composite 640x480, {WORDS[variant]}",
        [_mesh(name, *materials[name]) for name in ("spot", "knot")],
        [surface(*materials[name]) for name in ("spot", "knot")],
        _mesh("floor", "diffuse", 0.4),
        read_rgb(DATA / "hotel_room.exr"),
        size,
        fov,
        pose,
        read_rgb(DATA / "plate.exr"),
        {"direct": 2, "diffuse": 3, "mg": 10}[variant],
    )
    return renderer_mitsuba.rows(same, job.result().alpha, quick)


def load_rows() -> list[Row]:
    """From files to the first composite in a fresh process, Python's imports apart."""
    found: list[Row] = []
    for cores in (1, 2):
        code = "from chromeball.bench.renderer import first_composite; first_composite()"
        done = subprocess.run(
            ["taskset", "-c", ",".join(map(str, sorted(os.sched_getaffinity(0))[:cores]))]
            + [sys.executable, "-c", code],
            check=True,
            capture_output=True,
            text=True,
        )
        told = json.loads(done.stdout)
        note = (
            f"{cores} core(s), {told['wall']:.2f} s by the clock, of the CPU "
            f"{told['built']:.2f} s until the scene stands; memory grows by "
            f"{told['grown']:.0f} MB over {told['imports']:.0f} MB of Python and its imports; "
            f"then {told['fps']:.1f} frames of 4 samples a second"
        )
        what = "files to first composite, 200,000 triangles, fresh process"
        found.append(Row("renderer", what, "chromeball", told["cpu"], math.nan, "", note))
    return found


def first_composite() -> None:
    """What a fresh process needs for its first composite, as JSON on stdout."""
    scene: dict[str, Any] = json.loads((DATA / "scene.json").read_text())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    cpu, wall = time.process_time(), time.perf_counter()
    job = _compositor(scene, "direct", 0, 4, integrator="direct")
    built = time.process_time() - cpu
    job.add(4)
    job.picture()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    fps = 1 / min(_frame(job, 4)[1] for _ in range(5))
    told = {"cpu": cpu, "wall": wall, "built": built, "fps": fps}
    print(json.dumps(told | {"grown": (after - before) / 1024, "imports": before / 1024}))


def _frame(job: Compositor, samples: int) -> tuple[float, float]:
    """CPU seconds and seconds by the clock of one frame from nothing."""
    cpu, wall = time.process_time(), time.perf_counter()
    job.restart()
    job.add(samples)
    job.picture()
    return time.process_time() - cpu, time.perf_counter() - wall


def frame_rows(scene: dict[str, Any], quick: bool) -> list[Row]:
    """Frames while an object moves, and the thesis's car: 32 light samples a pixel.

    The frames a second are by the clock, on all cores that this process may use.
    """
    found: list[Row] = []
    count = 5 if quick else 20
    cores = len(os.sched_getaffinity(0))
    for what, samples in (("interactive frame", 2), ("interactive frame", 3), ("car", 32)):
        job = _compositor(scene, "direct", 0, samples, integrator="direct")
        cpu: list[float] = []
        wall: list[float] = []
        for k in range(count):
            pose = Pose(np.eye(3), np.array([0.002 * k, 0.0, 0.0]))
            start = time.process_time(), time.perf_counter()
            job.move(0, pose)
            job.add(samples)
            job.picture()
            cpu.append(time.process_time() - start[0])
            wall.append(time.perf_counter() - start[1])
        note = (
            f"{samples} samples, object moved each frame: {1 / min(wall):.1f} frames a "
            f"second on {cores} cores at best, {1 / float(np.median(wall)):.1f} in the median"
        )
        title = {
            "car": "the thesis's set-up: 200,000 triangles, 32 light samples, 640x480",
            "interactive frame": "interactive frame, 640x480, 200,000 triangles",
        }[what]
        found.append(Row("renderer", title, "chromeball", min(cpu), math.nan, "", note))
    return found


def size_rows(scene: dict[str, Any], quick: bool) -> list[Row]:
    """What a frame costs with the number of pixels."""
    found: list[Row] = []
    for share in (0.25, 0.5, 1.0) if quick else (0.25, 0.5, 1.0, 2.0, 4.0):
        view = scene["camera"] | {
            "width": int(640 * share),
            "height": int(480 * share),
        }
        smaller = scene | {"camera": view}
        plate = np.full((view["height"], view["width"], 3), 0.3, np.float32)
        job = _compositor(smaller, "direct", 0, 4, integrator="direct", plate=plate)
        seconds = min(_frame(job, 4)[0] for _ in range(3))
        pixels = view["width"] * view["height"]
        note = f"4 samples, {seconds / pixels * 1e9:.0f} ns a pixel"
        what = f"one frame, {pixels:,} pixels"
        found.append(Row("renderer", what, "chromeball", seconds, math.nan, "", note))
    return found


def triangle_rows(scene: dict[str, Any], quick: bool) -> list[Row]:
    """What a frame costs with the number of triangles: spheres that look alike."""
    found: list[Row] = []
    for rings in (16, 50, 158) if quick else (16, 50, 158, 500, 1581):
        vertices, faces, normals = sphere(rings, 2 * rings)
        mesh = Mesh.of(vertices * np.float32(1.2), faces, 0.5, normals=normals)
        start = time.process_time()
        job = _compositor(scene, "direct", 0, 4, integrator="direct", objects=[mesh])
        built = time.process_time() - start
        seconds = math.inf
        for _ in range(3):
            job.restart()
            start = time.process_time()
            job.add(4)
            job.picture()
            seconds = min(seconds, time.process_time() - start)
        what = f"one frame, {len(faces):,} triangles"
        note = f"{built:.2f} s to build, {job.rays_traced / seconds / 1e6:.1f} Mrays a CPU s"
        found.append(Row("renderer", what, "chromeball", seconds, math.nan, "", note))
    return found


def _passes(job: Compositor, samples: int) -> None:
    while job.samples < samples:
        job.refine(min(16, samples - job.samples))


def _mesh(name: str, kind: str, value: Any) -> Mesh:
    vertices, faces, _ = read_mesh(DATA / f"{name}.ply")
    color, ior = (value, 1.5) if kind != "glass" else (1.0, value)
    turned = (vertices @ TURN.T).astype(np.float32)
    return Mesh.of(turned, faces, color, kind=Kind[kind.upper()], ior=ior)


def _camera(scene: dict[str, Any]) -> tuple[tuple[int, int], float, Pose]:
    view = scene["camera"]
    size = (int(view["width"]), int(view["height"]))
    pose = Pose.look_at(TURN @ np.array(view["position"]), TURN @ np.array(view["target"]))
    fov = 2 * math.atan(math.tan(math.radians(view["vfov_deg"]) / 2) * size[0] / size[1])
    return size, fov, pose


def _compositor(
    scene: dict[str, Any],
    variant: str,
    seed: int,
    samples: int,
    *,
    integrator: Integrator = "path",
    filtered: bool = True,
    objects: list[Mesh] | None = None,
    plate: Picture | None = None,
) -> Compositor:
    materials = scene["variants"][variant]
    size, fov, pose = _camera(scene)
    ground = _mesh("floor", "diffuse", 0.4)
    surface = np.full(len(ground.faces), SUPPORT, np.uint8)
    floor = StandInMesh(ground.vertices, ground.vertices, ground.faces, surface)
    captured = CapturedSet(read_rgb(DATA / "hotel_room.exr"), np.array([0.0, 1.0, 0.0]), floor)
    if objects is None:
        objects = [_mesh(name, *materials[name]) for name in ("spot", "knot")]
    return Compositor(
        objects,
        captured,
        corner_rays(CameraModel.pinhole(size, fov, pose)),
        pose.translation,
        read_rgb(DATA / "plate.exr") if plate is None else plate,
        bounces=min(int(materials["indirect_bounces"]), 4),
        seed=seed,
        samples=samples,
        integrator=integrator,
        filtered=filtered,
    )
