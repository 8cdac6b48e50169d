"""What frames in memory must be, for all that compares them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]

KINDS = ("uint8", "uint16", "float32")


def check_frames(
    frames: Sequence[NDArray[Any]], exposures: Float, log_exposure: Float | None = None
) -> None:
    """Refuse frames (H, W, C) that are no bracket, or not of the response (C, codes) given.

    Raises
    ------
    UserError
        No frames; shapes, types, exposures or a response that do not fit.

    """
    if len(frames) == 0:
        raise UserError("no pictures are given")
    if len(frames) != len(exposures):
        raise UserError(f"{len(exposures)} exposures for {len(frames)} pictures")
    if not (np.all(np.isfinite(exposures)) and np.all(exposures > 0)):
        raise UserError("exposures must be positive numbers")
    first = frames[0]
    if first.ndim != 3 or any(f.shape != first.shape or f.dtype != first.dtype for f in frames):
        raise UserError("the pictures of a bracket have one size, (H, W, C), and one type")
    if str(first.dtype) not in KINDS:
        raise UserError(f"pictures of {first.dtype} values: 8-bit, 16-bit or float are needed")
    if log_exposure is None:
        return
    codes = log_exposure.shape[1]
    if first.dtype == np.float32 or (first.dtype == np.uint8 and codes != 256):
        raise UserError(f"a response of {codes} codes is not for pictures of {first.dtype}")
    if log_exposure.shape[0] != first.shape[2]:
        raise UserError("the response does not have the pictures' channels")
