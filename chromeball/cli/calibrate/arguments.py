"""What the commands of ``chromeball calibrate`` share."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.scene.record import Stage, to_json

if TYPE_CHECKING:
    from chromeball.calibrate.rig_file import Rig

type Out = Annotated[Path, Parameter(name=["-o", "--output"])]
type Json = Annotated[bool, Parameter(name="--json", negative="")]
type Cache = Annotated[bool, Parameter(name="--cache", negative="--no-cache")]


def say(message: str) -> None:
    """A line of progress or advice."""
    print(message, file=sys.stderr)


def print_figures(figures: dict[str, Any]) -> None:
    """Figures as JSON, for programs."""
    print(json.dumps(to_json(figures), indent=1))


def store_rig(stage: Stage, folder: Path, rig: Rig) -> None:
    """``NAME.cameramodel`` for each camera, then ``rig.json``, which names them all."""
    from chromeball.calibrate.rig_file import write_rig

    for own in rig.cameras:
        with stage.output(folder / f"{own.name}.cameramodel") as temporary:
            own.camera.write(temporary)
    with stage.output(folder / "rig.json") as temporary:
        write_rig(temporary, rig)
