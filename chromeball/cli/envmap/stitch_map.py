"""What ``envmap stitch`` does once it knows what is asked for."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from chromeball.cli.envmap.arguments import (
    check_panorama_width,
    clicked_shot,
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
    from chromeball.envmap.stitch.links import Prior
    from chromeball.envmap.stitch.orient import Oriented
    from chromeball.scene.camera import CameraModel

type Refine = Literal["none", "focal", "lens", "all"]
type Bend = Literal["auto", "no"]
type Expose = Literal["auto", "keep", "white-balance"]

#: Codes whose response over sRGB is recorded, ln: 16, 64, 128, 192, 240.
RESPONSE = [15, 63, 127, 191, 239]
#: More of the sphere that moved than this, sr, is told.
MOVED = 0.3
#: Frames that differ by more from their neighbours, relatively, are named.
UNLIKE = 0.15
#: Maps are no wider than this unless a width is asked for.
WIDEST = 8192


def make_map(
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
    vignetting: str | None,
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
    from chromeball.envmap.stitch.frames import divided
    from chromeball.envmap.stitch.lens import pixel_focal
    from chromeball.envmap.stitch.orient import orient
    from chromeball.envmap.stitch.photometric import optics, solve, unchanged
    from chromeball.scene.record import Stage, check_output, write_json
    from chromeball.scene.vignette import check_once, resolved
    from chromeball.scene.vignette_option import read_given

    names = [path.stem for path in files]
    if len(files) < 2:
        raise UserError("one frame needs no stitching; `envmap probe` takes it to a map")
    if len({*names}) < len(names):
        raise UserError("two frames have the same name; rename one")
    if width is not None:
        check_panorama_width(width)
    check_output(output, [*files, *inputs], ".exr")
    falloff = None if vignetting is None else read_given(vignetting)
    settings = {"width": width, "exposure": exposure, "vignetting": vignetting}
    with Stage("envmap stitch", [*files, *inputs], **settings) as stage:
        frames = read_frames(files, response)
        features = []
        for frame in frames:
            _say(f"features of {frame.name}")
            features.append(find(frame.radiance, frame.valid))
        model, freedom, lens_notes = lens_of(camera, lens, refine, frames, features)
        if falloff is not None:
            for frame, path in zip(frames, files, strict=True):
                check_once(frame.attributes, path)
            known = resolved(falloff, model.size, *optics(model)[:2]).picture(model.size)
            frames = [divided(frame, known) for frame in frames]
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
                frames,
                found.camera,
                rotations,
                white_balance=exposure == "white-balance",
                falloff=falloff is None,
            )
        if width is None:
            around = 2 * math.pi * pixel_focal(found.camera)
            width = min(WIDEST, max(64, 64 * round(around / 64)))
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
        moved = result.seams.moved_solid_angle
        if moved > MOVED:
            notes.append(
                f"much moved ({moved:.2f} sr of the map): each place is taken whole from one "
                "frame; look at the seams"
            )
        unlike = [k for k in range(len(names)) if light.left[k] > UNLIKE]
        if unlike:
            listed = ", ".join(f"{names[k]} by {100 * light.left[k]:.0f} %" for k in unlike)
            notes.append(
                f"still differ from their neighbours in brightness: {listed}; did the light "
                "change, or does the camera adapt its curve to each picture? Use RAW, or a "
                "bracket"
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
            "response_over_srgb": light.curve[RESPONSE] if light.curve.any() else None,
            "overlap_scatter": light.scatter,
            "overlap_left": light.left,
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
        if light.falloff_told:
            with stage.output(output.with_name(f"{output.stem}.vignette.json")) as temporary:
                temporary.write_bytes(light.vignette(found.camera).encode())
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
            result.sigma,
        )
    print_figures(stage.figures, as_json, output)


def read_frames(files: Sequence[Path], response: Path | None) -> list[Frame]:
    """The frames as radiance, all of one kind."""
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
            "note: photographs are made linear as sRGB, and better where frames overlap; "
            "--response, from a bracket, is surer; what is clipped in them stays a lower bound",
            file=sys.stderr,
        )
    return frames


def lens_of(
    camera: Path | None,
    lens: str | None,
    refine: Refine | None,
    frames: Sequence[Frame],
    features: Sequence[Features],
) -> tuple[CameraModel, Freedom, list[str]]:
    """The lens to start from, what of it is solved along, and notes."""
    from chromeball.envmap.stitch.lens import Freedom, parse_lens
    from chromeball.envmap.stitch.links import likeliest

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
        own = light.corrected(frame, k, camera).radiance
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
