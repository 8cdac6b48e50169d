"""Which views of a board tell something that the others do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Views whose corners lie this near another's, as a share of the picture's longer side, repeat
#: it; so do those nearer than as many pixels.
NEAR_SHARE = 0.002
NEAR_PIXELS = 1.5
#: More views than this lower the errors by little and cost time.
MOST_VIEWS = 200


def repeated_views(corners: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.intp]:
    """For each view of `corners` (V, rows, columns, 2) the earlier one it repeats, or -1, (V,).

    The same picture twice, or a camera and a board that stood still, repeat the same error of
    the detector: counted twice, they would make the standard errors too small.
    """
    near = max(NEAR_PIXELS, NEAR_SHARE * max(size))
    found = np.isfinite(corners[..., 0])
    repeats = np.full(len(corners), -1, np.intp)
    for view in range(1, len(corners)):
        earlier = np.flatnonzero(repeats[:view] < 0)
        both = found[earlier] & found[view]
        gap = np.linalg.norm(corners[earlier] - corners[view], axis=-1)
        far = np.where(both, gap, 0.0).max(axis=(1, 2))
        # A view that shows more of the board than the earlier one does not repeat it.
        covered = (both.sum(axis=(1, 2)) == found[view].sum()) & (found[view].sum() > 0)
        same = earlier[covered & (far < near)]
        if len(same):
            repeats[view] = same[0]
    return repeats


def spread_views(corners: NDArray[np.float64], most: int = MOST_VIEWS) -> NDArray[np.bool_]:
    """The `most` views of `corners` (V, rows, columns, 2) that differ most, as marks (V,).

    Each next one is the farthest from those chosen, by where its board's corners lie: middle,
    size, slant and foreshortening (Gonzalez 1985).
    """
    chosen = np.zeros(len(corners), bool)
    if len(corners) <= most:
        return np.ones(len(corners), bool)
    place = np.array([_place(view) for view in corners])
    place = (place - place.mean(axis=0)) / np.maximum(place.std(axis=0), 1e-12)
    chosen[np.argmax(np.linalg.norm(place, axis=1))] = True
    distance = np.linalg.norm(place - place[chosen][0], axis=1)
    while chosen.sum() < most:
        far = int(np.argmax(distance))
        chosen[far] = True
        distance = np.minimum(distance, np.linalg.norm(place - place[far], axis=1))
    return chosen


def _place(view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ten numbers: a quadratic form of the grid, fitted to corners (rows, columns, 2)."""
    rows, columns = view.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    found = np.isfinite(view[..., 0])
    terms = np.stack([np.ones_like(x), x, y, x * y, x**2 + y**2], axis=-1)[found]
    known = terms.T @ terms + 1e-3 * np.eye(5)
    return np.linalg.solve(known, terms.T @ view[found]).ravel()
