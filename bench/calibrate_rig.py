"""Rigs beside mrcal's command, on the same corners; real stereo pairs and webcams."""

from __future__ import annotations

import math
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.calibrate.rig import calibrate_rig
from chromeball.calibrate.rig_views import find_sources, look, plan_pairs
from chromeball.calibrate.target import Charuco, Chessboard
from chromeball.calibrate.virtual_rig import observe, ring, scattered_boards
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/calibrate"
BOARD = Chessboard(9, 6, 0.04)
PEER = "mrcal-calibrate-cameras"

type Corners = NDArray[np.float64]


def rows(quick: bool) -> list[Row]:
    """Virtual rings against their truth; real rigs by what is left."""
    seeds = 1 if quick else 3
    found = [row for share in (0.0, 0.05, 0.15) for row in _ring(seeds, share, ())]
    found += _ring(seeds, 0.05, (3, 4))
    if (DATA / "opencv_stereo").is_dir():
        found += _stereo()
    if (DATA / "webcams").is_dir() and not quick:
        found += _webcams()
    return found


def _ring(seeds: int, share: float, wide: tuple[int, ...]) -> list[Row]:
    """Cameras' centres and triangulated points, the best motion taken out, medians of seeds."""
    kind = "8 cameras, 2 of them of 190 degrees" if wide else "ring of 8 cameras"
    what = f"{kind}, 30 boards, noise 0.2 px, {share:.0%} false corners, {seeds} seeds"
    tools = ["chromeball"] + ([f"{PEER} OPENCV4"] if shutil.which(PEER) and not wide else [])
    centres: dict[str, list[float]] = {tool: [] for tool in tools}
    points: dict[str, list[float]] = {tool: [] for tool in tools}
    seconds = dict.fromkeys(tools, math.inf)
    for seed in range(seeds):
        truth = ring(8, wide=wide, seed=seed)
        boards = scattered_boards(BOARD, truth, 30, seed=seed)
        corners = observe(BOARD, truth, boards, outliers=share, seed=seed)
        for tool in tools:
            start = _cpu()
            if tool == "chromeball":
                models = ["kb4" if c.model == "kb4" else "opencv4" for c in truth]
                sizes, names = [c.size for c in truth], [f"{c}" for c in range(8)]
                rig = calibrate_rig(corners, BOARD, sizes, names, models=models)
                found = list(rig.cameras)
            else:
                found = _mrcal(corners, truth[0].size)
            seconds[tool] = min(seconds[tool], _cpu() - start)
            centre, point = _errors(found, truth)
            centres[tool].append(centre)
            points[tool].append(point)
    return [
        Row("calibrate", f"{what}, {name}", tool, seconds[tool],
            1000 * float(np.median(errors[tool])), "mm",
            "" if tool == "chromeball" else "with its process's start")
        for name, errors in (("centres", centres), ("points", points))
        for tool in tools
    ]  # fmt: skip


def _cpu() -> float:
    """CPU seconds of this process and of those that it waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _errors(found: Sequence[CameraModel], truth: Sequence[CameraModel]) -> tuple[float, float]:
    """RMS of centres and median of points seen by two or more cameras, metres."""
    here = np.array([c.world_from_camera.translation for c in found])
    there = np.array([c.world_from_camera.translation for c in truth])
    u, _, vt = np.linalg.svd((there - there.mean(axis=0)).T @ (here - here.mean(axis=0)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    centre = math.sqrt(
        float(
            (((here - here.mean(axis=0)) @ turn.T + there.mean(axis=0) - there) ** 2)
            .sum(-1)
            .mean()
        )
    )
    targets = np.random.default_rng(0).uniform(-0.3, 0.3, (300, 3))
    normal, right = np.zeros((300, 3, 3)), np.zeros((300, 3))
    views = np.zeros(300, int)
    for camera, true in zip(found, truth, strict=True):
        pixels = true.project_world(targets)
        inside = ((pixels > 0) & (pixels < np.array(true.size))).all(axis=-1)
        rays = camera.rays(np.where(inside[:, None], pixels, 0.0))
        inside &= np.isfinite(rays).all(axis=-1)
        across = np.eye(3) - rays[..., None] * rays[:, None]
        across[~inside] = 0
        normal += across
        right += across @ camera.world_from_camera.translation
        views += inside
    seen = views > 1
    points = np.linalg.solve(normal[seen], right[seen][..., None])[..., 0]
    middle, goal = points.mean(axis=0), targets[seen].mean(axis=0)
    u, _, vt = np.linalg.svd((targets[seen] - goal).T @ (points - middle))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    off = (points - middle) @ turn.T + goal - targets[seen]
    return centre, float(np.median(np.linalg.norm(off, axis=1)))


def _mrcal(corners: Corners, size: tuple[int, int]) -> list[CameraModel]:
    """Mrcal's command on a cache of corners."""
    with tempfile.TemporaryDirectory() as folder:
        lines = ["# filename x y level"]
        for c, v in np.argwhere(np.isfinite(corners).any(axis=(2, 3, 4))):
            for x, y in corners[c, v].reshape(-1, 2):
                place = f"{x:.6f} {y:.6f} 0" if np.isfinite(x) else "- - -"
                lines.append(f"{folder}/{v:03d}-cam{c}.png {place}")
        cache = Path(folder, "corners.vnl")
        cache.write_text("\n".join(lines) + "\n")
        globs = [f"{folder}/*-cam{c}.png" for c in range(len(corners))]
        subprocess.run(
            [PEER, "--corners-cache", str(cache), "--lensmodel", "LENSMODEL_OPENCV4",
             "--focal", "900", "--object-spacing", str(BOARD.square),
             "--object-width-n", str(BOARD.columns), "--object-height-n", str(BOARD.rows),
             "--imagersize", str(size[0]), str(size[1]), "--outdir", folder, *globs],
            check=True, capture_output=True,
        )  # fmt: skip
        return [
            CameraModel.read(Path(folder, f"camera-{c}.cameramodel"))
            for c in range(len(corners))
        ]


def _stereo() -> list[Row]:
    """OpenCV's stereo pairs: RMS over all corners, joint and by cv2 from the same corners."""
    import cv2

    board = Chessboard(9, 6, 0.025)
    with tempfile.TemporaryDirectory() as folder:
        for side in ("left", "right"):
            Path(folder, side).mkdir()
            for path in (DATA / "opencv_stereo").glob(f"{side}[01]*.jpg"):
                Path(folder, side, path.name).symlink_to(path)
        sources = find_sources([Path(folder)])
        views = look(sources, plan_pairs(sources), board)
    corners = views.corners
    start = time.process_time()
    rig = calibrate_rig(corners, board, views.sizes, views.names, models=["opencv5"] * 2)
    ours = time.process_time() - start
    cv: Any = cv2
    both = np.isfinite(corners).all(axis=(0, 2, 3, 4))
    points = [board.points().reshape(-1, 3).astype(np.float32)] * int(both.sum())
    sides = [[v.reshape(-1, 1, 2).astype(np.float32) for v in side[both]] for side in corners]
    start = time.process_time()
    lenses = [cv.calibrateCamera(points, s, views.sizes[0], None, None)[1:3] for s in sides]
    theirs = cv.stereoCalibrate(
        points, *sides, *lenses[0], *lenses[1], views.sizes[0], flags=0
    )[0]
    seconds = time.process_time() - start
    what = f"{int(both.sum())} real stereo pairs 640x480, RMS per corner, our corners"
    good = int(rig.outliers.sum())
    square = np.nanmean((rig.residuals**2).sum(axis=-1))
    return [
        Row("calibrate", what, "chromeball rig", ours, float(np.sqrt(square)), "px",
            f"bow; {good} corners rejected"),
        Row("calibrate", what, "cv2.stereoCalibrate", seconds, float(theirs), "px",
            "no rejection"),
    ]  # fmt: skip


def _webcams() -> list[Row]:
    """Four webcams without synchronisation: RMS over all corners, at once and with clocks."""
    folder = DATA / "webcams/charuco_calibration/calibration/extrinsic"
    board = Charuco(4, 5, 0.054, 0.0405, "4X4_1000")
    sources = find_sources([folder])
    plan = plan_pairs(sources, folder / "timestamps.csv")
    views = look(sources, plan, board)
    what = "four unsynchronised webcams, RMS over all corners"
    start = time.process_time()
    try:
        rig = calibrate_rig(
            views.corners, board, views.sizes, views.names,
            models=["opencv5"] * 4, stamps=plan.stamps,
        )  # fmt: skip
    except UserError as error:
        return [Row("calibrate", what, "chromeball rig", math.nan, math.nan, "px", error.what)]
    seconds = time.process_time() - start
    if rig.sync is None:
        return [Row("calibrate", what, "chromeball rig", seconds, math.nan, "px", "no clocks")]
    offsets = ", ".join(f"{1000 * v:.0f}" for v in rig.sync.motion.offsets)
    return [
        Row("calibrate", what, "chromeball rig", seconds, rig.sync.rms, "px",
            f"offsets {offsets} ms; median left out {rig.sync.held_out[1]:.2f}"),
        Row("calibrate", what, "chromeball rig, as if at once", seconds, rig.sync.rms_before,
            "px", f"median left out {rig.sync.held_out[0]:.2f}"),
    ]  # fmt: skip
