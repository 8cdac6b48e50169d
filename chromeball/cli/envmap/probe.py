"""``chromeball envmap probe``: shots of a light probe to one map."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    check_panorama_width,
    parse_numbers,
    print_figures,
    read_camera,
    read_mask,
    write_panorama,
)
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.mapping import Mapping
    from chromeball.envmap.picture import Radiance
    from chromeball.envmap.probe import Shot
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.manifest import Scene


@dataclass(frozen=True)
class _Request:
    """What is to be done, however it was said; angles in degrees, one of each per shot.

    ``lenses`` are camera models or what says one for a picture's size; ``fill`` a photograph
    and its camera.
    """

    files: list[Path]
    yaw: list[float]
    pitch: list[float]
    roll: list[float]
    lenses: list[str | Path | None]
    balls: list[list[float] | None]
    masks: list[Path | None]
    vignetting: list[float]
    photographer: float
    reflectance: list[float]
    trim: float
    refine: bool
    refine_lens: bool
    ground: list[float] | None
    fill: tuple[Path, Path] | None
    align: Path | None
    clicked: int | None
    width: int

    @property
    def inputs(self) -> list[Path]:
        cameras = [lens for lens in self.lenses if isinstance(lens, Path)]
        others = [*self.masks, self.align, *(self.fill or ())]
        named = [*self.files, *cameras, *(path for path in others if path is not None)]
        return list(dict.fromkeys(named))


def probe(
    shots: list[Path],
    /,
    *,
    yaw: str | None = None,
    pitch: str | None = None,
    roll: str | None = None,
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
        Of a ball: where its camera looks.
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
        Fall-off c1,c2,... of 1 + c1 r^2 + c2 r^4 + ..., r = 1 at the rim of the circle.
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

    _probe(
        _Request(
            files=shots,
            yaw=angles(yaw, "--yaw"),
            pitch=angles(pitch, "--pitch"),
            roll=angles(roll, "--roll"),
            lenses=[camera] * count if camera else each(lenses, "--lens"),
            balls=each(balls, "--ball"),
            masks=each(list(mask or []), "--mask"),
            vignetting=parse_numbers(vignetting, "--vignetting", None) if vignetting else [],
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
    from chromeball.cli.stages import lens_text
    from chromeball.scene.manifest import read_scene

    scene = read_scene(path)
    root = path.parent
    aligned = root / scene.folder / "align.json" if scene.align else None
    if scene.env.file:
        _turn_panorama(root / scene.env.file, aligned, scene.env.width, output, as_json)
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
    _probe(
        _Request(
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
            vignetting=entry.vignetting,
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


def _probe(request: _Request, output: Path, as_json: bool) -> None:
    import numpy as np

    from chromeball.envmap.align import read_alignment
    from chromeball.envmap.complete import Source
    from chromeball.envmap.mapping import LatLong
    from chromeball.envmap.picture import read_radiance
    from chromeball.envmap.probe import combine, refined, trimmed, world_from_shots
    from chromeball.envmap.refine_lens import refine_lenses
    from chromeball.scene.record import Stage

    check_panorama_width(request.width)
    files, clicked = request.files, request.clicked
    if clicked is not None and (request.align is None or not 1 <= clicked <= len(files)):
        raise UserError(f"--clicked {clicked}: there is no such shot, or no --align")
    settings = {"width": request.width, "vignetting": request.vignetting}
    with Stage("envmap probe", request.inputs, **settings) as stage:
        pictures = {file: read_radiance(file) for file in dict.fromkeys(files)}
        shots: list[Shot] = []
        clipped: list[float] = []
        for k, file in enumerate(files):
            shot, bound = _shot(request, k, pictures[file])
            shots.append(shot)
            clipped += [] if bound is None else [bound]
        index = 0
        if request.align is not None:
            pose, picture = read_alignment(request.align)
            index = _clicked_shot(files, clicked, picture, request.align)
            rotations = world_from_shots(shots, index, pose.rotation)
            origin = pose.translation
        else:
            rotations, origin = world_from_shots(shots), None
        if request.refine_lens:
            solved = refine_lenses(shots, rotations, index)
            shots, rotations = solved.shots, solved.rotations
            stage.figures["lens"] = {
                "fov_degrees": math.degrees(solved.fov),
                "fov_sigma_degrees": math.degrees(solved.fov_sigma),
                "centres": solved.centres,
                "centre_sigma": solved.centre_sigma,
                "correlation": solved.correlation,
                "as_option": " ".join(map(_lens_option, request.lenses, shots)),
            }
        elif request.refine and len(shots) > 1:
            rotations, found = refined(shots, rotations, index)
            stage.figures["refined"] = {
                "degrees": np.degrees(found.angles),
                "sigma_degrees": np.degrees(found.sigma),
                "correlation": found.correlation,
                "kept_as_given_because": found.reason or None,
            }
            if found.reason:
                print(f"directions kept as given: {found.reason}", file=sys.stderr)
        if request.trim:
            shots = [trimmed(shot, math.radians(request.trim)) for shot in shots]
        result = combine(shots, rotations, request.width)
        missing = result.alpha == 0
        if missing.all():
            raise UserError("no pixel of any shot can be used: check --lens, --ball and masks")
        completed, ratio = _complete(request, result.radiance, missing)
        solid = LatLong((request.width, request.width // 2)).solid_angles()
        energy = np.einsum("hwc,hw->hw", result.radiance, solid)
        share = float(energy[missing].sum() / max(float(energy.sum()), 1e-300))
        unseen = float((solid * (1 - result.alpha)).sum())
        stage.figures |= {
            "size": [request.width, request.width // 2],
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
            "completed_solid_angle": unseen,
            "completed_share": share,
            "completed_from": {
                source.name.lower(): float(solid[completed == source].sum())
                for source in Source
                if source != Source.SEEN and (completed == source).any()
            },
            "seen_over_fill": ratio,
            "clipped_solid_angle": clipped or None,  # too bright for every exposure: a bound
        }
        kept = dict(pictures[files[0]].attributes)
        write_panorama(
            stage,
            output,
            result.radiance,
            result.alpha,
            kept,
            origin,
            completed,
            result.clipped,
        )
    if unseen > 0.01:
        print(
            f"{unseen:.2f} sr were seen by no shot and are completed "
            f"(alpha 0); {100 * share:.1f} % of the light lies there",
            file=sys.stderr,
        )
    print_figures(stage.figures, as_json, output)


def _shot(request: _Request, k: int, image: Radiance) -> tuple[Shot, float | None]:
    """Shot k, ready to be placed, and the solid angle of what was clipped in it."""
    import numpy as np

    from chromeball.envmap.ball import ball_in_circle
    from chromeball.envmap.mapping import Lens, of_camera
    from chromeball.envmap.probe import Shot, without_vignetting

    file, ball = request.files[k], request.balls[k]
    camera = _camera(request.lenses[k], image.size, file)
    rgb, valid, clipped = image.rgb, image.valid, image.clipped
    mask = request.masks[k]
    if mask is not None:
        allowed = read_mask(mask, image.size, file)
        valid = allowed if valid is None else valid & allowed
    if ball is not None:
        x, y, radius = ball
        try:
            seen, part = ball_in_circle(image.size, (x, y), radius, camera).cut_out()
        except UserError as error:
            raise UserError(error.what, file=file) from error
        rgb = np.ascontiguousarray(rgb[part] / np.array(request.reflectance, np.float32))
        valid = None if valid is None else np.ascontiguousarray(valid[part])
        clipped = None if clipped is None else clipped[part]
        mapping: Mapping = Lens((rgb.shape[1], rgb.shape[0]), camera=seen)
    else:
        assert camera is not None
        mapping = of_camera(camera)
    a, b, c = (math.radians(float(v[k])) for v in (request.yaw, request.pitch, request.roll))
    if not 0 <= request.photographer < 120:
        raise UserError(f"--photographer {request.photographer:g}: from 0 to 120 degrees")
    back = math.radians(request.photographer) if ball is not None else 0.0
    shot = Shot(rgb, mapping, a, b, c, valid, back, clipped)
    try:
        if request.vignetting:
            shot = without_vignetting(shot, request.vignetting)
    except UserError as error:
        raise UserError(error.what, file=file) from error
    bound = None if clipped is None else float(shot.mapping.solid_angles()[clipped].sum())
    return shot, bound


def _lens_option(spec: str | Path | None, shot: Shot) -> str:
    """A solved lens as --lens takes it."""
    from chromeball.envmap.mapping import Radial

    lens = shot.mapping
    assert isinstance(lens, Radial)
    model = str(spec).split(":", 1)[0]
    (x, y), radius = lens.centre, lens.rim * lens.focal[0]
    return f"{model}:{2 * math.degrees(lens.max_angle):.4f}:{x:.2f},{y:.2f},{radius:.2f}"


def _camera(lens: str | Path | None, size: tuple[int, int], file: Path) -> CameraModel | None:
    from chromeball.envmap.mapping import parse_lens

    if isinstance(lens, Path):
        return read_camera(lens, size, file)
    return None if lens is None else parse_lens(lens, size)


def _complete(request: _Request, radiance: Any, missing: Any) -> tuple[Any, float | None]:
    """Fill what is missing, best first; where from, and how well the photograph fits."""
    import numpy as np

    from chromeball.envmap.complete import Source, from_border, from_plate, ground
    from chromeball.envmap.mapping import of_camera
    from chromeball.envmap.picture import read_radiance

    completed = np.zeros(missing.shape, np.uint8)
    seen, left, ratio = ~missing, missing.copy(), None
    if request.fill is not None:
        plate = read_radiance(request.fill[0])
        model = read_camera(request.fill[1], plate.size, request.fill[0])
        mapping = of_camera(model).turned(model.world_from_camera.rotation)
        filled, ratio = from_plate(radiance, left, plate.rgb, mapping)
        completed[filled] = Source.PLATE
        left &= ~filled
    if request.ground is not None:
        filled = ground(radiance, left, np.array(request.ground), seen)
        completed[filled] = Source.GROUND
        left &= ~filled
    completed[from_border(radiance, left)] = Source.BORDER
    return completed, ratio


def _turn_panorama(
    file: Path, aligned: Path | None, width: int, output: Path, as_json: bool
) -> None:
    """A finished panorama into world axes (seeds.md F15)."""
    from chromeball.envmap.align import read_alignment
    from chromeball.envmap.complete import Source, from_border
    from chromeball.envmap.mapping import LatLong, make_mapping
    from chromeball.envmap.picture import read_radiance
    from chromeball.envmap.resample import carry
    from chromeball.envmap.resample import warp as resample
    from chromeball.scene.record import Stage

    check_panorama_width(width)
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
        clipped = None
        if image.clipped is not None and image.clipped.any():
            clipped = carry(image.clipped, source, target, valid=image.valid)
        completed = from_border(result.radiance, result.coverage == 0) * float(Source.BORDER)
        stage.figures |= {
            "size": target.size,
            "origin": origin,
            "energy_error": [float(result.energy.sum() / result.source_energy.sum() - 1)],
            "hot_pixels": result.hot_pixels,
            "completed_solid_angle": float(
                (target.solid_angles() * (1 - result.coverage)).sum()
            ),
        }
        write_panorama(
            stage, output, result.radiance, result.coverage, kept, origin, completed, clipped
        )
    print_figures(stage.figures, as_json, output)


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
