"""Cameras and rigs in the files of other tools, in and out.

A format is a module with ``read(path, hints)``, which gives named cameras, and
``encode(cameras, path)``, which gives the bytes of its files by name, ``""`` for `path` itself.
``MODELS`` names the lens models that it holds as they are, None for any.
"""

from chromeball.calibrate.formats.named import Hints, Loss, NamedCamera
from chromeball.calibrate.formats.table import (
    FORMATS,
    Prepared,
    encoded,
    format_for,
    prepared,
    read_camera,
    read_cameras,
    read_lenses,
    write_cameras,
)

__all__ = [
    "FORMATS",
    "Hints",
    "Loss",
    "NamedCamera",
    "Prepared",
    "encoded",
    "format_for",
    "prepared",
    "read_camera",
    "read_cameras",
    "read_lenses",
    "write_cameras",
]
