"""The virtual scene turned onto the real one by pairs of points: one of the model, one seen.

One pair turns by the least angle that brings the point where it is seen (two of three degrees
of freedom), two pairs turn fully, three and more find turn and place. Turning the scene about
the camera is turning the camera the other way, which is what is returned. A single picture
cannot tell the model's scale: a model twice as large and twice as far looks the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.calibrate.resection import POSE, TURN, Evidence, refine
from chromeball.calibrate.wrong_click import ALARM, WrongClick, refuse_gross, wrong_clicks
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: A turn beyond this is no correction, radians.
LARGEST = math.radians(60)


@dataclass(frozen=True)
class Realignment:
    """``camera`` as it stands now in the model's world.

    ``model_from_model`` moves the model instead, before the camera as it stood. ``before`` and
    ``after`` (N,) are the pairs' distances in the picture, pixels; ``freedom`` is what was
    solved: 2, 3 or 6; ``covariance`` (6, 6) of the turn about the camera's axes (radians) and
    of its place (world, metres): zero for what was held, NaN where one pair says nothing.
    ``misfit`` is how many times as far the pairs are off as their sigma explains, 1 where
    nothing can tell; where that is beyond chance, the covariance is larger by its square.
    ``wrong`` are pairs that the others contradict.
    """

    camera: CameraModel
    model_from_model: Pose
    before: Array
    after: Array
    freedom: int
    covariance: Array
    misfit: float
    wrong: tuple[WrongClick, ...]

    @property
    def turn(self) -> float:
        """By which angle the camera was turned, radians."""
        return float(np.linalg.norm(self.model_from_model.rotation_vector()))


def realign(
    camera: CameraModel,
    points: ArrayLike,
    pixels: ArrayLike,
    *,
    sigma: float = 0.5,
    keep_place: bool = False,
) -> Realignment:
    """Turn the posed `camera` so that model `points` (N, 3) lie at `pixels` (N, 2).

    `sigma` is the standard deviation of a click in pixels. With `keep_place` three pairs and
    more turn only, too.

    Raises
    ------
    UserError
        Points behind the camera or pixels beyond the lens, points in a line, a turn beyond 60
        degrees, pairs that do not fit together, a single one that the others contradict.

    """
    from scipy import stats

    p, q = np.asarray(points, float), np.asarray(pixels, float)
    if p.ndim != 2 or p.shape[1] != 3 or q.shape != (len(p), 2) or not len(p):
        raise UserError("every point of the model needs its pixel, and one pair at least")
    if not (np.isfinite(p).all() and np.isfinite(q).all()):
        raise UserError("points and pixels must be finite")
    old = camera.world_from_camera
    there = old.inverse().apply(p)
    was = camera.project(there)
    if not np.isfinite(was).all():
        bad = int(np.argmax(~np.isfinite(was).all(axis=1))) + 1
        raise UserError(f"point {bad} of the model is not before the camera")
    rays = camera.unproject(q)
    if not np.isfinite(rays).all():
        x, y = q[~np.isfinite(rays).all(axis=1)][0]
        raise UserError(f"the lens does not see pixel {x:g},{y:g}")
    unit = there / np.linalg.norm(there, axis=1, keepdims=True)
    start = Pose(_turn(unit, rays), np.zeros(3)) @ old.inverse()
    freedom = 2 if len(p) == 1 else 3 if len(p) == 2 or keep_place else 6
    covariance = np.full((6, 6), np.nan)
    now, misfit, wrong = start, 1.0, tuple[WrongClick, ...]()
    if freedom > 2:
        free = TURN if freedom == 3 else POSE
        _check_spread(unit, p, freedom)
        evidence = Evidence(p, q, sigma)
        fit = refine(camera, start, evidence, free)
        if fit is None:
            raise UserError("no turn of the camera brings the points near their pixels")
        spare = 2 * len(p) - freedom
        misfit = math.sqrt(fit.cost / spare) if spare else 1.0
        pose = fit.pose
        wrong = wrong_clicks(evidence, fit, spare, lambda e: refine(camera, pose, e, free))
        refuse_gross(wrong, "pair")
        if freedom == 6 and misfit * sigma > max(10 * sigma, 0.01 * math.hypot(*camera.size)):
            worst = int(np.argmax(np.linalg.norm(fit.rows.reshape(-1, 2), axis=1))) + 1
            raise UserError(
                f"the pairs do not fit together, they stay {misfit * sigma:.1f} px off a "
                f"coordinate, pair {worst} most: check which point belongs to which pixel, the "
                "model's unit, and the lens"
            )
        normal = fit.jacobian.T @ fit.jacobian
        size = np.sqrt(np.diag(normal))
        if not np.linalg.cond(normal / np.outer(size, size)) < 1e12:
            raise UserError(
                "these pairs leave the camera's place open: spread them over the picture, at "
                "different distances"
            )
        now, covariance = fit.pose, np.zeros((6, 6))
        spread = np.linalg.inv(normal)
        covariance[:3, :3] = spread[:3, :3]
        if freedom == 6:
            change = np.eye(6)
            change[:3, :3] *= -1
            change[3:, 3:] = -now.rotation.T
            covariance = change @ spread @ change.T
        if stats.chi2.sf(misfit**2 * spare, spare) < ALARM:  # never at no spare
            covariance *= misfit**2
    placed = now.inverse()
    move = old @ now  # the model moved, seen by the camera as it stood
    result = Realignment(
        camera=camera.posed(placed),
        model_from_model=move,
        before=np.linalg.norm(was - q, axis=1),
        after=np.linalg.norm(camera.project(now.apply(p)) - q, axis=1),
        freedom=freedom,
        covariance=covariance,
        misfit=misfit,
        wrong=wrong,
    )
    if result.turn > LARGEST:
        raise UserError(
            f"the pairs turn the camera by {math.degrees(result.turn):.0f} degrees: check "
            "which point belongs to which pixel, or find the pose anew with `calibrate match`"
        )
    return result


def _turn(unit: Array, rays: Array) -> Array:
    """The rotation that takes unit directions to `rays`: the least one, or least squares."""
    if len(unit) == 1:
        axis = np.cross(unit[0], rays[0])
        sine, cosine = float(np.linalg.norm(axis)), float(unit[0] @ rays[0])
        angle = math.atan2(sine, cosine)
        return Pose.from_rotation_vector(
            axis * (angle / sine if sine > 1e-15 else 1.0), np.zeros(3)
        ).rotation
    u, _, vt = np.linalg.svd(rays.T @ unit)
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, float)


def _check_spread(unit: Array, points: Array, freedom: int) -> None:
    if freedom == 3:
        if np.linalg.svd(unit, compute_uv=False)[1] < 1e-3:
            raise UserError("the pairs lie on one line of sight; one farther aside is needed")
        return
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if size[1] < 1e-6 * max(size[0], 1e-300):
        raise UserError("the model's points lie in a line, which leaves a turn about it open")
