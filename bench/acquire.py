"""Wrongly labelled frames after shutter changes: waiting by brightness beside a fixed skip.

Frames waited decide how fast a bracket is; a label is wrong when either field was exposed for
more than 7 % more or less than the take says, and the share of wrong ones is given as its upper
bound at 95 % confidence (Clopper and Pearson 1934). Emulated VISCA camera, 64 x 48 pixels; CPU
seconds are those of one change, the emulated frames included.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import beta

from chromeball.acquire.bracket import capture_bracket
from chromeball.acquire.emulate.camera import VideoCamera
from chromeball.acquire.emulate.direct import DirectCamera
from chromeball.acquire.emulate.sensor import Sensor
from chromeball.acquire.settle import Curve, generic_curve
from chromeball.acquire.visca_packets import MODELS
from chromeball.bench.row import Row

MODEL = MODELS["evi-d100p"]

#: a tool takes a bracket: for each frame what it waited, its label, when it was taken
type Labels = list[tuple[int, float, float]]


def rows(quick: bool) -> list[Row]:
    """One row a tool; each sees the same seeded cameras, in turn."""
    response = Curve(Sensor().log_exposure(), "response")
    tools: dict[str, Callable[[DirectCamera, list[float]], Labels]] = {
        "chromeball, response known": partial(_by_brightness, curve=response),
        "chromeball, response unknown": partial(_by_brightness, curve=generic_curve()),
        **{f"skip {n} frames": partial(_skip, count=n) for n in (2, 4, 8)},
    }
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:48, :64] / 9
    radiance = np.exp(1.6 * (np.sin(x + np.sin(y)) + np.cos(1.3 * y)))[..., None]
    radiance = np.repeat(radiance, 3, axis=2).astype(np.float32)
    seconds, waited = dict.fromkeys(tools, 0.0), dict.fromkeys(tools, 0)
    wrong, changes = dict.fromkeys(tools, 0), 0
    for seed in range(12 if quick else 120):
        times = sorted(
            map(float, rng.choice(MODEL.times[3:16], 5, replace=False)), reverse=True
        )
        changes += len(times)
        for name, tool in tools.items():
            device = DirectCamera(VideoCamera(radiance, MODEL, seed=seed))
            start = time.process_time()
            labels = tool(device, times)
            seconds[name] += time.process_time() - start
            for frames, label, monotonic in labels:
                truth = device.truth(monotonic)
                error = max(abs(math.log(t / label)) for t in (truth.even, truth.odd))
                wrong[name] += error > 0.07
                waited[name] += frames
    return [
        Row(
            stage="acquire",
            what=f"{changes} shutter changes",
            tool=name,
            cpu_seconds=seconds[name] / changes,
            error=100 * float(beta.ppf(0.95, wrong[name] + 1, changes - wrong[name])),
            unit="% wrong labels at most",
            note=f"{wrong[name]} wrong, {waited[name] / changes:.1f} frames waited",
        )
        for name in tools
    ]


def _by_brightness(device: DirectCamera, times: list[float], *, curve: Curve) -> Labels:
    with tempfile.TemporaryDirectory() as folder:
        take = capture_bracket(device, device, times, Path(folder), curve=curve)
    labels: Labels = []
    for frame in take.frames:
        assert frame.row.settle is not None
        assert frame.row.monotonic is not None
        labels.append((frame.row.settle.frames_waited, frame.time, frame.row.monotonic))
    return labels


def _skip(device: DirectCamera, times: list[float], *, count: int) -> Labels:
    labels: Labels = []
    for shutter in times:
        device.set_shutter(shutter)
        for _ in range(count):
            device.grab()
        labels.append((count, shutter, device.grab().monotonic))
    return labels
