"""Features of radiance and of photographs alike, and which of two frames belong together.

SIFT (Lowe 2004) on the logarithm of luminance, its large-scale part halved, so that the sun and
the ground under the tripod have features both, whatever the exposure; RootSIFT (Arandjelovic
and Zisserman 2012); mutual nearest neighbours with a ratio test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.color import LUMINANCE

type Array = NDArray[np.float64]

#: Share of the large-scale log luminance that is taken away.
FLATTEN = 0.7
#: Codes a natural unit of what is left.
CONTRAST = 60.0
RATIO = 0.8
#: Contrast of the faintest features, and the cells (across, down) that have their share each.
FAINTEST, CELLS = 0.008, (9, 6)
#: Features a frame, and how few make one look closer.
LIMIT, FEW = 2000, 300


@dataclass(frozen=True)
class Features:
    """``pixels`` (N, 2) float64, ``scale`` (N,) px, ``descriptors`` (N, 128) of unit length."""

    pixels: Array
    scale: Array
    descriptors: NDArray[np.float32]
    size: tuple[int, int]


def perceptual(
    radiance: NDArray[np.float32],
    valid: NDArray[np.bool_] | None = None,
    contrast: float = CONTRAST,
) -> NDArray[np.uint8]:
    """(H, W, 3) radiance as an (H, W) picture whose codes follow contrast, not light."""
    import cv2

    y = np.asarray(radiance @ LUMINANCE.astype(np.float32), np.float32)
    seen = np.ones(y.shape, bool) if valid is None else valid
    lit = y[seen & (y > 0)]
    if lit.size == 0:
        return np.zeros(y.shape, np.uint8)
    low = np.float32(np.percentile(lit[:: max(1, lit.size // 65536)], 1) * 0.1)
    log = np.log(np.maximum(y, max(low, np.finfo(np.float32).tiny)))
    log[~seen] = 0
    sigma = max(y.shape) / 24
    step = max(1, round(sigma / 4))
    small = (max(1, y.shape[1] // step), max(1, y.shape[0] // step))
    weight = cv2.resize(seen.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    base = cv2.resize(log, small, interpolation=cv2.INTER_AREA)  # times the weight already
    base = cv2.GaussianBlur(base, (0, 0), sigma / step)
    base = base / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma / step), 1e-6)
    base = cv2.resize(base, (y.shape[1], y.shape[0]), interpolation=cv2.INTER_LINEAR)
    flat = log - np.float32(FLATTEN) * base
    middle = np.median(flat[seen][:: max(1, int(seen.sum()) // 65536)])
    codes = np.clip(128 + contrast * (flat - middle) + 0.5, 0, 255).astype(np.uint8)
    codes[~seen] = 128
    return codes


def find(
    radiance: NDArray[np.float32], valid: NDArray[np.bool_] | None = None, limit: int = LIMIT
) -> Features:
    """Features of (H, W, 3) radiance; where there are few (a clear sky), faint ones, too."""
    found = detect(perceptual(radiance, valid), valid, limit)
    if len(found.pixels) < FEW:
        faint = detect(perceptual(radiance, valid, 6 * CONTRAST), valid, limit)
        found = faint if len(faint.pixels) > len(found.pixels) else found
    return found


def detect(
    picture: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None, limit: int = LIMIT
) -> Features:
    """The strongest `limit` features of an (H, W) picture, none on the border of `valid`."""
    import cv2

    # without the precise upscale all places are 0.25 px off
    sift = cv2.SIFT.create(contrastThreshold=FAINTEST, enable_precise_upscale=True)
    mask = None
    if valid is not None:
        inner = np.pad(valid, 1).astype(np.uint8)
        mask = cv2.erode(inner, np.ones((13, 13), np.uint8))[1:-1, 1:-1]
    points = sift.detect(picture, mask)
    size = (picture.shape[1], picture.shape[0])
    if not points:
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.float32), size)
    points = [points[k] for k in _spread(points, size, limit)]
    points, descriptors = sift.compute(picture, points)
    # a place with two orientations counts twice; that is right for matching
    pixels = np.array([p.pt for p in points], float)
    scale = np.array([p.size for p in points], float) / 2
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    root = np.sqrt(np.maximum(descriptors, 0) / total)
    return Features(pixels, scale, np.ascontiguousarray(root, np.float32), size)


def _spread(points: Sequence[Any], size: tuple[int, int], limit: int) -> NDArray[np.intp]:
    """The strongest `limit` of all cells by turns: the sky has its share beside the trees."""
    strength = np.array([p.response for p in points])
    at = np.array([p.pt for p in points]) / size * CELLS
    x, y = np.clip(at.astype(int), 0, np.array(CELLS) - 1).T
    cell = y * CELLS[0] + x
    order = np.lexsort((-strength, cell))
    first = np.searchsorted(cell[order], cell[order])
    rank = np.empty(len(points), np.intp)
    rank[order] = np.arange(len(points)) - first
    return np.lexsort((-strength, rank))[:limit]


def match(
    first: Features,
    second: Features,
    rays: tuple[Array, Array] | None = None,
    gate: float = 0.0,
    ratio: float = RATIO,
) -> NDArray[np.int64]:
    """Pairs of indices (M, 2): mutual nearest neighbours that pass the ratio test.

    With `rays`, unit directions of both in common axes, only those within `gate` radians of
    each other are neighbours: a tiled wall then has one match a tile, not hundreds.
    """
    none = np.zeros((0, 2), np.int64)
    if len(first.pixels) < 2 or len(second.pixels) < 2:
        return none
    likeness = first.descriptors @ second.descriptors.T
    if rays is not None:
        a, b = (np.nan_to_num(r).astype(np.float32) for r in rays)
        # chord^2 = 2 - 2 cos, kept from cancelling by float32 differences of unit vectors
        cosine = a @ b.T
        likeness[cosine < np.cos(gate) - 2e-7] = -1
    best = likeness.argmax(axis=1)
    rows = np.arange(len(best))
    top = likeness[rows, best]
    mutual = likeness.argmax(axis=0)[best] == rows
    good = mutual & (top > 0.5)
    # the runner-up: another place, not the same one with another orientation
    i = rows[good]
    if i.size == 0:
        return none
    rest, j = likeness[i], best[i]
    here = np.arange(len(i))
    for _ in range(3):
        rest[here, j] = -1
        j = rest.argmax(axis=1)
        if (np.abs(second.pixels[j] - second.pixels[best[i]]).max(axis=1) > 2.0).all():
            break
    runner = rest[here, j]
    distance = np.sqrt(np.maximum(2 - 2 * top[i], 0))
    other = np.sqrt(np.maximum(2 - 2 * runner, 0))
    i = i[distance < ratio * other]
    found = np.stack([i, best[i]], axis=1)
    # one match a place
    places = np.round(
        np.concatenate([first.pixels[found[:, 0]], second.pixels[found[:, 1]]], 1), 1
    )
    _, kept = np.unique(places, axis=0, return_index=True)
    return found[np.sort(kept)]
