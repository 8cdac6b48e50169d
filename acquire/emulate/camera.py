"""An emulated video camera: its exposure state, and the frames that come of it.

The shutter register changes at once and reads back so; the picture follows later, as on real
devices: some frames are still the old exposure, then one has a field of each, and a slow
shutter repeats its last picture until the next exposure is done.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chromeball.acquire.emulate.sensor import Sensor
from chromeball.acquire.visca_packets import AutoExposure, Model

_REMEMBERED = 4096  # frames whose truth is kept for tests


@dataclass(frozen=True)
class Transition:
    """What happens after a shutter change.

    ``delay``: least and most frames that still show the old exposure, drawn uniformly.
    ``drift``: log exposure error of the first new frame (a gain that still settles); it
    shrinks to ``decay`` of itself a frame.
    """

    delay: tuple[int, int] = (1, 4)
    drift: float = 0.0
    decay: float = 0.6


@dataclass(frozen=True)
class Truth:
    """What a frame really was: seconds of its even and odd rows."""

    even: float
    odd: float


@dataclass
class VideoCamera:
    """A camera before (H, W, 3) `radiance`, free-running at `fps` frames a second."""

    radiance: NDArray[np.floating]
    model: Model
    fps: float = 25.0
    sensor: Sensor = field(default_factory=Sensor)
    transition: Transition = field(default_factory=Transition)
    seed: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._lock = threading.Lock()
        self.mode = AutoExposure.AUTO
        self._auto = self._meter()
        self.position = self._auto
        time = self.model.times[self.position]
        self._shown = Truth(time, time)
        self._target = time
        self._old_frames = 0  # frames until the change shows
        self._mixed = False
        self._drift = 0.0
        self._exposing = 0  # frames until the exposure under way is done
        self._pixels: NDArray[np.uint8] | None = None
        self.truth: OrderedDict[float, Truth] = OrderedDict()

    @property
    def cycle(self) -> float:
        """Seconds of the V cycle now; in slow shutter it grows to the exposure."""
        return max(1 / self.model.fields, self.model.times[self.position])

    def set_mode(self, mode: AutoExposure) -> None:
        """Change the AE mode: outside manual the camera chooses the exposure itself."""
        with self._lock:
            self.mode = mode
            self._change()

    def set_shutter(self, position: int) -> bool:
        """Set the shutter register; ``False`` where the AE mode forbids it."""
        with self._lock:
            if self.mode not in {AutoExposure.MANUAL, AutoExposure.SHUTTER}:
                return False
            self.position = position
            self._change()
            return True

    def tick(self, monotonic: float, *, wanted: bool) -> NDArray[np.uint8] | None:
        """The next video frame; its pixels are only made if they are `wanted`."""
        with self._lock:
            self._advance()
            self.truth[monotonic] = self._shown
            while len(self.truth) > _REMEMBERED:
                self.truth.popitem(last=False)
            shown = self._shown
            if not wanted:
                return None
            if self._pixels is None:
                self._pixels = self._expose(shown)
            return self._pixels

    def _change(self) -> None:
        manual = self.mode is AutoExposure.MANUAL
        target = self.model.times[self.position if manual else self._auto]
        if target == self._target and not self._old_frames:
            return
        self._target = target
        # An exposure under way is finished first.
        self._old_frames = self._exposing + int(
            self._rng.integers(*self.transition.delay, endpoint=True)
        )
        self._mixed = False

    def _advance(self) -> None:
        """One frame period later."""
        if self._old_frames:
            self._old_frames -= 1
            if not self._old_frames:
                old = self._shown.even
                fields = (
                    (old, self._target) if self._rng.random() < 0.5 else (self._target, old)
                )
                self._shown, self._pixels = Truth(*fields), None
                self._mixed = True
                self._exposing = self._frames(self._target)
                return
        self._exposing -= 1
        if self._exposing > 0:
            return  # the frame memory repeats the last picture
        self._pixels = None
        if self._mixed:
            self._mixed = False
            self._drift = self.transition.drift
        elif self._old_frames == 0:
            self._drift *= self.transition.decay
            if abs(self._drift) < 1e-3:
                self._drift = 0.0
        if not self._old_frames:
            time = self._target * math.exp(self._drift)
            self._shown = Truth(time, time)
        self._exposing = self._frames(self._shown.even)

    def _frames(self, time: float) -> int:
        """Frame periods that an exposure takes."""
        return max(1, math.ceil(time * self.fps - 1e-9))

    def _expose(self, truth: Truth) -> NDArray[np.uint8]:
        pixels = self.sensor.expose(self.radiance, truth.even, self._rng)
        if truth.odd != truth.even:
            pixels[1::2] = self.sensor.expose(self.radiance, truth.odd, self._rng)[1::2]
        return pixels

    def _meter(self) -> int:
        """The position whose picture is nearest to middle grey, as the camera's own AE."""
        middle = float(np.median(self.radiance.mean(axis=2))) or self.sensor.middle
        wanted = math.log(self.sensor.middle / middle)
        errors = [abs(math.log(time) - wanted) for time in self.model.times]
        return errors.index(min(errors))
