"""``chromeball calibrate match``: camera and pose from one picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.cli.calibrate.clicks import (
    parse_pixels,
    parse_rectangle,
    read_corners,
    read_lines,
    read_pairs,
)
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage


def match(
    picture: Path,
    /,
    *,
    output: Out,
    points: Path | None = None,
    lines: Path | None = None,
    rectangle: str | None = None,
    align: Path | None = None,
    corners: str | None = None,
    camera: Path | None = None,
    focal: Literal["auto", "known", "free"] = "auto",
    sigma: float = 0.5,
    centre_sigma: float | None = None,
    bend_sigma: float | None = None,
    json: Json = False,
) -> None:
    """Find focal length and pose of the camera that took a picture, from what it shows.

    Parameters
    ----------
    picture
        The photograph; its size counts.
    points
        A CSV x,y,z,u,v: points of the world in metres and their pixels; four and more, two and
        more beside lines.
    lines
        A CSV axis,u1,v1,u2,v2: edges along the world's axes (x, y or z; -x for one that runs
        the other way), from end to end.
    rectangle
        A rectangle on the floor about the origin, width x depth in metres, such as 0.6x0.4.
    align
        align.json of `envmap align` in its place.
    corners
        The pixels of its corners, far left, far right, near right, near left: "x,y x,y ...".
    camera
        A lens whose distortion and principal point hold; else one that bends by --bend-sigma.
    focal
        known keeps the focal length of --camera, free finds another (a zoom); auto is known
        with --camera, else free.
    sigma
        Standard deviation of a click in pixels, for the standard errors.
    centre_sigma
        How far the principal point may be from the middle (or --camera's), pixels; a hundredth
        of the width, more for cropped pictures.
    bend_sigma
        How far an unknown lens may move the picture's corners, as a share of their distance
        from the middle; 0.03, more for webcams and action cameras, 0 for no distortion at all.
    output
        The posed .cameramodel to write.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.formats import read_camera
    from chromeball.calibrate.match import BEND, NAMES
    from chromeball.calibrate.match import match as solve
    from chromeball.calibrate.wrong_click import SOUND
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.image import read_header

    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    if not 0 < sigma < 1e3:
        raise UserError(f"--sigma {sigma:g}: a click's error in pixels is positive")
    if centre_sigma is not None and not 0 < centre_sigma < 1e6:
        raise UserError(f"--centre-sigma {centre_sigma:g}: pixels, positive")
    if bend_sigma is not None and camera is not None:
        raise UserError("--bend-sigma says nothing of a known lens: leave it out")
    if bend_sigma is not None and not 0 <= bend_sigma < 1:
        raise UserError(f"--bend-sigma {bend_sigma:g}: a share of the distance, such as 0.03")
    if not any((points, lines, rectangle, align, corners)):
        raise UserError(
            "a picture alone tells no camera: give points of known place (--points FILE), "
            "edges along the axes (--lines FILE, with two points), or a rectangle on the floor "
            "(--rectangle 0.6x0.4 or --align FILE) and the pixels of its --corners"
        )
    known = focal == "known" or (focal == "auto" and camera is not None)
    if known and centre_sigma is not None:
        raise UserError("--centre-sigma says nothing of a known lens: leave it out")
    if focal == "known" and camera is None:
        raise UserError("--focal known needs the lens, --camera")
    world: list[list[float]] = []
    pixels: list[list[float]] = []
    if points is not None:
        world, pixels = read_pairs(points)
    if (rectangle is not None) and (align is not None):
        raise UserError("--rectangle or --align, one of the two")
    floor = rectangle is not None or align is not None
    if floor != (corners is not None):
        raise UserError(
            "a rectangle needs its --corners, and corners their --rectangle or --align"
        )
    if corners is not None:
        own = parse_rectangle(rectangle) if rectangle else read_corners(align or Path())
        clicked = parse_pixels(corners)
        if len(clicked) != len(own):
            raise UserError(f"{len(clicked)} corners were given, the rectangle has {len(own)}")
        world, pixels = [*world, *own], [*pixels, *map(list, clicked)]
    axes, ends = read_lines(lines) if lines is not None else ([], [])
    size = read_header(picture).size
    lens = CameraModel.pinhole(size, 1.0) if camera is None else read_camera(camera)
    if lens.size != size:
        raise UserError(
            "is for pictures of {}x{}, this one is {}x{}".format(*lens.size, *size), file=camera
        )
    inputs = [p for p in (picture, points, lines, align, camera) if p is not None]
    options = {
        "rectangle": rectangle, "corners": corners, "focal": focal, "sigma": sigma,
        "centre_sigma": centre_sigma, "bend_sigma": bend_sigma,
    }  # fmt: skip
    with Stage("calibrate match", inputs, **options) as stage:
        found = solve(
            lens,
            world,
            pixels,
            axes=axes,
            ends=ends,
            sigma=sigma,
            focal_known=known,
            centre_sigma=centre_sigma,
            bend_sigma=BEND if bend_sigma is None else bend_sigma,
            above_floor=floor,
        )
        errors = found.standard_errors
        value = found.camera.intrinsics[0]
        place = found.camera.world_from_camera.translation
        stage.figures.update(
            {
                "rms": found.rms,
                "focal_px": float(value),
                "sigma_focal_percent": 100 * errors[0],
                "sigma_centre_px": errors[1:3],
                "position": place,
                "sigma_position": errors[6:9],
                "misfit": found.misfit,
                "wrong_points": [click.index + 1 for click in found.wrong],
                "sigma_rotation_degrees": [math.degrees(v) for v in errors[3:6]],
                "residuals": found.residuals,
                "line_residuals": found.line_residuals,
                "covariance": found.covariance,
                "unknowns": list(NAMES),
                "condition": found.condition,
                "rivals": [
                    {
                        "focal_px": float(r.intrinsics[0]),
                        "position": r.world_from_camera.translation,
                    }
                    for r in found.rivals
                ],
            }
        )
        with stage.output(output) as temporary:
            found.camera.write(temporary)
    for click in found.wrong:
        say(f"warning: {click.words('point')}: correct or remove it")
    if found.misfit > SOUND and not found.wrong:
        say(
            f"the clicks are {found.misfit:.1f} times as far off as --sigma says, which is in "
            "the standard errors: look for a wrong point, or calibrate the lens"
        )
    for rival in found.rivals:
        x, y, z = rival.world_from_camera.translation
        say(
            f"the clicks fit another camera as well, {rival.intrinsics[0]:.0f} px at {x:.2f}, "
            f"{y:.2f}, {z:.2f} m: add points, or click more exactly"
        )
    if json:
        print_figures(stage.figures)
        return
    x, y, z = place
    print(
        f"{output}: focal length {value:.0f} px +- {errors[0]:.1%}, camera at {x:.3f}, "
        f"{y:.3f}, {z:.3f} m, RMS {found.rms:.2f} px"
    )
    shifts = ", ".join(f"{v * 1000:.1f}" for v in errors[6:9])
    turns = ", ".join(f"{math.degrees(v):.3f}" for v in errors[3:6])
    print(f"standard errors {shifts} mm; pitch, yaw, roll {turns} degrees")
