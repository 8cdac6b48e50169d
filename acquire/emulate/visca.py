"""The VISCA side of an emulated camera: real bytes behind a real pseudo-terminal.

Bytes take their time on the line, one command is executed a V cycle, two sockets hold
commands that are under way. A client at another baud rate reads and is read as garbage.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import select
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chromeball.acquire.emulate.camera import VideoCamera
from chromeball.acquire.visca_packets import (
    ADDRESS_SET,
    AE_INQUIRY,
    BUFFER_FULL,
    CANCELLED,
    IF_CLEAR,
    IF_CLEAR_ALL,
    NO_SOCKET,
    NOT_EXECUTABLE,
    SHUTTER_INQUIRY,
    SYNTAX,
    AutoExposure,
    Splitter,
)
from chromeball.scene.errors import UserError

_BAUDS = {9600: termios.B9600, 38400: termios.B38400}
_BITS = 10  # start, 8 data, stop


@dataclass(frozen=True)
class Faults:
    """What goes wrong, for tests: probabilities a reply, and the command to fall silent at.

    ``silent_after``: packets answered before the camera falls silent for good. ``drop_ack``,
    ``drop``: an ACK, or any reply, is lost. ``garble``: a bit of a reply flips.
    """

    silent_after: int | None = None
    drop_ack: float = 0.0
    drop: float = 0.0
    garble: float = 0.0


class ViscaPort:
    """A pseudo-terminal at which a camera answers; use as a context manager.

    Parameters
    ----------
    camera
        What the commands act on.
    link
        A symbolic link to make; clients open it.
    baud
        The camera's rate, 9600 or 38400.
    speed
        How many times faster than real the line and the V cycle run (tests).
    faults, seed
        Faults and the seed that draws them.

    """

    def __init__(
        self,
        camera: VideoCamera,
        link: str | os.PathLike[str],
        *,
        baud: int = 9600,
        speed: float = 1.0,
        faults: Faults | None = None,
        seed: int = 0,
    ) -> None:
        if baud not in _BAUDS:
            raise UserError(f"{baud} is no baud rate of this camera; 9600 or 38400")
        self.camera = camera
        self.answered = 0
        self._link = Path(link)
        self._baud = baud
        self._byte = _BITS / baud / speed
        self._speed = speed
        self._faults = faults or Faults()
        self._rng = np.random.default_rng(seed)
        self._splitter = Splitter()
        self._inbox: deque[tuple[float, bytes]] = deque()
        self._outbox: list[tuple[float, int, bytes]] = []
        self._order = 0
        self._line_free = 0.0  # when the transmit line has sent what was given to it
        self._heard = 0.0  # when the last received byte was through
        self._next_v = 0.0
        self._running: dict[int, float] = {}  # socket -> when its command is done
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="visca", daemon=True)

    def __enter__(self) -> ViscaPort:
        if self._link.exists() and not self._link.is_symlink():
            raise UserError("something else lies here; choose another --link", file=self._link)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = _BAUDS[self._baud]
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        self._wake_read, self._wake_write = os.pipe()
        try:
            self._link.parent.mkdir(parents=True, exist_ok=True)
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(os.ttyname(self._slave))
        except OSError as error:
            self._close()
            raise UserError(f"cannot link here: {error.strerror}", file=self._link) from error
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        os.write(self._wake_write, b"x")
        self._thread.join()
        self._link.unlink(missing_ok=True)
        self._close()

    def _close(self) -> None:
        for descriptor in (self._master, self._slave, self._wake_read, self._wake_write):
            os.close(descriptor)

    # ---- the loop

    def _run(self) -> None:
        while not self._stop.is_set():
            now = time.monotonic()
            due = [item[0] for item in self._outbox[:1]]
            due += [max(self._next_v, arrived) for arrived, _ in list(self._inbox)[:1]]
            due += list(self._running.values())
            wait = None if not due else max(0.0, min(due) - now)
            readable, _, _ = select.select([self._master, self._wake_read], [], [], wait)
            if self._master in readable:
                self._receive()
            self._finish()
            self._execute()
            self._transmit()

    def _receive(self) -> None:
        try:
            data = os.read(self._master, 4096)
        except BlockingIOError:
            return
        now = time.monotonic()
        for byte in self._through_the_line(data):
            self._heard = max(self._heard, now) + self._byte
            for packet in self._splitter.feed(bytes([byte])):
                self._inbox.append((self._heard, packet))

    def _execute(self) -> None:
        """One packet a V cycle."""
        now = time.monotonic()
        if not self._inbox or now < max(self._next_v, self._inbox[0][0]):
            return
        cycle = self.camera.cycle / self._speed
        _, packet = self._inbox.popleft()
        # V cycles are a clock of their own: the next one begins where the grid says.
        self._next_v = max(self._next_v, now - now % cycle) + cycle
        silent = self._faults.silent_after
        if silent is not None and self.answered >= silent:
            return
        self.answered += 1
        # A completion takes about a cycle, so two commands may be under way at once.
        self._answer(packet, now + cycle * self._rng.uniform(0.8, 1.2))

    def _finish(self) -> None:
        now = time.monotonic()
        for socket, done in list(self._running.items()):
            if now >= done:
                del self._running[socket]
                self._reply(bytes([0x90, 0x50 | socket]))

    # ---- what the camera does

    def _answer(self, packet: bytes, done: float) -> None:
        if packet == ADDRESS_SET:
            self._reply(bytes([0x88, 0x30, 0x02]))
        elif packet == IF_CLEAR_ALL:
            self._running.clear()
            self._reply(IF_CLEAR_ALL[:-1])
        elif packet[0] == 0x81:
            self._command(packet[1:-1], done)
        # Packets for other addresses would travel on down the chain.

    def _command(self, payload: bytes, done: float) -> None:
        match payload[:3]:
            case _ if len(payload) == 1 and payload[0] >> 4 == 2:
                self._cancel(payload[0] & 0x0F)
            case b"\x01\x00\x01":
                assert payload[:3] == IF_CLEAR
                self._running.clear()
                self._reply(b"\x90\x50")
            case _ if payload == AE_INQUIRY:
                self._reply(bytes([0x90, 0x50, self.camera.mode]))
            case _ if payload == SHUTTER_INQUIRY:
                position = self.camera.position
                self._reply(bytes([0x90, 0x50, 0, 0, position >> 4, position & 0x0F]))
            case b"\x01\x04\x39" if len(payload) == 4 and payload[3] in set(AutoExposure):
                self._set(lambda: self.camera.set_mode(AutoExposure(payload[3])), done)
            case b"\x01\x04\x4a" if (place := self._shutter(payload)) is not None:
                self._set(lambda: self.camera.set_shutter(place), done)
            case _:
                self._reply(bytes([0x90, 0x60, SYNTAX]))

    def _shutter(self, payload: bytes) -> int | None:
        if len(payload) != 7 or any(payload[3:5]) or max(payload[5:7]) > 0x0F:
            return None
        position = payload[5] << 4 | payload[6]
        return position if position < len(self.camera.model.times) else None

    def _set(self, act: Callable[[], bool | None], done: float) -> None:
        socket = next((s for s in (1, 2) if s not in self._running), None)
        if socket is None:
            self._reply(bytes([0x90, 0x60, BUFFER_FULL]))
        elif act() is False:
            self._reply(bytes([0x90, 0x60 | socket, NOT_EXECUTABLE]))
        else:
            self._reply(bytes([0x90, 0x40 | socket]))
            self._running[socket] = done

    def _cancel(self, socket: int) -> None:
        known = self._running.pop(socket, None) is not None
        self._reply(bytes([0x90, 0x60 | socket, CANCELLED if known else NO_SOCKET]))

    # ---- bytes on the line

    def _reply(self, body: bytes) -> None:
        faults = self._faults
        lost = faults.drop + (faults.drop_ack if body[1] >> 4 == 4 else 0.0)
        if self._rng.random() < lost:
            return
        data = bytearray(body + b"\xff")
        if self._rng.random() < faults.garble:
            data[self._rng.integers(len(data))] ^= 1 << int(self._rng.integers(8))
        self._line_free = max(self._line_free, time.monotonic())
        for byte in self._through_the_line(bytes(data)):
            self._line_free += self._byte
            heapq.heappush(self._outbox, (self._line_free, self._order, bytes([byte])))
            self._order += 1

    def _transmit(self) -> None:
        now = time.monotonic()
        while self._outbox and self._outbox[0][0] <= now:
            _, _, byte = heapq.heappop(self._outbox)
            # Nobody reads and the buffer is full: bytes are lost, as on a line.
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, byte)

    def _through_the_line(self, data: bytes) -> bytes:
        """The bytes as they come out at the other end: noise if the rates differ."""
        if termios.tcgetattr(self._master)[4] == _BAUDS[self._baud]:
            return data
        return self._rng.integers(0, 256, len(data), np.uint8).tobytes()
