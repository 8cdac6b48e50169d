"""``take.json``: what a bracket's frames are, how long each was exposed, and how we know.

The file lies in the take's folder; pictures are named relative to it. It is written last and
whole, so a folder without one holds no take.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from chromeball.scene.errors import UserError
from chromeball.scene.record import decode

TAKE = "take.json"

type Seconds = Annotated[float, Meta(gt=0, le=1e6)]
type Positive = Annotated[float, Meta(gt=0, le=1e9)]
type Verdict = Literal["settled", "plateau", "unverified"]


class Settle(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How we know that a frame was exposed as its shutter time says.

    ``verdict``: ``settled``, its brightness agrees with the time; ``plateau``, it stands still
    at a brightness that does not, and ``measured_time`` is what the brightness says;
    ``unverified``, the pictures cannot tell (first frame of a bracket, too few usable pixels),
    and ``frames_waited`` alone speaks for it. ``ratio``: measured over expected exposure.
    """

    verdict: Verdict
    frames_waited: Annotated[int, Meta(ge=0)]
    ratio: Positive | None = None
    method: str


class TakeFrame(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One picture; times in seconds, ``None`` where nothing is known."""

    file: Annotated[str, Meta(min_length=1)]
    requested_time: Seconds | None = None
    read_back_time: Seconds | None = None
    measured_time: Seconds | None = None
    aperture: Positive | None = None
    iso: Positive | None = None
    gain: Positive | None = None
    device: str | None = None
    monotonic: float | None = None
    wall: str | None = None
    averaged: Annotated[int, Meta(ge=1)] = 1
    settle: Settle | None = None

    @property
    def time(self) -> float:
        """The exposure time to count with, in seconds.

        What the device read back, unless the pictures proved it wrong (a plateau).
        """
        plateau = self.settle is not None and self.settle.verdict == "plateau"
        order = (self.read_back_time, self.requested_time, self.measured_time)
        for time in (self.measured_time, *order) if plateau else order:
            if time is not None:
                return time
        raise UserError(f"{self.file} has no exposure time")


class TakeFile(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file as it is written."""

    version: Literal[1] = 1
    device: str | None = None
    video: str | None = None
    size: tuple[Annotated[int, Meta(gt=0)], Annotated[int, Meta(gt=0)]]
    frames: Annotated[list[TakeFrame], Meta(min_length=1)]


@dataclass(frozen=True)
class Exposed:
    """A picture, the time it was exposed for in seconds, and its row in the take."""

    path: Path
    time: float
    row: TakeFrame


@dataclass(frozen=True)
class Take:
    """A take as read: ``frames`` with absolute paths, ``size`` (width, height) in pixels."""

    path: Path
    frames: tuple[Exposed, ...]
    size: tuple[int, int]
    device: str | None = None
    video: str | None = None

    @property
    def paths(self) -> list[Path]:
        """The pictures, in the take's order."""
        return [frame.path for frame in self.frames]

    @property
    def times(self) -> list[float]:
        """Their exposure times in seconds."""
        return [frame.time for frame in self.frames]


def read_take(path: str | os.PathLike[str]) -> Take:
    """Read a take: its folder or its ``take.json``.

    Raises
    ------
    UserError
        No take there, not JSON, an unknown key or a wrong type (with its place), a picture
        that is missing or named twice.

    """
    file = take_path(path)
    try:
        data = file.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise UserError(
            "no such take; `acquire bracket` or `acquire import` makes one", file=file
        ) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=file) from error
    take = parse_take(data, file)
    for frame in take.frames:
        if not frame.path.is_file():
            raise UserError(
                f"the picture {frame.row.file} is missing; take the bracket again or remove "
                "its entry",
                file=file,
            )
    return take


def parse_take(data: bytes, path: str | os.PathLike[str] = TAKE) -> Take:
    """As :func:`read_take`, from the bytes; whether the pictures exist is not looked at."""
    file = Path(path)
    content = decode(data, TakeFile, file)
    folder = file.absolute().parent
    frames: list[Exposed] = []
    for row in content.frames:
        path = Path(os.path.normpath(folder / row.file))
        if any(path == frame.path for frame in frames):
            raise UserError(f"the picture {row.file} is listed twice", file=file)
        try:
            frames.append(Exposed(path, row.time, row))
        except UserError as error:
            raise UserError(error.what, file=file) from error
    return Take(file.absolute(), tuple(frames), content.size, content.device, content.video)


def encode_take(
    frames: Sequence[TakeFrame],
    size: tuple[int, int],
    *,
    device: str | None = None,
    video: str | None = None,
) -> bytes:
    """The bytes of a ``take.json``."""
    content = TakeFile(device=device, video=video, size=size, frames=list(frames))
    return msgspec.json.format(msgspec.json.encode(content), indent=1) + b"\n"


def take_path(path: str | os.PathLike[str]) -> Path:
    """The ``take.json`` of a take's folder; a path that ends in .json is taken as it is."""
    path = Path(path)
    return path if path.suffix == ".json" else path / TAKE


def row_summary(row: TakeFrame) -> dict[str, Any]:
    """A row as plain values, for records and ``--json``."""
    return {key: v for key, v in msgspec.to_builtins(row).items() if v is not None}
