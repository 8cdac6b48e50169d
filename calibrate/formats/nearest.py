"""The camera of a model that a file can hold, and what the change costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.convert import converted, is_flat
from chromeball.calibrate.formats.named import Loss, fisheye
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: Each of a family is the next with its last terms zero.
_FAMILIES = (
    ("pinhole", *(f"LENSMODEL_OPENCV{n}" for n in (4, 5, 8, 12))),
    ("kb4", "kb4_decentred"),
)
#: Names for `--model`.
MODELS = {
    "pinhole": "pinhole",
    **{f"opencv{n}": f"LENSMODEL_OPENCV{n}" for n in (4, 5, 8, 12)},
    **{name: name for name in ("kb4", "kb4_decentred", "equidistant", "equisolid")},
    "stereographic": "stereographic",
}
#: Samples across the picture that a conversion is fitted and judged over.
SAMPLES = 48
#: Flat models are fitted and judged up to this cosine, 85 degrees.
GRAZING = 0.09
#: A direction that comes back this far from its pixel is none: there the model folds, px.
_FOLD = 1e-3


def nearest(camera: CameraModel, models: Sequence[str]) -> tuple[CameraModel, Loss | None]:
    """`camera` if its model is one of `models`, or the best of them over its picture.

    Nothing is lost, None, where the model is another's special case. Else the richest of each
    family in `models` is fitted by least squares; the one that reaches most of the picture is
    taken, then the one with the least error.

    Raises
    ------
    UserError
        The camera is a panorama, or no model comes near it.

    """
    if camera.model in models:
        return camera, None
    for model in models:
        same = _embedded(camera, model)
        if same is not None:
            return same, None
    if camera.model in ("latlong", "cube"):
        raise UserError(
            f"a panorama ({camera.model}) is not a lens: this format has no such camera"
        )
    pixels, rays = directions(camera)
    fits: list[tuple[CameraModel, Loss]] = []
    for model in _richest(models):
        found, _ = converted(camera, model, rays)
        if model.startswith("kb4"):
            found = fisheye(found.intrinsics, found.size, found.world_from_camera)
        found = replace(found, region=camera.region)
        fits.append((found, loss(found, camera.model, pixels, rays)))
    if not fits:
        raise UserError(f"this format has no lens like {camera.model}")
    return min(fits, key=lambda fit: (round(fit[1].left_out, 3), fit[1].rms))


def _richest(models: Sequence[str]) -> list[str]:
    """Of each family the model with most terms, and those of no family; no panoramas."""
    found = [m for m in models if m not in ("latlong", "cube", *_FAMILIES[0], *_FAMILIES[1])]
    for family in _FAMILIES:
        found += [model for model in family if model in models][-1:]
    return found


def directions(camera: CameraModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (N, 2) over the picture that the lens reaches and their unit rays (N, 3)."""
    width, height = camera.size
    x = np.linspace(-0.5, width - 0.5, SAMPLES)
    y = np.linspace(-0.5, height - 0.5, max(12, round(SAMPLES * height / width)))
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = camera.unproject(pixels)
    with np.errstate(invalid="ignore"):
        miss = np.linalg.norm(camera.project(rays) - pixels, axis=1)
    known = miss < _FOLD
    return pixels[known], rays[known]


def loss(
    camera: CameraModel, was: str, pixels: NDArray[np.float64], rays: NDArray[np.float64]
) -> Loss:
    """How far from `pixels` (N, 2) the `camera` sees `rays` (N, 3) that a lens saw there."""
    distance = np.linalg.norm(camera.project(rays) - pixels, axis=1)
    reached = np.isfinite(distance)
    if is_flat(camera.model):
        reached &= rays[:, 2] > GRAZING
    if not reached.any():
        return Loss(was, camera.model, math.inf, math.inf, 1.0)
    found = distance[reached]
    rms = float(np.sqrt(np.mean(found**2)))
    return Loss(was, camera.model, rms, float(found.max()), 1 - float(reached.mean()))


def _embedded(camera: CameraModel, model: str) -> CameraModel | None:
    """The same lens in words of `model`, where the terms that differ are zero."""
    if camera.model == "equidistant" and model in _FAMILIES[1]:
        f, cx, cy = camera.intrinsics
        zeros = np.zeros(4 if model == "kb4" else 6)
        values = np.array([f, f, cx, cy, *zeros])
        return replace(camera, model=model, intrinsics=values, covariance=None)
    for family in _FAMILIES:
        if camera.model in family and model in family:
            count = _count(model)
            if camera.intrinsics[count:].any():
                return None
            values = np.zeros(count)
            kept = camera.intrinsics[:count]
            values[: len(kept)] = kept
            return replace(camera, model=model, intrinsics=values, covariance=None)
    return None


def _count(model: str) -> int:
    named = {"pinhole": 4, "kb4": 8, "kb4_decentred": 10}
    return named.get(model) or 4 + int(model.removeprefix("LENSMODEL_OPENCV"))
