"""``chromeball envmap``: the light around a point."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.mapping import Mapping
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.manifest import Align, Probe, Scene

app = App(name="envmap", help="The light around a point.")

type Kind = Literal["mirror", "angular", "fisheye", "paraboloid", "cube", "latlong"]
type Out = Annotated[Path, Parameter(name=["--output", "-o"])]
type Json = Annotated[bool, Parameter(negative="")]


@app.command
def warp(
    picture: Path,
    /,
    *,
    from_: Annotated[Kind, Parameter(name="--from")],
    to: Kind,
    width: int,
    camera: Path | None = None,
    lens: str | None = None,
    to_lens: str | None = None,
    rotate: str | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """One map to another, the energy of small bright lights kept.

    A cube is a horizontal cross, 4:3; a mirror ball is a photograph of one, cropped to it.
    Where the source does not see, the result is black with alpha 0.

    Parameters
    ----------
    picture
        A scene-linear map; pixels of alpha 0 are left out.
    from_
        What the picture is.
    to
        What to make of it.
    width
        Of the result, in pixels.
    camera
        The fisheye, as a camera model; its pose is not used.
    lens
        The fisheye, as MODEL:FOV[:cx,cy,radius], degrees and pixels.
    to_lens
        The fisheye that is made, where both maps are fisheyes.
    rotate
        YAW,PITCH,ROLL in degrees by which the world is turned: what lay ahead moves to the
        left by yaw (right-handed about +Y), up by pitch; roll is clockwise.
    output
        The map, an EXR.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.mapping import make_mapping, sized
    from chromeball.envmap.picture import (
        latlong_attributes,
        read_radiance,
        tone_mapped,
        write_preview,
    )
    from chromeball.envmap.probe import rotation
    from chromeball.envmap.resample import warp as resample
    from chromeball.scene.image import write_exr
    from chromeball.scene.record import Stage

    angles = _numbers(rotate, "--rotate", 3) if rotate is not None else [0.0, 0.0, 0.0]
    if not 2 <= width <= 65536:
        raise UserError(f"--width {width}: it must be from 2 to 65536")
    fisheyes = [from_, to].count("fisheye")
    if to_lens is not None and fisheyes < 2:
        raise UserError("--to-lens is for a fisheye made of a fisheye; use --lens")
    if (camera or lens) and not fisheyes:
        raise UserError("neither map is a fisheye: --lens and --camera have no use")
    if fisheyes == 2 and to_lens is None:
        raise UserError("--to-lens is missing: both maps are fisheyes")
    image = read_radiance(picture)
    size, kept = image.size, dict(image.attributes)
    if from_ == "fisheye":
        source = _fisheye(lens, camera, size, picture)
    else:
        try:
            source = make_mapping(from_, size)
        except UserError as error:
            raise UserError(error.what, file=picture) from error
    target = (
        _target_fisheye(to_lens if fisheyes == 2 else lens, camera, width, fisheyes == 2)
        if to == "fisheye"
        else make_mapping(to, sized(to, width))
    )
    with Stage("envmap warp", [picture, *([camera] if camera else [])], to=to) as stage:
        result = resample(
            image.rgb,
            source,
            target,
            rotation=rotation(*(math.radians(a) for a in angles)),
            valid=image.valid,
        )
        stage.figures |= {
            "size": target.size,
            "energy": result.energy,
            "source_energy": result.source_energy,
            "hot_pixels": result.hot_pixels,
            "hot_energy_outside": result.outside,
            "seen_solid_angle": float((target.solid_angles() * result.coverage).sum()),
            "preview": write_preview(
                output, "preview", tone_mapped(result.radiance, result.coverage)
            ),
        }
        if any(angles):
            kept.pop("origin", None)
        attributes = latlong_attributes(kept) if to == "latlong" else kept
        with stage.output(output) as temporary:
            write_exr(
                temporary,
                np.concatenate([result.radiance, result.coverage[..., None]], axis=2),
                channels=("R", "G", "B", "A"),
                attributes=attributes,
            )
    _print(stage.figures, json, output)


@app.command
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
        clicks = _points(points)
        extent = _size(size) if size is not None else _picture_size(picture)
        if (lens is None) == (camera is None):
            raise UserError("give --lens or --camera, one of the two")
        if lens == "latlong":
            if extent is None:
                raise UserError("--lens latlong needs --size or --picture")
            model = CameraModel.latlong(extent)
        elif camera is not None:
            model = _read_camera(camera, extent, picture)
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


@app.command
def probe(
    shots: list[Path],
    /,
    *,
    yaw: str | None = None,
    pitch: str | None = None,
    roll: str | None = None,
    lens: str | None = None,
    camera: Path | None = None,
    vignetting: str | None = None,
    align: Path | None = None,
    clicked: int | None = None,
    width: int | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """Shots of a fisheye light probe to one lat-long map in world axes.

    What no shot sees is completed soberly and has alpha 0.

    Parameters
    ----------
    shots
        Radiance pictures, or one scene file that says everything.
    yaw
        Turn of each shot about the vertical, degrees, right-handed seen from above: "0,180".
    pitch
        Tilt of each shot, degrees, up positive.
    roll
        Roll of each shot, degrees, clockwise.
    lens
        The fisheye, MODEL:FOV[:cx,cy,radius].
    camera
        A calibrated camera instead.
    vignetting
        Fall-off c1,c2,... of 1 + c1 r^2 + c2 r^4 + ..., r = 1 at the rim of the circle.
    align
        World axes, align.json.
    clicked
        Number, from 1, of the shot that was aligned; by default the one of the name in
        align.json, or the first.
    width
        Of the map, in pixels (1024).
    output
        The map, env.exr.
    json
        Print the figures as JSON.

    """
    if len(shots) == 1 and shots[0].suffix == ".toml":
        options = (yaw, pitch, roll, lens, camera, vignetting, align, clicked, width)
        if any(option is not None for option in options):
            raise UserError("a scene file says everything: leave out the other options")
        _probe_of_scene(shots[0], output, json)
        return
    count = len(shots)

    def angles(text: str | None, option: str) -> list[float]:
        return _numbers(text, option, count) if text is not None else [0.0] * count

    if (lens is None) == (camera is None):
        raise UserError("give --lens or --camera, one of the two")
    _probe(
        shots,
        [angles(yaw, "--yaw"), angles(pitch, "--pitch"), angles(roll, "--roll")],
        lens,
        camera,
        _numbers(vignetting, "--vignetting", None) if vignetting else [],
        align,
        clicked,
        1024 if width is None else width,
        output,
        json,
    )


@app.command
def lights(
    env: Path,
    /,
    *,
    count: int = 64,
    depth: Path | None = None,
    ambient: Annotated[bool, Parameter(negative="")] = False,
    output: Out,
    json: Json = False,
) -> None:
    """A map as light samples of the same total irradiance (variance cut).

    Parameters
    ----------
    env
        A lat-long map.
    count
        How many lights at most.
    depth
        A light-depth map, env_depth.exr: the lights get positions.
    ambient
        Keep the order-2 harmonics of what the lights leave out.
    output
        The lights, lights.json.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.lights import variance_cut
    from chromeball.envmap.mapping import LatLong, make_mapping
    from chromeball.envmap.picture import read_radiance, tone_mapped, write_preview
    from chromeball.scene.record import Stage, write_json

    if not 1 <= count <= 65536:
        raise UserError(f"--count {count}: between 1 and 65536 lights")
    image = read_radiance(env)
    radiance, size, kept = image.rgb, image.size, image.attributes
    try:
        make_mapping("latlong", size)
    except UserError as error:
        raise UserError(error.what, file=env) from error
    distance = _read_depth(depth, size) if depth is not None else None
    origin = kept.get("origin")
    if distance is not None and origin is None:
        raise UserError(
            "no attribute `origin`: positions need the probe's place; make the map with "
            "`envmap probe --align`",
            file=env,
        )
    with Stage("envmap lights", [env, *([depth] if depth else [])], count=count) as stage:
        try:
            result = variance_cut(
                radiance,
                count,
                depth=distance,
                origin=np.zeros(3) if origin is None else np.ravel(origin),
                ambient=ambient,
            )
        except UserError as error:
            raise UserError(error.what, file=env) from error
        own = result.own_irradiance()
        energy = (result.radiance * result.solid_angles[:, None]).sum(axis=0)
        scale = np.maximum(result.irradiance.max(axis=0), 1e-300)
        display = tone_mapped(radiance)
        small = LatLong((display.shape[1], display.shape[0]))
        stage.figures |= {
            "lights": len(result.directions),
            "positioned": int(np.isfinite(result.positions).all(axis=1).sum()),
            "total": result.total,
            "total_error": float(np.max(np.abs(energy / np.maximum(result.total, 1e-300) - 1))),
            "irradiance_error": float(
                np.sqrt(np.mean(((own - result.irradiance) / scale) ** 2))
            ),
            "preview": write_preview(
                output, "preview", _dots(display, small.pixels_of(result.directions))
            ),
        }
        with stage.output(output) as temporary:
            write_json(temporary, result.to_json())
    _print(stage.figures, json, output)


# ---- the work behind align and probe


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
    _print(stage.figures, as_json, output)


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
        return CameraModel.latlong(_need_size(picture)), entry, picture, [path, picture]
    if scene.probe is None:
        raise UserError("there is no [probe]: nothing says through which lens", file=path)
    if entry.picture not in [shot.bracket for shot in scene.probe.shot]:
        raise UserError(f"align.picture {entry.picture!r} is no shot of the [probe]", file=path)
    picture = _picture_of(scene, entry.picture, root)
    model = _lens_of(scene.probe, _need_size(picture), root, picture)
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


def _lens_of(
    probe: Probe, size: tuple[int, int], root: Path, picture: Path | None
) -> CameraModel:
    from chromeball.scene.camera import CameraModel

    if (probe.lens is None) == (probe.camera is None):
        raise UserError("[probe] needs a lens or a camera, one of the two")
    if probe.camera is not None:
        return _read_camera(root / probe.camera, size, picture)
    assert probe.lens is not None
    return CameraModel.fisheye(
        probe.lens.model,
        size,
        math.radians(probe.lens.fov),
        centre=probe.lens.centre,
        radius=probe.lens.radius,
    )


def _probe_of_scene(path: Path, output: Path, as_json: bool) -> None:
    from chromeball.scene.manifest import read_scene

    scene = read_scene(path)
    root = path.parent
    aligned = root / scene.folder / "align.json" if scene.align else None
    if scene.env.file:
        _turn_panorama(root / scene.env.file, aligned, scene.env.width, output, as_json)
        return
    if scene.probe is None or not scene.probe.shot:
        raise UserError("there is no [probe] with a shot, and no env.file", file=path)
    shots = scene.probe.shot
    files = [root / scene.folder / f"{shot.bracket}.exr" for shot in shots]
    clicked = None
    if scene.align:
        names = [shot.bracket for shot in shots]
        if scene.align.picture not in names:
            raise UserError(
                f"align.picture {scene.align.picture!r} is no shot of the [probe]", file=path
            )
        clicked = names.index(scene.align.picture) + 1
    lens = scene.probe.lens
    _probe(
        files,
        [[s.yaw for s in shots], [s.pitch for s in shots], [s.roll for s in shots]],
        None,
        root / scene.probe.camera if scene.probe.camera else None,
        scene.probe.vignetting,
        aligned,
        clicked,
        scene.env.width,
        output,
        as_json,
        scene.probe if lens else None,
    )


def _probe(
    files: Sequence[Path],
    angles: Sequence[Sequence[float]],
    lens: str | None,
    camera: Path | None,
    vignetting: Sequence[float],
    aligned: Path | None,
    clicked: int | None,
    width: int,
    output: Path,
    as_json: bool,
    of_scene: Probe | None = None,
) -> None:
    from chromeball.envmap.align import read_alignment
    from chromeball.envmap.mapping import of_camera, parse_lens
    from chromeball.envmap.picture import read_radiance
    from chromeball.envmap.probe import Shot, combine, world_from_shots
    from chromeball.scene.record import Stage

    _check_panorama_width(width)
    if clicked is not None and (aligned is None or not 1 <= clicked <= len(files)):
        raise UserError(f"--clicked {clicked}: there is no such shot, or no --align")
    inputs = [*files, *(path for path in (camera, aligned) if path)]
    with Stage("envmap probe", inputs, width=width, vignetting=list(vignetting)) as stage:
        shots: list[Shot] = []
        clipped: list[float] = []
        kept: dict[str, Any] = {}
        for file, yaw, pitch, roll in zip(files, *angles, strict=True):
            image = read_radiance(file)
            kept, size = kept or dict(image.attributes), image.size
            if lens is not None:
                model = parse_lens(lens, size)
            elif of_scene is not None:
                model = _lens_of(of_scene, size, Path(), file)
            else:
                assert camera is not None
                model = _read_camera(camera, size, file)
            a, b, c = (math.radians(angle) for angle in (yaw, pitch, roll))
            shots.append(Shot(image.rgb, model, a, b, c, image.valid))
            if image.clipped is not None:
                solid = of_camera(model).solid_angles()
                clipped.append(float(solid[image.clipped].sum()))
        if aligned is not None:
            pose, picture = read_alignment(aligned)
            index = _clicked_shot(files, clicked, picture, aligned)
            rotations = world_from_shots(shots, index, pose.rotation)
            origin = pose.translation
        else:
            rotations, origin = world_from_shots(shots), None
        result = combine(shots, rotations, width, vignetting)
        stage.figures |= {
            "size": [width, width // 2],
            "shots": [file.stem for file in files],
            "origin": origin,
            "energy_error": result.energy_error,
            "hot_pixels": result.hot_pixels,
            "overlaps": [
                {
                    "shots": overlap.shots,
                    "median_ratio": overlap.ratio,
                    "spread": overlap.spread,
                    "solid_angle": overlap.solid_angle,
                }
                for overlap in result.overlaps
            ],
            "completed_solid_angle": result.missing,
            "completed_share": result.completed_share,
            "clipped_solid_angle": clipped or None,  # too bright for every exposure: a bound
        }
        _write_panorama(stage, output, result.radiance, result.alpha, kept, origin)
    if result.missing > 0.01:
        print(
            f"{result.missing:.2f} sr were seen by no shot and are completed from the border "
            f"(alpha 0); {100 * result.completed_share:.1f} % of the light lies there",
            file=sys.stderr,
        )
    _print(stage.figures, as_json, output)


def _turn_panorama(
    file: Path, aligned: Path | None, width: int, output: Path, as_json: bool
) -> None:
    """A finished panorama into world axes (seeds.md F15)."""
    from chromeball.envmap.align import read_alignment
    from chromeball.envmap.mapping import LatLong, make_mapping
    from chromeball.envmap.picture import read_radiance
    from chromeball.envmap.probe import complete
    from chromeball.envmap.resample import warp as resample
    from chromeball.scene.record import Stage

    _check_panorama_width(width)
    with Stage("envmap probe", [file, *([aligned] if aligned else [])], width=width) as stage:
        image = read_radiance(file)
        kept = dict(image.attributes)
        try:
            source = make_mapping("latlong", image.size)
        except UserError as error:
            raise UserError(error.what, file=file) from error
        origin = kept.get("origin")
        if aligned is not None:
            pose, _ = read_alignment(aligned)
            source, origin = source.turned(pose.rotation), pose.translation
        target = LatLong((width, width // 2))
        result = resample(image.rgb, source, target, valid=image.valid)
        complete(result.radiance, result.coverage == 0)
        stage.figures |= {
            "size": target.size,
            "origin": origin,
            "energy_error": [float(result.energy.sum() / result.source_energy.sum() - 1)],
            "hot_pixels": result.hot_pixels,
            "completed_solid_angle": float(
                (target.solid_angles() * (1 - result.coverage)).sum()
            ),
        }
        _write_panorama(stage, output, result.radiance, result.coverage, kept, origin)
    _print(stage.figures, as_json, output)


def _write_panorama(
    stage: Any, output: Path, radiance: Any, alpha: Any, kept: dict[str, Any], origin: Any
) -> None:
    import numpy as np

    from chromeball.envmap.picture import latlong_attributes, tone_mapped, write_preview
    from chromeball.scene.image import write_exr

    kept.pop("origin", None)
    stage.figures["preview"] = write_preview(output, "preview", tone_mapped(radiance, alpha))
    with stage.output(output) as temporary:
        write_exr(
            temporary,
            np.concatenate([radiance, alpha[..., None]], axis=2),
            channels=("R", "G", "B", "A"),
            attributes=latlong_attributes(kept, origin),
        )


def _clicked_shot(
    files: Sequence[Path], clicked: int | None, picture: str | None, aligned: Path
) -> int:
    if clicked is not None:
        return clicked - 1
    names = [file.stem for file in files]
    if picture is None:
        return 0
    if picture in names:
        return names.index(picture)
    raise UserError(
        f"aligned in {picture!r}, which is none of the shots {', '.join(names)}; "
        "say which with --clicked",
        file=aligned,
    )


# ---- what people type


def _numbers(text: str | None, option: str, count: int | None) -> list[float]:
    try:
        values = [float(part) for part in (text or "").split(",")]
    except ValueError as error:
        raise UserError(f"{option} {text!r}: numbers with commas between") from error
    if not all(math.isfinite(value) for value in values):
        raise UserError(f"{option} {text!r}: the numbers must be finite")
    if count is not None and len(values) != count:
        raise UserError(f"{option} {text!r}: {count} numbers are needed, not {len(values)}")
    return values


def _points(text: str) -> list[list[float]]:
    points = [_numbers(pair, "--points", 2) for pair in text.split()]
    if len(points) != 4:
        raise UserError(f"--points: four corners are needed, not {len(points)}")
    return points


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError as error:
        raise UserError(f"--size {text!r}: write it as 640x480") from error
    if min(width, height) < 1:
        raise UserError(f"--size {text!r}: it must be positive")
    return width, height


def _check_panorama_width(width: int) -> None:
    if not 2 <= width <= 65536 or width % 2:
        raise UserError(f"--width {width}: a lat-long map's width is even, from 2 to 65536")


def _picture_size(picture: Path | None) -> tuple[int, int] | None:
    return None if picture is None else _need_size(picture)


def _need_size(picture: Path) -> tuple[int, int]:
    from chromeball.scene.image import read_size

    return read_size(picture)


def _read_camera(path: Path, size: tuple[int, int] | None, picture: Path | None) -> CameraModel:
    from chromeball.scene.camera import CameraModel

    model = CameraModel.read(path)
    if size is not None and model.size != size:
        raise UserError(
            f"the camera's pictures are {model.size[0]}x{model.size[1]}, "
            f"{picture or '--size'} is {size[0]}x{size[1]}",
            file=path,
        )
    return model


def _fisheye(
    lens: str | None, camera: Path | None, size: tuple[int, int], picture: Path
) -> Mapping:
    from chromeball.envmap.mapping import of_camera, parse_lens

    if (lens is None) == (camera is None):
        raise UserError("a fisheye needs --lens or --camera, one of the two")
    if camera is not None:
        return of_camera(_read_camera(camera, size, picture))
    return of_camera(parse_lens(lens or "", size))


def _target_fisheye(lens: str | None, camera: Path | None, width: int, both: bool) -> Mapping:
    from chromeball.envmap.mapping import of_camera, parse_lens
    from chromeball.scene.camera import CameraModel

    if both:
        return of_camera(parse_lens(lens or "", (width, width)))
    if (lens is None) == (camera is None):
        raise UserError("a fisheye needs --lens or --camera, one of the two")
    if camera is None:
        return of_camera(parse_lens(lens or "", (width, width)))
    model = CameraModel.read(camera)
    return of_camera(model.scaled(width / model.size[0]))


def _read_depth(path: Path, size: tuple[int, int]) -> Any:
    """Metres, (H, W) at `size`, the nearest sample of a light-depth map."""
    import numpy as np

    from chromeball.scene.image import read_image

    image = read_image(path)
    if "Z" not in image.channels:
        raise UserError("no channel Z: not a light-depth map", file=path)
    distance = image.pixels[..., image.channels.index("Z")].astype(np.float32)
    height, width = distance.shape
    if width != 2 * height:
        raise UserError(f"{width}x{height} is no lat-long map: it must be 2:1", file=path)
    x = (np.arange(size[0]) + 0.5) * width / size[0]
    y = (np.arange(size[1]) + 0.5) * height / size[1]
    return np.ascontiguousarray(distance[y.astype(int)[:, None], x.astype(int)[None, :]])


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


def _dots(display: Any, pixels: Any) -> Any:
    import cv2
    import numpy as np

    picture = np.ascontiguousarray(display)
    for x, y in np.round(pixels).astype(int):
        cv2.circle(picture, (int(x), int(y)), 3, (0, 0, 0), -1, cv2.LINE_AA)
        cv2.circle(picture, (int(x), int(y)), 2, (255, 220, 0), -1, cv2.LINE_AA)
    return picture


def _print(figures: dict[str, object], as_json: bool, output: Path) -> None:
    from chromeball.scene.record import to_json

    if as_json:
        print(json.dumps({"output": str(output), **to_json_dict(figures)}, indent=1))
        return
    print(output)
    for name, value in figures.items():
        print(f"  {name}: {to_json(value)}")


def to_json_dict(figures: dict[str, object]) -> dict[str, object]:
    """Figures as plain JSON values."""
    from chromeball.scene.record import to_json

    return {name: to_json(value) for name, value in figures.items()}
