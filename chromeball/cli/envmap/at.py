"""``chromeball envmap at``: the light at a point, from probes elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from chromeball.cli.envmap.arguments import (
    Json,
    Out,
    check_panorama_width,
    parse_numbers,
    print_figures,
)
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def at(
    point: Annotated[str, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    probes: Annotated[list[Path], Parameter(consume_multiple=True)],
    stand_in: Path,
    width: int | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """The map that a probe at a point would show, from probes at other places.

    The maps are laid on the stand-in and looked at from the point. What no probe saw of it is
    completed from what is near it and has alpha 0; channel `probe` is the number of the probe
    that counts most.

    Parameters
    ----------
    point
        X,Y,Z in metres.
    probes
        Lat-long maps with the attribute `origin`.
    stand_in
        The set's geometry, stand_in.ply.
    width
        Of the map; as wide as the first probe's unless given.
    output
        The map, an EXR.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.cli.envmap.geometry import caster, read_probe
    from chromeball.envmap.complete import Source
    from chromeball.envmap.picture import (
        latlong_attributes,
        read_latlong,
        tone_mapped,
        write_map,
        write_preview,
    )
    from chromeball.envmap.several import light_at
    from chromeball.scene.record import Stage, check_output
    from chromeball.stand_in.ply import read_stand_in

    place = np.array(parse_numbers(point, "the point", 3))
    if not probes:
        raise UserError("--probes: at least one map is needed")
    check_output(output, [*probes, stand_in], ".exr")
    maps = [read_probe(path) for path in probes]
    across = maps[0].radiance.shape[1] if width is None else width
    check_panorama_width(across)
    with Stage("envmap at", [*probes, stand_in], point=point) as stage:
        found = light_at(maps, place, caster(read_stand_in(stand_in)), across)
        stage.figures |= {
            "point": place,
            "metres_from_probes": [float(np.linalg.norm(p.origin - place)) for p in maps],
            "shares_of_probes": found.shares,
            "share_hidden_from_the_first": found.lone,
            "share_completed": found.unseen,
            "preview": write_preview(
                output, "preview", tone_mapped(found.radiance, found.seen)
            ),
            "probes_preview": write_preview(output, "probes", _coloured(found.probe)),
        }
        attributes = latlong_attributes(dict(read_latlong(probes[0]).attributes), place)
        marks = {
            "A": found.seen,
            "completed": np.where(found.seen == 0, Source.BORDER, Source.SEEN),
            "probe": found.probe + 1,
        }
        with stage.output(output) as temporary:
            write_map(temporary, found.radiance, marks, attributes)
    print_figures(stage.figures, json, output)


def _coloured(probe: NDArray[np.int16]) -> NDArray[np.uint8]:
    """A colour for each probe's part, black where none saw anything."""
    import numpy as np

    colours = np.array(
        [[0, 0, 0], [86, 180, 233], [230, 159, 0], [0, 158, 115], [204, 121, 167]]
        + [[240, 228, 66], [213, 94, 0]],
        np.uint8,
    )
    return colours[np.where(probe < 0, 0, probe % (len(colours) - 1) + 1)]
