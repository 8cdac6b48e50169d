"""The video side of an emulated camera: a free-running stream on a unix socket.

A client asks with a byte and is sent the next frame that is exposed; what it does not ask for
in time, it misses, so nothing stale waits in a buffer. The frames' layout is that of
:data:`chromeball.acquire.video.HEADER`.
"""

from __future__ import annotations

import os
import selectors
import socket
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from chromeball.acquire.emulate.camera import VideoCamera
from chromeball.acquire.video import HEADER, MAGIC
from chromeball.scene.errors import UserError


@dataclass
class _Client:
    socket: socket.socket
    asks: bool = False
    unsent: list[memoryview] = field(default_factory=list[memoryview])


class VideoServer:
    """Frames of `camera` on the unix socket `path`; use as a context manager."""

    def __init__(
        self, camera: VideoCamera, path: str | os.PathLike[str], *, speed: float = 1.0
    ) -> None:
        self.camera = camera
        self._path = Path(path)
        self._period = 1 / camera.fps / speed
        self._clients: list[_Client] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="video", daemon=True)

    def __enter__(self) -> VideoServer:
        if self._path.exists() and not self._path.is_socket():
            raise UserError("something else lies here; choose another --video", file=self._path)
        self._selector = selectors.DefaultSelector()
        self._listener = socket.socket(socket.AF_UNIX)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.unlink(missing_ok=True)
            self._listener.bind(os.fspath(self._path))
        except OSError as error:
            self._listener.close()
            self._selector.close()
            why = (
                "this path is too long for a socket" if "long" in str(error) else error.strerror
            )
            raise UserError(f"no video socket here: {why}", file=self._path) from error
        self._listener.listen()
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        for client in self._clients:
            client.socket.close()
        self._listener.close()
        self._selector.close()
        self._path.unlink(missing_ok=True)

    def _run(self) -> None:
        sequence, due = 0, time.monotonic() + self._period
        while not self._stop.is_set():
            now = time.monotonic()
            if now < due:
                for key, _ in self._selector.select(due - now):
                    self._accept() if key.data is None else self._serve(key.data)
                continue
            sequence += 1
            self._frame(sequence)
            # A clock that cannot be kept loses frames, it does not run late for ever.
            due = max(due + self._period, time.monotonic() - self._period)

    def _frame(self, sequence: int) -> None:
        ready = [client for client in self._clients if client.asks and not client.unsent]
        monotonic = time.monotonic()
        pixels = self.camera.tick(monotonic, wanted=bool(ready))
        if pixels is None:
            return
        height, width, _ = pixels.shape
        header = HEADER.pack(MAGIC, sequence, monotonic, height, width)
        for client in ready:
            client.asks = False
            client.unsent = [memoryview(header), memoryview(pixels.reshape(-1))]
            self._selector.modify(client.socket, selectors.EVENT_WRITE, client)
            self._send(client)

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        client = _Client(connection)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _serve(self, client: _Client) -> None:
        if client.unsent:
            self._send(client)
            return
        try:
            client.asks = bool(client.socket.recv(64))
        except OSError:
            client.asks = False
        if not client.asks:  # it went away
            self._drop(client)

    def _send(self, client: _Client) -> None:
        try:
            while client.unsent:
                sent = client.socket.send(client.unsent[0])
                client.unsent[0] = client.unsent[0][sent:]
                if not len(client.unsent[0]):
                    client.unsent.pop(0)
            self._selector.modify(client.socket, selectors.EVENT_READ, client)
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        self._selector.unregister(client.socket)
        client.socket.close()
        self._clients.remove(client)
