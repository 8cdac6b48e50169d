"""Mirrors and glass show the photograph (seeds F12, blender T71253)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Compositor, Reflect
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import box
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import SUPPORT, StandInMesh

ORIGIN = np.array([0.0, 1.0, 0.5])
EYE = np.array([0.3, 1.1, 2.4])
SIZE = (160, 120)
POSE = Pose.look_at(EYE, np.array([0.0, 0.35, 0.0]))
PINHOLE = CameraModel.pinhole(SIZE, math.radians(60), POSE)
CORNERS = np.array([[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], np.float32)
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
FLOOR = StandInMesh(CORNERS, CORNERS, QUAD, np.full(2, SUPPORT, np.uint8))
SKY = np.full((16, 32, 3), 0.4, np.float32)  # far too coarse for the floor's pattern
GREY = 0.4


def mirror(color: float = 1.0) -> Mesh:
    """Upright, its face at z = 0."""
    vertices, faces, _ = box()
    mesh = Mesh.of(vertices, faces, color, kind=Kind.MIRROR)
    return mesh.placed(Pose(np.eye(3), np.array([0, 0, -0.05])), (1.6, 1.2, 0.1))


def pattern(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The floor's own: smooth waves of some pixels."""
    wave = np.sin(17 * x[..., 0] + 0.3) * np.sin(13 * x[..., 2])
    return np.asarray(GREY * (1 + 0.6 * wave))


def on_floor(
    eye: NDArray[np.float64], d: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    down = d[..., 1] < -1e-6
    p = eye - d * (eye[1] / np.where(down, d[..., 1], -1))[..., None]
    return p, down & (np.abs(p) < 4).all(axis=-1)


def over_pixel(
    view: CameraModel, value: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """The mean of value(directions) over each pixel."""
    steps = (np.arange(4) - 1.5) / 4
    grid = view.pixel_grid()
    each = [value(view.rays(grid + np.array([x, y]))) for x in steps for y in steps]
    return np.asarray(np.mean(each, axis=0))


def photograph(view: CameraModel) -> NDArray[np.float32]:
    def shown(d: NDArray[np.float64]) -> NDArray[np.float64]:
        p, floor = on_floor(EYE, d)
        return np.asarray(np.where(floor, pattern(p), GREY))

    grey = over_pixel(view, shown)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.float32)


def render(
    things: list[Mesh], view: CameraModel, reflect: Reflect, plate: NDArray[np.float32]
) -> NDArray[np.float32]:
    job = Compositor(
        things,
        CapturedSet(SKY, ORIGIN, FLOOR),
        corner_rays(view),
        EYE,
        plate,
        bounces=0,
        samples=16,
        reflect=reflect,
    )
    job.add(16)
    r = job.result()
    return np.where(r.alpha[..., None] == 1, r.rgb, np.float32(np.nan))


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_a_mirror_shows_the_floor_as_the_plate_does(lens: str) -> None:
    view = PINHOLE
    if lens == "fisheye":
        view = CameraModel.fisheye("equidistant", SIZE, math.radians(80)).posed(POSE)
    rgb = render([mirror()], view, "plate", photograph(view))[..., 0]
    d = view.rays(view.pixel_grid())
    at = EYE - d * (EYE[2] / d[..., 2])[..., None]  # on the mirror
    p, floor = on_floor(EYE * [1, 1, -1], d * [1, 1, -1])
    seen = view.project_world(p)
    inside = ((seen > 8) & (seen < np.array(SIZE) - 9)).all(axis=-1)
    inside &= p[..., 2] < 1.6  # fine enough in the plate
    if lens == "fisheye":  # its circle
        inside &= np.hypot(*np.moveaxis(seen - [79.5, 59.5], -1, 0)) < 50
    floor &= np.isfinite(rgb)
    shown = floor & inside & (np.abs(at[..., 0]) < 0.78) & (at[..., 1] < 1.15)
    assert shown.sum() > 300
    expected = over_pixel(
        view, lambda d: pattern(on_floor(EYE * [1, 1, -1], d * [1, 1, -1])[0])
    )
    assert np.std(expected[shown]) > 0.08
    np.testing.assert_allclose(rgb[shown], expected[shown], atol=0.05)
    # a pixel further the pattern is another one: the places are right
    beside = np.roll(expected, 1, axis=1)
    assert np.abs(rgb - beside)[shown].mean() > 2 * np.abs(rgb - expected)[shown].mean()
    outside = floor & ((seen < -6) | (seen > np.array(SIZE) + 5)).any(axis=-1)
    assert outside.any() or lens == "fisheye"
    np.testing.assert_allclose(rgb[outside], GREY, atol=1e-3)  # as the map has it


def test_the_border_of_the_plate_is_soft() -> None:
    bright = np.full((SIZE[1], SIZE[0], 3), 0.8, np.float32)
    rgb = render([mirror()], PINHOLE, "plate", bright)[..., 0]

    def shown(d: NDArray[np.float64]) -> NDArray[np.float64]:
        p, floor = on_floor(EYE * [1, 1, -1], d * [1, 1, -1])
        inside = np.minimum(seen := PINHOLE.project_world(p) + 0.5, SIZE - seen).min(axis=-1)
        weight = np.clip(np.nan_to_num(inside) / 4, 0, 1)
        return np.asarray(np.where(floor, GREY + 0.4 * weight, GREY))

    expected = over_pixel(PINHOLE, shown)
    face = np.isfinite(rgb)
    assert ((expected > GREY + 0.05) & (expected < 0.75) & face).sum() > 50
    # the mirror's rim sees the floor through what hides it, the mirror itself
    assert np.quantile(np.abs(rgb - expected)[face], 0.95) < 0.03


def test_the_map_alone_where_it_is_asked_for() -> None:
    plate = photograph(PINHOLE)
    rgb = render([mirror()], PINHOLE, "map", plate)
    np.testing.assert_allclose(rgb[np.isfinite(rgb)], GREY, atol=1e-4)


def test_what_stands_before_a_place_is_not_mirrored_as_floor() -> None:
    """A real thing that an object covers does not come back in the mirror (seeds F7)."""
    plate = np.full((SIZE[1], SIZE[0], 3), GREY, np.float32)
    vertices, faces, _ = box()
    cover = Mesh.of(vertices, faces, material=Material.diffuse((0.0, 0.0, 0.0))).placed(
        Pose(np.eye(3), np.array([0.1, 0, 0.9])), 0.3
    )
    hidden = plate.copy()
    d = PINHOLE.rays(PINHOLE.pixel_grid())
    p, floor = on_floor(EYE, d)
    near = floor & (np.abs(p[..., 0] - 0.1) < 0.1) & (np.abs(p[..., 2] - 0.9) < 0.1)
    assert near.sum() > 10
    hidden[near] = 50
    a, b = (render([mirror(), cover], PINHOLE, "plate", rgb) for rgb in (plate, hidden))
    np.testing.assert_array_equal(a, b)


def test_paths_that_no_object_bends_keep_the_plate() -> None:
    """Glass of index 1 in front of the camera changes nothing."""
    vertices, faces, _ = box()
    pane = Mesh.of(vertices, faces, 1.0, kind=Kind.GLASS, ior=1.0).placed(
        Pose(np.eye(3), np.array([0, 0.3, 0.6])), (0.8, 0.5, 0.05)
    )
    plate = photograph(PINHOLE)
    shown = render([pane], PINHOLE, "plate", plate)
    flat = np.isfinite(shown[..., 0]) & on_floor(EYE, PINHOLE.rays(PINHOLE.pixel_grid()))[1]
    assert flat.sum() > 300
    # the pane hides the floor behind it from the camera: there the map is asked
    np.testing.assert_allclose(shown[flat], GREY, atol=2e-3)
