"""The files that a mesh file is made of, found without reading its triangles."""

from __future__ import annotations

from pathlib import Path

import msgspec

from chromeball.renderer import gltf, mtl
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import PRIMITIVES, Scene


def mesh_inputs(path: Path) -> list[Path]:
    """The files that a mesh file is made of, itself first: buffers, materials, images."""
    if not path.is_file():
        return [path]
    try:
        match path.suffix.lower():
            case ".gltf" | ".glb":
                others = gltf.named_files(path)
            case ".obj":
                others = mtl.named_files(path)
            case _:
                others = []
    except (
        ValueError,
        RecursionError,
        OSError,
        UserError,
        msgspec.DecodeError,
    ):  # broken: the reader says so
        others = []
    return [path, *dict.fromkeys(others)]


def scene_inputs(scene: Scene, folder: Path) -> list[Path]:
    """All files that the objects and lights of a scene are made of; `folder` is the scene's."""
    found: list[Path] = []
    for entry in scene.object:
        if entry.mesh not in PRIMITIVES:
            found += mesh_inputs(folder / entry.mesh)
        found += [
            folder / name for name in (entry.material.textures() if entry.material else [])
        ]
    found += [folder / light.texture for light in scene.light if light.texture]
    return list(dict.fromkeys(found))
