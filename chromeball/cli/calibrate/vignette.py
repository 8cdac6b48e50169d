"""``chromeball calibrate vignette``: how much darker a lens is towards its rim."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from chromeball.cli.calibrate.arguments import Cache, Json, Out, say
from chromeball.cli.calibrate.vignette_overlap import figures_of, overlap, told
from chromeball.cli.options import Numbers
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output, check_output

if TYPE_CHECKING:
    from chromeball.calibrate.vignette import Solved
    from chromeball.calibrate.vignette_data import Picture
    from chromeball.hdr.response_file import Response

type Images = Annotated[list[Path], Parameter(required=True)]

app = App(
    name="vignette",
    help="Fall-off of a lens towards its rim: vignette.json, for --vignetting.",
)


@app.command
def board(
    images: Images,
    /,
    *,
    target: str,
    camera: Path | None = None,
    response: Path | None = None,
    smooth: bool | None = None,
    output: Out,
    cache: Cache = True,
    json: Json = False,
) -> None:
    """Measure it on the white paper of a board, with the pictures of a lens calibration.

    The light may vary smoothly over the board, in each picture otherwise; that it favours no
    side of the lens is assumed, so do not light the board from the camera.

    Parameters
    ----------
    images
        Photographs of the board at one aperture, focus and zoom; RAW or EXR, or codes.
    target
        A chessboard, ChArUco board or symmetric grid of circles, as `calibrate lens` takes it.
    camera
        The lens: its principal point says about where the fall-off has its centre.
    response
        The camera's response.json for pictures of codes; sRGB is assumed without, and told.
    smooth
        Add a smooth map to the polynomial, or forbid it; by default where the pictures ask.
    output
        The vignette.json to write.
    cache
        Keep detections, and do not search pictures again that were searched before.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.target import parse_target
    from chromeball.calibrate.vignette import solve
    from chromeball.calibrate.vignette_board import board_samples, check_target
    from chromeball.cli.calibrate.detecting import detect_told

    sheet = parse_target(target)
    check_target(sheet)
    others = [path for path in (camera, response) if path is not None]
    check_output(output, [*images, *others], ".json")
    with Stage("calibrate vignette board", [*images, *others], target=target) as stage:
        aperture = _aperture(images)

        used = [d for d in detect_told(images, sheet, cache) if d.usable]
        if len(used) < 4:
            raise UserError(
                f"the board was seen in {len(used)} pictures; its light and the lens's "
                "fall-off are told apart by 4 or more, better 20"
            )
        size = used[0].size
        counted = board_samples(
            _pictures([d.file for d in used], response),
            [d.corners for d in used],
            sheet,
            [d.blur for d in used],
        )
        solved = solve(
            counted.samples,
            size,
            source="board",
            centre=_principal(camera, size),
            with_map=smooth,
        )
        stage.figures |= {
            "views_used": counted.views,
            "saturated_squares": counted.saturated,
            "squares": len(counted.samples.log),
            "light_gradient": solved.light_sigma[0],
            "light_curvature": solved.light_sigma[1],
        }
        _write(stage, output, solved, aperture, counted.samples.pixels)
    told(stage, output, solved.vignette, solved.scatter, json)


@app.command
def flat(
    images: Images,
    /,
    *,
    turns: Numbers = None,
    camera: Path | None = None,
    response: Path | None = None,
    smooth: bool | None = None,
    output: Out,
    json: Json = False,
) -> None:
    """Measure it on an evenly bright field: an integrating sphere, an overcast sky, a panel.

    A hard edge, a hood's or that of the image circle, is found and kept apart.

    Parameters
    ----------
    images
        Pictures of the field at one aperture, focus and zoom; RAW or EXR, or codes.
    turns
        Clockwise turns of the camera about its axis in each picture, degrees, 0,90,180: what
        turns along is the lens's, what stays is the field's gradient.
    camera
        The lens: its principal point says about where the fall-off has its centre.
    response
        The camera's response.json for pictures of codes; sRGB is assumed without, and told.
    smooth
        Add a smooth map to the polynomial, or forbid it; by default where the pictures ask.
    output
        The vignette.json to write.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.calibrate.vignette import solve
    from chromeball.calibrate.vignette_field import check_gradient, flat_samples

    angles = None
    if turns is not None:
        angles = [math.radians(v) for v in _numbers(turns, len(images))]
        if len(images) < 2:
            raise UserError("--turns is for two pictures or more")
        if max(angles) - min(angles) < math.radians(45):
            raise UserError("--turns: the camera must be turned by 45 degrees or more")
    others = [path for path in (camera, response) if path is not None]
    check_output(output, [*images, *others], ".json")
    with Stage("calibrate vignette flat", [*images, *others], turns=turns) as stage:
        aperture = _aperture(images)
        pictures = list(_pictures(images, response))
        size = pictures[0].radiance.shape[1], pictures[0].radiance.shape[0]
        field = flat_samples(pictures, angles)
        centre = _principal(camera, size)
        if field.edge is not None and centre is None:
            inside = field.edge.radius < math.hypot(*size) / 2
            centre = field.edge.centre if inside else None
        middle = centre or ((size[0] - 1) / 2, (size[1] - 1) / 2)
        if len(pictures) == 1:
            gradient = check_gradient(field.samples, size, np.array(middle))
            stage.figures["field_gradient"] = gradient
            say(
                "note: one picture: the field is taken to be even; turned pictures with "
                "--turns would tell"
            )
        radius = None
        if field.edge is not None and field.edge.radius < math.hypot(*size) / 2:
            radius = field.edge.radius
        solved = solve(
            field.samples,
            size,
            source="flat",
            centre=centre,
            radius=radius,
            edge=field.edge,
            with_map=smooth,
        )
        stage.figures |= {
            "blocks": len(field.samples.log),
            "hard_edge": None
            if field.edge is None
            else {
                "centre": field.edge.centre,
                "radius": field.edge.radius,
                "rms": field.edge_rms,
            },
            "hard_edge_share": field.edge_share,
            "beyond_edge_share": field.dark,
            "field_light": solved.shared,
        }
        _write(stage, output, solved, aperture, field.samples.pixels)
        if field.edge is not None:
            x, y = field.edge.centre
            say(
                f"a hard edge (mechanical vignetting or the image circle) in "
                f"{field.edge_share:.0%} of the directions: radius {field.edge.radius:.0f} px "
                f"about {x:.0f}, {y:.0f}"
            )
    told(stage, output, solved.vignette, solved.scatter, json)


app.command(overlap)


def _numbers(text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise UserError(f"--turns {text!r}: degrees with commas between") from error
    if len(values) != count or not all(map(math.isfinite, values)):
        raise UserError(f"--turns {text!r}: {count} angles are needed, one a picture")
    return values


def _aperture(images: Sequence[Path]) -> float | None:
    from chromeball.calibrate.vignette_data import apertures_agree
    from chromeball.scene.image import read_exposure

    return apertures_agree([read_exposure(path).aperture for path in images])


def _principal(camera: Path | None, size: tuple[int, int]) -> tuple[float, float] | None:
    """Pixel of the lens's axis."""
    if camera is None:
        return None
    import numpy as np

    from chromeball.scene.camera import CameraModel

    model = CameraModel.read(camera)
    if model.size != size:
        raise UserError(
            "the camera is for pictures of {}x{}, these are {}x{}".format(*model.size, *size),
            file=camera,
        )
    x, y = (float(v) for v in model.project(np.array([0.0, 0.0, 1.0])))
    return x, y


def _pictures(files: Sequence[Path], response: Path | None) -> Iterator[Picture]:
    """Grey radiance of each file, one at a time."""
    import numpy as np

    from chromeball.calibrate.vignette_data import Picture
    from chromeball.envmap.stitch.frames import read_frame
    from chromeball.scene.vignette import check_once

    curve: Response | None = None
    if response is not None:
        from chromeball.hdr.response_file import read_response

        curve = read_response(response)
    assumed = False
    for file in files:
        frame = read_frame(file, curve)
        if curve is not None and frame.source == "radiance":
            raise UserError("linear pictures need no response: leave it out", file=response)
        check_once(frame.attributes, file)
        if frame.assumed and not assumed:
            assumed = True
            say(
                "note: the codes are taken to be sRGB; a camera's own curve changes the "
                "fall-off: --response, or RAW, is surer"
            )
        bad = np.zeros(frame.radiance.shape[:2], bool)
        for mask in (frame.clipped, None if frame.valid is None else ~frame.valid):
            bad |= False if mask is None else mask
        # green twice, as sensors have it
        grey = frame.radiance @ np.array([0.25, 0.5, 0.25], np.float32)
        yield Picture(file.name, grey, bad)


def _write(
    stage: Stage, output: Path, solved: Solved, aperture: float | None, pixels: Any
) -> None:
    """The file, its plot and its figures."""
    from chromeball.calibrate.vignette_plots import plot_vignette

    found = solved.vignette
    plot = output.with_name(f"{output.stem}.plot.png")
    stage.figures |= {
        **figures_of(found),
        "scatter": solved.scatter,
        "outliers": solved.outliers,
        "inflation": solved.inflation,
        "condition": solved.condition,
        "map": found.map is not None,
        "map_asked": solved.map_chi_square,
        "plot": plot.name,
    }
    with atomic_output(plot) as temporary:
        plot_vignette(found, temporary, pixels, solved.residuals)
    full = replace(found, aperture=aperture, record=dict(stage.figures))
    with stage.output(output) as temporary:
        temporary.write_bytes(full.encode())
