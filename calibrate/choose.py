"""Which lens model: the simplest of those that predict left-out pictures equally well."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.lens import FEWEST_VIEWS, calibrate_lens, check_views
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.solve import Fit, fit_start
from chromeball.calibrate.target import Target
from chromeball.calibrate.view_poses import pose_residuals
from chromeball.scene.errors import UserError

#: What `auto` chooses from, the simplest first.
CANDIDATES = ("opencv4", "kb4", "opencv5", "kb4_decentred", "opencv8", "splined")
FOLDS = 4


@dataclass(frozen=True)
class Choice:
    """The model chosen; ``errors``, held out, of all candidates in pixels; and the reason."""

    model: str
    errors: dict[str, float]
    reason: str


def choose_model(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    progress: Callable[[str, float], object] | None = None,
    start: Fit | None = None,
    candidates: Sequence[str] = CANDIDATES,
) -> Choice:
    """The simplest lens whose held-out error is as low as the lowest.

    `candidates` are models, the simplest first; `start` is a fit of the same views, if there is
    one already.

    As low means: the logarithm of the two models' errors, view by view, differs by no more
    than the standard error of its median. The error of a model that these corners do not
    determine is infinite, as is that of a view which it does not reach.

    Raises
    ------
    UserError
        When no candidate is determined, or the views are too few to leave some out.

    """
    check_views(len(corners))
    if len(corners) == FEWEST_VIEWS:
        raise UserError(
            f"{FEWEST_VIEWS} pictures with the board do not tell lens models apart: take more, "
            "better 15, or choose one with --model, opencv4 for an ordinary lens"
        )
    start = fit_start(corners, target, size) if start is None else start
    found: dict[str, NDArray[np.float64]] = {}
    errors: dict[str, float] = {}
    refusal: UserError | None = None
    for model in candidates:
        try:
            found[model] = held_out_errors(corners, target, size, model, start=start)
            errors[model] = float(np.median(found[model]))
        except UserError as error:
            errors[model], refusal = math.inf, error
        if progress is not None:
            progress(model, errors[model])
    best = min(errors, key=errors.__getitem__)
    if math.isinf(errors[best]):
        raise refusal or UserError("no lens model reaches the corners of most pictures")
    chosen = next(m for m in found if m == best or _as_low(found[m], found[best]))
    if chosen == best:
        others = list(candidates[: candidates.index(best)])
        than = f"simpler ones ({', '.join(others)}) predict worse" if others else "the simplest"
        return Choice(chosen, errors, f"least held-out error; {than}")
    reason = f"as good as {best} on left-out pictures within the errors, and simpler"
    return Choice(chosen, errors, reason)


def held_out_errors(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    model: str,
    folds: int = FOLDS,
    start: Fit | None = None,
) -> NDArray[np.float64]:
    """RMS per point of each view of `corners` (V, rows, columns, 2) when left out, (V,).

    Every view is left out once; its pose alone is fitted to the lens of the others.
    """
    errors = np.full(len(corners), np.inf)
    for fold in range(min(folds, len(corners))):
        left_out = np.arange(len(corners)) % folds == fold
        lens = calibrate_lens(corners[~left_out], target, size, model, start=start)
        errors[left_out] = pose_errors(lens, corners[left_out], target)
    return errors


def pose_errors(
    lens: Lens, corners: NDArray[np.float64], target: Target
) -> NDArray[np.float64]:
    """RMS per point of views (V, rows, columns, 2) whose poses alone are fitted, (V,).

    Infinite where the lens allows no pose, or does not see some corner.
    """
    left = pose_residuals(lens.camera, corners, target, lens.bow, lens.pupil)
    return view_errors(left, corners)


def view_errors(
    residuals: NDArray[np.float64], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """RMS per point (V,) of `residuals`, infinite where some of the `corners` has none."""
    square = (residuals**2).sum(axis=-1)
    square[np.isfinite(corners[..., 0]) & np.isnan(square)] = np.inf
    return np.sqrt([np.nanmean(s) for s in square])


def _as_low(errors: NDArray[np.float64], best: NDArray[np.float64]) -> bool:
    """Whether views' errors (V,) are those of the `best`, within the error of the median."""
    both = np.isfinite(errors) & np.isfinite(best)
    if np.isinf(errors).sum() > np.isinf(best).sum() or not both.any():
        return False
    ratio = np.log(np.maximum(errors[both], 1e-12) / np.maximum(best[both], 1e-12))
    middle = float(np.median(ratio))
    # The median's standard error is 1.2533 of the mean's; 1.4826 MAD is a deviation.
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    return middle <= max(1.2533 * spread / math.sqrt(both.sum()), 0.005)
