"""All frames in one lat-long: resampled, and blended band by band in linear radiance.

The mean of all frames, weighted by how well each sees, is the ground; what the chosen frame of
each direction differs from it is added in bands whose seams are as wide as their detail (Burt
and Adelson 1983), so that fine detail has sharp seams and what is left of exposure smooth ones.
Radiance far above the mean takes no part: it is taken whole from its frame, and cannot ring.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong, Mapping, of_camera
from chromeball.envmap.resample import carry, warp
from chromeball.envmap.stitch.frames import Frame
from chromeball.envmap.stitch.photometric import Photometric
from chromeball.envmap.stitch.seams import WIDTH, Seams, find_seams, sight
from chromeball.scene.camera import CameraModel

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: Radiance above this many times the mean is hot: taken whole.
HOT = 8.0
BANDS = 6
#: The blend stays within these shares of the darkest and brightest frame at a pixel.
LIMITS = (0.5, 2.0)


@dataclass(frozen=True)
class Patch:
    """A frame in the lat-long, cropped: ``left`` may wrap around.

    ``radiance`` (h, w, 3), ``coverage`` (h, w); ``energy_error``: what resampling changed;
    ``clipped`` (h, w) the share of lower bounds, None where there are none; ``sigma``
    (h, w, 3) or None.
    """

    radiance: Picture
    coverage: Picture
    top: int
    left: int
    energy_error: float
    clipped: Picture | None = None
    sigma: Picture | None = None

    def place(self, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the map, for indexing."""
        height, across = self.coverage.shape
        rows = np.arange(self.top, self.top + height)
        return np.ix_(rows, (self.left + np.arange(across)) % width)  # pyright: ignore


@dataclass(frozen=True)
class Composite:
    """``radiance`` (H, W, 3) float32, black where no frame sees; ``alpha`` (H, W).

    ``labels`` (H, W) the frame of each pixel, -1 for none; ``energy_errors`` of each frame's
    resampling; ``limited`` pixels whose blend was held near the frames', ``limited_share`` what
    that changed of the energy; ``blend_energy`` what the bands changed of it, relative;
    ``clipped`` (H, W) the share of each pixel that is a lower bound in its frame, or None where
    no frame says; ``sigma`` (H, W, 3) the standard deviation of the frame that a pixel is of,
    or None where one does not tell it.
    """

    radiance: Picture
    alpha: Picture
    labels: NDArray[np.int16]
    seams: Seams
    energy_errors: tuple[float, ...]
    hot_share: float
    limited: int
    limited_share: float
    blend_energy: float
    clipped: Picture | None = None
    sigma: Picture | None = None


def compose(
    frames: Sequence[Frame],
    camera: CameraModel,
    rotations: Array,
    width: int,
    photometric: Photometric,
    *,
    bands: int = BANDS,
    mappings: Sequence[Mapping] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Composite:
    """The panorama of `width` from frames, rotations (N, 3, 3) and photometric gains.

    `mappings`, turned to the world, stand for the camera where each frame is bent on its own.
    """
    target = LatLong((width, width // 2))
    patches: list[Patch] = []
    clips: list[Picture] = []
    small = LatLong(_small(target.size))
    for k, frame in enumerate(frames):
        if progress is not None:
            progress(f"resampling {frame.name}")
        source = of_camera(camera).turned(rotations[k]) if mappings is None else mappings[k]
        patches.append(_patch(photometric.corrected(frame, k, camera), source, target))
        clips.append(_clipped(frame, of_camera(camera).turned(rotations[k]), small))
    low = np.stack([_reduced(p, p.radiance, width, small.size) for p in patches])
    covered = np.stack([_reduced(p, p.coverage, width, small.size) for p in patches])
    low /= np.maximum(covered, 1e-6)[..., None]
    world = small.directions()
    sights = np.stack([sight(camera, r, small, world) for r in rotations])
    mean = _mean(low, covered, small)
    seams = find_seams(low, covered, sights, np.stack(clips), HOT * mean)
    return _blend(patches, seams, target, HOT * mean, bands)


def _blend(
    patches: Sequence[Patch], seams: Seams, target: LatLong, cap: float, bands: int
) -> Composite:
    import cv2

    width, height = target.size
    labels = cv2.resize(seams.labels, target.size, interpolation=cv2.INTER_NEAREST)
    whole = cv2.resize((seams.moved > 0).astype(np.uint8), target.size) > 0
    ground = np.zeros((height, width, 3), np.float32)
    total = np.zeros((height, width), np.float32)
    alpha = np.zeros((height, width), np.float32)
    weights: list[Picture] = []
    for k, patch in enumerate(patches):
        at = patch.place(width)
        weight = cv2.resize(seams.weights[k], target.size, interpolation=cv2.INTER_LINEAR)[at]
        # a place that is kept whole has no ghosts of other frames, where its own sees it
        weight = (weight + 1e-7) * np.where(whole[at] & (labels[at] != k), 1e-6, 1)
        weight = (weight * (patch.coverage > 0.5)).astype(np.float32)
        ground[at] += weight[..., None] * np.minimum(patch.radiance, cap)
        total[at] += weight
        alpha[at] = np.maximum(alpha[at], patch.coverage)
        weights.append(weight)
    seen = total > 0
    ground /= np.where(seen, total, 1)[..., None]
    alpha[~seen] = 0
    pyramid = _Pyramid(target.size, bands)
    hot = np.zeros_like(ground)
    low = np.full((height, width, 3), np.inf, np.float32)
    high = np.zeros((height, width, 3), np.float32)
    chosen = ground.copy()
    clipped = np.zeros_like(alpha) if any(p.clipped is not None for p in patches) else None
    sigma = np.zeros_like(ground) if all(p.sigma is not None for p in patches) else None
    for k, patch in enumerate(patches):
        at = patch.place(width)
        usable = patch.coverage > 0.5
        mask = (labels[at] == k) & usable
        base = np.minimum(patch.radiance, cap)
        sees = usable[..., None] & (weights[k] > 0)[..., None]
        low[at] = np.where(sees, np.minimum(low[at], base), low[at])
        high[at] = np.where(sees, np.maximum(high[at], base), high[at])
        chosen[at] = np.where(mask[..., None], base, chosen[at])
        hot[at] += np.where(mask[..., None], patch.radiance - base, 0)
        if clipped is not None and patch.clipped is not None:
            clipped[at] = np.where(mask, patch.clipped, clipped[at])
        if sigma is not None and patch.sigma is not None:
            sigma[at] = np.where(mask[..., None], patch.sigma, sigma[at])
        pyramid.add(np.where(sees, base - ground[at], 0), mask.astype(np.float32), patch)
    blended = ground + pyramid.collapse()
    bounded = np.clip(blended, LIMITS[0] * np.where(np.isfinite(low), low, 0), LIMITS[1] * high)
    bounded[~seen] = 0
    solid = target.solid_angles()
    result = bounded + hot

    def energy(picture: Picture) -> float:
        return float(np.einsum("hwc,hw->", picture, solid * alpha, dtype=np.float64))

    everything = max(energy(result), 1e-300)
    return Composite(
        radiance=result,
        alpha=alpha,
        labels=np.where(seen, labels, -1).astype(np.int16),
        seams=seams,
        energy_errors=tuple(p.energy_error for p in patches),
        hot_share=energy(hot) / everything,
        limited=int((bounded != blended)[seen].any(axis=-1).sum()),
        limited_share=energy(bounded - np.where(seen[..., None], blended, 0)) / everything,
        blend_energy=energy(bounded) / max(energy(chosen), 1e-300) - 1,
        clipped=clipped,
        sigma=sigma,
    )


class _Pyramid:
    """Sums of masked Laplacian bands on a map that wraps (Burt and Adelson 1983)."""

    def __init__(self, size: tuple[int, int], bands: int) -> None:
        width, height = size
        self.bands = 0
        while (
            self.bands < bands
            and width % 2 ** (self.bands + 1) == 0
            and height % 2 ** (self.bands + 1) == 0
            and height >> (self.bands + 1) >= 8
        ):
            self.bands += 1
        self.size = size
        self.sums = [
            np.zeros((height >> level, width >> level, 3), np.float32)
            for level in range(self.bands + 1)
        ]

    def add(self, picture: Picture, mask: Picture, patch: Patch) -> None:
        """Add a patch's `picture` (h, w, 3) where `mask` (h, w) chooses it."""
        import cv2

        block = 2**self.bands
        width, height = self.size
        # out to whole blocks, and as far beyond as the coarsest filter reaches
        top = max(0, (patch.top // block - 2) * block)
        bottom = min(height, (-(-(patch.top + picture.shape[0]) // block) + 2) * block)
        left = (patch.left // block - 2) * block
        right = (-(-(patch.left + picture.shape[1]) // block) + 2) * block
        if right - left >= width:
            left, right = patch.left // block * block, patch.left // block * block + width
        columns = (patch.left - left + np.arange(picture.shape[1])) % (right - left)
        rows = slice(patch.top - top, patch.top - top + picture.shape[0])
        full = np.zeros((bottom - top, right - left, 3), np.float32)
        of = np.zeros(full.shape[:2], np.float32)
        full[rows, columns], of[rows, columns] = picture, mask
        for level in range(self.bands + 1):
            at = np.ix_(
                np.arange(top >> level, (top >> level) + full.shape[0]),
                ((left >> level) + np.arange(full.shape[1])) % (width >> level),
            )
            if level == self.bands:
                self.sums[level][at] += full * of[..., None]
                break
            coarse = cv2.pyrDown(full)
            fine = cv2.pyrUp(coarse, dstsize=(full.shape[1], full.shape[0]))
            self.sums[level][at] += (full - fine) * of[..., None]
            full, of = coarse, cv2.pyrDown(of)

    def collapse(self) -> Picture:
        """The sum of all bands, (H, W, 3)."""
        import cv2

        result = self.sums[-1]
        for level in range(self.bands - 1, -1, -1):
            height, width = self.sums[level].shape[:2]
            wide = np.concatenate([result[:, -2:], result, result[:, :2]], axis=1)
            up = cv2.pyrUp(wide, dstsize=(2 * wide.shape[1], height))
            result = up[:, 4 : 4 + width] + self.sums[level]
        return result


def _patch(frame: Frame, source: Mapping, target: LatLong) -> Patch:
    result = warp(frame.radiance, source, target, valid=frame.valid, sigma=frame.sigma)
    seeable = float((result.source_energy - result.outside).sum())
    error = float(result.energy.sum()) / seeable - 1 if seeable > 0 else 0.0
    rows = np.flatnonzero(result.coverage.any(axis=1))
    columns = result.coverage.any(axis=0)
    if rows.size == 0:
        empty = np.zeros((1, 1), np.float32)
        black = np.zeros((1, 1, 3), np.float32)
        return Patch(black, empty, 0, 0, error, sigma=None if frame.sigma is None else black)
    width = len(columns)
    left, across = 0, width
    if not columns.all():
        # the longest gap without coverage lies outside
        seen = np.flatnonzero(np.r_[columns, columns])
        gaps = np.diff(seen)
        at = int(gaps.argmax())
        left, across = int(seen[at + 1]) % width, width - int(gaps[at]) + 1
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    where = np.ix_(np.arange(top, bottom), (left + np.arange(across)) % width)
    clipped = None
    if frame.clipped is not None and frame.clipped.any():
        clipped = carry(frame.clipped, source, target, valid=frame.valid)[where]
    sigma = None if result.sigma is None else result.sigma[where]
    light = result.radiance[where], result.coverage[where]
    return Patch(*light, top, left, error, clipped, sigma)


def _small(size: tuple[int, int]) -> tuple[int, int]:
    step = max(1, size[0] // WIDTH)
    return size[0] // step, size[1] // step


def _reduced(patch: Patch, picture: Picture, width: int, size: tuple[int, int]) -> Picture:
    """A patch on the small map, (h, w, ...), times its coverage."""
    import cv2

    full = np.zeros((width // 2, width, *picture.shape[2:]), np.float32)
    weighted = picture if picture.ndim == 2 else picture * patch.coverage[..., None]
    full[patch.place(width)] = weighted
    return np.asarray(cv2.resize(full, size, interpolation=cv2.INTER_AREA), np.float32)


def _clipped(frame: Frame, source: Mapping, small: LatLong) -> Picture:
    """Whether the pixel under each direction of the small map is a lower bound, (h, w)."""
    import cv2

    if frame.clipped is None or not frame.clipped.any():
        return np.zeros((small.size[1], small.size[0]), np.float32)
    q = np.nan_to_num(source.pixels_of(small.directions()), nan=-10.0).astype(np.float32)
    wide = cv2.dilate(frame.clipped.astype(np.float32), np.ones((5, 5), np.uint8))
    return np.asarray(
        cv2.remap(wide, q[..., 0], q[..., 1], cv2.INTER_LINEAR, borderValue=0.0), np.float32
    )


def _mean(low: Picture, covered: Picture, small: LatLong) -> float:
    """Mean radiance of the brightest channel over what is seen."""
    weight = covered * small.solid_angles()
    top = low.max(axis=3)
    cap = 30 * float(np.median(top[covered > 0.5])) if (covered > 0.5).any() else 1.0
    return float((np.minimum(top, cap) * weight).sum() / max(weight.sum(), 1e-300))
