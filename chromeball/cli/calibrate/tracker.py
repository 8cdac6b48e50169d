"""``chromeball calibrate tracker``: where a camera sits on a tracker's sensor."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from chromeball.cli.calibrate.arguments import Cache, Json, Out, print_figures, say
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, atomic_output


def tracker(
    images: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    camera: Path,
    target: str,
    log: Path,
    output: Out,
    times: Path | None = None,
    delay: Annotated[float | None, Parameter(allow_leading_hyphen=True)] = None,
    position_noise: float | None = None,
    rotation_noise: float | None = None,
    window: float | None = None,
    search: float = 0.5,
    cache: Cache = True,
    json: Json = False,
) -> None:
    """Find how a tracker's sensor sits on a camera, where a board is, and the tracker's delay.

    The board stays where it is; the camera moves, and turns about two axes or more.

    Parameters
    ----------
    images
        Photographs of the target by the camera on the sensor.
    camera
        The lens, a .cameramodel.
    target
        The board, as for `calibrate lens`.
    log
        The tracker's samples, .csv or .json: t (seconds) or file (the picture), x, y, z
        (metres; x_cm, x_mm, x_in) and qw, qx, qy, qz or azimuth, elevation, roll (degrees).
    times
        When the pictures were taken: a .csv with file and t, or a take; for a log with t.
    delay
        Log time minus picture time in seconds where it is known; else it is estimated.
    position_noise
        The tracker's standard deviation an axis, metres; else it is estimated.
    rotation_noise
        The same of its turns, degrees.
    window
        Smooth the log over so many seconds, 0 for none; else over eight samples.
    search
        The delay lies within so many seconds of zero.
    output
        The tracker.json to write.
    cache
        Keep detections, and do not search pictures again that were searched before.
    json
        Print the figures as JSON.

    """
    import numpy as np

    from chromeball.calibrate.formats import read_camera
    from chromeball.calibrate.target import parse_target
    from chromeball.calibrate.tracker import solve_tracker
    from chromeball.calibrate.tracker_file import figures, write_tracker
    from chromeball.calibrate.tracker_log import read_log, read_times
    from chromeball.calibrate.tracker_plot import plot_differences
    from chromeball.cli.calibrate.detecting import detect_told

    for name, value in (
        ("--position-noise", position_noise),
        ("--rotation-noise", rotation_noise),
        ("--search", search),
    ):
        if value is not None and not 0 < value < 1e3:
            raise UserError(f"{name} {value:g}: it is positive")
    if delay is not None and not abs(delay) < 1e3:
        raise UserError(f"--delay {delay:g}: log time minus picture time, in seconds")
    if window is not None and not 0 <= window < 1e3:
        raise UserError(f"--window {window:g}: seconds, or 0 for none")
    if output.suffix != ".json":
        raise UserError("a calibrated tracker's name ends in .json", file=output)
    board, lens, samples = parse_target(target), read_camera(camera), read_log(log)
    clock = None
    if samples.times is not None:
        if times is None:
            raise UserError(
                "has times: say with --times when the pictures were taken", file=log
            )
        clock = read_times(times, images)
    else:
        for name, given in (("times", times), ("delay", delay)):
            if given is not None:
                raise UserError(
                    f"its poses belong to pictures: --{name} says nothing", file=log
                )
        at = {Path(f).name: k for k, f in enumerate(samples.files or ())}
        if missing := [f for f in images if f.name not in at]:
            raise UserError(f"says nothing of {missing[0].name}", file=log)
        k = [at[f.name] for f in images]
        samples = replace(
            samples,
            positions=samples.positions[k],
            rotations=samples.rotations[k],
            files=tuple(map(str, k)),
            angles=None if samples.angles is None else samples.angles[k],
        )
    inputs = [*images, camera, log, *([times] if times else [])]
    options = {
        "target": target, "delay": delay, "position_noise": position_noise,
        "rotation_noise": rotation_noise, "window": window, "search": search,
    }  # fmt: skip
    with Stage("calibrate tracker", inputs, **options) as stage:
        detections = detect_told(images, board, cache)
        if detections[0].size != lens.size:
            raise UserError(
                "it is for pictures of {}x{}, these are {}x{}".format(
                    *lens.size, *detections[0].size
                ),
                file=camera,
            )
        corners = np.array([d.corners for d in detections])
        corners[[not d.usable for d in detections]] = np.nan
        found = solve_tracker(
            lens,
            board.points().reshape(-1, 3),
            corners.reshape(len(corners), -1, 2),
            samples,
            clock,
            delay=delay,
            position_noise=position_noise,
            rotation_noise=None if rotation_noise is None else math.radians(rotation_noise),
            window=window,
            search=search,
            tell=say,
        )
        stage.figures.update(figures(found, images))
        plot = output.with_name(f"{output.stem}.differences.png")
        with atomic_output(plot) as temporary:
            plot_differences(found, images, temporary)
        stage.figures["plots"] = {"differences": plot.name}
        with stage.output(output) as temporary:
            write_tracker(temporary, found)
    if json:
        print_figures(stage.figures)
        return
    for file, used, turn, place in zip(
        images, found.used, found.turn_errors, found.place_errors, strict=True
    ):
        if not used and not math.isnan(turn):
            off = f"{math.degrees(turn):.1f} degrees and {place * 1e3:.0f} mm"
            say(f"{file}: the tracker is {off} off; it counts for nothing")
    x, y, z = found.sensor_from_camera.translation * 1e3
    errors = found.standard_errors
    print(f"{output}: {int(found.used.sum())} of {len(images)} pictures")
    print(
        f"camera on the sensor at {x:.1f}, {y:.1f}, {z:.1f} mm, standard errors "
        + ", ".join(f"{v * 1e3:.1f}" for v in errors[3:6])
        + " mm and "
        + ", ".join(f"{math.degrees(v):.2f}" for v in errors[:3])
        + " degrees"
    )
    if samples.times is not None:
        told = f"+- {errors[12] * 1e3:.1f} ms" if found.delay_estimated else "ms, as given"
        print(f"log time minus picture time {found.delay * 1e3:.1f} {told}")
    print(
        f"tracker noise {found.noise.position * 1e3:.1f} mm and "
        f"{math.degrees(found.noise.rotation):.2f} degrees an axis, corners "
        f"{found.noise.pixel:.2f} px; the tracker's metre is {found.scale:.3f} +- "
        f"{found.sigma_scale:.3f} of the board's"
    )
