"""Least squares for one camera before points and lines whose place in the world is known.

Unknown are a factor of the focal length, the principal point, a turn, a shift and the first
radial distortion; any of them may be held. With p = R p_world + t the state is exp(w) p + dt,
so that a turn is one about the camera's own place. Rows are residuals in standard deviations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import gradients
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: The unknowns: ln of the focal length's factor, cx, cy, turn and shift in camera axes, k1.
UNKNOWNS = 10
POSE = np.isin(np.arange(UNKNOWNS), range(3, 9))
TURN = np.isin(np.arange(UNKNOWNS), range(3, 6))
#: k1 is the fifth number of this model, the only one of which it may be unknown.
BENT = "LENSMODEL_OPENCV4"
K1 = 4


@dataclass(frozen=True)
class Evidence:
    """What a picture shows of the world.

    ``points`` (N, 3), metres, seen at ``pixels`` (N, 2); lines along the world's ``axes`` (M,),
    0 1 2 for x y z, whose ``ends`` (M, 2, 2) were clicked, the second farther along the axis.
    ``sigma`` is the standard deviation of a click in pixels; ``centre`` the principal point as
    it is believed (2,), and ``centre_sigma`` how far it may be off, pixels, infinite for
    nothing believed; ``k1_sigma`` the same of k1, which is believed to be zero.
    """

    points: Array
    pixels: Array
    sigma: float = 1.0
    axes: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    ends: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    centre: Array = field(default_factory=lambda: np.zeros(2))
    centre_sigma: float = math.inf
    k1_sigma: float = math.inf


@dataclass(frozen=True)
class Fit:
    """``pose`` is camera_from_world; ``rows`` residuals, ``jacobian`` (rows, free unknowns)."""

    camera: CameraModel
    pose: Pose
    rows: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        """Sum of squares of the rows."""
        return float(self.rows @ self.rows)


def focals(camera: CameraModel) -> int:
    """How many focal lengths the intrinsics begin with."""
    return 2 if len(camera.intrinsics) > 3 else 1


def refine(
    camera: CameraModel,
    start: Pose,
    evidence: Evidence,
    free: NDArray[np.bool_],
    steps: int = 100,
) -> Fit | None:
    """Levenberg-Marquardt from `start`, camera_from_world, over the `free` unknowns (9,).

    None where the start does not see some of the evidence.
    """
    fit = linearise(camera, start, evidence, free)
    if not np.isfinite(fit.rows).all():
        return None
    damping = 1e-3
    for _ in range(steps):
        normal = fit.jacobian.T @ fit.jacobian
        damped = normal + damping * np.diag(np.diag(normal))
        step = np.linalg.lstsq(damped, -fit.jacobian.T @ fit.rows, rcond=None)[0]
        if np.abs(step).max(initial=0) < 1e-13 * (1 + np.abs(fit.pose.translation).max()):
            break
        change = np.zeros(UNKNOWNS)
        change[free] = step
        new = None
        if abs(change[0]) < 2:  # a longer step of ln f is none
            new = linearise(*_moved(fit.camera, fit.pose, change), evidence, free)
        if new is not None and np.isfinite(new.rows).all() and new.cost <= fit.cost:
            gain = fit.cost - new.cost
            fit = new
            damping = max(damping / 10, 1e-12)
            if gain <= 1e-14 * (1 + fit.cost):
                break
        elif damping > 1e12:
            break
        else:
            damping *= 10
    return fit


def linearise(
    camera: CameraModel, pose: Pose, evidence: Evidence, free: NDArray[np.bool_]
) -> Fit:
    """Rows and their derivatives where the camera is now."""
    p = pose.apply(evidence.points)
    if free[~POSE].any():
        q, by_point, by_intrinsics = gradients(camera, p)
        behind = ~np.isfinite(camera.project(p))
        q = np.where(behind, np.nan, q)
    else:
        q, by_point = camera.project_with_jacobian(p)
        by_intrinsics = np.zeros((*q.shape, len(camera.intrinsics)))
    n = focals(camera)
    by_focal = by_intrinsics[..., :n] @ camera.intrinsics[:n]
    bend = by_intrinsics[..., K1 : K1 + 1] if free[9] else np.zeros((*q.shape, 1))
    j = np.concatenate(
        [by_focal[..., None], by_intrinsics[..., n : n + 2],
         -by_point @ cross_matrix(p), by_point, bend], axis=-1,
    )  # fmt: skip
    rows = [((q - evidence.pixels) / evidence.sigma).ravel()]
    slopes = [j.reshape(-1, UNKNOWNS) / evidence.sigma]
    if len(evidence.axes):
        rows.append(line_rows(camera, pose, evidence))
        slopes.append(_line_slopes(camera, pose, evidence, free))
    if free[1:3].any() and math.isfinite(evidence.centre_sigma):
        rows.append((camera.intrinsics[n : n + 2] - evidence.centre) / evidence.centre_sigma)
        slopes.append(np.eye(UNKNOWNS)[1:3] / evidence.centre_sigma)
    if free[9] and math.isfinite(evidence.k1_sigma):
        rows.append(camera.intrinsics[K1 : K1 + 1] / evidence.k1_sigma)
        slopes.append(np.eye(UNKNOWNS)[9:] / evidence.k1_sigma)
    return Fit(camera, pose, np.concatenate(rows), np.concatenate(slopes)[:, free])


def line_rows(camera: CameraModel, pose: Pose, evidence: Evidence) -> Array:
    """How far the lines' ends lie off their axes' directions in the picture, (M,).

    Through the middle of a line its axis is seen along w = (d pixel / d point) R e; an end is
    |w x s| / 2|w| off, s from end to end, and both ends' noise makes that sigma / sqrt 2.
    """
    by_point, s = _middles(camera, evidence)
    w = (by_point @ pose.rotation.T[evidence.axes][..., None])[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return _side(w, s) / np.linalg.norm(w, axis=1) / (math.sqrt(2) * evidence.sigma)


def axis_directions(camera: CameraModel, pose: Pose, evidence: Evidence) -> tuple[Array, Array]:
    """Where the axes run in the picture at the lines' middles, and the lines, (M, 2) each."""
    by_point, s = _middles(camera, evidence)
    return (by_point @ pose.rotation.T[evidence.axes][..., None])[..., 0], s


def _middles(camera: CameraModel, evidence: Evidence) -> tuple[Array, Array]:
    """D pixel / d point (M, 2, 3) at the lines' middles, and the lines (M, 2)."""
    middle = camera.unproject(evidence.ends.mean(axis=1))
    by_point = camera.project_with_jacobian(middle)[1]
    return by_point, evidence.ends[:, 1] - evidence.ends[:, 0]


def _side(w: Array, s: Array) -> Array:
    return w[:, 0] * s[:, 1] - w[:, 1] * s[:, 0]


def cross_matrix(v: Array) -> Array:
    """[v] with [v] a = v x a, ``(..., 3) -> (..., 3, 3)``."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack(
        [
            np.stack([zero, -z, y], axis=-1),
            np.stack([z, zero, -x], axis=-1),
            np.stack([-y, x, zero], axis=-1),
        ],
        axis=-2,
    )


def _line_slopes(
    camera: CameraModel, pose: Pose, evidence: Evidence, free: NDArray[np.bool_]
) -> Array:
    """By the turn exactly; by the lens, differentiated twice, by central differences."""
    slopes = np.zeros((len(evidence.axes), UNKNOWNS))
    by_point, s = _middles(camera, evidence)
    along = pose.rotation.T[evidence.axes]
    w = (by_point @ along[..., None])[..., 0]
    length = np.linalg.norm(w, axis=1)
    row = _side(w, s) / length
    dw = -by_point @ cross_matrix(along)  # (M, 2, 3)
    for k in range(3):
        forth = (w * dw[..., k]).sum(axis=1) / length
        slopes[:, 3 + k] = (_side(dw[..., k], s) - row * forth) / length
    slopes /= math.sqrt(2) * evidence.sigma
    for k in np.flatnonzero(free & ~POSE).tolist():
        change = np.zeros(UNKNOWNS)
        change[k] = 1e-2 if k in (1, 2) else 1e-5
        ahead = line_rows(*_moved(camera, pose, change), evidence)
        behind = line_rows(*_moved(camera, pose, -change), evidence)
        slopes[:, k] = (ahead - behind) / (2 * change[k])
    return slopes


def _moved(camera: CameraModel, pose: Pose, change: Array) -> tuple[CameraModel, Pose]:
    values, n = camera.intrinsics.copy(), focals(camera)
    values[:n] *= math.exp(change[0])
    values[n : n + 2] += change[1:3]
    turn = Pose.from_rotation_vector(change[3:6], np.zeros(3)).rotation
    u, _, vt = np.linalg.svd(turn @ pose.rotation)
    moved = Pose(u @ vt, turn @ pose.translation + change[6:9])
    if change[9]:
        values[K1] += change[9]
    return (replace(camera, intrinsics=values) if change[~POSE].any() else camera), moved
