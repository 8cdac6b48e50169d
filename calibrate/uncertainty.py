"""How well a lens is known: covariance of projection from that of the intrinsics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import gradients
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: Places across and down the picture that are looked at.
PLACES = 24


def projection_covariance(
    camera: CameraModel,
    covariance: NDArray[np.float64],
    support: NDArray[np.float64],
    rays: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Covariance (..., 2, 2) of where points at infinity along unit `rays` are seen, px^2.

    `covariance` (k, k) is that of the intrinsics; see :func:`projection_slopes`. It is the
    error from corner noise alone; what the model cannot express is not in it.
    """
    j = projection_slopes(camera, support, rays)
    return np.asarray(j @ covariance @ np.swapaxes(j, -1, -2), float)


def projection_slopes(
    camera: CameraModel, support: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How pixels of unit `rays` (..., 3) move with the intrinsics, (..., 2, k).

    Other intrinsics look like a turned camera in part, which no use of the lens minds: the turn
    w that fits best over the `support`, unit rays (N, 3) to where corners were seen, is taken
    out, dq = dq/di di + dq/dp (w x p) (Kogan's mrcal).
    """
    by_turn, by_intrinsics = _sensitivity(camera, support)
    known = np.isfinite(by_turn).all(axis=(1, 2))
    w = -np.linalg.lstsq(
        by_turn[known].reshape(-1, 3),
        by_intrinsics[known].reshape(-1, len(camera.intrinsics)),
        rcond=None,
    )[0]
    by_turn, by_intrinsics = _sensitivity(camera, rays)
    return by_intrinsics + by_turn @ w


def camera_uncertainty(camera: CameraModel, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """As :func:`projection_covariance`, (..., 2, 2), from what a camera's file says.

    Unit `rays` are in camera axes; the support is the file's valid region.

    Raises
    ------
    UserError
        When the file says nothing of its uncertainty.

    """
    if camera.covariance is None or camera.region is None:
        raise UserError("the camera's file does not say how well it is known; calibrate it")
    return projection_covariance(camera, camera.covariance, _inside(camera), rays)


def seen_places(camera: CameraModel) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels (N, 2) over the picture, and whether corners told the lens there, (N,).

    Raises
    ------
    UserError
        When the file says nothing of the region that it was solved from.

    """
    import cv2

    if camera.region is None:
        raise UserError("the camera's file does not say where it is known; calibrate it")
    width, height = camera.size
    x, y = np.meshgrid(
        (np.arange(PLACES) + 0.5) * width / PLACES - 0.5,
        (np.arange(PLACES) + 0.5) * height / PLACES - 0.5,
    )
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    region = camera.region.astype(np.float32)
    inside = [cv2.pointPolygonTest(region, (u, v), False) >= 0 for u, v in pixels.tolist()]
    return pixels, np.array(inside)


def worst_direction(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation (...) along the longer axis of covariances (..., 2, 2)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.asarray(np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b)), float)


def _inside(camera: CameraModel) -> NDArray[np.float64]:
    """Unit rays (N, 3) over the region where corners were seen."""
    import cv2

    assert camera.region is not None
    region = camera.region.astype(np.float32)
    low, high = region.min(axis=0), region.max(axis=0)
    x, y = np.meshgrid(np.linspace(low[0], high[0], 24), np.linspace(low[1], high[1], 24))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)
    inside = [cv2.pointPolygonTest(region, (u, v), False) >= 0 for u, v in pixels.tolist()]
    rays = camera.unproject(pixels[inside])
    return rays[np.isfinite(rays).all(axis=1)]


def _sensitivity(
    camera: CameraModel, rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """D pixel / d turn (..., 2, 3) and d pixel / d intrinsics (..., 2, k)."""
    _, by_point, by_intrinsics = gradients(camera, np.ascontiguousarray(rays))
    return np.cross(rays[..., None, :], by_point), by_intrinsics
