"""COLMAP's models, text and binary: cameras, images, rigs and frames.

COLMAP counts pixels from the corner of the picture, its centres are at .5; we count from the
centre of the first. The files are read here, not by pycolmap, which needs all of a model's
points for its cameras and waits for ever on some broken files.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.formats import foreign
from chromeball.calibrate.formats.named import (
    Hints,
    Loss,
    NamedCamera,
    brown,
    core_and_terms,
    fisheye,
    number,
    numbers,
    picture_size,
)
from chromeball.calibrate.formats.tree import read_text
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: From our pixels to COLMAP's.
HALF = 0.5
#: Its models: number, name, parameters.
_LENSES = (
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (7, "FOV", 5),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
    (10, "THIN_PRISM_FISHEYE", 12),
    (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    (12, "SIMPLE_DIVISION", 4),
    (13, "DIVISION", 5),
    (14, "SIMPLE_FISHEYE", 3),
    (15, "FISHEYE", 4),
    (16, "EUCM", 6),
    (17, "EQUIRECTANGULAR", 2),
)
_COUNTS = {name: count for _, name, count in _LENSES}


@dataclass(frozen=True)
class _Image:
    pose: Pose
    camera: int
    name: str


def is_model(path: Path) -> bool:
    """Whether a folder, or the folder of a file, holds cameras of COLMAP's."""
    folder = path if path.is_dir() else path.parent
    files = [folder / f"cameras{suffix}" for suffix in (".bin", ".txt")]
    return any(file.is_file() for file in files) and (path.is_dir() or path.stem in _STEMS)


_STEMS = ("cameras", "images", "rigs", "frames", "points3D")


def read(path: Path, hints: Hints) -> list[NamedCamera]:
    """A camera for each image of a model, named as that; without images those of its rigs.

    `path` is the folder or one of its files; the file of rigs gives the cameras of its rig.

    Raises
    ------
    UserError
        A file is missing or broken.

    """
    folder = path if path.is_dir() else path.parent
    binary = (folder / "cameras.bin").is_file()
    if path.is_file() and path.suffix == ".txt":
        binary = False
    suffix = ".bin" if binary else ".txt"
    parts: list[Any] = []
    for stem in ("cameras", "images", "rigs"):
        file = folder / f"{stem}{suffix}"
        if stem != "cameras" and not file.is_file():
            parts.append({})
            continue
        try:
            if binary:
                parts.append(_BINARY[stem](_Bytes(_data(file))))
            else:
                parts.append(_TEXT[stem](read_text(file)))
        except (ValueError, IndexError, struct.error, OverflowError) as error:
            reason = " ".join(str(error).split())[:120]
            raise UserError(f"not a readable file of COLMAP's ({reason})", file=file) from error
        except UserError as error:
            raise UserError(error.what, file=file) from error
    cameras, images, rigs = parts
    if not cameras:
        raise UserError("no cameras in it", file=folder / f"cameras{suffix}")
    return _named(cameras, {} if path.stem == "rigs" else images, rigs, folder)


type _Lenses = dict[int, tuple[CameraModel, Loss | None]]
type _Rigs = list[dict[int, Pose]]


def _named(
    cameras: _Lenses, images: dict[int, _Image], rigs: _Rigs, folder: Path
) -> list[NamedCamera]:
    several = [rig for rig in rigs if len(rig) > 1]
    if not images and len(several) == 1:
        images = {i: _Image(p, c, f"camera{c}") for i, (c, p) in enumerate(several[0].items())}
    elif not images:
        images = {i: _Image(Pose.identity(), c, f"camera{c}") for i, c in enumerate(cameras)}
    used = [image.camera for image in images.values()]
    rig = len(several) == 1 and sorted(used) == sorted(several[0])
    found: list[NamedCamera] = []
    for _, image in sorted(images.items()):
        if image.camera not in cameras:
            raise UserError(
                f"image {image.name[:80]} is by camera {image.camera}, which is not there",
                file=folder,
            )
        camera, cost = cameras[image.camera]
        posed = camera.posed(image.pose.inverse())
        found.append(NamedCamera(image.name, posed, loss=cost, rig=rig))
    return found


# ---- lenses


def lens_of(
    model: str, size: tuple[int, int], params: NDArray[np.float64]
) -> tuple[CameraModel, Loss | None]:
    """A lens by COLMAP's name and parameters; ValueError for none of its own."""
    if model not in _COUNTS:
        raise ValueError(f"COLMAP has no lens {model[:40]!r}")
    if len(params) != _COUNTS[model]:
        raise ValueError(f"{model} has {_COUNTS[model]} parameters, not {len(params)}")
    if model == "EQUIRECTANGULAR":
        return CameraModel("latlong", np.zeros(0), size), None
    single = model.startswith(("SIMPLE_", "RADIAL"))  # one focal length
    core = params[[0, 0, 1, 2]] if single else params[:4]
    k = params[3:] if single else params[4:]
    core = core - [0, 0, HALF, HALF]
    if core[:2].min() <= 0:
        raise ValueError("a focal length is not positive")
    match model:
        case "SIMPLE_PINHOLE" | "PINHOLE":
            return brown(core, [], size), None
        case "SIMPLE_RADIAL":
            return brown(core, [k[0], 0, 0, 0], size), None
        case "RADIAL":
            return brown(core, [k[0], k[1], 0, 0], size), None
        case "OPENCV" | "FULL_OPENCV":
            return brown(core, k, size), None
        case "SIMPLE_FISHEYE" | "FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE":
            return fisheye([*core, *k, *np.zeros(4 - len(k))], size), None
        case "OPENCV_FISHEYE":
            return fisheye([*core, *k], size), None
        case "THIN_PRISM_FISHEYE" if not k[6:].any():
            return fisheye([*core, *k[[0, 1, 4, 5, 2, 3]]], size), None
        case _:
            project = _by_colmap(model, size, params)
            return foreign.nearest_to(project, model, size, model="kb4_decentred")


def _by_colmap(
    model: str, size: tuple[int, int], params: NDArray[np.float64]
) -> foreign.Projection:
    """COLMAP's own projection of one of its lenses, in our pixels."""
    import pycolmap

    kind = pycolmap.CameraModelId.__members__[model]
    camera = pycolmap.Camera(model=kind, width=size[0], height=size[1], params=params)

    def project(rays: NDArray[np.float64]) -> NDArray[np.float64]:
        q = np.array(camera.img_from_cam(np.ascontiguousarray(rays)), float)
        return np.where(np.isfinite(q), q, np.nan) - HALF

    return project


def written(camera: CameraModel) -> tuple[str, list[float]]:
    """COLMAP's name and parameters of a lens."""
    if camera.model == "latlong":
        return "EQUIRECTANGULAR", [float(v) for v in camera.size]
    core, k = core_and_terms(camera)
    core = core + [0, 0, HALF, HALF]
    name = {"kb4": "OPENCV_FISHEYE", "pinhole": "PINHOLE", "LENSMODEL_OPENCV4": "OPENCV"}.get(
        camera.model, "FULL_OPENCV"
    )
    if camera.model == "kb4_decentred":
        name, k = "THIN_PRISM_FISHEYE", np.array([*k[[0, 1, 4, 5, 2, 3]], 0, 0])
    return name, [*core.tolist(), *k.tolist()]


# ---- text


def _lines(text: str) -> Iterator[list[str]]:
    for line in text.splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            yield line.split()


def _text_cameras(text: str) -> _Lenses:
    found: _Lenses = {}
    for words in _lines(text):
        key, model, width, height, *params = words
        size = picture_size(width, height)
        found[int(key)] = lens_of(model, size, np.array([number(p) for p in params], float))
    return found


def _text_images(text: str) -> dict[int, _Image]:
    found: dict[int, _Image] = {}
    lines = iter(text.splitlines())
    for line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise ValueError("a line of an image has ten words")
        pose = pose_of(numbers(list(words[1:8])))
        found[int(words[0])] = _Image(pose, int(words[8]), words[9].strip())
        next(lines, None)  # its points
    return found


def _text_rigs(text: str) -> _Rigs:
    found: _Rigs = []
    for words in _lines(text):
        rig: dict[int, Pose] = {}
        rest = iter(words[2:])
        for index in range(int(words[1])):
            kind, sensor = next(rest, ""), int(next(rest, ""))
            pose = Pose.identity()
            if index and int(next(rest, "")):
                pose = pose_of(numbers([next(rest, "") for _ in range(7)]))
            if kind == "CAMERA":
                rig[sensor] = pose
        found.append(rig)
    return found


def pose_of(values: NDArray[np.float64]) -> Pose:
    """From a quaternion, w first, and a translation."""
    norm = float(np.linalg.norm(values[:4]))
    if norm < 1e-9:
        raise ValueError("a pose is no pose")
    w, x, y, z = values[:4] / norm
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return Pose(rotation, values[4:])


def quaternion(pose: Pose) -> list[float]:
    """Quaternion, w first, and translation."""
    v = pose.rotation_vector()
    angle = float(np.linalg.norm(v))
    # sinc, which is whole at no turn at all
    xyz = v * (np.sinc(angle / (2 * np.pi)) / 2)
    return [float(np.cos(angle / 2)), *xyz.tolist(), *pose.translation.tolist()]


_TEXT = {"cameras": _text_cameras, "images": _text_images, "rigs": _text_rigs}


# ---- binary


def _data(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise UserError("not readable", file=file) from error


class _Bytes:
    """Little-endian values one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, kinds: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{kinds}", self.data, self.at)
        self.at += struct.calcsize(f"<{kinds}")
        return values

    def word(self) -> str:
        end = self.data.index(b"\0", self.at)
        word, self.at = self.data[self.at : end].decode(), end + 1
        return word

    def skip(self, count: int) -> None:
        if self.at + count > len(self.data):
            raise ValueError("it ends too early")
        self.at += count


def _binary_cameras(data: _Bytes) -> _Lenses:
    names = {key: name for key, name, _ in _LENSES}
    found: _Lenses = {}
    for _ in range(data.take("Q")[0]):
        key, kind, width, height = data.take("IiQQ")
        if kind not in names:
            raise ValueError(f"COLMAP has no lens {kind}")
        model = names[kind]
        params = numbers(list(data.take(f"{_COUNTS[model]}d")))
        found[key] = lens_of(model, picture_size(width, height), params)
    return found


def _binary_images(data: _Bytes) -> dict[int, _Image]:
    found: dict[int, _Image] = {}
    for _ in range(data.take("Q")[0]):
        key, *pose = data.take("I7d")
        (camera,) = data.take("I")
        found[key] = _Image(pose_of(numbers(pose)), camera, data.word())
        data.skip(24 * data.take("Q")[0])
    return found


def _binary_rigs(data: _Bytes) -> _Rigs:
    found: _Rigs = []
    for _ in range(data.take("Q")[0]):
        _, count = data.take("II")
        rig: dict[int, Pose] = {}
        for index in range(count):
            kind, sensor = data.take("iI")
            posed = index > 0 and data.take("B")[0]
            pose = pose_of(numbers(list(data.take("7d")))) if posed else Pose.identity()
            if kind == 0:  # a camera
                rig[sensor] = pose
        found.append(rig)
    return found


_BINARY = {"cameras": _binary_cameras, "images": _binary_images, "rigs": _binary_rigs}
