"""Calibrated cameras as maps, and lenses as people type them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, override, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from chromeball.envmap.kernel import Projection
from chromeball.envmap.mapping.base import (
    Array,
    Mapping,
    Pattern,
    each_its_own,
    pixel_grid,
    triangle,
)
from chromeball.envmap.mapping.latlong import LatLong
from chromeball.envmap.mapping.radial import Radial
from chromeball.scene.camera import CUBE_FACES as FACES
from chromeball.scene.camera import FISHEYE_MODELS, CameraModel
from chromeball.scene.errors import UserError

_NODES = 512  # nodes a side of a face of an arbitrary lens's table


@runtime_checkable
class Projects(Protocol):
    """Directions in camera axes to pixels and back: a camera, or a camera and a mirror."""

    def project(self, directions: ArrayLike, /) -> Array:
        """(..., 3) to (..., 2), NaN where unseen."""
        ...

    def unproject(self, pixels: ArrayLike, /) -> Array:
        """(..., 2) to (..., 3) unit, NaN where nothing is seen."""
        ...


@dataclass(frozen=True, kw_only=True)
class Lens(Mapping):
    """Any other camera, by its own projection."""

    camera: Projects

    @override
    def project(self, directions: ArrayLike) -> Array:
        q = self.camera.project(directions)
        width, height = self.size
        with np.errstate(invalid="ignore"):
            x, y = q[..., 0], q[..., 1]
            seen = (x >= -0.5) & (y >= -0.5) & (x <= width - 0.5) & (y <= height - 0.5)
            # a distortion polynomial folds back far outside: only what round-trips is seen
            back = self.camera.unproject(np.where(seen[..., None], q, 0.0))
            d = np.asarray(directions, float)
            cosine = np.sum(back * d, axis=-1) / np.linalg.norm(d, axis=-1)
        q[~(seen & (cosine > 1 - 1e-6))] = np.nan
        return q

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        return self.camera.unproject(pixels)

    @override
    def pattern(self) -> Pattern:
        """Of the spherical quadrilaterals between the rays of the pixel corners."""
        d = self._corners()
        a, b, c, e = d[:-1, :-1], d[:-1, 1:], d[1:, 1:], d[1:, :-1]
        solid = np.abs(triangle(a, b, c)) + np.abs(triangle(a, c, e))
        return each_its_own(np.where(np.isfinite(solid), solid, 0.0))

    def _corners(self) -> Array:
        return self.camera.unproject(pixel_grid(self.size, -0.5, more=1))

    @cached_property
    @override
    def kernel(self) -> Projection:
        edge = np.linspace(-1, 1, _NODES)
        a, b = np.meshgrid(edge, edge)
        faces = [
            np.array(f) + a[..., None] * np.array(r) + b[..., None] * np.array(d)
            for f, r, d, _ in FACES
        ]
        pixels = self._project_margin(np.stack(faces))
        return Projection.table(
            *self.size,
            _NODES,
            np.ascontiguousarray(pixels, np.float32),
            np.ascontiguousarray(self._corners(), np.float32),
        )

    def _project_margin(self, directions: Array) -> Array:
        """As `project`, with a margin around the picture so that its border interpolates."""
        q = self.camera.project(directions)
        margin = 0.1 * max(self.size)
        with np.errstate(invalid="ignore"):
            near = np.all((q > -margin) & (q < np.array(self.size) + margin), axis=-1)
            back = self.camera.unproject(np.where(near[..., None], q, 0.0))
            unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
            near &= np.sum(back * unit, axis=-1) > 1 - 1e-6
        q[~near] = np.nan
        return q


def of_camera(camera: CameraModel) -> Mapping:
    """The mapping of a camera; its pose is left out (`turned` gives it one)."""
    if camera.model == "latlong":
        return LatLong(camera.size)
    if camera.model not in FISHEYE_MODELS:
        return Lens(camera.size, camera=camera)
    values = camera.intrinsics
    fx, fy, cx, cy = values[:4] if camera.model == "kb4" else values[[0, 0, 1, 2]]

    # r(theta) goes on beyond the rim, where the formula does: a rim may turn out to lie there
    whole = camera if camera.model == "kb4" else replace(camera, max_angle=math.pi)

    def radius(theta: Array) -> Array:
        d = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
        # the sign: at 180 degrees sin theta rounds to either side of zero
        return np.abs(whole.project(d)[..., 0] - cx) / fx

    def angle(r: Array) -> Array:
        d = whole.unproject(np.stack([cx + fx * r, np.full_like(r, cy)], axis=-1))
        theta = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2])
        # rounding at the rim
        return np.where(np.isfinite(theta), theta, whole.max_angle)

    return Radial(
        camera.size,
        focal=(float(fx), float(fy)),
        centre=(float(cx), float(cy)),
        radius=radius,
        angle=angle,
        max_angle=camera.max_angle,
    )


def parse_lens(spec: str, size: tuple[int, int]) -> CameraModel:
    """``equisolid:FOV[:cx,cy,radius]``, degrees and pixels, as a fisheye on `size`.

    An empty centre or radius is the picture's own.

    Raises
    ------
    UserError
        When it cannot be read.

    """
    model, _, rest = spec.partition(":")
    fov_text, _, circle_text = rest.partition(":")
    try:
        fov = float(fov_text)
        cx, cy, radius = (
            float(v) if v.strip() else None for v in (circle_text or ",,").split(",")
        )
        if not 0 < fov <= 360 or (radius is not None and not 0 < radius < math.inf):
            raise ValueError
        if (cx is None) != (cy is None):
            raise ValueError
    except ValueError as error:
        raise UserError(
            f"--lens {spec!r}: write MODEL:FOV or MODEL:FOV:cx,cy,radius, e.g. equisolid:186"
        ) from error
    return CameraModel.fisheye(
        model,
        size,
        math.radians(fov),
        centre=None if cx is None or cy is None else (cx, cy),
        radius=radius,
    )
