"""``chromeball calibrate exif``: a camera by a picture's metadata alone."""

from __future__ import annotations

import math
from pathlib import Path

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage


def exif(
    picture: Path,
    /,
    *,
    output: Out,
    sensor: str | None = None,
    focal: float | None = None,
    json: Json = False,
) -> None:
    """Make a camera from a picture's metadata, where there is nothing better.

    It knows no distortion and its focal length to a few per cent, which the record says.

    Parameters
    ----------
    picture
        A photograph as the camera wrote it.
    sensor
        The sensor, where metadata do not name a camera that is known here: its width in mm, or
        full-frame, aps-c, aps-c-canon, four-thirds, 1in, 1/1.7in, 1/2.3in, 1/2.5in and others.
    focal
        The focal length in mm instead of the metadata's, as by a prime lens without contacts.
    output
        The .cameramodel to write.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.exif_camera import camera_from_exif

    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    with Stage("calibrate exif", [picture], sensor=sensor, focal=focal) as stage:
        found = camera_from_exif(picture, sensor, focal)
        error = found.focal_error
        stage.figures.update(
            {
                "focal_px": float(found.camera.intrinsics[0]),
                "sigma_focal_percent": 100 * error,
                "sigma_centre_px": found.centre_error,
                "fov_degrees": math.degrees(found.fov),
                "clues": [
                    {"how": c.how, "focal_px": c.focal, "sigma_percent": 100 * c.error}
                    for c in found.clues
                ],
                "notes": list(found.notes),
            }
        )
        with stage.output(output) as temporary:
            found.camera.write(temporary)
    for note in found.notes:
        say(note)
    if json:
        print_figures(stage.figures)
        return
    print(
        f"{output}: focal length {found.camera.intrinsics[0]:.0f} px +- {error:.1%}, by "
        f"{found.clues[0].how}; {math.degrees(found.fov):.1f} degrees across"
    )
