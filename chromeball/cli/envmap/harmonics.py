"""``chromeball envmap harmonics``: irradiance as spherical harmonics and as a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import Json, Out, print_figures
from chromeball.scene.errors import UserError


def harmonics(
    env: Path,
    /,
    *,
    order: int = 2,
    window: Annotated[bool, Parameter(negative="")] = False,
    map: Path | None = None,
    width: int = 64,
    output: Out,
    json: Json = False,
) -> None:
    """A map's light in spherical harmonics, and its diffuse irradiance.

    Parameters
    ----------
    env
        A lat-long map.
    order
        The highest order, 0 to 4.
    window
        Damp the higher orders until no irradiance is negative (Sloan 2008).
    map
        Write the exact irradiance over all normals, too: a lat-long EXR.
    width
        Of that map, in pixels.
    output
        The coefficients, harmonics.json.
    json
        Print the figures as JSON.

    """
    from chromeball.envmap.irradiance import harmonics as project
    from chromeball.envmap.irradiance import irradiance_map
    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        tone_mapped,
        write_preview,
    )
    from chromeball.scene.image import write_exr
    from chromeball.scene.record import Stage, write_json

    if not 2 <= width <= 4096 or width % 2:
        raise UserError(f"--width {width}: a lat-long map's width is even, from 2 to 4096")
    image = read_latlong(env)
    options = {"order": order, "window": window}
    with Stage("envmap harmonics", [env], **options) as stage:
        try:
            found = project(image.rgb, order, window=window)
        except UserError as error:
            raise UserError(error.what, file=env) from error
        stage.figures |= {
            "order": order,
            "window": found.window,
            "irradiance_error": found.error,
            "lowest_irradiance": found.lowest,
        }
        if map is not None:
            diffuse = irradiance_map(image.rgb, width)
            with stage.output(map) as temporary:
                write_exr(temporary, diffuse, attributes=latlong_attributes(image.attributes))
            stage.figures["preview"] = write_preview(map, "preview", tone_mapped(diffuse))
        value = {
            "convention": "real, orthonormal Y_lm in the order (0,0), (1,-1), (1,0), (1,1), "
            "(2,-2) ...; no Condon-Shortley phase: (1,-1), (1,0), (1,1) go with y, z, x; world "
            "axes, +Y up; E(n) = sum of irradiance x Y(n)",
            "order": order,
            "window": found.window,
            "radiance": found.radiance,
            "irradiance": found.irradiance,
            "error": found.error,
            "lowest": found.lowest,
        }
        with stage.output(output) as temporary:
            write_json(temporary, value)
    print_figures(stage.figures, json, output)
