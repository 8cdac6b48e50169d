"""A part: triangles with materials, as a mesh file holds them, and where they stand."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.material import Material
from chromeball.scene.errors import UserError

#: Faces looked at together, so that float64 copies of them stay small.
_CHUNK = 1 << 20


def _nowhere() -> NDArray[np.float64]:
    return np.eye(4)


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles with a place; instances of one mesh share all arrays.

    ``vertices`` (V, 3) float32, ``faces`` (F, 3) uint32, ``normals`` (V, 3) float32 (a zero
    for a flat vertex) or None, ``uv`` (V, 2) float32 (v down, as glTF) or None, ``material``
    (F,) uint16 into ``materials``, ``pose`` (4, 4) float64 world_from_part. No ``materials``:
    the file has none.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    normals: NDArray[np.float32] | None = None
    uv: NDArray[np.float32] | None = None
    material: NDArray[np.uint16] = field(default_factory=lambda: np.zeros(0, np.uint16))
    materials: tuple[Material, ...] = ()
    pose: NDArray[np.float64] = field(default_factory=_nowhere)

    @classmethod
    def joined(cls, parts: Sequence[Part]) -> Part:
        """One part of several that stand at the same place."""
        if len(parts) == 1:
            return parts[0]
        first = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]]).astype(np.uint32)
        materials = tuple(dict.fromkeys(m for p in parts for m in p.materials))
        place = {m: i for i, m in enumerate(materials)}

        def places(part: Part) -> NDArray[np.uint16]:
            return np.array([place[m] for m in part.materials], np.uint16)

        def column(name: str, width: int) -> NDArray[np.float32] | None:
            columns = [getattr(p, name) for p in parts]
            if all(c is None for c in columns):
                return None
            none = [np.zeros((len(p.vertices), width), np.float32) for p in parts]
            rows = [z if c is None else c for c, z in zip(columns, none, strict=True)]
            return np.concatenate(rows)

        return cls(
            np.concatenate([p.vertices for p in parts]),
            np.concatenate([p.faces + at for p, at in zip(parts, first, strict=True)]),
            column("normals", 3),
            column("uv", 2),
            np.concatenate([places(p)[p.material] for p in parts]),
            materials,
            parts[0].pose,
        )

    def baked(self) -> Part:
        """The same triangles at the same place, with the world's coordinates."""
        linear, offset = self.pose[:3, :3], self.pose[:3, 3]
        if np.array_equal(self.pose, np.eye(4)):
            return self
        mirrored = bool(np.linalg.det(linear) < 0)
        normals = None
        if self.normals is not None:
            turned = self.normals @ np.linalg.inv(linear)
            norm = np.linalg.norm(turned, axis=1, keepdims=True)
            normals = (turned / np.where(norm > 0, norm, 1)).astype(np.float32)
        return replace(
            self,
            vertices=(self.vertices @ linear.T + offset).astype(np.float32),
            faces=self.faces[:, ::-1] if mirrored else self.faces,
            normals=normals,
            pose=np.eye(4),
        )

    def moved(self, pose: NDArray[np.float64]) -> Part:
        """The same part, its place moved by `pose` (4, 4)."""
        return replace(self, pose=pose @ self.pose)


def checked(part: Part, file: Path) -> Part:
    """The part without faces that have no area, which are counted on stderr.

    Raises
    ------
    UserError
        When vertices are not finite, a face names one that is not there, or no face is left.

    """
    vertices, faces = part.vertices, part.faces
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise UserError(f"{bad} vertices are NaN or infinite; repair the mesh", file=file)
    for name, what in (("normals", "normals"), ("uv", "texture coordinates")):
        rows: NDArray[np.float32] | None = getattr(part, name)
        if rows is not None and not np.isfinite(rows).all():
            bad = int((~np.isfinite(rows).all(axis=1)).sum())
            raise UserError(f"{bad} {what} are NaN or infinite; repair the mesh", file=file)
    if len(faces) == 0:
        raise UserError("the mesh has no faces", file=file)
    if faces.max() >= len(vertices):
        raise UserError(
            f"a face names a vertex that is not among the {len(vertices)}", file=file
        )
    keep = face_areas(vertices, faces) > 0
    if keep.all():
        return part
    if not keep.any():
        raise UserError("no face of the mesh has an area", file=file)
    say(file, f"{int((~keep).sum())} faces without area are left out")
    material = part.material[keep] if len(part.material) else part.material
    return replace(part, faces=faces[keep], material=material)


def say(file: Path, what: str) -> None:
    """Tell on stderr what a file holds that is not used."""
    print(f"{file}: {what}", file=sys.stderr)


def face_areas(vertices: NDArray[np.float32], faces: NDArray[Any]) -> NDArray[np.float64]:
    """Area of each triangle, (F,)."""
    areas = np.empty(len(faces))
    for first in range(0, len(faces), _CHUNK):
        normal = _normals(vertices, faces[first : first + _CHUNK])
        areas[first : first + _CHUNK] = np.sqrt(np.einsum("ij,ij->i", normal, normal)) / 2
    return areas


def smooth(part: Part, angle: float) -> Part:
    """With normals averaged over edges flatter than `angle` (radians), split at the others.

    Faces are weighted by their angle at the vertex (Thuermer and Wuethrich 1998). Vertices
    within a millionth of the mesh's size count as one, so seams of uv stay smooth.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces = part.faces
    count = len(faces)
    at = _places(part.vertices)[faces]  # (F, 3) of the corners
    normal = _normals(part.vertices, faces)
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    # each edge twice, once a face, sorted so that those of the same two places are neighbours
    corner = np.arange(3 * count).reshape(count, 3)
    a, b = at.reshape(-1), np.roll(at, -1, axis=1).reshape(-1)
    low, high = np.minimum(a, b), np.maximum(a, b)
    other = np.roll(corner, -1, axis=1).reshape(-1)
    at_low = np.where(a <= b, corner.reshape(-1), other)
    at_high = np.where(a <= b, other, corner.reshape(-1))
    order = np.lexsort((high, low))
    left, right = order[:-1], order[1:]
    same = (low[left] == low[right]) & (high[left] == high[right])
    left, right = left[same], right[same]
    flat = np.einsum("ij,ij->i", unit[left // 3], unit[right // 3]) >= np.cos(angle)
    left, right = left[flat], right[flat]
    rows = np.concatenate([at_low[left], at_high[left]])
    columns = np.concatenate([at_low[right], at_high[right]])
    links = coo_array((np.ones(len(rows), np.uint8), (rows, columns)), (3 * count, 3 * count))
    groups, group = connected_components(links, directed=False)
    weight = _corner_angles(part.vertices, faces).reshape(-1)
    weighted = np.repeat(unit, 3, axis=0) * weight[:, None]
    sums = np.stack([np.bincount(group, weighted[:, k], groups) for k in range(3)], axis=1)
    norm = np.linalg.norm(sums, axis=1, keepdims=True)
    sums /= np.where(norm > 1e-9, norm, np.inf)  # faces back to back: flat
    # a vertex for each group and each vertex of the file in it
    key = group.astype(np.int64) * len(part.vertices) + faces.reshape(-1)
    _, first, vertex = np.unique(key, return_index=True, return_inverse=True)
    old = faces.reshape(-1)[first]
    return replace(
        part,
        vertices=part.vertices[old],
        faces=vertex.reshape(count, 3).astype(np.uint32),
        normals=sums[group[first]].astype(np.float32),
        uv=None if part.uv is None else part.uv[old],
    )


def _places(vertices: NDArray[np.float32]) -> NDArray[np.intp]:
    """A number for each vertex (V,), the same for those within rounding of each other."""
    low = vertices.min(axis=0).astype(float)
    step = 1e-6 * max(float((vertices.max(axis=0) - low).max()), 1e-300)
    cells = np.round((vertices - low) / step).astype(np.int32)
    _, place = np.unique(cells.view("V12"), return_inverse=True)
    return place.reshape(-1)


def _normals(vertices: NDArray[np.float32], faces: NDArray[Any]) -> NDArray[np.float64]:
    """Normals of twice the faces' areas."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a)


def _corner_angles(
    vertices: NDArray[np.float32], faces: NDArray[np.uint32]
) -> NDArray[np.float64]:
    corners = vertices.astype(float)[faces]
    to = np.roll(corners, -1, axis=1) - corners
    to /= np.maximum(np.linalg.norm(to, axis=2, keepdims=True), 1e-300)
    cosine = -np.einsum("ijk,ijk->ij", to, np.roll(to, 1, axis=1))
    return np.arccos(np.clip(cosine, -1, 1))
