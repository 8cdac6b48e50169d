"""The benchmark of this room, and the emulated camera that its modules photograph with.

DoRF curves (Grossberg and Nayar 2003) photograph real radiance maps: full well 15000 e-, read
noise 5 e-, 8 bits. `hdr_response` judges curves, `hdr_left_out` predicts exposures of real
brackets, `hdr_merge` judges radiance, `hdr_align` alignment and ghosts.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from dataclasses import asdict
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.bench.row import Row
from chromeball.scene.image import read_image

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/hdr"
MAPS = (
    "polyhaven_studio",
    "polyhaven_apartment",
    "openexr_Desk",
    "openexr_StillLife",
    "polyhaven_city",
)

type Float = NDArray[np.float64]
type Frames = list[NDArray[np.uint8]]

#: what is measured, each in a process of its own
MODULES = ("hdr_response", "hdr_left_out", "hdr_merge", "hdr_align")
#: exposures of the three brackets
BRACKETS: dict[str, Float] = {
    "5 x 2 EV": np.exp2(np.arange(-4.0, 5.0, 2.0)),
    "7 x 1 EV": np.exp2(np.arange(-3.0, 4.0)),
    "9 x 1 EV": np.exp2(np.arange(-4.0, 5.0)),
}
TIMES = BRACKETS["7 x 1 EV"]
FULL_WELL, READ_NOISE = 15000.0, 5.0
#: values of the emulated sensor, before its curve
SENSOR_VALUES = 1 << 16


def rows(quick: bool = False) -> list[Row]:
    """The rows of this room; none where the shared data set is absent.

    Each module is measured in a process of its own with one BLAS thread: threads that wait on
    a loaded machine are counted as CPU seconds, several times those of the work.
    """
    if not (DATA / "dorf.npz").is_file():
        return []
    found: list[Row] = []
    for module in MODULES:
        words = [sys.executable, "-m", "chromeball.bench.hdr", module, *(["quick"] * quick)]
        alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True, env=alone)
        found += [Row(**fields) for fields in json.loads(done.stdout)]
    return found


@cache
def dorf() -> tuple[Float, Float]:
    """The curves of the database: irradiance and brightness, (111, n) each."""
    table = np.load(DATA / "dorf.npz")
    return table["irradiance"].astype(np.float64), table["brightness"].astype(np.float64)


def curve(number: int) -> tuple[tuple[Float, Float], Float]:
    """A DoRF curve as (irradiance, brightness), and the true ln exposure per code, (1, 256)."""
    x, z = (table[number] for table in dorf())
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


def expose(radiance: Float, times: Float = TIMES) -> list[NDArray[np.uint16]]:
    """What the emulated sensor reads for each exposure: 65535 is its full well."""
    rng = np.random.default_rng(0)
    sensor: list[NDArray[np.uint16]] = []
    for t in times:
        electrons = rng.poisson(np.minimum(radiance * t, 2) * FULL_WELL).astype(np.float64)
        electrons += rng.normal(0, READ_NOISE, radiance.shape)
        value = np.clip(electrons / FULL_WELL, 0, 1) * (SENSOR_VALUES - 1)
        sensor.append(np.round(value).astype(np.uint16))
    return sensor


def develop(sensor: list[NDArray[np.uint16]], transfer: tuple[Float, Float]) -> Frames:
    """8-bit pictures of what the sensor read, by a camera of curve `transfer`."""
    z = np.interp(np.arange(SENSOR_VALUES) / (SENSOR_VALUES - 1), *transfer)
    table = np.round(255 * z).astype(np.uint8)
    return [table[frame] for frame in sensor]


def photograph(radiance: Float, transfer: tuple[Float, Float], times: Float = TIMES) -> Frames:
    """8-bit pictures of a radiance map by the emulated camera."""
    return develop(expose(radiance, times), transfer)


if __name__ == "__main__":
    measured = importlib.import_module(f"chromeball.bench.{sys.argv[1]}").rows(
        "quick" in sys.argv[2:]
    )
    print(json.dumps([asdict(row) for row in measured]))
