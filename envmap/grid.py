"""Light samples as in Pomi 2005, 7.6.3 (seeds.md P16): the bright cells of a grid.

Each hemisphere is warped to a square by the concentric map of Shirley and Chiu 1997, and a
grid is laid over it. Cells whose mean luminance times the cosine exceeds a threshold make a
list of N, sorted; M samples are made of them: the brightest, with the others merged into those
near them, or a random sub-list. What is under the threshold is left to the ambient.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.lights import Lights, survey

type Array = NDArray[np.float64]

#: eq. 7.13
_LUMINANCE = np.array([0.299, 0.587, 0.114])
#: Cells of the map that are sorted into those of the grid.
_ROWS, _COLUMNS = 128, 256


def grid_lights(
    radiance: NDArray[np.float32],
    count: int,
    *,
    pick: Literal["merged", "random"] = "merged",
    threshold: float = 1.0,
    cells: int = 16,
    seed: int = 0,
    ambient: bool = True,
) -> Lights:
    """At most `count` lights from a lat-long map (H, W, 3), by `cells` x `cells` a hemisphere.

    `threshold` is in units of the median cell's luminance times cosine. The random
    sub-list is drawn from `seed`, and scaled so that its luminance is that of all N cells.

    Raises
    ------
    UserError
        When the map is black, or a pixel is negative or not finite.

    """
    sky = survey(radiance, _ROWS, _COLUMNS)
    found = sky.cells.reshape(-1, 4, 3)
    luminous = found @ _LUMINANCE
    lit = luminous[:, 0] > 0
    found, luminous = found[lit], luminous[lit]
    d = luminous[:, 1:] / np.linalg.norm(luminous[:, 1:], axis=1, keepdims=True)
    st = np.minimum((square_of(d) * cells).astype(int), cells - 1)
    cell = ((d[:, 1] < 0) * cells + st[:, 1]) * cells + st[:, 0]
    sums = np.zeros((2 * cells * cells, 4, 3))
    np.add.at(sums, cell, found)

    energy = sums @ _LUMINANCE
    weighted = np.abs(energy[:, 2])  # L cos theta, integrated: the hemispheres' axes are +-Y
    order = np.argsort(weighted, kind="stable")
    bright = (weighted[order] >= threshold * np.median(weighted)) & (weighted[order] > 0)
    listed = order[bright] if bright.any() else order[-1:]
    if listed.size > count:
        if pick == "random":
            chosen = np.random.default_rng(seed).choice(listed, count, replace=False)
            scale = energy[listed, 0].sum() / energy[chosen, 0].sum()
            result, solid = sums[chosen] * scale, np.ones(count)
        else:
            result, solid = _merged(sums[listed], count)
    else:
        result, solid = sums[listed], np.ones(len(listed))
    solid = solid * (2 * math.pi / cells**2)
    return sky.lights(result, solid, lambda: np.zeros((len(solid), 3)), ambient=ambient)


def _merged(sums: Array, count: int) -> tuple[Array, Array]:
    """The last `count`, each with those of the others that are nearest to it."""
    m = (sums @ _LUMINANCE)[:, 1:]
    d = m / np.linalg.norm(m, axis=1, keepdims=True)
    nearest = np.argmax(d @ d[-count:].T, axis=1)
    nearest[-count:] = np.arange(count)
    result = np.zeros((count, 4, 3))
    np.add.at(result, nearest, sums)
    return result, np.bincount(nearest, minlength=count).astype(float)


def square_of(d: ArrayLike) -> Array:
    """Unit directions to the unit square of their hemisphere, ``(..., 3) -> (..., 2)``.

    The hemispheres are about +-Y. The inverse of the concentric map (Shirley and Chiu 1997) of
    the equal-area disc r = sqrt(1 - |y|): equal areas of the square are equal solid angles.
    """
    v = np.asarray(d, float)
    rho = np.hypot(v[..., 0], v[..., 2])
    r = rho / np.sqrt(1 + np.abs(v[..., 1]))  # sqrt(1 - |y|) without cancellation
    phi = np.arctan2(v[..., 2], v[..., 0])
    phi = np.where(phi < -math.pi / 4, phi + 2 * math.pi, phi)  # four wedges from -pi / 4 on
    wedge = np.minimum(((phi + math.pi / 4) / (math.pi / 2)).astype(int), 3)
    across = (phi - wedge * (math.pi / 2)) * r / (math.pi / 4)  # -r .. r within the wedge
    a = np.choose(wedge, [r, -across, -r, across])
    b = np.choose(wedge, [across, r, -across, -r])
    return np.stack([a + 1, b + 1], axis=-1) / 2
