"""All corners of a board from a few places on it that are known, by fitting rendered patches.

Each corner is predicted by the homography of what is known around it and kept where the picture
shows the board there (:mod:`chromeball.calibrate.patch`); found corners predict the next ones,
so that a board is followed through distortion that no homography of the whole could describe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.patch import BLURS, LEAST_CORRELATION, Board, Fit, fit_corner

#: How far away, in squares, what predicts a corner may be, and how many such points suffice.
NEAR = 3.2
NEIGHBOURS = 12
#: Corners that tell the blur.
SAMPLES = 8


@dataclass(frozen=True)
class Found:
    """Corners ``pixels`` (M, 2), NaN where not seen; standard errors ``sigma`` (M,) of a
    coordinate, pixels; ``blur``, the spread of edges that renders the board most like the
    picture, pixels.
    """  # noqa: D205

    pixels: NDArray[np.float64]
    sigma: NDArray[np.float64]
    blur: float


def grow(
    picture: NDArray[np.uint8],
    board: Board,
    places: NDArray[np.float64],
    known: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> Found:
    """Corners at `places` (M, 2) of the board, from `known` places (N, 2) seen at `pixels`."""
    found = np.full(places.shape, np.nan)
    sigma = np.full(len(places), np.nan)
    homographies = neighbourhoods(places, found, known, pixels)
    if not homographies:
        return Found(found, sigma, np.nan)
    blur = fit_blur(picture, board, places, homographies)
    seen = 0
    while True:
        found, sigma = fit_all(picture, board, places, homographies, blur)
        count = int(np.isfinite(sigma).sum())
        grown, seen = count > seen, max(count, seen)
        if not grown or count == len(places):
            break
        homographies = neighbourhoods(places, found, known, pixels)
    if not seen:
        return Found(found, sigma, np.nan)
    # Once more, from neighbours that are all well placed now.
    return refit(picture, board, places, found, blur)


def refit(
    picture: NDArray[np.uint8],
    board: Board,
    places: NDArray[np.float64],
    found: NDArray[np.float64],
    blur: float | None = None,
) -> Found:
    """Corners fitted anew, each where its neighbours among `found` (M, 2) put it.

    `blur` is about the picture's, if it is known.
    """
    nothing = np.zeros((0, 2))
    homographies = neighbourhoods(places, found, nothing, nothing)
    if not homographies:
        return Found(np.full_like(found, np.nan), np.full(len(found), np.nan), np.nan)
    blur = fit_blur(picture, board, places, homographies, blur)
    return Found(*fit_all(picture, board, places, homographies, blur), blur)


def fit_all(
    picture: NDArray[np.uint8],
    board: Board,
    places: NDArray[np.float64],
    homographies: dict[int, NDArray[np.float64]],
    blur: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (M, 2) and standard errors (M,) of corners fitted where homographies put them.

    `homographies`, from (x, y, 1) on the board to pixels, are by number of the corner. NaN
    where there is none, and where the picture does not show the board.
    """
    pixels = np.full(places.shape, np.nan)
    sigma = np.full(len(places), np.nan)
    for i, h in homographies.items():
        fit = fit_corner(picture, board, places[i], h, blur)
        if fit.correlation > LEAST_CORRELATION:
            pixels[i], sigma[i] = fit.place, fit.sigma
    return pixels, sigma


def fit_blur(
    picture: NDArray[np.uint8],
    board: Board,
    places: NDArray[np.float64],
    homographies: dict[int, NDArray[np.float64]],
    about: float | None = None,
) -> float:
    """The blur of :data:`BLURS` whose patches correlate best, over some of the corners.

    Searched from `about` on if it is given, else over all.
    """
    scores: dict[int, float] = {}

    def score(k: int) -> float:
        if k not in scores:
            scores[k] = _score(picture, board, places, homographies, BLURS[k])
        return scores[k]

    start = range(1, len(BLURS), 2) if about is None else [BLURS.index(about)]
    best = max(start, key=score)
    while True:
        sides = [k for k in (best - 1, best, best + 1) if 0 <= k < len(BLURS)]
        better = max(sides, key=score)
        if better == best:
            return BLURS[best]
        best = better


def likeness(
    picture: NDArray[np.uint8],
    board: Board,
    places: NDArray[np.float64],
    found: NDArray[np.float64],
) -> float:
    """How much the picture is like the board where its corners are at `found` (M, 2)."""
    nothing = np.zeros((0, 2))
    homographies = neighbourhoods(places, found, nothing, nothing)
    return _score(picture, board, places, homographies, BLURS[3])


def _score(
    picture: NDArray[np.uint8],
    board: Board,
    places: NDArray[np.float64],
    homographies: dict[int, NDArray[np.float64]],
    blur: float,
) -> float:
    """Sum of the correlations of some of the corners."""
    chosen = list(homographies.items())[:: max(1, len(homographies) // SAMPLES)]
    fits: list[Fit] = [fit_corner(picture, board, places[i], h, blur) for i, h in chosen]
    return float(sum(fit.correlation for fit in fits))


def neighbourhoods(
    places: NDArray[np.float64],
    found: NDArray[np.float64],
    known: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> dict[int, NDArray[np.float64]]:
    """Homographies to pixels about each of `places`, by the number of the corner.

    By the nearest `found` corners, but not by the corner itself; where they are too few the
    places `known` from the start help.
    """
    seen = np.flatnonzero(np.isfinite(found[:, 0]))
    board, image = places[seen], found[seen]
    more = np.concatenate([board, known]), np.concatenate([image, pixels])
    homographies: dict[int, NDArray[np.float64]] = {}
    for i, place in enumerate(places):
        own = np.append(seen == i, np.zeros(len(known), bool))
        h = _homography(place, board, image, own[: len(seen)])
        if h is None and len(known):
            h = _homography(place, *more, own)
        if h is not None:
            homographies[i] = h
    return homographies


def _homography(
    place: NDArray[np.float64],
    known: NDArray[np.float64],
    pixels: NDArray[np.float64],
    without: NDArray[np.bool_],
) -> NDArray[np.float64] | None:
    """By the nearest of `known`, least squares of the direct linear equations."""
    here = known - place
    near = np.flatnonzero((np.abs(here).max(axis=1, initial=0) < NEAR) & ~without)
    if len(near) < 4:
        return None
    near = near[np.argsort((here[near] ** 2).sum(axis=1), kind="stable")[:NEIGHBOURS]]
    x, y = here[near].T
    middle = pixels[near].mean(axis=0)
    u, v = (pixels[near] - middle).T
    spread = np.linalg.eigvalsh(np.cov(x, y, bias=True) * len(x))
    if spread[0] < 0.09 or (len(near) == 4 and _three_in_line(here[near])):
        return None
    size = float(np.abs([u, v]).max())
    u, v = u / size, v / size
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=-1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=-1),
        ]
    )
    h = np.append(np.linalg.lstsq(rows, np.concatenate([u, v]), rcond=None)[0], 1.0)
    to_pixels = np.array([[size, 0, middle[0]], [0, size, middle[1]], [0, 0, 1]])
    from_place = np.array([[1, 0, -place[0]], [0, 1, -place[1]], [0, 0, 1.0]])
    h = to_pixels @ h.reshape(3, 3) @ from_place
    return None if abs(np.linalg.det(h)) < 1e-12 else np.asarray(h, float)


def _three_in_line(four: NDArray[np.float64]) -> bool:
    """Whether three of four points lie in a line, which leaves a homography open."""
    (a, b, c, d) = four
    return any(
        abs((q - p)[0] * (r - p)[1] - (q - p)[1] * (r - p)[0]) < 0.05
        for p, q, r in ((a, b, c), (a, b, d), (a, c, d), (b, c, d))
    )
