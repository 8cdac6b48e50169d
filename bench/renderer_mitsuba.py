"""The renderer's scenes in tuned Mitsuba 3, two pictures each: with the objects and without.

Tuned is ``multijitter`` and ``mis_compensation``; its defaults need several times as long. The
composite is plate with / without on the floor, our quotient, and the picture itself on the
objects, told apart by their coverage. Mitsuba's map has no place, and its floor a reflectance
in the place of captured radiance: it has the simpler problem, so that each tool is held against
its own converged picture.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from chromeball.bench import mitsuba_peer as peer
from chromeball.bench import renderer_scenes
from chromeball.bench.race import Picture, Runner, converged
from chromeball.bench.renderer_scenes import Setting

#: Reflectance of the ground.
_GROUND = 0.4


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

    def __init__(self, setting: Setting, plate: Picture) -> None:
        assert setting.surfaces is not None
        parts: dict[str, Any] = {
            "sky": peer.environment(setting.captured.environment, mis_compensation=True),
            "floor": peer.shape("floor", setting.floor(), peer.diffuse(_GROUND)),
        }
        camera = setting.camera
        pose, angle = camera.world_from_camera, renderer_scenes.fov(camera)
        sensor = peer.pinhole(camera.size, angle, pose, "multijitter")
        self._before = peer.scene(sensor, parts, setting.depth)
        for k, (mesh, bsdf) in enumerate(zip(setting.objects, setting.surfaces, strict=True)):
            parts[f"object{k}"] = peer.shape(f"object{k}", mesh, bsdf)
        self._after = peer.scene(sensor, parts, setting.depth)
        self._plate, self._alpha = plate, setting.coverage()[..., None]

    def composites(self, samples: int, seed: int) -> Iterator[Picture]:
        """(H, W, 3) by two pictures of one seed, then the same with both denoised."""
        with_, without = (peer.render(s, samples, seed) for s in (self._after, self._before))
        yield self._blend(with_, without)
        import pyoidn

        yield self._blend(*(pyoidn.denoise(p, hdr=True) for p in (with_, without)))

    def _blend(self, with_: Picture, without: Picture) -> Picture:
        floor = self._plate * (with_ / np.maximum(without, 1e-6))
        found = self._alpha * with_ + (1 - self._alpha) * floor
        return np.maximum(found, 0).astype(np.float32)


def runners(setting: Setting, plate: Picture, quick: bool) -> list[Runner]:
    """Tuned Mitsuba on a scene over `plate`; none where it does not run."""
    name = variant()
    if name is None:
        return []
    mi = peer.load(name)
    pair = Pair(setting, plate)
    each, passes = (32, 1) if quick else (64, 4)

    def half(seed: int) -> Picture:
        seeds = (1000 * seed + k for k in range(passes))
        return np.mean([next(pair.composites(each, s)) for s in seeds], axis=0)

    code = [Path(str(m.__file__)).read_bytes() for m in (peer, renderer_scenes)]
    key = [*code, Path(__file__).read_bytes(), mi.__version__, name, each, passes, plate]
    truth = converged(f"mitsuba-{setting.name()}", key, half)
    for _ in pair.composites(1, 0):  # compiled
        pass

    def runner(samples: int) -> Runner:
        def run() -> Iterator[tuple[str, str, Picture]]:
            note = f"{name}, 2 x {samples} samples"
            for tool, picture in zip(
                ("Mitsuba 3 tuned", "Mitsuba 3 tuned + OIDN"),
                pair.composites(samples, 0),
                strict=True,
            ):
                yield tool, note, picture

        return Runner(run, truth)

    return [runner(n) for n in ((4, 16) if quick else (4, 16, 64, 256))]
