"""What evenly bright fields measure of a lens's fall-off, and hard edges in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.vignette_data import PAPER, Picture, Samples
from chromeball.scene.errors import UserError
from chromeball.scene.vignette import Edge

type Float = NDArray[np.float64]

#: Blocks along a flat field's longer side, and tiles of blocks that err together.
BLOCKS, TILES = 96, 6
#: Sectors in which a hard edge is sought, fewest that must show it; the share of the light
#: that is left, and the way of it over the radius.
SECTORS, SHOW, LEFT, WAY = 48, 5, 0.5, 0.04
#: A gradient of one flat picture across the half diagonal, ln, that cannot be the lens's.
GRADIENT = 0.05


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
    edge, rms, used = _circle(np.array(points), float(step))
    if edge is None or not edge.radius < 20 * diagonal or rms > way:
        return None, rms, len(points) / SECTORS, whole
    inside = np.linalg.norm(pixels - edge.centre, axis=-1) < edge.radius - way
    return edge, rms, used / SECTORS, inside


def _circle(points: Float, tolerance: float) -> tuple[Edge | None, float, int]:
    """The circle through most of `points` (N, 2), its RMS, and how many these are."""
    p, edge, rms = points, None, math.inf
    for _ in range(4):
        A = np.concatenate([2 * p, np.ones((len(p), 1))], axis=1)
        solution, _, rank, _ = np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)
        centre = solution[:2]
        radius = math.sqrt(max(float(solution[2] + centre @ centre), 0))
        if rank < 3 or radius == 0:
            return None, math.inf, len(p)
        edge = Edge((float(centre[0]), float(centre[1])), radius)
        off = np.linalg.norm(p - centre, axis=1) - radius
        rms = float(np.sqrt((off**2).mean()))
        good = np.abs(off) <= max(4 * float(np.median(np.abs(off))), tolerance)
        if good.all() or good.sum() < SHOW:
            break
        p = p[good]
    return edge, rms, len(p)


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
