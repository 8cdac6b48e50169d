"""All corners of a board from a few places on it that are known, by fitting rendered patches.

Each corner is predicted by the homography of what is known around it and kept where the picture
shows the board there (:mod:`chromeball.calibrate.patch`); found corners predict the next ones,
so that a board is followed through distortion that no homography of the whole could describe.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
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
    homographies = _neighbourhoods(places, found, known, pixels)
    if not homographies:
        return Found(found, sigma, np.nan)
    blur = fit_blur(picture, board, places, homographies, BLURS)
    seen = 0
    while True:
        found, sigma = fit_all(picture, board, places, homographies, blur)
        count = int(np.isfinite(sigma).sum())
        grown, seen = count > seen, max(count, seen)
        if not grown or count == len(places):
            break
        homographies = _neighbourhoods(places, found, known, pixels)
    if not seen:
        return Found(found, sigma, np.nan)
    # Once more, from neighbours that are all well placed now.
    homographies = _neighbourhoods(places, found, known, pixels)
    k = BLURS.index(blur)
    blur = fit_blur(picture, board, places, homographies, BLURS[max(0, k - 1) : k + 2])
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
    blurs: tuple[float, ...],
) -> float:
    """The one of `blurs` whose patches correlate best, over some of the corners."""
    return max(blurs, key=lambda blur: _score(picture, board, places, homographies, blur))


def likeness(
    picture: NDArray[np.uint8],
    board: Board,
    places: NDArray[np.float64],
    known: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> float:
    """How much the picture is like the board about `known` places (N, 2) seen at `pixels`."""
    nothing = np.full(places.shape, np.nan)
    homographies = _neighbourhoods(places, nothing, known, pixels)
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


def _neighbourhoods(
    places: NDArray[np.float64],
    found: NDArray[np.float64],
    known: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> dict[int, NDArray[np.float64]]:
    """Homographies to pixels about each of `places`, by the number of the corner.

    By the nearest found corners, but not by the corner itself; where they are too few the
    places known from the start help.
    """
    seen = np.isfinite(found[:, 0])
    homographies: dict[int, NDArray[np.float64]] = {}
    for i, place in enumerate(places):
        others = seen.copy()
        others[i] = False
        h = _homography(place, places[others], found[others])
        if h is None:
            h = _homography(
                place,
                np.concatenate([places[others], known]),
                np.concatenate([found[others], pixels]),
            )
        if h is not None:
            homographies[i] = h
    return homographies


def _homography(
    place: NDArray[np.float64], known: NDArray[np.float64], pixels: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    distance = np.abs(known - place).max(axis=1)
    near = np.flatnonzero(distance < NEAR)
    if len(near) < 4:
        return None
    near = near[np.argsort(np.hypot(*(known[near] - place).T), kind="stable")[:NEIGHBOURS]]
    here = known[near] - place
    spread = np.linalg.svd(here - here.mean(axis=0), compute_uv=False)
    if spread[1] < 0.3 or (len(near) == 4 and _three_in_line(here)):
        return None
    h: Any = cv2.findHomography(known[near], pixels[near])[0]
    return None if h is None or abs(np.linalg.det(h)) < 1e-12 else np.asarray(h, float)


def _three_in_line(four: NDArray[np.float64]) -> bool:
    """Whether three of four points lie in a line, which leaves a homography open."""
    return any(
        abs(np.cross(np.append(b - a, 0.0), np.append(c - a, 0.0))[2]) < 0.05
        for a, b, c in (four[[0, 1, 2]], four[[0, 1, 3]], four[[0, 2, 3]], four[[1, 2, 3]])
    )
