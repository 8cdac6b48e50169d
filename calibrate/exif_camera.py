"""A camera from what a picture's metadata say, with how little that is.

Three ways lead to a focal length in pixels: the focal length over the sensor's width; over the
pixels a millimetre that some cameras write; and the equivalent for 36 x 24 mm. Each has an
error from the rounding of its numbers and one of its kind, which are assumptions:

- A lens's marked focal length, or a zoom's reported one, holds to 2 %, typed or not.
- The lens is focused somewhere between a metre and infinity, which changes the image's size by
  up to f / (1 m - f); lenses that focus inside breathe by as much to either side.
- A sensor's nominal width is that of its active pixels to 1 %, typed or not. Compact cameras
  straighten their pictures and crop them, for which 5 % is allowed below four-thirds: a
  Panasonic TZ41's 4.3 mm on 1/2.3 inch come out 9 % short of what a panorama tells.
- FocalPlaneXResolution to 3 %: a Canon 5D Mark II and a 550D write widths of 37.06 and 22.99 mm
  for sensors of 36.0 and 22.3.
- Equivalents hold to 3 %: the same camera's 25 mm is 5 % short, a Kodak Z612's 35 mm 1 %.
- They are by the diagonal (CIPA DCG-001) or by the width; for pictures that are not 3:2
  the two differ, by 4 % at 4:3, and half of that counts.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import positive, read_header

#: Widths and heights of sensors' active areas, mm.
FORMATS: Mapping[str, tuple[float, float]] = {
    "medium": (43.8, 32.9),
    "full-frame": (36.0, 24.0),
    "aps-h": (27.9, 18.6),
    "aps-c": (23.5, 15.6),
    "aps-c-canon": (22.3, 14.9),
    "four-thirds": (17.3, 13.0),
    "1in": (13.2, 8.8),
    "2/3in": (8.8, 6.6),
    "1/1.7in": (7.6, 5.7),
    "1/1.8in": (7.18, 5.32),
    "1/2.3in": (6.17, 4.55),
    "1/2.5in": (5.76, 4.29),
    "1/2.55in": (5.64, 4.23),
    "1/3in": (4.8, 3.6),
}
#: Model names, as metadata write them -> format. Families whose members share one.
MODELS: tuple[tuple[str, str], ...] = (
    (r"Canon EOS (5D|5DS|6D|R|RP|R3|R5|R6|R8|Ra|1D X|1D ?C|1Ds)\b.*", "full-frame"),
    (r"Canon EOS 1D\b.*", "aps-h"),
    (r"Canon EOS (M\d*|R7|R10|R50|R100|[789]0D|7D|\d0D|\d{3,4}D|REBEL|DIGITAL REBEL|Kiss)\b.*",
     "aps-c-canon"),
    (r"NIKON (D[3456]|D600|D610|D7[058]0|D8[0-9]0[AE]?|D850|Z ?[5-9].*)", "full-frame"),
    (r"NIKON (D\d{2}|D[35]\d00|D7[0-9]00|D[12].*|D300S?|D500|Z ?(30|50).*|Z ?fc)", "aps-c"),
    (r"ILCE-(7|9|1)(?!\d{3}).*", "full-frame"),
    (r"ILCE-(5|6)\d{3}.*|NEX-.*|SLT-A(33|35|37|55|57|58|65|77).*", "aps-c"),
    (r"X-(T|E|Pro|H|S|M|A)\d.*|X100.*", "aps-c"),
    (r"GFX.*", "medium"),
    (r"(E-[MP]\w*|OM-\w+|DMC-G\w*|DC-G\w*|E-\d+).*", "four-thirds"),
    (r"DSC-RX100.*|DSC-RX10.*|DMC-LX100.*", "1in"),
)  # fmt: skip

MARKED, ACTIVE, RESOLUTION, EQUIVALENT = 0.02, 0.01, 0.03, 0.03
#: Sensors narrower than this (mm) are compact cameras', whose pictures are straightened.
COMPACT, STRAIGHTENED = 17.0, 0.05
NEAREST = 1000.0
#: Canon's 5200 mm f/14, the longest lens that was sold for cameras.
LONGEST = 5200.0
#: A principal point lies this share of the width from the middle (1 sigma).
CENTRE = 0.01
#: Aspects that differ by more mean that the picture was cropped.
CROP = 0.02
#: Fields of view beyond this are a fisheye's, of which metadata do not tell the projection.
WIDEST = math.radians(112)


@dataclass(frozen=True)
class Clue:
    """One way to the focal length: pixels, its relative standard error, and in words."""

    focal: float
    error: float
    how: str


@dataclass(frozen=True)
class ExifCamera:
    """A pinhole ``camera``; ``focal_error`` relative, ``centre_error`` pixels (1 sigma).

    ``clues`` the most certain first, which the camera is; ``notes`` what is odd.
    """

    camera: CameraModel
    focal_error: float
    centre_error: float
    clues: tuple[Clue, ...]
    notes: tuple[str, ...]

    @property
    def fov(self) -> float:
        """Horizontal field of view, radians."""
        return 2 * math.atan(self.camera.size[0] / (2 * self.camera.intrinsics[0]))


def camera_from_exif(
    path: str | os.PathLike[str], sensor: str | None = None, focal: float | None = None
) -> ExifCamera:
    """The camera by a picture's metadata; `sensor` and `focal` (mm) go before them.

    `sensor` is one of :data:`FORMATS`, or a width in mm. Lens distortion is not in metadata.

    Raises
    ------
    UserError
        When the metadata do not tell a focal length, or tell a fisheye's.

    """
    header = read_header(path)
    try:
        return from_attributes(header.attributes, header.size, sensor, focal)
    except UserError as error:
        raise UserError(error.what, file=path) from error


def from_attributes(
    attributes: Mapping[str, Any],
    size: tuple[int, int],
    sensor: str | None = None,
    focal: float | None = None,
) -> ExifCamera:
    """As :func:`camera_from_exif`, from OpenImageIO's attributes and the picture's size.

    Raises
    ------
    UserError
        When they do not tell a focal length, or tell a fisheye's.

    """
    known = {str(k).rpartition(":")[2]: v for k, v in attributes.items()}
    notes: list[str] = []
    lens = str(known.get("LensModel", ""))
    if re.search("fish.?eye", lens, re.IGNORECASE):
        raise UserError(
            f"its lens is a fisheye ({lens}): metadata do not tell the projection; calibrate it"
        )
    written = positive(known.get("FocalLength"))
    marked = written if focal is None else focal
    if marked is not None and not 0 < marked <= LONGEST:
        said = "its metadata tell" if focal is None else "--focal says"
        raise UserError(
            f"{said} {marked:g} mm: no lens has that, the longest is one of {LONGEST:g} mm; "
            "give the focal length engraved on the lens with --focal"
        )
    if focal is not None and written is not None and (
        abs(math.log(focal / written)) > 2 * math.hypot(MARKED, _marked_error(written))
    ):  # fmt: skip
        notes.append(f"its metadata tell {written:g} mm: --focal {focal:g} goes before them")
    equivalent = None if focal is not None else positive(known.get("FocalLengthIn35mmFilm"))
    zoom = positive(known.get("DigitalZoomRatio"))
    zoomed = zoom is not None and zoom > 1.001
    if zoomed:
        notes.append(f"a digital zoom of {zoom:g} is counted")
    body, nominal = _sensor(sensor, str(known.get("Model", "")))
    crop, cropped = _crop(known, size, body, notes)
    clues: list[Clue] = []
    long_side = max(size)
    if marked is not None:
        own = _marked_error(marked)
        scale = (zoom or 1.0) if zoomed else 1.0
        if body is not None:
            error = math.hypot(own, nominal, cropped)
            clues.append(
                Clue(marked / body[0] * long_side * scale, error,
                     f"{marked:g} mm on a sensor of {body[0]:g} mm")
            )  # fmt: skip
        width = _written_width(known, size)
        if width is not None and 3.0 <= width <= 60.0:
            error = math.hypot(own, RESOLUTION, cropped)
            clues.append(
                Clue(marked / width * long_side * scale, error,
                     f"{marked:g} mm on {width:.2f} mm, by FocalPlaneXResolution")
            )  # fmt: skip
        elif width is not None:
            notes.append(
                f"FocalPlaneXResolution would make the sensor {width:.1f} mm wide: not used"
            )
    if equivalent is not None:
        clues.append(_by_equivalent(equivalent, marked, size, cropped))
    if not clues:
        raise UserError(
            "its metadata tell no focal length: give --sensor and --focal, or calibrate it"
            if marked is None
            else f"its metadata tell {marked:g} mm, but not the sensor: give --sensor, one of "
            f"{', '.join(FORMATS)}, or a width in mm"
        )
    clues.sort(key=lambda clue: clue.error)
    best = clues[0]
    error = best.error
    for clue in clues[1:]:
        apart = abs(math.log(clue.focal / best.focal))
        if apart > 2 * math.hypot(clue.error, best.error):
            notes.append(
                f"{clue.how} would be {clue.focal:.0f} px, {apart:.0%} off: one is wrong"
            )
            error = max(error, apart)
    if crop:
        notes.append(crop)
    width, height = size
    if 2 * math.atan(width / (2 * best.focal)) > WIDEST:
        raise UserError(
            f"{best.how} sees {math.degrees(2 * math.atan(width / (2 * best.focal))):.0f} "
            "degrees, which is a fisheye's: metadata do not tell the projection; calibrate it"
        )
    values = np.array([best.focal, best.focal, (width - 1) / 2, (height - 1) / 2])
    centre = (0.1 if crop else CENTRE) * width
    return ExifCamera(
        CameraModel("pinhole", values, size), error, centre, tuple(clues), tuple(notes)
    )


def _sensor(sensor: str | None, model: str) -> tuple[tuple[float, float] | None, float]:
    """Width and height in mm, and the relative error of the width."""
    if sensor is not None:
        if sensor in FORMATS:
            return FORMATS[sensor], _active(FORMATS[sensor][0])
        try:
            width = float(sensor)
        except ValueError as error:
            raise UserError(
                f"--sensor {sensor!r}: a width in mm, or one of {', '.join(FORMATS)}"
            ) from error
        if not 0.5 <= width <= 200:
            raise UserError(f"--sensor {sensor}: no sensor is {width:g} mm wide")
        return (width, math.nan), _active(width)
    for pattern, name in MODELS:
        if re.fullmatch(pattern, model.strip(), re.IGNORECASE):
            return FORMATS[name], _active(FORMATS[name][0])
    return None, ACTIVE


def _active(width: float) -> float:
    return STRAIGHTENED if width < COMPACT else ACTIVE


def _crop(
    known: Mapping[str, Any],
    size: tuple[int, int],
    body: tuple[float, float] | None,
    notes: list[str],
) -> tuple[str, float]:
    """What speaks for a crop, in words, and the relative error of the focal length from it.

    Of a picture narrower or wider than its sensor the long side may have been cut or not: the
    aspects' ratio is between none and all of it, uniformly.
    """
    aspect = max(size) / min(size)
    full = positive(known.get("PixelXDimension")), positive(known.get("PixelYDimension"))
    truth = None
    if full[0] is not None and full[1] is not None:
        truth = max(full[0], full[1]) / min(full[0], full[1])
        if abs(math.log(truth / aspect)) <= CROP and full[0] < max(size) - 1:
            notes.append("the picture was enlarged since it was taken")
    if body is not None and math.isfinite(body[1]):
        of_body = body[0] / body[1]
        if truth is None or abs(math.log(of_body / aspect)) > abs(math.log(truth / aspect)):
            truth = of_body
    if truth is None or abs(math.log(truth / aspect)) <= CROP:
        return "", 0.0
    apart = abs(math.log(truth / aspect))
    return (
        f"the picture is {aspect:.3f}:1, the camera's {truth:.3f}:1: it was cropped, and where "
        "is not known",
        apart / math.sqrt(3) if aspect < truth else apart / math.sqrt(12),
    )


def _marked_error(marked: float) -> float:
    """Of a focal length in mm as metadata write it: marking, rounding, focus."""
    digits = Decimal(f"{marked:.6g}").normalize().as_tuple().exponent
    step = 10.0 ** min(int(digits), 0)  # 50.0 is written by cameras that count whole mm
    focus = marked / (NEAREST - marked) if marked < NEAREST / 2 else 1.0
    return math.hypot(MARKED, step / math.sqrt(12) / marked, focus / math.sqrt(3))


def _written_width(known: Mapping[str, Any], size: tuple[int, int]) -> float | None:
    """The sensor's long side in mm by FocalPlaneXResolution."""
    resolution = positive(known.get("FocalPlaneXResolution"))
    if resolution is None:
        return None
    unit = {3: 10.0, 4: 1.0, 5: 1e-3}.get(int(known.get("FocalPlaneResolutionUnit", 2)), 25.4)
    whole = positive(known.get("PixelXDimension")) or float(size[0])
    tall = positive(known.get("PixelYDimension")) or float(size[1])
    return max(whole, tall) / resolution * unit


def _by_equivalent(
    equivalent: float, marked: float | None, size: tuple[int, int], cropped: float
) -> Clue:
    diagonal = math.hypot(*size)
    by_diagonal = equivalent / math.hypot(36, 24) * diagonal
    by_width = equivalent / 36 * max(size)
    definition = abs(math.log(by_diagonal / by_width)) / 2
    focus = 0.0 if marked is None else marked / (NEAREST - min(marked, NEAREST / 2))
    error = math.hypot(
        1 / math.sqrt(12) / equivalent, EQUIVALENT, definition, focus / math.sqrt(3), cropped
    )
    return Clue(by_diagonal, error, f"{equivalent:g} mm at 36 x 24 mm, by the diagonal")
