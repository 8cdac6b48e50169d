"""The rotation between two frames from their matches, robust, with its rivals.

Two matches fix a rotation; many random twos are tried at once and the one that most matches
agree with is refined (RANSAC; Wahba's problem by SVD). A pair is believed when more matches
agree than chance explains (Brown and Lowe 2007, eq. 13). Where a second rotation explains as
many (tiled walls), it is kept as a rival, to be told apart by the other frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]

TRIALS = 600
JURY = 250  # matches that vote on them
LEAST = 9  # inliers below which a rotation means nothing


@dataclass(frozen=True)
class Link:
    """Frames ``first`` and ``second`` see the same things.

    ``rotation`` takes directions of the second's axes to the first's; ``matches`` (M, 2) are
    the indices of features that agree with it, of ``tried`` matches.
    """

    first: int
    second: int
    rotation: Array
    matches: NDArray[np.int64]
    tried: int


def wahba(first: Array, second: Array, weights: Array | None = None) -> Array:
    """R (3, 3) that minimises sum w |first - R second|^2 (Wahba 1965, by SVD)."""
    w = np.ones(len(first)) if weights is None else weights
    return nearest((first * w[:, None]).T @ second)


def nearest(matrix: Array) -> Array:
    """The rotation nearest to a (3, 3) matrix."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt, float)


def find_rotations(
    first: Array, second: Array, tolerance: float, rng: np.random.Generator, most: int = 3
) -> list[tuple[Array, NDArray[np.bool_]]]:
    """Rotations with first = R second within `tolerance` radians, and who agrees, best first.

    `first`, `second` (M, 3) are unit directions, NaN where there is none.
    """
    usable = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    free = usable.copy()
    found: list[tuple[Array, NDArray[np.bool_]]] = []
    a, b = np.nan_to_num(first), np.nan_to_num(second)
    for _ in range(most):
        if free.sum() < LEAST:
            break
        rotation = _best(a[free], b[free], tolerance, rng)
        if rotation is None:
            break
        for _ in range(4):
            agree = usable & (np.linalg.norm(a - b @ rotation.T, axis=1) < tolerance)
            if agree.sum() < 3:
                break
            rotation = wahba(a[agree], b[agree])
        agree = usable & (np.linalg.norm(a - b @ rotation.T, axis=1) < tolerance)
        if agree.sum() < LEAST:
            break
        found.append((rotation, agree))
        free &= ~agree
    return sorted(found, key=lambda item: -int(item[1].sum()))


def _best(a: Array, b: Array, tolerance: float, rng: np.random.Generator) -> Array | None:
    """The rotation of two matches that most others agree with."""
    i, j = rng.integers(0, len(a), (2, TRIALS))
    # both must see the same angle between the two, and it must not be small
    apart = np.linalg.norm(a[i] - a[j], axis=1)
    same = np.abs(apart - np.linalg.norm(b[i] - b[j], axis=1)) < 2 * tolerance
    i, j = i[same & (apart > 4 * tolerance)], j[same & (apart > 4 * tolerance)]
    if i.size == 0:
        return None
    rotations = _frame(a[i], a[j]) @ np.swapaxes(_frame(b[i], b[j]), 1, 2)
    some = rng.permutation(len(a))[:JURY]
    turned = rotations.reshape(-1, 3) @ b[some].T  # (3 K, M)
    cosines = (turned.reshape(-1, 3, len(some)) * a[some].T).sum(axis=1)
    return rotations[int((cosines > 1 - tolerance**2 / 2).sum(axis=1).argmax())]


def _frame(p: Array, q: Array) -> Array:
    """Axes (K, 3, 3) from two directions: their middle, their plane's normal."""
    x = p + q
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    z = np.cross(p, q)
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-300)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def believable(inliers: int, in_overlap: int) -> bool:
    """More agree than chance explains (Brown and Lowe 2007, eq. 13)."""
    return inliers >= LEAST and inliers > 8 + 0.3 * in_overlap
