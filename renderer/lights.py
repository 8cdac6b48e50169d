"""Lights of the scene file: those without size, and area lights as meshes that shine."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Instance, Mesh
from chromeball.renderer.texture import read_texture
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Light, Scene
from chromeball.scene.pose import Pose

#: Corners of a disc.
_SEGMENTS = 64
#: How far behind an area light its black back is, relative to its size.
_GAP = 1e-3


def delta_lights(scene: Scene) -> list[DeltaLight]:
    """The lights of the scene without size."""
    found: list[DeltaLight] = []
    for light in scene.light:
        match light.kind:
            case "point":
                assert light.intensity is not None
                found.append(DeltaLight(light.position, light.intensity))
            case "spot":
                assert light.intensity is not None
                assert light.angle is not None
                found.append(
                    DeltaLight(
                        light.position,
                        light.intensity,
                        _triple(axis_of(light)),
                        math.cos(math.radians(light.inner_angle or 0.0)),
                        math.cos(math.radians(light.angle)),
                    )
                )
            case "sun":
                assert light.irradiance is not None
                found.append(DeltaLight(None, light.irradiance, _triple(axis_of(light))))
            case "area":
                pass
    return found


def area_lights(scene: Scene, folder: str | os.PathLike[str] = ".") -> list[Instance]:
    """The area lights of the scene, each a mesh that shines; images relative to `folder`.

    Raises
    ------
    UserError
        When a texture is missing, broken, or black all over under a given power.

    """
    found: list[Instance] = []
    for light in scene.light:
        if light.kind == "area":
            try:
                place = Pose(np.eye(3), np.array(light.position, float))
                found.append(Instance(_area_mesh(light, Path(folder)), place))
            except UserError as error:
                where = "" if error.file is None else f"{error.file}: "
                raise UserError(f"[[light]] {light.name!r}: {where}{error.what}") from error
    return found


def axis_of(light: Light) -> NDArray[np.float64]:
    """The unit direction into which a light shines."""
    if light.direction is not None:
        axis = np.array(light.direction, float)
    else:
        axis = np.array(light.look_at, float) - np.array(light.position, float)
    return axis / np.linalg.norm(axis)


def _area_mesh(light: Light, folder: Path) -> Mesh:
    """The light about its position."""
    n = axis_of(light)
    up = np.array([0.0, 1.0, 0.0])
    if np.linalg.norm(np.cross(up, n)) < 1e-6:
        up = np.array([0.0, 0.0, -1.0])  # it shines straight down or up
    right = np.cross(up, n)  # of someone who looks at it
    right /= np.linalg.norm(right)
    up = np.cross(n, right)
    if light.size is not None:
        width, height = light.size
        flat = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
        faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
        area, extent = width * height, np.array([width, height])
    else:
        assert light.radius is not None
        phi = 2 * math.pi * np.arange(_SEGMENTS) / _SEGMENTS
        corner = np.stack([np.cos(phi), np.sin(phi)], axis=1)
        # a polygon of the disc's area
        grow = math.sqrt(2 * math.pi / (_SEGMENTS * math.sin(2 * math.pi / _SEGMENTS)))
        flat = np.concatenate([[[0.0, 0.0]], light.radius * grow * corner])
        k = np.arange(_SEGMENTS)
        faces = np.stack([0 * k, 1 + k, 1 + (k + 1) % _SEGMENTS], axis=1).astype(np.uint32)
        area = math.pi * light.radius**2
        extent = np.array([2.0, 2.0]) * light.radius * grow
    uv = flat / extent + 0.5
    uv[:, 1] = 1 - uv[:, 1]
    front = flat @ np.stack([right, up])
    texture = None
    share = 1.0
    if light.texture is not None:
        file = folder / light.texture
        texture = read_texture(file, color=True, wrap=("clamp", "clamp"))
        share = float(texture.pixels[..., :3].mean())
        if light.power is not None and share == 0:
            raise UserError("the texture is black, so it has no power", file=file)
    radiance = light.radiance
    if radiance is None:
        assert light.power is not None
        sides = 2 if light.two_sided else 1
        radiance = _triple(np.array(light.power) / (sides * math.pi * area * share))
    shine = Material((0.0, 0.0, 0.0), specular=0.0, emission=radiance, emission_texture=texture)
    mesh = Mesh.of(front, faces, uv=uv, material=shine)
    if light.two_sided:
        return mesh
    behind = front - _GAP * float(extent.min()) * n
    back = Mesh.of(behind, faces[:, ::-1], uv=uv, material=Material.diffuse((0.0, 0.0, 0.0)))
    return Mesh.join([mesh, back])


def _triple(value: NDArray[np.float64] | Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in value)
    return x, y, z
