"""A camera from a single picture: points of known place, and lines along the world's axes.

Focal length and pose are solved together, the principal point with them: it is believed to be
the picture's middle within a share of its width, and an unknown lens to bend straight lines a
little. What that leaves open is in the standard errors; where the clicks can tell, they do. No
start is asked for: lenses of many fields of view are tried, each posed by points
(perspective-n-point) or by the vanishing points of the lines, and the best ones refined. What
fits as well as the best, but lies elsewhere, is told.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.calibrate.match_check import refuse_mirrored, told_apart, wrong_points
from chromeball.calibrate.match_start import candidates, starts
from chromeball.calibrate.resection import (
    BENT,
    POSE,
    UNKNOWNS,
    Evidence,
    Fit,
    axis_directions,
    focals,
    linearise,
    refine,
)
from chromeball.calibrate.wrong_click import SOUND, WrongClick, refuse_gross
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: So many of them are refined, of each pose that a plane allows.
TRIED = 5
#: The principal point of an uncropped picture lies within this share of its width (1 sigma).
CENTRE = 0.01
#: A relative standard error of the focal length beyond which it is open.
WORST_FOCAL = 0.2
#: Excess of the squared rows below which two solutions cannot be told apart: 3 sigma.
RIVAL = 9.0
#: A lens that nobody knows moves the picture's corners by this share of their distance from the
#: middle (1 sigma): photographic lenses by up to 0.03, webcams by more.
BEND = 0.03
#: What is believed of k1 follows the focal length, until that changes by less (ln f).
ROUNDS, SETTLED = 10, 1e-4
NAMES = ("focal", "cx", "cy", "pitch", "yaw", "roll", "x", "y", "z", "k1")


@dataclass(frozen=True)
class Match:
    """A camera matched to a picture.

    ``camera`` with its pose; of an unknown lens mrcal's OPENCV4 with k1 alone. ``residuals``
    (N, 2) of the points, projected minus clicked, and ``line_residuals`` (M,) how far a line's
    ends lie off its axis, pixels. ``covariance`` (10, 10) of ln f, the principal point
    (pixels), the turn about the camera's x, y, z (radians), the position (world, metres) and
    k1; zero for what was known. ``misfit`` is how many times as far the clicks are off as
    their sigma explains, 1 where nothing can tell; above 1 the covariance is larger by its
    square.
    ``rivals`` are cameras elsewhere that fit as well within 3 standard deviations, beyond what
    the standard errors tell. ``wrong`` are points that the others contradict.
    """

    camera: CameraModel
    residuals: Array
    line_residuals: Array
    rms: float
    sigma: float
    covariance: Array
    condition: float
    misfit: float
    rivals: tuple[CameraModel, ...]
    wrong: tuple[WrongClick, ...] = ()

    @property
    def standard_errors(self) -> Array:
        """Of the ten unknowns, (10,)."""
        return np.sqrt(np.diag(self.covariance))


def match(
    lens: CameraModel,
    points: ArrayLike,
    pixels: ArrayLike,
    *,
    axes: ArrayLike | None = None,
    ends: ArrayLike | None = None,
    sigma: float = 0.5,
    focal_known: bool = False,
    centre_sigma: float | None = None,
    bend_sigma: float = BEND,
    above_floor: bool = False,
) -> Match:
    """The camera that sees world `points` (N, 3) at `pixels` (N, 2), and lines along `axes`.

    Parameters
    ----------
    lens
        Size, distortion and the believed principal point; its focal length counts only where it
        is known. A plain picture's is ``CameraModel.pinhole(size, 1.0)``.
    points, pixels
        Metres and pixels. Four and more of a plane or in space; two and more beside lines.
    axes, ends
        Lines: which axis of the world each runs along, 0 1 2 for x y z (M,), and its ends in
        the picture (M, 2, 2), the second farther along the axis. Two lines or more of each of
        two axes.
    sigma
        Standard deviation of a click, pixels.
    focal_known
        Only the pose is unknown.
    centre_sigma
        How far the principal point may be from `lens`'s, pixels; by default a hundredth of the
        width. For a picture that was cropped: large.
    bend_sigma
        How far a lens without distortion (``pinhole``) may move the picture's corners after
        all, as a share of their distance from the middle; 0 where it is known not to.
    above_floor
        Only cameras with y > 0.

    Raises
    ------
    UserError
        Too little evidence, or evidence that leaves focal length or pose open, that no camera
        can have seen, that is mirrored, or a point that the others contradict.

    """
    width = lens.size[0]
    bends = lens.model == "pinhole" and not focal_known and bend_sigma > 0
    if bends:
        lens = replace(lens, model=BENT, intrinsics=np.append(lens.intrinsics, np.zeros(4)))
    evidence = _evidence(lens, points, pixels, axes, ends, sigma)
    n = focals(lens)
    evidence = replace(
        evidence,
        centre=lens.intrinsics[n : n + 2].copy(),
        centre_sigma=CENTRE * width if centre_sigma is None else centre_sigma,
    )
    free = POSE.copy() if focal_known else np.arange(UNKNOWNS) < 9
    free[9] = bends
    _check_count(evidence, focal_known)

    def solve(evidence: Evidence) -> list[Fit]:
        return _solve(lens, evidence, free, focal_known, bend_sigma)

    fits = solve(evidence)
    if not fits:
        refuse_mirrored(evidence, width, solve)
    standing = [fit for fit in fits if not above_floor or fit.pose.inverse().translation[1] > 0]
    if not standing:
        raise UserError(
            "the camera would stand below the floor: click the points in the order of the "
            "world points, and not mirrored"
            if fits
            else "no camera sees these points and lines like this: check their order and place"
        )
    best = standing[0]
    evidence = _bending(evidence, best.camera, free, bend_sigma)
    spare = len(best.rows) - int(free.sum())
    misfit = math.sqrt(best.cost / spare) if spare > 0 else 1.0
    if misfit > SOUND:
        refuse_mirrored(evidence, width, solve)
    wrong = wrong_points(evidence, best, spare, free, solve)
    refuse_gross(wrong, "point")
    count = len(evidence.points)
    residuals = best.rows[: 2 * count].reshape(-1, 2) * sigma
    along = best.rows[2 * count : 2 * count + len(evidence.axes)] * sigma * math.sqrt(2)
    square = float((residuals**2).sum() + (along**2).sum())
    rms = math.sqrt(square / max(count + len(along), 1))
    tolerance = max(10 * sigma, 0.01 * math.hypot(*lens.size))
    if rms > tolerance:
        raise UserError(
            f"the clicks miss the points and lines by {rms:.1f} px: check their order, which "
            "axis a line runs along, and whether the lens distorts (--camera)"
        )
    covariance, condition = _covariance(best, free, evidence)
    inflated = max(misfit, 1.0) ** 2
    covariance = covariance * inflated
    if not (error := math.sqrt(covariance[0, 0])) < WORST_FOCAL:
        raise UserError(
            f"the clicks are {misfit:.0f} times as far off as their sigma says, which leaves "
            f"the focal length open (standard error {error:.0%}): check the order of the "
            "points, and look for wrong ones"
        )
    rivals: list[Fit] = []
    for fit in standing[1:]:
        close = fit.cost - best.cost < RIVAL * inflated
        if close and all(told_apart(fit, f, free, RIVAL * inflated) for f in (best, *rivals)):
            rivals.append(fit)
    return Match(
        camera=best.camera.posed(best.pose.inverse()),
        residuals=residuals,
        line_residuals=along,
        rms=rms,
        sigma=sigma,
        covariance=covariance,
        condition=condition,
        misfit=misfit,
        rivals=tuple(fit.camera.posed(fit.pose.inverse()) for fit in rivals),
        wrong=wrong,
    )


def _evidence(
    lens: CameraModel,
    points: ArrayLike,
    pixels: ArrayLike,
    axes: ArrayLike | None,
    ends: ArrayLike | None,
    sigma: float,
) -> Evidence:
    p = np.asarray(points, float).reshape(-1, 3)
    q = np.asarray(pixels, float).reshape(-1, 2)
    if len(p) != len(q):
        raise UserError(f"{len(p)} world points need as many pixels, not {len(q)}")
    which = np.asarray([] if axes is None else axes, int).astype(np.intp).ravel()
    line = np.asarray([] if ends is None else ends, float).reshape(-1, 2, 2)
    if len(which) != len(line) or not ((which >= 0) & (which <= 2)).all():
        raise UserError("every line needs its axis, 0, 1 or 2, and two ends")
    clicked = np.concatenate([q, line.reshape(-1, 2)])
    if not (np.isfinite(p).all() and np.isfinite(clicked).all()):
        raise UserError("points and pixels must be finite")
    width, height = lens.size
    for x, y in clicked.tolist():
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise UserError(f"pixel {x:g},{y:g} lies outside the picture of {width}x{height}")
    gaps = np.linalg.norm(q[:, None] - q[None], axis=-1) + np.diag(np.full(len(q), np.inf))
    if len(q) and gaps.min() < 1:
        i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
        raise UserError(f"points {i + 1} and {j + 1} were clicked at the same pixel")
    lengths = np.linalg.norm(line[:, 1] - line[:, 0], axis=1)
    if len(line) and lengths.min() < 10:
        raise UserError(f"line {int(np.argmin(lengths)) + 1} is shorter than 10 px: click more")
    return Evidence(p, q, sigma, which, line)


def _check_count(evidence: Evidence, focal_known: bool) -> None:
    count, lines = len(evidence.points), len(evidence.axes)
    if lines == 0 and count < 4:
        raise UserError(
            f"{count} points are too few: click four or more, or add lines along the axes"
        )
    if lines and count < 4:
        if (np.bincount(evidence.axes, minlength=3) >= 2).sum() < 2:
            raise UserError(
                "too few lines: two or more along each of two axes, or four points and more"
            )
        if count < 2:
            raise UserError(
                "lines say where the camera looks, not where it stands: click two points whose "
                "place is known, too"
            )
    unknowns = 6 if focal_known else 7
    if 2 * count + lines < unknowns:
        raise UserError(
            f"{2 * count + lines} numbers for {unknowns} unknowns: click more points or lines"
        )


def _solve(
    lens: CameraModel,
    evidence: Evidence,
    free: NDArray[np.bool_],
    focal_known: bool,
    bend_sigma: float,
) -> list[Fit]:
    """Distinct local minima, the best first."""
    # Principal point and k1 stay as they are believed until the rest is in place.
    held = free & ~np.isin(np.arange(UNKNOWNS), (1, 2, 9))
    # Of a plane two poses fit: each branch has its own best focal lengths.
    branches: tuple[list[Fit], ...] = ([], [])
    for camera in [lens] if focal_known else candidates(lens):
        for branch, pose in zip(branches, starts(camera, evidence), strict=False):
            first = linearise(camera, pose, evidence, held)
            if np.isfinite(first.rows).all():
                branch.append(first)
    rough: list[Fit] = []
    for branch in branches:
        for start in sorted(branch, key=lambda fit: fit.cost)[:TRIED]:
            fit = refine(start.camera, start.pose, evidence, held, steps=10)
            if fit is not None and _sound(fit, evidence):
                rough.append(fit)
    rough.sort(key=lambda fit: fit.cost)
    found: list[Fit] = []
    for start in rough:
        least = min((fit.cost for fit in found), default=math.inf)
        fit = _settled(start, evidence, free, bend_sigma, least + 10 * RIVAL * (1 + least))
        if fit is None or not _sound(fit, evidence) or any(_same(fit, f) for f in found):
            continue
        found.append(fit)
    found.sort(key=lambda fit: fit.cost)
    return found


def _settled(
    start: Fit, evidence: Evidence, free: NDArray[np.bool_], bend_sigma: float, worst: float
) -> Fit | None:
    """All `free` unknowns from `start` on; no further where the cost stays above `worst`."""
    fit = start
    for _ in range(ROUNDS):
        believed = _bending(evidence, fit.camera, free, bend_sigma)
        new = refine(fit.camera, fit.pose, believed, free, steps=60)
        if new is None or new.cost > worst or abs(_focals_apart(new, fit)) < SETTLED:
            return new
        fit = new
    return fit


def _bending(
    evidence: Evidence, camera: CameraModel, free: NDArray[np.bool_], bend_sigma: float
) -> Evidence:
    """With what is believed of k1, which moves the corners by less the longer the lens is."""
    corner = math.hypot(*camera.size) / 2 / camera.intrinsics[0]
    return replace(evidence, k1_sigma=bend_sigma / corner**2) if free[9] else evidence


def _focals_apart(a: Fit, b: Fit) -> float:
    return math.log(a.camera.intrinsics[0] / b.camera.intrinsics[0])


def _sound(fit: Fit, evidence: Evidence) -> bool:
    """Whether points lie before the camera and lines run the right way."""
    if not np.isfinite(fit.rows).all():
        return False
    fov = 2 * math.atan(fit.camera.size[0] / (2 * fit.camera.intrinsics[0]))
    if not math.radians(1) < fov < math.radians(170):
        return False
    if len(evidence.axes) == 0:
        return True
    w, s = axis_directions(fit.camera, fit.pose, evidence)
    return bool(((w * s).sum(axis=1) > 0).all())


def _covariance(fit: Fit, free: NDArray[np.bool_], evidence: Evidence) -> tuple[Array, float]:
    """Covariance (10, 10) in the terms of :class:`Match`, and the scaled condition."""
    normal = fit.jacobian.T @ fit.jacobian
    size = np.sqrt(np.diag(normal))
    condition = (
        float(np.linalg.cond(normal / np.outer(size, size))) if (size > 0).all() else math.inf
    )
    spread = np.full((len(size), len(size)), math.inf)
    if condition < 1e13:
        spread = np.linalg.inv(normal)
    focal = math.sqrt(spread[0, 0]) if free[0] else 0.0
    if not focal < WORST_FOCAL:
        raise UserError(_open(fit, evidence, focal))
    if not condition < 1e13:
        raise UserError("the points do not determine the pose: they are too close together")
    change = np.eye(UNKNOWNS)
    change[3:6, 3:6] *= -1
    change[6:9, 6:9] = -fit.pose.rotation.T
    full = np.zeros((UNKNOWNS, UNKNOWNS))
    full[np.ix_(free, free)] = spread
    return change @ full @ change.T, condition


def _open(fit: Fit, evidence: Evidence, error: float) -> str:
    """Why the focal length stays open, and what to do."""
    known = f" (standard error {error:.0%})" if math.isfinite(error) else ""
    start = f"this view leaves the focal length open{known}: "
    rest = "give the lens with --camera --focal known"
    p = evidence.points
    if len(p) >= 3:
        _, size, axes = np.linalg.svd(p - p.mean(axis=0))
        if size[2] < 1e-6 * size[0]:
            normal = fit.pose.rotation @ axes[2]
            tilt = math.degrees(math.acos(min(1.0, abs(float(normal[2])))))
            return (
                f"{start}the points lie in a plane that is tilted by {tilt:.0f} degrees to the "
                f"picture; photograph it more from the side, add points off it, or {rest}"
            )
    return f"{start}add points, nearer and farther, or lines along a second axis; or {rest}"


def _same(a: Fit, b: Fit) -> bool:
    turn = Pose(a.pose.rotation.T @ b.pose.rotation, np.zeros(3)).rotation_vector()
    here, there = a.pose.inverse().translation, b.pose.inverse().translation
    far = 1e-3 * max(float(np.linalg.norm(a.pose.translation)), 1e-9)
    near = float(np.linalg.norm(here - there)) < far
    return bool(np.linalg.norm(turn) < 1e-3 and near and abs(_focals_apart(a, b)) < 1e-3)
