"""PLY files: text and binary, any element order, polygons of any size.

plyfile is GPL, trimesh takes 2 CPU seconds to import, and assimp crashes on broken PLY files:
the header is read here, the rows by the C++ core.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import files
from chromeball.renderer.part import Part, say
from chromeball.scene.errors import UserError

_FORMATS = {"ascii": 0, "binary_little_endian": 1, "binary_big_endian": 2}
_TYPES = {
    **dict.fromkeys(("char", "int8"), "b"),
    **dict.fromkeys(("uchar", "uint8"), "B"),
    **dict.fromkeys(("short", "int16"), "h"),
    **dict.fromkeys(("ushort", "uint16"), "H"),
    **dict.fromkeys(("int", "int32"), "i"),
    **dict.fromkeys(("uint", "uint32"), "I"),
    **dict.fromkeys(("float", "float32"), "f"),
    **dict.fromkeys(("double", "float64"), "d"),
}
_MAX_HEADER = 65536
_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_UV = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    name: str
    count: int
    #: name, type of the list's length or "", type
    properties: list[tuple[str, str, str]] = field(default_factory=list[tuple[str, str, str]])


type _Column = tuple[NDArray[np.int32], NDArray[Any]]


def read_ply(path: Path) -> list[Part]:
    """The one part of a PLY file: normals and texture coordinates too, no materials.

    Raises
    ------
    UserError
        When the file is no PLY, is truncated, or lacks vertices or faces.

    """
    data = path.read_bytes()
    try:
        return [_parse(data, path)]
    except ValueError as error:
        raise UserError(f"not a readable mesh: {error}", file=path) from error


def _parse(data: bytes, path: Path) -> Part:
    kind, elements, offset = _header(data)
    tables: dict[str, dict[str, _Column]] = {}
    for element in elements:
        wanted = {"vertex": {*_POSITION, *_NORMAL, *sum(_UV, ())}, "face": {*_CORNERS}}
        keep = wanted.get(element.name, set())
        names = [name for name, _, _ in element.properties]
        columns, offset = files.read_ply_rows(
            data,
            offset,
            kind,
            element.count,
            [(count, type_, name in keep) for name, count, type_ in element.properties],
        )
        tables[element.name] = dict(zip(names, columns, strict=False))
        if element.name == "vertex" and {"red", "green", "blue"} <= {*names}:
            say(path, "colours of vertices are not used")
        if {"vertex", "face"} <= tables.keys():
            break
    vertex, face = tables.get("vertex"), tables.get("face")
    if vertex is None or any(name not in vertex for name in _POSITION):
        raise ValueError("it has no vertices with x, y and z")
    if face is None:
        raise UserError("the mesh has no faces", file=path)
    vertices = _table(vertex, _POSITION)
    corners = next((face[name] for name in _CORNERS if name in face), None)
    if corners is None:
        raise ValueError("its faces have no vertex_indices")
    sizes, indices = corners
    if len(sizes) == 0:
        raise UserError("the mesh has no faces", file=path)
    if np.issubdtype(indices.dtype, np.floating):
        raise ValueError("its faces name vertices by real numbers")
    normals = _table(vertex, _NORMAL) if all(n in vertex for n in _NORMAL) else None
    uv = next((_table(vertex, pair) for pair in _UV if all(n in vertex for n in pair)), None)
    if uv is not None:
        uv[:, 1] = 1 - uv[:, 1]  # v is up in PLY
    return Part(vertices, triangles(vertices, sizes, indices), normals, uv)


def triangles(
    vertices: NDArray[np.float32], sizes: NDArray[np.int32], corners: NDArray[np.int32]
) -> NDArray[np.uint32]:
    """Polygons of `sizes` (F,) corners (C,) as triangles (T, 3); ValueError for bad corners."""
    if (sizes == 3).all():
        bad = (corners < 0) | (corners >= len(vertices))
        if bad.any():
            raise ValueError(f"a face names a vertex that is not among the {len(vertices)}")
        return corners.reshape(-1, 3).view(np.uint32)
    at, _ = files.triangulate(vertices, sizes, corners)
    return corners[at].view(np.uint32)


def _table(columns: dict[str, _Column], names: tuple[str, ...]) -> NDArray[np.float32]:
    rows = [columns[name] for name in names]
    if any(len(sizes) for sizes, _ in rows):
        raise ValueError(f"{names[0]} is a list")
    return np.stack([values.astype(np.float32, copy=False) for _, values in rows], axis=1)


def _header(data: bytes) -> tuple[int, list[_Element], int]:
    """Format, elements, and where the data begin."""
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", data[:_MAX_HEADER], re.MULTILINE)
    if end is None or not data.startswith(b"ply"):
        raise ValueError("it does not begin with the header of a PLY file")
    try:
        lines = data[: end.start()].decode("ascii").split("\n")[1:]
    except UnicodeDecodeError as error:
        raise ValueError("its header is not text") from error
    kind: int | None = None
    elements: list[_Element] = []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _FORMATS:
                kind = _FORMATS[name]
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count, re.ASCII):
                elements.append(_Element(name, int(count)))
            case ["property", type_, name] if type_ in _TYPES and elements:
                elements[-1].properties.append((name, "", _TYPES[type_]))
            case ["property", "list", count, type_, name] if {
                count,
                type_,
            } <= _TYPES.keys() and elements:
                elements[-1].properties.append((name, _TYPES[count], _TYPES[type_]))
            case _:
                raise ValueError(f"its header says {line.strip():.60}")
    if kind is None:
        raise ValueError("its header names no format")
    return kind, elements, end.end()
