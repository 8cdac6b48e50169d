"""A corner to a small part of a pixel by fitting the rendered board around it.

Where markers stand close to the corners a gradient method has only a narrow white rim to work
in. The picture around a corner is instead compared with what the board would look like there:
its cells through the local homography, blurred as the picture is. Gain, offset and shift follow
by Gauss-Newton (inverse compositional, Baker and Matthews 2004), so that every edge in reach
counts, the markers' too.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

#: Half of the compared window, in pitches: all of it on the four squares about the corner.
REACH = 0.45
#: Supersampling of the rendered patch.
FINE = 3
#: Least correlation of picture and patch to believe in a corner.
LEAST_CORRELATION = 0.85
BLURS = (0.4, 0.7, 1.0, 1.4, 1.9, 2.5, 3.2, 4.0, 5.0)


@dataclass(frozen=True)
class Board:
    """``cells`` as of a target, ``n`` of them a square; inner corner (0, 0) is at square 1."""

    cells: NDArray[np.uint8]
    n: int


def fit_corner(
    picture: NDArray[np.uint8],
    board: Board,
    corner: tuple[int, int],
    h: NDArray[np.float64],
    sigma: float,
) -> tuple[NDArray[np.float64], float]:
    """Place of inner corner (row, column) near where `h` puts it, (2,), and the correlation.

    `h` (3, 3) is the homography from (column, row, 1) to pixels about the corner, `sigma` the
    picture's blur in pixels. The correlation is 0 where the fit is lost or the picture's border
    too near.
    """
    height, width = picture.shape
    row, column = corner
    sides = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    start, right, left, below, above = apply(h, np.array([column, row]) + sides)
    pitch = float(min(np.linalg.norm(right - left), np.linalg.norm(below - above)))
    if not np.isfinite(pitch):
        return start, 0.0
    room = np.minimum(start, [width - 1, height - 1] - start).min() - 0.15 * pitch - 1
    half = int(min(round(REACH * pitch), 24, np.floor(room)))
    if half < 4:
        return start, 0.0
    patch = render_patch(board, h, start, half + 1, sigma)
    dx = (patch[1:-1, 2:] - patch[1:-1, :-2]) / 2
    dy = (patch[2:, 1:-1] - patch[:-2, 1:-1]) / 2
    template = patch[1:-1, 1:-1]
    basis = np.stack([np.ones_like(template), template, -dx, -dy], axis=-1).reshape(-1, 4)
    solve = np.linalg.pinv(basis)
    place, correlation = _search(picture, template, start, round(0.15 * pitch) + 1)
    size = (2 * half + 1, 2 * half + 1)
    for _ in range(20):
        seen = cv2.getRectSubPix(picture, size, place.tolist(), patchType=cv2.CV_32F)
        values = np.asarray(seen, float).ravel()
        offset, gain, *shift = (solve @ values).tolist()
        step = np.array(shift) / gain if gain > 0 else np.array([np.inf, np.inf])
        place = place + step
        if not np.abs(place - start).max() < 0.25 * pitch + 1:
            return start, 0.0
        if np.abs(step).max() < 1e-3:
            rest = values - basis @ np.array([offset, gain, *shift])
            correlation = float(np.sqrt(max(0.0, 1 - rest.var() / max(values.var(), 1e-9))))
            return place, correlation
    return place, min(correlation, LEAST_CORRELATION / 2)


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
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float32)
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
