"""``stand_in.ply``: triangles in metres, a class per face, the captured place per vertex.

The layout is fixed, so that reading is one check of the header and two views of the bytes:
binary little endian, vertices with x y z and wx wy wz (the environment coordinates of Felinto,
Zang and Velho, section 6.4; seeds F8), triangles with ``surface`` 0 support, 1 environment.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.record import write_bytes

#: Values of ``surface``.
SUPPORT, ENVIRONMENT = 0, 1

_VERTEX = np.dtype([("position", "<f4", 3), ("original", "<f4", 3)])
_FACE = np.dtype([("count", "u1"), ("indices", "<i4", 3), ("surface", "u1")])
_HEADER = """\
ply
format binary_little_endian 1.0
comment chromeball stand-in: metres, +Y up, surface 0 support 1 environment
element vertex {vertices}
property float x
property float y
property float z
property float wx
property float wy
property float wz
element face {faces}
property list uchar int vertex_indices
property uchar surface
end_header
"""
#: Names that other programs give to the same types.
_ALIASES = {
    "float32": "float",
    "uint8": "uchar",
    "int32": "int",
    "vertex_index": "vertex_indices",
}
_MAX_HEADER = 65536


@dataclass(frozen=True)
class StandInMesh:
    """Stand-in geometry in world metres.

    ``vertices`` (V, 3) float32; ``original`` (V, 3) float32, where each vertex stood when the
    map was captured (it keeps its light when the geometry is moved); ``faces`` (F, 3) uint32,
    counter-clockwise seen from outside; ``surface`` (F,) uint8, 0 support, 1 environment.

    Raises
    ------
    UserError
        When there is no face, a coordinate is not finite, a face names a vertex that is not
        there or one twice, or a surface is neither 0 nor 1.

    """

    vertices: NDArray[np.float32]
    original: NDArray[np.float32]
    faces: NDArray[np.uint32]
    surface: NDArray[np.uint8]

    def __post_init__(self) -> None:
        count, faces = len(self.vertices), self.faces
        if self.vertices.shape != (count, 3) or self.original.shape != (count, 3):
            raise ValueError("vertices and original must both be (V, 3)")
        if faces.shape != (len(faces), 3) or self.surface.shape != (len(faces),):
            raise ValueError("faces must be (F, 3) and surface (F,)")
        if len(faces) == 0:
            raise UserError("the stand-in has no faces")
        for name, points in (("position", self.vertices), ("wx wy wz", self.original)):
            bad = ~np.isfinite(points).all(axis=1)
            if bad.any():
                raise UserError(f"the {name} of vertex {int(bad.argmax())} is not finite")
        if (bad := (faces >= count).any(axis=1)).any():
            raise UserError(
                f"face {int(bad.argmax())} names vertex {int(faces[bad][0].max())}, "
                f"but there are {count} vertices"
            )
        if (bad := (faces == np.roll(faces, 1, axis=1)).any(axis=1)).any():
            raise UserError(f"face {int(bad.argmax())} names a vertex twice")
        a, b, c = np.moveaxis(self.vertices[faces].astype(float), 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        longest = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
        if (bad := area <= 1e-7 * longest**2).any():
            raise UserError(f"face {int(bad.argmax())} has no area: its corners lie on a line")
        if (bad := self.surface > ENVIRONMENT).any():
            raise UserError(
                f"face {int(bad.argmax())} has surface {int(self.surface[bad][0])}; "
                "0 is support, 1 environment"
            )

    def triangles(self) -> NDArray[np.float64]:
        """The corners of each face, (F, 3 corners, 3) float64."""
        return self.vertices.astype(float)[self.faces]


def write_stand_in(path: str | os.PathLike[str], mesh: StandInMesh) -> None:
    """Write the mesh, whole or not at all."""
    vertices = np.empty(len(mesh.vertices), _VERTEX)
    vertices["position"], vertices["original"] = mesh.vertices, mesh.original
    faces = np.empty(len(mesh.faces), _FACE)
    faces["count"], faces["indices"], faces["surface"] = 3, mesh.faces, mesh.surface
    header = _HEADER.format(vertices=len(vertices), faces=len(faces))
    write_bytes(path, header.encode() + vertices.tobytes() + faces.tobytes())


def read_stand_in(path: str | os.PathLike[str]) -> StandInMesh:
    """Read a stand-in mesh.

    Raises
    ------
    UserError
        When the file is missing, has another layout, is truncated or too long, or holds what
        :class:`StandInMesh` refuses.

    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError as error:
        raise UserError("no such stand-in mesh", file=path) from error
    except OSError as error:
        raise UserError(f"cannot read: {error.strerror}", file=path) from error
    try:
        return _parse(data)
    except UserError as error:
        raise UserError(error.what, file=path) from error


def _parse(data: bytes) -> StandInMesh:
    start, vertex_count, face_count = _read_header(data)
    middle = start + vertex_count * _VERTEX.itemsize
    expected = middle + face_count * _FACE.itemsize
    if len(data) != expected:
        verdict = "truncated" if len(data) < expected else "too long"
        raise UserError(
            f"{verdict}: {vertex_count} vertices and {face_count} faces need {expected} bytes, "
            f"the file has {len(data)}"
        )
    vertices = np.frombuffer(data, _VERTEX, vertex_count, start)
    faces = np.frombuffer(data, _FACE, face_count, middle)
    if (bad := faces["count"] != 3).any():
        raise UserError(f"face {int(bad.argmax())} is no triangle; triangulate the mesh")
    if (bad := (faces["indices"] < 0).any(axis=1)).any():
        raise UserError(f"face {int(bad.argmax())} names a negative vertex")
    return StandInMesh(
        np.ascontiguousarray(vertices["position"]),
        np.ascontiguousarray(vertices["original"]),
        faces["indices"].astype(np.uint32),
        np.ascontiguousarray(faces["surface"]),
    )


def _read_header(data: bytes) -> tuple[int, int, int]:
    """Where the vertices start, how many there are, and how many faces."""
    if not data.startswith(b"ply\n"):
        raise UserError("not a PLY file")
    end = data.find(b"\nend_header\n", 0, _MAX_HEADER)
    if end < 0:
        raise UserError("the PLY header has no end: truncated or not a stand-in mesh")
    try:
        lines = data[:end].decode("ascii").split("\n")[1:]
    except UnicodeDecodeError as error:
        raise UserError("the PLY header is not text") from error
    lines = [" ".join(_ALIASES.get(word, word) for word in line.split()) for line in lines]
    lines = [line for line in lines if line.partition(" ")[0] not in {"comment", "obj_info"}]
    wanted = [line for line in _HEADER.split("\n")[1:-2] if not line.startswith("comment")]
    counts: list[int] = []
    for index, want in enumerate(wanted):
        line = lines[index] if index < len(lines) else "nothing"
        stem, brace, _ = want.partition("{")
        number = line.removeprefix(stem)
        if brace and line.startswith(stem) and number.isascii() and number.isdigit():
            if len(number) > 9:
                raise UserError(f"{line!r}: too many for a stand-in mesh")
            counts.append(int(number))
        elif line != want:
            raise UserError(
                f"not the layout of a stand-in mesh: {want.format(vertices='N', faces='N')!r} "
                f"expected, {line!r} found"
            )
    if len(lines) > len(wanted):
        raise UserError(f"not the layout of a stand-in mesh: {lines[len(wanted)]!r} unexpected")
    return end + len(b"\nend_header\n"), counts[0], counts[1]
