"""``chromeball envmap stitch``: frames of several directions to one map."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    check_panorama_width,
    clicked_shot,
    parse_numbers,
    print_figures,
    read_camera,
    write_panorama,
)
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.stitch.bend import Bends
    from chromeball.envmap.stitch.features import Features
    from chromeball.envmap.stitch.frames import Frame
    from chromeball.envmap.stitch.lens import Freedom
    from chromeball.envmap.stitch.orient import Oriented, Prior
    from chromeball.scene.camera import CameraModel

type Refine = Literal["none", "focal", "lens", "all"]
type Bend = Literal["auto", "no"]
type Expose = Literal["auto", "keep", "white-balance"]

#: Maps are no wider than this unless a width is asked for.
WIDEST = 8192


def stitch(
    frames: list[Path],
    /,
    *,
    camera: Path | None = None,
    lens: str | None = None,
    refine: Refine | None = None,
    directions: Path | None = None,
    yaw: str | None = None,
    pitch: str | None = None,
    roll: str | None = None,
    sigma: float | None = None,
    align: Path | None = None,
    clicked: int | None = None,
    response: Path | None = None,
    exposure: Expose = "auto",
    bend: Bend = "auto",
    width: int | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """Frames of several directions to one lat-long map, in linear radiance throughout.

    Beside the map: its preview, the frames' borders and the seams, the panorama through the
    lens beside a frame, the refined lens (.cameramodel) and directions (.directions.json).

    Parameters
    ----------
    frames
        Radiance pictures, or photographs of one exposure each, of one camera and zoom; or one
        scene file that says everything.
    camera
        The calibrated camera.
    lens
        Its model instead: MODEL (of unknown focal length), MODEL:FOV[:cx,cy,radius], or
        MODEL:10.5mm:23.6, focal length and sensor width. Without either the metadata's focal
        length, or a search.
    refine
        What of the lens is solved along: none, focal, lens (focal length and distortion), all
        (its centre, too). A calibrated camera is kept (none), others are not (lens).
    directions
        A tracker's rotations, JSON or CSV.
    yaw
        Turn of each frame about the vertical as it was aimed, degrees, right-handed from above.
    pitch
        Tilt of each frame, degrees, up positive.
    roll
        Roll of each frame, degrees, clockwise.
    sigma
        How far directions are off, degrees an axis: a tracker 1, aimed angles 4.
    align
        World axes, align.json.
    clicked
        Number, from 1, of the frame that was aligned; by default the one named in align.json.
    response
        The camera's response.json, for photographs; sRGB otherwise.
    exposure
        auto: exposures and vignetting are made equal where frames overlap; keep: they are
        right; white-balance: each channel by itself.
    bend
        auto: where the camera moved between frames (parallax) they are bent a little so that
        they meet, and that is told; no: they are not.
    width
        Of the map, in pixels; by default what the frames resolve.
    output
        The map, env.exr.
    json
        Print the figures as JSON.

    """
    from chromeball.envmap.stitch.directions import SESSION, from_angles, read_directions

    if len(frames) == 1 and frames[0].suffix == ".toml":
        given = (camera, lens, refine, directions, yaw, pitch, roll, sigma, align, clicked)
        if any(option is not None for option in (*given, response, width)):
            raise UserError("a scene file says everything: leave out the other options")
        _of_scene(frames[0], output, json)
        return
    count = len(frames)
    if camera is not None and lens is not None:
        raise UserError("give --lens or --camera, not both")
    angles = [yaw, pitch, roll]
    if directions is not None and any(a is not None for a in angles):
        raise UserError("give --directions or --yaw, --pitch and --roll, not both")
    if sigma is not None and (not 0 < sigma < 180 or (directions is None and yaw is None)):
        raise UserError(f"--sigma {sigma:g}: degrees, for --directions or --yaw")
    if yaw is None and (pitch is not None or roll is not None):
        raise UserError("--pitch and --roll need --yaw")
    names = [path.stem for path in frames]
    prior: Prior | None = None
    if directions is not None:
        prior = read_directions(directions, names, sigma)
    elif yaw is not None:
        three = [
            parse_numbers(a, f"--{n}", count) if a is not None else [0.0] * count
            for a, n in zip(angles, ("yaw", "pitch", "roll"), strict=True)
        ]
        prior = from_angles(*three, sigma=SESSION if sigma is None else sigma)
    run(
        frames,
        camera=camera,
        lens=lens,
        refine=refine,
        prior=prior,
        inputs=[p for p in (camera, directions, align, response) if p is not None],
        align=align,
        clicked=clicked,
        response=response,
        exposure=exposure,
        bend=bend,
        width=width,
        output=output,
        as_json=json,
    )


def _of_scene(path: Path, output: Path, as_json: bool) -> None:
    """The command that `plan` writes, for the scene as it is."""
    from chromeball.cli.stages import lens_text
    from chromeball.scene.manifest import read_scene

    scene = read_scene(path)
    root, probe = path.parent, scene.probe
    if scene.env.file:
        raise UserError(
            f"{scene.env.file} is a finished panorama: nothing to stitch", file=path
        )
    if probe is None or not probe.stitch:
        raise UserError("[probe] has no stitch = true: use `envmap probe`", file=path)
    aimed = probe.directions is None

    def angles(axis: str) -> str | None:
        values = ",".join(f"{getattr(shot, axis):.10g}" for shot in probe.shot)
        return values if aimed else None

    stitch(
        [root / scene.folder / f"{shot.bracket}.exr" for shot in probe.shot],
        camera=root / probe.camera if probe.camera else None,
        lens=lens_text(probe.lens) if probe.lens and not probe.camera else None,
        directions=root / probe.directions if probe.directions else None,
        yaw=angles("yaw"),
        pitch=angles("pitch"),
        roll=angles("roll"),
        sigma=probe.sigma,
        align=root / scene.folder / "align.json" if scene.align else None,
        width=scene.env.width,
        output=output,
        json=as_json,
    )


def run(
    files: Sequence[Path],
    *,
    camera: Path | None,
    lens: str | None,
    refine: Refine | None,
    prior: Prior | None,
    inputs: Sequence[Path],
    align: Path | None,
    clicked: int | None,
    response: Path | None,
    exposure: Expose,
    bend: Bend,
    width: int | None,
    output: Path,
    as_json: bool,
) -> None:
    """The stage, with everything read from the command line or the scene file."""
    import numpy as np

    from chromeball.envmap.align import read_alignment
    from chromeball.envmap.complete import Source, from_border
    from chromeball.envmap.mapping import LatLong
    from chromeball.envmap.stitch.bend import PARALLAX, bent_all, parallax
    from chromeball.envmap.stitch.bend import bend as bent_to_meet
    from chromeball.envmap.stitch.blend import compose
    from chromeball.envmap.stitch.features import find
    from chromeball.envmap.stitch.lens import pixel_focal
    from chromeball.envmap.stitch.orient import orient
    from chromeball.envmap.stitch.photometric import solve, unchanged
    from chromeball.scene.record import Stage, write_json

    names = [path.stem for path in files]
    if len(files) < 2:
        raise UserError("one frame needs no stitching; `envmap probe` takes it to a map")
    if len({*names}) < len(names):
        raise UserError("two frames have the same name; rename one")
    if width is not None:
        check_panorama_width(width)
    with Stage("envmap stitch", [*files, *inputs], width=width, exposure=exposure) as stage:
        frames = _read(files, response)
        features = []
        for frame in frames:
            _say(f"features of {frame.name}")
            features.append(find(frame.radiance, frame.valid))
        model, freedom, lens_notes = _lens(camera, lens, refine, frames, features)
        found = orient(
            features, model, freedom=freedom, prior=prior, names=names, progress=_say
        )
        rotations, origin = found.rotations, None
        if align is not None:
            pose, picture = read_alignment(align)
            index = clicked_shot(names, clicked, picture, align)
            rotations = pose.rotation @ rotations[index].T @ rotations
            origin = pose.translation
        elif clicked is not None:
            raise UserError(f"--clicked {clicked} is for --align")
        bends = None
        if bend == "auto" and parallax(found.adjusted) > PARALLAX:
            _say("bending frames: the camera moved between them")
            bends = bent_to_meet(found.matches, found.adjusted)
            frames = bent_all(frames, bends)
        if exposure == "keep":
            light = unchanged(len(frames))
        else:
            light = solve(
                frames, found.camera, rotations, white_balance=exposure == "white-balance"
            )
        if width is None:
            resolved = 2 * math.pi * pixel_focal(found.camera)
            width = min(WIDEST, max(64, 64 * round(resolved / 64)))
        result = compose(frames, found.camera, rotations, width, light, progress=_say)
        missing = result.alpha == 0
        completed = from_border(result.radiance, missing) * float(Source.BORDER)
        solid = LatLong((width, width // 2)).solid_angles()
        notes = [*lens_notes, *found.notes]
        if bends is not None:
            notes.append(
                f"the camera moved between frames (parallax): they are bent by up to "
                f"{bends.largest:.0f} px, half of the held-out matches lie within "
                f"{bends.held_out[1]:.2f} px instead of {bends.held_out[0]:.2f}"
            )
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
        stage.figures |= {
            "size": [width, width // 2],
            "frames": names,
            "linear": sorted({frame.source for frame in frames}),
            "origin": origin,
            **_orientation_figures(found, names),
            "exposure": np.exp(light.exposure).round(6),
            "exposure_sigma": light.exposure_sigma,
            "vignetting": light.falloff,
            "vignetting_sigma": light.falloff_sigma,
            "overlap_scatter": light.scatter,
            "photometric": light.applied,
            "energy_error": result.energy_errors,
            "bend_px": None if bends is None else _bend_figures(bends),
            "hot_share": result.hot_share,
            "blend_energy": result.blend_energy,
            "limited_pixels": result.limited,
            "limited_share": result.limited_share,
            "moved_places": result.seams.places,
            "moved_solid_angle": result.seams.moved_solid_angle,
            "torn_places": result.seams.torn,
            "seen_solid_angle": float((solid * result.alpha).sum()),
            "completed_solid_angle": float((solid * (1 - result.alpha)).sum()),
            "notes": notes,
        }
        _pictures(stage, output, frames, found.camera, rotations, light, result)
        with stage.output(output.with_name(f"{output.stem}.cameramodel")) as temporary:
            found.camera.write(temporary)
        with stage.output(output.with_name(f"{output.stem}.directions.json")) as temporary:
            write_json(temporary, _directions(names, rotations, found))
        kept = dict(frames[0].attributes)
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
    print_figures(stage.figures, as_json, output)


def _read(files: Sequence[Path], response: Path | None) -> list[Frame]:
    from chromeball.envmap.stitch.frames import check_alike, read_frame

    curve = None
    if response is not None:
        from chromeball.hdr.response_file import read_response

        curve = read_response(response)
    frames: list[Frame] = []
    for file in files:
        _say(f"reading {file.name}")
        frames.append(read_frame(file, curve))
    check_alike(frames)
    kinds = {frame.source for frame in frames}
    if len(kinds) > 1:
        raise UserError(f"frames of different kinds: {', '.join(sorted(kinds))}")
    if response is not None and kinds == {"radiance"}:
        raise UserError("the frames are radiance already; leave out --response", file=response)
    if any(kind.startswith("sRGB") for kind in kinds):
        print(
            "note: photographs are made linear as sRGB; --response gives the camera's own "
            "curve, and what is clipped in them stays a lower bound",
            file=sys.stderr,
        )
    return frames


def _lens(
    camera: Path | None,
    lens: str | None,
    refine: Refine | None,
    frames: Sequence[Frame],
    features: Sequence[Features],
) -> tuple[CameraModel, Freedom, list[str]]:
    from chromeball.envmap.stitch.lens import Freedom, parse_lens
    from chromeball.envmap.stitch.orient import likeliest

    size, focal35 = frames[0].size, frames[0].focal35
    notes: list[str] = []
    guess = False
    if camera is not None:
        model = read_camera(camera, size, Path(frames[0].name))
    elif lens is not None:
        model, guess = parse_lens(lens, size, focal35)
    elif focal35 is not None:
        model, guess = parse_lens("pinhole", size, focal35)
        notes.append(f"lens from metadata: {focal35:g} mm at 36 mm, perspective")
    else:
        _say("searching a lens")
        kinds = [parse_lens(kind, size)[0] for kind in ("pinhole", "equisolid", "equidistant")]
        model, guess = likeliest(features, kinds), True
        notes.append(f"no lens is given: {model.model} explains the frames best")
    if refine is None:
        refine = "none" if camera is not None else "lens"
    if guess and refine == "none":
        raise UserError("--refine none: the focal length is not known; give MODEL:FOV")
    freedom = Freedom(
        focal=refine != "none", radial=refine in ("lens", "all"), centre=refine == "all"
    )
    return model, freedom, notes


def _orientation_figures(found: Oriented, names: Sequence[str]) -> dict[str, Any]:
    import numpy as np

    adjusted = found.adjusted
    residual = adjusted.residuals[adjusted.inliers]
    some = residual if residual.size else np.array([math.nan])
    return {
        "connected": len(found.groups[0]),
        "groups": [[names[k] for k in group] for group in found.groups],
        "matches": len(adjusted.inliers),
        "inliers": int(adjusted.inliers.sum()),
        "residual_px": {
            "median": float(np.median(some)),
            "rms": float(np.sqrt(np.mean(some**2))),
            "median_of_all": float(np.median(adjusted.residuals)) if residual.size else None,
        },
        "sigma_degrees": np.degrees(adjusted.sigma),
        "condition": adjusted.condition,
        "lens": {
            "model": found.camera.model,
            "intrinsics": found.camera.intrinsics,
            "sigma": adjusted.lens_sigma,
        },
        "off_prior_degrees": np.degrees(adjusted.prior_residual),
        "doubted": [names[k] for k in found.doubted],
        "refused_pairs": [[names[i], names[j]] for i, j in found.refused],
    }


def _bend_figures(bends: Bends) -> dict[str, Any]:
    """Medians and RMS in pixels, of the matches that count, and of those held out."""
    return {
        "largest": bends.largest,
        "matches": bends.inliers,
        "before": bends.before,
        "after": bends.after,
        "held_out": bends.held_out,
    }


def _directions(names: Sequence[str], rotations: Any, found: Oriented) -> dict[str, Any]:
    """What --directions reads again."""
    import numpy as np

    sigma = np.degrees(found.adjusted.sigma)
    return {
        "frames": [
            {"file": name, "world_from_camera": turn, "sigma": max(float(s), 1e-4)}
            for name, turn, s in zip(names, rotations, sigma, strict=True)
        ]
    }


def _pictures(
    stage: Any,
    output: Path,
    frames: Sequence[Frame],
    camera: CameraModel,
    rotations: Any,
    light: Any,
    result: Any,
) -> None:
    from chromeball.envmap.picture import tone_mapped, write_preview
    from chromeball.envmap.stitch.check import outlines, through_lens

    shown = tone_mapped(result.radiance, result.alpha, width=1600)
    stage.figures["outlines"] = write_preview(
        output, "seams", outlines(shown, result.labels, camera, rotations)
    )
    checks = []
    for k, frame in enumerate(frames):
        own = frame.radiance * light.gain(k, camera) if light.applied else frame.radiance
        checks.append(through_lens(result.radiance, result.alpha, camera, rotations[k], own))
    worst = max(range(len(checks)), key=lambda k: checks[k].difference)
    stage.figures |= {
        "check": write_preview(output, "check", checks[worst].picture),
        "check_frame": frames[worst].name,
        "check_ratio": [check.ratio for check in checks],
        "check_difference": [check.difference for check in checks],
        "check_far": [check.far for check in checks],
    }


def _say(text: str) -> None:
    print(text, file=sys.stderr)
