"""Direction <-> pixel of every environment map (seeds.md P14), with exact pixel solid angles.

All maps share one orientation: centre +Z, up +Y, image right -X (OpenEXR's). The mirror ball
alone is a photograph of a reflection, so its image right is +X. Inside, directions are in
camera axes (x right, y down, z forward); ``world_from_camera`` turns them to the world.
Pixel centres are at integers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from chromeball.envmap.mapping.base import Mapping, pixel_grid
from chromeball.envmap.mapping.cube import (
    COLUMN,
    CROSS,
    SIX,
    STRIP,
    VERTICAL_CROSS,
    Cube,
    Face,
    Layout,
)
from chromeball.envmap.mapping.latlong import LatLong
from chromeball.envmap.mapping.lens import Lens, of_camera, parse_lens
from chromeball.envmap.mapping.octahedral import Octahedral
from chromeball.envmap.mapping.radial import (
    Radial,
    angular,
    ball_distance,
    mirror,
    mirror_ball,
    paraboloid,
)
from chromeball.scene.errors import UserError

__all__ = [
    "COLUMN",
    "CROSS",
    "MAPPINGS",
    "SIX",
    "STRIP",
    "VERTICAL_CROSS",
    "Cube",
    "Entry",
    "Face",
    "LatLong",
    "Layout",
    "Lens",
    "Mapping",
    "Octahedral",
    "Radial",
    "angular",
    "ball_distance",
    "make_mapping",
    "mirror",
    "mirror_ball",
    "of_camera",
    "paraboloid",
    "parse_lens",
    "pixel_grid",
    "sized",
]

type Size = tuple[int, int]


def _cube(layout: Layout) -> Callable[[Size], Mapping]:
    return lambda size: Cube(size, layout=layout)


@dataclass(frozen=True)
class Entry:
    """One kind of map: how to make it, and what its picture looks like.

    ``aspect`` is width to height; the width is a multiple of ``step``; ``total`` is the solid
    angle that the whole map sees, sr; ``shape`` says the picture in words.
    """

    make: Callable[[Size], Mapping]
    aspect: tuple[int, int]
    step: int = 1
    total: float = 4 * math.pi
    shape: str = ""


#: Every map that needs its size alone. A fisheye comes from its camera, `of_camera`, and a
#: mirror ball nearby from its distance, `mirror_ball`.
MAPPINGS: dict[str, Entry] = {
    "latlong": Entry(LatLong, (2, 1), 2),
    "mirror": Entry(mirror, (1, 1)),
    "angular": Entry(angular, (1, 1)),
    "paraboloid": Entry(paraboloid, (1, 1), total=2 * math.pi),
    "octahedral": Entry(Octahedral, (1, 1), 2),
    "cube": Entry(_cube(CROSS), (4, 3), 4, shape="a horizontal cross"),
    "cube-vertical": Entry(_cube(VERTICAL_CROSS), (3, 4), 3, shape="a vertical cross"),
    "cube-strip": Entry(_cube(STRIP), (6, 1), 6, shape=f"{' '.join(SIX)} in a row"),
    "cube-column": Entry(_cube(COLUMN), (1, 6), shape=f"{' '.join(SIX)} downwards"),
}


def make_mapping(name: str, size: Size) -> Mapping:
    """A named map of that size.

    Raises
    ------
    UserError
        For an unknown name or a size of the wrong shape.

    """
    entry = _entry(name)
    across, down = entry.aspect
    width, height = size
    if width * down != height * across or width % entry.step or min(size) < 1:
        raise UserError(
            f"{width}x{height} is no {name} map: it must be {across}:{down}"
            + (f", {entry.shape}" if entry.shape else "")
            + (f", its width a multiple of {entry.step}" if width % entry.step else "")
        )
    return entry.make(size)


def sized(name: str, width: int) -> Size:
    """Width and height of a named map `width` pixels across."""
    across, down = _entry(name).aspect
    return width, width * down // across


def _entry(name: str) -> Entry:
    if name not in MAPPINGS:
        raise UserError(f"unknown mapping {name!r}; one of {', '.join(MAPPINGS)}, fisheye")
    return MAPPINGS[name]
