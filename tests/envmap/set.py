"""A set whose surfaces shine by a formula: every panorama of it is known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.virtual_room import stand_in
from chromeball.cli.envmap.geometry import caster
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.several import ProbeMap
from chromeball.scene.camera import CameraModel

type Array = NDArray[np.float64]

MESH = stand_in()
CAST = caster(MESH)
#: on either side of the screen
LEFT, RIGHT = np.array([-1.5, 1.2, 0.5]), np.array([1.4, 1.1, 0.4])
BEHIND = np.array([1.6, 1.0, -1.3])


def shine(q: Array, n: Array) -> Array:
    """Radiance of a place (N, 3) with normal (N, 3)."""
    x, y, z = q.T
    return np.stack(
        [2 + np.sin(2 * x), 2 + np.cos(2 * z + y), 1.5 + np.sin(x + z) + 0.4 * n[:, 0]], axis=1
    )


def radiance(origins: Array, d: Array) -> Array:
    t, n = CAST(origins, d)
    return shine(origins + t[:, None] * d, n)


def panorama(place: Array, width: int = 128, side: int = 3) -> ProbeMap:
    """The map that a perfect probe takes at `place`."""
    fine = LatLong((width * side, width * side // 2))
    d = fine.directions().reshape(-1, 3)
    values = radiance(np.broadcast_to(place, d.shape), d)
    height = width // 2
    means = values.reshape(height, side, width, side, 3).mean(axis=(1, 3))
    return ProbeMap(means.astype(np.float32), place)


def photograph(camera: CameraModel) -> NDArray[np.float32]:
    d = camera.rays(camera.pixel_grid()).reshape(-1, 3)
    eye = np.broadcast_to(camera.world_from_camera.translation, d.shape)
    return radiance(eye, d).reshape(*camera.size[::-1], 3).astype(np.float32)
