"""Longitude across, latitude down."""

from __future__ import annotations

import math
from functools import cached_property
from typing import override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.kernel import Projection
from chromeball.envmap.mapping.base import Array, Mapping, Pattern
from chromeball.scene.camera import CameraModel


class LatLong(Mapping):
    """Longitude across, latitude down; a 2:1 panorama."""

    @cached_property
    def _camera(self) -> CameraModel:
        return CameraModel.latlong(self.size)

    @override
    def project(self, directions: ArrayLike) -> Array:
        return self._camera.project(directions)

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        return self._camera.unproject(pixels)

    @override
    def pattern(self) -> Pattern:
        width, height = self.size
        edges = np.linspace(-math.pi / 2, math.pi / 2, height + 1)
        # sin b - sin a without cancellation
        middle, half = (edges[1:] + edges[:-1]) / 2, math.pi / (2 * height)
        rows = 2 * np.cos(middle) * math.sin(half) * (2 * math.pi / width)
        return Pattern(rows[:, None], np.arange(height), np.zeros(width, np.int32))

    @cached_property
    @override
    def omega(self) -> NDArray[np.float32]:
        return self._pattern[0]

    @cached_property
    @override
    def whole(self) -> bool:
        return True

    @cached_property
    @override
    def kernel(self) -> Projection:
        return Projection.latlong(*self.size)
