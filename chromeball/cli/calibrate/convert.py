"""``chromeball calibrate convert``: cameras and rigs in and out of other tools' files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage

if TYPE_CHECKING:
    from chromeball.calibrate.formats import NamedCamera

#: A conversion farther off than this, px, is warned of.
_FAR = 0.1


def convert(
    sources: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    output: Out,
    to: str | None = None,
    model: str | None = None,
    camera: Annotated[list[str] | None, Parameter(negative="")] = None,
    origin: str | None = None,
    size: str | None = None,
    fisheye: bool | None = None,
    json: Json = False,
) -> None:
    """Cameras and rigs from the files of one tool to those of another.

    A lens that the format does not hold becomes the nearest that it does, by least squares over
    the picture, and the error is told in pixels.

    Parameters
    ----------
    sources
        Files or folders of them: .cameramodel, OpenCV's .yml, .json and .xml (one camera, or a
        pair with R and T, which may stand in a second file), ROS camera_info, COLMAP's model or
        rig_config.json, Kalibr's camchain.yaml, OpenUSD, a script for Blender written here.
    output
        What to write: a file, or a folder for many cameras.
    to
        cameramodel, opencv, colmap, colmap-binary, kalibr, usd or blender, where the name of
        the output does not say it.
    model
        Lens model to write, as it stands or the nearest: pinhole, opencv4, opencv5, opencv8,
        opencv12, kb4, kb4_decentred, equidistant, equisolid, stereographic.
    camera
        Only this camera of the files; may be repeated.
    origin
        Place the cameras from this one, which then stands at the origin.
    size
        Width and height in pixels, 640x480, where a file does not tell.
    fisheye
        What four distortion terms without a word are: of OpenCV's fisheye, or k1 k2 p1 p2.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.formats import Hints, read_cameras

    cameras = read_cameras(sources, Hints(_size(size), fisheye))
    if camera:
        cameras = [_named(cameras, name) for name in camera]
    if origin is not None:
        there = _named(cameras, origin).camera.world_from_camera.inverse()
        cameras = [
            replace(c, camera=c.camera.posed(there @ c.camera.world_from_camera))
            for c in cameras
        ]
    options = {"model": model, "camera": camera, "origin": origin, "size": size}
    stage = Stage("calibrate convert", inputs_of(sources), fisheye=fisheye, **options)
    write_as(cameras, stage, output, to, model, json)


def write_as(
    cameras: Sequence[NamedCamera],
    stage: Stage,
    output: Path,
    to: str | None,
    model: str | None,
    json: bool,
) -> None:
    """Write `cameras` within `stage`, and say what it cost."""
    from chromeball.calibrate.formats import encoded, format_for, prepared

    kind = format_for(output, to, len(cameras))
    with stage:
        found = prepared(cameras, kind, model)
        losses = [{"camera": name, **asdict(loss)} for name, loss in found.losses]
        stage.figures |= {
            "format": kind,
            "cameras": [_told(named) for named in found.cameras],
            "conversions": losses,
            "left_behind": found.left_behind,
            "notes": found.notes,
        }
        for name, data in encoded(found.cameras, output, kind).items():
            with stage.output(output / name if name else output) as temporary:
                temporary.write_bytes(data)
    for name, loss in found.losses:
        off = (
            f"{name}: {loss.was} as {loss.now}, off by {loss.rms:.2g} px (RMS over {loss.part}"
        )
        out = f", without {loss.left_out:.1%} of it" if loss.left_out > 0 else ""
        turn = f", turned by {math.degrees(loss.turned):.3g} degrees with its pose"
        out += turn if loss.turned else ""
        warning = "warning: " if loss.worst > _FAR or loss.left_out > 0 else ""
        say(f"{warning}{off}{out}; at most {loss.worst:.2g})")
    for line in found.notes:
        say(f"warning: {line}")
    for line in found.left_behind:
        say(f"left behind: {line}")
    if json:
        print_figures(stage.figures)
        return
    many = f"{len(found.cameras)} cameras" if len(found.cameras) > 1 else "a camera"
    print(f"{output}: {many}, {kind}")
    for named in found.cameras[:12]:
        x, y, z = named.camera.world_from_camera.translation
        width, height = named.camera.size
        words = named.camera.model.removeprefix("LENSMODEL_").lower()[:40]
        print(f"  {named.name}: {words}, {width}x{height}, at {x:.4g}, {y:.4g}, {z:.4g}")
    if len(found.cameras) > 12:
        print(f"  and {len(found.cameras) - 12} more")


def inputs_of(sources: Sequence[Path]) -> list[Path]:
    """The files that `sources` name, those of folders included."""
    return [
        file
        for source in sources
        for file in (sorted(source.iterdir()) if source.is_dir() else [source])
        if file.is_file() and not file.name.endswith(".record.json")
    ]


def _told(named: NamedCamera) -> dict[str, Any]:
    pose = named.camera.world_from_camera
    return {
        "name": named.name,
        "model": named.camera.model,
        "size": named.camera.size,
        "intrinsics": named.camera.intrinsics,
        "position": pose.translation,
        "rotation_degrees": [math.degrees(v) for v in pose.rotation_vector()],
        "time_shift": named.time_shift,
    }


def _named(cameras: Sequence[NamedCamera], name: str) -> NamedCamera:
    for camera in cameras:
        if camera.name == name:
            return camera
    names = ", ".join(c.name for c in cameras[:12])
    raise UserError(f"there is no camera {name!r}: there are {names}")


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UserError(f"--size {text}: write width and height as 640x480")
    return int(width), int(height)
