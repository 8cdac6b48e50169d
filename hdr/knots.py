"""Codes and knots: a response curve has 256 knots, whatever the number of codes.

With 256 codes the knots are the codes. Pictures of more codes (10 .. 16 bits) have knots at
``z_k = (codes - 1) (k / 255)^2``: the curve is then resolved evenly in relative terms down to
the darkest codes, and its cost does not grow with the number of codes.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

KNOTS = 256
MIDDLE = KNOTS // 2
#: numbers of codes that pictures have: 8, 10, 12, 14, 16 bits
DEPTHS = (256, 1024, 4096, 16384, 65536)

type Float = NDArray[np.float64]


def code_count(brightest: int) -> int:
    """Codes of a camera whose largest code is `brightest`: 16-bit files hold fewer, too."""
    return next(codes for codes in DEPTHS if codes > brightest)


def coordinate(codes: int) -> Float:
    """Knot coordinate 0 .. 255 of each code, (codes,)."""
    if codes == KNOTS:
        return np.arange(codes, dtype=np.float64)
    return (KNOTS - 1) * np.sqrt(np.arange(codes) / (codes - 1))


def codes_at_knots(codes: int) -> Float:
    """Code at each knot, not always whole, (256,)."""
    k = np.arange(KNOTS, dtype=np.float64)
    return k if codes == KNOTS else (codes - 1) * (k / (KNOTS - 1)) ** 2


@cache
def fixed_point(codes: int) -> NDArray[np.uint16]:
    """`coordinate` in 8.8 fixed point, as the kernels take it."""
    return np.round(256 * coordinate(codes)).astype(np.uint16)


def at_codes(curves: Float, codes: int) -> Float:
    """Curves (C, 256) at the knots to (C, codes): monotone cubic, so that what rises rises."""
    if codes == KNOTS:
        return curves
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(np.arange(KNOTS), curves, axis=1)(coordinate(codes)))


def at_knots(curves: Float) -> Float:
    """Curves (C, codes) at the knots, (C, 256); the inverse of :func:`at_codes`."""
    codes = curves.shape[1]
    if codes == KNOTS:
        return curves
    z = codes_at_knots(codes)
    return np.stack([np.interp(z, np.arange(codes), curve) for curve in curves])


def as_codes(frame: NDArray[Any], codes: int) -> NDArray[Any]:
    """The frame with no code beyond `codes`, as uint8 where that holds it.

    Raises
    ------
    UserError
        A code beyond `codes`.

    """
    if frame.dtype == np.uint16:
        brightest = int(frame.max(initial=0))
        if brightest >= codes:
            raise UserError(
                f"code {brightest} in a picture of a camera with {codes} codes: the pictures "
                "of a bracket have one depth"
            )
        if codes == KNOTS:
            return frame.astype(np.uint8)
    return frame
