"""Shots of a fisheye probe to one lat-long in world axes (seeds.md P15b)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong, Mapping, Radial, of_camera
from chromeball.envmap.resample import warp
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.color import luminance
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shot:
    """One radiance picture of the probe.

    ``radiance`` (H, W, 3) float32; ``valid`` (H, W) or None; ``yaw`` about the vertical,
    right-handed, ``pitch`` up and ``roll`` clockwise, radians.
    """

    radiance: NDArray[np.float32]
    camera: CameraModel
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    valid: NDArray[np.bool_] | None = None


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
    """``radiance`` (H, W, 3) and ``alpha`` (H, W): the seen part of each pixel.

    ``missing`` sr were not seen and are completed, ``completed_share`` of the map's energy
    lies there. ``energy_error`` per shot: what resampling changed, relative.
    """

    radiance: NDArray[np.float32]
    alpha: NDArray[np.float32]
    overlaps: tuple[Overlap, ...]
    missing: float
    completed_share: float
    energy_error: tuple[float, ...]
    hot_pixels: int


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


def vignetting_gain(camera: CameraModel, coefficients: Sequence[float]) -> Array:
    """1 / (1 + c1 r^2 + c2 r^4 + ...), (H, W), r = 1 at the rim of the image circle.

    Raises
    ------
    UserError
        When the lens has no image circle or the fall-off is not positive inside it.

    """
    mapping = of_camera(camera)
    if not isinstance(mapping, Radial):
        raise UserError(f"vignetting is measured on an image circle; {camera.model} has none")
    polynomial = np.polynomial.Polynomial([1.0, *coefficients])
    if not (polynomial(np.linspace(0, 1, 1001)) > 0.01).all():
        raise UserError("the vignetting falls below 1 % inside the image circle: check c1, c2")
    width, height = camera.size
    x = (np.arange(width) - mapping.centre[0]) / (mapping.focal[0] * mapping.rim)
    y = (np.arange(height) - mapping.centre[1]) / (mapping.focal[1] * mapping.rim)
    r2 = np.minimum(x[None, :] ** 2 + y[:, None] ** 2, 1.0)
    return 1 / polynomial(r2)


def combine(
    shots: Sequence[Shot],
    rotations: Sequence[Array],
    width: int,
    vignetting: Sequence[float] = (),
) -> Panorama:
    """All shots in one lat-long of `width`, blended by cos^2 weights that end at the rim.

    `rotations` are world_from_shot (3, 3). Directions that no shot sees get the median
    radiance of the seen part's border in the same elevation band: a lamp that touches the
    border is not smeared around the back.
    """
    target = LatLong((width, width // 2))
    solid = target.solid_angles()
    world = target.directions()
    total = np.zeros((*solid.shape, 3), np.float32)
    weights = np.zeros(solid.shape, np.float32)
    alpha = np.zeros(solid.shape, np.float32)
    seen: list[tuple[NDArray[np.float32], NDArray[np.bool_]]] = []
    errors: list[float] = []
    hot = 0
    for shot, turn in zip(shots, rotations, strict=True):
        source = of_camera(shot.camera).turned(turn)
        radiance = shot.radiance
        if vignetting:
            gain = vignetting_gain(shot.camera, vignetting).astype(np.float32)
            radiance = radiance * gain[..., None]
        result = warp(radiance, source, target, valid=shot.valid)
        seeable = float((result.source_energy - result.outside).sum())
        errors.append(float(result.energy.sum()) / seeable - 1 if seeable > 0 else 0.0)
        hot += result.hot_pixels
        weight = rim_weight(source, world) * result.coverage
        total += weight[..., None] * result.radiance
        weights += weight
        alpha = np.maximum(alpha, result.coverage)
        inner = (result.coverage > 0.999) & (weight > 5e-4)  # to 98.5 % of the rim
        if len(shots) > 1:
            seen.append((luminance(result.radiance).astype(np.float32), inner))
    known = weights > 0
    total[known] /= weights[known][:, None]
    alpha[~known] = 0
    missing = alpha == 0
    complete(total, missing)
    energy = luminance(total) * solid
    return Panorama(
        radiance=total,
        alpha=alpha,
        overlaps=_overlaps(seen, solid),
        missing=float((solid * (1 - alpha)).sum()),
        completed_share=float(energy[missing].sum() / max(energy.sum(), 1e-300)),
        energy_error=tuple(errors),
        hot_pixels=hot,
    )


def rim_weight(source: Mapping, world: Array) -> NDArray[np.float32]:
    """cos^2 of the way from the axis to the rim, (H, W); small but positive up to the rim."""
    if isinstance(source, Radial):
        cosine = np.clip(world @ source.rotation[:, 2], -1, 1)
        way = np.arccos(cosine) / source.max_angle
    else:
        half = np.array(source.size) / 2
        way = np.abs(source.pixels_of(world) - (half - 0.5)) / half
        way = np.nan_to_num(way, nan=1.0).max(axis=-1)
    return (np.cos(np.minimum(way, 1) * math.pi / 2) ** 2 + 1e-6).astype(np.float32)


def complete(radiance: NDArray[np.float32], missing: NDArray[np.bool_]) -> None:
    """Fill `missing` (H, W) in place, from the border of the rest, band by band.

    The border lies 1.5 to 6 degrees inside, where no fringe of the lens' rim reaches; a band
    is 15 degrees up and down, so that a window at the border is outvoted by the walls.
    """
    import cv2

    if not missing.any() or missing.all():
        return
    height, width = missing.shape
    degree = width / 360

    def near(degrees: float) -> NDArray[np.bool_]:
        reach = max(1, round(degrees * degree))
        wide = np.pad(missing.astype(np.uint8), ((0, 0), (reach, reach)), mode="wrap")
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        return np.asarray(cv2.dilate(wide, kernel))[:, reach:-reach] > 0

    border = near(6.0) & ~near(1.5)
    if not border.any():
        border = ~missing
    rows = np.nonzero(border.any(axis=1))[0]
    half = max(1, round(15 * degree))
    bands = np.zeros((height, 3))
    step = max(1, half // 8)
    heights = np.arange(0, height + step, step)
    knots = np.zeros((len(heights), 3))
    for k, y in enumerate(heights):
        middle = int(rows[np.argmin(np.abs(rows - y))])
        band = np.s_[max(middle - half, 0) : middle + half + 1]
        knots[k] = np.median(radiance[band][border[band]], axis=0)
    for c in range(3):
        bands[:, c] = np.interp(np.arange(height), heights, knots[:, c])
    radiance[missing] = bands[np.nonzero(missing)[0]]


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
