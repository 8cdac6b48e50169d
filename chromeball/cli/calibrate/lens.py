"""``chromeball calibrate lens``: one lens from pictures of a target."""

from __future__ import annotations

from pathlib import Path

from chromeball.cli.calibrate.arguments import Json, Out, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, check_output


def lens(
    images: tuple[Path, ...] = (),
    /,
    *,
    target: str,
    output: Out,
    model: str = "opencv8",
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
    from chromeball.calibrate.detect import Detection, detect_files
    from chromeball.calibrate.lens import MODELS
    from chromeball.calibrate.target import parse_target
    from chromeball.cli.calibrate.solved import solve_and_tell

    board = parse_target(target)
    if not images:
        raise UserError("name the pictures of the target")
    if model not in MODELS:
        raise UserError(f"unknown lens model {model!r}; one of {', '.join(MODELS)}")
    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    check_output(output, images)
    stage = Stage("calibrate lens", images, target=target, model=model)

    def tell(detection: Detection) -> None:
        say(f"{detection.file}: {detection.verdict}")

    with stage:
        detections = detect_files(images, board, tell)
        print_out = solve_and_tell(stage, detections, board, model, output)
    print_out(json)
