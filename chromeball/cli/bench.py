"""``chromeball bench``: run time against error, stage by stage, ours beside the peers."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.bench.row import Row
from chromeball.scene.errors import UserError
from chromeball.scene.record import atomic_output, write_json, write_text

#: in the order of the pipeline; each is a module of `chromeball.bench`
STAGES = ("acquire", "hdr", "calibrate", "envmap", "stand_in", "renderer")
BENCH = Path(__file__).resolve().parents[1] / "bench"
RESULTS = Path("bench-results")


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

    Writes table.md, table.json and a plot for each stage.

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
    """Plot time against error of one stage, a panel a task, or nothing without a pair of them.

    Both axes are logarithmic, so that a row of zero or unknown error has no place in it.
    """
    mine = [row for row in rows if row.stage == stage and row.cpu_seconds > 0 and row.error > 0]
    tasks = list(dict.fromkeys(row.what for row in mine if math.isfinite(row.error)))
    if not tasks:
        return None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(3, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    figure = Figure(figsize=(4.4 * columns, 3.6 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    for i, task in enumerate(tasks):
        axes = figure.add_subplot(lines, columns, i + 1)
        here = [row for row in mine if row.what == task and math.isfinite(row.error)]
        for row in here:
            ours = row.tool.startswith("chromeball")
            axes.loglog(
                row.cpu_seconds,
                row.error,
                marker="o" if ours else "s",
                markersize=9 if ours else 7,
                color="#3f6f8f" if ours else "#b0aaa0",
                linestyle="none",
            )
            axes.annotate(
                row.tool,
                (row.cpu_seconds, row.error),
                xytext=(7, 5),
                textcoords="offset points",
                fontsize=8,
            )
        axes.set_title(task, fontsize=9, loc="left")
        axes.set_xlabel("CPU s")
        axes.set_ylabel(f"error, {here[0].unit}")
        axes.grid(which="major", color="#e3e0da", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(0.35)
    path = output / f"{stage}.png"
    with atomic_output(path) as temporary:
        figure.savefig(temporary, dpi=120)
    return path


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
