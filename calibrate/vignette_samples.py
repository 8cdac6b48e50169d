"""What evenly bright things measure of a lens's fall-off: a board's paper, flat fields."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.target import Target
from chromeball.calibrate.vignette import Samples
from chromeball.scene.errors import UserError
from chromeball.scene.vignette import Edge

type Float = NDArray[np.float64]

#: Places along a square's side that are looked up, fewest of them that are white, and of
#: pixels that they stand for.
STEPS, FEWEST, FEWEST_PIXELS = 24, 12, 12.0
#: Pixels between them and the nearest edge of black, and the spreads of edges added.
MARGIN, BLURS = 1.5, 2.5
#: Least relative error of a place: paper and print.
PAPER = 0.002
#: Blocks along a flat field's longer side, and tiles of blocks that err together.
BLOCKS, TILES = 96, 6
#: Sectors in which a hard edge is sought, fewest that must show it; the share of the light
#: that is left, and the way of it over the radius.
SECTORS, SHOW, LEFT, WAY = 48, 5, 0.5, 0.04
#: A gradient of one flat picture across the half diagonal, ln, that cannot be the lens's.
GRADIENT = 0.05


@dataclass(frozen=True)
class Picture:
    """``radiance`` (H, W) linear; ``unusable`` (H, W): saturated, or not valid."""

    name: str
    radiance: NDArray[np.float32]
    unusable: NDArray[np.bool_]


@dataclass(frozen=True)
class Counted:
    """Samples, the views they are of, and how many squares were saturated."""

    samples: Samples
    views: tuple[str, ...]
    saturated: int


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
        When white is saturated in most squares, or no square is large enough.

    """
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


@dataclass(frozen=True)
class Field:
    """Samples of flat fields; the hard edge that cuts them, or None, and its fit in pixels."""

    samples: Samples
    edge: Edge | None
    edge_rms: float
    edge_share: float
    dark: float


def flat_samples(pictures: Sequence[Picture], turns: Sequence[float] | None) -> Field:
    """Blocks of flat-field pictures.

    `turns`: clockwise turns of the camera in each, radians, against a field whose gradient
    stays; without them the gradients of several pictures are at random.

    Raises
    ------
    UserError
        When most of it is saturated or dark, or sizes differ.

    """
    height, width = pictures[0].radiance.shape
    for picture in pictures:
        if picture.radiance.shape != (height, width):
            raise UserError("pictures of one lens have one size", file=picture.name)
        share = float(picture.unusable.mean())
        if share > 0.2:
            raise UserError(
                f"{share:.0%} of the flat field is saturated: expose it shorter",
                file=picture.name,
            )
    step = max(1, round(max(width, height) / BLOCKS))
    blocks = [_blocks(picture, step) for picture in pictures]
    light = np.stack([b[0] for b in blocks])
    usable = np.stack([b[2] for b in blocks])
    if not usable.any(axis=(1, 2)).all():
        raise UserError("a flat field is dark or saturated throughout: expose it anew")
    rows, columns = light.shape[1:]
    y, x = np.meshgrid(
        (np.arange(rows) + 0.5) * step - 0.5, (np.arange(columns) + 0.5) * step - 0.5,
        indexing="ij",
    )  # fmt: skip
    pixels = np.stack([x, y], axis=-1)
    peak = np.array([np.quantile(v[k], 0.9) for v, k in zip(light, usable, strict=True)])
    relative = np.median(light / peak[:, None, None], axis=0)
    edge, rms, share, inside = _hard_edge(relative, pixels, (width, height), step)
    usable &= inside & (light > 0)
    error = np.stack([b[1] for b in blocks]) / np.maximum(light, 1e-30)
    number, j, i = np.nonzero(usable)
    place = (pixels[j, i] - [(width - 1) / 2, (height - 1) / 2]) / (
        math.hypot(width, height) / 2
    )
    tile = (j * TILES // rows) * TILES + i * TILES // columns
    shared, random = np.zeros((len(j), 0)), np.zeros((len(j), 0))
    if turns is not None and len(pictures) > 1:
        angle = np.array(turns, float)[number]
        u = np.cos(angle) * place[:, 0] - np.sin(angle) * place[:, 1]
        v = np.sin(angle) * place[:, 0] + np.cos(angle) * place[:, 1]
        shared = np.stack([u, v, u * u - v * v, 2 * u * v], axis=1)
    elif len(pictures) > 1:
        random = place
    samples = Samples(
        pixels[j, i],
        np.log(light[number, j, i]),
        np.hypot(error[number, j, i], PAPER / 2),
        number,
        tile,  # of all pictures: what the sensor does there is one error
        random,
        (0,) * random.shape[1],
        shared,
    )
    return Field(samples, edge, rms, share, float((~inside).mean()))


def _blocks(picture: Picture, step: int) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Mean of each block, its standard error, and whether all of it is usable."""
    height, width = (n // step * step for n in picture.radiance.shape)
    shape = (height // step, step, width // step, step)
    value = picture.radiance[:height, :width].astype(float).reshape(shape)
    bad = picture.unusable[:height, :width].reshape(shape).any(axis=(1, 3))
    mean = value.mean(axis=(1, 3))
    error = value.std(axis=(1, 3)) / step
    return mean, np.maximum(error, 1e-12), ~bad


def _hard_edge(
    relative: Float, pixels: Float, size: tuple[int, int], step: int
) -> tuple[Edge | None, float, float, NDArray[np.bool_]]:
    """A circle beyond which the light breaks off: it, its RMS, its share, what is inside.

    Optical fall-off loses a few per cent over a twenty-fifth of the radius; what loses half
    over that way is something that stands in the light (seeds A 5.2), or the image circle.
    """
    whole = np.ones(relative.shape, bool)
    bright = relative > 0.3
    if not bright.any():
        raise UserError("the flat field is dark: expose it longer")
    middle = pixels[bright].mean(axis=0)
    diagonal = math.hypot(*size) / 2
    way = max(WAY * diagonal, 2.0 * step)
    points: list[Float] = []
    for k in range(SECTORS):
        turn = 2 * math.pi * k / SECTORS
        direction = np.array([math.cos(turn), math.sin(turn)])
        r = np.arange(0, 2 * diagonal, step / 2)
        q = middle + r[:, None] * direction
        inside = ((q >= 0) & (q <= np.array(size) - 1)).all(axis=1)
        at = ((q[inside] + 0.5) / step - 0.5).astype(np.float32)
        profile = cv2.remap(
            relative.astype(np.float32), at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )[0].astype(float)  # fmt: skip
        gap = math.ceil(way / (step / 2))
        if len(profile) <= gap:
            continue
        fall = np.flatnonzero(profile[gap:] < LEFT * profile[:-gap])
        if fall.size:
            first = int(fall[0])
            half = profile[first : first + gap + 1]
            down = np.flatnonzero(half < half[0] * (1 + LEFT) / 2)
            where = first + (int(down[0]) if down.size else gap // 2)
            points.append(middle + r[where] * direction)
    if len(points) < SHOW:
        return None, math.nan, len(points) / SECTORS, whole
    p = np.array(points)
    for _ in range(4):
        A = np.concatenate([2 * p, np.ones((len(p), 1))], axis=1)
        solution, _, rank, _ = np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)
        centre = solution[:2]
        radius = math.sqrt(max(float(solution[2] + centre @ centre), 0))
        off = np.linalg.norm(p - centre, axis=1) - radius
        good = np.abs(off) <= max(4 * float(np.median(np.abs(off))), step)
        if good.all() or good.sum() < SHOW:
            break
        p = p[good]
    rms = float(np.sqrt((off**2).mean()))
    if rank < 3 or not radius < 20 * diagonal or rms > way:
        return None, rms, len(points) / SECTORS, whole
    edge = Edge((float(centre[0]), float(centre[1])), radius)
    inside = np.linalg.norm(pixels - centre, axis=-1) < radius - way
    return edge, rms, len(p) / SECTORS, inside


def check_gradient(samples: Samples, size: tuple[int, int], centre: Float) -> float:
    """Gradient of a single flat picture about `centre`, ln across the half diagonal.

    Raises
    ------
    UserError
        When it is larger than a lens's: it is the field's, and cannot be told from the lens.

    """
    place = (samples.pixels - centre) / (math.hypot(*size) / 2)
    r2 = (place**2).sum(axis=1)
    columns = np.stack([np.ones_like(r2), r2, r2**2, r2**3, *place.T], axis=1)
    w = 1 / samples.sigma
    found = np.linalg.lstsq(columns * w[:, None], samples.log * w, rcond=None)[0]
    gradient = float(np.hypot(*found[-2:]))
    if gradient > GRADIENT:
        raise UserError(
            f"one picture of a field that brightens by {gradient:.0%} to one side: field and "
            "lens cannot be told apart; take it again with the camera turned by 90 and 180 "
            "degrees, and give --turns 0,90,180"
        )
    return gradient
