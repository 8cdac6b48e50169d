"""What the commands of ``chromeball calibrate`` share."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from chromeball.scene.record import to_json

type Out = Annotated[Path, Parameter(name=["-o", "--output"])]
type Json = Annotated[bool, Parameter(name="--json", negative="")]
type Cache = Annotated[bool, Parameter(name="--cache", negative="--no-cache")]


def say(message: str) -> None:
    """A line of progress or advice."""
    print(message, file=sys.stderr)


def print_figures(figures: dict[str, Any]) -> None:
    """Figures as JSON, for programs."""
    print(json.dumps(to_json(figures), indent=1))
