"""``rig.json``: the cameras of a rig, where they stand, and how well all of it is known."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import decode, write_json

if TYPE_CHECKING:
    from chromeball.calibrate.rig_result import RigSolution
    from chromeball.calibrate.wand_result import WandRig


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig.

    ``camera`` is posed, world_from_camera = rig_from_camera. ``covariance`` (6, 6) of the turn
    about its own axes (radians) and its position on the rig (metres), given the first camera's.
    ``rms`` per corner and ``sigma``, the deviation of a coordinate, in pixels. In seconds: its
    pictures were taken ``time_offset`` after their stamps, their rows over ``readout``;
    None where that was not estimated. ``delay_frames``: the same of recordings without stamps.
    """

    name: str
    camera: CameraModel
    covariance: NDArray[np.float64]
    rms: float
    sigma: float
    time_offset: float | None
    time_offset_error: float | None
    readout: float | None
    readout_error: float | None
    delay_frames: float | None = None


@dataclass(frozen=True)
class Rig:
    """Cameras that hold together.

    ``unit`` of all lengths, "m" but where nothing told the scale; ``gauge`` says what the
    standard errors are relative to. ``covariance`` (6C, 6C) of all poses jointly, in the order
    of ``cameras``, and ``bow`` (2,), the board's deflection along x and y in metres: None
    without a board. ``pairs`` name two cameras and count the boards that both saw.
    """

    cameras: tuple[RigCamera, ...]
    gauge: str
    unit: str = "m"
    covariance: NDArray[np.float64] | None = None
    bow: NDArray[np.float64] | None = None
    pairs: tuple[tuple[str, str, int], ...] = ()

    def __getitem__(self, name: str) -> RigCamera:
        """The camera of that name; a :class:`UserError` where there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        names = ", ".join(camera.name for camera in self.cameras)
        raise UserError(f"the rig has no camera {name!r}; its cameras are {names}")

    def distance(self, a: str, b: str) -> tuple[float, float]:
        """Distance of two cameras and its standard error, in the rig's unit.

        Raises
        ------
        UserError
            When there is no such camera, or the errors of the two are not known jointly.

        """
        if self.covariance is None:
            raise UserError(f"how {a} and {b} err together is not known: {self.gauge}")
        places = {camera.name: i for i, camera in enumerate(self.cameras)}
        between = (
            self[b].camera.world_from_camera.translation
            - self[a].camera.world_from_camera.translation
        )
        length = float(np.linalg.norm(between))
        if length == 0:
            raise UserError(f"{a} and {b} stand at one place")
        slope = np.zeros(6 * len(self.cameras))
        for name, sign in ((a, -1), (b, 1)):
            first = 6 * places[name] + 3
            slope[first : first + 3] += sign * between / length
        return length, math.sqrt(max(float(slope @ self.covariance @ slope), 0.0))


class _Camera(msgspec.Struct):
    name: str
    lensmodel: str
    intrinsics: list[float]
    size: tuple[int, int]
    max_angle: float
    rotation: tuple[float, float, float]
    translation: tuple[float, float, float]
    covariance: list[list[float]]
    rms: float
    sigma: float
    time_offset: float | None
    time_offset_error: float | None
    readout: float | None
    readout_error: float | None
    delay_frames: float | None


class _Pair(msgspec.Struct):
    cameras: tuple[str, str]
    boards: int


class _Rig(msgspec.Struct):
    unit: str
    gauge: str
    cameras: list[_Camera]
    covariance: list[list[float]] | None
    bow: tuple[float, float] | None
    pairs: list[_Pair]


def rig_of(solution: RigSolution) -> Rig:
    """What of a `solution` other rooms need."""
    sync, cameras = solution.sync, list[RigCamera]()
    for c, (name, camera) in enumerate(zip(solution.names, solution.cameras, strict=True)):
        timed, rolled = sync is not None, sync is not None and sync.rolling
        cameras.append(
            RigCamera(
                name=name,
                camera=camera,
                covariance=solution.covariance[6 * c : 6 * c + 6, 6 * c : 6 * c + 6],
                rms=float(solution.rms[c]),
                sigma=float(solution.sigma[c]),
                time_offset=float(sync.motion.offsets[c]) if sync and timed else None,
                time_offset_error=float(sync.offset_errors[c]) if sync and timed else None,
                readout=float(sync.motion.readout[c]) if sync and rolled else None,
                readout_error=float(sync.readout_errors[c]) if sync and rolled else None,
            )
        )
    common = solution.common
    pairs = tuple(
        (solution.names[a], solution.names[b], int(common[a, b]))
        for a, b in combinations(range(len(solution.names)), 2)
    )
    gauge = f"the pose of {solution.names[0]} counts as exact"
    return Rig(tuple(cameras), gauge, "m", solution.covariance, solution.bow, pairs)


def rig_of_wand(found: WandRig, rate: float | None) -> Rig:
    """The same of lights in motion, recorded at `rate` frames a second if that is known."""
    rms = found.camera_rms()
    cameras = tuple(
        RigCamera(
            name=name,
            camera=camera,
            covariance=found.covariance[c],
            rms=float(rms[c]),
            sigma=found.sigma,
            time_offset=None if rate is None else float(found.delays[c]) / rate,
            time_offset_error=None if rate is None else float(found.delay_errors[c]) / rate,
            readout=None,
            readout_error=None,
            delay_frames=float(found.delays[c]),
        )
        for c, (name, camera) in enumerate(zip(found.names, found.cameras, strict=True))
    )
    return Rig(cameras, found.gauge(), found.unit)


def write_rig(path: str | os.PathLike[str], rig: Rig) -> None:
    """Write ``rig.json``, whole or not at all."""
    cameras = [
        {
            "name": own.name,
            "lensmodel": own.camera.model,
            "intrinsics": own.camera.intrinsics,
            "size": own.camera.size,
            "max_angle": own.camera.max_angle,
            "rotation": own.camera.world_from_camera.rotation_vector(),
            "translation": own.camera.world_from_camera.translation,
            "covariance": own.covariance,
            "rms": own.rms,
            "sigma": own.sigma,
            "time_offset": own.time_offset,
            "time_offset_error": own.time_offset_error,
            "readout": own.readout,
            "readout_error": own.readout_error,
            "delay_frames": own.delay_frames,
        }
        for own in rig.cameras
    ]
    told = {
        "unit": rig.unit,
        "gauge": rig.gauge,
        "cameras": cameras,
        "covariance": rig.covariance,
        "bow": rig.bow,
        "pairs": [{"cameras": (a, b), "boards": boards} for a, b, boards in rig.pairs],
    }
    write_json(path, told)


def read_rig(path: str | os.PathLike[str]) -> Rig:
    """Read ``rig.json``.

    Raises
    ------
    UserError
        When it is missing, no such file, or does not hold together.

    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path) from error
    read = decode(content, _Rig, path)
    cameras: list[RigCamera] = []
    for own in read.cameras:
        try:
            camera = CameraModel(
                own.lensmodel,
                np.array(own.intrinsics, float),
                own.size,
                Pose.from_rotation_vector(np.array(own.rotation), np.array(own.translation)),
                own.max_angle,
            )
        except UserError as error:
            raise UserError(f"camera {own.name}: {error.what}", file=path) from error
        cameras.append(
            RigCamera(
                own.name, camera, _square(own.covariance, 6, path), own.rms, own.sigma,
                own.time_offset, own.time_offset_error, own.readout, own.readout_error,
                own.delay_frames,
            )
        )  # fmt: skip
    jointly = read.covariance
    return Rig(
        tuple(cameras),
        read.gauge,
        read.unit,
        None if jointly is None else _square(jointly, 6 * len(cameras), path),
        None if read.bow is None else np.array(read.bow, float),
        tuple((*pair.cameras, pair.boards) for pair in read.pairs),
    )


def _square(
    rows: list[list[float]], size: int, path: str | os.PathLike[str]
) -> NDArray[np.float64]:
    if len(rows) != size or any(len(row) != size for row in rows):
        raise UserError(f"a covariance in it is not {size} x {size}", file=path)
    return np.array(rows, float)
