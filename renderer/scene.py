"""Objects of the scene file as triangles: primitives and mesh files."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.assets import read_parts
from chromeball.renderer.material import Material, Texture, Wrap
from chromeball.renderer.mesh import Instance, Mesh, affine
from chromeball.renderer.part import Part
from chromeball.renderer.primitives import PRIMITIVES, Triangles
from chromeball.renderer.texture import read_texture
from chromeball.scene import manifest
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Object, Scene, Vector
from chromeball.scene.pose import Pose
from chromeball.scene.sequence import object_at


def object_meshes(scene: Scene, folder: str | os.PathLike[str] = ".") -> list[Mesh]:
    """The triangles of each object of the scene in the world, in its order."""
    return [
        Mesh.join([baked(instance) for instance in instances])
        for instances in object_instances(scene, folder)
    ]


def object_instances(
    scene: Scene, folder: str | os.PathLike[str] = "."
) -> list[list[Instance]]:
    """The instances of each object of the scene, in its order.

    Objects that name one mesh file and one material share its triangles.

    Raises
    ------
    UserError
        As :func:`instances_of`; it names the object.

    """
    reader = _Reader(Path(folder))
    found: list[list[Instance]] = []
    for entry in scene.object:
        try:
            found.append(reader.instances(entry))
        except UserError as error:
            where = "" if error.file is None else f"{error.file}: "
            raise UserError(f"[[object]] {entry.name!r}: {where}{error.what}") from error
    return found


def moving_instances(
    scene: Scene, folder: str | os.PathLike[str], shutter: float
) -> list[Instance]:
    """As :func:`object_instances`, one after another; with keys they move until `shutter`.

    Raises
    ------
    UserError
        As :func:`object_instances`; where an object with ``instances`` moves.

    """
    found: list[Instance] = []
    for entry, instances in zip(scene.object, object_instances(scene, folder), strict=True):
        later = object_at(entry, shutter)
        place = (later.position, later.rotation, later.scale)
        stays = place == (entry.position, entry.rotation, entry.scale)
        if stays or not (shutter and entry.key):
            found += instances
            continue
        if entry.instances:
            raise UserError(
                f"[[object]] {entry.name!r}: what has instances cannot move while the shutter "
                "is open: write them as objects"
            )
        closing = pose_of(later), later.scale
        found += [replace(instance, closing=closing) for instance in instances]
    return found


def instances_of(entry: Object, folder: str | os.PathLike[str] = ".") -> list[Instance]:
    """One object: an instance for each of its places, and of its file's shared parts.

    Paths are relative to `folder`. Without shared parts or ``instances`` it is one, so that
    it can be moved as one.

    Raises
    ------
    UserError
        When the mesh is neither a primitive nor a readable file, or is broken; when a texture
        is missing, or lies on a mesh without texture coordinates.

    """
    return _Reader(Path(folder)).instances(entry)


class _Reader:
    """Reads each mesh file and image once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.parts: dict[tuple[object, ...], list[Part]] = {}
        self.materials: dict[object, Material] = {}
        self.meshes: dict[tuple[object, ...], list[tuple[Mesh, NDArray[np.float64]]]] = {}

    def instances(self, entry: Object) -> list[Instance]:
        own = np.vstack([affine(pose_of(entry), entry.scale), [0, 0, 0, 1]])
        parts = self.placed(entry)
        if not entry.instances:
            return [
                Instance(mesh, pose_of(entry), entry.scale, None if is_home(inner) else inner)
                for mesh, inner in parts
            ]
        return [
            Instance(
                mesh,
                Pose(turn(place.rotation), np.array(place.position, float)),
                place.scale,
                own @ inner,
            )
            for place in entry.instances
            for mesh, inner in parts
        ]

    def placed(self, entry: Object) -> list[tuple[Mesh, NDArray[np.float64]]]:
        """The object's meshes with their own places in it."""
        key = (entry.mesh, entry.smooth, entry.material)
        if key not in self.meshes:
            material = None if entry.material is None else self.material(entry.material)
            parts = self.read(entry.mesh, entry.smooth)
            if len({id(part.faces) for part in parts}) == len(parts):  # nothing is shared
                parts = [Part.joined([part.baked() for part in parts])]
            known: dict[int, Mesh] = {}
            for part in parts:
                if id(part.faces) not in known:
                    known[id(part.faces)] = to_mesh(part, material)
            self.meshes[key] = [(known[id(part.faces)], part.pose) for part in parts]
        return self.meshes[key]

    def read(self, mesh: str, smooth: float | None) -> list[Part]:
        if (mesh, smooth) not in self.parts:
            if mesh in PRIMITIVES:
                parts = [Part(*PRIMITIVES[mesh]())]
            else:
                angle = None if smooth is None else math.radians(smooth)
                parts = read_parts(self.folder / mesh, angle)
            self.parts[mesh, smooth] = parts
        return self.parts[mesh, smooth]

    def material(self, entry: manifest.Material) -> Material:
        if entry not in self.materials:
            self.materials[entry] = to_material(entry, self.folder)
        return self.materials[entry]


def to_mesh(part: Part, material: Material | None = None) -> Mesh:
    """A part's triangles, of `material` or of the file's own, else of plain grey.

    Raises UserError for textures on a mesh without texture coordinates.
    """
    materials = part.materials if material is None else (material,)
    index = part.material if len(part.material) and material is None else None
    mesh = Mesh(
        part.vertices,
        part.faces,
        np.zeros(len(part.faces), np.uint16) if index is None else index,
        materials or (Material.diffuse((0.5, 0.5, 0.5)),),
        part.normals,
        part.uv,
    )
    if mesh.uv is None and any(m.is_textured() for m in mesh.materials):
        raise UserError("a texture needs texture coordinates (uv), and the mesh has none")
    return mesh


def to_material(entry: manifest.Material, folder: Path) -> Material:
    """The scene file's material, its images read.

    Raises
    ------
    UserError
        When an image is missing or broken.

    """
    wrap: tuple[Wrap, Wrap] = (entry.wrap or "repeat", entry.wrap or "repeat")

    def texture(name: str | None, color: bool) -> Texture | None:
        return None if name is None else read_texture(folder / name, color=color, wrap=wrap)

    color = entry.color or ((1.0, 1.0, 1.0) if entry.color_texture else (0.5, 0.5, 0.5))
    match entry.kind:
        case "mirror":
            return Material.mirror(color)
        case "glass" | "thin_glass":
            return replace(
                Material.glass(color, entry.ior or 1.5),
                roughness=entry.roughness or 0.0,
                thin=entry.kind == "thin_glass",
            )
        case "diffuse":
            plain = Material.diffuse(color)
        case "metallic_roughness":
            plain = Material(color)
    names = (
        *("metallic", "roughness", "specular", "ior", "transmission", "thin", "clearcoat"),
        *("clearcoat_roughness", "emission", "alpha", "alpha_mode", "alpha_cutoff"),
        "normal_scale",
    )
    given = {name: v for name in names if (v := getattr(entry, name)) is not None}
    if entry.emission_texture:
        given.setdefault("emission", (1.0, 1.0, 1.0))
    if entry.alpha is not None:
        given.setdefault("alpha_mode", "blend")
    return replace(
        plain,
        **given,
        base_color_texture=texture(entry.color_texture, True),
        metallic_roughness_texture=texture(entry.metallic_roughness_texture, False),
        normal_texture=texture(entry.normal_texture, False),
        emission_texture=texture(entry.emission_texture, True),
    )


def baked(instance: Instance) -> Mesh:
    """The instance's triangles in the world's coordinates."""
    mesh = instance.mesh
    pose = np.vstack([instance.matrix(), [0, 0, 0, 1]])
    part = Part(mesh.vertices, mesh.faces, mesh.normals, pose=pose).baked()
    return replace(mesh, vertices=part.vertices, faces=part.faces, normals=part.normals)


def is_home(pose: NDArray[np.float64]) -> bool:
    """Whether a pose (4, 4) leaves all where it is."""
    return bool(np.array_equal(pose, np.eye(4)))


def read_mesh(path: str | os.PathLike[str]) -> Triangles:
    """Vertices, faces and normals of all parts of a mesh file, where they stand.

    Raises
    ------
    UserError
        As :func:`chromeball.renderer.assets.read_parts`.

    """
    part = Part.joined([part.baked() for part in read_parts(path)])
    return part.vertices, part.faces, part.normals


def pose_of(entry: Object) -> Pose:
    """Where the object is: turned about x, then y, then z, then moved."""
    return Pose(turn(entry.rotation), np.array(entry.position, float))


def turn(degrees: Vector) -> NDArray[np.float64]:
    """The rotation (3, 3) about x, then y, then z, by so many degrees."""
    pose = Pose.identity()
    for axis, angle in zip(np.eye(3), degrees, strict=True):
        pose = Pose.from_rotation_vector(axis * np.radians(angle), np.zeros(3)) @ pose
    return pose.rotation
