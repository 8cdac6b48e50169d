"""Ghosts: what moved between the exposures, found by its residuals, taken from one exposure.

Frame j says of a pixel ln E = g(z_j) - ln t_j with variance (g' sigma_z)^2 + sigma_g^2
+ (g' d r / 2)^2, r the range of codes over 3 x 3 pixels and d the misalignment allowed for:
on an edge a small shift, or sharpening that differs, is no motion. A clipped frame says "at
least", a black one "at most". Each frame is compared with the weighted mean of the others; the
score is the rms over channels of the largest deviation in standard deviations.

The variances are measured too: where neighbouring exposures differ by more than the model says
at some brightness all over the picture (an error of the curve, JPEG, flare), they are raised.

Regions grow from high scores into lower ones (hysteresis, Canny 1986), are cleaned, and each is
given the exposure that shows it best, a common one if that will do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.frames import check_frames
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]
type Mask = NDArray[np.bool_]

CODES = 256
#: deviations (standard deviations) that start a region, and that continue one
SEED, GROW = 6.0, 3.5
#: pixels of misalignment allowed for at edges
MISALIGNED = 0.5
#: codes that measure: three deviations from black and white, and never beyond these
DARKEST, BRIGHTEST = 4, 250
#: smallest region, as share of the picture and in pixels
LEAST_SHARE, LEAST_AREA = 2e-5, 25
#: share of a region that the common exposure must show for it to be taken
SHOWN = 0.9
#: measured over modelled variance is held between these: more is motion all over the picture
LEAST_FACTOR, MOST_FACTOR = 0.1, 100.0


@dataclass(frozen=True)
class Region:
    """A connected ghost.

    Its box (x, y, width, height), its pixels, the frame it is taken from, and how many of its
    pixels are clipped or black even there.
    """

    box: tuple[int, int, int, int]
    area: int
    frame: int
    clipped: int


@dataclass(frozen=True)
class Ghosts:
    """What moved.

    ``labels`` (H, W) int32: 0, or one more than the index in ``regions``. ``reference``: the
    frame that regions are taken from where it shows them: the one that shows most of them,
    or the best exposed one where nothing moved. ``score`` (H, W) uint8: 8 times the
    deviation in standard deviations, 255 at most. ``inflation`` (P, C): median factor by which
    the variances had to be raised.
    """

    labels: NDArray[np.int32]
    regions: tuple[Region, ...]
    reference: int
    score: NDArray[np.uint8]
    inflation: Float

    @property
    def mask(self) -> Mask:
        """(H, W): where something moved."""
        return self.labels > 0

    @property
    def pixels(self) -> int:
        """How many pixels moved."""
        return sum(region.area for region in self.regions)


def find_ghosts(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    log_exposure: Float | None,
    code_noise: Float,
    *,
    sigma: Float | None = None,
    valid: Sequence[Mask] | None = None,
    misaligned: float = MISALIGNED,
    reference: int | None = None,
    white: float | None = None,
) -> Ghosts:
    """Find what moved in aligned frames (H, W, C).

    `log_exposure` (C, codes) is the response of frames of codes and `sigma` (C, codes) its
    standard error, `code_noise` (C,) the standard deviation of a pixel in codes (for linear
    frames of 255, after a root). Without `log_exposure` the frames are linear, uint16 or
    float32, with `white` their saturated value (65535, or the largest float). `valid` (H, W),
    one a frame: where it has pixels, as :func:`chromeball.hdr.align.warp` says. `misaligned`
    in pixels.

    Raises
    ------
    UserError
        Fewer than two frames, shapes or exposures that do not fit.

    """
    _refuse(frames, exposures, log_exposure, code_noise, misaligned)
    channels = frames[0].shape[2]
    tones, g = _tones(frames, log_exposure, white)
    error = np.zeros((channels, CODES)) if sigma is None else _at_tones(sigma)
    scale = 1.0 if log_exposure is None else (CODES - 1) / (log_exposure.shape[1] - 1)
    noise = np.maximum(np.broadcast_to(code_noise, (channels,)) * scale, 12**-0.5)
    darkest = np.clip(np.ceil(3 * noise), DARKEST, 64).astype(np.int32)
    brightest = np.clip(CODES - 2 - np.ceil(3 * noise), 128, BRIGHTEST).astype(np.int32)
    slope, variance = _propagate(g, noise)
    variance += error**2
    value = g[None] - np.log(exposures)[:, None, None]  # (P, C, 256)
    masks = [] if valid is None else [np.ascontiguousarray(v) for v in valid]
    limit = darkest, brightest
    factor = _inflation(tones, value, variance, slope, limit, masks, misaligned, exposures)
    table = np.stack(
        [value, variance[None] * factor, np.broadcast_to(slope**2, value.shape)], axis=3
    )
    limits = np.stack([darkest, brightest], axis=1)
    ranges = np.ascontiguousarray(np.broadcast_to(limits, (len(frames), channels, 2)))
    score = kernel.ghost_scores(tones, np.ascontiguousarray(table), ranges, masks, misaligned)
    labels, boxes = _regions(score)
    counts = np.zeros((len(boxes), len(tones)), np.int64)
    for k, (x, y, w, h, _) in enumerate(boxes):
        box = np.s_[y : y + h, x : x + w]
        inside = labels[box] == k + 1
        for j, tone in enumerate(tones):
            shown = _shows(tone[box], limit, masks[j][box] if masks else None)
            counts[k, j] = np.count_nonzero(shown & inside)
    if reference is not None:
        chosen = reference
    elif boxes:  # what moves in several regions is then shown at one moment
        chosen = int(np.argmax(counts.sum(axis=0)))
    else:
        # a pixel read to 10 % counts a half
        worth = 1 / (1 + 100 * variance * factor)
        step = max(1, int(np.sqrt(score.size / 100_000)))
        lattice = [tone[::step, ::step] for tone in tones]
        known: list[Mask | None] = [None] * len(tones)
        if masks:
            known = [mask[::step, ::step] for mask in masks]
        overall = [
            float((_worth(tone, worth[j]) * _shows(tone, limit, known[j])).mean())
            for j, tone in enumerate(lattice)
        ]
        chosen = int(np.argmax(overall))
    regions: list[Region] = []
    for (x, y, w, h, area), count in zip(boxes, counts, strict=True):
        best = chosen if count[chosen] >= SHOWN * area else int(np.argmax(count))
        regions.append(Region((x, y, w, h), area, best, int(area - count[best])))
    return Ghosts(labels, tuple(regions), chosen, score, np.median(factor, axis=2))


def replace(
    radiance: NDArray[np.float32],
    clipped: NDArray[np.int8],
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    log_exposure: Float | None,
    ghosts: Ghosts,
    *,
    valid: Sequence[Mask] | None = None,
    white: float | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """The merged picture with each region taken from its exposure, borders feathered.

    `radiance` (H, W, C) and `clipped` (H, W) are the merge of the same frames with the same
    exposures and response. Outside a region the exposure fades into the merge over a few
    pixels. Pixels that are clipped in the exposure stay marked (1 saturated, -1 black).
    """
    import cv2

    height, width = ghosts.labels.shape
    if radiance.shape[:2] != (height, width) or clipped.shape != (height, width):
        raise UserError("the merged picture is not of the frames that the ghosts were found in")
    feather = max(3, round(float(np.hypot(height, width)) / 400))
    out, marks = radiance.copy(), clipped.copy()
    if log_exposure is None and white is None:
        white = _white(frames)
    # frame by frame, so that regions of one frame fade together
    for j in sorted({region.frame for region in ghosts.regions}):
        numbers = np.zeros(len(ghosts.regions) + 1, bool)
        for number, region in enumerate(ghosts.regions):
            numbers[number + 1] = region.frame == j
        for number, region in enumerate(ghosts.regions):
            if region.frame != j:
                continue
            x, y, w, h = region.box
            top, left = max(0, y - feather), max(0, x - feather)
            box = np.s_[top : min(height, y + h + feather), left : min(width, x + w + feather)]
            here = ghosts.labels[box]
            mine = here == number + 1
            away = cv2.distanceTransform((~mine).astype(np.uint8), cv2.DIST_L2, 3)
            alpha = np.clip(1 - np.asarray(away, np.float32) / (feather + 1), 0, 1)
            # another region keeps its own exposure
            alpha[(here != 0) & ~mine] = 0
            if valid is not None:
                alpha[~valid[j][box]] = 0
            single, mark = _single(frames[j][box], float(exposures[j]), log_exposure, white)
            a = alpha[..., None]
            out[box] = np.where(a > 0, a * single + (1 - a) * out[box], out[box])
            both = np.where(marks[box] != 0, marks[box], mark)
            marks[box] = np.where(alpha == 1, mark, np.where(alpha > 0, both, marks[box]))
    return out, marks


def _single(
    pixels: NDArray[Any], exposure: float, log_exposure: Float | None, white: float | None
) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    if log_exposure is None:
        assert white is not None
        radiance = (pixels / exposure).astype(np.float32)
        high, low = pixels >= 0.99 * white, pixels <= 0
    else:
        channel = np.arange(pixels.shape[2])
        radiance = np.exp(log_exposure[channel, pixels] - np.log(exposure)).astype(np.float32)
        high, low = pixels == log_exposure.shape[1] - 1, pixels == 0
    mark = np.where(high.any(axis=2), 1, np.where(low.any(axis=2), -1, 0))
    return radiance, mark.astype(np.int8)


def _white(frames: Sequence[NDArray[Any]]) -> float:
    return 65535.0 if frames[0].dtype == np.uint16 else max(float(f.max()) for f in frames)


def _tones(
    frames: Sequence[NDArray[Any]], log_exposure: Float | None, white: float | None
) -> tuple[list[NDArray[np.uint8]], Float]:
    """8-bit frames and their ln exposure; linear ones through a root: it evens shot noise."""
    if log_exposure is not None:
        scale = (CODES - 1) / (log_exposure.shape[1] - 1)
        same = frames[0].dtype == np.uint8
        tones = [f if same else (f * scale + 0.5).astype(np.uint8) for f in frames]
        return [np.ascontiguousarray(tone) for tone in tones], _at_tones(log_exposure)
    limit = _white(frames) if white is None else white
    tones = []
    for frame in frames:
        share = np.sqrt(np.minimum(frame, limit).astype(np.float32) / np.float32(limit))
        tones.append((255 * share + 0.5).astype(np.uint8))
    z = np.maximum(np.arange(CODES), 0.25)
    return tones, np.repeat(2 * np.log(z / 128)[None], frames[0].shape[2], axis=0)


def _at_tones(table: Float) -> Float:
    """A table over codes (C, codes) at 256 of them."""
    codes = table.shape[1]
    at = np.linspace(0, codes - 1, CODES)
    return np.stack([np.interp(at, np.arange(codes), row) for row in table])


def _propagate(g: Float, noise: Float) -> tuple[Float, Float]:
    """Slope (C, 256) of g and variance of g(z + e) with e normal; noise (C,) in codes.

    Over the codes that noise mixes: a flat or steep place of the curve that is narrower than
    that is neither certainty nor doubt.
    """
    slope, variance = np.empty_like(g), np.empty_like(g)
    z = np.arange(CODES)
    for c, spread in enumerate(noise):
        p = np.exp(-0.5 * ((z[:, None] - z) / spread) ** 2)
        p /= p.sum(axis=1, keepdims=True)
        apart = g[c][None, :] - g[c][:, None]
        variance[c] = (p * apart**2).sum(axis=1)
        slope[c] = np.sqrt(variance[c]) / spread
    return slope, variance


def _shows(
    tone: NDArray[np.uint8],
    limit: tuple[NDArray[np.int32], NDArray[np.int32]],
    valid: Mask | None,
) -> Mask:
    low, high = (edge.astype(np.uint8) for edge in limit)
    shown = ((tone >= low) & (tone <= high)).all(axis=2)
    return shown if valid is None else shown & valid


def _worth(tone: NDArray[np.uint8], worth: Float) -> Float:
    """What each pixel (H, W, C) is worth, by a table (C, 256); mean of the channels."""
    return worth[np.arange(tone.shape[2]), tone].mean(axis=2)


def _inflation(
    tones: Sequence[NDArray[np.uint8]],
    value: Float,
    variance: Float,
    slope: Float,
    limit: tuple[NDArray[np.int32], NDArray[np.int32]],
    masks: Sequence[Mask],
    misaligned: float,
    exposures: Float,
) -> Float:
    """Measured over modelled variance per frame, channel and code; (P, C, 256).

    From exposures one and two apart on a lattice of pixels: the median square of the
    standardised difference over that of a normal one (0.455), in bins of 16 codes.
    """
    P, channels = len(tones), variance.shape[0]
    largest = np.zeros((P, channels, CODES))
    height, width = tones[0].shape[:2]
    step = max(1, int(np.sqrt(height * width / 150_000)))
    order = np.argsort(exposures, kind="stable")
    codes = [tone[::step, ::step].astype(np.int32) for tone in tones]
    spread = [_spread(tone, step) for tone in tones]
    known = [mask[::step, ::step] for mask in masks]
    z = np.arange(CODES)
    near = [*pairwise(order), *zip(order, order[2:], strict=False)]
    for a, b in [*near, *((b, a) for a, b in near)]:
        for c in range(channels):
            low, high = int(limit[0][c]), int(limit[1][c])
            # chosen by a alone: codes that b is expected to show, whatever it does show
            shown = value[a, c]
            use = (shown >= value[b, c, low]) & (shown <= value[b, c, high])
            use &= (z >= low) & (z <= high)
            za, zb = codes[a][..., c], codes[b][..., c]
            both = use[za] & known[a] & known[b] if known else use[za]
            za, zb = za[both], zb[both]
            total = variance[c, za] + variance[c, zb]
            for k, s in ((za, spread[a][..., c][both]), (zb, spread[b][..., c][both])):
                total = total + (0.5 * misaligned * slope[c, k] * s) ** 2
            chi2 = (value[a, c, za] - value[b, c, zb]) ** 2 / total
            found = np.full(16, np.nan)
            for k in range(16):
                mine = chi2[za // 16 == k]
                if len(mine) >= 200:
                    found[k] = np.median(mine) / 0.455
            seen = np.isfinite(found)
            if seen.any():
                at = 16 * np.arange(16)[seen] + 7.5
                largest[a, c] = np.maximum(largest[a, c], np.interp(z, at, found[seen]))
    factor = np.where(largest > 0, largest, 1.0)
    return np.clip(factor, LEAST_FACTOR, MOST_FACTOR)


def _spread(tone: NDArray[np.uint8], step: int) -> NDArray[np.int32]:
    """The range over 3 x 3 pixels at a lattice, borders repeated."""
    padded = np.pad(tone, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows, columns = tone.shape[:2]
    near = [
        padded[y : y + rows : step, x : x + columns : step] for y in range(3) for x in range(3)
    ]
    low, high = near[0], near[0]
    for part in near[1:]:
        low, high = np.minimum(low, part), np.maximum(high, part)
    return high.astype(np.int32) - low


def _regions(
    score: NDArray[np.uint8],
) -> tuple[NDArray[np.int32], list[tuple[int, int, int, int, int]]]:
    """Labels and boxes (x, y, width, height, area) of what is high enough and large enough."""
    import cv2

    height, width = score.shape
    least = max(LEAST_AREA, round(LEAST_SHARE * height * width))
    smooth = _bytes(cv2.blur(score, (3, 3)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    grow = cv2.morphologyEx(_bytes(smooth > 8 * GROW), cv2.MORPH_OPEN, disc)
    labels, area = _components(_bytes(grow))
    seeds = np.bincount(labels[smooth > 8 * SEED], minlength=len(area))
    keep = (area >= least) & (seeds >= max(4, least // 4))
    # joined over small gaps, with a rim for soft borders
    radius = max(2, round(float(np.hypot(height, width)) / 500))
    size = 2 * radius + 1
    wide = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    mask = np.pad(_bytes(cv2.dilate(_bytes(keep[labels]), wide)), size)
    mask = _bytes(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, wide))[size:-size, size:-size]
    # small holes are filled; what a region goes around is not
    inner, area = _components(_bytes(mask == 0))
    mask = _bytes((mask > 0) | ((area <= 4 * least) & (np.arange(len(area)) > 0))[inner])
    _, found, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    table = np.asarray(stats, np.int64)
    large = table[:, cv2.CC_STAT_AREA] >= least  # closing may split off crumbs
    large[0] = False
    labels = np.where(large, np.cumsum(large), 0).astype(np.int32)[np.asarray(found, np.int32)]
    return labels, [
        (int(x), int(y), int(w), int(h), int(area)) for x, y, w, h, area in table[large]
    ]


def _bytes(values: Any) -> NDArray[np.uint8]:
    return np.ascontiguousarray(values, dtype=np.uint8)


def _components(mask: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Labels (H, W) of connected pixels, and pixels of each; that of no label is 0."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    area = np.asarray(stats, np.int64)[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return np.asarray(labels, np.int32), area


def _refuse(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    log_exposure: Float | None,
    code_noise: Float,
    misaligned: float,
) -> None:
    if len(frames) < 2:
        raise UserError("ghosts need two pictures or more")
    check_frames(frames, exposures, log_exposure)
    if log_exposure is None:
        if frames[0].dtype == np.uint8:
            raise UserError("8-bit pictures need a response: make it with `hdr response`")
    elif max(int(f.max()) for f in frames) >= log_exposure.shape[1]:
        raise UserError(
            f"the pictures hold codes beyond the {log_exposure.shape[1]} of the response"
        )
    if not (np.all(np.isfinite(code_noise)) and np.all(code_noise >= 0)):
        raise UserError("the noise of a code is a positive number")
    if not (np.isfinite(misaligned) and misaligned >= 0):
        raise UserError("the misalignment allowed for is a number of pixels")
