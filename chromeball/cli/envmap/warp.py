"""``chromeball envmap warp``: one map to another."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    parse_numbers,
    print_figures,
    read_mask,
)
from chromeball.cli.envmap.maps import Optics, files_of, read_map, source_map, target_map
from chromeball.cli.options import Numbers
from chromeball.envmap.names import Kind
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.picture import Radiance
    from chromeball.scene.record import Stage

#: A result finer than its source by more than this is told.
FINER = 1.1


def warp(
    picture: Path,
    /,
    *,
    from_: Annotated[Kind, Parameter(name="--from")],
    to: Kind,
    width: int | None = None,
    camera: Path | None = None,
    lens: str | None = None,
    to_lens: str | None = None,
    vignetting: str | None = None,
    ball_distance: float | None = None,
    focal: float | None = None,
    rotate: Numbers = None,
    mask: Path | None = None,
    fast: Annotated[bool, Parameter(negative="")] = False,
    output: Out,
    json: Json = False,
) -> None:
    """One map to another, the energy of small bright lights kept.

    A cube is a cross, 4:3 (cube) or 3:4 (cube-vertical), a row (cube-strip) or column
    (cube-column) of px nx py ny pz nz, or six files of these names (cube-files, {} in their
    place: "pisa_{}.hdr"). A mirror ball is a photograph of one, cropped to it; its middle, that
    shows the camera, is ahead (+Z). Where the source does not see, the result is black with
    alpha 0. Channels sigma.R, sigma.G, sigma.B and clipped are carried along.

    Parameters
    ----------
    picture
        A scene-linear map; pixels of alpha 0 are left out.
    from_
        What the picture is.
    to
        What to make of it.
    width
        Of the result, in pixels, of a face with cube-files; by default what the picture
        resolves.
    camera
        The fisheye, as a camera model; its pose is not used.
    lens
        The fisheye, as MODEL:FOV[:cx,cy,radius], degrees and pixels.
    to_lens
        The fisheye that is made, where both maps are fisheyes.
    vignetting
        Fall-off of the fisheye that is read, divided out: a vignette.json of `calibrate
        vignette`, c1,c2,... of 1 + c1 r^2 + c2 r^4 + ..., r = 1 at the rim of its circle, or
        HDRICalibrationTool's .cal of such.
    ball_distance
        From the camera to the mirror ball's centre, in ball radii; without it the ball is far.
    focal
        The focal length in pixels of the camera that photographed the ball, instead.
    rotate
        YAW,PITCH,ROLL in degrees by which the world is turned: what lay ahead moves to the
        left by yaw (right-handed about +Y), up by pitch; roll is clockwise.
    mask
        A picture of the same size, six side by side with cube-files: what is not brighter than
        half is left out.
    fast
        One linear sample a pixel: the energy is kept, edges are softer.
    output
        The map, an EXR.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.picture import (
        Preview,
        latlong_attributes,
        map_from_world,
        write_preview,
    )
    from chromeball.envmap.probe import rotation, vignetting_gain
    from chromeball.envmap.resample import Warping, marking
    from chromeball.scene.record import Stage, check_output
    from chromeball.scene.vignette import REMOVED, check_once
    from chromeball.scene.vignette_option import file_of, read_given

    angles = parse_numbers(rotate, "--rotate", 3) if rotate is not None else [0.0, 0.0, 0.0]
    if width is not None and not 1 <= width <= 65536:
        raise UserError(f"--width {width}: it must be from 1 to 65536")
    optics = Optics(lens, to_lens, camera, ball_distance, focal)
    optics.check(from_, to)
    if vignetting is not None and from_ != "fisheye":
        raise UserError("--vignetting is of a fisheye that is read: --from fisheye")
    falloff = None if vignetting is None else read_given(vignetting)
    inputs = [*files_of(picture, from_), *(path for path in (camera, mask) if path)]
    inputs += file_of(vignetting)
    outputs = files_of(output, to)
    for path in outputs:
        check_output(path, inputs, ".exr")
    image = read_map(picture, from_)
    if mask is not None:
        allowed = read_mask(mask, image.size, picture)
        image = replace(image, valid=allowed if image.valid is None else image.valid & allowed)
    kept = dict(image.attributes)
    if from_ in ("fisheye", "mirror"):
        kept.pop("worldToCamera", None)  # of a camera's axes, not a map's
    if from_ == to == "mirror":
        optics_in = Optics(ball_distance=ball_distance, focal=focal)
        source = source_map(from_, image.size, optics_in, picture)
        target = target_map(to, width, Optics(), source)  # of a ball nearby the ideal one
    else:
        source = source_map(from_, image.size, optics, picture)
        target = target_map(to, width, optics, source)
    if falloff is not None:
        check_once(kept, picture)
        kept[REMOVED] = str(vignetting)
        gain = vignetting_gain(source, falloff).astype(np.float32)[..., None]
        image = replace(
            image,
            rgb=image.rgb * gain,
            sigma=None if image.sigma is None else image.sigma * gain,
        )
    turn = rotation(*(math.radians(a) for a in angles))
    with Stage("envmap warp", inputs, to=to, fast=fast, vignetting=vignetting) as stage:
        job = Warping(
            image.rgb,
            source,
            target,
            rotation=turn,
            valid=image.valid,
            sigma=image.sigma,
            quality="fast" if fast else "best",
        )
        marks = None
        if image.clipped is not None:
            marks = marking(image.clipped, source, target, rotation=turn, valid=image.valid)
        turned = None
        if any(angles):
            turned = turn @ map_from_world(kept)
            kept.pop("origin", None)
        attributes = latlong_attributes(kept, rotation=turned) if to == "latlong" else kept
        preview = Preview(target.size)
        with _files(stage, outputs, target.size, image, attributes) as append:
            for band in job.bands():
                planes = [band.radiance, band.coverage[..., None]]
                if band.sigma is not None:
                    planes.append(band.sigma)
                if marks is not None:
                    planes.append(marks.rows(band.first, band.last)[..., None])
                append(np.concatenate(planes, axis=2))
                preview.add(band.radiance, band.coverage)
        first = outputs[0] if len(outputs) > 1 else output
        stage.figures |= {
            "size": target.size,
            "energy": job.energy,
            "source_energy": job.source_energy,
            "balance": job.balance,
            "hot_pixels": job.hot_pixels,
            "hot_energy_outside": job.outside,
            "seen_solid_angle": job.seen,
            "finer_than_source": target.density / source.density,
            "preview": write_preview(first, "preview", preview.picture()),
        }
        if marks is not None:
            stage.figures["clipped_solid_angle"] = marks.solid_angle
    if target.density > FINER * source.density:
        print(
            f"the result is {target.density / source.density:.1f} times as fine as the picture "
            "resolves: it holds no more detail",
            file=sys.stderr,
        )
    print_figures(stage.figures, json, output)


@contextmanager
def _files(
    stage: Stage,
    outputs: list[Path],
    size: tuple[int, int],
    image: Radiance,
    attributes: dict[str, Any],
) -> Generator[Callable[[Any], None]]:
    """One file, or a face each, that take rows from the top: all whole, or none."""
    import numpy as np

    from chromeball.scene.image import exr_rows

    channels = ["R", "G", "B", "A"]
    channels += ["sigma.R", "sigma.G", "sigma.B"] if image.sigma is not None else []
    channels += ["clipped"] if image.clipped is not None else []
    size = (size[0] // len(outputs), size[1])
    with ExitStack() as stack:
        temporaries = [stack.enter_context(stage.output(path)) for path in outputs]
        with ExitStack() as files:
            appends = [
                files.enter_context(
                    exr_rows(path, size, channels=channels, attributes=attributes)
                )
                for path in temporaries
            ]

            def append(rows: Any) -> None:
                parts = np.split(rows, len(outputs), axis=1)
                for one, part in zip(appends, parts, strict=True):
                    one(part)

            yield append
