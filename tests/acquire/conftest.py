"""Scenes and devices for the tests of acquire."""

import tempfile
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray


def make_scene(seed: int = 0, size: tuple[int, int] = (48, 64)) -> NDArray[np.float32]:
    """Smooth log-normal radiance over ten stops, with a lamp in it."""
    rng = np.random.default_rng(seed)
    coarse = rng.standard_normal((7, 9))
    y, x = (np.linspace(0, n - 1.001, s) for n, s in zip(coarse.shape, size, strict=True))
    i, j = y.astype(int)[:, None], x.astype(int)[None]
    u, v = y[:, None] - i, x[None] - j
    smooth = (1 - u) * ((1 - v) * coarse[i, j] + v * coarse[i, j + 1])
    smooth += u * ((1 - v) * coarse[i + 1, j] + v * coarse[i + 1, j + 1])
    radiance = np.exp(1.8 * smooth)[..., None] * np.array([1.1, 1.0, 0.9])
    radiance[4:8, 4:10] = 500.0
    return radiance.astype(np.float32)


@pytest.fixture(scope="session")
def scene() -> NDArray[np.float32]:
    return make_scene()


@pytest.fixture
def short() -> Generator[Path]:
    """A folder whose path is short enough for a socket."""
    with tempfile.TemporaryDirectory(prefix="cb") as folder:
        yield Path(folder)
