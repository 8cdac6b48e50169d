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


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig.

    ``camera`` is posed, world_from_camera = rig_from_camera. ``covariance`` (6, 6) of the turn
    about its own axes (radians) and its position on the rig (metres), given the first camera's.
    ``rms`` per corner and ``sigma``, the deviation of a coordinate, in pixels. In seconds: its
    pictures were taken ``time_offset`` after their stamps, their rows over ``readout``;
    None where that was not estimated.
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


@dataclass(frozen=True)
class Rig:
    """Cameras that hold together; the first is the rig's origin.

    ``covariance`` (6C, 6C) of all poses jointly, in the order of ``cameras``; ``bow`` (2,) the
    board's deflection along x and y, metres.
    """

    cameras: tuple[RigCamera, ...]
    covariance: NDArray[np.float64]
    bow: NDArray[np.float64]

    def __getitem__(self, name: str) -> RigCamera:
        """The camera of that name; a :class:`UserError` where there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        names = ", ".join(camera.name for camera in self.cameras)
        raise UserError(f"the rig has no camera {name!r}; its cameras are {names}")

    def distance(self, a: str, b: str) -> tuple[float, float]:
        """Distance of two cameras and its standard error, metres."""
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


class _Pair(msgspec.Struct):
    cameras: tuple[str, str]
    boards: int


class _Rig(msgspec.Struct):
    cameras: list[_Camera]
    covariance: list[list[float]]
    bow: tuple[float, float]
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
    return Rig(tuple(cameras), solution.covariance, solution.bow)


def write_rig(path: str | os.PathLike[str], solution: RigSolution) -> None:
    """Write ``rig.json``, whole or not at all."""
    rig = rig_of(solution)
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
        }
        for own in rig.cameras
    ]
    common = solution.common
    pairs = [
        {"cameras": (solution.names[a], solution.names[b]), "boards": int(common[a, b])}
        for a, b in combinations(range(len(solution.names)), 2)
    ]
    write_json(
        path,
        {"cameras": cameras, "covariance": rig.covariance, "bow": rig.bow, "pairs": pairs},
    )


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
    covariance = _square(read.covariance, 6 * len(read.cameras), path)
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
            )
        )  # fmt: skip
    return Rig(tuple(cameras), covariance, np.array(read.bow, float))


def _square(
    rows: list[list[float]], size: int, path: str | os.PathLike[str]
) -> NDArray[np.float64]:
    if len(rows) != size or any(len(row) != size for row in rows):
        raise UserError(f"a covariance in it is not {size} x {size}", file=path)
    return np.array(rows, float)
