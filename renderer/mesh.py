"""Triangles with a material on every face."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import core
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: One value for all, or one a face.
type Values = int | float | Sequence[int | float] | NDArray[Any]


class Kind(IntEnum):
    """What a face does with light. The numbers are those of the C++ core."""

    DIFFUSE = 0
    MIRROR = 1
    GLASS = 2


@dataclass(frozen=True)
class Mesh:
    """Triangles in metres, a material each.

    ``vertices`` (V, 3) float32, ``faces`` (F, 3) uint32, counter-clockwise seen from outside
    (glass alone minds). ``albedo`` (F, 3) float32: albedo of diffuse, reflectance of mirror,
    transmittance of a glass surface. ``emission`` (F, 3) float32 radiance, both sides alike.
    ``kind`` (F,) uint8 of :class:`Kind`. ``ior`` (F,) float32, used by glass. ``normals``
    (V, 3) float32: smooth shading normals, a zero for a flat vertex; none: all faces are flat.
    :meth:`of` takes anything array-like and one material for all faces.

    Raises
    ------
    UserError
        For vertices or materials that are not finite, and faces with an index out of range.

    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    albedo: NDArray[np.float32]
    emission: NDArray[np.float32]
    kind: NDArray[np.uint8]
    ior: NDArray[np.float32]
    normals: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        count, faces = len(self.vertices), self.faces
        if faces.size and faces.max() >= count:
            raise UserError(f"a face names vertex {faces.max()}, the mesh has {count} vertices")
        for name in ("vertices", "normals", "albedo", "emission", "ior"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                bad = int(np.argwhere(~np.isfinite(value))[0][0])
                what = "vertex" if name in ("vertices", "normals") else "face"
                raise UserError(f"{name} of {what} {bad} are NaN or infinite")

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
    ) -> Mesh:
        """From anything array-like; a single value or colour is given to all faces."""
        if faces.size and faces.min() < 0:
            raise UserError(f"a face names vertex {faces.min()}")
        f = np.array(faces, np.uint32).reshape(-1, 3)
        v = np.array(vertices, np.float32).reshape(-1, 3)

        def per_face(value: Values, *shape: int) -> NDArray[np.float32]:
            rows = np.broadcast_to(np.asarray(value, np.float32), (len(f), *shape))
            return np.ascontiguousarray(rows)

        return cls(
            v,
            f,
            per_face(albedo, 3),
            per_face(emission, 3),
            per_face(kind).astype(np.uint8),
            per_face(ior),
            None if normals is None else np.array(normals, np.float32).reshape(v.shape),
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
        smooth = any(m.normals is not None for m in parts)
        return cls(
            np.concatenate([m.vertices for m in parts]),
            np.concatenate([m.faces + start for m, start in zip(parts, first, strict=True)]),
            np.concatenate([m.albedo for m in parts]),
            np.concatenate([m.emission for m in parts]),
            np.concatenate([m.kind for m in parts]),
            np.concatenate([m.ior for m in parts]),
            np.concatenate(
                [np.zeros_like(m.vertices) if m.normals is None else m.normals for m in parts]
            )
            if smooth
            else None,
        )

    def placed(self, pose: Pose, scale: Values = 1.0) -> Mesh:
        """Scaled (one factor or three), then turned and moved by `pose`."""
        factors = np.broadcast_to(np.asarray(scale, float), (3,))
        normals = None
        if self.normals is not None:
            turned = pose.rotate(self.normals / factors)
            norm = np.linalg.norm(turned, axis=1, keepdims=True)
            normals = (turned / np.where(norm > 0, norm, 1)).astype(np.float32)
        vertices = pose.apply(self.vertices * factors).astype(np.float32)
        return replace(self, vertices=vertices, normals=normals)

    def core(self) -> core.Mesh:
        """The C++ core's view of these arrays."""
        return core.Mesh(
            self.vertices,
            self.normals,
            self.faces,
            self.albedo,
            self.emission,
            self.kind,
            self.ior,
        )
