"""Names of the maps, for the command line: no import of numpy."""

from typing import Literal

#: Every map of the table in :mod:`chromeball.envmap.mapping`.
type Name = Literal[
    "latlong",
    "mirror",
    "angular",
    "paraboloid",
    "octahedral",
    "cube",
    "cube-vertical",
    "cube-strip",
    "cube-column",
]
#: And what needs more than a size: a camera, or six files.
type Kind = Name | Literal["fisheye", "cube-files"]
