"""A room of two lamps and a screen across, path-traced: truth for light that changes or varies.

Light is linear: the room is traced once for each lamp, and every setting of the lamps is a sum.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.gather import LitSet, light_set
from chromeball.renderer.mesh import Mesh, Values
from chromeball.renderer.path import corner_rays
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT, StandInMesh

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: Half of the room's length (x) and depth (z), and its height; the screen stands at x = 0 from
#: the back wall to the middle.
LENGTH, DEPTH, HEIGHT = 3.0, 2.0, 2.5
LAMPS = ((-1.8, 0.3), (1.9, 0.5))
_LAMP = 0.35
WARM, COLD = (60.0, 45.0, 28.0), (30.0, 40.0, 52.0)


def _walls() -> list[tuple[Array, tuple[float, float, float]]]:
    x, z, y = LENGTH, DEPTH, HEIGHT
    screen = 0.03
    quads = [
        ([[-x, 0, z], [x, 0, z], [x, 0, -z], [-x, 0, -z]], (0.35, 0.3, 0.25)),
        ([[-x, y, -z], [x, y, -z], [x, y, z], [-x, y, z]], (0.75, 0.75, 0.73)),
        ([[-x, 0, -z], [-x, y, -z], [-x, y, z], [-x, 0, z]][::-1], (0.6, 0.25, 0.2)),
        ([[x, 0, -z], [x, y, -z], [x, y, z], [x, 0, z]], (0.25, 0.35, 0.6)),
        ([[-x, 0, -z], [x, 0, -z], [x, y, -z], [-x, y, -z]], (0.6, 0.6, 0.58)),
        ([[-x, 0, z], [x, 0, z], [x, y, z], [-x, y, z]][::-1], (0.6, 0.6, 0.58)),
        # the screen: two sides and its edge
        ([[-screen, 0, -z], [-screen, y, -z], [-screen, y, 0.2], [-screen, 0, 0.2]],
         (0.3, 0.55, 0.3)),
        ([[screen, 0, -z], [screen, y, -z], [screen, y, 0.2], [screen, 0, 0.2]][::-1],
         (0.65, 0.55, 0.2)),
        ([[-screen, 0, 0.2], [-screen, y, 0.2], [screen, y, 0.2], [screen, 0, 0.2]],
         (0.5, 0.5, 0.5)),
    ]  # fmt: skip
    return [(np.array(corners, float), albedo) for corners, albedo in quads]


def _lamp(k: int) -> Array:
    x, z, y = *LAMPS[k], HEIGHT - 0.01
    return np.array(
        [[x - _LAMP, y, z - _LAMP], [x + _LAMP, y, z - _LAMP], [x + _LAMP, y, z + _LAMP],
         [x - _LAMP, y, z + _LAMP]]
    )  # fmt: skip


def mesh(lit: int) -> Mesh:
    """The room with one of its lamps lit."""
    walls = _walls()
    corners = [c for c, _ in walls] + [_lamp(0), _lamp(1)]
    vertices = np.concatenate(corners).astype(np.float32)
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], axis=1).reshape(-1, 3)
    albedo = [a for _, a in walls] + [(0.0, 0.0, 0.0)] * 2
    emission: list[Values] = [(0.0, 0.0, 0.0)] * len(corners)
    emission[len(walls) + lit] = (WARM, COLD)[lit]
    return Mesh.of(
        vertices,
        faces,
        np.repeat(albedo, 2, axis=0),
        np.repeat(np.array(emission, float), 2, axis=0),
    )


def stand_in() -> StandInMesh:
    """Floor and screen as a person would draw them."""
    corners = [c for c, _ in _walls()]
    vertices = np.concatenate(corners).astype(np.float32)
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], axis=1).reshape(-1, 3)
    surface = np.full(len(faces), ENVIRONMENT, np.uint8)
    surface[:2] = SUPPORT
    return StandInMesh(vertices, vertices, faces.astype(np.uint32), surface)


@lru_cache
def _solved(lit: int) -> LitSet:
    return light_set(mesh(lit), edge=0.25, spp=128, seed=lit)


@lru_cache(maxsize=64)
def _seen(camera: str, lit: int, spp: int) -> Picture:
    model = _CAMERAS[camera]
    rays, eye = corner_rays(model), model.world_from_camera.translation
    return _solved(lit).radiance(rays, eye, spp=spp, seed=lit)


_CAMERAS: dict[str, CameraModel] = {}


def photograph(
    camera: CameraModel, lamps: tuple[float, float] = (1.0, 1.0), spp: int = 32
) -> Picture:
    """What a camera sees, the lamps dimmed by factors."""
    key = camera.text()
    _CAMERAS[key] = camera
    one, two = (_seen(key, lit, spp) for lit in (0, 1))
    return (lamps[0] * one + lamps[1] * two).astype(np.float32)


def panorama(
    place: Values, lamps: tuple[float, float] = (1.0, 1.0), width: int = 128, spp: int = 32
) -> Picture:
    """The lat-long map at a place."""
    base = CameraModel.latlong((width, width // 2))
    pose = Pose(base.world_from_camera.rotation, np.asarray(place, float))
    return photograph(base.posed(pose), lamps, spp)


def view(place: Values, target: Values, size: tuple[int, int] = (144, 108)) -> CameraModel:
    """A camera that looks at a point."""
    pose = Pose.look_at(np.asarray(place, float), np.asarray(target, float))
    return CameraModel.pinhole(size, math.radians(80), pose)
