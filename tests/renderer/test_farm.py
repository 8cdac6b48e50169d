"""Frames and tiles made by real workers of a real scheduler, on loopback."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import distributed
import pytest

from chromeball.renderer.farm import farm_out
from chromeball.renderer.frames import Outcome, Task, Tile
from chromeball.renderer.render import Budget
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image
from tests.renderer.scenes import SCENE, run, write_scene

pytestmark = pytest.mark.filterwarnings("ignore")  # what dask and tornado do is theirs

MOVING = SCENE.replace(
    "scale = 0.5\n",
    "scale = 0.5\n"
    "key = [{ frame = 1, position = [-0.5, 0, 0] }, { frame = 6, position = [0.5, 0, 0] }]\n",
).replace("size = [40, 30]", "size = [80, 60]")


class Farm:
    """A scheduler and workers, processes of our own."""

    def __init__(self, folder: Path) -> None:
        self._processes: list[subprocess.Popen[bytes]] = []
        self._file = folder / "scheduler.json"
        self._folder = folder
        self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0")
        limit = time.monotonic() + 60
        while not self._file.is_file() or not self._file.read_text().strip():
            assert time.monotonic() < limit
            time.sleep(0.05)
        self.address = json.loads(self._file.read_text())["address"]

    def _start(self, module: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options]
        with (self._folder / "log").open("ab") as log:
            process = subprocess.Popen(
                [*command, "--scheduler-file", str(self._file), "--no-dashboard"],
                stdout=log,
                stderr=log,
                cwd=self._folder,
            )
        self._processes.append(process)
        return process

    def worker(self, name: str) -> subprocess.Popen[bytes]:
        alone = ("--no-nanny", "--nthreads", "1", "--host", "127.0.0.1")
        return self._start("dask_worker", "--name", name, *alone)

    def stop(self) -> None:
        for process in self._processes[::-1]:
            if process.poll() is None:
                process.kill()
            process.wait(30)


@pytest.fixture(scope="module")
def farm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Farm]:
    made = Farm(tmp_path_factory.mktemp("farm"))
    made.worker("first")
    yield made
    made.stop()


def tasks(scene: Path, frames: range, spp: int = 4) -> list[Task]:
    return [Task(str(scene), "main", Budget(spp=spp), frame) for frame in frames]


def pixels(path: str | Path) -> bytes:
    return read_image(path).pixels.tobytes()


def test_a_killed_worker_costs_no_frame_and_doubles_none(farm: Farm, tmp_path: Path) -> None:
    scene = write_scene(tmp_path, MOVING)
    second = farm.worker("second")
    watch: Any = distributed.Client(farm.address, set_as_default=False)
    watch.wait_for_workers(2, timeout=60)
    addresses = {w["name"]: a for a, w in watch.scheduler_info()["workers"].items()}
    outcomes: list[Outcome] = []
    made = threading.Thread(
        target=lambda: outcomes.extend(farm_out(tasks(scene, range(1, 7), 96), farm.address))
    )
    made.start()
    build = tmp_path / "build"
    limit = time.monotonic() + 120
    while len(list(build.glob("main.*.exr.record.json"))) < 2 or not watch.processing().get(
        addresses["second"]
    ):
        assert time.monotonic() < limit
        time.sleep(0.01)
    os.kill(second.pid, signal.SIGKILL)  # in the middle of a frame
    watch.close()
    finished = {p: p.stat().st_mtime_ns for p in build.glob("main.*.exr.record.json")}
    assert 2 <= len(finished) < 6
    made.join(120)
    assert not made.is_alive()
    assert sorted(outcome.task.frame or 0 for outcome in outcomes) == [1, 2, 3, 4, 5, 6]
    assert {outcome.state for outcome in outcomes} <= {"rendered", "kept"}
    assert {p: p.stat().st_mtime_ns for p in finished} == finished
    assert len(list(build.glob("main.*.exr"))) == 6
    for outcome in outcomes:
        run(
            *("render", scene, "--spp", "96", "--frames", str(outcome.task.frame)),
            *("-o", tmp_path / "here.%d.exr"),
        )
        assert pixels(tmp_path / f"here.{outcome.task.frame}.exr") == pixels(outcome.output)


def test_a_frame_that_always_fails_is_told_and_the_others_go_on(
    farm: Farm, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_scene(tmp_path, MOVING)
    (tmp_path / "build/main.0002.exr").mkdir()  # where no file can be written
    arguments = ("render", scene, "--frames", "1-3", "--scheduler", farm.address, "--json")
    with pytest.raises(UserError, match=r"1 of 3 failed, first main frame 2: .*is a folder"):
        run(*arguments)
    rows = json.loads(capsys.readouterr().out)
    assert [row["state"] for row in rows] == ["rendered", "failed", "rendered"]
    (tmp_path / "build/main.0002.exr").rmdir()
    run(*arguments)
    rows = json.loads(capsys.readouterr().out)
    assert [row["state"] for row in rows] == ["kept", "rendered", "kept"]


def test_tiles_made_by_workers_are_the_whole(farm: Farm, tmp_path: Path) -> None:
    scene = write_scene(tmp_path, SCENE)
    parts = [Task(str(scene), "main", tile=tile) for tile in Tile.parse("3")]
    outcomes = list(farm_out(parts, farm.address))
    assert {outcome.state for outcome in outcomes} == {"rendered"}
    run("render", scene, "--tile", "1/1", "-o", tmp_path / "whole.exr")
    assert pixels(tmp_path / "build/main.exr") == pixels(tmp_path / "whole.exr")


def test_an_error_that_is_not_the_users_is_tried_again_and_then_told(
    farm: Farm, tmp_path: Path
) -> None:
    scene = write_scene(tmp_path, MOVING)
    odd = Task(str(scene), "main", Budget(spp=2), 10**96)  # no file has such a name
    good = Task(str(scene), "main", Budget(spp=2), 1)
    outcomes = {o.task: o for o in farm_out([odd, good], farm.address)}
    assert outcomes[odd].state == "failed"
    assert outcomes[odd].error
    assert outcomes[good].state == "rendered"


def test_nobody_answers(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, MOVING)
    with pytest.raises(UserError, match="no dask scheduler answers at tcp://127"):
        list(farm_out(tasks(scene, range(1, 2)), "tcp://127.0.0.1:1", patience=2))
    lonely = Farm(tmp_path)
    try:
        with pytest.raises(UserError, match="has no workers"):
            list(farm_out(tasks(scene, range(1, 2)), lonely.address, patience=2))
    finally:
        lonely.stop()
