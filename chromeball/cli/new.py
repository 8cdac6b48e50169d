"""``chromeball new`` and ``chromeball demo``: scene folders from the examples."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.scene.errors import UserError
from chromeball.scene.record import write_bytes

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
QUICK = "quick.toml"
_PLACEHOLDER = re.compile(r"\{\{(\w+)(?:\|(.*?))?\}\}")


class MakeError(UserError):
    """A stage failed; it has said why."""

    exit_code = 1


def new(
    folder: Path,
    /,
    *,
    example: str = "blank",
    values: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
    if_absent: Annotated[bool, Parameter(negative="")] = False,
) -> None:
    """Make a scene folder with scene.toml and Makefile from an example.

    Parameters
    ----------
    folder
        The folder to make.
    example
        Which example: blank, atrium, office.
    values
        key=value for a placeholder of the example; data=FOLDER is made absolute.
    if_absent
        Keep the files of a folder that is already there; add only what is missing.

    """
    written = copy_example(folder, example, _parse(values or []), if_absent=if_absent)
    print(f"{folder}: {', '.join(written) if written else 'kept as it is'}", file=sys.stderr)


def demo(
    *,
    folder: Path | None = None,
    quick: Annotated[bool, Parameter(negative="")] = False,
) -> None:
    """Photograph the virtual set, run every stage on it, and print what came out.

    Parameters
    ----------
    folder
        Where to work: demo, or demo-quick for a quick one.
    quick
        Fewer samples: a look at the pipeline, not at its accuracy.

    """
    start = time.perf_counter()
    folder = folder or Path("demo-quick" if quick else "demo")
    values = quick_values("atrium") if quick else {}
    if not copy_example(folder, "atrium", values, if_absent=True):
        print(f"{folder} is there already and is used as it is", file=sys.stderr)
    make(folder)
    from chromeball.cli.report.figures import summary

    print(summary(folder / "scene.toml"))
    print(f"\n{time.perf_counter() - start:.1f} s in all")


def make(folder: Path) -> None:
    """Run make in `folder`, this very chromeball and Python first on the PATH.

    Raises
    ------
    UserError
        When make is missing or a rule of it fails; what failed has then been said.

    """
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    # flags of a make that we run under are not meant for this one
    without = ("MAKEFLAGS", "MAKELEVEL", "MFLAGS")
    environment = {k: v for k, v in os.environ.items() if k not in without} | {"PATH": path}
    command = ["make", "--no-print-directory", "-j2", "-C", str(folder)]
    try:
        result = subprocess.run(command, env=environment, stdout=sys.stderr, check=False)
    except FileNotFoundError as error:
        raise UserError("make is not installed; run: apt-get install make") from error
    if result.returncode:
        raise MakeError("make stopped at the error above; mend it and run again", file=folder)


def copy_example(
    folder: Path, example: str, values: Mapping[str, str], *, if_absent: bool = False
) -> list[str]:
    """Copy an example's files, placeholders filled in; returns the names written.

    ``{{key}}`` in a text file is replaced by the value of `key`; ``{{key|default}}`` may go
    without one. Python files stay in the package.

    Raises
    ------
    UserError
        For an unknown example or key, a key without value, a value that TOML cannot hold, or
        a folder that is not empty (unless `if_absent`).

    """
    source = EXAMPLES / example
    if not re.fullmatch(r"\w+", example) or not (source / "scene.toml").is_file():
        raise UserError(f"there is no example {example!r}; known: {', '.join(examples())}")
    if folder.exists() and not folder.is_dir():
        raise UserError("not a folder", file=folder)
    if not if_absent and folder.exists() and any(folder.iterdir()):
        raise UserError("not empty; name a new folder, or add --if-absent", file=folder)
    contents = {path: path.read_bytes() for path in _files(source)}
    known = {
        key: default
        for content in contents.values()
        for key, default in _PLACEHOLDER.findall(content.decode("utf-8", "ignore"))
    }
    filled = {key: _checked(key, value) for key, value in values.items()}
    for key in filled:
        if key not in known:
            raise UserError(
                f"--set {key}: {example} has no such placeholder; "
                f"known: {', '.join(sorted(known)) or 'none'}"
            )
    written: list[str] = []
    made = {path: _fill(content, filled, example, known) for path, content in contents.items()}
    for path, content in made.items():
        target = folder / path.relative_to(source)
        if not target.exists():
            write_bytes(target, content)
            written.append(str(path.relative_to(source)))
    return written


def examples() -> list[str]:
    """The examples that can be copied."""
    return sorted(path.parent.name for path in EXAMPLES.glob("*/scene.toml"))


def quick_values(example: str) -> dict[str, str]:
    """Placeholder values for a quick run, from the example's ``quick.toml``."""
    path = EXAMPLES / example / QUICK
    return {key: str(value) for key, value in tomllib.loads(path.read_text()).items()}


def _files(source: Path) -> list[Path]:
    return sorted(
        path
        for path in source.rglob("*")
        if path.is_file()
        and path.suffix not in {".py", ".pyc", ".pyi"}
        and path.name != QUICK
        and "__pycache__" not in path.parts
    )


def _fill(
    content: bytes, values: Mapping[str, str], example: str, known: Mapping[str, str]
) -> bytes:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return content  # a picture

    def value(match: re.Match[str]) -> str:
        key, default = match[1], match[2]
        if key not in values and default is None:
            raise UserError(
                f"{example} needs --set {key}=...; its keys: {', '.join(sorted(known))}"
            )
        return values.get(key, default)

    return _PLACEHOLDER.sub(value, text).encode()


def _parse(settings: Sequence[str]) -> dict[str, str]:
    values: dict[str, str] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or not key:
            raise UserError(f"--set {setting!r}: write key=value")
        if key in values:
            raise UserError(f"--set {key} is given twice")
        values[key] = value
    return values


def _checked(key: str, value: str) -> str:
    if key == "data":
        path = Path(value).expanduser()
        if not path.exists():
            raise UserError(
                "no such folder; give the photographs' with --set data=...", file=path
            )
        value = str(path.resolve())
        if re.search(r"[*?\[]", value):
            raise UserError("its name would be taken for a pattern: rename it", file=value)
    if re.search(r'["\\\x00-\x1f\x7f]', value):
        raise UserError(f"--set {key}: quotes, backslashes and line ends cannot be used here")
    return value
