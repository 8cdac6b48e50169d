"""A scene folder with a Makefile, and a `chromeball` that only touches what it should make."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.cli.scenes import FULL, photograph

MAKEFILE = """all:

include pipeline.mk

pipeline.mk: scene.toml
\tchromeball plan scene.toml --makefile
"""

# Logs its command, then writes what the named stage would: -o, and the PNG beside a render.
FAKE = """#!/bin/bash
set -e
if [ "$1" = plan ]; then
  echo plan >> "$LOG"
  exec "{python}" -c "from chromeball.cli import main; main()" "$@"
fi
if [ "$1" = emulate ]; then while [ "$1" != -- ]; do shift; done; shift 2; fi
printf '%s\\n' "$1 $2 $3" >> "$LOG"
out=; previous=
for word in "$@"; do
  if [ "$previous" = -o ]; then out=$word; fi
  previous=$word
done
if [ "$1" = acquire ]; then out=$out/take.json; fi
if [ -n "$FAIL" ] && [[ "$out" == $FAIL ]]; then echo "cannot make $out" >&2; exit 1; fi
if [ -n "$SLOW" ]; then sleep "$SLOW"; fi
[ -d "${{out%/*}}" ] || [ "${{out%/*}}" = "$out" ] || mkdir -p "${{out%/*}}"
echo "$@" > "$out"
if [ "$1" = render ]; then echo "$@" > "${{out%.exr}}.png"; fi
"""


@dataclass
class Workshop:
    """A scene folder that make can run in; `run` returns the stages that ran."""

    folder: Path
    binaries: Path
    log: Path
    env: dict[str, str] = field(default_factory=dict)

    def write(self, scene: str) -> None:
        (self.folder / "scene.toml").write_text(scene, encoding="utf-8")

    def make(self, *arguments: str, ok: bool = True) -> subprocess.CompletedProcess[str]:
        self.log.write_text("")
        env = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}
        env |= {"PATH": f"{self.binaries}:{env['PATH']}", "LOG": str(self.log)} | self.env
        result = subprocess.run(
            ["make", *arguments], cwd=self.folder, env=env, capture_output=True, text=True
        )
        if ok:
            assert result.returncode == 0, result.stderr
        return result

    def run(self, *arguments: str) -> list[str]:
        self.make(*arguments)
        return self.ran()

    def ran(self) -> list[str]:
        return self.log.read_text().splitlines()


def open_workshop(place: Path) -> Workshop:
    """A scene folder with the Makefile alone."""
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    folder, binaries = place / "scene", place / "bin"
    folder.mkdir()
    binaries.mkdir()
    (folder / "Makefile").write_text(MAKEFILE)
    fake = binaries / "chromeball"
    fake.write_text(FAKE.format(python=sys.executable))
    fake.chmod(0o755)
    return Workshop(folder, binaries, place / "log")


@pytest.fixture
def workshop(tmp_path: Path) -> Workshop:
    """A scene folder with the Makefile alone."""
    return open_workshop(tmp_path)


@pytest.fixture(scope="session")
def first_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """FULL made once, and what ran."""
    place = tmp_path_factory.mktemp("made")
    workshop = open_workshop(place)
    workshop.write(FULL)
    photograph(workshop.folder)
    return place, workshop.run()


@pytest.fixture
def made(first_run: tuple[Path, list[str]], tmp_path: Path) -> Workshop:
    """A copy, times of files included, of FULL made once."""
    place = tmp_path / "copy"
    shutil.copytree(first_run[0], place)
    return Workshop(place / "scene", place / "bin", place / "log")
