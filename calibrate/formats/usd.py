"""OpenUSD: cameras of a stage, +Y up, looking along -Z, in the stage's metres.

Perspective is written as UsdGeom has it, focal length, apertures and their offsets; distortion
as the ``OmniLensDistortion`` schemas of NVIDIA's renderers, OpenUSD itself having none; and all
of it once more, in double precision, as ``chromeball:`` attributes, which are read back.
Apertures and those schemas measure the picture from its corner.
"""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.formats.named import (
    Hints,
    NamedCamera,
    brown,
    core_and_terms,
    fisheye,
    number,
    numbers,
    picture_size,
    rigid,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

TITLE = "OpenUSD"
#: Every lens goes into its own attributes, whatever other programs make of it.
MODELS: tuple[str, ...] | None = None
#: Width of the sensor that focal lengths are written for, tenths of a metre: 36 mm.
APERTURE = 0.36
#: From the axes of a camera of ours to a camera of USD's, x right, y up, z backwards.
USD_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
#: From a stage with +Z up.
_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])

_PINHOLE: tuple[str, ...] = (
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
    "k4",
    "k5",
    "k6",
    "s1",
    "s2",
    "s3",
    "s4",
)


def read(path: Path, hints: Hints) -> list[NamedCamera]:
    """The cameras of a stage, moving ones where they are first.

    Raises
    ------
    UserError
        OpenUSD is not installed, the stage is broken, or a camera of another program does not
        tell its picture's size.

    """
    try:
        errors, usd, geometry = (_library(name) for name in ("Tf", "Usd", "UsdGeom"))
    except ImportError as error:
        raise UserError(
            "reading USD needs usd-core: uv pip install usd-core", file=path
        ) from error
    if not path.is_file():
        raise UserError("no such file", file=path)
    try:
        stage = usd.Stage.Open(str(path))
    except errors.ErrorException as error:
        raise UserError("not a readable USD stage", file=path) from error
    metres = float(geometry.GetStageMetersPerUnit(stage))
    up = _Y_UP if geometry.GetStageUpAxis(stage) == geometry.Tokens.z else np.eye(3)
    found: list[NamedCamera] = []
    prims = [prim for prim in stage.Traverse() if prim.IsA(geometry.Camera)]
    for prim in prims:
        camera = geometry.Camera(prim)
        time = usd.TimeCode.EarliestTime()
        try:
            matrix = np.array(camera.ComputeLocalToWorldTransform(time), float).T
            pose = _pose(matrix, metres, up)
            values = {a.GetName(): a.Get(time) for a in prim.GetAttributes() if a.HasValue()}
            lens = _lens(values, hints)
        except (ValueError, TypeError, OverflowError) as error:
            raise UserError(f"camera {prim.GetPath()}: {error}", file=path) from error
        except UserError as error:
            raise UserError(f"camera {prim.GetPath()}: {error.what}", file=path) from error
        name = str(values.get("chromeball:name", prim.GetName()))
        notes = ("it moves: taken where it is first",) if _moves(camera, stage) else ()
        rig = prim.GetParent().GetName() == "Rig" and len(prims) > 1
        found.append(NamedCamera(name, lens.posed(pose), rig=rig, notes=notes))
    if not found:
        raise UserError("no cameras on this stage", file=path)
    return found


def _library(name: str) -> Any:
    """A module of OpenUSD, which tells no types."""
    return importlib.import_module(f"pxr.{name}")


def _moves(camera: Any, stage: Any) -> bool:
    """Whether the camera or something that it hangs from has poses at several times."""
    prim = camera.GetPrim()
    while prim and prim.GetPath() != stage.GetPseudoRoot().GetPath():
        ops = prim.GetAttribute("xformOpOrder")
        names = list(ops.Get() or []) if ops else []
        if any(prim.GetAttribute(str(n)).GetNumTimeSamples() > 1 for n in names if n[0] != "!"):
            return True
        prim = prim.GetParent()
    return False


def _pose(matrix: NDArray[np.float64], metres: float, up: NDArray[np.float64]) -> Pose:
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not scale > 0:
        raise ValueError("its transform mirrors or flattens the world")
    pose = rigid(np.column_stack([matrix[:3, :3] / scale, matrix[:3, 3] * metres]))
    return Pose(up @ pose.rotation @ USD_FROM_CAMERA, up @ pose.translation)


def _lens(values: dict[str, Any], hints: Hints) -> CameraModel:
    if "chromeball:model" in values:
        size = picture_size(*(int(v) for v in values["chromeball:imageSize"]))
        intrinsics = np.array(values["chromeball:intrinsics"], float)
        limit = float(values.get("chromeball:maxAngle", math.pi))
        return CameraModel(str(values["chromeball:model"]), intrinsics, size, max_angle=limit)
    kind = values.get("omni:lensdistortion:model")
    if kind in ("opencvPinhole", "opencvFisheye"):
        prefix = f"omni:lensdistortion:{kind}:"
        size = picture_size(*(int(v) for v in values[f"{prefix}imageSize"]))
        core = numbers([values[f"{prefix}{n}"] for n in ("fx", "fy", "cx", "cy")])
        core = core - [0, 0, 0.5, 0.5]
        if kind == "opencvFisheye":
            k = [values.get(f"{prefix}k{i}", 0.0) for i in (1, 2, 3, 4)]
            return fisheye([*core, *numbers(k)], size)
        return brown(core, numbers([values.get(f"{prefix}{n}", 0.0) for n in _PINHOLE]), size)
    if isinstance(kind, str) and kind not in ("", "pinhole"):
        raise UserError(f"its lens is {kind[:40]!r}; opencvPinhole and opencvFisheye are read")
    if values.get("projection", "perspective") != "perspective":
        raise UserError("it is orthographic, and no lens here is")
    if hints.size is None:
        raise UserError("it does not tell the picture's size: add --size WIDTHxHEIGHT")
    focal, wide, high = (
        number(float(values.get(name, standard)))
        for name, standard in (
            ("focalLength", 50.0),
            ("horizontalAperture", 20.955),
            ("verticalAperture", 15.2908),
        )
    )
    if min(focal, wide, high) <= 0:
        raise ValueError("its focal length and apertures are not positive")
    right = number(float(values.get("horizontalApertureOffset", 0.0))) / wide
    upward = number(float(values.get("verticalApertureOffset", 0.0))) / high
    width, height = hints.size
    perspective = [
        focal / wide * width,
        focal / high * height,
        width * (0.5 - right) - 0.5,
        height * (0.5 + upward) - 0.5,
    ]
    return brown(perspective, [], hints.size)


def encode(cameras: Sequence[NamedCamera], path: Path) -> dict[str, bytes]:
    """A stage in text, as ``{"": bytes}``.

    Raises
    ------
    UserError
        For a panorama, which no camera of USD's is, and names that become one.

    """
    names = [_identifier(named.name) for named in cameras]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"two cameras would be written as {name}: rename one", file=path)
    body = "\n".join(_camera(name, named) for name, named in zip(names, cameras, strict=True))
    rig = len(cameras) > 1 and all(named.rig for named in cameras)
    root = "Rig" if rig else "Cameras"
    text = f"""#usda 1.0
(
    defaultPrim = "{root}"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "{root}"
{{
{body}}}
"""
    return {"": text.encode()}


def _identifier(name: str) -> str:
    word = re.sub(r"\W", "_", name, flags=re.ASCII)
    return word if word[:1].isalpha() else f"_{word}"


def _camera(identifier: str, named: NamedCamera) -> str:
    camera = named.camera
    if camera.model in ("latlong", "cube"):
        raise UserError(f"{named.name} is a panorama, which no camera of USD's is")
    (fx, fy, cx, cy), terms = core_and_terms(camera)
    width, height = camera.size
    pose = camera.world_from_camera
    matrix = np.eye(4)
    matrix[:3, :3] = pose.rotation @ USD_FROM_CAMERA.T
    matrix[:3, 3] = pose.translation
    rows = ", ".join(f"({', '.join(repr(float(v)) for v in row)})" for row in matrix.T)
    focal = fx * APERTURE / width
    high = height * focal / fy
    lines = [
        f"float focalLength = {focal:.9g}",
        f"float horizontalAperture = {APERTURE:.9g}",
        f"float verticalAperture = {high:.9g}",
        f"float horizontalApertureOffset = {(0.5 - (cx + 0.5) / width) * APERTURE:.9g}",
        f"float verticalApertureOffset = {((cy + 0.5) / height - 0.5) * high:.9g}",
        "float2 clippingRange = (0.01, 10000)",
        *_distortion(camera, [fx, fy, cx + 0.5, cy + 0.5], terms),
        f'custom string chromeball:name = "{_escaped(named.name)}"',
        f'custom token chromeball:model = "{camera.model}"',
        f"custom double[] chromeball:intrinsics = [{_numbers(camera.intrinsics)}]",
        f"custom int2 chromeball:imageSize = ({width}, {height})",
        f"custom double chromeball:maxAngle = {camera.max_angle!r}",
        f"matrix4d xformOp:transform = ( {rows} )",
        'uniform token[] xformOpOrder = ["xformOp:transform"]',
    ]
    schema = _schema(camera)
    head = f'(\n        prepend apiSchemas = ["{schema}"]\n    )\n    ' if schema else ""
    inside = "\n".join(f"        {line}" for line in lines)
    return f'    def Camera "{identifier}" {head}{{\n{inside}\n    }}\n'


def _schema(camera: CameraModel) -> str | None:
    if camera.model in ("kb4", "equidistant"):
        return "OmniLensDistortionOpenCvFisheyeAPI"
    return "OmniLensDistortionOpenCvPinholeAPI" if "OPENCV" in camera.model else None


def _distortion(
    camera: CameraModel, core: Sequence[float], terms: NDArray[np.float64]
) -> list[str]:
    """Attributes of the schema that holds the lens; `core` is in pixels from the corner."""
    schema = _schema(camera)
    if schema is None:
        return []
    kind, names = "opencvPinhole", _PINHOLE[: len(terms)]
    if "Fisheye" in schema:
        kind, names = "opencvFisheye", ("k1", "k2", "k3", "k4")
        terms = terms if len(terms) else np.zeros(4)
    prefix = f"omni:lensdistortion:{kind}:"
    pairs = zip(("fx", "fy", "cx", "cy", *names), [*core, *terms], strict=True)
    return [
        f'token omni:lensdistortion:model = "{kind}"',
        f"int2 {prefix}imageSize = ({camera.size[0]}, {camera.size[1]})",
        *(f"float {prefix}{name} = {value:.9g}" for name, value in pairs),
    ]


def left_behind(cameras: Sequence[NamedCamera]) -> list[str]:
    """What of `cameras` other programs do not see, a line each."""
    plain = [c.name for c in cameras if c.camera.model != "pinhole" and not _schema(c.camera)]
    bent = [c.name for c in cameras if _schema(c.camera)]
    lines = []
    if bent:
        lines.append(
            "USD itself has no distortion: other programs than NVIDIA's show "
            f"{', '.join(bent)} without"
        )
    if plain:
        lines.append(f"only this program sees the distortion of {', '.join(plain)}")
    return lines


def _escaped(name: str) -> str:
    kept = "".join(c if c.isprintable() else "_" for c in name)
    return kept.replace("\\", "\\\\").replace('"', '\\"')


def _numbers(values: NDArray[np.float64]) -> str:
    return ", ".join(repr(float(v)) for v in values)
