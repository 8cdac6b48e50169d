"""``chromeball calibrate wand``: cameras of a room from a moving light."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Json, Out, print_figures, say, store_rig
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output, check_output

if TYPE_CHECKING:
    from chromeball.calibrate.wand_result import Tracks, WandRig
    from chromeball.calibrate.wand_world import Survey
    from chromeball.scene.camera import CameraModel

type Several = Annotated[list[Path] | None, Parameter(negative="", consume_multiple=True)]


def wand(
    sources: Annotated[list[Path] | None, Parameter(negative="")] = None,
    /,
    *,
    output: Out,
    points: Path | None = None,
    wand: str | None = None,
    lights: int | None = None,
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

    Scale comes from the wand's length, a distance or known centres; without these the unit is
    the distance of the first two cameras. The axes are those of the first camera unless --up,
    --floor or --centres tells others.

    Parameters
    ----------
    sources
        For each camera a video, or a folder of pictures in the order of their names; the
        camera is called as its file or folder is.
    points
        Instead of these a folder of MultiCamSelfCal's: points.dat, IdMat.dat, Res.dat,
        camera_order.txt.
    wand
        Distance of the two lights of a wand in metres, 0.5, or of three in a line from one to
        the next, "0.2,0.3". All lights must be seen for a frame to count.
    lights
        Number of lights, if the wand's length is unknown; 1 by default.
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
    from chromeball.calibrate.rig_file import rig_of_wand
    from chromeball.calibrate.wand import solve_wand
    from chromeball.calibrate.wand_files import read_centres, read_points
    from chromeball.calibrate.wand_plot import plot_wand
    from chromeball.calibrate.wand_world import as_surveyed

    if sum(choice is not None for choice in (up, floor, centres)) > 1:
        raise UserError("--up, --floor and --centres each give the axes: choose one")
    if sum(choice is not None for choice in (wand, distance, centres)) > 1:
        raise UserError("--wand, --distance and --centres each give the scale: choose one")
    if (points is None) == (not sources):
        raise UserError("name a video or folder for each camera, or --points DIR")
    lengths = _lengths(wand)
    count = _lights(lights, wand, points)
    if refine and not lens:
        raise UserError("--refine refines lenses that are given: name them with --lens")
    check_output(output / "rig.json")
    options = {
        "model": model,
        "refine": refine,
        "wand": wand,
        "lights": count,
        "distance": distance,
        "up": up,
        "floor": floor,
        "synchronous": synchronous,
    }
    extra = [*(lens or ()), *([centres] if centres else ())]
    with Stage("calibrate wand", [*_files(sources, points), *extra], **options) as stage:
        rate, survey = None, None
        if points is not None:
            tracks = read_points(points)
        else:
            tracks, rate, stage.figures["tracks"] = _followed(sources or [], count)
        rig = solve_wand(
            tracks,
            _lenses(lens, tracks),
            model=model,
            refine=refine,
            lengths=lengths,
            distance=_distance(distance, tracks),
            synchronous=synchronous,
        )
        if centres is not None:
            rig, survey = as_surveyed(rig, read_centres(centres, len(tracks.names)))
            stage.figures["centres"] = {
                "rms": survey.rms, "misses": dict(zip(rig.names, survey.misses, strict=True))
            }  # fmt: skip
        rig = _placed(rig, up, floor)
        stage.figures.update(rig.figures())
        with atomic_output(output / "rig.png") as temporary:
            plot_wand(rig, temporary)
        stage.figures["plots"] = {"rig": "rig.png"}
        store_rig(stage, output, rig_of_wand(rig, rate))
    for line in _advice(rig, survey):
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
        if not rig.synchronous:
            line += f"; {rig.delays[c]:+.3f} +- {rig.delay_errors[c]:.2g} frames late"
            line += f" ({1000 * rig.delays[c] / rate:+.1f} ms)" if rate else ""
        print(line)
    if survey is not None:
        worst = int(survey.misses.argmax())
        print(
            f"from the centres given: {1000 * survey.rms:.2g} mm (RMS), most "
            f"{rig.names[worst]}: {1000 * survey.misses[worst]:.2g} mm"
        )
    print(f"{rig.gauge()}; lengths in {'metres' if metres else f'the {rig.unit}'}")


def _lengths(text: str | None) -> tuple[tuple[int, int, float], ...]:
    """Distances of all pairs of lights from those of one to the next."""
    if text is None:
        return ()
    try:
        steps = [float(word) for word in text.split(",")]
    except ValueError:
        steps = []
    if not 1 <= len(steps) <= 2 or not all(0 < step < 1e3 for step in steps):
        raise UserError(
            f"--wand {text!r}: write the distance of two lights in metres, 0.5, or of three "
            'from one to the next, "0.2,0.3"'
        )
    pairs = [(i, i + 1, step) for i, step in enumerate(steps)]
    return (*pairs, (0, 2, sum(steps))) if len(steps) == 2 else tuple(pairs)


def _lights(lights: int | None, wand: str | None, points: Path | None) -> int:
    count = 1 if wand is None else wand.count(",") + 2
    if points is not None and (wand is not None or lights is not None):
        raise UserError("--points hold one light: --wand and --lights are for recordings")
    if lights is None:
        return count
    if not 1 <= lights <= 3 or (wand is not None and lights != count):
        raise UserError("--lights: a wand has one to three lights, as many as --wand says")
    return lights


def _files(sources: list[Path] | None, points: Path | None) -> list[Path]:
    """What the rig is made of."""
    from chromeball.calibrate.led_frames import open_recording

    if points is not None:
        return [points / name for name in ("points.dat", "IdMat.dat", "Res.dat")]
    return [file for source in sources or [] for file in open_recording(source).files]


def _followed(
    sources: list[Path], lights: int
) -> tuple[Tracks, float | None, dict[str, object]]:
    """The tracks of all recordings, their frames a second, and figures of each."""
    from concurrent.futures import ThreadPoolExecutor

    from chromeball.calibrate.led import LightTrack, together, track_lights

    def one(source: Path) -> LightTrack:
        track = track_lights(source, lights)
        say(f"{source}: {track.verdict()}")
        return track

    with ThreadPoolExecutor() as pool:
        found = list(pool.map(one, sources))
    figures: dict[str, object] = {
        t.name: {
            "frames": len(t.pixels),
            "frames_without": t.none,
            "frames_ambiguous": t.several,
            "frames_flooded": t.flooded,
        }
        for t in found
    }
    return together(found), found[0].rate, figures


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


def _advice(rig: WandRig, survey: Survey | None) -> list[str]:
    """What to do next, if anything."""
    import numpy as np

    lines: list[str] = []
    if rig.unit != "m":
        lines.append(
            "nothing tells the scale: give --distance or --centres, or record two lights on a "
            "wand and give its length with --wand"
        )
    if survey is not None and survey.doubtful is not None:
        name, miss = rig.names[survey.doubtful], survey.misses[survey.doubtful]
        lines.append(
            f"{name} stands {1000 * miss:.2g} mm from its centre, without it the others fit "
            "far better: check its line of --centres"
        )
    if not rig.synchronous:
        most = float(np.abs(rig.delays).max())
        lines.append(
            f"the cameras are not synchronous, by up to {most:.3g} frames; the delays are "
            "estimated. Bring rig.json's delays to whatever uses them together"
        )
    return lines
