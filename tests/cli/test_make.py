"""pipeline.mk under real make, the stages being faked."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from tests.cli.conftest import Workshop
from tests.cli.scenes import ALL, FULL, photograph


def later(path: Path) -> None:
    """Give a file a time after everything made so far."""
    now = time.time_ns() + 20_000_000
    os.utime(path, ns=(now, now))
    time.sleep(0.03)


def edit(workshop: Workshop, old: str, new: str) -> None:
    text = (workshop.folder / "scene.toml").read_text()
    assert old in text
    time.sleep(0.02)
    workshop.write(text.replace(old, new))


def test_first_run_makes_everything_in_order(first_run: tuple[Path, list[str]]) -> None:
    ran = first_run[1]
    assert ran.count("plan") == 1
    assert set(ran) - {"plan"} == ALL
    order = [
        "hdr response takes/front",
        "hdr merge takes/front",
        "envmap align scene.toml",
        "envmap probe build/front.exr",
        "stand-in build scene.toml",
        "stand-in depth build/stand_in.ply",
        "render scene.toml --view",
        "report scene.toml -o",
    ]
    assert sorted(order, key=ran.index) == order
    assert ran[-1] == "report scene.toml -o"


def test_a_finished_scene_runs_nothing(made: Workshop) -> None:
    start = time.perf_counter()
    result = made.make()
    assert time.perf_counter() - start < 1
    assert made.ran() == []
    assert "Nothing to be done" in result.stdout


def test_a_touched_take_reruns_what_follows_it(made: Workshop) -> None:
    later(made.folder / "takes/plate/take.json")
    assert made.run() == [
        "hdr merge takes/plate",
        "render scene.toml --view",
        "report scene.toml -o",
    ]
    assert made.run() == []


@pytest.mark.parametrize(
    ("old", "new"),
    [("[0.1, 0.2, 0.3]", "[0.9, 0.2, 0.3]"), ("spp = 64", "spp = 65")],
)
def test_a_changed_material_or_sample_count_renders_alone(
    made: Workshop, old: str, new: str
) -> None:
    edit(made, old, new)
    ran = made.run()
    assert ran == ["plan", *["render scene.toml --view"] * 2, "report scene.toml -o"]
    assert made.run() == []


def test_one_changed_view_renders_alone(made: Workshop) -> None:
    edit(made, 'model = "equisolid"\n[render]', 'model = "equisolid"\nfov = 120\n[render]')
    assert made.run() == ["plan", "render scene.toml --view", "report scene.toml -o"]


def test_a_comment_reruns_nothing(made: Workshop) -> None:
    edit(made, 'name = "full"', '# a remark\nname = "full"  # another')
    assert made.run() == ["plan"]
    assert made.run() == []


def test_changed_times_retake_and_all_that_follows(made: Workshop) -> None:
    edit(made, "yaw = -180 }]", "yaw = -170 }]")
    ran = made.run()
    assert ran[:2] == ["plan", "envmap probe build/front.exr"]
    assert "envmap lights build/env.exr" in ran
    assert "hdr merge takes/front" not in ran
    assert "stand-in build scene.toml" in ran


def test_a_new_photograph_is_noticed(made: Workshop) -> None:
    time.sleep(0.02)
    photograph(made.folder, ("board_3.jpg",))
    ran = made.run()
    assert ran[:2] == ["plan", "calibrate lens photos/board_1.jpg"]
    assert "board_3.jpg" in (made.folder / "build/lens.cameramodel").read_text()
    assert made.run() == []


def test_a_lost_picture_is_rendered_again_once(made: Workshop) -> None:
    (made.folder / "build/main.png").unlink()
    assert made.run() == ["render scene.toml --view", "report scene.toml -o"]


def test_two_jobs_run_each_stage_once(workshop: Workshop) -> None:
    workshop.write(FULL)
    photograph(workshop.folder)
    ran = workshop.run("-j4")
    counts = {command: ran.count(command) for command in ALL}
    twice = {"acquire bracket --device", "render scene.toml --view"}
    assert counts == {command: 2 if command in twice else 1 for command in ALL}


def test_one_device_takes_one_bracket_at_a_time(workshop: Workshop) -> None:
    workshop.write(FULL)
    photograph(workshop.folder)
    workshop.env["SLOW"] = "0.2"
    workshop.make("-j4", "takes/front/take.json", "takes/back/take.json")
    front, back = (workshop.folder / f"takes/{n}/take.json" for n in ("front", "back"))
    assert back.stat().st_mtime - front.stat().st_mtime >= 0.15


def test_keep_going_makes_what_can_be_made(workshop: Workshop) -> None:
    workshop.write(FULL)
    photograph(workshop.folder)
    workshop.env["FAIL"] = "build/lens.cameramodel"
    result = workshop.make("-k", ok=False)
    assert result.returncode == 2
    assert "cannot make build/lens.cameramodel" in result.stderr
    assert (workshop.folder / "build/wide.exr").exists()
    assert not (workshop.folder / "build/main.exr").exists()
    assert not (workshop.folder / "report.html").exists()
    del workshop.env["FAIL"]
    assert "hdr merge takes/front" not in workshop.run()


def test_dry_run_and_touch_behave(made: Workshop) -> None:
    later(made.folder / "build/response.json")
    shown = made.make("-n").stdout
    assert "chromeball hdr merge takes/front --response build/response.json" in shown
    assert made.ran() == []
    made.make("-t")
    assert made.run() == []


def test_a_names_own_rule_may_make_pictures(workshop: Workshop) -> None:
    """Names without wildcards need not exist: a rule of the Makefile makes them."""
    workshop.write(FULL.replace("board_*", "board_1"))
    photograph(workshop.folder, ("p1.jpg", "p2.jpg"))
    with (workshop.folder / "Makefile").open("a") as file:
        file.write("photos/board_1.jpg:\n\ttouch $@\n")
    assert "calibrate lens photos/board_1.jpg" in workshop.run()


def test_missing_photograph_is_named(workshop: Workshop) -> None:
    workshop.write(FULL)
    photograph(workshop.folder, ("p1.jpg", "board_1.jpg"))
    result = workshop.make(ok=False)
    assert "photos/p2.jpg" in result.stderr


@pytest.mark.parametrize("name", ["a b.jpg", "a#b.jpg", "a$b.jpg", "a'b (1).jpg", "a:b&c.jpg"])
def test_odd_file_names_work(workshop: Workshop, name: str) -> None:
    workshop.write(FULL.replace("photos/p1.jpg", f"photos/{name}"))
    photograph(workshop.folder, (name, "p2.jpg", "board_1.jpg"))
    workshop.make()
    assert name in (workshop.folder / "takes/plate/take.json").read_text()
    assert workshop.run() == []
    later(workshop.folder / "photos" / name)
    assert workshop.run()[0].startswith("acquire import")


@pytest.mark.parametrize("name", ["a;b.jpg", "a=b.jpg", "a\\\\b.jpg", "a\\nb.jpg"])
def test_file_names_that_make_cannot_hold_are_refused(workshop: Workshop, name: str) -> None:
    workshop.write(FULL.replace("photos/p1.jpg", f"photos/{name}"))
    photograph(workshop.folder, ("p2.jpg", "board_1.jpg"))
    result = workshop.make(ok=False)
    assert result.returncode == 2
    assert "rename the file" in result.stderr
    assert not (workshop.folder / "pipeline.mk").exists()
