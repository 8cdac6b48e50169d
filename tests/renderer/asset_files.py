"""Small mesh files for the tests of the readers, written by hand."""

from __future__ import annotations

import base64
import copy
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.primitives import box

PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "u2": "ushort"}


def ply(
    kind: str, vertices: NDArray[Any], polygons: list[list[int]], *, real: str = "f4"
) -> bytes:
    """A PLY file of `kind` with a property and an element that nobody needs."""
    header = [
        "ply",
        f"format {kind} 1.0",
        "comment made by hand",
        "element camera 1",
        "property list uchar short crumbs",
        f"element vertex {len(vertices)}",
        "property uchar flag",
        *(f"property {PLY_TYPES[real]} {axis}" for axis in "xyz"),
        f"element face {len(polygons)}",
        "property list uchar int vertex_indices",
        "property ushort tag",
        "end_header\n",
    ]
    if kind == "ascii":
        rows = ["2 7 8"]
        rows += [f"1 {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        rows += [f"{len(p)} {' '.join(map(str, p))} 9" for p in polygons]
        return ("\n".join(header) + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in kind else ">"
    letter = "f" if real == "f4" else "d"
    body = struct.pack(f"{order}Bhh", 2, 7, 8)
    for x, y, z in vertices.tolist():
        body += struct.pack(f"{order}B3{letter}", 1, x, y, z)
    for p in polygons:
        body += struct.pack(f"{order}B{len(p)}iH", len(p), *p, 9)
    return "\n".join(header).encode() + body


class Gltf:
    """A glTF document that grows; :meth:`write` it as .gltf or .glb."""

    def __init__(self) -> None:
        self.data = b""
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, data: bytes, **more: Any) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        views = self.json["bufferViews"]
        views.append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)} | more
        )
        self.data += data
        return len(views) - 1

    def accessor(self, rows: NDArray[Any], **more: Any) -> int:
        codes = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121, "i2": 5122, "i1": 5120}
        kinds = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
        rows = np.atleast_2d(rows.T).T
        entry = {
            "bufferView": self.view(rows.astype(rows.dtype.newbyteorder("<")).tobytes()),
            "componentType": codes[rows.dtype.str[1:]],
            "count": len(rows),
            "type": kinds[rows.shape[1]],
        }
        self.json["accessors"].append(entry | more)
        return len(self.json["accessors"]) - 1

    def mesh(self, *primitives: dict[str, Any]) -> int:
        self.json["meshes"].append({"primitives": list(primitives)})
        return len(self.json["meshes"]) - 1

    def node(self, root: bool = True, **fields: Any) -> int:
        self.json["nodes"].append(fields)
        number = len(self.json["nodes"]) - 1
        if root:
            self.json["scenes"][0]["nodes"].append(number)
        return number

    def add(self, name: str, entry: dict[str, Any]) -> int:
        self.json.setdefault(name, []).append(entry)
        return len(self.json[name]) - 1

    def write(self, path: Path, uri: str | None = "data:") -> Path:
        """As `path` says; `uri` of a .gltf: embedded, or a file's name."""
        document = copy.deepcopy(self.json)
        if path.suffix == ".glb":
            document["buffers"] = [{"byteLength": len(self.data)}]
            text = json.dumps(document).encode()
            text += b" " * (-len(text) % 4)
            data = self.data + b"\0" * (-len(self.data) % 4)
            body = struct.pack("<II", len(text), 0x4E4F534A) + text
            body += struct.pack("<II", len(data), 0x004E4942) + data
            path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
            return path
        if uri == "data:":
            text64 = base64.b64encode(self.data).decode()
            uri = f"data:application/octet-stream;base64,{text64}"
        elif uri is not None:
            (path.parent / uri).write_bytes(self.data)
        document["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        path.write_text(json.dumps(document))
        return path


def cube(gltf: Gltf, **material: Any) -> dict[str, Any]:
    """A primitive: the box of the renderer, with uv."""
    vertices, faces, _ = box()
    uv = vertices[:, :2] + np.float32(0.5)
    primitive: dict[str, Any] = {
        "attributes": {"POSITION": gltf.accessor(vertices), "TEXCOORD_0": gltf.accessor(uv)},
        "indices": gltf.accessor(faces.astype(np.uint16).reshape(-1)),
    }
    if material:
        primitive["material"] = gltf.add("materials", material)
    return primitive


def picture(path: Path, codes: NDArray[np.uint8]) -> Path:
    """An image file of these codes, colours not multiplied by alpha."""
    order = [2, 1, 0, 3][: codes.shape[2]]
    assert cv2.imwrite(str(path), codes[..., order])
    return path
