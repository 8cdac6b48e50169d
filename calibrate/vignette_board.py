"""What a board's white paper measures of a lens's fall-off."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.target import CircleGrid, Target
from chromeball.calibrate.vignette_data import PAPER, Picture, Samples
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]

#: Places along a square's side that are looked up, fewest of them that are white, and of
#: pixels that they stand for.
STEPS, FEWEST, FEWEST_PIXELS = 24, 12, 12.0
#: Pixels between them and the nearest edge of black, and the spreads of edges added.
MARGIN, BLURS = 1.5, 2.5


@dataclass(frozen=True)
class Counted:
    """Samples, the views they are of, and how many squares were saturated."""

    samples: Samples
    views: tuple[str, ...]
    saturated: int


def check_target(target: Target) -> None:
    """Refuse a target whose squares of four neighbouring corners are not whole.

    Raises
    ------
    UserError
        For AprilGrids and asymmetric grids of circles.

    """
    if isinstance(target, AprilGrid) or (isinstance(target, CircleGrid) and target.asymmetric):
        raise UserError(
            f"{target.spec}: white is measured between the corners of a chessboard, a ChArUco "
            "board or a symmetric grid of circles: photograph one of these, or use "
            "`calibrate vignette flat`"
        )


def board_samples(
    pictures: Iterable[Picture],
    corners: Sequence[Float],
    target: Target,
    blurs: Sequence[float],
) -> Counted:
    """White paper of a board in pictures whose `corners` (rows, columns, 2) are known.

    One sample a square: the mean of its white, away from black by the `blurs` of edges. Black
    is left out: what shines on it is more than what it sends.

    Raises
    ------
    UserError
        When white is saturated in most squares, no square is large enough, or the target is
        of another kind, :func:`check_target`.

    """
    check_target(target)
    white = _whiteness(target)
    kept: list[tuple[str, Float]] = []
    saturated = found = 0
    for picture, grid, blur in zip(pictures, corners, blurs, strict=True):
        rows, bad = _squares(picture, grid, white, blur if math.isfinite(blur) else 1.0)
        saturated += bad
        found += bad + len(rows)
        if len(rows) >= 6:
            kept.append((picture.name, rows))
    if found and saturated > found / 2:
        raise UserError(
            f"white is saturated in {saturated} of {found} squares: expose the board shorter"
        )
    if not kept:
        raise UserError(
            "no view shows 6 white squares large enough to measure: bring the board nearer"
        )
    table = np.concatenate([rows for _, rows in kept])
    group = np.concatenate([np.full(len(rows), k) for k, (_, rows) in enumerate(kept)])
    place = table[:, 4:6] / np.abs(table[:, 4:6]).max(axis=0)
    u, v = place.T
    light = np.stack([u, v, u * u, v * v, u * v], axis=1)
    return Counted(
        Samples(
            table[:, :2],
            table[:, 2],
            table[:, 3],
            group,
            group,
            light,
            (0, 0, 1, 1, 1),
            np.zeros((len(table), 0)),
        ),
        tuple(name for name, _ in kept),
        saturated,
    )


def _whiteness(target: Target) -> Float:
    """Squares' distances from black, in squares, (rows - 1, columns - 1, STEPS, STEPS)."""
    cells = target.cells()
    n = target.cells_per_square
    fine = -(-64 // n)
    board = np.kron(np.pad(cells, n, constant_values=255), np.ones((fine, fine), np.uint8))
    n *= fine
    away = cv2.distanceTransform((board > 127).astype(np.uint8), cv2.DIST_L2, 5) / n
    at = ((np.arange(STEPS) + 0.5) / STEPS * n).astype(int)
    # the pad is one square wide, and the first corner one square further in
    rows = ((np.arange(target.rows - 1) + 2)[:, None] * n + at).ravel()
    columns = ((np.arange(target.columns - 1) + 2)[:, None] * n + at).ravel()
    shape = (target.rows - 1, STEPS, target.columns - 1, STEPS)
    return np.asarray(away, float)[np.ix_(rows, columns)].reshape(shape).transpose(0, 2, 1, 3)


def _squares(picture: Picture, grid: Float, white: Float, blur: float) -> tuple[Float, int]:
    """(n, 6) x, y, ln I, its error, place on the board; and how many are saturated."""
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    t = (np.arange(STEPS) + 0.5) / STEPS
    u, v = (w[..., None] for w in np.meshgrid(t, t))
    far = [m[:, :, None, None, :] for m in (a, b, c, d)]
    q = (far[0] * (1 - u) + far[1] * u) * (1 - v) + (far[2] * (1 - u) + far[3] * u) * v
    sides = np.stack([np.linalg.norm(m, axis=-1) for m in (b - a, d - c, c - a, d - b)])
    short = np.nan_to_num(sides.min(axis=0))
    area = np.nan_to_num(np.abs(np.cross(_third(d - a), _third(c - b))[..., 2]) / 2 / STEPS**2)
    usable = white * short[..., None, None] > MARGIN + BLURS * blur
    count = usable.sum(axis=(2, 3))
    enough = (count >= FEWEST) & (count * area >= FEWEST_PIXELS)
    x, y = (np.nan_to_num(q[..., i], nan=-1e4).astype(np.float32) for i in range(2))
    flat = (x.shape[0] * x.shape[1] * STEPS, STEPS)
    maps = x.reshape(flat), y.reshape(flat)
    value = np.asarray(
        cv2.remap(picture.radiance, *maps, cv2.INTER_LINEAR, borderValue=-1.0), float
    ).reshape(q.shape[:-1])
    bad = cv2.remap(
        picture.unusable.astype(np.float32), *maps, cv2.INTER_LINEAR, borderValue=1.0
    ).reshape(q.shape[:-1])
    inside = np.where(usable, value > 0, True).all(axis=(2, 3))
    over = enough & (np.where(usable, bad, 0).max(axis=(2, 3)) > 0)
    good = enough & ~over & inside
    rows: list[list[float]] = []
    for j, i in np.argwhere(good).tolist():
        w = usable[j, i]
        light, place = value[j, i][w], q[j, i][w]
        middle = place.mean(axis=0)
        plane = np.concatenate([np.ones((len(light), 1)), place - middle], axis=1)
        fitted = np.linalg.lstsq(plane, light, rcond=None)[0]
        mean = float(fitted[0])
        if mean <= 0:
            continue
        left = light - plane @ fitted
        pixels = max(float(len(light) * area[j, i]), 4.0)
        noise = float(np.sqrt((left**2).sum() / max(len(light) - 3, 1))) / mean
        error = math.hypot(noise / math.sqrt(pixels), PAPER)
        board = np.argwhere(w).mean(axis=0)[::-1] / STEPS
        middle_of_board = (np.array(grid.shape[1::-1]) - 1) / 2
        on = np.array([i, j]) + board - middle_of_board
        rows.append([*middle, math.log(mean), error, *on])
    return np.array(rows).reshape(-1, 6), int(over.sum())


def _third(v: Float) -> Float:
    return np.concatenate([v, np.zeros((*v.shape[:-1], 1))], axis=-1)
