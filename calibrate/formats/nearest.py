"""The camera of a model that a file can hold, and what the change costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import gradients
from chromeball.calibrate.convert import converted, is_flat
from chromeball.calibrate.formats.named import Loss, fisheye
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

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
    part, free = "the picture", camera.model.startswith("LENSMODEL_SPLINED")
    if free and camera.region is not None:  # elsewhere its splines are what they began as
        part, inside = "its calibrated part", _inside(pixels, camera.region)
        pixels, rays = pixels[inside], rays[inside]
    fits: list[tuple[CameraModel, Loss]] = []
    for model in _richest(models):
        found, _ = converted(camera, model, rays)
        turn = Pose.identity()
        if free:
            found, turn = _turned(found, rays, pixels)
        if model.startswith("kb4"):
            found = fisheye(found.intrinsics, found.size)
        found = replace(
            found,
            region=camera.region,
            world_from_camera=camera.world_from_camera @ turn.inverse(),
        )
        cost = loss(found, camera.model, pixels, turn.rotate(rays))
        angle = float(np.linalg.norm(turn.rotation_vector()))
        fits.append((found, replace(cost, part=part, turned=angle)))
    if not fits:
        raise UserError(f"this format has no lens like {camera.model}")
    return min(fits, key=lambda fit: (round(fit[1].left_out, 3), fit[1].rms))


def _richest(models: Sequence[str]) -> list[str]:
    """Of each family the model with most terms, and those of no family; no panoramas."""
    found = [m for m in models if m not in ("latlong", "cube", *_FAMILIES[0], *_FAMILIES[1])]
    for family in _FAMILIES:
        found += [model for model in family if model in models][-1:]
    return found


def _turned(
    camera: CameraModel, rays: NDArray[np.float64], pixels: NDArray[np.float64]
) -> tuple[CameraModel, Pose]:
    """The lens and the turn that see `rays` (N, 3), turned, nearest to `pixels` (N, 2).

    A splined lens has no axis: it may have been solved turned by degrees against its pose, also
    about itself, which no other model can follow. `camera` is the start.
    """
    from scipy.optimize import least_squares

    if is_flat(camera.model):
        ahead = rays[:, 2] > GRAZING
        rays, pixels = rays[ahead], pixels[ahead]
    count, turn = len(camera.intrinsics), Pose.identity()

    def seen(x: NDArray[np.float64]) -> tuple[CameraModel, NDArray[np.float64]]:
        step = Pose.from_rotation_vector(x[count:], np.zeros(3))
        return replace(camera, intrinsics=x[:count]), (step @ turn).rotate(rays)

    def miss(x: NDArray[np.float64]) -> NDArray[np.float64]:
        lens, points = seen(x)
        return np.nan_to_num((gradients(lens, points)[0] - pixels).ravel(), nan=1e6)

    def slope(x: NDArray[np.float64]) -> NDArray[np.float64]:
        lens, points = seen(x)
        _, by_point, by_intrinsics = gradients(lens, points)
        by_turn = np.cross(points[:, None], by_point)  # at no turn
        return np.nan_to_num(
            np.concatenate([by_intrinsics, by_turn], -1).reshape(-1, count + 3)
        )

    solve: Any = least_squares
    for _ in range(2):
        start = np.concatenate([camera.intrinsics, np.zeros(3)])
        x = solve(miss, start, slope, x_scale="jac", ftol=1e-6, max_nfev=60).x
        turn = Pose.from_rotation_vector(x[count:], np.zeros(3)) @ turn
        camera = replace(camera, intrinsics=x[:count])
    return camera, turn


def _inside(
    pixels: NDArray[np.float64], region: NDArray[np.floating[Any]]
) -> NDArray[np.bool_]:
    """Which of `pixels` (N, 2) lie in the polygon `region` (M, 2)."""
    from matplotlib.path import Path as Polygon

    return np.asarray(Polygon(np.asarray(region, float)).contains_points(pixels), bool)


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
