"""``chromeball envmap prefilter``: GGX-prefiltered maps for real-time engines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import Json, print_figures
from chromeball.scene.errors import UserError


def prefilter(
    env: Path,
    /,
    *,
    size: int = 256,
    levels: int = 6,
    table: Path | None = None,
    output: Annotated[list[Path], Parameter(name=["--output", "-o"])],
    json: Json = False,
) -> None:
    """A map blurred by the GGX lobe, a mip level for each roughness (split sum).

    Level i of n has the perceptual roughness i / (n - 1).

    Parameters
    ----------
    env
        A lat-long map.
    size
        Pixels a side of the cube's faces at roughness 0; a lat-long map is twice as wide.
    levels
        How many levels; each is half as large as the one before.
    table
        Write A and B of F0 A + B, too: rows roughness, columns n.v; .exr or .ktx2.
    output
        A cube with mip levels, .ktx2, or a lat-long map with mip levels, .exr; may be given
        twice, for both.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.envmap.ktx import write_ktx2
    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        tone_mapped,
        write_preview,
    )
    from chromeball.envmap.prefilter import (
        brdf_table,
        prefilter_cube,
        prefilter_latlong,
        split_sum_error,
    )
    from chromeball.scene.image import write_exr, write_mipmapped_exr
    from chromeball.scene.record import Stage

    for path in (*output, *([table] if table else [])):
        if path.suffix not in (".exr", ".ktx2"):
            raise UserError("a prefiltered map is .ktx2 (cube) or .exr (lat-long)", file=path)
    if not 2 <= levels <= 12 or not 4 <= size <= 4096 or size % (1 << (levels - 1)):
        raise UserError(
            f"--size {size} --levels {levels}: at least 2 levels, and a size of 4 to 4096 that "
            "can be halved for each level after the first"
        )
    image = read_latlong(env)
    with Stage("envmap prefilter", [env], size=size, levels=levels) as stage:
        for path in output:
            if path.suffix == ".exr":
                try:
                    found = prefilter_latlong(image.rgb, 2 * size, levels)
                except UserError as error:
                    raise UserError(error.what, file=env) from error
                attributes = latlong_attributes(image.attributes)
                with stage.output(path) as temporary:
                    write_mipmapped_exr(temporary, found.levels, attributes=attributes)
                pictures = [tone_mapped(level, width=size) for level in found.levels]
                shown = np.zeros((size // 2 * len(pictures), size, 3), np.uint8)
                for i, picture in enumerate(pictures):
                    shown[i * size // 2 :][: picture.shape[0], : picture.shape[1]] = picture
                stage.figures["preview"] = write_preview(path, "preview", shown)
            else:
                try:
                    found = prefilter_cube(image.rgb, size, levels)
                except UserError as error:
                    raise UserError(error.what, file=env) from error
                with stage.output(path) as temporary:
                    stage.figures["format"] = write_ktx2(temporary, found.levels)
            stage.figures |= {
                "roughness": found.roughness,
                f"energy_error{path.suffix.replace('.', '_')}": [e - 1 for e in found.energy],
            }
        roughness = [i / (levels - 1) for i in range(1, levels)]
        stage.figures["split_sum_error"] = [
            {"roughness": e.roughness, "degrees": e.angle, "F0_0.04": e.error[0],
             "F0_1": e.error[1]}
            for e in split_sum_error(image.rgb, roughness)
        ]  # fmt: skip
        if table is not None:
            values = brdf_table()
            with stage.output(table) as temporary:
                if table.suffix == ".exr":
                    write_exr(temporary, values, channels=("R", "G"))
                else:
                    write_ktx2(temporary, [values])
    print_figures(stage.figures, json, output[0])
