"""Bright moving lights in a video or a folder of pictures, frame by frame, to sub-pixels.

What does not move is the median of some frames; a light is a spot well above it. Spots are
joined to the brightest continuous path (Viterbi's), so that its dimmer reflections and a
passing glint are left aside, and then measured: an elliptical Gaussian is fitted, which takes
the streak of a moving light, too, and in which saturated pixels only say "at least so bright".
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.led_fit import fit_spot
from chromeball.calibrate.led_frames import FULL, Recording, open_recording
from chromeball.calibrate.wand_result import Tracks
from chromeball.scene.errors import UserError

#: Frames of which the still picture is the median.
STILL_FRAMES = 31
#: A spot is so many deviations of the noise above it, and at least this share of white.
LEAST_DEVIATIONS = 6.0
LEAST_CONTRAST = 0.08
#: Pixels of a spot, and the share of the picture's diagonal that it may be long.
FEWEST_PIXELS = 3
LONGEST = 0.1
#: A frame in which more than this share of the pixels brightened shows another light going on.
FLOODED = 0.05
#: Spots that are looked at for each light.
SPOTS = 4
#: Costs of a path: none where a light could be, a spot `e` times dimmer is 1, a jump.
NONE_COST = 1.6
JUMP_COST = 3.0
#: Error of a spot's place beside that of its fit, pixels.
SHAPE_ERROR = 0.05
#: Another spot at least so bright as the chosen one makes a frame ambiguous.
RIVAL = 0.5


@dataclass(frozen=True)
class Spot:
    """A spot before it is measured: place (2,), summed brightness, and its surroundings.

    ``patch`` is the picture without what is still, ``corner`` (x, y) its first pixel and
    ``saturated`` which of its pixels are white.
    """

    place: NDArray[np.float64]
    brightness: float
    patch: NDArray[np.float32]
    corner: tuple[int, int]
    saturated: NDArray[np.bool_]


@dataclass(frozen=True)
class LightTrack:
    """Where one camera saw K lights in F frames.

    ``pixels`` (F, K, 2) in order along the wand, NaN where not all lights were seen;
    ``errors`` (F, K) standard errors of a coordinate, pixels. ``none`` frames without all
    lights, ``several`` with a rival of a light, ``flooded`` left out as another light went on.
    ``rate`` frames a second, None for pictures.
    """

    name: str
    size: tuple[int, int]
    rate: float | None
    pixels: NDArray[np.float64]
    errors: NDArray[np.float64]
    none: int
    several: int
    flooded: int

    def verdict(self) -> str:
        """One line for people."""
        frames = len(self.pixels)
        text = f"{frames - self.none} of {frames} frames, {self.several} ambiguous"
        return f"{text}, {self.flooded} flooded" if self.flooded else text


def track_lights(
    source: str | os.PathLike[str],
    lights: int = 1,
    progress: Callable[[int], object] | None = None,
) -> LightTrack:
    """Follow `lights` in a video or a folder of pictures; `progress` gets frames done.

    Raises
    ------
    UserError
        It is no video and no folder of equally large pictures, or shows no moving light.

    """
    recording = open_recording(source)
    still, noise = still_picture(recording)
    spots: list[list[Spot]] = []
    flooded = 0
    for frame in recording.frames():
        found = find_spots(frame, still, noise, SPOTS * lights)
        flooded += found is None
        spots.append(found or [])
        if progress is not None:
            progress(len(spots))
    if not any(spots):
        raise UserError("shows no moving light: darken the room, expose less", file=source)
    chosen, several = follow(spots, lights, recording.size)
    pixels, errors = _measured(spots, chosen, float(np.median(noise)))
    order = _along(pixels)
    pixels = np.take_along_axis(pixels, order[..., None], axis=1)
    errors = np.take_along_axis(errors, order, axis=1)
    whole = np.isfinite(pixels).all(axis=(1, 2))
    pixels[~whole], errors[~whole] = np.nan, np.nan
    return LightTrack(
        recording.name,
        recording.size,
        recording.rate,
        pixels,
        errors,
        int((~whole).sum()),
        several,
        flooded,
    )


def still_picture(
    recording: Recording,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The median of frames spread over the recording, and the deviation from it, (H, W)."""
    step = max(1, recording.count // STILL_FRAMES)
    stack = np.array([f for i, f in enumerate(recording.frames()) if i % step == 0][:64])
    if len(stack) < 3:
        raise UserError("holds too few frames to tell what moves", file=recording.path)
    still = np.median(stack, axis=0).astype(np.float32)
    off = np.abs(stack - still)
    noise = 1.4826 * np.median(off, axis=0)
    # Where the light dwelt, and where codes are few, the whole picture's deviation holds.
    common = 1.4826 * float(np.median(off)) + 0.5
    return still, np.maximum(cv2.blur(noise.astype(np.float32), (5, 5)), common)


def find_spots(
    frame: NDArray[np.float32],
    still: NDArray[np.float32],
    noise: NDArray[np.float32],
    most: int,
) -> list[Spot] | None:
    """The `most` brightest spots of a frame (H, W); None where much of it brightened."""
    change = frame - still
    mask = change > np.maximum(LEAST_DEVIATIONS * noise, LEAST_CONTRAST * FULL)
    if mask.mean() > FLOODED:
        return None
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    longest = LONGEST * float(np.hypot(*frame.shape))
    found: list[Spot] = []
    for label in range(1, count):
        x, y, w, h, area = (int(v) for v in stats[label])
        if area < FEWEST_PIXELS or max(w, h) > longest:
            continue
        margin = 3 + max(w, h) // 3
        x0, y0 = max(0, x - margin), max(0, y - margin)
        window = np.s_[y0 : y + h + margin, x0 : x + w + margin]
        patch = change[window]
        own = np.where(labels[window] == label, patch, 0).astype(float)
        brightness = float(own.sum())
        rows, columns = np.indices(own.shape)
        place = np.array([(own * columns).sum(), (own * rows).sum()]) / brightness + [x0, y0]
        others = (labels[window] != label) & (labels[window] > 0)
        found.append(
            Spot(
                place,
                brightness,
                np.where(others, np.nan, patch).astype(np.float32),
                (x0, y0),
                frame[window] > 0.97 * FULL,
            )
        )
    return sorted(found, key=lambda spot: -spot.brightness)[:most]


def follow(
    spots: list[list[Spot]], lights: int, size: tuple[int, int]
) -> tuple[NDArray[np.intp], int]:
    """Which spot is which light, (F, K), -1 for none; and the number of ambiguous frames.

    The path of least cost, one light after the other: dim spots and jumps cost.
    """
    usual = float(np.quantile([s[0].brightness for s in spots if s], 0.75))
    chosen = np.full((len(spots), lights), -1)
    left = [list(range(len(s))) for s in spots]
    reach = _reach(spots, size)
    for light in range(lights):
        path = _path(spots, left, usual, reach)
        chosen[:, light] = path
        for options, taken in zip(left, path.tolist(), strict=True):
            if taken >= 0:
                options.remove(taken)
    several = 0
    for f, options in enumerate(left):
        taken = [spots[f][i].brightness for i in chosen[f] if i >= 0]
        rest = max((spots[f][i].brightness for i in options), default=0.0)
        several += bool(taken) and rest > RIVAL * min(taken)
    return chosen, several


def _path(
    spots: list[list[Spot]], left: list[list[int]], usual: float, reach: float
) -> NDArray[np.intp]:
    """Viterbi's path through the spots that are `left`, (F,)."""
    back: list[NDArray[np.intp]] = []
    cost, places = np.zeros(1), np.full((1, 2), np.nan)
    for here, options in zip(spots, left, strict=True):
        now = np.array([here[i].place for i in options] + [[np.nan, np.nan]])
        dim = np.array([usual / here[i].brightness for i in options])
        own = np.append(np.clip(np.log(dim), 0, None), NONE_COST)
        gap = np.linalg.norm(now[:, None] - places[None], axis=-1) / reach
        step = np.where(np.isnan(gap), 0.0, np.minimum(gap**2, JUMP_COST))
        total = step + cost[None]
        back.append(total.argmin(axis=1))
        cost = total.min(axis=1) + own
        places = now
    state = int(cost.argmin())
    path = np.full(len(spots), -1)
    for f in range(len(spots) - 1, -1, -1):
        path[f] = left[f][state] if state < len(left[f]) else -1
        state = int(back[f][state])
    return path


def _reach(spots: list[list[Spot]], size: tuple[int, int]) -> float:
    """How far a light moves in a frame when it moves fast, pixels."""
    brightest = np.array([s[0].place if s else [np.nan, np.nan] for s in spots])
    steps = np.linalg.norm(np.diff(brightest, axis=0), axis=-1)
    steps = steps[np.isfinite(steps)]
    usual = float(np.median(steps)) if len(steps) else 0.0
    return min(10 + 4 * usual, 0.25 * float(np.hypot(*size)))


def _measured(
    spots: list[list[Spot]], chosen: NDArray[np.intp], noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (F, K, 2) and their standard errors (F, K)."""
    pixels = np.full((*chosen.shape, 2), np.nan)
    errors = np.full(chosen.shape, np.nan)
    for f, k in np.argwhere(chosen >= 0).tolist():
        spot = spots[f][int(chosen[f, k])]
        fit = fit_spot(spot.patch, spot.saturated, noise)
        if fit is not None:
            place, errors[f, k] = fit
            pixels[f, k] = place + spot.corner
    return pixels, errors


def _along(pixels: NDArray[np.float64]) -> NDArray[np.intp]:
    """The order of lights (F, K, 2) along the line on which they lie, (F, K)."""
    centred = np.nan_to_num(pixels - pixels.mean(axis=1, keepdims=True))
    moments = np.einsum("fki,fkj->fij", centred, centred)
    axis = np.linalg.eigh(moments)[1][..., -1]
    return np.argsort(np.einsum("fki,fi->fk", centred, axis), axis=1)


def together(tracks: Sequence[LightTrack]) -> Tracks:
    """What all cameras saw; a recording that ends before others saw nothing afterwards.

    Raises
    ------
    UserError
        Two have the same name, or frames at different rates.

    """
    names = tuple(t.name for t in tracks)
    if twice := [n for n in names if names.count(n) > 1]:
        raise UserError(f"two recordings are called {twice[0]}: name each as its camera")
    rates = {round(t.rate, 2) for t in tracks if t.rate is not None}
    if len(rates) > 1:
        raise UserError(
            f"recordings of {min(rates):g} and {max(rates):g} frames a second do not belong "
            "together: bring them to one rate"
        )
    frames = max(len(t.pixels) for t in tracks)
    pixels = np.full((len(tracks), frames, *tracks[0].pixels.shape[1:]), np.nan)
    errors = np.full(pixels.shape[:3], np.nan)
    for c, track in enumerate(tracks):
        pixels[c, : len(track.pixels)] = track.pixels
        # Compression and the spot's own shape are not in the error of the fit.
        errors[c, : len(track.errors)] = np.hypot(track.errors, SHAPE_ERROR)
    return Tracks(names, tuple(t.size for t in tracks), pixels, errors)
