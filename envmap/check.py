"""A map held against photographs taken at its place: a matt or a mirror ball, a colour chart.

What the photograph shows is rendered from the map alone; what differs is the map's error, the
photograph's, or that of the ball's reflectance. Both must be in the same units for the ratio to
be 1: of one session, or in cd/m^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.ball import BallCamera
from chromeball.envmap.irradiance import irradiance_of
from chromeball.envmap.lights import survey
from chromeball.envmap.mapping import LatLong, Lens, pixel_grid
from chromeball.envmap.resample import warp
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: Of the ball's radius: its rim is left out, where reflectance and focus are not to be trusted.
INNER = 0.9


@dataclass(frozen=True)
class Comparison:
    """What the photograph shows beside what the map says.

    ``seen`` and ``rendered`` (H, W, 3) float32, 0 outside ``used`` (H, W). ``ratio`` (3,) is
    photograph over map per channel, a weighted mean. ``median`` and ``worst`` (95 %) are errors
    relative to the photograph's luminance, with the ratio as it is; ``median_shape`` and
    ``worst_shape`` with each channel's ratio taken out. ``light_off``: radians between
    where the light comes from in both.
    """

    seen: Picture
    rendered: Picture
    used: NDArray[np.bool_]
    ratio: Array
    median: float
    worst: float
    median_shape: float
    worst_shape: float
    light_off: float


def matt_ball(
    radiance: Picture, photograph: Picture, ball: BallCamera, world_from_camera: ArrayLike,
    *, albedo: float | ArrayLike = 0.18, used: NDArray[np.bool_] | None = None,
) -> Comparison:  # fmt: skip
    """A matt ball in a `photograph` (H, W, 3) beside one under the lat-long map's light.

    Its radiance is albedo E(n) / pi by the exact cosine integral. `albedo` is one number or
    three; `used` (H, W) marks pixels to be trusted.

    Raises
    ------
    UserError
        When fewer than 30 pixels can be compared, or either is black.

    """
    reflectance = _reflectance(albedo, "albedo")
    rays, reflected, inside = _ball_pixels(ball, photograph.shape[:2], used)
    normals = reflected - rays  # halfway between the reflection and the way back
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals @ np.asarray(world_from_camera, float).T
    light = irradiance_of(survey(radiance, 256, 512), normals)
    rendered = np.zeros_like(photograph)
    rendered[inside] = reflectance * light / math.pi
    # the direction of a gradient over the ball's normals
    return _compare(photograph, rendered, inside, lambda y: _gradient(normals, y))


def mirror_ball_check(
    radiance: Picture, photograph: Picture, ball: BallCamera, world_from_camera: ArrayLike,
    *, reflectance: float | ArrayLike = 1.0, used: NDArray[np.bool_] | None = None,
) -> Comparison:  # fmt: skip
    """A chrome ball in a `photograph` (H, W, 3) beside the map resampled to its reflection.

    Raises
    ------
    UserError
        As :func:`matt_ball`.

    """
    factor = _reflectance(reflectance, "reflectance")
    height, width = photograph.shape[:2]
    rotation = np.asarray(world_from_camera, float)
    _, reflected, inside = _ball_pixels(ball, (height, width), used)
    source = LatLong((radiance.shape[1], radiance.shape[0]))
    target = Lens((width, height), rotation, camera=ball)
    seen = warp(radiance, source, target)
    rendered = np.where(
        inside[..., None], seen.radiance * factor.astype(np.float32), np.float32(0)
    )
    directions = (reflected @ rotation.T) * target.solid_angles()[inside][:, None]

    def brightest(y: Array) -> Array:
        bright = np.maximum(y - 4 * np.median(y), 0)
        return (bright if bright.any() else y) @ directions

    return _compare(photograph, np.asarray(rendered, np.float32), inside, brightest)


@dataclass(frozen=True)
class Patch:
    """A chart's patch: x, y, width, height in px, and its reflectance (3,)."""

    region: tuple[int, int, int, int]
    reflectance: Array


@dataclass(frozen=True)
class Chart:
    """Patches ``seen`` and ``rendered`` (N, 3), and their errors as of :class:`Comparison`."""

    seen: Array
    rendered: Array
    ratio: Array
    median: float
    worst: float
    median_shape: float
    worst_shape: float


def colour_chart(
    radiance: Picture, photograph: Picture, patches: list[Patch], normal: ArrayLike
) -> Chart:
    """A flat chart with a `normal` (3,) in the world beside Lambert patches under the map.

    Raises
    ------
    UserError
        For a patch outside the photograph, a normal that is none, or no patch.

    """
    if not patches:
        raise UserError("the chart has no patch")
    n = np.asarray(normal, float)
    if not (np.isfinite(n).all() and n.any()):
        raise UserError("a normal of length 0 faces nowhere")
    light = irradiance_of(survey(radiance, 256, 512), n / np.linalg.norm(n)) / math.pi
    height, width = photograph.shape[:2]
    seen: list[Array] = []
    for number, patch in enumerate(patches, 1):
        x, y, across, down = patch.region
        if min(x, y) < 0 or min(across, down) < 1 or x + across > width or y + down > height:
            raise UserError(f"patch {number} lies outside the photograph of {width}x{height}")
        seen.append(photograph[y : y + down, x : x + across].mean(axis=(0, 1), dtype=float))
    rendered = np.stack([_reflectance(p.reflectance, "reflectance") for p in patches]) * light
    return Chart(np.stack(seen), rendered, *_errors(np.stack(seen), rendered))


def side_by_side(found: Comparison) -> Picture:
    """Photograph, rendering, and four times their difference about grey; (H, 3 W, 3), 0..1.

    The first two at one exposure, for looking at.
    """
    rows, columns = np.nonzero(found.used)
    part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    seen, rendered = found.seen[part], found.rendered[part]
    mask = found.used[part][..., None]
    level = float(np.percentile(seen[found.used[part]] @ LUMINANCE.astype(np.float32), 98))
    exposure = 0.8 / max(level, 1e-30)
    difference = 0.5 + 4 * exposure * (rendered - seen)
    panels = [
        mask * np.clip(p, 0, 1) for p in (seen * exposure, rendered * exposure, difference)
    ]
    return np.concatenate(panels, axis=1).astype(np.float32)


# ---- in common


def _reflectance(value: float | ArrayLike, name: str) -> Array:
    r = np.broadcast_to(np.asarray(value, float), 3)
    if not ((r > 0) & (r <= 1)).all():
        raise UserError(f"the {name} lies between 0 and 1")
    return r


def _ball_pixels(
    ball: BallCamera, size: tuple[int, int], used: NDArray[np.bool_] | None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Rays and reflections (N, 3) in camera axes of the pixels (H, W) inside the rim."""
    grid = pixel_grid((size[1], size[0]))
    rays, reflected = ball.camera.unproject(grid + ball.corner), ball.unproject(grid)
    off = rays - (rays @ ball.middle)[..., None] * ball.middle
    with np.errstate(invalid="ignore"):
        inside = np.isfinite(reflected).all(axis=2)
        inside &= np.linalg.norm(off, axis=2) < INNER * math.sin(ball.hidden)
    if used is not None:
        inside &= used
    if inside.sum() < 30:
        raise UserError(f"the ball has {int(inside.sum())} pixels to compare: too few")
    return rays[inside], reflected[inside], inside


def _gradient(normals: Array, y: Array) -> Array:
    """Where shading over visible normals rises to: least squares of y on 1 and n."""
    system = np.column_stack([np.ones(len(normals)), normals])
    return np.linalg.lstsq(system, y, rcond=None)[0][1:]


def _compare(
    photograph: Picture, rendered: Picture, used: NDArray[np.bool_], towards: object
) -> Comparison:
    assert callable(towards)
    seen = np.where(used[..., None], photograph, np.float32(0))
    a, b = seen[used].astype(float), rendered[used].astype(float)
    ratio, median, worst, median_shape, worst_shape = _errors(a, b)
    u, v = (np.asarray(towards(x @ LUMINANCE), float) for x in (a, b))
    off = float(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))
    return Comparison(
        np.asarray(seen, np.float32), rendered, used, ratio,
        median, worst, median_shape, worst_shape, off,
    )  # fmt: skip


def _errors(seen: Array, rendered: Array) -> tuple[Array, float, float, float, float]:
    """Ratio (3,), median and 95 % as they are, and with the ratio taken out; (N, 3) each."""
    total = rendered.sum(axis=0)
    if not (seen.sum(axis=0) > 0).all() or not (total > 0).all():
        raise UserError("a channel of the photograph, or of the map, is black there")
    ratio = seen.sum(axis=0) / total
    y = seen @ LUMINANCE
    floor = 0.02 * float(y.mean())  # what is nearly black is compared with this

    def spread(what: Array) -> tuple[float, float]:
        error = np.abs(what - y) / np.maximum(y, floor)
        return float(np.median(error)), float(np.percentile(error, 95))

    return ratio, *spread(rendered @ LUMINANCE), *spread((rendered * ratio) @ LUMINANCE)
