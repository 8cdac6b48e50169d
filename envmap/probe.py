"""Shots of a light probe to one lat-long in world axes (seeds.md P14b, P15b).

A shot is a fisheye's picture or a photograph of a mirror ball. Where several see, they are
blended by weights that fall to nothing at the rim, and at the photographer's reflection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.ball import BallCamera
from chromeball.envmap.mapping import LatLong, Lens, Mapping, Radial
from chromeball.envmap.refine import REACH, Refined, refine_turns
from chromeball.envmap.resample import Warped, carry, warp
from chromeball.scene.camera import WORLD_FROM_LATLONG
from chromeball.scene.color import luminance
from chromeball.scene.errors import UserError
from chromeball.scene.vignette import LEAST, Vignette, polynomial

type Array = NDArray[np.float64]

_REFINE_WIDTH = 1024
_MIN_WEIGHT = 1e-6  # up to the rim: what one shot alone sees is used whole
_FADE = 1.3  # the photographer's cone ends softly, over this times its angle


@dataclass(frozen=True)
class Shot:
    """One radiance picture of the probe.

    ``radiance`` (H, W, 3) float32; ``mapping`` its pixels' directions in camera axes;
    ``valid`` and ``clipped`` (H, W) or None, the latter lower bounds; ``yaw`` about the
    vertical, right-handed, ``pitch`` up and ``roll`` clockwise, radians. ``photographer``:
    half angle of the cone about the direction back to a ball's camera that is not used.
    ``sigma`` (H, W, 3): standard deviations of independent pixels, or None.
    """

    radiance: NDArray[np.float32]
    mapping: Mapping
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    valid: NDArray[np.bool_] | None = None
    photographer: float = 0.0
    clipped: NDArray[np.bool_] | None = None
    sigma: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Overlap:
    """How two shots agree where both see: median of their luminance ratio, and its spread.

    ``spread`` is half the distance between the 16th and 84th percentile of the ratio;
    ``solid_angle`` the size of the overlap in sr.
    """

    shots: tuple[int, int]
    ratio: float
    spread: float
    solid_angle: float


@dataclass(frozen=True)
class Panorama:
    """``radiance`` (H, W, 3), black where unseen, and ``alpha`` (H, W), the seen part.

    ``clipped`` (H, W) is the part that was too bright for every exposure, None if none was;
    ``sigma`` (H, W, 3), or None where a shot has none.
    ``energy_error`` per shot: what resampling changed, relative.
    """

    radiance: NDArray[np.float32]
    alpha: NDArray[np.float32]
    clipped: NDArray[np.float32] | None
    overlaps: tuple[Overlap, ...]
    energy_error: tuple[float, ...]
    hot_pixels: int
    sigma: NDArray[np.float32] | None = None


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """World turned by roll about +Z, then pitch (+Z rises), then yaw about +Y; radians."""
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, sp], [0, -sp, cp]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def world_from_shots(
    shots: Sequence[Shot], clicked: int = 0, world_from_clicked: Array | None = None
) -> list[Array]:
    """Rotations of all shots.

    Without an alignment, a shot of no yaw looks along +Z with +Y up. With that of shot
    `clicked`, the others are turned from it about the world's vertical.
    """
    # camera axes: x right, y down, z forward are the world's -X, -Y, +Z
    base = WORLD_FROM_LATLONG.rotation
    own = [base.T @ rotation(0.0, shot.pitch, shot.roll) @ base for shot in shots]
    if world_from_clicked is None:
        return [rotation(s.yaw, 0.0, 0.0) @ base @ p for s, p in zip(shots, own, strict=True)]
    level = world_from_clicked @ own[clicked].T
    return [
        rotation(s.yaw - shots[clicked].yaw, 0.0, 0.0) @ level @ p
        for s, p in zip(shots, own, strict=True)
    ]


def refined(
    shots: Sequence[Shot],
    rotations: Sequence[Array],
    fixed: int = 0,
    width: int | None = None,
    reach: float = REACH,
    insist: bool = False,
) -> tuple[list[Array], Refined]:
    """`rotations` (world_from_shot) improved by what the shots see together.

    Shot `fixed` keeps its place; all do where the result is not to be trusted, unless one
    does `insist`. Turns of up to `reach` radians are found. Works on maps of `width`, by
    default at the shots' own resolution, 1024 at most.
    """
    finest = max(1 / math.sqrt(_pixel(shot.mapping)) for shot in shots)  # pixels a radian
    if width is None:
        width = min(_REFINE_WIDTH, max(128, 8 * round(2 * math.pi * finest / 8)))
    target = LatLong((width, width // 2))
    world = target.directions()
    lights: list[NDArray[np.float32]] = []
    weights: list[NDArray[np.float32]] = []
    for shot, turn in zip(shots, rotations, strict=True):
        placed = _placed(shot, turn, target)
        weight = shot_weight(shot, turn, world) * (placed.coverage > 0.999)
        lights.append(luminance(placed.radiance).astype(np.float32))
        weights.append((weight * (weight > 10 * _MIN_WEIGHT)).astype(np.float32))
    found = refine_turns(lights, weights, reach)
    if found.reason and not insist:
        return list(rotations), found
    back = found.turns[fixed].T
    return [back @ t @ r for t, r in zip(found.turns, rotations, strict=True)], found


def combine(shots: Sequence[Shot], rotations: Sequence[Array], width: int) -> Panorama:
    """All shots in one lat-long of `width`; `rotations` are world_from_shot (3, 3)."""
    target = LatLong((width, width // 2))
    solid = target.solid_angles()
    world = target.directions()
    total = np.zeros((*solid.shape, 3), np.float32)
    weights = np.zeros(solid.shape, np.float32)
    alpha = np.zeros(solid.shape, np.float32)
    clipped = np.zeros(solid.shape, np.float32)
    noisy = all(shot.sigma is not None for shot in shots)
    variance = np.zeros_like(total) if noisy else None
    seen: list[tuple[NDArray[np.float32], NDArray[np.bool_]]] = []
    errors: list[float] = []
    hot = 0
    for shot, turn in zip(shots, rotations, strict=True):
        result = _placed(shot, turn, target)
        seeable = float((result.source_energy - result.outside).sum())
        errors.append(float(result.energy.sum()) / seeable - 1 if seeable > 0 else 0.0)
        hot += result.hot_pixels
        weight = shot_weight(shot, turn, world) * result.coverage
        total += weight[..., None] * result.radiance
        weights += weight
        if variance is not None and result.sigma is not None:
            variance += (weight[..., None] * result.sigma) ** 2
        alpha = np.maximum(alpha, np.where(weight > 0, result.coverage, 0))
        if shot.clipped is not None and shot.clipped.any():
            turned = turn @ shot.mapping.rotation.T
            clipped += weight * carry(
                shot.clipped, shot.mapping, target, rotation=turned, valid=shot.valid
            )
        inner = (result.coverage > 0.999) & (weight > 5e-4)  # to 98.5 % of the rim
        if len(shots) > 1:
            seen.append((luminance(result.radiance).astype(np.float32), inner))
    known = weights > 0
    total[known] /= weights[known][:, None]
    clipped[known] /= weights[known]
    sigma = None if variance is None else np.sqrt(variance)
    if sigma is not None:
        sigma[known] /= weights[known][:, None]
    return Panorama(
        radiance=total,
        alpha=alpha,
        clipped=clipped if clipped.any() else None,
        overlaps=_overlaps(seen, solid),
        energy_error=tuple(errors),
        hot_pixels=hot,
        sigma=sigma,
    )


def _pixel(mapping: Mapping) -> float:
    """Solid angle of a typical pixel, sr."""
    solid = mapping.solid_angles()
    return float(np.median(solid[solid > 0]))


def _placed(shot: Shot, world_from_shot: Array, target: Mapping) -> Warped:
    # by `rotation`: a turned mapping would make its tables anew
    turn = world_from_shot @ shot.mapping.rotation.T
    return warp(
        shot.radiance, shot.mapping, target, rotation=turn, valid=shot.valid, sigma=shot.sigma
    )


def shot_weight(shot: Shot, world_from_shot: Array, world: Array) -> NDArray[np.float32]:
    """How far a shot is trusted in each direction, (H, W); 0 where it must not be used.

    A fisheye by cos^2 of the way from its axis to its rim, a ball by cos^2(theta / 2) of the
    angle theta to its camera, where its picture is stretched by 1 / cos(theta / 2).
    """
    ball = shot.mapping.camera if isinstance(shot.mapping, Lens) else None
    if isinstance(ball, BallCamera):
        towards_camera = world_from_shot @ -ball.middle
        theta = np.arccos(np.clip(world @ towards_camera, -1, 1))
        weight = np.cos(np.minimum(theta, math.pi) / 2) ** 2 + _MIN_WEIGHT
        if shot.photographer > 0:
            fade = np.clip((theta / shot.photographer - 1) / (_FADE - 1), 0, 1)
            weight = weight * fade * fade * (3 - 2 * fade)
        return weight.astype(np.float32)
    return rim_weight(shot.mapping.turned(world_from_shot), world)


def rim_weight(source: Mapping, world: Array) -> NDArray[np.float32]:
    """cos^2 of the way from the axis to the rim, (H, W); small but positive up to the rim."""
    if isinstance(source, Radial):
        cosine = np.clip(world @ source.rotation[:, 2], -1, 1)
        way = np.arccos(cosine) / source.max_angle
    else:
        half = np.array(source.size) / 2
        way = np.abs(source.pixels_of(world) - (half - 0.5)) / half
        way = np.nan_to_num(way, nan=1.0).max(axis=-1)
    return (np.cos(np.minimum(way, 1) * math.pi / 2) ** 2 + _MIN_WEIGHT).astype(np.float32)


def without_vignetting(shot: Shot, falloff: Vignette | Sequence[float]) -> Shot:
    """The shot divided by 1 + c1 r^2 + c2 r^4 + ..., r = 1 at the rim of its image circle.

    A measured `falloff` has its own centre and radius.

    Raises
    ------
    UserError
        When the lens has no image circle or the fall-off is not positive inside it.

    """
    gain = vignetting_gain(shot.mapping, falloff).astype(np.float32)[..., None]
    sigma = None if shot.sigma is None else shot.sigma * gain
    return replace(shot, radiance=shot.radiance * gain, sigma=sigma)


def vignetting_gain(mapping: Mapping, falloff: Vignette | Sequence[float]) -> Array:
    """1 / (1 + c1 r^2 + c2 r^4 + ...), (H, W), r = 1 at the rim of the image circle.

    Raises
    ------
    UserError
        When the lens has no image circle or the fall-off is not positive inside it.

    """
    if isinstance(falloff, Vignette):
        return 1 / falloff.picture(mapping.size).astype(float)
    if not isinstance(mapping, Radial):
        raise UserError(
            "vignetting c1,c2,... counts from the rim of an image circle, and this lens has "
            "none; a vignette.json of `calibrate vignette` fits any lens"
        )
    coefficients = np.array(falloff, float)
    if not (polynomial(np.linspace(0, 1, 1001), coefficients) > LEAST).all():
        raise UserError("the vignetting falls below 1 % inside the image circle: check c1, c2")
    width, height = mapping.size
    x = (np.arange(width) - mapping.centre[0]) / (mapping.focal[0] * mapping.rim)
    y = (np.arange(height) - mapping.centre[1]) / (mapping.focal[1] * mapping.rim)
    r2 = np.minimum(x[None, :] ** 2 + y[:, None] ** 2, 1.0)
    return 1 / polynomial(r2, coefficients)


def trimmed(shot: Shot, angle: float) -> Shot:
    """Without the outermost `angle` radians of the image circle, where its edge is soft.

    Raises
    ------
    UserError
        When the lens has no image circle, or nothing would be left of it.

    """
    mapping = shot.mapping
    if not isinstance(mapping, Radial):
        raise UserError("only an image circle can be trimmed; this lens has none")
    if not 0 <= angle < mapping.max_angle / 2:
        raise UserError(
            f"a circle of {math.degrees(mapping.max_angle):.0f} degrees from axis "
            f"to rim cannot lose {math.degrees(angle):.0f}"
        )
    return replace(shot, mapping=replace(mapping, max_angle=mapping.max_angle - angle))


def _overlaps(
    seen: Sequence[tuple[NDArray[np.float32], NDArray[np.bool_]]], solid: Array
) -> tuple[Overlap, ...]:
    result: list[Overlap] = []
    for i, (first, mask) in enumerate(seen):
        for j in range(i + 1, len(seen)):
            second, other = seen[j]
            both = mask & other & (first > 0) & (second > 0)
            if both.any():
                low, ratio, high = np.percentile(first[both] / second[both], [16, 50, 84])
                spread = float(high - low) / 2
                angle = float(solid[both].sum())
                result.append(Overlap((i, j), float(ratio), spread, angle))
    return tuple(result)
