"""The hole under the tripod: a shot from elsewhere placed, matched, blended; patches."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.cli.main import build_app
from chromeball.envmap.complete import Source
from chromeball.envmap.ground_view import OnGround, place_by_points
from chromeball.envmap.mapping import LatLong, of_camera
from chromeball.envmap.membrane import membrane
from chromeball.envmap.nadir import find_hole
from chromeball.envmap.probe import rotation
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr, write_picture
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

WIDTH = 768
HOLE = 18.0
HEIGHT = 1.5  # of the panorama over the ground, metres
CAMERA = CameraModel.pinhole((400, 340), math.radians(95))
#: The shot's camera in world axes: where it stood, and how it looked down, askew.
PLACE = np.array([0.35, 0.2, -0.25])
TURN = rotation(math.radians(40), math.radians(-78), math.radians(8)) @ (
    WORLD_FROM_LATLONG.rotation
)
GAIN = np.array([0.7, 0.7, 0.7])


def texture(x: Array, z: Array) -> Array:
    """Radiance of the ground, (..., 3): blots of many sizes, not the same anywhere."""
    rng = np.random.default_rng(3)
    total = np.zeros(x.shape)
    for k in range(60):
        a = rng.normal(size=2) * rng.uniform(1.0, 11.0)
        total += np.sin(a[0] * x + a[1] * z + k)
    tint = np.stack([1 + 0.1 * np.sin(x), np.ones_like(x), 1 - 0.1 * np.cos(z)], axis=-1)
    return np.exp(total / 10)[..., None] * tint


def seen(d: Array, place: Array) -> NDArray[np.float32]:
    """What rays (..., 3) from `place` (metres from the panorama's) see."""
    d = np.nan_to_num(d)
    below = d[..., 1] < -0.02
    t = np.where(below, -(HEIGHT + place[1]) / np.where(below, d[..., 1], -1), 0)
    ground = texture(place[0] + t * d[..., 0], place[2] + t * d[..., 2])
    sky = 2 + d[..., 1:2] * np.ones(3)
    return np.where(below[..., None], ground, sky).astype(np.float32)


def averaged(directions: Any, size: tuple[int, int], place: Array) -> NDArray[np.float32]:
    """Pixels as means of 2 x 2 rays."""
    at = (-0.25, 0.25)
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    total = np.zeros((size[1], size[0], 3))
    for dy in at:
        for dx in at:
            total += seen(directions(np.stack([x + dx, y + dy], axis=-1)), place)
    return (total / 4).astype(np.float32)


@cache
def panorama() -> NDArray[np.float32]:
    target = LatLong((WIDTH, WIDTH // 2))
    return averaged(lambda q: target.unproject(q) @ target.rotation.T, target.size, np.zeros(3))


@cache
def shot() -> NDArray[np.float32]:
    picture = averaged(lambda q: CAMERA.unproject(q) @ TURN.T, CAMERA.size, PLACE)
    return (picture * GAIN).astype(np.float32)


def angle() -> Array:
    d = LatLong((WIDTH, WIDTH // 2)).directions()
    return np.degrees(np.arccos(np.clip(-d[..., 1], -1, 1)))


def truth() -> Array:
    """The homography: a point of the ground is d HEIGHT / -d.y, seen from elsewhere."""
    plane = np.array([0.0, -1.0, 0.0]) / HEIGHT  # 1 = plane . p on the ground
    h = TURN.T @ (np.eye(3) - np.outer(PLACE, plane))
    return h / np.linalg.norm(h)


def write(folder: Path, *, mask: bool = True) -> None:
    low = angle() < HOLE
    rgb = np.where(low[..., None], np.float32(0.05), panorama())
    alpha = (~low).astype(np.float32) if mask else np.ones_like(low, np.float32)
    completed = low * np.float32(Source.BORDER)
    clipped = (angle() > 150).astype(np.float32)
    write_exr(
        folder / "env.exr",
        np.dstack([rgb, alpha, completed, clipped]),
        channels=("R", "G", "B", "A", "completed", "clipped"),
        attributes={"origin": np.array([1.0, 2.0, 3.0])},
    )
    write_exr(folder / "shot.exr", shot())
    CAMERA.write(folder / "lens.cameramodel")


def run(folder: Path, *options: object, out: str = "out.exr") -> dict[str, Any]:
    words = ["envmap", "nadir", folder / "env.exr", *options, "-o", folder / out]
    build_app()(
        [str(word) for word in words], result_action="return_value", exit_on_error=False
    )
    record: dict[str, Any] = read_json(folder / f"{out}.record.json")
    return record["figures"]


def channels(path: Path) -> dict[str, NDArray[np.float32]]:
    image = read_image(path)
    return {name: image.pixels[..., k] for k, name in enumerate(image.channels)}


def rgb_of(found: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    return np.stack([found[c] for c in "RGB"], axis=-1)


def off(homography: Any) -> float:
    """Largest angle in degrees between rays on the hole's edge, placed and true."""
    turn = np.linspace(0, 2 * np.pi, 24)
    r = math.radians(HOLE)
    d = np.stack(
        [math.sin(r) * np.cos(turn), -math.cos(r) * np.ones(24), math.sin(r) * np.sin(turn)], -1
    )
    a, b = (d @ h.T for h in (np.asarray(homography), truth()))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return math.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)).max())


def test_a_shot_from_elsewhere_fills_the_hole(tmp_path: Path) -> None:
    write(tmp_path)
    figures = run(tmp_path, tmp_path / "shot.exr", "--camera", tmp_path / "lens.cameramodel")
    assert off(figures["homography"]) < 0.15  # a pixel of the map is .47 degree
    assert off(figures["homography"]) < 5 * figures["edge_sigma_degrees"] + 0.02
    assert figures["gain"] == pytest.approx(1 / GAIN, rel=0.01)
    assert abs(figures["energy_error"]) < 2e-3
    assert abs(figures["light_changed_around"]) < 1e-3
    found = channels(tmp_path / "out.exr")
    low = angle() < HOLE
    error = np.abs(np.log(rgb_of(found)[low] / panorama()[low]))
    solid = LatLong((WIDTH, WIDTH // 2)).solid_angles()
    assert np.percentile(error, 90) < 0.06
    for c in range(3):
        light = [(p[..., c] * solid)[low].sum() for p in (rgb_of(found), panorama())]
        assert light[0] == pytest.approx(light[1], rel=0.01)
    assert (found["completed"][low] == Source.NADIR).all()
    assert (found["completed"][~low] == 0).all()
    assert (found["A"] == 1).all()
    assert (found["clipped"][angle() > 150] == 1).all()
    assert (rgb_of(found)[angle() > HOLE + 10] == panorama()[angle() > HOLE + 10]).all()
    assert (tmp_path / "out.nadir.png").is_file()


def test_points_place_it_as_well_and_white_balance_is_each_channels(tmp_path: Path) -> None:
    write(tmp_path, mask=False)
    tinted = shot() * np.array([0.8, 1.0, 1.25], np.float32)
    write_exr(tmp_path / "shot.exr", tinted)
    turn = np.radians([20, 110, 200, 290])
    r = math.radians(25)
    d = np.stack(
        [math.sin(r) * np.cos(turn), -math.cos(r) * np.ones(4), math.sin(r) * np.sin(turn)], -1
    )
    q = CAMERA.project(d @ truth().T)
    at = LatLong((WIDTH, WIDTH // 2)).pixels_of(d)
    text = " ".join(
        f"{a:.3f},{b:.3f}:{x:.3f},{y:.3f}" for (a, b), (x, y) in zip(q, at, strict=True)
    )
    figures = run(
        tmp_path,
        tmp_path / "shot.exr",
        "--camera",
        tmp_path / "lens.cameramodel",
        "--points",
        text,
        "--hole",
        HOLE,
        "--exposure",
        "white-balance",
    )
    assert off(figures["homography"]) < 0.02
    assert np.array(figures["gain"]) * [0.8, 1, 1.25] == pytest.approx(1 / GAIN, rel=0.01)
    low = angle() < HOLE
    found = rgb_of(channels(tmp_path / "out.exr"))
    assert np.percentile(np.abs(np.log(found[low] / panorama()[low])), 90) < 0.05


def test_feet_are_masked_and_what_is_left_is_told_or_patched(tmp_path: Path) -> None:
    write(tmp_path)
    foot = CAMERA.project(np.array([[0.05, -1.0, 0.03]]) @ truth().T)[0]
    x, y = np.meshgrid(np.arange(400), np.arange(340))
    mask = np.hypot(x - foot[0], y - foot[1]) > 30
    stained = np.where(mask[..., None], shot(), np.float32(50))
    write_exr(tmp_path / "shot.exr", stained)
    write_picture(tmp_path / "mask.png", (mask * np.uint8(255))[..., None].repeat(3, axis=2))
    given = [tmp_path / "shot.exr", "--camera", tmp_path / "lens.cameramodel"]
    given += ["--mask", tmp_path / "mask.png"]
    with pytest.raises(UserError, match="% of the hole open"):
        run(tmp_path, *given)
    assert not (tmp_path / "out.exr").exists()
    figures = run(tmp_path, *given, "--patch", "fill")
    found = channels(tmp_path / "out.exr")
    patched = found["completed"] == Source.PATCH
    assert 0.01 < figures["left_by_shot"] < 0.6
    assert (found["A"][patched] == 0).all()
    assert figures["by_patch_solid_angle"] == pytest.approx(
        float(LatLong((WIDTH, WIDTH // 2)).solid_angles()[patched].sum())
    )
    assert rgb_of(found)[angle() < HOLE].max() < 1.3 * panorama()[angle() < HOLE + 5].max()


def test_a_patch_is_marked_and_keeps_the_light(tmp_path: Path) -> None:
    write(tmp_path)
    figures = run(tmp_path, "--patch", "fill")
    found = channels(tmp_path / "out.exr")
    low = angle() < HOLE
    assert (found["completed"][low] == Source.PATCH).all()
    assert (found["A"][low] == 0).all()
    assert (found["A"][~low] == 1).all()
    assert (rgb_of(found)[~low] == panorama()[~low]).all()
    ring = panorama()[(angle() < HOLE + 4) & ~low]
    assert ring.min() * 0.9 < rgb_of(found)[low].min()
    assert rgb_of(found)[low].max() < ring.max() * 1.1
    # a picture laid over it changes where the light is, not how much
    colours = np.zeros((40, 40, 4), np.uint8)
    colours[:, :20, 0], colours[..., 1], colours[..., 3] = 255, 40, 255
    write_picture(tmp_path / "logo.png", colours)
    over = run(tmp_path, "--patch", tmp_path / "logo.png")
    assert over["light_by_patch"] == pytest.approx(figures["light_by_patch"], rel=0.05)
    picture = rgb_of(channels(tmp_path / "out.exr"))
    assert np.abs(picture - rgb_of(found))[low].max() > 0.1


def test_a_membrane_is_harmonic_and_bounded() -> None:
    y, x = np.mgrid[-32:32, -32:32] / 32.0
    log = 1.5 * x - y + x * y  # harmonic
    picture = np.exp(np.stack([log] * 3, axis=-1)).astype(np.float32)
    hole = np.hypot(x, y) < 0.5
    spoiled = np.where(hole[..., None], np.float32(1e4), picture)
    got = membrane(spoiled, hole, np.ones_like(hole))
    assert np.abs(np.log(got / picture))[hole].max() < 0.12
    assert (got[~hole] == picture[~hole]).all()
    with pytest.raises(UserError, match="nothing about the hole"):
        membrane(spoiled, hole, hole)


def test_rays_through_the_plane_go_there_and_back() -> None:
    lens = OnGround(CAMERA, truth())
    q = of_camera(CAMERA).project(CAMERA.unproject(np.array([[100.0, 100], [200, 170]])))
    assert lens.project(lens.unproject(q)) == pytest.approx(q, abs=1e-6)
    assert np.isnan(lens.project(np.array([[0.1, 0.5, 0.2]]))).all()


def test_mistakes(tmp_path: Path) -> None:
    write(tmp_path)
    lens = ["--camera", tmp_path / "lens.cameramodel"]
    with pytest.raises(UserError, match="give a shot"):
        run(tmp_path)
    with pytest.raises(UserError, match="needs its --camera"):
        run(tmp_path, tmp_path / "shot.exr")
    with pytest.raises(UserError, match="--hole 95"):
        run(tmp_path, "--patch", "fill", "--hole", 95)
    with pytest.raises(UserError, match="reaches 80 degrees"):
        run(tmp_path, "--patch", "fill", "--hole", 80)
    with pytest.raises(UserError, match="write each as"):
        run(tmp_path, tmp_path / "shot.exr", *lens, "--points", "1,2,3,4")
    write_exr(tmp_path / "plain.exr", np.ones((340, 400, 3), np.float32))
    with pytest.raises(UserError, match="shares 0 features"):
        run(tmp_path, tmp_path / "plain.exr", *lens)
    noise = np.random.default_rng(1).uniform(0.5, 1, (340, 400, 3)).astype(np.float32)
    write_exr(tmp_path / "noise.exr", noise)
    with pytest.raises(UserError, match="features"):
        run(tmp_path, tmp_path / "noise.exr", *lens)
    with pytest.raises(UserError, match="no hole below"):
        find_hole(np.ones((32, 64), np.float32))
    line = np.array([[0.1 * k, -1.0, 0.05 * k] for k in range(4)])
    with pytest.raises(UserError, match="on one line"):
        place_by_points(CAMERA.project(line @ truth().T), line, CAMERA, line)
