"""Away from the place of capture: what a camera sees that the light probe did not (row F14).

A camera that stands elsewhere sees the captured set by its stand-in geometry: each point shows
what the map holds in its direction. Where another surface stood between the map and the point,
the map holds that one instead: such pixels show the wrong surface, and their share says how far
a camera may travel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.world import world
from chromeball.scene.camera import CameraModel
from chromeball.stand_in.ply import StandInMesh

#: a surface this much nearer than the point, relatively, hides it
_NEARER = 1e-3


def unseen(captured: CapturedSet, camera: CameraModel) -> NDArray[np.bool_]:
    """Which pixels (H, W) show a place of the set that the map's origin does not see."""
    width, height = camera.size
    nothing = np.zeros((height, width), bool)
    stand_in = captured.stand_in
    if stand_in is None or not len(stand_in.faces):
        return nothing
    origin = np.asarray(captured.origin, float)
    now = world([_mesh(stand_in, stand_in.vertices)], about=origin)
    then = world([_mesh(stand_in, stand_in.original)], about=origin)
    d = camera.rays(camera.pixel_grid()).reshape(-1, 3).astype(np.float32)
    inside = np.flatnonzero(np.isfinite(d).all(axis=1))
    eye = (camera.world_from_camera.translation - origin).astype(np.float32)
    eyes = np.ascontiguousarray(np.broadcast_to(eye, (len(inside), 3)))
    found = now.hits(eyes, np.ascontiguousarray(d[inside])).reshape(-1, 15)
    met = np.isfinite(found[:, 0])
    place = _when_captured(stand_in, found[met], origin)
    distance = np.linalg.norm(place, axis=1)
    towards = (place / np.maximum(distance, 1e-30)[:, None]).astype(np.float32)
    first = then.hits(np.zeros_like(towards), np.ascontiguousarray(towards)).reshape(-1, 15)
    nothing.reshape(-1)[inside[met]] = first[:, 0] < distance * (1 - _NEARER)
    return nothing


def _mesh(stand_in: StandInMesh, vertices: NDArray[np.floating]) -> Mesh:
    return Mesh.of(vertices, stand_in.faces, 0.0)


def _when_captured(
    stand_in: StandInMesh, hits: NDArray[np.float32], origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where the places that were hit stood when the map was captured, from its origin."""
    if np.array_equal(stand_in.vertices, stand_in.original):
        return hits[:, 1:4].astype(float)
    corners = stand_in.faces[hits[:, 14].astype(np.intp)]
    a, b, c = (stand_in.vertices[corners[:, k]].astype(float) - origin for k in range(3))
    p = hits[:, 1:4] - a
    e1, e2 = b - a, c - a
    g11, g12, g22 = (e1 * e1).sum(1), (e1 * e2).sum(1), (e2 * e2).sum(1)
    p1, p2 = (p * e1).sum(1), (p * e2).sum(1)
    det = np.maximum(g11 * g22 - g12 * g12, 1e-300)
    u, v = (g22 * p1 - g12 * p2) / det, (g11 * p2 - g12 * p1) / det
    a, b, c = (stand_in.original[corners[:, k]].astype(float) - origin for k in range(3))
    return (1 - u - v)[:, None] * a + u[:, None] * b + v[:, None] * c
