"""Alignment and ghosts on real brackets: CPU seconds against error, beside OpenCV's AlignMTB.

Each frame of a bracket is cut out at a place of its own, up to 30 pixels away (the fisheye at
four times the resolution, then averaged down: sub-pixel shifts), so the shift between
neighbouring exposures is known. What a bracket was misaligned by before (memorial was
registered by hand) is measured on the uncut frames and taken off for both tools. The error is
the share of neighbouring pairs that are off by more than 2 pixels and not flagged.
"""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.hdr.align import Alignment, align
from chromeball.hdr.ghost import find_ghosts
from chromeball.hdr.response import sample, solve
from chromeball.scene.image import read_image

DATA = Path(__file__).resolve().parents[1].parent / "shared/data/hdr"
REACH, RUNS = 30, 2
type Float = NDArray[np.float64]
type Frame = NDArray[np.uint8]


def rows(quick: bool = False) -> list[Row]:
    """The rows of alignment and ghosts; none where the shared data set is absent."""
    if not (DATA / "memorial").is_dir():
        return []
    return [*align_rows(quick), *ghost_rows(quick)]


def align_rows(quick: bool) -> list[Row]:
    """Known shifts of real brackets: ours and AlignMTB."""
    found: list[Row] = []
    for name, frames, times, fine in _brackets(quick):
        rng = np.random.default_rng(0)
        errors: dict[str, list[float]] = {"chromeball": [], "OpenCV AlignMTB": []}
        seconds = dict.fromkeys(errors, 0.0)
        flagged: list[bool] = []
        uncut = [_cut(f, (0, 0), fine) for f in frames]
        height, width = uncut[0].shape[:2]
        still = _centres(align(uncut, times), height, width)
        for _ in range(1 if quick else RUNS):
            shifts = rng.integers(-REACH, REACH + 1, (len(frames), 2))
            cut = [_cut(f, s, fine) for f, s in zip(frames, shifts, strict=True)]
            truth = shifts / fine + still
            start = time.process_time()
            ours = align(cut, times)
            seconds["chromeball"] += time.process_time() - start
            places = _centres(ours, height, width)
            start = time.process_time()
            mtb = cv2.createAlignMTB(6)
            grey = [cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in cut]
            steps = [mtb.calculateShift(a, b) for a, b in pairwise(grey)]
            seconds["OpenCV AlignMTB"] += time.process_time() - start
            for k, step in enumerate(steps):
                want = truth[k + 1] - truth[k]
                flagged.append(bool(ours.flags[k] or ours.flags[k + 1]))
                moved = places[k + 1] - places[k]
                errors["chromeball"].append(float(np.hypot(*(moved - want))))
                errors["OpenCV AlignMTB"].append(float(np.hypot(*(np.array(step) - want))))
        doubtful = np.array(flagged)
        for tool, values in errors.items():
            error = np.array(values)
            trusted = ~doubtful if tool == "chromeball" else np.ones(len(error), bool)
            kept = error[trusted]
            found.append(
                Row(
                    "hdr",
                    f"align {name}, {len(frames)} x {width} x {height}",
                    tool,
                    seconds[tool] / (1 if quick else RUNS),
                    float(np.mean((error > 2) & trusted)),
                    "share of pairs > 2 px",
                    f"{len(error)} pairs, median {np.median(kept):.3f} px, "
                    f"95 % {np.quantile(kept, 0.95):.3f}, > 0.5 px {np.mean(kept > 0.5):.1%}, "
                    f"flagged {np.mean(~trusted):.1%}",
                )
            )
    return found


def ghost_rows(quick: bool) -> list[Row]:
    """Share of the picture called a ghost on tripod brackets, and recall of patches moved."""
    found: list[Row] = []
    for name, frames, times, _ in _brackets(quick)[:2]:
        inside = [np.ascontiguousarray(f[40:-60, 14:-14]) for f in frames]
        solved = solve([sample(f) for f in inside], times)
        noise: dict[str, Any] = {"sigma": solved.sigma}
        start = time.process_time()
        still = find_ghosts(inside, times, solved.g, solved.code_noise, **noise)
        seconds = time.process_time() - start
        rng = np.random.default_rng(0)
        height, width = inside[0].shape[:2]
        seen = hidden = 0
        for _ in range(2 if quick else 8):
            moved = [f.copy() for f in inside]
            truth = np.zeros((height, width), bool)
            for _ in range(3):
                side = int(rng.integers(20, 50))
                j = int(rng.integers(0, len(moved)))
                y0, y1 = rng.integers(0, height - side, 2)
                x0, x1 = rng.integers(0, width - side, 2)
                patch = inside[j][y0 : y0 + side, x0 : x0 + side]
                old = inside[j][y1 : y1 + side, x1 : x1 + side]
                truth[y1 : y1 + side, x1 : x1 + side] |= (
                    np.abs(patch.astype(int) - old).max(axis=2) > 24
                )
                moved[j][y1 : y1 + side, x1 : x1 + side] = patch
            mask = find_ghosts(moved, times, solved.g, solved.code_noise, **noise).mask
            seen += int((mask & truth).sum())
            hidden += int((truth & ~mask).sum())
        found.append(
            Row(
                "hdr",
                f"ghosts {name}, {len(frames)} x {width} x {height}",
                "chromeball",
                seconds,
                float(still.mask.mean()),
                "share found where nothing moved",
                f"patches moved: recall {seen / max(seen + hidden, 1):.2f}",
            )
        )
    return found


def _centres(found: Alignment, height: int, width: int) -> Float:
    """Where the middle of each frame lies in the reference, less where it lies in itself."""
    middle = np.array([(width - 1) / 2, (height - 1) / 2, 1.0])
    at = found.transforms @ middle
    return at[:, :2] / at[:, 2:] - middle[:2]


def _brackets(quick: bool) -> list[tuple[str, list[Frame], Float, int]]:
    """Name, frames, exposures, and how many of their pixels make one of what is aligned."""
    room = sorted((DATA / "hdrtoolbox/stack").glob("*.jpg"))
    memorial = sorted((DATA / "memorial").glob("*.png"))[: 4 if quick else 11]
    brackets = [
        (
            "room",
            [_read(p) for p in room],
            np.array([2, 0.5, 1 / 8, 1 / 30, 1 / 125, 1 / 1000, 1 / 4000]),
            1,
        ),
        (
            "memorial",
            [_read(p) for p in memorial],
            np.exp2(-np.arange(float(len(memorial)))),
            1,
        ),
    ]
    if not quick:
        fisheye = sorted((DATA / "fisheye_lumilab/JPEG").glob("*.JPG"))[5:12]
        frames = [np.ascontiguousarray(_read(p)[800:2900, 1300:4200]) for p in fisheye]
        brackets.append(("fisheye", frames, np.exp2(-np.arange(7.0)), 4))
    return brackets


def _read(path: Path) -> Frame:
    return np.ascontiguousarray(read_image(path).pixels[..., :3])


def _cut(frame: Frame, shift: Any, fine: int) -> Frame:
    height, width = ((n - 2 * REACH) // fine * fine for n in frame.shape[:2])
    x, y = REACH + int(shift[0]), REACH + int(shift[1])
    cut = np.ascontiguousarray(frame[y : y + height, x : x + width])
    size = width // fine, height // fine
    if fine == 1:
        return cut
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.uint8)
