"""The command as a user calls it: exit codes, one-line errors, a quick overview."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from chromeball.cli.main import COMMANDS, GROUPS, build_app
from chromeball.scene.errors import DeviceError, QualityError, UserError

module = sys.modules["chromeball.cli.main"]  # its function of that name hides it
BINARY = Path(sys.executable).parent / "chromeball"


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(BINARY), *arguments], capture_output=True, text=True, check=False, timeout=60
    )


def test_overview_names_every_command_and_imports_no_parser() -> None:
    result = call("--help")
    assert result.returncode == 0
    for name in (*COMMANDS, *GROUPS):
        assert f"  {name}" in result.stdout
    assert call().stdout == result.stdout
    code = (
        "import sys; sys.argv = ['chromeball', '--help']\n"
        "from chromeball.cli import main; main()\n"
        "assert not {'cyclopts', 'numpy', 'rich', 'msgspec'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_version() -> None:
    result = call("--version")
    assert (result.returncode, result.stdout) == (0, version("chromeball") + "\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["plna"], "chromeball: there is no command 'plna'; did you mean 'plan'?\n"),
        (["xyzzy"], "chromeball: there is no command 'xyzzy'; see chromeball --help\n"),
        (["plan"], "chromeball: Command"),
        (["plan", "s.toml", "--nope"], "chromeball: Unknown option: "),
        (
            ["plan", "no/such/scene.toml"],
            "chromeball: no/such/scene.toml: no such scene file\n",
        ),
        (
            ["envmap", "sun", "env.exr", "--meter", "nan", "-o", "out.exr"],
            'chromeball: Invalid value "nan" for --meter',
        ),
        (
            ["envmap", "sun", "env.exr", "--meter", "5", "-o", "out.png"],
            "chromeball: out.png: this is written as .exr",
        ),
        (["bench", "hrd"], "chromeball: there is no stage 'hrd' to measure"),
    ],
)
def test_mistakes_of_usage_are_one_line_and_exit_2(arguments: list[str], message: str) -> None:
    result = call(*arguments)
    assert result.returncode == 2
    assert result.stderr.startswith(message)
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UserError("no good", file="a.png"), 2),
        (DeviceError("it is silent"), 1),
        (QualityError("too coarse"), 3),
        (UserError("two\nlines"), 2),
    ],
)
def test_errors_have_their_exit_codes(
    error: UserError,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(arguments: list[str]) -> None:
        raise error

    monkeypatch.setattr(module, "_run", fail)
    monkeypatch.setattr(sys, "argv", ["chromeball", "plan", "x"])
    with pytest.raises(SystemExit) as caught:
        module.main()
    assert caught.value.code == code
    err = capsys.readouterr().err
    assert err == f"chromeball: {' '.join(str(error).split())}\n"


def test_our_own_fault_keeps_its_traceback_and_exits_1() -> None:
    code = (
        "import sys; sys.argv = ['chromeball', 'plan', 'x.toml']\n"
        "import chromeball.cli.plan as plan\n"
        "def broken(path): raise ZeroDivisionError('ours')\n"
        "plan.read_scene = broken\n"
        "from chromeball.cli import main; main()"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 1
    assert "Traceback" in result.stderr
    assert "ZeroDivisionError: ours" in result.stderr


def test_an_import_error_within_a_group_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(module.GROUPS, "hdr", ("chromeball.cli.no_such_module", "Nothing."))
    app = build_app()
    with pytest.raises(ImportError, match="no_such_module"):
        app(["hdr", "merge"], exit_on_error=False)


def test_the_root_help_imports_no_group(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(module.GROUPS, "hdr", ("chromeball.cli.no_such_module", "Nothing."))
    build_app()(["--help"], result_action="return_value")
    assert "hdr" in capsys.readouterr().out


def test_a_reader_that_goes_away_is_no_traceback() -> None:
    read, write = os.pipe()
    os.close(read)
    process = subprocess.run([str(BINARY), "--help"], stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert process.returncode == 141
    assert process.stderr == b""
