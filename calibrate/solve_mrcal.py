"""mrcal's solution from our start: its splined model, and files that its tools can read.

A fit of ours gives intrinsics, poses and the corners that count; mrcal estimates from there, so
that its camera model holds the optimisation inputs of an optimum. Its splined model is started
from Kannala and Brandt's lens. Source: mrcal's
documentation (Kogan), for the models, the bow and the uncertainty of projection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mrcal
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import residuals
from chromeball.calibrate.convert import converted
from chromeball.calibrate.lens_result import (
    LEAST_TILT,
    PARALLEL,
    Lens,
    check_focal,
    largest_tilt,
)
from chromeball.calibrate.solve import OUTLIER, Fit, board_frames
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

solver: Any = mrcal
#: Corners farther than this many deviations from the start's lens are not shown to the splines.
GROSS = 12.0
#: Rounds of rejection at most.
ROUNDS = 6


def refine(
    fit: Fit,
    corners: NDArray[np.float64],
    target: Target,
    paths: Sequence[str] | None = None,
) -> Lens:
    """mrcal's lens of the same model, on the corners that count in `fit`.

    `corners` (V, rows, columns, 2), NaN where missing; `paths` of their pictures are kept in
    the solution for mrcal's tools.
    """  # noqa: D403
    camera = fit.estimate.camera
    name = "LENSMODEL_PINHOLE" if camera.model == "pinhole" else camera.model
    problem = _problem(fit, corners, fit.used, target.square, paths)
    problem |= {
        "lensmodel": name,
        "intrinsics": camera.intrinsics[None].copy(),
        "calobject_warp": fit.estimate.bow.copy(),
        "do_optimize_calobject_warp": True,
    }
    statistics = solver.optimize(**problem)
    return _judge(problem, statistics["x"], fit, corners)


def solve_splined(
    start: Fit,
    corners: NDArray[np.float64],
    target: Target,
    paths: Sequence[str] | None = None,
) -> Lens:
    """mrcal's splined lens, from a `start` of model kb4 on the same corners."""  # noqa: D403
    board = target.points()
    seen = corners[start.placed]
    error = residuals(start.estimate, board, seen)
    used = np.hypot(error[..., 0], error[..., 1]) < GROSS / 2.4 * start.scale
    plain, _ = converted(start.estimate.camera, "LENSMODEL_STEREOGRAPHIC", start.rays(board))
    name = _splined(plain)
    knots = solver.lensmodel_num_params(name) - 4
    problem = _problem(start, corners, used, target.square, paths)
    problem |= {
        "lensmodel": name,
        "intrinsics": np.concatenate([plain.intrinsics, np.zeros(knots)])[None],
        "do_optimize_intrinsics_core": False,
    }
    solver.optimize(**problem)
    problem |= {"calobject_warp": np.zeros(2), "do_optimize_calobject_warp": True}
    x = solver.optimize(**problem)["x"]
    for _ in range(ROUNDS):
        weight = problem["observations_board"][..., 2]
        error = np.hypot(*_residuals(x, weight).transpose(3, 0, 1, 2))
        sigma = float(np.sqrt(np.mean(error[weight > 0] ** 2) / 2))
        fits = np.where(used & (error < OUTLIER * sigma), 1.0, -1.0)
        if (fits == weight).all():
            break
        weight[:] = fits
        x = solver.optimize(**problem)["x"]
    return _judge(problem, x, start, corners)


def _problem(
    fit: Fit,
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
    square: float,
    paths: Sequence[str] | None,
) -> dict[str, Any]:
    """What mrcal.optimize wants to know of the views that have a pose."""
    views = len(fit.placed)
    observations = np.where(used[..., None], corners[fit.placed], 0.0)
    weights = np.where(used, 1.0, -1.0)[..., None]
    index = np.zeros((views, 3), np.int32)
    index[:, 0], index[:, 2] = np.arange(views), -1
    problem = {
        "rt_cam_ref": None,
        "rt_ref_frame": board_frames(fit),
        "points": None,
        "observations_board": np.concatenate([observations, weights], axis=-1),
        "indices_frame_camintrinsics_camextrinsics": index,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "imagersizes": np.array([fit.estimate.camera.size], np.int32),
        "calobject_warp": None,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": False,
        "do_optimize_frames": True,
        "do_optimize_calobject_warp": False,
        "calibration_object_spacing": square,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": True,
        "verbose": False,
    }
    if paths is not None:
        problem["imagepaths"] = np.array(paths)[fit.placed]
    return problem


def _splined(camera: CameraModel) -> str:
    """A splined model about as wide as a stereographic lens."""
    width, height = camera.size
    # Knots a little beyond the picture's edges, where the cubic patches still need them.
    degrees = math.ceil(math.degrees(4 * math.atan(width / (4 * camera.intrinsics[0]))) * 1.15)
    across = 11
    down = max(5, round(across * height / width))
    return f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={across}_Ny={down}_fov_x_deg={degrees}"


def _judge(
    problem: dict[str, Any],
    x: NDArray[np.float64],
    fit: Fit,
    corners: NDArray[np.float64],
) -> Lens:
    frames = problem["rt_ref_frame"]
    if largest_tilt(frames) < LEAST_TILT:
        raise UserError(PARALLEL)
    inlier = problem["observations_board"][..., 2] > 0
    error = _residuals(x, inlier)
    square = error[inlier] ** 2
    free = square.size - solver.num_states(**problem)
    if free < 1:
        raise UserError("after outlier rejection too few corners are left: check the pictures")
    sigma = math.sqrt(float(square.sum()) / free)
    covariance, condition = _covariance(problem, sigma)
    intrinsics = problem["intrinsics"][0]
    with np.errstate(invalid="ignore"):  # a variance below zero is refused as NaN
        check_focal(intrinsics, np.sqrt(np.diag(covariance)), 2)
    name = problem["lensmodel"]
    left = np.full(corners.shape, np.nan)
    left[fit.placed] = np.where(inlier[..., None], error, np.nan)
    poses = np.full((len(corners), 6), np.nan)
    poses[fit.placed] = frames
    return Lens(
        camera=CameraModel(
            "pinhole" if name == "LENSMODEL_PINHOLE" else name,
            intrinsics,
            fit.estimate.camera.size,
        ),
        observed=corners,
        residuals=left,
        outliers=np.isfinite(corners[..., 0]) & np.isnan(left[..., 0]),
        rms=math.sqrt(2 * float(square.mean())),
        sigma=sigma,
        covariance=covariance,
        bow=np.array(problem["calobject_warp"], float),
        pupil=np.zeros(2),
        camera_from_board=poses,
        condition=condition,
        solution=solver.cameramodel(optimization_inputs=problem, icam_intrinsics=0),
    )


def _residuals(x: NDArray[np.float64], corners: NDArray[Any]) -> NDArray[np.float64]:
    """Of the board in mrcal's measurement vector, (V, rows, columns, 2)."""
    return np.array(x[: corners.size * 2], float).reshape(*corners.shape, 2)


def _covariance(problem: dict[str, Any], sigma: float) -> tuple[NDArray[np.float64], float]:
    """Of the intrinsics: sigma^2 (J'J)^-1; zero for those held fixed. And J'J's condition."""
    states = solver.num_states(**problem)
    count = problem["intrinsics"].shape[1]
    free = solver.num_states_intrinsics(**problem)
    _, _, _, factorization = solver.optimizer_callback(**problem)
    if factorization is None:
        raise UserError("these pictures do not determine the lens: take more, tilted, views")
    first = solver.state_index_intrinsics(0, **problem)
    rows = np.zeros((free, states))
    rows[np.arange(free), first + np.arange(free)] = 1
    packed = factorization.solve_xt_JtJ_bt(rows)[:, first : first + free]
    scale = np.ones(states)
    solver.unpack_state(scale, **problem)
    unit = sigma * scale[first : first + free]
    covariance = np.zeros((count, count))
    covariance[count - free :, count - free :] = packed * np.outer(unit, unit)
    return covariance, 1 / max(float(factorization.rcond()), 1e-300)
