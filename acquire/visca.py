"""Sony EVI cameras on a serial line: the VISCA driver.

One command is under way at a time. A reply is matched by its socket, never by its order, for
replies of earlier commands may still come in. When a reply is lost the interface is cleared
and the state inquired; a command is sent again only if the state is not what it asked for.
"""

from __future__ import annotations

import errno
import termios
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import NoReturn

import serial

from chromeball.acquire.visca_packets import (
    ADDRESS_SET,
    AE_INQUIRY,
    BUFFER_FULL,
    IF_CLEAR,
    MODELS,
    NOT_EXECUTABLE,
    SHUTTER_INQUIRY,
    SYNTAX,
    AutoExposure,
    Kind,
    Model,
    Reply,
    Splitter,
    packet,
    parse_reply,
    set_ae,
    set_shutter,
    shutter_position,
)
from chromeball.scene.errors import DeviceError

__all__ = ["MODELS", "ViscaCamera"]

_TRIES = 3


class _LostReplyError(Exception):
    """No usable reply in time."""


class ViscaCamera:
    """A camera whose shutter is set directly, in manual exposure.

    Parameters
    ----------
    port
        The serial port's path.
    model
        Its shutter table.
    bauds
        Rates to try in turn.
    timeout
        Seconds that a reply may take in fast shutter; the exposure time is added to it, for
        the camera's cycle grows with it.

    Raises
    ------
    DeviceError
        The port is missing, taken or closed, or no camera answers on it.

    """

    def __init__(
        self,
        port: str,
        model: Model = MODELS["evi-d100p"],
        *,
        bauds: tuple[int, ...] = (9600, 38400),
        timeout: float = 0.5,
    ) -> None:
        self.name = f"{model.name} at {port}"
        self.speeds = model.times
        self._port = port
        self._timeout = timeout
        self._set_to = self._slowest = 0.0  # longest exposure that may be under way
        self._splitter = Splitter()
        self._waiting: list[Reply] = []
        self._address = 1
        with self._guarded():
            self._serial = serial.Serial(
                port, bauds[0], timeout=0.01, write_timeout=1.0, exclusive=True
            )
        try:
            self._find(bauds)
            self._expose_manually()
            self._set_to = self._slowest = self.shutter()
        except DeviceError:
            self.close()
            raise

    def set_shutter(self, time: float) -> float:
        """Set one of `speeds` and read it back; see :class:`ShutterCamera`."""
        position = self.speeds.index(time)
        # Both the exposure under way and the next one may stretch the camera's cycle.
        self._slowest, self._set_to = max(self._set_to, time), time
        for _ in range(_TRIES):
            self._command(set_shutter(position), lambda: self._position() == position)
            if self._position() == position:
                return time
        raise DeviceError(
            f"the shutter was set to {_speed(time)} but reads back {_speed(self.shutter())}; "
            "is the camera in use by another program?",
            file=self._port,
        )

    def shutter(self) -> float:
        """The exposure time that the camera reads back, in seconds."""
        return self.speeds[self._position()]

    def close(self) -> None:
        """Close the port."""
        with self._guarded():
            self._serial.close()

    # ---- finding the camera

    def _find(self, bauds: tuple[int, ...]) -> None:
        for baud in bauds:
            with self._guarded():
                self._serial.baudrate = baud
            for _ in range(2):
                try:
                    self._send(ADDRESS_SET)
                    reply = self._await(lambda r: r.kind is Kind.ADDRESS, self._timeout)
                    self._address = max(1, reply.data[0] - 1)
                    self._clear_interface()
                except _LostReplyError:
                    continue
                return
        rates = " or ".join(map(str, bauds))
        raise DeviceError(
            f"no VISCA camera answers at {rates} baud; check that the camera is on, the cable "
            "is in VISCA IN and the port is the right one",
            file=self._port,
        )

    def _expose_manually(self) -> None:
        def manual() -> bool:
            return self._inquire(AE_INQUIRY, _mode) is AutoExposure.MANUAL

        if not manual():
            self._command(set_ae(AutoExposure.MANUAL), manual)
        if not manual():
            raise DeviceError("refuses manual exposure", file=self._port)

    # ---- commands and inquiries

    def _command(self, payload: bytes, done: Callable[[], bool]) -> None:
        """Send `payload` until the camera completes it or `done` says that it has."""
        lost: _LostReplyError | None = None
        for _ in range(_TRIES):
            try:
                error = self._try_command(payload)
            except _LostReplyError as reason:
                lost = reason
                if self._recover() and done():
                    return
                continue
            match error:
                case None:
                    return
                case 0x02:  # damaged on its way, or unknown to this model: try again
                    continue
                case 0x03:
                    time.sleep(self._timeout / 10)
                case 0x41:
                    self._expose_manually()
                case _:
                    self._recover()
        if lost is not None:
            self._fail(lost)
        raise DeviceError(
            f"refuses the command {payload.hex(' ')}; is the model right (model=NAME)?",
            file=self._port,
        )

    def _try_command(self, payload: bytes) -> int | None:
        """One attempt: ``None`` when completed, else the camera's error code."""
        self._send(packet(self._address, payload))
        patience = self._timeout + 2 * self._slowest
        # An ACK opens a socket; an error before it has none of its own (0) or the new one's.
        first = self._await(
            lambda r: r.kind is Kind.ACK or (r.kind is Kind.ERROR and _immediate(r)), patience
        )
        if first.kind is Kind.ERROR:
            return first.data[0]
        last = self._await(
            lambda r: r.kind in {Kind.COMPLETION, Kind.ERROR} and r.socket == first.socket,
            patience,
        )
        return last.data[0] if last.kind is Kind.ERROR else None

    def _inquire[T](self, payload: bytes, read: Callable[[bytes], T | None]) -> T:
        """Ask until a reply comes that `read` makes sense of."""
        lost = _LostReplyError("damaged replies")
        for _ in range(_TRIES):
            self._send(packet(self._address, payload))
            try:
                reply = self._await(
                    lambda r: r.kind is Kind.INQUIRY and read(r.data) is not None,
                    self._timeout + 2 * self._slowest,
                )
            except _LostReplyError as reason:
                lost = reason
                self._recover()
            else:
                value = read(reply.data)
                assert value is not None
                return value
        self._fail(lost)

    def _position(self) -> int:
        def read(data: bytes) -> int | None:
            position = shutter_position(data)
            return position if position is not None and position < len(self.speeds) else None

        return self._inquire(SHUTTER_INQUIRY, read)

    def _recover(self) -> bool:
        try:
            self._clear_interface()
        except _LostReplyError:
            return False
        return True

    def _clear_interface(self) -> None:
        """IF_Clear: the camera forgets what it was doing, and we what it said."""
        self._send(packet(self._address, IF_CLEAR))
        self._await(
            lambda r: r.kind is Kind.INQUIRY and not r.data, self._timeout + 2 * self._slowest
        )

    def _fail(self, reason: Exception) -> NoReturn:
        raise DeviceError(
            f"the camera stopped answering ({reason}); check its power and the cable, then run "
            "the command again",
            file=self._port,
        ) from reason

    # ---- bytes

    def _send(self, data: bytes) -> None:
        self._splitter.clear()
        self._waiting.clear()
        with self._guarded():
            self._serial.reset_input_buffer()
            self._serial.write(data)

    def _await(self, wanted: Callable[[Reply], bool], patience: float) -> Reply:
        """The next reply that is `wanted`; others are let go by."""
        deadline = time.monotonic() + patience
        while True:
            while self._waiting:
                if wanted(reply := self._waiting.pop(0)):
                    return reply
            if time.monotonic() > deadline:
                raise _LostReplyError(f"silent for {patience:.1f} s")
            with self._guarded():
                data = self._serial.read(max(1, self._serial.in_waiting))
            self._waiting += map(parse_reply, self._splitter.feed(data))

    @contextmanager
    def _guarded(self) -> Generator[None]:
        """What a dying port raises, as one error that says what to check."""
        try:
            yield
        except (serial.SerialException, OSError, termios.error) as error:
            raise DeviceError(_advice(error), file=self._port) from error


def _advice(error: Exception) -> str:
    match error.args[0] if error.args else None:
        case errno.ENOENT:
            return "no such serial port; is the adapter plugged in?"
        case errno.EACCES:
            return "this port is not yours to open; join the group dialout or use sudo"
        case errno.EAGAIN | errno.EBUSY:
            return "another program uses this serial port; close it first"
        case _:
            return f"the serial port broke off ({error}); check the adapter and the cable"


def _immediate(reply: Reply) -> bool:
    return reply.data[0] in {SYNTAX, BUFFER_FULL, NOT_EXECUTABLE}


def _mode(data: bytes) -> AutoExposure | None:
    try:
        return AutoExposure(data[0]) if len(data) == 1 else None
    except ValueError:
        return None


def _speed(time: float) -> str:
    return f"1/{1 / time:.0f} s" if time < 1 else f"{time:g} s"
