"""A bracket: which pictures, how much light each was given, and the pictures themselves.

A frame's exposure is ``time * ISO / 100 / N^2`` where aperture and ISO are known for all
frames, its time in seconds otherwise, so that all brackets of one camera share one scale. A
neutral-density filter multiplies it by its transmission, 2^-stops.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr.exposure import contradictions, exact_times, transmissions
from chromeball.scene.errors import UserError
from chromeball.scene.image import RAW_SUFFIXES, Exposure, read_exposure, read_image
from chromeball.scene.raw import Mosaic, read_mosaic


@dataclass(frozen=True)
class Frame:
    """One picture of a bracket: its file, and time (s), aperture (f-number), ISO speed."""

    path: Path
    time: float
    aperture: float | None = None
    iso: float | None = None
    camera: str | None = None
    scene: int = 0  # a take is one scene, the pictures named one by one are another
    transform: NDArray[np.float64] | None = (
        None  # (3, 3) to its reference, where it is resampled
    )


@dataclass(frozen=True)
class Bracket:
    """The frames, each with its exposure; ``scale`` says how the exposures were made."""

    frames: tuple[Frame, ...]
    exposures: NDArray[np.float64]  # (P,)
    scale: str
    inputs: tuple[Path, ...]  # what a record lists: pictures, and take.json where one was read
    notes: tuple[str, ...] = ()  # what the metadata say against themselves, a sentence each

    @property
    def paths(self) -> list[Path]:
        """The pictures in order."""
        return [frame.path for frame in self.frames]

    def moved_by(self, motions: Sequence[str | os.PathLike[str]]) -> Bracket:
        """The bracket with the transforms of ``motion.json`` files, one for each frame.

        Raises
        ------
        UserError
            A frame that none of them holds.

        """
        from chromeball.hdr.motion import read_motion

        known = [read_motion(path) for path in motions]
        frames: list[Frame] = []
        for frame in self.frames:
            whole = Path(os.path.abspath(frame.path))
            own = next((motion for motion in known if whole in motion.files), None)
            if own is None:
                raise UserError(
                    f"not in {', '.join(map(str, motions))}: run `hdr align` on these pictures",
                    file=frame.path,
                )
            frames.append(replace(frame, transform=own.of(frame.path)))
        return replace(self, frames=tuple(frames), inputs=(*self.inputs, *map(Path, motions)))

    @property
    def aligned(self) -> bool:
        """Whether a frame is resampled on its way in."""
        return any(frame.transform is not None for frame in self.frames)

    @property
    def raw(self) -> bool:
        """Whether all pictures are camera RAW, see :func:`mosaics`."""
        return all(path.suffix.lower() in RAW_SUFFIXES for path in self.paths)


@dataclass(frozen=True)
class Picture:
    """A frame's pixels, (H, W, C) with C of 1 or 3; `linear` if proportional to exposure.

    `white`, if known, is the value of saturated pixels in all channels: in RAW pictures, where
    it lies above all others.
    """

    path: Path
    pixels: NDArray[Any]
    channels: tuple[str, ...]
    linear: bool
    white: float | None = None


def read_bracket(
    inputs: Sequence[str | os.PathLike[str]],
    times: Sequence[float] | None = None,
    nd: Sequence[float] = (),
    *,
    exact: bool = False,
) -> Bracket:
    """Gather frames from pictures, take folders and ``take.json`` files.

    `times` (seconds, one a picture) override those of takes and metadata. `nd` are the stops of
    neutral-density filters, one for all pictures or one a picture; none where it is empty.
    `exact` takes times for names of the shutter's series: 1/30 stands for 1/32 s.

    Raises
    ------
    UserError
        A missing picture, no exposure time in the metadata, times that do not match.

    """
    if not inputs:
        raise UserError("no pictures given")
    frames: list[Frame] = []
    files: list[Path] = []
    for item in map(Path, inputs):
        if item.is_dir() or item.suffix == ".json":
            from chromeball.acquire.take import read_take, take_path

            files.append(take_path(item))
            for shot in read_take(item).frames:
                seen = read_exposure(shot.path)
                frames.append(
                    Frame(
                        shot.path,
                        shot.time,
                        shot.row.aperture or seen.aperture,
                        shot.row.iso or seen.iso,
                        seen.camera,
                        scene=len(files),
                    )
                )
        else:
            frames.append(_photograph(item, read_exposure(item), timed=times is not None))
    if times is not None:
        if len(times) != len(frames):
            raise UserError(
                f"{len(times)} exposure times for {len(frames)} pictures: give one a picture"
            )
        for time in times:
            if not (math.isfinite(time) and time > 0):
                raise UserError(f"exposure time {time} is not a positive number of seconds")
        frames = [replace(f, time=float(t)) for f, t in zip(frames, times, strict=True)]
    if exact:
        series = exact_times([frame.time for frame in frames])
        if series is None:
            raise UserError(
                "the exposure times are not those of a shutter's series (thirds or halves of a "
                "stop): leave --exact-times out"
            )
        frames = [replace(f, time=float(t)) for f, t in zip(frames, series, strict=True)]
    exposures, scale = _exposures(frames)
    if nd:
        exposures = exposures * transmissions(nd, len(frames))
    return Bracket(
        tuple(frames),
        exposures,
        scale,
        (*files, *(frame.path for frame in frames)),
        (
            *(f"{f.path.name}: {said}" for f in frames for said in contradictions(f.path)),
            *_unknown(frames),
        ),
    )


def _photograph(path: Path, seen: Exposure, *, timed: bool) -> Frame:
    if seen.time is None and not timed:
        raise UserError(
            "no exposure time in its metadata; give the times of all pictures with --times",
            file=path,
        )
    return Frame(path, seen.time or 1.0, seen.aperture, seen.iso, seen.camera)


def _exposures(frames: Sequence[Frame]) -> tuple[NDArray[np.float64], str]:
    time = np.array([frame.time for frame in frames], np.float64)
    known = [frame.aperture is not None and frame.iso is not None for frame in frames]
    if all(known):
        gain = np.array([(f.iso or 0) / 100 / (f.aperture or 1) ** 2 for f in frames])
        return time * gain, "time * ISO/100 / N^2"
    for name in ("aperture", "iso"):
        values = {getattr(frame, name) for frame in frames} - {None}
        if len(values) > 1:
            silent = next(f for f, k in zip(frames, known, strict=True) if not k)
            raise UserError(
                f"the bracket changes its {name}, and this picture lacks aperture or ISO: "
                "leave it out, or use pictures with full metadata",
                file=silent.path,
            )
    return time, "time"


def _unknown(frames: Sequence[Frame]) -> list[str]:
    """Frames that keep the bracket from the session's scale."""
    silent = [f for f in frames if f.aperture is None or f.iso is None]
    if not silent or len(silent) == len(frames):
        return []
    names = ", ".join(frame.path.name for frame in silent)
    return [f"{names}: no aperture or ISO, so the bracket's exposures are its times alone"]


def pictures(bracket: Bracket, tell: Callable[[str], None]) -> Iterator[Picture]:
    """Read the frames in order, a few ahead, and see that they fit together.

    Raises
    ------
    UserError
        A picture that cannot be read, another size, depth or channels than the first, NaN
        or infinite values in a linear picture.

    """
    first: Picture | None = None
    ahead = min(2, os.cpu_count() or 1)
    with ThreadPoolExecutor(ahead) as pool:
        frames = bracket.frames
        waiting = [pool.submit(_read_moved, frame) for frame in frames[:ahead]]
        for number, path in enumerate(bracket.paths):
            picture = waiting.pop(0).result()
            if number + ahead < len(frames):
                waiting.append(pool.submit(_read_moved, frames[number + ahead]))
            first = first or picture
            _fits(first, picture)
            tell(f"{number + 1}/{len(bracket.paths)} {path.name}")
            yield picture


def mosaics(bracket: Bracket, tell: Callable[[str], None]) -> Iterator[Mosaic]:
    """Read the frames of a RAW bracket as sensor values, in order.

    Raises
    ------
    UserError
        A picture that is no Bayer mosaic, or of another size, pattern or camera than the first.

    """
    first: Mosaic | None = None
    for number, path in enumerate(bracket.paths):
        mosaic = read_mosaic(path)
        first = first or mosaic
        for what, mine, its in (
            ("size", mosaic.pixels.shape[::-1], first.pixels.shape[::-1]),
            ("colour pattern", mosaic.pattern, first.pattern),
            ("camera", mosaic.exposure.camera, first.exposure.camera),
        ):
            if mine != its:
                raise UserError(
                    f"its {what} is {mine}, that of {bracket.paths[0].name} is {its}: a RAW "
                    "bracket comes from one camera",
                    file=path,
                )
        tell(f"{number + 1}/{len(bracket.paths)} {path.name}")
        yield mosaic


def _read_moved(frame: Frame) -> Picture:
    """A frame as it is, or resampled to the reference: black, no measurement, outside."""
    picture = _read(frame.path)
    if frame.transform is None:
        return picture
    from chromeball.hdr.align import warp

    if picture.linear:
        raise UserError(
            "aligned frames of linear values cannot be merged: outside a frame there is no "
            "value that means none; use codes (JPEG, TIFF), or a tripod",
            file=frame.path,
        )
    return replace(picture, pixels=warp(picture.pixels, frame.transform)[0])


def _read(path: Path) -> Picture:
    image = read_image(path)
    names = [name.upper() for name in image.channels]
    pixels = image.pixels
    match names:
        case ["R", "G", "B", *_] | ["Y", *_]:
            count = 3 if names[0] == "R" else 1
            chosen = names[:count]
            pixels = pixels[..., :count]
        case _ if {"R", "G", "B"} <= set(names):
            chosen = ["R", "G", "B"]
            pixels = pixels[..., [names.index(name) for name in chosen]]
        case _:
            raise UserError(
                f"channels {', '.join(image.channels)}: neither RGB nor grey", file=path
            )
    pixels = np.ascontiguousarray(pixels)
    if image.saturated is not None and image.white is not None:
        # so that values tell: negative ones are noise, of the saturated colour nothing is known
        pixels = np.clip(pixels, 0, np.float32(0.98 * image.white))
        pixels[image.saturated] = image.white
    if pixels.dtype == np.float32:
        bad = ~np.isfinite(pixels)  # negative values are noise about black, and kept
        if bad.any():
            y, x, _ = np.argwhere(bad)[0]
            raise UserError(
                f"{int(bad.any(axis=2).sum())} pixels are NaN or infinite, the first at x {x}, "
                f"y {y}",
                file=path,
            )
    return Picture(path, pixels, tuple(chosen), image.linear, image.white)


def _fits(first: Picture, picture: Picture) -> None:
    def size(p: Picture) -> str:
        return f"{p.pixels.shape[1]} x {p.pixels.shape[0]}"

    if size(picture) != size(first):
        raise UserError(
            f"{size(picture)} pixels, but {first.path.name} has {size(first)}: "
            "a bracket's pictures have one size",
            file=picture.path,
        )
    if picture.channels != first.channels:
        raise UserError(
            f"channels {', '.join(picture.channels)}, but {first.path.name} has "
            f"{', '.join(first.channels)}",
            file=picture.path,
        )
    if picture.pixels.dtype != first.pixels.dtype or picture.linear != first.linear:
        raise UserError(
            f"{picture.pixels.dtype} values, but {first.path.name} has {first.pixels.dtype}: "
            "do not mix RAW, EXR and 8-bit pictures in one bracket",
            file=picture.path,
        )
