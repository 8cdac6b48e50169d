"""Picture streams: V4L2 devices and video files through OpenCV, the emulator's socket."""

from __future__ import annotations

import socket
import struct
import time

import numpy as np

from chromeball.acquire.devices import Frame
from chromeball.scene.errors import DeviceError, UserError

#: The client sends a byte for each frame that it wants. A frame on the socket: magic, sequence
#: number, monotonic seconds, height, width, then the (H, W, 3) uint8 pixels. Little endian.
HEADER = struct.Struct("<4sQdII")
MAGIC = b"CBv1"


class SocketSource:
    """The emulator's stream on a unix socket; see ``emulate/video.py`` for the other end."""

    def __init__(self, path: str, *, timeout: float = 3.0) -> None:
        self.name = f"socket:{path}"
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(timeout)
        self._sequence = -1
        try:
            self._socket.connect(path)
        except OSError as error:
            self._socket.close()
            raise DeviceError(
                f"no video here ({error.strerror or error}); is the emulator running?",
                file=path,
            ) from error

    def grab(self) -> Frame:
        """The next picture that the emulated camera exposes."""
        self._ask()
        magic, sequence, monotonic, height, width = HEADER.unpack(self._read(HEADER.size))
        if magic != MAGIC or sequence <= self._sequence or not 0 < height * width <= 2**28:
            raise DeviceError("the video stream is damaged; start it again", file=self._path)
        self._sequence = sequence
        pixels = np.frombuffer(self._read(height * width * 3), np.uint8)
        # The stream names the moment on the monotonic clock; the wall clock's follows.
        wall = time.time() - (time.monotonic() - monotonic)
        return Frame(pixels.reshape(height, width, 3), monotonic, wall)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _ask(self) -> None:
        try:
            self._socket.sendall(b"n")
        except OSError as error:
            raise DeviceError(
                f"the video broke off: {error.strerror}", file=self._path
            ) from error

    def _read(self, count: int) -> bytearray:
        data = bytearray(count)
        view, filled = memoryview(data), 0
        while filled < count:
            try:
                got = self._socket.recv_into(view[filled:])
            except TimeoutError as error:
                raise DeviceError("the video stands still", file=self._path) from error
            except OSError as error:
                raise DeviceError(
                    f"the video broke off: {error.strerror}", file=self._path
                ) from error
            if not got:
                raise DeviceError("the video ended", file=self._path)
            filled += got
        return data


class CaptureSource:
    """A V4L2 device (``live``) or a video file, through ``cv2.VideoCapture``."""

    def __init__(self, path: str, *, live: bool) -> None:
        import os

        import cv2

        self.name = f"v4l2:{path}" if live else path
        self._path = path
        self._live = live
        if not os.path.exists(path):
            kind = DeviceError if live else UserError
            raise kind("no such video device" if live else "no such video file", file=path)
        backend = cv2.CAP_V4L2 if live else cv2.CAP_ANY
        self._capture = cv2.VideoCapture(path, backend)
        if not self._capture.isOpened():
            raise DeviceError("cannot be opened as video", file=path)
        if live:
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def grab(self) -> Frame:
        """The next picture; a file's clock is its own, from zero."""
        import cv2

        read, bgr = self._capture.read()
        if not read:
            what = "delivers no picture; check the cable" if self._live else "the video ended"
            raise DeviceError(what, file=self._path)
        wall, monotonic = time.time(), time.monotonic()
        if not self._live:
            monotonic = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        pixels = np.ascontiguousarray(bgr[..., ::-1], np.uint8)
        return Frame(pixels, monotonic, wall)

    def close(self) -> None:
        """Release the device."""
        self._capture.release()
