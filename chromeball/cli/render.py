"""``chromeball render``: the views of a scene with its synthetic objects."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Scene, View, parse_frames, read_scene
from chromeball.scene.sequence import frames_of, missing_plates, moves

if TYPE_CHECKING:
    from chromeball.renderer.frames import Outcome, Task
    from chromeball.renderer.render import Progress


def render(
    scene_file: Path,
    *,
    view: str | None = None,
    frames: str | None = None,
    tile: str | None = None,
    join: Annotated[bool, Parameter(negative="")] = False,
    force: Annotated[bool, Parameter(negative="")] = False,
    scheduler: str | None = None,
    spp: int | None = None,
    seconds: float | None = None,
    error: float | None = None,
    integrator: Literal["path", "direct", "ao"] | None = None,
    denoise: Annotated[bool, Parameter(negative="")] = False,
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
    json_: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> None:
    """Render a view of the scene into an EXR with its layers, and a PNG beside it.

    Without --spp, --seconds or --error the scene file says how many samples; with more than
    one of them the first that is reached ends the work. Frames and tiles that are finished
    are kept, so that a sequence that was interrupted goes on.

    Parameters
    ----------
    scene_file
        The scene.toml.
    view
        Name of the view; needed where the scene has several.
    frames
        Frames of a sequence: 1-48, 1-48:2 or 7; by default those of the view.
    tile
        Make one tile of the picture: 1/4 is the first of four, 4 all of them. The last one
        joins them. Tiles have equally many samples in each pixel, the path integrator's.
    join
        Join tiles that were made elsewhere, with the same --spp.
    force
        Make finished frames and tiles again.
    scheduler
        Have the workers of a dask scheduler make them, tcp://host:8786; they see the scene's
        folder under the same path.
    spp
        Samples a pixel.
    seconds
        Stop after so many seconds.
    error
        Stop when the standard error of the changed pixels, relative to their mean, is below.
    integrator
        path: all light between objects and set, the reference. direct: many times faster, the
        set's light on the objects and their shadows. ao: direct under a white sky, for a plate
        without a light probe. By default what the scene file says, else path.
    denoise
        Smooth the objects and their shadows, not the plate, by Open Image Denoise (the extra
        denoise).
    output
        The EXR, by default VIEW.exr in the scene's build folder, VIEW.%04d.exr for frames.
    json_
        Print the figures as JSON.

    """
    scene = read_scene(scene_file)
    chosen = _view(scene, scene_file, view)
    numbers = _frames(scene, scene_file, chosen, frames)
    sequence = [number for number in numbers if number is not None]
    if sequence and output is not None and "%" not in output.name:
        raise UserError("a sequence has one file a frame; write %04d in its name", file=output)
    if join and scheduler:
        raise UserError("--join is done here: leave out --scheduler")
    if join and tile:
        raise UserError("--join takes the tiles that lie there: leave out --tile")
    if tile and (integrator or scene.render.integrator) != "path":
        raise UserError("tiles are for the path integrator: direct makes whole frames")

    from chromeball.renderer import frames as jobs
    from chromeball.renderer.render import Budget

    budget = Budget(spp, seconds, error)
    if scheduler is not None:  # workers stand elsewhere
        scene_file = scene_file.resolve()
        output = output and output.resolve()
    parts = [None] if tile is None else jobs.Tile.parse(tile)
    tasks = [
        jobs.Task(
            str(scene_file),
            chosen.name,
            budget,
            number,
            part,
            None if output is None else str(output),
            integrator,
            denoise,
        )
        for number in numbers
        for part in parts
    ]
    if not join:
        missing_plates(chosen, sequence, scene_file.parent)
    total = spp if spp is not None else scene.render.spp if budget == Budget() else None
    if scheduler is not None:
        outcomes = _elsewhere(tasks, scheduler, force)
    else:
        outcomes = map(jobs.join, tasks) if join else _locally(tasks, force, total)
    order = {task: k for k, task in enumerate(tasks)}
    _report(sorted(outcomes, key=lambda outcome: order[outcome.task]), as_json=json_)


def _view(scene: Scene, scene_file: Path, name: str | None) -> View:
    names = [entry.name for entry in scene.view]
    if not names:
        raise UserError("the scene has no [[view]] to render", file=scene_file)
    if name is None and len(names) > 1:
        raise UserError(
            f"the scene has several views; choose one with --view: {', '.join(names)}",
            file=scene_file,
        )
    if name is not None and name not in names:
        raise UserError(
            f"there is no [[view]] named {name!r}; there are {', '.join(names)}",
            file=scene_file,
        )
    return scene.view[0 if name is None else names.index(name)]


def _frames(scene: Scene, scene_file: Path, view: View, given: str | None) -> list[int | None]:
    """Frames to make; None alone for a still."""
    if given is not None:
        return [*parse_frames(given)]
    numbers = frames_of(view)
    if not numbers and moves(scene, view):
        raise UserError(
            f"view {view.name!r} is a sequence: say --frames 1-48, or give it frames",
            file=scene_file,
        )
    return [*numbers] or [None]


def _locally(tasks: Sequence[Task], force: bool, total: int | None) -> Iterator[Outcome]:
    """Make the tasks here, one after the other; one that fails does not keep others back."""
    from chromeball.renderer.frames import Outcome, make

    with _bar(total, len(tasks)) as (begin, progress):
        for task in tasks:
            begin(str(task))
            still = task.frame is None and task.tile is None
            try:
                yield make(task, force=force or still, progress=progress)
            except UserError as error:
                if len(tasks) == 1:
                    raise
                yield Outcome(task, "failed", error=str(error))


def _elsewhere(tasks: Sequence[Task], scheduler: str, force: bool) -> Iterator[Outcome]:
    """Have the workers of a scheduler make the tasks; how many are done is shown."""
    from rich.console import Console
    from rich.progress import track

    from chromeball.renderer.farm import farm_out

    outcomes = farm_out(tasks, scheduler, force=force)
    yield from track(
        outcomes,
        f"render at {scheduler}",
        len(tasks),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )


@contextmanager
def _bar(total: int | None, count: int) -> Generator[tuple[Callable[[str], None], Progress]]:
    """A progress bar on a terminal: what is made, its samples, its error, how many are done."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("render {task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} spp{task.fields[error]}{task.fields[done]}"),
        TimeElapsedColumn(),
    )
    with Progress(
        *columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()
    ) as bar:
        row = bar.add_task("", total=total, error="", done="")
        begun = itertools.count()

        def begin(name: str) -> None:
            done = f", {next(begun)} of {count} done" if count > 1 else ""
            bar.reset(row, total=total, description=name, error="", done=done)

        def progress(samples: int, error: float | None) -> None:
            noise = "" if error is None else f", error {error:.2%}"
            bar.update(row, completed=samples, error=noise)

        yield begin, progress


def _report(outcomes: Sequence[Outcome], *, as_json: bool) -> None:
    """Print what became of the tasks; raise where some failed."""
    single = len(outcomes) == 1 and outcomes[0].task.frame is None
    if as_json:
        rows = [_row(outcome) for outcome in outcomes]
        json.dump(outcomes[0].figures if single else rows, sys.stdout)
        print()
    else:
        for outcome in outcomes:
            print(_line(outcome))
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    if failed:
        raise UserError(
            f"{len(failed)} of {len(outcomes)} failed, first {failed[0].task}: "
            f"{failed[0].error}"
        )


def _row(outcome: Outcome) -> dict[str, object]:
    tile = outcome.task.tile
    return {
        "frame": outcome.task.frame,
        "tile": None if tile is None else str(tile),
        "state": outcome.state,
        "output": outcome.output,
        "error": outcome.error or None,
        "figures": outcome.figures,
    }


def _line(outcome: Outcome) -> str:
    figures = outcome.figures
    match outcome.state:
        case "failed":
            return f"{outcome.task}: failed: {outcome.error}"
        case "kept":
            return f"{outcome.output}: finished before, kept"
        case "rendered" if "changed_pixels" not in figures:  # a tile
            return f"{outcome.output}: {figures['spp']} spp in {figures['seconds']:.1f} s"
        case "rendered":
            spread, speed = figures["relative_error"], figures["mrays_per_second"]
            noise = f", noise {spread:.2%} of their mean" if isinstance(spread, float) else ""
            rays = f", {speed:.1f} Mrays/s" if isinstance(speed, float) else ""
            made = f"{outcome.output}: {figures['spp']} spp in {figures['seconds']:.1f} s{rays}"
            changed = figures["changed_pixels"]
            if not changed:
                return f"{made}, no pixel changed: no object is seen, none touches the light"
            return f"{made}, {changed} pixels changed{noise}; {figures['png']} beside it"
