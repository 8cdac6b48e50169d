"""Solvers of a response, ours and the peers', as functions of frames, times and a prior.

Each gives ln exposure (C, 256), zero at code 128, NaN where it says nothing finite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from colour_hdri import g_solve
from colour_hdri.calibration.debevec1997 import extrapolating_function_polynomial
from colour_hdri.generation import weighting_function_Debevec1997
from colour_hdri.sampling import samples_Grossberg2003
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from chromeball.bench.hdr import dorf
from chromeball.hdr.prior import FAMILY, Prior, distances, from_curves, inverse_curves
from chromeball.hdr.response import Solution, sample, solve
from chromeball.hdr.response_file import Response

type Float = NDArray[np.float64]
type Frames = list[NDArray[np.uint8]]
type Solver = Callable[[Frames, Float, Prior | None], Float]

#: samples that the paper's dense solve is given: it has an unknown for each
PAPER_SAMPLES = 300
#: steps by which a curve that does not rise is made to
RISE = 1e-6


def comparagram(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """Our default, with a prior that has not seen the curve it is judged on."""
    return solve([sample(frame) for frame in frames], times, prior=prior).g


def comparagram_shipped(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """Our default with the prior that is shipped, made of all curves of the database."""
    return solve([sample(frame) for frame in frames], times).g


def debevec(frames: Frames, times: Float, prior: Prior | None) -> Float:
    """Our Debevec and Malik, from all pixels."""
    return solve([sample(frame) for frame in frames], times, method="debevec").g


def as_response(found: Solution) -> Response:
    """Curve, standard error and code noise, as `hdr merge` is given them."""
    known = Response.from_log_exposure(found.g)
    return replace(known, sigma=found.sigma, code_noise=found.code_noise)


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
    """The program of the 1997 paper as colour-hdri has it: its samples, its ends."""
    stack = np.stack([frame / 255 for frame in frames], axis=-1)
    chosen = samples_Grossberg2003(stack, samples=PAPER_SAMPLES)  # (samples, P, C)
    solved = [g_solve(chosen[..., c], np.log(times))[0] for c in range(chosen.shape[2])]
    # the paper's hat is zero at the ends, where its solve says nothing
    ended = extrapolating_function_polynomial(
        np.exp(np.stack(solved, axis=1)), weighting_function_Debevec1997
    )
    return _logarithm(ended.T)


def _opencv(tool: Any, frames: Frames, times: Float) -> Float:
    return _logarithm(tool.process(frames, times.astype(np.float32)).reshape(256, 3).T)


def _logarithm(exposure: NDArray[Any]) -> Float:
    with np.errstate(divide="ignore", invalid="ignore"):
        g = np.log(exposure.astype(np.float64))
    finite = np.where(np.isfinite(g), g, np.nan)
    return finite - finite[:, 128, None]


def rising(g: Float) -> Float:
    """Missing codes from their neighbours; where it falls, level outwards from the middle."""
    z = np.arange(g.shape[1])
    middle = len(z) // 2
    whole = np.stack([np.interp(z, z[np.isfinite(c)], c[np.isfinite(c)]) for c in g])
    below = np.minimum.accumulate(whole[:, middle::-1], axis=1)[:, ::-1]
    above = np.maximum.accumulate(whole[:, middle:], axis=1)
    return np.concatenate([below, above[:, 1:]], axis=1) + RISE * z


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
