"""``chromeball acquire`` and ``chromeball emulate`` as a user calls them."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.acquire.take import read_take
from chromeball.cli import main
from chromeball.scene.image import Exposure, write_exr, write_picture

CHROMEBALL = os.fspath(Path(sys.executable).with_name("chromeball"))
EMULATE = ["emulate", "visca", "--radiance", "r.exr", "--link", "dev", "--video", "socket:v"]
BRACKET = ["acquire", "bracket", "--device", "visca:dev", "--video", "socket:v", "-o", "t"]


def chromeball(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [CHROMEBALL, *arguments], cwd=folder, capture_output=True, text=True, timeout=60
    )


@pytest.fixture
def set_up(short: Path, scene: NDArray[np.float32]) -> Path:
    write_exr(short / "r.exr", scene)
    return short


def test_a_bracket_from_an_emulated_camera_survives_its_silence(set_up: Path):
    times = ["--times", "1/25,1/100,1/425"]
    broken = chromeball(
        set_up, *EMULATE, "--speed", "4", "--silent-after", "13", "--",
        "chromeball", *BRACKET, *times,
    )  # fmt: skip
    assert broken.returncode == 1
    assert broken.stdout == ""
    last = broken.stderr.splitlines()[-1]
    assert last.startswith("chromeball: dev: the camera stopped answering")
    assert "of 3 frames are kept, run the command again" in last
    assert "Traceback" not in broken.stderr
    assert not (set_up / "t/take.json").exists()
    assert not (set_up / "dev").is_symlink()
    assert not (set_up / "v").exists()

    whole = chromeball(
        set_up, *EMULATE, "--speed", "4", "--seed", "5", "--",
        "chromeball", *BRACKET, *times, "--json",
    )  # fmt: skip
    assert whole.returncode == 0, whole.stderr
    assert "going on after" in whole.stderr
    result = json.loads(whole.stdout)
    assert [f["time"] for f in result["frames"]] == [1 / 425, 1 / 100, 1 / 25]
    take = read_take(set_up / "t")
    assert take.size == (64, 48)
    assert all(f.row.settle and f.row.settle.verdict == "settled" for f in take.frames)
    assert take.device == "EVI-D100P at dev"
    assert take.video == "socket:v"


@pytest.mark.parametrize(
    ("arguments", "message", "code"),
    [
        ([*BRACKET, "--times", "1/25"], "dev: no such serial port", 1),
        ([*BRACKET, "--times", "fast"], "'fast' is no exposure time", 2),
        ([*BRACKET, "--times", "1/25", "--response", "no.json"], "no.json: no such file", 2),
        (["acquire", "import", "none.jpg", "-o", "t"], "at least two pictures", 2),
        (["acquire", "import", "a.jpg", "b.jpg", "-o", "t"], "a.jpg: no such picture", 2),
        ([*EMULATE, "--model", "evi-d30"], "no model 'evi-d30'", 2),
        ([*EMULATE[:-1], "file:x"], "write socket:PATH", 2),
        ([*EMULATE, "--baud", "1200"], "1200 is no baud rate", 2),
        ([*EMULATE, "--fps", "0"], "must lie between", 2),
        ([*EMULATE, "--", "no-such-program"], "no-such-program: no such command", 2),
    ],
)
def test_mistakes_are_one_line(
    set_up: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
    code: int,
):
    monkeypatch.chdir(set_up)
    monkeypatch.setattr(sys, "argv", ["chromeball", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == code
    output, errors = capsys.readouterr()
    assert output == ""
    assert message in errors.splitlines()[-1]
    assert sorted(p.name for p in set_up.iterdir()) == ["r.exr"]


def test_the_emulator_passes_the_exit_code_on(set_up: Path):
    result = chromeball(set_up, *EMULATE, "--", "sh", "-c", "test -e dev && exit 7")
    assert result.returncode == 7


def test_the_emulator_stands_until_it_is_told_to_go(set_up: Path):
    process = subprocess.Popen(
        [CHROMEBALL, *EMULATE], cwd=set_up, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "EVI-D100P on dev, video on socket:v\n"
    assert (set_up / "dev").is_symlink()
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    assert process.stderr.read() == ""
    process.stderr.close()
    assert not (set_up / "dev").is_symlink()
    assert not (set_up / "v").exists()


def test_import(tmp_path: Path):
    for name, seconds in (("b.jpg", 0.5), ("a.jpg", 0.25)):
        pixels = np.full((6, 8, 3), 100, np.uint8)
        write_picture(tmp_path / name, pixels, exposure=Exposure(time=seconds))
    result = chromeball(tmp_path, "acquire", "import", "a.jpg", "b.jpg", "-o", "takes/plate")
    assert result.returncode == 0, result.stderr
    assert [line.split("\t")[0] for line in result.stdout.splitlines()] == ["0.25", "0.5"]
    assert read_take(tmp_path / "takes/plate").paths == [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    given = chromeball(
        tmp_path,
        "acquire",
        "import",
        "a.jpg",
        "b.jpg",
        "--times",
        "1/4,1/2",
        "-o",
        "u",
        "--json",
    )
    assert [f["requested_time"] for f in json.loads(given.stdout)["frames"]] == [0.25, 0.5]
