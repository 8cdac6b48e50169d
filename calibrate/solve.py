"""One lens of any model by our own least squares; no focal length is asked for.

Lenses of many fields of view are tried as a start, each board posed by its rays turned to the
axis (:func:`chromeball.calibrate.board_pose.board_poses`), which holds beyond 90 degrees. The
start is Kannala and Brandt's lens (2006), which bends to any other; the model asked for begins
as the nearest to it. Everything is estimated together, the board's bow included: with Cauchy's
weights first, then by least squares on the corners that fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import (
    Estimate,
    adjust,
    camera_points,
    covariance,
    residuals,
)
from chromeball.calibrate.board_pose import board_poses
from chromeball.calibrate.convert import converted, parameters
from chromeball.calibrate.lens_result import (
    LEAST_TILT,
    PARALLEL,
    Lens,
    check_focal,
    largest_tilt,
)
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

FISHEYES = ("kb4", "kb4_decentred", "equidistant", "equisolid", "stereographic")
#: Fields of view across the longer side tried as a start, degrees.
FIELDS_OF_VIEW = (12, 20, 40, 60, 80, 100, 125, 150, 180, 215, 255, 300)
#: So many of these are bent to the corners.
MOST_LIKELY = 4
#: So many views, spread over the pictures, find the start.
START_VIEWS = 24
#: And so many of those the field of view.
SEARCH_VIEWS = 8
#: Weak knowledge: deviations of distortion terms; of the bow in widths of the board.
K_DEVIATION = 1.0
BOW_DEVIATION = 0.05
#: Of the pupil's travel, metres.
PUPIL_DEVIATION = 0.02
#: It must lower the cost by this share, and by so many squared deviations of a corner.
PUPIL_SHARE, PUPIL_SQUARES = 0.03, 30.0
#: A corner farther off than this many deviations of a coordinate is no corner.
OUTLIER = 4.0
#: A view of which fewer corners than this share fit was misread, and counts for nothing.
LEAST_SHARE = 0.4
FEWEST_CORNERS = 6
#: Unknowns of the start: focal lengths and centre; the lens; lens and bow.
CORE, LENS, BOWED = (np.arange(12) < count for count in (4, 8, 10))
#: The second pose of a board is a rival of the first up to so many times its error.
RIVAL = 5.0
UNEXPLAINED = "no lens explains where the corners lie: is the board's size right?"


@dataclass(frozen=True)
class Fit:
    """A lens fitted to corners (V, rows, columns, 2).

    ``placed`` (n,) are the views that have a pose, ``estimate`` the lens before those, ``used``
    (n, rows, columns) the corners that count, ``scale`` Cauchy's for their residuals, pixels.
    """

    placed: NDArray[np.intp]
    estimate: Estimate
    used: NDArray[np.bool_]
    scale: float

    def rays(self, board: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit directions to the corners that count, (N, 3)."""
        points = camera_points(self.estimate, board)[self.used]
        return points / np.linalg.norm(points, axis=-1, keepdims=True)


def fit_start(corners: NDArray[np.float64], target: Target, size: tuple[int, int]) -> Fit:
    """A lens of model kb4 that explains `corners` (V, rows, columns, 2), NaN where missing.

    Raises
    ------
    UserError
        When no lens does.

    """
    board, found = target.points(), np.isfinite(corners[..., 0])
    few, first = (_spread(len(corners), n) for n in (START_VIEWS, SEARCH_VIEWS))
    estimate = _start(board, corners[first], found[first], size)
    placed, estimate = _place(estimate, board, corners[few], found[few], None)
    placed = few[placed]
    if len(placed) < 3:
        raise UserError(UNEXPLAINED)
    for free in (CORE, LENS, BOWED):
        estimate = _robust(estimate, board, corners[placed], found[placed], free)
    # Boards that had no pose, or the wrong one of two, get theirs from the lens as it is now.
    scale = _scale(residuals(estimate, board, corners[placed]))
    placed, estimate = _place(estimate, board, corners, found, scale)
    if len(placed) < 3:
        raise UserError(UNEXPLAINED)
    estimate = _robust(estimate, board, corners[placed], found[placed], BOWED)
    error = residuals(estimate, board, corners[placed])
    scale = _scale(error)
    return Fit(placed, estimate, found[placed] & (_distance(error) < 3 * scale), scale)


def fit_model(
    start: Fit,
    corners: NDArray[np.float64],
    target: Target,
    model: str,
    *,
    travel: bool = True,
) -> Fit:
    """The lens of `model`, a :class:`CameraModel`'s, that explains the corners best.

    `start` may be of the same corners or of others of the same lens. Without `travel` the
    entrance pupil of a kb4 stands still, too.

    Raises
    ------
    UserError
        When no such lens does.

    """
    board, found = target.points(), np.isfinite(corners[..., 0])
    estimate = start.estimate
    if model != estimate.camera.model:
        camera, _ = converted(estimate.camera, model, start.rays(board))
        estimate = replace(estimate, camera=camera)
    placed, estimate = _place(estimate, board, corners, found, start.scale)
    if len(placed) < 3:
        raise UserError(UNEXPLAINED)
    estimate = replace(estimate, pupil=np.zeros(2))
    still = np.arange(parameters(model) + 4) < parameters(model) + 2
    estimate = _robust(estimate, board, corners[placed], found[placed], still)
    # A lens of one parameter would bend by the pupil what it cannot bend itself.
    if travel and model.startswith("kb4"):
        moving = _robust(estimate, board, corners[placed], found[placed], still | True)
        if _earned(estimate, moving, board, corners[placed]):
            return _settle(placed, moving, board, corners, found, still | True)
    return _settle(placed, estimate, board, corners, found, still)


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
    return _place(start, target.points(), corners, np.isfinite(corners[..., 0]), math.inf)


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


# ---- stages of the solution


def _spread(views: int, most: int) -> NDArray[np.intp]:
    """At most so many of the views, evenly."""
    return np.unique(np.linspace(0, views - 1, most).round().astype(np.intp))


def _start(
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    found: NDArray[np.bool_],
    size: tuple[int, int],
) -> Estimate:
    """The best lens over the fields of view.

    Lenses are judged by the median distance over all corners: those of a view without a pose
    count as infinitely far.
    """

    def median(estimate: Estimate, placed: NDArray[np.intp]) -> float:
        distance = np.full(found.shape, math.inf)
        distance[placed] = _distance(residuals(estimate, board, corners[placed]))
        return float(np.median(distance[found]))

    tried: list[tuple[float, NDArray[np.intp], Estimate]] = []
    for degrees in FIELDS_OF_VIEW:
        f = max(size) / math.radians(degrees)
        core = np.array([f, f, (size[0] - 1) / 2, (size[1] - 1) / 2, 0, 0, 0, 0])
        camera = CameraModel("kb4", core, size)
        start = Estimate(camera, np.zeros(2), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        placed, estimate = _place(start, board, corners, found, None)
        if len(placed) >= 3:
            tried.append((median(estimate, placed), placed, estimate))
    if not tried:
        raise UserError(UNEXPLAINED)
    tried.sort(key=lambda lens: lens[0])
    bent: list[tuple[float, Estimate]] = []
    for _, placed, start in tried[:MOST_LIKELY]:
        estimate = _robust(start, board, corners[placed], found[placed], CORE, rounds=2)
        bent.append((median(estimate, placed), estimate))
    return min(bent, key=lambda lens: lens[0])[1]


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
        error = residuals(estimate, board, corners)
        scale = _scale(error)
        estimate = adjust(
            estimate,
            board,
            corners,
            used & np.isfinite(error[..., 0]),
            free=free,
            precision=_precision(estimate.camera, board, scale),
            scale=scale,
            steps=12,
            least_gain=1e-4,  # the scale is a rough one, too
        )
    return estimate


def _earned(
    still: Estimate, moving: Estimate, board: NDArray[np.float64], corners: NDArray[np.float64]
) -> bool:
    """Whether a travelling pupil explains clearly more than one that stands."""
    a, b = (_distance(residuals(e, board, corners)) for e in (still, moving))
    scale = _scale(residuals(moving, board, corners))
    seen = np.isfinite(a) & np.isfinite(b)
    cost, less = (float(np.log1p((d[seen] / scale) ** 2).sum()) for d in (a, b))
    squares = (cost - less) * 2.4**2
    return cost - less > PUPIL_SHARE * cost and squares > PUPIL_SQUARES


def _settle(
    placed: NDArray[np.intp],
    estimate: Estimate,
    board: NDArray[np.float64],
    corners: NDArray[np.float64],
    found: NDArray[np.bool_],
    free: NDArray[np.bool_],
) -> Fit:
    """Least squares on the corners that fit, until they stay the same; views that do not go."""
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
            free=free,
            precision=_precision(estimate.camera, board, sigma),
        )
        error = residuals(estimate, board, corners[placed])[used]
        sigma = _sigma(error, estimate)
    return Fit(placed, estimate, used, 2.4 * sigma)


def judge(fit: Fit, corners: NDArray[np.float64], target: Target) -> Lens:
    """A fit as a lens with all that tells how good it is.

    Raises
    ------
    UserError
        When the views are all parallel or leave the focal length open.

    """
    board, placed, estimate, used = target.points(), fit.placed, fit.estimate, fit.used
    frames = board_frames(fit)
    if largest_tilt(frames) < LEAST_TILT:
        raise UserError(PARALLEL)
    error = residuals(estimate, board, corners[placed])
    sigma = _sigma(error[used], estimate)
    count = len(estimate.camera.intrinsics)
    spread, condition = covariance(
        estimate,
        board,
        corners[placed],
        used,
        _precision(estimate.camera, board, sigma),
        np.arange(count + 4) < (count + 4 if estimate.pupil.any() else count + 2),
    )
    spread = sigma**2 * spread[:count, :count]
    check_focal(estimate.camera.intrinsics, np.sqrt(np.diag(spread)), 2 if count > 3 else 1)
    left = np.full(corners.shape, np.nan)
    left[placed] = np.where(used[..., None], error, np.nan)
    poses = np.full((len(corners), 6), np.nan)
    poses[placed] = frames
    return Lens(
        camera=bounded(estimate.camera),
        observed=corners,
        residuals=left,
        outliers=np.isfinite(corners[..., 0]) & np.isnan(left[..., 0]),
        rms=math.sqrt(float((error[used] ** 2).sum(axis=-1).mean())),
        sigma=sigma,
        covariance=spread,
        bow=estimate.bow,
        pupil=estimate.pupil,
        camera_from_board=poses,
        condition=condition,
    )


def board_frames(fit: Fit) -> NDArray[np.float64]:
    """Rotation vectors and translations of the boards, (n, 6)."""
    from scipy.spatial.transform import Rotation

    estimate = fit.estimate
    turns = Rotation.from_matrix(estimate.rotations).as_rotvec()
    return np.concatenate([turns, estimate.translations], axis=1)


def bounded(camera: CameraModel) -> CameraModel:
    """The lens up to the angle where its radius stops to grow, as no real lens's does."""
    if not camera.model.startswith("kb4"):
        return camera
    theta = np.linspace(0, math.pi, 2000)
    slope = 1 + sum(
        (2 * i + 3) * k * theta ** (2 * i + 2) for i, k in enumerate(camera.intrinsics[4:8])
    )
    falls = np.flatnonzero(np.asarray(slope) <= 0)
    limit = float(theta[falls[0] - 1]) if len(falls) else math.pi
    return replace(camera, max_angle=limit)


def _precision(
    camera: CameraModel, board: NDArray[np.float64], sigma: float
) -> NDArray[np.float64]:
    """Inverse variances of weak knowledge, times sigma squared, (k + 4,)."""
    count = len(camera.intrinsics)
    width = float(np.ptp(board[..., :2], axis=(0, 1)).max())
    known = np.zeros(count + 4)
    known[4:count] = (sigma / K_DEVIATION) ** 2
    known[count : count + 2] = (sigma / (BOW_DEVIATION * width)) ** 2
    known[count + 2 :] = (sigma / PUPIL_DEVIATION) ** 2
    return known


def _sigma(error: NDArray[np.float64], estimate: Estimate) -> float:
    """Deviation of a coordinate from residuals (N, 2), freed from the fitted unknowns."""
    unknowns = len(estimate.camera.intrinsics) + 4 + 6 * len(estimate.rotations)
    if error.size <= unknowns:
        raise UserError("after outlier rejection too few corners are left: check the pictures")
    return max(math.sqrt(float((error**2).sum()) / (error.size - unknowns)), 1e-9)


def _scale(error: NDArray[np.float64]) -> float:
    """Cauchy's scale, 2.4 deviations of a coordinate by the median distance."""
    median = float(np.nanmedian(_distance(error)))
    return max(2.4 * median / math.sqrt(2 * math.log(2)), 1e-9)


def _distance(error: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.hypot(error[..., 0], error[..., 1])
