"""Lenses by mrcal: OpenCV's models, the pinhole and mrcal's splined one.

Intrinsics, board poses and the board's bow are estimated together with mrcal's outlier
rejection. No focal length is asked for: stereographic lenses of many fields of view are tried
as a start, with poses from rays turned to the axis. Sources: mrcal's documentation (Kogan), for
the models, the bow and the uncertainty of projection.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mrcal
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.lens_result import (
    LEAST_TILT,
    PARALLEL,
    Lens,
    check_count,
    check_focal,
    largest_tilt,
)
from chromeball.calibrate.pose import start_poses
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

solver: Any = mrcal
MODELS = ("pinhole", "opencv4", "opencv5", "opencv8", "splined")
OPENCV_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
#: Horizontal fields of view tried as a start, degrees.
FIELDS_OF_VIEW = (12, 20, 32, 48, 66, 90, 120, 150, 185)


@dataclass(frozen=True)
class MrcalLens(Lens):
    """A lens by mrcal; ``solution`` is its camera model with its optimisation inputs."""

    solution: Any

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intrinsics."""
        count = len(self.camera.intrinsics)
        if self.camera.model.startswith("LENSMODEL_SPLINED"):
            return (*OPENCV_NAMES[:4], *(f"s{i}" for i in range(count - 4)))
        return OPENCV_NAMES[:count]

    def pose_residuals(
        self, corners: NDArray[np.float64], target: Target
    ) -> NDArray[np.float64]:
        """Residuals (V, rows, columns, 2) of views whose poses alone are fitted."""
        frames = _board_poses(self.camera, corners, target.square)
        if frames is None:
            return np.full(corners.shape, np.nan)
        problem = _problem(corners, target.square, self.camera.size, frames)
        problem |= {
            "lensmodel": self.camera.model,
            "intrinsics": self.camera.intrinsics[None].copy(),
            "calobject_warp": self.bow.copy(),
            "do_optimize_intrinsics_core": False,
            "do_optimize_intrinsics_distortions": False,
        }
        if self.camera.model == "pinhole":
            problem["lensmodel"] = "LENSMODEL_PINHOLE"
        return _residuals(solver.optimize(**problem)["x"], corners)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write mrcal's ``.cameramodel`` with its optimisation inputs to a temporary path."""
        self.solution.write(os.fspath(path), note=f"RMS {self.rms:.4f} px per point")


def solve_mrcal(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    model: str,
    paths: Sequence[str] | None = None,
) -> MrcalLens:
    """Estimate one of :data:`MODELS` from `corners` (V, rows, columns, 2), NaN where missing.

    `paths` are kept in the solution for mrcal's tools.
    """
    problem = _start(corners, target.square, size)
    if paths is not None:
        problem["imagepaths"] = np.array(paths)
    if largest_tilt(problem["rt_ref_frame"]) < LEAST_TILT:
        raise UserError(PARALLEL)
    check_count(corners, model, solver.lensmodel_num_params(_lensmodel(model, problem)))
    for stage in ("opencv4", model) if model in ("opencv5", "opencv8") else (model,):
        _expand(problem, _lensmodel(stage, problem))
        if stage == "splined":
            problem["do_optimize_intrinsics_core"] = False
        solver.optimize(**problem)
    problem |= {
        "calobject_warp": np.zeros(2),
        "do_optimize_calobject_warp": True,
        "do_apply_outlier_rejection": True,
    }
    statistics = solver.optimize(**problem)
    return _judge(problem, statistics["x"], corners, size)


# ---- stages of the solution


def _problem(
    corners: NDArray[np.float64],
    square: float,
    size: tuple[int, int],
    frames: NDArray[np.float64],
) -> dict[str, Any]:
    """What mrcal.optimize wants to know of `corners` with board poses `frames` (V, 6)."""
    views = len(corners)
    missing = np.isnan(corners[..., :1])
    observations = np.where(missing, 0.0, corners)
    weights = np.where(missing, -1.0, 1.0)
    index = np.zeros((views, 3), np.int32)
    index[:, 0], index[:, 2] = np.arange(views), -1
    return {
        "rt_cam_ref": None,
        "rt_ref_frame": frames,
        "points": None,
        "observations_board": np.concatenate([observations, weights], axis=-1),
        "indices_frame_camintrinsics_camextrinsics": index,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "imagersizes": np.array([size], np.int32),
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


def _start(
    corners: NDArray[np.float64], square: float, size: tuple[int, int]
) -> dict[str, Any]:
    """The best stereographic lens over the fields of view, with its board poses."""
    best: dict[str, Any] | None = None
    least = math.inf
    for degrees in FIELDS_OF_VIEW:
        f = size[0] / (4 * math.tan(math.radians(degrees) / 4))
        core = np.array([f, f, (size[0] - 1) / 2, (size[1] - 1) / 2])
        camera = CameraModel("LENSMODEL_STEREOGRAPHIC", core, size)
        frames = _board_poses(camera, corners, square)
        if frames is None:
            continue
        problem = _problem(corners, square, size, frames)
        problem |= {"lensmodel": camera.model, "intrinsics": core[None].copy()}
        error = float(solver.optimize(**problem)["rms_reproj_error__pixels"])
        if error < least and 0.02 < problem["intrinsics"][0, 0] / max(size) < 100:
            best, least = problem, error
    if best is None:
        raise UserError("no lens explains where the corners lie: is the board's size right?")
    return best


def _board_poses(
    camera: CameraModel, corners: NDArray[np.float64], square: float
) -> NDArray[np.float64] | None:
    """Rotation vector and translation of each view's board, (V, 6); None where one fails."""
    _, rows, columns, _ = corners.shape
    y, x = np.indices((rows, columns))
    board = np.stack([x * square, y * square, np.zeros_like(x)], axis=-1).astype(float)
    frames = np.empty((len(corners), 6))
    for frame, view in zip(frames, corners, strict=True):
        found = np.isfinite(view[..., 0])
        rays = camera.unproject(view[found])
        poses = start_poses(board[found], rays) if np.isfinite(rays).all() else []
        if not poses:
            return None
        misses = [_miss(pose.apply(board[found]), rays) for pose in poses]
        pose = poses[int(np.argmin(misses))]
        frame[:3], frame[3:] = pose.rotation_vector(), pose.translation
    return frames


def _miss(points: NDArray[np.float64], rays: NDArray[np.float64]) -> float:
    unit = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return float(((unit - rays) ** 2).sum())


def _lensmodel(model: str, problem: dict[str, Any]) -> str:
    """The name of our `model` in mrcal."""
    if model != "splined":
        return f"LENSMODEL_{model.upper()}"
    width, height = problem["imagersizes"][0]
    focal = problem["intrinsics"][0, 0]
    # Knots a little beyond the picture's edges, where the cubic patches still need them.
    degrees = math.ceil(math.degrees(4 * math.atan(width / (4 * focal))) * 1.15)
    across = 11
    down = max(5, round(across * height / width))
    return f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={across}_Ny={down}_fov_x_deg={degrees}"


def _expand(problem: dict[str, Any], lensmodel: str) -> None:
    """Change the lens model, keeping what is known and starting the rest near zero."""
    known = problem["intrinsics"]
    if "STEREOGRAPHIC" in problem["lensmodel"] and "STEREOGRAPHIC" not in lensmodel:
        known = known[:, :4]
    count = solver.lensmodel_num_params(lensmodel) - known.shape[1]
    fresh = np.random.default_rng(0).uniform(-1e-6, 1e-6, (1, count))
    if found := re.fullmatch(r"LENSMODEL_OPENCV(\d+)", lensmodel):
        # A rational model whose denominator starts near zero radius terms cannot lock up.
        fresh[:, max(0, 5 + 4 - known.shape[1]) :] *= 1e-3 if int(found[1]) >= 8 else 1
    problem["intrinsics"] = np.concatenate([known, fresh], axis=1)
    problem["lensmodel"] = lensmodel


def _judge(
    problem: dict[str, Any],
    x: NDArray[np.float64],
    corners: NDArray[np.float64],
    size: tuple[int, int],
) -> MrcalLens:
    found = np.isfinite(corners[..., 0])
    inlier = problem["observations_board"][..., 2] > 0
    residuals = _residuals(x, corners)
    residuals[~inlier] = np.nan
    square = residuals[inlier] ** 2
    free = square.size - solver.num_states(**problem)
    if free < 1:
        raise UserError("after outlier rejection too few corners are left: check the pictures")
    sigma = math.sqrt(float(square.sum()) / free)
    covariance = _covariance(problem, sigma)
    intrinsics = problem["intrinsics"][0]
    with np.errstate(invalid="ignore"):  # a variance below zero is refused as NaN
        check_focal(intrinsics, np.sqrt(np.diag(covariance)), 2)
    name = problem["lensmodel"]
    return MrcalLens(
        camera=CameraModel(
            "pinhole" if name == "LENSMODEL_PINHOLE" else name, intrinsics, size
        ),
        solution=solver.cameramodel(optimization_inputs=problem, icam_intrinsics=0),
        observed=corners,
        residuals=residuals,
        outliers=found & ~inlier,
        rms=math.sqrt(2 * float(square.mean())),
        sigma=sigma,
        covariance=covariance,
        bow=np.array(problem["calobject_warp"], float),
        camera_from_board=problem["rt_ref_frame"],
    )


def _residuals(x: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Board residuals (V, rows, columns, 2) of mrcal's measurement vector."""
    residuals = np.array(x[: corners.size], float).reshape(corners.shape)
    residuals[np.isnan(corners[..., 0])] = np.nan
    return residuals


def _covariance(problem: dict[str, Any], sigma: float) -> NDArray[np.float64]:
    """Of the intrinsics: sigma^2 (J'J)^-1; zero for those held fixed."""
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
    return covariance
