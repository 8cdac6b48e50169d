"""N lights from a map (seeds.md P16): variance cut, Viriyothai and Debevec 2009.

The map is cut again and again, always the region with the largest spread of energy about its
centroid, where that spread shrinks most. Every region becomes a light: sum L dOmega is kept.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.mapping import LatLong
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

#: The six normals for which irradiance is compared: +X -X +Y -Y +Z -Z.
NORMALS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)


@dataclass(frozen=True)
class Lights:
    """Light samples of a map.

    ``directions`` (N, 3) unit, world, at the energy's centroid; ``radiance`` (N, 3), the mean
    over the region; ``solid_angles`` (N,) sr; ``positions`` (N, 3) metres, NaN where unknown;
    ``ambient`` (9, 3), real spherical harmonics of what the lights leave out, or None.
    ``total`` (3,) is the map's sum L dOmega; ``irradiance`` (6, 3) on NORMALS.
    """

    directions: Array
    radiance: Array
    solid_angles: Array
    positions: Array
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
        """The content of lights.json."""
        known = np.isfinite(self.positions).all(axis=1)
        return {
            "lights": [
                {"direction": d, "radiance": r, "solid_angle": s, "position": p if ok else None}
                for d, r, s, p, ok in zip(
                    self.directions,
                    self.radiance,
                    self.solid_angles,
                    self.positions,
                    known,
                    strict=True,
                )
            ],
            "ambient": self.ambient,
            "total": self.total,
            "irradiance": {
                "normals": NORMALS,
                "map": self.irradiance,
                "lights": self.own_irradiance(),
            },
        }


def variance_cut(
    radiance: NDArray[np.float32],
    count: int,
    *,
    depth: NDArray[np.float32] | None = None,
    origin: ArrayLike = (0, 0, 0),
    ambient: bool = False,
) -> Lights:
    """At most `count` lights from a lat-long map (H, W, 3).

    `depth` (H, W) in metres from `origin` gives positions; infinite or non-positive depth is
    a light far away. With `ambient`, the order-2 harmonics of the residual are kept.

    Raises
    ------
    UserError
        When the map is black.

    """
    height, width = radiance.shape[:2]
    mapping = LatLong((width, height))
    solid = mapping.solid_angles()
    d = mapping.directions()
    energy_rgb = radiance.astype(float) * solid[..., None]
    energy = energy_rgb @ LUMINANCE
    if not energy.sum() > 0:
        raise UserError("the map is black: there is no light in it")
    # summed-area tables of E and E w
    table = np.zeros((height + 1, width + 1, 4))
    moments = np.concatenate([energy[..., None], energy[..., None] * d], axis=-1)
    table[1:, 1:] = moments.cumsum(axis=0).cumsum(axis=1)

    # the region with the largest spread first; the counter settles ties
    heap: list[tuple[float, int, tuple[int, int, int, int]]] = []
    whole = (0, height, 0, width)
    heapq.heappush(heap, (-float(_spread(_sum(table, whole))), 0, whole))
    leaves: list[tuple[int, int, int, int]] = []
    made = 1
    while heap and len(heap) + len(leaves) < count:
        spread, _, region = heapq.heappop(heap)
        # what remains of rounding in a region of one point of light
        if -spread <= 1e-12 * float(table[-1, -1, 0]):
            leaves.append(region)
            continue
        parts = _cut(table, region)
        if not parts:
            leaves.append(region)
        for part in parts:
            heapq.heappush(heap, (-float(_spread(_sum(table, part))), made, part))
            made += 1
    leaves += [region for *_, region in heap]
    leaves.sort()

    n = len(leaves)
    directions, means, solids = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    positions = np.full((n, 3), np.nan)
    for k, (y0, y1, x0, x1) in enumerate(leaves):
        here = np.s_[y0:y1, x0:x1]
        e, w, s = energy[here], d[here], solid[here]
        solids[k] = s.sum()
        means[k] = energy_rgb[here].sum(axis=(0, 1)) / solids[k]
        weight = e if e.sum() > 0 else s
        m = np.einsum("ij,ijk->k", weight, w)
        norm = np.linalg.norm(m)
        directions[k] = m / norm if norm > 0 else w[0, 0]
        if depth is not None:
            z = depth[here].astype(float)
            near = np.isfinite(z) & (z > 0)
            if weight[near].sum() > weight.sum() / 2:
                p = (w * z[..., None])[near] * weight[near][:, None]
                positions[k] = p.sum(axis=0) / weight[near].sum() + np.asarray(origin, float)
    total = energy_rgb.sum(axis=(0, 1))
    residual = None
    if ambient:
        map_sh = np.zeros((9, 3))
        for row, here in zip(d, energy_rgb, strict=True):  # a row at a time: memory
            map_sh += sh_basis(row).T @ here
        lights_sh = sh_basis(directions).T @ (means * solids[:, None])
        residual = map_sh - lights_sh
    irradiance = np.stack(
        [np.einsum("hw,hwc->c", np.maximum(d @ normal, 0), energy_rgb) for normal in NORMALS]
    )
    return Lights(
        directions=directions,
        radiance=means,
        solid_angles=solids,
        positions=positions,
        ambient=residual,
        total=total,
        irradiance=irradiance,
    )


def _sum(table: Array, region: tuple[int, int, int, int]) -> Array:
    y0, y1, x0, x1 = region
    return table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]


def _spread(moments: Array) -> Array:
    """E - |m|^2 / E: the energy's variance about its centroid on the sphere."""
    e = np.maximum(moments[..., 0], 0)
    m2 = np.sum(moments[..., 1:] ** 2, axis=-1)
    return np.asarray(np.maximum(e - m2 / np.where(e > 0, e, 1), 0))


def _cut(
    table: Array, region: tuple[int, int, int, int]
) -> tuple[tuple[int, int, int, int], tuple[int, int, int, int]] | tuple[()]:
    """The cut into two that leaves the least spread."""
    y0, y1, x0, x1 = region
    whole = _sum(table, region)
    best, parts = math.inf, None
    if y1 - y0 > 1:
        rows = np.arange(y0 + 1, y1)
        upper = table[rows, x1] - table[y0, x1] - table[rows, x0] + table[y0, x0]
        cost = _spread(upper) + _spread(whole - upper)
        k = int(np.argmin(cost))
        best, y = float(cost[k]), int(rows[k])
        parts = (y0, y, x0, x1), (y, y1, x0, x1)
    if x1 - x0 > 1:
        columns = np.arange(x0 + 1, x1)
        left = table[y1, columns] - table[y0, columns] - table[y1, x0] + table[y0, x0]
        cost = _spread(left) + _spread(whole - left)
        k = int(np.argmin(cost))
        if float(cost[k]) < best:
            x = int(columns[k])
            parts = (y0, y1, x0, x), (y0, y1, x, x1)
    return parts or ()


# ---- spherical harmonics of order 2, real and orthonormal

#: Convolution with the clamped cosine (Ramamoorthi and Hanrahan 2001), for each coefficient.
COSINE = np.array([math.pi] + 3 * [2 * math.pi / 3] + 5 * [math.pi / 4])


def sh_basis(d: ArrayLike) -> Array:
    """Y_00, Y_1-1 .. Y_22 at unit directions, ``(..., 3) -> (..., 9)``; axes x, y, z."""
    v = np.asarray(d, float)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    one = np.ones_like(x)
    a, b = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    return np.stack(
        [
            one / math.sqrt(4 * math.pi),
            a * y,
            a * z,
            a * x,
            b * x * y,
            b * y * z,
            math.sqrt(5 / (16 * math.pi)) * (3 * z * z - 1),
            b * x * z,
            b / 2 * (x * x - y * y),
        ],
        axis=-1,
    )


def sh_irradiance(coefficients: ArrayLike, normals: ArrayLike) -> Array:
    """Irradiance on `normals` (..., 3) of radiance given by (9, 3) coefficients."""
    return (sh_basis(normals) * COSINE) @ np.asarray(coefficients, float)
