"""Parts of a picture in words: corners, edges, sides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = ("top", "middle", "bottom"), ("left", "middle", "right")
#: A third of the picture lacks something where this share of it does.
LACKING = 0.3


def thirds(
    bad: NDArray[np.bool_], pixels: NDArray[np.float64], size: tuple[int, int]
) -> set[tuple[int, int]]:
    """Thirds (row, column) of the picture of which the `pixels` (n, 2) are `bad` (n,)."""
    place = np.clip((3 * (pixels + 0.5) / size).astype(int), 0, 2)
    lacking: set[tuple[int, int]] = set()
    for row in range(3):
        for column in range(3):
            here = (place == [column, row]).all(axis=1)
            if here.any() and bad[here].mean() >= LACKING:
                lacking.add((row, column))
    return lacking


def named(places: set[tuple[int, int]]) -> tuple[str, bool]:
    """Thirds (row, column) in words, and whether the words are a plural."""
    rest, words = set(places), list[str]()
    everything = {(r, c) for r in range(3) for c in range(3)}
    if rest == everything:
        return "the whole picture", False
    if rest == everything - {(1, 1)}:
        return "everything but the middle", False
    corners = {(r, c) for r in (0, 2) for c in (0, 2)}
    sides = [(f"the {COLUMNS[c]} side", {(r, c) for r in range(3)}) for c in (0, 2)]
    sides += [(f"the {ROWS[r]} side", {(r, c) for c in range(3)}) for r in (0, 2)]
    groups = [
        *sides,
        ("the corners", corners),
        *((f"the {COLUMNS[c]} corners", {(0, c), (2, c)}) for c in (0, 2)),
        *((f"the {ROWS[r]} corners", {(r, 0), (r, 2)}) for r in (0, 2)),
    ]
    for word, group in groups:
        if group <= places and group & rest == group:
            words.append(word)
            rest -= group
    plural = len(words) + len(rest) > 1 or any(word.endswith("corners") for word in words)
    words += [f"the {_third(*place)}" for place in sorted(rest)]
    return _listed(words), plural


def _third(row: int, column: int) -> str:
    if (row, column) == (1, 1):
        return "middle"
    if row == 1:
        return f"{COLUMNS[column]} edge"
    if column == 1:
        return f"{ROWS[row]} edge"
    return f"{ROWS[row]} {COLUMNS[column]} corner"


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]
