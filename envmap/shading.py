"""How much of the light on each surface comes from each lamp, by all reflections in the set.

The map is its own radiosity solution: lamps, the sky, and cells of everything else, which
reflect. A reflecting cell r gets the share F_rk = E_k(r) / E(r) of its light from source k.
When lamps change by factors s, a cell changes by s_r = sum_l F_rl s_l + sum_r' F_rr' s_r', so
that s_r = (1 - F_rr)^-1 F_rl s: no albedo is asked for, and all bounces are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.lamps import Lamp, find_lamps
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.several import Cast, ProbeMap
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: Cells of what reflects, down and across.
_ROWS, _COLUMNS = 16, 32
#: A surface this much nearer than a patch, relatively, hides it.
_NEARER = 2e-3


@dataclass(frozen=True)
class Sources:
    """Lamps and the rest of a map as sources of light.

    ``names`` of the K that change on their own: lamps, and `sky` where the map shows what is
    infinitely far; ``lamps``; ``owner`` (H, W): the lamp of each pixel, -1 for none. Patches
    (M): ``places`` (M, 3), infinite for what is far away, ``directions`` (M, 3) from the map's
    place, ``normals`` (M, 3), ``areas`` (M,) m^2, or sr where far, ``radiance`` (M, 3);
    ``column`` (M,): which of the K, -1 for what reflects; ``bounced`` (R, K, 3): how the
    reflecting cells follow the K.
    """

    names: tuple[str, ...]
    lamps: tuple[Lamp, ...]
    owner: NDArray[np.int16]
    places: Array
    directions: Array
    normals: Array
    areas: Array
    radiance: Array
    column: NDArray[np.int64]
    bounced: Array

    def shares(self, points: Array, normals: Array, cast: Cast) -> Array:
        """Of each of the K sources in the light on surfaces (N, 3): (N, K, 3), sums are 1.

        NaN where no light arrives.
        """
        e = _irradiance(self, points, normals, cast)
        total = e.sum(axis=1)
        direct = np.stack(
            [e[:, self.column == k].sum(axis=1) for k in range(len(self.names))], axis=1
        )
        indirect = np.einsum("nrc,rkc->nkc", e[:, self.column < 0], self.bounced)
        with np.errstate(divide="ignore", invalid="ignore"):
            return (direct + indirect) / total[:, None]


def find_sources(env: ProbeMap, cast: Cast) -> Sources:
    """The sources of a map over geometry.

    Raises
    ------
    UserError
        When there is no lamp in it, nor sky.

    """
    height, width = env.radiance.shape[:2]
    fine = LatLong((width, height))
    found, rest = find_lamps(env.radiance, depth=_depth(env, cast), origin=env.origin)
    owner = owners(env.radiance, rest, found)
    places, directions, normals, areas, radiance, column = [], [], [], [], [], []

    def add(d: Array, omega: Array, value: Array, k: NDArray[np.int64] | int) -> None:
        t, n = cast(np.broadcast_to(env.origin, d.shape), d)
        met = np.isfinite(t)
        cosine = np.maximum(-(n * d).sum(axis=1), 0.02)
        z = np.where(met, t, 1)
        places.append(np.where(met[:, None], env.origin + z[:, None] * d, np.inf))
        directions.append(d)
        normals.append(np.where(met[:, None], n, -d))
        areas.append(np.where(met, omega * z**2 / cosine, omega))
        radiance.append(value)
        column.append(np.where(met, k, len(found)) if isinstance(k, int) and k < 0 else
                      np.full(len(d), k))  # fmt: skip

    solid, d = fine.solid_angles(), fine.directions()
    for k in range(len(found)):
        own = owner == k
        # a lamp as at most 16 patches
        order = np.argsort(d[own] @ np.array([0.36, 0.48, 0.8]))
        for part in np.array_split(order, min(16, len(order))):
            w = solid[own][part]
            m = w @ d[own][part]
            mean = (w @ env.radiance[own][part].astype(float)) / w.sum()
            add((m / np.linalg.norm(m))[None], w.sum()[None], mean[None], k)
    cells = LatLong((_COLUMNS, _ROWS))
    y, x = np.arange(height) * _ROWS // height, np.arange(width) * _COLUMNS // width
    cell = (y[:, None] * _COLUMNS + x[None, :]).ravel()
    weight = (solid * (owner < 0)).ravel()
    omega = np.bincount(cell, weight, _ROWS * _COLUMNS)
    mean = np.stack(
        [np.bincount(cell, weight * env.radiance[..., c].ravel(), _ROWS * _COLUMNS)
         for c in range(3)], axis=1,
    ) / np.maximum(omega, 1e-12)[:, None]  # fmt: skip
    used = omega > 0
    add(cells.directions().reshape(-1, 3)[used], omega[used], mean[used], -1)
    columns = np.concatenate(column).astype(np.int64)
    names = [f"lamp {k + 1}" for k in range(len(found))]
    if (columns == len(found)).any():
        names.append("sky")
    if not names:
        raise UserError("no lamp and no sky in the map: there is nothing to change one by one")
    result = Sources(
        tuple(names), tuple(found), owner, np.concatenate(places), np.concatenate(directions),
        np.concatenate(normals), np.concatenate(areas), np.concatenate(radiance), columns,
        np.zeros((0, len(names), 3)),
    )  # fmt: skip
    return _with_bounces(result, cast)


def owners(radiance: Picture, rest: Picture, lamps: Sequence[Lamp]) -> NDArray[np.int16]:
    """Which lamp each pixel of a map (H, W, 3) belongs to, -1 for none."""
    height, width = radiance.shape[:2]
    owner = np.full((height, width), -1, np.int16)
    if not lamps:
        return owner
    own = (radiance > rest).any(axis=2)
    d = LatLong((width, height)).directions()[own]
    owner[own] = (d @ np.array([lamp.direction for lamp in lamps]).T).argmax(axis=1)
    return owner


def _depth(env: ProbeMap, cast: Cast) -> NDArray[np.float32]:
    height, width = env.radiance.shape[:2]
    d = LatLong((width, height)).directions().reshape(-1, 3)
    t, _ = cast(np.broadcast_to(env.origin, d.shape), d)
    return t.reshape(height, width).astype(np.float32)


def _with_bounces(sources: Sources, cast: Cast) -> Sources:
    from dataclasses import replace

    reflecting = sources.column < 0
    e = _irradiance(sources, sources.places[reflecting], sources.normals[reflecting], cast)
    total = np.maximum(e.sum(axis=1), 1e-30)
    share = e / total[:, None]
    count, k = int(reflecting.sum()), len(sources.names)
    bounced = np.zeros((count, k, 3))
    for c in range(3):
        inner = share[:, reflecting, c]
        outer = np.stack([share[:, sources.column == j, c].sum(axis=1) for j in range(k)], 1)
        # a cell that no source reaches, by any way, has no factor: least squares leaves it 0
        solved, *_ = np.linalg.lstsq(np.eye(count) - inner, outer, rcond=1e-9)
        bounced[..., c] = np.clip(solved, 0, 1)
    sums = bounced.sum(axis=1, keepdims=True)
    bounced = np.where(sums > 1e-6, bounced / np.maximum(sums, 1e-6), 1 / k)
    return replace(sources, bounced=bounced)


def _irradiance(sources: Sources, points: Array, normals: Array, cast: Cast) -> Array:
    """E of each patch on each surface, (N, M, 3)."""
    far = np.isinf(sources.places[:, 0])
    result = np.zeros((len(points), len(sources.areas), 3))
    lift = 1e-4 * (1 + np.abs(points).max(axis=1, keepdims=True, initial=0))
    starts = points + lift * normals
    for m in range(len(sources.areas)):
        if far[m]:
            d = np.broadcast_to(sources.directions[m], points.shape)
            t, solid = np.full(len(points), np.inf), np.full(len(points), sources.areas[m])
        else:
            to = sources.places[m] - starts
            t = np.maximum(np.linalg.norm(to, axis=1), 1e-9)
            d = to / t[:, None]
            facing = np.maximum(-(d @ sources.normals[m]), 0)
            # of a disc, finite even where it lies near
            solid = sources.areas[m] * facing / (t**2 + sources.areas[m] / np.pi)
        cosine = np.maximum((d * normals).sum(axis=1), 0)
        lit = (cosine > 0) & (solid > 0)
        if not lit.any():
            continue
        first, _ = cast(starts[lit], np.ascontiguousarray(d[lit]))
        visible = np.isinf(first) if far[m] else first > t[lit] * (1 - _NEARER)
        share = np.zeros(len(points))
        share[lit] = (cosine * solid)[lit] * visible
        result[:, m] = share[:, None] * sources.radiance[m]
    return result
