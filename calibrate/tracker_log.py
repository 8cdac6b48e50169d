"""What a tracker wrote down: samples of its sensor's pose, and the pose at any time between.

A log is CSV with a first line, or JSON ``{"samples": [{...}]}`` with the same names:

``t``
    seconds on any clock, rising; or ``file``, the picture that a sample belongs to.
``x y z``
    the sensor in the tracker's own axes, metres (``x_cm``, ``x_mm``, ``x_in``: other units).
``qw qx qy qz``
    its rotation, sensor to tracker; or ``azimuth elevation roll`` in degrees, turned in this
    order about z, the new y and the newest x, as Polhemus' ISOTRAK reports them. Angles are
    turned into quaternions at once: near an elevation of 90 degrees they cannot be averaged.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.resection import cross_matrix
from chromeball.scene.errors import UserError
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

#: ending of a column's name -> metres
LENGTHS = {"": 1.0, "_mm": 1e-3, "_cm": 1e-2, "_in": 0.0254}
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("azimuth", "elevation", "roll")
#: A quaternion's length may differ from 1 by its decimals' rounding.
NORM = 0.02
#: A gap of so many usual intervals is no motion to interpolate over.
GAP = 5.0


@dataclass(frozen=True)
class TrackerLog:
    """Poses ``tracker_from_sensor``: ``positions`` (N, 3) metres, ``rotations`` (N, 3, 3).

    ``times`` (N,) in seconds, rising; or ``files`` the picture of each sample. ``angles``
    (N, 3): azimuth, elevation and roll in degrees where the turns were written so.
    """

    positions: Array
    rotations: Array
    times: Array | None = None
    files: tuple[str, ...] | None = None
    angles: Array | None = None

    @property
    def interval(self) -> float:
        """The usual time between samples, seconds."""
        return math.nan if self.times is None else float(np.median(np.diff(self.times)))


@dataclass(frozen=True)
class Sampled:
    """The sensor at V times: poses, their velocities, and what that does to the log's noise.

    ``velocities`` (V, 3) m/s in the tracker's axes; ``spins`` (V, 3) rad/s in the sensor's.
    Each pose is a weighted mean of samples. With weights w and those of the slope s,
    ``variance`` (V,) is sum w^2, ``mixed`` sum w s and ``slope_variance`` sum s^2: how much of
    a sample's variance is in the pose, in both and in the velocity. ``shared`` (V,) is at least
    1, the sum of the correlations with all V poses, which use samples in common.
    """

    positions: Array
    rotations: Array
    velocities: Array
    spins: Array
    variance: Array
    mixed: Array
    slope_variance: Array
    shared: Array


def sample(log: TrackerLog, times: Array, window: float = 0.0) -> Sampled:
    """The sensor's poses at `times` (V,).

    Between two samples: the straight line and the shortest turn (slerp; Shoemake 1985). With a
    `window` in seconds: a local parabola through all samples in it, tricube weights (Cleveland
    1979), of positions and of turns from the nearest sample.

    Raises
    ------
    UserError
        When the log has no times, or a window fewer than four samples.

    """
    from scipy.spatial.transform import Rotation

    if log.times is None:
        raise UserError("the log has no column t: its poses belong to pictures, not to times")
    if window <= 0:
        index, value, slope = _between(log.times, times)
    else:
        index, value, slope = _parabola(log.times, times, window)
    rows = np.arange(len(times))
    near = index[rows, np.argmax(value, axis=1)]
    base = Rotation.from_matrix(log.rotations[near])
    turns = np.swapaxes(base.as_matrix(), 1, 2)[:, None] @ log.rotations[index]
    vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(*index.shape, 3)
    phi = np.einsum("vm,vmi->vi", value, vectors)
    rate = np.einsum("vm,vmi->vi", slope, vectors)
    used, place = np.unique(index, return_inverse=True)
    weights = np.zeros((len(times), len(used)))
    np.add.at(weights, (rows[:, None], place.reshape(index.shape)), value)
    product = weights @ weights.T
    variance = np.diag(product)
    correlation = np.abs(product) / np.sqrt(np.outer(variance, variance))
    return Sampled(
        positions=np.einsum("vm,vmi->vi", value, log.positions[index]),
        rotations=(base * Rotation.from_rotvec(phi)).as_matrix(),
        velocities=np.einsum("vm,vmi->vi", slope, log.positions[index]),
        spins=np.einsum("vij,vj->vi", right_jacobian(phi), rate),
        variance=variance.copy(),
        mixed=(value * slope).sum(axis=1),
        slope_variance=(slope**2).sum(axis=1),
        shared=correlation.sum(axis=1),
    )


def usual_window(log: TrackerLog) -> float:
    """Eight samples, so that velocities are not the noise's; none above a quarter of a second,
    in which a hand does not move along a parabola any more.
    """  # noqa: D205
    window = 8 * log.interval
    return window if window <= 0.25 else 0.0


def reached(log: TrackerLog, times: Array, window: float = 0.0) -> NDArray[np.bool_]:
    """Which of `times` (V,) the log covers, without a gap around them."""
    if log.times is None:
        raise UserError("the log has no column t: its poses belong to pictures, not to times")
    reach = max(window / 2, 0.0)
    inside = (times - reach >= log.times[0]) & (times + reach <= log.times[-1])
    after = np.clip(np.searchsorted(log.times, times, side="right"), 1, len(log.times) - 1)
    gap = log.times[after] - log.times[after - 1]
    return np.asarray(inside & (gap <= GAP * log.interval), bool)


def _between(known: Array, times: Array) -> tuple[NDArray[np.intp], Array, Array]:
    after = np.clip(np.searchsorted(known, times, side="right"), 1, len(known) - 1)
    step = known[after] - known[after - 1]
    u = (times - known[after - 1]) / step
    index = np.stack([after - 1, after], axis=1)
    value = np.stack([1 - u, u], axis=1)
    return index, value, np.stack([-1 / step, 1 / step], axis=1)


def _parabola(
    known: Array, times: Array, window: float
) -> tuple[NDArray[np.intp], Array, Array]:
    half = window / 2
    first = np.searchsorted(known, times - half, side="left")
    last = np.searchsorted(known, times + half, side="right")
    count = last - first
    if count.min(initial=4) < 4:
        raise UserError(
            f"a window of {window:g} s holds {count.min()} samples of the tracker; a parabola "
            "needs four: take a longer window, or none"
        )
    index = first[:, None] + np.arange(int(count.max(initial=4)))
    inside = index < last[:, None]
    index = np.minimum(index, len(known) - 1)
    tau = (known[index] - times[:, None]) / half
    kernel = np.where(inside, np.clip(1 - np.abs(tau) ** 3, 1e-6, None) ** 3, 0.0)
    design = tau[..., None] ** np.arange(3)
    weighted = design * kernel[..., None]
    solved = np.linalg.solve(np.swapaxes(design, 1, 2) @ weighted, np.swapaxes(weighted, 1, 2))
    return index, solved[:, 0], solved[:, 1] / half


def right_jacobian(phi: Array) -> Array:
    """J with Exp(phi + d) = Exp(phi) Exp(J d), (..., 3) -> (..., 3, 3) (Sola 2018, eq. 143)."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    k = cross_matrix(phi)
    return np.eye(3) - a * k + b * (k @ k)


# ---- files


def read_log(path: str | os.PathLike[str]) -> TrackerLog:
    """Read a tracker's log, CSV or JSON.

    Raises
    ------
    UserError
        When it cannot be read, names no pose, holds a value that is no number or times that do
        not rise; with the sample's number.

    """
    path = Path(path)
    rows = _rows(path, "samples")
    if not rows:
        raise UserError("holds no samples", file=path)
    names = set(rows[0])
    unit = next((u for u in LENGTHS if {f"{a}{u}" for a in "xyz"} <= names), None)
    if unit is None:
        raise UserError("needs columns x, y, z in metres, or x_cm, x_mm, x_in", file=path)
    quaternion = set(QUATERNION) <= names
    if not quaternion and not set(ANGLES) <= names:
        raise UserError(
            f"needs columns {', '.join(QUATERNION)}, or {', '.join(ANGLES)} in degrees",
            file=path,
        )
    timed = "t" in names
    if timed == ("file" in names):
        raise UserError("needs a column t in seconds, or else a column file", file=path)
    turns = QUATERNION if quaternion else ANGLES
    columns = [*(f"{a}{unit}" for a in "xyz"), *turns, *(["t"] if timed else [])]
    if unknown := sorted(names - {*columns, "file"}):
        raise UserError(f"unknown column {unknown[0]}; known: {', '.join(columns)}", file=path)
    values = np.array(
        [[_number(row, c, k, path) for c in columns] for k, row in enumerate(rows)]
    )
    written = values[:, 3 : 3 + len(turns)]
    rotations = _rotations(written, path)
    angles = None if quaternion else written
    positions = values[:, :3] * LENGTHS[unit]
    if not timed:
        files = tuple(str(row.get("file", "")) for row in rows)
        return TrackerLog(positions, rotations, files=files, angles=angles)
    times = values[:, -1]
    if len(times) < 2:
        raise UserError("one sample is no log", file=path)
    if not (np.diff(times) > 0).all():
        late = int(np.argmin(np.diff(times) > 0)) + 2
        raise UserError(f"sample {late} is not later than the one before", file=path)
    return TrackerLog(positions, rotations, times=times, angles=angles)


def read_times(path: str | os.PathLike[str], files: Sequence[Path]) -> Array:
    """When each of `files` was taken, seconds, (N,), as :func:`all_times` has it.

    Raises
    ------
    UserError
        When it cannot be read or says nothing of a picture.

    """
    known = all_times(path)
    if missing := [f for f in files if f.name not in known]:
        raise UserError(f"says nothing of {missing[0].name}", file=path)
    return np.array([known[f.name] for f in files])


def all_times(path: str | os.PathLike[str]) -> dict[str, float]:
    """Pictures' names and when they were taken, seconds.

    From a CSV with columns ``file, t``, or from a take: its folder or its ``take.json`` (the
    monotonic clock, or where a frame has none, wall time).

    Raises
    ------
    UserError
        When it cannot be read, or names a picture twice.

    """
    path = Path(path)
    if path.is_dir() or path.name == "take.json":
        return _take_times(path)
    known: dict[str, float] = {}
    for k, row in enumerate(_rows(path, "times")):
        if not {"file", "t"} <= set(row):
            raise UserError("needs columns file and t", file=path)
        name = Path(str(row["file"])).name
        if name in known:
            raise UserError(f"names {name} twice", file=path)
        known[name] = _number(row, "t", k, path)
    return known


def _take_times(path: Path) -> dict[str, float]:
    from chromeball.acquire.take import read_take

    take = read_take(path)
    rows = [frame.row for frame in take.frames]
    if all(row.monotonic is not None for row in rows):
        return {f.path.name: float(f.row.monotonic or 0) for f in take.frames}
    try:
        walls = [datetime.fromisoformat(row.wall or "").timestamp() for row in rows]
    except ValueError as error:
        raise UserError("not all of its frames have a time", file=take.path) from error
    return {f.path.name: wall for f, wall in zip(take.frames, walls, strict=True)}


def _rotations(values: Array, path: Path) -> Array:
    from scipy.spatial.transform import Rotation

    if values.shape[1] == 3:
        return Rotation.from_euler("ZYX", values, degrees=True).as_matrix()
    length = np.linalg.norm(values, axis=1)
    if (np.abs(length - 1) > NORM).any():
        bad = int(np.argmax(np.abs(length - 1)))
        raise UserError(
            f"sample {bad + 1}: the quaternion's length is {length[bad]:.3g}, not 1", file=path
        )
    return Rotation.from_quat(values[:, [1, 2, 3, 0]]).as_matrix()


def _rows(path: Path, key: str) -> list[dict[str, Any]]:
    if path.suffix.lower() == ".json":
        value = read_json(path)
        rows = value.get(key) if isinstance(value, dict) else None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise UserError(f'needs {{"{key}": [{{...}}, ...]}}', file=path)
        return rows
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise UserError("no such file", file=path) from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot be read: {error}", file=path) from error
    try:
        head, *lines = csv.reader(io.StringIO(text), skipinitialspace=True, strict=True)
    except ValueError as error:
        raise UserError(f"holds no {key}", file=path) from error
    except csv.Error as error:
        raise UserError(f"not a readable CSV: {error}", file=path) from error
    lines = [line for line in lines if line]
    for k, line in enumerate(lines):
        if len(line) != len(head):
            raise UserError(
                f"row {k + 1} has {len(line)} fields, the first line {len(head)}", file=path
            )
    return [dict(zip(head, line, strict=True)) for line in lines]


def _number(row: Mapping[str, Any], name: str, index: int, path: Path) -> float:
    value: Any = row.get(name)
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise UserError(
            f"sample {index + 1}: {name} {value!r} is no number", file=path
        ) from error
    if not math.isfinite(number):
        raise UserError(f"sample {index + 1}: {name} {value!r} is not finite", file=path)
    return number
