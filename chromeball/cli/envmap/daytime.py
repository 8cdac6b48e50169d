"""``chromeball envmap daytime``: a map for an hour between those of other maps."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import Json, Out, print_figures
from chromeball.scene.errors import UserError

#: How fast the sun turns about the pole, and what hours and directions may be wrong by.
DEGREES_AN_HOUR, SLACK = 15.0, 10.0


def daytime(
    maps: Annotated[list[str], Parameter(consume_multiple=True)],
    /,
    *,
    at: str,
    blend: Literal["log", "linear"] = "log",
    output: Out,
    json: Json = False,
) -> None:
    """The map of an hour between maps of other hours; its sun moves along its arc.

    Parameters
    ----------
    maps
        Lat-long maps with their hour: morning.exr@09:00 noon.exr@12:00 evening.exr@18:00.
    at
        The hour, as 14:30.
    blend
        log: brightness changes evenly in its logarithm; linear: in itself.
    output
        The map, an EXR.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.daytime import Template, at_hour, clock, left_out, parse_clock
    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        tone_mapped,
        write_preview,
    )
    from chromeball.scene.image import write_exr
    from chromeball.scene.record import Stage, check_output

    hour = parse_clock(at)
    named = [text.rpartition("@") for text in maps]
    for (name, _, _), text in zip(named, maps, strict=True):
        if not name:
            raise UserError(f"{text}: say its hour, as {text}@09:00")
    hours = [parse_clock(when) for _, _, when in named]
    paths = [Path(name) for name, _, _ in named]
    check_output(output, paths, ".exr")
    with Stage("envmap daytime", paths, at=at, blend=blend) as stage:
        images = [read_latlong(path) for path in paths]
        templates = [
            Template.of(h, image.rgb, image.clipped)
            for h, image in zip(hours, images, strict=True)
        ]
        made = at_hour(templates, hour, blend)
        stage.figures |= {
            "hour": clock(hour),
            "between": [clock(made.earlier), clock(made.later)],
            "share_of_the_later": made.share,
            "sun_direction": made.direction,
            "sun_irradiance": made.irradiance,
            "sun_turn_degrees": math.degrees(made.turn),
            "suns": [
                {"hour": clock(t.hour), "direction": None if t.sun is None else t.sun.direction,
                 "clipped": None if t.sun is None else t.sun.clipped}
                for t in templates
            ],
            "left_out_errors": {
                clock(h): error for h, error in left_out(templates, blend).items()
            },
            "preview": write_preview(output, "preview", tone_mapped(made.radiance)),
        }  # fmt: skip
        apart = made.later - made.earlier
        if abs(made.turn) > math.radians(DEGREES_AN_HOUR * apart + SLACK):
            warning = (
                f"the sun turns by {math.degrees(abs(made.turn)):.0f} degrees in {apart:.1f} "
                f"hours: it does at most {DEGREES_AN_HOUR:g} an hour; are these maps of one "
                "place and day, their hours right, their axes the same?"
            )
            print(f"warning: {warning}", file=sys.stderr)
            stage.figures["warnings"] = [warning]
        first = images[int(np.argmin(hours))]
        with stage.output(output) as temporary:
            write_exr(
                temporary, made.radiance, attributes=latlong_attributes(dict(first.attributes))
            )
    print_figures(stage.figures, json, output)
