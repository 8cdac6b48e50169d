"""Area lights of a map (seeds.md A8): connected bright regions, with place and size.

A lamp's radiance is what it has above its surroundings; what is left of the map without lamps
holds the rest, so that both together give the map's light once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.mapping import LatLong
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: A lamp is brighter than this many times the map's mean, and has this part of its energy.
_BRIGHT, _SHARE = 8.0, 0.005
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Lamp:
    """A bright region.

    ``direction`` (3,) unit, world, of its energy; ``radiance`` (3,) above its surroundings,
    mean over ``solid_angle`` (sr). With a light-depth map: ``position`` (3,) metres, ``normal``
    (3,), unit, towards the map's place, ``size`` (width, height), metres, of a rectangle of the
    lamp's area, level across; all None where it is far away.
    """

    direction: Array
    radiance: Array
    solid_angle: float
    position: Array | None = None
    normal: Array | None = None
    size: tuple[float, float] | None = None

    def to_json(self) -> dict[str, object]:
        """As lights.json has it."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


def find_lamps(
    radiance: Picture,
    *,
    depth: NDArray[np.float32] | None = None,
    origin: ArrayLike = (0, 0, 0),
    bright: float = _BRIGHT,
    share: float = _SHARE,
) -> tuple[list[Lamp], Picture]:
    """The lamps of a lat-long map (H, W, 3), brightest first, and the map without them.

    A lamp is a connected region above `bright` times the map's mean luminance that has at least
    the part `share` of its energy. `depth` (H, W), metres from `origin`, gives places.

    Raises
    ------
    UserError
        When the map is black.

    """
    from scipy import ndimage

    height, width = radiance.shape[:2]
    mapping = LatLong((width, height))
    solid, d = mapping.solid_angles(), mapping.directions()
    y = radiance @ LUMINANCE
    total = float((y * solid).sum())
    if not total > 0:
        raise UserError("the map is black: there is no light in it")
    hot = y > bright * total / (4 * math.pi)
    labels, count = cast("tuple[NDArray[np.int32], int]", ndimage.label(hot, np.ones((3, 3))))
    parents = np.arange(count + 1)  # regions that meet at the seam are one
    for shift in (-1, 0, 1):
        for a, b in zip(labels[:, 0], np.roll(labels[:, -1], shift), strict=True):
            if a and b:
                parents[parents == parents[b]] = parents[a]
    regions = parents[labels]
    rest, place = radiance.copy(), np.asarray(origin, float)
    found: list[tuple[float, Lamp]] = []
    energies = np.bincount(regions.ravel(), (y * solid).ravel(), count + 1)
    for n in np.flatnonzero(energies >= share * total):
        if n == 0:
            continue
        region = regions == n
        around = _dilated(region, max(2, round(height / 128))) & ~hot
        behind = np.median(radiance[around], axis=0) if around.any() else np.zeros(3)
        behind = np.minimum(behind, radiance[region].min(axis=0)).astype(float)
        excess = (radiance[region] - behind) * solid[region][:, None]
        omega = float(solid[region].sum())
        lum = excess @ LUMINANCE
        m = lum @ d[region]
        lamp = Lamp(m / np.linalg.norm(m), excess.sum(axis=0) / omega, omega)
        if depth is not None:
            lamp = _placed(lamp, d[region], solid[region], lum, depth[region], place)
        found.append((float(lum.sum()), lamp))
        rest[region] = behind
    found.sort(key=lambda pair: -pair[0])
    return [lamp for _, lamp in found], rest


def _dilated(region: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Grown by so many pixels, around the seam."""
    from scipy import ndimage

    wide = np.pad(region, ((0, 0), (steps, steps)), mode="wrap")
    grown = np.asarray(ndimage.binary_dilation(wide, iterations=steps), bool)
    return grown[:, steps:-steps]


def _placed(
    lamp: Lamp,
    d: Array,
    solid: Array,
    energy: Array,
    depth: NDArray[np.float32],
    origin: Array,
) -> Lamp:
    """With its place, the plane through its pixels, and its size along level and upright."""
    z = depth.astype(float)
    near = np.isfinite(z) & (z > 0)
    if not energy[near].sum() > energy.sum() / 2:
        return lamp
    points, omega = d[near] * z[near, None], solid[near]
    weight = omega * z[near] ** 2
    middle = (weight @ points) / weight.sum()
    offset = points - middle
    spread = (offset * weight[:, None]).T @ offset / weight.sum()
    values, axes = np.linalg.eigh(spread)
    normal = -middle / np.linalg.norm(middle)  # a point, or a line: it faces the map's place
    if len(points) >= 6 and values[1] > 9 * values[0]:
        normal = axes[:, 0] if axes[:, 0] @ middle < 0 else -axes[:, 0]
    cosine = np.maximum(-(d[near] @ normal), 0.1)
    weight = weight / cosine  # areas: dA = r^2 dOmega / cos
    area = float(weight.sum()) * float(solid.sum() / omega.sum())
    middle = (weight @ points) / weight.sum()
    offset = points - middle
    right = np.cross(_UP, normal)  # as a scene file's area light lies
    if np.linalg.norm(right) < 1e-6:
        right = np.cross([0.0, 0.0, -1.0], normal)
    right /= np.linalg.norm(right)
    up = np.cross(normal, right)
    wide, high = (math.sqrt(float(weight @ (offset @ axis) ** 2)) for axis in (right, up))
    ratio = float(np.clip(wide / high, 0.02, 50)) if high > 0 else 1.0
    return Lamp(
        lamp.direction,
        lamp.radiance,
        lamp.solid_angle,
        origin + middle,
        normal,
        (math.sqrt(area * ratio), math.sqrt(area / ratio)),
    )


def as_scene_lights(lamps: list[Lamp]) -> str:
    """The lamps as ``[[light]]`` of a scene file: area lights, and suns for those far away."""

    def numbers(values: ArrayLike) -> str:
        return "[" + ", ".join(f"{v:.6g}" for v in np.ravel(np.asarray(values, float))) + "]"

    lines = ["# Beside the map without its lamps: the map itself has their light already.", ""]
    for k, lamp in enumerate(lamps, 1):
        lines += ["[[light]]", f'name = "lamp{k}"']
        if lamp.position is None or lamp.normal is None or lamp.size is None:
            lines += [
                'kind = "sun"',
                f"direction = {numbers(-lamp.direction)}",
                f"irradiance = {numbers(lamp.radiance * lamp.solid_angle)}",
            ]
        else:
            in_front = lamp.position + 0.01 * lamp.normal  # clear of the stand-in's surface
            lines += [
                'kind = "area"',
                f"position = {numbers(in_front)}",
                f"direction = {numbers(lamp.normal)}",
                f"size = {numbers(np.array(lamp.size))}",
                f"radiance = {numbers(lamp.radiance)}",
            ]
        lines.append("")
    return "\n".join(lines)
