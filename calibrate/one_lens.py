"""Whether all views were taken with one lens: the focal length that each asks for by itself.

A view of a tilted board tells the focal length alone: with a magnification s of the solved lens
about its axis' image c, q = c + s (project(R p + t) - c), s, R and t are estimated together.
Where zoom or focus changed between two pictures, the magnifications before and after differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, residuals
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.target import Target
from chromeball.calibrate.view_poses import FEWEST_CORNERS, place_views
from chromeball.scene.pose import Pose

#: A change counts where it is so many of its standard errors, although the best of all places
#: to part the views is taken, which by chance alone reaches 3 of them.
CERTAIN = 6.0
#: So many views on a side are no change but bad views.
FEWEST_VIEWS = 3
#: A magnification less certain than this says nothing.
OPEN = 0.2


@dataclass(frozen=True)
class Change:
    """From view `first` on everything is `magnification` times as large, ± `error`."""

    first: int
    magnification: float
    error: float


def lens_change(lens: Lens, target: Target) -> Change | None:
    """Where in the order of the views the lens changed, if it did."""
    found, errors = magnifications(lens, target)
    known = np.flatnonzero(errors < OPEN)
    best, most = None, CERTAIN
    for k in range(FEWEST_VIEWS, len(known) - FEWEST_VIEWS + 1):
        (a, a_error), (b, b_error) = (
            _mean(found[side], errors[side]) for side in (known[:k], known[k:])
        )
        error = math.hypot(a_error, b_error)
        if abs(math.log(b / a)) > most * error:
            most = abs(math.log(b / a)) / error
            best = Change(int(known[k]), b / a, b / a * error)
    return best


def magnifications(
    lens: Lens, target: Target
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Magnification (V,) that each view asks of the lens, and the error of its logarithm.

    NaN where a view has no pose; views that were rejected have theirs, too.
    """
    from scipy.optimize import least_squares

    corners, board = lens.observed, target.points()
    placed, start = place_views(lens.camera, corners, target, lens.bow, lens.pupil)
    centre = lens.camera.project(np.array([0.0, 0, 1]))
    found, errors = (np.full(len(corners), np.nan) for _ in range(2))
    for at, view in enumerate(placed):
        seen = np.isfinite(corners[view][..., 0])
        if seen.sum() < FEWEST_CORNERS:
            continue
        estimate = start.views(np.array([at]))

        def misses(
            x: NDArray[np.float64], estimate: Estimate = estimate, view: int = int(view)
        ) -> NDArray[np.float64]:
            turn = Pose.from_rotation_vector(x[:3], np.zeros(3)).rotation
            there = replace(
                estimate,
                rotations=turn @ estimate.rotations,
                translations=estimate.translations + x[3:6],
            )
            here = corners[view] + residuals(there, board, corners[view][None])[0]
            miss = centre + math.exp(x[6]) * (here - centre) - corners[view]
            return np.nan_to_num(miss[np.isfinite(corners[view][..., 0])], nan=1e3).ravel()

        fit = least_squares(
            misses, np.zeros(7), x_scale="jac", loss="cauchy", f_scale=2.4 * lens.sigma
        )
        sigma = max(lens.sigma, 1.4826 * float(np.median(np.abs(misses(fit.x)))))
        spread = np.linalg.pinv(fit.jac.T @ fit.jac)
        found[view], errors[view] = math.exp(fit.x[6]), sigma * math.sqrt(spread[6, 6])
    return found, errors


def _mean(found: NDArray[np.float64], errors: NDArray[np.float64]) -> tuple[float, float]:
    """Weighted mean and its relative error, by the values' own scatter where that is larger.

    Views differ by more than noise explains, by a board that bends for one; the scatter is
    that of a median, so that a stray view does not count.
    """
    weight = errors**-2
    mean = math.exp(float((np.log(found) * weight).sum() / weight.sum()))
    off = np.abs(np.log(found / mean)) / errors
    scatter = max(1.0, 1.4826 * float(np.median(off)))
    return mean, scatter / math.sqrt(float(weight.sum()))
