"""``chromeball render``: the views of a scene with its synthetic objects."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import read_scene


def render(
    scene_file: Path,
    *,
    view: str | None = None,
    spp: int | None = None,
    seconds: float | None = None,
    error: float | None = None,
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
    json_: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> None:
    """Render a view of the scene into an EXR with its layers, and a PNG beside it.

    Without --spp, --seconds or --error the scene file says how many samples; with more than
    one of them the first that is reached ends the work.

    Parameters
    ----------
    scene_file
        The scene.toml.
    view
        Name of the view; needed where the scene has several.
    spp
        Samples a pixel.
    seconds
        Stop after so many seconds.
    error
        Stop when the standard error of the changed pixels, relative to their mean, is below.
    output
        The EXR; by default VIEW.exr in the scene's build folder.
    json_
        Print the figures as JSON.

    """
    scene = read_scene(scene_file)
    names = [entry.name for entry in scene.view]
    if not names:
        raise UserError("the scene has no [[view]] to render", file=scene_file)
    if view is None and len(names) > 1:
        raise UserError(
            f"the scene has several views; choose one with --view: {', '.join(names)}",
            file=scene_file,
        )
    if view is not None and view not in names:
        raise UserError(
            f"there is no [[view]] named {view!r}; there are {', '.join(names)}",
            file=scene_file,
        )
    chosen = scene.view[0 if view is None else names.index(view)]

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from chromeball.renderer.render import Budget, render_view

    budget = Budget(spp, seconds, error)
    total = spp if spp is not None else scene.render.spp if budget == Budget() else None
    columns = (
        TextColumn("render {task.fields[name]}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} spp"),
        TimeElapsedColumn(),
    )
    with Progress(
        *columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()
    ) as bar:
        task = bar.add_task("render", total=total, name=chosen.name)
        figures = render_view(
            scene,
            scene_file,
            chosen,
            budget,
            output,
            lambda samples, _: bar.update(task, completed=samples),
        )
    if json_:
        json.dump(figures, sys.stdout)
        print()
        return
    spread = figures["relative_error"]
    noise = f"{spread:.2%}" if isinstance(spread, float) else "unknown"
    target = output or scene_file.parent / scene.folder / f"{chosen.name}.exr"
    print(
        f"{target}: {figures['spp']} spp in {figures['seconds']:.1f} s, "
        f"{figures['mrays_per_second']:.1f} Mrays/s, {figures['changed_pixels']} pixels "
        f"changed, noise {noise} of their mean; "
        f"{figures['png']} beside it"
    )
