"""Conversion between maps: what is lost, and what it costs, beside the peers.

Three photographed maps of 1024 x 512 make the worlds, 4096 x 2048. *resolved*: enlarged by a
cubic, cut off above 8 times the mean, for suns have measures of their own; what a map of 1024
can hold. *fine*: each 4 x 4 times over instead, mirrored in turns, with a photograph's detail
in pixels that a map of 1024 cannot hold and no tool finds again. *bright*: enlarged, nothing
cut off, RMSE over RMS: it is that of the suns' and lamps' edges.

A map's truth is the mean over each pixel of 4 x 4 samples of a world, each by its solid angle.
RMSE is over the mean, pixels by their solid angles, two pixels at the rims of discs left out.
"Equal density": from 1024 x 512 to as many pixels a radian, and back.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.envmap_peers import Picture, Tool, tools
from bench.row import Row
from chromeball.envmap.mapping import (
    MAPPINGS,
    LatLong,
    Mapping,
    Radial,
    make_mapping,
    of_camera,
    sized,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import read_image

type Array = NDArray[np.float64]
type Size = tuple[int, int]

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/envmap/latlong1k"
SCENES = ("pedestrian_overpass_1k", "quarry_01_1k", "venice_sunset_1k")
OTHERS = ("angular", "mirror", "octahedral", "cube", "fisheye")
FISHEYE = math.radians(190)
SUNS = 24
SUN, SKY = 1e5, 0.2  # radiance of the suns and of all else
SUN_RADIUS = math.radians(0.2666)
CUT = 4  # samples a pixel of a truth, each way


#: Kinds of worlds, and the rows' names of their RMSE
KINDS = {
    "resolved": "RMSE",
    "fine": "RMSE, a world finer than the maps",
    "bright": "RMSE over RMS, suns and lamps not cut off",
}


@dataclass(frozen=True)
class Result:
    """A tool on a task; shares of 1, means over the worlds of a kind in ``rmse``.

    ``energy``: the largest error of a channel's. ``suns``: what each sun's energy is off by.
    ``lowest``: how far the suns' picture goes below the sky, in suns. ``megapixels`` of the
    result, and the CPU ``seconds`` they took.
    """

    rmse: dict[str, float]
    energy: float
    suns: Array
    lowest: float
    megapixels: float
    seconds: float


@dataclass(frozen=True)
class Given:
    """A map and its truths, one a world; all maps have the worlds in one order."""

    mapping: Mapping
    pictures: list[Picture]


def rows(quick: bool) -> list[Row]:
    """Equal density there and back, minification, and speed."""
    scenes = [DATA / f"{name}.hdr" for name in SCENES[: 1 if quick else 3]]
    if not all(file.is_file() for file in scenes):
        return []
    found, absent = tools()
    width = 256 if quick else 1024
    kinds = [kind for kind in KINDS for _ in scenes]
    worlds = [_world(file, kind, width) for kind in KINDS for file in scenes]
    even = LatLong((width, width // 2))
    sizes = {"latlong": even.size} | {name: _as_fine(name, even) for name in OTHERS}
    maps = {
        name: Given(_mapping(name, size), means(worlds, name, size, CUT))
        for name, size in sizes.items()
    }
    results: dict[str, dict[str, Result]] = {tool.name: {} for tool in found}
    for name in OTHERS:
        for one, other in (("latlong", name), (name, "latlong")):
            source, target = maps[one], maps[other]
            able = [tool for tool in found if tool.knows(one, other)]
            seconds = _seconds(able, source, target.mapping)
            for tool in able:
                results[tool.name][f"{one} to {other}"] = _measure(
                    tool, source, target, kinds, seconds[tool.name]
                )
    made = [row for tool, tasks in results.items() for row in _same_rows(tool, tasks)]
    made += _minified(found, 4 * width, (16, 32) if quick else (64, 128))
    note = "not installed, see bench/envmap_peers.py"
    return made + [
        Row(
            "envmap",
            f"conversion at equal density: {KINDS['resolved']}",
            name,
            0.0,
            math.nan,
            "%",
            note,
        )
        for name in absent
    ]


def _measure(
    tool: Tool, given: Given, wanted: Given, kinds: Sequence[str], seconds: float
) -> Result:
    source, target = given.mapping, wanted.mapping
    solid = target.solid_angles()
    clear = _clear(source, target) & _clear(target, target)
    weight = solid * clear
    whole = source.whole and target.whole
    rmse: dict[str, list[float]] = {kind: [] for kind in KINDS}
    energy: list[float] = []
    for kind, picture, truth in zip(kinds, given.pictures, wanted.pictures, strict=True):
        got = tool.run(picture, source, target).astype(float)
        got = np.where(np.isfinite(got), got, truth)
        off = np.einsum("hwc,hw->", np.square(got - truth), weight)
        if kind == "bright":
            rmse[kind].append(
                math.sqrt(off / np.einsum("hwc,hw->", np.square(truth, dtype=float), weight))
            )
            continue
        sums = np.einsum("hwc,hw->c", truth.astype(float), weight)
        rmse[kind].append(math.sqrt(off * 3 * weight.sum()) / float(sums.sum()))
        if kind == "resolved":
            area, goal = weight, sums
            if whole:  # all of it, and what was given
                area = solid
                goal = np.einsum("hwc,hw->c", picture.astype(float), source.solid_angles())
            energy.append(float(np.abs(np.einsum("hwc,hw->c", got, area) / goal - 1).max()))
    reach = max(math.radians(2.5), 7 / target.density)
    suns = _directions([source, target], reach)
    lit = _lit(source, suns)
    got = tool.run(lit, source, target)
    ratio = _energies(got, target, suns, reach) / _energies(lit, source, suns, reach)
    return Result(
        {kind: float(np.mean(values)) for kind, values in rmse.items()},
        max(energy),
        np.abs(ratio - 1),
        float(SKY - np.nanmin(got[weight > 0])) / SUN,
        target.size[0] * target.size[1] / 1e6,
        seconds,
    )


def _seconds(able: Sequence[Tool], given: Given, target: Mapping) -> dict[str, float]:
    """The least CPU seconds of five runs in turns; slow ones run twice."""
    taken: dict[str, list[float]] = {tool.name: [] for tool in able}
    for k in range(5):
        for tool in able:
            if k < 2 or taken[tool.name][-1] < 0.4:
                start = time.process_time()
                tool.run(given.pictures[0], given.mapping, target)
                taken[tool.name].append(time.process_time() - start)
    return {name: min(values) for name, values in taken.items()}


def _same_rows(tool: str, tasks: dict[str, Result]) -> list[Row]:
    """A tool over all tasks that it knows, and its speed on each."""
    if not tasks:
        return []
    every = list(tasks.values())
    seconds = float(np.mean([one.seconds for one in every]))
    others = sorted({name for name in OTHERS for task in tasks if name in task})
    kinds = "" if len(others) == len(OTHERS) else f"{', '.join(others)} alone; "
    suns = np.concatenate([one.suns for one in every])
    deepest = max(one.lowest for one in every)

    def row(what: str, value: float, note: str) -> Row:
        title = f"conversion at equal density: {what}"
        return Row("envmap", title, tool, seconds, 100 * value, "%", kinds + note)

    def worst(values: dict[str, float]) -> str:
        name = max(values, key=lambda key: values[key])
        return f"worst {name} {100 * values[name]:.3g} %"

    made: list[Row] = []
    for kind, title in KINDS.items():
        rmse = {name: one.rmse[kind] for name, one in tasks.items()}
        made.append(row(title, float(np.mean(list(rmse.values()))), worst(rmse)))
    energy = {name: one.energy for name, one in tasks.items() if "fisheye" not in name}
    partial = [one.energy for name, one in tasks.items() if "fisheye" in name]
    ends = f"; of fisheyes, which end, {100 * max(partial):.3g} %" if partial else ""
    lowest = f"-{100 * deepest:.3g} % of the suns" if deepest > 1e-6 else "not below the sky"
    made += [
        row("energy, largest error", max(energy.values()), worst(energy) + ends),
        row(
            "a sun's energy, mean error",
            float(suns.mean()),
            f"largest {100 * suns.max():.3g} %; lowest value {lowest}",
        ),
    ]
    for name in others:
        there, back = tasks[f"latlong to {name}"], tasks[f"{name} to latlong"]
        errors = [f"{100 * one.rmse['resolved']:.2f} %" for one in (there, back)]
        note = f"back {back.megapixels / back.seconds:.3g}; RMSE {' and '.join(errors)}"
        title = f"conversion speed: latlong to {name}"
        speed = there.megapixels / there.seconds
        made.append(Row("envmap", title, tool, there.seconds, speed, "MP / CPU s", note))
    return made


def _minified(found: Sequence[Tool], width: int, small: Sequence[int]) -> list[Row]:
    """Suns of a large lat-long in small maps, three at a time, one a channel."""
    source = LatLong((width, width // 2))
    targets = [_mapping(name, _wide(name, n)) for name in OTHERS for n in small]
    off: dict[str, list[float]] = {tool.name: [] for tool in found}
    taken: dict[str, float] = dict.fromkeys(off, 0.0)
    runs: dict[str, int] = dict.fromkeys(off, 0)
    directions = _directions([source], math.radians(2.5))
    for three in directions.reshape(-1, 3, 3):
        lit = np.stack([_lit(source, sun[None])[..., 0] for sun in three], axis=-1)
        given = np.einsum("hwc,hw->c", lit.astype(float) - SKY, source.solid_angles())
        for name, target in zip(np.repeat(OTHERS, len(small)), targets, strict=True):
            # four pixels from a rim, which half a pixel of these small maps may cross
            clear = [_is_clear(target, sun, 4 / target.density) for sun in three]
            for tool in found:
                if not tool.knows("latlong", str(name)) or not any(clear):
                    continue
                start = time.process_time()
                got = tool.run(lit, source, target)
                taken[tool.name] += time.process_time() - start
                runs[tool.name] += 1
                solid = target.solid_angles()
                energy = np.einsum("hwc,hw->c", np.nan_to_num(got.astype(float) - SKY), solid)
                off[tool.name] += [
                    float(abs(e / g - 1))
                    for e, g, c in zip(energy, given, clear, strict=True)
                    if c
                ]
    sizes = " and ".join(map(str, small))
    return [
        Row(
            "envmap",
            f"minification, {width} to {sizes} px: a sun's energy, mean error",
            name,
            taken[name] / runs[name],
            100 * float(np.mean(values)),
            "%",
            f"largest {100 * max(values):.3g} %; {len(values)} suns away from rims"
            + ("" if runs[name] == max(runs.values()) else "; some maps alone"),
        )
        for name, values in off.items()
        if values
    ]


# ---- maps


def _mapping(name: str, size: Size) -> Mapping:
    if name == "fisheye":
        return of_camera(CameraModel.fisheye("equisolid", size, FISHEYE))
    return make_mapping(name, size)


def _wide(name: str, width: int) -> Size:
    return (width, width) if name == "fisheye" else sized(name, width)


def _as_fine(name: str, source: Mapping) -> Size:
    """The size at which a map has as many pixels a radian as `source`."""
    step = 1 if name == "fisheye" else MAPPINGS[name].step
    trial = _mapping(name, _wide(name, 64 * step))
    wide = trial.size[0] * source.density / trial.density
    return _wide(name, max(1, round(wide / step)) * step)


def _clear(mapping: Mapping, target: Mapping) -> NDArray[np.bool_]:
    """(H, W) of `target`: where `mapping` sees, two pixels and more from the rim of a disc."""
    d = target.directions()
    seen = np.isfinite(d).all(axis=2)
    if isinstance(mapping, Radial):
        along = np.where(seen[..., None], d, 1) @ mapping.rotation[:, 2]
        theta = np.arccos(np.clip(along, -1, 1))
        rim = mapping.rim - 2 / abs(mapping.focal[0])
        seen &= mapping.radius(np.minimum(theta, mapping.max_angle)) < rim
        seen &= theta <= mapping.max_angle
    return seen


def means(worlds: Sequence[Picture], name: str, size: Size, cut: int) -> list[Picture]:
    """Each world's mean over each pixel of a map: cut x cut samples by their solid angles."""
    import cv2

    width, height = size
    fine = _mapping(name, (width * cut, height * cut))
    solid = fine.solid_angles().astype(np.float32)
    lookup = LatLong((worlds[0].shape[1], worlds[0].shape[0]))
    made = [np.zeros((height, width, 3), np.float32) for _ in worlds]
    for j in range(height):
        rows = np.arange(j * cut, (j + 1) * cut, dtype=float)
        pixels = np.stack(np.meshgrid(np.arange(width * cut, dtype=float), rows), axis=-1)
        d = fine.unproject(pixels) @ fine.rotation.T
        seen = np.isfinite(d).all(axis=2)
        at = lookup.pixels_of(np.where(seen[..., None], d, 1.0)).astype(np.float32)
        share = (solid[j * cut : (j + 1) * cut] * seen).reshape(cut, width, cut)
        total = np.maximum(share.sum(axis=(0, 2)), 1e-30)
        for world, out in zip(worlds, made, strict=True):
            got = cv2.remap(
                world, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
            )
            parts = np.asarray(got).reshape(cut, width, cut, 3)
            out[j] = np.einsum("awbc,awb->wc", parts, share) / total[:, None]
    return made


# ---- worlds and suns


def _world(file: Path, kind: str, width: int) -> Picture:
    """One of the worlds, 4 `width` across."""
    import cv2

    pixels = read_image(file).pixels[..., :3].astype(np.float32)
    size = width, width // 2
    pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.float32)
    if kind != "bright":
        pixels = np.minimum(pixels, 8 * float(pixels.mean()))
    if kind == "fine":
        pair = np.concatenate([pixels, pixels[:, ::-1]], axis=1)
        return np.ascontiguousarray(np.tile(np.concatenate([pair, pair[::-1]]), (2, 2, 1)))
    around = np.concatenate([pixels[:, -8:], pixels, pixels[:, :8]], axis=1)
    size = 4 * around.shape[1], 4 * around.shape[0]
    large = np.asarray(cv2.resize(around, size, interpolation=cv2.INTER_CUBIC), np.float32)
    return np.ascontiguousarray(np.maximum(large[:, 32:-32], 0))


def _directions(maps: Sequence[Mapping], reach: float) -> Array:
    """Suns far from each other, and further than `reach` from the rims of all maps, (n, 3)."""
    rng = np.random.default_rng(5)
    suns: list[Array] = []
    for _ in range(20_000):
        d = rng.normal(size=3)
        d /= np.linalg.norm(d)
        apart = all(float(d @ other) < math.cos(math.radians(22)) for other in suns)
        if apart and all(_is_clear(mapping, d, reach) for mapping in maps):
            suns.append(d)
        if len(suns) == SUNS:
            break
    return np.array(suns)


def _is_clear(mapping: Mapping, sun: Array, reach: float) -> bool:
    """Whether all within `reach` radians of a sun is inside a disc."""
    if not isinstance(mapping, Radial):
        return True
    return math.acos(float(sun @ mapping.rotation[:, 2])) + reach < mapping.max_angle


def _lit(mapping: Mapping, suns: Array) -> Picture:
    """A sky with suns of half a degree, each pixel by the share of 16 x 16 samples in a sun."""
    d = np.nan_to_num(mapping.directions())
    picture = np.full((*d.shape[:2], 3), SKY, np.float32)
    picture[mapping.solid_angles() == 0] = 0
    reach = SUN_RADIUS + 2.5 / mapping.density
    steps = (np.arange(16) + 0.5) / 16 - 0.5
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    for sun in suns:
        y, x = np.nonzero(d @ sun > math.cos(reach))
        rays = mapping.unproject(np.stack([x, y], axis=-1)[:, None] + grid)
        inside = np.nan_to_num(rays) @ mapping.rotation.T @ sun > math.cos(SUN_RADIUS)
        picture[y, x] += (SUN * inside.mean(axis=1)).astype(np.float32)[:, None]
    return picture


def _energies(picture: Picture, mapping: Mapping, suns: Array, reach: float) -> Array:
    """What is above the sky within `reach` of each sun, (n,)."""
    d, solid = np.nan_to_num(mapping.directions()), mapping.solid_angles()
    above = np.nan_to_num(picture.astype(float).mean(axis=2) - SKY) * solid
    return np.array([above[d @ sun > math.cos(reach)].sum() for sun in suns])
