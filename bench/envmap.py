"""Resampling of environment maps against OpenCV's remap: error, energy and suns."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.envmap_align import rows as align_rows
from bench.envmap_lights import rows as lights_rows
from bench.envmap_probe import rows as probe_rows
from bench.envmap_stitch import rows as stitch_rows
from bench.envmap_update import rows as update_rows
from bench.row import Row
from chromeball.envmap.mapping import (
    LatLong,
    Mapping,
    make_mapping,
    of_camera,
    pixel_grid,
    sized,
)
from chromeball.envmap.resample import warp
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import read_image

type Picture = NDArray[np.float32]
type Tool = Callable[[Picture, Mapping, Mapping], Picture]

DATA = (
    Path(__file__).resolve().parents[1].parent / "shared/data/envmap/latlong1k/quarry_01_1k.hdr"
)
SUNS = 8


def rows(quick: bool) -> list[Row]:
    """Fisheye to lat-long and lat-long to the others, real maps where they stand."""
    scale = 1 if quick else 2
    lens = CameraModel.fisheye("equisolid", (512 * scale, 512 * scale), math.radians(190))
    fisheye, panorama = of_camera(lens), LatLong((512 * scale, 256 * scale))
    small = LatLong((64 * scale, 32 * scale))
    tasks: list[tuple[str, Mapping, Mapping]] = [
        ("fisheye to lat-long", fisheye, panorama),
        ("fisheye to lat-long, 8 times smaller", fisheye, small),
    ]
    for name, width in (("mirror", 360), ("angular", 360), ("cube", 512)):
        target = make_mapping(name, sized(name, width * scale))
        tasks.append((f"lat-long to {name}", panorama, target))
    result: list[Row] = []
    for what, source, target in tasks:
        result += _task(what, source, target)
    others = align_rows(quick) + update_rows(quick) + probe_rows(quick)
    return result + lights_rows(quick) + stitch_rows(quick) + others


def _task(what: str, source: Mapping, target: Mapping) -> list[Row]:
    import cv2

    world, kind = _world()
    picture, truth = _average(world, source), _average(world, target)
    solid = target.solid_angles()
    d = target.directions()
    # compare where the source sees, away from both rims
    inner = (solid > 0.5 * np.median(solid[solid > 0])) & np.isfinite(d).all(axis=2)
    seen = source.project(np.nan_to_num(d) @ source.rotation)
    inner &= np.isfinite(seen).all(axis=2)
    inner = np.asarray(cv2.erode(inner.astype(np.uint8), np.ones((3, 3), np.uint8))) > 0
    suns = _with_suns(source)
    energy_of_suns = np.einsum("hwc,hw->", suns.astype(float), source.solid_angles())
    found: list[Row] = []
    for tool, run in _tools().items():
        start = time.process_time()
        got = run(picture, source, target)
        seconds = time.process_time() - start
        difference = (got - truth)[inner].astype(float)
        error = 100 * math.sqrt(float(np.mean(difference**2))) / float(truth[inner].mean())
        found.append(Row("envmap", f"{what}: RMSE", tool, seconds, error, "% of mean", kind))
        start = time.process_time()
        lit = run(suns, source, target)
        seconds = time.process_time() - start
        energy = float(np.einsum("hwc,hw->", lit.astype(float), solid))
        error = 100 * abs(energy / energy_of_suns - 1)
        note = f"{SUNS} suns of 1e5; lowest value {lit.min():.3g}"
        found.append(Row("envmap", f"{what}: suns' energy", tool, seconds, error, "%", note))
    return found


def _tools() -> dict[str, Tool]:
    import cv2

    def ours(picture: Picture, source: Mapping, target: Mapping) -> Picture:
        result = warp(picture, source, target)
        return result.radiance * result.coverage[..., None]

    def fast(picture: Picture, source: Mapping, target: Mapping) -> Picture:
        result = warp(picture, source, target, quality="fast")
        return result.radiance * result.coverage[..., None]

    def remap(interpolation: int) -> Tool:
        def run(picture: Picture, source: Mapping, target: Mapping) -> Picture:
            d = np.nan_to_num(target.directions())
            maps = source.project(d @ source.rotation).astype(np.float32)
            maps = np.nan_to_num(maps, nan=-100.0)
            border = cv2.BORDER_WRAP if isinstance(source, LatLong) else cv2.BORDER_CONSTANT
            got = cv2.remap(
                picture, maps[..., 0], maps[..., 1], interpolation, borderMode=border
            )
            got[target.solid_angles() == 0] = 0
            return np.asarray(got, np.float32)

        return run

    return {
        "chromeball": ours,
        "chromeball --fast": fast,
        "cv2.remap linear": remap(cv2.INTER_LINEAR),
        "cv2.remap lanczos4": remap(cv2.INTER_LANCZOS4),
    }


def _world() -> tuple[Picture, str]:
    """A lat-long whose pixels are the truth: a photograph, else a made-up one."""
    if DATA.is_file():
        # no suns here: they have rows of their own
        pixels = read_image(DATA).pixels[..., :3].astype(np.float32)
        return np.minimum(pixels, 8 * float(pixels.mean())), DATA.stem
    d = LatLong((1024, 512)).directions()
    x, y, z = np.moveaxis(d, -1, 0)
    detail = 1 + 0.4 * np.sin(90 * x) * np.sin(70 * y + 40 * z)
    level = 1.5 + y + (np.abs(x) > 0.6) * (z > 0.2) * 5
    return np.stack([detail * level, level, 2 - y], axis=-1).astype(np.float32), "made up"


def _average(world: Picture, mapping: Mapping, cut: int = 8) -> Picture:
    """The world's mean over each pixel by cut x cut sub-samples, bilinear between its own."""
    import cv2

    lookup = LatLong((world.shape[1], world.shape[0]))
    total = np.zeros((mapping.size[1], mapping.size[0], 3), np.float32)
    count = np.zeros((mapping.size[1], mapping.size[0], 1), np.float32)
    for j in range(cut):
        for i in range(cut):
            offset = np.array([i + 0.5, j + 0.5]) / cut - 0.5
            d = mapping.unproject(pixel_grid(mapping.size) + offset) @ mapping.rotation.T
            seen = np.isfinite(d).all(axis=2)
            maps = lookup.pixels_of(np.nan_to_num(d)).astype(np.float32)
            maps = np.nan_to_num(maps)
            got = cv2.remap(
                world, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
            )
            total += np.asarray(got, np.float32) * seen[..., None]
            count += seen[..., None]
    return (total / np.maximum(count, 1)).astype(np.float32)


def _with_suns(mapping: Mapping) -> Picture:
    """A dim map with suns of 1e5 of half a degree, all over what the map sees."""
    rng = np.random.default_rng(7)
    d = np.nan_to_num(mapping.directions())
    picture = np.full((*d.shape[:2], 3), 0.2, np.float32)
    picture[mapping.solid_angles() == 0] = 0
    for _ in range(SUNS):
        sun = rng.normal(size=3)
        sun[2] = abs(sun[2])
        sun /= np.linalg.norm(sun)
        picture[np.unravel_index(int((d @ sun).argmax()), d.shape[:2])] = 1e5
        picture[d @ sun > math.cos(math.radians(0.25))] = 1e5
    return picture
