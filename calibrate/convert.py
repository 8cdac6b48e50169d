"""A lens in the words of another model: the camera nearest to it over given directions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import gradients
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: Models of pictures in a plane: they end 90 degrees from the axis.
FLAT = ("pinhole", "LENSMODEL_OPENCV", "LENSMODEL_PINHOLE")
#: mrcal's, between perspective (linearity 1) and fisheye (0).
CAHVORE = "LENSMODEL_CAHVORE_linearity=0.37"
#: More rays say no more.
_ENOUGH = 600
#: Directions nearer than this to the plane of the lens (cosine) say nothing of a flat model.
_GRAZING = 0.09


def is_flat(model: str) -> bool:
    """Whether a model ends 90 degrees from the axis."""
    return model.startswith(FLAT)


def converted(
    camera: CameraModel, model: str, rays: NDArray[np.float64]
) -> tuple[CameraModel, float]:
    """The camera of `model` that sees unit `rays` (N, 3) most nearly where `camera` does.

    With it comes the RMS distance in pixels over those rays; for a flat model rays beyond 85
    degrees are left out of both.

    Raises
    ------
    UserError
        When fewer than twelve of the rays are left.

    """
    if is_flat(model):
        rays = rays[rays[:, 2] > _GRAZING]
    pixels = camera.project(rays)
    seen = np.isfinite(pixels).all(axis=1)
    rays, pixels = rays[seen], pixels[seen]
    if len(rays) < 12:
        raise UserError(f"a lens in {model} needs directions up to 85 degrees from the axis")
    few = np.linspace(0, len(rays) - 1, min(len(rays), _ENOUGH)).astype(int)
    rays, pixels = rays[few], pixels[few]
    return fitted(_start(camera, model), rays, pixels)


def fitted(
    start: CameraModel, rays: NDArray[np.float64], pixels: NDArray[np.float64]
) -> tuple[CameraModel, float]:
    """The camera of `start`'s model that sees `rays` (N, 3) nearest to `pixels` (N, 2).

    With it comes the RMS distance in pixels.
    """
    from scipy.optimize import least_squares

    free = free_terms(start.model)

    def at(values: NDArray[np.float64]) -> CameraModel:
        intrinsics = start.intrinsics.copy()
        intrinsics[free] = values
        return replace(start, intrinsics=intrinsics)

    def miss(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.nan_to_num((gradients(at(values), rays)[0] - pixels).ravel(), nan=1e6)

    def slope(values: NDArray[np.float64]) -> NDArray[np.float64]:
        by = gradients(at(values), rays)[2]
        return np.nan_to_num(by.reshape(-1, len(free))[:, free])

    # Terms that hardly differ over these rays would be followed for ever.
    solve: Any = least_squares
    found = solve(miss, start.intrinsics[free], slope, x_scale="jac", ftol=1e-6, max_nfev=60)
    return at(found.x), float(np.sqrt(2 * np.mean(found.fun**2)))


def _start(camera: CameraModel, model: str) -> CameraModel:
    """The same focal lengths and centre, no distortion."""
    k = camera.intrinsics
    fx, fy, cx, cy = k[:4] if len(k) > 3 else k[[0, 0, 1, 2]]
    count = parameters(model)
    values = np.zeros(count)
    if count == 3:
        values[:] = [(fx + fy) / 2, cx, cy]
    else:
        values[:4] = [fx, fy, cx, cy]
    return CameraModel(model, values, camera.size, camera.world_from_camera)


def free_terms(model: str) -> NDArray[np.bool_]:
    """Which of a model's intrinsics are its own to choose, (k,).

    CAHVORE's r0 does what the focal length does, and its E is the travel of the pupil, which
    :class:`chromeball.calibrate.adjust.Estimate` has for all models: with it mrcal cannot turn
    pixels into rays. Both stay zero.
    """
    free = np.ones(parameters(model), bool)
    if model == CAHVORE:
        free[[6, 9, 10, 11]] = False
    return free


def parameters(model: str) -> int:
    """How many intrinsics a model has."""
    if model.startswith("LENSMODEL_"):
        import mrcal

        return int(mrcal.lensmodel_num_params(model))  # pyright: ignore[reportAttributeAccessIssue]
    return {"pinhole": 4, "kb4": 8, "kb4_decentred": 10}.get(model, 3)
