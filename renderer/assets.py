"""Mesh files as parts: glTF, OBJ and PLY as they are, others by their triangles alone."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from chromeball.renderer.part import Part, checked, smooth
from chromeball.renderer.primitives import PRIMITIVES
from chromeball.renderer.read_gltf import read_gltf
from chromeball.renderer.read_obj import read_obj
from chromeball.renderer.read_ply import read_ply
from chromeball.scene.errors import UserError

_READERS = {".gltf": read_gltf, ".glb": read_gltf, ".obj": read_obj, ".ply": read_ply}
#: What MeshLab reads without crashing on broken files (its FBX importer does).
_MESHLAB = frozenset({".stl", ".off", ".dae", ".3ds"})
MESH_SUFFIXES = frozenset(_READERS) | _MESHLAB


def read_parts(path: str | os.PathLike[str], smooth_angle: float | None = None) -> list[Part]:
    """All parts of a mesh file, checked; instances of one mesh share their arrays.

    Parts without normals are flat, or where `smooth_angle` (radians) is given smooth across
    all edges flatter than that. Faces without area are dropped and counted on stderr.

    Raises
    ------
    UserError
        When there is no such file, it is of no format that is read here, or is broken.

    """
    path = Path(path)
    if not path.is_file():
        raise UserError(
            f"no such mesh; write a file or one of {', '.join(PRIMITIVES)}", file=path
        )
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise UserError(
            f"no mesh format that is read here: {', '.join(sorted(MESH_SUFFIXES))}", file=path
        )
    try:
        parts = _READERS[suffix](path) if suffix in _READERS else _read_meshlab(path)
        done: dict[int, Part] = {}
        for part in parts:
            if (key := id(part.faces)) not in done:
                whole = checked(part, path)
                if smooth_angle is not None and whole.normals is None:
                    whole = smooth(whole, smooth_angle)
                done[key] = whole
        return [replace(done[id(part.faces)], pose=part.pose) for part in parts]
    except MemoryError as error:
        raise UserError("the mesh does not fit into memory", file=path) from error
    except OSError as error:
        raise UserError(f"cannot read: {error.strerror}", file=path) from error


def _read_meshlab(path: Path) -> list[Part]:
    import pymeshlab

    library: Any = pymeshlab  # its classes come at run time
    meshes = library.MeshSet()
    points = [np.zeros((0, 3), np.float32)]
    corners = [np.zeros((0, 3), np.int64)]
    try:
        meshes.load_new_mesh(os.fspath(path))
        first = 0
        for mesh in meshes:
            points.append(np.asarray(mesh.transformed_vertex_matrix(), np.float32))
            corners.append(np.asarray(mesh.face_matrix()).astype(np.int64) + first)
            first += len(points[-1])
    except library.PyMeshLabException as error:
        reason = str(error).strip().splitlines()
        raise UserError(
            f"not a readable mesh: {reason[-1] if reason else 'unknown format'}", file=path
        ) from error
    faces = np.concatenate(corners)
    if faces.size and faces.min() < 0:
        raise UserError("a face names a vertex that is not there", file=path)
    return [Part(np.concatenate(points), faces.astype(np.uint32))]
