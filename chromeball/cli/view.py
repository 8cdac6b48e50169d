"""``chromeball view``: a scene in the browser, on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.scene.errors import UserError


def view(
    scene_file: Path,
    *,
    port: int = 8080,
    host: str = "127.0.0.1",
    travel: Annotated[bool, Parameter(negative="")] = False,
    radius: float | None = None,
    frame: int | None = None,
    error: float = 0.01,
    fps: float = 15.0,
) -> None:
    """Move cameras and objects of a scene in the browser, and change what they are made of.

    The picture is coarse while something moves, sharpens at rest and then costs nothing.

    Parameters
    ----------
    scene_file
        The scene.toml; `make` must have made what its views need.
    port
        Of the web page; 0 takes any that is free.
    host
        A loopback address: the page has no password.
    travel
        Let the camera go anywhere, not only near the places where light and plates were taken.
    radius
        How near that is, in metres; by default half the distance from the light probe to the
        nearest stand-in geometry.
    frame
        Of a sequence, the frame to look at; by default the first.
    error
        At rest, stop when the standard error of the changed pixels is below this share of
        their mean.
    fps
        Frames a second to aim at while something moves.

    """
    try:
        from chromeball.renderer.viewer import Viewer, check_loopback
    except ModuleNotFoundError as missing:
        raise UserError(
            f"the viewer needs {missing.name}, which is not installed: "
            "pip install 'chromeball[viewer]'"
        ) from missing
    from chromeball.renderer.stream import Session

    if not (error > 0 and fps > 0):
        raise UserError("--error and --fps must be positive")
    check_loopback(host)
    session = Session(scene_file, travel=travel, radius=radius, frame=frame)
    session.set(error=error, fps=fps)
    try:
        viewer = Viewer(session, host, port)
        try:
            print(f"{viewer.url} shows {scene_file}; Ctrl-C ends it", flush=True)
            session.wait()
        except KeyboardInterrupt:
            print()
        finally:
            viewer.stop()
    finally:
        session.stop()
