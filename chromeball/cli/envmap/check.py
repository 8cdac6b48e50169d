"""``chromeball envmap check``: the map against a photographed ball or chart."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    parse_numbers,
    print_figures,
    read_camera,
)
from chromeball.cli.options import Numbers
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.check import Chart, Comparison, Patch


def check(
    env: Path,
    photograph: Path,
    /,
    *,
    ball: Literal["matt", "chrome"] | None = None,
    circle: str | None = None,
    camera: Path | None = None,
    reflectance: str | None = None,
    chart: Path | None = None,
    normal: Numbers = None,
    output: Out,
    json: Json = False,
) -> None:
    """A ball or a colour chart rendered from the map beside the photographed one.

    The photograph is radiance of the same session, or both are in cd/m^2; else the ratio tells
    the units, and the errors with the ratio taken out tell the rest.

    Parameters
    ----------
    env
        A lat-long map.
    photograph
        Radiance of a ball or chart where the map was taken.
    ball
        What the ball is made of.
    circle
        The ball's outline in the photograph, cx,cy,radius in pixels.
    camera
        The photograph's camera, with its pose in the world; without it the ball is far away and
        the camera looks along +Z.
    reflectance
        Of the ball, one number or R,G,B: 0.18 for a matt one, 1 for chrome unless given.
    chart
        A CSV with x,y,width,height,R,G,B for each patch: pixels, and reflectances.
    normal
        Where the chart faces, x,y,z.
    output
        The figures, a JSON; the picture beside it shows photograph, rendering, difference.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.ball import ball_in_circle
    from chromeball.envmap.check import (
        colour_chart,
        matt_ball,
        mirror_ball_check,
        side_by_side,
    )
    from chromeball.envmap.picture import read_latlong, read_radiance, write_preview
    from chromeball.scene.camera import WORLD_FROM_LATLONG
    from chromeball.scene.image import to_display
    from chromeball.scene.record import Stage, check_output, write_json

    if (ball is None) == (chart is None):
        raise UserError("give --ball with --circle, or --chart with --normal")
    if ball is not None and (circle is None or normal is not None):
        raise UserError("--ball needs --circle, and has no --normal")
    if chart is not None and (normal is None or circle or camera or reflectance):
        raise UserError("--chart needs --normal alone: the CSV has the rest")
    inputs = [env, photograph, *(path for path in (camera, chart) if path)]
    check_output(output, inputs)
    image, picture = read_latlong(env), read_radiance(photograph)
    used = np.ones(picture.rgb.shape[:2], bool) if picture.valid is None else picture.valid
    if picture.clipped is not None:
        used = used & ~picture.clipped
    with Stage("envmap check", inputs, ball=ball) as stage:
        if ball is not None:
            x, y, radius = parse_numbers(circle, "--circle", 3)
            model = read_camera(camera, picture.size, photograph) if camera else None
            try:
                lies = ball_in_circle(picture.size, (x, y), radius, model)
                pose = WORLD_FROM_LATLONG if model is None else model.world_from_camera
                lies, part = lies.cut_out()
                default = 0.18 if ball == "matt" else 1.0
                values = (
                    parse_numbers(reflectance, "--reflectance", None) if reflectance else []
                )
                if len(values) not in (0, 1, 3):
                    raise UserError("--reflectance: one number, or three for R,G,B")
                shiny = np.array(values or [default])
                seen = np.ascontiguousarray(picture.rgb[part])
                if ball == "matt":
                    found = matt_ball(
                        image.rgb, seen, lies, pose.rotation, albedo=shiny, used=used[part]
                    )
                else:
                    found = mirror_ball_check(
                        image.rgb, seen, lies, pose.rotation, reflectance=shiny, used=used[part]
                    )
            except UserError as error:
                raise UserError(error.what, file=error.file or photograph) from error
            stage.figures |= {
                "pixels": int(found.used.sum()),
                "light_off_degrees": math.degrees(found.light_off),
                "picture": write_preview(output, "beside", to_display(side_by_side(found))),
            }
            errors: Comparison | Chart = found
        else:
            assert chart is not None
            towards = np.array(parse_numbers(normal, "--normal", 3))
            try:
                flat = colour_chart(image.rgb, picture.rgb, _patches(chart), towards)
            except UserError as error:
                raise UserError(error.what, file=error.file or chart) from error
            stage.figures |= {"seen": flat.seen, "rendered": flat.rendered}
            errors = flat
        stage.figures |= {
            "ratio": errors.ratio,
            "median_error": errors.median,
            "error_95": errors.worst,
            "median_error_without_ratio": errors.median_shape,
            "error_95_without_ratio": errors.worst_shape,
        }
        with stage.output(output) as temporary:
            write_json(temporary, stage.figures)
    print_figures(stage.figures, json, output)


def _patches(path: Path) -> list[Patch]:
    """Patches of a CSV; a first line of names is left out."""
    import csv

    import numpy as np

    from chromeball.envmap.check import Patch

    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"not a readable CSV: {error}", file=path) from error
    patches: list[Patch] = []
    for number, row in enumerate(csv.reader(text.splitlines()), 1):
        if not row or (number == 1 and not row[0].strip().lstrip("-").isdigit()):
            continue
        try:
            x, y, width, height = (int(v) for v in row[:4])
            red, green, blue = (float(v) for v in row[4:])
        except ValueError as error:
            raise UserError(
                f"line {number}: it must be x,y,width,height,R,G,B", file=path
            ) from error
        patches.append(Patch((x, y, width, height), np.array([red, green, blue])))
    return patches
