"""``chromeball calibrate``: lenses, poses, undistorted pictures."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output, read_json, to_json

app = App(name="calibrate", help="Cameras and their poses.")

Output = Annotated[Path, Parameter(name=["-o", "--output"])]
AsJson = Annotated[bool, Parameter(name="--json", negative="")]


@app.command
def lens(
    images: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    target: str,
    output: Output,
    model: str = "opencv8",
    json: AsJson = False,
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
        circles:7x5:0.04 (dark discs, distance of their centres in metres) or
        acircles:4x11:0.02 (every second row shifted by 0.02; rows that far apart, discs in a
        row twice as far).
    model
        pinhole, opencv4, opencv5, opencv8, splined; kb4 for fisheyes beyond 180 degrees, too
        (Kannala and Brandt), equidistant, equisolid, stereographic; or auto: the one of
        opencv4, opencv5, opencv8 and kb4 with the least error on pictures left out of the
        solution.
    output
        The .cameramodel to write, in mrcal's format; for its models, the first five, with all
        that the solution was made of.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.detect import Detection, detect_files
    from chromeball.calibrate.lens import MODELS, calibrate_lens, choose_model
    from chromeball.calibrate.plots import plot_coverage, plot_residuals, plot_uncertainty
    from chromeball.calibrate.target import parse_target

    board = parse_target(target)
    if model not in MODELS:
        raise UserError(f"unknown lens model {model!r}; one of {', '.join(MODELS)}")
    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    with Stage("calibrate lens", images, target=target, model=model) as stage:

        def tell(detection: Detection) -> None:
            _say(f"{detection.file}: {detection.verdict}")

        detections = detect_files(images, board, tell)
        used = [d for d in detections if d.usable]
        import numpy as np

        corners, size = np.array([d.corners for d in used]), detections[0].size
        stage.figures["views"] = [
            {"file": d.file, "corners": d.count, "blur": d.blur, "verdict": d.verdict}
            for d in detections
        ]
        chosen = model
        if model == "auto":
            chosen, errors = choose_model(
                corners, board, size, lambda m, e: _say(f"{m}: held-out error {e:.3f} px")
            )
            stage.figures["held_out_rms"] = errors
        result = calibrate_lens(corners, board, size, chosen, [str(d.file) for d in used])
        figures = result.figures() | {
            "views_used": len(used),
            "views_skipped": len(detections) - len(used),
            "skipped": [str(d.file) for d in detections if not d.usable],
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
        _print_json(stage.figures)
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


@app.command
def pose(
    *,
    camera: Path,
    points: str,
    align: Path,
    output: Output,
    sigma: float = 0.5,
    json: AsJson = False,
) -> None:
    """Find where a calibrated camera stood from the clicked corners of the align rectangle.

    Parameters
    ----------
    camera
        The lens, a .cameramodel.
    points
        Pixels of the corners in the order of align.json: "x,y x,y x,y x,y".
    align
        align.json of `envmap align`; its corners are the world points.
    output
        The posed .cameramodel to write.
    sigma
        Standard deviation of a click in pixels, for the standard errors.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.pose import solve_pose
    from chromeball.scene.camera import CameraModel

    if not 0 < sigma < 1e3:
        raise UserError(f"--sigma {sigma:g}: a click's error in pixels is positive")
    pixels = _points(points)
    corners = _corners(align)
    if len(pixels) != len(corners):
        raise UserError(f"{len(pixels)} points were given, {align} has {len(corners)} corners")
    unposed = CameraModel.read(camera)
    options = {"camera": camera, "points": points, "align": align, "sigma": sigma}
    with Stage("calibrate pose", [camera, align], **options) as stage:
        found = solve_pose(unposed, corners, pixels, sigma=sigma)
        stage.figures.update(
            {
                "rms": found.rms,
                "residuals": found.residuals,
                "position": found.world_from_camera.translation,
                "sigma_position": found.sigma_position,
                "sigma_rotation_degrees": [math.degrees(v) for v in found.sigma_rotation],
                "rival_rms": found.rival_rms,
                "ambiguous": found.ambiguous,
            }
        )
        with stage.output(output) as temporary:
            unposed.posed(found.world_from_camera).write(temporary)
    if found.ambiguous:
        _say(
            "the clicks fit a second pose almost as well: click more exactly, or take the "
            "plate from nearer the floor rectangle"
        )
    if json:
        _print_json(stage.figures)
        return
    x, y, z = found.world_from_camera.translation
    errors = ", ".join(f"{v * 1000:.1f}" for v in found.sigma_position)
    turns = ", ".join(f"{math.degrees(v):.3f}" for v in found.sigma_rotation)
    print(f"{output}: camera at {x:.3f}, {y:.3f}, {z:.3f} m, RMS {found.rms:.2f} px")
    print(f"standard errors {errors} mm; pitch, yaw, roll {turns} degrees")


@app.command
def undistort(
    image: Path,
    /,
    *,
    camera: Path,
    output: Output,
    fov: float | None = None,
    json: AsJson = False,
) -> None:
    """Remove a lens's distortion: the picture of a perspective camera at the same place.

    That camera is written beside the picture as NAME.cameramodel.

    Parameters
    ----------
    image
        A picture by that lens, codes or radiance.
    camera
        The lens, a .cameramodel.
    output
        The picture to write; EXR for a scene-linear one.
    fov
        Horizontal field of view in degrees; by default the lens's focal length is kept.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.undistort import undistort as resample
    from chromeball.calibrate.undistort import undistorted_camera
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.image import read_image, write_exr, write_picture

    source = read_image(image)
    if source.linear != (output.suffix.lower() == ".exr"):
        kind = "EXR" if source.linear else "PNG, JPEG or TIFF"
        raise UserError(f"a picture like {image} is written as {kind}", file=output)
    model = CameraModel.read(camera)
    target = undistorted_camera(model, None if fov is None else math.radians(fov))
    with Stage("calibrate undistort", [image, camera], fov=fov) as stage:
        try:
            pixels, unseen = resample(source.pixels, model, target)
        except UserError as error:
            raise UserError(error.what, file=image) from error
        across = 2 * math.atan(target.size[0] / (2 * target.intrinsics[0]))
        stage.figures.update({"unseen_pixels": unseen, "fov_degrees": math.degrees(across)})
        with stage.output(output) as temporary:
            if source.linear:
                write_exr(temporary, pixels, channels=source.channels)
            else:
                write_picture(temporary, pixels, exposure=source.exposure)
        with stage.output(output.with_suffix(".cameramodel")) as temporary:
            target.write(temporary)
    if json:
        _print_json(stage.figures)
        return
    print(f"{output}: {math.degrees(across):.2f} degrees across, {unseen} pixels unseen")


def _points(text: str) -> list[tuple[float, float]]:
    """Pixels from "x,y x,y ..."."""
    pixels: list[tuple[float, float]] = []
    for item in text.split():
        try:
            x, y = (float(v) for v in item.split(","))
        except ValueError as error:
            raise UserError(
                f'{item!r} is no pixel; write --points "x,y x,y x,y x,y"'
            ) from error
        pixels.append((x, y))
    return pixels


def _corners(align: Path) -> list[list[float]]:
    """World corners (N, 3) of align.json."""
    value = read_json(align)
    corners = value.get("corners") if isinstance(value, dict) else None
    try:
        points = [[float(v) for v in corner] for corner in corners or []]
    except (TypeError, ValueError):
        points = []
    if not points or any(len(p) != 3 for p in points):
        raise UserError("no world corners in it; make it with `envmap align`", file=align)
    return points


def _say(message: str) -> None:
    print(message, file=sys.stderr)


def _print_json(figures: dict[str, object]) -> None:
    print(json.dumps(to_json(figures), indent=1))
