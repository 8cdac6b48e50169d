"""What a bracket has captured so far, so that a run that broke off can be taken up again.

One JSON line a frame, after a first line that names the bracket. A frame counts only if its
picture still has the hash that the journal wrote down.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
from msgspec import Struct

from chromeball.acquire.take import TakeFrame
from chromeball.scene.record import content_hash, write_bytes

JOURNAL = "journal.jsonl"


class Bracket(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What two runs must have in common for one to take up the other's frames."""

    device: str
    video: str
    times: list[float]
    average: int
    curve: str


class _Line(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    row: TakeFrame
    hash: str


class Journal:
    """The journal of `bracket` in a take's `folder`; ``kept`` rows are an earlier run's."""

    def __init__(self, folder: Path, bracket: Bracket) -> None:
        self._path = folder / JOURNAL
        self._bracket = bracket
        self.kept = self._read()

    def append(self, row: TakeFrame) -> None:
        """Note a frame whose picture is on disk."""
        line = _Line(row=row, hash=content_hash(self._path.parent / row.file))
        with self._path.open("ab") as file:
            file.write(msgspec.json.encode(line) + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def begin(self) -> None:
        """Start over: forget what was kept."""
        self.kept = []
        write_bytes(self._path, msgspec.json.encode(self._bracket) + b"\n")

    def remove(self) -> None:
        """The take is whole; the journal has done its work."""
        self._path.unlink(missing_ok=True)

    def _read(self) -> list[TakeFrame]:
        """An earlier run's frames; none if it was of another bracket or its file is damaged."""
        try:
            head, *lines = self._path.read_bytes().split(b"\n")
            if msgspec.json.decode(head, type=Bracket) != self._bracket:
                return []
        except (OSError, msgspec.DecodeError):
            return []
        rows: list[TakeFrame] = []
        for line in lines:
            try:
                entry = msgspec.json.decode(line, type=_Line)
            except msgspec.DecodeError:
                break  # the run died while it wrote this line
            picture = self._path.parent / entry.row.file
            if not picture.is_file() or content_hash(picture) != entry.hash:
                break
            rows.append(entry.row)
        return rows
