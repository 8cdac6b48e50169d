"""The page: sections in the pipeline's order, filled from records, rendered by jinja2."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from chromeball.cli.report.figures import (
    Figures,
    TruthError,
    match,
    show,
    sort_figures,
    truth_errors,
    verdict_of,
)
from chromeball.cli.report.picture import data_uri
from chromeball.cli.report.records import Run, find_runs
from chromeball.cli.stages import StagePlan, stages
from chromeball.scene.manifest import read_scene
from chromeball.scene.record import Stage

#: first words of a stage's name -> what it does
DEEDS = {
    "take": "Frames of known exposure time, from a device or from photographs.",
    "hdr align": "How the frames of a hand-held bracket lie to each other.",
    "hdr response": "The camera's response curve, solved from the same light at several "
    "exposures: joint histograms of neighbouring exposures and a prior over real curves, or "
    "Debevec and Malik (1997).",
    "hdr merge": "The frames of a bracket merged to scene-linear radiance.",
    "calibrate lens": "Intrinsics and distortion of the lens, from photographs of a target.",
    "envmap align": "World axes and scale from what was clicked: a rectangle, verticals, the "
    "horizon, the sun.",
    "envmap probe": "The shots of the light probe resampled to one lat-long map in world axes.",
    "envmap stitch": "Frames of several directions as one map: where each looked is found from "
    "what they have in common, exposures are made equal, moving things come from one frame.",
    "envmap sun": "The light of a sun that every exposure clipped, restored.",
    "envmap lights": "The map as a few directional lights of the same total irradiance, and "
    "the harmonics of what they leave out.",
    "envmap harmonics": "Irradiance in spherical harmonics, with its error.",
    "envmap units": "The map in cd/m^2, by light-meter readings.",
    "envmap check": "A ball or chart rendered from the map beside the photographed one.",
    "envmap update": "The map brought up to date by later frames: predicted, seen, ratio.",
    "envmap daytime": "The map of an hour between those of other maps, its sun on its arc.",
    "envmap at": "The light at a point, from probes elsewhere by way of the stand-in.",
    "envmap export": "The map turned as another program expects it.",
    "envmap prefilter": "The map blurred by the GGX lobe, for real-time engines.",
    "calibrate pose": "Where the photograph was taken from, by four points on the floor.",
    "calibrate match": "Focal length and pose of the camera that took one picture.",
    "calibrate exif": "A camera by a picture's metadata alone.",
    "calibrate realign": "The virtual scene turned onto the photograph by pairs of points.",
    "calibrate track": "Where the camera was in each picture, by the tracker.",
    "calibrate tracker": "Where the camera sits on a tracker's sensor, and its delay.",
    "stand-in build": "Stand-in geometry of the real place, as drawn on the panorama.",
    "stand-in depth": "How far away the light of each direction comes from.",
    "render": "The synthetic objects, lit by the map, in the photograph or the panorama.",
}


@dataclass(frozen=True)
class Shown:
    """A picture in the page; ``uri`` is None when the file is not there or no picture."""

    label: str
    name: str
    uri: str | None


@dataclass(frozen=True)
class Section:
    """One stage of the page."""

    name: str
    deed: str
    reason: str
    run: Run | None
    figures: Figures
    pictures: tuple[Shown, ...]
    command: str
    anchor: str
    note: str = ""
    verdict: str = ""
    good: bool = True
    advice: tuple[str, ...] = ()


def write_report(scene_file: Path, output: Path) -> str:
    """Write the report of a scene to `output`; returns the verdict in a sentence.

    Where the scene names a truth and all its stages have run, what they made is compared
    with it first.

    Raises
    ------
    UserError
        For a scene or a record that cannot be read, or a truth that cannot be compared with.

    """
    scene = read_scene(scene_file)
    root = scene_file.parent
    planned = stages(scene, scene_file)
    made = [o for stage in planned if stage.name != "report" for o in stage.outputs]
    unmade = [name for name in made if not (root / name).exists()]
    truth_note = ""
    if scene.truth:
        if unmade:
            truth_note = f"Not compared with the truth: {unmade[0]} is not there."
        else:
            from chromeball.cli.report.truth import compare

            compare(scene, root)
    runs = find_runs(scene, root)
    found = match(planned, runs, root)
    errors = truth_errors(runs) if not truth_note else []
    good, verdict = verdict_of(planned, found, errors)
    sections = [
        _section(stage, found.get(stage.name), root)
        for stage in planned
        if stage.needed and stage.name != "report"
    ]
    # the composites stand at the top of the page, and there alone
    heroes: list[Shown] = []
    for i, section in enumerate(sections):
        if section.name.startswith("render "):
            heroes += section.pictures[:1]
            sections[i] = replace(section, pictures=section.pictures[1:])
    truth = next((run for run in runs if run.record.stage == "truth"), None)
    rest = [
        run
        for run in runs
        if run.record.stage not in ("truth", "report")
        and not any(run is other for other in found.values())
    ]
    records = [path for run in runs for path in run.records]
    with Stage("report", inputs=[scene_file, *records]) as stage:
        text = render_page(
            title=scene.name,
            good=good,
            verdict=verdict,
            sections=sections,
            bars=_bars(sections),
            total=math.fsum(s.run.record.seconds for s in sections if s.run),
            cpu=math.fsum(s.run.record.cpu_seconds for s in sections if s.run),
            heroes=heroes,
            skipped=[stage for stage in planned if not stage.needed],
            errors=errors,
            truth_note=truth_note,
            truth_pictures=_pictures(truth, sort_figures(truth.record.figures), root)
            if truth and not truth_note
            else (),
            rest=[_section_of_run(run, root) for run in rest],
            finished=max((run.record.finished for run in runs), default=""),
        )
        stage.figures |= {
            "verdict": verdict,
            "stages_recorded": len(found),
            "errors_kept": sum(error.kept for error in errors),
            "errors_missed": sum(not error.kept for error in errors),
        }
        with stage.output(output) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return verdict


def render_page(**values: Any) -> str:
    """The HTML text; every value is escaped."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    functions: dict[str, Any] = {
        "show": show,
        "seconds": seconds,
        "megabytes": megabytes,
        "bar": bar,
    }
    return environment.get_template("page.html.j2", globals=functions).render(**values)


def seconds(value: float) -> str:
    """``40 ms``, ``12.3 s``, ``2 min 05 s``."""
    if value < 0.0995:
        return f"{1000 * value:.0f} ms"
    if value >= 99.95:
        minutes, rest = divmod(round(value), 60)
        return f"{minutes} min {rest:02} s"
    return f"{value:.1f} s" if value >= 9.95 else f"{value:.2f} s"


def megabytes(value: int) -> str:
    """``812 MB``."""
    return f"{value / 2**20:,.0f} MB".replace(",", "\u202f")


def bar(error: TruthError) -> float:
    """Length of an error's bar, percent of a track whose end is one and a half bounds."""
    if not error.bound > 0 or not error.value >= 0:
        return 100.0
    return min(100.0, 100 * error.value / (1.5 * error.bound))


def _section(stage: StagePlan, run: Run | None, root: Path) -> Section:
    section = _section_of_run(run, root) if run else _empty(stage.name)
    deed = next((deed for name, deed in DEEDS.items() if stage.name.startswith(name)), "")
    gone = [name for name in stage.outputs if run and not (root / name).exists()]
    return Section(
        name=stage.name,
        deed=deed,
        reason=stage.reason,
        run=run,
        figures=section.figures,
        pictures=section.pictures,
        command=section.command,
        anchor=stage.name.replace(" ", "-"),
        note=f"{gone[0]} is recorded but not there any more" if gone else "",
        verdict=section.verdict,
        good=section.good,
        advice=section.advice,
    )


def _empty(name: str) -> Section:
    return Section(name, "", "", None, Figures((), (), ()), (), "", name.replace(" ", "-"))


def _section_of_run(run: Run, root: Path) -> Section:
    told = dict(run.record.figures)
    # A calibration's verdict and advice stand above its figures.
    verdict, good, advice = "", True, list[str]()
    if run.record.stage.startswith("calibrate") and isinstance(told.get("verdict"), str):
        verdict = str(told.pop("verdict"))
        good = bool(told.pop("good", True))
        advice = [str(line) for line in told.pop("advice", None) or []]
    figures = sort_figures(told)
    return Section(
        name=run.record.stage,
        deed="",
        reason=", ".join(run.record.outputs),
        run=run,
        figures=figures,
        pictures=_pictures(run, figures, root),
        command=shlex.join(run.record.command),
        anchor="",
        verdict=verdict,
        good=good,
        advice=tuple(advice),
    )


def _pictures(run: Run | None, figures: Figures, root: Path) -> tuple[Shown, ...]:
    if run is None:
        return ()
    named = [(label, run.folder / name, name) for label, name in figures.pictures]
    made = [
        ("picture", path, path.name)
        for path in run.files
        if path.suffix.lower() in (".png", ".jpg", ".jpeg")
    ]
    shown: dict[Path, Shown] = {}
    for label, path, name in [*made, *named]:
        place = path.resolve()
        # a record names pictures of the scene, not other files of the machine
        inside = place.is_relative_to(root.resolve())
        shown.setdefault(place, Shown(label, name, data_uri(place) if inside else None))
    return tuple(shown.values())


def _bars(sections: Sequence[Section]) -> list[tuple[Section, float, float]]:
    """Each section with the lengths of its bars, percent: wall time, CPU time."""
    records = [section.run.record if section.run else None for section in sections]
    longest = max((max(r.seconds, r.cpu_seconds) for r in records if r), default=0.0) or 1.0
    return [
        (
            section,
            100 * record.seconds / longest if record else 0.0,
            100 * record.cpu_seconds / longest if record else 0.0,
        )
        for section, record in zip(sections, records, strict=True)
    ]
