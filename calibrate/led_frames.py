"""Frames of a video or of a folder of pictures as grey floats, one after the other."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.image import LINEAR_SUFFIXES, read_image

#: White.
FULL = 255.0
PICTURES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}) | LINEAR_SUFFIXES


@dataclass(frozen=True)
class Recording:
    """What one camera recorded: ``count`` frames or about so many, ``rate`` a second.

    ``frames`` gives them from the first, (H, W) with white at :data:`FULL`.
    """

    path: Path
    name: str
    size: tuple[int, int]
    count: int
    rate: float | None
    frames: Callable[[], Iterator[NDArray[np.float32]]]

    @property
    def files(self) -> list[Path]:
        """The video, or the pictures."""
        return pictures(self.path) if self.path.is_dir() else [self.path]


def open_recording(source: str | os.PathLike[str]) -> Recording:
    """A video, or a folder whose pictures are the frames in the order of their names.

    Raises
    ------
    UserError
        It is neither, or its pictures differ in size.

    """
    path = Path(source)
    if path.is_dir():
        files = pictures(path)
        if not files:
            raise UserError("holds no pictures", file=path)
        size = _grey_file(files[0]).shape[::-1]
        width, height = size
        return Recording(
            path, path.absolute().name, (width, height), len(files), None,
            lambda: _pictures(files, (width, height)),
        )  # fmt: skip
    if not path.is_file():
        raise UserError("no such video or folder of pictures", file=path)
    capture = cv2.VideoCapture(os.fspath(path))
    good, frame = capture.read()
    count, rate = (capture.get(p) for p in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    capture.release()
    if not good:
        raise UserError("not a readable video", file=path)
    height, width = frame.shape[:2]
    return Recording(
        path, path.stem, (width, height), max(int(count), 1), rate if rate > 0 else None,
        lambda: _video(path),
    )  # fmt: skip


def pictures(folder: Path) -> list[Path]:
    """The pictures of a folder by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)


def _video(path: Path) -> Iterator[NDArray[np.float32]]:
    capture = cv2.VideoCapture(os.fspath(path))
    try:
        while True:
            good, frame = capture.read()
            if not good:
                return
            yield cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).astype(np.float32)
    finally:
        capture.release()


def _pictures(files: list[Path], size: tuple[int, int]) -> Iterator[NDArray[np.float32]]:
    for file in files:
        grey = _grey_file(file)
        if grey.shape[::-1] != size:
            raise UserError(
                f"{grey.shape[1]} x {grey.shape[0]} pixels, the others {size[0]} x {size[1]}",
                file=file,
            )
        yield grey


def _grey_file(file: Path) -> NDArray[np.float32]:
    image = read_image(file)
    white = {"uint8": 255.0, "uint16": 65535.0}.get(str(image.pixels.dtype), 1.0)
    colours = image.pixels[..., :3].astype(np.float32) * np.float32(FULL / white)
    if colours.shape[-1] < 3:
        return np.ascontiguousarray(colours[..., 0])
    return np.asarray(colours @ np.array([0.299, 0.587, 0.114], np.float32), np.float32)
