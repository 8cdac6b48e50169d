"""The octahedral map (Praun and Hoppe 2003; Cigolle et al. 2014), +Z in the middle."""

from __future__ import annotations

from functools import cached_property
from typing import override

import numpy as np
from numpy.typing import ArrayLike

from chromeball.envmap.kernel import Projection
from chromeball.envmap.mapping.base import Array, Mapping, triangle


class Octahedral(Mapping):
    """``p = d / (|x| + |y| + |z|)``; the half behind is folded out over the corners.

    A square of even width. Per ``du dv`` of the unit square a pixel sees ``4 / |p|^3``.
    """

    @override
    def project(self, directions: ArrayLike) -> Array:
        d = np.asarray(directions, float)
        p = d / np.abs(d).sum(axis=-1, keepdims=True)
        folded = (1 - np.abs(p[..., 1::-1])) * np.where(p[..., :2] < 0, -1, 1)
        uv = np.where(p[..., 2:] >= 0, p[..., :2], folded)
        return (uv + 1) / 2 * np.array(self.size) - 0.5

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        uv = 2 * (np.asarray(pixels, float) + 0.5) / np.array(self.size) - 1
        p = _unfolded(uv)
        p = p / np.linalg.norm(p, axis=-1, keepdims=True)
        p[(np.abs(uv) > 1 + 1e-12).any(axis=-1)] = np.nan
        return p

    @override
    def solid_angles(self) -> Array:
        """Of two spherical triangles a pixel: its straight edges are great circles.

        The fold runs along the diagonals of pixels, so a triangle lies in one face.
        """
        half = self.size[0] // 2
        edge = np.arange(half + 1) / half
        u, v = np.meshgrid(edge, edge)
        d = _unfolded(np.stack([u, v], axis=-1))
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        a, b, c, e = d[:-1, :-1], d[:-1, 1:], d[1:, 1:], d[1:, :-1]
        quarter = np.abs(triangle(a, b, e)) + np.abs(triangle(b, c, e))
        right = np.concatenate([quarter[::-1], quarter])
        return np.concatenate([right[:, ::-1], right], axis=1)

    @cached_property
    @override
    def kernel(self) -> Projection:
        return Projection.octahedral(*self.size)


def _unfolded(uv: Array) -> Array:
    """The point of the octahedron that the square's point ``uv`` (-1..1) stands for."""
    z = 1 - np.abs(uv).sum(axis=-1, keepdims=True)
    behind = (1 - np.abs(uv[..., ::-1])) * np.where(uv < 0, -1, 1)
    return np.concatenate([np.where(z >= 0, uv, behind), z], axis=-1)
