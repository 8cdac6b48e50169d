"""When does a shutter change show? By the brightness of the pictures, not by guessing.

A frame at the new time t must be brighter than a settled reference at t_ref by ln(t / t_ref).
With the inverse response h = ln f^-1 and over pixels that are usable in both,

    m = median[h(z) - h(z_ref)],    r = m - ln(t / t_ref)

and the frame is settled when r is small, even and odd rows agree (else one field is still the
old exposure), and m stands still from frame to frame.

Without a measured response a generic camera curve stands in for h. It is good to a third of a
step, so the frame must also have left the old exposure behind for good, and stand still for a
whole exposure time.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.acquire.devices import Frame
from chromeball.scene.color import srgb_decode
from chromeball.scene.errors import UserError
from chromeball.scene.record import read_json

LOW, HIGH = 12, 243  # codes that are neither noise nor clipped
ENOUGH = 200  # usable samples, in each field
RATIO = 0.06  # |r| of a settled frame, by a measured response
GENERIC = 0.4  # and by the generic curve: this part of ln(t / t_ref) more
FIELDS = 0.05  # |m_even - m_odd|
DRIFT = 0.015  # |m_k - m_(k-1)|
SKIP = 12  # frames to let go by where the pictures cannot tell

_SAMPLES = 8192  # pixels looked at in each field


@dataclass(frozen=True)
class Curve:
    """h: ln exposure (3, 256) for each code, where it is from, and its lowest usable code."""

    log_exposure: NDArray[np.float64]
    origin: Literal["response", "generic"]
    low: int = LOW


def generic_curve() -> Curve:
    """The sRGB curve, in place of an unknown camera's."""
    codes = np.maximum(np.arange(256), 0.5) / 255
    h = np.log(np.asarray(srgb_decode(codes), np.float64))
    # Cameras differ most in the dark: what they make of black is left out.
    return Curve(np.repeat((h - h[128])[None], 3, axis=0), "generic", low=32)


def read_curve(path: str | os.PathLike[str]) -> Curve:
    """The curve of a ``response.json``.

    Raises
    ------
    UserError
        No such file, or it holds no rising 256-code curve for one or three channels.

    """
    content = read_json(path)
    try:
        h = np.array(content["log_exposure"], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError("no response curve: log_exposure is missing", file=path) from error
    if h.ndim != 2 or h.shape not in {(1, 256), (3, 256)}:
        raise UserError("log_exposure must be 1 or 3 rows of 256 numbers", file=path)
    usable = h[:, LOW : HIGH + 1]
    if not np.isfinite(usable).all() or (usable[:, -1] <= usable[:, 0]).any():
        raise UserError("the response curve does not rise; solve it again", file=path)
    return Curve(np.broadcast_to(h, (3, 256)).copy(), "response")


@dataclass(frozen=True)
class Reference:
    """A settled picture's `samples` and its exposure time in seconds."""

    samples: NDArray[np.uint8]
    time: float


@dataclass(frozen=True)
class Brightness:
    """How much brighter a frame is than a reference, as logarithms.

    ``measured`` m, ``expected`` ln(t / t_ref), ``fields`` m_even - m_odd, ``error`` the
    standard error of m, ``count`` samples in the poorer field.
    """

    measured: float
    expected: float
    fields: float
    error: float
    count: int

    @property
    def residual(self) -> float:
        """R = m - ln(t / t_ref)."""
        return self.measured - self.expected


def sample(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(2, N, 3): some pixels of the even rows, and those below them in the odd rows."""
    height, width = pixels.shape[0] // 2 * 2, pixels.shape[1]
    step = max(1, math.isqrt(height // 2 * width // _SAMPLES))
    pairs = pixels[:height].reshape(height // 2, 2, width, 3)[::step, :, ::step]
    return np.ascontiguousarray(pairs.transpose(1, 0, 2, 3)).reshape(2, -1, 3)


def compare(
    samples: NDArray[np.uint8], time: float, reference: Reference, curve: Curve
) -> Brightness:
    """Brightness of a frame said to be exposed for `time` against a reference."""
    expected = math.log(time / reference.time)
    count, medians, errors = [], [], []
    for now, before in zip(samples, reference.samples, strict=True):
        differences: list[NDArray[np.float64]] = []
        for channel, h in enumerate(curve.log_exposure):
            z = before[:, channel]
            # Usable in the reference, and, as it predicts, at the new time as well: choosing
            # by the frame itself would favour pixels that noise has pushed inside.
            low, high = h[curve.low], h[HIGH]
            predicted = h + expected
            usable = (h >= low) & (h <= high) & (predicted >= low) & (predicted <= high)
            usable[: curve.low] = usable[HIGH + 1 :] = False
            chosen = usable[z]
            differences.append(h[now[chosen, channel]] - h[z[chosen]])
        joined = np.concatenate(differences)
        count.append(joined.size)
        if joined.size:
            median = float(np.median(joined))
            deviation = float(np.median(np.abs(joined - median)))
            medians.append(median)
            errors.append(1.253 * 1.4826 * deviation / math.sqrt(joined.size))
    if min(count) < ENOUGH:
        return Brightness(math.nan, expected, math.nan, math.nan, min(count))
    return Brightness(
        measured=(medians[0] + medians[1]) / 2,
        expected=expected,
        fields=medians[0] - medians[1],
        error=math.hypot(*errors) / 2,
        count=min(count),
    )


type Outcome = Literal["waiting", "settled", "cannot tell"]


@dataclass
class Watch:
    """Watches the frames after one shutter change.

    Parameters
    ----------
    curve
        h.
    references
        Settled pictures of the same scene at other times.
    time, before
        Exposure times in seconds: the new one, and the one that was set before.

    """

    curve: Curve
    references: list[Reference]
    time: float
    before: float
    waited: int = 0
    brightness: Brightness | None = None
    _steady: list[tuple[float, Brightness]] = field(
        default_factory=list[tuple[float, Brightness]]
    )
    _first: float | None = None
    _reference: Reference | None = None

    def feed(self, frame: Frame, samples: NDArray[np.uint8]) -> Outcome:
        """Look at the next frame; ``waited`` counts those that were not settled."""
        self._first = frame.monotonic if self._first is None else self._first
        if self._reference is None:
            self._reference = self._choose()
        now = (
            compare(samples, self.time, self._reference, self.curve)
            if self._reference
            else None
        )
        if now is None or math.isnan(now.measured):
            outcome = self._skip(frame)
        else:
            self.brightness = now
            self._remember(frame, now)
            outcome = "settled" if self._is_settled(frame, now) else "waiting"
        if outcome == "waiting":
            self.waited += 1
        return outcome

    @property
    def stands_still(self) -> bool:
        """Whether the last frames agree, whatever their brightness, for long enough."""
        if len(self._steady) < SKIP:
            return False
        return self._steady[-1][0] - self._steady[0][0] >= 2 * self.time

    @property
    def followed(self) -> bool:
        """Whether the brightness has left the old exposure for the new one."""
        now = self.brightness
        if now is None or self._reference is None:
            return False
        step = math.log(self.time / self.before)
        old = math.log(self.before / self._reference.time)
        return step == 0 or (now.measured - old) / step > 0.5

    def _choose(self) -> Reference | None:
        """The reference with most samples that are usable at both times.

        By the generic curve ln(t / t_ref) may be wrong by a part of itself, so a reference far
        from the old exposure cannot tell that from the new one: the old one itself is best.
        """
        step = abs(math.log(self.time / self.before))
        best, most = None, ENOUGH - 1
        for reference in self.references:
            far = abs(math.log(self.before / reference.time))
            if self.curve.origin == "generic" and far and GENERIC * far > step / 4:
                continue
            count = compare(reference.samples, self.time, reference, self.curve).count
            if count > most:
                best, most = reference, count
        return best

    def _skip(self, frame: Frame) -> Outcome:
        assert self._first is not None
        passed = frame.monotonic - self._first
        long_enough = self.waited >= SKIP and passed >= self.before + 2 * self.time
        return "cannot tell" if long_enough else "waiting"

    def _remember(self, frame: Frame, now: Brightness) -> None:
        """Keep the run of frames that agree with their predecessors and in both fields."""
        if self._steady:
            last = self._steady[-1][1]
            if abs(now.measured - last.measured) > max(DRIFT, 6 * now.error):
                self._steady.clear()
        if abs(now.fields) < self._field_bound(now):
            self._steady.append((frame.monotonic, now))
        else:
            self._steady.clear()

    def _field_bound(self, now: Brightness) -> float:
        step = abs(math.log(self.time / self.before))
        bound = min(FIELDS, step / 4) if step else FIELDS
        return max(bound, 8 * now.error)

    def _is_settled(self, frame: Frame, now: Brightness) -> bool:
        if len(self._steady) < 2 or not self.followed:
            return False
        bound = max(RATIO, 4 * now.error)
        if self.curve.origin == "response":
            return abs(now.residual) < bound
        whole_exposure = frame.monotonic - self._steady[0][0] >= self.time
        return whole_exposure and abs(now.residual) < bound + GENERIC * abs(now.expected)
