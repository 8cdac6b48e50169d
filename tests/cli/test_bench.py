"""The benchmark table, with invented bench modules."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from chromeball.bench.row import Row
from chromeball.cli.main import build_app
from chromeball.scene.errors import UserError

module = sys.modules.get("chromeball.cli.bench")
if module is None:
    import chromeball.cli.bench as module


def hdr_rows(quick: bool) -> list[Row]:
    time = 0.1 if quick else 1.0
    return [
        Row("hdr", "response", "OpenCV", 4.2, 0.05, "ln", "peer | of ours"),
        Row("hdr", "response", "chromeball", time, 0.01, "ln"),
        Row("hdr", "merge", "chromeball", 0.3, 0.0, "%"),
        Row("hdr", "merge", "OpenCV", 3.0, float("nan"), "%"),
    ]


@pytest.fixture
def benches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, object], None]:
    """Install a bench module of a name with a `rows`."""
    folder = tmp_path / "bench"
    folder.mkdir()
    monkeypatch.setattr(module, "BENCH", folder)
    monkeypatch.chdir(tmp_path)

    def install(name: str, rows: object) -> None:
        (folder / f"{name}.py").write_text("")
        invented = ModuleType(f"chromeball.bench.{name}")
        invented.rows = rows  # type: ignore[attr-defined]  # pyright: ignore[reportAttributeAccessIssue]
        monkeypatch.setitem(sys.modules, f"chromeball.bench.{name}", invented)

    return install


def run(*arguments: str) -> None:
    build_app()(["bench", *arguments], result_action="return_value")


def test_table_json_and_plots(
    benches: Callable[[str, object], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    benches("hdr", hdr_rows)
    benches("acquire", lambda quick: [Row("acquire", "settle", "chromeball", 0.5, 1.0, "f")])
    run()
    out, err = capsys.readouterr()
    assert out.index("acquire") < out.index("merge") < out.index("response")
    assert "not measured" in out
    for missing in ("envmap", "renderer", "calibrate", "stand_in"):
        assert f"{missing}: skipped, it has no benchmark yet" in err
    results = tmp_path / "bench-results"
    assert {p.name for p in results.iterdir()} == {
        "table.md",
        "table.json",
        "hdr.png",
    }
    assert (results / "hdr.png").read_bytes().startswith(b"\x89PNG")
    lines = (results / "table.md").read_text().splitlines()
    assert lines[2].startswith("| acquire | settle")
    assert "peer \\| of ours" in (results / "table.md").read_text()
    stored = json.loads((results / "table.json").read_text())
    assert [row["tool"] for row in stored["rows"]][1:3] == ["chromeball", "OpenCV"]
    assert stored["rows"][2]["error"] is None
    assert len(stored["skipped"]) == 4
    assert stored["quick"] is False


def test_quick_and_json_and_one_stage(
    benches: Callable[[str, object], None], capsys: pytest.CaptureFixture[str]
) -> None:
    benches("hdr", hdr_rows)
    benches("stand_in", lambda quick: pytest.fail("not asked for"))
    run("hdr", "--quick", "--json", "-o", "elsewhere")
    value = json.loads(capsys.readouterr().out)
    assert value["quick"] is True
    assert [r["cpu_seconds"] for r in value["rows"] if r["what"] == "response"] == [4.2, 0.1]
    assert "A quick run" in Path("elsewhere/table.md").read_text()


def test_absent_data_are_a_stated_skip(
    benches: Callable[[str, object], None], capsys: pytest.CaptureFixture[str]
) -> None:
    def rows(quick: bool) -> list[Row]:
        raise UserError("no such file", file="dorf.npz")

    benches("hdr", rows)
    benches("envmap", lambda quick: [])
    run("hdr", "envmap")
    err = capsys.readouterr().err
    assert "hdr: skipped, dorf.npz: no such file" in err
    assert "envmap: skipped, its benchmark found nothing to measure" in err


def test_a_broken_benchmark_is_not_hidden(benches: Callable[[str, object], None]) -> None:
    def rows(quick: bool) -> list[Row]:
        raise ZeroDivisionError

    benches("hdr", rows)
    with pytest.raises(ZeroDivisionError):
        run("hdr")
    assert not Path("bench-results").exists()


def test_a_stage_asked_for_must_exist(benches: Callable[[str, object], None]) -> None:
    with pytest.raises(UserError, match="there is no stage 'hrd' to measure; known: acquire"):
        run("hrd")
    with pytest.raises(UserError, match="stand-in has no benchmark yet"):
        run("stand-in")
