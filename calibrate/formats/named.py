"""What the readers and writers of camera files speak: a camera with a name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: No number of a camera is as large; products of such numbers are finite.
LARGEST = 1e18
#: A rotation in a file may be this far from one before it is none.
_ROTATION_SLACK = 1e-3


@dataclass(frozen=True)
class Loss:
    """What a change of lens model cost.

    ``was`` and ``now`` name the models; ``rms`` and ``worst`` are distances in pixels over the
    picture, or over its ``part``; ``left_out`` is the share of it whose directions the new
    model does not reach. The camera is ``turned`` by so many radians, its pose with it.
    """

    was: str
    now: str
    rms: float
    worst: float
    left_out: float = 0.0
    part: str = "the picture"
    turned: float = 0.0


@dataclass(frozen=True)
class NamedCamera:
    """A camera of a file.

    ``camera`` is posed in the file's world, turned to +Y up where the file says how, or on the
    rig. ``time_shift`` seconds are added to the camera's times to get the rig's, None where the
    file says nothing. ``loss``: the lens was changed to a model of ours. ``source``: the
    ``.cameramodel`` with more in it than the camera, kept when it is written unchanged but for
    its pose. ``rig``: it stands fixed to the others of its file. ``notes``: what the file left
    open, or said that a camera of ours does not hold, one line each.
    """

    name: str
    camera: CameraModel
    time_shift: float | None = None
    loss: Loss | None = None
    source: Path | None = None
    rig: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Hints:
    """What a person knows of a file that does not say it.

    ``size`` width and height in pixels; ``fisheye``: four unmarked distortion terms of OpenCV
    are k1 to k4 of its fisheye, or k1 k2 p1 p2; None where it is not known.
    """

    size: tuple[int, int] | None = None
    fisheye: bool | None = None


def number(value: object) -> float:
    """A finite number, given as one or in writing; ValueError for all else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError("a number is missing")
    found = float(value)
    if not abs(found) < LARGEST:
        raise ValueError("a number is not finite, or larger than any of a camera")
    return found


def numbers(value: object, count: int | None = None) -> NDArray[np.float64]:
    """Numbers of lists in lists, flat; ValueError where they are not `count`."""
    if isinstance(value, list):
        found = [v for item in value for v in numbers(item).tolist()]
    else:
        found = [number(value)]
    if count is not None and len(found) != count:
        raise ValueError(f"{count} numbers are needed where there are {len(found)}")
    return np.array(found, float)


def picture_size(width: object, height: object) -> tuple[int, int]:
    """Width and height in pixels; ValueError where they are none."""
    size = (number(width), number(height))
    if not all(1 <= v < 1e6 and v == int(v) for v in size):
        raise ValueError("width and height of the picture are whole positive pixels")
    return int(size[0]), int(size[1])


def rigid(matrix: ArrayLike) -> Pose:
    """The pose of a (3, 4) or (4, 4) matrix, its rotation made exact; ValueError for none."""
    m = np.asarray(matrix, float)
    if m.shape not in ((3, 4), (4, 4)) or not (np.abs(m) < LARGEST).all():
        raise ValueError("a pose is a matrix of 3 or 4 rows and 4 columns")
    u, _, vt = np.linalg.svd(m[:3, :3])
    rotation = u @ vt
    if np.abs(rotation - m[:3, :3]).max() > _ROTATION_SLACK or np.linalg.det(rotation) < 0:
        raise ValueError("the matrix of a pose is no rotation")
    return Pose(rotation, m[:3, 3])


def fisheye(
    intrinsics: ArrayLike, size: tuple[int, int], pose: Pose | None = None
) -> CameraModel:
    """Kannala and Brandt's lens, up to the angle where its radius stops to grow.

    `intrinsics` fx fy cx cy k1 k2 k3 k4, and p1 p2 where it is decentred.
    """
    values = np.asarray(intrinsics, float)
    theta = np.linspace(0, math.pi, 2000)
    powers = np.stack([(2 * i + 3) * theta ** (2 * i + 2) for i in range(4)], axis=-1)
    falls = np.flatnonzero(1 + powers @ values[4:8] <= 0)
    limit = float(theta[falls[0] - 1]) if len(falls) else math.pi
    model = "kb4" if len(values) == 8 else "kb4_decentred"
    return CameraModel(model, values, size, pose or Pose.identity(), limit)


def brown(
    core: ArrayLike, terms: ArrayLike, size: tuple[int, int], pose: Pose | None = None
) -> CameraModel:
    """OpenCV's lens of 0, 4, 5, 8 or 12 distortion `terms`, `core` fx fy cx cy."""
    d = np.asarray(terms, float)
    name = f"LENSMODEL_OPENCV{len(d)}" if len(d) else "pinhole"
    return CameraModel(name, np.concatenate([core, d]), size, pose or Pose.identity())


def core_and_terms(camera: CameraModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intrinsics fx fy cx cy and the distortion terms after them."""
    k = camera.intrinsics
    if len(k) == 3:
        return k[[0, 0, 1, 2]], np.zeros(0)
    return k[:4], k[4:]


def file_name(name: str) -> str:
    """A camera's name as the name of a file: no folders, no picture's suffix."""
    stem = name.replace("\\", "/").strip("/")
    head, dot, suffix = stem.rpartition(".")
    if dot and suffix.lower() in ("jpg", "jpeg", "png", "tif", "tiff", "exr", "bmp", "webp"):
        stem = head
    stem = "_".join(part for part in stem.split("/") if part not in ("", ".", ".."))
    if not stem or stem.startswith(".") or not stem.isprintable():
        raise UserError(f"a camera is named {name!r}, which is no name for a file")
    return stem


def files_of[T](named: Mapping[str, T]) -> dict[str, T]:
    """The same by file name; two cameras of one name are refused."""
    found: dict[str, T] = {}
    for name, value in named.items():
        stem = file_name(name)
        if stem in found:
            raise UserError(f"two cameras would be written as {stem}: rename one")
        found[stem] = value
    return found
