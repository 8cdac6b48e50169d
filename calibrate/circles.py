"""Centres of a grid of circles, freed from the bias of perspective.

OpenCV finds the grid. Each disc's place is then its centroid in grey values, which blur leaves
alone, in a window that follows the local pitch and tilt. The centroid of a circle's picture is
not the picture of its centre (Heikkila 2000): the local homography, estimated from the
neighbours, says by how much, and that is taken off.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.target import CircleGrid

#: Larger pictures are searched at this width first; centroids are always at full size.
SEARCH_WIDTH = 1600
#: Least contrast of disc and paper, codes.
LEAST_CONTRAST = 12.0
#: Most blobs to search for a grid, for each of its circles.
MOST_BLOBS = 6
#: How far a disc's radius may be from the board's, relative.
SAME_SIZE = 0.2


def detect_circles(
    picture: NDArray[np.uint8], target: CircleGrid
) -> tuple[NDArray[np.float64], float]:
    """Centres (rows, columns, 2) in pixels, NaN where the grid has none, and the edges' blur.

    All of a grid must be in the picture: a part of it could be any part. Single discs are left
    out where they cannot be measured, at the picture's border or half in shadow.
    """
    grid = np.full((target.rows, target.columns, 2), np.nan)
    places = target.places()
    centres = _find(picture, target)
    if centres is None:
        return grid, np.nan
    rough = _measure(picture, centres, target)
    # The second time in windows about the first time's centres.
    fine = None if rough is None else _measure(picture, rough[0], target)
    if fine is None:
        return grid, np.nan
    centres, seen, blur = fine
    column, row = places[seen].T
    grid[row, column] = centres[seen]
    return grid, blur


def _measure(
    picture: NDArray[np.uint8], centres: NDArray[np.float64], target: CircleGrid
) -> tuple[NDArray[np.float64], NDArray[np.bool_], float] | None:
    """Better `centres` (N, 2), which of them were measured, the edges' blur; None if few."""
    places = target.places()
    homographies = [_local(places, centres, i) for i in range(len(places))]
    measured = [_centroid(picture, h, target.pitch) for h in homographies]
    radii = np.array([r for _, r, _ in measured])
    seen = (radii > 0) & (radii < 0.5 * target.pitch)
    if seen.sum() < target.count / 2:
        return None
    radius = float(np.median(radii[seen]))
    # Discs of one board are of one size; one half hidden or in a shadow's edge is not.
    seen &= np.abs(radii / radius - 1) < SAME_SIZE
    bias = np.array([_bias(h, radius) for h in homographies])
    better = np.array([c for c, _, _ in measured]) - bias
    blur = float(np.nanmedian([b for _, _, b in measured]))
    return np.where(seen[:, None], better, centres), seen, blur


def _find(picture: NDArray[np.uint8], target: CircleGrid) -> NDArray[np.float64] | None:
    """OpenCV's grid in the order of :meth:`CircleGrid.places`, (N, 2), right way round."""
    cv: Any = cv2
    count = (target.across, target.down)
    kind = cv.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv.CALIB_CB_SYMMETRIC_GRID
    width = max(picture.shape)
    for factor in [1.0] if width <= SEARCH_WIDTH else [SEARCH_WIDTH / width, 1.0]:
        small = cv.resize(picture, None, fx=factor, fy=factor, interpolation=cv.INTER_AREA)
        blobs = _blobs(small.size / (2 * target.count))
        # The search grows fast with the blobs, and where they swarm there is no grid to see.
        if not target.count <= len(blobs.detect(small)) <= MOST_BLOBS * target.count:
            continue
        for flags in (kind, kind | cv.CALIB_CB_CLUSTERING):
            found, centres = cv.findCirclesGrid(small, count, flags=flags, blobDetector=blobs)
            if found:
                centres = (np.asarray(centres, float).reshape(-1, 2) + 0.5) / factor - 0.5
                return _right_way_round(centres, target)
    return None


def _blobs(largest: float) -> Any:
    """A detector of dark discs of any size up to `largest` pixels in area."""
    cv: Any = cv2
    search = cv.SimpleBlobDetector_Params()
    search.minArea, search.maxArea = 12.0, float(largest)
    search.minDistBetweenBlobs = 3.0
    search.minConvexity, search.minInertiaRatio = 0.85, 0.05
    return cv.SimpleBlobDetector_create(search)


def _right_way_round(
    centres: NDArray[np.float64], target: CircleGrid
) -> NDArray[np.float64] | None:
    """Rows turned about where OpenCV read them mirrored; None where that cannot be mended."""
    h: Any = cv2.findHomography(target.places().astype(float), centres)[0]
    if h is None or not np.isfinite(h).all():
        return None
    middle = target.places().mean(axis=0)
    if np.linalg.det(_jacobian(h, middle)) > 0:
        return centres
    rows = centres.reshape(target.down, target.across, 2)
    # Of an asymmetric grid only the order of the rows may turn, and only of an odd count.
    turned = rows[::-1] if target.asymmetric else rows[:, ::-1]
    return None if target.asymmetric and target.down % 2 == 0 else turned.reshape(-1, 2)


def _local(
    places: NDArray[np.int_], centres: NDArray[np.float64], i: int
) -> NDArray[np.float64]:
    """Homography from steps about circle `i` to pixels, by it and its nearest neighbours."""
    steps = (places - places[i]).astype(float)
    near = np.argsort((steps**2).sum(axis=1), kind="stable")[:13]
    return np.asarray(cv2.findHomography(steps[near], centres[near])[0], float)


def _jacobian(h: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the homography's pixels by the place, (2, 2)."""
    x, y, w = h @ np.append(place, 1.0)
    pixel = np.array([x, y]) / w
    return np.asarray((h[:2, :2] - pixel[:, None] * h[2, :2]) / w, float)


def _centroid(
    picture: NDArray[np.uint8], h: NDArray[np.float64], pitch: float
) -> tuple[NDArray[np.float64], float, float]:
    """Centroid (2,) of the disc at `h`'s origin, its radius in steps, its edges' blur, pixels.

    `pitch` is the distance to the nearest circle in steps. NaN where the window leaves the
    picture or holds no dark disc.
    """
    lost = np.full(2, np.nan), np.nan, np.nan
    turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    reach = 0.5 * pitch
    rim = _apply(h, reach * ring)
    low, high = np.floor(rim.min(axis=0)), np.ceil(rim.max(axis=0))
    if not (low >= 0).all() or not (high < picture.shape[::-1]).all() or np.ptp(rim) > 4000:
        return lost
    x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    pixels = np.stack([x, y], axis=-1)
    steps = np.linalg.norm(_apply(np.linalg.inv(h), pixels.reshape(-1, 2)), axis=-1)
    distance = steps.reshape(x.shape)
    (left, top), (right, bottom) = low.astype(int).tolist(), high.astype(int).tolist()
    codes = picture[top : bottom + 1, left : right + 1].astype(float)
    # The paper's shade is a plane through the window's outermost ring.
    paper = (distance > 0.88 * reach) & (distance <= reach)
    inside = distance <= reach
    start = _apply(h, np.zeros((1, 2)))[0]
    terms = np.stack([np.ones_like(x), x - start[0], y - start[1]], axis=-1)
    if paper.sum() < 6:
        return lost
    plane = np.linalg.lstsq(terms[paper], codes[paper], rcond=None)[0]
    dark = (terms @ plane - codes)[inside]
    contrast = float(np.percentile(dark, 90))
    if contrast < LEAST_CONTRAST:
        return lost
    centre = (dark[:, None] * pixels[inside]).sum(axis=0) / dark.sum()
    jacobian = _jacobian(h, np.zeros(2))
    area = dark.sum() / contrast / abs(np.linalg.det(jacobian))
    radius = float(np.sqrt(max(area, 0.0) / np.pi))
    return centre, radius, _edge_blur(picture, h, ring[::4], reach)


def _edge_blur(
    picture: NDArray[np.uint8],
    h: NDArray[np.float64],
    ring: NDArray[np.float64],
    reach: float,
) -> float:
    """Standard deviation of the edge's spread: contrast / largest slope = sqrt(2 pi) sigma."""
    spreads: list[float] = []
    for way in ring:
        line = _apply(h, np.linspace(0, reach, 80)[:, None] * way)
        x, y = (np.ascontiguousarray(line[:, i : i + 1], np.float32) for i in range(2))
        profile = cv2.remap(picture.astype(np.float32), x, y, cv2.INTER_LINEAR).ravel()
        spacing = np.linalg.norm(np.diff(line, axis=0), axis=-1)
        slope = float(np.abs(np.diff(profile) / spacing).max())
        if slope > 0:
            spreads.append(float(np.ptp(profile)) / (np.sqrt(2 * np.pi) * slope))
    return float(np.median(spreads)) if spreads else float("nan")


def _bias(h: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Centroid of the disc's picture less the picture of its centre, pixels, (2,)."""
    # Equal areas of the disc, each weighed by the pixels that it covers.
    shells = np.sqrt((np.arange(8) + 0.5) / 8) * radius
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    disc = (
        shells[:, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)[None]
    ).reshape(-1, 2)
    # The determinant of a homography's Jacobian falls with the cube of its denominator.
    weight = np.abs(disc @ h[2, :2] + h[2, 2]) ** -3.0
    seen = (weight[:, None] * _apply(h, disc)).sum(axis=0) / weight.sum()
    return np.asarray(seen - _apply(h, np.zeros((1, 2)))[0], float)


def _apply(h: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    mapped = places @ h[:, :2].T + h[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:], float)
