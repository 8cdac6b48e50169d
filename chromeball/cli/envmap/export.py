"""``chromeball envmap export``: a finished map as other programs expect it."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import Json, Out, print_figures
from chromeball.scene.errors import UserError

type Program = Literal["blender", "usd", "three", "unreal", "mitsuba"]


def export(
    env: Path,
    /,
    *,
    for_: Annotated[Program, Parameter(name="--for")],
    keep_pixels: Annotated[bool, Parameter(negative="")] = False,
    scale: float = 1.0,
    output: Out,
    json: Json = False,
) -> None:
    """A finished map turned as another program expects it, and a file that loads it there.

    Columns are moved, so that pixels keep their bits; only a width that is no multiple of four
    is resampled. What looks along our +Z looks along +Z as that program takes over our axes.

    Parameters
    ----------
    env
        A lat-long map in world axes.
    for_
        The program: writes a .py, .usda, .json, .json or .xml beside the map.
    keep_pixels
        Leave the pixels, and let the file beside it tell the program to turn the map.
    scale
        Multiplies the values; the file beside it undoes that. For programs that keep maps in
        16-bit floats, which end at 65504.
    output
        The map, .exr or .hdr.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.companion import Dome, companion
    from chromeball.envmap.orientation import HALF_MAX, convention_of, oriented
    from chromeball.envmap.picture import (
        latlong_attributes,
        map_from_world,
        read_latlong,
        tone_mapped,
        write_preview,
    )
    from chromeball.scene.color import REC709_CHROMATICITIES
    from chromeball.scene.image import write_exr, write_hdr
    from chromeball.scene.record import Stage, check_output, write_text

    convention = convention_of(for_)
    kind = output.suffix.lower()
    if kind not in convention.formats:
        raise UserError(
            f"{convention.title} reads {' and '.join(convention.formats)}; name the map so",
            file=output,
        )
    if not 0 < scale < math.inf:
        raise UserError(f"--scale {scale:g}: it must be positive")
    if keep_pixels and convention.yaw == 0:
        raise UserError(f"--keep-pixels: {convention.title} reads our maps as they are")
    check_output(output, [env])
    image = read_latlong(env)
    warnings: list[str] = []
    if not np.allclose(map_from_world(image.attributes), np.eye(3), atol=1e-4):
        warnings.append("the map is turned in its world (worldToCamera); taken as it lies")
    colors = image.attributes.get("chromaticities", REC709_CHROMATICITIES)
    if not np.allclose(colors, REC709_CHROMATICITIES, atol=1e-3):
        warnings.append("the map's colours are not Rec.709, and programs take them for that")
    with Stage("envmap export", [env], program=for_, keep_pixels=keep_pixels) as stage:
        found = oriented(image.rgb, convention) if not keep_pixels else None
        radiance = image.rgb if found is None else found.radiance
        if scale != 1:
            if float(radiance.max()) * scale > float(np.finfo(np.float32).max):
                raise UserError(f"--scale {scale:g}: the brightest pixel becomes infinite")
            radiance = radiance * np.float32(scale)
        top = float(radiance.max())
        over = int((radiance.max(axis=2) > HALF_MAX).sum()) if convention.half else 0
        if over:
            warnings.append(
                f"{over} pixels are above {HALF_MAX:g}, where the 16-bit floats of "
                f"{convention.title} end, the brightest {top:.3g}: "
                f"--scale {0.9 * scale * HALF_MAX / top:.2g} keeps them"
            )
        kept = dict(image.attributes)
        origin = kept.get("origin")
        white = kept.get("whiteLuminance")
        if white is not None:
            kept["whiteLuminance"] = float(white) / scale
        dome = Dome(
            output.name,
            turned=not keep_pixels,
            # values times whiteLuminance are cd/m^2
            intensity=1 / scale if white is None else float(white) / scale,
            absolute=white is not None,
            origin=None if origin is None else np.ravel(origin).tolist(),
        )
        suffix, text = companion(for_, dome)
        beside = output.with_suffix(suffix)
        stage.figures |= {
            "for": convention.title,
            "turned_degrees": 0.0 if keep_pixels else math.degrees(convention.yaw),
            "bits_kept": scale == 1 and kind == ".exr" and (found is None or found.exact),
            "energy_error": 0.0 if found is None else found.energy_error,
            "intensity": dome.intensity,
            "brightest": top,
            "beyond_16_bits": over,
            "companion": beside.name,
            "warnings": warnings,
            "preview": write_preview(output, "preview", tone_mapped(radiance)),
        }
        with stage.output(output) as temporary:
            if kind == ".hdr":
                write_hdr(temporary, radiance)
            else:
                turn = None if keep_pixels else convention.map_from_world
                attributes = latlong_attributes(kept, origin, turn)
                write_exr(temporary, radiance, attributes=attributes)
        with stage.output(beside) as temporary:
            write_text(temporary, text)
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print_figures(stage.figures, json, output)
