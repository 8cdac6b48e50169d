"""Broken mesh files and degenerate worlds against the core with its sanitizers on.

``make sanitize`` builds the core for it and runs it: until the time is up, or until a sanitizer
ends it, or an error that is no refusal does. Every case follows from its number, which is told.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import random
import sys
import tempfile
import time
from contextlib import redirect_stderr
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

type Numbers = NDArray[np.float32]

#: From what the numbers of a strange world are drawn, beside ordinary ones.
STRANGE = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e-38, 1e-20, 1e-7, 1e4, 1e7, 9e7, -9e7)
FAR = (*STRANGE, 1e18, 1e20, 3e38, -3e38)
TILES = (8, 6)


def preload(build: Path) -> list[ModuleType]:
    """The kernels of `build` in place of those that are installed."""
    loaded: list[ModuleType] = []
    for name in ("core", "files"):
        (file,) = (build / "renderer/renderer").glob(f"{name}.*.so")
        spec = importlib.util.spec_from_file_location(f"chromeball.renderer.{name}", file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        sys.modules[f"chromeball.renderer.{name}"] = module
        loaded.append(module)
    return loaded


def numbers(
    rng: random.Random,
    *shape: int,
    strange: float = 0.1,
    among: tuple[float, ...] = STRANGE,
) -> Numbers:
    """Of about 1, some of them not."""
    flat = [
        rng.choice(among) if rng.random() < strange else rng.gauss(0, 1)
        for _ in range(int(np.prod(shape)))
    ]
    return np.array(flat, np.float32).reshape(shape)


def strange_material(rng: random.Random) -> Any:
    """Any material that is not refused."""
    from chromeball.renderer.material import Material, Texture, Wrap

    def share() -> float:
        return rng.choice([0.0, 1.0, 1e-3, rng.random()])

    def texture(channels: int) -> Texture | None:
        if rng.random() < 0.6:
            return None
        pixels = np.abs(numbers(rng, rng.randint(1, 3), rng.randint(1, 3), channels))
        wraps: tuple[Wrap, ...] = get_args(Wrap.__value__)
        return Texture(pixels, (rng.choice(wraps), rng.choice(wraps)))

    return Material(
        (share(), share(), share()),
        metallic=share(),
        roughness=share(),
        specular=share(),
        ior=rng.choice([1.0, 1.5, 4.0]),
        transmission=share(),
        thin=rng.random() < 0.3,
        clearcoat=share(),
        clearcoat_roughness=share(),
        emission=(rng.choice([0.0, 0.0, 1.0, 1e30]), 0.0, 1.0 * (rng.random() < 0.1)),
        alpha=share(),
        alpha_mode=rng.choice(["opaque", "mask", "blend"]),
        alpha_cutoff=share(),
        base_color_texture=texture(4),
        metallic_roughness_texture=texture(3),
        normal_texture=texture(3),
        emission_texture=texture(3),
    )


def strange_mesh(rng: random.Random) -> Any:
    """Slivers, points and doubles of triangles, near, far and tiny."""
    from chromeball.renderer.mesh import Mesh

    count = rng.choice([1, 3, 4, 20])
    strange = rng.choice([0.0, 0.02, 0.3])
    among = rng.choice([STRANGE, STRANGE, FAR])
    vertices = numbers(rng, count, 3, strange=strange, among=among)
    faces = np.array(
        [[rng.randrange(count) for _ in range(3)] for _ in range(rng.randint(0, 30))], np.uint32
    ).reshape(-1, 3)
    normals = None if rng.random() < 0.5 else numbers(rng, count, 3, strange=strange)
    uv = numbers(rng, count, 2, strange=strange, among=FAR)
    return Mesh.of(vertices, faces, material=strange_material(rng), normals=normals, uv=uv)


def look_at(rng: random.Random, objects: list[Any], name: str) -> None:
    """A few samples of each integrator, the objects on a floor, and one of them moved."""
    from chromeball.renderer.composite import CapturedSet, Compositor
    from chromeball.renderer.delta_light import DeltaLight
    from chromeball.renderer.path import corner_rays
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.pose import Pose
    from chromeball.stand_in.ply import StandInMesh

    calm = rng.random() < 0.7
    strange = 0.0 if calm else 0.2
    w, h = rng.choice([(2, 1), (4, 2), (64, 32)])
    sky = np.minimum(np.abs(numbers(rng, h, w, 3, strange=strange)), np.float32(1e30))
    corners = np.array([[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], np.float32)
    moved = corners if calm else corners + numbers(rng, 4, 3, strange=strange)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    surface = np.array([rng.randrange(2), 0], np.uint8)
    floor = None if rng.random() < 0.2 else StandInMesh(moved, corners, faces, surface)
    origin = np.array([0.0, rng.choice([1.0, 0.0, 1e-6, 1e4]), 0.0])
    eye = np.array([rng.gauss(0, 1), rng.choice([1.0, 0.0, 1e-4]), 3.0])
    pose = Pose.look_at(eye, np.array([0.0, 0.2, 0.0]))
    camera = (
        CameraModel.pinhole(TILES, 0.9, pose)
        if rng.random() < 0.7
        else CameraModel.fisheye("equisolid", TILES, 3.1, pose=pose)
    )
    lights = [
        DeltaLight((0.5, rng.choice([1.0, 0.0]), 0.0), (1.0, 2.0, 3.0)),
        DeltaLight(None, (1.0, 1.0, 1.0)),
    ][: rng.randint(0, 2)]
    job = Compositor(
        objects,
        CapturedSet(sky, origin, floor),
        corner_rays(camera),
        eye,
        np.abs(numbers(rng, TILES[1], TILES[0], 3)),
        bounces=rng.randint(0, 3),
        samples=4,
        lights=lights,
        integrator="path" if name == "path" else "direct",
    )
    job.add(rng.choice([1, 4, 17]))
    job.result()
    if objects:
        job.move(0, Pose(np.eye(3), np.array([0.1, 0.0, 0.0])), 0.5)
        job.add(2)
        job.picture()


def damaged_file(rng: random.Random, folder: Path, bases: dict[str, bytes]) -> list[Any]:
    """What is read of a mesh file with words put in, bytes taken out, copied and flipped."""
    from chromeball.renderer.assets import read_parts
    from chromeball.renderer.mesh import Instance
    from chromeball.renderer.scene import to_mesh
    from tests.renderer.test_asset_fuzz import WORDS, damaged

    name = rng.choice(list(bases))
    damage = [
        (rng.randint(0, 4), rng.randrange(1 << 16), rng.randint(1, 24), rng.choice(WORDS))
        for _ in range(rng.randint(1, 6))
    ]
    (folder / name).write_bytes(damaged(bases[name], damage))
    file = folder / ("board.obj" if name.endswith(".mtl") else name)
    try:
        parts = read_parts(file)
    finally:
        (folder / name).write_bytes(bases[name])
    return [Instance(to_mesh(part), inner=part.pose) for part in parts]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("build", type=Path, help="the build folder with the sanitizers on")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--first", type=int, default=0, help="the number of the first case")
    parser.add_argument("--cases", type=int, default=10**9)
    options = parser.parse_args()
    kernels = preload(options.build)

    from chromeball.renderer import composite, read_obj
    from chromeball.scene.errors import UserError
    from tests.renderer.asset_files import picture
    from tests.renderer.test_asset_fuzz import BASES
    from tests.renderer.test_assets import MTL

    # not those that are installed
    assert [composite.core, read_obj.files] == kernels
    start, case, done, refused = time.monotonic(), options.first, 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        picture(folder / "wood.png", np.full((2, 2, 3), 99, np.uint8))
        bases = {"wood.mtl": MTL.encode()} | {k: base(folder) for k, base in BASES.items()}
        for file, content in bases.items():
            (folder / file).write_bytes(content)
        while time.monotonic() - start < options.seconds and done < options.cases:
            rng = random.Random(case)
            # the number is on the screen before the core may end the process
            print(f"\rcase {case} ", end="", file=sys.stderr, flush=True)
            try:
                with redirect_stderr(io.StringIO()):
                    objects = (
                        damaged_file(rng, folder, bases)
                        if case % 2
                        else [strange_mesh(rng) for _ in range(rng.randint(0, 3))]
                    )
                    for integrator in ("path", "direct"):
                        look_at(rng, objects, integrator)
            except UserError:
                refused += 1
            case, done = case + 1, done + 1
    print(f"\r{done} cases, {refused} of them refused, no fault", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
