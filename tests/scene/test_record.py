"""Outputs appear whole or not at all, also when the process is killed; records tell all."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from chromeball.scene.errors import DeviceError, QualityError, UserError
from chromeball.scene.record import (
    Stage,
    atomic_output,
    content_hash,
    read_json,
    record_path,
    to_json,
    write_json,
    write_text,
)

HALFWAY = """
import sys, time
from chromeball.scene.record import Stage
with Stage("test half", ["{folder}/in.txt"]) as stage:
    with stage.output("{folder}/out.bin") as temporary:
        with temporary.open("wb") as file:
            file.write(b"x" * 100_000)
            file.flush()
            print("half", flush=True)
            time.sleep(60)
            file.write(b"y" * 100_000)
"""


def start_and_reach_the_middle(folder: Path) -> subprocess.Popen[str]:
    (folder / "in.txt").write_text("input")
    process = subprocess.Popen(
        [sys.executable, "-c", HALFWAY.format(folder=folder)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "half\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert process.stdout is not None
    process.stdout.close()


@pytest.mark.parametrize("before", [None, b"the old and whole file"])
def test_a_killed_run_leaves_the_output_as_it_was(tmp_path: Path, before: bytes | None) -> None:
    out = tmp_path / "out.bin"
    if before is not None:
        out.write_bytes(before)
    kill(start_and_reach_the_middle(tmp_path))
    assert (out.read_bytes() if out.exists() else None) == before
    assert not record_path(out).exists()
    visible = {p.name for p in tmp_path.iterdir() if not p.name.startswith(".")}
    assert visible == {"in.txt"} | ({"out.bin"} if before else set())
    # the next run of the same output sweeps up and succeeds
    write_text(out, "new")
    assert {p.name for p in tmp_path.iterdir()} == {"in.txt", "out.bin"}


def test_a_living_run_keeps_its_temporary_file(tmp_path: Path) -> None:
    process = start_and_reach_the_middle(tmp_path)
    try:
        write_text(tmp_path / "out.bin", "someone else's")
        hidden = [p for p in tmp_path.iterdir() if p.name.startswith(".")]
        assert len(hidden) == 1
        assert hidden[0].stat().st_size == 100_000
    finally:
        kill(process)


def test_leftovers_of_other_outputs_stay(tmp_path: Path) -> None:
    others = [".out.abcdefgh.exr", ".outer.abcdefgh.bin", ".out.bin", ".out.short.bin"]
    for name in others:
        (tmp_path / name).touch()
    (tmp_path / ".out.abcdefgh.bin").touch()
    write_text(tmp_path / "out.bin", "new")
    assert {p.name for p in tmp_path.iterdir()} == {*others, "out.bin"}


def test_a_failing_writer_leaves_nothing(tmp_path: Path) -> None:
    def fail_midway() -> None:
        with Stage("test", []) as stage, stage.output(tmp_path / "deep/out.txt") as temporary:
            temporary.write_text("half")
            raise RuntimeError("midway")

    with pytest.raises(RuntimeError, match="midway"):
        fail_midway()
    assert list((tmp_path / "deep").iterdir()) == []


def test_outputs_have_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    write_text(tmp_path / "ours", "x")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"file/out\.txt: cannot write here: "):
        write_text(tmp_path / "file" / "out.txt", "x")
    with pytest.raises(UserError, match=r"is a folder"), atomic_output(tmp_path) as temporary:
        temporary.write_text("x")
    assert {p.name for p in tmp_path.parent.glob(f".{tmp_path.name}*")} == set()


def test_the_record_tells_all(tmp_path: Path) -> None:
    source, out = tmp_path / "in.txt", tmp_path / "out.txt"
    source.write_text("input")
    with Stage("room verb", [source, tmp_path], strength=0.5) as stage:
        stage.figures["error"] = np.float32(0.25)
        stage.figures["table"] = np.array([[1, 2], [3, 4]])
        stage.figures["unknown"] = float("nan")
        with stage.output(out) as temporary:
            temporary.write_text("output")
            assert temporary.suffix == ".txt"
    assert out.read_text() == "output"
    record = json.loads(record_path(out).read_text())
    assert record_path(out).name == "out.txt.record.json"
    assert record["stage"] == "room verb"
    assert record["inputs"] == {str(source): content_hash(source)}
    assert record["outputs"] == [str(out)]
    assert record["options"] == {"strength": 0.5}
    assert record["figures"] == {"error": 0.25, "table": [[1, 2], [3, 4]], "unknown": None}
    assert record["versions"]["chromeball"]
    assert 0 <= record["seconds"] < 60
    assert record["peak_memory_bytes"] > 1e6


def test_every_output_of_a_stage_has_the_record_and_failures_have_none(tmp_path: Path) -> None:
    names = [tmp_path / "a.txt", tmp_path / "b.txt"]
    with Stage("two", []) as stage:
        for name in names:
            with stage.output(name) as temporary:
                temporary.write_text("x")
    a, b = (json.loads(record_path(name).read_text()) for name in names)
    assert a == b
    assert a["outputs"] == [str(name) for name in names]

    def fail_late() -> None:
        with Stage("two", []) as stage:
            with stage.output(names[0]) as temporary:
                temporary.write_text("newer")
            raise UserError("late")

    with pytest.raises(UserError, match="late"):
        fail_late()
    assert names[0].read_text() == "newer"
    assert not record_path(names[0]).exists()  # the old figures are not the new file's


def test_no_stage_overwrites_what_it_was_made_from(tmp_path: Path) -> None:
    source, link = tmp_path / "in.txt", tmp_path / "link.txt"
    source.write_text("light")
    link.symlink_to(source)
    for output in (source, link):
        with (
            pytest.raises(UserError, match="is an input"),
            Stage("test", [source]) as stage,
            stage.output(output) as temporary,
        ):
            temporary.write_text("dark")
    assert source.read_text() == "light"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.txt", "link.txt"]


def test_hashes_follow_content_alone(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"same")
    (tmp_path / "b").write_bytes(b"same")
    (tmp_path / "c").write_bytes(b"Same")
    a, b, c = (content_hash(tmp_path / name) for name in "abc")
    assert a == b != c
    assert len(a) == 32


def test_json_of_numpy_paths_and_what_has_none(tmp_path: Path) -> None:
    value = {"a": np.arange(3), "b": tmp_path, "c": (True, None, "x"), 4: np.float64("inf")}
    assert to_json(value) == {
        "a": [0, 1, 2],
        "b": str(tmp_path),
        "c": [True, None, "x"],
        "4": None,
    }
    with pytest.raises(TypeError, match="no JSON form for object"):
        to_json({"a": object()})
    write_json(tmp_path / "v.json", value)
    assert read_json(tmp_path / "v.json")["a"] == [0, 1, 2]


@pytest.mark.parametrize("text", ["", "{", "[1,", "nope", "[" * 200_000, '"\\ud800'])
def test_broken_json_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(UserError, match="not a readable JSON file") as caught:
        read_json(tmp_path / "a.json")
    assert "\n" not in str(caught.value)


def test_missing_and_binary_json(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        read_json(tmp_path / "none.json")
    (tmp_path / "b.json").write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match="not a readable JSON file"):
        read_json(tmp_path / "b.json")


def test_errors_name_the_file_and_the_exit_code() -> None:
    assert str(UserError("wrong", file="a.txt")) == "a.txt: wrong"
    assert str(UserError("wrong")) == "wrong"
    codes = [error("x").exit_code for error in (UserError, DeviceError, QualityError)]
    assert codes == [2, 1, 3]


def test_text_is_utf8_whatever_the_locale(tmp_path: Path) -> None:
    script = "from chromeball.scene.record import write_text; write_text('t', 'Gr\\u00fcn')"
    subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0"},
        check=True,
    )
    assert (tmp_path / "t").read_bytes().decode() == "Grün"
