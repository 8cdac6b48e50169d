"""Stand-in geometry drawn on the map: planes, polygons, boxes and rooms from a few clicks.

Felinto, Zang and Velho, section 6.1 (seeds F5): the floor is y = 0, so a pixel below the
horizon is a point of it; outlines on the floor are raised to prisms. Each vertex keeps where it
was drawn as wx wy wz (seeds F8), so geometry that is moved later keeps its captured light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import StandIn
from chromeball.stand_in import outline
from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT, StandInMesh

#: A click this close to the horizon sees the floor more than a thousand heights away.
_HORIZON = 1e-3


@dataclass(frozen=True)
class Piece:
    """One entry of the stand-in as triangles, and what its drawing says of its accuracy.

    ``vertices`` (V, 3) float64 metres, ``faces`` (F, 3), ``surface`` (F,) as in
    :class:`StandInMesh`. ``height`` in metres, None where flat; ``height_miss``: how far the
    clicked ray passes from the vertical above the first corner; ``metres_per_pixel``: how far
    the worst clicked corner moves with one pixel. Both None where nothing was clicked.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    surface: NDArray[np.uint8]
    height: float | None = None
    height_miss: float | None = None
    metres_per_pixel: float | None = None


def floor_points(camera: CameraModel, pixels: ArrayLike) -> NDArray[np.float64]:
    """Where pixels (N, 2) of the map see the floor y = 0: (N, 2), x and z in metres.

    Raises
    ------
    UserError
        For a pixel outside the map, or at or above the horizon.

    """
    q = np.asarray(pixels, float).reshape(-1, 2)
    origin = camera.world_from_camera.translation
    rays = _rays(camera, q)
    for number, (pixel, ray) in enumerate(zip(q, rays, strict=True), 1):
        if ray[1] > -_HORIZON:
            raise UserError(
                f"point {number} ({_at(pixel)}) does not lie below the horizon (y "
                f"{(camera.size[1] - 1) / 2:g}): the ray through it never meets the floor"
            )
    return (origin - rays * (origin[1] / rays[:, 1])[:, None])[:, [0, 2]]


def metres_per_pixel(camera: CameraModel, corners: NDArray[np.float64]) -> float:
    """How far the farthest of `corners` (N, 2) on the floor moves with a pixel of the map."""
    origin = camera.world_from_camera.translation
    reach = float(np.hypot(*(corners - origin[[0, 2]]).T).max())
    # tan(elevation) = y / reach: d reach = (y^2 + reach^2) / y d elevation
    return (origin[1] ** 2 + reach**2) / origin[1] * np.pi / camera.size[1]


def height_above(
    camera: CameraModel, corner: NDArray[np.float64], pixel: ArrayLike
) -> tuple[float, float]:
    """Height of the point above the floor's `corner` (x, z) that `pixel` sees, and the miss.

    The ray o + s d and the vertical c + t y are nearest where their difference is normal to
    both; t is the height, and the miss is their distance there, both in metres.

    Raises
    ------
    UserError
        When the pixel looks straight up or down, away from the corner, or below the floor.

    """
    d = _rays(camera, np.asarray(pixel, float).reshape(1, 2))[0]
    o = camera.world_from_camera.translation
    across = np.array([corner[0] - o[0], corner[1] - o[2]])
    horizontal = d[[0, 2]]
    length2 = float(horizontal @ horizontal)
    where = f"height_point ({_at(np.ravel(np.asarray(pixel, float)))})"
    if length2 < 1e-12:
        raise UserError(f"{where} looks straight up or down: it gives no height")
    s = float(across @ horizontal) / length2
    if s <= 0:
        raise UserError(f"{where} looks away from the first corner, which it should be above")
    height = float(o[1] + s * d[1])
    if height <= 0:
        raise UserError(f"{where} lies below the floor at the first corner")
    return height, float(np.hypot(*(across - s * horizontal)))


def build_piece(entry: StandIn, camera: CameraModel | None = None) -> Piece:
    """The triangles of one entry; `camera` is the map that its pixels are of.

    Normals point outward (up for flat pieces), for a room inward. A box has no bottom: it
    stands on the floor.

    Raises
    ------
    UserError
        When the entry has keys that its kind does not take or lacks those it needs, when
        pixels are given without a map, and for everything that :func:`floor_points`,
        :func:`height_above` and :func:`chromeball.stand_in.outline.ring` refuse.

    """
    try:
        return _build(entry, camera)
    except UserError as error:
        raise UserError(f"stand_in {entry.name!r}: {error.what}") from error


def build_mesh(pieces: Sequence[Piece]) -> StandInMesh:
    """All pieces as one mesh."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    vertices = np.concatenate([piece.vertices for piece in pieces]).astype(np.float32)
    faces = [piece.faces + start for piece, start in zip(pieces, starts, strict=False)]
    return StandInMesh(
        vertices,
        vertices.copy(),
        np.concatenate(faces).astype(np.uint32),
        np.concatenate([piece.surface for piece in pieces]),
    )


def _build(entry: StandIn, camera: CameraModel | None) -> Piece:
    _check_keys(entry)
    surface = SUPPORT if entry.surface == "support" else ENVIRONMENT
    if entry.size is not None:
        x, z = entry.size[0] / 2, entry.size[1] / 2
        given = np.array([[-x, -z], [-x, z], [x, z], [x, -z]])
    elif entry.points:
        given = floor_points(_needed(camera), np.array(entry.points))
    else:
        given = np.array(entry.corners, float)
    ring = outline.ring(entry.outline, given)
    clicked = metres_per_pixel(camera, ring) if entry.points and camera is not None else None
    flat = outline.triangulate(ring)
    floor = np.stack([ring[:, 0], np.zeros(len(ring)), ring[:, 1]], axis=1)
    if entry.kind in ("plane", "polygon"):
        classes = np.full(len(flat), surface, np.uint8)
        return Piece(entry.name, floor, flat, classes, metres_per_pixel=clicked)

    miss = None
    if entry.height_point is not None:
        height, miss = height_above(_needed(camera), given[0], list(entry.height_point))
    else:
        assert entry.height is not None
        height = float(entry.height)
    count = len(ring)
    top = flat + count
    here = np.arange(count)
    after = np.roll(here, -1)
    walls = np.concatenate(
        [
            np.stack([here, after, after + count], axis=1),
            np.stack([here, after + count, here + count], axis=1),
        ]
    )
    if entry.kind == "box":
        faces = np.concatenate([top, walls])
        classes = np.full(len(faces), surface, np.uint8)
    else:  # a room is the prism with its bottom, seen from inside
        faces = np.concatenate([flat, top[:, ::-1], walls[:, ::-1]])
        classes = np.full(len(faces), ENVIRONMENT, np.uint8)
        classes[: len(flat)] = surface
    vertices = np.concatenate([floor, floor + np.array([0, height, 0])])
    return Piece(entry.name, vertices, faces, classes, height, miss, clicked)


def _check_keys(entry: StandIn) -> None:
    raised = entry.kind in ("box", "room")
    if entry.kind == "plane":
        if entry.size is None:
            raise UserError("a plane needs size, width and depth in metres")
        if entry.points or entry.corners or entry.outline != "polygon":
            raise UserError("a plane takes size alone; kind polygon takes points or corners")
    elif entry.size is not None:
        raise UserError(f"size is for a plane; a {entry.kind} takes points or corners")
    elif bool(entry.points) == bool(entry.corners):
        raise UserError(
            f"a {entry.kind} needs points (pixels of the map) or corners (x, z in metres)"
            + (", not both" if entry.points else "")
        )
    given = (entry.height is not None) + (entry.height_point is not None)
    if raised and given != 1:
        raise UserError(
            f"a {entry.kind} needs height (metres) or height_point (pixel above corner 1)"
            + (", not both" if given else "")
        )
    if not raised and given:
        raise UserError(f"a {entry.kind} is flat; kind box or room takes a height")


def _rays(camera: CameraModel, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    width, height = camera.size
    inside = (pixels >= -0.5) & (pixels <= [width - 0.5, height - 0.5])
    for number, (pixel, good) in enumerate(zip(pixels, inside.all(axis=1), strict=True), 1):
        if not good:
            raise UserError(
                f"point {number} ({_at(pixel)}) is outside the map ({width} x {height} pixels)"
            )
    return camera.rays(pixels)


def _needed(camera: CameraModel | None) -> CameraModel:
    if camera is None:
        raise UserError("pixels of the map are given, but no map: add --env env.exr")
    return camera


def _at(pixel: NDArray[np.float64]) -> str:
    return f"x {pixel[0]:g}, y {pixel[1]:g}"
