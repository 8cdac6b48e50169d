"""The renderer: time against error in three scenes, beside tuned Mitsuba, and what frames cost.

The error is the RMS difference in 8-bit sRGB codes from the tool's own converged picture: that
the pictures agree is the matter of the tests and of :func:`_bias_rows`. The time is that of a
frame; scenes are loaded, lists of lamps are drawn.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from chromeball.bench import renderer_cost, renderer_mitsuba, renderer_rays, renderer_scenes
from chromeball.bench.race import Picture, Runner, Truth, converged, race
from chromeball.bench.renderer_scenes import WORDS, Setting, hotel, outdoors, room
from chromeball.bench.row import Row
from chromeball.renderer import core
from chromeball.renderer.composite import Compositor
from chromeball.renderer.denoise import denoise
from chromeball.scene.errors import UserError

#: Samples of the pass before ``path`` steers by what it saw, and of each one after it.
_PASS = 8


def rows(quick: bool) -> list[Row]:
    """Rays, scenes, bias, then what it costs."""
    if not renderer_scenes.DATA.is_dir():
        raise UserError("its scene is not there", file=renderer_scenes.DATA)
    found = renderer_rays.rows(quick)
    still = hotel("direct")
    found += renderer_cost.rows(still, _truth(still, "direct", quick), quick)
    for setting in (still, hotel("diffuse"), outdoors(), room()):
        found += _direct_rows(setting, quick)
    found += _path_rows(hotel("mg"), (4,) if quick else (2, 4, 8, 16), quick)
    for setting in (outdoors(), room()):
        found += _path_rows(setting, (4,) if quick else (4, 16, 64), quick)
    return found + _bias_rows(quick)


def _direct_rows(setting: Setting, quick: bool) -> list[Row]:
    """The direct integrator and, where it can do the same, Mitsuba."""
    truth = _truth(setting, "direct", quick)
    job = setting.job(0, 16, integrator="direct")
    job.add(1)  # lists of lamps drawn

    def runner(samples: int) -> Runner:
        def run() -> Iterator[tuple[str, str, Picture]]:
            job.restart()
            job.add(samples)
            picture = job.picture()
            millions = job.rays_traced / 1e6
            yield "chromeball direct", f"{samples} samples, {millions:.2f} M rays", picture

        return Runner(run, truth)

    runners = [runner(n) for n in ((1, 2, 4, 8) if quick else (1, 2, 3, 4, 8, 16))]
    if setting.surfaces is not None:
        runners += renderer_mitsuba.runners(setting, job.plate, quick)
    return race(setting.what, runners, quick)


def _path_rows(setting: Setting, samples: tuple[int, ...], quick: bool) -> list[Row]:
    """The path integrator without and with OIDN; beside Mitsuba where direct cannot be."""
    truth = _truth(setting, "path", quick)
    job = setting.job(0, max(samples))

    def runner(count: int) -> Runner:
        def run() -> Iterator[tuple[str, str, Picture]]:
            job.restart()
            _sample(job, count)
            composite = job.result()
            note = f"{count} samples, {job.rays_traced / 1e6:.1f} M rays"
            yield "chromeball path", note, composite.rgb
            yield "chromeball path + OIDN", note, denoise(composite, job.plate).rgb

        return Runner(run, truth)

    runners = [runner(n) for n in samples]
    if setting.what.endswith(WORDS["mg"]):
        runners += renderer_mitsuba.runners(setting, job.plate, quick)
    return race(setting.what, runners, quick)


def _bias_rows(quick: bool) -> list[Row]:
    """Mean quotient of the floor, direct against path, where the objects change it."""
    found: list[Row] = []
    for variant in ("direct", "diffuse"):
        setting = hotel(variant)
        truth = setting.job(1, 16)
        truth.add(8 if quick else 32)
        a = truth.result()
        ratios: list[float] = []
        start = time.process_time()
        for seed in range(4 if quick else 16):
            job = setting.job(seed, 16, integrator="direct")
            job.add(16)
            b = job.result()
            floor = (a.alpha == 0) & (b.alpha == 0) & b.changed
            ratios.append(float(b.quotient[floor].mean() / a.quotient[floor].mean()))
        seconds = (time.process_time() - start) / len(ratios)
        bias = float(np.mean(ratios)) - 1
        scatter = float(np.std(ratios, ddof=1))
        floor = (a.alpha == 0) & a.changed
        noise = float(np.sqrt(np.mean(a.standard_error[floor] ** 2) / floor.sum()))
        noise /= float(a.rgb[floor].mean())
        note = (
            f"mean of {len(ratios)} seeds of 16 samples that scatter by {scatter:.1e}; "
            f"the path's own noise {noise:.1e}"
        )
        what, unit = f"mean floor ratio, {WORDS[variant]}", "of the path integrator's"
        found.append(Row("renderer", what, "chromeball direct", seconds, abs(bias), unit, note))
    return found


def _truth(setting: Setting, integrator: Literal["direct", "path"], quick: bool) -> Truth:
    """Our own picture after many samples, not filtered."""
    samples = {"direct": 16, "path": 4} if quick else {"direct": 128, "path": 64}
    count = samples[integrator]

    def half(seed: int) -> Picture:
        job = setting.job(seed, count, integrator=integrator, filtered=False)
        _sample(job, count)
        return job.picture()

    library = Path(str(core.__file__)).read_bytes()
    scenes = Path(str(renderer_scenes.__file__)).read_bytes()
    key = [hashlib.sha256(library).digest(), scenes, count, _PASS]
    return converged(f"{integrator}-{setting.name()}", key, half)


def _sample(job: Compositor, samples: int) -> None:
    while job.samples < samples:
        job.refine(min(_PASS, samples - job.samples))
