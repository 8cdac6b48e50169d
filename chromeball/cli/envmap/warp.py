"""``chromeball envmap warp``: one map to another."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import (
    Json,
    Kind,
    Out,
    parse_numbers,
    print_figures,
    source_fisheye,
)
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.mapping import Mapping


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

    angles = parse_numbers(rotate, "--rotate", 3) if rotate is not None else [0.0, 0.0, 0.0]
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
        source = source_fisheye(lens, camera, size, picture)
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
    print_figures(stage.figures, json, output)


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
