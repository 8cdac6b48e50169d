"""``chromeball stand-in``: the geometry of the set, drawn on the map, and its depth."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from cyclopts import App, Parameter

from chromeball.cli.options import Numbers
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import StandIn, read_scene
from chromeball.scene.record import Stage, to_json

if TYPE_CHECKING:
    from chromeball.scene.camera import CameraModel
    from chromeball.stand_in.primitives import Piece

app = App(name="stand-in", help="The geometry of the set.")

type Out = Annotated[Path, Parameter(name=["--output", "-o"])]
type Map = Annotated[Path | None, Parameter(name="--env")]
type Json = Annotated[bool, Parameter(negative="")]
type Surface = Literal["support", "environment"]
type Outline = Literal["polygon", "square", "rectangle", "circle"]


@app.command
def build(scene: Path, *, env: Map = None, output: Out, json: Json = False) -> None:
    """Every [[stand_in]] of a scene as one mesh, with a picture of it over the map.

    Parameters
    ----------
    scene
        The scene file.
    env
        The map that its points were clicked in, env.exr.
    output
        The mesh, stand_in.ply.
    json
        Print the figures as JSON.

    """
    entries = read_scene(scene).stand_in
    if not entries:
        raise UserError("there is no [[stand_in]] to build", file=scene)
    try:
        _build(entries, env, output, json, "stand-in build", [scene])
    except UserError as error:
        raise error if error.file else UserError(error.what, file=scene) from error


@app.command
def floor(
    *, size: str, surface: Surface = "support", output: Out, env: Map = None, json: Json = False
) -> None:
    """A rectangle of the floor about the world's origin.

    Parameters
    ----------
    size
        Width (x) and depth (z) in metres, "4,4".
    surface
        Whether it receives the objects' shadows and light (support) or only emits.
    output
        The mesh, F.ply.
    env
        A map to draw it over.
    json
        Print the figures as JSON.

    """
    values = _numbers(size, "--size", 2)
    if not (0 < values[0] < np.inf and 0 < values[1] < np.inf):
        raise UserError(f"--size {size}: width and depth must be positive")
    entry = StandIn(name="floor", kind="plane", size=(values[0], values[1]), surface=surface)
    _build([entry], env, output, json, "stand-in floor", [])


@app.command
def polygon(
    *,
    points: Numbers = None,
    corners: Numbers = None,
    outline: Outline = "polygon",
    surface: Surface = "support",
    env: Map = None,
    output: Out,
    json: Json = False,
) -> None:
    """A flat piece of the floor.

    Parameters
    ----------
    points
        Pixels of the map, "x,y x,y x,y ...".
    corners
        Instead of points: places on the floor in metres, "x,z x,z x,z ...".
    outline
        How they draw it: polygon by its corners, square by its diagonal (2), rectangle by one
        side and a point of the opposite side (3), circle by three points.
    surface
        Whether it receives the objects' shadows and light (support) or only emits.
    env
        The map that the points were clicked in.
    output
        The mesh, F.ply.
    json
        Print the figures as JSON.

    """
    entry = _entry("polygon", points, corners, outline, surface, None, None)
    _build([entry], env, output, json, "stand-in polygon", [])


@app.command
def box(
    *,
    points: Numbers = None,
    corners: Numbers = None,
    outline: Outline = "polygon",
    height: float | None = None,
    height_point: str | None = None,
    surface: Surface = "support",
    env: Map = None,
    output: Out,
    json: Json = False,
) -> None:
    """An outline on the floor raised to a height: a table, a chest, a column.

    Parameters
    ----------
    points
        Pixels of the map, "x,y x,y x,y ...".
    corners
        Instead of points: places on the floor in metres, "x,z x,z x,z ...".
    outline
        How they draw it: polygon by its corners, square by its diagonal (2), rectangle by one
        side and a point of the opposite side (3), circle by three points.
    height
        Height in metres.
    height_point
        Instead of height: the pixel "x,y" that shows the top above the first point.
    surface
        Whether it receives the objects' shadows and light (support) or only emits.
    env
        The map that the points were clicked in.
    output
        The mesh, F.ply.
    json
        Print the figures as JSON.

    """
    entry = _entry("box", points, corners, outline, surface, height, height_point)
    _build([entry], env, output, json, "stand-in box", [])


@app.command
def room(
    *,
    points: Numbers = None,
    corners: Numbers = None,
    outline: Outline = "polygon",
    height: float | None = None,
    height_point: str | None = None,
    surface: Surface = "support",
    env: Map = None,
    output: Out,
    json: Json = False,
) -> None:
    """A room seen from inside: its floor is `surface`, walls and ceiling are environment.

    Parameters
    ----------
    points
        Pixels of the map, "x,y x,y x,y ...".
    corners
        Instead of points: places on the floor in metres, "x,z x,z x,z ...".
    outline
        How they draw it: polygon by its corners, square by its diagonal (2), rectangle by one
        side and a point of the opposite side (3), circle by three points.
    height
        Height in metres.
    height_point
        Instead of height: the pixel "x,y" that shows the ceiling above the first point.
    surface
        Whether the floor receives the objects' shadows and light (support) or only emits.
    env
        The map that the points were clicked in.
    output
        The mesh, F.ply.
    json
        Print the figures as JSON.

    """
    entry = _entry("room", points, corners, outline, surface, height, height_point)
    _build([entry], env, output, json, "stand-in room", [])


@app.command
def depth(
    mesh: Path, *, env: Path, width: int | None = None, output: Out, json: Json = False
) -> None:
    """The light-depth map: RGB of the map, and Z, the distance to the mesh in metres.

    Z is infinite where the mesh is not met.

    Parameters
    ----------
    mesh
        The stand-in, F.ply.
    env
        The map, env.exr.
    width
        Width of the result; it must divide the map's.
    output
        The light-depth map, env_depth.exr.
    json
        Print the figures as JSON.

    """
    from chromeball.scene.image import read_header, read_rgb, write_exr
    from chromeball.stand_in.depth import coverage, distance_map, shrink
    from chromeball.stand_in.panorama import panorama, read_panorama
    from chromeball.stand_in.ply import read_stand_in

    with Stage("stand-in depth", [mesh, env], width=width) as stage:
        geometry = read_stand_in(mesh)
        camera = read_panorama(env)
        rgb = read_rgb(env)
        if width is not None:
            rgb = shrink(rgb, width)
        origin = camera.world_from_camera.translation
        distance = distance_map(geometry, panorama((rgb.shape[1], rgb.shape[0]), origin))
        stage.figures.update(coverage(distance))
        attributes = read_header(env).attributes
        kept = {name: attributes[name] for name in ("chromaticities",) if name in attributes}
        with stage.output(output) as temporary:
            write_exr(
                temporary,
                np.concatenate([rgb, distance[..., None]], axis=2),
                channels=("R", "G", "B", "Z"),
                attributes=kept
                | {"textureformat": "LatLong Environment", "origin": origin, "depthUnit": "m"},
            )
    _print(stage.figures, json, output)


def _entry(
    kind: Literal["polygon", "box", "room"],
    points: str | None,
    corners: str | None,
    outline: Outline,
    surface: Surface,
    height: float | None,
    height_point: str | None,
) -> StandIn:
    if height is not None and not 0 < height < np.inf:
        raise UserError(f"--height {height:g}: it must be positive and finite")
    top = _numbers(height_point, "--height-point", 2) if height_point is not None else None
    return StandIn(
        name=kind,
        kind=kind,
        points=_pairs(points, "--points"),
        corners=_pairs(corners, "--corners"),
        outline=outline,
        height=height,
        height_point=None if top is None else (top[0], top[1]),
        surface=surface,
    )


def _build(
    entries: list[StandIn],
    env: Path | None,
    output: Path,
    as_json: bool,
    name: str,
    inputs: list[Path],
) -> None:
    from chromeball.stand_in.panorama import read_panorama
    from chromeball.stand_in.ply import write_stand_in
    from chromeball.stand_in.primitives import build_mesh, build_piece

    with Stage(name, inputs + ([env] if env else [])) as stage:
        camera = read_panorama(env) if env else None
        pieces = [build_piece(entry, camera) for entry in entries]
        mesh = build_mesh(pieces)
        stage.figures.update(_figures(pieces, camera))
        if env and camera:
            stage.figures["overlay"] = _draw(env, camera, pieces, output)
        with stage.output(output) as temporary:
            write_stand_in(temporary, mesh)
    _print(stage.figures, as_json, output)


def _figures(pieces: list[Piece], camera: CameraModel | None) -> dict[str, object]:
    from chromeball.stand_in.depth import coverage, distance_map
    from chromeball.stand_in.panorama import panorama
    from chromeball.stand_in.ply import ENVIRONMENT, SUPPORT
    from chromeball.stand_in.primitives import build_mesh

    mesh = build_mesh(pieces)
    a, b, c = np.moveaxis(mesh.triangles(), 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    figures: dict[str, object] = {
        "faces": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "area_support": float(areas[mesh.surface == SUPPORT].sum()),
        "area_environment": float(areas[mesh.surface == ENVIRONMENT].sum()),
        "bounding_box": [mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)],
        "pieces": [
            {
                "name": piece.name,
                "faces": len(piece.faces),
                "height": piece.height,
                "height_miss": piece.height_miss,
                "metres_per_pixel": piece.metres_per_pixel,
            }
            for piece in pieces
        ],
    }
    if camera is not None:
        figures["origin"] = camera.world_from_camera.translation
        small = panorama((256, 128), camera.world_from_camera.translation)
        figures.update(coverage(distance_map(mesh, small)))
    return figures


def _draw(env: Path, camera: CameraModel, pieces: list[Piece], output: Path) -> str:
    """Draw the mesh over the map beside `output`; returns the picture's name."""
    from chromeball.scene.image import read_rgb, write_picture
    from chromeball.stand_in.panorama import overlay
    from chromeball.stand_in.primitives import build_mesh

    picture = overlay(read_rgb(env), camera, build_mesh(pieces))
    path = output.with_name(output.stem + ".overlay.png")
    write_picture(path, picture)
    return path.name


def _pairs(text: str | None, option: str) -> list[tuple[float, float]]:
    if text is None:
        return []
    pairs = [_numbers(word, option, 2) for word in text.split()]
    return [(x, y) for x, y in pairs]


def _numbers(text: str, option: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise UserError(f"{option}: {text!r} is not numbers with commas between") from error
    if len(values) != count or not np.isfinite(values).all():
        raise UserError(f"{option}: {text!r} is not {count} finite numbers with commas between")
    return values


def _print(figures: dict[str, Any], as_json: bool, output: Path) -> None:
    if as_json:
        print(json.dumps(to_json(figures), indent=1))
        return
    print(output)
    for name, value in figures.items():
        if isinstance(value, float | int):
            print(f"  {name.replace('_', ' ')}: {value:.6g}", file=sys.stderr)
