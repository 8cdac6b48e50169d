"""Aperture, shutter and pixel filter against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.lens import Filter, Lens, edge, focus_axis, quantiles
from chromeball.renderer.mesh import Instance, Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import box
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: looks along -z from the origin, x to the right
AHEAD = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


def panel(x: tuple[float, float], y: tuple[float, float], z: float) -> Mesh:
    """A rectangle across the view that shines with radiance 1 and reflects nothing."""
    corners = np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh.of(corners.astype(np.float32), faces, 0.0, 1.0)


def seen(
    thing: Mesh | Instance, camera: CameraModel, lens: Lens, spp: int = 256
) -> NDArray[np.float64]:
    """The green channel (H, W)."""
    rays, origin = corner_rays(camera), camera.world_from_camera.translation
    return path_trace(thing, rays, origin, spp=spp, max_bounces=0, lens=lens)[..., 1].astype(
        float
    )


def disc_edge(x: NDArray[np.float64], diameter: float) -> NDArray[np.float64]:
    """How an edge looks through a disc of that diameter: the disc's share beyond x."""
    s = np.clip(2 * x / diameter, -1, 1)
    return 0.5 + (s * np.sqrt(1 - s * s) + np.arcsin(s)) / math.pi


@pytest.mark.parametrize("distance", [2.0, 4.0, 8.0])
def test_the_circle_of_confusion_is_that_of_a_thin_lens(distance: float) -> None:
    aperture, focus, fov = 0.1, 4.0, 0.3
    camera = CameraModel.pinhole((64, 4), fov, AHEAD)
    f = 32 / math.tan(fov / 2)
    lens = Lens(aperture=aperture, focus=focus, axis=focus_axis(camera))
    L = seen(panel((0, 9), (-9, 9), -distance), camera, lens, 1024).mean(axis=0)
    diameter = aperture * f * abs(distance - focus) / (distance * focus)  # pixels
    x = np.arange(64, dtype=float) - 31.5
    fine = x[:, None] + (np.arange(64) + 0.5) / 64 - 0.5  # over the pixel's area
    np.testing.assert_allclose(L, disc_edge(fine, max(diameter, 1e-6)).mean(axis=1), atol=0.015)


def test_a_sphere_is_in_focus_for_cameras_without_a_plane() -> None:
    """A fisheye focused at the distance of a small far panel to the side sees it sharp."""
    pose = AHEAD
    camera = CameraModel.fisheye("equidistant", (80, 80), math.pi, pose=pose)
    assert focus_axis(camera) is None
    target = np.array([2.0, 0.0, -2.0])  # 45 degrees off the axis
    side = np.array([1.0, 0.0, 1.0]) / math.sqrt(2)
    up = np.array([0.0, 1.0, 0.0])
    corners = [
        target + 0.5 * (a * side + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    thing = Mesh.of(np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]]), 0, 1)
    sharp = seen(thing, camera, Lens())
    focused = seen(thing, camera, Lens(aperture=0.2, focus=float(np.linalg.norm(target))))
    blurred = seen(thing, camera, Lens(aperture=0.2, focus=1.0))
    assert np.abs(focused - sharp).max() < 0.08
    assert np.abs(blurred - sharp).max() > 0.3
    # light is spread, not lost
    assert focused.sum() == pytest.approx(sharp.sum(), rel=0.02)


def test_focus_at_infinity_blurs_by_the_aperture_itself() -> None:
    camera = CameraModel.pinhole((64, 4), 0.3, AHEAD)
    lens = Lens(aperture=0.1, axis=focus_axis(camera))
    L = seen(panel((0, 9), (-9, 9), -2.0), camera, lens, 1024).mean(axis=0)
    diameter = 0.1 * 32 / math.tan(0.15) / 2
    x = np.arange(64, dtype=float) - 31.5
    np.testing.assert_allclose(L, disc_edge(x, diameter), atol=0.02)


def test_a_moving_camera_draws_a_streak_of_its_way() -> None:
    fov, way, z = 0.3, 0.1, 3.0
    camera = CameraModel.pinhole((64, 4), fov, AHEAD)
    end = Pose(AHEAD.rotation, np.array([way, 0, 0]))
    L = seen(panel((-0.05, 0.05), (-9, 9), -z), camera, Lens(motion=(AHEAD, end)), 1024)
    scale = 32 / math.tan(fov / 2) / z  # pixels a metre
    # a box of 0.1 m over a way of 0.1 m: a triangle from -0.15 to 0.05
    x = (np.arange(64) - 31.5)[:, None] / scale + (np.arange(64) + 0.5 - 32) / 64 / scale
    profile = np.clip(1 - np.abs(x + 0.05) / 0.1, 0, None).mean(axis=1)
    np.testing.assert_allclose(L.mean(axis=0), profile, atol=0.015)


def test_a_turning_camera_goes_through_its_poses() -> None:
    """A roll by 60 degrees: what is seen at a time is what the camera there would see."""
    camera = CameraModel.pinhole((32, 32), 0.6, AHEAD)
    roll = Pose.from_rotation_vector(np.array([0, 0, math.pi / 3]), np.zeros(3))
    end = roll @ AHEAD
    thing = panel((-0.1, 0.1), (0.3, 0.9), -3.0)
    L = seen(thing, camera, Lens(motion=(AHEAD, end)), 1024)
    moments = [
        seen(
            thing,
            camera.posed(
                Pose.from_rotation_vector(np.array([0, 0, t * math.pi / 3]), np.zeros(3))
                @ AHEAD
            ),
            Lens(),
            64,
        )
        for t in (np.arange(24) + 0.5) / 24
    ]
    np.testing.assert_allclose(L, np.mean(moments, axis=0), atol=0.06)
    assert L.sum() == pytest.approx(np.mean(moments, axis=0).sum(), rel=5e-3)


def test_a_moving_box_leaves_a_trapezoid() -> None:
    """Coverage of a box of width w on a way v: a trapezoid of height min(1, w / v)."""
    fov, z, w, v = 0.3, 3.0, 0.1, 0.25
    camera = CameraModel.pinhole((64, 4), fov, AHEAD)
    still = panel((-w / 2, w / 2), (-9, 9), 0.0)
    start = Pose(np.eye(3), np.array([-v / 2, 0, -z]))
    end = Pose(np.eye(3), np.array([v / 2, 0, -z]))
    moving = Instance(still, start, closing=(end, 1.0))
    scale = 32 / math.tan(fov / 2) / z
    x = ((np.arange(64) - 31.5)[:, None] + (np.arange(64) + 0.5) / 64 - 0.5) / scale
    trapezoid = np.clip(((v + w) / 2 - np.abs(x)) / v, 0, w / v).mean(axis=1)
    L = seen(moving, camera, Lens(shutter=True), 1024).mean(axis=0)
    np.testing.assert_allclose(L, trapezoid, atol=0.01)
    # without a shutter it stands where the shutter opens
    frozen = seen(moving, camera, Lens(), 64).mean(axis=0)
    there = seen(Instance(still, start), camera, Lens(), 64).mean(axis=0)
    np.testing.assert_allclose(frozen, there, atol=1e-6)


def test_a_turning_object_keeps_its_size_on_the_way() -> None:
    """A panel turns half about its middle: each moment covers the same area."""
    camera = CameraModel.pinhole((48, 48), 0.5, AHEAD)
    bar = panel((-0.5, 0.5), (-0.05, 0.05), 0.0)
    place = np.array([0.0, 0.0, -3.0])
    turned = Pose.from_rotation_vector(np.array([0, 0, 2.5]), place)
    moving = Instance(bar, Pose(np.eye(3), place), closing=(turned, 1.0))
    L = seen(moving, camera, Lens(shutter=True), 512)
    f = 24 / math.tan(0.25)
    assert L.sum() == pytest.approx(0.1 * (f / 3.0) ** 2, rel=5e-3)


def test_shadow_and_object_of_a_mover_are_blurred_in_the_composite() -> None:
    """The composite of a moving box is the mean of composites along its way."""
    camera = CameraModel.pinhole((48, 36), 0.9, Pose.look_at([0, 1.2, 2.5], [0, 0.2, 0]))
    from chromeball.stand_in.ply import StandInMesh

    v = np.array([[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], np.float32)
    floor = StandInMesh(
        v, v, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), np.zeros(2, np.uint8)
    )
    sky = np.full((16, 32, 3), 0.3, np.float32)
    sky[2:4, 6:9] = 30
    captured = CapturedSet(sky, np.array([0.0, 1.0, 0.0]), floor)
    vertices, faces, _ = box()
    cube = Mesh.of(vertices, faces, 0.5)
    rays, origin = corner_rays(camera), camera.world_from_camera.translation
    plate = np.full((36, 48, 3), 0.5, np.float32)

    def render(thing: Instance, lens: Lens, samples: int) -> NDArray[np.float64]:
        compositor = Compositor(
            [thing], captured, rays, origin, plate, bounces=1, samples=samples, lens=lens
        )
        compositor.add(samples)
        return compositor.result().rgb.astype(float)

    def at(t: float) -> Pose:
        return Pose(np.eye(3), np.array([-0.6 + 1.2 * t, 0.2, 0.0]))

    blurred = render(Instance(cube, at(0), 0.4, closing=(at(1), 0.4)), Lens(shutter=True), 256)
    times = (np.arange(32) + 0.5) / 32
    mean = np.mean([render(Instance(cube, at(t), 0.4), Lens(), 16) for t in times], axis=0)
    difference = blurred - mean
    assert np.abs(difference.mean()) < 2e-3
    assert np.sqrt((difference**2).mean()) < 0.012
    assert np.abs(render(Instance(cube, at(0.5), 0.4), Lens(), 64) - mean).max() > 0.1


@pytest.mark.parametrize("name", ["box", "gaussian", "blackman-harris"])
def test_an_edge_is_the_step_convolved_with_the_filter(name: Filter) -> None:
    camera = CameraModel.pinhole((32, 16), 0.3, AHEAD)
    f = 16 / math.tan(0.15)
    at = 0.3 / f * 3  # the edge lies 0.3 pixels off a pixel's border
    L = seen(panel((at, 9), (-9, 9), -3.0), camera, Lens(filter=name), 1024).mean(axis=0)
    x = np.arange(32, dtype=float) - 15.8
    wanted = edge(name, x) if name != "box" else np.clip(x + 0.5, 0, 1)
    np.testing.assert_allclose(L, wanted, atol=0.01)


def test_filters_are_even_and_integrate_to_one() -> None:
    for name in ("gaussian", "blackman-harris"):
        q = quantiles(name)
        np.testing.assert_allclose(q, -q[::-1], atol=2e-3)
        assert (np.diff(q) > 0).all()
    x = np.linspace(-2, 2, 401)
    variance = integrate.simpson(x**2 * np.gradient(edge("gaussian", x), x), x=x)
    assert math.sqrt(variance) == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("name", ["box", "gaussian", "blackman-harris"])
def test_the_filter_leaves_the_plate_alone(name: Filter) -> None:
    """Half-covered pixels show the plate unblurred; beyond the filter its bits stay."""
    camera = CameraModel.pinhole((40, 30), 0.6, AHEAD)
    rays, origin = corner_rays(camera), camera.world_from_camera.translation
    plate = np.random.default_rng(0).uniform(0.1, 1, (30, 40, 3)).astype(np.float32)
    captured = CapturedSet(np.full((8, 16, 3), 0.5, np.float32), np.zeros(3))
    compositor = Compositor(
        [panel((-0.2, 0.2), (-0.2, 0.2), -3.0)],
        captured,
        rays,
        origin,
        plate,
        samples=64,
        lens=Lens(filter=name),
    )
    compositor.add(64)
    made = compositor.result()
    away = made.alpha == 0
    np.testing.assert_array_equal(made.rgb[away], plate[away])
    np.testing.assert_allclose(
        made.rgb, plate * (1 - made.alpha[..., None]) + made.alpha[..., None], atol=1e-5
    )
    f = 20 / math.tan(0.3)
    assert made.alpha.sum() == pytest.approx((0.4 * f / 3) ** 2, rel=0.01)


def test_the_rim_of_picture_and_lens_is_filtered_with_what_is_there() -> None:
    camera = CameraModel.fisheye("equisolid", (40, 40), 2.0, pose=AHEAD)
    sky = np.ones((8, 16, 3), np.float32)
    rays = corner_rays(camera)
    L = path_trace(
        Mesh.empty(), rays, (0, 0, 0), environment=sky, lens=Lens(filter="gaussian"), spp=16
    )
    corners = np.isfinite(rays).all(axis=2)
    inside = corners[1:, 1:] & corners[1:, :-1] & corners[:-1, 1:] & corners[:-1, :-1]
    np.testing.assert_allclose(L[inside], 1, rtol=1e-5)
    assert (L[~inside] == 0).all()


def test_lenses_that_cannot_be_are_refused() -> None:
    with pytest.raises(UserError, match=r"aperture of -1\.0"):
        Lens(aperture=-1.0)
    with pytest.raises(UserError, match="before the camera"):
        Lens(focus=0.0)
    with pytest.raises(UserError, match=r"scale is 0\.0"):
        Instance(panel((0, 1), (0, 1), 0), closing=(Pose.identity(), 0.0))
