"""Stitching: seven equisolid views with a noisy tracker, and 25 photographs taken by hand."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.envmap.mapping import LatLong, of_camera
from chromeball.envmap.probe import rotation
from chromeball.envmap.resample import warp
from chromeball.envmap.stitch.bend import bend
from chromeball.envmap.stitch.blend import compose
from chromeball.envmap.stitch.features import find
from chromeball.envmap.stitch.frames import Frame, read_frame
from chromeball.envmap.stitch.lens import Freedom, full_frame, guessed
from chromeball.envmap.stitch.links import Prior
from chromeball.envmap.stitch.orient import orient
from chromeball.envmap.stitch.photometric import radius2, solve
from chromeball.envmap.stitch.rotations import angle_between, exp
from chromeball.scene.camera import WORLD_FROM_LATLONG
from chromeball.scene.image import read_image

type Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/envmap"
SCENES = ("pedestrian_overpass_1k", "quarry_01_1k", "venice_sunset_1k")
NOISE = math.radians(0.7)


def rows(quick: bool) -> list[Row]:
    """Orientation, energy and time on real maps; the photographed panorama."""
    scenes = [DATA / "latlong1k" / f"{name}.hdr" for name in SCENES]
    scenes = [file for file in scenes if file.is_file()][: 1 if quick else 3]
    result: list[Row] = []
    for file in scenes:
        result += _views(file)
    photographs = sorted((DATA / "pano25").glob("*.JPG"))
    return result if quick or not photographs else result + _photographs(photographs)


def _views(file: Path) -> list[Row]:
    world = read_image(file).pixels[..., :3].astype(np.float32)
    size = (1072, 712)
    lens = full_frame("equisolid", size, 10.5 / 23.6 * size[0])
    rng = np.random.default_rng(3)
    aimed = [(60.0 * k, -8.0, 90.0) for k in range(6)] + [(10.0, 55.0, 0.0)]
    true = np.array(
        [
            rotation(*np.radians(np.array(a) + rng.normal(size=3) * 2))
            @ WORLD_FROM_LATLONG.rotation
            for a in aimed
        ]
    )
    source = LatLong((world.shape[1], world.shape[0]))
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    r2 = radius2(lens, np.stack([x, y], axis=-1))
    fall = (1 - 0.25 * r2 - 0.1 * r2**2)[..., None]
    exposure = rng.normal(size=7) * 0.1
    exposure -= exposure.mean()
    frames = [
        Frame(
            str(k),
            (
                warp(world, source, of_camera(lens).turned(r)).radiance * fall * math.exp(e)
            ).astype(np.float32),
        )
        for k, (r, e) in enumerate(zip(true, exposure, strict=True))
    ]
    tracked = exp(rng.normal(size=(7, 3)) * NOISE) @ true
    start = time.process_time()
    features = [find(frame.radiance) for frame in frames]
    found = orient(features, lens, prior=Prior(tracked, np.full(7, NOISE)))
    oriented = time.process_time() - start
    u, _, vt = np.linalg.svd(np.einsum("nab,ncb->ac", true, found.rotations))
    common = u @ vt  # the tracker's mean error is nobody's to find
    off = angle_between(common @ found.rotations, true)
    error = math.degrees(math.sqrt(float(np.mean(off**2))))
    what = f"stitch 7 views, {file.stem}"
    note = f"largest standard error told {np.degrees(found.adjusted.sigma).max():.4f}"
    result = [Row("envmap", f"{what}: orientation", "chromeball", oriented, error, "deg", note)]
    start = time.process_time()
    light = solve(frames, lens, common @ found.rotations)
    made = compose(frames, lens, common @ found.rotations, 1024, light)
    blended = time.process_time() - start
    solid = source.solid_angles()
    seen = made.alpha > 0.999
    energy = [float((p.sum(axis=2) * solid)[seen].sum()) for p in (made.radiance, world)]
    return [
        *result,
        Row(
            *("envmap", f"{what}: energy", "chromeball", blended),
            *(100 * abs(energy[0] / energy[1] - 1), "%"),
            "exposures and vignetting solved; no turn but the common one is taken out",
        ),
        *_opencv(frames, true, what),
    ]


def _opencv(frames: list[Frame], true: Array, what: str) -> list[Row]:
    """OpenCV's own estimator on the same views; it knows perspective lenses alone."""
    import cv2

    codes = [
        (255 * np.clip(f.radiance / (4 * np.median(f.radiance)), 0, 1) ** (1 / 2.2)).astype(
            np.uint8
        )
        for f in frames
    ]
    start = time.process_time()
    stitcher = cv2.Stitcher.create(cv2.Stitcher_PANORAMA)
    try:
        status = stitcher.estimateTransform(codes)
        used = 0 if status != 0 else len(np.ravel(stitcher.component()))
        note = f"{used} of {len(frames)} frames connected (it has no fisheye)"
    except cv2.error as error:  # a frame of little contrast ends it
        used, note = 0, f"fails: {' '.join(str(error.err).split())[:60]}"
    seconds = time.process_time() - start
    off_by = 180.0
    if used == len(frames):
        turns = np.array([np.asarray(c.R, float) for c in stitcher.cameras()])
        u, _, vt = np.linalg.svd(np.einsum("nab,ncb->ac", true, turns))
        off = angle_between((u @ vt) @ turns, true)
        off_by = math.degrees(math.sqrt(float(np.mean(off**2))))
    row = Row("envmap", f"{what}: orientation", "cv2.Stitcher", seconds, off_by, "deg", note)
    return [row]


def _photographs(files: list[Path]) -> list[Row]:
    start = time.process_time()
    frames = [read_frame(file) for file in files]
    features = [find(frame.radiance) for frame in frames]
    lens = guessed("pinhole", frames[0].size, frames[0].focal35)
    found = orient(features, lens, freedom=Freedom(focal=True, radial=True))
    middle = time.process_time()
    bends = bend(found.matches, found.adjusted)
    end = time.process_time()
    residual = found.adjusted.residuals
    inlying = residual[found.adjusted.inliers]
    total = len(residual)
    rms = float(np.sqrt(np.mean(inlying**2)))
    what, connected = "stitch 25 photographs by hand", len(found.groups[0])
    return [
        Row(
            *(
                "envmap",
                f"{what}: rotations alone, RMS",
                "chromeball",
                middle - start,
                rms,
                "px",
            ),
            f"{connected} connected; the {len(inlying)} of {total} matches that agree best; "
            f"median of all {np.median(residual):.2f}",
        ),
        Row(
            *("envmap", f"{what}: bent, RMS", "chromeball", end - middle, bends.after[1], "px"),
            f"{bends.inliers} of {total} matches, median {bends.after[0]:.2f}; all held out: "
            f"median {bends.held_out[1]:.2f} (before {bends.held_out[0]:.2f})",
        ),
    ]
