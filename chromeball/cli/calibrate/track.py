"""``chromeball calibrate track``: where a camera on a calibrated tracker was."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np

from chromeball.cli.calibrate.arguments import Json, Out, print_figures
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import Stage, write_json

#: The world in which the calibration's board lies on the floor, its lower edge towards +z, or
#: hangs upright and faces +z; the origin is its first corner.
WORLDS = {
    "floor": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "wall": np.diag([1.0, -1, -1]),
}


def track(
    tracker: Path,
    /,
    *,
    log: Path,
    times: Path,
    output: Out,
    world: Literal["tracker", "floor", "wall"] = "tracker",
    window: float = 0.0,
    json: Json = False,
) -> None:
    """Say where the camera was in each picture, by a calibrated tracker, its delay taken off.

    `envmap stitch --directions` takes the result.

    Parameters
    ----------
    tracker
        tracker.json of `calibrate tracker`.
    log
        The tracker's samples of these pictures, .csv or .json.
    times
        When they were taken: a .csv with file and t, or a take.
    world
        The tracker's own axes, or those of the board that it was calibrated with: lying on the
        floor or hanging upright, not moved since.
    window
        Smooth the log over so many seconds.
    output
        The .json to write: file, world_from_camera (4 x 4, metres) and sigma_degrees.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.tracker_file import camera_poses, read_tracker
    from chromeball.calibrate.tracker_log import all_times, read_log

    if output.suffix != ".json":
        raise UserError("directions are written as .json", file=output)
    if not 0 <= window < 1e3:
        raise UserError(f"--window {window:g}: seconds, or 0 for none")
    known, samples, when = read_tracker(tracker), read_log(log), all_times(times)
    there = Pose.identity()
    if world != "tracker":
        there = Pose(WORLDS[world], np.zeros(3)) @ known.tracker_from_board.pose().inverse()
    options = {"world": world, "window": window}
    with Stage("calibrate track", [tracker, log, times], **options) as stage:
        clock = np.array(list(when.values()))
        poses, sigma = camera_poses(known, samples, clock, window)
        worst = math.degrees(float(sigma.max()))
        frames = [
            {"file": name, "t": t, "world_from_camera": (there @ pose).matrix()}
            for (name, t), pose in zip(when.items(), poses, strict=True)
        ]
        stage.figures.update(
            {
                "pictures": len(frames),
                "sigma_degrees": worst,
                "delay_ms": known.delay * 1e3,
                "world": world,
            }
        )
        with stage.output(output) as temporary:
            write_json(temporary, {"sigma_degrees": worst, "frames": frames})
    if json:
        print_figures(stage.figures)
        return
    print(f"{output}: {len(frames)} pictures, each to {worst:.2f} degrees an axis or better")
