"""N lights from a map (seeds.md P16): variance cut, Viriyothai and Debevec 2009.

The map is cut again and again, always the region with the largest spread of energy about its
centroid, where that spread shrinks most; then the borders relax (Lloyd 1982), for less spread
yet. Every region becomes a light: sum L dOmega is kept. What is wrong with so few directions is
kept as order-2 harmonics of the difference, the ambient.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.harmonics import sh_basis, sh_irradiance
from chromeball.envmap.lights_kernel import moments, summary
from chromeball.envmap.lights_kernel import variance_cut as cut
from chromeball.envmap.mapping import LatLong
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

#: The six normals for which irradiance is compared: +X -X +Y -Y +Z -Z.
NORMALS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
#: Cells of the lattice that is cut, down and across.
_ROWS, _COLUMNS = 64, 128
#: Steps of relaxation, and the most lights that are worth it.
_STEPS, _RELAXED = 4, 1024


@dataclass(frozen=True)
class Lights:
    """Light samples of a map.

    ``directions`` (N, 3) unit, world, at the energy's centroid; ``radiance`` (N, 3), the mean
    over the region; ``solid_angles`` (N,) sr, the region's; ``angular_radii`` (N,), radians, of
    the disc over which the region's light is as spread as it is (a small lamp in a large dark
    region is small); ``positions`` (N, 3) metres, NaN where unknown, and ``distances`` (N,)
    from the map's place. ``ambient`` (9, 3), real spherical harmonics of what the lights leave
    out, or None; it may be negative in places. ``total`` (3,) is the map's sum L dOmega;
    ``irradiance`` (6, 3) the map's on NORMALS.
    """

    directions: Array
    radiance: Array
    solid_angles: Array
    angular_radii: Array
    positions: Array
    distances: Array
    ambient: Array | None
    total: Array
    irradiance: Array

    def own_irradiance(self, normals: ArrayLike = NORMALS) -> Array:
        """Irradiance by the lights and the ambient on `normals`, (K, 3) -> (K, 3)."""
        n = np.asarray(normals, float)
        energy = self.radiance * self.solid_angles[:, None]
        result = np.maximum(n @ self.directions.T, 0) @ energy
        if self.ambient is not None:
            result = result + sh_irradiance(self.ambient, n)
        return result

    def to_json(self) -> dict[str, object]:
        """The content of lights.json.

        A light at a place has a ``radius`` (m), too, of the disc that faces the map's place,
        and its ``intensity`` (W/sr): L dOmega times the distance squared.
        """
        lights: list[dict[str, object]] = []
        for k, direction in enumerate(self.directions):
            light: dict[str, object] = {
                "direction": direction,
                "radiance": self.radiance[k],
                "solid_angle": self.solid_angles[k],
                "angular_radius": self.angular_radii[k],
                "position": None,
            }
            if np.isfinite(self.positions[k]).all():
                away = float(self.distances[k])
                light["position"] = self.positions[k]
                light["radius"] = away * math.tan(float(self.angular_radii[k]))
                energy = self.radiance[k] * self.solid_angles[k]
                light["intensity"] = energy * away**2
            lights.append(light)
        return {
            "lights": lights,
            "ambient": self.ambient,
            "total": self.total,
            "irradiance": {
                "normals": NORMALS,
                "map": self.irradiance,
                "lights": self.own_irradiance(),
            },
        }


def read_lights(path: str | os.PathLike[str]) -> Lights:
    """Read lights.json.

    Raises
    ------
    UserError
        When the file is missing or no list of lights.

    """
    value = read_json(path)
    try:
        entries: list[dict[str, Any]] = value["lights"]
        unknown = [math.nan] * 3
        place = [unknown if v["position"] is None else v["position"] for v in entries]
        positions = np.array(place, float).reshape(-1, 3)
        known = np.isfinite(positions).all(axis=1)
        radiance = np.array([v["radiance"] for v in entries], float)
        solid = np.array([v["solid_angle"] for v in entries], float)
        intensity = np.array([v.get("intensity", unknown) for v in entries], float)
        energy = (radiance * solid[:, None]) @ LUMINANCE
        lit = known & (energy > 0)
        distances = np.full(len(entries), math.nan)
        distances[lit] = np.sqrt((intensity @ LUMINANCE)[lit] / energy[lit])
        return Lights(
            directions=np.array([v["direction"] for v in entries], float),
            radiance=radiance,
            solid_angles=solid,
            angular_radii=np.array([v["angular_radius"] for v in entries], float),
            positions=positions,
            distances=distances,
            ambient=None if value["ambient"] is None else np.array(value["ambient"], float),
            total=np.array(value["total"], float),
            irradiance=np.array(value["irradiance"]["map"], float),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"no list of lights by `envmap lights`: {error}", file=path) from error


def variance_cut(
    radiance: NDArray[np.float32],
    count: int,
    *,
    depth: NDArray[np.float32] | None = None,
    origin: ArrayLike = (0, 0, 0),
    ambient: bool = True,
) -> Lights:
    """At most `count` lights from a lat-long map (H, W, 3).

    `depth` (H, W) in metres from `origin` gives positions; infinite or non-positive depth is
    a light far away. Without `ambient` the lights alone stand for the map, and their ambient
    is None.

    Raises
    ------
    UserError
        When the map is black, or a pixel is negative or not finite.

    """
    sky = survey(radiance, *_lattice(count))
    labels, sums = cut(sky.cells, count, _STEPS if count <= _RELAXED else 0)
    result = sky.lights(
        sums.reshape(-1, 4, 3),
        _solid_angles(labels, sky.size, len(sums)),
        lambda: _middles(labels, len(sums)),
        ambient=ambient,
    )
    if depth is not None:
        result = _placed(result, radiance, depth, labels, origin)
    return result


@dataclass(frozen=True)
class Survey:
    """A map on a coarse lattice.

    ``cells`` (rows, columns, 12): integrals of L, L x, L y, L z over a cell, each R, G, B;
    ``harmonics`` (9, 3) and ``irradiance`` (6, 3) of the whole; ``size``: rows and columns of
    the pixels that the cells are made of.
    """

    size: tuple[int, int]
    cells: Array
    harmonics: Array
    irradiance: Array

    def lights(
        self, sums: Array, solid: Array, middles: Callable[[], Array], *, ambient: bool
    ) -> Lights:
        """Lights of regions with moments `sums` (N, 4, 3) and solid angles (N,).

        `middles` gives directions (N, 3) of any length for regions that are dark.
        """
        energy = sums @ LUMINANCE
        lit = energy[:, 0] > 0
        m = energy[:, 1:]
        if not lit.all():
            m = np.where(lit[:, None], m, middles())
        norm = np.linalg.norm(m, axis=1)
        directions = m / np.where(norm > 0, norm, 1)[:, None]
        directions[norm == 0] = [0, 0, 1]
        share = np.where(lit, norm / np.where(lit, energy[:, 0], 1), 1)
        left = self.harmonics - sh_basis(directions).T @ sums[:, 0] if ambient else None
        return Lights(
            directions=directions,
            radiance=sums[:, 0] / solid[:, None],
            solid_angles=solid,
            angular_radii=disc_radius(share),
            positions=np.full(directions.shape, np.nan),
            distances=np.full(len(directions), np.nan),
            ambient=left,
            total=self.harmonics[0] * math.sqrt(4 * math.pi),
            irradiance=self.irradiance,
        )


def survey(radiance: NDArray[np.float32], rows: int, columns: int) -> Survey:
    """A map (H, W, 3) on a lattice of at most `rows` x `columns`.

    Raises
    ------
    UserError
        When the map is black, or a pixel is negative or not finite.

    """
    source = fine_enough(radiance, min(columns // 2, 256))
    cells, bad = moments(source, min(rows, source.shape[0]), min(columns, source.shape[1]))
    if bad:
        raise UserError(f"{bad} pixels are NaN, infinite or negative")
    harmonics, irradiance = summary(cells)
    if not harmonics[0].sum() > 0:
        raise UserError("the map is black: there is no light in it")
    return Survey(source.shape[:2], cells, harmonics, irradiance)


def disc_radius(share: ArrayLike) -> Array:
    """Angular radius of an even disc whose mean direction has the length `share`.

    A cap of radius a has (1 + cos a) / 2; never more than a hemisphere.
    """
    return np.arccos(np.clip(2 * np.asarray(share, float) - 1, 0, 1))


def fine_enough(radiance: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """The same map with its pixels split where it is smaller than `width`."""
    radiance = np.ascontiguousarray(radiance, np.float32)
    times = math.ceil(width / radiance.shape[1])
    down = math.ceil(width / 2 / radiance.shape[0])
    if times > 1:
        radiance = np.repeat(radiance, times, axis=1)
    if down > 1:
        radiance = np.repeat(radiance, down, axis=0)
    return radiance


def _lattice(count: int) -> tuple[int, int]:
    """Rows and columns, more for very many lights: 32 cells a light."""
    more = max(1.0, math.sqrt(32 * count / (_ROWS * _COLUMNS)))
    return int(_ROWS * more), int(_COLUMNS * more)


def _solid_angles(labels: NDArray[np.int32], shape: tuple[int, int], count: int) -> Array:
    """Of the lights' regions, (N,)."""
    # the cells' borders are those of pixels
    down, across = (
        np.arange(cells + 1) * pixels // cells / pixels
        for cells, pixels in zip(labels.shape, shape, strict=True)
    )
    band = -np.diff(np.sin(math.pi * (0.5 - down)))
    solid = band[:, None] * np.diff(2 * math.pi * across)
    return np.bincount(labels.ravel(), solid.ravel(), count)


def _middles(labels: NDArray[np.int32], count: int) -> Array:
    """Integrals of w over the lights' regions, (N, 3)."""
    d = LatLong((labels.shape[1], labels.shape[0])).directions()
    d *= np.sqrt(1 - d[..., 1:2] ** 2)
    flat = labels.ravel()
    return np.stack([np.bincount(flat, d[..., k].ravel(), count) for k in range(3)], axis=1)


def _placed(
    lights: Lights,
    radiance: NDArray[np.float32],
    depth: NDArray[np.float32],
    labels: NDArray[np.int32],
    origin: ArrayLike,
) -> Lights:
    """With the places of those lights most of whose energy has a finite depth: its centroid."""
    count, (height, width) = len(lights.directions), depth.shape
    lon = (np.arange(width) + 0.5) * 2 * math.pi / width - math.pi
    rows, columns = labels.shape
    column = np.arange(width) * columns // width
    near_sums, all_sums = np.zeros((count, 4)), np.zeros(count)
    for y in range(height):
        lat = math.pi * (0.5 - (y + 0.5) / height)
        z = depth[y].astype(float)
        near = np.isfinite(z) & (z > 0)
        # a trace for the dark: their middle
        weight = (radiance[y] @ LUMINANCE + 1e-30) * math.cos(lat)
        label = labels[y * rows // height][column]
        all_sums += np.bincount(label, weight, count)
        weight, z = np.where(near, weight, 0), np.where(near, z, 0)
        level = math.cos(lat)
        w = (-np.sin(lon) * level, np.full(width, math.sin(lat)), np.cos(lon) * level)
        for k, value in enumerate((np.ones(width), *(v * z for v in w))):
            near_sums[:, k] += np.bincount(label, weight * value, count)
    known = near_sums[:, 0] > all_sums / 2
    p = np.full((count, 3), np.nan)
    p[known] = near_sums[known, 1:] / near_sums[known, :1]
    return replace(
        lights,
        positions=p + np.asarray(origin, float),
        distances=np.linalg.norm(p, axis=1),
    )
