"""The octahedral map (Praun and Hoppe 2003; Cigolle et al. 2014), +Z in the middle."""

from __future__ import annotations

from functools import cached_property
from typing import override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.kernel import Projection
from chromeball.envmap.mapping.base import Array, Mapping, Pattern, mirrored, triangle

_COARSE = 96  # pixels of a quarter's side below which every pixel is made of triangles


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
    def pattern(self) -> Pattern:
        """Of two spherical triangles a pixel: its straight edges are great circles.

        The fold runs along the diagonals of pixels, so a triangle lies in one face, and each
        quarter is alike on both sides of its fold. Large pictures use the triangles at the fold
        alone; elsewhere the density J + laplace(J) / 24 is exact to the fourth order.
        """
        half = self.size[0] // 2
        j, i = np.mgrid[:half, :half]
        if half < _COARSE:
            return mirrored(_triangles(i, j, half), self.size)
        u, v = (np.arange(half) + 0.5)[None, :] / half, (np.arange(half) + 0.5)[:, None] / half
        # beyond the fold what lies across it
        beyond = i + j >= half
        u, v = np.where(beyond, 1 - v, u), np.where(beyond, 1 - u, v)
        w = 1 - u - v
        q = u * u + v * v + w * w  # |p|^2; J = q^-3/2 per du dv
        # its gradient has (2 (u - w), 2 (v - w)), its Laplacian is 8
        slope = 4 * ((u - w) ** 2 + (v - w) ** 2)
        laplace = (3.75 * slope / q - 12) / q
        quarter = q**-1.5 / half**2 * (1 + laplace / (24 * half**2))
        k = np.arange(half)
        quarter[k, half - 1 - k] = _triangles(half - 1 - k, k, half)
        return mirrored(quarter, self.size)

    @cached_property
    @override
    def whole(self) -> bool:
        return True

    @cached_property
    @override
    def kernel(self) -> Projection:
        return Projection.octahedral(*self.size)


def _triangles(i: NDArray[np.intp], j: NDArray[np.intp], half: int) -> Array:
    """Solid angles of pixels (i, j) right of and below the middle."""

    def corner(x: NDArray[np.intp], y: NDArray[np.intp]) -> Array:
        d = _unfolded(np.stack([x, y], axis=-1) / half)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    a, b, c, e = corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)
    return np.abs(triangle(a, b, e)) + np.abs(triangle(b, c, e))


def _unfolded(uv: Array) -> Array:
    """The point of the octahedron that the square's point ``uv`` (-1..1) stands for."""
    z = 1 - np.abs(uv).sum(axis=-1, keepdims=True)
    behind = (1 - np.abs(uv[..., ::-1])) * np.where(uv < 0, -1, 1)
    return np.concatenate([np.where(z >= 0, uv, behind), z], axis=-1)
