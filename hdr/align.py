"""Alignment of hand-held brackets: sub-pixel, with a standard error and a verdict for each frame.

Two exposures of one scene differ by a monotone map of their codes: the response and the ratio
of exposures where they are known, else the map that matches the ranks of commonly exposed
pixels. After it both are compared where neither is clipped or black, local means removed.

For frames one and two exposures apart:

1. start: masked normalised cross-correlation (Padfield 2012) on a small level, at several
   rotations; its best peaks are refined and the best of them kept, another as good is
   ambiguity and said so;
2. a pyramid of Gauss-Newton steps (Lucas and Kanade 1981). Normal equations are summed per
   tile, and the motion is fitted to the tiles with redescending weights: what moves by itself,
   and borders that stay, are outliers.

Then all frames together: the tiles of all pairs are the observations
T_j(y_k) = T_i(x_k) of the transforms T to the reference. A tile's covariance is H^-1 + tau^2,
tau^2 from the scatter between tiles (DerSimonian and Laird 1986); the standard error is the
sandwich over tiles. The model (shift; shift and rotation; homography) is the one with the
least BIC.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]
type Image = NDArray[np.float32]
type Mask = NDArray[np.bool_]

#: generators of the motion, in coordinates of half the diagonal: shift x, y, rotation, scale,
#: two shears, two perspectives (the Lie algebra of homographies)
GENERATORS: Float = np.array(
    [
        [[0, 0, 1], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 1, 0]],
    ],
    np.float64,
)
#: model -> how many of the generators it uses
MODELS = {"shift": 2, "rotation": 3, "homography": 8}
#: codes (of 255) between which a pixel is compared: below is black, above clipped
DARK, BRIGHT = 4.0, 250.0
#: pixels of the finest level that is compared; larger frames are averaged down to it
FINEST = 1_000_000
#: long side of the level that the search starts on, and the rotations tried there, radians
COARSEST = 256
TURNS = np.deg2rad([0.0, -1.5, 1.5, -3.0, 3.0])
#: share of its overlap that a search result must keep, and candidates refined
OVERLAP, CANDIDATES = 0.2, 4
#: standard deviation (pixels) of the smoothing of the finest level
SMOOTH = 1.0
#: verdict: largest standard error and disagreement of halves (pixels of the frame), fewest
#: tiles that agree, least share of the tiles that do, least correlation, and how much better
#: than any other place the motion found must be
MOST_SIGMA, MOST_SPLIT, LEAST_TILES, LEAST_SHARE, LEAST_NCC, LEAST_LEAD = 0.3, 1.0, 8, 0.3, 0.2, 1.15
#: share of the best motion's significance that keeps another one in the race
RIVAL = 0.7
#: standard deviations by which a tile's correlation must differ from none
SIGNIFICANT = 3.5
#: chi^2 (two degrees of freedom) at which a tile's weight is a quarter
OUTLIER = 9.0


@dataclass(frozen=True)
class Alignment:
    """Where each frame's pixels lie in the reference frame.

    ``transforms`` (P, 3, 3): frame to reference, pixel centres at integers, ``model`` one of
    shift, rotation, homography. ``sigma`` (P,): standard error in pixels, rms over the tiles
    that measure the frame (infinite where none does). ``residual`` (P,): robust scatter of its
    tiles in pixels. ``split`` (P,): rms distance in pixels between the transforms of two
    disjoint halves of the tiles. ``tiles`` (P,): tiles that agree. ``flags`` (P,): empty, or
    why the frame's transform is not to be trusted. ``displacement`` (P,): the farthest that a
    corner of the picture moves, in pixels.
    """

    reference: int
    model: str
    transforms: Float
    sigma: Float
    residual: Float
    split: Float
    tiles: NDArray[np.int64]
    displacement: Float
    flags: tuple[str, ...]

    @property
    def confident(self) -> Mask:
        """(P,): frames without a flag."""
        return np.array([not flag for flag in self.flags])


@dataclass(frozen=True)
class _Level:
    """One channel of a frame at one resolution, codes of 0 .. 255, and where they count."""

    codes: Image
    valid: Mask


@dataclass(frozen=True)
class _Tiles:
    """Normal equations H u = b of the shift u of each tile (in noise units), at ``x``."""

    x: Float  # (n, 2) centres in the first frame, pixels
    H: Float  # (n, 2, 2)
    b: Float  # (n, 2)
    ncc: float
    pixels: float
    same: Mask  # (n,) whether the two exposures correlate in the tile

    def structured(self) -> _Tiles:
        """The tiles that show the same structure in both exposures."""
        keep = self.same
        return replace(self, x=self.x[keep], H=self.H[keep], b=self.b[keep], same=keep[keep])


@dataclass(frozen=True)
class _Pair:
    """Tiles of frame i at x that were found at ``M x + u`` in frame j, all in frame pixels."""

    i: int
    j: int
    M: Float
    tiles: _Tiles
    flag: str
    ncc: float


def align(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    log_exposure: Float | None = None,
    *,
    reference: int | None = None,
    models: Sequence[str] = ("shift", "rotation", "homography"),
) -> Alignment:
    """Find the motion of every frame (H, W, C), uint8, uint16 or float32, to the reference.

    `exposures` (P,) order the frames; with `log_exposure` (C, 256), the response of 8-bit
    frames, they give the map between the codes too. Without it the map is measured, so no
    response is needed. `reference` is the best exposed frame unless given. `models` are those
    that may be chosen.

    Raises
    ------
    UserError
        No frames, frames of different shapes, exposures that do not fit, frames under 32
        pixels a side.

    """
    _refuse(frames, exposures, log_exposure, reference, models)
    P, (height, width) = len(frames), frames[0].shape[:2]
    order = np.argsort(exposures, kind="stable")
    channel = _channel(frames, order)
    factor = max(1, int(np.ceil(np.sqrt(height * width / FINEST))))
    white = 255.0 if frames[0].dtype == np.uint8 else max(float(f.max()) for f in frames)
    pyramids = [_pyramid(_plane(f, channel, factor, white)) for f in frames]
    exposed = np.array([pyramid[0].valid.mean() for pyramid in pyramids])
    chosen = int(np.argmax(exposed)) if reference is None else reference
    curve = None if log_exposure is None else log_exposure[channel]

    def pair(i: int, j: int, guess: Float | None) -> _Pair:
        known = None
        if curve is not None:
            known = (curve, float(np.log(exposures[j] / exposures[i])))
        return _pair(i, j, pyramids[i], pyramids[j], known, guess, factor, models)

    pairs = [pair(int(i), int(j), None) for i, j in zip(order, order[1:])]
    for k in range(P - 2):
        sound = not (pairs[k].flag or pairs[k + 1].flag)
        guess = pairs[k + 1].M @ pairs[k].M if sound else None
        pairs.append(pair(int(order[k]), int(order[k + 2]), guess))
    return _joint(pairs, P, chosen, order, (height, width), exposed, models)


def is_needed(alignment: Alignment, tolerance: float = 0.15) -> bool:
    """Whether any frame that could be measured moved by more than `tolerance` pixels.

    A corner's motion counts only beyond two standard errors, so noise is not motion.
    """
    seen = np.isfinite(alignment.sigma)
    moved = alignment.displacement - 2 * np.where(seen, alignment.sigma, 0)
    return bool(np.any(seen & alignment.confident & (moved > tolerance)))


def warp(
    frame: NDArray[Any], transform: Float, white: float | None = None
) -> tuple[NDArray[Any], Mask]:
    """Resample a frame (H, W, C) to the reference; also (H, W) bool, where it has pixels.

    Catmull-Rom cubic (Keys 1981), held within the range of the four nearest pixels: no code
    appears that is not between its neighbours, and edges do not ring. Where one of these four
    is clipped (`white`: 255, 65535, or the frame's largest float) the result is clipped, where
    one is zero it is zero. Whole-pixel shifts copy pixels. Pixels from outside are zero.

    Noise: the variance of independent pixels falls by the sum of squared weights, to 0.41 at
    half a pixel in both directions and to 0.70 on average over all fractions; neighbours
    become correlated.

    Raises
    ------
    UserError
        A transform that is singular or sends part of the picture to infinity.

    """
    if frame.ndim != 3 or frame.dtype not in (np.uint8, np.uint16, np.float32):
        raise UserError("frames to warp are (H, W, C) of 8-bit, 16-bit or float values")
    if transform.shape != (3, 3) or not np.all(np.isfinite(transform)):
        raise UserError("a transform is 3 x 3 finite numbers")
    if abs(np.linalg.det(transform)) < 1e-9:
        raise UserError("the transform is singular: the picture would be a line")
    height, width = frame.shape[:2]
    inverse = np.linalg.inv(transform)
    inverse = np.ascontiguousarray(inverse / inverse[2, 2])
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]).T
    if np.any((inverse @ corners)[2] < 1e-3):
        raise UserError("the transform sends part of the picture to infinity")
    frame = np.ascontiguousarray(frame)
    if frame.dtype == np.uint8:
        return kernel.warp_u8(frame, inverse, 255.0 if white is None else white)
    if frame.dtype == np.uint16:
        return kernel.warp_u16(frame, inverse, 65535.0 if white is None else white)
    return kernel.warp_f32(frame, inverse, float(frame.max()) if white is None else white)


# one frame -----------------------------------------------------------------------------------


def _channel(frames: Sequence[NDArray[Any]], order: NDArray[np.int64]) -> int:
    """The channel with most contrast between pixels that neighbouring exposures both show."""
    if frames[0].shape[2] == 1:
        return 0
    height, width, channels = frames[0].shape
    step = max(1, int(np.sqrt(height * width / 60_000)))
    white = 255.0 if frames[0].dtype == np.uint8 else max(float(f.max()) for f in frames)
    small = [_tone(f[::step, ::step], white) for f in frames]
    worth = np.zeros(channels)
    for i, j in zip(order, order[1:]):
        both = (small[i] > DARK) & (small[j] < BRIGHT)
        rise = np.diff(small[j], axis=1) ** 2
        worth += (rise * (both[:, 1:] & both[:, :-1])).sum(axis=(0, 1))
    return int(np.argmax(worth))


def _tone(values: NDArray[Any], white: float) -> Image:
    """Codes of 0 .. 255: 8-bit ones as they are, others by a root that evens out shot noise."""
    if values.dtype == np.uint8:
        return values.astype(np.float32)
    return (255 * np.sqrt(values.astype(np.float32) / max(white, 1e-30))).astype(np.float32)


def _plane(frame: NDArray[Any], channel: int, factor: int, white: float) -> _Level:
    """One channel, averaged over factor x factor pixels; clipped if one of them is."""
    import cv2

    rows, columns = (size // factor * factor for size in frame.shape[:2])
    codes = _tone(np.ascontiguousarray(frame[:rows, :columns, channel]), white)
    valid = (codes >= DARK) & (codes <= BRIGHT)
    if factor > 1:
        size = columns // factor, rows // factor
        codes = cv2.resize(codes, size, interpolation=cv2.INTER_AREA)
        share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        valid = share > 0.999
    return _Level(np.asarray(codes, np.float32), valid)


def _pyramid(finest: _Level) -> list[_Level]:
    """Halved until the long side is COARSEST or less; a pixel is valid if its support is."""
    import cv2

    levels = [finest]
    while max(levels[-1].codes.shape) > COARSEST and min(levels[-1].codes.shape) > 48:
        last = levels[-1]
        share = cv2.pyrDown(last.valid.astype(np.float32))
        # some of the support may be missing on small levels, or narrow shapes vanish
        levels.append(_Level(np.asarray(cv2.pyrDown(last.codes)), share > 0.9))
    return levels


# two frames ----------------------------------------------------------------------------------


def _map(a: Float, b: Float) -> tuple[Float, Float]:
    """Codes of a -> codes of b by rank: value and weight at codes 0 .. 255.

    The weight is 1 / (1 + slope^2): noise of one code in both.
    """
    grid = np.arange(256.0)
    q = np.linspace(0, 1, 129)
    x, y = np.quantile(a, q), np.quantile(b, q)
    x, first = np.unique(x, return_index=True)
    y = y[first]
    if len(x) < 2:
        return np.full(256, float(y[0])), np.zeros(256)
    value = np.interp(grid, x, y)
    slope = np.gradient(value)
    slope = np.convolve(np.pad(slope, 4, mode="edge"), np.full(9, 1 / 9), "valid")
    return value, 1 / (1 + slope**2)


def _known_map(g: Float, difference: float) -> tuple[Float, Float]:
    """As `_map`, from the response: g(b) = g(a) + ln t_b / t_a."""
    value = np.interp(g + difference, g, np.arange(float(len(g))))
    return value, 1 / (1 + np.gradient(value) ** 2)


def _lookup(table: Float, codes: Image) -> Image:
    fine = np.interp(np.arange(0, 255.01, 1 / 32), np.arange(256.0), table).astype(np.float32)
    return fine[(codes * 32 + 0.5).astype(np.int32)]


def _fields(x: Float, centre: Float, scale: float, count: int) -> Float:
    """d(position)/d(parameter) in pixels of the first `count` generators at x; (n, 2, count)."""
    flat = np.concatenate([(x - centre) / scale, np.ones((len(x), 1))], axis=1)
    moved = np.einsum("gij,nj->nig", GENERATORS[:count], flat)
    return scale * (moved[:, :2] - flat[:, :2, None] * moved[:, 2:])


def _exponential(p: Float, centre: Float, scale: float) -> Float:
    """The 3x3 transform of the parameters, by its series."""
    A = np.einsum("g,gij->ij", p, GENERATORS[: len(p)])
    total, term = np.eye(3), np.eye(3)
    for k in range(1, 14):
        term = term @ A / k
        total = total + term
    N = np.array([[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1]])
    M = np.linalg.inv(N) @ total @ N
    return M / M[2, 2]


def _apply(M: Float, x: Float) -> Float:
    y = np.concatenate([x, np.ones((len(x), 1))], axis=1) @ M.T
    return y[:, :2] / y[:, 2:]


def _resize(M: Float, factor: float) -> Float:
    """A transform in pixels of a level `factor` times finer; centres at integers, 0 on 0."""
    S = np.diag([factor, factor, 1.0])
    return S @ M @ np.linalg.inv(S)


def _coarse_to_frame(factor: int) -> Float:
    """Pixels of blocks of factor x factor to pixels of the frame."""
    half = (factor - 1) / 2
    return np.array([[factor, 0, half], [0, factor, half], [0, 0, 1.0]])


def _flatten(image: Image, mask: Image, size: int) -> Image:
    """Less its local mean over the mask, zero outside."""
    import cv2

    share = cv2.blur(mask, (size, size))
    mean = cv2.blur(image * mask, (size, size)) / np.maximum(share, 1e-3)
    return cast("Image", (image - mean) * mask)


def _warped(level: _Level, M: Float) -> _Level:
    import cv2

    size = level.codes.shape[1], level.codes.shape[0]
    back = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    codes = cv2.warpPerspective(
        level.codes, M, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    )
    valid = cv2.warpPerspective(level.valid.astype(np.float32), M, size, flags=back)
    return _Level(np.asarray(codes, np.float32), valid > 0.999)


class _Matcher:
    """Two levels of one size made comparable: a's codes in b's domain."""

    def __init__(self, a: _Level, b: _Level, known: tuple[Float, float] | None, blur: float):
        self.a, self.b, self.known, self.blur = a, b, known, blur
        self.size = 31 if max(a.codes.shape) > 400 else 21
        self.tile = 32 if max(a.codes.shape) > 1000 else 16
        # above the shorter's highest usable code there is nothing to compare
        self.rematch(np.eye(3))

    def rematch(self, M: Float) -> None:
        """Measure the map again, where the two overlap under M."""
        if self.known is not None:
            table, weight = _known_map(*self.known)
        else:
            b = _warped(self.b, M)
            both = self.a.valid & b.valid
            step = max(1, int(np.sqrt(both.size / 60_000)))
            lattice = both[::step, ::step]
            if lattice.sum() < 64:
                table, weight = np.arange(256.0), np.full(256, 0.5)
            else:
                table, weight = _map(
                    self.a.codes[::step, ::step][lattice].astype(np.float64),
                    b.codes[::step, ::step][lattice].astype(np.float64),
                )
        self.mapped = self._smooth(_lookup(table, self.a.codes))
        self.weight = _lookup(weight, self.a.codes)
        self.target = _Level(self._smooth(self.b.codes), self._inside(self.b.valid))
        self.valid = self._inside(self.a.valid)

    def _smooth(self, image: Image) -> Image:
        import cv2

        return image if self.blur == 0 else cv2.GaussianBlur(image, (0, 0), self.blur)

    def _inside(self, valid: Mask) -> Mask:
        """Without pixels that the smoothing mixed with clipped ones."""
        import cv2

        width = 2 * int(np.ceil(1.5 * self.blur)) + 3
        return cv2.erode(valid.astype(np.uint8), np.ones((width, width), np.uint8)) > 0

    def starts(self) -> list[Float]:
        """Peaks of the masked correlation at several rotations, the best first."""
        height, width = self.a.codes.shape
        # half an octave under a power of two is enough room for shifts of half the picture
        shape = tuple(1 << int(np.ceil(np.log2(1.5 * n))) for n in (height, width))
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        va = self.valid.astype(np.float32)
        a = _flatten(self.mapped, va, self.size)
        fa, faa, fva = (np.conj(np.fft.rfft2(v, shape)) for v in (a, a * a, va))
        found: list[tuple[float, Float]] = []
        most = 0.0
        for turn in TURNS:
            R = _exponential(np.array([0, 0, turn]), centre, 1.0)
            b = _warped(self.target, R)
            vb = b.valid.astype(np.float32)
            flat = _flatten(b.codes, vb, self.size)
            fb, fbb, fvb = (np.fft.rfft2(v, shape) for v in (flat, flat * flat, vb))
            top, ea, eb, n = (
                np.fft.irfft2(v, shape) for v in (fa * fb, faa * fvb, fva * fbb, fva * fvb)
            )
            most = max(most, float(n.max()))
            energy = np.sqrt(np.maximum(ea, 0) * np.maximum(eb, 0))
            keep = (n > OVERLAP * most) & (energy > 1e-3 * energy.max())
            ncc = np.where(keep, top / np.maximum(energy, 1e-12), -1)
            score = np.where(keep, ncc * np.sqrt(np.maximum(n, 0)), -np.inf)
            for _ in range(2):
                y, x = np.unravel_index(int(np.argmax(score)), shape)
                if not np.isfinite(score[y, x]):
                    break
                dx = int(x) - (shape[1] if x > shape[1] // 2 else 0)
                dy = int(y) - (shape[0] if y > shape[0] // 2 else 0)
                shift = np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]])
                # a(x) = b_turned(x + d) = b(R (x + d))
                found.append((float(score[y, x]), R @ shift))
                ys = (np.arange(y - 4, y + 5)) % shape[0]
                xs = (np.arange(x - 4, x + 5)) % shape[1]
                score[np.ix_(ys, xs)] = -np.inf
        found.sort(key=lambda item: -item[0])
        return [M for _, M in found[:CANDIDATES]]

    def tiles(self, M: Float) -> _Tiles:
        """Normal equations per tile at M: b(M(x + u)) = a(x)."""
        import cv2

        b = _warped(self.target, M)
        mask = (self.valid & b.valid).astype(np.float32)
        a, flat = _flatten(self.mapped, mask, self.size), _flatten(b.codes, mask, self.size)
        mean = 0.5 * (self.mapped + b.codes)
        gx = cv2.Sobel(mean, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
        gy = cv2.Sobel(mean, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
        r = a - flat
        w = mask * self.weight
        wx, wy, wr = w * gx, w * gy, w * r
        wa, wb = w * a, w * flat
        parts = (wx * gx, wx * gy, wy * gy, wx * r, wy * r, wr * r, mask, wa * a, wb * flat, wa * flat)
        sums = np.stack([self._per_tile(v) for v in parts])
        rows, columns = sums.shape[1:]
        y, x = np.mgrid[0:rows, 0:columns] * float(self.tile) + (self.tile - 1) / 2
        enough = sums[6] >= 0.25 * self.tile**2
        xx, xy, yy, xr, yr, rr, n, aa, bb, ab = (v[enough].astype(np.float64) for v in sums)
        H = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
        H += (1e-3 * (xx + yy) / 2 + 1e-12)[:, None, None] * np.eye(2)
        b_ = np.stack([xr, yr], -1)
        u = np.linalg.solve(H, b_[..., None])[..., 0]
        left = np.maximum(rr - np.einsum("ni,ni->n", b_, u), 0)
        # smoothed pixels are correlated over 4 pi sigma^2 of them (at least a few: JPEG)
        area = max(4.0, 4 * np.pi * self.blur**2)
        variance = area * left / np.maximum(n - 2, 1) + 1e-6
        norm = float(np.sqrt(aa.sum() * bb.sum()))
        # a tile of noise alone would say "as it is" (its gradients are in H, not in b)
        same = ab > SIGNIFICANT * np.sqrt(aa * bb * area / np.maximum(n, 1))
        return _Tiles(
            np.stack([x[enough], y[enough]], -1),
            H / variance[:, None, None],
            b_ / variance[:, None],
            float(ab.sum()) / norm if norm > 0 else 0.0,
            float(n.sum()) / area,
            same,
        )

    def _per_tile(self, image: Image) -> Image:
        t = self.tile
        rows, columns = image.shape[0] // t, image.shape[1] // t
        cut = image[: rows * t, : columns * t]
        return cast("Image", cut.reshape(rows, t, columns, t).sum(axis=(1, 3)))

    def refine(
        self, M: Float, model: str, steps: int, *, structured: bool = False
    ) -> tuple[Float, _Tiles]:
        """Gauss-Newton steps of the model on M, until it moves by less than 0.005 pixels."""
        height, width = self.a.codes.shape
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        scale = float(np.hypot(height, width) / 2)

        def measure(M: Float) -> _Tiles:
            tiles = self.tiles(M)
            return tiles.structured() if structured else tiles

        tiles = measure(M)
        for _ in range(steps):
            if len(tiles.x) < MODELS[model]:
                break
            J = _fields(tiles.x, centre, scale, MODELS[model])
            p = _fit(J, tiles.H, tiles.b).p
            size = float(np.sqrt(np.mean((J @ p) ** 2)))
            if not np.isfinite(size) or size > 0.25 * min(height, width):
                break
            M = M @ _exponential(p, centre, scale)
            tiles = measure(M)
            if size < 0.005:
                break
        return M, tiles


def _pair(
    i: int,
    j: int,
    a: list[_Level],
    b: list[_Level],
    known: tuple[Float, float] | None,
    guess: Float | None,
    factor: int,
    models: Sequence[str],
) -> _Pair:
    S = _coarse_to_frame(factor)
    # a chain of sound pairs needs no search
    top = len(a) - 1 if guess is None else min(len(a) - 1, 1)
    turning = "shift" if list(models) == ["shift"] else "rotation"
    matcher = _Matcher(a[top], b[top], known, 0.7)
    if guess is None:
        motions = [np.eye(3), *matcher.starts()]
    else:
        motions = [_resize(np.linalg.inv(S) @ guess @ S, 2.0**-top)]
    lead = np.inf
    for level in range(top, -1, -1):
        if level < top:
            motions = [_resize(M, 2.0) for M in motions]
            matcher = _Matcher(a[level], b[level], known, SMOOTH if level == 0 else 0.7)
        steps = ["shift", turning] if level == top else [turning]
        motions, lead = _rank_motions(matcher, motions, steps)
    M, tiles = matcher.refine(motions[0], turning, 5, structured=True)
    if "homography" in models and len(tiles.x) > 0:
        model = _choose(tiles, models, matcher.a.codes.shape)
        M, tiles = matcher.refine(M, model, 6, structured=True)
    flag = ""
    if len(tiles.x) < LEAST_TILES:
        flag = f"only {len(tiles.x)} tiles show structure in both exposures"
    elif tiles.ncc < LEAST_NCC:
        flag = f"the two exposures correlate by {tiles.ncc:.2f} only"
    elif lead < LEAST_LEAD:
        flag = "another motion fits as well (repeated structure, or too little of it)"
    scaled = replace(
        tiles, x=_apply(S, tiles.x), H=tiles.H / factor**2, b=tiles.b / factor
    )
    return _Pair(i, j, S @ M @ np.linalg.inv(S), scaled, flag, tiles.ncc)


def _rank_motions(
    matcher: _Matcher, motions: Sequence[Float], models: Sequence[str]
) -> tuple[list[Float], float]:
    """Refine motions; those that may still win, the best first, and its lead over the next."""
    height, width = matcher.a.codes.shape
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)

    def apart(A: Float, B: Float) -> float:
        return float(np.abs(_apply(A, corners) - _apply(B, corners)).max())

    starts: list[Float] = []
    for M in motions:
        if all(apart(M, other) > 2 for other in starts):
            starts.append(M)
    scored: list[tuple[float, Float]] = []
    for M in starts:
        for model in models:
            matcher.rematch(M)
            M, tiles = matcher.refine(M, model, 4)
        scored.append((_significance(tiles), M))
    scored.sort(key=lambda item: -item[0])
    best, M = scored[0]
    others = [item for item in scored[1:] if apart(item[1], M) > 2]
    lead = best / max(others[0][0], 1e-9) if others else np.inf
    return [M, *(other for score, other in others[:2] if score > RIVAL * best)], lead


def _significance(tiles: _Tiles) -> float:
    """Standard deviations of the correlation from none (Fisher's z)."""
    if len(tiles.x) == 0:
        return 0.0
    return float(np.arctanh(np.clip(tiles.ncc, 0, 0.9999)) * np.sqrt(max(tiles.pixels - 3, 0)))


# fits to tiles -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fit:
    p: Float
    weight: Float  # (n, 2, 2) inverse covariances, robust weight not included
    robust: Float  # (n,)
    chi2: Float  # (n,)
    tau: float


def _fit(J: Float, H: Float, b: Float) -> _Fit:
    """Robust p of u_k = J_k p, with cov u_k = H_k^-1 + tau^2, tau from the tiles' scatter.

    Geman-McClure weights: (1 + chi2 / OUTLIER)^-2.
    """
    cov = _inverse(H)
    u = np.einsum("nij,nj->ni", cov, b)
    robust = np.ones(len(J))
    tau2 = 0.0
    W = H
    p = np.zeros(J.shape[2])
    chi2 = np.zeros(len(J))
    for step in range(12):
        W = _inverse(cov + tau2 * np.eye(2))
        p = _weighted(J, W, robust, u)
        e = u - J @ p
        tau2 = _scatter(e, cov)
        W = _inverse(cov + tau2 * np.eye(2))
        chi2 = np.einsum("ni,nij,nj->n", e, W, e)
        # graduated: a generous weight first, so that a poor start does not lose the majority
        robust = (1 + chi2 / (OUTLIER * max(1, 8 >> step))) ** -2
    return _Fit(p, W, robust, chi2, float(np.sqrt(tau2)))


def _scatter(e: Float, cov: Float) -> float:
    """tau^2 at which the median of chi^2 is that of two degrees of freedom (1.386)."""
    if len(e) < 3:
        return 0.0
    # in the axes of each tile: chi2 = sum of along / (value + tau^2)
    half, skew, cross = (
        0.5 * (cov[:, 0, 0] + cov[:, 1, 1]),
        0.5 * (cov[:, 0, 0] - cov[:, 1, 1]),
        cov[:, 0, 1],
    )
    radius = np.hypot(skew, cross)
    turn = 0.5 * np.arctan2(cross, skew)
    first = (np.cos(turn) * e[:, 0] + np.sin(turn) * e[:, 1]) ** 2
    second = (np.cos(turn) * e[:, 1] - np.sin(turn) * e[:, 0]) ** 2
    squares = first + second
    tau2 = np.append(0.0, np.geomspace(1e-5, np.median(squares) + 1e-4, 20))[:, None]
    small = np.maximum(half - radius, 0)
    chi2 = first / (half + radius + tau2) + second / np.maximum(small + tau2, 1e-12)
    middle = np.median(chi2, axis=1)
    if middle[0] <= 1.386:
        return 0.0
    return float(np.interp(-1.386, -middle, tau2[:, 0]))


def _inverse(A: Float) -> Float:
    """Of symmetric 2 x 2 matrices, (n, 2, 2)."""
    out = np.empty_like(A)
    det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] ** 2
    out[:, 0, 0], out[:, 1, 1] = A[:, 1, 1] / det, A[:, 0, 0] / det
    out[:, 0, 1] = out[:, 1, 0] = -A[:, 0, 1] / det
    return out


def _choose(tiles: _Tiles, models: Sequence[str], shape: tuple[int, ...]) -> str:
    """The model of least BIC, noise and scatter taken from the richest one."""
    height, width = shape
    centre, scale = np.array([(width - 1) / 2, (height - 1) / 2]), float(np.hypot(height, width) / 2)
    names = [m for m in MODELS if m in models and 2 * len(tiles.x) > 3 * MODELS[m]]
    if not names:
        return next(m for m in MODELS if m in models)
    J = _fields(tiles.x, centre, scale, MODELS[names[-1]])
    rich = _fit(J, tiles.H, tiles.b)
    u = np.linalg.solve(tiles.H, tiles.b[..., None])[..., 0]
    criteria: dict[str, float] = {}
    for name in names:
        Jm = J[..., : MODELS[name]]
        e = u - Jm @ _weighted(Jm, rich.weight, rich.robust, u)
        chi2 = np.einsum("ni,nij,nj->n", e, rich.weight, e)
        criteria[name] = float(rich.robust @ chi2) + MODELS[name] * np.log(2 * len(u))
    return min(criteria, key=lambda name: criteria[name])


def _weighted(J: Float, W: Float, robust: Float, u: Float) -> Float:
    """The p of least sum of robust (u - J p)' W (u - J p)."""
    WJ = (W * robust[:, None, None]) @ J
    flat, right = WJ.reshape(-1, J.shape[2]), J.reshape(-1, J.shape[2])
    A = flat.T @ right
    A += 1e-12 * np.trace(A) * np.eye(len(A))
    return np.linalg.solve(A, flat.T @ u.reshape(-1))


# all frames ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Observations:
    """Tiles of all pairs: x in frame i, y in frame j; (n, ...) each, `edge` numbers the pair."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    edge: NDArray[np.int64]
    x: Float
    y: Float
    cov: Float

    def part(self, keep: Mask) -> _Observations:
        return _Observations(
            self.i[keep], self.j[keep], self.edge[keep], self.x[keep], self.y[keep], self.cov[keep]
        )


@dataclass(frozen=True)
class _Joint:
    T: Float  # (P, 3, 3)
    cov: Float  # (P, k, k) of the parameters of each frame
    e: Float  # (n, 2)
    W: Float  # (n, 2, 2)
    robust: Float  # (n,)


def _observations(pairs: Sequence[_Pair]) -> _Observations:
    columns: list[list[Any]] = [[], [], [], [], [], []]
    for number, pair in enumerate(pairs):
        cov = _inverse(pair.tiles.H)
        u = np.einsum("nij,nj->ni", cov, pair.tiles.b)
        near = np.hypot(*u.T) < 4 * np.sqrt(np.prod(np.ptp(pair.tiles.x, axis=0) + 1)) / 4
        n = int(near.sum())
        x = pair.tiles.x[near]
        row = (
            np.full(n, pair.i),
            np.full(n, pair.j),
            np.full(n, number),
            x,
            _apply(pair.M, x + u[near]),
            cov[near],
        )
        for column, value in zip(columns, row, strict=True):
            column.append(value)
    return _Observations(*(np.concatenate(column) for column in columns))


def _solve(
    seen: _Observations,
    T: Float,
    free: NDArray[np.int64],
    count: int,
    frame: tuple[Float, float],
    fixed: tuple[Float, Float] | None = None,
) -> _Joint:
    """Gauss-Newton on T_i(x) = T_j(y) over the frames `free`, `count` parameters each."""
    centre, scale = frame
    n, size = len(seen.x), len(free) * count
    T = T.copy()
    place = np.full(len(T), -1)
    place[free] = np.arange(len(free))
    robust = np.ones(n) if fixed is None else fixed[1]
    W = _inverse(seen.cov) if fixed is None else fixed[0]

    def positions(at: NDArray[np.int64], x: Float) -> Float:
        flat = np.concatenate([x, np.ones((n, 1))], axis=1)
        moved = np.einsum("nij,nj->ni", T[at], flat)
        return moved[:, :2] / moved[:, 2:]

    A, WJ, e = np.eye(size), np.zeros((2 * n, size)), np.zeros((n, 2))
    for step in range(12 if fixed is None else 4):
        xi, yj = positions(seen.i, seen.x), positions(seen.j, seen.y)
        e = yj - xi
        if fixed is None:
            for number in np.unique(seen.edge):
                mine = seen.edge == number
                tau2 = _scatter(e[mine], seen.cov[mine])
                W[mine] = _inverse(seen.cov[mine] + tau2 * np.eye(2))
            chi2 = np.einsum("ni,nij,nj->n", e, W, e)
            robust = (1 + chi2 / (OUTLIER * max(1, 8 >> step))) ** -2
        J = np.zeros((n, 2, len(free), count))
        for at, points, sign in ((seen.i, xi, 1.0), (seen.j, yj, -1.0)):
            moves = place[at] >= 0
            J[np.flatnonzero(moves), :, place[at][moves]] += sign * _fields(
                points[moves], centre, scale, count
            )
        J = J.reshape(n, 2, size)
        WJ = ((W * robust[:, None, None]) @ J).reshape(2 * n, size)
        A = WJ.T @ J.reshape(2 * n, size)
        A += 1e-10 * np.trace(A) / size * np.eye(size)
        p = np.linalg.solve(A, WJ.T @ e.reshape(2 * n)).reshape(-1, count)
        for number, part in zip(free, p, strict=True):
            T[number] = _exponential(part, centre, scale) @ T[number]
            T[number] /= T[number, 2, 2]
    score = np.einsum("nij,ni->nj", WJ.reshape(n, 2, size), e)
    inverse = np.linalg.inv(A)
    # errors of neighbouring tiles, and of a place in several pairs, are one error
    _, cell = np.unique(_cells(seen.x, scale), axis=0, return_inverse=True)
    cluster = np.zeros((int(cell.max()) + 1, size))
    np.add.at(cluster, cell.reshape(-1), score)
    whole = inverse @ (cluster.T @ cluster) @ inverse
    cov = np.zeros((len(T), count, count))
    for k, number in enumerate(free):
        cov[number] = whole[k * count : (k + 1) * count, k * count : (k + 1) * count]
    return _Joint(T, cov, e, W, robust)


def _tree(pairs: Sequence[_Pair], P: int, reference: int) -> tuple[Float, Mask]:
    """First transforms by the best pairs, and which frames unflagged ones reach."""
    T = np.repeat(np.eye(3)[None], P, axis=0)
    reached = np.arange(P) == reference
    sound = reached.copy()
    while not reached.all():
        # sound pairs first, then neighbours (they come first), by correlation
        edges = [p for p in pairs if reached[p.i] != reached[p.j]]
        edge = max(edges, key=lambda p: (sound[p.i] | sound[p.j], not p.flag, p.ncc))
        M = edge.M if np.all(np.isfinite(edge.M)) else np.eye(3)
        if reached[edge.j]:
            new, old, T[edge.i] = edge.i, edge.j, T[edge.j] @ M
        else:
            new, old, T[edge.j] = edge.j, edge.i, T[edge.i] @ np.linalg.inv(M)
        reached[new] = True
        sound[new] = sound[old] and not edge.flag
    return T / T[:, 2:, 2:], sound


def _joint(
    pairs: Sequence[_Pair],
    P: int,
    reference: int,
    order: NDArray[np.int64],
    shape: tuple[int, int],
    exposed: Float,
    models: Sequence[str],
) -> Alignment:
    height, width = shape
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    frame = centre, float(np.hypot(height, width) / 2)
    T, sound = _tree(pairs, P, reference)
    used = [p for p in pairs if not p.flag and sound[p.i] and sound[p.j]]
    free = np.flatnonzero(sound & (np.arange(P) != reference))
    sigma, split, residual = (np.full(P, np.inf) for _ in range(3))
    tiles = np.zeros(P, np.int64)
    share = np.zeros(P)
    name = next(m for m in MODELS if m in models)
    if len(free):
        seen = _observations(used)
        name, joint = _best_model(seen, T, free, frame, models)
        T = joint.T
        count = MODELS[name]
        halves = [
            _solve(seen.part(_half(seen.x, frame[1]) == k), T, free, count, frame).T
            for k in (0, 1)
        ]
        agree = joint.robust > 0.25
        for number in free:
            mine = (seen.i == number) | (seen.j == number)
            points = np.where((seen.i == number)[:, None], seen.x, seen.y)[mine]
            F = _fields(_apply(T[number], points), *frame, count)
            variance = np.einsum("nij,jk,nik->n", F, joint.cov[number], F)
            apart = _apply(halves[0][number], points) - _apply(halves[1][number], points)
            split[number] = np.sqrt(np.mean((apart**2).sum(axis=1)))
            # halves differ by twice the error of the whole
            sigma[number] = max(float(np.sqrt(variance.mean())), split[number] / 2)
            tiles[number], share[number] = (agree & mine).sum(), (agree & mine).sum() / mine.sum()
            weight = joint.robust[mine] * np.trace(joint.W[mine], axis1=1, axis2=2)
            squares = (joint.e[mine] ** 2).sum(axis=1)
            residual[number] = np.sqrt((weight @ squares) / weight.sum())
    for k in np.flatnonzero(~sound):
        # nothing known: as the nearest exposure that is known
        known = min(np.flatnonzero(sound), key=lambda m: abs(_rank(order, k) - _rank(order, m)))
        T[k] = T[known]
    sigma[reference] = split[reference] = residual[reference] = 0.0
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
    moved = np.array([np.hypot(*(_apply(t, corners) - corners).T).max() for t in T])
    flags = [""] * P
    for k in range(P):
        if k == reference:
            continue
        if not sound[k]:
            mine = [p for p in pairs if k in (p.i, p.j) and p.flag]
            reasons = [p.flag for p in mine if abs(_rank(order, p.i) - _rank(order, p.j)) == 1]
            flags[k] = (reasons or ["it links to the reference by doubtful frames only"])[0]
        elif sigma[k] > MOST_SIGMA:
            flags[k] = f"its standard error is {sigma[k]:.2f} pixels"
        elif split[k] > MOST_SPLIT:
            flags[k] = f"two halves of the picture differ by {split[k]:.2f} pixels"
        elif tiles[k] < LEAST_TILES or share[k] < LEAST_SHARE:
            flags[k] = f"only {tiles[k]} tiles ({share[k]:.0%}) agree on a motion"
    return Alignment(reference, name, T, sigma, residual, split, tiles, moved, tuple(flags))


def _best_model(
    seen: _Observations,
    T: Float,
    free: NDArray[np.int64],
    frame: tuple[Float, float],
    models: Sequence[str],
) -> tuple[str, _Joint]:
    """The model of least BIC; noise and scatter are those of the richest."""
    n = len(seen.x)
    names = [m for m in MODELS if m in models]
    names = [m for m in names if 2 * n > 3 * MODELS[m] * len(free)] or names[:1]
    rich = _solve(seen, T, free, MODELS[names[-1]], frame)
    criteria: dict[str, float] = {}
    for name in names:
        start = _rigid(T, frame[0]) if name != "homography" else T
        if name == "shift":
            start = start.copy()
            start[:, :2, 2] += np.einsum("pij,j->pi", start[:, :2, :2] - np.eye(2), frame[0])
            start[:, :2, :2] = np.eye(2)
        fit = _solve(seen, start, free, MODELS[name], frame, (rich.W, rich.robust))
        chi2 = np.einsum("ni,nij,nj->n", fit.e, fit.W, fit.e)
        criteria[name] = float(rich.robust @ chi2) + MODELS[name] * len(free) * np.log(2 * n)
        T = fit.T if name == names[-1] else T
    best = min(criteria, key=lambda m: criteria[m])
    start = rich.T if best == "homography" else _rigid(rich.T, frame[0])
    if best == "shift":
        start[:, :2, 2] += np.einsum("pij,j->pi", start[:, :2, :2] - np.eye(2), frame[0])
        start[:, :2, :2] = np.eye(2)
    return best, rich if best == names[-1] else _solve(seen, start, free, MODELS[best], frame)


def _rigid(T: Float, centre: Float) -> Float:
    """The nearest shift and rotation: that of the centre."""
    out = np.repeat(np.eye(3)[None], len(T), axis=0)
    for k, t in enumerate(T):
        eps = 1.0
        around = centre + eps * np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1.0]])
        moved = _apply(t, around)
        right, down = moved[1] - moved[3], moved[2] - moved[4]
        angle = np.arctan2(right[1] - down[0], right[0] + down[1])
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, -s], [s, c]])
        out[k, :2, :2], out[k, :2, 2] = R, moved[0] - R @ centre
    return out


def _half(x: Float, scale: float) -> NDArray[np.int64]:
    """0 or 1 by a chessboard over the picture."""
    return _cells(x, scale).sum(axis=1) % 2


def _cells(x: Float, scale: float) -> NDArray[np.int64]:
    return np.floor(x / (scale / 8)).astype(np.int64)


def _rank(order: NDArray[np.int64], frame: int) -> int:
    return int(np.flatnonzero(order == frame)[0])


def _refuse(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    log_exposure: Float | None,
    reference: int | None,
    models: Sequence[str],
) -> None:
    if len(frames) == 0:
        raise UserError("no pictures to align")
    if len(frames) != len(exposures):
        raise UserError(f"{len(exposures)} exposures for {len(frames)} pictures")
    if not (np.all(np.isfinite(exposures)) and np.all(exposures > 0)):
        raise UserError("exposures must be positive numbers")
    first = frames[0]
    if first.ndim != 3 or any(f.shape != first.shape or f.dtype != first.dtype for f in frames):
        raise UserError("the pictures of a bracket have one size, (H, W, C), and one type")
    if first.dtype not in (np.uint8, np.uint16, np.float32):
        raise UserError(f"pictures of {first.dtype} values: 8-bit, 16-bit or float are needed")
    if min(first.shape[:2]) < 32:
        raise UserError("pictures under 32 pixels a side are too small to be aligned")
    if log_exposure is not None:
        if first.dtype != np.uint8:
            raise UserError("a response is for 8-bit pictures: leave it out")
        if log_exposure.shape != (first.shape[2], 256):
            raise UserError("the response does not have the pictures' channels")
    if reference is not None and not 0 <= reference < len(frames):
        raise UserError(f"there is no frame {reference} to be the reference")
    if not models or any(m not in MODELS for m in models):
        raise UserError(f"a model is one of {', '.join(MODELS)}")
