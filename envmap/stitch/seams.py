"""Which frame each direction is taken from: the one that sees it best, moving things whole.

On a small lat-long. Where frames disagree after their exposures are made equal, something
moved, or stood near: each such place comes from one frame that sees all of it. Very bright
places are kept whole as well, so that a sun is one sun.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong, Radial, of_camera
from chromeball.scene.camera import CameraModel

type Array = NDArray[np.float64]

#: Width of the map that seams are found on.
WIDTH = 512
#: |difference of ln L| that contrast and noise do not explain, from which something moved.
MOVED = 0.25
#: A place that no frame sees this share of is not kept whole.
WHOLE = 0.98
#: Pixels of the small map below which a disagreement is noise.
SPECK = 6


@dataclass(frozen=True)
class Seams:
    """``labels`` (h, w) int16: the frame of each direction, -1 where none sees.

    ``weights`` (N, h, w) float32: how well each sees it, 0 where not. ``moved`` (h, w): 0, or
    the number of the place that is kept whole; ``places`` how many; ``torn`` how many places of
    disagreement no frame sees whole; ``moved_solid_angle`` sr.
    """

    labels: NDArray[np.int16]
    weights: NDArray[np.float32]
    moved: NDArray[np.int32]
    places: int
    torn: int
    moved_solid_angle: float


def sight(
    camera: CameraModel, rotation: Array, target: LatLong, world: Array
) -> NDArray[np.float32]:
    """How far inside the picture each direction lies, (h, w): 1 in the middle, 0 at its edge.

    Squared, so that weights end smoothly.
    """
    mapping = of_camera(camera).turned(rotation)
    q = mapping.pixels_of(world)
    width, height = camera.size
    with np.errstate(invalid="ignore"):
        x = np.minimum(q[..., 0] + 0.5, width - 0.5 - q[..., 0]) / (min(width, height) / 2)
        y = np.minimum(q[..., 1] + 0.5, height - 0.5 - q[..., 1]) / (min(width, height) / 2)
        inside = np.minimum(np.minimum(x, y), 1.0)
        if isinstance(mapping, Radial):
            r = np.hypot(*np.moveaxis((q - mapping.centre) / mapping.focal, -1, 0))
            inside = np.minimum(inside, 1 - r / mapping.rim)
    return np.where(inside > 0, np.nan_to_num(inside), 0.0).astype(np.float32) ** 2


def find_seams(
    radiance: NDArray[np.float32],
    coverage: NDArray[np.float32],
    sights: NDArray[np.float32],
    clipped: NDArray[np.float32],
    hot: float,
) -> Seams:
    """Labels of a small lat-long.

    `radiance` (N, h, w, 3), `coverage`, `sights` and the `clipped` share (N, h, w); above `hot`
    radiance is kept whole.
    """
    import cv2

    count, height, width = coverage.shape
    seen = (coverage > 0.99) & (sights > 0)
    # a lower bound is the last resort
    worth = np.where(seen, sights * np.where(clipped > 0.01, np.float32(1e-3), 1), 0)
    weights = worth.astype(np.float32)
    labels = np.where(seen.any(axis=0), worth.argmax(axis=0), -1).astype(np.int16)
    bad = _disagreement(radiance, seen & (clipped <= 0.01))
    bright = (np.where(seen[..., None], radiance, 0).max(axis=(0, 3)) > hot).astype(np.uint8)
    solid = LatLong((width, height)).solid_angles()
    moved = np.zeros((height, width), np.int32)
    places, torn, area = 0, 0, 0.0
    for mask in (bad, bright):
        number, regions, stats = _regions(mask)
        for k in range(1, number):
            if mask is bad and stats[k] < SPECK:
                continue
            place = regions == k
            grown = _wrapped(place.astype(np.uint8), lambda m: cv2.dilate(m, _disc(2))) > 0
            whole = seen[:, grown].mean(axis=1)
            if whole.max() < WHOLE:
                torn += 1
                continue
            able = whole >= whole.max() - 0.005
            quality = np.where(able, worth[:, grown].mean(axis=1), -1.0)
            if mask is bad and count > 2:
                quality = quality * (0.1 + _agreement(radiance, seen, grown))
            chosen = int(quality.argmax())
            taken = moved[grown]
            if taken.any():  # a bright thing that moved is one thing
                of_it = int(labels[grown][taken > 0][0])
                chosen = of_it if able[of_it] else chosen
                grown |= np.isin(moved, taken[taken > 0])
            labels[grown] = chosen
            moved[grown] = places = places + 1
            if mask is bad:
                area += float(solid[place].sum())
    # the rim of a place may lie outside its frame
    blind = ~np.take_along_axis(seen, np.maximum(labels, 0).astype(np.intp)[None], axis=0)[
        0
    ] & seen.any(axis=0)
    labels[blind] = worth.argmax(axis=0)[blind]
    moved[blind] = 0
    return Seams(labels, weights, moved, places, torn, area)


def _disagreement(radiance: NDArray[np.float32], seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Where frames differ by more than contrast explains, (h, w) of 0 and 1."""
    import cv2

    several = seen.sum(axis=0) > 1
    grey = radiance @ np.array([0.25, 0.5, 0.25], np.float32)
    floor = max(float(np.median(grey[seen])) * 1e-2, 1e-12) if seen.any() else 1.0
    log = np.log(np.maximum(grey, floor))
    top, low = np.full(several.shape, -np.inf), np.full(several.shape, np.inf)
    rough = np.zeros(several.shape, np.float32)
    for one, sees in zip(log, seen, strict=True):
        smooth = cv2.GaussianBlur(one, (0, 0), 0.8)
        spread = cv2.dilate(smooth, np.ones((3, 3), np.uint8)) - cv2.erode(
            smooth, np.ones((3, 3), np.uint8)
        )
        rough = np.maximum(rough, np.where(sees, spread, 0))
        top = np.maximum(top, np.where(sees, smooth, -np.inf))
        low = np.minimum(low, np.where(sees, smooth, np.inf))
    with np.errstate(invalid="ignore"):
        beyond = several & (top - low > MOVED + 0.7 * rough)
    mask = beyond.astype(np.uint8)
    # specks are misplaced edges; what moved has a body
    mask = _wrapped(
        mask, lambda m: cv2.morphologyEx(m, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    )
    return _wrapped(mask, lambda m: cv2.morphologyEx(m, cv2.MORPH_CLOSE, _disc(2)))


def _agreement(
    radiance: NDArray[np.float32], seen: NDArray[np.bool_], place: NDArray[np.bool_]
) -> Array:
    """How near each frame is to the median of all there, (N,), 1 the same, 0 far."""
    grey = np.log(np.maximum(radiance[:, place].sum(axis=2), 1e-12))
    sees = seen[:, place]
    grey[~sees] = np.nan
    usual = np.nanmedian(np.where(sees.any(axis=0), grey, 0.0), axis=0)
    off = np.where(sees, np.abs(grey - usual), 0.0).sum(axis=1) / np.maximum(
        sees.sum(axis=1), 1
    )
    return np.where(sees.any(axis=1), 1 / (1 + (off / MOVED) ** 2), 0.0)


def _regions(mask: NDArray[np.uint8]) -> tuple[int, NDArray[np.int32], NDArray[np.int64]]:
    """Connected places of a map that wraps, their number + 1, and their sizes in pixels."""
    import cv2

    number, found = cv2.connectedComponents(mask, connectivity=8)
    regions = np.asarray(found, np.int32)
    for y in range(len(regions)):
        a, b = int(regions[y, 0]), int(regions[y, -1])
        if a and b and a != b:
            regions[regions == b] = a
    return number, regions, np.bincount(regions.ravel(), minlength=number).astype(np.int64)


def _wrapped(mask: NDArray[np.uint8], what: Callable[[Any], Any]) -> NDArray[np.uint8]:
    """A filter on a map whose left and right edges meet."""
    reach = 8
    wide = np.pad(mask, ((0, 0), (reach, reach)), mode="wrap")
    return np.ascontiguousarray(what(wide)[:, reach:-reach])


def _disc(radius: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return (x * x + y * y <= radius * radius + 1).astype(np.uint8)
