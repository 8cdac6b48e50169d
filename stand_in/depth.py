"""The light-depth map: radiance and distance for each direction from the map's origin (F9).

All rays start at one point, so a triangle is three planes through it. With the corners a, b, c
relative to the origin, a direction d = alpha a + beta b + gamma c meets the triangle where the
three weights are not negative, at the distance 1 / (alpha + beta + gamma). A tile of the map
that lies beyond one of the planes is skipped.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.stand_in.ply import StandInMesh

#: Side of the tiles that triangles are sorted out for, pixels.
TILE = 32


def distance_map(mesh: StandInMesh, camera: CameraModel) -> NDArray[np.float32]:
    """Metres to the nearest face along each pixel centre of `camera`, (H, W) float32.

    Infinite where there is no face: light that arrives there is directional. Both sides of a
    face count. Felinto, Zang and Velho, section 7.1.
    """
    planes, volumes = _planes(mesh, camera.world_from_camera.translation)
    width, height = camera.size
    rays = camera.rays(camera.pixel_grid())
    distance = np.full((height, width), np.inf, np.float32)
    for y in range(0, height, TILE):
        for x in range(0, width, TILE):
            part = np.s_[y : y + TILE, x : x + TILE]
            d = rays[part].reshape(-1, 3)
            near = _may_meet(planes, d)
            if near.any():
                nearest = _nearest(planes[near], volumes[near], d)
                distance[part] = nearest.reshape(distance[part].shape)
    return distance


def shrink(rgb: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """The lat-long map (H, W, 3) at a smaller `width`, rows weighted by their solid angle.

    Raises
    ------
    UserError
        When `width` does not divide the map's width into an even number of pixels.

    """
    full = rgb.shape[1]
    if width < 2 or width % 2 or full % width:
        divisors = [n for n in range(2, full + 1, 2) if full % n == 0]
        raise UserError(
            f"width {width} does not fit a map {full} pixels wide; "
            f"one of {', '.join(map(str, divisors[-5:]))}"
        )
    step = full // width
    weights = row_solid_angles(rgb.shape[0], full).reshape(-1, step)
    weights = weights / weights.sum(axis=1, keepdims=True)
    blocks = rgb.reshape(width // 2, step, width, step, 3).mean(axis=3, dtype=float)
    return np.einsum("rs,rswc->rwc", weights, blocks).astype(np.float32)


def row_solid_angles(height: int, width: int) -> NDArray[np.float64]:
    """Solid angle of a pixel in each row of a lat-long map, (height,), steradians."""
    latitude = np.linspace(-math.pi / 2, math.pi / 2, height + 1)
    return np.diff(np.sin(latitude)) * (2 * math.pi / width)


def coverage(distance: NDArray[np.float32]) -> dict[str, float | None]:
    """Solid angle that the stand-in covers, its share of the sphere, and the distances met."""
    met = np.isfinite(distance)
    solid = float((row_solid_angles(*distance.shape) * met.sum(axis=1)).sum())
    inside = distance[met]
    return {
        "solid_angle": solid,
        "sphere_share": solid / (4 * math.pi),
        "distance_min": float(inside.min()) if inside.size else None,
        "distance_max": float(inside.max()) if inside.size else None,
    }


def _planes(
    mesh: StandInMesh, origin: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inward normals (F, 3 planes, 3) through `origin`, and six times the cone's volume, (F,).

    Cross products change sign exactly with the order of their factors, so neighbours share
    their plane and no ray slips between them. A face seen edge-on covers no direction.
    """
    corners = mesh.triangles() - origin
    planes = np.cross(np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1))
    volume = (corners[:, 0] * planes[:, 0]).sum(axis=1)
    scale = np.abs(corners).max(axis=(1, 2)) ** 3
    seen = np.abs(volume) > 1e-12 * scale
    planes, volume = planes[seen], volume[seen]
    return planes * np.sign(volume)[:, None, None], np.abs(volume)


def _may_meet(planes: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Faces that a cone around all `rays` (N, 3) does not miss for sure, (F,)."""
    axis = rays.mean(axis=0)
    length = float(np.linalg.norm(axis))
    if length < 0.1:  # no useful cone
        return np.ones(len(planes), bool)
    axis /= length
    cosine = float((rays @ axis).min())
    if cosine <= 0:
        return np.ones(len(planes), bool)
    sine = math.sqrt(max(0.0, 1 - cosine**2)) + 1e-9
    return (planes @ axis >= -sine * np.linalg.norm(planes, axis=2)).all(axis=1)


def _nearest(
    planes: NDArray[np.float64], volumes: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance along each of `rays` (N, 3), infinite where no face is met."""
    nearest = np.zeros(len(rays))  # of 1 / distance
    for start in range(0, len(planes), 256):
        part = planes[start : start + 256]
        weights = (rays @ part.reshape(-1, 3).T).reshape(len(rays), -1, 3)
        inverse = weights.sum(axis=2) / volumes[start : start + 256]
        met = (weights >= 0).all(axis=2)
        np.maximum(nearest, np.where(met, inverse, 0).max(axis=1), out=nearest)
    with np.errstate(divide="ignore"):
        return 1 / nearest
