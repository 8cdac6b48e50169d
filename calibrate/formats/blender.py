"""Blender: a script that makes the cameras, and reading such a script again.

Perspective is a lens with shift. Every other lens becomes Cycles' fisheye polynomial, an angle
for each distance on the sensor; it has no decentring and square pixels, and what that costs
is measured. From Blender to here cameras come through its export of OpenUSD.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.formats.named import (
    Hints,
    Loss,
    NamedCamera,
    core_and_terms,
    number,
    numbers,
    picture_size,
    rigid,
)
from chromeball.calibrate.formats.nearest import directions
from chromeball.calibrate.formats.tree import read_text
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

TITLE = "Blender"
#: Models that are written as near as Cycles comes to them; they have an axis.
MODELS = (
    "pinhole",
    *(f"LENSMODEL_OPENCV{n}" for n in (4, 5, 8, 12)),
    *("kb4", "kb4_decentred", "equidistant", "equisolid", "stereographic", "orthographic"),
)
#: Width of the sensor, mm.
SENSOR = 36.0
#: Blender's world has +Z up: its x is ours, its y our -z, its z our y.
BLENDER_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
#: A camera of Blender's looks along -Z, y up.
_BLENDER_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])

_SCRIPT = '''"""Run in Blender (blender --python): the cameras appear in the scene, +Z up.

A fisheye, or a lens with distortion, is a panoramic camera of Cycles with its polynomial.
"""

import bpy
from mathutils import Matrix

CAMERAS = %s

scene = bpy.context.scene
for index, it in enumerate(CAMERAS):
    data = bpy.data.cameras.new(it["name"])
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = it["sensor_width"]
    data.shift_x, data.shift_y = it["shift"]
    if it["polynomial"] is None:
        data.lens = it["lens"]
    else:
        data.type = "PANO"
        lens = data if hasattr(data, "panorama_type") else data.cycles
        lens.panorama_type = "FISHEYE_LENS_POLYNOMIAL"
        lens.fisheye_fov = it["field_of_view"]
        for power, factor in enumerate(it["polynomial"]):
            setattr(lens, f"fisheye_polynomial_k{power}", factor)
        scene.render.engine = "CYCLES"
    camera = bpy.data.objects.new(it["name"], data)
    camera.matrix_world = Matrix(it["matrix_world"])
    scene.collection.objects.link(camera)
    if index == 0:
        scene.camera = camera
        scene.render.resolution_x, scene.render.resolution_y = it["size"]
        scene.render.resolution_percentage = 100
        scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = it["pixel_aspect"]
'''


def read(path: Path, hints: Hints) -> list[NamedCamera]:
    """The cameras of a script that was written here; the script is not run.

    Raises
    ------
    UserError
        It is another one, or broken.

    """
    try:
        module = ast.parse(read_text(path))
        (value,) = (
            ast.literal_eval(node.value)
            for node in module.body
            if isinstance(node, ast.Assign)
            and [t.id for t in node.targets if isinstance(t, ast.Name)] == ["CAMERAS"]
        )
        return [_camera(entry) for entry in value]
    except UserError:
        raise
    except (SyntaxError, ValueError, TypeError, KeyError, RecursionError, MemoryError) as error:
        raise UserError(
            "no cameras that were written here; from Blender export the scene as USD",
            file=path,
        ) from error


def _camera(entry: dict[str, Any]) -> NamedCamera:
    camera = CameraModel(
        str(entry["model"]),
        numbers(list(entry["intrinsics"])),
        picture_size(*entry["size"]),
        max_angle=number(entry["max_angle"]),
    )
    matrix = np.array(entry["matrix_world"], float)
    there = rigid(matrix)
    pose = Pose(
        BLENDER_FROM_WORLD.T @ there.rotation @ _BLENDER_FROM_CAMERA,
        BLENDER_FROM_WORLD.T @ there.translation,
    )
    return NamedCamera(str(entry["name"]), camera.posed(pose), rig=bool(entry.get("rig")))


@dataclass(frozen=True)
class _Polynomial:
    """Cycles' angle = -(k1 r + ... + k4 r^4), r in mm; up to `limit` radians."""

    k: NDArray[np.float64]
    limit: float
    loss: Loss


def cost(camera: CameraModel) -> Loss | None:
    """What Blender's camera misses of a lens; None for perspective."""
    return None if camera.model == "pinhole" else _polynomial(camera).loss


def _polynomial(camera: CameraModel) -> _Polynomial:
    """Fitted over the picture by least squares in angle, judged in pixels."""
    if camera.model in ("latlong", "cube"):
        raise UserError("a panorama is no camera here: take it to Blender by `envmap export`")
    pixels, rays = directions(camera)
    (_, _, cx, cy), _ = core_and_terms(camera)
    millimetres = SENSOR / camera.size[0]
    from_centre = pixels - [cx, cy]
    r = np.linalg.norm(from_centre, axis=1)
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    # Scaled to the rim, where powers of r would differ by many orders.
    rim = float(r.max())
    scaled = np.stack([(r / rim) ** i for i in (1, 2, 3, 4)], axis=1)
    factors = np.linalg.lstsq(scaled, theta, rcond=None)[0]
    angle = scaled @ factors
    along = from_centre / np.where(r > 0, r, 1)[:, None]
    seen = np.concatenate([np.sin(angle)[:, None] * along, np.cos(angle)[:, None]], axis=1)
    distance = np.linalg.norm(camera.project(seen) - pixels, axis=1)
    distance = distance[np.isfinite(distance)]
    found = Loss(
        camera.model,
        "Cycles' polynomial",
        float(np.sqrt(np.mean(distance**2))),
        float(distance.max()),
    )
    k = -factors / (rim * millimetres) ** np.arange(1, 5)
    return _Polynomial(np.array([0.0, *k]), float(max(angle.max(), theta.max())), found)


def encode(cameras: Sequence[NamedCamera], path: Path) -> dict[str, bytes]:
    """The script, as ``{"": bytes}``."""
    entries = ",\n".join(_entry(named) for named in cameras)
    return {"": (_SCRIPT % f"[\n{entries},\n]").encode()}


def _entry(named: NamedCamera) -> str:
    camera = named.camera
    (fx, fy, cx, cy), _ = core_and_terms(camera)
    width, height = camera.size
    pose = camera.world_from_camera
    matrix = np.eye(4)
    matrix[:3, :3] = BLENDER_FROM_WORLD @ pose.rotation @ _BLENDER_FROM_CAMERA.T
    matrix[:3, 3] = BLENDER_FROM_WORLD @ pose.translation
    lens = _polynomial(camera) if camera.model != "pinhole" else None
    # Pixels are fx / fy as high as wide; Blender takes no aspect below 1.
    tall = 1.0 if lens else float(fx / fy)
    # Shifts are in widths of the picture; a panoramic camera's upward one is in heights.
    unit = height if lens else width
    shift = [0.5 - (cx + 0.5) / width, ((cy + 0.5) - height / 2) * tall / unit]
    values: dict[str, Any] = {
        "name": named.name,
        "size": [width, height],
        "sensor_width": SENSOR,
        "lens": float(fx) * SENSOR / width,
        "shift": [float(v) for v in shift],
        "pixel_aspect": [max(1.0, 1 / tall), max(1.0, tall)],
        "polynomial": lens.k.tolist() if lens else None,
        "field_of_view": min(2 * lens.limit * 1.001, 2 * math.pi) if lens else None,
        "matrix_world": matrix.tolist(),
        "rig": named.rig,
        "model": camera.model,
        "intrinsics": camera.intrinsics.tolist(),
        "max_angle": camera.max_angle,
    }
    lines = "".join(f"        {key!r}: {value!r},\n" for key, value in values.items())
    return f"    {{\n{lines}    }}"


def left_behind(cameras: Sequence[NamedCamera]) -> list[str]:
    """What of `cameras` the format does not hold, a line each."""
    sizes = {named.camera.size for named in cameras}
    if len(sizes) > 1:
        return [f"Blender has one picture size: that of {cameras[0].name} is set"]
    return []
