"""``chromeball envmap units``: a map in cd/m^2."""

from __future__ import annotations

import sys
from pathlib import Path

from chromeball.cli.envmap.arguments import Json, Out, parse_numbers, print_figures
from chromeball.cli.options import Numbers
from chromeball.scene.errors import UserError


def units(
    env: Path,
    /,
    *,
    lux: str | None = None,
    normal: Numbers = None,
    luminance: str | None = None,
    at: Numbers = None,
    accuracy: float = 0.05,
    output: Out,
    json: Json = False,
) -> None:
    """A map brought to cd/m^2 by readings of a lux meter or a spot meter.

    Several readings give the mean of their factors; how far each is off is told.

    Parameters
    ----------
    env
        A lat-long map.
    lux
        Illuminances, "1200" or "1200,800".
    normal
        Where the lux meter faced, x,y,z for each reading, "0,1,0 1,0,0"; up unless given.
    luminance
        Luminances in cd/m^2, "250" or "250,90".
    at
        Their places in the map, x,y,width,height in pixels each, "512,100,8,8 40,80,8,8".
    accuracy
        Relative standard error of a reading.
    output
        The map in cd/m^2, an EXR; its attribute whiteLuminance is 1.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        tone_mapped,
        write_preview,
    )
    from chromeball.envmap.units import Lux, Reading, Spot, absolute_units
    from chromeball.scene.image import read_image, write_exr
    from chromeball.scene.record import Stage, check_output

    readings: list[Reading] = []
    values = parse_numbers(lux, "--lux", None) if lux is not None else []
    if normal is not None and not values:
        raise UserError("--normal is for --lux")
    faces = [parse_numbers(n, "--normal", 3) for n in (normal or "").split()]
    faces = faces or [[0.0, 1.0, 0.0]] * len(values)
    if len(faces) != len(values):
        raise UserError(f"--lux has {len(values)} readings, --normal {len(faces)} directions")
    readings += [Lux(v, np.array(n)) for v, n in zip(values, faces, strict=True)]
    values = parse_numbers(luminance, "--luminance", None) if luminance is not None else []
    places = [parse_numbers(p, "--at", 4) for p in (at or "").split()]
    if len(places) != len(values):
        raise UserError(f"--luminance has {len(values)} readings, --at {len(places)} places")
    for value, place in zip(values, places, strict=True):
        x, y, width, height = (round(v) for v in place)
        if [x, y, width, height] != place:
            raise UserError("--at: whole pixels x,y,width,height")
        readings.append(Spot(value, (x, y, width, height)))
    check_output(output, [env], ".exr")
    image = read_latlong(env)
    with Stage("envmap units", [env], accuracy=accuracy) as stage:
        try:
            found = absolute_units(
                image.rgb, readings, accuracy=accuracy, clipped=image.clipped, valid=image.valid
            )
        except UserError as error:
            raise UserError(error.what, file=env) from error
        for warning in found.warnings:
            print(f"warning: {warning}", file=sys.stderr)
        whole = read_image(env)  # every channel stays, whatever it is
        pixels = whole.pixels.astype(np.float32)
        measured = [
            k
            for k, name in enumerate(whole.channels)
            if name.removeprefix("sigma.") in ("R", "G", "B", "Y")
        ]
        if float(image.rgb.max()) * found.factor > float(np.finfo(np.float32).max):
            raise UserError("the brightest pixel becomes infinite in cd/m^2", file=env)
        pixels[..., measured] *= np.float32(found.factor)
        before = image.attributes.get("whiteLuminance")
        stage.figures |= {
            "factor": found.factor,
            "relative_sigma": found.sigma,
            "readings": [r.value for r in readings],
            "expected": found.expected,
            "deviations": found.deviations,
            "chi_square": found.chi_square,
            "factor_over_former_units": None if before is None else found.factor / before,
            "warnings": found.warnings,
            "preview": write_preview(output, "preview", tone_mapped(image.rgb)),
        }
        attributes = latlong_attributes(image.attributes) | {
            "whiteLuminance": 1.0,
            "luminanceSigma": found.sigma,
        }
        with stage.output(output) as temporary:
            write_exr(
                temporary,
                pixels,
                channels=whole.channels,
                attributes=attributes,
            )
    print_figures(stage.figures, json, output)
