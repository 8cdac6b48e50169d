"""What a picture shows of a target."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.printed import Printed


@dataclass(frozen=True)
class Detection:
    """What one picture shows of the target.

    ``corners`` is (rows, columns, 2) in pixels, NaN where not found; ``sigma`` (rows, columns)
    the standard error of a coordinate from the picture's noise, NaN where it is not known;
    ``size`` is width and height; ``blur`` the standard deviation of the edges' spread in
    pixels, NaN without a board; ``usable`` says that the view may enter a calibration,
    ``verdict`` why or why not; ``printed`` how the board looks.
    """

    file: Path
    size: tuple[int, int]
    corners: NDArray[np.float64]
    sigma: NDArray[np.float64]
    blur: float
    usable: bool
    verdict: str
    printed: Printed

    @property
    def count(self) -> int:
        """How many corners were found."""
        return int(np.isfinite(self.corners[..., 0]).sum())
