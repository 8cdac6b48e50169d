"""Capture a bracket: set the shutter, read it back, wait until the pictures show it, keep one.

The longest time comes first, so that neighbours overlap. Before it the next time is set for a
moment: its picture is the reference against which the first frame is judged, and the first
frame in turn confirms it.
"""

from __future__ import annotations

import math
import os
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.acquire.devices import Frame, FrameSource, ShutterCamera
from chromeball.acquire.journal import Bracket, Journal
from chromeball.acquire.settle import (
    DRIFT,
    RATIO,
    SKIP,
    Curve,
    Reference,
    Watch,
    compare,
    generic_curve,
    sample,
)
from chromeball.acquire.take import (
    Settle,
    Take,
    TakeFrame,
    encode_take,
    read_take,
    take_path,
)
from chromeball.scene.errors import DeviceError, UserError
from chromeball.scene.image import Exposure, read_image, write_picture
from chromeball.scene.record import Stage, record_path

NEAR = 1.2  # a requested time may be this factor from the shutter's
CHANGED = 0.05  # share of the picture that may change between two runs of one bracket


def match_times(times: Sequence[float], speeds: Sequence[float]) -> list[float]:
    """The shutter's speed for each of `times`, in seconds.

    Raises
    ------
    UserError
        A time is more than 20 % from every speed, or two times have the same speed.

    """
    matched: list[float] = []
    for time in times:
        nearest = min(speeds, key=lambda speed: abs(math.log(speed / time)))
        if max(time / nearest, nearest / time) > NEAR:
            raise UserError(
                f"the camera has no shutter time near {_text(time)}; the nearest is "
                f"{_text(nearest)}"
            )
        if nearest in matched:
            other = times[matched.index(nearest)]
            raise UserError(
                f"{_text(other)} and {_text(time)} are both the camera's {_text(nearest)}; "
                "leave one out"
            )
        matched.append(nearest)
    return matched


def capture_bracket(
    camera: ShutterCamera,
    video: FrameSource,
    times: Sequence[float],
    output: str | os.PathLike[str],
    *,
    curve: Curve | None = None,
    average: int = 1,
    patience: float = 2.0,
    say: Callable[[str], None] = lambda message: None,
) -> Take:
    """Capture one frame at each of `times` and write the take to `output`.

    `curve` is the camera's response where it is known; `average` frames are averaged for each
    picture; `patience` seconds and six exposures are what a shutter change may take; `say`
    is told of the progress. A run that breaks off leaves its frames and a journal, and the
    next one goes on from there if the scene has not changed.

    Raises
    ------
    UserError
        No such shutter time.
    DeviceError
        The camera or the video fails, or a shutter change never shows in the pictures.

    """
    if not times:
        raise UserError("a bracket needs exposure times; give --times 1/3,1/12,...")
    if average < 1:
        raise UserError(f"cannot average {average} frames; 1 or more")
    matched = match_times(times, camera.speeds)
    requested = {m: float(t) for m, t in zip(matched, times, strict=True)}
    file = take_path(output)
    curve = curve or generic_curve()
    bracket = Bracket(
        device=camera.name,
        video=video.name,
        times=sorted(matched),
        average=average,
        curve=curve.origin,
    )
    with Stage("acquire bracket", times=list(times), average=average) as stage:
        begin = clock.perf_counter()
        run = _Run(camera, video, curve, average, patience, file.parent, say)
        journal = Journal(file.parent, bracket)
        order = sorted(matched, reverse=True)
        rows = run.resume(journal.kept)
        resumed = len(rows)
        try:
            # The pictures of an older take are about to be overwritten.
            for old in (file, record_path(file)):
                old.unlink(missing_ok=True)
            if not rows:
                journal.begin()
            for index, time in enumerate(order):
                if any(row.read_back_time == time for row in rows):
                    continue
                name = f"frame_{index:02d}.png"
                rows.append(run.capture(time, requested[time], name, _primer(order, camera)))
                journal.append(rows[-1])
        except BaseException as error:
            if not rows:
                journal.remove()
            if isinstance(error, DeviceError):
                raise _with_hint(error, len(rows), len(order)) from error
            raise
        rows.sort(key=lambda row: row.time)
        with stage.output(file) as temporary:
            assert run.size is not None
            content = encode_take(rows, run.size, device=camera.name, video=video.name)
            temporary.write_bytes(content)
        seconds = clock.perf_counter() - begin
        settles = [row.settle for row in rows if row.settle is not None]
        stage.figures.update(
            device=camera.name,
            frames=len(rows),
            resumed_frames=resumed,
            times_s=[row.time for row in rows],
            frames_waited=[settle.frames_waited for settle in settles],
            ratios=[settle.ratio for settle in settles],
            verdicts=[settle.verdict for settle in settles],
            curve=curve.origin,
            capture_seconds=seconds,
            hdr_frames_per_second=1 / seconds,
        )
    journal.remove()
    return read_take(file)


@dataclass
class _Run:
    """One bracket under way."""

    camera: ShutterCamera
    video: FrameSource
    curve: Curve
    average: int
    patience: float
    folder: Path
    say: Callable[[str], None]
    size: tuple[int, int] | None = None
    references: list[Reference] = field(default_factory=list[Reference])
    before: float = 0.0
    confirmed: bool = False

    def capture(self, time: float, requested: float, name: str, primer: float) -> TakeFrame:
        """Set, read back, wait, grab, write: the row of one picture."""
        if not self.references:
            self._prime(primer)
        watch, frames = self._settle(time)
        if watch is None and not self.confirmed:
            self.say("the first reference does not hold; taking it again")
            self._prime(primer, 2)
            watch, frames = self._settle(time)
        if watch is None:
            raise DeviceError(
                f"the picture never came to what {_text(time)} must look like; is this video "
                "from this camera, is the light steady, are gain and iris fixed?"
            )
        pixels = _mean(frames)
        settle = self._verdict(watch, time)
        measured = None
        if watch.brightness is not None and self.curve.origin == "response":
            measured = time * math.exp(watch.brightness.residual)
        row = TakeFrame(
            file=name,
            requested_time=requested,
            read_back_time=time,
            measured_time=measured,
            device=self.camera.name,
            monotonic=frames[0].monotonic,
            wall=datetime.fromtimestamp(frames[0].wall, UTC).isoformat(timespec="milliseconds"),
            averaged=len(frames),
            settle=settle,
        )
        exposure = Exposure(time=row.time, camera=self.camera.name)
        write_picture(self.folder / name, pixels, exposure=exposure)
        self.references.append(Reference(sample(pixels), row.time))
        self.confirmed = self.confirmed or settle.verdict == "settled"
        ratio = "" if settle.ratio is None else f", brightness {settle.ratio:.3f} of expected"
        self.say(f"{_text(time)}: {settle.verdict} after {settle.frames_waited} frames{ratio}")
        return row

    def resume(self, kept: list[TakeFrame]) -> list[TakeFrame]:
        """An earlier run's rows, if the scene still looks as it did in the last of them."""
        if not kept:
            return []
        pictures = [read_image(self.folder / row.file).pixels[..., :3] for row in kept]
        last = Reference(sample(pictures[-1]), kept[-1].time)
        time = kept[-1].read_back_time
        assert time is not None
        self._prime(time)
        now = self.references.pop()
        same = compare(now.samples, last.time, last, self.curve)
        if not abs(same.measured) < max(RATIO, 4 * same.error) or _changed(
            now.samples, last.samples, self.curve
        ):
            self.say("the scene or its light has changed since the last run; starting over")
            return []
        self.say(f"going on after {len(kept)} frames of the last run")
        self.references = [
            Reference(sample(picture), row.time)
            for picture, row in zip(pictures, kept, strict=True)
        ]
        self.confirmed = any(row.settle and row.settle.verdict == "settled" for row in kept)
        return list(kept)

    def _prime(self, time: float, factor: int = 1) -> None:
        """The first reference: set and left alone for longer than any change may take."""
        before = self.camera.shutter()
        self.camera.set_shutter(time)
        frame = self._grab()
        begin, count, steady = frame.monotonic, 1, 0
        last = Reference(sample(frame.pixels), time)
        while True:
            passed = frame.monotonic - begin
            waited = count >= factor * SKIP and passed >= factor * (before + 2 * time)
            if waited and (steady >= 2 or passed > self.patience + 6 * max(before, time)):
                break
            frame = self._grab()
            samples = sample(frame.pixels)
            # Comparing with nothing usable gives NaN, which counts as steady: no news.
            moved = abs(compare(samples, time, last, self.curve).measured) > DRIFT / 2
            steady = 0 if moved else steady + 1
            last = Reference(samples, time)
            count += 1
        self.references = [last]
        self.before = time

    def _settle(self, time: float) -> tuple[Watch | None, list[Frame]]:
        """The frames at `time` once they are settled, or no watch if that never happens."""
        self.camera.set_shutter(time)
        watch = Watch(self.curve, self.references, time, self.before)
        self.before = time
        begin, frames, seen = None, list[Frame](), 0
        patience = self.patience + 6 * max(time, watch.before)
        while True:
            frame = self._grab()
            seen += 1
            begin = frame.monotonic if begin is None else begin
            outcome = watch.feed(frame, sample(frame.pixels))
            spent = seen > 2 * SKIP and frame.monotonic - begin > patience
            if outcome != "waiting" or (spent and self._is_plateau(watch)):
                # A slow shutter repeats its picture: averaged frames are an exposure apart.
                if not frames or frame.monotonic - frames[-1].monotonic >= time:
                    frames.append(frame)
                if len(frames) == self.average:
                    return watch, frames
            elif spent:
                return None, []

    def _is_plateau(self, watch: Watch) -> bool:
        """Steady at a wrong brightness: only a measured response can say what it is."""
        known = self.confirmed and self.curve.origin == "response"
        return known and watch.stands_still and watch.followed

    def _verdict(self, watch: Watch, time: float) -> Settle:
        now = watch.brightness
        if now is None:
            return Settle(
                verdict="unverified",
                frames_waited=watch.waited,
                method="fixed wait: too few pixels are usable at both times",
            )
        ratio = math.exp(now.residual)
        if self.curve.origin == "response":
            wrong = abs(now.residual) >= max(RATIO, 4 * now.error)
            method = "brightness ratio by the camera's response"
        else:
            wrong = False
            method = f"steady for {_text(time)}, brightness ratio by a generic curve"
        return Settle(
            verdict="plateau" if wrong else "settled",
            frames_waited=watch.waited,
            ratio=ratio,
            method=method,
        )

    def _grab(self) -> Frame:
        frame = self.video.grab()
        size = (frame.pixels.shape[1], frame.pixels.shape[0])
        if self.size is None and min(size) < 2:
            raise DeviceError(f"the video has {size[0]}x{size[1]} pixels", file=self.video.name)
        if self.size not in {None, size}:
            raise DeviceError("the video changed its size", file=self.video.name)
        self.size = size
        return frame


def _primer(order: list[float], camera: ShutterCamera) -> float:
    """What to set before the first frame: the next time of the bracket, or a neighbour."""
    if len(order) > 1:
        return order[1]
    others = [speed for speed in camera.speeds if speed != order[0]]
    return min(others, key=lambda speed: abs(math.log(speed / order[0])))


def _mean(frames: list[Frame]) -> NDArray[np.uint8]:
    if len(frames) == 1:
        return frames[0].pixels
    total = np.sum([frame.pixels for frame in frames], axis=0, dtype=np.uint32)
    return ((total + len(frames) // 2) // len(frames)).astype(np.uint8)


def _changed(now: NDArray[np.uint8], before: NDArray[np.uint8], curve: Curve) -> bool:
    """Whether more of the picture is different than noise makes it."""
    different = 0
    for channel, h in enumerate(curve.log_exposure):
        a, b = (h[np.clip(s[..., channel], 12, 243)] for s in (now, before))
        different += int((np.abs(a - b) > 0.3).sum())
    return different > CHANGED * now.size


def _with_hint(error: DeviceError, kept: int, count: int) -> DeviceError:
    if not kept:
        return error
    hint = f"{kept} of {count} frames are kept, run the command again to go on"
    return DeviceError(f"{error.what} ({hint})", file=error.file)


def _text(time: float) -> str:
    return f"1/{1 / time:.5g} s" if time < 0.4 else f"{time:.4g} s"
