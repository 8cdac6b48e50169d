"""Objects of the scene file as triangles: primitives and mesh files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.assets import read_parts
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.part import Part
from chromeball.renderer.primitives import PRIMITIVES, Triangles
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Object, Scene, Vector
from chromeball.scene.pose import Pose


def object_meshes(scene: Scene, folder: str | os.PathLike[str] = ".") -> list[Mesh]:
    """The triangles of all objects of the scene, in its order; see :func:`object_mesh`."""
    meshes: list[Mesh] = []
    for entry in scene.object:
        try:
            meshes.append(object_mesh(entry, folder))
        except UserError as error:
            where = "" if error.file is None else f"{error.file}: "
            raise UserError(f"[[object]] {entry.name!r}: {where}{error.what}") from error
    return meshes


def object_mesh(entry: Object, folder: str | os.PathLike[str] = ".") -> Mesh:
    """The object's triangles in the world; mesh files are relative to `folder`.

    Raises
    ------
    UserError
        When the mesh is neither a primitive nor a readable file, or is broken.

    """
    if entry.mesh in PRIMITIVES:
        vertices, faces, normals = PRIMITIVES[entry.mesh]()
    else:
        vertices, faces, normals = read_mesh(Path(folder) / entry.mesh)
    material = entry.material
    mesh = Mesh.of(
        vertices,
        faces,
        material.color,
        kind=Kind[material.kind.upper()],
        ior=material.ior,
        normals=normals,
    )
    return mesh.placed(pose_of(entry), entry.scale)


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
