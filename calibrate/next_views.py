"""Which views of the board to take next: those that would tell most of what is not known yet.

What a view tells of the lens are its normal equations with its own pose eliminated; they depend
on where the board is held, not on what is measured there, so that a view can be judged before
it is taken (Peng and Sturm 2019, Calibration Wizard). Views are chosen one by one, each the one
that lowers the error of projection over the picture most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, derivatives
from chromeball.calibrate.convert import converted
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.solve import BOW_DEVIATION, K_DEVIATION, PUPIL_DEVIATION
from chromeball.calibrate.target import Target
from chromeball.calibrate.uncertainty import projection_slopes
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

#: Error that a lens is allowed, pixels: a third of what an edge of a composite shows.
GOOD = 0.3
#: And over how much of the picture.
GOOD_SHARE = 0.95
#: A place farther from all corners than this share of the picture's longer side, outside their
#: hull, is one of which no view tells: a board's inner corners end a square before its rim.
REACH = 0.1
#: There a lens is only extrapolated: so much is added to its error, pixels.
UNSEEN = 2.0
#: What a person is asked for: the board's size as a share of the longer side, and degrees.
SIZES, TILT = (0.3, 0.5, 0.8), 30.0
#: Nobody takes more views than so many without looking again.
MOST = 8

PLACES = (
    ("top left corner", 1 / 8, 1 / 8), ("top edge", 1 / 2, 1 / 8),
    ("top right corner", 7 / 8, 1 / 8),
    ("left edge", 1 / 8, 1 / 2), ("middle", 1 / 2, 1 / 2), ("right edge", 7 / 8, 1 / 2),
    ("bottom left corner", 1 / 8, 7 / 8), ("bottom edge", 1 / 2, 7 / 8),
    ("bottom right corner", 7 / 8, 7 / 8),
)  # fmt: skip
TILTS = (
    ("facing the camera", (0.0, 0.0)),
    ("its right edge nearer", (0.0, 1.0)),
    ("its left edge nearer", (0.0, -1.0)),
    ("its top edge nearer", (1.0, 0.0)),
    ("its bottom edge nearer", (-1.0, 0.0)),
)


@dataclass(frozen=True)
class View:
    """A view to take: in words, as a share of the picture's longer side, and as a pose."""

    place: str
    tilt: str
    size: float
    camera_from_board: Pose
    corners: NDArray[np.float64]


@dataclass(frozen=True)
class Knowledge:
    """What is known of a lens over the picture, and what more views would add.

    ``pixels`` (n, 2) over the picture, ``slopes`` (n, 2, s) of projection there, NaN where the
    lens does not reach; ``seen`` (n,), where corners tell; ``information`` (s, s) of the
    unknowns; ``estimate`` the lens; ``sigma`` the deviation of a corner, pixels; ``places``
    (rows, columns) of the target's grid that have a corner.
    """

    pixels: NDArray[np.float64]
    slopes: NDArray[np.float64]
    seen: NDArray[np.bool_]
    information: NDArray[np.float64]
    estimate: Estimate
    sigma: float
    places: NDArray[np.bool_]

    def deviation(self) -> NDArray[np.float64]:
        """Of projection in the worst direction, from corner noise, (n,) pixels."""
        return _deviation(self.slopes, np.linalg.inv(self.information))

    def error(self) -> NDArray[np.float64]:
        """The same with what extrapolation adds, (n,); infinite where the lens ends."""
        return _error(self.deviation(), self.seen)


def knowledge(lens: Lens, target: Target, pixels: NDArray[np.float64]) -> Knowledge:
    """What the views of a lens tell over `pixels` (n, 2).

    Of a splined lens, whose many unknowns are local, a kb4 in its place.

    Raises
    ------
    UserError
        When a splined lens sees too few corners to find that kb4.

    """
    camera, posed = lens.camera, np.isfinite(lens.camera_from_board).all(axis=-1)
    used = np.isfinite(lens.residuals[..., 0])
    corner_rays = _rays(camera, lens.observed[used])
    if camera.model.startswith("LENSMODEL_SPLINED"):
        camera, _ = converted(camera, "kb4", corner_rays)
    poses = [Pose.from_rotation_vector(p[:3], p[3:]) for p in lens.camera_from_board[posed]]
    estimate = _estimate(camera, lens, poses)
    board = target.points()
    information = np.diag(_prior(estimate, board))
    each = view_information(estimate, board, used[posed])
    information += each.sum(axis=0) / lens.sigma**2
    slopes = projection_slopes(camera, corner_rays, _rays(camera, pixels))
    slopes = np.concatenate(
        [slopes, np.zeros((len(pixels), 2, len(information) - slopes.shape[-1]))], axis=-1
    )
    seen = near_corners(pixels, lens.observed[used], lens.camera.size, lens.hull())
    places = np.isfinite(lens.observed[..., 0]).any(axis=0)
    return Knowledge(pixels, slopes, seen, information, estimate, lens.sigma, places)


def view_information(
    estimate: Estimate, board: NDArray[np.float64], used: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """What each of V views tells of intrinsics, bow and pupil by corners of deviation 1 pixel.

    (V, s, s), s = k + 2, or k + 4 where the pupil travels; `used` (V, rows, columns).
    """
    _, shared, own = derivatives(estimate, board)
    unknowns = len(estimate.camera.intrinsics) + (4 if estimate.pupil.any() else 2)
    a = np.where(used[..., None, None], shared[..., :unknowns], 0.0)
    b = np.where(used[..., None, None], own, 0.0)
    a, b = (m.reshape(len(m), -1, m.shape[-1]) for m in (a, b))
    # Unknowns in units of their own, else metres and radians meet badly.
    b = b / np.maximum(np.linalg.norm(b, axis=1, keepdims=True), 1e-12)
    between = np.swapaxes(b, 1, 2) @ a
    pose = np.swapaxes(b, 1, 2) @ b
    return np.swapaxes(a, 1, 2) @ a - np.swapaxes(between, 1, 2) @ np.linalg.solve(
        pose, between
    )


def near_corners(
    pixels: NDArray[np.float64],
    corners: NDArray[np.float64],
    size: tuple[int, int],
    hull: NDArray[np.float32] | None = None,
) -> NDArray[np.bool_]:
    """Which of the `pixels` (n, 2) lie near `corners` (N, 2), or inside their `hull`."""
    import cv2
    from scipy.spatial import KDTree

    distance, _ = KDTree(corners).query(pixels)
    near = np.asarray(distance < REACH * max(size), bool)
    if hull is not None:
        inside = [cv2.pointPolygonTest(hull, (x, y), False) >= 0 for x, y in pixels.tolist()]
        near |= np.array(inside, bool)
    return near


def candidates(
    known: Knowledge, target: Target, lit: NDArray[np.bool_] | None = None
) -> list[View]:
    """Boards all over the picture, whole, of two sizes, tilted five ways.

    A board that would reach out of the picture, or where the pixels of `known` are not `lit`,
    is moved towards the middle.
    """
    found: list[View] = []
    for size in SIZES:
        for place, x, y in PLACES:
            for tilt, axis in TILTS:
                view = _candidate(known, target, (place, tilt, size), (x, y), axis, lit)
                if view is not None:
                    found.append(view)
    return found


def next_views(
    known: Knowledge,
    target: Target,
    *,
    lit: NDArray[np.bool_] | None = None,
    worse: float = 1.0,
    fewest: int = 0,
    most: int = MOST,
    from_among: list[View] | None = None,
) -> tuple[list[View], Knowledge]:
    """Views to take, the most telling first, and what will be known then.

    As many as bring the error below :data:`GOOD` over :data:`GOOD_SHARE` of the `lit` pixels,
    at least `fewest` and at most `most`; `worse` is how many times the true error is that of
    corner noise. `from_among` replaces :func:`candidates`.
    """
    shown = np.ones(len(known.pixels), bool) if lit is None else lit
    chosen: list[View] = []
    if fewest == 0 and np.mean(worse * known.error()[shown] < GOOD) >= GOOD_SHARE:
        return chosen, known
    views = candidates(known, target, lit) if from_among is None else from_among
    if not views:
        return chosen, known
    estimate = _at(known.estimate, [v.camera_from_board for v in views])
    board = target.points()
    used = np.broadcast_to(known.places, (len(views), *board.shape[:2]))
    gains = view_information(estimate, board, used) / known.sigma**2
    size = known.estimate.camera.size
    shows = [near_corners(known.pixels, v.corners[known.places], size) for v in views]
    while len(chosen) < most:
        error = worse * known.error()[shown]
        if len(chosen) >= fewest and np.mean(error < GOOD) >= GOOD_SHARE:
            break
        costs = [
            _cost(
                known.slopes[shown], known.information + gain, (known.seen | show)[shown], worse
            )
            for gain, show in zip(gains, shows, strict=True)
        ]
        best = int(np.argmin(costs))
        before = _cost(known.slopes[shown], known.information, known.seen[shown], worse)
        if len(chosen) >= fewest and before - costs[best] < 0.002:
            break
        chosen.append(views[best])
        known = replace(
            known,
            seen=known.seen | shows[best],
            information=known.information + gains[best],
        )
    return chosen, known


def slants(lens: Lens) -> NDArray[np.float64]:
    """How boards slant against the ray to their middle, (n, 2) radians.

    Right edge nearer and top edge nearer, of the picture as the camera sees it.
    """
    posed = lens.camera_from_board[np.isfinite(lens.camera_from_board).all(axis=-1)]
    found: list[NDArray[np.float64]] = []
    for row in posed:
        pose = Pose.from_rotation_vector(row[:3], row[3:])
        # The normal from the board's back, in axes whose z is the ray to the board.
        normal = _turn_to(pose.translation).T @ pose.rotation[:, 2]
        across = float(np.hypot(normal[0], normal[1]))
        angle = math.atan2(across, float(normal[2]))
        found.append(normal[:2] * [1, -1] / max(across, 1e-12) * angle)
    return np.array(found).reshape(-1, 2)


def _turn_to(ray: NDArray[np.float64]) -> NDArray[np.float64]:
    """The least rotation that takes the optical axis to a direction."""
    across = np.cross([0.0, 0.0, 1.0], ray / np.linalg.norm(ray))
    sine = float(np.linalg.norm(across))
    turn = across / max(sine, 1e-12) * math.atan2(sine, float(ray[2] / np.linalg.norm(ray)))
    return Pose.from_rotation_vector(turn, np.zeros(3)).rotation


def _cost(
    slopes: NDArray[np.float64],
    information: NDArray[np.float64],
    seen: NDArray[np.bool_],
    worse: float,
) -> float:
    """Mean logarithm of the error where the lens reaches; below GOOD little is gained."""
    error = worse * _error(_deviation(slopes, np.linalg.inv(information)), seen)
    error = error[np.isfinite(error)]
    return float(np.log(GOOD**2 + error**2).mean() / 2) if error.size else 0.0


def _error(deviation: NDArray[np.float64], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    error = np.hypot(deviation, np.where(seen, 0.0, UNSEEN))
    return np.where(np.isfinite(error), error, math.inf)


def _deviation(
    slopes: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    spread = slopes @ covariance @ np.swapaxes(slopes, -1, -2)
    a, b, c = spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
    return np.asarray(np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b)), float)


def _candidate(
    known: Knowledge,
    target: Target,
    words: tuple[str, str, float],
    at: tuple[float, float],
    axis: tuple[float, float],
    lit: NDArray[np.bool_] | None,
) -> View | None:
    """The board at a share `at` of the picture, as near to it as it is whole."""
    from scipy.spatial import KDTree

    camera = known.estimate.camera
    board = target.points().reshape(-1, 3)
    middle = (np.array(camera.size) - 1) / 2
    wanted = np.array(at) * camera.size
    margin = 0.01 * max(camera.size)
    dark = None if lit is None else KDTree(known.pixels)
    for pull in np.linspace(1, 0, 9):
        ray = camera.unproject(middle + pull * (wanted - middle))
        if not np.isfinite(ray).all():
            continue
        pose = _facing(camera, board, ray, axis, words[2] * max(camera.size))
        if pose is None:
            continue
        seen = camera.project(pose.apply(board))
        far = np.array(camera.size) - 1 - margin
        inside = bool((seen >= margin).all() and (seen <= far).all())
        if inside and lit is not None and dark is not None:
            inside = bool(lit[dark.query(seen)[1]].all())
        if inside:
            return View(*words, pose, seen.reshape(target.rows, target.columns, 2))
    return None


def _facing(
    camera: CameraModel,
    board: NDArray[np.float64],
    ray: NDArray[np.float64],
    axis: tuple[float, float],
    extent: float,
) -> Pose | None:
    """A board on `ray`, facing the camera but for its tilt, `extent` pixels large."""
    tilt = math.radians(TILT) * np.array([*axis, 0.0])
    rotation = _turn_to(ray) @ Pose.from_rotation_vector(tilt, np.zeros(3)).rotation
    middle = (board.min(axis=0) + board.max(axis=0)) / 2
    distance = 2 * float(np.linalg.norm(np.ptp(board, axis=0)))
    pose = None
    for _ in range(4):
        pose = Pose(rotation, distance * ray - rotation @ middle)
        seen = camera.project(pose.apply(board))
        if not np.isfinite(seen).all():
            return None
        distance *= float(np.ptp(seen, axis=0).max()) / extent
    return pose


def _estimate(camera: CameraModel, lens: Lens, poses: list[Pose]) -> Estimate:
    none = Estimate(camera, lens.bow, np.zeros((0, 3, 3)), np.zeros((0, 3)), lens.pupil)
    return _at(none, poses)


def _at(estimate: Estimate, poses: list[Pose]) -> Estimate:
    return Estimate(
        estimate.camera,
        estimate.bow,
        np.array([p.rotation for p in poses]).reshape(-1, 3, 3),
        np.array([p.translation for p in poses]).reshape(-1, 3),
        estimate.pupil,
    )


def _prior(estimate: Estimate, board: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse variances of the weak knowledge that the solution had, too."""
    width = float(np.ptp(board[..., :2], axis=(0, 1)).max())
    count = len(estimate.camera.intrinsics)
    known = np.full(count, 1 / K_DEVIATION**2)
    known[: min(count, 4)] = 0.0
    more = [1 / (BOW_DEVIATION * width) ** 2] * 2
    if estimate.pupil.any():
        more += [1 / PUPIL_DEVIATION**2] * 2
    return np.concatenate([known, more])


def _rays(camera: CameraModel, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit rays, NaN where they do not project back."""
    rays = camera.unproject(pixels)
    with np.errstate(invalid="ignore"):
        miss = np.linalg.norm(camera.project(rays) - pixels, axis=-1)
    return np.where((miss < 0.1)[..., None], rays, np.nan)
