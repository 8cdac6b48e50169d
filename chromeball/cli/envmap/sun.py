"""``chromeball envmap sun``: the sun of a map, and its light where it was clipped."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import Json, Out, parse_numbers, print_figures
from chromeball.cli.options import Numbers
from chromeball.scene.errors import UserError


def sun(
    env: Path,
    /,
    *,
    meter: float | None = None,
    ratio: str | None = None,
    ball: Path | None = None,
    circle: str | None = None,
    camera: Path | None = None,
    normal: Annotated[str, Parameter(allow_leading_hyphen=True)] = "up",
    at: Numbers = None,
    clipped: float | None = None,
    color: str | None = None,
    radius: float = 0.2666,
    accuracy: float = 0.05,
    output: Out,
    json: Json = False,
) -> None:
    """Restore the light of a sun that was too bright for every exposure.

    One of --meter, --ratio and --ball says how much light fell on a surface.

    Parameters
    ----------
    env
        A lat-long map.
    meter
        Lux on the surface, sun and sky together; the map is in cd/m^2.
    ratio
        How much brighter a card is in the light than in the sun's shadow; one number, or R,G,B.
    ball
        A linear photograph of a matt ball where the map was taken.
    circle
        The ball's outline in it, cx,cy,radius in pixels.
    camera
        The camera of that photograph, with its pose.
    normal
        Of the measured surface: up, sun (it faced the sun) or x,y,z.
    at
        The sun's direction x,y,z, where the map does not show it; it is taken as exact.
    clipped
        Values from here on are clipped, where the map has no channel that says so.
    color
        R,G,B of the sun's light, for --meter or one ratio; that of its glare unless given.
    radius
        Of the disc, degrees.
    accuracy
        Of the reading or the ratio, as a part of it.
    output
        The map with its sun, an EXR.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        read_marks,
        tone_mapped,
        write_map,
        write_preview,
    )
    from chromeball.envmap.sun import (
        find_sun,
        ratio_of_ball,
        restore_from_ratio,
        restore_from_reading,
    )
    from chromeball.scene.record import Stage, check_output

    if [meter, ratio, ball].count(None) != 2:
        raise UserError("give one of --meter, --ratio and --ball")
    if ball is not None and (circle is None or camera is None):
        raise UserError("--ball needs --circle and --camera")
    if ball is None and (circle or camera):
        raise UserError("--circle and --camera are for --ball")
    if color is not None and ball is not None:
        raise UserError("--color is for --meter and --ratio: a ball has its own colour")
    if not 0.01 <= radius <= 10 or not 0 < accuracy < 1:
        raise UserError("--radius is 0.01 to 10 degrees, --accuracy between 0 and 1")
    inputs = [env, *(path for path in (ball, camera) if path)]
    check_output(output, inputs, ".exr")
    image = read_latlong(env)
    level = float(image.attributes.get("whiteLuminance", 0) or 0)
    if meter is not None and level <= 0:
        raise UserError(
            "values are relative: lux need a map in cd/m^2 (`hdr merge --luminance` or "
            "--grey-card); or use --ratio",
            file=env,
        )
    marked = image.clipped
    if clipped is not None:
        marked = (image.rgb.max(axis=2) >= clipped) | (False if marked is None else marked)
    with Stage("envmap sun", inputs, meter=meter, ratio=ratio, normal=normal) as stage:
        found = find_sun(image.rgb, marked)
        if at is not None:
            from chromeball.envmap.sun import Sun

            towards = np.array(parse_numbers(at, "--at", 3))
            if not towards.any():
                raise UserError("--at 0,0,0: a direction is needed")
            towards /= np.linalg.norm(towards)
            off = (
                0.0 if found is None else math.acos(min(float(towards @ found.direction), 1.0))
            )
            if found is not None and off > math.radians(1) + found.angular_radius:
                print(
                    f"warning: the map's own sun stands {math.degrees(off):.1f} degrees from "
                    "--at and stays where it is: leave out --at, or turn the map",
                    file=sys.stderr,
                )
            colour = np.array(image.rgb.reshape(-1, 3).mean(axis=0), float)
            bound = marked is not None and bool(_about(marked, towards, radius).any())
            found = Sun(towards, math.nan, math.radians(radius), 0.0,
                        1e-9 * colour, colour, bound)  # fmt: skip
        if found is None:
            raise UserError(
                "no small bright light: say where the sun stands with --at x,y,z", file=env
            )
        n = {"up": np.array([0.0, 1, 0]), "sun": found.direction}.get(normal)
        if n is None:
            n = np.array(parse_numbers(normal, "--normal", 3))
            if not n.any():
                raise UserError("--normal 0,0,0: a direction is needed")
        try:
            tint = None if color is None else parse_numbers(color, "--color", 3)
            if meter is not None:
                made = restore_from_reading(
                    image.rgb, found, meter / level, n, accuracy=accuracy, color=tint,
                    radius=math.radians(radius),
                )  # fmt: skip
                source = f"a light meter's reading, {meter:g} lux"
            else:
                if ball is not None and circle is not None and camera is not None:
                    normals, seen = _ball(ball, circle, camera)
                    times, sigma = ratio_of_ball(image.rgb, found, normals, seen)
                    n, accuracy = found.direction, float(max(accuracy, (sigma / times).max()))
                    stage.figures |= {"ball_ratio": times, "ball_ratio_sigma": sigma}
                    source = "a matt ball's shading"
                else:
                    values = parse_numbers(ratio, "--ratio", None)
                    if len(values) not in (1, 3):
                        raise UserError("--ratio: one number, or three for R,G,B")
                    if color is not None and len(values) == 3:
                        raise UserError(
                            "--color is for one --ratio: three have their own colour"
                        )
                    times = np.array(values)
                    source = f"a card {ratio} times as bright in the sun as in its shadow"
                made = restore_from_ratio(
                    image.rgb, found, times, n, accuracy=accuracy, color=tint,
                    radius=math.radians(radius),
                )  # fmt: skip
        except UserError as error:
            raise error if error.file else UserError(error.what, file=env) from error
        stage.figures |= {
            "direction": found.direction,
            "sigma_direction_degrees": math.degrees(found.sigma_direction),
            "was_clipped": found.clipped,
            "irradiance_before": found.irradiance,
            "irradiance": made.sun.irradiance,
            "radiance": made.sun.radiance,
            "relative_sigma": made.sigma,
            "restored_from": source,
            "preview": write_preview(output, "preview", tone_mapped(made.radiance)),
        }
        attributes = latlong_attributes(image.attributes) | {
            "sunRestored": source,
            "sunDirection": found.direction,
            "sunIrradiance": made.sun.irradiance,
            "sunSigma": made.sigma,
        }
        marks = read_marks(env)
        if "clipped" in marks:  # no longer, where the sun is now known
            marks["clipped"][(made.radiance != image.rgb).any(axis=2)] = 0
        with stage.output(output) as temporary:
            write_map(temporary, made.radiance, marks, attributes)
    print_figures(stage.figures, json, output)


def _about(marked: Any, direction: Any, radius: float) -> Any:
    """The marks (N,) of the pixels within `radius` degrees, or the nearest one."""
    import numpy as np

    from chromeball.envmap.mapping import LatLong

    near = LatLong(marked.shape[::-1]).directions() @ direction
    return marked[near >= min(math.cos(math.radians(radius)), float(np.max(near)))]


def _ball(ball: Path, circle: str, camera: Path) -> tuple[Any, Any]:
    """Normals (N, 3) in the world and radiance (N, 3) of a ball's picture, its rim left out."""
    import numpy as np

    from chromeball.calibrate.formats import read_camera
    from chromeball.envmap.mapping import pixel_grid
    from chromeball.envmap.picture import read_radiance

    cx, cy, r = parse_numbers(circle, "--circle", 3)
    picture, model = read_radiance(ball), read_camera(camera)
    if model.size != picture.size:
        raise UserError(f"the camera's pictures are {model.size[0]}x{model.size[1]}", file=ball)
    rim = model.unproject(np.array([[cx + r, cy], [cx - r, cy], [cx, cy + r], [cx, cy - r]]))
    if not np.isfinite(rim).all():
        raise UserError("--circle lies outside the picture", file=ball)
    middle = rim.mean(axis=0)
    middle /= np.linalg.norm(middle)
    cosine = float((rim @ middle).mean())
    sine2 = 1 - cosine**2
    d = model.unproject(pixel_grid(picture.size)).reshape(-1, 3)
    along = np.nan_to_num(d @ middle)
    # at distance 1 the ball's radius is the sine of its angular radius; 0.9: not its rim
    inside = 1 - along**2 < 0.81 * sine2
    inside &= along > 0
    if inside.sum() < 10:
        raise UserError("--circle holds fewer than 10 pixels", file=ball)
    d, along = d[inside], along[inside]
    distance = along - np.sqrt(sine2 - (1 - along**2))
    normals = (d * distance[:, None] - middle) / np.sqrt(sine2)
    world = normals @ model.world_from_camera.rotation.T
    return world, picture.rgb.reshape(-1, 3)[inside].astype(float)
