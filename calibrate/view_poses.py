"""Where the board stands in each view before a lens that is known, or guessed.

Poses come from rays (:func:`chromeball.calibrate.board_pose.board_poses`), which holds beyond
90 degrees; a plane allows two, of which the better one by pixels is taken.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, adjust, residuals
from chromeball.calibrate.board_pose import board_poses
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

#: Fewer corners in a view give no pose.
FEWEST_CORNERS = 6
#: The second pose of a board is a rival of the first up to so many times its error.
RIVAL = 5.0


def place_views(
    camera: CameraModel,
    corners: NDArray[np.float64],
    target: Target,
    bow: NDArray[np.float64] | None = None,
    pupil: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.intp], Estimate]:
    """Views (n,) of `corners` that have a pose before a known camera, and their poses.

    `bow` (2,) of the board and travel of the `pupil` (2,) are those of :class:`Estimate`.
    """
    none = np.zeros(2)
    start = Estimate(
        camera,
        none if bow is None else bow,
        np.zeros((0, 3, 3)),
        np.zeros((0, 3)),
        none if pupil is None else pupil,
    )
    return place(start, target.points(), corners, np.isfinite(corners[..., 0]), math.inf)


def pose_residuals(
    camera: CameraModel,
    corners: NDArray[np.float64],
    target: Target,
    bow: NDArray[np.float64] | None = None,
    pupil: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Residuals (V, rows, columns, 2) of views whose poses alone are fitted to a camera.

    Projected minus observed; NaN where there is no corner, or no pose.
    """
    placed, estimate = place_views(camera, corners, target, bow, pupil)
    errors = np.full(corners.shape, np.nan)
    errors[placed] = residuals(estimate, target.points(), corners[placed])
    return errors


def place(
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
    poses: list[list[Pose]] = []
    for view, (pixels, seen) in enumerate(zip(corners, found, strict=True)):
        rays = estimate.camera.unproject(pixels[seen])
        reached = np.isfinite(rays).all(axis=-1)
        points, rays = board[seen][reached], rays[reached]
        if len(rays) < FEWEST_CORNERS:
            continue
        candidates = board_poses(points, rays)
        if not candidates:
            continue
        misses = [_miss(pose.apply(points), rays) for pose in candidates]
        order = np.argsort(misses)
        likely = [candidates[i] for i in order if misses[i] <= min(misses) * RIVAL**2]
        placed.append(view)
        poses.append(likely if scale is not None else likely[:1])
    chosen = np.array(placed, np.intp)
    best = _at(estimate, [p[0] for p in poses])
    if scale is None:
        return chosen, best
    best, left = _refined(best, board, corners[chosen], found[chosen], scale)
    rivals = np.array([len(p) > 1 for p in poses], bool)
    if rivals.any():
        there = chosen[rivals]
        other = _at(estimate, [p[1] for p in poses if len(p) > 1])
        other, theirs = _refined(other, board, corners[there], found[there], scale)
        better = theirs < left[rivals]
        turn, shift = best.rotations.copy(), best.translations.copy()
        turn[np.flatnonzero(rivals)[better]] = other.rotations[better]
        shift[np.flatnonzero(rivals)[better]] = other.translations[better]
        best = replace(best, rotations=turn, translations=shift)
    return chosen, best


def _at(estimate: Estimate, poses: list[Pose]) -> Estimate:
    """The same lens before boards at `poses`."""
    rotations = np.array([p.rotation for p in poses]).reshape(-1, 3, 3)
    translations = np.array([p.translation for p in poses]).reshape(-1, 3)
    return replace(estimate, rotations=rotations, translations=translations)


def _miss(points: NDArray[np.float64], rays: NDArray[np.float64]) -> float:
    """Median distance between unit directions."""
    unit = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return float(np.median(((unit - rays) ** 2).sum(axis=-1)))


def _refined(
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    found: NDArray[np.bool_],
    scale: float,
) -> tuple[Estimate, NDArray[np.float64]]:
    """Poses fitted to their pixels, and what is left of each view: a robust sum of squares."""
    none = np.zeros(len(estimate.camera.intrinsics) + 4)
    # A pose that the lens cannot see is no rival, and must not keep the others from moving.
    seen = np.isfinite(residuals(estimate, board, corners)[..., 0])
    whole = (seen | ~found).all(axis=(1, 2))
    left = np.full(len(corners), math.inf)
    if whole.any():
        moved = adjust(
            estimate.views(whole),
            board,
            corners[whole],
            found[whole],
            free=none > 0,
            precision=none,
            scale=scale,
        )
        u, _, vt = np.linalg.svd(moved.rotations)  # rounding alone
        turn, shift = estimate.rotations.copy(), estimate.translations.copy()
        turn[whole], shift[whole] = u @ vt, moved.translations
        estimate = replace(estimate, rotations=turn, translations=shift)
        square = (residuals(estimate, board, corners)[whole] ** 2).sum(axis=-1)
        cost = square if math.isinf(scale) else np.log1p(square / scale**2)
        left[whole] = np.where(found[whole], cost, 0.0).sum(axis=(1, 2))
    return estimate, left


def cauchy_scale(error: NDArray[np.float64]) -> float:
    """Cauchy's scale, 2.4 deviations of a coordinate by the median distance."""
    median = float(np.nanmedian(distance(error)))
    return max(2.4 * median / math.sqrt(2 * math.log(2)), 1e-9)


def distance(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Length of residuals (..., 2)."""
    return np.hypot(error[..., 0], error[..., 1])
