"""A small tone-mapped picture of a radiance map, gathered from its rows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Preview:
    """Area means of an (H, W, C) picture that comes by rows, some `across` pixels wide."""

    def __init__(self, height: int, width: int, across: int = 640) -> None:
        self._k = max(1, math.ceil(width / across))
        self._size = math.ceil(height / self._k), math.ceil(width / self._k)
        self._columns = np.arange(0, width, self._k)
        self._sum: NDArray[np.float64] | None = None
        self._shape = height, width

    def add(self, top: int, rows: NDArray[np.float32]) -> None:
        """Add rows (h, W, C), the first of them row `top` of the picture."""
        if self._sum is None:
            self._sum = np.zeros((*self._size, rows.shape[2]))
        across = np.add.reduceat(rows, self._columns, axis=1, dtype=np.float64)
        y = np.arange(top, top + len(rows)) // self._k
        np.add.at(self._sum, y, across)

    def finish(self) -> NDArray[np.uint8]:
        """The tone-mapped picture (h, w, 3)."""
        if self._sum is None:
            raise ValueError("no rows were added")
        high, wide = (np.minimum(self._k, n - np.arange(0, n, self._k)) for n in self._shape)
        return tone_map(self._sum / (high[:, None] * wide)[..., None])


def tone_map(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Reinhard et al. 2002, the global operator: (h, w, C) radiance to (h, w, 3) sRGB."""
    from chromeball.scene.image import to_display

    small = np.maximum(np.asarray(pixels, np.float64), 0)
    luminance = small @ [0.2126, 0.7152, 0.0722] if small.shape[2] == 3 else small[..., 0]
    measured = luminance[luminance > np.percentile(luminance, 99.9) * 1e-6]
    key = 0.18 / np.exp(np.mean(np.log(measured))) if measured.size else 1.0
    scaled = luminance * key
    white = max(1.0, float(np.percentile(scaled, 99.5)))
    gain = key * (1 + scaled / white**2) / (1 + scaled)
    return to_display(np.broadcast_to(small * gain[..., None], (*small.shape[:2], 3)))
