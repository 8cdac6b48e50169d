"""``chromeball calibrate pose``: where a calibrated camera stood."""

from __future__ import annotations

import math
from pathlib import Path

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.cli.calibrate.clicks import parse_pixels, read_corners
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage


def pose(
    *,
    camera: Path,
    points: str,
    align: Path,
    output: Out,
    sigma: float = 0.5,
    json: Json = False,
) -> None:
    """Find where a calibrated camera stood from the clicked corners of the align rectangle.

    Parameters
    ----------
    camera
        The lens, a .cameramodel or another file that `calibrate convert` reads.
    points
        Pixels of the corners in the order of align.json: "x,y x,y x,y x,y".
    align
        align.json of `envmap align`; its corners are the world points.
    output
        The posed .cameramodel to write; what else a .cameramodel of the lens holds is kept.
    sigma
        Standard deviation of a click in pixels, for the standard errors.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.formats import NamedCamera, encoded, read_camera
    from chromeball.calibrate.pose import solve_pose

    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    if not 0 < sigma < 1e3:
        raise UserError(f"--sigma {sigma:g}: a click's error in pixels is positive")
    pixels = parse_pixels(points)
    corners = read_corners(align)
    if len(pixels) != len(corners):
        raise UserError(f"{len(pixels)} points were given, {align} has {len(corners)} corners")
    unposed = read_camera(camera)
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
            posed = unposed.posed(found.world_from_camera)
            source = camera if camera.suffix == output.suffix else None
            named = NamedCamera(output.stem, posed, source=source)
            temporary.write_bytes(encoded([named], output, "cameramodel")[""])
    if found.ambiguous:
        say(
            "the clicks fit a second pose almost as well: click more exactly, or take the "
            "plate from nearer the floor rectangle"
        )
    if json:
        print_figures(stage.figures)
        return
    x, y, z = found.world_from_camera.translation
    errors = ", ".join(f"{v * 1000:.1f}" for v in found.sigma_position)
    turns = ", ".join(f"{math.degrees(v):.3f}" for v in found.sigma_rotation)
    print(f"{output}: camera at {x:.3f}, {y:.3f}, {z:.3f} m, RMS {found.rms:.2f} px")
    print(f"standard errors {errors} mm; pitch, yaw, roll {turns} degrees")
