"""Scene folders from examples, and their placeholders."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from chromeball.cli import new as module
from chromeball.cli.main import build_app
from chromeball.cli.new import MakeError, copy_example, examples, make, quick_values
from chromeball.cli.stages import stages
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import read_scene


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    source = tmp_path / "examples/toy"
    (source / "photos").mkdir(parents=True)
    (source / "scene.toml").write_text('name = "{{name}}"\nx = {{spp|64}}  # {{spp|64}}\n')
    (source / "Makefile").write_text("all:\n\techo {{data}} $@\n")
    (source / "room.py").write_text("x = '{{unknown}}'")
    (source / "quick.toml").write_text("spp = 4\n")
    (source / "photos/dot.png").write_bytes(b"\x89PNG\xff\x00{{name}}")
    monkeypatch.setattr(module, "EXAMPLES", tmp_path / "examples")
    return source


def run(*arguments: str) -> None:
    build_app()(list(arguments), result_action="return_value")


def test_placeholders_are_filled_and_python_stays(example: Path, tmp_path: Path) -> None:
    folder = tmp_path / "made"
    data = tmp_path / "photographs"
    data.mkdir()
    run("new", str(folder), "--example", "toy", "--set", "name=hi", "--set", f"data={data}/.")
    assert (folder / "scene.toml").read_text() == 'name = "hi"\nx = 64  # 64\n'
    assert (folder / "Makefile").read_text() == f"all:\n\techo {data} $@\n"
    assert (folder / "photos/dot.png").read_bytes() == b"\x89PNG\xff\x00{{name}}"
    assert not (folder / "room.py").exists()
    assert not (folder / "quick.toml").exists()


def test_data_is_made_absolute(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(example)
    run("new", str(tmp_path / "made"), "--example", "toy", "--set", "name=a", "--set", "data=.")
    assert f"echo {example} $@" in (tmp_path / "made/Makefile").read_text()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["name=a"], r"toy needs --set data=\.\.\.; its keys: data, name, spp"),
        (
            ["name=a", "data=.", "nmae=b"],
            "nmae: toy has no such placeholder; known: data, name",
        ),
        (["name"], "write key=value"),
        (["name=a", "name=b"], "name is given twice"),
        (["name=a", "data=/no/such/folder"], "/no/such/folder: no such folder"),
        (['name=a"b', "data=."], "quotes, backslashes and line ends"),
        (["name=a\nb", "data=."], "quotes, backslashes and line ends"),
    ],
)
def test_wrong_settings_are_one_clear_error(
    example: Path, tmp_path: Path, settings: list[str], message: str
) -> None:
    arguments = [part for setting in settings for part in ("--set", setting)]
    with pytest.raises(UserError, match=message):
        run("new", str(tmp_path / "made"), "--example", "toy", *arguments)
    assert not (tmp_path / "made").exists()


def test_unknown_example_names_the_known(example: Path, tmp_path: Path) -> None:
    for name in ("tyo", "../toy", ""):
        with pytest.raises(UserError, match="known: toy"):
            copy_example(tmp_path / "made", name, {})


def test_a_folder_in_use_is_left_alone(example: Path, tmp_path: Path) -> None:
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / "scene.toml").write_text("mine")
    values = {"name": "a", "data": "."}
    with pytest.raises(UserError, match="not empty; name a new folder, or add --if-absent"):
        copy_example(folder, "toy", values)
    assert sorted(path.name for path in folder.iterdir()) == ["scene.toml"]
    written = copy_example(folder, "toy", values, if_absent=True)
    assert written == ["Makefile", "photos/dot.png"]
    assert (folder / "scene.toml").read_text() == "mine"
    assert copy_example(folder, "toy", values, if_absent=True) == []


def test_a_file_in_place_of_the_folder(example: Path, tmp_path: Path) -> None:
    (tmp_path / "made").write_text("")
    with pytest.raises(UserError, match="not a folder"):
        copy_example(tmp_path / "made", "toy", {"name": "a", "data": "."})


def test_the_examples_that_ship_are_scenes(tmp_path: Path) -> None:
    assert {"atrium", "blank", "office"} <= set(examples())
    for name in examples():
        folder = tmp_path / name
        copy_example(folder, name, {"data": str(tmp_path)} if name == "office" else {})
        assert read_scene(folder / "scene.toml").name
        assert "include pipeline.mk" in (folder / "Makefile").read_text()


def test_the_blank_example_is_a_whole_pipeline(tmp_path: Path) -> None:
    folder = tmp_path / "made"
    copy_example(folder, "blank", {"name": "garden"})
    for kind in ("probe", "plate", "board"):
        (folder / "photographs" / kind).mkdir(parents=True)
        for name in ("1.jpg", "2.jpg"):
            (folder / "photographs" / kind / name).write_bytes(b"")
    path = folder / "scene.toml"
    plan = stages(read_scene(path), path)
    skipped = {stage.name for stage in plan if not stage.needed}
    assert skipped == {"envmap sun", "envmap harmonics", "envmap prefilter"}


def test_quick_values_are_placeholders_of_the_atrium(tmp_path: Path) -> None:
    values = quick_values("atrium")
    assert values
    copy_example(tmp_path / "made", "atrium", values)


def test_make_says_where_it_stopped(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "Makefile").write_text(
        "all:\n\t@command -v chromeball; echo it broke; exit 3\n"
    )
    with pytest.raises(MakeError, match="make stopped at the error above") as caught:
        make(tmp_path)
    assert caught.value.exit_code == 1
    out, err = capfd.readouterr()
    assert out == ""
    assert "it broke" in err
    import sys

    assert str(Path(sys.executable).parent / "chromeball") in err


def test_help_of_the_command_names_its_options() -> None:
    import sys

    binary = Path(sys.executable).parent / "chromeball"
    result = subprocess.run([binary, "new", "--help"], capture_output=True, text=True)
    assert result.returncode == 0
    for option in ("--example", "--set", "--if-absent"):
        assert option in result.stdout
