"""A cube's six faces in one picture: crosses and strips."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import override

import numpy as np
from numpy.typing import ArrayLike

from chromeball.envmap.kernel import Projection
from chromeball.envmap.mapping.base import Array, Mapping, Pattern, mirrored
from chromeball.scene.camera import CUBE_FACES

type Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Face:
    """A face in camera axes, and its column and row in the picture, counted in faces."""

    forward: Triple
    right: Triple
    down: Triple
    column: int
    row: int

    def at(self, column: int, row: int) -> Face:
        """The same face in another place."""
        return replace(self, column=column, row=row)

    def half_turn(self) -> Face:
        """The same face upside down."""
        a, b, c = self.right
        d, e, f = self.down
        return replace(self, right=(-a, -b, -c), down=(-d, -e, -f))


type Layout = tuple[Face, ...]

#: Horizontal cross, 4:3: left, front, right, back in the middle row, up and down about front.
CROSS: Layout = tuple(
    Face(forward, right, down, column, row)
    for forward, right, down, (column, row, _) in CUBE_FACES
)
_FRONT, _RIGHT, _BACK, _LEFT, _UP, _DOWN = CROSS
#: Vertical cross, 3:4, as HDRShop's and Debevec's: the back hangs below, upside down.
VERTICAL_CROSS: Layout = (
    _FRONT.at(1, 1),
    _RIGHT.at(2, 1),
    _BACK.at(1, 3).half_turn(),
    _LEFT.at(0, 1),
    _UP.at(1, 0),
    _DOWN.at(1, 2),
)
#: The files' order of OpenGL and three.js, px nx py ny pz nz. Seen from inside, unmirrored, px
#: is right of pz; so pz looks to +Z and px to -X.
SIX = ("px", "nx", "py", "ny", "pz", "nz")
_ORDER = (_RIGHT, _LEFT, _UP, _DOWN, _FRONT, _BACK)
STRIP: Layout = tuple(face.at(k, 0) for k, face in enumerate(_ORDER))
COLUMN: Layout = tuple(face.at(0, k) for k, face in enumerate(_ORDER))


@dataclass(frozen=True)
class Cube(Mapping):
    """A cube; :data:`CROSS` unless another layout is given."""

    layout: Layout = CROSS

    @property
    def face(self) -> int:
        """Pixels a side of a face."""
        return self.size[0] // (1 + max(face.column for face in self.layout))

    @override
    def project(self, directions: ArrayLike) -> Array:
        d = np.asarray(directions, float)
        pixels = np.full((*d.shape[:-1], 2), np.nan)
        best = np.full(d.shape[:-1], -np.inf)
        for face in self.layout:
            w = d @ np.array(face.forward, float)
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = d @ np.array(face.right, float) / w, d @ np.array(face.down, float) / w
            here = (w > best) & (w > 0)
            best = np.where(here, w, best)
            q = np.stack([face.column + (a + 1) / 2, face.row + (b + 1) / 2], axis=-1)
            pixels[here] = (q * self.face - 0.5)[here]
        return pixels

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        q = (np.asarray(pixels, float) + 0.5) / self.face
        d = np.full((*q.shape[:-1], 3), np.nan)
        for face in self.layout:
            a, b = 2 * (q[..., 0] - face.column) - 1, 2 * (q[..., 1] - face.row) - 1
            here = (a >= -1) & (a <= 1) & (b >= -1) & (b <= 1)
            v = np.array(face.forward) + a[here, None] * np.array(face.right)
            v = v + b[here, None] * np.array(face.down)
            d[here] = v / np.linalg.norm(v, axis=-1, keepdims=True)
        return d

    @override
    def pattern(self) -> Pattern:
        n = self.face
        edge = (2 * np.arange((n + 1) // 2 + 1) - n % 2) / n
        a, b = edge[None, :], edge[:, None]
        corner = np.arctan2(a * b, np.sqrt(a * a + b * b + 1))
        one = mirrored(np.diff(np.diff(corner, axis=0), axis=1), (n, n))
        total = np.bincount(one.lines) @ one.values @ np.bincount(one.columns)
        return Pattern(
            one.values * (4 * math.pi / 6 / total),  # rounding of the differences
            np.tile(one.lines, self.size[1] // n),
            np.tile(one.columns, self.size[0] // n),
        )

    @override
    def solid_angles(self) -> Array:
        n, everywhere = self.face, super().solid_angles()
        solid = np.zeros_like(everywhere)
        for face in self.layout:
            place = np.s_[
                face.row * n : face.row * n + n, face.column * n : face.column * n + n
            ]
            solid[place] = everywhere[place]
        return solid

    @cached_property
    @override
    def whole(self) -> bool:
        return True

    @cached_property
    @override
    def kernel(self) -> Projection:
        axes = [[face.forward, face.right, face.down] for face in self.layout]
        places = [[face.column, face.row] for face in self.layout]
        return Projection.cube(
            *self.size,
            self.face,
            np.ascontiguousarray(np.array(axes).reshape(-1), np.float32),
            np.ascontiguousarray(np.array(places).reshape(-1), np.float32),
        )
