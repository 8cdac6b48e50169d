"""What a device has to offer, and how a command names one.

A new device is a class with one of these interfaces, an entry in :func:`open_camera` or
:func:`open_video`, its emulator, and the contract test that all devices share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError


@dataclass(frozen=True)
class Frame:
    """A picture (H, W, 3) uint8 RGB and when it was taken: host clocks in seconds."""

    pixels: NDArray[np.uint8]
    monotonic: float
    wall: float


class ShutterCamera(Protocol):
    """A camera whose shutter can be set. Every method raises :class:`DeviceError`."""

    @property
    def name(self) -> str:
        """Model and port, for messages and takes."""
        ...

    @property
    def speeds(self) -> tuple[float, ...]:
        """The exposure times it has, in seconds, longest first."""
        ...

    def set_shutter(self, time: float) -> float:
        """Set one of `speeds`; returns the time that the device reads back afterwards."""
        ...

    def shutter(self) -> float:
        """The exposure time that the device reads back now, in seconds."""
        ...

    def close(self) -> None:
        """Give the port back; may be called twice."""
        ...


class FrameSource(Protocol):
    """A free-running picture stream. Every method raises :class:`DeviceError`."""

    @property
    def name(self) -> str:
        """The specification it was opened with."""
        ...

    def grab(self) -> Frame:
        """The next picture, never one that was grabbed before."""
        ...

    def close(self) -> None:
        """Give the device back; may be called twice."""
        ...


def open_camera(spec: str) -> ShutterCamera:
    """The camera of ``visca:PORT[,model=evi-d70p][,baud=38400]``."""
    kind, _, rest = spec.partition(":")
    if kind != "visca" or not rest:
        raise UserError(f"{spec!r} names no camera; write visca:/dev/ttyUSB0")
    from chromeball.acquire.visca import MODELS, ViscaCamera

    port, *pairs = rest.split(",")
    options: dict[str, str] = {}
    for pair in pairs:
        key, _, value = pair.partition("=")
        if key not in {"model", "baud"} or not value:
            raise UserError(f"{spec!r}: unknown option {pair!r}; known: model=NAME, baud=RATE")
        options[key] = value
    model = options.get("model", "evi-d100p")
    if model not in MODELS:
        raise UserError(f"{spec!r}: no model {model!r}; known: {', '.join(MODELS)}")
    baud = options.get("baud")
    if baud is not None and not baud.isdecimal():
        raise UserError(f"{spec!r}: {baud!r} is no baud rate")
    return ViscaCamera(port, MODELS[model], bauds=(int(baud),) if baud else (9600, 38400))


def open_video(spec: str) -> FrameSource:
    """The stream of ``v4l2:/dev/video0``, ``socket:PATH`` or a video file's path."""
    from chromeball.acquire.video import CaptureSource, SocketSource

    kind, _, rest = spec.partition(":")
    match kind:
        case "socket" if rest:
            return SocketSource(rest)
        case "v4l2" if rest:
            return CaptureSource(rest, live=True)
        case _:
            return CaptureSource(spec, live=False)
