"""A picture as a perfect perspective camera would have taken it (seeds A1)."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError


def undistorted_camera(camera: CameraModel, fov: float | None = None) -> CameraModel:
    """The perspective camera at the same place, of the same size.

    `fov` is its horizontal field of view in radians; by default the focal lengths and the
    principal point of the lens are kept, FOV = 2 atan(width / 2 f).
    """
    if fov is not None:
        if not 0 < fov < math.radians(175):
            raise UserError("a perspective picture shows more than 0 and less than 175 degrees")
        return CameraModel.pinhole(camera.size, fov, camera.world_from_camera)
    if camera.model == "latlong":
        raise UserError("a panorama has no focal length; give the field of view, --fov 90")
    values = camera.intrinsics
    core = values[:4] if len(values) >= 4 else np.array([values[0], *values])
    return CameraModel("pinhole", core, camera.size, camera.world_from_camera)


def undistort(
    pixels: NDArray[Any], camera: CameraModel, target: CameraModel
) -> tuple[NDArray[Any], int]:
    """Resample `pixels` (H, W, C) of `camera` to the pixels of `target` at the same place.

    Bicubic, within the values that the four neighbours span, so that no edge rings and radiance
    stays positive. Returns the picture, black where `camera` sees nothing, and how many pixels
    that are.
    """
    height, width = pixels.shape[:2]
    if (width, height) != camera.size:
        raise UserError(
            "the camera model is for pictures of {}x{}, this one is {}x{}".format(
                *camera.size, width, height
            )
        )
    q = camera.project(target.unproject(target.pixel_grid()))
    with np.errstate(invalid="ignore"):
        seen = ((q >= -0.5) & (q <= [width - 0.5, height - 0.5])).all(axis=-1)
    x, y = (np.where(seen, q[..., i], -1).astype(np.float32) for i in range(2))
    source = pixels.astype(np.float32)
    planes: list[NDArray[np.float32]] = []
    kernel = np.ones((2, 2), np.uint8)
    for channel in np.moveaxis(source, -1, 0):
        plane = np.ascontiguousarray(channel)
        value = cv2.remap(plane, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        # Extremes of the 2 x 2 neighbours of each sample: anchor at their upper left.
        low, high = (
            cv2.remap(
                f(plane, kernel, anchor=(0, 0), borderType=cv2.BORDER_REPLICATE),
                np.floor(x), np.floor(y), cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE,
            )
            for f in (cv2.erode, cv2.dilate)
        )  # fmt: skip
        planes.append(np.asarray(np.clip(value, low, high), np.float32))
    result = np.where(seen[..., None], np.stack(planes, axis=-1), 0)
    if np.issubdtype(pixels.dtype, np.integer):
        result = np.round(result)
    return result.astype(pixels.dtype), int((~seen).sum())
