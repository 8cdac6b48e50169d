"""``motion.json``: where the pixels of a hand-held bracket's frames lie in one of them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from chromeball.hdr.align import Alignment, is_needed
from chromeball.scene.errors import UserError
from chromeball.scene.record import decode

type Float = NDArray[np.float64]
type Row = Annotated[list[float], Meta(min_length=3, max_length=3)]


class _Frame(Struct, frozen=True, forbid_unknown_fields=True):
    file: str
    transform: Annotated[list[Row], Meta(min_length=3, max_length=3)]
    sigma: float | None
    displacement: float
    flag: str


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    size: Annotated[list[int], Meta(min_length=2, max_length=2)]
    model: str
    reference: str
    needed: bool
    frames: Annotated[list[_Frame], Meta(min_length=1)]
    version: int = 1


@dataclass(frozen=True)
class Motion:
    """``transforms`` (P, 3, 3) of the frames ``files`` to ``reference``; ``size`` W, H.

    ``needed`` is False where no frame moved by more than its error: nothing is resampled then.
    """

    files: tuple[Path, ...]
    transforms: Float
    size: tuple[int, int]
    reference: Path
    needed: bool

    def of(self, path: Path) -> Float | None:
        """The transform of a frame that has to be resampled, (3, 3); None where it stays.

        Raises
        ------
        KeyError
            A frame that was not aligned.

        """
        whole = Path(os.path.abspath(path))
        if whole not in self.files:
            raise KeyError(whole)
        found = self.transforms[self.files.index(whole)]
        return None if not self.needed or np.array_equal(found, np.eye(3)) else found


def encode_motion(
    alignment: Alignment, paths: Sequence[Path], size: tuple[int, int], folder: Path
) -> bytes:
    """The bytes of a ``motion.json`` in `folder`, of frames of `size` width, height.

    A frame whose own motion is not to be trusted gets that of its nearest neighbour.
    """
    names = [os.path.relpath(path, folder) for path in paths]
    transforms = alignment.transforms.copy()
    sure = np.flatnonzero(alignment.confident)
    for k in np.flatnonzero(~alignment.confident):
        # the hand was there shortly before or after
        transforms[k] = (
            transforms[sure[np.argmin(np.abs(sure - k))]] if sure.size else np.eye(3)
        )
    rows = [
        _Frame(
            name,
            transform.tolist(),
            float(sigma) if np.isfinite(sigma) else None,
            float(displacement),
            flag,
        )
        for name, transform, sigma, displacement, flag in zip(
            names,
            transforms,
            alignment.sigma,
            alignment.displacement,
            alignment.flags,
            strict=True,
        )
    ]
    content = _File(
        [size[0], size[1]],
        alignment.model,
        names[alignment.reference],
        is_needed(alignment),
        rows,
    )
    return msgspec.json.format(msgspec.json.encode(content), indent=1) + b"\n"


def read_motion(path: str | os.PathLike[str]) -> Motion:
    """Read and check a ``motion.json``.

    Raises
    ------
    UserError
        Missing, not JSON, an unknown or missing key, numbers that are no transform.

    """
    try:
        return parse_motion(Path(path).read_bytes(), path)
    except FileNotFoundError as error:
        raise UserError("no such file; `hdr align` makes one", file=path) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path) from error


def parse_motion(data: bytes, path: str | os.PathLike[str] = "motion.json") -> Motion:
    """As :func:`read_motion`, from the bytes."""
    content = decode(data, _File, path)
    if content.version != 1:
        raise UserError(f"version {content.version}: this program reads version 1", file=path)
    transforms = np.array([frame.transform for frame in content.frames], np.float64)
    for frame, transform in zip(content.frames, transforms, strict=True):
        sound = np.all(np.isfinite(transform)) and np.all(np.abs(transform) < 1e9)
        if not sound or abs(np.linalg.det(transform)) < 1e-9:
            raise UserError(f"the transform of {frame.file} is singular", file=path)
    folder = Path(path).parent
    return Motion(
        files=tuple(Path(os.path.abspath(folder / f.file)) for f in content.frames),
        transforms=transforms,
        size=(content.size[0], content.size[1]),
        reference=Path(os.path.abspath(folder / content.reference)),
        needed=content.needed,
    )
