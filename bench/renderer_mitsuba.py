"""The renderer's scenes in tuned Mitsuba 3, two pictures each: with the objects and without.

Tuned is ``multijitter`` and ``mis_compensation``; its defaults need several times as long. The
composite is plate with / without on the floor, our quotient, and the picture itself on the
objects, told apart by the coverage that our own composite has. Mitsuba's map has no place, and
its floor a reflectance in the place of captured radiance: it has the simpler problem, so that
each tool is held against its own converged picture.
"""

from __future__ import annotations

import hashlib
import math
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.bench import mitsuba_peer as peer
from chromeball.bench.row import Row
from chromeball.renderer import core
from chromeball.renderer.mesh import Mesh
from chromeball.scene.color import srgb_encode
from chromeball.scene.pose import Pose

type Picture = NDArray[np.float32]

#: What is expensive is kept between runs, until scene or code change.
CACHE = Path(__file__).resolve().parents[1] / "build/bench"


@dataclass(frozen=True)
class Scene:
    """A scene for both: objects with their Mitsuba surfaces on a floor under a map."""

    what: str
    objects: list[Mesh]
    surfaces: list[peer.Entry]
    floor: Mesh
    sky: Picture
    size: tuple[int, int]
    fov: float
    pose: Pose
    plate: Picture
    #: edges of Mitsuba's paths: 2 is direct light
    depth: int


def variant() -> str | None:
    """The variant of Mitsuba that runs here; LLVM's where its library does, none without it.

    Tried in a process of its own, which LLVM may end.
    """
    for name in ("llvm_ad_rgb", "scalar_rgb"):
        code = (
            f"import mitsuba as mi; mi.set_variant({name!r}); "
            "mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy() "
            "if 'llvm' in mi.variant() else None"
        )
        if subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0:
            return name
    return None


class Pair:
    """Both scenes, loaded."""

    def __init__(self, scene: Scene, alpha: Picture) -> None:
        parts: dict[str, Any] = {
            "sky": peer.environment(scene.sky, mis_compensation=True),
            "floor": peer.shape("floor", scene.floor, peer.diffuse(0.4)),
        }
        sensor = peer.pinhole(scene.size, scene.fov, scene.pose, "multijitter")
        self._before = peer.scene(sensor, parts, scene.depth)
        for k, (mesh, bsdf) in enumerate(zip(scene.objects, scene.surfaces, strict=True)):
            parts[f"object{k}"] = peer.shape(f"object{k}", mesh, bsdf)
        self._after = peer.scene(sensor, parts, scene.depth)
        self._plate, self._alpha = scene.plate, alpha[..., None]

    def composite(self, samples: int, seed: int, *, denoised: bool = False) -> Picture:
        """(H, W, 3), by two pictures of one seed."""
        with_, without = (
            peer.render(scene, samples, seed) for scene in (self._after, self._before)
        )
        if denoised:
            import pyoidn

            with_, without = (pyoidn.denoise(p, hdr=True) for p in (with_, without))
        floor = self._plate * (with_ / np.maximum(without, 1e-6))
        found = self._alpha * with_ + (1 - self._alpha) * floor
        return np.maximum(found, 0).astype(np.float32)


def rows(scene: Scene, alpha: Picture, quick: bool) -> list[Row]:
    """Tuned Mitsuba's rows of a scene whose coverage by objects is `alpha` (H, W)."""
    name = variant()
    if name is None:
        return []
    mi = peer.load(name)
    pair = Pair(scene, alpha)
    passes, each = (2, 64) if quick else (16, 64)

    def halves() -> Picture:
        pictures = [pair.composite(each, 1000 + k) for k in range(passes)]
        return np.array([np.mean(pictures[k::2], axis=0) for k in (0, 1)], np.float32)

    key: list[Any] = [
        Path(__file__).read_text(),
        mi.__version__,
        name,
        scene.what,
        scene.depth,
        passes * each,
        alpha,
        scene.plate,
    ]
    key += [a for m in scene.objects for a in (m.vertices, m.faces)] + [scene.sky]
    first, second = cached(f"mitsuba-{scene.what}", key + [repr(scene.surfaces)], halves)
    truth, noise = codes((first + second) / 2), rms(codes(first) - codes(second)) / 2
    pair.composite(1, 0)  # compiled
    found: list[Row] = []
    for samples in (4, 16) if quick else (4, 16, 64, 256):
        for denoised in (False, True):
            start = time.process_time()
            picture = pair.composite(samples, 0, denoised=denoised)
            seconds = time.process_time() - start
            tool = f"Mitsuba 3 tuned{' + OIDN' if denoised else ''}"
            note = f"{name}, 2 x {samples} samples; the truth's own noise {noise:.2f}"
            error = rms(codes(picture) - truth)
            found.append(Row("renderer", scene.what, tool, seconds, error, "8-bit codes", note))
    return found


def cached(name: str, key: list[Any], make: Callable[[], Picture]) -> Picture:
    """What `make` made for this key, in this run or in one before."""
    digest = hashlib.sha256()
    for part in key:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    slug = "".join(c if c.isalnum() else "-" for c in name)
    file = CACHE / f"{slug}-{digest.hexdigest()[:16]}.npy"
    if not file.is_file():
        CACHE.mkdir(parents=True, exist_ok=True)
        picture = make()
        partial = file.with_suffix(".part.npy")
        np.save(partial, picture)
        partial.replace(file)
    return np.load(file)


def code_version() -> str:
    """Changes with the C++ core."""
    file = core.__file__
    assert file is not None
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def codes(rgb: Picture) -> NDArray[Any]:
    """8-bit sRGB codes, not rounded."""
    return 255 * srgb_encode(np.clip(rgb, 0, 1))


def rms(x: NDArray[Any]) -> float:
    """Root mean square."""
    return math.sqrt(float(np.mean(np.square(x, dtype=float))))
