"""What ``--vignetting`` takes: numbers, a ``vignette.json``, HDRICalibrationTool's ``.cal``."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

from chromeball.scene.errors import UserError
from chromeball.scene.vignette import Given, read_vignette


def read_given(text: str, what: str = "--vignetting") -> Given:
    """What an option says: ``c1,c2,...``, a ``vignette.json``, or a ``.cal`` file.

    The last are HDRICalibrationTool's polynomials; they and c1, c2, ... count r from the rim
    of the image circle, or from the corner where there is no circle.

    Raises
    ------
    UserError
        With what is wrong with it.

    """
    if text.endswith(".json"):
        return read_vignette(text)
    if text.endswith(".cal"):
        try:
            return parse_cal(Path(text).read_text(errors="replace"), text)
        except OSError as error:
            raise UserError(f"cannot be read: {error.strerror}", file=text) from error
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(
            f"{what} {text!r}: give c1,c2,... or a vignette.json or .cal file"
        ) from error
    if not all(map(math.isfinite, values)):
        raise UserError(f"{what} {text!r}: the numbers must be finite")
    return values


def file_of(text: str | None) -> list[Path]:
    """The file that an option names, for a record's inputs; none if it gives numbers."""
    return [Path(text)] if text is not None and text.endswith((".json", ".cal")) else []


def parse_cal(text: str, path: str | os.PathLike[str] = "vignetting.cal") -> tuple[float, ...]:
    """c1, c2, ... of HDRICalibrationTool's ``sf=(1/((c*(r^8))+ ... +1))``.

    Raises
    ------
    UserError
        Another formula; odd powers that count; a polynomial that is not 1 at the centre.

    """
    found = re.search(r"^\s*sf\s*=\s*\(?1/(.*);", text, re.MULTILINE)
    if found is None:
        raise UserError("no line sf=(1/(...)); it is no vignetting of that form", file=path)
    formula = found[1].replace(" ", "")
    number = r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?"
    terms: dict[int, float] = {}
    term = re.compile(rf"\(\(?({number})\)?\*(?:\(r\^(\d+)\)|r)\)")
    for match in term.finditer(formula):
        power = int(match[2] or 1)
        if power in terms or power > 40:
            raise UserError(f"r^{power} stands there twice, or is too high a power", file=path)
        terms[power] = float(match[1])
    rest = re.sub(r"[()+]", "", term.sub("", formula))
    if not terms or rest not in ("1", "1.0"):
        raise UserError("its sf is not 1 over a polynomial in r that is 1 at r = 0", file=path)
    odd = [power for power, c in terms.items() if power % 2 and abs(c) > 1e-9]
    if odd or not all(map(math.isfinite, terms.values())):
        raise UserError(f"odd powers of r in it: {odd}; a fall-off has even ones", file=path)
    return tuple(terms.get(2 * k, 0.0) for k in range(1, max(terms) // 2 + 1))


def read_known(text: str, what: str = "--vignetting") -> Given:
    """As :func:`read_given`, where no image circle is known that a ``.cal`` could count from.

    Raises
    ------
    UserError
        With what is wrong with it.

    """
    if text.endswith(".cal"):
        raise UserError(
            f"{what}: it counts from the rim of an image circle, which is told to `envmap`: "
            "give it there, or a vignette.json here",
            file=text,
        )
    return read_given(text, what)
