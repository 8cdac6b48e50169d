"""OpenCV's storage files, YAML, JSON and XML: one camera, or a stereo pair with R and T.

The names that are read are those of OpenCV's samples, of ROS ``camera_info`` and of what people
write beside them; written are those of OpenCV's samples.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

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
    numbers,
    picture_size,
    rigid,
)
from chromeball.calibrate.formats.tree import read_tree
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

TITLE = "OpenCV's storage"
MODELS = ("pinhole", *(f"LENSMODEL_OPENCV{n}" for n in (5, 8, 12)), "LENSMODEL_OPENCV4", "kb4")

#: Names in lower case without _ and -, before or after which stands which camera of several.
_MATRIX = "cameramatrix|intrinsicmatrix|intrinsics|mtx|k|m"
_TERMS = "distortioncoefficients|distortioncoeffs|distcoeffs|distcoeff|distortion|dist|d"
_ROTATIONS = ("r", "rvec", "rotation", "rmat")
_TRANSLATIONS = ("t", "tvec", "translation")
_NAME = re.compile(rf"(left|right)?({_MATRIX}|{_TERMS})(0|1|2|left|right|l|r)?")


def holds(tree: dict[str, Any]) -> bool:
    """Whether a tree has OpenCV's matrices of a camera."""
    return any(kind == "matrix" for kind, _ in _sorted(tree))


def holds_pose(tree: dict[str, Any]) -> bool:
    """Whether a tree has a rotation and a translation."""
    names = {_plain(name) for name in tree}
    return bool(names & set(_ROTATIONS)) and bool(names & set(_TRANSLATIONS))


def read(path: Path, hints: Hints) -> list[NamedCamera]:
    """The camera of a file, or the two of a stereo pair, the first at the origin.

    Raises
    ------
    UserError
        The file is broken, does not tell the picture's size, or four terms that could be those
        of the fisheye or of the plain lens.

    """
    return cameras_of(read_tree(path), path, hints)


def cameras_of(tree: dict[str, Any], path: Path, hints: Hints) -> list[NamedCamera]:
    """As :func:`read`, of a tree that was read."""
    found = _sorted(tree)
    flat = {_plain(name): value for name, value in tree.items()}
    cameras: list[NamedCamera] = []
    try:
        sides = sorted({side for kind, side in found if kind == "matrix"})
        if not sides:
            raise ValueError("it has no camera matrix")
        size = _size(flat) or hints.size
        if size is None:
            raise UserError("it does not tell the picture's size: add --size WIDTHxHEIGHT")
        poses = _poses(flat, len(sides))
        names = _names(flat, path.stem, len(sides))
        if len(sides) > 2:
            raise ValueError(f"it has {len(sides)} camera matrices; a pair has two")
        for side, pose, name in zip(sides, poses, names, strict=True):
            core = _core(found["matrix", side])
            terms = _vector(found["terms", side]) if ("terms", side) in found else np.zeros(0)
            camera, cost = _lens(core, terms, _is_fisheye(flat, hints), size)
            cameras.append(NamedCamera(name, camera.posed(pose), loss=cost, rig=len(sides) > 1))
        if len(sides) > 1 and not holds_pose(tree):
            cameras = [replace(camera, rig=False) for camera in cameras]
            cameras[1] = replace(cameras[1], notes=(_unposed(path),))
    except UserError as error:
        raise UserError(error.what, file=path) from error
    except (ValueError, KeyError, OverflowError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise UserError(f"not a camera of OpenCV's: {missing}", file=path) from error
    return cameras


def _unposed(path: Path) -> str:
    """What a pair without R and T needs."""
    beside = path.with_name(path.name.replace("intrinsics", "extrinsics"))
    lies = beside != path and beside.is_file()
    where = f"{beside.name}, which lies beside it," if lies else "the file that has them"
    return (
        "no R and T in the file: where it stands is not known, and both cameras are put at the "
        f"origin; name {where} after {path.name}"
    )


def _plain(name: object) -> str:
    return re.sub(r"[_\- ]", "", str(name)).lower()


def _sorted(tree: dict[str, Any]) -> dict[tuple[str, str], Any]:
    """Camera matrices and distortion terms by kind and by which camera: "", "1", "left" ..."""
    found: dict[tuple[str, str], Any] = {}
    for name, value in tree.items():
        match = _NAME.fullmatch(_plain(name))
        if match is None or (match[1] and match[3]):
            continue
        kind = "matrix" if re.fullmatch(_MATRIX, match[2]) else "terms"
        found[kind, match[1] or match[3] or ""] = value
    return found


def _vector(value: object) -> NDArray[np.float64]:
    """The numbers of OpenCV's matrix or of lists in lists."""
    if isinstance(value, dict):
        count = None
        if "rows" in value and "cols" in value:
            count = int(numbers(value["rows"], 1)[0]) * int(numbers(value["cols"], 1)[0])
        return numbers(value["data"], count)
    return numbers(value) if value not in ([], "") else np.zeros(0)


def _core(value: object) -> NDArray[np.float64]:
    """The numbers fx fy cx cy of a camera matrix."""
    values = _vector(value)
    if len(values) == 4:
        core = values
    elif len(values) == 9:
        fx, skew, cx, y, fy, cy, *last = values.tolist()
        if [y, *last] != [0, 0, 0, 1]:
            raise ValueError("the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1]")
        if skew != 0:
            raise ValueError(
                f"the camera matrix has a skew of {skew:g}, which no lens here has"
            )
        core = np.array([fx, fy, cx, cy])
    else:
        raise ValueError("the camera matrix has not 3 x 3 numbers")
    if core[:2].min() <= 0:
        raise ValueError("a focal length is not positive")
    return core


def _size(flat: dict[str, Any]) -> tuple[int, int] | None:
    for width, height in (("imagewidth", "imageheight"), ("width", "height")):
        if width in flat and height in flat:
            return picture_size(flat[width], flat[height])
    for name in ("imagesize", "imgsize", "size", "resolution", "calibrationresolution"):
        if name in flat:
            return picture_size(*_vector(flat[name])[:2].tolist())
    return None


def _names(flat: dict[str, Any], stem: str, count: int) -> list[str]:
    named = flat.get("cameraname" if count == 1 else "cameranames")
    words = [_words(w) for w in named] if isinstance(named, list) else [_words(named)]
    if count == 1:
        return [" ".join(words).strip() or stem]
    return words if len(words) == count and all(words) else ["left", "right"]


def _words(value: object) -> str:
    return value.strip('" ') if isinstance(value, str) else ""


def _is_fisheye(flat: dict[str, Any], hints: Hints) -> bool | None:
    """Whether the terms are the fisheye's; None where the file does not say."""
    for key in ("fisheyemodel", "fisheye", "isfisheye", "usefisheye"):
        value = flat.get(key)
        if isinstance(value, bool | int | str) and str(value).lower() in _TRUTH:
            return _TRUTH[str(value).lower()]
    for key in ("distortionmodel", "cameramodel", "model", "modeltype"):
        kind = _plain(flat.get(key, ""))
        if any(word in kind for word in ("fisheye", "equidistant", "kannala", "kb4")):
            return True
        if any(word in kind for word in _RADIAL):
            return False
    return hints.fisheye


_RADIAL = ("plumb", "opencv", "radtan", "radialtan", "rational", "brown")
_TRUTH = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


def _lens(
    core: NDArray[np.float64],
    terms: NDArray[np.float64],
    is_fisheye: bool | None,
    size: tuple[int, int],
) -> tuple[CameraModel, Loss | None]:
    if len(terms) not in (0, 4, 5, 8, 12, 14):
        raise ValueError(f"{len(terms)} distortion terms, where OpenCV has 4, 5, 8, 12 or 14")
    if is_fisheye:
        if len(terms) not in (0, 4):
            raise ValueError(f"a fisheye has 4 distortion terms, not {len(terms)}")
        return fisheye([*core, *(terms if len(terms) else np.zeros(4))], size), None
    if len(terms) == 4 and terms.any() and is_fisheye is None:
        raise UserError(
            "its four distortion terms may be a fisheye's k1 k2 k3 k4 or k1 k2 p1 p2: add "
            "--fisheye or --no-fisheye"
        )
    if len(terms) == 14 and terms[12:].any():
        project = foreign.opencv(core, terms)
        return foreign.nearest_to(project, "OPENCV14", size, model="LENSMODEL_OPENCV12")
    return brown(core, terms[:12], size), None


def _poses(flat: dict[str, Any], count: int) -> list[Pose]:
    """world_from_camera of each; R and T of OpenCV take points into a camera."""
    rotation = next((flat[k] for k in _ROTATIONS if k in flat), None)
    shift = next((flat[k] for k in _TRANSLATIONS if k in flat), None)
    if rotation is None or shift is None:
        return [Pose.identity()] * count
    r, t = _vector(rotation), _vector(shift)
    if len(r) not in (3, 9) or len(t) != 3:
        raise ValueError("R and T of a pose are 3 x 3 or 3 numbers, and 3")
    if len(r) == 9:
        pose = rigid(np.column_stack([r.reshape(3, 3), t]))
    else:
        pose = Pose.from_rotation_vector(r, t)
    return [Pose.identity(), pose.inverse()][-count:]


def encode(cameras: Sequence[NamedCamera], path: Path) -> dict[str, bytes]:
    """The file, as ``{"": bytes}``; lenses are of :data:`MODELS`.

    Raises
    ------
    UserError
        For more than two cameras, and for a pair of two kinds or sizes.

    """
    if len(cameras) > 2:
        raise UserError("a file of OpenCV's holds one camera or two: name a folder", file=path)
    first = cameras[0].camera
    kinds = {camera.camera.model == "kb4" for camera in cameras}
    if len(kinds) > 1 or len({camera.camera.size for camera in cameras}) > 1:
        raise UserError(
            "a stereo pair has one kind of lens and one size: name a folder", file=path
        )
    tree: dict[str, Any] = {}
    if len(cameras) == 2:
        tree["camera_names"] = [camera.name for camera in cameras]
    else:
        tree["camera_name"] = cameras[0].name
    tree |= {"image_width": first.size[0], "image_height": first.size[1]}
    for index, camera in enumerate(cameras):
        (fx, fy, cx, cy), terms = core_and_terms(camera.camera)
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        names = ("camera_matrix", "distortion_coefficients")
        if len(cameras) == 2:
            names = (f"M{index + 1}", f"D{index + 1}")
        tree |= {names[0]: matrix, names[1]: (terms if len(terms) else np.zeros(5))[:, None]}
    tree["fisheye_model"] = int(first.model == "kb4")
    camera_from_world = cameras[-1].camera.world_from_camera.inverse()
    if len(cameras) == 2:
        camera_from_world = camera_from_world @ first.world_from_camera
    tree |= {"R": camera_from_world.rotation, "T": camera_from_world.translation[:, None]}
    writer = {".json": _json, ".xml": _xml}.get(path.suffix.lower(), _yaml)
    return {"": writer(tree).encode()}


def left_behind(cameras: Sequence[NamedCamera]) -> list[str]:
    """What of `cameras` the format does not hold, a line each."""
    first = cameras[0].camera.world_from_camera
    moved = len(cameras) == 2 and not np.allclose(first.matrix(), np.eye(4), atol=1e-12)
    return [f"a pair has no world: it stands where {cameras[0].name} is"] if moved else []


def _yaml(tree: dict[str, Any]) -> str:
    lines = ["%YAML:1.0", "---"]
    for name, value in tree.items():
        if isinstance(value, np.ndarray):
            rows, cols = value.shape
            data = ", ".join(repr(float(v)) for v in value.ravel())
            lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {cols}"]
            lines += ["   dt: d", f"   data: [ {data} ]"]
        else:
            lines.append(f"{name}: {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"


def _json(tree: dict[str, Any]) -> str:
    def plain(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        rows, cols = value.shape
        head = {"type_id": "opencv-matrix", "rows": rows, "cols": cols, "dt": "d"}
        return {**head, "data": value.ravel().tolist()}

    return json.dumps({name: plain(value) for name, value in tree.items()}, indent=1) + "\n"


def _xml(tree: dict[str, Any]) -> str:
    root = ElementTree.Element("opencv_storage")
    for name, value in tree.items():
        element = ElementTree.SubElement(root, name)
        if isinstance(value, np.ndarray):
            element.set("type_id", "opencv-matrix")
            for key, item in zip(("rows", "cols"), value.shape, strict=True):
                ElementTree.SubElement(element, key).text = str(item)
            ElementTree.SubElement(element, "dt").text = "d"
            numbers_ = " ".join(repr(float(v)) for v in value.ravel())
            ElementTree.SubElement(element, "data").text = numbers_
        elif isinstance(value, list):
            for item in value:
                ElementTree.SubElement(element, "_").text = f'"{item}"'
        else:
            element.text = f'"{value}"' if isinstance(value, str) else str(value)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
