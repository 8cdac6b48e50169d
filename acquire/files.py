"""Photographs that already lie in a folder, as a take: nothing is copied."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from chromeball.acquire.take import (
    Take,
    TakeFrame,
    encode_take,
    parse_take,
    read_take,
    take_path,
)
from chromeball.scene.errors import UserError
from chromeball.scene.image import RAW_SUFFIXES, Exposure, read_exposure, read_size
from chromeball.scene.record import Stage

PICTURES = RAW_SUFFIXES | {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".hdr", ".pfm"}


def open_frames(sources: Sequence[str | os.PathLike[str]], times: Sequence[float] = ()) -> Take:
    """A take from what a command was given: one take (folder or file), or photographs.

    `times` in seconds, one a photograph, in place of the pictures' metadata. Photographs are
    checked and sorted as by :func:`photographs`.
    """
    if len(sources) == 1:
        path = Path(sources[0])
        if path.suffix == ".json" or take_path(path).is_file():
            if times:
                raise UserError("a take has its times; leave --times out", file=path)
            return read_take(path)
    return photographs(sources, times)


def photographs(
    sources: Sequence[str | os.PathLike[str]],
    times: Sequence[float] = (),
    *,
    path: str | os.PathLike[str] = "take.json",
) -> Take:
    """A take of photographs, sorted by exposure time, for a ``take.json`` at `path`.

    `sources`: pictures, or folders of pictures in the order of their names.

    Raises
    ------
    UserError
        A picture is missing or unreadable, has no exposure time, or another size, aperture or
        ISO speed than the first; all times are equal; not as many times as pictures.

    """
    pictures = _expand(sources)
    if len(pictures) < 2:
        raise UserError("a bracket needs at least two pictures")
    if times and len(times) != len(pictures):
        raise UserError(f"{len(pictures)} pictures, but {len(times)} exposure times")
    exposures = [read_exposure(picture) for picture in pictures]
    size = _common_size(pictures)
    given = bool(times)
    if not given:
        times = [_time(p, e) for p, e in zip(pictures, exposures, strict=True)]
        _check_constant(pictures, exposures)
    if max(times) <= min(times):
        raise UserError(
            f"all {len(pictures)} exposure times are {times[0]:g} s; a bracket needs at least "
            "two different ones",
            file=pictures[0],
        )
    folder = Path(path).absolute().parent
    rows = [
        TakeFrame(
            file=os.path.relpath(picture.absolute(), folder),
            requested_time=time if given else None,
            read_back_time=None if given else time,
            aperture=exposure.aperture,
            iso=exposure.iso,
            device=exposure.camera,
        )
        for picture, exposure, time in zip(pictures, exposures, times, strict=True)
    ]
    rows.sort(key=lambda row: (row.time, row.file))
    return parse_take(encode_take(rows, size), path)


def import_take(
    sources: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    times: Sequence[float] = (),
) -> Take:
    """Write the take of :func:`photographs` to `output`, a folder or a file ``*.json``."""
    file = take_path(output)
    take = photographs(sources, times, path=file)
    with Stage("acquire import", inputs=take.paths, times=list(times)) as stage:
        with stage.output(file) as temporary:
            temporary.write_bytes(encode_take([frame.row for frame in take.frames], take.size))
        stage.figures.update(
            frames=len(take.frames),
            shortest_s=min(take.times),
            longest_s=max(take.times),
            size=list(take.size),
        )
    return read_take(file)


def _expand(sources: Sequence[str | os.PathLike[str]]) -> list[Path]:
    pictures: list[Path] = []
    for source in map(Path, sources):
        if source.is_dir():
            inside = sorted(p for p in source.iterdir() if p.suffix.lower() in PICTURES)
            if not inside:
                raise UserError("no pictures in this folder", file=source)
            pictures += inside
        else:
            pictures.append(source)
    for i, picture in enumerate(pictures):
        if picture in pictures[:i]:
            raise UserError("this picture is given twice", file=picture)
    return pictures


def _common_size(pictures: Sequence[Path]) -> tuple[int, int]:
    size = read_size(pictures[0])
    for picture in pictures[1:]:
        if (other := read_size(picture)) != size:
            raise UserError(
                f"{other[0]}x{other[1]} pixels, but {pictures[0].name} has "
                f"{size[0]}x{size[1]}; the pictures of a bracket have one size",
                file=picture,
            )
    return size


def _time(picture: Path, exposure: Exposure) -> float:
    if exposure.time is None:
        raise UserError(
            "no exposure time in its metadata; give --times, one for each picture",
            file=picture,
        )
    return exposure.time


def _check_constant(pictures: Sequence[Path], exposures: Sequence[Exposure]) -> None:
    for name in ("aperture", "iso"):
        known = [
            (picture, value)
            for picture, exposure in zip(pictures, exposures, strict=True)
            if (value := getattr(exposure, name)) is not None
        ]
        for picture, value in known[1:]:
            if value != known[0][1]:
                raise UserError(
                    f"{name} {value:g}, but {known[0][0].name} has {known[0][1]:g}; only the "
                    "shutter may change (or give --times as equivalent times)",
                    file=picture,
                )
