"""Response: CPU seconds against error, beside OpenCV; merges are in `hdr_merge`.

Ten DoRF curves (Grossberg and Nayar 2003) photograph real radiance maps: 7 pictures of 1
megapixel, one stop apart, full well 15000 e-, read noise 5 e-, 8 bits. Errors are RMS of ln
exposure over the codes 5 .. 250, zero at code 128.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.hdr.response import sample, solve
from chromeball.scene.image import read_image

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/hdr"
MAPS = (
    "polyhaven_studio",
    "polyhaven_apartment",
    "openexr_Desk",
    "openexr_StillLife",
    "polyhaven_city",
)
TIMES: NDArray[np.float64] = np.exp2(np.arange(-3.0, 4.0))
FULL_WELL, READ_NOISE = 15000.0, 5.0

type Float = NDArray[np.float64]
type Frames = list[NDArray[np.uint8]]


def rows(quick: bool = False) -> list[Row]:
    """The rows of this room; none where the shared data set is absent."""
    if not (DATA / "dorf.npz").is_file():
        return []
    from bench import hdr_merge

    return [*response_rows(quick), *hdr_merge.rows(quick)]


def response_rows(quick: bool) -> list[Row]:
    """Our response beside OpenCV's two, interleaved."""
    megapixels = 0.25 if quick else 1.0
    tools: dict[str, Callable[[Frames], Float]] = {
        "chromeball": _ours,
        "OpenCV Debevec": lambda frames: _opencv(cv2.createCalibrateDebevec(), frames),
        "OpenCV Robertson": lambda frames: _opencv(cv2.createCalibrateRobertson(), frames),
    }
    seconds: dict[str, list[float]] = {name: [] for name in tools}
    errors: dict[str, list[float]] = {name: [] for name in tools}
    _ours(photograph(radiance(MAPS[0], 0.05), curve(0)[0]))  # compiles
    for k, number in enumerate(np.linspace(0, 110, 5 if quick else 10).astype(int)):
        transfer, truth = curve(int(number))
        frames = photograph(radiance(MAPS[k % len(MAPS)], megapixels), transfer)
        for name, tool in tools.items():
            start = time.process_time()
            g = tool(frames)
            seconds[name].append(time.process_time() - start)
            difference = (g - truth)[:, 5:251]
            errors[name].append(float(np.sqrt(np.nanmean(difference**2))))
    wins = int(np.sum(np.array(errors["chromeball"]) < np.array(errors["OpenCV Debevec"])))
    what = f"response, 7 x {megapixels:g} MP"
    return [
        Row(
            "hdr",
            what,
            name,
            float(np.median(seconds[name])),
            float(np.median(errors[name])),
            "ln RMS, median",
            f"worst {max(errors[name]):.4f}"
            + (
                f"; closer than OpenCV Debevec on {wins} of {len(errors[name])}"
                if name == "chromeball"
                else ""
            ),
        )
        for name in tools
    ]


def _ours(frames: Frames) -> Float:
    return solve([sample(frame) for frame in frames], TIMES).g


def _opencv(tool: Any, frames: Frames) -> Float:
    curve = tool.process(frames, TIMES.astype(np.float32)).reshape(256, 3).T
    with np.errstate(divide="ignore", invalid="ignore"):
        g = np.log(curve.astype(np.float64))
    g -= g[:, 128, None]
    return np.where(np.isfinite(g), g, np.nan)


def curve(number: int) -> tuple[tuple[Float, Float], Float]:
    """A DoRF curve as (irradiance, brightness), and the true ln exposure per code, (1, 256)."""
    dorf = np.load(DATA / "dorf.npz")
    x = dorf["irradiance"][number].astype(np.float64)
    z = dorf["brightness"][number].astype(np.float64)
    rising = np.maximum.accumulate(z) + 1e-9 * np.arange(len(z))
    g = np.log(np.maximum(np.interp(np.arange(256) / 255, rising, x), 1e-9))
    return (x, z), (g - g[128])[None]


def radiance(name: str, megapixels: float) -> Float:
    """A radiance map of the data set, resized, its median 0.18."""
    # some of the maps hold a few negative values: no light reaches the emulated sensor there
    picture = np.maximum(read_image(DATA / "radiance" / f"{name}.exr").pixels[..., :3], 0)
    scale = np.sqrt(megapixels * 1e6 / (picture.shape[0] * picture.shape[1]))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=method)
    return np.asarray(resized, np.float64) * (0.18 / np.median(picture[picture > 0]))


def photograph(radiance: Float, transfer: tuple[Float, Float], times: Float = TIMES) -> Frames:
    """8-bit pictures of a radiance map by the emulated camera."""
    rng = np.random.default_rng(0)
    frames: Frames = []
    for t in times:
        electrons = rng.poisson(np.minimum(radiance * t, 2) * FULL_WELL).astype(np.float64)
        electrons += rng.normal(0, READ_NOISE, radiance.shape)
        z = np.interp(np.clip(electrons / FULL_WELL, 0, 1), *transfer)
        frames.append(np.round(255 * z).astype(np.uint8))
    return frames
