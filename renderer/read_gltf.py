"""glTF 2.0: .gltf with external or embedded buffers, and .glb.

The JSON is decoded by msgspec into records and buffers are views of numpy:
pygltflib reads no accessor and checks nothing, trimesh takes 2 CPU seconds to import.
"""

from __future__ import annotations

import base64
import binascii
import math
import urllib.parse
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import gltf
from chromeball.renderer.material import Material, Texture, Wrap
from chromeball.renderer.part import Part, say
from chromeball.renderer.texture import TextureCache, read_texture, texture_of_bytes
from chromeball.scene.errors import UserError

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_ALPHA_MODES: dict[str, Literal["opaque", "mask", "blend"]] = {
    "OPAQUE": "opaque",
    "MASK": "mask",
    "BLEND": "blend",
}
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
#: Most placed meshes, so that a small file cannot ask for everything.
_MOST_PLACES = 1_000_000


def read_gltf(path: Path) -> list[Part]:
    """The placed meshes of a glTF file's scene; instances share their arrays.

    Raises
    ------
    UserError
        When the file, a buffer or an image is missing or broken, or the file needs an
        extension that is not read here.

    """
    try:
        return _Reader(path).parts()
    except UserError as error:
        raise UserError(error.what, file=error.file or path) from error
    except (msgspec.DecodeError, ValueError, OverflowError, RecursionError) as error:
        reason = str(error).replace("`$.", "`")
        raise UserError(f"not a readable glTF file: {reason:.200}", file=path) from error


def _item[T](items: list[T], index: int, what: str) -> T:
    if not 0 <= index < len(items):
        raise UserError(f"it names {what} {index}, there are {len(items)}")
    return items[index]


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.document, self.binary = gltf.open_document(path)
        self.buffers: dict[int, memoryview] = {}
        self.textures = TextureCache()
        self.materials: dict[
            int | None, tuple[Material, tuple[int, gltf.TextureTransform]]
        ] = {}
        self.dropped = 0

    def parts(self) -> list[Part]:
        meshes: dict[int, Part | None] = {}
        placed: list[Part] = []
        flat = 0
        for node, pose in self._placed_nodes():
            assert node.mesh is not None
            if node.mesh not in meshes:
                meshes[node.mesh] = self._mesh(node.mesh)
            part = meshes[node.mesh]
            if part is None:
                continue
            for instance in self._instances(node):
                place = pose @ instance
                if not np.isfinite(place).all():
                    raise UserError("the transform of a node is NaN or infinite")
                if abs(np.linalg.det(place[:3, :3])) < 1e-300:
                    flat += 1
                    continue
                if len(placed) >= _MOST_PLACES:
                    raise UserError(f"more than {_MOST_PLACES} placed meshes")
                placed.append(replace(part, pose=place))
        if flat:
            say(self.path, f"{flat} meshes scaled to nothing are left out")
        if self.dropped:
            say(self.path, f"{self.dropped} sets of points and lines are left out")
        if not placed:
            raise UserError("the mesh has no faces")
        return placed

    # ---- nodes

    def _placed_nodes(self) -> list[tuple[gltf.Node, NDArray[np.float64]]]:
        """All nodes with a mesh in the scene, with world_from_node."""
        nodes = self.document.nodes
        if self.document.scenes:
            roots = _item(self.document.scenes, self.document.scene or 0, "scene").nodes
        else:
            children = {child for node in nodes for child in node.children}
            roots = [i for i in range(len(nodes)) if i not in children]
        found: list[tuple[gltf.Node, NDArray[np.float64]]] = []
        seen: set[int] = set()
        waiting = [(root, np.eye(4)) for root in reversed(roots)]
        skinned = 0
        while waiting:
            index, parent = waiting.pop()
            node = _item(nodes, index, "node")
            if index in seen:
                raise UserError(f"node {index} has two parents, or is its own")
            seen.add(index)
            with np.errstate(all="ignore"):  # what overflows is refused where it matters
                pose = parent @ _local(node)
            if node.mesh is not None:
                skinned += node.skin is not None
                found.append((node, pose))
            waiting += [(child, pose) for child in reversed(node.children)]
        if skinned:
            say(self.path, f"{skinned} skinned meshes are shown at rest")
        return found

    def _instances(self, node: gltf.Node) -> list[NDArray[np.float64]]:
        """EXT_mesh_gpu_instancing, or the one place of the node itself."""
        many = node.extensions.EXT_mesh_gpu_instancing
        if many is None:
            return [np.eye(4)]
        columns = {
            name: self._floats(index, width)
            for name, width in (("TRANSLATION", 3), ("ROTATION", 4), ("SCALE", 3))
            if (index := many.attributes.get(name)) is not None
        }
        counts = {len(rows) for rows in columns.values()}
        if len(counts) != 1:
            raise UserError("the instances of a node have attributes of differing length")
        (count,) = counts
        if count > _MOST_PLACES:
            raise UserError(f"more than {_MOST_PLACES} placed meshes")
        places = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        if "ROTATION" in columns:
            places[:, :3, :3] = _rotations(columns["ROTATION"].astype(float))
        if "SCALE" in columns:
            places[:, :3, :3] *= columns["SCALE"][:, None, :]
        if "TRANSLATION" in columns:
            places[:, :3, 3] = columns["TRANSLATION"]
        return list(places)

    # ---- meshes

    def _mesh(self, index: int) -> Part | None:
        mesh = _item(self.document.meshes, index, "mesh")
        parts = [part for p in mesh.primitives if (part := self._primitive(p)) is not None]
        return Part.joined(parts) if parts else None

    def _primitive(self, primitive: gltf.Primitive) -> Part | None:
        if primitive.mode not in (4, 5, 6):
            self.dropped += 1
            return None
        if "POSITION" not in primitive.attributes:
            raise UserError("a mesh has no POSITION")
        vertices = self._floats(primitive.attributes["POSITION"], 3)
        count = len(vertices)
        if primitive.indices is None:
            index = np.arange(count, dtype=np.uint32)
        else:
            index = self._accessor(primitive.indices, 1)[:, 0]
            if np.issubdtype(index.dtype, np.floating):
                raise UserError("indices are real numbers")
        faces = _triangles(index, primitive.mode)
        if faces.size and (faces.min() < 0 or faces.max() >= count):
            raise UserError(f"a face names a vertex that is not among the {count}")
        material, (coord, transform) = self._material(primitive.material)
        normals = self._attribute(primitive, "NORMAL", 3, count)
        uv = self._attribute(primitive, f"TEXCOORD_{coord}", 2, count)
        if uv is not None and transform != gltf.TextureTransform():
            uv = _moved(uv, transform)
        if "COLOR_0" in primitive.attributes:
            say(self.path, "colours of vertices are not used")
        if uv is None and material.is_textured():
            raise UserError(f"a textured mesh has no TEXCOORD_{coord}")
        return Part(
            vertices,
            faces.astype(np.uint32),
            normals,
            uv,
            np.zeros(len(faces), np.uint16),
            (material,),
        )

    def _attribute(
        self, primitive: gltf.Primitive, name: str, width: int, count: int
    ) -> NDArray[np.float32] | None:
        if name not in primitive.attributes:
            return None
        rows = self._floats(primitive.attributes[name], width)
        if len(rows) != count:
            raise UserError(f"{name} and POSITION differ in length")
        return rows

    # ---- numbers

    def _floats(self, index: int, width: int) -> NDArray[np.float32]:
        accessor = _item(self.document.accessors, index, "accessor")
        rows = self._accessor(index, width)
        if np.issubdtype(rows.dtype, np.floating):
            return np.ascontiguousarray(rows, np.float32)
        if not accessor.normalized:
            return rows.astype(np.float32)
        info = np.iinfo(rows.dtype)
        return np.maximum(rows.astype(np.float32) / np.float32(info.max), np.float32(-1))

    def _accessor(self, index: int, width: int) -> NDArray[Any]:
        """Rows (count, width) in the accessor's own type."""
        accessor = _item(self.document.accessors, index, "accessor")
        if _WIDTHS.get(accessor.type) != width:
            raise UserError(f"accessor {index} is {accessor.type:.20}, not of {width} numbers")
        dtype = self._dtype(accessor.component_type)
        count = accessor.count
        if accessor.buffer_view is not None:
            rows = self._rows(accessor.buffer_view, accessor.byte_offset, dtype, count, width)
        else:
            size = sum(len(self._buffer(i)) for i in range(len(self.document.buffers)))
            if not 0 <= count <= max(size, 1 << 16):
                raise UserError(f"accessor {index} has {count} rows and no data")
            rows = np.zeros((count, width), dtype)
        if accessor.sparse is not None:
            rows = self._scattered(rows, accessor.sparse, dtype)
        return rows

    def _scattered(
        self, rows: NDArray[Any], sparse: gltf.Sparse, dtype: np.dtype[Any]
    ) -> NDArray[Any]:
        where, what = sparse.indices, sparse.values
        kind = self._dtype(where.component_type)
        at = self._rows(where.buffer_view, where.byte_offset, kind, sparse.count, 1)[:, 0]
        width = rows.shape[1]
        values = self._rows(what.buffer_view, what.byte_offset, dtype, sparse.count, width)
        if np.issubdtype(kind, np.floating) or (at.size and not 0 <= at.max() < len(rows)):
            raise UserError("a sparse accessor names a row that is not there")
        rows = rows.copy()
        rows[at] = values
        return rows

    def _dtype(self, component_type: int) -> np.dtype[Any]:
        if component_type not in _COMPONENTS:
            raise UserError(f"unknown component type {component_type}")
        return np.dtype(_COMPONENTS[component_type])

    def _rows(
        self, view: int, offset: int, dtype: np.dtype[Any], count: int, width: int
    ) -> NDArray[Any]:
        entry = _item(self.document.buffer_views, view, "bufferView")
        data = self._view(view)
        row = dtype.itemsize * width
        stride = entry.byte_stride or row
        if count < 0 or offset < 0 or stride < row:
            raise UserError("an accessor with a negative count, offset or stride")
        if count and offset + (count - 1) * stride + row > len(data):
            raise UserError("truncated: an accessor reaches beyond its bufferView")
        if not count:
            return np.zeros((0, width), dtype)
        strided = np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))
        return strided.astype(dtype.newbyteorder("="))

    def _view(self, index: int) -> memoryview:
        view = _item(self.document.buffer_views, index, "bufferView")
        data = self._buffer(view.buffer)
        end = view.byte_offset + view.byte_length
        if min(view.byte_offset, view.byte_length) < 0 or end > len(data):
            raise UserError("truncated: a bufferView reaches beyond its buffer")
        return data[view.byte_offset : end]

    def _buffer(self, index: int) -> memoryview:
        if index not in self.buffers:
            buffer = _item(self.document.buffers, index, "buffer")
            if buffer.uri is None:
                if index != 0 or self.binary is None:
                    raise UserError(f"buffer {index} has no data")
                data = self.binary
            else:
                data = self._read(buffer.uri, "buffer")
            if buffer.byte_length > len(data):
                raise UserError(
                    f"truncated: buffer {index} has {len(data)} of {buffer.byte_length} bytes"
                )
            self.buffers[index] = memoryview(data)
        return self.buffers[index]

    def _read(self, uri: str, what: str) -> bytes:
        if uri.startswith("data:"):
            return _embedded(uri)
        file = gltf.external(self.path, uri)
        if not file.is_file():
            raise UserError(f"its {what} {uri!r:.80} is not there; put it beside")
        return file.read_bytes()

    # ---- materials

    def _material(
        self, index: int | None
    ) -> tuple[Material, tuple[int, gltf.TextureTransform]]:
        """The material, and the one set of coordinates that all of its textures use."""
        if index not in self.materials:
            entry = gltf.Material()
            if index is not None:
                entry = _item(self.document.materials, index, "material")
            name = entry.name or str(index)
            try:
                self.materials[index] = self._converted(entry, name)
            except UserError as error:
                raise UserError(
                    f"material {name!r:.60}: {error.what}", file=error.file
                ) from error
        return self.materials[index]

    def _converted(
        self, entry: gltf.Material, name: str
    ) -> tuple[Material, tuple[int, gltf.TextureTransform]]:
        physical, more = entry.physical, entry.extensions
        uses = {
            "base_color": physical.base_color_texture,
            "metallic_roughness": physical.metallic_roughness_texture,
            "normal": entry.normal_texture,
            "emission": entry.emissive_texture,
        }
        places = [use.coordinates() for use in uses.values() if use]
        place = places[0] if places else (0, gltf.TextureTransform())
        textures: dict[str, Texture | None] = {}
        for kind, use in uses.items():
            if use and use.coordinates() != place:
                say(
                    self.path,
                    f"material {name!r:.60}: its {kind} texture is left out, having other "
                    "coordinates than the first; bake them to one set",
                )
                use = None
            color = kind in ("base_color", "emission")
            textures[f"{kind}_texture"] = self._texture(use.index, color) if use else None
        coat = more.clearcoat or gltf.Clearcoat()
        through = more.transmission or gltf.Transmission()
        unused = (
            coat.clearcoat_texture,
            coat.clearcoat_roughness_texture,
            coat.clearcoat_normal_texture,
            through.transmission_texture,
        )
        if any(unused):
            say(
                self.path,
                f"material {name!r:.60}: textures of clearcoat and transmission are not used",
            )
        strength = more.strength.emissive_strength if more.strength else 1.0
        r, g, b = (c * strength for c in entry.emissive_factor)
        red, green, blue, alpha = physical.base_color_factor
        transmission = through.transmission_factor
        thick = more.volume is not None and more.volume.thickness_factor > 0
        material = Material(
            base_color=(red, green, blue),
            metallic=physical.metallic_factor,
            roughness=physical.roughness_factor,
            specular=more.specular.specular_factor if more.specular else 1.0,
            ior=more.ior.ior if more.ior else 1.5,
            transmission=transmission,
            thin=transmission > 0 and not thick,
            clearcoat=coat.clearcoat_factor,
            clearcoat_roughness=coat.clearcoat_roughness_factor,
            emission=(r, g, b),
            alpha=alpha,
            alpha_mode=_ALPHA_MODES[entry.alpha_mode],
            alpha_cutoff=min(entry.alpha_cutoff, 1.0),
            normal_scale=entry.normal_texture.scale if entry.normal_texture else 1.0,
            **textures,
        )
        if not math.isfinite(material.normal_scale):
            raise UserError("the scale of its normal texture is not finite")
        return material, place

    def _texture(self, index: int, color: bool) -> Texture:
        texture = _item(self.document.textures, index, "texture")
        sampler = gltf.Sampler()
        if texture.sampler is not None:
            sampler = _item(self.document.samplers, texture.sampler, "sampler")
        wraps = (sampler.wrap_s, sampler.wrap_t)
        if not {*wraps} <= _WRAPS.keys():
            raise UserError(f"unknown wrap mode among {wraps}")
        wrap = (_WRAPS[wraps[0]], _WRAPS[wraps[1]])
        source = texture.source
        webp = texture.extensions.get("EXT_texture_webp")
        if isinstance(webp, dict) and isinstance(webp.get("source"), int):
            source = webp["source"]
        if source is None:
            raise UserError("a texture has no image")
        image = _item(self.document.images, source, "image")
        return self.textures.get((source, color, wrap), lambda: self._image(image, color, wrap))

    def _image(self, image: gltf.Image, color: bool, wrap: tuple[Wrap, Wrap]) -> Texture:
        if image.uri is not None and not image.uri.startswith("data:"):
            return read_texture(gltf.external(self.path, image.uri), color=color, wrap=wrap)
        if image.uri is not None:
            data = _embedded(image.uri)
        elif image.buffer_view is not None:
            data = bytes(self._view(image.buffer_view))
        else:
            raise UserError("an image has neither a name nor data")
        return texture_of_bytes(data, color=color, wrap=wrap)


def _embedded(uri: str) -> bytes:
    head, comma, body = uri.partition(",")
    if not comma or not head.endswith(";base64"):
        raise UserError("embedded data are not base64")
    try:
        return base64.b64decode(urllib.parse.unquote(body), validate=True)
    except binascii.Error as error:
        raise UserError(f"embedded data are broken: {error}") from error


def _local(node: gltf.Node) -> NDArray[np.float64]:
    """parent_from_node."""
    if node.matrix is not None:
        if len(node.matrix) != 16:
            raise UserError("the matrix of a node needs 16 numbers")
        matrix = np.array(node.matrix, float).reshape(4, 4).T
        if (np.abs(matrix[3] - [0, 0, 0, 1]) > 1e-6).any():
            raise UserError("the matrix of a node is not affine")
        return matrix
    matrix = np.eye(4)
    rotation = _rotations(np.array([node.rotation], float))[0]
    matrix[:3, :3] = rotation * np.array(node.scale, float)
    matrix[:3, 3] = node.translation
    return matrix


def _rotations(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), x y z w."""
    norm = np.linalg.norm(q, axis=1)
    if not (np.isfinite(norm) & (norm > 0)).all():
        raise UserError("a rotation is zero, NaN or infinite")
    x, y, z, w = (q / norm[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _triangles(index: NDArray[Any], mode: int) -> NDArray[Any]:
    """Faces (F, 3) of a list, strip or fan."""
    if mode == 4:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if len(index) < 3:
        return np.zeros((0, 3), index.dtype)
    if mode == 6:
        first = np.broadcast_to(index[:1], len(index) - 2)
        return np.stack([first, index[1:-1], index[2:]], axis=1)
    faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    faces[1::2] = faces[1::2][:, [1, 0, 2]]
    return faces


def _moved(uv: NDArray[np.float32], transform: gltf.TextureTransform) -> NDArray[np.float32]:
    """KHR_texture_transform: scaled, turned, then moved."""
    c, s = math.cos(transform.rotation), math.sin(transform.rotation)
    turn = np.array([[c, s], [-s, c]])
    matrix = turn * np.array(transform.scale)
    return (uv.astype(float) @ matrix.T + np.array(transform.offset)).astype(np.float32)
