"""What people clicked, as the commands take it: pixels, points and lines of the world."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from chromeball.scene.errors import UserError
from chromeball.scene.record import read_json

AXES = {"x": 0, "y": 1, "z": 2}


def parse_pixels(text: str) -> list[tuple[float, float]]:
    """Pixels from "x,y x,y ..."."""
    pixels: list[tuple[float, float]] = []
    for item in text.split():
        try:
            x, y = (float(v) for v in item.split(","))
        except ValueError as error:
            raise UserError(f'{item!r} is no pixel; write "x,y x,y x,y x,y"') from error
        pixels.append((x, y))
    return pixels


def read_pairs(path: Path) -> tuple[list[list[float]], list[list[float]]]:
    """World points and their pixels from a CSV x,y,z,u,v."""
    rows = [
        _numbers(row, path, k) for k, row in enumerate(_rows(path, ("x", "y", "z", "u", "v")))
    ]
    return [row[:3] for row in rows], [row[3:] for row in rows]


def read_lines(path: Path) -> tuple[list[int], list[list[list[float]]]]:
    """Lines along the axes from a CSV axis,u1,v1,u2,v2: axes, and their ends' pixels."""
    axes: list[int] = []
    ends: list[list[list[float]]] = []
    for k, (name, *rest) in enumerate(_rows(path, ("axis", "u1", "v1", "u2", "v2"))):
        sign = -1 if name.strip().startswith("-") else 1
        axis = AXES.get(name.strip().lstrip("+-").lower())
        if axis is None:
            raise UserError(
                f"row {k + 1}: {name!r} is no axis; write x, y, z, -x, -y or -z", file=path
            )
        u1, v1, u2, v2 = _numbers(rest, path, k)
        axes.append(axis)
        ends.append([[u1, v1], [u2, v2]][::sign])
    return axes, ends


def parse_rectangle(text: str) -> list[list[float]]:
    """The corners of a rectangle "0.6x0.4" on the floor, about the origin, as `envmap align`.

    Its first side runs along +x, the second towards the camera, +z.
    """
    width, _, depth = text.lower().partition("x")
    try:
        w, d = float(width) / 2, float(depth) / 2
    except ValueError as error:
        raise UserError(
            f"--rectangle {text!r}: width x depth in metres, such as 0.6x0.4"
        ) from error
    if not (0 < w < 1e4 and 0 < d < 1e4):
        raise UserError(f"--rectangle {text}: both sides are positive")
    return [[-w, 0.0, -d], [w, 0.0, -d], [w, 0.0, d], [-w, 0.0, d]]


def read_corners(align: Path) -> list[list[float]]:
    """World corners (N, 3) of align.json."""
    value = read_json(align)
    corners = value.get("corners") if isinstance(value, dict) else None
    try:
        points = [[float(v) for v in corner] for corner in corners or []]
    except (TypeError, ValueError):
        points = []
    if not points or any(len(p) != 3 for p in points):
        raise UserError("no world corners in it; make it with `envmap align`", file=align)
    return points


def _rows(path: Path, names: tuple[str, ...]) -> list[list[str]]:
    """The columns `names` of a CSV, row by row."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise UserError("no such file", file=path) from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot be read: {error}", file=path) from error
    try:
        rows = [
            r for r in csv.reader(io.StringIO(text), skipinitialspace=True, strict=True) if r
        ]
    except csv.Error as error:
        raise UserError(f"not a readable CSV: {error}", file=path) from error
    if not rows or sorted(rows[0]) != sorted(names):
        raise UserError(f"needs the first line {','.join(names)}", file=path)
    order = [rows[0].index(name) for name in names]
    for k, row in enumerate(rows[1:]):
        if len(row) != len(names):
            raise UserError(f"row {k + 1} has {len(row)} fields, not {len(names)}", file=path)
    return [[row[i] for i in order] for row in rows[1:]]


def _numbers(row: Sequence[str], path: Path, index: int) -> list[float]:
    try:
        values = [float(v) for v in row]
    except ValueError as error:
        raise UserError(f"row {index + 1}: {error}", file=path) from error
    if not all(math.isfinite(v) for v in values):
        raise UserError(f"row {index + 1} is not finite", file=path)
    return values
