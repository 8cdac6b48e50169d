"""Other programs' conversions between maps, as their users call them.

Each is asked for the same picture; what it turns or mirrors otherwise is put right afterwards,
free of charge. skylibs and py360convert come with `uv sync --group peers`, pyequilib, with
PyTorch and CUDA behind it, with `uv pip install pyequilib`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import Cube, LatLong, Mapping, make_mapping
from chromeball.envmap.resample import Quality, warp

type Picture = NDArray[np.float32]


@dataclass(frozen=True)
class Tool:
    """What converts (H, W, 3) of a source to a target; ``knows`` the names of both maps.

    What it has nothing for, as pixels whose centre is beside a disc, is NaN.
    """

    name: str
    run: Callable[[Picture, Mapping, Mapping], Picture]
    knows: Callable[[str, str], bool] = lambda source, target: True


def tools() -> tuple[list[Tool], list[str]]:
    """Ours and all that are installed, and what is not."""
    found = [_ours("best"), _ours("fast"), *_opencv()]
    absent: list[str] = []
    for make in (_skylibs, _py360convert, _pyequilib):
        try:
            found.append(make())
        except ImportError:
            absent.append(make.__name__.lstrip("_"))
    return found, absent


def _ours(quality: Quality) -> Tool:
    def run(picture: Picture, source: Mapping, target: Mapping) -> Picture:
        result = warp(picture, source, target, quality=quality)
        return result.radiance

    return Tool("chromeball" if quality == "best" else "chromeball --fast", run)


def _opencv() -> list[Tool]:
    import cv2

    def tool(name: str, interpolation: int) -> Tool:
        def run(picture: Picture, source: Mapping, target: Mapping) -> Picture:
            d = target.directions()
            maps = source.pixels_of(np.where(np.isfinite(d), d, 1.0)).astype(np.float32)
            seen = np.isfinite(maps).all(axis=2) & np.isfinite(d).all(axis=2)
            maps = np.nan_to_num(maps, nan=-100.0)
            border = cv2.BORDER_WRAP if isinstance(source, LatLong) else cv2.BORDER_REPLICATE
            got = cv2.remap(
                picture, maps[..., 0], maps[..., 1], interpolation, borderMode=border
            )
            return np.where(seen[..., None], got, np.nan).astype(np.float32)

        return Tool(f"cv2.remap {name}", run)

    return [tool("linear", cv2.INTER_LINEAR), tool("lanczos4", cv2.INTER_LANCZOS4)]


def _between(*names: str) -> Callable[[str, str], bool]:
    """A lat-long to one of these, or back."""
    return lambda source, target: (
        "latlong" in (source, target) and (target if source == "latlong" else source) in names
    )


def _skylibs() -> Tool:
    # its package is called envmap, as a folder here is
    try:
        place = importlib.metadata.distribution("skylibs").locate_file("envmap")
    except importlib.metadata.PackageNotFoundError as error:
        raise ImportError from error
    name = "skylibs_envmap"
    spec = importlib.util.spec_from_file_location(
        name, f"{place}/__init__.py", submodule_search_locations=[str(place)]
    )
    if spec is None or spec.loader is None:
        raise ImportError
    module: Any = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)

    def run(picture: Picture, source: Mapping, target: Mapping) -> Picture:
        given = _mirrored(_upright(picture, source), source)
        into = _vertical(target) if isinstance(target, Cube) else target
        made = module.EnvironmentMap(given, _FORMATS[_kind(source)], copy=False)
        made.convertTo(_FORMATS[_kind(target)], into.size[1])
        got = _mirrored(np.asarray(made.data, np.float32), target)
        if isinstance(target, Cube):
            return _moved(got, into, target)
        return np.where(np.isfinite(target.directions()), got, np.nan).astype(np.float32)

    return Tool("skylibs", run, _between("angular", "mirror", "cube"))


_FORMATS = {"latlong": "latlong", "angular": "angular", "mirror": "sphere", "cube": "cube"}


def _kind(mapping: Mapping) -> str:
    if isinstance(mapping, Cube):
        return "cube"
    if isinstance(mapping, LatLong):
        return "latlong"
    focal: Any = getattr(mapping, "focal", (1.0, 1.0))
    return "mirror" if focal[0] < 0 else "angular"


def _mirrored(picture: Picture, mapping: Mapping) -> Picture:
    """Its mirror balls are not mirrored."""
    turned = picture[:, ::-1] if _kind(mapping) == "mirror" else picture
    return np.ascontiguousarray(turned)


def _vertical(cross: Mapping) -> Mapping:
    face = cross.size[0] // 4
    return make_mapping("cube-vertical", (3 * face, 4 * face))


def _upright(picture: Picture, source: Mapping) -> Picture:
    return _moved(picture, source, _vertical(source)) if isinstance(source, Cube) else picture


def _moved(picture: Picture, source: Mapping, target: Mapping) -> Picture:
    """The faces of one cross in the places of another."""
    d = target.directions()
    seen = np.isfinite(d).all(axis=2)
    x, y = np.moveaxis(np.rint(source.pixels_of(np.where(seen[..., None], d, 1))), -1, 0)
    return np.where(seen[..., None], picture[y.astype(int), x.astype(int)], 0).astype(
        np.float32
    )


def _py360convert() -> Tool:
    peer: Any = importlib.import_module("py360convert")

    def run(picture: Picture, source: Mapping, target: Mapping) -> Picture:
        if isinstance(target, Cube):
            return np.asarray(peer.e2c(picture, target.face), np.float32)
        width, height = target.size
        return np.asarray(peer.c2e(picture, height, width, cube_format="dice"), np.float32)

    return Tool("py360convert", run, _between("cube"))


def _pyequilib() -> Tool:
    peer: Any = importlib.import_module("equilib")
    still = {"roll": 0.0, "pitch": 0.0, "yaw": 0.0}

    def run(picture: Picture, source: Mapping, target: Mapping) -> Picture:
        planes = np.ascontiguousarray(np.moveaxis(picture, -1, 0))
        if isinstance(target, Cube):
            made = peer.equi2cube(
                planes, still, w_face=target.face, cube_format="dice", clip_output=False
            )
        else:
            width, height = target.size
            made = peer.cube2equi(planes, "dice", height=height, width=width, clip_output=False)
        return np.ascontiguousarray(np.moveaxis(np.asarray(made, np.float32), 0, -1))

    return Tool("pyequilib", run, _between("cube"))
