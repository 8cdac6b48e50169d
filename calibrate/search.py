"""A target looked for in many pictures: in several processes, kept for the next time."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate import detect_cache
from chromeball.calibrate.detect import counts_hint, grey, judge
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.target import Target
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image

#: Pictures for each further process that are worth its start.
WORTH = 4
#: Pictures that wait for each process.
AHEAD = 3


@dataclass(frozen=True)
class Frame:
    """Number ``index`` of a video's frames; ``picture`` (H, W) is grey."""

    video: Path
    index: int
    picture: NDArray[np.uint8]


def detect_files(
    files: Sequence[str | os.PathLike[str]],
    target: Target,
    progress: Callable[[Detection], object] | None = None,
    *,
    workers: int = 1,
    cache: Path | None = None,
) -> list[Detection]:
    """Look for `target` in every picture; `progress` hears of each, in their order.

    Up to `workers` processes share the pictures. Detections are kept in the folder `cache`, if
    it is given, and pictures known there are not searched again.

    Raises
    ------
    UserError
        When a picture cannot be read, the sizes differ, or no picture shows the board.

    """
    detections: list[Detection] = []
    pictures = [Path(f) for f in files]
    for detection in search(pictures, len(pictures), target, workers=workers, cache=cache):
        if detections and detection.size != detections[0].size:
            raise UserError(
                "this picture is {}x{}, {} is {}x{}: pictures of one lens have one size".format(
                    *detection.size, detections[0].file, *detections[0].size
                ),
                file=detection.file,
            )
        detections.append(detection)
        if progress is not None:
            progress(detection)
    if not any(detection.usable for detection in detections):
        names = (
            detections[0].file if len(detections) == 1 else f"any of {len(detections)} pictures"
        )
        raise UserError(
            f"the board {target.spec} was not seen in {names}: "
            f"{counts_hint(files, target)}, focus and light"
        )
    return detections


def search(
    pictures: Iterable[Path | Frame | Detection],
    count: int,
    target: Target,
    *,
    workers: int = 1,
    cache: Path | None = None,
) -> Iterator[Detection]:
    """What each of `count` pictures shows of the `target`, in their order.

    Up to `workers` processes share the pictures, of which few are held at a time. Detections
    are kept in the folder `cache`, if it is given; those already made pass through.
    """
    detect = partial(_detection, target=target, cache=cache)
    processes = min(workers, count // WORTH)
    if processes < 2:
        for picture in pictures:
            yield picture if isinstance(picture, Detection) else detect(picture)
        return
    # Not forked: what runs in threads here, as OpenCV and JAX do, would hang in the copy.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _one_thread) as pool:
        waiting: deque[Detection | Future[Detection]] = deque()
        try:
            for picture in pictures:
                if isinstance(picture, Detection):
                    waiting.append(picture)
                else:
                    waiting.append(pool.submit(detect, picture))
                if len(waiting) > AHEAD * processes:
                    yield _done(waiting.popleft())
            while waiting:
                yield _done(waiting.popleft())
        finally:
            pool.shutdown(cancel_futures=True)


def _done(waiting: Detection | Future[Detection]) -> Detection:
    return waiting if isinstance(waiting, Detection) else waiting.result()


def _one_thread() -> None:
    """Every process has a core to itself."""
    cv2.setNumThreads(1)


def _detection(picture: Path | Frame, target: Target, cache: Path | None) -> Detection:
    file, frame = (
        (picture.video, picture.index) if isinstance(picture, Frame) else (picture, None)
    )
    kept: Path | None = None
    if cache is not None and file.is_file():
        kept = detect_cache.entry(cache, file, target, frame)
        known = detect_cache.load(kept, file)
        if known is not None:
            return known
    pixels = picture.picture if isinstance(picture, Frame) else grey(read_image(picture))
    detection = judge(file, pixels, target)
    if kept is not None:
        detect_cache.store(kept, detection)
    return detection
