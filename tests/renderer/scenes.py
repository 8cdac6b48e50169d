"""A small scene on disk: a floor, a sky with a lamp, a ball."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chromeball.cli.main import build_app
from chromeball.scene.image import write_exr
from chromeball.stand_in.ply import StandInMesh, write_stand_in

SCENE = """
name = "small"
[[stand_in]]
name = "floor"
kind = "plane"
size = [4, 4]
[[object]]
name = "ball"
mesh = "sphere"
scale = 0.5
[[view]]
name = "main"
size = [40, 30]
[render]
spp = 4
"""


def write_scene(folder: Path, text: str = SCENE) -> Path:
    """The scene's files in `folder`; returns scene.toml."""
    sky = np.full((16, 32, 3), 0.5, np.float32)
    sky[3, 9] = 40
    write_exr(folder / "build/env.exr", sky, attributes={"origin": (0.0, 1.0, 1.5)})
    v = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    write_stand_in(
        folder / "build/stand_in.ply", StandInMesh(v, v, faces, np.zeros(2, np.uint8))
    )
    file = folder / "scene.toml"
    file.write_text(text)
    return file


def run(*arguments: str | Path) -> None:
    """The command line, errors raised."""
    build_app()([str(a) for a in arguments], exit_on_error=False, result_action="return_value")
