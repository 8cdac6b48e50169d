"""``chromeball envmap probe``: shots of a light probe to one map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import Json, Out, parse_numbers
from chromeball.cli.envmap.probe_map import Request, make_map
from chromeball.cli.envmap.turned import turn_panorama
from chromeball.cli.options import Numbers
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.scene.manifest import Scene


def probe(
    shots: list[Path],
    /,
    *,
    yaw: Numbers = None,
    pitch: Numbers = None,
    roll: Numbers = None,
    lens: str | None = None,
    camera: Path | None = None,
    ball: str | None = None,
    photographer: float | None = None,
    reflectance: str | None = None,
    vignetting: str | None = None,
    trim: float | None = None,
    mask: Annotated[list[Path] | None, Parameter(consume_multiple=True)] = None,
    refine: bool | None = None,
    refine_lens: Annotated[bool | None, Parameter(negative="")] = None,
    ground: str | None = None,
    fill: str | None = None,
    align: Path | None = None,
    clicked: int | None = None,
    width: int | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """Shots of a fisheye or of a mirror ball to one lat-long map in world axes.

    Several shots are turned until they agree where they overlap. What no shot sees is
    completed, has alpha 0, and the channel `completed` says how.

    Parameters
    ----------
    shots
        Radiance pictures, or one scene file that says everything. One picture with several
        image circles is given once, with a lens for each.
    yaw
        Turn of each shot about the vertical, degrees, right-handed seen from above: "0,180".
        Of a ball: where its camera looks; the middle of its picture shows what is behind that
        camera (`envmap warp --from mirror` puts it ahead instead).
    pitch
        Tilt of each shot, degrees, up positive.
    roll
        Roll of each shot, degrees, clockwise.
    lens
        The fisheye, MODEL:FOV[:cx,cy,radius]; several with blanks between, one a shot.
    camera
        A calibrated camera instead; with --ball the camera that photographed the ball.
    ball
        The mirror ball's outline in each picture, "cx,cy,radius"; one for all, or with
        blanks between one a shot. Without --camera it is taken to be far away.
    photographer
        Half angle about the direction to a ball's camera that is not used, degrees (20).
    reflectance
        Of the ball, one number or r,g,b (1): the map is divided by it.
    vignetting
        Fall-off of the camera, divided out: a vignette.json of `calibrate vignette`, or of a
        fisheye c1,c2,... of 1 + c1 r^2 + c2 r^4 + ..., r = 1 at the rim of its circle, or
        HDRICalibrationTool's .cal of such.
    trim
        Leave out the outermost degrees of the image circle, where its edge is soft (0).
    mask
        A picture for each shot, white where it may be used.
    refine
        Turn the shots from what they see together; shot `clicked` keeps its place.
    refine_lens
        Solve for the lens as well, from the overlap: its field of view and each circle's
        centre. The record has it as --lens takes it.
    ground
        Complete what lies below the horizon as matt ground of this reflectance, 0.2 or r,g,b.
    fill
        PLATE.exr:CAMERA.cameramodel: complete with what this photograph shows.
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
        options: list[object] = [
            yaw,
            pitch,
            roll,
            lens,
            camera,
            ball,
            photographer,
            reflectance,
            vignetting,
        ]
        options += [trim, mask, refine, refine_lens, ground, fill, align, clicked, width]
        if any(option is not None for option in options):
            raise UserError("a scene file says everything: leave out the other options")
        _probe_of_scene(shots[0], output, json)
        return
    lenses = lens.split() if lens is not None else []
    balls = (
        [parse_numbers(one, "--ball", 3) for one in ball.split()] if ball is not None else []
    )
    if refine_lens and lens is None:
        raise UserError("--refine-lens solves for what --lens says: give it")
    if lens is not None and (camera is not None or balls):
        raise UserError("--lens goes with neither --camera nor --ball")
    if photographer is not None and not balls:
        raise UserError("--photographer is for --ball")
    if reflectance is not None and not balls:
        raise UserError("--reflectance is for --ball")
    if lens is None and camera is None and not balls:
        raise UserError("give --lens, --camera or --ball")
    if len(shots) == 1:
        shots = shots * max(len(lenses), len(balls), 1)
    count = len(shots)

    def each(values: list[Any], option: str) -> list[Any]:
        if len(values) not in (0, 1, count):
            raise UserError(f"{option}: one for all or {count}, not {len(values)}")
        return values if len(values) == count else (values or [None]) * count

    def angles(text: str | None, option: str) -> list[float]:
        return parse_numbers(text, option, count) if text is not None else [0.0] * count

    make_map(
        Request(
            files=shots,
            yaw=angles(yaw, "--yaw"),
            pitch=angles(pitch, "--pitch"),
            roll=angles(roll, "--roll"),
            lenses=[camera] * count if camera else each(lenses, "--lens"),
            balls=each(balls, "--ball"),
            masks=each(list(mask or []), "--mask"),
            vignetting=vignetting,
            photographer=20.0 if photographer is None else photographer,
            reflectance=_rgb(reflectance, "--reflectance") or [1.0, 1.0, 1.0],
            trim=trim or 0.0,
            refine=refine is not False,
            refine_lens=refine_lens or False,
            ground=_rgb(ground, "--ground"),
            fill=_fill(fill),
            align=align,
            clicked=clicked,
            width=1024 if width is None else width,
        ),
        output,
        json,
    )


def _rgb(text: str | None, option: str) -> list[float] | None:
    """A reflectance: one number, or three."""
    if text is None:
        return None
    values = parse_numbers(text, option, None)
    if len(values) not in (1, 3) or not all(0 < value <= 1 for value in values):
        raise UserError(f"{option} {text!r}: one number or r,g,b, above 0 and at most 1")
    return values * (3 // len(values))


def _fill(text: str | None) -> tuple[Path, Path] | None:
    if text is None:
        return None
    plate, colon, camera = text.rpartition(":")
    if not colon or not plate:
        raise UserError(f"--fill {text!r}: write it as PLATE.exr:CAMERA.cameramodel")
    return Path(plate), Path(camera)


def _probe_of_scene(path: Path, output: Path, as_json: bool) -> None:
    from chromeball.cli.stages import lens_text, vignetting_text
    from chromeball.scene.manifest import read_scene

    scene = read_scene(path)
    root = path.parent
    aligned = root / scene.folder / "align.json" if scene.align else None
    if scene.env.file:
        turn_panorama(root / scene.env.file, aligned, scene.env.width, output, as_json)
        return
    if scene.probe is None or not scene.probe.shot:
        raise UserError("there is no [probe] with a shot, and no env.file", file=path)
    entry, shots = scene.probe, scene.probe.shot
    clicked = None
    if scene.align:
        names = [shot.bracket for shot in shots]
        if scene.align.picture not in names:
            raise UserError(
                f"align.picture {scene.align.picture!r} is no shot of the [probe]", file=path
            )
        clicked = names.index(scene.align.picture) + 1
    lens = None if entry.lens is None else lens_text(entry.lens)
    make_map(
        Request(
            files=[root / scene.folder / f"{shot.bracket}.exr" for shot in shots],
            yaw=[shot.yaw for shot in shots],
            pitch=[shot.pitch for shot in shots],
            roll=[shot.roll for shot in shots],
            lenses=[
                root / entry.camera
                if entry.camera
                else lens_text(shot.lens)
                if shot.lens
                else lens
                for shot in shots
            ],
            balls=[None if shot.ball is None else list(shot.ball) for shot in shots],
            masks=[root / shot.mask if shot.mask else None for shot in shots],
            vignetting=vignetting_text(entry.vignetting, root),
            photographer=entry.photographer,
            reflectance=list(entry.reflectance),
            trim=entry.trim,
            refine=entry.refine,
            refine_lens=entry.refine_lens,
            ground=None if scene.env.ground is None else list(scene.env.ground),
            fill=_fill_of_scene(scene, root),
            align=aligned,
            clicked=clicked,
            width=scene.env.width,
        ),
        output,
        as_json,
    )


def _fill_of_scene(scene: Scene, root: Path) -> tuple[Path, Path] | None:
    if scene.env.fill is None:
        return None
    plate, camera = scene.photograph_of(scene.find_view(scene.env.fill))
    return root / plate, root / camera
