"""``tracker.json``: a calibrated tracker on disk, and what it tells of other pictures."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from chromeball.calibrate.tracker import TrackerSolution
from chromeball.calibrate.tracker_log import TrackerLog, sample
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import decode, to_json, write_text

type Array = NDArray[np.float64]
type Vector = tuple[float, float, float]

#: The unknowns in the order of the covariance.
UNKNOWNS = (
    *(f"sensor_from_camera.{k}" for k in ("rx", "ry", "rz", "x", "y", "z")),
    *(f"tracker_from_board.{k}" for k in ("rx", "ry", "rz", "x", "y", "z")),
    "delay",
)


class Rigid(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A pose: axis times angle in radians, and metres."""

    rotation_vector: Vector
    translation: Vector

    @classmethod
    def of(cls, pose: Pose) -> Rigid:
        """From a pose."""
        turn, shift = (tuple(v.tolist()) for v in (pose.rotation_vector(), pose.translation))
        return cls(rotation_vector=turn, translation=shift)

    def pose(self) -> Pose:
        """As a pose."""
        return Pose.from_rotation_vector(list(self.rotation_vector), list(self.translation))


class TrackerFile(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file: seconds, metres, radians.

    ``delay`` is log time minus picture time. ``covariance`` (13, 13) in the order of
    ``unknowns``; turns are about the axes of the pose's outer side. ``position_noise`` and
    ``rotation_noise`` are the tracker's, an axis.
    """

    version: Literal[1] = 1
    sensor_from_camera: Rigid
    tracker_from_board: Rigid
    delay: float
    delay_estimated: bool
    position_noise: Annotated[float, Meta(gt=0)]
    rotation_noise: Annotated[float, Meta(gt=0)]
    unknowns: tuple[str, ...] = UNKNOWNS
    covariance: list[list[float]]


def write_tracker(path: str | os.PathLike[str], found: TrackerSolution) -> None:
    """Write ``tracker.json``, whole or not at all."""
    content = TrackerFile(
        sensor_from_camera=Rigid.of(found.sensor_from_camera),
        tracker_from_board=Rigid.of(found.tracker_from_board),
        delay=found.delay,
        delay_estimated=found.delay_estimated,
        position_noise=found.noise.position,
        rotation_noise=found.noise.rotation,
        covariance=found.covariance.tolist(),
    )
    write_text(
        path, msgspec.json.format(msgspec.json.encode(content), indent=1).decode() + "\n"
    )


def read_tracker(path: str | os.PathLike[str]) -> TrackerFile:
    """Read ``tracker.json``.

    Raises
    ------
    UserError
        No such file, another kind of file, not JSON, an unknown or missing key, a covariance of
        another size.

    """
    file = Path(path)
    if file.suffix != ".json" or file.name.endswith(".record.json"):
        kind = "a record" if file.suffix == ".json" else "another kind of file"
        raise UserError(
            f"{kind}: what is needed is the tracker.json that `calibrate tracker` wrote, which "
            "holds where the camera sits on the sensor",
            file=path,
        )
    try:
        content = decode(file.read_bytes(), TrackerFile, path)
    except FileNotFoundError as error:
        raise UserError("no such file; `calibrate tracker` makes one", file=path) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path) from error
    if [len(row) for row in content.covariance] != [len(UNKNOWNS)] * len(UNKNOWNS):
        raise UserError("its covariance is not 13 x 13", file=path)
    return content


def camera_poses(
    tracker: TrackerFile, log: TrackerLog, times: Array, window: float = 0.0
) -> tuple[list[Pose], Array]:
    """Where the camera was at `times` (V,) seconds on the pictures' clock.

    Returns V poses ``tracker_from_camera`` and the standard deviation of their turns an axis,
    radians, (V,): the tracker's noise in them and that of the calibration.

    Raises
    ------
    UserError
        When the log does not reach a picture.

    """
    from chromeball.calibrate.tracker_log import reached

    there = times + tracker.delay
    if not reached(log, there, window).all():
        late = int(np.argmin(reached(log, there, window))) + 1
        raise UserError(f"the log does not cover picture {late}, or has a gap there")
    sensor = sample(log, there, window)
    on = tracker.sensor_from_camera.pose()
    poses = [Pose(r, t) @ on for r, t in zip(sensor.rotations, sensor.positions, strict=True)]
    shared = np.array(tracker.covariance)
    spin = (sensor.spins**2).sum(axis=1) * shared[12, 12] / 3
    turn = float(np.trace(shared[:3, :3])) / 3
    return poses, np.sqrt(sensor.variance * tracker.rotation_noise**2 + turn + spin)


def figures(found: TrackerSolution, files: Sequence[Path]) -> dict[str, Any]:
    """Figures of quality for the record."""
    errors = found.standard_errors
    views = [
        {
            "file": str(file),
            "used": bool(used),
            "turn_degrees": math.degrees(turn),
            "place_mm": place * 1e3,
        }
        for file, used, turn, place in zip(
            files, found.used, found.turn_errors, found.place_errors, strict=True
        )
    ]
    return {
        "pictures": len(files),
        "pictures_used": int(found.used.sum()),
        "sensor_from_camera_turn_degrees": np.degrees(
            found.sensor_from_camera.rotation_vector()
        ),
        "sensor_from_camera_place_mm": found.sensor_from_camera.translation * 1e3,
        "sigma_turn_degrees": np.degrees(errors[:3]),
        "sigma_place_mm": errors[3:6] * 1e3,
        "sigma_board_turn_degrees": np.degrees(errors[6:9]),
        "sigma_board_place_mm": errors[9:12] * 1e3,
        "delay_ms": found.delay * 1e3,
        "sigma_delay_ms": errors[12] * 1e3,
        "delay_estimated": found.delay_estimated,
        "tracker_noise_mm": found.noise.position * 1e3,
        "tracker_noise_degrees": math.degrees(found.noise.rotation),
        "corner_noise_px": found.noise.pixel,
        "tracker_scale": found.scale,
        "sigma_tracker_scale": found.sigma_scale,
        "condition": found.condition,
        "views": to_json(views),
    }
