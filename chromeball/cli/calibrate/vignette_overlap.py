"""``chromeball calibrate vignette overlap``: a fall-off from frames that overlap."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output, check_output

if TYPE_CHECKING:
    from chromeball.scene.vignette import Vignette


def overlap(
    frames: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    camera: Path | None = None,
    lens: str | None = None,
    response: Path | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """Measure it on frames of several directions that overlap, as `envmap stitch` does.

    Parameters
    ----------
    frames
        Radiance pictures, or photographs of one exposure each, of one camera and zoom, that
        overlap widely.
    camera
        The calibrated camera.
    lens
        Its model instead, as `envmap stitch` takes it.
    response
        The camera's response.json, for photographs; otherwise it is found along.
    output
        The vignette.json to write.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.vignette_plots import plot_vignette
    from chromeball.cli.envmap.stitch_map import lens_of, read_frames
    from chromeball.envmap.stitch.features import find
    from chromeball.envmap.stitch.orient import orient
    from chromeball.envmap.stitch.photometric import solve
    from chromeball.scene.vignette import check_once

    if len(frames) < 2:
        raise UserError("one frame overlaps with none: give several")
    if camera is not None and lens is not None:
        raise UserError("give --lens or --camera, not both")
    names = [path.stem for path in frames]
    others = [path for path in (camera, response) if path is not None]
    check_output(output, [*frames, *others], ".json")
    with Stage("calibrate vignette overlap", [*frames, *others], lens=lens) as stage:
        pictures = read_frames(frames, response)
        for picture, path in zip(pictures, frames, strict=True):
            check_once(picture.attributes, path)
        features = [find(frame.radiance, frame.valid) for frame in pictures]
        model, freedom, notes = lens_of(camera, lens, None, pictures, features)
        found = orient(features, model, freedom=freedom, prior=None, names=names, progress=say)
        light = solve(pictures, found.camera, found.rotations)
        if not light.falloff_told:
            raise UserError(
                "the overlaps show no fall-off beyond its error: let frames overlap more, "
                "corners over middles, and merge brackets or give --response"
            )
        for note in [*notes, *found.notes]:
            say(f"note: {note}")
        vignette = light.vignette(found.camera)
        plot = output.with_name(f"{output.stem}.plot.png")
        stage.figures |= {
            **figures_of(vignette),
            "samples": light.samples,
            "scatter": light.scatter,
            "plot": plot.name,
        }
        with atomic_output(plot) as temporary:
            plot_vignette(vignette, temporary)
        with stage.output(output) as temporary:
            full = replace(vignette, record=dict(stage.figures))
            temporary.write_bytes(full.encode())
    told(stage, output, vignette, light.scatter, json)


def figures_of(found: Vignette) -> dict[str, Any]:
    """What is said of every measured fall-off."""
    import numpy as np

    from chromeball.scene.vignette import lattice

    V, sigma = found.at(lattice(found.size)), found.sigma
    sure = np.diag(found.covariance)
    return {
        "coefficients": found.coefficients,
        "coefficients_sigma": np.sqrt(np.maximum(sure, 0)),
        "centre": found.centre,
        "covered": found.covered,
        "beyond_covered_share": found.beyond(),
        "least": float(V.min()),
        "sigma_median": float(np.median(sigma)),
        "sigma_largest": float(sigma.max()),
    }


def told(
    stage: Stage,
    output: Path,
    found: Vignette,
    scatter: tuple[float, float],
    as_json: bool,
) -> None:
    """Print a measured fall-off; `scatter` of what measured it, before and after."""
    import numpy as np

    from chromeball.scene.vignette import lattice

    beyond = found.beyond()
    if beyond > 0.02:
        say(
            f"note: {beyond:.0%} of the picture lies farther out than what was measured: the "
            "polynomial goes on there, and its error says how far it is to be trusted"
        )
    if as_json:
        print_figures(stage.figures)
        return
    sure = np.sqrt(np.maximum(np.diag(found.covariance), 0))
    terms = ", ".join(
        f"{c:.4f} +- {s:.2g}" for c, s in zip(found.coefficients, sure, strict=True)
    )
    map_too = "" if found.map is None else ", and a smooth map"
    print(f"{output}: 1 + c1 r^2 + ..., {terms}{map_too}")
    x, y = found.centre
    least = float(found.at(lattice(found.size)).min())
    print(
        f"centre {x:.1f}, {y:.1f}; {least:.2f} of the light at the darkest place, error "
        f"{np.median(found.sigma):.2%} (median), {found.sigma.max():.2%} at most"
    )
    before, after = scatter
    print(
        f"scatter {before:.2%} before, {after:.2%} after; "
        f"measured to {found.covered:.0%} of the radius"
    )
