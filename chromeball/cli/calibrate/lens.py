"""``chromeball calibrate lens``: one lens from pictures of a target."""

from __future__ import annotations

from pathlib import Path

from chromeball.cli.calibrate.arguments import Cache, Json, Out, print_figures
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, check_output, record_path


def lens(
    images: tuple[Path, ...] = (),
    /,
    *,
    target: str,
    output: Out,
    model: str = "auto",
    watch: Path | None = None,
    views: int | None = None,
    reuse: Path | None = None,
    cache: Cache = True,
    json: Json = False,
) -> None:
    """Calibrate one lens from pictures of a target.

    No focal length is needed. First comes a verdict: how good the lens is over how much of the
    picture, and what to do about it. Plots stand beside the camera model and are named in its
    record.

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
        auto is the simplest that predicts pictures left out of the solution as well as any;
        or pinhole, opencv4, opencv5, opencv8, splined; kb4 for fisheyes beyond 180 degrees, too
        (Kannala and Brandt), kb4_decentred (with elements off the axis), equidistant,
        equisolid, stereographic; cahvore (Gennery's, its moving pupil as kb4's).
    watch
        Instead of pictures a folder into which they come: each is looked at when it is whole,
        and verdict and advice are told again. Ends with Ctrl-C, after so many views, or when
        the verdict is good; then the camera is written. With auto, kb4 stands in until then.
    views
        With --watch: so many views are enough.
    reuse
        A camera calibrated earlier: kept when metadata and the new pictures agree with it, one
        tilted view of the board suffices; else it is solved again, and why is said.
    output
        The .cameramodel to write, in mrcal's format, with the covariance of the intrinsics; for
        mrcal's models, the first five, with all that the solution was made of.
    cache
        Keep what was detected in a picture, by its content, and use it the next time.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.lens import MODELS
    from chromeball.calibrate.target import parse_target
    from chromeball.calibrate.watch import watch_lens
    from chromeball.cli.calibrate.detecting import detect_told
    from chromeball.cli.calibrate.kept import keep_camera
    from chromeball.cli.calibrate.solved import solve_and_tell, tell_progress

    board = parse_target(target)
    if bool(images) == (watch is not None):
        raise UserError("name the pictures of the target, or a folder to --watch")
    if views is not None and (watch is None or views < 1):
        raise UserError("--views N goes with --watch, and is 1 or more")
    if reuse is not None and watch is not None:
        raise UserError("--reuse checks pictures that are there: leave --watch out")
    if model not in MODELS:
        raise UserError(f"unknown lens model {model!r}; one of {', '.join(MODELS)}")
    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    inputs = [*images, *([] if reuse is None else [reuse, record_path(reuse)])]
    check_output(output, inputs)
    stage = Stage("calibrate lens", inputs, target=target, model=model)

    with stage:
        if watch is not None:
            stand_in = "kb4" if model == "auto" else model
            detections = watch_lens(watch, board, stand_in, tell_progress, enough=views)
            if not any(d.usable for d in detections):
                raise UserError("no picture of the board came", file=watch)
            stage.inputs = [d.file for d in detections]
            check_output(output, stage.inputs)
        else:
            detections = detect_told(images, board, cache)
        if reuse is not None and keep_camera(stage, detections, board, reuse, output):
            if json:
                print_figures(stage.figures)
            else:
                print(f"{output}: {stage.figures['verdict']}")
            return
        print_out = solve_and_tell(stage, detections, board, model, output)
    print_out(json)
