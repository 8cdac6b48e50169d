"""``chromeball acquire``: devices and folders of photographs to takes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

if TYPE_CHECKING:
    from chromeball.acquire.take import Take

app = App(name="acquire", help="Devices and folders of photographs to takes.")


@app.command
def bracket(
    *,
    device: str,
    video: str,
    times: str,
    output: Annotated[Path, Parameter(alias="-o")],
    response: Path | None = None,
    average: int = 1,
    json: bool = False,
) -> None:
    """Capture an exposure bracket; every frame is waited for until its brightness is right.

    A run that breaks off keeps its frames; run it again to go on.

    Parameters
    ----------
    device
        The camera: visca:/dev/ttyUSB0[,model=evi-d100p][,baud=9600]. Models: evi-d100p,
        evi-d100, evi-d70p, evi-d70.
    video
        Its picture: v4l2:/dev/video0, socket:PATH (the emulator's) or a video file.
    times
        Exposure times in seconds, as 1/3,1/12,0.02; the nearest of the camera's are taken.
    output
        The take's folder (or its file, ending in .json).
    response
        The camera's response.json, for a strict test of the brightness.
    average
        How many frames to average for each picture.
    json
        Print the frames as JSON on stdout.

    """
    from chromeball.acquire.bracket import capture_bracket
    from chromeball.acquire.connect import open_camera, open_video
    from chromeball.acquire.settle import read_curve

    seconds = _times(times)
    curve = None if response is None else read_curve(response)
    camera = open_camera(device)
    try:
        source = open_video(video)
        try:
            take = capture_bracket(
                camera,
                source,
                seconds,
                output,
                curve=curve,
                average=average,
                say=lambda message: print(message, file=sys.stderr),
            )
        finally:
            source.close()
    finally:
        camera.close()
    _report(take, json)


@app.command(name="import")
def import_(
    frames: Annotated[list[Path], Parameter(negative=())],
    /,
    *,
    output: Annotated[Path, Parameter(alias="-o")],
    times: str | None = None,
    json: bool = False,
) -> None:
    """Make a take of photographs where they lie.

    Parameters
    ----------
    frames
        Pictures, or folders of pictures.
    output
        The take's folder (or its file, ending in .json).
    times
        Exposure times in seconds, one a picture; else the pictures' metadata say.
    json
        Print the frames as JSON on stdout.

    """
    from chromeball.acquire.files import import_take

    take = import_take(frames, output, () if times is None else _times(times))
    _report(take, json)


def _times(text: str) -> list[float]:
    from chromeball.scene.manifest import parse_time

    return [parse_time(part.strip()) for part in text.split(",") if part.strip()]


def _report(take: Take, as_json: bool) -> None:
    if as_json:
        import json

        from chromeball.acquire.take import row_summary

        frames = [row_summary(frame.row) | {"time": frame.time} for frame in take.frames]
        print(json.dumps({"take": str(take.path), "size": take.size, "frames": frames}))
        return
    for frame in take.frames:
        settle = frame.row.settle
        print(f"{frame.time:.6g}\t{frame.path}" + (f"\t{settle.verdict}" if settle else ""))
