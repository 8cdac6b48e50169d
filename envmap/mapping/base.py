"""What every map of the sphere can do; axes, pixel centres, units are said in the package."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.kernel import Projection, SolidAngles
from chromeball.scene.camera import WORLD_FROM_LATLONG

type Array = NDArray[np.float64]


class Pattern(NamedTuple):
    """Pixel (x, y) has ``values[lines[y], columns[x]]``; a cube's, where there is a face."""

    values: Array
    lines: NDArray[np.int64]
    columns: NDArray[np.int32]

    def spread(self) -> Array:
        """(H, W)."""
        return self.values[self.lines[:, None], self.columns[None, :]]


def each_its_own(values: Array) -> Pattern:
    """The pattern of a map (H, W) without symmetry."""
    height, width = values.shape
    return Pattern(values, np.arange(height), np.arange(width, dtype=np.int32))


def mirrored(quarter: Array, size: tuple[int, int]) -> Pattern:
    """The pattern of a map that is alike on both sides of its middle lines.

    `quarter` begins at the middle and goes right and down; of an odd size it has the middle
    line.
    """
    width, height = size
    lines = np.abs(2 * np.arange(height) - (height - 1)) // 2
    columns = np.abs(2 * np.arange(width) - (width - 1)) // 2
    return Pattern(quarter, lines, columns.astype(np.int32))


@dataclass(frozen=True)
class Mapping(ABC):
    """A picture of the sphere: ``size`` is width and height in pixels."""

    size: tuple[int, int]
    rotation: Array = field(default_factory=lambda: WORLD_FROM_LATLONG.rotation)

    def turned(self, world_from_camera: Array) -> Mapping:
        """The same picture, turned in the world."""
        return replace(self, rotation=np.asarray(world_from_camera, float))

    @abstractmethod
    def project(self, directions: ArrayLike) -> Array:
        """Directions in camera axes to pixels, ``(..., 3) -> (..., 2)``; NaN where unseen."""

    @abstractmethod
    def unproject(self, pixels: ArrayLike) -> Array:
        """Pixels to unit directions in camera axes, ``(..., 2) -> (..., 3)``; NaN outside."""

    @abstractmethod
    def pattern(self) -> Pattern:
        """Exact solid angles of the valid parts of the pixels, those that are alike once."""

    def solid_angles(self) -> Array:
        """Exact solid angle of the valid part of each pixel, (H, W) steradians."""
        return self.pattern().spread()

    @cached_property
    @abstractmethod
    def kernel(self) -> Projection:
        """The same mapping for the C++ kernel."""

    @cached_property
    def _pattern(self) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int32]]:
        values, lines, columns = self.pattern()
        return np.ascontiguousarray(values, np.float32), lines, columns

    @cached_property
    def solid(self) -> SolidAngles:
        """:meth:`solid_angles` for the kernel."""
        return SolidAngles(self.kernel, *self._pattern)

    @cached_property
    def omega(self) -> NDArray[np.float32]:
        """:meth:`solid_angles` as float32, (H, W), or (H, 1) of even rows."""
        return self.solid.rows(0, self.size[1])

    @cached_property
    def density(self) -> float:
        """Pixels a radian, typically."""
        omega = self._pattern[0].reshape(-1)
        step = max(1, len(omega) // 20_000) | 1
        return float(1 / np.sqrt(np.median(omega[omega > 0][::step])))

    @cached_property
    def whole(self) -> bool:
        """Whether it sees the whole sphere."""
        return abs(self.solid.total() - 4 * math.pi) < 1e-4

    def pixels_of(self, world: ArrayLike) -> Array:
        """Directions in world axes to pixels, ``(..., 3) -> (..., 2)``; NaN where unseen."""
        return self.project(np.asarray(world, float) @ self.rotation)

    def directions(self) -> Array:
        """World directions of all pixel centres, (H, W, 3); NaN outside the map."""
        return self.unproject(pixel_grid(self.size)) @ self.rotation.T


def pixel_grid(size: tuple[int, int], offset: float = 0.0, more: int = 0) -> Array:
    """All pixel centres moved by `offset`, ``(H + more, W + more, 2)``, x first."""
    x, y = np.meshgrid(
        np.arange(size[0] + more, dtype=float) + offset,
        np.arange(size[1] + more, dtype=float) + offset,
    )
    return np.stack([x, y], axis=-1)


def triangle(a: Array, b: Array, c: Array) -> Array:
    """Solid angle of spherical triangles (Van Oosterom and Strackee 1983)."""
    triple = np.sum(a * np.cross(b, c), axis=-1)
    ab, bc, ca = (np.sum(u * v, axis=-1) for u, v in ((a, b), (b, c), (c, a)))
    return 2 * np.arctan2(triple, 1 + ab + bc + ca)
