"""Absolute units from readings; balls and charts rendered from a map, by a second route."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.envmap import app
from chromeball.envmap.ball import ball_in_circle, find_ball
from chromeball.envmap.check import (
    Patch,
    colour_chart,
    matt_ball,
    mirror_ball_check,
    side_by_side,
)
from chromeball.envmap.mapping import LatLong, pixel_grid
from chromeball.envmap.picture import latlong_attributes
from chromeball.envmap.units import Lux, Spot, absolute_units
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.pose import Pose

UP = np.array([0.0, 1, 0])


def sky(d: np.ndarray) -> np.ndarray:
    """A smooth sky with a soft light to one side, over a brown floor; (..., 3)."""
    side = np.array([0.6, 0.5, 0.62])
    glow = np.exp(20 * (d @ (side / np.linalg.norm(side)) - 1))
    base = 1 + 0.5 * d[..., 1] + 0.3 * d[..., 0]
    return base[..., None] * [0.8, 1.0, 1.2] + 12 * glow[..., None] * [1.0, 0.9, 0.7]


def sky_map(width: int = 256) -> np.ndarray:
    return sky(LatLong((width, width // 2)).directions()).astype(np.float32)


# ---- units


def test_an_even_world_has_a_closed_form() -> None:
    """E = pi L on any surface: 1000 lux on L = 2 is 1000 / 2 pi."""
    even = np.full((32, 64, 3), 2, np.float32)
    found = absolute_units(even, [Lux(1000.0, UP)])
    assert found.factor == pytest.approx(1000 / (2 * math.pi), rel=1e-4)
    assert found.sigma == pytest.approx(0.05)
    spot = absolute_units(even, [Spot(300.0, (3, 4, 5, 6))])
    assert spot.factor == pytest.approx(150)
    assert not found.warnings


def test_a_metered_world_gets_its_units_back() -> None:
    """Readings of a world 37 times as bright, by numeric integrals of another route."""
    picture, mapping = sky_map(), LatLong((256, 128))
    d, solid = mapping.directions(), mapping.solid_angles()
    y = picture @ LUMINANCE
    normals = np.array([[0, 1, 0], [1, 0, 0], [0.3, 0.8, -0.5]], float)
    lux = [
        37 * float((y * np.maximum(d @ (n / np.linalg.norm(n)), 0) * solid).sum())
        for n in normals
    ]
    readings = [Lux(v, n) for v, n in zip(lux, normals, strict=True)]
    found = absolute_units(picture, [*readings, Spot(37 * float(y[40, 100]), (100, 40, 1, 1))])
    assert found.factor == pytest.approx(37, rel=2e-3)
    assert np.abs(found.deviations).max() < 5e-3
    assert found.sigma == pytest.approx(0.025)


def test_a_reading_that_contradicts_is_named() -> None:
    even = np.full((32, 64, 3), 2, np.float32)
    lux = 2 * math.pi
    readings = [Lux(lux, UP), Lux(1.02 * lux, -UP), Lux(0.99 * lux, UP), Lux(1.6 * lux, UP)]
    found = absolute_units(even, readings)
    assert any("reading 4 is +" in w for w in found.warnings)
    assert found.sigma > 0.025  # the scatter shows in the error
    two = absolute_units(even, [readings[0], readings[3]])
    assert two.warnings == ("the two readings differ by 60 %",)


def test_light_that_was_clipped_or_not_seen_is_told() -> None:
    picture = sky_map(64)
    clipped = np.zeros((32, 64), bool)
    clipped[np.unravel_index(int(picture[..., 1].argmax()), (32, 64))] = True
    found = absolute_units(picture, [Lux(9.0, np.array([0.6, 0.5, 0.62]))], clipped=clipped)
    assert "too bright for every exposure" in found.warnings[0]
    valid = np.ones((32, 64), bool)
    valid[:8] = False
    assert "not seen" in absolute_units(picture, [Lux(9.0, UP)], valid=valid).warnings[0]


@pytest.mark.parametrize(
    ("reading", "message"),
    [
        (Lux(-1.0, UP), "must be positive"),
        (Lux(5.0, np.zeros(3)), "faces nowhere"),
        (Spot(5.0, (60, 0, 8, 8)), "outside the map"),
        (Spot(5.0, (0, 0, 0, 8)), "outside the map"),
    ],
)
def test_bad_readings(reading: Lux | Spot, message: str) -> None:
    with pytest.raises(UserError, match=message):
        absolute_units(np.full((32, 64, 3), 2, np.float32), [reading])


def test_no_reading_and_a_black_place() -> None:
    with pytest.raises(UserError, match="no reading"):
        absolute_units(np.full((32, 64, 3), 2, np.float32), [])
    half = np.full((32, 64, 3), 2, np.float32)
    half[:, :32] = 0
    with pytest.raises(UserError, match="black where the meter looked"):
        absolute_units(half, [Spot(5.0, (3, 3, 4, 4))])


def test_the_units_command(tmp_path: Path) -> None:
    picture = sky_map(64)
    planes = np.dstack([picture, np.full((32, 64), 0.5), 0.1 * picture, np.full((32, 64), 3.0)])
    names = ("R", "G", "B", "A", "sigma.R", "sigma.G", "sigma.B", "completed")
    env, out = tmp_path / "env.exr", tmp_path / "cd.exr"
    write_exr(env, planes, channels=names, attributes=latlong_attributes({}, [0, 1, 2]))
    command = ["units", str(env), "--lux", "700", "--luminance", "90", "--at", "3,4,2,2"]
    app([*command, "-o", str(out)], result_action="return_value", exit_on_error=False)
    image = read_image(out)
    factor = json.loads((tmp_path / "cd.exr.record.json").read_text())["figures"]["factor"]
    for k, name in enumerate(names):
        got = image.pixels[..., image.channels.index(name)]
        scaled = factor if name not in ("A", "completed") else 1.0
        np.testing.assert_allclose(got, planes[..., k] * scaled, rtol=1e-5)
    assert image.attributes["whiteLuminance"] == 1
    np.testing.assert_allclose(np.ravel(image.attributes["origin"]), [0, 1, 2])
    for bad, message in (
        (["--lux", "7", "--normal", "0,1,0 1,0,0"], "1 readings, --normal 2"),
        (["--luminance", "7"], "1 readings, --at 0"),
        (["--normal", "0,1,0"], "--normal is for --lux"),
    ):
        with pytest.raises(UserError, match=message):
            app(["units", str(env), *bad, "-o", str(out)], result_action="return_value",
                exit_on_error=False)  # fmt: skip


# ---- balls

CAMERA = CameraModel.fisheye("equisolid", (240, 200), math.radians(70))
POSE = Pose.look_at([0.3, 0.4, 2.0], [0.0, 0.1, 0.0])


def photographed(radius: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays and normals where they meet a ball about (0, 0.1, 0), by the quadratic; the mask."""
    d = CAMERA.unproject(pixel_grid(CAMERA.size)) @ POSE.rotation.T
    to = np.array([0.0, 0.1, 0.0]) - POSE.translation
    b = d @ to
    under = b**2 - (to @ to - radius**2)
    with np.errstate(invalid="ignore"):
        hit = under > 0
    t = b - np.sqrt(np.where(hit, under, 0))
    normals = (t[..., None] * d - to) / radius
    return d, normals, hit


def outline() -> np.ndarray:
    """Pixels where rays touch the ball."""
    to = POSE.inverse().apply([0.0, 0.1, 0.0])
    far = float(np.linalg.norm(to))
    side = np.linalg.svd(to[None] / far)[2][1:]
    phi = np.linspace(0, 2 * math.pi, 12, endpoint=False)[:, None]
    reach = math.tan(math.asin(0.5 / far))
    return CAMERA.project(to / far + reach * (np.cos(phi) * side[0] + np.sin(phi) * side[1]))


def matt_photograph(albedo: float) -> np.ndarray:
    _, normals, hit = photographed()
    small, mapping = sky_map(64), LatLong((64, 32))
    d, solid = mapping.directions().reshape(-1, 3), mapping.solid_angles().ravel()
    light = np.zeros((*hit.shape, 3))
    light[hit] = np.maximum(normals[hit] @ d.T, 0) @ (small.reshape(-1, 3) * solid[:, None])
    return (albedo / math.pi * light).astype(np.float32)


def test_a_matt_ball() -> None:
    photograph = matt_photograph(0.18)
    ball = find_ball(CAMERA, outline())
    found = matt_ball(sky_map(), photograph, ball, POSE.rotation)
    assert found.ratio == pytest.approx([1, 1, 1], abs=0.01)
    assert found.median < 0.005
    assert found.worst < 0.02
    assert math.degrees(found.light_off) < 0.5
    # another albedo shows in the ratio alone; a turned map in the light's direction
    half = matt_ball(sky_map(), photograph, ball, POSE.rotation, albedo=0.36)
    assert half.ratio == pytest.approx([0.5] * 3, rel=0.01)
    assert half.median == pytest.approx(1, abs=0.02)
    assert half.median_shape < 0.005
    turned = np.roll(sky_map(), 10, axis=1)  # 14 degrees
    off = matt_ball(turned, photograph, ball, POSE.rotation)
    assert 3 < math.degrees(off.light_off) < 20
    picture = side_by_side(found)
    assert picture.shape[1] % 3 == 0
    third = picture[:, 2 * picture.shape[1] // 3 :]
    assert np.abs(third[third > 0] - 0.5).max() < 0.1  # no difference: grey


def test_a_chrome_ball() -> None:
    d, normals, hit = photographed()
    reflected = d - 2 * np.sum(d * normals, axis=-1, keepdims=True) * normals
    photograph = np.where(hit[..., None], 0.9 * sky(np.nan_to_num(reflected)), 0)
    photograph = photograph.astype(np.float32)
    ball = find_ball(CAMERA, outline())
    found = mirror_ball_check(sky_map(512), photograph, ball, POSE.rotation, reflectance=0.9)
    assert found.ratio == pytest.approx([1, 1, 1], abs=0.01)
    assert found.median < 0.01
    assert found.worst < 0.05
    assert math.degrees(found.light_off) < 0.3
    turned = np.roll(sky_map(512), 10, axis=1)  # 7 degrees about the vertical
    off = mirror_ball_check(turned, photograph, ball, POSE.rotation, reflectance=0.9)
    assert math.degrees(off.light_off) == pytest.approx(7 * math.cos(0.53), abs=1)


def test_a_chart() -> None:
    rng = np.random.default_rng(2)
    reflectance = rng.uniform(0.05, 0.9, (6, 3))
    even = np.full((32, 64, 3), 3, np.float32)
    photograph = np.zeros((20, 60, 3), np.float32)
    for k, r in enumerate(reflectance):
        photograph[:, 10 * k : 10 * k + 10] = 3 * r  # E / pi is the even radiance
    patches = [Patch((10 * k + 2, 3, 6, 9), r) for k, r in enumerate(reflectance)]
    found = colour_chart(even, photograph, patches, [0, 1.0, 0])
    assert found.ratio == pytest.approx([1, 1, 1], rel=1e-3)
    assert found.worst < 1e-3
    photograph[..., 0] *= 1.2
    tinted = colour_chart(even, photograph, patches, [0, 1.0, 0])
    assert tinted.ratio == pytest.approx([1.2, 1, 1], rel=1e-3)
    assert tinted.worst_shape < 1e-3 < tinted.median
    with pytest.raises(UserError, match="patch 1 lies outside"):
        colour_chart(even, photograph, [Patch((55, 0, 9, 9), reflectance[0])], [0, 1.0, 0])


def test_balls_that_cannot_be_compared() -> None:
    ball = ball_in_circle((240, 200), (100.0, 100.0), 2.0)
    black = np.zeros((200, 240, 3), np.float32)
    with pytest.raises(UserError, match="too few"):
        matt_ball(sky_map(64), black, ball, np.eye(3))
    ball = ball_in_circle((240, 200), (100.0, 100.0), 50.0)
    with pytest.raises(UserError, match="black there"):
        matt_ball(sky_map(64), black, ball, np.eye(3))
    with pytest.raises(UserError, match="albedo lies between"):
        matt_ball(sky_map(64), black, ball, np.eye(3), albedo=1.5)


def test_the_check_command(tmp_path: Path) -> None:
    env, photo, camera = (tmp_path / n for n in ("env.exr", "ball.exr", "x.cameramodel"))
    write_exr(env, sky_map(), attributes=latlong_attributes({}))
    write_exr(photo, matt_photograph(0.18))
    CAMERA.posed(POSE).write(camera)
    rim = outline()
    centre = (rim.max(axis=0) + rim.min(axis=0)) / 2
    radius = float((rim.max(axis=0) - rim.min(axis=0)).mean() / 2)
    out = tmp_path / "check.json"
    command = ["check", str(env), str(photo), "--camera", str(camera)]
    circle = ["--circle", f"{centre[0]},{centre[1]},{radius}", "-o", str(out)]
    run = {"result_action": "return_value", "exit_on_error": False}
    app([*command, "--ball", "matt", *circle], **run)  # pyright: ignore[reportArgumentType]
    figures = json.loads(out.read_text())
    assert figures["median_error"] < 0.02
    assert figures["light_off_degrees"] < 1
    assert (tmp_path / "check.beside.png").is_file()
    chart = tmp_path / "chart.csv"
    chart.write_text("x,y,w,h,R,G,B\n100,80,5,5,0.2,0.2,0.2\n120,90,5,5,0.4,0.4,0.4\n")
    bare = ["check", str(env), str(photo), "--chart", str(chart), "-o", str(out)]
    app([*bare, "--normal", "0,0,1"], **run)  # pyright: ignore[reportArgumentType]
    assert len(json.loads(out.read_text())["seen"]) == 2
    chart.write_text("1,2,3\n")
    with pytest.raises(UserError, match="line 1: it must be"):
        app([*bare, "--normal", "0,0,1"], **run)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UserError, match="--ball with --circle, or --chart"):
        app(["check", str(env), str(photo), "-o", str(out)], **run)  # pyright: ignore[reportArgumentType]
