"""A camera with a known response, for the tests: radiance to 8-bit pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TIMES: NDArray[np.float64] = np.exp2(np.arange(-3.0, 4.0))


def scene(height: int = 192, width: int = 256, seed: int = 3) -> NDArray[np.float64]:
    """Smooth colours over some seven stops, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / max(height, width)
    waves = [
        np.sin(2 * np.pi * (rng.uniform(-2, 2) * x + rng.uniform(-2, 2) * y + rng.uniform()))
        for _ in range(12)
    ]
    return 0.18 * np.exp(np.stack([sum(waves[c::3]) for c in range(3)], axis=2) * 0.6)


def log_exposure(gamma: float = 2.2) -> NDArray[np.float64]:
    """ln exposure of each code of a camera z = 255 x^(1/gamma), zero at 128; finite at 0."""
    z = np.maximum(np.arange(256), 0.5)
    return gamma * np.log(z / 128)


def photograph(
    radiance: NDArray[np.float64],
    times: NDArray[np.float64] = TIMES,
    *,
    gamma: float = 2.2,
    well: float = 20000,
    read: float = 4,
    seed: int = 1,
) -> list[NDArray[np.uint8]]:
    """Frames of the camera with shot and read noise, in the times' order."""
    rng = np.random.default_rng(seed)
    frames: list[NDArray[np.uint8]] = []
    for time in times:
        electrons = rng.poisson(np.minimum(radiance * time, 2) * well)
        x = np.clip((electrons + rng.normal(0, read, radiance.shape)) / well, 0, 1)
        frames.append(np.round(255 * x ** (1 / gamma)).astype(np.uint8))
    return frames
