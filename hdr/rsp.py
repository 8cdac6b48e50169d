"""A camera's response as Radiance's hdrgen keeps it, ``.rsp``."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

#: the highest order that hdrgen knows, with room
MOST = 16
CODES = 256


def parse_rsp(text: str, path: str | os.PathLike[str] = "camera.rsp") -> NDArray[np.float64]:
    """Log exposure (3, 256) of red, green, blue: a line each, order and coefficients.

    The exposure of code z is the polynomial at (z + 1/2) / 256, the highest power's coefficient
    first (Mitsunaga and Nayar 1999; Radiance's hdrgen).

    Raises
    ------
    UserError
        When it is no such file, or a curve is not positive or does not rise.

    """
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError as error:
        raise UserError("no .rsp: its words are no numbers", file=path) from error
    curves: list[NDArray[np.float64]] = []
    z = (np.arange(CODES) + 0.5) / CODES
    for channel in ("red", "green", "blue"):
        if not numbers or not 1 <= numbers[0] <= MOST or numbers[0] % 1:
            raise UserError(f"no .rsp: the order of {channel} is missing", file=path)
        count = int(numbers[0]) + 1
        coefficients, numbers = numbers[1 : count + 1], numbers[count + 1 :]
        if len(coefficients) < count:
            raise UserError(f"{channel} needs {count} coefficients", file=path)
        curve = np.polyval(coefficients, z)
        if not (np.isfinite(curve).all() and curve[0] > 0 and (np.diff(curve) > 0).all()):
            bad = int(np.argmin((curve > 0) & (np.diff(curve, prepend=-np.inf) > 0)))
            raise UserError(
                f"the curve of {channel} is not positive or does not rise at code {bad}",
                file=path,
            )
        curves.append(np.log(curve))
    if numbers:
        raise UserError(f"{len(numbers)} numbers too many: three channels are read", file=path)
    return np.stack(curves)
