"""One lens of any model by our own least squares; no focal length is asked for.

Lenses of many fields of view are tried as a start, each board posed by its rays
(:mod:`chromeball.calibrate.view_poses`), which holds beyond 90 degrees. The start is Kannala
and Brandt's lens (2006), which bends to any other; the model asked for begins as the nearest to
it. Everything is estimated together, the board's bow included: with Cauchy's weights first,
then by least squares on the corners that fit.
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
from chromeball.calibrate.convert import CAHVORE, converted, free_terms
from chromeball.calibrate.lens_result import (
    LEAST_TILT,
    PARALLEL,
    Lens,
    check_focal,
    largest_tilt,
)
from chromeball.calibrate.target import Target
from chromeball.calibrate.view_poses import FEWEST_CORNERS, cauchy_scale, distance, place
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

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
#: Unknowns of the start: focal lengths and centre; the lens; lens and bow.
CORE, LENS, BOWED = (np.arange(12) < count for count in (4, 8, 10))
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
    placed, estimate = place(estimate, board, corners[few], found[few], None)
    placed = few[placed]
    if len(placed) < 3:
        raise UserError(UNEXPLAINED)
    for free in (CORE, LENS, BOWED):
        estimate = _robust(estimate, board, corners[placed], found[placed], free)
    # Boards that had no pose, or the wrong one of two, get theirs from the lens as it is now.
    scale = cauchy_scale(residuals(estimate, board, corners[placed]))
    placed, estimate = place(estimate, board, corners, found, scale)
    if len(placed) < 3:
        raise UserError(UNEXPLAINED)
    estimate = _robust(estimate, board, corners[placed], found[placed], BOWED)
    error = residuals(estimate, board, corners[placed])
    scale = cauchy_scale(error)
    return Fit(placed, estimate, found[placed] & (distance(error) < 3 * scale), scale)


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
    entrance pupil of a kb4 or CAHVORE stands still, too.

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
    placed, estimate = place(estimate, board, corners, found, start.scale)
    if len(placed) < 3:
        raise UserError(UNEXPLAINED)
    estimate = replace(estimate, pupil=np.zeros(2))
    still = np.concatenate([free_terms(model), [True, True, False, False]])
    moving_too = np.concatenate([free_terms(model), [True] * 4])
    estimate = _robust(estimate, board, corners[placed], found[placed], still)
    # A lens of one parameter would bend by the pupil what it cannot bend itself.
    if travel and model.startswith(("kb4", CAHVORE)):
        moving = _robust(estimate, board, corners[placed], found[placed], moving_too)
        if _earned(estimate, moving, board, corners[placed]):
            return _settle(placed, moving, board, corners, found, moving_too)
    return _settle(placed, estimate, board, corners, found, still)


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
        far = np.full(found.shape, math.inf)
        far[placed] = distance(residuals(estimate, board, corners[placed]))
        return float(np.median(far[found]))

    tried: list[tuple[float, NDArray[np.intp], Estimate]] = []
    for degrees in FIELDS_OF_VIEW:
        f = max(size) / math.radians(degrees)
        core = np.array([f, f, (size[0] - 1) / 2, (size[1] - 1) / 2, 0, 0, 0, 0])
        camera = CameraModel("kb4", core, size)
        start = Estimate(camera, np.zeros(2), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        placed, estimate = place(start, board, corners, found, None)
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
        scale = cauchy_scale(error)
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
    a, b = (distance(residuals(e, board, corners)) for e in (still, moving))
    scale = cauchy_scale(residuals(moving, board, corners))
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
        error = distance(residuals(estimate, board, corners[placed]))
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
        np.concatenate(
            [free_terms(estimate.camera.model), [True, True], [bool(estimate.pupil.any())] * 2]
        ),
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
