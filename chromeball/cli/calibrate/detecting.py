"""Detection as the commands do it: on all cores, told as it goes, kept for the next time."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from chromeball.calibrate.detect import larger_board
from chromeball.calibrate.detect_cache import default_folder
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.search import detect_files
from chromeball.calibrate.target import Target
from chromeball.cli.calibrate.arguments import say


def detect_told(images: Sequence[Path], target: Target, cache: bool) -> list[Detection]:
    """Detections in pictures, on all cores, told one by one and on a terminal by a bar."""
    with Progress(
        console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()
    ) as bar:
        row = bar.add_task("detect", total=len(images))

        def tell(detection: Detection) -> None:
            say(f"{detection.file}: {detection.verdict}")
            bar.advance(row)

        detections = detect_files(
            images,
            target,
            tell,
            workers=cores(),
            cache=kept_in() if cache else None,
        )
    if larger := larger_board([d.file for d in detections if d.usable], target):
        say(f"{larger}; the part that was named is used")
    return detections


def cores() -> int:
    """Processes that may run at once."""
    return os.process_cpu_count() or 1


def kept_in() -> Path | None:
    """The folder that keeps detections; None, told, where it cannot be written."""
    folder = default_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
        reason = "it is read-only"
    except OSError as error:
        reason = str(error.strerror)
    say(f"detections are not kept: {folder}: {reason}")
    return None
