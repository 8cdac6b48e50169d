"""Merges: CPU seconds against error, beside OpenCV and numpy.

Pictures of the emulated camera of `bench.hdr`: DoRF curves, real radiance maps, full well
15000 e-, read noise 5 e-, 8 bits. The oracle knows the true curve, and the true noise at the
true exposure of every sample.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.bench import hdr as room
from chromeball.bench import hdr_solvers as solvers
from chromeball.bench.row import Row
from chromeball.hdr.merge import code_weights, merge_frames, merge_linear
from chromeball.hdr.noise import lattice, measure_codes, unsaturated
from chromeball.hdr.prior import Prior
from chromeball.hdr.response import sample, solve
from chromeball.hdr.response_file import Response
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]

#: size of the pictures that are merged against the oracle
ORACLE_MEGAPIXELS = 0.1


def rows(quick: bool = False) -> list[Row]:
    """Speed and memory, the error over the oracle's, the RAW merge over its bound."""
    return [*speed_rows(quick), *bound_rows(quick), *oracle_rows(quick)]


def speed_rows(quick: bool) -> list[Row]:
    """7 frames of 12 MP in three depths: each in a process of its own, for its peak memory."""
    megapixels = 2.0 if quick else 12.0
    found: list[Row] = []
    for tool in ("u8", "u16", "f32", "OpenCV Debevec", "OpenCV Robertson", "numpy"):
        words = [sys.executable, "-m", "chromeball.bench.hdr_merge", tool, str(megapixels)]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        seconds, error, extra = map(float, done.stdout.split())
        name = f"chromeball {tool}" if len(tool) <= 3 else tool
        note = f"{7 * megapixels / seconds:.0f} MP-exposures/s, memory {extra:.2f} x output"
        what = f"merge, 7 x {megapixels:g} MP"
        found.append(Row("hdr", what, name, seconds, error, "ln RMS", note))
    return found


def oracle_rows(quick: bool) -> list[Row]:
    """RMS of ln radiance over the oracle's: with the true curves, and with solved ones.

    Our noise is measured from the bracket. Solved curves are each tool's own from the same
    frames, ours by a prior of other families (see `hdr_response`); CPU seconds are the
    merge's.
    """
    numbers = np.linspace(0, 110, 4 if quick else 20).astype(int)
    maps = room.MAPS[:2] if quick else room.MAPS
    true = ("chromeball", "chromeball, constant code noise", "OpenCV Debevec", "numpy, hat")
    solved = ("chromeball", "OpenCV Debevec", "OpenCV Robertson")
    tasks = [("merge, true curve", tool) for tool in true]
    tasks += [("merge, solved curve", tool) for tool in solved]
    ratios: dict[tuple[str, str], list[float]] = {task: [] for task in tasks}
    seconds = dict.fromkeys(tasks, 0.0)
    bad, refused = dict.fromkeys(tasks, 0), dict.fromkeys(tasks, 0)
    where = dict.fromkeys(tasks, "")
    for number in map(int, numbers):
        transfer, truth = room.curve(number)
        for k, name in enumerate(maps):
            radiance = room.radiance(name, ORACLE_MEGAPIXELS)
            bracket = list(room.BRACKETS)[(number + k) % 3]
            times = room.BRACKETS[bracket]
            frames = room.photograph(radiance, transfer, times)
            best, measured = _oracle(frames, times, radiance, transfer, truth[0])
            wanted = _rms(best, radiance, measured)
            for task in tasks:
                what, tool = task
                try:
                    known = (
                        Response.from_log_exposure(np.repeat(truth, 3, axis=0))
                        if what == "merge, true curve"
                        else _solved(tool, frames, times, solvers.unseen(number))
                    )
                except UserError:
                    refused[task] += 1
                    continue
                start = time.process_time()
                merged = _merge(tool, frames, times, known)
                seconds[task] += time.process_time() - start
                bad[task] += int(np.sum(~(np.isfinite(merged) & (merged > 0))))
                ratio = _rms(merged, radiance, measured) / wanted
                if ratio > max(ratios[task], default=0):
                    where[task] = f"curve {number}, {name}, {bracket}"
                ratios[task].append(ratio)
    return [
        Row(
            "hdr",
            task[0],
            task[1],
            seconds[task] / len(ratios[task]),
            float(np.median(ratios[task])),
            "RMS / oracle's, median",
            f"worst {max(ratios[task]):.3f}: {where[task]}; {bad[task]} bad values"
            + (f"; refuses {refused[task]} runs" if refused[task] else ""),
        )
        for task in tasks
    ]


def bound_rows(quick: bool) -> list[Row]:
    """Linear mosaic with its black level against the Cramer-Rao bound, 13 e- to mid."""
    side = 300 if quick else 1000
    well, read = room.FULL_WELL, room.READ_NOISE**2 + 1 / 12
    found: list[Row] = []
    for name, step, count in (("5 x 2 EV", 2.0, 5), ("7 x 1 EV", 1.0, 7)):
        t = np.exp2(step * np.arange(1.0 - count, 1.0))
        for where, level in (("deep shadow", 13.0), ("shadow", 100.0), ("mid", 3000.0)):
            rng = np.random.default_rng(0)
            shape = (count, side, side, 1)
            x = rng.poisson(level * t[:, None, None, None], shape).astype(np.float64)
            x += rng.normal(0, room.READ_NOISE, shape)
            raw = np.clip(np.round(x + 512), 0, well + 512).astype(np.uint16)
            start = time.process_time()
            merged = merge_linear(
                list(raw), t, black=512.0, white=well + 512, noise=(1 / well, read / well**2)
            ).radiance
            seconds = time.process_time() - start
            bound = np.sum(t**2 / (level * t + read)) ** -0.5
            error = merged.astype(np.float64) - level
            found.append(
                Row(
                    "hdr",
                    f"RAW merge, {name}, {where}",
                    "chromeball",
                    seconds,
                    float(np.sqrt(np.mean(error**2)) / bound),
                    "RMS / Cramer-Rao",
                    f"bias {100 * error.mean() / level:+.2f} "
                    f"+- {100 * bound / level / side:.2f} %",
                )
            )
    return found


def _solved(tool: str, frames: room.Frames, times: Float, prior: Prior) -> Response:
    match tool:
        case "OpenCV Debevec":
            g = solvers.opencv_debevec(frames, times, prior)
        case "OpenCV Robertson":
            g = solvers.opencv_robertson(frames, times, prior)
        case _:
            return solvers.as_response(solve([sample(f) for f in frames], times, prior=prior))
    return Response.from_log_exposure(solvers.rising(g))


def _oracle(
    frames: room.Frames, times: Float, radiance: Float, transfer: tuple[Float, Float], g: Float
) -> tuple[Float, NDArray[np.bool_]]:
    """Weights at the true exposure, and where a frame measures a value at all."""
    x, z = transfer
    scale = np.interp(128 / 255, np.maximum.accumulate(z) + 1e-9 * np.arange(len(z)), x)
    exposure = np.exp(g) * scale
    codes = np.stack(frames).astype(np.intp)
    t = times[:, None, None, None]
    true = np.minimum(radiance * t, 4)
    step = np.interp(true, exposure, exposure * np.gradient(g))
    variance = (true * room.FULL_WELL + room.READ_NOISE**2) / room.FULL_WELL**2 + step**2 / 12
    usable = unsaturated(codes, 255) & (codes > 0)
    w = np.where(usable, t**2 / variance, 0)
    total = w.sum(axis=0)
    measured = (total > 0) & (radiance > 0)
    return (w * exposure[codes] / t).sum(axis=0) / np.where(total > 0, total, 1), measured


def _rms(merged: NDArray[Any], radiance: Float, where: NDArray[np.bool_]) -> float:
    error = np.log(np.maximum(merged[where], 1e-12) / radiance[where])
    return float(np.sqrt(np.mean((error - np.median(error)) ** 2)))


def _merge(tool: str, frames: Any, times: Float, known: Response) -> NDArray[Any]:
    match tool:
        case "chromeball":
            rows, columns = lattice(frames[0].shape[:2])
            values = [frame[rows, columns].reshape(-1, 3) for frame in frames]
            noise = measure_codes(values, times, known)
            return merge_frames(
                frames, times, known, tables=code_weights(known, noise)
            ).radiance
        case "numpy" | "numpy, hat":
            g = known.log_exposure[0]
            hat = np.minimum(np.arange(256.0), 255 - np.arange(256.0))
            top, total = np.zeros(frames[0].shape), np.zeros(frames[0].shape)
            for frame, t in zip(frames, times, strict=True):
                w = hat[frame]
                top += w * (g[frame] - np.log(t))
                total += w
            return np.exp(top / np.maximum(total, 1e-12))
        case "OpenCV Debevec" | "OpenCV Robertson":
            curve = np.exp(known.log_exposure.T).astype(np.float32)[:, None]
            make = cv2.createMergeDebevec if "Deb" in tool else cv2.createMergeRobertson
            return np.asarray(make().process(frames, times.astype(np.float32), curve))
        case _:
            return merge_frames(frames, times, known).radiance


def _measure(tool: str, megapixels: float) -> None:
    """Print best CPU seconds of three, the error, memory beyond the input over the output."""
    g = 2.2 * np.log(np.maximum(np.arange(256.0), 0.5) / 128)
    known = Response.from_log_exposure(np.stack([g] * 3))
    times = room.TIMES
    high = int(np.sqrt(megapixels * 1e6 * 0.75))
    y, x = np.linspace(0, 20, high)[:, None, None], np.linspace(0, 20, high * 4 // 3)[:, None]
    radiance = (0.18 * np.exp(np.sin(y) + np.cos(x + np.arange(3)))).astype(np.float32)
    frames: list[NDArray[Any]] = []
    for t in times:
        v = np.clip(radiance * np.float32(t), 0, 1)
        match tool:
            case "u16":
                frames.append((65535 * v + 0.5).astype(np.uint16))
            case "f32":
                frames.append(v)
            case _:
                frames.append((255 * v ** np.float32(1 / 2.2) + 0.5).astype(np.uint8))

    merge: Callable[[], NDArray[Any]] = lambda: _merge(tool, frames, times, known)  # noqa: E731
    if tool in {"u16", "f32"}:
        white = 65535.0 if tool == "u16" else 1.0
        merge = lambda: merge_linear(frames, times, white=white).radiance  # noqa: E731
    ctypes.CDLL(None).malloc_trim(0)  # what was freed before must not serve the merge unseen
    before = _resident("VmRSS")
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # the peak begins anew
    merged, best = merge(), np.inf
    extra = (_resident("VmHWM") - before) / merged.nbytes
    for _ in range(3):
        start = time.process_time()
        merged = merge()
        best = min(best, time.process_time() - start)
    shown = (radiance * times[0] < 0.9) & (radiance * times[-1] > 0.02)
    print(best, _rms(merged, radiance.astype(np.float64), shown), extra)


def _resident(key: str) -> float:
    with open("/proc/self/status") as file:
        return next(1024 * float(line.split()[1]) for line in file if line.startswith(key))


if __name__ == "__main__":
    _measure(sys.argv[1], float(sys.argv[2]))
