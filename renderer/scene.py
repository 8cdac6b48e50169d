"""Objects of the scene file as triangles: primitives and mesh files."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.primitives import PRIMITIVES, Triangles
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Object, Scene, Vector
from chromeball.scene.pose import Pose

#: What MeshLab reads without crashing on broken files (its FBX importer does).
MESH_SUFFIXES = frozenset({".ply", ".obj", ".stl", ".off", ".gltf", ".glb", ".dae", ".3ds"})


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
    """Vertices, faces and no normals of a mesh file, whatever format MeshLab reads.

    Faces without area are dropped.

    Raises
    ------
    UserError
        When there is no such file, no faces, or vertices are NaN or out of range.

    """
    path = Path(path)
    if not path.is_file():
        raise UserError(
            f"no such mesh; write a file or one of {', '.join(PRIMITIVES)}", file=path
        )
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise UserError(
            f"no mesh format that is read here: {', '.join(sorted(MESH_SUFFIXES))}", file=path
        )
    import pymeshlab

    library: Any = pymeshlab  # its classes come at run time

    meshes = library.MeshSet()
    points = [np.zeros((0, 3), np.float32)]
    corners = [np.zeros((0, 3), np.int64)]
    try:
        meshes.load_new_mesh(os.fspath(path))
        first = 0
        for mesh in meshes:  # glTF and its like hold several, each with its own place
            points.append(np.asarray(mesh.transformed_vertex_matrix(), np.float32))
            corners.append(np.asarray(mesh.face_matrix()).astype(np.int64) + first)
            first += len(points[-1])
    except library.PyMeshLabException as error:
        reason = str(error).strip().splitlines()
        raise UserError(
            f"not a readable mesh: {reason[-1] if reason else 'unknown format'}", file=path
        ) from error
    vertices, faces = np.concatenate(points), np.concatenate(corners)
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    # MeshLab leaves broken vertices out without a word
    bad += max(0, _declared_vertices(path) - len(vertices))
    if bad:
        raise UserError(f"{bad} vertices are NaN or infinite; repair the mesh", file=path)
    if len(faces) == 0:
        raise UserError("the mesh has no faces", file=path)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(
            f"a face names a vertex that is not among the {len(vertices)}", file=path
        )
    keep = face_areas(vertices, faces) > 0
    if not keep.any():
        raise UserError("no face of the mesh has an area", file=path)
    if not keep.all():
        dropped = int((~keep).sum())
        print(f"{path}: {dropped} faces without area are left out", file=sys.stderr)
    return vertices, faces[keep].astype(np.uint32), None


def _declared_vertices(path: Path) -> int:
    """How many vertices a PLY or OBJ file says it has; 0 for other formats.

    Raises UserError for an OBJ face that names a vertex that is not there, which MeshLab also
    leaves out.
    """
    match path.suffix.lower():
        case ".ply":
            header = path.read_bytes()[:65536].partition(b"end_header")[0]
            found = re.search(rb"element vertex (\d+)", header)
            return int(found[1]) if found else 0
        case ".obj":
            data = path.read_bytes()
            count = len(re.findall(rb"^[ \t]*v[ \t]", data, re.MULTILINE))
            for line in re.findall(rb"^[ \t]*f[ \t]+(.*)", data, re.MULTILINE):
                if len(set(line.split())) < 3:
                    text = line.decode(errors="replace").strip()
                    raise UserError(f"a face has fewer than three corners: f {text}", file=path)
                for corner in line.split():
                    number = corner.partition(b"/")[0]
                    index = int(number) if number.lstrip(b"-").isdigit() else 0
                    if not 0 < abs(index) <= count:
                        raise UserError(
                            f"a face names vertex {index}, the mesh has {count}", file=path
                        )
            return count
        case _:
            return 0


def face_areas(vertices: NDArray[np.float32], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Area of each triangle, (F,)."""
    a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def pose_of(entry: Object) -> Pose:
    """Where the object is: turned about x, then y, then z, then moved."""
    return Pose(turn(entry.rotation), np.array(entry.position, float))


def turn(degrees: Vector) -> NDArray[np.float64]:
    """The rotation (3, 3) about x, then y, then z, by so many degrees."""
    pose = Pose.identity()
    for axis, angle in zip(np.eye(3), degrees, strict=True):
        pose = Pose.from_rotation_vector(axis * np.radians(angle), np.zeros(3)) @ pose
    return pose.rotation
