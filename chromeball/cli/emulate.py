"""``chromeball emulate``: a device on a pseudo-terminal, for rehearsals and tests."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

app = App(name="emulate", help="A device on a pseudo-terminal.")


@app.command
def visca(
    *command: Annotated[str, Parameter(allow_leading_hyphen=True)],
    radiance: Path,
    link: Path,
    video: str,
    seed: int = 0,
    model: str = "evi-d100p",
    fps: float = 25.0,
    baud: int = 9600,
    speed: float = 1.0,
    middle: float | None = None,
    silent_after: int | None = None,
    drop: float = 0.0,
    garble: float = 0.0,
) -> int:
    """A Sony EVI camera before a radiance picture: VISCA on a pseudo-terminal, and its video.

    Frames after a shutter change are wrong for a while, as on the real device.

    Parameters
    ----------
    command
        After --, a command to run while the camera stands; its exit code is passed on.
        Without one the camera stands until it is interrupted.
    radiance
        A scene-linear picture (EXR, HDR): what reaches the sensor.
    link
        Where to link the pseudo-terminal; use it as visca:LINK.
    video
        Where to serve the frames: socket:PATH.
    seed
        Seed of noise, delays and faults.
    model
        evi-d100p, evi-d100, evi-d70p or evi-d70.
    fps
        Frames a second.
    baud
        The camera's rate: 9600 or 38400.
    speed
        How many times faster than real its clocks run.
    middle
        Radiance times seconds that gives code 128 (0.02).
    silent_after
        Fall silent after this many packets.
    drop
        Probability that a reply is lost.
    garble
        Probability that a reply is damaged.

    """
    import numpy as np

    from chromeball.acquire.emulate.camera import VideoCamera
    from chromeball.acquire.emulate.sensor import Sensor
    from chromeball.acquire.emulate.video import VideoServer
    from chromeball.acquire.emulate.visca import Faults, ViscaPort
    from chromeball.acquire.visca_packets import MODELS
    from chromeball.scene.errors import UserError
    from chromeball.scene.image import read_rgb

    if model not in MODELS:
        raise UserError(f"no model {model!r}; known: {', '.join(MODELS)}")
    kind, _, path = video.partition(":")
    if kind != "socket" or not path:
        raise UserError(f"--video {video!r}: write socket:PATH")
    if not (0 < fps <= 1000 and 0 < speed <= 1000):
        raise UserError("--fps and --speed must lie between 0 and 1000")
    sensor = Sensor() if middle is None else Sensor(middle=middle)
    seeds = np.random.SeedSequence(seed).generate_state(2)
    camera = VideoCamera(read_rgb(radiance), MODELS[model], fps, sensor, seed=int(seeds[0]))
    faults = Faults(silent_after=silent_after, drop=drop, garble=garble)
    port = ViscaPort(camera, link, baud=baud, speed=speed, faults=faults, seed=int(seeds[1]))
    with port, VideoServer(camera, path, speed=speed):
        ready = f"{MODELS[model].name} on {link}, video on {video}"
        return _run(command, ready) if command else _stand(ready)


def _run(command: tuple[str, ...], ready: str) -> int:
    """Run `command`; an interrupt goes to it as well, and its exit code comes back."""
    import shutil
    import subprocess

    from chromeball.scene.errors import UserError

    program = shutil.which(command[0])
    if program is None and command[0] == "chromeball":
        program = sys.argv[0]  # our own, though its folder is not on the PATH
    if program is None:
        raise UserError("no such command", file=command[0])
    print(ready, file=sys.stderr, flush=True)
    child = subprocess.Popen([program, *command[1:]])
    # A terminal's Ctrl-C reaches the child by itself; a kill of ours is passed on.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: child.send_signal(number))
    while True:
        try:
            code = child.wait()
        except KeyboardInterrupt:
            continue
        return 128 - code if code < 0 else code


def _stand(ready: str) -> int:
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    try:
        print(ready, file=sys.stderr, flush=True)
        signal.pause()
    except KeyboardInterrupt:
        return 0
    return 0
