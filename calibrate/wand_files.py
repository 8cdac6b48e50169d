"""Tracks of lights as MultiCamSelfCal keeps them, and its lenses.

A folder holds ``points.dat`` (3C, F): x, y and 1 of each camera and frame; ``IdMat.dat``
(C, F): 1 where the light was seen; ``Res.dat`` (C, 2): width and height; and, if it likes,
``camera_order.txt``, a name a line (Svoboda, Martinec and Pajdla 2005).
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.formats import read_camera
from chromeball.calibrate.wand_result import Tracks
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: Numbers of a ``.rad``: focal lengths, principal point, distortion.
RAD = ("K11", "K22", "K13", "K23", "kc1", "kc2", "kc3", "kc4")


def read_points(folder: str | os.PathLike[str]) -> Tracks:
    """The tracks of one light in a folder of MultiCamSelfCal's.

    Raises
    ------
    UserError
        A file is missing, holds something else, or does not fit the others.

    """
    folder = Path(folder)
    sizes = _table(folder / "Res.dat")
    if sizes.shape[1] != 2 or not ((sizes >= 1) & (sizes < 1e6)).all():
        raise UserError(
            "each line is the width and height of a camera", file=folder / "Res.dat"
        )
    count = len(sizes)
    seen = _table(folder / "IdMat.dat")
    frames = seen.shape[1]
    if len(seen) != count:
        raise UserError(
            f"{len(seen)} lines for the {count} cameras of Res.dat", file=folder / "IdMat.dat"
        )
    points = _table(folder / "points.dat")
    if points.shape != (3 * count, frames):
        rows, columns = points.shape
        raise UserError(
            f"{rows} lines of {columns} numbers are not three lines of {frames} for each of "
            f"{count} cameras",
            file=folder / "points.dat",
        )
    pixels = points.reshape(count, 3, frames)[:, :2].transpose(0, 2, 1)[:, :, None].copy()
    pixels[~(seen > 0) | ~np.isfinite(pixels).all(axis=(2, 3))] = np.nan
    return Tracks(
        names=_names(folder / "camera_order.txt", count),
        sizes=tuple((int(w), int(h)) for w, h in sizes),
        pixels=pixels,
        errors=np.ones(pixels.shape[:3]),
    )


def read_lens(path: str | os.PathLike[str], size: tuple[int, int]) -> CameraModel:
    """A camera file, or a ``.rad`` of a camera of `size`: Bouguet's four distortions."""
    path = Path(path)
    if path.suffix != ".rad":
        return read_camera(path)
    pairs = re.findall(r"^\s*(\w+)\s*=\s*(\S+)\s*$", _text(path), re.MULTILINE)
    values: dict[str, float] = {}
    for name, text in pairs:
        try:
            values[name] = float(text)
        except ValueError as error:
            raise UserError(f"{name} = {text} is no number", file=path) from error
    if missing := [name for name in RAD if not math.isfinite(values.get(name, math.nan))]:
        raise UserError(f"no {', '.join(missing)} in it", file=path)
    k = np.array([values[name] for name in RAD])
    if k[:2].min() <= 0:
        raise UserError("focal lengths are positive", file=path)
    return CameraModel("LENSMODEL_OPENCV4", k, size)


def read_centres(path: str | os.PathLike[str], count: int) -> NDArray[np.float64]:
    """Camera centres, a line of x y z each, (C, 3)."""
    path = Path(path)
    centres = _table(path)
    if centres.shape != (count, 3) or not np.isfinite(centres).all():
        raise UserError(f"{count} lines of x y z are needed, one for each camera", file=path)
    return centres


def _table(path: Path) -> NDArray[np.float64]:
    """Lines of equally many numbers; ``nan`` is one."""
    lines = [line.split() for line in _text(path).splitlines() if line.strip()]
    if not lines or any(len(line) != len(lines[0]) for line in lines):
        raise UserError("not lines of equally many numbers", file=path)
    try:
        return np.array([[float(word) for word in line] for line in lines])
    except ValueError as error:
        raise UserError(f"not a table of numbers: {error}", file=path) from error


def _names(path: Path, count: int) -> tuple[str, ...]:
    if not path.exists():
        return tuple(f"camera{i}" for i in range(count))
    names = tuple(line.strip() for line in _text(path).splitlines() if line.strip())
    if len(set(names)) != count:
        raise UserError(f"{count} different names are needed, not {len(names)}", file=path)
    if bad := [n for n in names if Path(n).name != n or n.startswith(".") or "\0" in n]:
        raise UserError(f"{bad[0]!r} cannot be the name of a file", file=path)
    return names


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except FileNotFoundError as error:
        raise UserError("no such file", file=path) from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"not a readable text: {error}", file=path) from error
