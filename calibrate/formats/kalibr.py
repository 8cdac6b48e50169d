"""Kalibr's ``camchain.yaml``, camera from camera; in, EuRoC's ``sensor.yaml``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
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
    rigid,
)
from chromeball.calibrate.formats.tree import read_tree
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

TITLE = "Kalibr's camchain.yaml"
#: Models that the format holds as they are.
MODELS = ("pinhole", "LENSMODEL_OPENCV4", "kb4")
#: Its camera models, and how many parameters stand before the focal lengths.
_OWN = {"pinhole": 0, "omni": 1, "eucm": 2, "ds": 2}


def holds(tree: dict[str, Any]) -> bool:
    """Whether a tree is Kalibr's: a chain, or a single camera without a name."""
    return (
        isinstance(tree.get("cam0"), dict) and "camera_model" in tree["cam0"]
    ) or _is_single(tree)


def _is_single(tree: dict[str, Any]) -> bool:
    """Whether the root is one camera, as in the data sets that came with Kalibr (EuRoC)."""
    flat = isinstance(tree.get("intrinsics"), list) and len(tree["intrinsics"]) > 3
    return flat and "resolution" in tree and tree.get("camera_model") in _OWN


def read(path: Path, hints: Hints) -> list[NamedCamera]:
    """The cameras of a chain; the first stands at the origin, or where T_cam_imu puts it.

    Raises
    ------
    UserError
        The file is broken, or has a lens that is none of Kalibr's.

    """
    return cameras_of(read_tree(path), path)


def cameras_of(tree: dict[str, Any], path: Path) -> list[NamedCamera]:
    """As :func:`read`, of a tree that was read."""
    found: list[NamedCamera] = []
    if _is_single(tree):
        tree = {"cam0": tree}
    names = sorted(
        (k for k in tree if re.fullmatch(r"cam\d{1,4}", k)), key=lambda k: int(k[3:])
    )
    for name in names:
        entry = tree[name]
        try:
            if not isinstance(entry, dict):
                raise ValueError("it holds no names")
            before = found[-1].camera.world_from_camera if found else None
            pose, told = _pose(entry, before)
            camera, cost = _lens(entry, pose)
            shift = entry.get("timeshift_cam_imu")
        except (ValueError, KeyError, OverflowError) as error:
            missing = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise UserError(f"{name}: {missing}", file=path) from error
        except UserError as error:
            raise UserError(f"{name}: {error.what}", file=path) from error
        seconds = None if shift is None else number(shift)
        found.append(NamedCamera(name, camera, seconds, cost, notes=told))
    if not found:
        raise UserError("no cam0 in it", file=path)
    return [replace(named, rig=len(found) > 1) for named in found]


def _pose(entry: dict[str, Any], before: Pose | None) -> tuple[Pose, tuple[str, ...]]:
    """world_from_camera of a link of the chain."""
    if before is not None and "T_cn_cnm1" in entry:
        link = rigid(numbers(entry["T_cn_cnm1"], 16).reshape(4, 4))
        return before @ link.inverse(), ()
    if "T_cam_imu" in entry:
        return rigid(numbers(entry["T_cam_imu"], 16).reshape(4, 4)).inverse(), ()
    if "T_BS" in entry:  # EuRoC's body_from_sensor
        matrix = entry["T_BS"]
        values = numbers(matrix["data"] if isinstance(matrix, dict) else matrix, 16)
        return rigid(values.reshape(4, 4)), ()
    if before is not None:
        return Pose.identity(), (
            "no T_cn_cnm1: where it stands is not known, and it is put at the origin",
        )
    return Pose.identity(), ()


def _lens(entry: dict[str, Any], pose: Pose) -> tuple[CameraModel, Loss | None]:
    size = picture_size(*numbers(entry["resolution"], 2).tolist())
    kind, distortion = str(entry["camera_model"]), str(entry.get("distortion_model", "none"))
    own = _OWN.get(kind)
    if own is None:
        raise ValueError(f"camera_model {kind[:40]!r} is none of pinhole, omni, eucm, ds")
    values = numbers(entry["intrinsics"], 4 + own)
    parameters, core = values[:own], values[own:]
    if core[:2].min() <= 0:
        raise ValueError("a focal length is not positive")
    distortion = {"radial-tangential": "radtan"}.get(distortion, distortion)
    count = {"radtan": 4, "equidistant": 4, "fov": 1, "none": 0}.get(distortion)
    if count is None:
        raise ValueError(
            f"distortion_model {distortion[:40]!r} is none of radtan, equidistant, fov, none"
        )
    terms = numbers(entry.get("distortion_coeffs", entry.get("distortion_coefficients", [])))
    if distortion != "none" and len(terms) != count:
        raise ValueError(f"{distortion} has {count} distortion_coeffs, not {len(terms)}")
    terms = terms[:count]
    match kind, distortion:
        case "pinhole", "none" | "radtan":
            return brown(core, terms, size, pose), None
        case "pinhole", "equidistant":
            return fisheye([*core, *terms], size, pose), None
        case "pinhole", "fov":
            if not 1e-6 < terms[0] < np.pi:
                raise ValueError("the fov lens has w between 0 and pi")
            project = foreign.field_of_view(terms, core)
        case "omni", "none" | "radtan":
            if not parameters[0] >= 0:
                raise ValueError("the omni lens has xi >= 0")
            project = foreign.unified(parameters, core, terms)
        case "eucm", "none":
            if not (0 <= parameters[0] < 1 and parameters[1] > 0):
                raise ValueError("the eucm lens has 0 <= alpha < 1 and beta > 0")
            project = foreign.enhanced_unified(parameters, core)
        case "ds", "none":
            if not (0 <= parameters[1] < 1 and -1 < parameters[0] < 10):
                raise ValueError("the ds lens has -1 < xi and 0 <= alpha < 1")
            project = foreign.double_sphere(parameters, core)
        case _:
            raise ValueError(f"Kalibr has no lens {kind}-{distortion}")
    model = "kb4_decentred" if len(terms) == 4 and terms[2:].any() else "kb4"
    return foreign.nearest_to(project, f"{kind}-{distortion}", size, pose, model)


def encode(cameras: Sequence[NamedCamera], path: Path) -> dict[str, bytes]:
    """The file, as ``{"": bytes}``; lenses are of :data:`MODELS`."""
    lines: list[str] = []
    before: Pose | None = None
    for index, named in enumerate(cameras):
        camera = named.camera
        core, terms = core_and_terms(camera)
        kind = {"kb4": "equidistant", "pinhole": "none"}.get(camera.model, "radtan")
        lines += [f"cam{index}:"]
        if before is not None:
            link = camera.world_from_camera.inverse() @ before
            lines += ["  T_cn_cnm1:", *(f"  - {_row(row)}" for row in link.matrix())]
        lines += [
            "  camera_model: pinhole",
            f"  distortion_coeffs: {_row(terms)}",
            f"  distortion_model: {kind}",
            f"  intrinsics: {_row(core)}",
            f"  resolution: [{camera.size[0]}, {camera.size[1]}]",
            f"  rostopic: /{re.sub(r'\W', '_', named.name, flags=re.ASCII)}/image_raw",
        ]
        if named.time_shift is not None:
            lines.append(f"  timeshift_cam_imu: {named.time_shift!r}")
        before = camera.world_from_camera
    return {"": ("\n".join(lines) + "\n").encode()}


def left_behind(cameras: Sequence[NamedCamera]) -> list[str]:
    """What of `cameras` the format does not hold, a line each."""
    first = cameras[0].camera.world_from_camera
    moved = not np.allclose(first.matrix(), np.eye(4), atol=1e-12)
    return (
        [f"a chain has no world: cameras are placed from {cameras[0].name} on"] if moved else []
    )


def _row(values: NDArray[np.float64]) -> str:
    return f"[{', '.join(repr(float(v)) for v in values)}]"
