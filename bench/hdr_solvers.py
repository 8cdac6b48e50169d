"""Solvers of a response, ours and the peers', as functions of frames, times and a prior.

Each gives ln exposure (C, 256), zero at code 128, NaN where it says nothing finite.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
from colour_hdri import g_solve
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from chromeball.bench.hdr import dorf
from chromeball.hdr.prior import FAMILY, Prior, distances, from_curves, inverse_curves
from chromeball.hdr.response import sample, solve

type Float = NDArray[np.float64]
type Frames = list[NDArray[np.uint8]]
type Solver = Callable[[Frames, Float, Prior | None], Float]

#: pixels that the paper's dense solve is given: it has an unknown for each
PAPER_PIXELS = 300


def comparagram(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """Our default, with a prior that has not seen the curve it is judged on."""
    return solve([sample(frame) for frame in frames], times, prior=prior).g


def comparagram_shipped(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """Our default with the prior that is shipped, made of all curves of the database."""
    return solve([sample(frame) for frame in frames], times).g


def debevec(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """Our Debevec and Malik, from all pixels."""
    return solve([sample(frame) for frame in frames], times, method="debevec").g


def opencv_debevec(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """OpenCV's Debevec and Malik with its 70 samples."""
    return _opencv(cv2.createCalibrateDebevec(), frames, times)


def opencv_debevec_500(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """OpenCV's Debevec and Malik with 500 samples."""
    return _opencv(cv2.createCalibrateDebevec(samples=500), frames, times)


def opencv_robertson(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """OpenCV's Robertson."""
    return _opencv(cv2.createCalibrateRobertson(), frames, times)


def paper(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """The program of the 1997 paper as colour-hdri has it, on a grid of pixels."""
    height, width, channels = frames[0].shape
    step = int(np.sqrt(height * width / PAPER_PIXELS))
    grid = np.stack([frame[step // 2 :: step, step // 2 :: step] for frame in frames], axis=-1)
    chosen = grid.reshape(-1, channels, len(frames))
    return _zeroed(
        np.stack([g_solve(chosen[:, c], np.log(times))[0] for c in range(channels)])
    )


def _opencv(tool: Any, frames: Frames, times: Float) -> Float:
    curve = tool.process(frames, times.astype(np.float32)).reshape(256, 3).T
    with np.errstate(divide="ignore", invalid="ignore"):
        return _zeroed(np.log(curve.astype(np.float64)))


def _zeroed(g: Float) -> Float:
    finite = np.where(np.isfinite(g), g, np.nan)
    return finite - finite[:, 128, None]


@cache
def _families() -> tuple[Float, Float, NDArray[np.int32]]:
    """The database's curves, their distances, and the family of each.

    A family is what single linkage joins: neighbours less than FAMILY apart.
    """
    g = inverse_curves(*dorf())
    between = distances(g)
    return g, between, fcluster(linkage(squareform(between), "single"), FAMILY, "distance")


@cache
def unseen(number: int) -> Prior:
    """The prior made of all curves but those of the family of curve `number`."""
    g, _, family = _families()
    return from_curves(g[family != family[number]])


def strangeness(number: int) -> float:
    """RMS (ln) from a curve to the nearest one of another family."""
    _, between, family = _families()
    return float(between[number, family != family[number]].min())
