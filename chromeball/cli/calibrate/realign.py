"""``chromeball calibrate realign``: the virtual scene turned onto the real one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.cli.calibrate.clicks import read_pairs
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage


def realign(
    camera: Path,
    /,
    *,
    pairs: Path,
    output: Out,
    sigma: float = 0.5,
    keep_place: bool = False,
    json: Json = False,
) -> None:
    """Turn a scene that lies a little off onto the photograph, by pairs of points.

    One pair turns the camera, two turn it fully, three and more move it, too. The model's scale
    cannot be told from a single picture.

    Parameters
    ----------
    camera
        The posed .cameramodel as it is.
    pairs
        A CSV x,y,z,u,v: points of the model in metres, and the pixels where they ought to be.
    output
        The .cameramodel to write, posed anew.
    sigma
        Standard deviation of a click in pixels, for the standard errors and for wrong pairs.
    keep_place
        Turn only, however many pairs there are.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.formats import read_camera
    from chromeball.calibrate.realign import realign as solve
    from chromeball.calibrate.wrong_click import SOUND

    if output.suffix != ".cameramodel":
        raise UserError("a camera model's name ends in .cameramodel", file=output)
    if not 0 < sigma < 1e3:
        raise UserError(f"--sigma {sigma:g}: a click's error in pixels is positive")
    before = read_camera(camera)
    points, pixels = read_pairs(pairs)
    with Stage(
        "calibrate realign", [camera, pairs], sigma=sigma, keep_place=keep_place
    ) as stage:
        found = solve(before, points, pixels, sigma=sigma, keep_place=keep_place)
        moved = (
            found.camera.world_from_camera.translation - before.world_from_camera.translation
        )
        errors = np.sqrt(np.diag(found.covariance))
        stage.figures.update(
            {
                "pairs": len(points),
                "freedom": found.freedom,
                "before_px": found.before,
                "after_px": found.after,
                "misfit": found.misfit,
                "wrong_pairs": [click.index + 1 for click in found.wrong],
                "turn_degrees": math.degrees(found.turn),
                "moved_metres": float(np.linalg.norm(moved)),
                "sigma_rotation_degrees": np.degrees(errors[:3]),
                "sigma_position": errors[3:],
                "model_from_model": found.model_from_model.matrix(),
            }
        )
        with stage.output(output) as temporary:
            found.camera.write(temporary)
    for click in found.wrong:
        say(f"warning: {click.words('pair')}: correct or remove it")
    if found.misfit > SOUND and not found.wrong:
        say(
            f"warning: the pairs are {found.misfit:.1f} times as far off as --sigma says, pair "
            f"{int(np.argmax(found.after)) + 1} most: look for a wrong one, or give more pairs"
        )
    if json:
        print_figures(stage.figures)
        return
    rms = [math.sqrt(float((v**2).mean())) for v in (found.before, found.after)]
    print(
        f"{output}: turned by {math.degrees(found.turn):.3f} degrees, moved by "
        f"{np.linalg.norm(moved) * 1e3:.1f} mm; the pairs are {rms[1]:.2f} px off, were "
        f"{rms[0]:.2f}"
    )
