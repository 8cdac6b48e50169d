"""``chromeball envmap probe``: shots of a light probe to one map."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    check_panorama_width,
    lens_of,
    parse_numbers,
    print_figures,
    read_camera,
    write_panorama,
)
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.scene.manifest import Probe


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
        return parse_numbers(text, option, count) if text is not None else [0.0] * count

    if (lens is None) == (camera is None):
        raise UserError("give --lens or --camera, one of the two")
    _probe(
        shots,
        [angles(yaw, "--yaw"), angles(pitch, "--pitch"), angles(roll, "--roll")],
        lens,
        camera,
        parse_numbers(vignetting, "--vignetting", None) if vignetting else [],
        align,
        clicked,
        1024 if width is None else width,
        output,
        json,
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

    check_panorama_width(width)
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
                model = lens_of(of_scene, size, Path(), file)
            else:
                assert camera is not None
                model = read_camera(camera, size, file)
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
        write_panorama(stage, output, result.radiance, result.alpha, kept, origin)
    if result.missing > 0.01:
        print(
            f"{result.missing:.2f} sr were seen by no shot and are completed from the border "
            f"(alpha 0); {100 * result.completed_share:.1f} % of the light lies there",
            file=sys.stderr,
        )
    print_figures(stage.figures, as_json, output)


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
        write_panorama(stage, output, result.radiance, result.coverage, kept, origin)
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
