"""What the office probe's reference tool does to a bracket, from what is published about it.

Radiance's hdrgen: a weighted mean whose weights are X / X' times the exposure under a flat hat;
ghosts are removed by pulling every frame towards the one with the most usable pixels; flare is
estimated from the darkest places around the brightest and taken off (Reinhard et al. 2010, High
Dynamic Range Imaging, 2nd edition, on ghosts and on lens flare). Then Radiance's `pcompos`,
`pfilt -1` and `pcomb` crop, average and bend the picture. Ours stops where numbers no longer
change: it explains a difference, and is nobody's tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.color import luminance

if TYPE_CHECKING:
    from scipy.sparse import csr_array

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
type Frame = NDArray[np.uint8]

CODES = 256
#: codes beyond these are left to other exposures
USABLE = (2, 239)
LEAST_SLOPE = 0.2
#: flare is worked out on a picture of so many pixels a side
SMALL = 200
#: a place this many times as bright as the darkest is a source of flare
SOURCE = 500.0
#: squared distances, in small pixels, from which on the flare falls, and is constant again
NEAR2, FAR2 = 8, SMALL**2 // 4
ORDER = 3
#: the most that is taken off where flare is all there is
REMOVED = 0.98


def merge(
    frames: Sequence[Frame], exposures: Array, polynomials: Sequence[Array]
) -> tuple[Picture, Picture]:
    """Radiance (H, W, 3) of 8-bit frames, without and with ghosts removed.

    `polynomials` are those of the response's three channels, the highest power first.
    """
    import cv2

    z = (np.arange(CODES) + 0.5) / CODES
    response = np.stack([np.polyval(p, z) for p in polynomials], axis=-1)
    slope = np.stack([np.polyval(np.polyder(p), z) for p in polynomials], axis=-1)
    share = response / np.maximum(slope, LEAST_SLOPE)
    usable = [np.mean((f >= USABLE[0]) & (f <= USABLE[1])) for f in frames]
    best = int(np.argmax(usable))
    shape = frames[best].shape
    reference = frames[best]
    expected = cv2.LUT(reference, (response / exposures[best])[None].astype(np.float32))
    doubt = _doubt(reference)
    sums = [np.zeros(shape, np.float32) for _ in range(4)]
    order = np.argsort(-exposures)  # the longest first
    for place, j in enumerate(order):
        hat = _hat(longest=place == 0, shortest=place == len(order) - 1)
        table = (share * hat[:, None] * exposures[j])[None].astype(np.float32)
        weight = np.asarray(cv2.LUT(frames[j], table), np.float32)
        value = np.asarray(
            cv2.LUT(frames[j], (response / exposures[j])[None].astype(np.float32))
        )
        for k, trust in enumerate((None, doubt)):
            w = weight
            if trust is not None and j != best:
                off = _most(np.square(1 - value / expected))
                w = np.asarray(weight * (trust / (trust + off))[..., None], np.float32)
            w = np.maximum(w, 0.05 * _most(w)[..., None])
            sums[2 * k] += w * value
            sums[2 * k + 1] += w
    plain, still = (
        (sums[k] / np.maximum(sums[k + 1], 1e-12)).astype(np.float32) for k in (0, 2)
    )
    return plain, still


def _most(picture: Picture) -> Picture:
    """The largest channel, (H, W)."""
    r, g, b = (picture[..., c] for c in range(3))
    return np.maximum(np.maximum(r, g), b)


def _hat(longest: bool, shortest: bool) -> Array:
    """1 - (2 z - 1)^8 over the usable codes; flat below in the longest, above in the other."""
    low, high = USABLE
    z = (np.arange(CODES) - low) / (high - low)
    hat = np.clip(1 - (2 * z - 1) ** 8, 0, 1)
    hat[(z < 0.5) & longest] = 1
    hat[(z > 0.5) & shortest] = 1
    return hat


def _doubt(reference: Frame) -> Picture:
    """(H, W) squared relative error that the reference exposure is granted, by its codes."""
    bright = (luminance(reference.astype(np.float32)) + 0.5) / CODES
    error = np.where(bright > 0.85, 0.058 + 0.68 * (bright - 0.85), 0.04 + 0.12 * (1 - bright))
    return (error**2).astype(np.float32)


def flare(radiance: Picture) -> Picture:
    """The flare (H, W, 3) that is taken off: bright places spread by a polynomial in 1 / r.

    Around the sources, ring by ring, no place is darker than their flare there: the darkest of
    each ring, all rings together, give the polynomial by least squares.
    """
    import cv2
    from scipy.signal import fftconvolve

    height, width = radiance.shape[:2]
    small = np.asarray(
        cv2.resize(radiance, (SMALL, SMALL), interpolation=cv2.INTER_AREA)
    ).astype(float)
    y = luminance(small)
    sources = y >= SOURCE * y.min()

    def spread(light: Array, kernel: Array) -> Array:
        return fftconvolve(light, kernel)[SMALL : 2 * SMALL, SMALL : 2 * SMALL]

    axis = np.arange(-SMALL, SMALL + 1)
    r2 = axis[:, None] ** 2 + axis[None, :] ** 2
    powers = [np.clip(r2, NEAR2, FAR2) ** (-i / 2) for i in range(ORDER + 1)]
    free = ~sources
    free[:3] = free[-3:] = free[:, :3] = free[:, -3:] = False
    hue = small[sources].mean(axis=0)
    rows: list[list[float]] = []
    darkest: list[float] = []
    inner, lowest = NEAR2, 1.0
    while (outer := inner * 3 // 2) <= FAR2:
        light = spread(np.where(sources, y, 0), ((r2 >= inner) & (r2 < outer)).astype(float))
        lit = free & (light > 1e-9 * y.sum())
        ratio = np.where(lit, y / np.where(lit, light, 1), np.inf)
        inner = outer
        if ratio.min() >= lowest:
            continue  # flare falls with the distance
        lowest = float(ratio.min())
        j, i = np.unravel_index(int(ratio.argmin()), ratio.shape)
        free[j, i] = False
        block = radiance[
            j * height // SMALL : (j + 1) * height // SMALL,
            i * width // SMALL : (i + 1) * width // SMALL,
        ].reshape(-1, 3)
        at, channel = np.unravel_index(int((block / hue).argmin()), block.shape)
        darkest.append(float(block[at, channel]))
        part = np.s_[SMALL - j : 2 * SMALL - j, SMALL - i : 2 * SMALL - i]
        rows.append([float((small[..., channel] * p[part]).sum()) for p in powers])
    scale = np.linalg.norm(rows, axis=0)
    c = np.linalg.lstsq(np.array(rows) / scale, np.array(darkest), rcond=None)[0] / scale
    psf = np.maximum(sum(c[i] * powers[i] for i in range(ORDER + 1)), 0)
    veil = np.stack(
        [spread(np.where(sources, small[..., k], 0), psf) for k in range(3)], axis=-1
    )
    share = min(REMOVED, 0.999 * float((small / np.maximum(veil, 1e-30)).min()))
    size = (width, height)
    return np.asarray(cv2.resize((share * veil).astype(np.float32), size), np.float32)


def crop(radiance: Picture, left: float, top: float, diameter: float, width: int) -> Array:
    """A square of `diameter` pixels averaged to (width, width, 3), as `pcompos`, `pfilt -1`.

    `left` and `top` are its edges, 0 the picture's own.
    """
    height, across = radiance.shape[:2]
    rows = _means(top, diameter, width, height) @ radiance.reshape(height, -1)
    rows = rows.reshape(width, across, 3).transpose(1, 0, 2).reshape(across, -1)
    cells = _means(left, diameter, width, across) @ rows
    return cells.reshape(width, width, 3).transpose(1, 0, 2)


def _means(first: float, extent: float, count: int, pixels: int) -> csr_array:
    """(count, pixels): means over equal parts of `extent` pixels from `first` on."""
    from scipy.sparse import csr_array

    edges = first + np.arange(count + 1) * extent / count
    i = np.arange(pixels)
    over = np.minimum(edges[1:, None], i + 1) - np.maximum(edges[:-1, None], i)
    return csr_array(np.maximum(over, 0) * (count / extent))


def bend(picture: Array) -> Array:
    """`fisheye_corr.cal`: equisolid to equidistant, 180 degrees across, by whole pixels.

    Where r goes to m(r) it should fetch m^-1(r), and takes 2 r - m(r) (see :func:`fetched`).
    """
    width = len(picture)
    y, x = np.mgrid[:width, :width]
    # lines are counted from the bottom there, so that the middle differs
    dx, dy = x - width / 2, y - (width / 2 - 1)
    r = np.hypot(dx, dy) / (width / 2)
    stretch = fetched(np.minimum(r, 1)) / np.maximum(r, 1e-9) - 1
    i, j = (
        np.clip(at + np.trunc(d * stretch + np.copysign(0.5, d)), 0, width - 1).astype(int)
        for at, d in ((x, dx), (y, dy))
    )
    return np.where((r <= 1)[..., None], picture[j, i], 0)


def fetched(r: Array) -> Array:
    """The radius that :func:`bend` fetches for r, 1 at the rim: 2 r - m(r)."""
    return 2 * r - 4 / np.pi * np.arcsin(r / np.sqrt(2))


def quantised(radiance: Array) -> Array:
    """As a Radiance picture keeps it, RGBE: 8 bits under one exponent."""
    exponent = np.frexp(radiance.max(axis=-1, keepdims=True))[1] - 8
    unit = np.ldexp(1.0, exponent)
    return (np.floor(radiance / unit) + 0.5) * unit
