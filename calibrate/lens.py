"""One lens from pictures of a target, solved by mrcal.

Intrinsics, board poses and the board's bow are estimated together with mrcal's outlier
rejection. No focal length is asked for: stereographic lenses of many fields of view are tried
as a start, with poses from rays turned to the axis. Sources: mrcal's documentation (Kogan), for
the models, the bow and the uncertainty of projection; Zhang 2000 for what pictures of a plane
determine.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mrcal
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.pose import start_poses
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

solver: Any = mrcal
MODELS = ("auto", "pinhole", "opencv4", "opencv5", "opencv8", "splined")
#: What `auto` chooses from.
CANDIDATES = ("opencv4", "opencv5", "opencv8")
OPENCV_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
#: Horizontal fields of view tried as a start, degrees.
FIELDS_OF_VIEW = (12, 20, 32, 48, 66, 90, 120, 150, 185)
FEWEST_VIEWS = 3
#: Boards must differ by this angle somewhere, else they do not determine a focal length.
LEAST_TILT = math.radians(5)
#: Relative standard error of the focal length beyond which a calibration is no calibration.
WORST_FOCAL = 0.05


@dataclass(frozen=True)
class Lens:
    """A calibrated lens with all that tells how good it is.

    V views of a board of R x C corners; pixels throughout, NaN where there is no corner.
    ``solution`` is mrcal's camera model with its optimisation inputs.
    ``observed`` (V, R, C, 2) and ``residuals`` (V, R, C, 2) projected minus observed, NaN for
    outliers; ``outliers`` (V, R, C). ``rms`` per point over inliers; ``sigma`` the estimated
    standard deviation of one coordinate of a corner, freed from the fitted unknowns.
    ``standard_errors`` of the intrinsics. ``bow`` (2,) the board's deflection, metres along x
    and y. ``camera_from_board`` (V, 6), rotation vector and translation.
    """

    camera: CameraModel
    solution: Any
    observed: NDArray[np.float64]
    residuals: NDArray[np.float64]
    outliers: NDArray[np.bool_]
    rms: float
    sigma: float
    standard_errors: NDArray[np.float64]
    bow: NDArray[np.float64]
    camera_from_board: NDArray[np.float64]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intrinsics."""
        count = len(self.camera.intrinsics)
        if self.camera.model.startswith("LENSMODEL_SPLINED"):
            return (*OPENCV_NAMES[:4], *(f"s{i}" for i in range(count - 4)))
        return OPENCV_NAMES[:count]

    @property
    def view_rms(self) -> NDArray[np.float64]:
        """RMS per point of each view over its inliers, (V,)."""
        square = (self.residuals**2).sum(axis=-1)
        return np.sqrt([np.nanmean(s) if np.isfinite(s).any() else np.nan for s in square])

    def field_of_view(self) -> tuple[float, float]:
        """2 atan(w / 2 f) across and down, radians (seeds A1): what an undistorted picture of
        this size and focal length shows.
        """  # noqa: D205
        (width, height), (fx, fy) = self.camera.size, self.camera.intrinsics[:2]
        return 2 * math.atan(width / (2 * fx)), 2 * math.atan(height / (2 * fy))

    def true_field_of_view(self) -> tuple[float, float]:
        """Angle between the rays through the middles of opposite edges, across and down,
        radians; distortion included. NaN where the model does not reach the edge.
        """  # noqa: D205
        (width, height), (cx, cy) = self.camera.size, self.camera.intrinsics[2:4]
        ends = np.array([[[-0.5, cy], [width - 0.5, cy]], [[cx, -0.5], [cx, height - 0.5]]])
        rays = self._rays(ends)
        # Each half to the axis, so that more than 180 degrees come out right.
        halves = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        across, down = halves.sum(axis=1)
        return float(across), float(down)

    def coverage(self) -> float:
        """Share of the picture inside the convex hull of all corners."""
        import cv2

        return float(cv2.contourArea(self.hull()) / (self.camera.size[0] * self.camera.size[1]))

    def hull(self) -> NDArray[np.float32]:
        """Convex hull of the corners that were used, (N, 2)."""
        import cv2

        seen = self.observed[np.isfinite(self.residuals[..., 0])]
        return np.asarray(cv2.convexHull(seen.astype(np.float32)), np.float32).reshape(-1, 2)

    def tilt(self) -> float:
        """Largest angle between two boards, radians."""
        return _largest_tilt(self.camera_from_board)

    def uncertainty(self, columns: int = 30) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Standard deviation of projection at infinity in the worst direction, pixels.

        Returns pixels (h, `columns`, 2) over the picture and values (h, `columns`).
        It is the error from corner noise alone; what the model cannot express is not in it.
        NaN where the model does not reach.
        """
        width, height = self.camera.size
        rows = max(2, round(columns * height / width))
        x, y = np.meshgrid(np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows))
        pixels = np.stack([x, y], axis=-1)
        values = solver.projection_uncertainty(
            np.ascontiguousarray(self._rays(pixels)),
            self.solution,
            atinfinity=True,
            what="worstdirection-stdev",
            observed_pixel_uncertainty=self.sigma,
        )
        return pixels, np.asarray(values, float)

    def figures(self) -> dict[str, Any]:
        """Figures of quality for the record."""
        pixels, uncertainty = self.uncertainty()
        hull = self.hull()
        import cv2

        inside = np.array(
            [
                cv2.pointPolygonTest(hull, (x, y), False) >= 0
                for x, y in pixels.reshape(-1, 2).tolist()
            ]
        ).reshape(uncertainty.shape)
        return {
            "rms": self.rms,
            "sigma": self.sigma,
            "corners": int(np.isfinite(self.observed[..., 0]).sum()),
            "outliers": int(self.outliers.sum()),
            "intrinsics": dict(zip(self.names, self.camera.intrinsics, strict=True)),
            "standard_errors": dict(zip(self.names, self.standard_errors, strict=True)),
            "bow_metres": self.bow,
            "fov_degrees": np.degrees(self.field_of_view()),
            "true_fov_degrees": np.degrees(self.true_field_of_view()),
            "coverage": self.coverage(),
            "tilt_degrees": math.degrees(self.tilt()),
            "uncertainty_median": _finite(np.nanmedian, uncertainty),
            "uncertainty_covered": _finite(np.nanmax, uncertainty[inside]),
            "uncertainty_unreached": float(np.isnan(uncertainty).mean()),
        }

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write mrcal's ``.cameramodel`` with its optimisation inputs to a temporary path."""
        self.solution.write(os.fspath(path), note=f"RMS {self.rms:.4f} px per point")

    def _rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit rays, NaN where they do not project back: there the lens model folds."""
        rays = self.camera.unproject(pixels)
        with np.errstate(invalid="ignore"):
            miss = np.linalg.norm(self.camera.project(rays) - pixels, axis=-1)
            rays[~(miss < 0.1)] = np.nan
        return rays


def calibrate_lens(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    model: str = "opencv8",
    paths: Sequence[str] | None = None,
) -> Lens:
    """Estimate a lens from `corners` (V, rows, columns, 2), NaN where missing.

    `size` is the pictures' width and height; `paths` are kept in the solution for mrcal's
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
    problem = _start(corners, target.square, size)
    if paths is not None:
        problem["imagepaths"] = np.array(paths)
    if _largest_tilt(problem["rt_ref_frame"]) < LEAST_TILT:
        raise UserError(
            "the board is parallel to itself in all pictures, which leaves the focal length "
            "open: tilt it by 20 to 45 degrees in different directions"
        )
    unknowns = solver.lensmodel_num_params(_lensmodel(model, problem)) + 6 * len(corners) + 2
    measured = 2 * int(np.isfinite(corners[..., 0]).sum())
    if measured < 2 * unknowns:
        raise UserError(
            f"{measured // 2} corners are too few for {model} with {unknowns} unknowns: "
            "take more pictures or choose a simpler model"
        )
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


def choose_model(
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    progress: Callable[[str, float], object] | None = None,
) -> tuple[str, dict[str, float]]:
    """The model of :data:`CANDIDATES` with the least held-out error, and all their errors."""
    errors: dict[str, float] = {}
    for model in CANDIDATES:
        errors[model] = held_out_error(corners, target, size, model)
        if progress is not None:
            progress(model, errors[model])
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
    """RMS per point of views (V, rows, columns, 2) whose poses alone are fitted, (V,)."""
    frames = _board_poses(lens.camera, corners, target.square)
    if frames is None:
        return np.full(len(corners), np.inf)
    problem = _problem(corners, target.square, lens.camera.size, frames)
    problem |= {
        "lensmodel": lens.camera.model,
        "intrinsics": lens.camera.intrinsics[None].copy(),
        "calobject_warp": lens.bow.copy(),
        "do_optimize_intrinsics_core": False,
        "do_optimize_intrinsics_distortions": False,
    }
    if lens.camera.model == "pinhole":
        problem["lensmodel"] = "LENSMODEL_PINHOLE"
    x = solver.optimize(**problem)["x"]
    residuals = _residuals(x, corners)
    return np.sqrt(np.nanmean((residuals**2).sum(axis=-1), axis=(1, 2)))


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
) -> Lens:
    found = np.isfinite(corners[..., 0])
    inlier = problem["observations_board"][..., 2] > 0
    residuals = _residuals(x, corners)
    residuals[~inlier] = np.nan
    square = residuals[inlier] ** 2
    free = square.size - solver.num_states(**problem)
    if free < 1:
        raise UserError("after outlier rejection too few corners are left: check the pictures")
    sigma = math.sqrt(float(square.sum()) / free)
    errors = _standard_errors(problem, sigma)
    intrinsics = problem["intrinsics"][0]
    focal = float(np.max(errors[:2] / np.abs(intrinsics[:2])))
    if not focal < WORST_FOCAL or intrinsics[:2].min() <= 0:
        raise UserError(
            f"these pictures leave the focal length open (standard error {focal:.0%}): tilt "
            "the board by 20 to 45 degrees in different directions and fill the picture with it"
        )
    name = problem["lensmodel"]
    return Lens(
        camera=CameraModel(
            "pinhole" if name == "LENSMODEL_PINHOLE" else name, intrinsics, size
        ),
        solution=solver.cameramodel(optimization_inputs=problem, icam_intrinsics=0),
        observed=corners,
        residuals=residuals,
        outliers=found & ~inlier,
        rms=math.sqrt(2 * float(square.mean())),
        sigma=sigma,
        standard_errors=errors,
        bow=np.array(problem["calobject_warp"], float),
        camera_from_board=problem["rt_ref_frame"],
    )


def _residuals(x: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Board residuals (V, rows, columns, 2) of mrcal's measurement vector."""
    residuals = np.array(x[: corners.size], float).reshape(corners.shape)
    residuals[np.isnan(corners[..., 0])] = np.nan
    return residuals


def _standard_errors(problem: dict[str, Any], sigma: float) -> NDArray[np.float64]:
    """Of the intrinsics: sigma sqrt diag (J'J)^-1; zero for those held fixed."""
    states = solver.num_states(**problem)
    count = problem["intrinsics"].shape[1]
    free = solver.num_states_intrinsics(**problem)
    _, _, _, factorization = solver.optimizer_callback(**problem)
    if factorization is None:
        raise UserError("these pictures do not determine the lens: take more, tilted, views")
    first = solver.state_index_intrinsics(0, **problem)
    rows = np.zeros((free, states))
    rows[np.arange(free), first + np.arange(free)] = 1
    covariance = factorization.solve_xt_JtJ_bt(rows)[:, first : first + free]
    scale = np.ones(states)
    solver.unpack_state(scale, **problem)
    errors = np.zeros(count)
    errors[count - free :] = sigma * np.sqrt(np.diag(covariance)) * scale[first : first + free]
    return errors


def _largest_tilt(frames: NDArray[np.float64]) -> float:
    normals = np.array([solver.R_from_r(rt[:3])[:, 2] for rt in frames])
    return float(np.arccos(np.clip(normals @ normals.T, -1, 1)).max())


def _finite(
    statistic: Callable[[NDArray[np.float64]], Any], values: NDArray[np.float64]
) -> float:
    return float(statistic(values)) if np.isfinite(values).any() else math.nan


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
