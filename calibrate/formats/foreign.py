"""Lens models of other tools that are none of ours, and the lens nearest to them.

Each projection takes unit rays (N, 3) to pixels (N, 2), NaN where the lens does not see.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.convert import fitted, is_flat
from chromeball.calibrate.formats.named import Loss, fisheye
from chromeball.calibrate.formats.nearest import GRAZING, directions, loss
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Projection = Callable[[NDArray[np.float64]], NDArray[np.float64]]

#: Directions that the lens nearest to a foreign one is fitted over.
SAMPLES = 600


def nearest_to(
    project: Projection,
    was: str,
    size: tuple[int, int],
    pose: Pose | None = None,
    model: str = "kb4",
) -> tuple[CameraModel, Loss]:
    """The camera of `model` nearest to a lens known by its projection, over its picture.

    Raises
    ------
    UserError
        The lens sees nothing in its picture.

    """
    rays = _inside(project, size)
    if is_flat(model):
        rays = rays[rays[:, 2] > GRAZING]
    pixels = project(rays)
    if len(rays) < 12:
        raise UserError(f"the {was} lens shows nothing in a picture of {size[0]}x{size[1]}")
    # Focal lengths and centre of the start are those of the foreign lens on its axis.
    step = 1e-4
    probe = np.array([[0, 0, 1.0], [step, 0, 1], [0, step, 1]])
    at = project(probe / np.linalg.norm(probe, axis=1, keepdims=True))
    core = [(at[1, 0] - at[0, 0]) / step, (at[2, 1] - at[0, 1]) / step, *at[0]]
    if not np.isfinite(core).all():
        raise UserError(f"the {was} lens does not see along its own axis")
    count = {"kb4": 8, "kb4_decentred": 10}.get(model, 4)
    count = int(model.removeprefix("LENSMODEL_OPENCV")) + 4 if "OPENCV" in model else count
    values = np.zeros(count)
    values[:4] = core
    camera, _ = fitted(CameraModel(model, values, size), rays, pixels)
    # Once more over an even grid of pixels, corners included.
    _, rays = directions(camera)
    pixels = project(rays)
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    some = seen[np.linspace(0, len(seen) - 1, min(len(seen), SAMPLES)).astype(int)]
    camera, _ = fitted(camera, rays[some], pixels[some])
    if model.startswith("kb4"):
        camera = fisheye(camera.intrinsics, size)
    cost = loss(camera, was, pixels[seen], rays[seen])
    return camera.posed(pose or Pose.identity()), cost


def _inside(project: Projection, size: tuple[int, int]) -> NDArray[np.float64]:
    """Unit rays spread evenly over what the picture shows, (N, 3)."""

    def seen(theta: NDArray[np.float64], phi: NDArray[np.float64]) -> NDArray[np.float64]:
        sine = np.sin(theta)
        rays = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1)
        q = project(rays)
        with np.errstate(invalid="ignore"):
            there = ((q >= -0.5) & (q <= np.array(size) - 0.5)).all(axis=-1)
        return rays[there]

    angles, turns = np.meshgrid(
        np.geomspace(1e-3, math.pi, 300), np.linspace(0, 2 * math.pi, 24, endpoint=False)
    )
    rough = seen(angles.ravel(), turns.ravel())
    if not len(rough):
        return rough
    limit = float(np.arccos(np.clip(rough[:, 2].min(), -1, 1))) * 1.05
    k = np.arange(SAMPLES)
    golden = math.pi * (3 - math.sqrt(5))  # a spiral of equal areas
    theta = np.minimum(limit * np.sqrt((k + 0.5) / SAMPLES), math.pi)
    return seen(np.asarray(theta, float), np.asarray(k * golden, float))


def unified(
    parameters: NDArray[np.float64], core: NDArray[np.float64], terms: NDArray[np.float64]
) -> Projection:
    """The unified model with OpenCV's distortion (Mei and Rives 2007, equations 2 and 3).

    `parameters` xi; `core` fx fy cx cy; `terms` none or k1 k2 p1 p2.
    """
    (xi,) = parameters

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        # Beyond this height two rays meet in one pixel.
        low = -1 / xi if xi > 1 else -xi
        z = np.where(rays[:, 2] > low, rays[:, 2] + xi, np.nan)
        return _pixels(_distorted(rays[:, :2] / z[:, None], terms), core)

    return project


def double_sphere(parameters: NDArray[np.float64], core: NDArray[np.float64]) -> Projection:
    """Usenko, Demmel and Cremers 2018, equations 40 to 45; `parameters` xi alpha."""
    xi, alpha = parameters

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = rays.T
        w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
        w2 = (w1 + xi) / math.sqrt(2 * w1 * xi + xi**2 + 1)
        d1 = np.sqrt(x**2 + y**2 + z**2)
        d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
        depth = alpha * d2 + (1 - alpha) * (xi * d1 + z)
        depth = np.where(z > -w2 * d1, depth, np.nan)
        return _pixels(rays[:, :2] / depth[:, None], core)

    return project


def enhanced_unified(parameters: NDArray[np.float64], core: NDArray[np.float64]) -> Projection:
    """Khomutenko, Garcia and Martinet 2016, equation 14; `parameters` alpha beta."""
    alpha, beta = parameters

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = rays.T
        d = np.sqrt(beta * (x**2 + y**2) + z**2)
        w = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
        depth = np.where(z > -w * d, alpha * d + (1 - alpha) * z, np.nan)
        return _pixels(rays[:, :2] / depth[:, None], core)

    return project


def field_of_view(parameters: NDArray[np.float64], core: NDArray[np.float64]) -> Projection:
    """Devernay and Faugeras 2001, r = atan(2 tan(w / 2) r_u) / w; `parameters` w."""
    (w,) = parameters

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        flat = rays[:, :2] / np.where(rays[:, 2] > 0, rays[:, 2], np.nan)[:, None]
        r = np.linalg.norm(flat, axis=1, keepdims=True)
        slope = 2 * math.tan(w / 2)
        scale = np.arctan(slope * r) / (w * np.where(r > 1e-9, r, 1))
        return _pixels(flat * np.where(r > 1e-9, scale, slope / w), core)

    return project


def opencv(core: NDArray[np.float64], terms: NDArray[np.float64]) -> Projection:
    """OpenCV's lens with a tilted sensor, 14 `terms`, by OpenCV."""

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        import cv2

        fx, fy, cx, cy = core
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        ahead = rays[:, 2] > 1e-3
        found = np.full((len(rays), 2), np.nan)
        if ahead.any():
            q, _ = cv2.projectPoints(rays[ahead], np.zeros(3), np.zeros(3), matrix, terms)
            found[ahead] = q.reshape(-1, 2)
        return found

    return project


def _distorted(xy: NDArray[np.float64], terms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (N, 2) in the plane z = 1 after OpenCV's k1 k2 p1 p2."""
    if not len(terms):
        return xy
    k1, k2, p1, p2 = terms
    x, y = xy.T
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _pixels(xy: NDArray[np.float64], core: NDArray[np.float64]) -> NDArray[np.float64]:
    return core[:2] * xy + core[2:]
