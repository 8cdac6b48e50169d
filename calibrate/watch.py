"""Pictures as they arrive in a folder, whole ones only, and the verdict after each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.detect import grey, judge
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.lens import FEWEST_VIEWS, calibrate_lens
from chromeball.calibrate.lit import brightest, lit_places
from chromeball.calibrate.printed import Printed
from chromeball.calibrate.solve import fit_start
from chromeball.calibrate.target import Target
from chromeball.calibrate.verdict import Verdict, judge_lens
from chromeball.calibrate.views import repeated_views
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image

PICTURES = frozenset(
    (
        *(".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".exr", ".dng"),
        *(".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf"),
    )
)
#: Seconds between two looks; a file that did not change between them is read.
PAUSE = 0.5
#: One that cannot be read is left out when it has stood still for so many seconds.
PATIENCE = 10.0


@dataclass(frozen=True)
class Progress:
    """What is known after one more picture: its ``detection``; how many ``views`` count.

    ``verdict`` on the lens so far, or None and a ``reason`` why there is none yet.
    """

    detection: Detection
    views: int
    verdict: Verdict | None
    reason: str


def arriving(
    folder: Path, *, pause: float = PAUSE, patience: float = PATIENCE
) -> Iterator[tuple[Path, UserError | None]]:
    """Pictures in `folder`, once each, whole; without end. Hidden files do not count.

    A file is whole when its size and time stood still for `pause` seconds and it can be read.
    One that still cannot after `patience` seconds comes with the error; when it changes it is
    looked at again.
    """
    done: dict[Path, tuple[int, int]] = {}
    seen: dict[Path, tuple[tuple[int, int], float]] = {}
    while True:
        for path in sorted(folder.iterdir()):
            if path.suffix.lower() not in PICTURES or path.name.startswith("."):
                continue
            try:
                state = path.stat()
            except FileNotFoundError:  # renamed or removed since
                continue
            mark = (state.st_size, state.st_mtime_ns)
            if done.get(path) == mark:
                continue
            known, since = seen.get(path, (None, 0.0))
            if known != mark:
                seen[path] = (mark, time.monotonic())
                continue
            try:
                read_image(path)
            except UserError as error:
                if time.monotonic() - since > patience:
                    done[path] = mark
                    yield path, error
                continue
            done[path] = mark
            yield path, None
        time.sleep(pause)


def watch_lens(
    folder: Path,
    target: Target,
    model: str,
    tell: Callable[[Progress], object],
    *,
    enough: int | None = None,
    pause: float = PAUSE,
    patience: float = PATIENCE,
) -> list[Detection]:
    """Look at pictures as they arrive in `folder` and `tell` what each of them brings.

    Returns the detections when `enough` views count, when the verdict is good, or on Ctrl-C.
    The lens is solved for with `model`, one of :data:`chromeball.calibrate.lens.MODELS` without
    ``auto``; the pictures' size is that of the first.

    Raises
    ------
    UserError
        When the folder is missing.

    """
    if not folder.is_dir():
        raise UserError("no such folder to watch", file=folder)
    detections: dict[Path, Detection] = {}
    codes = None
    try:
        for path, error in arriving(folder, pause=pause, patience=patience):
            if error is not None:
                empty = np.full((target.rows, target.columns, 2), np.nan)
                failed = Detection(
                    file=path,
                    size=(0, 0),
                    corners=empty,
                    sigma=empty[..., 0],
                    blur=float("nan"),
                    usable=False,
                    verdict=error.what,
                    printed=Printed(target, False),
                )
                tell(Progress(failed, len(_counting(detections)), None, "not a picture"))
                continue
            picture = grey(read_image(path))
            detection = judge(path, picture, target)
            first = next(iter(detections.values()), detection)
            if detection.size != first.size:
                wrong = "{}x{}, not {}x{}: left out".format(*detection.size, *first.size)
                failed = replace(detection, usable=False, verdict=wrong)
                tell(Progress(failed, len(_counting(detections)), None, "another size"))
                continue
            detections[path] = detection
            codes = brightest(picture, _shape(first.size), codes)
            views = _counting(detections)
            verdict, reason = _so_far(views, target, model, codes)
            tell(Progress(detection, len(views), verdict, reason))
            if enough is not None and len(views) >= enough:
                break
            if verdict is not None and verdict.good:
                break
    except KeyboardInterrupt:
        pass
    return list(detections.values())


def _counting(detections: dict[Path, Detection]) -> list[Detection]:
    """Views that may be solved from."""
    usable = [d for d in detections.values() if d.usable]
    if not usable:
        return []
    repeats = repeated_views(np.array([d.corners for d in usable]), usable[0].size)
    return [d for d, first in zip(usable, repeats, strict=True) if first < 0]


def _so_far(
    views: list[Detection], target: Target, model: str, codes: NDArray[np.uint8]
) -> tuple[Verdict | None, str]:
    if len(views) < FEWEST_VIEWS:
        return None, f"a lens needs {FEWEST_VIEWS} views"
    corners, size = np.array([d.corners for d in views]), views[0].size
    try:
        lens = calibrate_lens(
            corners, target, size, model, start=fit_start(corners, target, size)
        )
        verdict = judge_lens(
            lens,
            target,
            lit=lit_places(codes),
            files=[str(d.file) for d in views],
            blur=float(np.nanmedian([d.blur for d in views])),
        )
    except UserError as error:
        return None, error.what
    return verdict, ""


def _shape(size: tuple[int, int], columns: int = 18) -> tuple[int, int]:
    """Of the places that a verdict judges."""
    return max(2, round(columns * size[1] / size[0])), columns
