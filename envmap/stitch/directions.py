"""Where the tracker or the session says that frames looked."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.probe import rotation
from chromeball.envmap.stitch.links import Prior
from chromeball.scene.camera import WORLD_FROM_LATLONG
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

#: Standard deviations, degrees an axis, where nobody says: a tracker, and a person's angles.
TRACKER, SESSION = 1.0, 4.0


def world_from_angles(yaw: float, pitch: float, roll: float) -> Array:
    """world_from_camera of a shot turned by degrees, as `envmap probe` takes them."""
    turned = rotation(*(math.radians(a) for a in (yaw, pitch, roll)))
    return turned @ WORLD_FROM_LATLONG.rotation


def from_angles(
    yaw: Sequence[float],
    pitch: Sequence[float],
    roll: Sequence[float],
    *,
    sigma: float = SESSION,
) -> Prior:
    """The session's angles, degrees, good to `sigma` degrees an axis."""
    turns = [world_from_angles(*a) for a in zip(yaw, pitch, roll, strict=True)]
    return Prior(np.array(turns), np.full(len(turns), math.radians(sigma)))


def read_directions(
    path: str | os.PathLike[str], names: Sequence[str], sigma: float | None = None
) -> Prior:
    """A tracker's rotations for the frames `names`, from JSON or CSV.

    JSON: ``{"sigma_degrees": 0.7, "frames": [{"file": "a.exr", "world_from_camera": [[...]] or
    "rotation_vector": [x, y, z] or "yaw": 0, "pitch": 0, "roll": 0}, ...]}``; a matrix is 3 x 3
    or 4 x 4, camera x right, y down, z forward, world +Y up. CSV: columns file, yaw, pitch,
    roll and, if it has one, sigma, degrees. Frames are found by their names without suffix;
    without names they are taken in order. `sigma` (degrees) goes before the file's.

    Raises
    ------
    UserError
        When it cannot be read, or says nothing of any frame.

    """
    path = Path(path)
    default = TRACKER if sigma is None else sigma
    if path.suffix.lower() == ".csv":
        rows = _read_csv(path)
    else:
        value = read_json(path)
        if not isinstance(value, dict) or not isinstance(value.get("frames"), list):
            raise UserError('needs {"frames": [...]}, a list of directions', file=path)
        rows = [row for row in value["frames"] if isinstance(row, dict)]
        if len(rows) < len(value["frames"]):
            raise UserError("each of the frames is a table", file=path)
        if sigma is None and "sigma_degrees" in value:
            default = _number(value["sigma_degrees"], "sigma_degrees", path)
    named = [bool(row.get("file")) for row in rows]
    if any(named) != all(named):
        raise UserError("either all directions name their file, or none does", file=path)
    if not any(named) and len(rows) != len(names):
        raise UserError(
            f"{len(rows)} directions for {len(names)} frames; name the files", file=path
        )
    turns = np.tile(np.eye(3), (len(names), 1, 1))
    spread = np.full(len(names), math.inf)
    for k, row in enumerate(rows):
        at = [k]
        if any(named):
            stem = Path(str(row["file"])).stem
            at = [i for i, name in enumerate(names) if name == stem]
        for i in at:
            turns[i] = _turn(row, k, path)
            own = default if sigma is not None else row.get("sigma", default)
            spread[i] = math.radians(_number(own, "sigma", path))
    if not np.isfinite(spread).any():
        raise UserError(f"says nothing of {', '.join(names[:5])}", file=path)
    if not (spread > 0).all():
        raise UserError("sigma must be positive", file=path)
    return Prior(turns, spread)


def _turn(row: dict[str, Any], index: int, path: Path) -> Array:
    try:
        if "world_from_camera" in row:
            matrix = np.array(row["world_from_camera"], float)
            if matrix.shape not in ((3, 3), (3, 4), (4, 4)):
                raise ValueError("a matrix of 3 x 3 or 4 x 4")
            return Pose(matrix[:3, :3], np.zeros(3)).rotation
        if "rotation_vector" in row:
            return Pose.from_rotation_vector(row["rotation_vector"], [0.0, 0, 0]).rotation
        if "yaw" in row:
            angles = [_number(row.get(a) or 0.0, a, path) for a in ("yaw", "pitch", "roll")]
            return world_from_angles(*angles)
    except (ValueError, TypeError) as error:
        raise UserError(f"direction {index + 1}: {error}", file=path) from error
    raise UserError(
        f"direction {index + 1} needs world_from_camera, rotation_vector or yaw", file=path
    )


def _number(value: Any, name: str, path: Path) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise UserError(f"{name} {value!r} is no number", file=path) from error
    if not math.isfinite(number):
        raise UserError(f"{name} {value!r} is not finite", file=path)
    return number


def _read_csv(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text()
    except FileNotFoundError as error:
        raise UserError("no such file", file=path) from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot be read: {error}", file=path) from error
    try:
        rows = list(csv.DictReader(io.StringIO(text), skipinitialspace=True, strict=True))
    except csv.Error as error:
        raise UserError(f"not a readable CSV: {error}", file=path) from error
    known = {"file", "yaw", "pitch", "roll", "sigma"}
    heads = {str(head) for row in rows for head in row}
    if not rows or "yaw" not in heads or heads - known:
        raise UserError(
            "needs a first line with the columns file, yaw, pitch, roll and, if known, sigma",
            file=path,
        )
    return [{k: v for k, v in row.items() if v not in (None, "")} for row in rows]
