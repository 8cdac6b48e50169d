"""The smooth map of a fall-off, bilinear and kept smooth by a prior; normal equations."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.vignette import LATTICE

type Float = NDArray[np.float64]
type Index = NDArray[np.intp]

#: Prior deviations of the map's bends and values.
BEND, VALUE = 0.01, 0.1


def bilinear(pixels: Float, size: tuple[int, int]) -> Float:
    """Weights of the lattice's nodes at `pixels` (N, 2), (N, rows * columns)."""
    rows, columns = LATTICE
    u = np.clip(pixels[:, 0] * ((columns - 1) / max(size[0] - 1, 1)), 0, columns - 1)
    v = np.clip(pixels[:, 1] * ((rows - 1) / max(size[1] - 1, 1)), 0, rows - 1)
    across = np.maximum(1 - np.abs(u[:, None] - np.arange(columns)), 0)
    down = np.maximum(1 - np.abs(v[:, None] - np.arange(rows)), 0)
    return (down[:, :, None] * across[:, None, :]).reshape(len(pixels), -1)


def smooth() -> Float:
    """Prior of the map: second differences of BEND, values of VALUE."""
    rows, columns = LATTICE
    identity = np.eye(rows * columns).reshape(-1, rows, columns)
    bends = [np.diff(identity, 2, axis=1), np.diff(identity, 2, axis=2)]
    bends.append(math.sqrt(2) * np.diff(np.diff(identity, axis=1), axis=2))
    flat = np.concatenate([b.reshape(rows * columns, -1) for b in bends], axis=1)
    return flat @ flat.T / BEND**2 + np.eye(rows * columns) / VALUE**2


def normal(
    J: Float, local: Float, y: Float, w: Float, group: Index, groups: int
) -> tuple[Float, Float, Float, Float, Float]:
    """Normal equations of shared columns J (N, c) and local ones (N, l) of each group."""
    wJ, wl = w[:, None] * J, w[:, None] * local
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(groups))
    B = np.add.reduceat((wl[:, :, None] * J[:, None, :])[order], starts, axis=0)
    blocks = np.add.reduceat((wl[:, :, None] * local[:, None, :])[order], starts, axis=0)
    gl = np.add.reduceat((wl * y[:, None])[order], starts, axis=0)
    return wJ.T @ J, B, blocks, wJ.T @ y, gl
