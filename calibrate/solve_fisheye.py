"""Fisheye lenses by our own least squares: Kannala and Brandt 2006, and the classic ones.

The start needs no focal length: lenses of many fields of view are tried, each board posed by
its rays turned to the axis (:func:`chromeball.calibrate.pose.start_poses`), which holds beyond
90 degrees. Then everything is estimated together, the board's bow included: with Cauchy's
weights first, then by least squares on the corners that fit.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, adjust, covariance, residuals
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
from chromeball.scene.pose import Pose

MODELS = ("kb4", "equidistant", "equisolid", "stereographic")
NAMES = {"kb4": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")}
#: Fields of view across the longer side tried as a start, degrees.
FIELDS_OF_VIEW = (20, 40, 60, 80, 100, 125, 150, 180, 215, 255, 300)
#: Weak knowledge: deviations of k1 ... k4, and of the bow in widths of the board.
K_DEVIATION = 1.0
BOW_DEVIATION = 0.05
#: A corner farther off than this many deviations of a coordinate is no corner.
OUTLIER = 4.0
#: A view of which fewer corners than this share fit was misread, and counts for nothing.
LEAST_SHARE = 0.4
FEWEST_CORNERS = 6
#: The second pose of a board is a rival of the first up to so many times its error.
RIVAL = 5.0
UNEXPLAINED = "no lens explains where the corners lie: is the board's size right?"


@dataclass(frozen=True)
class FisheyeLens(Lens):
    """A lens by our own solver; ``condition`` is that of its normal equations."""

    condition: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intrinsics."""
        return NAMES.get(self.camera.model, ("f", "cx", "cy"))

    def figures(self) -> dict[str, Any]:
        """Figures of quality for the record."""
        return super().figures() | {"condition": self.condition}

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the ``.cameramodel``."""
        self.camera.write(path)

    def pose_residuals(
        self, corners: NDArray[np.float64], target: Target
    ) -> NDArray[np.float64]:
        """Residuals (V, rows, columns, 2) of views whose poses alone are fitted."""
        board, found = target.points(), np.isfinite(corners[..., 0])
        start = Estimate(self.camera, self.bow, np.zeros((0, 3, 3)), np.zeros((0, 3)))
        placed, estimate = _place(start, board, corners, found, math.inf)
        errors = np.full(corners.shape, np.nan)
        errors[placed] = residuals(estimate, board, corners[placed])
        return errors


def solve_fisheye(
    corners: NDArray[np.float64], target: Target, size: tuple[int, int], model: str
) -> FisheyeLens:
    """Estimate one of :data:`MODELS` from `corners` (V, rows, columns, 2), NaN where missing.

    Raises
    ------
    UserError
        When no such lens explains the corners, or they leave it undetermined.

    """
    check_count(corners, model, 8 if model == "kb4" else 3)
    board, found = target.points(), np.isfinite(corners[..., 0])
    placed, estimate = _start(board, corners, found, size, model)
    count = len(estimate.camera.intrinsics)
    core = np.arange(count + 2) < (4 if model == "kb4" else 3)
    lens = np.arange(count + 2) < count
    for free in (core, lens, np.ones(count + 2, bool)):
        if free is lens and model != "kb4":
            continue
        estimate = _robust(estimate, board, corners[placed], found[placed], free)
    # Boards that had no pose, or the wrong one of two, get theirs from the lens as it is now.
    scale = _scale(residuals(estimate, board, corners[placed]))
    placed, estimate = _place(estimate, board, corners, found, scale)
    if len(placed) < 3:
        raise UserError(UNEXPLAINED)
    free = np.ones(count + 2, bool)
    estimate = _robust(estimate, board, corners[placed], found[placed], free)
    placed, estimate, used = _settle(placed, estimate, board, corners, found)
    return _judge(placed, estimate, board, corners, used)


# ---- stages of the solution


def _start(
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    found: NDArray[np.bool_],
    size: tuple[int, int],
    model: str,
) -> tuple[NDArray[np.intp], Estimate]:
    """The views that have a pose, and the best lens over the fields of view.

    Lenses are judged by the median distance over all corners: those of a view without a pose
    count as infinitely far.
    """
    best: tuple[NDArray[np.intp], Estimate] | None = None
    least = math.inf
    for degrees in FIELDS_OF_VIEW:
        camera = _candidate(model, size, math.radians(degrees))
        if camera is None:
            continue
        start = Estimate(camera, np.zeros(2), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        placed, estimate = _place(start, board, corners, found, None)
        if len(placed) < 3:
            continue
        free = np.arange(len(camera.intrinsics) + 2) < (4 if model == "kb4" else 3)
        estimate = _robust(estimate, board, corners[placed], found[placed], free, rounds=2)
        distance = np.full(found.shape, math.inf)
        distance[placed] = _distance(residuals(estimate, board, corners[placed]))
        error = float(np.median(distance[found]))
        if error < least:
            best, least = (placed, estimate), error
    if best is None:
        raise UserError(UNEXPLAINED)
    return best


def _candidate(model: str, size: tuple[int, int], fov: float) -> CameraModel | None:
    """A lens of which the picture's longer side shows `fov` radians."""
    name = "equidistant" if model == "kb4" else model
    camera = CameraModel.fisheye(name, size, fov, radius=max(size) / 2)
    f, cx, cy = camera.intrinsics
    if model != "kb4":
        return replace(camera, max_angle=math.pi)
    return CameraModel("kb4", np.array([f, f, cx, cy, 0, 0, 0, 0]), size)


def _place(
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    found: NDArray[np.bool_],
    scale: float | None,
) -> tuple[NDArray[np.intp], Estimate]:
    """Views that have a pose, and their poses by their rays through the lens as it is.

    Of the two poses that a plane allows the better one is taken: by rays, or with a `scale` of
    Cauchy's by pixels, refined.
    """
    placed: list[int] = []
    poses: list[Pose] = []
    for view, (pixels, seen) in enumerate(zip(corners, found, strict=True)):
        rays = estimate.camera.unproject(pixels[seen])
        reached = np.isfinite(rays).all(axis=-1)
        points, rays = board[seen][reached], rays[reached]
        if len(rays) < FEWEST_CORNERS:
            continue
        candidates = start_poses(points, rays)
        if not candidates:
            continue
        placed.append(view)
        misses = [_miss(pose.apply(points), rays) for pose in candidates]
        if scale is not None:
            likely = min(misses) * RIVAL**2
            candidates = [p for p, m in zip(candidates, misses, strict=True) if m <= likely]
            refined = [_refined(estimate, p, board, pixels, seen, scale) for p in candidates]
            candidates, misses = [p for p, _ in refined], [m for _, m in refined]
        poses.append(candidates[int(np.argmin(misses))])
    rotations = np.array([p.rotation for p in poses]).reshape(-1, 3, 3)
    translations = np.array([p.translation for p in poses]).reshape(-1, 3)
    return np.array(placed, np.intp), replace(
        estimate, rotations=rotations, translations=translations
    )


def _miss(points: NDArray[np.float64], rays: NDArray[np.float64]) -> float:
    """Median distance between unit directions."""
    unit = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return float(np.median(((unit - rays) ** 2).sum(axis=-1)))


def _refined(
    estimate: Estimate,
    pose: Pose,
    board: NDArray[np.float64],
    pixels: NDArray[np.float64],
    seen: NDArray[np.bool_],
    scale: float,
) -> tuple[Pose, float]:
    """One view's pose fitted to its pixels, and what is left: a robust sum of squares."""
    one = replace(estimate, rotations=pose.rotation[None], translations=pose.translation[None])
    none = np.zeros(len(estimate.camera.intrinsics) + 2)
    one = adjust(
        one, board, pixels[None], seen[None], free=none > 0, precision=none, scale=scale
    )
    square = (residuals(one, board, pixels[None])[0][seen] ** 2).sum(axis=-1)
    left = square if math.isinf(scale) else np.log1p(square / scale**2)
    u, _, vt = np.linalg.svd(one.rotations[0])  # rounding alone
    # A pose that the lens cannot see is no rival.
    return Pose(u @ vt, one.translations[0]), float(np.nan_to_num(left, nan=math.inf).sum())


def _robust(
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
    free: NDArray[np.bool_],
    rounds: int = 4,
) -> Estimate:
    """Cauchy's estimate, its scale renewed from the residuals."""
    for _ in range(rounds):
        scale = _scale(residuals(estimate, board, corners))
        estimate = adjust(
            estimate,
            board,
            corners,
            used,
            free=free,
            precision=_precision(estimate.camera, board, scale),
            scale=scale,
            steps=12,
            least_gain=1e-4,  # the scale is a rough one, too
        )
    return estimate


def _settle(
    placed: NDArray[np.intp],
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> tuple[NDArray[np.intp], Estimate, NDArray[np.bool_]]:
    """Least squares on the corners that fit, until they stay the same; views that do not fit
    go. Returns the views left, the estimate and the corners used, (views left, rows, columns).
    """  # noqa: D205
    used = np.zeros(found[placed].shape, bool)
    sigma = 0.0
    for turn in range(10):
        error = _distance(residuals(estimate, board, corners[placed]))
        if turn == 0:
            sigma = float(np.nanmedian(error)) / math.sqrt(2 * math.log(2))
        fits = found[placed] & (error < OUTLIER * sigma)
        counts = fits.sum(axis=(1, 2))
        keep = (counts >= FEWEST_CORNERS) & (
            counts >= LEAST_SHARE * found[placed].sum(axis=(1, 2))
        )
        if keep.all() and fits.shape == used.shape and (fits == used).all():
            break
        placed, estimate, used = placed[keep], estimate.views(keep), fits[keep]
        if len(placed) < 3:
            raise UserError(
                f"the boards of only {len(placed)} pictures fit one lens: look for misread "
                "boards, or choose another model"
            )
        estimate = adjust(
            estimate,
            board,
            corners[placed],
            used,
            free=np.ones(len(estimate.camera.intrinsics) + 2, bool),
            precision=_precision(estimate.camera, board, sigma),
        )
        error = residuals(estimate, board, corners[placed])[used]
        sigma = _sigma(error, estimate)
    return placed, estimate, used


def _judge(
    placed: NDArray[np.intp],
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    used: NDArray[np.bool_],
) -> FisheyeLens:
    from scipy.spatial.transform import Rotation

    frames = np.concatenate(
        [Rotation.from_matrix(estimate.rotations).as_rotvec(), estimate.translations], axis=1
    )
    if largest_tilt(frames) < LEAST_TILT:
        raise UserError(PARALLEL)
    error = residuals(estimate, board, corners[placed])
    sigma = _sigma(error[used], estimate)
    spread, condition = covariance(
        estimate, board, corners[placed], used, _precision(estimate.camera, board, sigma)
    )
    count = len(estimate.camera.intrinsics)
    spread = sigma**2 * spread[:count, :count]
    check_focal(estimate.camera.intrinsics, np.sqrt(np.diag(spread)), 2 if count > 3 else 1)
    left = np.full(corners.shape, np.nan)
    left[placed] = np.where(used[..., None], error, np.nan)
    poses = np.full((len(corners), 6), np.nan)
    poses[placed] = frames
    return FisheyeLens(
        camera=_bounded(estimate.camera),
        observed=corners,
        residuals=left,
        outliers=np.isfinite(corners[..., 0]) & np.isnan(left[..., 0]),
        rms=math.sqrt(float((error[used] ** 2).sum(axis=-1).mean())),
        sigma=sigma,
        covariance=spread,
        bow=estimate.bow,
        camera_from_board=poses,
        condition=condition,
    )


def _bounded(camera: CameraModel) -> CameraModel:
    """The lens up to the angle where its radius stops to grow, as no real lens's does."""
    if camera.model != "kb4":
        return camera
    theta = np.linspace(0, math.pi, 2000)
    slope = 1 + sum(
        (2 * i + 3) * k * theta ** (2 * i + 2) for i, k in enumerate(camera.intrinsics[4:])
    )
    falls = np.flatnonzero(np.asarray(slope) <= 0)
    limit = float(theta[falls[0] - 1]) if len(falls) else math.pi
    return replace(camera, max_angle=limit)


def _precision(
    camera: CameraModel, board: NDArray[np.float64], sigma: float
) -> NDArray[np.float64]:
    """Inverse variances of weak knowledge, times sigma squared, (k + 2,)."""
    count = len(camera.intrinsics)
    width = float(np.ptp(board[..., :2], axis=(0, 1)).max())
    known = np.zeros(count + 2)
    known[4:count] = (sigma / K_DEVIATION) ** 2
    known[count:] = (sigma / (BOW_DEVIATION * width)) ** 2
    return known


def _sigma(error: NDArray[np.float64], estimate: Estimate) -> float:
    """Deviation of a coordinate from residuals (N, 2), freed from the fitted unknowns."""
    unknowns = len(estimate.camera.intrinsics) + 2 + 6 * len(estimate.rotations)
    if error.size <= unknowns:
        raise UserError("after outlier rejection too few corners are left: check the pictures")
    return max(math.sqrt(float((error**2).sum()) / (error.size - unknowns)), 1e-9)


def _scale(error: NDArray[np.float64]) -> float:
    """Cauchy's scale, 2.4 deviations of a coordinate by the median distance."""
    median = float(np.nanmedian(_distance(error)))
    return max(2.4 * median / math.sqrt(2 * math.log(2)), 1e-9)


def _distance(error: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.hypot(error[..., 0], error[..., 1])
