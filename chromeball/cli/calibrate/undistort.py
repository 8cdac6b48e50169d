"""``chromeball calibrate undistort``: a picture without its lens's distortion."""

from __future__ import annotations

import math
from pathlib import Path

from chromeball.cli.calibrate.arguments import Json, Out, print_figures
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage


def undistort(
    image: Path,
    /,
    *,
    camera: Path,
    output: Out,
    fov: float | None = None,
    json: Json = False,
) -> None:
    """Remove a lens's distortion: the picture of a perspective camera at the same place.

    That camera is written beside the picture as NAME.cameramodel.

    Parameters
    ----------
    image
        A picture by that lens, codes or radiance.
    camera
        The lens, a .cameramodel or another file that `calibrate convert` reads.
    output
        The picture to write; EXR for a scene-linear one.
    fov
        Horizontal field of view in degrees; by default the lens's focal length is kept.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.formats import read_camera
    from chromeball.calibrate.undistort import undistort as resample
    from chromeball.calibrate.undistort import undistorted_camera
    from chromeball.scene.image import read_image, write_exr, write_picture

    source = read_image(image)
    if source.linear != (output.suffix.lower() == ".exr"):
        kind = "EXR" if source.linear else "PNG, JPEG or TIFF"
        raise UserError(f"a picture like {image} is written as {kind}", file=output)
    model = read_camera(camera)
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
        print_figures(stage.figures)
        return
    print(f"{output}: {math.degrees(across):.2f} degrees across, {unseen} pixels unseen")
