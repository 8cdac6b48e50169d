"""``chromeball envmap align``: world axes and scale."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    lens_of,
    need_size,
    parse_points,
    parse_size,
    picture_size,
    print_figures,
    read_camera,
)
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.manifest import Align, Scene


def align(
    scene: Path | None = None,
    /,
    *,
    points: str | None = None,
    picture: Path | None = None,
    lens: str | None = None,
    camera: Path | None = None,
    size: str | None = None,
    width: float | None = None,
    depth: float | None = None,
    camera_height: float | None = None,
    click: float = 1.0,
    any_plane: Annotated[bool, Parameter(negative="")] = False,
    output: Out,
    json: Json = False,
) -> None:
    """World axes and scale from the four corners of a rectangle on the floor.

    Parameters
    ----------
    scene
        A scene file: its [align] and [probe] say everything.
    points
        The corners in order around the rectangle, pixels, "x,y x,y x,y x,y".
    picture
        The picture that was clicked in: gives the size, and the check is drawn over it.
    lens
        The fisheye, MODEL:FOV[:cx,cy,radius], or "latlong".
    camera
        Any calibrated camera instead.
    size
        The picture's size, WxH, where there is no picture.
    width
        First corner to second, in metres.
    depth
        Second corner to third, in metres.
    camera_height
        The camera above the floor, in metres.
    click
        Noise of a click in pixels, for the standard errors.
    any_plane
        Allow a rectangle on a wall or a ceiling.
    output
        The axes, align.json.
    json
        Print the figures as JSON.

    """
    from chromeball.scene.camera import CameraModel

    if scene is not None:
        given = (points, picture, lens, camera, size, width, depth, camera_height)
        if any(value is not None for value in given):
            raise UserError("a scene file says everything: leave out the other options")
        model, entry, shown, inputs = _align_of_scene(scene)
        name: str | None = entry.picture
        clicks = [list(point) for point in entry.points]
        width, depth, camera_height = entry.width, entry.depth, entry.camera_height
    else:
        if points is None:
            raise UserError("give a scene file, or --points with --lens or --camera")
        clicks = parse_points(points)
        extent = parse_size(size) if size is not None else picture_size(picture)
        if (lens is None) == (camera is None):
            raise UserError("give --lens or --camera, one of the two")
        if lens == "latlong":
            if extent is None:
                raise UserError("--lens latlong needs --size or --picture")
            model = CameraModel.latlong(extent)
        elif camera is not None:
            model = read_camera(camera, extent, picture)
        else:
            if extent is None:
                raise UserError("--lens needs --size or --picture")
            from chromeball.envmap.mapping import parse_lens

            model = parse_lens(lens or "", extent)
        shown = picture
        name = picture.stem if picture else None
        inputs = [path for path in (picture, camera) if path is not None]
    try:
        _align(
            (model, clicks, name, shown),
            (width, depth, camera_height),
            click,
            any_plane,
            inputs,
            output,
            json,
        )
    except UserError as error:
        raise (
            error if error.file or scene is None else UserError(error.what, file=scene)
        ) from error


def _align(
    clicked: tuple[CameraModel, list[list[float]], str | None, Path | None],
    lengths: tuple[float | None, float | None, float | None],
    click: float,
    any_plane: bool,
    inputs: Sequence[Path],
    output: Path,
    as_json: bool,
) -> None:
    from chromeball.envmap.align import align, alignment_json, overlay
    from chromeball.envmap.picture import write_preview
    from chromeball.scene.record import Stage, write_json

    model, clicks, name, shown = clicked
    width, depth, camera_height = lengths
    if not 0 < click < 1000:
        raise UserError(f"--click {click:g}: pixels, more than 0")
    with Stage("envmap align", inputs) as stage:
        result = align(
            model,
            clicks,
            width=width,
            depth=depth,
            camera_height=camera_height,
            click=click,
            any_plane=any_plane,
        )
        for warning in result.warnings:
            print(f"warning: {warning}", file=sys.stderr)
        stage.figures |= {
            "width": result.width,
            "depth": result.depth,
            "camera_height": result.camera_height,
            "residual_degrees": math.degrees(result.residual),
            "sigma_tilt_degrees": math.degrees(result.sigma_tilt),
            "sigma_yaw_degrees": math.degrees(result.sigma_yaw),
            "sigma_height": result.sigma_height,
            "disagreement": result.disagreement,
            "warnings": result.warnings,
        }
        if shown is not None:
            drawn = overlay(_display(shown), model, result, clicks)
            stage.figures["overlay"] = write_preview(output, "overlay", drawn)
        with stage.output(output) as temporary:
            write_json(temporary, alignment_json(result, name, clicks))
    print_figures(stage.figures, as_json, output)


def _align_of_scene(path: Path) -> tuple[CameraModel, Align, Path | None, list[Path]]:
    """Camera, [align], picture to draw on, and inputs."""
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.manifest import read_scene

    scene = read_scene(path)
    entry = scene.align
    if entry is None:
        raise UserError("there is no [align]", file=path)
    root = path.parent
    if entry.picture == "env":
        if not scene.env.file:
            raise UserError('align.picture is "env" but env.file names no panorama', file=path)
        picture = root / scene.env.file
        return CameraModel.latlong(need_size(picture)), entry, picture, [path, picture]
    if scene.probe is None:
        raise UserError("there is no [probe]: nothing says through which lens", file=path)
    shots = [shot for shot in scene.probe.shot if shot.bracket == entry.picture]
    if not shots:
        raise UserError(f"align.picture {entry.picture!r} is no shot of the [probe]", file=path)
    if shots[0].ball:
        raise UserError("the corners must be clicked through a lens, not in a ball", file=path)
    picture = _picture_of(scene, entry.picture, root)
    model = lens_of(scene.probe, shots[0], need_size(picture), root, picture)
    inputs = [path, picture]
    if scene.probe.camera:
        inputs.append(root / scene.probe.camera)
    return model, entry, picture, inputs


def _picture_of(scene: Scene, name: str, root: Path) -> Path:
    """The bracket's radiance, or its first frame where that is not made yet."""
    from chromeball.scene.record import read_json

    merged = root / scene.folder / f"{name}.exr"
    if merged.is_file():
        return merged
    bracket = scene.find_bracket(name)
    for pattern in bracket.frames:
        found = [root / pattern] if (root / pattern).is_file() else sorted(root.glob(pattern))
        if found:
            return found[0]
    take = root / (bracket.take or f"takes/{name}")
    if (take / "take.json").is_file():
        value = read_json(take / "take.json")
        try:
            return take / str(value["frames"][0]["file"])
        except (KeyError, IndexError, TypeError) as error:
            raise UserError("not a readable take", file=take / "take.json") from error
    raise UserError(f"bracket {name!r} has no picture yet; merge it first", file=merged)


def _display(path: Path) -> Any:
    """8 bits of any picture, at its full size."""
    import numpy as np

    from chromeball.envmap.picture import tone_mapped
    from chromeball.scene.image import read_image

    image = read_image(path)
    pixels = image.pixels[..., :3]
    if pixels.shape[2] < 3:
        pixels = np.repeat(pixels[..., :1], 3, axis=2)
    if image.linear:
        finite = np.nan_to_num(pixels.astype(np.float32), nan=0, posinf=0, neginf=0)
        return tone_mapped(np.maximum(finite, 0), width=pixels.shape[1])
    return pixels if pixels.dtype == np.uint8 else (pixels // 257).astype(np.uint8)
