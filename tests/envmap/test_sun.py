"""A sun of known light: found, clipped, and restored by each of the measurements."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.main import build_app
from chromeball.envmap.irradiance import irradiance, spread_directions
from chromeball.envmap.mapping import LatLong, pixel_grid
from chromeball.envmap.sun import (
    SUN_RADIUS,
    add_disc,
    find_sun,
    ratio_of_ball,
    restore_from_ratio,
    restore_from_reading,
    without_sun,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json

SUN = np.array([0.48, 0.6, 0.64])
LIGHT = np.array([90e3, 80e3, 65e3])  # facing it
UP = np.array([0.0, 1, 0])


def sky(width: int = 512) -> np.ndarray:
    d = LatLong((width, width // 2)).directions()
    glow = 4000 * np.exp((d @ SUN - 1) * 40)
    base = np.where(d[..., 1] > 0, 3000 + 1000 * d[..., 1], 800)
    return np.stack([base * 0.8 + glow, base + glow, base * 1.3 + glow], axis=-1).astype(
        np.float32
    )


def clip(radiance: np.ndarray, level: float = 5e4) -> tuple[np.ndarray, np.ndarray]:
    return np.minimum(radiance, np.float32(level)), (radiance >= level).any(axis=2)


@pytest.mark.parametrize("radius", [math.radians(0.2666), math.radians(1.5)])
@pytest.mark.parametrize("width", [512, 2048])
def test_found(width: int, radius: float) -> None:
    found = find_sun(add_disc(sky(width), SUN, radius, LIGHT))
    assert found is not None
    away = math.acos(min(1.0, float(found.direction @ SUN)))
    assert away < 4 * found.sigma_direction + math.radians(0.02)
    np.testing.assert_allclose(found.irradiance, LIGHT, rtol=0.02)
    pixel = 2 * math.pi / width
    assert found.angular_radius == pytest.approx(radius, abs=0.6 * pixel)
    assert not found.clipped


def test_no_sun() -> None:
    assert find_sun(sky()) is None
    assert find_sun(np.zeros((8, 16, 3), np.float32)) is None
    window = sky()
    window[LatLong((512, 256)).directions() @ SUN > math.cos(0.3)] = 1e6
    assert find_sun(window) is None  # too large


@pytest.mark.parametrize("radius", [1e-4, SUN_RADIUS, 0.1])
def test_disc_gives_its_irradiance(radius: float) -> None:
    more = add_disc(sky(256), SUN, radius, LIGHT)
    difference = irradiance(more, SUN) - irradiance(sky(256), SUN)
    np.testing.assert_allclose(difference, LIGHT, rtol=2e-3)
    assert (more >= sky(256)).all()


@pytest.mark.parametrize("normal", [UP, SUN, np.array([0.8, 0.1, 0.2])])
def test_restored_from_a_reading(normal: np.ndarray) -> None:
    truth = add_disc(sky(), SUN, SUN_RADIUS, LIGHT)
    map_, marked = clip(truth)
    found = find_sun(map_, marked)
    assert found is not None
    assert found.clipped
    n = normal / np.linalg.norm(normal)
    reading = float(irradiance(truth, n) @ LUMINANCE)
    made = restore_from_reading(map_, found, reading, n, color=LIGHT)
    normals = spread_directions(30)
    np.testing.assert_allclose(
        irradiance(made.radiance, normals) @ LUMINANCE,
        irradiance(truth, normals) @ LUMINANCE,
        atol=0.01 * float(LIGHT @ LUMINANCE),  # its direction is good to a quarter of a pixel
    )
    assert 0.03 < made.sigma < 0.2
    # a reading 5 % off moves the sun by what sigma says
    off = restore_from_reading(map_, found, 1.05 * reading, n, color=LIGHT)
    change = float(off.sun.irradiance @ LUMINANCE) / float(made.sun.irradiance @ LUMINANCE) - 1
    assert change == pytest.approx(made.sigma, rel=0.15)


def test_restored_from_a_card() -> None:
    truth = add_disc(sky(), SUN, SUN_RADIUS, LIGHT)
    map_, marked = clip(truth)
    found = find_sun(map_, marked)
    assert found is not None
    shade = irradiance(sky(), UP)
    ratio = irradiance(truth, UP) / shade
    made = restore_from_ratio(map_, found, ratio, UP)
    # the shadow of a card hides what is near the sun, too
    np.testing.assert_allclose(made.sun.irradiance, LIGHT, rtol=0.03)
    np.testing.assert_allclose(made.sun.angular_radius, SUN_RADIUS)
    # one ratio is luminance: the sun keeps its own colour, not the sky's
    bright = [float(irradiance(truth, UP) @ LUMINANCE) / float(shade @ LUMINANCE)]
    one = restore_from_ratio(map_, found, bright, UP, color=LIGHT)
    np.testing.assert_allclose(one.sun.irradiance, LIGHT, rtol=0.03)
    # the map's scale does not matter
    scaled = restore_from_ratio(
        map_ * np.float32(1e-3), find_sun(map_ * np.float32(1e-3), marked) or found, ratio, UP
    )
    np.testing.assert_allclose(scaled.sun.irradiance, made.sun.irradiance * 1e-3, rtol=1e-3)


def ball_normals() -> np.ndarray:
    n = spread_directions(600)
    return n[n[:, 2] > 0.1]  # the side that a camera sees


def test_restored_from_a_ball() -> None:
    truth = add_disc(sky(), SUN, SUN_RADIUS, LIGHT)
    map_, marked = clip(truth)
    found = find_sun(map_, marked)
    assert found is not None
    n = ball_normals()
    rng = np.random.default_rng(1)
    seen = 0.18 / math.pi * irradiance(truth, n) * rng.normal(1, 0.02, (len(n), 1))
    ratio, sigma = ratio_of_ball(map_, found, n, seen)
    expected = 1 + LIGHT / irradiance(without_sun(map_, found), SUN)
    assert (np.abs(ratio - expected) < 4 * sigma + 0.03 * expected).all()
    made = restore_from_ratio(map_, found, ratio, found.direction)
    np.testing.assert_allclose(made.sun.irradiance, LIGHT, rtol=0.05)
    with pytest.raises(UserError, match="must both be seen"):
        ratio_of_ball(map_, found, n[:5], seen[:5])
    with pytest.raises(UserError, match="does not fit"):
        ratio_of_ball(map_, found, n, seen[::-1])


def test_refused() -> None:
    truth = add_disc(sky(), SUN, SUN_RADIUS, LIGHT)
    found = find_sun(truth)
    assert found is not None
    own = float(irradiance(truth, UP) @ LUMINANCE)
    with pytest.raises(UserError, match="no light missing"):
        restore_from_reading(truth, found, 0.9 * own, UP)
    with pytest.raises(UserError, match="degrees away from the sun"):
        restore_from_reading(truth, found, 1e6, -UP)
    with pytest.raises(UserError, match="above 1"):
        restore_from_ratio(truth, found, [0.8] * 3, UP)
    with pytest.raises(UserError, match="as much sun"):
        restore_from_ratio(truth, found, [1.5] * 3, UP)


def run(*arguments: object) -> None:
    build_app()([str(a) for a in arguments], result_action="return_value")


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = add_disc(sky(), SUN, SUN_RADIUS, LIGHT)
    map_, marked = clip(truth)
    env, out = tmp_path / "env.exr", tmp_path / "env_sun.exr"
    alpha = np.ones(marked.shape)
    alpha[-1] = 0
    marked[-2, 7] = True  # somewhere else
    pixels = np.dstack([map_, alpha, marked, 2 * (1 - alpha)])
    channels = ("R", "G", "B", "A", "clipped", "completed")
    write_exr(env, pixels, channels=channels)
    with pytest.raises(UserError, match="values are relative"):
        run("envmap", "sun", env, "--meter", 80000, "-o", out)
    with pytest.raises(UserError, match="give one of"):
        run("envmap", "sun", env, "-o", out)
    write_exr(env, pixels, channels=channels, attributes={"whiteLuminance": 1.0})
    reading = float(irradiance(truth, UP) @ LUMINANCE)
    run("envmap", "sun", env, "--meter", reading, "--color", "90,80,65", "-o", out)
    made = read_image(out)
    assert "light meter" in made.attributes["sunRestored"]
    assert made.channels == channels
    np.testing.assert_array_equal(made.pixels[..., 3::2], np.dstack([alpha, 2 * (1 - alpha)]))
    left = np.argwhere(made.pixels[..., 4] > 0)  # clipped is what is still a bound
    assert left.tolist() == [[marked.shape[0] - 2, 7]]
    np.testing.assert_allclose(
        irradiance(made.pixels[..., :3], UP) @ LUMINANCE, reading, rtol=1e-3
    )
    figures = read_json(tmp_path / "env_sun.exr.record.json")["figures"]
    assert figures["was_clipped"] is True
    np.testing.assert_allclose(figures["irradiance"], LIGHT, rtol=0.03)
    assert 0 < figures["relative_sigma"] < 0.2
    # by a card, and without a channel that says what is clipped
    write_exr(env, map_)
    ratio = ",".join(f"{v:.6f}" for v in irradiance(truth, UP) / irradiance(sky(), UP))
    run("envmap", "sun", env, "--ratio", ratio, "--clipped", 5e4, "-o", out)
    figures = read_json(tmp_path / "env_sun.exr.record.json")["figures"]
    np.testing.assert_allclose(figures["irradiance"], LIGHT, rtol=0.03)
    # overcast: nothing to see, a direction is given
    write_exr(env, sky())
    with pytest.raises(UserError, match="--at"):
        run("envmap", "sun", env, "--ratio", 4, "-o", out)
    run("envmap", "sun", env, "--ratio", 4, "--at", "0.48,0.6,0.64", "-o", out)
    figures = read_json(tmp_path / "env_sun.exr.record.json")["figures"]
    assert figures["was_clipped"] is False
    assert figures["sigma_direction_degrees"] is None
    assert "warning" not in capsys.readouterr().err
    # beside the sun that the map shows
    write_exr(env, pixels, channels=channels)
    run("envmap", "sun", env, "--ratio", 4, "--at", "-0.48,0.6,0.64", "-o", out)
    assert re.search(r"stands 57\.\d degrees from --at", capsys.readouterr().err)


def test_a_clipped_sun_little_brighter_than_the_sky_is_found() -> None:
    truth = add_disc(sky(), SUN, SUN_RADIUS, LIGHT)
    limit = 1.5 * float(sky().max())
    marked = truth.max(axis=2) > limit
    found = find_sun(np.minimum(truth, limit).astype(np.float32), marked)
    assert found is not None
    assert found.clipped
    assert np.degrees(np.arccos(found.direction @ SUN / np.linalg.norm(SUN))) < 0.5
    # a sky that was clipped is no sun
    overcast = np.minimum(sky(), np.float32(3000))
    assert find_sun(overcast, (sky() >= 3000).any(axis=2)) is None


def test_command_with_a_ball(tmp_path: Path) -> None:
    truth = add_disc(sky(), SUN, SUN_RADIUS, LIGHT)
    map_, marked = clip(truth)
    write_exr(
        tmp_path / "env.exr", np.concatenate([map_, marked[..., None]], axis=2),
        channels=("R", "G", "B", "clipped"),
    )  # fmt: skip
    # a ball of 10 cm, 1 m ahead of a camera that looks along -Z from the front
    camera = CameraModel.pinhole((120, 90), 2 * math.atan(60 / 400)).posed(
        Pose.look_at([0, 0, 1], [0, 0, 0])
    )
    rays = camera.unproject(pixel_grid((120, 90))).reshape(-1, 3)
    world = rays @ camera.world_from_camera.rotation.T
    eye = camera.world_from_camera.translation
    b = world @ eye
    root = b**2 - (eye @ eye - 0.05**2)
    hit = root > 0
    points = eye + world[hit] * (-b[hit] - np.sqrt(root[hit]))[:, None]
    picture = np.full((90 * 120, 3), 0.1)
    picture[hit] = 0.5 / math.pi * irradiance(truth, points / 0.05)
    write_exr(tmp_path / "ball.exr", picture.reshape(90, 120, 3))
    camera.write(tmp_path / "c.cameramodel")
    outline = 400 * math.tan(math.asin(0.05))
    run(
        *("envmap", "sun", tmp_path / "env.exr", "--ball", tmp_path / "ball.exr", "--circle"),
        *(f"59.5,44.5,{outline}", "--camera", tmp_path / "c.cameramodel"),
        *("-o", tmp_path / "out.exr"),
    )
    figures = read_json(tmp_path / "out.exr.record.json")["figures"]
    np.testing.assert_allclose(figures["irradiance"], LIGHT, rtol=0.1)
