"""A wand of lights moved through a room of virtual cameras, for tests and benches."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.wand_result import Tracks
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose


def room(
    count: int = 5,
    *,
    radius: float = 3.0,
    size: tuple[int, int] = (1280, 960),
    fov: float = 1.1,
    distortion: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> list[CameraModel]:
    """`count` cameras round a volume, metres, of different heights, lenses and centres."""
    rng = np.random.default_rng(seed)
    cameras: list[CameraModel] = []
    for i in range(count):
        angle = 2 * math.pi * i / count + rng.uniform(-0.2, 0.2)
        height = 1.2 + 0.9 * (i % 2) + rng.uniform(-0.2, 0.2)
        place = np.array([radius * math.sin(angle), height, radius * math.cos(angle)])
        aim = np.array([0, 1.2, 0]) + rng.uniform(-0.3, 0.3, 3)
        f = size[0] / 2 / math.tan(fov / 2) * rng.uniform(0.95, 1.05)
        centre = np.array(size) / 2 - 0.5 + rng.uniform(-0.01, 0.01, 2) * size[0]
        values = np.array([f, f, *centre, *distortion, 0, 0])
        cameras.append(CameraModel("LENSMODEL_OPENCV4", values, size, Pose.look_at(place, aim)))
    return cameras


def path(
    frames: int,
    *,
    extent: float = 1.0,
    lights: int = 1,
    length: float = 0.5,
    pace: float = 1.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Smooth path of a wand through a volume of `extent` metres about its middle, (F, K, 3).

    At `pace` 1 a camera of the room sees it move by some 25 pixels a frame.
    """
    rng = np.random.default_rng(seed + 1000)
    t = np.linspace(0, 1, frames)[:, None]
    rates = np.array([7.0, 5, 9]) * pace * frames / 500
    middle = [0, 1.2, 0] + extent * np.sin(
        2 * math.pi * (rates * t + rng.uniform(0, 1, 3))
    ) * np.sin(2 * math.pi * (rates[::-1] * 0.37 * t + rng.uniform(0, 1, 3)))
    turn = 2 * math.pi * (np.array([4.0, 3]) * pace * frames / 500 * t + rng.uniform(0, 1, 2))
    along = np.stack(
        [
            np.cos(turn[:, 0]) * np.cos(turn[:, 1]),
            np.sin(turn[:, 1]),
            np.sin(turn[:, 0]) * np.cos(turn[:, 1]),
        ],
        axis=-1,
    )
    at = np.linspace(-0.5, 0.5, lights) * length if lights > 1 else np.zeros(1)
    return np.asarray(middle[:, None] + at[:, None] * along[:, None], float)


def watch(
    cameras: list[CameraModel],
    points: NDArray[np.float64],
    *,
    noise: float = 0.3,
    outliers: float = 0.0,
    missing: float = 0.0,
    mixed: bool = True,
    seed: int = 0,
) -> Tracks:
    """What `cameras` see of lights (F, K, 3): pixels with noise, a share of them anywhere.

    With `mixed` half of the pictures have the lights in the opposite order.
    """
    rng = np.random.default_rng(seed)
    pixels = np.array([c.project_world(points) for c in cameras])
    sizes = np.array([c.size for c in cameras], float)[:, None, None]
    pixels += noise * rng.standard_normal(pixels.shape)
    wrong = rng.uniform(size=pixels.shape[:3]) < outliers
    pixels[wrong] = (rng.uniform(size=pixels.shape) * sizes)[wrong]
    inside = ((pixels > 0) & (pixels < sizes - 1)).all(axis=(2, 3))
    pixels[~inside | (rng.uniform(size=inside.shape) < missing)] = np.nan
    if mixed:
        swapped = rng.uniform(size=pixels.shape[:2]) < 0.5
        pixels = np.where(swapped[..., None, None], pixels[:, :, ::-1], pixels)
    names = tuple(f"cam{i}" for i in range(len(cameras)))
    return Tracks(names, tuple(c.size for c in cameras), pixels, np.ones(pixels.shape[:3]))


def film(
    camera: CameraModel,
    points: NDArray[np.float64],
    *,
    frames: int,
    steps: int = 4,
    peak: float = 500.0,
    mirror: float = 0.3,
    table: float = 0.7,
    noise: float = 2.0,
    seed: int = 0,
) -> Iterator[NDArray[np.uint8]]:
    """Pictures (H, W, 3) of lights (F * steps, K, 3) that move during an exposure.

    An exposure lasts half of a frame's `steps`, its middle at step ``f * steps``. Lights of
    `peak` codes are saturated above 255, their reflection in a `table` so high, metres, is
    `mirror` times as bright; a lamp stands still.
    """
    rng = np.random.default_rng(seed)
    width, height = camera.size
    y, x = np.mgrid[:height, :width].astype(np.float32)
    still = 30 + 20 * np.sin(x / 37) * np.cos(y / 23)
    still += 180 * np.exp(-((x - 0.8 * width) ** 2 + (y - 0.2 * height) ** 2) / 18)
    span = steps // 4
    for f in range(frames):
        picture = still.copy()
        exposed = range(f * steps - span, f * steps + span + 1)
        inside = [s for s in exposed if 0 <= s < len(points)]
        for s in inside:
            reflected = points[s] * [1, -1, 1] + [0, 2 * table, 0]
            for there, share in ((points[s], 1.0), (reflected, mirror)):
                for u, v in camera.project_world(there):
                    if not (np.isfinite(u) and -20 < u < width + 20 and -20 < v < height + 20):
                        continue
                    x0, y0 = max(0, int(u) - 12), max(0, int(v) - 12)
                    window = np.s_[y0 : int(v) + 13, x0 : int(u) + 13]
                    square = (x[window] - u) ** 2 + (y[window] - v) ** 2
                    picture[window] += (
                        share * peak / len(inside) * np.exp(-square / (2 * 1.6**2))
                    )
        picture += noise * rng.standard_normal(picture.shape)
        grey = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        yield np.repeat(grey[..., None], 3, axis=2)
