"""The emulated camera without a serial line and without waiting: its clock is the frame count.

For statistics over many shutter changes, where real time would take hours.
"""

from __future__ import annotations

from chromeball.acquire.devices import Frame
from chromeball.acquire.emulate.camera import Truth, VideoCamera
from chromeball.acquire.visca_packets import AutoExposure


class DirectCamera:
    """Both a shutter camera and a frame source, before one :class:`VideoCamera`."""

    def __init__(self, camera: VideoCamera) -> None:
        self.name = camera.model.name
        self.speeds = camera.model.times
        self.camera = camera
        self._frames = 0
        camera.set_mode(AutoExposure.MANUAL)

    def set_shutter(self, time: float) -> float:
        """See :class:`chromeball.acquire.devices.ShutterCamera`."""
        self.camera.set_shutter(self.speeds.index(time))
        return self.shutter()

    def shutter(self) -> float:
        """The register, not the picture."""
        return self.speeds[self.camera.position]

    def grab(self) -> Frame:
        """The next frame, at once."""
        self._frames += 1
        now = self._frames / self.camera.fps
        pixels = self.camera.tick(now, wanted=True)
        assert pixels is not None
        return Frame(pixels, now, now)

    def truth(self, monotonic: float) -> Truth:
        """What the frame grabbed at `monotonic` really was."""
        return self.camera.truth[monotonic]

    def close(self) -> None:
        """Nothing to give back."""
