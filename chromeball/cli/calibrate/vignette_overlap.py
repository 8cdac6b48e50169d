"""``chromeball calibrate vignette overlap``: a fall-off from frames that overlap."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output, check_output


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
    from chromeball.cli.calibrate.vignette import figures_of
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
        if not light.applied or not light.falloff.any():
            raise UserError("the overlaps show no fall-off beyond its error")
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
    if json:
        print_figures(stage.figures)
        return
    f = stage.figures
    terms = ", ".join(
        f"{c:.4f} +- {s:.2g}"
        for c, s in zip(f["coefficients"], f["coefficients_sigma"], strict=True)
    )
    print(f"{output}: 1 + c1 r^2 + ..., {terms}")
    before, after = f["scatter"]
    print(f"overlaps differ by {before:.2%} before, {after:.2%} after")
