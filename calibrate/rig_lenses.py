"""The lens of each camera of a rig by itself, to begin with and to compare with.

It is what `calibrate lens` solves from some of the views, but for the entrance pupil, which
stands still in a rig. The joint solution has the last word.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, residuals
from chromeball.calibrate.choose import CANDIDATES as LENSES
from chromeball.calibrate.choose import choose_model
from chromeball.calibrate.halves import lens_excess
from chromeball.calibrate.lens import FEWEST_VIEWS, OPENCV
from chromeball.calibrate.rig_solve import FEWEST_CORNERS, OUTLIER
from chromeball.calibrate.rig_start import place_boards
from chromeball.calibrate.solve import FISHEYES, Fit, fit_model, fit_start, judge
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: A splined lens has too many unknowns for a start from few boards: it can be given.
MODELS = ("auto", "pinhole", *OPENCV, *FISHEYES)
#: What auto chooses from.
CANDIDATES = tuple(m for m in LENSES if m in MODELS)
#: Views that the fit needs; they are taken evenly from the session.
FIT_VIEWS = 24

#: A lens of the pictures' own may be so many pixels and so many times its errors off a given
#: one before that is doubted, and before it is another camera's or another zoom's. Two good
#: calibrations of one real lens differ by three to six times their errors.
DOUBTED_LENS, WRONG_LENS = (0.5, 4.0), (3.0, 8.0)

type Corners = NDArray[np.float64]


@dataclass(frozen=True)
class Alone:
    """One camera by itself before F instants of the board.

    ``camera`` unposed; ``camera_from_board`` (F, 4, 4) where it ``saw`` (F,) the board;
    ``sigma`` the deviation of a corner's coordinate, freed from the unknowns; ``covariance``
    (k, k) of the intrinsics, zero where they were given.
    """

    camera: CameraModel
    camera_from_board: NDArray[np.float64]
    saw: NDArray[np.bool_]
    sigma: float
    covariance: Corners


def calibrate_alone(
    corners: Corners, target: Target, size: tuple[int, int], model: str
) -> Alone:
    """Lens and board poses from one camera's `corners` (F, rows, columns, 2).

    Raises
    ------
    UserError
        When the pictures are too few, or no lens explains them.

    """
    if model not in MODELS:
        raise UserError(f"unknown lens model {model!r} for a rig; one of {', '.join(MODELS)}")
    views = np.flatnonzero(np.isfinite(corners[..., 0]).sum(axis=(1, 2)) >= FEWEST_CORNERS)
    if len(views) < FEWEST_VIEWS:
        raise UserError(
            f"the board was found in {len(views)} of its pictures; a lens needs "
            f"{FEWEST_VIEWS}, better 15, or must be given"
        )
    fitted = views[np.linspace(0, len(views) - 1, min(len(views), FIT_VIEWS)).astype(int)]
    chosen = corners[fitted]
    start = fit_start(chosen, target, size)
    if model == "auto":
        model = choose_model(chosen, target, size, start=start, candidates=CANDIDATES).model
    name = f"LENSMODEL_{model.upper()}" if model in OPENCV else model
    lens = judge(fit_model(start, chosen, target, name, travel=False), chosen, target)
    if len(fitted) < len(views):
        return replace(place_alone(corners, target, lens.camera), covariance=lens.covariance)
    poses, saw = np.tile(np.eye(4), (len(corners), 1, 1)), np.zeros(len(corners), bool)
    for view, frame in zip(fitted, lens.camera_from_board, strict=True):
        if np.isfinite(frame).all():
            saw[view] = True
            poses[view] = Pose.from_rotation_vector(frame[:3], frame[3:]).matrix()
    return Alone(lens.camera, poses, saw, lens.sigma, lens.covariance)


def place_alone(corners: Corners, target: Target, camera: CameraModel) -> Alone:
    """Board poses through a lens that is known."""
    board = target.points()
    poses, saw = place_boards(camera, board, corners)
    if not saw.any():
        raise UserError("no board of its pictures is seen by the lens: is it the right one?")
    estimate = Estimate(camera, np.zeros(2), poses[saw, :3, :3], poses[saw, :3, 3])
    sigma = _sigma(residuals(estimate, board, corners[saw]), 6 * int(saw.sum()))
    none = np.zeros((len(camera.intrinsics), len(camera.intrinsics)))
    return Alone(camera, poses, saw, sigma, none)


def off_own_lens(corners: Corners, target: Target, given: Alone) -> tuple[float, float]:
    """How far the `given` lens is off one of the corners' own, of its model.

    RMS distance over the corners in pixels, a turn apart, and its multiple of the own lens's
    errors; NaN where the boards are too few, or not turned enough, to tell.
    """
    camera, views = given.camera, given.saw
    own = camera.model in FISHEYES or camera.model.removeprefix("LENSMODEL_").lower() in OPENCV
    if not own or views.sum() < FEWEST_VIEWS:
        return math.nan, math.nan
    placed, poses = np.flatnonzero(views), given.camera_from_board[views]
    estimate = Estimate(camera, np.zeros(2), poses[:, :3, :3], poses[:, :3, 3])
    used = np.isfinite(corners[placed][..., 0])
    start = Fit(placed, estimate, used, 2.4 * given.sigma)
    try:
        fit = fit_model(start, corners, target, camera.model, travel=False)
        lens = judge(fit, corners, target)
    except UserError:
        return math.nan, math.nan
    support = corners[np.isfinite(lens.residuals[..., 0])]
    support = support[:: 1 + len(support) // 2000]
    off, excess, _ = lens_excess(lens.camera, camera, lens.covariance, support)
    return off, excess


def _sigma(error: Corners, unknowns: int) -> float:
    """Deviation of a coordinate by the residuals (V, rows, columns, 2) that fit."""
    distance = np.hypot(error[..., 0], error[..., 1])
    sigma = float(np.nanmedian(distance)) / math.sqrt(2 * math.log(2))
    for _ in range(6):
        used = distance < OUTLIER * sigma
        free = max(2 * int(used.sum()) - int(unknowns), 1)
        sigma = math.sqrt(float((error[used] ** 2).sum()) / free)
    return max(sigma, 1e-9)
