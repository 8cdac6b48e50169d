"""``chromeball envmap stitch``: frames of several directions to one map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    parse_numbers,
)
from chromeball.cli.envmap.stitch_map import Bend, Expose, Refine, make_map
from chromeball.cli.options import Numbers
from chromeball.scene.errors import UserError
from chromeball.scene.vignette_option import file_of

if TYPE_CHECKING:
    from chromeball.envmap.stitch.links import Prior


def stitch(
    frames: list[Path],
    /,
    *,
    camera: Path | None = None,
    lens: str | None = None,
    refine: Refine | None = None,
    directions: Path | None = None,
    yaw: Numbers = None,
    pitch: Numbers = None,
    roll: Numbers = None,
    sigma: float | None = None,
    align: Path | None = None,
    clicked: int | None = None,
    response: Path | None = None,
    exposure: Expose = "auto",
    vignetting: str | None = None,
    bend: Bend = "auto",
    width: int | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """Frames of several directions to one lat-long map, in linear radiance throughout.

    Beside the map: its preview, the frames' borders and the seams, the panorama through the
    lens beside a frame, the refined lens (.cameramodel) and directions (.directions.json), and
    the fall-off that was found (.vignette.json).

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
        The camera's response.json, for photographs; otherwise it is found from where frames
        overlap, from sRGB on.
    exposure
        auto: exposures and vignetting are made equal where frames overlap; keep: they are
        right; white-balance: each channel by itself.
    vignetting
        Fall-off of the lens that is known, divided out and not solved: a vignette.json of
        `calibrate vignette`, c1,c2,... of 1 + c1 r^2 + c2 r^4 + ... with r = 1 at the rim of
        the circle or at the corner, or HDRICalibrationTool's .cal of such.
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
    from chromeball.envmap.stitch.lens import parse_lens

    if len(frames) == 1 and frames[0].suffix == ".toml":
        given = (camera, lens, refine, directions, yaw, pitch, roll, sigma, align, clicked)
        if any(option is not None for option in (*given, vignetting, response, width)):
            raise UserError("a scene file says everything: leave out the other options")
        _of_scene(frames[0], output, json)
        return
    count = len(frames)
    if camera is not None and lens is not None:
        raise UserError("give --lens or --camera, not both")
    if lens is not None:
        parse_lens(lens, (640, 480))  # what cannot be is said before the frames are read
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
    make_map(
        frames,
        camera=camera,
        lens=lens,
        refine=refine,
        prior=prior,
        inputs=[
            *(p for p in (camera, directions, align, response) if p is not None),
            *file_of(vignetting),
        ],
        align=align,
        clicked=clicked,
        response=response,
        exposure=exposure,
        vignetting=vignetting,
        bend=bend,
        width=width,
        output=output,
        as_json=json,
    )


def _of_scene(path: Path, output: Path, as_json: bool) -> None:
    """The command that `plan` writes, for the scene as it is."""
    from chromeball.cli.stages import lens_text, vignetting_text
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
        vignetting=vignetting_text(probe.vignetting, root),
        align=root / scene.folder / "align.json" if scene.align else None,
        width=scene.env.width,
        output=output,
        json=as_json,
    )
