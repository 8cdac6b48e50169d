"""The lens of each camera of a rig by itself, to begin with and to compare with.

No focal length is asked for: lenses of many fields of view are tried on a few boards, the best
two fitted as Kannala and Brandt's (2006), the best of these turned into the model that is
wanted, and all fitted with Cauchy's weights. The joint solution has the last word.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, adjust, camera_points, covariance, residuals
from chromeball.calibrate.choose import choose_model
from chromeball.calibrate.convert import converted
from chromeball.calibrate.lens import FEWEST_VIEWS, OPENCV
from chromeball.calibrate.lens_result import LEAST_TILT, PARALLEL, check_focal
from chromeball.calibrate.rig_solve import (
    BOW_DEVIATION,
    CAUCHY,
    FEWEST_CORNERS,
    K_DEVIATION,
    OUTLIER,
)
from chromeball.calibrate.rig_start import place_boards
from chromeball.calibrate.solve import FISHEYES, UNEXPLAINED
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: A splined lens has too many unknowns for a start from few boards: it can be given.
MODELS = ("auto", "pinhole", *OPENCV, *FISHEYES)
#: Fields of view across the longer side tried as a start, degrees.
FIELDS_OF_VIEW = (25, 45, 70, 100, 140, 185, 230, 290)
#: Views that the search and the fit need; they are taken evenly from the session.
SEARCH_VIEWS, FIT_VIEWS = 6, 24

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
    fitted = _evenly(views, FIT_VIEWS)
    chosen = corners[fitted]
    if model == "auto":
        model = choose_model(chosen, target, size).model
    board = target.points()
    rough = _search(corners[_evenly(views, SEARCH_VIEWS)], board, size)
    camera = rough.camera
    if model != "kb4":
        points = camera_points(rough, board).reshape(-1, 3)
        rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
        name = f"LENSMODEL_{model.upper()}" if model in OPENCV else model
        camera, _ = converted(camera, name, rays)
    poses, saw = place_boards(camera, board, chosen)
    if saw.sum() < FEWEST_VIEWS:
        raise UserError(UNEXPLAINED)
    normals = poses[saw, :3, 2]
    if np.arccos(np.clip(normals @ normals.T, -1, 1)).max() < LEAST_TILT:
        raise UserError(PARALLEL)
    start = Estimate(camera, np.zeros(2), poses[saw, :3, :3], poses[saw, :3, 3])
    unknown = np.arange(len(camera.intrinsics) + 4) < len(camera.intrinsics) + 2
    estimate = _fit(start, board, chosen[saw], unknown, rounds=2)
    error = residuals(estimate, board, chosen[saw])
    sigma = _sigma(error, int(unknown.sum() + 6 * saw.sum()))
    used = np.hypot(error[..., 0], error[..., 1]) < OUTLIER * sigma
    k = len(camera.intrinsics)
    known, _ = covariance(
        estimate, board, chosen[saw], used, _precision(k, board, sigma), unknown
    )
    spread = sigma**2 * known[:k, :k]
    check_focal(estimate.camera.intrinsics, np.sqrt(np.diag(spread)), 2 if k > 3 else 1)
    if len(fitted) < len(views):
        return replace(place_alone(corners, target, estimate.camera), covariance=spread)
    saw_all, poses_all = np.zeros(len(corners), bool), np.tile(np.eye(4), (len(corners), 1, 1))
    saw_all[fitted[saw]] = True
    poses_all[fitted[saw], :3, :3] = estimate.rotations
    poses_all[fitted[saw], :3, 3] = estimate.translations
    return Alone(estimate.camera, poses_all, saw_all, sigma, spread)


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


# ---- stages


def _evenly(views: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    if len(views) <= count:
        return views
    return views[np.linspace(0, len(views) - 1, count).round().astype(int)]


@dataclass(frozen=True)
class _Tried:
    """A lens before those views that it ``seen`` (V,) has poses for."""

    estimate: Estimate
    seen: NDArray[np.bool_]


def _search(corners: Corners, board: Corners, size: tuple[int, int]) -> Estimate:
    """A lens of Kannala and Brandt's from fields of view tried on a few boards."""
    tried: list[tuple[float, _Tried]] = []
    for degrees in FIELDS_OF_VIEW:
        fisheye = CameraModel.fisheye(
            "equidistant", size, math.radians(degrees), radius=max(size) / 2
        )
        f, cx, cy = fisheye.intrinsics
        camera = CameraModel("kb4", np.array([f, f, cx, cy, 0, 0, 0, 0]), size)
        poses, saw = place_boards(camera, board, corners, refine=False)
        if saw.sum() < min(len(corners), FEWEST_VIEWS):
            continue
        start = Estimate(camera, np.zeros(2), poses[saw, :3, :3], poses[saw, :3, 3])
        tried.append((_median(start, board, corners, saw), _Tried(start, saw)))
    if not tried:
        raise UserError(UNEXPLAINED)
    tried.sort(key=lambda pair: pair[0])
    core, least = np.arange(12) < 4, math.inf
    best = tried[0][1]
    for _, candidate in tried[:2]:
        saw = candidate.seen
        estimate = _fit(candidate.estimate, board, corners[saw], core, rounds=1)
        miss = _median(estimate, board, corners, saw)
        if miss < least:
            best, least = _Tried(estimate, saw), miss
    return _fit(best.estimate, board, corners[best.seen], np.arange(12) < 10, rounds=2)


def _fit(
    estimate: Estimate,
    board: Corners,
    corners: Corners,
    free: NDArray[np.bool_],
    rounds: int = 3,
) -> Estimate:
    """Cauchy's estimate, its scale renewed from the residuals."""
    for _ in range(rounds):
        distance = _distance(estimate, board, corners)
        found, sigma = np.isfinite(distance), float(np.nanmedian(distance))
        sigma = max(sigma / math.sqrt(2 * math.log(2)), 1e-6)
        known = _precision(len(free) - 4, board, sigma)
        estimate = adjust(
            estimate, board, corners, found,
            free=free, precision=known, scale=CAUCHY * sigma, steps=12, least_gain=1e-4,
        )  # fmt: skip
    return estimate


def _precision(intrinsics: int, board: Corners, sigma: float) -> Corners:
    """Inverse variances of weak knowledge, times sigma squared, (intrinsics + 4,)."""
    known = np.zeros(intrinsics + 4)
    known[4:intrinsics] = (sigma / K_DEVIATION) ** 2
    width = float(np.ptp(board[..., :2], axis=(0, 1)).max())
    known[intrinsics : intrinsics + 2] = (sigma / (BOW_DEVIATION * width)) ** 2
    return known


def _sigma(error: Corners, unknowns: int) -> float:
    """Deviation of a coordinate by the residuals (V, rows, columns, 2) that fit."""
    distance = np.hypot(error[..., 0], error[..., 1])
    sigma = float(np.nanmedian(distance)) / math.sqrt(2 * math.log(2))
    for _ in range(6):
        used = distance < OUTLIER * sigma
        free = max(2 * int(used.sum()) - int(unknowns), 1)
        sigma = math.sqrt(float((error[used] ** 2).sum()) / free)
    return max(sigma, 1e-9)


def _median(
    estimate: Estimate, board: Corners, corners: Corners, seen: NDArray[np.bool_]
) -> float:
    """Median distance over all corners; those of a view without a pose are infinitely far."""
    miss = np.full(corners.shape[:3], math.inf)
    miss[seen] = _distance(estimate, board, corners[seen])
    return float(np.median(miss[np.isfinite(corners[..., 0])]))


def _distance(estimate: Estimate, board: Corners, corners: Corners) -> Corners:
    error = residuals(estimate, board, corners)
    length = np.hypot(error[..., 0], error[..., 1])
    return np.where(np.isfinite(corners[..., 0]) & np.isnan(length), math.inf, length)
