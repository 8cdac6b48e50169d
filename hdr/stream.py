"""A bracket larger than memory: its frames by bands of rows.

Every frame is read once whole, to see that it is sound and to take a sample of it. While there
is room, frames stay in memory; the others are read again by rows through OpenImageIO, or, where
a format cannot be read by rows (RAW, progressive JPEG, interlaced PNG, tiles), from a temporary
file without a name, which vanishes with the process.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr.bracket import Bracket, Picture, pictures
from chromeball.hdr.noise import lattice
from chromeball.scene.errors import UserError

#: bytes of frames that stay in memory
MEMORY = 1 << 30
#: bytes of all frames' rows that are merged at a time
BAND = 48 << 20
#: files open at a time; further frames go to a temporary file
MOST_FILES = 200
#: samples of all frames together; one frame gives between the two numbers below
_SAMPLES, _FEWEST, _MOST = 240_000, 4_000, 12_000
_BY_ROWS = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".hdr"})

type Rows = Callable[[int, int], NDArray[Any]]


@dataclass(frozen=True)
class Sampled:
    """A frame at a glance: values on a lattice (n, C), the least and largest of all (C,)."""

    values: NDArray[Any]
    least: NDArray[Any]
    largest: NDArray[Any]


@dataclass
class Frames:
    """The frames of a bracket, a context manager.

    ``shape`` (H, W, C), ``kind`` their dtype, ``samples`` one a frame.
    """

    bracket: Bracket
    tell: Callable[[str], None]
    read: Callable[[Bracket, Callable[[str], None]], Iterator[Picture]] = pictures
    check: Callable[[Picture], None] = lambda picture: None
    memory: int = MEMORY
    spool: Path | None = None
    shape: tuple[int, int, int] = (0, 0, 0)
    kind: np.dtype[Any] = field(default_factory=lambda: np.dtype(np.uint8))
    channels: tuple[str, ...] = ()
    linear: bool = False
    samples: list[Sampled] = field(default_factory=list[Sampled])

    def __enter__(self) -> Frames:
        self._open = ExitStack()
        self._rows: list[Rows] = []
        self._files = 0
        room = self.memory
        try:
            for picture in self.read(self.bracket, self.tell):
                self.check(picture)
                pixels = picture.pixels
                if not self._rows:
                    height, width, count = pixels.shape
                    self.shape, self.kind = (height, width, count), pixels.dtype
                    self.channels, self.linear = picture.channels, picture.linear
                self.samples.append(_sample(pixels, len(self.bracket.paths)))
                if pixels.nbytes <= room:
                    room -= pixels.nbytes
                    self._rows.append(_held(pixels))
                elif (
                    not self.bracket.aligned
                    and self._files < MOST_FILES
                    and _by_rows(picture.path)
                ):
                    self._files += 1
                    self._rows.append(self._reader(picture))
                else:
                    self._rows.append(self._spooled(pixels))
        except BaseException:
            self._open.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()

    def bands(self, chosen: Sequence[int]) -> Iterator[tuple[int, list[NDArray[Any]]]]:
        """(first row, rows of the chosen frames), from the top; a multiple of 16 rows each."""
        height, width, count = self.shape
        row = width * count * self.kind.itemsize * len(chosen)
        step = max(16, BAND // max(row, 1) // 16 * 16)
        with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
            for top in range(0, height, step):
                end = min(height, top + step)
                rows = [self._rows[j] for j in chosen]
                yield top, list(pool.map(lambda read: read(top, end), rows))  # noqa: B023

    @property
    def lattice(self) -> tuple[slice, slice]:
        """Rows and columns that the samples are of."""
        return _lattice(self.shape[:2], len(self.bracket.paths))

    def part(self, chosen: Sequence[int], top: int, end: int) -> list[NDArray[Any]]:
        """The rows `top` .. `end` of the chosen frames."""
        return [self._rows[j](top, end) for j in chosen]

    def _reader(self, picture: Picture) -> Rows:
        import OpenImageIO as oiio

        path, base = picture.path, str(picture.pixels.dtype)
        source = oiio.ImageInput.open(os.fspath(path))
        if source is None:
            raise UserError("the picture changed while it was merged", file=path)
        self._open.callback(source.close)
        spec = source.spec()
        names = [name.upper() for name in spec.channelnames]
        count, pick = spec.nchannels, [names.index(name) for name in picture.channels]
        kind = "float" if base == "float32" else base

        def read(top: int, end: int) -> NDArray[Any]:
            rows = source.read_scanlines(top, end, 0, 0, count, kind)
            if rows is None or source.has_error:
                raise UserError("the picture changed while it was merged", file=path)
            whole = np.asarray(rows).reshape(end - top, spec.width, count)
            return whole if pick == list(range(count)) else whole[..., pick]

        return read

    def _spooled(self, pixels: NDArray[Any]) -> Rows:
        try:
            nameless = tempfile.TemporaryFile(dir=self.spool)  # noqa: SIM115 (closed by the stack)
            file = self._open.enter_context(nameless)
            pixels.tofile(file)
        except OSError as error:
            raise UserError(
                f"no room for a temporary file: {error.strerror}", file=self.spool
            ) from error
        return _held(np.memmap(file, pixels.dtype, "r", shape=pixels.shape))


def _held(pixels: NDArray[Any]) -> Rows:
    return lambda top, end: pixels[top:end]


def _sample(pixels: NDArray[Any], frames: int) -> Sampled:
    rows, columns = _lattice((pixels.shape[0], pixels.shape[1]), frames)
    values = pixels[rows, columns].reshape(-1, pixels.shape[2]).copy()
    return Sampled(values, pixels.min(axis=(0, 1)), pixels.max(axis=(0, 1)))


def _lattice(shape: tuple[int, int], frames: int) -> tuple[slice, slice]:
    return lattice(shape, min(_MOST, max(_FEWEST, _SAMPLES // frames)))


def _by_rows(path: Path) -> bool:
    """Whether a file gives its rows in order without holding the whole picture."""
    suffix = path.suffix.lower()
    if suffix not in _BY_ROWS:
        return False
    if suffix in {".jpg", ".jpeg"}:
        return not _is_progressive(path)
    if suffix == ".png":
        with path.open("rb") as file:
            return file.read(29)[28:] == b"\0"  # the header's interlace method
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(os.fspath(path))
    if source is None:
        return False
    spec = source.spec()
    source.close()
    return spec.tile_width == 0


def _is_progressive(path: Path) -> bool:
    """Whether the first start-of-frame marker is other than baseline or extended sequential."""
    with path.open("rb") as file:
        file.read(2)
        while len(head := file.read(4)) == 4 and head[0] == 0xFF:
            if 0xC0 <= head[1] <= 0xCF and head[1] not in {0xC4, 0xC8, 0xCC}:
                return head[1] not in {0xC0, 0xC1}
            file.seek(int.from_bytes(head[2:]) - 2, os.SEEK_CUR)
    return True
