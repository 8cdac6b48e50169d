"""The motion between two exposures of one scene, measured tile by tile.

What :mod:`chromeball.hdr.align` is made of: codes made comparable, the masked search, the
Gauss-Newton steps on a pyramid, robust fits of a motion to tiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel

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
#: long side of the level that the search starts on, and the rotations tried there, radians
COARSEST = 256
TURNS = np.deg2rad([0.0, -1.5, 1.5, -3.0, 3.0])
#: share of its overlap that a search result must keep, and candidates refined
OVERLAP, CANDIDATES = 0.2, 4
#: standard deviation (pixels) of the smoothing of the finest level
SMOOTH = 1.0
#: verdict: fewest tiles that agree, least correlation, and how much better than any other
#: motion the one found must be
LEAST_TILES, LEAST_NCC, LEAST_LEAD = 8, 0.2, 1.15
#: share of the best motion's significance that keeps another one in the race
RIVAL = 0.7
#: standard deviations by which a tile's correlation must differ from none
SIGNIFICANT = 3.5
#: chi^2 (two degrees of freedom) at which a tile's weight is a quarter
OUTLIER = 9.0


@dataclass(frozen=True)
class Level:
    """One channel of a frame at one resolution, codes of 0 .. 255, and where they count."""

    codes: Image
    valid: Mask


@dataclass(frozen=True)
class Tiles:
    """Normal equations H u = b of the shift u of each tile (in noise units), at ``x``."""

    x: Float  # (n, 2) centres in the first frame, pixels
    H: Float  # (n, 2, 2)
    b: Float  # (n, 2)
    ncc: float
    pixels: float
    same: Mask  # (n,) whether the two exposures correlate in the tile

    def structured(self) -> Tiles:
        """The tiles that show the same structure in both exposures."""
        keep = self.same
        return replace(self, x=self.x[keep], H=self.H[keep], b=self.b[keep], same=keep[keep])


@dataclass(frozen=True)
class Pair:
    """Tiles of frame i at x that were found at ``M x + u`` in frame j, all in frame pixels."""

    i: int
    j: int
    M: Float
    tiles: Tiles
    flag: str
    ncc: float


# one frame -----------------------------------------------------------------------------------


def best_channel(frames: Sequence[NDArray[Any]], order: NDArray[np.int64]) -> int:
    """The channel with most contrast between pixels that neighbouring exposures both show."""
    if frames[0].shape[2] == 1:
        return 0
    height, width, channels = frames[0].shape
    step = max(1, int(np.sqrt(height * width / 60_000)))
    white = max(float(f.max()) for f in frames)
    small = [_tone(f[::step, ::step], white, root=True) for f in frames]
    worth = np.zeros(channels)
    for i, j in pairwise(order):
        both = (small[i] > DARK) & (small[j] < BRIGHT)
        rise = np.diff(small[j], axis=1) ** 2
        worth += (rise * (both[:, 1:] & both[:, :-1])).sum(axis=(0, 1))
    return int(np.argmax(worth))


def _tone(values: NDArray[Any], white: float | None, *, root: bool) -> Image:
    """Codes of 0 .. 255: 8-bit ones as they are, others of `white`, through a root or not.

    The root evens out the shot noise of linear frames.
    """
    if values.dtype == np.uint8 or white is None:
        return values.astype(np.float32)
    share = values.astype(np.float32) / np.float32(max(white, 1e-30))
    return cast("Image", 255 * (np.sqrt(share) if root else share))


def plane(
    frame: NDArray[Any], channel: int, factor: int, white: float | None, *, root: bool
) -> Level:
    """One channel, averaged over factor x factor pixels; clipped if one of them is."""
    import cv2

    rows, columns = (size // factor * factor for size in frame.shape[:2])
    codes = _tone(np.ascontiguousarray(frame[:rows, :columns, channel]), white, root=root)
    valid = (codes >= DARK) & (codes <= BRIGHT)
    if factor > 1:
        size = columns // factor, rows // factor
        codes = np.asarray(cv2.resize(codes, size, interpolation=cv2.INTER_AREA), np.float32)
        share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        valid = share > 0.999
    return Level(codes, valid)


def pyramid(finest: Level) -> list[Level]:
    """Halved until the long side is COARSEST or less; a pixel is valid if its support is."""
    import cv2

    levels = [finest]
    while max(levels[-1].codes.shape) > COARSEST and min(levels[-1].codes.shape) > 48:
        last = levels[-1]
        share = cv2.pyrDown(last.valid.astype(np.float32))
        # some of the support may be missing on small levels, or narrow shapes vanish
        codes = np.asarray(cv2.pyrDown(last.codes), np.float32)
        levels.append(Level(codes, np.asarray(share) > 0.9))
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


def fields(x: Float, centre: Float, scale: float, count: int) -> Float:
    """Displacement in pixels at x by each of the first `count` generators; (n, 2, count)."""
    flat = np.concatenate([(x - centre) / scale, np.ones((len(x), 1))], axis=1)
    moved = np.einsum("gij,nj->nig", GENERATORS[:count], flat)
    return scale * (moved[:, :2] - flat[:, :2, None] * moved[:, 2:])


def exponential(p: Float, centre: Float, scale: float) -> Float:
    """The 3x3 transform of the parameters, by its series."""
    A = np.einsum("g,gij->ij", p, GENERATORS[: len(p)])
    total, term = np.eye(3), np.eye(3)
    for k in range(1, 14):
        term = term @ A / k
        total = total + term
    N = np.array(
        [[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1]]
    )
    M = np.linalg.inv(N) @ total @ N
    return M / M[2, 2]


def apply(M: Float, x: Float) -> Float:
    """The points x (n, 2) moved by the transform M (3, 3)."""
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


def _warped(level: Level, M: Float) -> Level:
    import cv2

    # OpenCV's cubic knows 32 places between two pixels: a bias of up to a 30th of a pixel
    codes, inside = kernel.warp_f32(level.codes[..., None], M / M[2, 2], np.inf, held=False)
    size = level.codes.shape[1], level.codes.shape[0]
    back = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    share = cv2.warpPerspective(level.valid.astype(np.float32), M, size, flags=back)
    return Level(codes[..., 0], inside & (np.asarray(share) > 0.999))


class _Matcher:
    """Two levels of one size made comparable: a's codes in b's domain."""

    def __init__(self, a: Level, b: Level, known: tuple[Float, float] | None, blur: float):
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
        self.target = Level(self._smooth(self.b.codes), self._inside(self.b.valid))
        self.valid = self._inside(self.a.valid)

    def _smooth(self, image: Image) -> Image:
        import cv2

        return np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur), np.float32)

    def _inside(self, valid: Mask) -> Mask:
        """Without pixels that the smoothing mixed with clipped ones."""
        import cv2

        width = 5 if self.blur >= 1 else 3
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
            R = exponential(np.array([0, 0, turn]), centre, 1.0)
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

    def tiles(self, M: Float) -> Tiles:
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
        parts = (
            wx * gx,
            wx * gy,
            wy * gy,
            wx * r,
            wy * r,
            wr * r,
            mask,
            wa * a,
            wb * flat,
            wa * flat,
        )
        sums = np.stack([self._per_tile(v) for v in parts])
        rows, columns = sums.shape[1:]
        y, x = np.mgrid[0:rows, 0:columns] * float(self.tile) + (self.tile - 1) / 2
        enough = sums[6] >= 0.25 * self.tile**2
        xx, xy, yy, xr, yr, rr, n, aa, bb, ab = (v[enough].astype(np.float64) for v in sums)
        normal = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
        normal += (1e-3 * (xx + yy) / 2 + 1e-12)[:, None, None] * np.eye(2)
        right = np.stack([xr, yr], -1)
        u = np.linalg.solve(normal, right[..., None])[..., 0]
        left = np.maximum(rr - np.einsum("ni,ni->n", right, u), 0)
        # smoothed pixels are correlated over 4 pi sigma^2 of them (at least a few: JPEG)
        area = max(4.0, 4 * np.pi * self.blur**2)
        variance = area * left / np.maximum(n - 2, 1) + 1e-6
        norm = float(np.sqrt(aa.sum() * bb.sum()))
        # a tile of noise alone would say "as it is" (its gradients are in normal, not in b)
        same = ab > SIGNIFICANT * np.sqrt(aa * bb * area / np.maximum(n, 1))
        return Tiles(
            np.stack([x[enough], y[enough]], -1),
            normal / variance[:, None, None],
            right / variance[:, None],
            float(ab.sum()) / norm if norm > 0 else 0.0,
            float(n.sum()) / area,
            same,
        )

    def _per_tile(self, image: Image) -> Image:
        t = self.tile
        rows, columns = image.shape[0] // t, image.shape[1] // t
        cut = image[: rows * t, : columns * t]
        return cut.reshape(rows, t, columns, t).sum(axis=(1, 3))

    def refine(
        self, motion: Float, model: str, steps: int, *, structured: bool = False
    ) -> tuple[Float, Tiles]:
        """Gauss-Newton steps of the model until it moves by less than 0.005 pixels."""
        height, width = self.a.codes.shape
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        scale = float(np.hypot(height, width) / 2)

        def measure(motion: Float) -> Tiles:
            tiles = self.tiles(motion)
            return tiles.structured() if structured else tiles

        tiles = measure(motion)
        for _ in range(steps):
            if len(tiles.x) < MODELS[model]:
                break
            J = fields(tiles.x, centre, scale, MODELS[model])
            p = _fit(J, tiles.H, tiles.b).p
            size = float(np.sqrt(np.mean((J @ p) ** 2)))
            if not np.isfinite(size) or size > 0.25 * min(height, width):
                break
            motion = motion @ exponential(p, centre, scale)
            tiles = measure(motion)
            if size < 0.005:
                break
        return motion, tiles


def match(
    i: int,
    j: int,
    a: list[Level],
    b: list[Level],
    known: tuple[Float, float] | None,
    guess: Float | None,
    factor: int,
    models: Sequence[str],
) -> Pair:
    """Frame i in frame j, from their pyramids a and b.

    `known` is the response and ln t_j / t_i, `guess` a motion that makes the search needless,
    `factor` the pixels of a frame in one of the finest level.
    """
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
    motion, tiles = matcher.refine(motions[0], turning, 5, structured=True)
    if "homography" in models and len(tiles.x) > 0:
        model = _choose(tiles, models, matcher.a.codes.shape)
        motion, tiles = matcher.refine(motion, model, 6, structured=True)
    flag = ""
    if len(tiles.x) < LEAST_TILES:
        flag = f"only {len(tiles.x)} tiles show structure in both exposures"
    elif tiles.ncc < LEAST_NCC:
        flag = f"the two exposures correlate by {tiles.ncc:.2f} only"
    elif lead < LEAST_LEAD:
        flag = "another motion fits as well (repeated structure, or too little of it)"
    scaled = replace(tiles, x=apply(S, tiles.x), H=tiles.H / factor**2, b=tiles.b / factor)
    return Pair(i, j, S @ motion @ np.linalg.inv(S), scaled, flag, tiles.ncc)


def _rank_motions(
    matcher: _Matcher, motions: Sequence[Float], models: Sequence[str]
) -> tuple[list[Float], float]:
    """Refine motions; those that may still win, the best first, and its lead over the next."""
    height, width = matcher.a.codes.shape
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)

    def apart(A: Float, B: Float) -> float:
        return float(np.abs(apply(A, corners) - apply(B, corners)).max())

    starts: list[Float] = []
    for M in motions:
        if all(apart(M, other) > 2 for other in starts):
            starts.append(M)
    scored: list[tuple[float, Float]] = []
    for motion in starts:
        for model in models:
            matcher.rematch(motion)
            motion, _ = matcher.refine(motion, model, 4)
        scored.append((_significance(matcher.tiles(motion)), motion))
    scored.sort(key=lambda item: -item[0])
    best, motion = scored[0]
    others = [item for item in scored[1:] if apart(item[1], motion) > 2]
    lead = best / max(others[0][0], 1e-9) if others else np.inf
    return [motion, *(other for score, other in others[:2] if score > RIVAL * best)], lead


def _significance(tiles: Tiles) -> float:
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
    cov = inverse_of(H)
    u = np.einsum("nij,nj->ni", cov, b)
    robust = np.ones(len(J))
    tau2 = 0.0
    precision = H
    p = np.zeros(J.shape[2])
    chi2 = np.zeros(len(J))
    for step in range(12):
        precision = inverse_of(cov + tau2 * np.eye(2))
        p = _weighted(J, precision, robust, u)
        e = u - J @ p
        tau2 = scatter(e, cov)
        precision = inverse_of(cov + tau2 * np.eye(2))
        chi2 = np.einsum("ni,nij,nj->n", e, precision, e)
        # graduated: a generous weight first, so that a poor start does not lose the majority
        robust = (1 + chi2 / (OUTLIER * max(1, 8 >> step))) ** -2
    return _Fit(p, precision, robust, chi2, float(np.sqrt(tau2)))


def scatter(e: Float, cov: Float) -> float:
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


def inverse_of(A: Float) -> Float:
    """Of symmetric 2 x 2 matrices, (n, 2, 2)."""
    out = np.empty_like(A)
    det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] ** 2
    out[:, 0, 0], out[:, 1, 1] = A[:, 1, 1] / det, A[:, 0, 0] / det
    out[:, 0, 1] = out[:, 1, 0] = -A[:, 0, 1] / det
    return out


def _choose(tiles: Tiles, models: Sequence[str], shape: tuple[int, ...]) -> str:
    """The model of least BIC, noise and scatter taken from the richest one."""
    height, width = shape
    centre, scale = (
        np.array([(width - 1) / 2, (height - 1) / 2]),
        float(np.hypot(height, width) / 2),
    )
    names = [m for m in MODELS if m in models and 2 * len(tiles.x) > 3 * MODELS[m]]
    if not names:
        return next(m for m in MODELS if m in models)
    J = fields(tiles.x, centre, scale, MODELS[names[-1]])
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
    normal = flat.T @ right
    normal += 1e-12 * np.trace(normal) * np.eye(len(normal))
    return np.linalg.solve(normal, flat.T @ u.reshape(-1))
