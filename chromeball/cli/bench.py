"""``chromeball bench``: run time against error, stage by stage, ours beside the peers."""

from __future__ import annotations

import importlib
import itertools
import math
import sys
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from chromeball.bench.row import Row
from chromeball.scene.errors import UserError
from chromeball.scene.record import atomic_output, write_json, write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: in the order of the pipeline; each is a module of `chromeball.bench`
STAGES = ("acquire", "hdr", "calibrate", "envmap", "stand_in", "renderer")
BENCH = Path(__file__).resolve().parents[1] / "bench"
RESULTS = Path("bench-results")
#: Colours of our own points, and of the peers'.
BLUES = ("#1f4e79", "#4f8fbf", "#8fb8d8", "#2a7f86")
EARTHS = ("#8a5a2b", "#d09a3f", "#6b6b6b", "#b04a3a", "#7a4988", "#5f8f4f", "#b8b0a8")


@dataclass(frozen=True)
class Skip:
    """A stage that was not measured, and why."""

    stage: str
    reason: str


def bench(
    *names: str,
    json: Annotated[bool, Parameter(negative="")] = False,
    quick: Annotated[bool, Parameter(negative="")] = False,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = RESULTS,
) -> None:
    """Measure each stage's CPU time against its error, beside its peers, in one run.

    Writes table.md, table.json and a plot for each stage: errors, and curves of the cost.

    Parameters
    ----------
    names
        The stages to measure: acquire, hdr, calibrate, envmap, stand-in, renderer; all of
        them when none is named.
    json
        Print the rows as JSON.
    quick
        Smaller tasks: a look at whether it runs, not figures to quote.
    output
        The folder for table and plots.

    """
    rows, skips = collect(_chosen(names), quick)
    write_json(
        output / "table.json",
        {"quick": quick, "rows": list(map(asdict, rows)), "skipped": list(map(asdict, skips))},
    )
    write_text(output / "table.md", as_markdown(rows, skips, quick=quick))
    plots = [plot_stage(stage, rows, output) for stage in dict.fromkeys(r.stage for r in rows)]
    if json:
        print((output / "table.json").read_text(), end="")
    else:
        _print(rows)
    for skip in skips:
        print(f"{skip.stage}: skipped, {skip.reason}", file=sys.stderr)
    written = ["table.md", "table.json", *(plot.name for plot in plots if plot)]
    print(f"{output}: {', '.join(written)}", file=sys.stderr)


def collect(names: Sequence[str], quick: bool) -> tuple[list[Row], list[Skip]]:
    """The rows of every stage named, sorted by stage and task, and what was not measured.

    A stage without a bench module, or without its data, is skipped with the reason; any other
    failure of a bench module is raised.
    """
    rows: list[Row] = []
    skips: list[Skip] = []
    for name in names:
        if not (BENCH / f"{name}.py").is_file():
            skips.append(Skip(name, "it has no benchmark yet"))
            continue
        module = importlib.import_module(f"chromeball.bench.{name}")
        print(f"{name} ...", file=sys.stderr)
        try:
            found: list[Row] = list(module.rows(quick))
        except UserError as error:  # the data are not there
            skips.append(Skip(name, str(error)))
            continue
        if not found:
            skips.append(Skip(name, "its benchmark found nothing to measure"))
        rows += found
    order = {stage: i for i, stage in enumerate(dict.fromkeys(row.stage for row in rows))}
    return sorted(rows, key=lambda row: (order[row.stage], row.what)), skips


def as_markdown(rows: Sequence[Row], skips: Sequence[Skip], *, quick: bool) -> str:
    """The table as Markdown."""
    lines = [
        "| stage | task | tool | CPU s | error | unit | note |",
        "|---|---|---|--:|--:|---|---|",
    ]
    for row in rows:
        cells = [row.stage, row.what, row.tool, f"{row.cpu_seconds:.3g}", _error(row)]
        cells += [row.unit, row.note]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    lines += ["", *(f"{skip.stage}: skipped, {skip.reason}" for skip in skips)]
    if quick:
        lines += ["", "A quick run: smaller tasks than those of the figures to quote."]
    return "\n".join(lines).rstrip() + "\n"


def plot_stage(stage: str, rows: Sequence[Row], output: Path) -> Path | None:
    """Plot time against error of one stage, a panel a task, then its curves; or nothing.

    All axes are logarithmic, so that a row of zero or unknown error has no place in it; nor has
    a single one, with nothing beside it.
    """
    mine = [row for row in rows if row.stage == stage]
    pairs = [r for r in mine if r.cpu_seconds > 0 and r.error > 0 and math.isfinite(r.error)]
    counts = Counter(row.what for row in pairs)
    panels = [(what, False) for what, count in counts.items() if count > 1]
    panels += [(what, True) for what in dict.fromkeys(r.what for r in mine if r.point)]
    if not panels:
        return None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(3, len(panels))
    lines = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(5.6 * columns, 3.4 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    for i, (what, is_curve) in enumerate(panels):
        axes = figure.add_subplot(lines, columns, i + 1)
        if is_curve:
            _plot_curve(axes, [row for row in mine if row.what == what])
        else:
            _plot_errors(axes, [row for row in pairs if row.what == what])
        axes.set_title(textwrap.fill(what, 48), fontsize=9, loc="left")
        axes.tick_params(axis="x", which="minor", labelsize=6, labelrotation=45)
        axes.grid(which="major", color="#e3e0da", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    path = output / f"{stage}.png"
    with atomic_output(path) as temporary:
        figure.savefig(temporary, dpi=120)
    return path


def _plot_errors(axes: Axes, rows: Sequence[Row]) -> None:
    """Time against error: a line a tool, ours in blues, named beside the panel."""
    colours = {True: itertools.cycle(BLUES), False: itertools.cycle(EARTHS)}
    for tool in dict.fromkeys(row.tool for row in rows):
        points = sorted((row.cpu_seconds, row.error) for row in rows if row.tool == tool)
        ours = tool.startswith("chromeball")
        axes.loglog(
            *zip(*points, strict=True),
            marker="o" if ours else "s",
            markersize=9 if ours else 7,
            color=next(colours[ours]),
            label=textwrap.fill(tool, 24),
            linewidth=1,
            linestyle="--" if "+" in tool else "-",
        )
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    axes.set_xlabel("CPU s")
    axes.set_ylabel(f"error, {rows[0].unit}")
    axes.margins(0.35)


def _plot_curve(axes: Axes, rows: Sequence[Row]) -> None:
    """Time along a curve, a line a tool."""
    for tool in dict.fromkeys(row.tool for row in rows):
        points = [row.point for row in rows if row.tool == tool and row.point]
        axes.loglog(
            [p.at for p in points], [p.seconds for p in points], marker="o", color="#3f6f8f"
        )
        axes.set_xlabel(points[0].along)
        axes.set_ylabel(points[0].clock)
    axes.margins(0.15)


def _chosen(names: Sequence[str]) -> list[str]:
    chosen: list[str] = []
    for name in names:
        module = name.replace("-", "_")
        if module not in STAGES:
            known = ", ".join(stage.replace("_", "-") for stage in STAGES)
            raise UserError(f"there is no stage {name!r} to measure; known: {known}")
        if not (BENCH / f"{module}.py").is_file():
            raise UserError(f"{name} has no benchmark yet")
        chosen.append(module)
    return chosen or list(STAGES)


def _error(row: Row) -> str:
    return f"{row.error:.3g}" if math.isfinite(row.error) else "not measured"


def _print(rows: Sequence[Row]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("stage", "task", "tool", header_style="bold")
    table.add_column("CPU s", justify="right")
    table.add_column("error", justify="right")
    table.add_column("unit")
    table.add_column("note")
    before: tuple[str, str] | None = None
    for row in rows:
        if before is not None and (row.stage, row.what) != before:
            table.add_section()
        before = (row.stage, row.what)
        cells = (row.stage, row.what, row.tool, f"{row.cpu_seconds:.3g}", _error(row))
        table.add_row(*cells, row.unit, row.note)
    Console().print(table)
