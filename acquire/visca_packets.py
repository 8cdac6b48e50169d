"""VISCA on the wire: packets, replies and the shutter tables of Sony's EVI cameras.

Source: Sony EVI-D100/D100P and EVI-D70/D70P technical manuals; the tables of shutter
positions also stand in JdeRobot's evicam driver.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum

TERMINATOR = 0xFF
SHORTEST, LONGEST = 3, 16  # bytes of a packet, header and terminator included

ADDRESS_SET = bytes.fromhex("88 30 01 FF")
IF_CLEAR_ALL = bytes.fromhex("88 01 00 01 FF")
IF_CLEAR = bytes.fromhex("01 00 01")
AE_INQUIRY = bytes.fromhex("09 04 39")
SHUTTER_INQUIRY = bytes.fromhex("09 04 4A")


class AutoExposure(IntEnum):
    """AE modes of ``8x 01 04 39 mm FF``."""

    AUTO = 0x00
    MANUAL = 0x03
    SHUTTER = 0x0A
    IRIS = 0x0B
    GAIN = 0x0C
    BRIGHT = 0x0D


class Kind(Enum):
    """What a reply is."""

    ACK = "acknowledged"
    COMPLETION = "completed"
    INQUIRY = "inquiry reply"
    ERROR = "error"
    ADDRESS = "address assigned"
    CLEARED = "interface cleared"
    NETWORK = "network changed"
    UNKNOWN = "unknown"


#: error codes of ``z0 6y ee FF``
SYNTAX, BUFFER_FULL, CANCELLED, NO_SOCKET, NOT_EXECUTABLE = 0x02, 0x03, 0x04, 0x05, 0x41


@dataclass(frozen=True)
class Reply:
    """A packet from a camera: its sender's address, kind, socket, and what it carries."""

    kind: Kind
    address: int
    socket: int = 0
    data: bytes = b""


class Splitter:
    """Bytes in, whole packets out, however the bytes are cut.

    A packet starts at a byte with its top bit set and ends at FF. What is too short, too long
    or has no header is dropped; ``dropped`` counts those bytes.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._held = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """The packets that `data` completes."""
        packets: list[bytes] = []
        for byte in data:
            if not self._held and (byte < 0x80 or byte == TERMINATOR) and not self._overlong:
                self.dropped += 1
                continue
            self._held.append(byte)
            if byte == TERMINATOR:
                if not self._overlong and SHORTEST <= len(self._held) <= LONGEST:
                    packets.append(bytes(self._held))
                    self._held.clear()
                self.clear()
            elif len(self._held) > LONGEST:
                self.clear()
                self._overlong = True
        return packets

    def clear(self) -> None:
        """Forget a packet begun."""
        self.dropped += len(self._held)
        self._held.clear()
        self._overlong = False


def packet(address: int, payload: bytes) -> bytes:
    """``8x payload FF`` from the controller to camera `address` (1-7)."""
    return bytes([0x80 | address]) + payload + bytes([TERMINATOR])


def parse_reply(data: bytes) -> Reply:
    """What a camera's packet says; never raises on bytes of a :class:`Splitter`."""
    if data[0] == 0x88:
        if data[1] == 0x30 and len(data) == 4:
            return Reply(Kind.ADDRESS, 0, data=data[2:3])
        kind = Kind.CLEARED if data == IF_CLEAR_ALL else Kind.UNKNOWN
        return Reply(kind, 0, data=data[1:-1])
    address, socket, rest = (data[0] >> 4) - 8, data[1] & 0x0F, data[2:-1]
    match data[1] >> 4:
        case 3 if data[1] == 0x38 and not rest:
            return Reply(Kind.NETWORK, address)
        case 4 if not rest:
            return Reply(Kind.ACK, address, socket)
        case 5 if socket == 0:
            return Reply(Kind.INQUIRY, address, data=rest)
        case 5 if not rest:
            return Reply(Kind.COMPLETION, address, socket)
        case 6 if len(rest) == 1:
            return Reply(Kind.ERROR, address, socket, rest)
        case _:
            return Reply(Kind.UNKNOWN, address, data=data[1:-1])


def set_ae(mode: AutoExposure) -> bytes:
    """The payload that sets the AE mode."""
    return bytes([0x01, 0x04, 0x39, mode])


def set_shutter(position: int) -> bytes:
    """The payload that sets the shutter's table position."""
    return bytes([0x01, 0x04, 0x4A, 0, 0, position >> 4, position & 0x0F])


def shutter_position(data: bytes) -> int | None:
    """The position in the data of a shutter inquiry's reply; ``None`` if they are damaged."""
    if len(data) == 4 and data[0] == data[1] == 0 and data[2] < 16 and data[3] < 16:
        return data[2] << 4 | data[3]
    return None


@dataclass(frozen=True)
class Model:
    """A camera model: 1/x s for each table position, and the video system's field rate."""

    name: str
    denominators: tuple[int, ...]
    fields: int

    @property
    def times(self) -> tuple[float, ...]:
        """Seconds for each table position."""
        return tuple(1 / d for d in self.denominators)


_D100P = (
    *(3, 6, 12, 25, 50, 75, 100, 120, 150, 215),
    *(300, 425, 600, 1000, 1250, 1750, 2500, 3500, 6000, 10000),
)
_NTSC = (60, 90, 100, 125, 180, 250, 350, 500, 725, 1000, 1500, 2000, 3000, 4000, 6000, 10000)

#: name on the command line -> model
MODELS = {
    "evi-d100p": Model("EVI-D100P", _D100P, 50),
    "evi-d100": Model("EVI-D100", (4, 8, 15, 30, *_NTSC), 60),
    "evi-d70p": Model("EVI-D70P", (1, 2, *_D100P), 50),
    "evi-d70": Model("EVI-D70", (1, 2, 4, 8, 15, 30, *_NTSC), 60),
}
