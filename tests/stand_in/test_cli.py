"""The commands as a user calls them: results, records, one line for a mistake, no rest."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.main import build_app
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_header, read_image, write_exr, write_picture
from chromeball.stand_in.panorama import panorama
from chromeball.stand_in.ply import read_stand_in

ORIGIN = np.array([0.25, 1.5, -0.125])
SCENE = """
name = "test"
[[stand_in]]
name = "hall"
kind = "room"
points = {points}
height_point = {top}
[[stand_in]]
name = "column"
kind = "box"
outline = "circle"
corners = [[1, 1], [1.2, 1], [1.1, 1.1]]
height = 1
surface = "environment"
"""


def call(*words: object) -> None:
    build_app()([str(word) for word in words], result_action="return_value")


@pytest.fixture
def env(tmp_path: Path) -> Path:
    pixels = np.random.default_rng(0).uniform(0.2, 1, (64, 128, 3)).astype(np.float32)
    attributes = {"textureformat": "LatLong Environment", "origin": ORIGIN}
    write_exr(tmp_path / "env.exr", pixels, attributes=attributes)
    return tmp_path / "env.exr"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    camera = panorama((128, 64), ORIGIN)
    corners = np.array([[-3.0, 0, -2], [-3, 0, 4], [3, 0, 4], [3, 0, -2]])
    points = camera.project_world(corners).tolist()
    top = camera.project_world(corners[0] + np.array([0, 2.5, 0])).tolist()
    (tmp_path / "scene.toml").write_text(SCENE.format(points=points, top=top))
    return tmp_path / "scene.toml"


def test_build_then_depth(
    tmp_path: Path, env: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = tmp_path / "build/stand_in.ply"
    call("stand-in", "build", scene, "--env", env, "-o", mesh, "--json")
    printed = json.loads(capsys.readouterr().out)
    read = read_stand_in(mesh)
    hall = read.vertices[:8]
    np.testing.assert_allclose(hall.min(axis=0), [-3, 0, -2], atol=1e-5)
    np.testing.assert_allclose(hall.max(axis=0), [3, 2.5, 4], atol=1e-5)
    record = json.loads((tmp_path / "build/stand_in.ply.record.json").read_text())
    assert record["figures"] == printed
    assert set(record["inputs"]) == {str(scene), str(env)}
    assert printed["faces"] == len(read.faces) == 12 + 190
    assert printed["pieces"][0]["height"] == pytest.approx(2.5)
    assert printed["area_support"] == pytest.approx(36, rel=1e-5)
    assert printed["sphere_share"] == pytest.approx(1)
    overlay = read_image(tmp_path / "build" / printed["overlay"])
    assert overlay.pixels.shape == (64, 128, 3)

    depth = tmp_path / "build/env_depth.exr"
    call("stand-in", "depth", mesh, "--env", env, "-o", depth)
    captured = capsys.readouterr()
    assert captured.out == f"{depth}\n"
    assert "distance max" in captured.err
    image = read_image(depth)
    assert image.channels == ("R", "G", "B", "Z")
    np.testing.assert_array_equal(image.pixels[..., :3], read_image(env).pixels)
    assert image.pixels[-1, 0, 3] == pytest.approx(1.5, rel=1e-3)
    assert image.pixels[0, 0, 3] == pytest.approx(1.0, rel=1e-3)
    header = read_header(depth)
    np.testing.assert_allclose(header.attributes["origin"], ORIGIN)
    assert header.attributes["textureformat"] == "LatLong Environment"

    small = tmp_path / "build/small.exr"
    call("stand-in", "depth", mesh, "--env", env, "--width", "32", "-o", small)
    assert read_header(small).size == (32, 16)


def test_floor_polygon_box_and_room(tmp_path: Path, env: Path) -> None:
    out = tmp_path / "f.ply"
    call("stand-in", "floor", "--size", "4,2", "-o", out)
    assert np.ptp(read_stand_in(out).vertices, axis=0).tolist() == [4, 0, 2]
    assert not (tmp_path / "f.overlay.png").exists()
    call("stand-in", "floor", "--size=4,2", "--surface=environment", "--env", env, "-o", out)
    assert read_stand_in(out).surface.tolist() == [1, 1]
    assert (tmp_path / "f.overlay.png").exists()

    camera = panorama((128, 64), ORIGIN)
    corners = np.array([[1.0, 0, 1], [1, 0, 2], [2, 0, 1]])
    points = " ".join(f"{x},{y}" for x, y in camera.project_world(corners))
    call("stand-in", "polygon", "--points", points, "--env", env, "-o", out)
    assert len(read_stand_in(out).faces) == 1
    x, y = camera.project_world([1, 0.75, 1])
    top = f"{x},{y}"
    call("stand-in", "box", "--points", points, "--height-point", top, "--env", env, "-o", out)
    assert read_stand_in(out).vertices[:, 1].max() == pytest.approx(0.75, abs=1e-5)
    call("stand-in", "room", "--corners=-1,-1 -1,1 1,1", "--height", "2.5", "-o", out)
    assert len(read_stand_in(out).faces) == 8


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["floor", "--size", "4"], "--size: '4' is not 2 finite numbers"),
        (["floor", "--size", "4,-1"], "--size 4,-1: width and depth must be positive"),
        (["floor", "--size", "4,x"], "'4,x' is not numbers"),
        (["floor", "--size", "inf,1"], "finite numbers"),
        (["polygon", "--points", "1,2 3,4 5,6"], "stand_in 'polygon': .*add --env env.exr"),
        (["polygon", "--points", "1,2 3", "--env", "env.exr"], "--points: '3' is not 2 finite"),
        (["polygon", "--points", "1,9 9,9 9,1", "--env", "env.exr"], "below the horizon"),
        (["polygon", "--corners", "0,0 1,1 1,0 0,1"], "sides 1 and 3 of the outline cross"),
        (["polygon", "--corners", "0,0 1,1 1,0", "--env", "no.exr"], "no.exr: no such picture"),
        (["polygon", "--corners", "0,0 1,1 1,0", "--env", "odd.exr"], "no lat-long map"),
        (["polygon", "--corners", "0,0 1,1 1,0", "--env", "bare.exr"], "no attribute `origin`"),
        (["polygon", "--corners", "0,0 1,1 1,0", "--env", "low.exr"], "above the floor"),
        (
            ["polygon", "--corners", "0,0 1,1 1,0", "--env", "bare.ply"],
            "not a readable picture",
        ),
        (["box", "--corners", "0,0 1,1 1,0"], "a box needs height"),
        (["box", "--corners", "0,0 1,1 1,0", "--height", "0"], "must be positive and finite"),
        (["box", "--corners", "0,0 1,1 1,0", "--height", "-1"], "must be positive and finite"),
        (["room", "--corners", "0,0 1,1 1,0", "--height", "-2"], "--height -2: it must be"),
        (["build", "empty.toml"], r"empty.toml: there is no \[\[stand_in\]\]"),
        (["build", "wrong.toml"], "wrong.toml: unknown key 'heigth' .*did you mean 'height'"),
        (["build", "crossed.toml"], "crossed.toml: stand_in 'a': sides 1 and 3"),
        (["depth", "no.ply", "--env", "env.exr"], "no.ply: no such stand-in mesh"),
        (["depth", "bare.ply", "--env", "env.exr"], "bare.ply: not a PLY file"),
        (["depth", "good.ply", "--env", "env.exr", "--width", "33"], "width 33 does not fit"),
        (["depth", "good.ply", "--env", "nan.exr"], "nan.exr: 1 pixels are NaN"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    tmp_path: Path,
    env: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    call("stand-in", "floor", "--size", "1,1", "-o", "good.ply")
    grey = np.ones((8, 16, 3), np.float32)
    write_exr("odd.exr", grey[:, :9], attributes={"origin": ORIGIN})
    write_exr("bare.exr", grey)
    write_exr("low.exr", grey, attributes={"origin": [0.0, 0.0, 0.0]})
    grey[3, 4, 1] = np.nan
    write_exr("nan.exr", grey, attributes={"origin": ORIGIN})
    (tmp_path / "bare.ply").write_bytes(b"no mesh")
    start = 'name = "t"\n[[stand_in]]\nname = "a"\nkind = "box"\nheight = 1\n'
    (tmp_path / "empty.toml").write_text('name = "t"\n')
    (tmp_path / "wrong.toml").write_text(start.replace("height", "heigth"))
    (tmp_path / "crossed.toml").write_text(start + "corners=[[0,0],[1,1],[1,0],[0,1]]\n")
    before = set(tmp_path.iterdir())
    with pytest.raises(UserError, match=message) as caught:
        call("stand-in", *words, "-o", "out/result")
    assert "\n" not in str(caught.value)
    assert set(tmp_path.iterdir()) == before


def test_the_installed_command_exits_2_with_one_line(tmp_path: Path) -> None:
    chromeball = Path(sys.executable).with_name("chromeball")
    ran = subprocess.run(
        [chromeball, "stand-in", "floor", "--size", "0,1", "-o", tmp_path / "f.ply"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert ran.stderr == "chromeball: --size 0,1: width and depth must be positive\n"
    assert list(tmp_path.iterdir()) == []


def test_a_grey_picture_is_no_map(tmp_path: Path) -> None:
    write_picture(tmp_path / "p.png", np.zeros((8, 16, 3), np.uint8))
    with pytest.raises(UserError, match="no attribute `origin`"):
        call("stand-in", "floor", "--size=1,1", "--env", tmp_path / "p.png", "-o", "f.ply")
