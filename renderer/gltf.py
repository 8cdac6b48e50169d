"""The records of a glTF 2.0 file (Khronos 2021) that are read; others are skipped."""

# ruff: noqa: D101  # the format's own names; its specification explains them

from __future__ import annotations

from typing import Any, Literal

import msgspec
from msgspec import Struct

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
