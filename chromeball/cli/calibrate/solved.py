"""From detections to a lens, its verdict, its plots and its record."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chromeball.calibrate.choose import choose_model
from chromeball.calibrate.detect import grey
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.halves import Halves, compare_halves
from chromeball.calibrate.lens import FEWEST_VIEWS, calibrate_lens
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.lit import brightest, lit_places, spread_out
from chromeball.calibrate.look_again import SecondLook, look_again
from chromeball.calibrate.plots import (
    plot_coverage,
    plot_halves,
    plot_residuals,
    plot_tilt,
    plot_uncertainty,
    plot_verdict,
    plot_worst,
)
from chromeball.calibrate.reuse import taken_with
from chromeball.calibrate.solve import Fit, fit_start
from chromeball.calibrate.target import Target
from chromeball.calibrate.verdict import Verdict, judge_lens
from chromeball.calibrate.views import repeated_views, spread_views
from chromeball.calibrate.watch import Progress
from chromeball.cli.calibrate.arguments import print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image
from chromeball.scene.record import Stage, atomic_output

#: The pupil's travel is told for rays so far from the axis, radians.
EDGE = math.radians(60)


def solve_and_tell(
    stage: Stage, detections: Sequence[Detection], board: Target, model: str, output: Path
) -> Callable[[bool], None]:
    """Solve, judge and plot; write `output`. Returns what prints it, as JSON or in words."""
    size = detections[0].size
    stage.figures["views"] = [
        {"file": d.file, "corners": d.count, "blur": d.blur, "verdict": d.verdict}
        for d in detections
    ]
    used, dropped = telling_views(detections)
    corners, files = np.array([d.corners for d in used]), [str(d.file) for d in used]
    chosen = model
    start = fit_start(corners, board, size) if len(used) >= FEWEST_VIEWS else None
    if model == "auto":
        choice = choose_model(
            corners, board, size, lambda m, e: say(f"{m}: held-out error {e:.3f} px"), start
        )
        chosen = choice.model
        stage.figures |= {"held_out_rms": choice.errors, "reason": choice.reason}
        say(f"{chosen}: {choice.reason}")
    lens = calibrate_lens(corners, board, size, chosen, files, start)
    second = look_again(used, lens, board, chosen, start)
    lens, used = second.lens, second.detections
    stage.figures["second_look"] = _told(second)
    halves, verdict = judged(lens, board, chosen, used, start, searched=model == "auto")
    # The verdict stands first in the record as on the screen.
    stage.figures = {
        "verdict": verdict.sentence,
        "good": verdict.good,
        "advice": list(verdict.advice),
        **stage.figures,
        **lens.figures(),
        "judged_by": verdict.figures,
        "views_used": verdict.figures["views"],
        "views_skipped": len(detections) - len(used),
        "skipped": [str(d.file) for d in detections if not d.usable],
        "do_not_fit": [
            file
            for file, pose in zip(files, lens.camera_from_board, strict=True)
            if not np.isfinite(pose).all()
        ],
        "repeated": [str(d.file) for d in dropped],
        "chosen_model": chosen,
        "taken_with": taken_with(files),
        "view_rms": dict(zip(files, lens.view_rms, strict=True)),
    }
    drawings: dict[str, Callable[[Path], None]] = {
        "verdict": lambda path: plot_verdict(lens, verdict, path),
        "uncertainty": lambda path: plot_uncertainty(lens, path),
        "residuals": lambda path: plot_residuals(lens, path),
        "coverage": lambda path: plot_coverage(lens, path),
        "tilt": lambda path: plot_tilt(lens, path),
        "worst": lambda path: plot_worst(lens, files, path),
    }
    if halves is not None:
        drawings["halves"] = lambda path: plot_halves(lens, halves, path)
    plots: dict[str, str] = {}
    for name, draw in drawings.items():
        path = output.with_name(f"{output.stem}.{name}.png")
        with atomic_output(path) as temporary:
            draw(temporary)
        plots[name] = path.name
    stage.figures["plots"] = plots
    with stage.output(output) as temporary:
        lens.write(temporary)
    fitting = verdict.figures["views"]
    title = f"{output}: {chosen}, {fitting} of {len(detections)} pictures"
    return lambda json: print_figures(stage.figures) if json else _print(title, lens, verdict)


def tell_progress(progress: Progress) -> None:
    """What one more picture brings, while pictures arrive."""
    say(f"{progress.detection.file}: {progress.detection.verdict}")
    if progress.verdict is None:
        say(f"  {progress.views} views: {progress.reason}")
        return
    say(f"  {progress.views} views: {progress.verdict.sentence}")
    for line in progress.verdict.advice:
        say(f"  - {line}")


def _told(second: SecondLook) -> dict[str, Any]:
    """The second look's figures, said if it found anything."""
    if second.won:
        verb = "kept" if second.kept else "not kept"
        noun = "corner" if second.won == 1 else "corners"
        say(
            f"second look: {second.won} more {noun}, {verb}: held-out error "
            f"{second.before:.3f} px without, {second.after:.3f} px with them"
        )
    return {
        "won": second.won,
        "kept": second.kept,
        "held_out_before": second.before,
        "held_out_after": second.after,
    }


def telling_views(detections: Sequence[Detection]) -> tuple[list[Detection], list[Detection]]:
    """Usable views that add something, and those that repeat others or are too many."""
    usable = [d for d in detections if d.usable]
    corners, size = np.array([d.corners for d in usable]), detections[0].size
    repeats = repeated_views(corners, size)
    for view, first in enumerate(repeats):
        if first >= 0:
            say(f"{usable[view].file}: left out, it repeats {usable[first].file}")
    kept = np.flatnonzero(repeats < 0)
    spread = spread_views(corners[kept])
    if not spread.all():
        say(f"{len(kept)} views: the {spread.sum()} that differ most are used")
    chosen = set(kept[spread].tolist())
    used = [d for i, d in enumerate(usable) if i in chosen]
    return used, [d for i, d in enumerate(usable) if i not in chosen]


def judged(
    lens: Lens,
    board: Target,
    model: str,
    used: Sequence[Detection],
    start: Fit | None,
    *,
    searched: bool,
) -> tuple[Halves | None, Verdict]:
    """Halves of the lens's views, where they can be solved, and the verdict."""
    files = [str(d.file) for d in used]
    try:
        halves = compare_halves(lens, board, model, start)
    except UserError as error:
        halves = None
        say(f"no comparison of two halves of the views: {error.what}")
    codes = None
    shape = lens.uncertainty(18)[0].shape
    for file in spread_out(files):
        codes = brightest(grey(read_image(file)), (shape[0], shape[1]), codes)
    verdict = judge_lens(
        lens,
        board,
        halves=halves,
        lit=None if codes is None else lit_places(codes),
        files=files,
        blur=float(np.nanmedian([d.blur for d in used])),
        searched=searched,
        columns=18,
    )
    return halves, verdict


def _print(title: str, lens: Lens, verdict: Verdict) -> None:
    """Verdict and advice, then the figures."""
    print(title)
    print(verdict.sentence)
    for line in verdict.advice:
        print(f"- {line}")
    print(
        f"RMS {lens.rms:.3f} px per corner, {int(lens.outliers.sum())} corners rejected, "
        f"corner noise {lens.sigma:.3f} px"
    )
    for name, value, error in list(
        zip(lens.names, lens.camera.intrinsics, lens.standard_errors, strict=True)
    )[:12]:
        print(f"  {name:3} {value:12.6g} +- {error:.2g}")
    if lens.pupil.any():
        travel = 1000 * float(lens.pupil @ [EDGE**2, EDGE**4])
        print(
            f"entrance pupil moves along the axis by {travel:.2g} mm towards rays of "
            f"{math.degrees(EDGE):.0f} degrees"
        )
    flat, true = (
        " x ".join("beyond the model" if math.isnan(v) else f"{math.degrees(v):.2f}" for v in f)
        for f in (lens.field_of_view(), lens.true_field_of_view())
    )
    print(f"field of view {flat} degrees undistorted, {true} through the lens")
    uncertain = float(np.nanmedian(lens.uncertainty()[1]))
    print(
        f"coverage {lens.coverage():.0%}, tilt {math.degrees(lens.tilt()):.0f} degrees, "
        f"projection uncertain to {uncertain:.2f} px (median)"
    )
