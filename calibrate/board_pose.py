"""The poses that a board may have behind a lens, though more than half of its corners be false.

Least quantile of squares (Rousseeuw 1984, section 4, with a smaller quantile than his median):
of homographies through four corners the one counts whose nearest corners are the nearest.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.pose import on_plane, start_poses
from chromeball.scene.pose import Pose

#: Share of the corners that must agree; one less true is not found.
AGREE = 0.4
#: Samples: of 54 % false corners all are false in one of a thousand.
SAMPLES = 150
#: A corner farther off than so many deviations of a coordinate is left out.
FAR = 3.0


def board_poses(points: NDArray[np.float64], rays: NDArray[np.float64]) -> list[Pose]:
    """As :func:`chromeball.calibrate.pose.start_poses` for a board's points (N, 3), z = 0.

    Without the false corners; `rays` (N, 3) are unit directions.
    """
    seen = on_plane(rays)
    if seen is None or len(points) < 4:
        return []
    kept = _agreeing(points[:, :2], seen[0])
    return start_poses(points[kept], rays[kept])


def _agreeing(places: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the corners (N, 2) `seen` at (N, 2) one homography explains; all in doubt."""
    everything = np.ones(len(places), bool)
    x = places - places.mean(axis=0)
    x = x / max(float(np.abs(x).max()), 1e-300)
    samples = _samples(x)
    if not len(samples):
        return everything
    # u = (a x + b y + c) / (g x + h y + 1), and v alike: eight equations of four corners.
    (px, py), (u, v) = x[samples].transpose(2, 0, 1), seen[samples].transpose(2, 0, 1)
    one, nought = np.ones_like(px), np.zeros_like(px)
    above = np.stack([px, py, one, nought, nought, nought, -u * px, -u * py], axis=-1)
    below = np.stack([nought, nought, nought, px, py, one, -v * px, -v * py], axis=-1)
    system = np.concatenate([above, below], axis=1)
    regular = np.abs(np.linalg.det(system)) > 1e-14
    if not regular.any():
        return everything
    right = np.concatenate([u, v], axis=1)[regular, :, None]
    h = np.linalg.solve(system[regular], right)[..., 0]
    h = np.concatenate([h, np.ones((len(h), 1))], axis=1).reshape(-1, 3, 3)
    mapped = np.column_stack([x, np.ones(len(x))]) @ h.transpose(0, 2, 1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        square = ((mapped[..., :2] / mapped[..., 2:] - seen) ** 2).sum(axis=-1)
    square = np.where(mapped[..., 2] > 0, square, math.inf)
    rank = min(len(x) - 1, max(4, math.ceil(AGREE * len(x))))
    quantile = np.partition(square, rank, axis=1)[:, rank]
    best = int(np.argmin(quantile))
    # The quantile of chi-square with two degrees of freedom: a deviation's square.
    variance = quantile[best] / (-2 * math.log(1 - (rank + 1) / (len(x) + 1)))
    kept = square[best] <= max(2 * FAR**2 * variance, 1e-18)
    return kept if kept.sum() >= 4 else everything


def _samples(x: NDArray[np.float64]) -> NDArray[np.intp]:
    """Fours of the N places (N, 2) of which no three lie in a line, (K, 4)."""
    rng = np.random.default_rng(0)
    fours = rng.random((SAMPLES * 2, len(x))).argsort(axis=1)[:, :4]
    corners = x[fours]
    least = np.full(len(fours), math.inf)
    for i in range(4):
        a, b, c = (corners[:, (i + k) % 4] for k in range(3))
        (p, q), (r, s) = (b - a).T, (c - a).T
        least = np.minimum(least, np.abs(p * s - q * r))
    return np.asarray(fours[least > 1e-6][:SAMPLES], np.intp)
