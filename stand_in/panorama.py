"""The map as a camera: where it was taken, what a pixel sees, and the mesh drawn over it."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.color import luminance
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_header, to_display
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import ENVIRONMENT, StandInMesh

#: Colours of the edges over the map: support green, environment blue, both where they meet.
_COLOURS = np.array([[60, 255, 60], [60, 160, 255]], np.uint8)


def panorama(size: tuple[int, int], origin: NDArray[np.float64]) -> CameraModel:
    """A lat-long map in world axes, taken at `origin` (3,) metres."""
    return CameraModel.latlong(size, Pose(WORLD_FROM_LATLONG.rotation, origin))


def read_panorama(path: str | os.PathLike[str]) -> CameraModel:
    """The camera of an ``env.exr``, from its header alone.

    Raises
    ------
    UserError
        When the file is missing or no picture, is not twice as wide as high, does not say its
        origin, or was not taken above the floor.

    """
    header = read_header(path)
    width, height = header.size
    if width != 2 * height:
        raise UserError(
            f"{width} x {height} is no lat-long map: it must be twice as wide as high",
            file=path,
        )
    origin = np.ravel(np.asarray(header.attributes.get("origin", ())))
    if origin.shape != (3,) or origin.dtype.kind not in "fi" or not np.isfinite(origin).all():
        raise UserError(
            "no attribute `origin` (x, y, z of the probe in metres): make the map with "
            "`envmap probe --align`",
            file=path,
        )
    if not origin[1] > 0:
        raise UserError(
            f"the map's origin lies at height {origin[1]:g} m; it must be above the floor",
            file=path,
        )
    return panorama(header.size, origin.astype(float))


def overlay(
    rgb: NDArray[np.float32], camera: CameraModel, mesh: StandInMesh, width: int = 1024
) -> NDArray[np.uint8]:
    """The outlines and edges of the mesh over the tone-mapped map, (h, w, 3) uint8 (seeds F6).

    `rgb` is the map, (H, W, 3). Edges that bend by less than 10 degrees are left out; hidden
    edges are drawn like visible ones, as for modelling.
    """
    step = max(1, rgb.shape[1] // width)
    small = rgb[step // 2 :: step, step // 2 :: step]
    grey = luminance(small)
    lit = grey[grey > 0]
    exposure = 0.18 / float(np.exp(np.log(lit).mean())) if lit.size else 1.0
    picture = to_display(small, exposure)
    height, width = picture.shape[:2]
    view = CameraModel.latlong((width, height), camera.world_from_camera)
    points, surface = _edge_points(mesh, camera.world_from_camera.translation, height)
    pixels = view.project_world(points)
    seen = np.isfinite(pixels).all(axis=1)
    x = np.rint(pixels[seen, 0]).astype(int) % width
    y = np.clip(np.rint(pixels[seen, 1]).astype(int), 0, height - 1)
    for dy, dx in ((1, 0), (0, 1), (1, 1), (0, 0)):
        picture[np.minimum(y + dy, height - 1), (x + dx) % width] = _COLOURS[surface[seen]]
    return picture


def _edge_points(
    mesh: StandInMesh, origin: NDArray[np.float64], height: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points along the edges, closer than a pixel of a map `height` pixels high."""
    ends, surface = _feature_edges(mesh)
    to_ends = ends - origin
    a, b = to_ends[:, 0], to_ends[:, 1]
    a, b = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12) for v in (a, b))
    cosine = (a * b).sum(axis=1)
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), cosine)
    counts = np.maximum(2, np.ceil(angle / (np.pi / height) * 2).astype(int) + 1)
    index = np.repeat(np.arange(len(ends)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    turn = (np.arange(counts.sum()) - first) / (counts[index] - 1) * angle[index]
    # Along the great circle from a towards b; what is left of b beside a spans the other axis.
    rest = b - cosine[:, None] * a
    rest /= np.maximum(np.linalg.norm(rest, axis=1, keepdims=True), 1e-12)
    along = np.cos(turn)[:, None] * a[index] + np.sin(turn)[:, None] * rest[index]
    return origin + along, surface[index]


def _feature_edges(mesh: StandInMesh) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Both ends (E, 2, 3) of each edge that is open or bends, and its surface."""
    corners = mesh.triangles()
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    pairs = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=-1), axis=-1)
    pairs = pairs.reshape(-1, 2)
    face = np.repeat(np.arange(len(mesh.faces)), 3)
    edges, place, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(edges), 3))
    np.add.at(total, place.reshape(-1), normals[face])
    # Unit normals at an angle t sum to 2 cos(t / 2).
    flat = (counts == 2) & (np.linalg.norm(total, axis=1) > 2 * np.cos(np.radians(10) / 2))
    surface = np.full(len(edges), ENVIRONMENT, np.uint8)
    np.minimum.at(surface, place.reshape(-1), mesh.surface[face])
    return mesh.vertices.astype(float)[edges[~flat]], surface[~flat]
