"""``chromeball calibrate rig``: several cameras that hold together, from one board."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Cache, Json, Out, print_figures, say, store_rig
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output

if TYPE_CHECKING:
    from chromeball.calibrate.rig_result import RigSolution
    from chromeball.scene.camera import CameraModel

#: Corners over less of the picture leave a lens to be completed.
SEEN_ENOUGH = 0.6
#: A camera that is so many times less exact in the rig than alone is told of.
UNEVEN = 1.3


def rig(
    folders: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    target: str,
    output: Out,
    model: list[str] | None = None,
    lens: list[Path] | None = None,
    refine: Annotated[bool, Parameter(negative="")] = False,
    times: Path | None = None,
    every: int = 1,
    distance: str | None = None,
    cache: Cache = True,
    json: Json = False,
) -> None:
    """Calibrate the cameras of a rig and where they stand, from pictures of one board.

    Lens models and resolutions may differ, and no board need be seen by all cameras. The first
    camera is the rig's origin. Cameras that did not look at once are recognised where times are
    known (videos, --times), and their time offsets estimated.

    Parameters
    ----------
    folders
        A folder of pictures or a video for each camera, or one folder that holds these.
        Pictures of one instant have the same name, else the same last number in their names.
    target
        As `calibrate lens` has it: chessboard:9x6:0.025, charuco:9x6:0.04:0.03:4X4_50 ...
    output
        The folder to write: NAME.cameramodel for each camera, rig.json, plots.
    model
        The lens model of all cameras, as `calibrate lens` has it without splined, or NAME=MODEL
        of one; may be given several times. auto by default.
    lens
        Known lenses, NAME.cameramodel, or files that convert reads; they are kept as they are.
    refine
        Refine the known lenses, too.
    times
        A table (CSV) with columns camera, frame, time in seconds, and maybe instant.
    every
        Use every second, third ... instant alone.
    distance
        A length to check the scale by, LEFT:RIGHT:METRES between two cameras.
    cache
        Keep detections, and do not search pictures or frames again that were searched before.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.detect import larger_board
    from chromeball.calibrate.formats import read_lenses
    from chromeball.calibrate.rig import calibrate_rig
    from chromeball.calibrate.rig_file import rig_of
    from chromeball.calibrate.rig_lenses import MODELS
    from chromeball.calibrate.rig_plots import plot_layout, plot_residuals, plot_sync
    from chromeball.calibrate.rig_views import find_sources, look, plan_pairs
    from chromeball.calibrate.target import parse_target
    from chromeball.cli.calibrate.detecting import cores, kept_in

    board = parse_target(target)
    if output.exists() and not output.is_dir():
        raise UserError("is a file; name a folder", file=output)
    sources = find_sources(folders)
    names = [source.name for source in sources]
    models = _models(model or [], names, MODELS)
    ends = _ends(distance, names)
    lenses = list(lens or [])
    known: dict[str, CameraModel] = {}
    for path in lenses:
        known |= read_lenses(path)
    if refine and not known:
        raise UserError("--refine is for lenses given by --lens")
    inputs = [*(p for source in sources for p in source.paths), *lenses]
    inputs += [times] if times else []
    options = {
        "target": target, "model": models, "refine": refine, "every": every,
        "distance": distance,
    }  # fmt: skip
    with Stage("calibrate rig", inputs, **options) as stage:
        plan = plan_pairs(sources, times, every)
        files = [file for source in sources for file in source.files]
        if larger := larger_board(files, board):
            raise UserError(f"{larger}; the cameras must all see the same corners")
        kept = kept_in() if cache else None
        views = look(sources, plan, board, workers=cores(), cache=kept, progress=say)
        solution = calibrate_rig(
            views.corners, board, views.sizes, names,
            models=models, known=known, refine=refine, stamps=plan.stamps,
            labels=plan.labels, progress=say,
        )  # fmt: skip
        stage.figures.update(_figures(solution, plan.labels))
        if ends is not None:
            a, b, truth = ends
            measured, error = rig_of(solution).distance(a, b)
            stage.figures["distance"] = {
                "cameras": [a, b], "given": truth, "measured": measured, "error": error
            }  # fmt: skip
        plots = {"residuals": plot_residuals, "layout": plot_layout}
        if solution.sync is not None:
            plots["sync"] = plot_sync
        for name, plot in plots.items():
            with atomic_output(output / f"{name}.png") as temporary:
                plot(solution, temporary)
        stage.figures["plots"] = {name: f"{name}.png" for name in plots}
        store_rig(stage, output, rig_of(solution))
    for line in _advice(solution, plan.labels, plan.stamps is not None, stage.figures):
        say(line)
    if json:
        print_figures(stage.figures)
        return
    _print(solution, output)


def _models(given: list[str], names: list[str], allowed: tuple[str, ...]) -> list[str]:
    """The lens model of each camera."""
    chosen = dict.fromkeys(names, "auto")
    for common in (True, False):
        for text in given:
            name, equals, model = text.rpartition("=")
            if bool(equals) == common:
                continue
            if model not in allowed:
                raise UserError(f"unknown lens model {model!r}; one of {', '.join(allowed)}")
            if equals and name not in chosen:
                raise UserError(f"--model {text}: the cameras are called {', '.join(names)}")
            chosen |= {name: model} if equals else dict.fromkeys(names, model)
    return [chosen[name] for name in names]


def _ends(text: str | None, names: list[str]) -> tuple[str, str, float] | None:
    """Two cameras and their distance in metres, of LEFT:RIGHT:METRES."""
    if text is None:
        return None
    parts = text.split(":")
    try:
        a, b, length = parts[0], parts[1], float(parts[2])
    except (IndexError, ValueError):
        a, b, length = "", "", math.nan
    if len(parts) != 3 or not 0 < length < math.inf or a == b or not {a, b} <= set(names):
        raise UserError(
            f"--distance {text}: write LEFT:RIGHT:METRES; the cameras are {', '.join(names)}"
        )
    return a, b, length


def _figures(solution: RigSolution, labels: tuple[str, ...]) -> dict[str, Any]:
    import numpy as np

    from chromeball.calibrate.uncertainty import seen_places

    sync, names = solution.sync, solution.names
    square = (solution.residuals**2).sum(axis=-1)
    figures: dict[str, Any] = {
        "rms": float(np.sqrt(np.nanmean(square))),
        "camera_rms": dict(zip(names, solution.rms, strict=True)),
        "sigma": dict(zip(names, solution.sigma, strict=True)),
        "sigma_alone": dict(zip(names, solution.alone, strict=True)),
        "disagreement": solution.disagreement,
        "corners": int(np.isfinite(solution.observed[..., 0]).sum()),
        "outliers": int(solution.outliers.sum()),
        "misread": [f"{names[c]} {labels[v]}" for c, v in solution.misread()],
        "turned": [f"{names[c]} {labels[v]}" for c, v in np.argwhere(solution.turned)],
        "repeated": [labels[v] for v in solution.repeated],
        "boards_in_common": solution.common,
        "positions": {
            n: c.world_from_camera.translation
            for n, c in zip(names, solution.cameras, strict=True)
        },
        "position_errors": dict(zip(names, solution.position_errors, strict=True)),
        "turn_errors_degrees": dict(zip(names, np.degrees(solution.turn_errors), strict=True)),
        "lens_seen_share": {
            name: float(seen_places(camera)[1].mean())
            for name, camera in zip(names, solution.cameras, strict=True)
            if camera.region is not None
        },
        "bow_metres": solution.bow,
        "condition": solution.condition,
        "synchronised": sync is None and solution.disagreement <= 2,
    }
    if sync is not None:
        figures |= {
            "time_offsets": dict(zip(names, sync.motion.offsets, strict=True)),
            "time_offset_errors": dict(zip(names, sync.offset_errors, strict=True)),
            "readout": dict(zip(names, sync.motion.readout, strict=True)),
            "readout_errors": dict(zip(names, sync.readout_errors, strict=True)),
            "rms_at_once": sync.rms_before,
            "rms_all_corners": sync.rms,
            "held_out": dict(
                zip(("at_once", "offsets", "rolling"), sync.held_out, strict=True)
            ),
        }
    return figures


def _advice(
    solution: RigSolution, labels: tuple[str, ...], timed: bool, figures: dict[str, Any]
) -> list[str]:
    """What a person should know or do."""
    names, lines = solution.names, list[str]()
    if solution.repeated:
        shown = ", ".join(labels[v] for v in solution.repeated[:6])
        lines.append(f"pictures that repeat earlier ones count for nothing: {shown}")
    if misread := figures["misread"]:
        more = f" and {len(misread) - 6} more" if len(misread) > 6 else ""
        lines.append(
            f"boards that do not fit the others were left out: {', '.join(misread[:6])}{more}"
        )
    lines += _open_lenses(solution, figures["lens_seen_share"])
    if solution.sync is None and solution.disagreement > 2:
        why = (
            "time offsets do not explain it: did the cameras move, or is a given lens wrong?"
            if timed
            else "if the board moved while they looked, hold it still, or give --times"
        )
        lines.append(
            f"together the cameras are {solution.disagreement:.1f} times less exact than "
            f"alone; {why}"
        )
    elif solution.sync is None:
        lines += [
            f"{name} is {ratio:.1f} times less exact in the rig than alone: was it or a "
            "neighbour moved between pictures?"
            for name, ratio in zip(names, solution.sigma / solution.alone, strict=True)
            if ratio > UNEVEN
        ]
    if "distance" in figures:
        told = figures["distance"]
        ratio = told["given"] / told["measured"]
        off = abs(told["given"] - told["measured"])
        text = (
            f"{' to '.join(told['cameras'])}: {told['measured']:.5g} +- {told['error']:.2g} m"
        )
        if off > 3 * told["error"] + 0.002 * told["given"]:
            text += (
                f", {told['given']:.5g} m was given: the board's squares are {ratio:.4f} times "
                "as large as --target says, or that length is wrong"
            )
        lines.append(text)
    return lines


def _open_lenses(solution: RigSolution, shares: dict[str, float]) -> list[str]:
    """Cameras whose corners leave much of the picture open."""
    from chromeball.calibrate.regions import named, thirds
    from chromeball.calibrate.uncertainty import seen_places

    lines: list[str] = []
    for name, camera in zip(solution.names, solution.cameras, strict=True):
        if shares.get(name, 1.0) >= SEEN_ENOUGH:
            continue
        pixels, seen = seen_places(camera)
        where, _ = named(thirds(~seen, pixels, camera.size))
        beyond = "all around" if where == "the whole picture" else f"in {where}"
        lines.append(
            f"{name}: corners lie over {shares[name]:.0%} of its picture; beyond, {beyond}, "
            "its lens is a guess: show it the board there, or calibrate it by itself and give "
            "--lens"
        )
    return lines


def _print(solution: RigSolution, output: Path) -> None:
    rejected, corners = (
        int(solution.outliers.sum()),
        int((solution.observed[..., 0] > -1e9).sum()),
    )
    print(
        f"{output}: {len(solution.names)} cameras, {len(solution.observed[0])} instants, "
        f"{rejected} of {corners} corners rejected"
    )
    for c, name in enumerate(solution.names):
        x, y, z = solution.cameras[c].world_from_camera.translation
        errors = ", ".join(f"{1000 * v:.2g}" for v in solution.position_errors[c])
        turn = math.degrees(float(solution.turn_errors[c].max()))
        line = (
            f"  {name}: RMS {solution.rms[c]:.3f} px (alone {1.414 * solution.alone[c]:.3f}); "
            f"at {x:.4f}, {y:.4f}, {z:.4f} m +- {errors} mm, {turn:.2g} degrees"
        )
        if solution.sync is not None:
            offset, error = solution.sync.motion.offsets[c], solution.sync.offset_errors[c]
            line += f"; {1000 * offset:.1f} +- {1000 * error:.1f} ms late"
            if solution.sync.rolling:
                line += f", read out over {1000 * solution.sync.motion.readout[c]:.1f} ms"
        print(line)
