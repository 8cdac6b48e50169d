"""One lens from pictures of a target, of any model.

Our own least squares finds the lens and the corners that count; mrcal then refines OpenCV's
models and solves its own splined one. Source: Zhang 2000 for what pictures of a plane
determine.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate import solve_mrcal
from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.convert import CAHVORE, parameters
from chromeball.calibrate.lens_result import Lens, check_count
from chromeball.calibrate.solve import (
    FISHEYES,
    Fit,
    fit_model,
    fit_start,
    judge,
)
from chromeball.calibrate.target import Target
from chromeball.scene.errors import UserError

OPENCV = ("opencv4", "opencv5", "opencv8")
MODELS = ("auto", "pinhole", *OPENCV, "splined", "cahvore", *FISHEYES)
FEWEST_VIEWS = 3


def calibrate_lens(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    model: str = "opencv8",
    paths: Sequence[str] | None = None,
    start: Fit | None = None,
) -> Lens:
    """Estimate a lens from `corners` (V, rows, columns, 2), NaN where missing.

    `size` is the pictures' width and height; `paths` are kept in mrcal's solution for its
    tools. `model` is one of :data:`MODELS` without ``auto``; `start` one of the same lens, if
    there is one already.

    Raises
    ------
    UserError
        When the views are too few, all parallel, or leave the focal length undetermined.

    """
    if model not in MODELS or model == "auto":
        raise UserError(f"unknown lens model {model!r}; one of {', '.join(MODELS)}")
    check_views(len(corners))
    if model == "splined" and isinstance(target, AprilGrid):
        raise UserError(
            "mrcal, which solves splined, knows only boards of evenly spaced corners, not "
            "an AprilGrid: take another model"
        )
    name = f"LENSMODEL_{model.upper()}" if model in OPENCV else model
    name = CAHVORE if model == "cahvore" else name
    check_count(corners, model, 4 if model == "splined" else parameters(name))
    start = fit_start(corners, target, size) if start is None else start
    if model == "splined":
        start = fit_model(start, corners, target, "kb4")
        return solve_mrcal.solve_splined(start, corners, target, paths)
    fit = fit_model(start, corners, target, name)
    if model in ("cahvore", *FISHEYES) or isinstance(target, AprilGrid):
        return judge(fit, corners, target)
    return solve_mrcal.refine(fit, corners, target, paths)


def check_views(count: int) -> None:
    """Raise :class:`UserError` where `count` views are too few for a lens."""
    if count < FEWEST_VIEWS:
        raise UserError(
            f"the board was found in {_count(count, 'picture')}; a lens needs "
            f"{FEWEST_VIEWS}, better 15, with the board tilted in different directions"
        )


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
