"""Triangles with a material on every face, and where they stand."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.material import Material
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: One value for all, or one a face.
type Values = int | float | Sequence[int | float] | NDArray[Any]

#: Materials that the faces of one mesh can have: their numbers are uint16.
_MOST_MATERIALS = 65536

#: radians that an instance turns from one step of its motion to the next, at most: a straight
#: way between them shortens it by 1 - cos(half of it), 3e-4
_STEP = 0.05


class Kind(IntEnum):
    """Materials by a word, for :meth:`Mesh.of`."""

    DIFFUSE = 0
    MIRROR = 1
    GLASS = 2


@dataclass(frozen=True)
class Mesh:
    """Triangles in metres, a material each.

    ``vertices`` (V, 3) float32, ``faces`` (F, 3) uint32, counter-clockwise seen from outside
    (glass alone minds). ``material`` (F,) uint16: of which of ``materials`` each face is.
    ``normals`` (V, 3) float32: smooth shading normals, a zero for a flat vertex; none: all
    faces are flat. ``uv`` (V, 2) float32: texture coordinates; none: textures show their
    corner. :meth:`of` takes anything array-like and one material for all faces.

    Raises
    ------
    UserError
        For vertices, normals or uv that are not finite, and indices out of range.

    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    material: NDArray[np.uint16]
    materials: tuple[Material, ...]
    normals: NDArray[np.float32] | None = None
    uv: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        count, faces = len(self.vertices), self.faces
        if faces.size and faces.max() >= count:
            raise UserError(f"a face names vertex {faces.max()}, the mesh has {count} vertices")
        if len(self.material) != len(faces):
            raise UserError(f"{len(faces)} faces, but materials for {len(self.material)}")
        if self.material.size and self.material.max() >= len(self.materials):
            raise UserError(
                f"a face names material {self.material.max()}, "
                f"the mesh has {len(self.materials)}"
            )
        for name in ("vertices", "normals", "uv"):
            value = getattr(self, name)
            if value is None:
                continue
            if len(value) != count:
                raise UserError(f"{count} vertices, but {len(value)} {name}")
            if not np.isfinite(value).all():
                bad = int(np.argwhere(~np.isfinite(value))[0][0])
                raise UserError(f"{name} of vertex {bad} are NaN or infinite")

    @classmethod
    def of(
        cls,
        vertices: NDArray[Any],
        faces: NDArray[Any],
        albedo: Values = 0.5,
        emission: Values = 0.0,
        kind: Values = Kind.DIFFUSE,
        ior: Values = 1.5,
        normals: NDArray[Any] | None = None,
        *,
        uv: NDArray[Any] | None = None,
        material: Material | None = None,
    ) -> Mesh:
        """From anything array-like; a single value or colour is given to all faces.

        ``albedo``: of diffuse, reflectance of mirror, transmittance of a glass surface;
        ``emission`` radiance, both sides alike; ``ior`` is used by glass. They become
        materials, unless one ``material`` is given for all faces.

        Raises
        ------
        UserError
            As the class, and for values that no material can have.

        """
        if faces.size and faces.min() < 0:
            raise UserError(f"a face names vertex {faces.min()}")
        f = np.array(faces, np.uint32).reshape(-1, 3)
        v = np.array(vertices, np.float32).reshape(-1, 3)
        materials, index = (
            _materials(len(f), albedo, emission, kind, ior)
            if material is None
            else ((material,), np.zeros(len(f), np.uint16))
        )
        return cls(
            v,
            f,
            index,
            materials,
            None if normals is None else np.array(normals, np.float32).reshape(v.shape),
            None if uv is None else np.array(uv, np.float32).reshape(len(v), 2),
        )

    @classmethod
    def empty(cls) -> Mesh:
        """No triangles at all."""
        return cls.of(np.zeros((0, 3)), np.zeros((0, 3), np.uint32))

    @classmethod
    def join(cls, meshes: Iterable[Mesh]) -> Mesh:
        """All triangles of all `meshes` as one."""
        parts = list(meshes)
        if not parts:
            return cls.empty()
        first = np.cumsum([0] + [len(m.vertices) for m in parts[:-1]]).astype(np.uint32)
        known: dict[Material, int] = {}
        numbers: list[NDArray[np.uint16]] = []
        for mesh in parts:
            table = [known.setdefault(m, len(known)) for m in mesh.materials]
            if len(known) > _MOST_MATERIALS:
                raise UserError(f"more than {_MOST_MATERIALS} materials in one mesh")
            numbers.append(np.array(table, np.uint16)[mesh.material])

        def either(name: str, width: int) -> NDArray[np.float32] | None:
            arrays = [getattr(m, name) for m in parts]
            if all(a is None for a in arrays):
                return None
            return np.concatenate(
                [
                    np.zeros((len(m.vertices), width), np.float32) if a is None else a
                    for m, a in zip(parts, arrays, strict=True)
                ]
            )

        return cls(
            np.concatenate([m.vertices for m in parts]),
            np.concatenate([m.faces + start for m, start in zip(parts, first, strict=True)]),
            np.concatenate(numbers),
            tuple(known),
            either("normals", 3),
            either("uv", 2),
        )

    def placed(self, pose: Pose, scale: Values = 1.0) -> Mesh:
        """Scaled (one factor or three), then turned and moved by `pose`, vertex by vertex.

        An :class:`Instance` does the same without touching the vertices.
        """
        factors = np.broadcast_to(np.asarray(scale, float), (3,))
        normals = None
        if self.normals is not None:
            turned = pose.rotate(self.normals / factors)
            norm = np.linalg.norm(turned, axis=1, keepdims=True)
            normals = (turned / np.where(norm > 0, norm, 1)).astype(np.float32)
        vertices = pose.apply(self.vertices * factors).astype(np.float32)
        # a reflection turns the corners about
        faces = self.faces if factors.prod() > 0 else np.ascontiguousarray(self.faces[:, ::-1])
        return replace(self, vertices=vertices, faces=faces, normals=normals)

    def albedo(self) -> NDArray[np.float32]:
        """The base colour of each face, (F, 3), textures left out."""
        return self._per_face([m.base_color for m in self.materials])

    def emission(self) -> NDArray[np.float32]:
        """The radiance of each face, (F, 3), textures left out."""
        return self._per_face([m.emission for m in self.materials])

    def _per_face(self, colors: Sequence[tuple[float, float, float]]) -> NDArray[np.float32]:
        return np.array(colors, np.float32).reshape(-1, 3)[self.material]


@dataclass(frozen=True)
class Instance:
    """A mesh at a place: scaled (one factor or three), then turned and moved by ``pose``.

    Several instances of one mesh share its triangles. ``inner`` (4, 4), where it is given,
    comes before: the mesh's own place in an object of several parts. With ``closing``, pose and
    scale when the shutter closes, it moves while it is open: straight, at constant speeds,
    turning about one axis the shorter way. Raises UserError for a scale that is zero or not
    finite.
    """

    mesh: Mesh
    pose: Pose = field(default_factory=Pose.identity)
    scale: Values = 1.0
    inner: NDArray[np.float64] | None = None
    closing: tuple[Pose, Values] | None = None

    def __post_init__(self) -> None:
        self.matrices()

    def matrix(self) -> NDArray[np.float64]:
        """World from mesh when the shutter opens, the rows of (3, 4)."""
        return affine(self.pose, self.scale, self.inner)

    def matrices(self) -> NDArray[np.float64]:
        """World from mesh, (S, 3, 4), at even times while the shutter is open.

        The core goes straight from one to the next: so many that it turns little on the way.
        """
        if self.closing is None:
            return self.matrix()[None]
        end, last = self.closing
        turn = Pose(end.rotation @ self.pose.rotation.T, np.zeros(3)).rotation_vector()
        count = 2 + int(np.linalg.norm(turn) / _STEP)
        start, stop = (np.broadcast_to(np.asarray(s, float), 3) for s in (self.scale, last))
        affine(end, last)
        steps = [
            affine(
                Pose(
                    Pose.from_rotation_vector(t * turn, np.zeros(3)).rotation
                    @ self.pose.rotation,
                    (1 - t) * self.pose.translation + t * end.translation,
                ),
                (1 - t) * start + t * stop,
                self.inner,
            )
            for t in np.linspace(0, 1, count)
        ]
        return np.array(steps)


def affine(
    pose: Pose, scale: Values = 1.0, inner: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """(3, 4) of `inner` (4, 4), then a scale, then a pose.

    Raises UserError for a scale that is zero or not finite.
    """
    factors = np.broadcast_to(np.asarray(scale, float), (3,))
    if not (np.isfinite(factors).all() and factors.all()):
        raise UserError(f"scale is {scale}; it must be finite and not zero")
    outer = np.column_stack([pose.rotation * factors, pose.translation])
    if inner is None:
        return outer
    return np.column_stack(
        [outer[:, :3] @ inner[:3, :3], outer[:, :3] @ inner[:3, 3] + outer[:, 3]]
    )


def _materials(
    count: int, albedo: Values, emission: Values, kind: Values, ior: Values
) -> tuple[tuple[Material, ...], NDArray[np.uint16]]:
    """Materials of all different rows of the values, and which of them each face has."""

    def columns(value: Values, width: int) -> NDArray[np.float32]:
        v = np.asarray(value, np.float32)
        if v.ndim == 0 or (width > 1 and v.shape == (width,)):
            return np.broadcast_to(v, (1, width))
        rows = v.reshape(len(v), -1)
        return np.broadcast_to(rows, (len(rows), width))

    given = [columns(albedo, 3), columns(emission, 3), columns(kind, 1), columns(ior, 1)]
    rows = max(len(g) for g in given)
    if any(len(g) not in (1, rows) for g in given) or rows not in (1, count):
        raise UserError(f"the mesh has {count} faces, its materials are for {rows}")
    table = np.concatenate([np.broadcast_to(g, (rows, g.shape[1])) for g in given], axis=1)
    if not np.isfinite(table).all():
        face, column = np.argwhere(~np.isfinite(table))[0]
        name = ("albedo", "emission", "kind", "ior")[
            np.searchsorted([3, 6, 7], column, "right")
        ]
        raise UserError(f"{name} of face {face} are NaN or infinite")
    unique, inverse = np.unique(table, axis=0, return_inverse=True)
    if len(unique) > _MOST_MATERIALS:
        raise UserError(f"{len(unique)} materials in one mesh; {_MOST_MATERIALS} at most")
    index = np.broadcast_to(inverse.reshape(-1).astype(np.uint16), (count,))
    return tuple(_material(row) for row in unique), np.ascontiguousarray(index)


def _material(row: NDArray[np.float32]) -> Material:
    r, g, b, er, eg, eb, kind, ior = (float(x) for x in row)
    color, emission = (r, g, b), (er, eg, eb)
    match Kind(int(kind)):
        case Kind.DIFFUSE:
            return Material.diffuse(color, emission)
        case Kind.MIRROR:
            return replace(Material.mirror(color), emission=emission)
        case Kind.GLASS:
            return replace(Material.glass(color, ior), emission=emission)
