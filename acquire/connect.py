"""Devices by their names on the command line."""

from __future__ import annotations

from chromeball.acquire.devices import FrameSource, ShutterCamera
from chromeball.scene.errors import UserError


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
