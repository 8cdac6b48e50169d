"""A radiance map at a glance, gathered from its rows: small picture, clipped map, histogram."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: bins of the histogram per stop, and the stops it reaches over and under 1
BINS_PER_STOP, STOPS = 8, 48


@dataclass(frozen=True)
class Glance:
    """What :class:`Preview` gathers.

    ``picture`` (h, w, 3) tone-mapped; ``clipped`` (h, w) int8: 1 where a pixel of the cell is
    saturated in all frames, else -1 where one is black in all; ``histogram`` (C, bins) of the
    measured values, ``edges`` (bins + 1,) in stops.
    """

    picture: NDArray[np.uint8]
    clipped: NDArray[np.int8]
    histogram: NDArray[np.int64]
    edges: NDArray[np.float64]


class Preview:
    """Area means of an (H, W, C) picture that comes by rows, some `across` pixels wide."""

    def __init__(self, height: int, width: int, across: int = 640) -> None:
        self._k = max(1, math.ceil(width / across))
        self._size = math.ceil(height / self._k), math.ceil(width / self._k)
        self._columns = np.arange(0, width, self._k)
        self._sum: NDArray[np.float64] | None = None
        self._shape = height, width
        self._high = np.zeros(self._size, bool)
        self._low = np.zeros(self._size, bool)
        self._counts = np.zeros((0, 2 * STOPS * BINS_PER_STOP), np.int64)

    def add(
        self, top: int, rows: NDArray[np.float32], clipped: NDArray[np.int8], stride: int
    ) -> None:
        """Add rows (h, W, C) and their marks (h, W), the first of them row `top`.

        Every `stride`-th pixel counts in the histogram.
        """
        if self._sum is None:
            self._sum = np.zeros((*self._size, rows.shape[2]))
            self._counts = np.zeros((rows.shape[2], self._counts.shape[1]), np.int64)
        across = np.add.reduceat(rows, self._columns, axis=1, dtype=np.float64)
        y = np.arange(top, top + len(rows)) // self._k
        np.add.at(self._sum, y, across)
        for mark, found in ((1, self._high), (-1, self._low)):
            np.logical_or.at(
                found, y, np.logical_or.reduceat(clipped == mark, self._columns, axis=1)
            )
        some = rows[-top % stride :: stride, ::stride]
        measured = clipped[-top % stride :: stride, ::stride] == 0
        for counts, values in zip(self._counts, np.moveaxis(some, 2, 0), strict=True):
            light = values[measured & (values > 0)]
            at = np.floor((np.log2(light) + STOPS) * BINS_PER_STOP).astype(np.intp)
            counts += np.bincount(at.clip(0, len(counts) - 1), minlength=len(counts))

    def finish(self) -> Glance:
        """What was gathered."""
        if self._sum is None:
            raise ValueError("no rows were added")
        high, wide = (np.minimum(self._k, n - np.arange(0, n, self._k)) for n in self._shape)
        return Glance(
            tone_map(self._sum / (high[:, None] * wide)[..., None]),
            np.where(self._high, 1, np.where(self._low, -1, 0)).astype(np.int8),
            self._counts,
            np.arange(2 * STOPS * BINS_PER_STOP + 1) / BINS_PER_STOP - STOPS,
        )


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
