"""Synthetic camera RAW for the tests and benchmarks: a sensor with known noise, and DNG files.

The layout is that of the DNG specification 1.7 (Adobe 2023): an uncompressed 16-bit Bayer
mosaic in the first directory, EXIF in a second.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: XYZ to the RGB of a made-up camera, near to what common cameras have
MATRIX = ((0.65, -0.18, -0.06), (-0.47, 1.24, 0.25), (-0.09, 0.18, 0.60))
LETTERS = {"R": 0, "G": 1, "B": 2}

type Field = tuple[int, int, Sequence[int | float] | bytes]  # tag, type, values

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SRATIONAL, _DOUBLE = 1, 2, 3, 4, 5, 10, 12
_PACKING = {_BYTE: "B", _SHORT: "H", _LONG: "I", _DOUBLE: "d"}


@dataclass(frozen=True)
class Sensor:
    """A Bayer sensor: ``black`` and ``white`` codes, noise var x = a x + b, x of full scale."""

    pattern: str = "RGGB"
    black: tuple[int, int, int, int] = (512, 512, 512, 512)
    white: int = 15000
    noise: tuple[float, float] = (3.5e-6, 3.9e-9)
    neutral: tuple[float, float, float] = (0.45, 1.0, 0.65)

    def mosaic(self, rgb: NDArray[np.floating]) -> NDArray[np.floating]:
        """Of (H, W, 3) camera RGB the values that the pattern's pixels see, (H, W)."""
        out = np.empty(rgb.shape[:2], rgb.dtype)
        for k, letter in enumerate(self.pattern):
            out[k // 2 :: 2, k % 2 :: 2] = rgb[k // 2 :: 2, k % 2 :: 2, LETTERS[letter]]
        return out

    def expose(
        self, radiance: NDArray[np.floating], exposure: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Codes of a mosaic (H, W) of radiance: shot noise, read noise, full well, rounding."""
        a, b = self.noise
        x = rng.poisson(np.maximum(radiance * exposure, 0) / a) * a
        x = x + rng.normal(0, np.sqrt(b), x.shape)
        black = np.tile(np.reshape(self.black, (2, 2)), [-(-n // 2) for n in x.shape])[
            : x.shape[0], : x.shape[1]
        ]
        codes = np.round(black + x * (self.white - black))
        return np.clip(codes, 0, self.white).astype(np.uint16)


def write_dng(
    path: str | Path,
    codes: NDArray[np.uint16],
    sensor: Sensor,
    *,
    time: float | None = None,
    aperture: float | None = None,
    iso: int | None = None,
    noise_profile: bool = True,
    matrix: Sequence[Sequence[float]] | None = MATRIX,
    white: int | None = None,
    more: Sequence[Field] = (),
) -> None:
    """Write `codes` (H, W) as DNG.

    `white` is the metadata's, the sensor's own by default; `more` adds or replaces tags.
    """
    height, width = codes.shape
    exif: list[Field] = []
    if time is not None:
        exif.append((33434, _RATIONAL, [time]))
    if aperture is not None:
        exif.append((33437, _RATIONAL, [aperture]))
    if iso is not None:
        exif.append((34855, _SHORT, [iso]))
    fields: list[Field] = [
        (254, _LONG, [0]),
        (256, _LONG, [width]),
        (257, _LONG, [height]),
        (258, _SHORT, [16]),
        (259, _SHORT, [1]),
        (262, _SHORT, [32803]),
        (271, _ASCII, b"Chromeball\0"),
        (272, _ASCII, b"Virtual\0"),
        (274, _SHORT, [1]),
        (277, _SHORT, [1]),
        (278, _LONG, [height]),
        (279, _LONG, [codes.nbytes]),
        (284, _SHORT, [1]),
        (33421, _SHORT, [2, 2]),
        (33422, _BYTE, bytes(LETTERS[letter] for letter in sensor.pattern)),
        (50706, _BYTE, bytes([1, 4, 0, 0])),
        (50707, _BYTE, bytes([1, 1, 0, 0])),
        (50708, _ASCII, b"Chromeball Virtual\0"),
        (50710, _BYTE, bytes([0, 1, 2])),
        (50711, _SHORT, [1]),
        (50713, _SHORT, [2, 2]),
        (50714, _LONG, sensor.black),
        (50717, _LONG, [sensor.white if white is None else white]),
        (50728, _RATIONAL, sensor.neutral),
    ]
    if matrix is not None:
        fields += [(50721, _SRATIONAL, np.ravel(matrix).tolist()), (50778, _SHORT, [21])]
    if noise_profile:
        fields.append((51041, _DOUBLE, [*sensor.noise] * 3))
    given = {field[0] for field in more}
    fields = [*(field for field in fields if field[0] not in given), *more]
    # a directory's size does not depend on the offsets in it
    size = len(_directory([*fields, (34665, _LONG, [0]), (273, _LONG, [0])], 8))
    second = _directory(exif, 8 + size)
    places: list[Field] = [(34665, _LONG, [8 + size]), (273, _LONG, [8 + size + len(second)])]
    first = _directory([*fields, *places], 8)
    data = codes.astype("<u2").tobytes()
    Path(path).write_bytes(struct.pack("<2sHI", b"II", 42, 8) + first + second + data)


def write_bracket(
    folder: Path,
    radiance: NDArray[np.floating],
    times: Sequence[float],
    sensor: Sensor,
    *,
    seed: int = 0,
    gains: Mapping[int, float] | None = None,
) -> list[Path]:
    """DNGs of (H, W, 3) camera RGB, ``0.dng`` ..; `gains` multiply single frames' light."""
    rng = np.random.default_rng(seed)
    paths: list[Path] = []
    mosaic = sensor.mosaic(radiance)
    for number, time in enumerate(times):
        paths.append(folder / f"{number}.dng")
        light = time * (gains or {}).get(number, 1.0)
        codes = sensor.expose(mosaic, light, rng)
        write_dng(paths[-1], codes, sensor, time=time, aperture=4.0, iso=100)
    return paths


def _directory(fields: Sequence[Field], start: int) -> bytes:
    """One image file directory that begins at byte `start`, values behind it."""
    entries, behind = b"", b""
    fields = sorted(fields, key=lambda field: field[0])
    values_at = start + 2 + 12 * len(fields) + 4
    for tag, kind, values in fields:
        if isinstance(values, bytes):
            packed = values
        elif kind in (_RATIONAL, _SRATIONAL):
            pairs = [Fraction(v).limit_denominator(1_000_000) for v in values]
            form = "i" if kind == _SRATIONAL else "I"
            packed = b"".join(struct.pack(f"<2{form}", *f.as_integer_ratio()) for f in pairs)
        elif kind == _DOUBLE:
            packed = struct.pack(f"<{len(values)}d", *values)
        else:
            packed = struct.pack(f"<{len(values)}{_PACKING[kind]}", *(int(v) for v in values))
        entries += struct.pack("<HHI", tag, kind, len(values))
        if len(packed) <= 4:
            entries += packed.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", values_at + len(behind))
            behind += packed + b"\0" * (len(packed) % 2)
    return struct.pack("<H", len(fields)) + entries + struct.pack("<I", 0) + behind
