"""``envmap probe`` as a user calls it: balls, several circles, what completes the rest."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.cli.main import build_app
from chromeball.cli.stages import stages
from chromeball.envmap.ball import BallCamera
from chromeball.envmap.mapping import LatLong, of_camera, pixel_grid
from chromeball.envmap.probe import rotation
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr, write_picture
from chromeball.scene.manifest import read_scene

BASE = WORLD_FROM_LATLONG.rotation


def run(*arguments: object) -> None:
    build_app()([str(a) for a in arguments], result_action="return_value")


def world(d: NDArray[np.float64]) -> NDArray[np.float32]:
    x, y, z = np.moveaxis(np.nan_to_num(d), -1, 0)
    return np.stack([2 + x, 2 + np.sin(3 * y), 2 + z * x], axis=-1).astype(np.float32)


def read(path: Path) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    image = read_image(path)
    assert image.channels == ("R", "G", "B", "A", "completed")
    pixels = image.pixels.astype(np.float32)
    return pixels[..., :3], pixels[..., 3], pixels[..., 4]


def figures(path: Path) -> dict[str, object]:
    return json.loads(path.with_name(path.name + ".record.json").read_text())["figures"]


def photographed(
    camera: CameraModel, centre: NDArray[np.float64], yaw: float
) -> NDArray[np.float32]:
    """A ball 20 radii away, grey of 0.8, in front of a black wall; the photographer is dark."""
    ball = BallCamera(camera, centre / np.linalg.norm(centre), 20.0)
    turn = rotation(yaw, 0.0, 0.0) @ BASE
    total = np.zeros((camera.size[1], camera.size[0], 3))
    for offset in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        d = ball.unproject(pixel_grid(camera.size) + offset)
        seen = 0.8 * world(d @ turn.T)
        seen[np.nan_to_num(d) @ -ball.middle > math.cos(math.radians(10))] = 0.01
        seen[np.isnan(d[..., 0])] = 0
        total += seen / 4
    return total.astype(np.float32)


@pytest.mark.parametrize("how", ["options", "scene"])
def test_a_pair_of_mirror_balls(tmp_path: Path, how: str) -> None:
    camera = CameraModel.pinhole((300, 240), math.radians(12))
    camera.write(tmp_path / "tele.cameramodel")
    (tmp_path / "build").mkdir()
    outlines: list[str] = []
    for name, yaw, x in (("east", 0.0, 0.01), ("north", math.pi / 2, -0.006)):
        centre = np.array([x, 0.004, 1.0])
        picture = photographed(camera, centre, yaw)
        write_exr(tmp_path / f"build/{name}.exr", picture)
        lit = np.argwhere(picture[..., 1] > 0)
        (y0, x0), (y1, x1) = lit.min(axis=0), lit.max(axis=0)
        outlines.append(f"{(x0 + x1) / 2},{(y0 + y1) / 2},{(x1 - x0 + 1) / 2}")
    out = tmp_path / "build/env.exr"
    options = ["--no-refine", "--photographer", "12", "--reflectance", "0.8,0.8,0.8"]
    if how == "options":
        run(
            *("envmap", "probe", tmp_path / "build/east.exr", tmp_path / "build/north.exr"),
            *("--yaw", "0,90", "--camera", tmp_path / "tele.cameramodel"),
            *("--ball", " ".join(outlines), *options, "--width", "128", "-o", out),
        )
    else:
        shots = ", ".join(
            f'{{ bracket = "{name}", yaw = {yaw}, ball = [{outline}] }}'
            for name, yaw, outline in zip(("east", "north"), (0, 90), outlines, strict=True)
        )
        file = tmp_path / "scene.toml"
        file.write_text(
            f"""
name = "balls"
bracket = [{{ name = "east", take = "a" }}, {{ name = "north", take = "b" }}]
[probe]
camera = "tele.cameramodel"
shot = [{shots}]
photographer = 12
reflectance = [0.8, 0.8, 0.8]
refine = false
[env]
width = 128
"""
        )
        run("envmap", "probe", file, "-o", out)
        # the plan's command says the same
        (plan,) = [s for s in stages(read_scene(file), file) if s.name == "envmap probe"]
        command = [str(word) for word in plan.command]
        for option in (*options, "--camera", "tele.cameramodel"):
            assert option in command
        (ball,) = [command[k + 1] for k, word in enumerate(command) if word == "--ball"]
        assert [[float(v) for v in b.split(",")] for b in ball.split()] == [
            [float(v) for v in b.split(",")] for b in outlines
        ]
        assert shlex.join(command)
    got, alpha, completed = read(out)
    truth = world(LatLong((128, 64)).directions())
    assert alpha.min() > 0.9
    assert completed.max() == 0
    error = np.abs(got / truth - 1)
    assert np.median(error) < 0.005
    assert np.quantile(error, 0.99) < 0.06


def test_one_picture_with_two_circles(tmp_path: Path) -> None:
    """As dual-fisheye cameras write it: turned by 90 degrees, one to each side."""
    frame = np.zeros((200, 400, 3), np.float32)
    specs = []
    for k, (yaw, roll) in enumerate(((0.0, math.pi / 2), (math.pi, -math.pi / 2))):
        lens = CameraModel.fisheye("equidistant", (200, 200), math.radians(196))
        own = BASE.T @ rotation(0.0, 0.0, roll) @ BASE
        pose = rotation(yaw, 0.0, 0.0) @ BASE @ own
        frame[:, 200 * k : 200 * k + 200] = world(of_camera(lens).turned(pose).directions())
        specs.append(f"equidistant:196:{99.5 + 200 * k},99.5,100")
    write_exr(tmp_path / "frame.exr", frame)
    out = tmp_path / "env.exr"
    run(
        *("envmap", "probe", tmp_path / "frame.exr", "--lens", " ".join(specs)),
        *("--yaw", "0,180", "--roll=90,-90", "--width", "128", "-o", out),
    )
    got, alpha, _ = read(out)
    assert alpha.min() > 0.99
    np.testing.assert_allclose(got, world(LatLong((128, 64)).directions()), atol=0.06)


def test_a_sky_dome_is_completed_as_the_user_says(tmp_path: Path) -> None:
    """A lens that looks up: ground of 0.25 below, a photograph of a part of it."""
    lens = CameraModel.fisheye("equisolid", (200, 200), math.radians(180))
    picture = np.full((200, 200, 3), 2.0, np.float32)
    write_exr(tmp_path / "up.exr", picture)
    assert of_camera(lens).solid_angles().sum() == pytest.approx(2 * math.pi, rel=1e-6)
    camera = CameraModel.pinhole((80, 60), math.radians(50))
    pose = rotation(0.5, math.radians(-40), 0.0) @ BASE
    camera.posed(type(WORLD_FROM_LATLONG)(pose, np.zeros(3))).write(
        tmp_path / "view.cameramodel"
    )
    write_exr(tmp_path / "plate.exr", np.full((60, 80, 3), 0.9, np.float32))
    out = tmp_path / "env.exr"
    up = ("envmap", "probe", tmp_path / "up.exr", "--lens", "equisolid:180", "--pitch", "90")
    run(*up, "--width", "128", "--ground", "0.25", "-o", out)
    d = LatLong((128, 64)).directions()
    got, alpha, completed = read(out)
    low, high = d[..., 1] < -0.05, d[..., 1] > 0.05
    assert (alpha[low] == 0).all()
    assert (completed[low] == 2).all()
    assert (completed[high] == 0).all()
    np.testing.assert_allclose(got[high], 2, rtol=1e-3)
    np.testing.assert_allclose(got[low], 0.25 * 2, rtol=0.01)  # E = 2 pi, rho E / pi
    fill = f"{tmp_path / 'plate.exr'}:{tmp_path / 'view.cameramodel'}"
    run(*up, "--width", "128", "--ground", "0.25", "--fill", fill, "-o", out)
    got, alpha, completed = read(out)
    assert set(np.unique(completed)) == {0, 2, 3}
    np.testing.assert_allclose(got[completed == 3], 0.9, rtol=1e-5)
    assert (alpha[completed > 0] == 0).all()
    where = d[completed == 3].mean(axis=0)
    axis = pose @ [0, 0, 1]
    assert where @ axis / np.linalg.norm(where) > math.cos(math.radians(8))
    recorded = figures(out)["completed_from"]
    assert isinstance(recorded, dict)
    assert recorded["ground"] + recorded["plate"] == pytest.approx(2 * math.pi, rel=0.02)


def test_masks_leave_out_what_must_not_be_seen(tmp_path: Path) -> None:
    """A tripod in the way of one shot is filled by the other."""
    lens = CameraModel.fisheye("equisolid", (200, 200), math.radians(230))
    names, masks = [], []
    for k, yaw in enumerate((0.0, math.pi)):
        pose = rotation(yaw, 0.0, 0.0) @ BASE
        picture = world(of_camera(lens).turned(pose).directions())
        mask = np.full((200, 200), 255, np.uint8)
        if k == 0:
            picture[80:120, 10:50], mask[75:125, 5:55] = 77, 0
        write_exr(tmp_path / f"{k}.exr", picture)
        write_picture(tmp_path / f"{k}.png", np.repeat(mask[..., None], 3, axis=2))
        names.append(tmp_path / f"{k}.exr")
        masks.append(tmp_path / f"{k}.png")
    out = tmp_path / "env.exr"
    arguments = (
        *names,
        "--lens",
        "equisolid:230",
        "--yaw",
        "0,180",
        "--no-refine",
        "--trim",
        "2",
    )
    run("envmap", "probe", *arguments, "--mask", *masks, "--width", "128", "-o", out)
    got, _, completed = read(out)
    truth = world(LatLong((128, 64)).directions())
    use = completed == 0
    # half a pixel of a border's pixel may be all that is seen of it
    np.testing.assert_allclose(got[use], truth[use], atol=0.08)


def test_what_cannot_be_is_said(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", np.ones((100, 100, 3), np.float32))
    write_picture(tmp_path / "m.png", np.zeros((100, 100, 3), np.uint8))
    write_picture(tmp_path / "s.png", np.zeros((50, 100, 3), np.uint8))
    a, out = tmp_path / "a.exr", tmp_path / "env.exr"
    fisheye = ["--lens", "equisolid:190"]
    for options, message in (
        (["--ball", "50,50"], "3 numbers"),
        (["--ball", "50,50,1"], "too small"),
        (["--ball", "50,500,40"], "outside the picture"),
        (["--ball", "50,50,40", *fisheye], "goes with neither"),
        (["--ball", "50,50,40", "--photographer", "130"], "from 0 to 120"),
        (["--ball", "50,50,40", "--reflectance", "1.5"], "at most 1"),
        ([*fisheye, "--reflectance", "0.5"], "is for --ball"),
        ([*fisheye, "--photographer", "20"], "is for --ball"),
        ([*fisheye, "--ground", "0.1,0.2"], "one number or r,g,b"),
        ([*fisheye, "--fill", "plate.exr"], "PLATE.exr:CAMERA"),
        ([*fisheye, "--trim", "60"], "cannot lose"),
        (["--ball", "50,50,40", "--trim", "2"], "no image circle|none|has none"),
        ([*fisheye, "--mask", tmp_path / "m.png"], "no pixel of any shot"),
        ([*fisheye, "--mask", tmp_path / "s.png"], "100x50"),
    ):
        with pytest.raises(UserError, match=message):
            run("envmap", "probe", a, *options, "--width", "64", "-o", out)
        assert not out.exists()
