"""What a device has to offer.

A new device is a class with one of these interfaces, an entry in ``connect``, its emulator,
and the contract test that all devices share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Frame:
    """A picture (H, W, 3) uint8 RGB and when it was taken: host clocks in seconds."""

    pixels: NDArray[np.uint8]
    monotonic: float
    wall: float


@runtime_checkable
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


@runtime_checkable
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
