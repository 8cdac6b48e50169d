"""Light samples and prefiltered maps: error against the number of lights, beside other methods.

Irradiance error: RMS over 256 normals of the difference, over the RMS of the truth, mean over
the real maps. The others are the methods of the literature, plainly written in numpy.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.envmap.grid import grid_lights
from chromeball.envmap.irradiance import irradiance, spread_directions
from chromeball.envmap.lights import Lights, variance_cut
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.prefilter import cube_directions, prefilter_cube
from chromeball.scene.color import LUMINANCE
from chromeball.scene.image import read_image

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
type Samples = tuple[Array, Array]  # directions (M, 3), energies (M, 3)

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/envmap"
MAPS = (
    *(f"latlong1k/{name}_1k.hdr" for name in ("pedestrian_overpass", "quarry_01")),
    *("latlong1k/venice_sunset_1k.hdr", "blender/city.exr", "blender/interior.exr"),
    "blender/sunset.exr",
)


def rows(quick: bool) -> list[Row]:
    """Error at 16 and 64 lights, and of prefiltered maps."""
    maps = [_read(DATA / name) for name in MAPS if (DATA / name).is_file()]
    if not maps:
        maps = [_made_up()]
    maps = maps[: 2 if quick else None]
    note = f"{len(maps)} maps of {maps[0].shape[1]} x {maps[0].shape[0]}"
    normals = spread_directions(256)
    truths = [irradiance(m, normals) for m in maps]
    found: list[Row] = []
    for count in (16, 64):
        for name, method in _methods().items():
            errors: list[float] = []
            best = math.inf
            for m, truth in zip(maps, truths, strict=True):
                own = method(m, count)
                for _ in range(3):
                    start = time.process_time()
                    method(m, count)
                    best = min(best, time.process_time() - start)
                difference = own(normals) - truth
                errors.append(math.sqrt(float(np.mean(difference**2) / np.mean(truth**2))))
            error = 100 * float(np.mean(errors))
            what = f"{count} lights: irradiance"
            found.append(Row("envmap", what, name, best, error, "% RMS", note))
    return found + _prefiltered(maps[0], quick)


def _methods() -> dict[str, Callable[[Picture, int], Callable[[Array], Array]]]:
    def ours(make: Callable[[Picture, int], Lights]) -> Callable[..., Callable[[Array], Array]]:
        return lambda m, count: make(m, count).own_irradiance

    def plain(
        make: Callable[[Picture, int], Samples],
    ) -> Callable[..., Callable[[Array], Array]]:
        def run(m: Picture, count: int) -> Callable[[Array], Array]:
            d, energy = make(m, count)
            return lambda n: np.maximum(n @ d.T, 0) @ energy

        return run

    return {
        "chromeball": ours(variance_cut),
        "chromeball without ambient": ours(lambda m, c: variance_cut(m, c, ambient=False)),
        "grid, merged (Pomi 2005), with our ambient": ours(grid_lights),
        "grid, merged (Pomi 2005)": ours(lambda m, c: grid_lights(m, c, ambient=False)),
        "grid, random (Pomi 2005)": ours(
            lambda m, c: grid_lights(m, c, pick="random", ambient=False)
        ),
        "median cut (Debevec 2005)": plain(median_cut),
        "importance, R2 sequence": plain(importance),
    }


def median_cut(radiance: Picture, count: int) -> Samples:
    """Regions of equal energy: halved across their longer side, the light at the centroid."""
    mapping = LatLong((radiance.shape[1], radiance.shape[0]))
    d, energy = mapping.directions(), radiance * mapping.solid_angles()[..., None]
    y = energy @ LUMINANCE
    regions = [(0, y.shape[0], 0, y.shape[1])]
    while 2 * len(regions) <= count:
        halves: list[tuple[int, int, int, int]] = []
        for y0, y1, x0, x1 in regions:
            part = y[y0:y1, x0:x1]
            tall = y1 - y0 > (x1 - x0) * math.sin(math.pi * (y0 + y1) / 2 / y.shape[0])
            along = part.sum(axis=1 if tall else 0).cumsum()
            at = int(np.clip(np.searchsorted(along, along[-1] / 2) + 1, 1, len(along) - 1))
            if tall:
                halves += [(y0, y0 + at, x0, x1), (y0 + at, y1, x0, x1)]
            else:
                halves += [(y0, y1, x0, x0 + at), (y0, y1, x0 + at, x1)]
        regions = halves
    directions: list[Array] = []
    energies: list[Array] = []
    for y0, y1, x0, x1 in regions:
        here = np.s_[y0:y1, x0:x1]
        m = np.einsum("ij,ijk->k", y[here], d[here])
        directions.append(m / max(float(np.linalg.norm(m)), 1e-30))
        energies.append(energy[here].sum(axis=(0, 1)))
    return np.array(directions), np.array(energies)


def importance(radiance: Picture, count: int) -> Samples:
    """Pixels drawn in proportion to their luminance by the points of an R2 sequence."""
    mapping = LatLong((radiance.shape[1], radiance.shape[0]))
    energy = (radiance * mapping.solid_angles()[..., None]).astype(float)
    y = energy @ LUMINANCE
    rows = y.sum(axis=1).cumsum()
    k = np.arange(count) + 0.5
    u, v = np.mod(k * 0.7548776662466927, 1.0), np.mod(k * 0.5698402909980532, 1.0)
    row = np.minimum(np.searchsorted(rows, u * rows[-1]), len(rows) - 1)
    columns = y[row].cumsum(axis=1)
    column = np.array(
        [np.searchsorted(c, t * c[-1]) for c, t in zip(columns, v, strict=True)], int
    ).clip(0, y.shape[1] - 1)
    share = y.sum() / (count * y[row, column])
    return mapping.directions()[row, column], energy[row, column] * share[:, None]


def _prefiltered(radiance: Picture, quick: bool) -> list[Row]:
    """A level of 6 beside plain importance sampling of the same lobe, against brute force."""
    size = 32 if quick else 64
    level, roughness = 2, 0.4
    start = time.process_time()
    own = prefilter_cube(radiance, size, 6).levels[level]
    seconds = time.process_time() - start
    side = size >> level
    d = cube_directions(side)[:, :, :, 0].reshape(-1, 3)
    mapping = LatLong((radiance.shape[1], radiance.shape[0]))
    where, solid = mapping.directions().reshape(-1, 3), mapping.solid_angles().ravel()
    flat = radiance.reshape(-1, 3).astype(float)
    truth = np.empty((len(d), 3))
    for i, axis in enumerate(d):
        k = _lobe(where @ axis, roughness) * solid
        truth[i] = k @ flat / k.sum()

    def error(got: Array) -> float:
        return 100 * math.sqrt(float(np.mean((got - truth) ** 2))) / float(truth.mean())

    what = "prefiltered, roughness 0.4: RMSE"
    note = f"all 6 levels from {size} a side; ours"
    found = [
        Row(
            "envmap",
            what,
            "chromeball",
            seconds,
            error(own.reshape(-1, 3).astype(float)),
            "% of mean",
            note,
        )
    ]
    for samples in (256, 1024):
        start = time.process_time()
        got = np.stack([_karis(radiance, mapping, axis, roughness, samples) for axis in d])
        seconds = time.process_time() - start
        name = f"importance sampling, {samples} a texel"
        found.append(Row("envmap", what, name, seconds, error(got), "% of mean", "this level"))
    return found


def _lobe(cosine: Array, roughness: float) -> Array:
    a2 = roughness**4
    t = (1 + cosine) / 2 * (a2 - 1) + 1
    masked = cosine + np.sqrt(np.maximum(cosine, 0) ** 2 * (1 - a2) + a2)
    return np.where(cosine > 0, cosine / (t * t * np.where(cosine > 0, masked, 1)), 0)


def _karis(
    radiance: Picture, mapping: LatLong, n: Array, roughness: float, samples: int
) -> Array:
    k = np.arange(samples) + 0.5
    u, v = np.mod(k * 0.7548776662466927, 1.0), np.mod(k * 0.5698402909980532, 1.0)
    a2 = roughness**4
    cos = np.sqrt((1 - u) / (1 + (a2 - 1) * u))
    sin, phi = np.sqrt(1 - cos**2), 2 * math.pi * v
    side = np.cross(n, [0.0, 1, 0] if abs(n[1]) < 0.9 else [1.0, 0, 0])
    side /= np.linalg.norm(side)
    h = (sin * np.cos(phi))[:, None] * side + (sin * np.sin(phi))[:, None] * np.cross(n, side)
    h += cos[:, None] * n
    light = 2 * (h @ n)[:, None] * h - n
    nl = np.maximum(light @ n, 0)
    weight = nl / (
        nl + np.sqrt(nl**2 * (1 - a2) + a2)
    )  # not Karis's n.l: the lobe of the truth
    pixels = np.rint(mapping.pixels_of(light)).astype(int)
    x, y = pixels[:, 0] % mapping.size[0], pixels[:, 1].clip(0, mapping.size[1] - 1)
    return weight @ radiance[y, x] / weight.sum()


def _read(path: Path) -> Picture:
    return np.maximum(read_image(path).pixels[..., :3].astype(np.float32), 0)


def _made_up() -> Picture:
    d = LatLong((1024, 512)).directions()
    sky = np.stack([1 + d[..., 1], 1.2 + d[..., 0] * 0.5, 0.8 - d[..., 2] * 0.4], axis=-1)
    sky[d @ [0.48, 0.6, 0.64] > math.cos(0.01)] = 1e4
    return sky.astype(np.float32)
