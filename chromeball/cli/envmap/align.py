"""``chromeball envmap align``: world axes and scale."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import Parameter

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    lens_of,
    need_size,
    parse_numbers,
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
    plane: Literal["floor", "ceiling", "wall"] = "floor",
    verticals: str | None = None,
    horizon: str | None = None,
    sun: str | None = None,
    time: str | None = None,
    latitude: float | None = None,
    longitude: float | None = None,
    north: str | None = None,
    bearing: float | None = None,
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
    """World axes and scale from a rectangle, verticals, the horizon, the sun, a bearing.

    Any mix of them is solved at once; what contradicts the others is named. Without a rectangle
    +X is east, and the origin lies on the floor below the camera.

    Parameters
    ----------
    scene
        A scene file: its [align] and [probe] say everything.
    points
        A rectangle's corners in order around it, pixels, "x,y x,y x,y x,y".
    plane
        Where the rectangle lies.
    verticals
        Points of vertical edges two by two, the lower first, "x,y x,y  x,y x,y".
    horizon
        Points of the horizon, "x,y x,y".
    sun
        Where the sun is, x,y; needs --time, --latitude and --longitude.
    time
        ISO 8601 with its zone, 2026-06-21T14:30+02:00.
    latitude
        Degrees north.
    longitude
        Degrees east.
    north
        A point to the north, x,y, or at --bearing; any point may be called north.
    bearing
        Degrees clockwise from north.
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
        Allow a rectangle on a wall or a ceiling, and take its plane for the floor's.
    output
        The axes, align.json.
    json
        Print the figures as JSON.

    """
    from chromeball.scene.camera import CameraModel

    if scene is not None:
        texts = (points, verticals, horizon, sun, time, latitude, longitude, north, bearing)
        given = (*texts, picture, lens, camera, size, width, depth, camera_height)
        if any(value is not None for value in given) or any_plane or plane != "floor":
            raise UserError("a scene file says everything: leave out the other options")
        model, entry, shown, inputs = _align_of_scene(scene)
        name: str | None = entry.picture
    else:
        entry = _typed(
            points, plane, verticals, horizon, sun, time, latitude, longitude, north, bearing
        )
        entry = msgspec.structs.replace(
            entry, width=width, depth=depth, camera_height=camera_height
        )
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
        if not 0 < click < 1000:
            raise UserError(f"--click {click:g}: pixels, more than 0")
        if _is_floor_alone(entry):
            _align_rectangle(model, entry, name, shown, click, any_plane, inputs, output, json)
        else:
            if any_plane:
                raise UserError("--any-plane is for a rectangle alone; say --plane")
            _align_mix(model, entry, name, shown, click, inputs, output, json)
    except UserError as error:
        raise (
            error if error.file or scene is None else UserError(error.what, file=scene)
        ) from error


def _typed(
    points: str | None,
    plane: Literal["floor", "ceiling", "wall"],
    verticals: str | None,
    horizon: str | None,
    sun: str | None,
    time: str | None,
    latitude: float | None,
    longitude: float | None,
    north: str | None,
    bearing: float | None,
) -> Align:
    """What was typed as the scene file's table."""
    from chromeball.scene.manifest import Align

    if points is None and verticals is None and horizon is None and not (sun or north):
        raise UserError("give a scene file, or --points with --lens or --camera")
    corners = parse_points(points) if points is not None else None
    edges = _pixels(verticals, "--verticals")
    if len(edges) % 2:
        raise UserError(f"--verticals: points two by two, not {len(edges)}")
    if bearing is not None and north is None:
        raise UserError("--bearing is for --north")
    if (sun is None) != (time is None) or (sun is None) != (latitude is None):
        raise UserError("--sun, --time, --latitude and --longitude are given together")
    if (latitude is None) != (longitude is None):
        raise UserError("--sun, --time, --latitude and --longitude are given together")
    value = {
        "picture": "",
        "points": corners,
        "plane": plane,
        "verticals": [[edges[i], edges[i + 1]] for i in range(0, len(edges), 2)],
        "horizon": _pixels(horizon, "--horizon"),
        "sun": parse_numbers(sun, "--sun", 2) if sun is not None else None,
        "time": time,
        "latitude": latitude,
        "longitude": longitude,
        "north": parse_numbers(north, "--north", 2) if north is not None else None,
        "bearing": bearing or 0.0,
    }
    try:
        return msgspec.convert(value, Align)
    except msgspec.ValidationError as error:
        raise UserError(str(error)) from error


def _pixels(text: str | None, option: str) -> list[list[float]]:
    return [parse_numbers(pair, option, 2) for pair in (text or "").split()]


def _is_floor_alone(entry: Align) -> bool:
    others = (entry.verticals, entry.horizon, entry.sun, entry.north)
    return not any(others) and entry.plane == "floor"


def _align_rectangle(
    model: CameraModel,
    entry: Align,
    name: str | None,
    shown: Path | None,
    click: float,
    any_plane: bool,
    inputs: Sequence[Path],
    output: Path,
    as_json: bool,
) -> None:
    import numpy as np

    from chromeball.envmap.align import align, alignment_json
    from chromeball.envmap.overlay import Drawn, overlay
    from chromeball.envmap.picture import write_preview
    from chromeball.scene.record import Stage, write_json

    assert entry.points is not None
    clicks = [list(point) for point in entry.points]
    with Stage("envmap align", inputs) as stage:
        result = align(
            model,
            clicks,
            width=entry.width,
            depth=entry.depth,
            camera_height=entry.camera_height,
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
            drawn = overlay(
                _display(shown),
                model,
                result.world_from_camera,
                Drawn(corners=result.corners, points=np.array(clicks)),
            )
            stage.figures["overlay"] = write_preview(output, "overlay", drawn)
        with stage.output(output) as temporary:
            write_json(temporary, alignment_json(result, name, clicks))
    print_figures(stage.figures, as_json, output)


def _align_mix(
    model: CameraModel,
    entry: Align,
    name: str | None,
    shown: Path | None,
    click: float,
    inputs: Sequence[Path],
    output: Path,
    as_json: bool,
) -> None:
    import numpy as np

    from chromeball.envmap.axes import (
        Bearing,
        Horizon,
        Observation,
        Rectangle,
        Vertical,
        axes_json,
        solve_axes,
    )
    from chromeball.envmap.overlay import Drawn, overlay
    from chromeball.envmap.picture import write_preview
    from chromeball.envmap.sun_position import parse_time, sun_position
    from chromeball.scene.record import Stage, write_json

    observed: list[Observation] = []
    corners = None if entry.points is None else np.array(entry.points)
    if corners is not None:
        observed.append(Rectangle(corners, entry.plane, entry.width, entry.depth))
    observed += [Vertical(np.array(edge)) for edge in entry.verticals]
    observed += [Horizon(np.array(point)) for point in entry.horizon]
    stands = None
    if entry.sun is not None:
        assert entry.time is not None
        assert entry.latitude is not None
        assert entry.longitude is not None
        stands = sun_position(parse_time(entry.time), entry.latitude, entry.longitude)
        observed.append(Bearing(np.array(entry.sun), stands.azimuth, stands.elevation))
    if entry.north is not None:
        observed.append(Bearing(np.array(entry.north), math.radians(entry.bearing)))
    with Stage("envmap align", inputs) as stage:
        result = solve_axes(model, observed, camera_height=entry.camera_height, click=click)
        for warning in result.warnings:
            print(f"warning: {warning}", file=sys.stderr)
        stage.figures |= {
            "width": result.width,
            "depth": result.depth,
            "camera_height": result.camera_height,
            "north_degrees": None if result.north is None else math.degrees(result.north),
            "sun_degrees": None
            if stands is None
            else [math.degrees(stands.azimuth), math.degrees(stands.elevation)],
            "residual_degrees": math.degrees(result.residual),
            "sigma_tilt_degrees": math.degrees(result.sigma_tilt),
            "sigma_yaw_degrees": math.degrees(result.sigma_yaw),
            "sigma_height": result.sigma_height,
            "chi_square_over_freedom": [result.chi_square, result.freedom],
            "observations": [
                {
                    "name": term.name,
                    "residual_degrees": math.degrees(term.residual),
                    "sigma_degrees": math.degrees(term.sigma),
                    "used": term.used,
                }
                for term in result.terms
            ],
            "warnings": result.warnings,
        }
        if shown is not None:
            drawn = overlay(
                _display(shown),
                model,
                result.world_from_camera,
                Drawn(
                    corners=result.corners,
                    points=corners,
                    verticals=[np.array(edge) for edge in entry.verticals],
                    marks=[
                        *[("horizon", np.array(point)) for point in entry.horizon],
                        *([("sun", np.array(entry.sun))] if entry.sun else []),
                        *([("north", np.array(entry.north))] if entry.north else []),
                    ],
                    sun=None if stands is None else (stands.azimuth, stands.elevation),
                    north=result.north,
                ),
            )
            stage.figures["overlay"] = write_preview(output, "overlay", drawn)
        with stage.output(output) as temporary:
            points = None if entry.points is None else [list(p) for p in entry.points]
            write_json(temporary, axes_json(result, name, points))
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
