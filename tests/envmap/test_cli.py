"""The commands as a user calls them, in process; and what they say of bad input."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from chromeball.cli.main import build_app
from chromeball.envmap.mapping import LatLong, of_camera
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json

SIZE = 300
LENS = CameraModel.fisheye("equisolid", (SIZE, SIZE), math.radians(190))
PLACE = np.array([0.2, 1.3, 0.9])


def run(*arguments: object) -> None:
    build_app()([str(a) for a in arguments], result_action="return_value")


def world(d: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(np.nan_to_num(d), -1, 0)
    return np.stack([2 + x, 2 + np.sin(3 * y), 2 + z * x], axis=-1).astype(np.float32)


def shot(path: Path, pose: Pose) -> np.ndarray:
    """A photograph of the world function; returns the clicks on a 1.2 x 0.8 m rectangle."""
    write_exr(path, world(of_camera(LENS).turned(pose.rotation).directions()))
    x, z = np.array([-0.6, 0.6, 0.6, -0.6]), np.array([0.4, 0.4, -0.4, -0.4])
    return LENS.posed(pose).project_world(np.stack([x, np.zeros(4), z], axis=1))


def front_pose() -> Pose:
    level = Pose.look_at(PLACE, PLACE + np.array([0.1, 0, -1]))
    tilt = Pose.from_rotation_vector([-0.15, 0, 0.04], [0, 0, 0])
    return Pose(level.rotation @ tilt.rotation, PLACE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "build").mkdir()
    front = front_pose()
    clicks = shot(tmp_path / "build/front.exr", front)
    turn = Pose.from_rotation_vector([0, math.pi, 0], [0, 0, 0])
    shot(tmp_path / "build/back.exr", Pose(turn.rotation @ front.rotation, PLACE))
    points = ", ".join(f"[{x:.4f}, {y:.4f}]" for x, y in clicks)
    (tmp_path / "scene.toml").write_text(
        f"""
name = "test"
bracket = [{{ name = "front", take = "a" }}, {{ name = "back", take = "b" }}]
[probe]
lens = {{ model = "equisolid", fov = 190 }}
shot = [{{ bracket = "front" }}, {{ bracket = "back", yaw = 180 }}]
[align]
picture = "front"
points = [{points}]
width = 1.2
[env]
width = 128
"""
    )
    return tmp_path


def points_of(folder: Path) -> str:
    text = (folder / "scene.toml").read_text()
    inside = text.split("points = [")[1].split("\n")[0][:-1]
    return inside.replace("], [", " ").strip("[]").replace(", ", ",")


def check_panorama(path: Path) -> None:
    image = read_image(path)
    assert {"R", "G", "B", "A", "completed"} <= set(image.channels)
    truth = world(LatLong((128, 64)).directions())
    # the tilted zone between the two rims may be unseen
    seen = image.pixels[..., 3] > 0.99
    assert seen.mean() > 0.9
    # pixels that the lens's rim cuts hold half of nothing
    assert np.percentile(np.abs(image.pixels[..., :3] - truth)[seen], 99.9) < 0.05
    np.testing.assert_allclose(np.ravel(image.attributes["origin"]), PLACE, atol=1e-3)
    assert image.attributes["textureformat"] == "LatLong Environment"
    assert "chromaticities" in image.attributes


def test_scene_file(folder: Path) -> None:
    run("envmap", "align", folder / "scene.toml", "-o", folder / "build/align.json")
    value = read_json(folder / "build/align.json")
    np.testing.assert_allclose(value["world_from_camera"], front_pose().matrix(), atol=1e-3)
    assert value["depth"] == pytest.approx(0.8, abs=1e-3)
    assert value["picture"] == "front"
    record = read_json(folder / "build/align.json.record.json")
    assert (folder / "build" / record["figures"]["overlay"]).is_file()
    run("envmap", "probe", folder / "scene.toml", "-o", folder / "build/env.exr")
    check_panorama(folder / "build/env.exr")
    figures = read_json(folder / "build/env.exr.record.json")["figures"]
    assert figures["overlaps"][0]["median_ratio"] == pytest.approx(1, abs=0.01)
    assert (folder / "build" / figures["preview"]).is_file()


def test_explicit_files(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    build = folder / "build"
    run(
        *("envmap", "align", "--points", points_of(folder), "--lens", "equisolid:190"),
        *("--size", f"{SIZE}x{SIZE}", "--width", 1.2, "-o", build / "align.json"),
    )
    run(
        *("envmap", "probe", build / "front.exr", build / "back.exr", "--yaw", "0,180"),
        *("--lens", "equisolid:190", "--align", build / "align.json"),
        *("--width", 128, "-o", build / "env.exr"),
    )
    check_panorama(build / "env.exr")
    capsys.readouterr()
    run(
        *("envmap", "lights", build / "env.exr", "--count", 20, "--no-ambient", "--json"),
        *("-o", build / "l.json"),
    )
    figures = json.loads(capsys.readouterr().out)
    assert figures["lights"] == 20
    value = read_json(build / "l.json")
    energy = sum(np.array(v["radiance"]) * v["solid_angle"] for v in value["lights"])
    np.testing.assert_allclose(energy, value["total"], rtol=1e-6)
    assert value["ambient"] is None
    assert all(v["position"] is None for v in value["lights"])


def test_camera_file_and_positions(folder: Path) -> None:
    build = folder / "build"
    LENS.write(build / "lens.cameramodel")
    run(
        *("envmap", "align", "--points", points_of(folder), "--width", "1.2"),
        *("--camera", build / "lens.cameramodel", "--picture", build / "front.exr"),
        *("-o", build / "align.json"),
    )
    run(
        *("envmap", "probe", build / "back.exr", build / "front.exr", "--yaw", "180,0"),
        *("--camera", build / "lens.cameramodel", "--align", build / "align.json"),
        *("--width", 128, "-o", build / "env.exr"),
    )
    check_panorama(build / "env.exr")  # the clicked shot is found by its name
    depth = np.full((16, 32, 1), 2.5, np.float32)
    write_exr(build / "depth.exr", depth, channels=("Z",))
    run(
        *("envmap", "lights", build / "env.exr", "--depth", build / "depth.exr"),
        *("--count", 8, "-o", build / "lights.json"),
    )
    value = read_json(build / "lights.json")
    assert np.array(value["ambient"]).shape == (9, 3)
    for light in value["lights"]:
        assert np.linalg.norm(np.array(light["position"]) - PLACE) < 2.5 + 1e-3


def test_clipped_and_masked_pixels(tmp_path: Path) -> None:
    """A lower bound is kept and counted; alpha 0 is left out, NaN or not."""
    pixels = np.ones((SIZE, SIZE, 5), np.float32)
    pixels[..., 4] = 0
    pixels[140:160, 140:160, 4] = 1
    pixels[:, :100, 3] = 0
    pixels[:, :100, 0] = np.nan
    names = ("R", "G", "B", "A", "clipped")
    write_exr(tmp_path / "s.exr", pixels, channels=names)
    run(
        *("envmap", "probe", tmp_path / "s.exr", "--lens", "equisolid:190", "--width", 64),
        *("-o", tmp_path / "env.exr"),
    )
    figures = read_json(tmp_path / "env.exr.record.json")["figures"]
    solid = of_camera(LENS).solid_angles()
    assert figures["clipped_solid_angle"] == [pytest.approx(solid[140:160, 140:160].sum())]
    seen = 4 * math.pi - figures["completed_solid_angle"]
    assert seen == pytest.approx(solid[:, 100:].sum(), rel=0.01)
    image = read_image(tmp_path / "env.exr")
    np.testing.assert_allclose(image.pixels[..., :3], 1, rtol=1e-5)
    assert "origin" not in image.attributes
    # the map says where its light is a bound
    alpha, marked = image.pixels[..., 3], image.pixels[..., image.channels.index("clipped")]
    bound = float((LatLong((64, 32)).solid_angles() * alpha * marked).sum())
    assert bound == pytest.approx(figures["clipped_solid_angle"][0], rel=0.02)
    assert (marked > 0).mean() < 0.01


def test_finished_panorama(tmp_path: Path) -> None:
    """F15: clicks in somebody's lat-long, then the map turned into the world's axes."""
    pose = Pose(
        Pose.from_rotation_vector([0.1, 0.7, -0.05], [0, 0, 0]).rotation
        @ WORLD_FROM_LATLONG.rotation,
        PLACE,
    )
    camera = CameraModel.latlong((512, 256))
    source = LatLong((512, 256)).turned(pose.rotation)
    lamp = (source.directions() @ np.array([0, 0.6, 0.8]) > math.cos(0.1)).astype(float)
    theirs = np.dstack([world(source.directions()), lamp])
    theirs = np.dstack([theirs, 0.01 * theirs[..., :3]])
    names = ("R", "G", "B", "clipped", "sigma.R", "sigma.G", "sigma.B")
    write_exr(tmp_path / "theirs.exr", theirs, channels=names)
    x, z = np.array([-0.6, 0.6, 0.6, -0.6]), np.array([0.4, 0.4, -0.4, -0.4])
    clicks = camera.posed(pose).project_world(np.stack([x, np.zeros(4), z], axis=1))
    points = ", ".join(f"[{u:.4f}, {v:.4f}]" for u, v in clicks)
    (tmp_path / "scene.toml").write_text(
        f'name = "t"\n[align]\npicture = "env"\npoints = [{points}]\nwidth = 1.2\n'
        '[env]\nwidth = 128\nfile = "theirs.exr"\n'
    )
    run("envmap", "align", tmp_path / "scene.toml", "-o", tmp_path / "build/align.json")
    run("envmap", "probe", tmp_path / "scene.toml", "-o", tmp_path / "build/env.exr")
    check_panorama(tmp_path / "build/env.exr")
    # what was too bright for their exposures is turned as well
    made = read_image(tmp_path / "build/env.exr")
    mapping = LatLong((128, 64))
    marked = made.pixels[..., made.channels.index("clipped")] * mapping.solid_angles()
    middle = np.einsum("hw,hwc->c", marked, mapping.directions())
    np.testing.assert_allclose(middle / np.linalg.norm(middle), [0, 0.6, 0.8], atol=0.01)
    assert marked.sum() == pytest.approx(2 * math.pi * (1 - math.cos(0.1)), rel=0.05)
    noise = made.pixels[..., made.channels.index("sigma.G")]
    share = np.median(noise / (0.01 * made.pixels[..., 1]))
    assert 0.2 < share < 0.5  # 16 pixels of theirs make one, and neighbours overlap


@pytest.mark.parametrize("kind", ["mirror", "angular", "cube", "latlong", "fisheye"])
def test_warp_there_and_back(tmp_path: Path, kind: str) -> None:
    source = tmp_path / "in.exr"
    write_exr(source, world(LatLong((128, 64)).directions()))
    lens = ["--lens", "equidistant:360"] if kind == "fisheye" else []
    run(
        *("envmap", "warp", source, "--from", "latlong", "--to", kind, "--width", 192),
        *("--rotate=40,10,-20", *lens, "-o", tmp_path / "there.exr"),
    )
    run(
        *("envmap", "warp", tmp_path / "there.exr", "--from", kind, "--to", "latlong"),
        *("--width", 128, *lens, "-o", tmp_path / "back.exr"),
    )
    figures = read_json(tmp_path / "there.exr.record.json")["figures"]
    np.testing.assert_allclose(figures["energy"], figures["source_energy"], rtol=1e-3)
    image = read_image(tmp_path / "back.exr")
    assert image.pixels[..., 3].min() > 0.99
    assert image.attributes["textureformat"] == "LatLong Environment"
    energy = read_json(tmp_path / "back.exr.record.json")["figures"]["energy"]
    np.testing.assert_allclose(energy, figures["source_energy"], rtol=2e-3)


def test_a_turned_map_is_as_wide_as_it_was(tmp_path: Path) -> None:
    write_exr(tmp_path / "in.exr", np.ones((74, 148, 3), np.float32))
    run(
        *("envmap", "warp", tmp_path / "in.exr", "--from", "latlong", "--to", "latlong"),
        *("--rotate", "-30,5,0", "-o", tmp_path / "out.exr"),
    )
    assert read_image(tmp_path / "out.exr").size == (148, 74)


def test_fisheye_to_fisheye(tmp_path: Path) -> None:
    source = tmp_path / "in.exr"
    write_exr(source, np.ones((60, 80, 3)))
    run(
        *("envmap", "warp", source, "--from", "fisheye", "--to", "fisheye", "--width", 50),
        *("--lens", "equisolid:180:39.5,29.5,28", "--to-lens", "stereographic:170"),
        *("-o", tmp_path / "out.exr"),
    )
    pixels = read_image(tmp_path / "out.exr").pixels
    assert pixels[25, 25] == pytest.approx([1, 1, 1, 1])
    assert pixels[0, 0] == pytest.approx([0, 0, 0, 0])


def write_raw_exr(path: Path, pixels: np.ndarray) -> None:
    """Whatever the values, past our own checks."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float")
    out = oiio.ImageOutput.create(str(path))
    assert out is not None
    out.open(str(path), spec)
    out.write_image(pixels.astype(np.float32))
    out.close()


@pytest.mark.parametrize(
    ("value", "size", "message"),
    [
        (np.nan, (32, 64), "1 pixels are NaN, infinite or negative, the first at x 5, y 3"),
        (-1.0, (32, 64), "negative"),
        (1.0, (32, 63), "no latlong map"),
        (0.0, (32, 64), None),
    ],
)
def test_bad_maps(
    tmp_path: Path, value: float, size: tuple[int, int], message: str | None
) -> None:
    pixels = np.ones((*size, 3), np.float32)
    pixels[3, 5, 1] = value
    write_raw_exr(tmp_path / "in.exr", pixels)
    out = tmp_path / "out.exr"
    arguments = ("envmap", "warp", tmp_path / "in.exr", "--from", "latlong", "--to", "angular")
    if message is None:
        run(*arguments, "--width", 16, "-o", out)
        return
    with pytest.raises(UserError, match=message):
        run(*arguments, "--width", 16, "-o", out)
    with pytest.raises(UserError, match=message):
        run("envmap", "lights", tmp_path / "in.exr", "-o", tmp_path / "l.json")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.exr"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "mirror", "--width", "0"], "--width"),
        (["--to", "latlong", "--ball-distance", "3"], "mirror ball"),
        (["--to", "mirror", "--ball-distance", "0.5"], "outside"),
        (["--to", "cube-files"], "px, nx"),
        (["--to", "cube", "--width", "10"], "4:3"),
        (["--to", "fisheye", "--width", "10"], "needs --lens or --camera"),
        (["--to", "fisheye", "--width", "10", "--lens", "nope:180"], "unknown fisheye"),
        (["--to", "mirror", "--width", "10", "--lens", "equisolid:180"], "neither map"),
        (["--to", "mirror", "--width", "10", "--rotate", "1,2"], "3 numbers"),
        (["--to", "mirror", "--width", "10", "--rotate", "1,2,inf"], "finite"),
        (["--to", "mirror", "--width", "10", "--to-lens", "equisolid:180"], "--to-lens"),
        (["--to", "mirror", "--width", "10", "--vignetting", "0.1"], "--from fisheye"),
    ],
)
def test_bad_warp_options(tmp_path: Path, arguments: list[str], message: str) -> None:
    write_exr(tmp_path / "in.exr", np.ones((8, 16, 3)))
    with pytest.raises(UserError, match=message):
        run(
            "envmap",
            "warp",
            tmp_path / "in.exr",
            "--from",
            "latlong",
            *arguments,
            "-o",
            "x.exr",
        )
    assert [p.name for p in tmp_path.iterdir()] == ["in.exr"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--lens", "equisolid:190"], "--points"),
        (["--points", "1,1 2,2 3,3", "--lens", "equisolid:190", "--size", "9x9"], "not 3"),
        (
            ["--points", "1,1 2,2 3,3 4,x", "--lens", "equisolid:190", "--size", "9x9"],
            "numbers",
        ),
        (["--points", "1,1 2,2 3,1 4,4", "--size", "9x9"], "--lens or --camera"),
        (["--points", "1,1 2,2 3,1 4,4", "--lens", "equisolid:190"], "--size"),
        (["--points", "1,1 2,2 3,1 4,4", "--lens", "equisolid:190", "--size", "9"], "640x480"),
    ],
)
def test_bad_align_options(tmp_path: Path, arguments: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        run("envmap", "align", *arguments, "--width", "1", "-o", tmp_path / "a.json")
    assert not list(tmp_path.iterdir())


def test_bad_probe_options(folder: Path) -> None:
    front, out = folder / "build/front.exr", folder / "out.exr"
    for arguments, message in (
        ([front], "--lens, --camera or --ball"),
        ([front, "--lens", "equisolid:190", "--yaw", "0,180"], "1 numbers are needed"),
        ([front, "--lens", "equisolid:190", "--width", "31"], "--width"),
        ([front, "--lens", "equisolid:190", "--vignetting=-3"], "vignetting falls"),
        ([front, "--lens", "equisolid:190", "--align", folder / "no.json"], "no such file"),
        ([front, "--lens", "equisolid:190", "--clicked", "2"], "--clicked"),
        ([folder / "no.exr", "--lens", "equisolid:190"], "no such picture"),
        ([folder / "scene.toml", "--yaw", "3"], "says everything"),
    ):
        with pytest.raises(UserError, match=message):
            run("envmap", "probe", *arguments, "-o", out)
        assert not out.exists()
    run("envmap", "align", folder / "scene.toml", "-o", folder / "build/align.json")
    with pytest.raises(UserError, match="none of the shots back"):
        run(
            *("envmap", "probe", folder / "build/back.exr", "--lens", "equisolid:190"),
            *("--align", folder / "build/align.json", "-o", out),
        )


def test_lights_need_an_origin_for_positions(tmp_path: Path) -> None:
    write_exr(tmp_path / "env.exr", np.ones((8, 16, 3)))
    write_exr(tmp_path / "depth.exr", np.ones((8, 16, 1)), channels=("Z",))
    with pytest.raises(UserError, match="--seed -1"):
        run(
            *("envmap", "lights", tmp_path / "env.exr", "--method", "random", "--seed=-1"),
            *("-o", tmp_path / "l.json"),
        )
    with pytest.raises(UserError, match="origin"):
        run(
            *("envmap", "lights", tmp_path / "env.exr", "--depth", tmp_path / "depth.exr"),
            *("-o", tmp_path / "l.json"),
        )
    with pytest.raises(UserError, match="no channel Z"):
        run(
            *("envmap", "lights", tmp_path / "env.exr", "--depth", tmp_path / "env.exr"),
            *("-o", tmp_path / "l.json"),
        )
    assert not (tmp_path / "l.json").exists()


def test_one_line_and_exit_code(tmp_path: Path) -> None:
    command = [
        str(Path(sys.executable).with_name("chromeball")),
        "envmap",
        "lights",
        "none.exr",
    ]
    done = subprocess.run(
        [*command, "-o", "l.json"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.strip() == "chromeball: none.exr: no such picture"
    assert not list(tmp_path.iterdir())


def test_warp_divides_by_the_vignetting(tmp_path: Path) -> None:
    y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    r2 = (x**2 + y**2) / (SIZE / 2) ** 2
    dim = np.maximum(1 - 0.4 * r2 + 0.1 * r2**2, 0.1)
    write_exr(tmp_path / "dim.exr", np.repeat(dim[..., None], 3, 2).astype(np.float32))
    lens = ("--from", "fisheye", "--lens", "equisolid:190", "--to", "latlong")
    options = (*lens, "--vignetting=-0.4,0.1", "--width", "256", "-o", tmp_path / "even.exr")
    run("envmap", "warp", tmp_path / "dim.exr", *options)
    even = read_image(tmp_path / "even.exr").pixels
    np.testing.assert_allclose(even[..., :3][even[..., 3] == 1], 1, atol=2e-3)


def test_warp_leaves_out_what_a_mask_does(tmp_path: Path) -> None:
    """The right half is masked; it is not read, even where it is enormous."""
    rgb = np.ones((16, 32, 3), np.float32)
    rgb[:, 16:] = 1e6
    write_exr(tmp_path / "in.exr", rgb)
    mask = np.ones((16, 32, 1), np.float32)
    mask[:, 16:] = 0
    write_exr(tmp_path / "mask.exr", mask, channels=("Y",))
    warp = ("envmap", "warp", tmp_path / "in.exr", "--from", "latlong", "--to", "latlong")
    out = tmp_path / "out.exr"
    run(*warp, "--mask", tmp_path / "mask.exr", "-o", out)
    got = read_image(out).pixels
    np.testing.assert_allclose(got[:, :15], 1, rtol=1e-5)
    assert (got[:, 17:] == 0).all()
    record = read_json(tmp_path / "out.exr.record.json")
    assert str(tmp_path / "mask.exr") in record["inputs"]
    assert record["figures"]["seen_solid_angle"] == pytest.approx(2 * math.pi, rel=1e-5)
    write_exr(tmp_path / "small.exr", mask[:8], channels=("Y",))
    with pytest.raises(UserError, match="is 32x16"):
        run(*warp, "--mask", tmp_path / "small.exr", "-o", out)


def test_warp_reads_tiles_as_it_reads_rows(tmp_path: Path) -> None:
    rgb = np.random.default_rng(2).random((150, 300, 3)).astype(np.float32)
    write_exr(tmp_path / "rows.exr", rgb)
    spec = oiio.ImageSpec(300, 150, 3, "float")
    spec.tile_width = spec.tile_height = 64
    file = oiio.ImageOutput.create(str(tmp_path / "tiles.exr"))
    assert file is not None
    assert file.open(str(tmp_path / "tiles.exr"), spec)
    assert file.write_image(rgb)
    assert file.close()
    for name in ("rows", "tiles"):
        run(
            *("envmap", "warp", tmp_path / f"{name}.exr", "--from", "latlong", "--to", "cube"),
            *("-o", tmp_path / f"{name}.cube.exr"),
        )
    rows, tiles = (read_image(tmp_path / f"{n}.cube.exr").pixels for n in ("rows", "tiles"))
    np.testing.assert_array_equal(rows, tiles)
