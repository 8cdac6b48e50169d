"""One lens from pictures of a target: the models, which one predicts best, by which solver.

mrcal solves OpenCV's models and its own splined one, our own least squares the fisheyes.
Source: Zhang 2000 for what pictures of a plane determine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate import solve_fisheye, solve_mrcal
from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.target import Target
from chromeball.scene.errors import UserError

MODELS = ("auto", *solve_mrcal.MODELS, *solve_fisheye.MODELS)
#: What `auto` chooses from.
CANDIDATES = ("opencv4", "opencv5", "opencv8", "kb4")
FEWEST_VIEWS = 3


def calibrate_lens(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    model: str = "opencv8",
    paths: Sequence[str] | None = None,
) -> Lens:
    """Estimate a lens from `corners` (V, rows, columns, 2), NaN where missing.

    `size` is the pictures' width and height; `paths` are kept in mrcal's solution for its
    tools. `model` is one of :data:`MODELS` without ``auto``.

    Raises
    ------
    UserError
        When the views are too few, all parallel, or leave the focal length undetermined.

    """
    if model not in MODELS or model == "auto":
        raise UserError(f"unknown lens model {model!r}; one of {', '.join(MODELS)}")
    if len(corners) < FEWEST_VIEWS:
        raise UserError(
            f"the board was found in {_count(len(corners), 'picture')}; a lens needs "
            f"{FEWEST_VIEWS}, better 15, with the board tilted in different directions"
        )
    if model in solve_fisheye.MODELS:
        return solve_fisheye.solve_fisheye(corners, target, size, model)
    if isinstance(target, AprilGrid):
        raise UserError(
            f"mrcal, which solves {model}, knows only boards of evenly spaced corners, "
            "not an AprilGrid: take --model kb4"
        )
    return solve_mrcal.solve_mrcal(corners, target, size, model, paths)


def choose_model(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    progress: Callable[[str, float], object] | None = None,
) -> tuple[str, dict[str, float]]:
    """The model of :data:`CANDIDATES` with the least held-out error, and all their errors.

    The error of a model that these corners do not determine, or that does not reach them, is
    infinite.

    Raises
    ------
    UserError
        When that is so of all of them.

    """
    errors: dict[str, float] = {}
    refusal: UserError | None = None
    for model in CANDIDATES:
        try:
            errors[model] = held_out_error(corners, target, size, model)
        except UserError as error:
            errors[model], refusal = math.inf, error
        if progress is not None:
            progress(model, errors[model])
    if refusal is not None and math.isinf(min(errors.values())):
        raise refusal
    return min(errors, key=errors.__getitem__), errors


def held_out_error(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    model: str,
    folds: int = 4,
) -> float:
    """Root median square of held-out views' RMS per point, pixels.

    Every view is left out once; its pose alone is fitted to the lens of the others. The median
    keeps a view that the detector misread from deciding.
    """
    errors: list[float] = []
    for fold in range(folds):
        left_out = np.arange(len(corners)) % folds == fold
        if not left_out.any():
            continue
        lens = calibrate_lens(corners[~left_out], target, size, model)
        errors.extend(pose_errors(lens, corners[left_out], target))
    return float(np.median(errors))


def pose_errors(
    lens: Lens, corners: NDArray[np.float64], target: Target
) -> NDArray[np.float64]:
    """RMS per point of views (V, rows, columns, 2) whose poses alone are fitted, (V,).

    Infinite where the lens allows no pose.
    """
    square = (lens.pose_residuals(corners, target) ** 2).sum(axis=-1)
    return np.sqrt([np.nanmean(s) if np.isfinite(s).any() else np.inf for s in square])


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
