"""``chromeball calibrate lens``: one lens from pictures of a target."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output


def lens(
    images: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    target: str,
    output: Out,
    model: str = "opencv8",
    json: Json = False,
) -> None:
    """Calibrate one lens from pictures of a target.

    No focal length is needed. Plots of residuals, coverage and uncertainty stand beside the
    camera model and are named in its record.

    Parameters
    ----------
    images
        Photographs of the target, all of one size, focus and zoom untouched.
    target
        chessboard:9x6:0.025 (inner corners, square in metres),
        charuco:9x6:0.04:0.03:4X4_50 (squares, square and marker in metres, dictionary),
        aprilgrid:6x6:0.088:0.3 (Kalibr's: tags, side of a tag in metres, gap in sides),
        circles:7x5:0.04 (dark discs, distance of their centres in metres) or
        acircles:4x11:0.02 (every second row shifted by 0.02; rows that far apart, discs in a
        row twice as far).
    model
        pinhole, opencv4, opencv5, opencv8, splined; kb4 for fisheyes beyond 180 degrees, too
        (Kannala and Brandt), kb4_decentred (with elements off the axis), equidistant,
        equisolid, stereographic; or auto: the simplest that predicts pictures left out of the
        solution as well as any.
    output
        The .cameramodel to write, in mrcal's format, with the covariance of the intrinsics; for
        mrcal's models, the first five, with all that the solution was made of.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.choose import choose_model
    from chromeball.calibrate.detect import Detection, detect_files
    from chromeball.calibrate.lens import MODELS, calibrate_lens
    from chromeball.calibrate.plots import plot_coverage, plot_residuals, plot_uncertainty
    from chromeball.calibrate.target import parse_target
    from chromeball.calibrate.views import repeated_views, spread_views

    board = parse_target(target)
    if model not in MODELS:
        raise UserError(f"unknown lens model {model!r}; one of {', '.join(MODELS)}")
    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    with Stage("calibrate lens", images, target=target, model=model) as stage:

        def tell(detection: Detection) -> None:
            say(f"{detection.file}: {detection.verdict}")

        detections = detect_files(images, board, tell)
        used = [d for d in detections if d.usable]
        import numpy as np

        corners, size = np.array([d.corners for d in used]), detections[0].size
        stage.figures["views"] = [
            {"file": d.file, "corners": d.count, "blur": d.blur, "verdict": d.verdict}
            for d in detections
        ]
        repeats = repeated_views(corners, size)
        for view, first in enumerate(repeats):
            if first >= 0:
                say(f"{used[view].file}: left out, it repeats {used[first].file}")
        kept = np.flatnonzero(repeats < 0)
        spread = spread_views(corners[kept])
        if not spread.all():
            say(f"{len(kept)} views: the {spread.sum()} that differ most are used")
        dropped = [used[i] for i in sorted({*range(len(used))} - {*kept[spread].tolist()})]
        used = [used[i] for i in kept[spread]]
        corners = corners[kept[spread]]
        chosen = model
        if model == "auto":
            choice = choose_model(
                corners, board, size, lambda m, e: say(f"{m}: held-out error {e:.3f} px")
            )
            chosen = choice.model
            stage.figures |= {"held_out_rms": choice.errors, "reason": choice.reason}
            say(f"{chosen}: {choice.reason}")
        result = calibrate_lens(corners, board, size, chosen, [str(d.file) for d in used])
        figures = result.figures() | {
            "views_used": len(used),
            "views_skipped": len(detections) - len(used),
            "skipped": [str(d.file) for d in detections if not d.usable],
            "repeated": [str(d.file) for d in dropped],
            "chosen_model": chosen,
            "view_rms": dict(zip((str(d.file) for d in used), result.view_rms, strict=True)),
        }
        stage.figures.update(figures)
        plots: dict[str, str] = {}
        for name, plot in (
            ("residuals", plot_residuals),
            ("coverage", plot_coverage),
            ("uncertainty", plot_uncertainty),
        ):
            path = output.with_name(f"{output.stem}.{name}.png")
            with atomic_output(path) as temporary:
                plot(result, temporary)
            plots[name] = path.name
        stage.figures["plots"] = plots
        with stage.output(output) as temporary:
            result.write(temporary)
    if json:
        print_figures(stage.figures)
        return
    print(f"{output}: {chosen}, {len(used)} of {len(detections)} pictures")
    print(
        f"RMS {result.rms:.3f} px per corner, {int(result.outliers.sum())} corners rejected, "
        f"corner noise {result.sigma:.3f} px"
    )
    for name, value, error in list(
        zip(result.names, result.camera.intrinsics, result.standard_errors, strict=True)
    )[:12]:
        print(f"  {name:3} {value:12.6g} +- {error:.2g}")
    flat, true = (
        " x ".join("beyond the model" if math.isnan(v) else f"{math.degrees(v):.2f}" for v in f)
        for f in (result.field_of_view(), result.true_field_of_view())
    )
    print(f"field of view {flat} degrees undistorted, {true} through the lens")
    print(
        f"coverage {result.coverage():.0%}, tilt {math.degrees(result.tilt()):.0f} degrees, "
        f"projection uncertain to {figures['uncertainty_median']:.2f} px (median)"
    )
