"""Tags of TIFF, DNG and JPEG files by number: what OpenImageIO and LibRaw do not hand on.

Two are wanted: DNG's NoiseProfile, and Canon's ShotInfo (OpenImageIO 3.2 names its entries from
the 15th on one too early: its ``Canon:FNumber`` is the exposure time).
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

type Value = tuple[int | float, ...] | bytes

_CODES = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I"}
_TEXT, _RATIONAL, _UNDEFINED, _SRATIONAL = 2, 5, 7, 10
_SUB, _EXIF, _MAKER = 330, 34665, 37500
_NOISE_PROFILE, _SHOT_INFO, _MAKE = 51041, 4, 271
#: no file has more directories, and no tag that is wanted has more values
_DIRECTORIES, _VALUES = 64, 65536


@dataclass(frozen=True)
class Directory:
    """One image file directory: ``main``, ``sub``, ``exif`` or ``canon`` (its maker note)."""

    name: str
    tags: Mapping[int, Value]


def read_tags(path: str | os.PathLike[str]) -> list[Directory]:
    """All directories of a TIFF-like file, or of a JPEG's EXIF; none where there is none.

    Broken entries are left out: metadata that cannot be read are not there.

    Raises
    ------
    UserError
        When the file is missing.

    """
    path = Path(path)
    if not path.is_file():
        raise UserError("no such picture", file=path)
    if path.stat().st_size < 8:
        return []
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = _tiff_start(data)
        return [] if start is None else _directories(data, start)


def dng_noise_profile(path: str | os.PathLike[str]) -> NDArray[np.float64] | None:
    """(a, b) of var x = a x + b for red, green, blue, (3, 2), from a DNG's NoiseProfile.

    x is (code - black) / (white - black). None where the file has no such tag, or nonsense in
    it (DNG specification 1.7, 2023).
    """
    for directory in read_tags(path):
        values = directory.tags.get(_NOISE_PROFILE)
        if values is None or isinstance(values, bytes) or len(values) not in (2, 6):
            continue
        profile = np.broadcast_to(np.reshape(np.array(values, np.float64), (-1, 2)), (3, 2))
        if np.isfinite(profile).all() and (profile >= 0).all() and (profile.sum(1) > 0).all():
            return profile.copy()
    return None


@dataclass(frozen=True)
class Canon:
    """What Canon's maker note says of an exposure, None where it is silent.

    ``time`` (s) and ``aperture`` are the camera's own targets, in 1/32 EV and not rounded to
    the names on its dial; ``iso``; ``bracket`` the step of automatic bracketing in EV; ``nd``
    whether the neutral-density filter that is built into some was in.
    """

    time: float | None = None
    aperture: float | None = None
    iso: float | None = None
    bracket: float | None = None
    nd: bool | None = None


def read_canon(path: str | os.PathLike[str]) -> Canon | None:
    """Canon's ShotInfo (P. Harvey, ExifTool's table of it), None where there is none."""
    for directory in read_tags(path):
        info = directory.tags.get(_SHOT_INFO)
        if directory.name == "canon" and isinstance(info, tuple) and len(info) > 6:
            # stored unsigned, meant signed
            return _canon([int(v) - (65536 if v > 32767 else 0) for v in info])
    return None


def _canon(info: list[int]) -> Canon:
    def entry(index: int) -> int | None:
        return info[index] if index < len(info) else None

    def stops(index: int) -> float | None:
        value = entry(index)
        return None if value is None or abs(value) > 1024 else _ev(value)

    auto, base, aperture, time = (stops(k) for k in (1, 2, 4, 5))
    sound = aperture is not None and aperture > 0
    iso = None
    if auto is not None and base is not None and base > 0:
        iso = 2.0**auto * 2.0**base * 100 / 32
    flag = entry(28)
    return Canon(
        time=2.0**-time if time is not None and sound else None,  # both 0: not filled in
        aperture=2.0 ** (aperture / 2) if aperture is not None and sound else None,
        iso=iso,
        bracket=stops(17),
        nd={0: False, 1: True}.get(flag) if flag is not None else None,
    )


def _ev(value: int) -> float:
    """Canon's hexadecimal EV: 1/32 steps in which 12 and 20 stand for a third and two."""
    whole, part = divmod(abs(value), 32)
    thirds = {12: 32 / 3, 20: 64 / 3}
    return float(np.copysign(whole + thirds.get(part, part) / 32, value))


def _tiff_start(data: mmap.mmap) -> int | None:
    """Where the TIFF header is: at the front, or in the EXIF segment of a JPEG."""
    if data[:2] in (b"II", b"MM"):
        return 0
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 10 <= len(data) and data[at] == 0xFF and data[at + 1] not in (0xD9, 0xDA):
        size = int.from_bytes(data[at + 2 : at + 4])
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return at + 10
        at += 2 + size
    return None


def _directories(data: mmap.mmap, start: int) -> list[Directory]:
    order: Literal["<", ">"] = "<" if data[start : start + 2] == b"II" else ">"
    if data[start : start + 2] not in (b"II", b"MM") or len(data) < start + 8:
        return []
    found: list[Directory] = []
    waiting = [("main", struct.unpack_from(order + "I", data, start + 4)[0])]
    seen: set[int] = set()
    canon = False
    while waiting and len(found) < _DIRECTORIES:
        name, at = waiting.pop(0)
        if at in seen or at == 0:
            continue
        seen.add(at)
        tags, places, behind = _directory(data, start, at, order)
        found.append(Directory(name, tags))
        make = tags.get(_MAKE)
        canon |= isinstance(make, bytes) and make.startswith(b"Canon")
        if name == "main":
            waiting.append(("main", behind))
        for tag, kind in ((_SUB, "sub"), (_EXIF, "exif")):
            value = tags.get(tag, ())
            if not isinstance(value, bytes):
                waiting += [(kind, int(v)) for v in value[:16] if 0 < v < 2**32]
        if name == "exif" and canon and _MAKER in places:
            waiting.append(("canon", places[_MAKER]))
    return found


def _directory(
    data: mmap.mmap, start: int, at: int, order: Literal["<", ">"]
) -> tuple[dict[int, Value], dict[int, int], int]:
    """Tags, where their values lie, and the next directory; offsets count from `start`."""
    tags: dict[int, Value] = {}
    places: dict[int, int] = {}
    if start + at + 2 > len(data):
        return tags, places, 0
    (count,) = struct.unpack_from(order + "H", data, start + at)
    end = at + 2 + 12 * count
    if start + end > len(data):
        return tags, places, 0
    for entry in range(start + at + 2, start + end, 12):
        tag, kind, number = struct.unpack_from(order + "HHI", data, entry)
        code = "II" if kind == _RATIONAL else "ii" if kind == _SRATIONAL else _CODES.get(kind)
        text = kind in (_TEXT, _UNDEFINED)
        if number > (2**24 if text else _VALUES) or not (text or code):
            continue
        size = number * (1 if text or code is None else struct.calcsize("=" + code))
        place = entry + 8
        if size > 4:
            place = start + struct.unpack_from(order + "I", data, place)[0]
        if place + size > len(data):
            continue
        places[tag] = place - start
        if text or code is None:
            tags[tag] = data[place : place + min(size, _VALUES)]
            continue
        values = struct.unpack_from(order + code[0] * len(code) * number, data, place)
        if kind in (_RATIONAL, _SRATIONAL):
            pairs = zip(values[::2], values[1::2], strict=True)
            tags[tag] = tuple(n / d if d else float("nan") for n, d in pairs)
        else:
            tags[tag] = values
    behind = 0
    if start + end + 4 <= len(data):
        (behind,) = struct.unpack_from(order + "I", data, start + end)
    return tags, places, behind
