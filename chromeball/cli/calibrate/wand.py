"""``chromeball calibrate wand``: cameras of a room from a moving light."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output, check_output

if TYPE_CHECKING:
    from chromeball.calibrate.wand_result import Tracks, WandRig
    from chromeball.scene.camera import CameraModel

type Several = Annotated[list[Path] | None, Parameter(negative="", consume_multiple=True)]


def wand(
    *,
    points: Path,
    output: Out,
    lens: Several = None,
    model: Literal["pinhole", "opencv4", "kb4"] = "opencv4",
    refine: Annotated[bool, Parameter(negative="")] = False,
    distance: str | None = None,
    centres: Path | None = None,
    up: Literal["camera"] | None = None,
    floor: str | None = None,
    synchronous: Annotated[bool, Parameter(negative="")] = False,
    json: Json = False,
) -> None:
    """Place the cameras of a room, and calibrate their lenses, by a light that they saw move.

    Scale comes from a distance or from known centres; without both the unit is the distance of
    the first two cameras. The axes are those of the first camera unless --up, --floor or
    --centres tells others.

    Parameters
    ----------
    points
        A folder of MultiCamSelfCal's: points.dat, IdMat.dat, Res.dat, camera_order.txt.
    output
        The folder to write: NAME.cameramodel for each camera and rig.json.
    lens
        The cameras' lenses in their order, .cameramodel or .rad; one lens stands for all.
        Without it the lenses are estimated, too.
    model
        What the lenses are when they are estimated.
    refine
        Estimate the given lenses, too, from where they are.
    distance
        Distance of two cameras in metres: "NAME,NAME,2.5".
    centres
        Where the cameras stand: a file with a line of x y z each, three cameras or more.
    up
        camera: the first camera stood level at the origin, looking along -z.
    floor
        Three frames in which the light lay on the floor: "12,80,150". The first is the origin,
        the second on +x.
    synchronous
        The cameras are known to be; else a constant delay of each is looked for.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.wand import solve_wand
    from chromeball.calibrate.wand_files import read_centres, read_points, write_rig
    from chromeball.calibrate.wand_plot import plot_wand
    from chromeball.calibrate.wand_world import as_surveyed

    if sum(choice is not None for choice in (up, floor, centres)) > 1:
        raise UserError("--up, --floor and --centres each give the axes: choose one")
    if distance is not None and centres is not None:
        raise UserError("--distance and --centres each give the scale: choose one")
    if refine and not lens:
        raise UserError("--refine refines lenses that are given: name them with --lens")
    check_output(output / "rig.json")
    files = [points / name for name in ("points.dat", "IdMat.dat", "Res.dat")]
    options = {"model": model, "refine": refine, "distance": distance, "up": up, "floor": floor}
    extra = [*(lens or ()), *([centres] if centres else ())]
    with Stage("calibrate wand", [*files, *extra], **options) as stage:
        tracks = read_points(points)
        rig = solve_wand(
            tracks,
            _lenses(lens, tracks),
            model=model,
            refine=refine,
            distance=_distance(distance, tracks),
            synchronous=synchronous,
        )
        if centres is not None:
            rig, left = as_surveyed(rig, read_centres(centres, len(tracks.names)))
            stage.figures["centres_rms"] = left
        rig = _placed(rig, up, floor)
        stage.figures.update(rig.figures())
        with atomic_output(output / "rig.png") as temporary:
            plot_wand(rig, temporary)
        stage.figures["plots"] = {"rig": "rig.png"}
        write_rig(stage, output, rig)
    for line in _advice(rig):
        say(line)
    if json:
        print_figures(stage.figures)
        return
    print(
        f"{output}: {len(rig.names)} cameras, RMS {rig.rms:.3f} px per light, "
        f"{int(rig.outliers.sum())} sightings rejected"
    )
    metres = rig.unit == "m"
    factor, unit = (1000.0, "mm") if metres else (1.0, "units")
    for c, name in enumerate(rig.names):
        x, y, z = rig.centres[c]
        errors = ", ".join(f"{v * factor:.2g}" for v in rig.sigma_position[c])
        line = f"  {name}: at {x:.4f}, {y:.4f}, {z:.4f} +- {errors} {unit}"
        if rig.delays.any():
            line += f"; {rig.delays[c]:+.3f} +- {rig.delay_errors[c]:.2g} frames late"
        print(line)
    print(f"{rig.gauge()}; lengths in {'metres' if metres else f'the {rig.unit}'}")


def _lenses(paths: list[Path] | None, tracks: Tracks) -> tuple[CameraModel, ...] | None:
    from chromeball.calibrate.wand_files import read_lens

    if not paths:
        return None
    count = len(tracks.sizes)
    if len(paths) not in (1, count):
        raise UserError(f"{count} cameras need a lens each or one for all, not {len(paths)}")
    every = paths * count if len(paths) == 1 else paths
    return tuple(read_lens(p, size) for p, size in zip(every, tracks.sizes, strict=True))


def _distance(text: str | None, tracks: Tracks) -> tuple[int, int, float] | None:
    if text is None:
        return None
    first, _, rest = text.partition(",")
    second, _, number = rest.rpartition(",")
    try:
        metres = float(number)
    except ValueError:
        metres = 0.0
    if first == second or not {first, second} <= set(tracks.names) or not 0 < metres < 1e6:
        raise UserError(
            f"--distance {text!r}: write two of {', '.join(tracks.names)} and metres, "
            f'"{tracks.names[0]},{tracks.names[-1]},2.5"'
        )
    return tracks.names.index(first), tracks.names.index(second), metres


def _placed(rig: WandRig, up: str | None, floor: str | None) -> WandRig:
    from chromeball.calibrate.wand_world import on_floor, upright

    if up is not None:
        return upright(rig)
    if floor is None:
        return rig
    try:
        one, two, three = (int(word) for word in floor.split(","))
    except ValueError as error:
        raise UserError(f'--floor {floor!r}: write three frames, "12,80,150"') from error
    return on_floor(rig, (one, two, three))


def _advice(rig: WandRig) -> list[str]:
    """What to do next, if anything."""
    lines: list[str] = []
    if rig.unit != "m":
        lines.append(
            "nothing tells the scale: give --distance or --centres, or record a wand of two "
            "lights of known length"
        )
    if rig.delays.any():
        lines.append(
            "the cameras are not synchronous; their delays are estimated. Bring rig.json's "
            "delays to whatever uses them together"
        )
    return lines
