"""Figures of records as people read them: rows with units, tables, pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chromeball.cli.report.records import Run, find_runs
from chromeball.cli.stages import REPORT, StagePlan, stages
from chromeball.scene.manifest import Scene, read_scene

PICTURES = (".png", ".jpg", ".jpeg")
#: last word of a figure's name -> the unit it stands for
UNITS = {
    "s": "s",
    "seconds": "s",
    "px": "px",
    "m": "m",
    "metres": "m",
    "mm": "mm",
    "deg": "°",
    "degrees": "°",
    "rad": "rad",
    "radians": "rad",
    "sr": "sr",
    "percent": "%",
    "bytes": "B",
    "db": "dB",
    "stops": "stops",
    "ms": "ms",
    "hz": "Hz",
}
#: first words of a figure's name -> the unit of what has only one here
QUANTITIES = {"solid_angle": "sr", "distance_": "m", "area_": "m\u00b2", "origin": "m"}
#: more numbers than these are no key figure
SHORT = 6


@dataclass(frozen=True)
class Row:
    """One figure: what it is, its value, its unit."""

    label: str
    value: str
    unit: str = ""


@dataclass(frozen=True)
class Table:
    """Figures that come as rows of one shape."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Figures:
    """A record's figures, sorted by how they are shown."""

    rows: tuple[Row, ...]
    tables: tuple[Table, ...]
    pictures: tuple[tuple[str, str], ...]  # label, name of the file


@dataclass(frozen=True)
class TruthError:
    """One figure against the truth and the bound it has to keep."""

    stage: str
    what: str
    value: float
    unit: str
    bound: float

    @property
    def kept(self) -> bool:
        """Whether the bound is kept; NaN keeps nothing."""
        return self.value <= self.bound


def sort_figures(figures: Mapping[str, Any]) -> Figures:
    """Split a record's figures into key figures, tables and pictures, in their order."""
    rows: list[Row] = []
    tables: list[Table] = []
    pictures: list[tuple[str, str]] = []
    for label, value in _flat(figures, ""):
        name = label.rpartition(" · ")[2]
        if isinstance(value, str) and value.lower().endswith(PICTURES):
            pictures.append((_spaced(label), value))
        elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
            tables.append(_table(_spaced(label), value))
        elif isinstance(value, list) and _is_pictures(value):
            pictures += [(_spaced(label), item) for item in value]
        elif isinstance(value, list) and len(value) > SHORT:
            tables.append(_long(_spaced(label), value))
        elif isinstance(value, dict):  # many keys of one kind, such as one a picture
            items = value.items()
            tables.append(
                Table(_spaced(label), ("", ""), tuple((k, show(v)) for k, v in items))
            )
        else:
            words = name.split("_")
            unit = UNITS.get(words[-1].lower(), "") if len(words) > 1 else ""
            if words[-1] == "pixels" and not isinstance(value, int):
                unit = "px"  # a count of pixels is an integer
                words[-1] = "px"
            text = label.removesuffix("_" + name.split("_")[-1]) if unit else label
            if not unit:
                unit = next((u for word, u in QUANTITIES.items() if name.startswith(word)), "")
            if unit == "B" and isinstance(value, int | float):
                value, unit = value / 2**20, "MB"
            if name == "size" and isinstance(value, list):
                value = " \u00d7 ".join(map(show, value))
            rows.append(Row(_spaced(text), show(value), unit))
    return Figures(tuple(rows), tuple(tables), tuple(pictures))


def show(value: Any) -> str:
    """A value as text: four digits, lists in one line, nothing invented for null."""
    match value:
        case None:
            return "\N{EN DASH}"
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,}".replace(",", "\u202f")
        case float():
            if value and not 1e-3 <= abs(value) < 1e5:
                mantissa, _, exponent = f"{value:.3e}".partition("e")
                return f"{float(mantissa):g}\u202f·\u202f10{_superscript(int(exponent))}"
            return f"{value:.4g}"
        case Mapping():
            return ", ".join(f"{key} {show(item)}" for key, item in value.items())
        case list():
            return ", ".join(show(item) for item in value) or "none"
        case _:
            return str(value)


def truth_errors(runs: Sequence[Run]) -> list[TruthError]:
    """The errors that the record of stage ``truth`` holds; a null value is NaN."""
    return [
        TruthError(
            str(error["stage"]),
            str(error["what"]),
            math.nan if error["value"] is None else float(error["value"]),
            str(error["unit"]),
            math.nan if error["bound"] is None else float(error["bound"]),
        )
        for run in runs
        if run.record.stage == "truth"
        for error in run.record.figures.get("errors", [])
    ]


def verdict_of(
    planned: Sequence[StagePlan], found: Mapping[str, Run], errors: Sequence[TruthError]
) -> tuple[bool, str]:
    """Whether all is well, and a sentence on it."""
    needed = [stage for stage in planned if stage.needed and stage.name != "report"]
    missing = [stage.name for stage in needed if stage.name not in found]
    broken = [error for error in errors if not error.kept]
    if missing:
        said = [f"{len(missing)} of {len(needed)} stages have no record"]
    else:
        said = [f"all {len(needed)} stages are recorded"]
    if broken:
        said.append(
            f"{len(broken)} of {len(errors)} errors against the truth miss their bounds"
        )
    elif errors:
        said.append(f"all {len(errors)} errors against the truth keep their bounds")
    return not (missing or broken), ", ".join(said)


def match(planned: Sequence[StagePlan], runs: Sequence[Run], root: Path) -> dict[str, Run]:
    """The run that made each stage's outputs, by the name of the stage."""
    by_file = {path.resolve(): run for run in runs for path in run.files}
    found: dict[str, Run] = {}
    for stage in planned:
        for output in stage.outputs:
            run = by_file.get((root / output).resolve())
            if run is not None and stage.name != "report":
                found.setdefault(stage.name, run)
    return found


def summary(scene_file: Path) -> str:
    """Where composite and report are, with their figures, for the end of a run."""
    scene: Scene = read_scene(scene_file)
    root = scene_file.parent
    planned = stages(scene, scene_file)
    runs = find_runs(scene, root)
    found = match(planned, runs, root)
    errors = truth_errors(runs)
    lines: list[str] = []
    for stage in planned:
        if stage.name.startswith("render ") and stage.name in found:
            rows = sort_figures(found[stage.name].record.figures).rows
            lines.append(f"composite  {root / stage.outputs[-1]}")
            lines += [f"  {row.label:40} {row.value} {row.unit}".rstrip() for row in rows]
    if errors:
        lines.append("errors against the truth")
        for error in errors:
            mark = "" if error.kept else "   missed"
            text = f"{error.stage}: {error.what}"
            bound = f"(bound {error.bound:g})"
            lines.append(f"  {text:48} {error.value:8.3g} {error.unit:4} {bound}{mark}")
    lines.append(f"report     {root / REPORT}: {verdict_of(planned, found, errors)[1]}")
    return "\n".join(lines)


def _flat(figures: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in figures.items():
        label = f"{prefix}{key}"
        if isinstance(value, Mapping) and len(value) <= 2 * SHORT:
            yield from _flat(value, f"{label} · ")
        else:
            yield label, value


def _is_pictures(value: list[Any]) -> bool:
    return bool(value) and all(
        isinstance(item, str) and item.lower().endswith(PICTURES) for item in value
    )


def _table(title: str, value: list[dict[str, Any]]) -> Table:
    header = tuple(dict.fromkeys(key for row in value for key in row))
    rows = tuple(tuple(show(row[k]) if k in row else "" for k in header) for row in value)
    return Table(title, tuple(map(_spaced, header)), rows)


def _long(title: str, value: list[Any]) -> Table:
    if all(isinstance(item, list) for item in value):
        width = max(len(item) for item in value)
        return Table(title, ("",) * width, tuple(tuple(map(show, item)) for item in value))
    rows = [value[i : i + 8] for i in range(0, len(value), 8)]
    return Table(title, ("",) * 8, tuple(tuple(map(show, row)) for row in rows))


def _spaced(label: str) -> str:
    return label.replace("_", " ")


def _superscript(value: int) -> str:
    return str(value).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
