"""A corner to a small part of a pixel by fitting the rendered board around it.

Where markers stand close to the corners a gradient method has only a narrow white rim to work
in. The picture around a corner is instead compared with what the board would look like there:
its cells through the local homography, blurred as the picture is. Gain, offset and shift follow
by Gauss-Newton (inverse compositional, Baker and Matthews 2004), so that every edge in reach
counts, the markers' too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

#: Supersampling of the rendered patch.
FINE = 2
#: Least correlation of picture and patch to believe in a corner.
LEAST_CORRELATION = 0.85
#: What a local homography may miss, one deviation: relative, and pixels at the window's edge;
#: and the noise, in codes of full contrast, that this is weighed with.
SHEAR = 0.03
BEND = 0.1
NOISE = 3.0
#: Error of a noiseless corner, from rendering and interpolation, pixels.
FLOOR = 0.005
BLURS = (0.4, 0.7, 1.0, 1.4, 1.9, 2.5, 3.2, 4.0, 5.0)


@dataclass(frozen=True)
class Board:
    """``cells`` (h, w), ``n`` of them a square; the first corner is at square 1.

    Cells are to be finer than pixels, see :meth:`of`. ``reach`` is half of the compared window,
    in squares.
    """

    cells: NDArray[np.float32]
    n: int
    reach: float

    @classmethod
    def of(cls, cells: NDArray[np.uint8], n: int, reach: float, pitch: float) -> Board:
        """A target's `cells`, split so that about two are a pixel wide where a square is
        `pitch` pixels: between their centres interpolated, edges are where they should be.
        """  # noqa: D205
        parts = max(1, round(2 * pitch / n))
        split = np.kron(cells, np.ones((parts, parts), np.uint8))
        return cls(split.astype(np.float32), n * parts, reach)


@dataclass(frozen=True)
class Fit:
    """A corner's ``place`` (2,), pixels; the ``correlation`` of picture and patch; and the
    standard error of a coordinate, ``sigma``, pixels, from the noise that the patch leaves.

    The correlation is 0 where the fit is lost or the picture's border too near.
    """  # noqa: D205

    place: NDArray[np.float64]
    correlation: float
    sigma: float


def fit_corner(
    picture: NDArray[np.uint8],
    board: Board,
    corner: NDArray[np.float64],
    h: NDArray[np.float64],
    blur: float,
) -> Fit:
    """The corner at `corner` (2,) on the board, in squares, near where `h` puts it.

    `h` (3, 3) is the homography from (x, y, 1) on the board to pixels about the corner, `blur`
    the spread of the picture's edges in pixels.
    """
    height, width = picture.shape
    sides = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    start, right, left, below, above = apply(h, corner + sides)
    pitch = float(min(np.linalg.norm(right - left), np.linalg.norm(below - above)))
    lost = Fit(start, 0.0, np.nan)
    if not np.isfinite(pitch):
        return lost
    room = np.minimum(start, [width - 1, height - 1] - start).min() - 0.15 * pitch - 1
    half = int(min(round(board.reach * pitch), 24, np.floor(room)))
    if half < 4:
        return lost
    patch = render_patch(board, h, start, half + 1, blur)
    dx = (patch[1:-1, 2:] - patch[1:-1, :-2]) / 2
    dy = (patch[2:, 1:-1] - patch[:-2, 1:-1]) / 2
    template = patch[1:-1, 1:-1]
    basis, prior = _basis(template, dx, dy), np.diag(_prior(half))
    normal = basis.T @ basis
    solve = np.linalg.solve(normal + NOISE**2 * prior, basis.T)
    place, correlation = _search(picture, template, start, round(0.15 * pitch) + 1)
    size = (2 * half + 1, 2 * half + 1)
    for _ in range(20):
        seen = cv2.getRectSubPix(picture, size, place.tolist(), patchType=cv2.CV_32F)
        values = np.asarray(seen, float).ravel()
        state = solve @ values
        gain, shift = float(state[1]), state[2:4]
        step = shift / gain if gain > 0 else np.array([np.inf, np.inf])
        place = place + step
        if not np.abs(place - start).max() < 0.25 * pitch + 1:
            return lost
        if np.abs(step).max() < 1e-3:
            rest = values - basis @ state
            correlation = float(np.sqrt(max(0.0, 1 - rest.var() / max(values.var(), 1e-9))))
            noise = float(rest @ rest) / (len(rest) - basis.shape[1])
            noise *= _interpolated(solve[2:4], place)
            spread = noise * np.linalg.inv(gain**2 * normal + noise * prior)
            sigma = np.hypot(np.sqrt((spread[2, 2] + spread[3, 3]) / 2), FLOOR)
            return Fit(place, correlation, float(sigma))
    return Fit(place, min(correlation, LEAST_CORRELATION / 2), np.nan)


def _basis(
    template: NDArray[np.float64], dx: NDArray[np.float64], dy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivatives of values by offset, gain, shift, shear and bend, (N, 14).

    Shear (4) and bend (6) are displacements linear and quadratic in the place in the window,
    pixels at its edges: what the homography does not say of the lens's distortion.
    """
    half = len(template) // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1] / half
    terms = [np.ones_like(template), template, -dx, -dy]
    terms += [-form * slope for form in (x, y, x * x, x * y, y * y) for slope in (dx, dy)]
    return np.stack(terms, axis=-1).reshape(-1, 14)


def _interpolated(weights: NDArray[np.float64], place: NDArray[np.float64]) -> float:
    """How much more noise the shift has than the variance of interpolated values suggests.

    `weights` (2, N) are those of the values in the shift. Between pixels a value is a mean of
    four, which has less noise, but shares it with its neighbours.
    """
    side = math.isqrt(weights.shape[1])
    x, y = (place - np.floor(place)).tolist()
    kernel = np.outer([1 - y, y], [1 - x, x])
    pixels = [
        cv2.filter2D(w, -1, kernel, borderType=cv2.BORDER_CONSTANT)
        for w in weights.reshape(2, side, side)
    ]
    return float(np.square(pixels).sum() / np.square(weights).sum() / np.square(kernel).sum())


def _prior(half: int) -> NDArray[np.float64]:
    """Inverse variances of the unknowns of :func:`_basis`, (14,); zero is nothing known."""
    return np.array([0.0] * 4 + [(SHEAR * half) ** -2] * 4 + [BEND**-2] * 6)


def render_patch(
    board: Board,
    h: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: int,
    sigma: float,
) -> NDArray[np.float64]:
    """The board about pixel `centre`, (2 half + 1, 2 half + 1), blurred by `sigma` pixels."""
    pad = int(np.ceil(3 * sigma)) + 1
    count = 2 * (half + pad) + 1
    x, y = centre - (half + pad) - 0.5 + 0.5 / FINE
    pixel_from_fine = np.array([[1 / FINE, 0, x], [0, 1 / FINE, y], [0, 0, 1]])
    n = board.n
    cell_from_place = np.array([[n, 0, n - 0.5], [0, n, n - 0.5], [0, 0, 1.0]])
    # Beyond the board its outermost cells go on; they are hardly in reach.
    shade = cv2.warpPerspective(
        board.cells,
        cell_from_place @ np.linalg.inv(h) @ pixel_from_fine,
        (count * FINE, count * FINE),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    # Sensor pixels are FINE wide, and are a box blur of their own.
    fine = cv2.GaussianBlur(shade, (0, 0), max(sigma, 0.1) * FINE)
    coarse = cv2.resize(fine, (count, count), interpolation=cv2.INTER_AREA)
    return np.asarray(coarse, float)[pad : count - pad, pad : count - pad]


def apply(h: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 2) through a homography."""
    mapped = points @ h[:, :2].T + h[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def _search(
    picture: NDArray[np.uint8],
    template: NDArray[np.float64],
    start: NDArray[np.float64],
    r: int,
) -> tuple[NDArray[np.float64], float]:
    """The whole pixel within `r` of `start` that correlates best."""
    half = len(template) // 2
    x, y = (round(v) for v in start.tolist())
    top, left = max(0, y - half - r), max(0, x - half - r)
    window = picture[top : y + half + r + 1, left : x + half + r + 1]
    score = cv2.matchTemplate(
        window.astype(np.float32), template.astype(np.float32), cv2.TM_CCOEFF_NORMED
    )
    _, best, _, (bx, by) = cv2.minMaxLoc(score)
    return np.array([left + bx + half, top + by + half], float), float(best)
