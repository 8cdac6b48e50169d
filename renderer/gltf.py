"""The records of a glTF 2.0 file (Khronos 2021) that are read; others are skipped."""

# ruff: noqa: D101  # the format's own names; its specification explains them

from __future__ import annotations

import struct
import urllib.parse
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from chromeball.scene.errors import UserError

type Three = tuple[float, float, float]
type Four = tuple[float, float, float, float]


class Record(Struct, frozen=True, rename="camel"):
    """A record of the JSON text; what is not named is left aside."""


class Buffer(Record, frozen=True):
    byte_length: int
    uri: str | None = None


class View(Record, frozen=True):
    buffer: int
    byte_length: int
    byte_offset: int = 0
    byte_stride: int | None = None


class SparsePart(Record, frozen=True):
    buffer_view: int
    byte_offset: int = 0
    component_type: int = 0


class Sparse(Record, frozen=True):
    count: int
    indices: SparsePart
    values: SparsePart


class Accessor(Record, frozen=True):
    component_type: int
    count: int
    type: str
    buffer_view: int | None = None
    byte_offset: int = 0
    normalized: bool = False
    sparse: Sparse | None = None


class Primitive(Record, frozen=True):
    attributes: dict[str, int]
    indices: int | None = None
    material: int | None = None
    mode: int = 4
    extensions: dict[str, Any] = {}


class Mesh(Record, frozen=True):
    primitives: list[Primitive]
    name: str = ""


class Instancing(Record, frozen=True):
    attributes: dict[str, int]


class NodeExtensions(Record, frozen=True):
    EXT_mesh_gpu_instancing: Instancing | None = msgspec.field(
        default=None, name="EXT_mesh_gpu_instancing"
    )


class Node(Record, frozen=True):
    mesh: int | None = None
    children: list[int] = []
    matrix: list[float] | None = None
    translation: Three = (0.0, 0.0, 0.0)
    rotation: Four = (0.0, 0.0, 0.0, 1.0)
    scale: Three = (1.0, 1.0, 1.0)
    skin: int | None = None
    extensions: NodeExtensions = NodeExtensions()


class Scene(Record, frozen=True):
    nodes: list[int] = []


class TextureTransform(Record, frozen=True):
    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    tex_coord: int | None = None


class UseExtensions(Record, frozen=True):
    KHR_texture_transform: TextureTransform | None = msgspec.field(
        default=None, name="KHR_texture_transform"
    )


class Use(Record, frozen=True):
    """Where a material uses a texture."""

    index: int
    tex_coord: int = 0
    scale: float = 1.0
    extensions: UseExtensions = UseExtensions()

    def coordinates(self) -> tuple[int, TextureTransform]:
        """Which set of uv, and how it is moved."""
        moved = self.extensions.KHR_texture_transform or TextureTransform()
        coord = self.tex_coord if moved.tex_coord is None else moved.tex_coord
        return coord, msgspec.structs.replace(moved, tex_coord=None)


class Physical(Record, frozen=True):
    base_color_factor: Four = (1.0, 1.0, 1.0, 1.0)
    metallic_factor: float = 1.0
    roughness_factor: float = 1.0
    base_color_texture: Use | None = None
    metallic_roughness_texture: Use | None = None


class Clearcoat(Record, frozen=True):
    clearcoat_factor: float = 0.0
    clearcoat_roughness_factor: float = 0.0
    clearcoat_texture: Use | None = None
    clearcoat_roughness_texture: Use | None = None
    clearcoat_normal_texture: Use | None = None


class Transmission(Record, frozen=True):
    transmission_factor: float = 0.0
    transmission_texture: Use | None = None


class Volume(Record, frozen=True):
    thickness_factor: float = 0.0


class Ior(Record, frozen=True):
    ior: float = 1.5


class Specular(Record, frozen=True):
    specular_factor: float = 1.0


class Strength(Record, frozen=True):
    emissive_strength: float = 1.0


class MaterialExtensions(Record, frozen=True):
    clearcoat: Clearcoat | None = msgspec.field(default=None, name="KHR_materials_clearcoat")
    transmission: Transmission | None = msgspec.field(
        default=None, name="KHR_materials_transmission"
    )
    volume: Volume | None = msgspec.field(default=None, name="KHR_materials_volume")
    ior: Ior | None = msgspec.field(default=None, name="KHR_materials_ior")
    specular: Specular | None = msgspec.field(default=None, name="KHR_materials_specular")
    strength: Strength | None = msgspec.field(
        default=None, name="KHR_materials_emissive_strength"
    )


class Material(Record, frozen=True):
    name: str = ""
    physical: Physical = msgspec.field(default=Physical(), name="pbrMetallicRoughness")
    normal_texture: Use | None = None
    emissive_texture: Use | None = None
    emissive_factor: Three = (0.0, 0.0, 0.0)
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: float = 0.5
    extensions: MaterialExtensions = MaterialExtensions()


class Sampler(Record, frozen=True):
    wrap_s: int = 10497
    wrap_t: int = 10497


class Texture(Record, frozen=True):
    source: int | None = None
    sampler: int | None = None
    extensions: dict[str, Any] = {}


class Image(Record, frozen=True):
    uri: str | None = None
    buffer_view: int | None = None


class Asset(Record, frozen=True):
    version: str


class Document(Record, frozen=True):
    asset: Asset
    scene: int | None = None
    scenes: list[Scene] = []
    nodes: list[Node] = []
    meshes: list[Mesh] = []
    materials: list[Material] = []
    textures: list[Texture] = []
    images: list[Image] = []
    samplers: list[Sampler] = []
    accessors: list[Accessor] = []
    buffer_views: list[View] = []
    buffers: list[Buffer] = []
    extensions_required: list[str] = []


_SUPPORTED = {
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_materials_clearcoat",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_volume",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def named_files(path: Path) -> list[Path]:
    """The buffers and images that a glTF file names, without reading them."""
    document, _ = open_document(path)
    uris = [b.uri for b in document.buffers] + [i.uri for i in document.images]
    return [external(path, uri) for uri in uris if uri and not uri.startswith("data:")]


def open_document(path: Path) -> tuple[Document, bytes | None]:
    """The JSON part and, of a .glb, the binary chunk.

    Raises
    ------
    UserError
        When it is of another version, truncated, or needs what is not read here; besides
        msgspec.DecodeError and ValueError for what is no JSON of this kind.

    """
    data = path.read_bytes()
    binary: bytes | None = None
    if data.startswith(b"glTF"):
        data, binary = _chunks(data)
    document = msgspec.json.decode(data, type=Document)
    if not document.asset.version.startswith("2."):
        raise UserError(f"glTF version {document.asset.version:.20}; export it as 2.0")
    unknown = [e for e in document.extensions_required if e not in _SUPPORTED]
    if unknown:
        raise UserError(f"it needs {', '.join(unknown)}; export it without")
    return document, binary


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    if len(data) < 20:
        raise UserError("truncated: the .glb file ends in its header")
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2:
        raise UserError(f"glTF version {version}; export it as 2.0")
    if length > len(data):
        raise UserError(f"truncated: {length} bytes expected, the file has {len(data)}")
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        at += 8
        if size > length - at:
            raise UserError("truncated: a chunk reaches beyond the file")
        found.setdefault(kind, data[at : at + size])
        at += size
    if _JSON_CHUNK not in found:
        raise UserError("the .glb file has no JSON chunk")
    return found[_JSON_CHUNK], found.get(_BINARY_CHUNK)


def external(path: Path, uri: str) -> Path:
    """The file that a URI in `path` means; UserError for one that is not beside it."""
    if urllib.parse.urlparse(uri).scheme:
        raise UserError(f"it names {uri:.60}; files beside it alone are read")
    name = urllib.parse.unquote(uri)
    if "\0" in name:
        raise UserError("a file name holds a zero byte")
    return path.parent / name
