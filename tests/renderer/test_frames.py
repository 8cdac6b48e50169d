"""Sequences, tiles and what is kept of them, through the command."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from chromeball.renderer.frames import Budget, Task, Tile, make
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.pose import Pose
from tests.renderer.scenes import SCENE, run, write_scene

MOVING = SCENE.replace(
    "scale = 0.5\n",
    """scale = 0.5
key = [{ frame = 1, position = [-0.5, 0, 0] }, { frame = 3, position = [0.5, 0, 0] }]
""",
)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path, MOVING)


def pixels(path: Path) -> bytes:
    return read_image(path).pixels.tobytes()


def states(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [row["state"] for row in json.loads(capsys.readouterr().out)]


def test_a_frame_alone_is_the_frame_of_a_range(scene: Path, tmp_path: Path) -> None:
    build = scene.parent / "build"
    run("render", scene, "--frames", "1-3")
    names = ["main.0001.exr", "main.0002.exr", "main.0003.exr"]
    assert sorted(p.name for p in build.glob("main*.exr")) == names
    assert all((build / name).with_suffix(".png").is_file() for name in names)
    one, two, three = (pixels(build / name) for name in names)
    assert len({one, two, three}) == 3
    run("render", scene, "--frames", "2", "-o", tmp_path / "alone.%03d.exr")
    assert pixels(tmp_path / "alone.002.exr") == two
    # the ball is where its keys say
    alpha = read_image(build / names[0])
    columns = np.argwhere(alpha.pixels[..., alpha.channels.index("A")] > 0)[:, 1]
    alpha = read_image(build / names[2])
    later = np.argwhere(alpha.pixels[..., alpha.channels.index("A")] > 0)[:, 1]
    assert later.mean() > columns.mean() + 5


def test_each_frame_has_a_seed_of_its_own_that_its_record_states(scene: Path) -> None:
    scene.write_text(SCENE)  # nothing moves: frames differ by their noise alone
    run("render", scene, "--frames", "4-5")
    build = scene.parent / "build"
    records = [
        json.loads((build / f"main.000{n}.exr.record.json").read_text())["options"]
        for n in (4, 5)
    ]
    assert [(r["frame"], r["seed"]) for r in records] == [(4, 4), (5, 5)]
    assert pixels(build / "main.0004.exr") != pixels(build / "main.0005.exr")


def test_finished_frames_are_kept_until_an_input_changes(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("render", scene, "--frames", "1-3", "--json")
    run(*arguments)
    assert states(capsys) == ["rendered"] * 3
    run(*arguments)
    assert states(capsys) == ["kept"] * 3
    build = scene.parent / "build"
    # a frame of which a part is gone does not count, nor one without its record
    (build / "main.0001.png").unlink()
    (build / "main.0003.exr.record.json").unlink()
    run(*arguments)
    assert states(capsys) == ["rendered", "kept", "rendered"]
    # a comment and another table of the file change nothing; a key changes its own frames
    scene.write_text(MOVING.replace("[render]", "# note\n[env]\nwidth = 64\n[render]"))
    run(*arguments)
    assert states(capsys) == ["kept"] * 3
    three = "{ frame = 2, position = [0, 0, 0] }, { frame = 3, position = [0.4, 0, 0] }"
    scene.write_text(MOVING.replace("{ frame = 3, position = [0.5, 0, 0] }", three))
    run(*arguments)
    assert states(capsys) == ["kept", "kept", "rendered"]
    # seen from another folder it is the same scene
    here = Path.cwd()
    os.chdir(scene.parent)
    try:
        run("render", Path("scene.toml"), "--frames", "1-3", "--json")
    finally:
        os.chdir(here)
    assert states(capsys) == ["kept"] * 3
    # more samples, another light: all of them
    run(*arguments, "--spp", "5")
    assert states(capsys) == ["rendered"] * 3
    sky = np.full((16, 32, 3), 0.4, np.float32)
    write_exr(build / "env.exr", sky, attributes={"origin": (0.0, 1.0, 1.5)})
    run(*arguments, "--spp", "5")
    assert states(capsys) == ["rendered"] * 3
    run(*arguments, "--spp", "5", "--force")
    assert states(capsys) == ["rendered"] * 3


def test_one_frame_that_fails_does_not_keep_the_others_back(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    pose = Pose.look_at(np.array([0.0, 1.0, 1.5]), np.array([0.0, 0.2, 0.0]))
    CameraModel.pinhole((40, 30), 1.0, pose).write(scene.parent / "posed.cameramodel")
    for frame in (1, 2, 3):
        plate = rng.uniform(0.1, 1, (30, 40, 3)).astype(np.float32)
        write_exr(scene.parent / f"plates/{frame:04d}.exr", plate)
    scene.write_text(
        MOVING.replace(
            "size = [40, 30]",
            'plate = "plates/%04d.exr"\ncamera = "posed.cameramodel"\nframes = "1-3"',
        )
    )
    (scene.parent / "plates/0002.exr").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"1 of 3 failed, first main frame 2: .*0002\.exr"):
        run("render", scene, "--json")
    assert states(capsys) == ["rendered", "failed", "rendered"]
    for frame in (1, 3):
        composite = read_image(scene.parent / f"build/main.{frame:04d}.exr")
        plate = read_image(scene.parent / f"plates/{frame:04d}.exr").pixels
        rgb = composite.pixels[..., [composite.channels.index(c) for c in "RGB"]]
        assert (rgb == plate).all(axis=2).sum() > 100  # its own plate, bit for bit
    (scene.parent / "plates/0002.exr").unlink()
    with pytest.raises(UserError, match=r"0002\.exr: the plate of frame 2 is missing"):
        run("render", scene)


def test_a_sequence_must_say_its_frames(scene: Path) -> None:
    with pytest.raises(UserError, match="say --frames"):
        run("render", scene)
    with pytest.raises(UserError, match="write %04d"):
        run("render", scene, "--frames", "1-2", "-o", scene.parent / "one.exr")


def test_one_exposure_shows_all_frames(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("render", scene, "--frames", "1-2", "--json")
    rows = json.loads(capsys.readouterr().out)
    assert len({row["figures"]["exposure"] for row in rows}) == 1


# ---- tiles


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_tiles_joined_are_the_whole(tmp_path: Path, count: int) -> None:
    scene = write_scene(tmp_path, SCENE)
    run("render", scene, "--tile", "1/1", "-o", tmp_path / "whole.exr")
    for i in range(count, 0, -1):
        assert not (tmp_path / "build/main.exr").exists()
        run("render", scene, "--tile", f"{i}/{count}")
    assert pixels(tmp_path / "build/main.exr") == pixels(tmp_path / "whole.exr")
    assert not list((tmp_path / "build").glob("*tile*"))  # they have done their work
    record = json.loads((tmp_path / "build/main.exr.record.json").read_text())
    assert record["figures"]["tiles"] == count


def test_each_row_is_of_one_tile() -> None:
    for height in (1, 8, 30, 1000):
        for count in (1, 2, 5):
            owners = sum(tile.rows(height).astype(int) for tile in Tile.parse(str(count)))
            np.testing.assert_array_equal(owners, 1)
    assert Tile.parse("2/4") == [Tile(2, 4)]
    for wrong in ("0/4", "5/4", "0", "-1", "a", "1/2/3", ""):
        with pytest.raises(UserError):
            Tile.parse(wrong)


def test_tiles_are_kept_joined_by_hand_and_never_mixed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, build = write_scene(tmp_path, SCENE), tmp_path / "build"
    with pytest.raises(UserError, match="no tiles of this picture lie here"):
        run("render", scene, "--join")
    run("render", scene, "--tile", "1/2")
    capsys.readouterr()
    run("render", scene, "--tile", "1/2")
    assert "kept" in capsys.readouterr().out
    with pytest.raises(UserError, match=r"tile-2-of-2\.exr: no such picture"):
        run("render", scene, "--join")
    # a tile that came from elsewhere with other samples, or another seed
    first = [build / f"main.tile-1-of-2.exr{end}" for end in ("", ".record.json")]
    for file in first:
        shutil.copy(file, tmp_path / file.name)
        file.unlink()
    for text, options, message in (
        (SCENE, ("--spp", "5"), "samples 5, the picture 4"),
        (SCENE + "seed = 3\n", (), "seed 3, the picture 0"),
        (SCENE.replace("40, 30", "40, 20"), (), "height 20, the picture 30"),
        (SCENE.replace("scale = 0.5", "scale = 0.6"), (), "have changed since"),
    ):
        scene.write_text(text)
        run("render", scene, "--tile", "2/2", *options)
        scene.write_text(SCENE)
        for file in first:
            shutil.copy(tmp_path / file.name, file)
        with pytest.raises(UserError, match=message):
            run("render", scene, "--join")
        for file in first:
            file.unlink()
    run("render", scene, "--tile", "2/3")
    with pytest.raises(UserError, match="of 2 and of 3"):
        run("render", scene, "--join")
    for file in build.glob("*tile*"):
        file.unlink()
    # the file alone says what it is: a tile under another's name is refused
    run("render", scene, "--tile", "1/2")
    for end in ("", ".record.json"):
        shutil.copy(f"{first[0]}{end}", build / f"main.tile-2-of-2.exr{end}")
    with pytest.raises(UserError, match="has tile 1/2, the picture 2/2"):
        run("render", scene, "--join")
    run("render", scene, "--tile", "2")
    assert (build / "main.exr").is_file()


def test_tiles_need_equal_samples(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, SCENE)
    for option in (("--error", "0.1"), ("--seconds", "1")):
        with pytest.raises(UserError, match="equally many samples"):
            run("render", scene, "--tile", "1/2", *option)
    with pytest.raises(UserError, match="30 rows make 4 tiles at most, not 5"):
        run("render", scene, "--tile", "5/5")


def test_tiles_of_frames(scene: Path) -> None:
    run("render", scene, "--frames", "1-2", "--tile", "2")
    run("render", scene, "--frames", "2", "--tile", "1/1", "-o", scene.parent / "w.%d.exr")
    assert pixels(scene.parent / "build/main.0002.exr") == pixels(scene.parent / "w.2.exr")


def test_a_task_is_all_that_another_process_needs(scene: Path) -> None:
    task = Task(str(scene), "main", Budget(spp=2), frame=3)
    first, second = make(task), make(task)
    assert (first.state, second.state) == ("rendered", "kept")
    assert first.figures["spp"] == second.figures["spp"] == 2
    assert str(task) == "main frame 3"
