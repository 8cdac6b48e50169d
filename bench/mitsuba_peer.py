"""Mitsuba 3 (Jakob et al. 2022) on our scenes: the same triangles, camera and light.

Choose its variant with ``mitsuba.set_variant`` before anything here is called.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.mesh import Mesh, Values
from chromeball.scene.pose import Pose

type Entry = dict[str, Any]


def load(variant: str) -> Any:
    """The module ``mitsuba`` with a variant set; ImportError where it is not installed.

    ImportError, too, where the variant needs a library that is missing (LLVM's).
    """
    mi: Any = importlib.import_module("mitsuba")
    mi.set_variant(variant)
    return mi


def diffuse(color: Values) -> Entry:
    """A Lambertian surface."""
    return {"type": "diffuse", "reflectance": rgb(color)}


def rgb(value: Values) -> Entry:
    """A colour, or a grey."""
    return {"type": "rgb", "value": vector(value)}


def environment(pixels: NDArray[np.float32], **options: Any) -> Entry:
    """A lat-long map (h, w, 3), our axes; the radiance of every direction is ours.

    Mitsuba puts the first and the last row at the poles, we put rows at pixel centres: a map
    of 2 h + 1 rows has a row at each of ours and one between, so that both interpolate alike.
    """
    mi: Any = importlib.import_module("mitsuba")
    height = len(pixels)
    v = np.clip(np.arange(2 * height + 1) / 2 - 0.5, 0, height - 1)
    row = np.minimum(v.astype(int), height - 2)
    b = (v - row)[:, None, None].astype(np.float32)
    finer = (1 - b) * pixels[row] + b * pixels[row + 1]
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(finer)), **options}


def shape(name: str, mesh: Mesh, bsdf: Entry) -> Any:
    """All triangles of `mesh` with one surface, smooth where it has normals."""
    mi: Any = importlib.import_module("mitsuba")
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh(
        name,
        len(mesh.vertices),
        len(mesh.faces),
        props=properties,
        has_vertex_normals=mesh.normals is not None,
    )
    arrays = mi.traverse(made)
    arrays["vertex_positions"] = mesh.vertices.ravel()
    arrays["faces"] = mesh.faces.ravel()
    if mesh.normals is not None:
        arrays["vertex_normals"] = mesh.normals.ravel()
    arrays.update()
    return made


def looking(
    place: Values, target: Values, scale: Values = 1.0, up: Values = (0.0, 1.0, 0.0)
) -> Any:
    """World from what stands at `place`, scaled and turned towards `target`."""
    mi: Any = importlib.import_module("mitsuba")
    to = mi.ScalarTransform4f().look_at(
        origin=vector(place), target=vector(target), up=vector(up)
    )
    return to @ mi.ScalarTransform4f().scale(vector(scale))


def vector(value: Values) -> list[float]:
    """Three numbers."""
    return [float(x) for x in np.broadcast_to(np.asarray(value, float), 3)]


def pinhole(size: tuple[int, int], fov: float, pose: Pose, sampler: str) -> Entry:
    """Our ``CameraModel.pinhole(size, fov, pose)``, pixels as boxes."""
    place, forward, down = pose.translation, pose.rotation[:, 2], pose.rotation[:, 1]
    return {
        "type": "perspective",
        "fov": math.degrees(fov),
        "fov_axis": "x",
        "to_world": looking(place, place + forward, up=-down),
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": sampler},
    }


def scene(sensor: Entry, parts: Mapping[str, Any], depth: int) -> Any:
    """A scene of `parts` for the path tracer: paths of `depth` edges (2: direct light)."""
    mi: Any = importlib.import_module("mitsuba")
    integrator = {"type": "path", "max_depth": depth, "rr_depth": 1000}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **parts})


def render(scene: Any, samples: int, seed: int) -> NDArray[np.float32]:
    """Radiance (H, W, 3)."""
    mi: Any = importlib.import_module("mitsuba")
    return np.array(mi.render(scene, spp=samples, seed=seed), np.float32)
