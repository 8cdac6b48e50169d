"""The records of a scene: one run of a stage each, found beside the files that it made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Scene

SUFFIX = ".record.json"


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What :class:`chromeball.scene.record.Stage` writes."""

    stage: str
    command: list[str]
    inputs: dict[str, str]
    outputs: list[str]
    figures: dict[str, Any]
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    finished: str
    options: dict[str, Any] = {}
    versions: dict[str, str] = {}


@dataclass(frozen=True)
class Run:
    """One run of a stage; ``files`` are the outputs beside which its record stands."""

    record: Record
    files: tuple[Path, ...]

    @property
    def folder(self) -> Path:
        """Where the names of pictures in the figures start from."""
        return self.files[0].parent

    @property
    def records(self) -> list[Path]:
        """The record files themselves."""
        return [path.with_name(path.name + SUFFIX) for path in self.files]


def find_runs(scene: Scene, root: Path) -> list[Run]:
    """Every run recorded in the scene's folder of made files and in its takes' folders.

    Raises
    ------
    UserError
        For a record that cannot be read.

    """
    takes = {bracket.take or f"takes/{bracket.name}" for bracket in scene.bracket}
    folders = [root / scene.folder, *(root / take for take in sorted(takes))]
    files = sorted({path for folder in folders for path in folder.rglob(f"*{SUFFIX}")})
    runs: dict[bytes, Run] = {}
    for path in files:
        record = _read(path)
        output = path.with_name(path.name.removesuffix(SUFFIX))
        # the outputs of one run each have a copy of its record
        key = msgspec.json.encode(record, order="sorted")
        known = runs.get(key)
        runs[key] = Run(record, (*(known.files if known else ()), output))
    return list(runs.values())


def _read(path: Path) -> Record:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Record)
    except (OSError, msgspec.DecodeError) as error:
        raise UserError(f"not a readable record: {error}", file=path) from error
