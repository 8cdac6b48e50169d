"""Where a lens throws light on its sensor: a fisheye's circle does not fill the picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

#: Codes up to this one, of 255, are dark.
DARK = 24
#: Pictures that are looked at.
PICTURES = 6


def brightest(
    picture: NDArray[np.uint8], shape: tuple[int, int], so_far: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """The largest code around each of (h, w) places over a grey picture, and `so_far`'s."""
    rows, columns = shape
    height, width = picture.shape
    # A cell's 90th percentile would be slow; the mean of small blocks keeps noise out as well.
    fine = cv2.resize(
        picture, (min(width, 4 * columns), min(height, 4 * rows)), interpolation=cv2.INTER_AREA
    )
    kernel = np.ones((3, 3), np.uint8)
    codes = cv2.dilate(fine, kernel)
    codes = np.asarray(cv2.resize(codes, (columns, rows), interpolation=cv2.INTER_NEAREST))
    return np.asarray(codes if so_far is None else np.maximum(codes, so_far), np.uint8)


def lit_places(codes: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where :func:`brightest` codes (h, w) show a lens's light, (h, w).

    Everywhere, unless at least three corners of the picture are dark: then what is dark and
    joined to the border is outside of the lens's circle.
    """
    dark = codes <= DARK
    if dark[[0, 0, -1, -1], [0, -1, 0, -1]].sum() < 3:
        return np.ones(codes.shape, bool)
    _, labels = cv2.connectedComponents(dark.astype(np.uint8), connectivity=4)
    rim = {*labels[0], *labels[-1], *labels[:, 0], *labels[:, -1]} - {0}
    return ~np.isin(labels, list(rim))


def spread_out(files: Sequence[str], most: int = PICTURES) -> list[str]:
    """At most so many of the files, evenly."""
    chosen = np.unique(np.linspace(0, len(files) - 1, most).round().astype(int))
    return [files[int(i)] for i in chosen]
