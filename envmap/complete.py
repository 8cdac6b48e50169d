"""What no shot saw, completed and marked as such.

Three ways, in the order of what is known: the background photograph, ground of a known
reflectance under the captured sky, or, soberly, the colours at the border of what was seen.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong, Mapping
from chromeball.envmap.resample import warp
from chromeball.scene.color import luminance

type Picture = NDArray[np.float32]
type Mask = NDArray[np.bool_]


class Source(IntEnum):
    """Where a pixel's radiance comes from; the channel `completed` of a map."""

    SEEN = 0
    BORDER = 1
    GROUND = 2
    PLATE = 3
    NADIR = 4
    PATCH = 5


def from_plate(
    radiance: Picture, missing: Mask, plate: Picture, mapping: Mapping
) -> tuple[Mask, float]:
    """Fill `missing` (H, W) in place where a photograph sees it; what was filled, and a ratio.

    `mapping` is the photograph's camera, turned to the world; it stands elsewhere, so that
    what is near is displaced. The ratio is the map's median luminance over the photograph's
    where both see, 1 where they agree; NaN where they share nothing.
    """
    height, width = missing.shape
    placed = warp(plate, mapping, LatLong((width, height)))
    covered = placed.coverage > 0.999
    filled = missing & covered
    radiance[filled] = placed.radiance[filled]
    both = covered & ~missing
    own, other = luminance(radiance[both]), luminance(placed.radiance[both])
    lit = (own > 0) & (other > 0)
    ratio = float(np.median(own[lit] / other[lit])) if lit.any() else math.nan
    return filled, ratio


def ground(
    radiance: Picture, missing: Mask, reflectance: NDArray[np.float64], seen: Mask
) -> Mask:
    """Fill `missing` below the horizon with matt ground; what was filled.

    L = reflectance / pi * E, with E the irradiance on a level plane by what was `seen`: the
    ground has no shadows and no near light.
    """
    height, width = missing.shape
    mapping = LatLong((width, height))
    up = mapping.directions()[..., 1]
    weight = np.maximum(up, 0) * mapping.solid_angles() * seen
    irradiance = np.einsum("hwc,hw->c", radiance, weight, dtype=np.float64)
    filled = missing & (up < 0)
    radiance[filled] = (reflectance * irradiance / math.pi).astype(np.float32)
    return filled


def from_border(radiance: Picture, missing: Mask) -> Mask:
    """Fill `missing` (H, W) in place, from the border of the rest; what was filled.

    The border lies 1.5 to 6 degrees inside, where no fringe of the lens' rim reaches. Medians
    over 15 degrees up and down: a window at the border is outvoted by the walls.
    """
    import cv2

    if not missing.any() or missing.all():
        return np.zeros_like(missing)
    height, width = missing.shape
    degree = width / 360

    def near(degrees: float) -> Mask:
        reach = max(1, round(degrees * degree))
        wide = np.pad(missing.astype(np.uint8), ((0, 0), (reach, reach)), mode="wrap")
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        return np.asarray(cv2.dilate(wide, kernel))[:, reach:-reach] > 0

    border = near(6.0) & ~near(1.5)
    if not border.any():
        border = ~missing
    rows = np.nonzero(border.any(axis=1))[0]
    half = max(1, round(15 * degree))
    step = max(1, half // 8)
    heights = np.arange(0, height + step, step)
    knots = np.zeros((len(heights), 3))
    for k, y in enumerate(heights):
        middle = int(rows[np.argmin(np.abs(rows - y))])
        band = np.s_[max(middle - half, 0) : middle + half + 1]
        knots[k] = np.median(radiance[band][border[band]], axis=0)
    bands = np.stack(
        [np.interp(np.arange(height), heights, knots[:, c]) for c in range(3)], axis=1
    )
    radiance[missing] = bands[np.nonzero(missing)[0]]
    return missing.copy()
