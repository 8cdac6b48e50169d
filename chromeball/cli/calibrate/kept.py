"""A camera that is kept: checked on new pictures of the board instead of solved again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chromeball.calibrate.detection import Detection
from chromeball.calibrate.reuse import check_reuse, taken_with
from chromeball.calibrate.target import Target
from chromeball.cli.calibrate.arguments import say
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage, read_json, record_path


def keep_camera(
    stage: Stage, detections: Sequence[Detection], board: Target, reuse: Path, output: Path
) -> bool:
    """Whether `reuse` still is the camera of the pictures; then it is written to `output`.

    Raises
    ------
    UserError
        When it, or its record, cannot be read.

    """
    camera = CameraModel.read(reuse)
    record: Any = read_json(record_path(reuse))
    if not isinstance(record, dict) or record.get("stage") != "calibrate lens":
        raise UserError("not the record of a calibrated lens", file=record_path(reuse))
    figures: dict[str, Any] = record["figures"]
    used = [d for d in detections if d.usable]
    check = check_reuse(
        camera,
        figures,
        board,
        np.array([d.corners for d in used]),
        used[0].size,
        taken_with([str(d.file) for d in used]),
        same_board=record["options"].get("target") == stage.options["target"],
    )
    if not check.kept:
        say(f"{reuse} is not kept: {check.reason}")
        stage.figures |= {"not_kept": check.reason, "check": check.figures}
        return False
    # What the camera was solved from stays with it, so that it can be checked once more.
    stage.figures = {
        "verdict": f"{reuse} is kept: {check.reason}",
        **{k: v for k, v in figures.items() if k not in ("verdict", "plots", "check")},
        "kept_from": str(reuse),
        "check": check.figures,
    }
    with stage.output(output) as temporary:
        temporary.write_bytes(reuse.read_bytes())
    return True
