"""Where other programs expect the front of a lat-long map, and a map turned for them.

No program mirrors a map; they differ in what looks ahead, in what is up, and in how they take
over our axes (+Y up, right-handed), which is how their importers of glTF or USD do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong
from chromeball.envmap.resample import warp
from chromeball.scene.camera import WORLD_FROM_LATLONG
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Rows = tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]

#: The largest number of a 16-bit float, in which some programs keep a map.
HALF_MAX = 65504.0

_SAME: Rows = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


@dataclass(frozen=True)
class Convention:
    """How a program lays a lat-long map around its world.

    ``centre``, ``right``, ``up``: what direction of the program's own axes the middle of the
    picture, the place a quarter of its width to the right of it, and its upper edge show.
    ``own_from_world``: our world's axes as the program takes them over. ``formats`` it reads,
    the best first. ``half``: it keeps maps in 16-bit floats. ``source``: where
    this is from.
    """

    title: str
    centre: tuple[int, int, int]
    right: tuple[int, int, int]
    up: tuple[int, int, int]
    own_from_world: Rows
    formats: tuple[str, ...]
    half: bool
    source: str

    @property
    def map_from_world(self) -> Array:
        """Our world to the axes of OpenEXR's map (centre +Z, right -X, up +Y) in the picture.

        The identity where the program reads our maps as they are.
        """
        own = np.array([[-v for v in self.right], self.up, self.centre], float)
        return own @ np.array(self.own_from_world, float)

    @property
    def yaw(self) -> float:
        """Radians about +Y by which the map must be turned; all programs keep up up."""
        turn = self.map_from_world
        return math.atan2(turn[0, 2], turn[2, 2])


#: After `--for`.
CONVENTIONS: dict[str, Convention] = {
    "blender": Convention(
        "Blender (Cycles, EEVEE)",
        centre=(1, 0, 0),
        right=(0, -1, 0),
        up=(0, 0, 1),
        own_from_world=((1, 0, 0), (0, 0, -1), (0, 1, 0)),
        formats=(".exr", ".hdr"),
        half=False,
        source="direction_to_equirectangular of Cycles; rendered with bpy",
    ),
    "usd": Convention(
        "OpenUSD's DomeLight on a stage with Y up",
        centre=(0, 0, 1),
        right=(-1, 0, 0),
        up=(0, 1, 0),
        own_from_world=_SAME,
        formats=(".exr", ".hdr"),
        half=False,
        source="UsdLuxDomeLight; opened with usd-core, and rendered by way of Blender's import",
    ),
    "three": Convention(
        "three.js, and glTF's viewers on it",
        centre=(1, 0, 0),
        right=(0, 0, 1),
        up=(0, 1, 0),
        own_from_world=_SAME,
        formats=(".exr", ".hdr"),
        half=True,
        source="equirectUv of three.js; rendered in Chromium",
    ),
    "unreal": Convention(
        "Unreal Engine, a cube texture from a long-lat picture",
        centre=(0, -1, 0),
        right=(1, 0, 0),
        up=(0, 0, 1),
        own_from_world=((1, 0, 0), (0, 0, 1), (0, 1, 0)),
        formats=(".hdr", ".exr"),
        half=True,
        source="its texture compressor's lookup of long-lat pictures, as read; not rendered",
    ),
    "mitsuba": Convention(
        "Mitsuba 3's envmap",
        centre=(0, 0, 1),
        right=(-1, 0, 0),
        up=(0, 1, 0),
        own_from_world=_SAME,
        formats=(".exr", ".hdr"),
        half=False,
        source="rendered with Mitsuba",
    ),
}


@dataclass(frozen=True)
class Oriented:
    """A map turned for a program.

    ``radiance`` (H, W, 3) float32; ``exact`` if columns were moved alone; ``energy_error``
    relative, the worst channel's, 0 if exact.
    """

    radiance: NDArray[np.float32]
    exact: bool
    energy_error: float


def oriented(radiance: NDArray[np.float32], convention: Convention) -> Oriented:
    """Turn a lat-long map (H, W, 3) for a program.

    A yaw of whole pixels moves columns: the bits stay. Any other is resampled.
    """
    height, width = radiance.shape[:2]
    columns = convention.yaw / (2 * math.pi) * width
    if abs(columns - round(columns)) < 1e-9:
        # yaw about +Y moves what lies ahead to the left: image right is -X
        return Oriented(np.roll(radiance, -round(columns), axis=1), True, 0.0)
    source = LatLong((width, height))
    target = LatLong(source.size, convention.map_from_world.T @ WORLD_FROM_LATLONG.rotation)
    got = warp(radiance, source, target)
    error = float(np.max(np.abs(got.energy / np.maximum(got.source_energy, 1e-300) - 1)))
    return Oriented(got.radiance, False, error)


def convention_of(name: str) -> Convention:
    """The convention after its name.

    Raises
    ------
    UserError
        For an unknown name.

    """
    if name not in CONVENTIONS:
        raise UserError(f"unknown program {name!r}; one of {', '.join(CONVENTIONS)}")
    return CONVENTIONS[name]
