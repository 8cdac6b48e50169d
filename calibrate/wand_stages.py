"""From a start to settled cameras: robust rounds, points found anew, least squares, delays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.wand_adjust import Bundle, Freedom, Sightings, adjust, residuals
from chromeball.calibrate.wand_lens import Unknown
from chromeball.calibrate.wand_start import FEWEST_COMMON, Start, triangulate
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: A light farther off than this many deviations of a coordinate is none.
OUTLIER = 4.0
#: The wand's lengths are kept to this share.
LENGTH_TOLERANCE = 1e-4
#: Lights found anew whose distance is so far off are not those of the wand.
LENGTH_MISS = 0.1
#: A light that changes its speed by more than its speed and so many pixels a frame jumped.
JUMP = 5.0
UNEXPLAINED = (
    "no cameras explain where the lights were seen: are the recordings of the same moment, "
    "in the same order as the lenses?"
)


@dataclass(frozen=True)
class Stages:
    """What all stages need: the sightings, what is unknown of the lenses, and the gauge.

    With `timed` only sightings count whose speed is known.
    """

    sightings: Sightings
    lenses: Unknown
    reference: int
    baseline: int | None
    lengths: tuple[tuple[int, int, float], ...]
    timed: bool = False

    def freedom(
        self, sigma: float, level: int, delays: NDArray[np.bool_] | None = None
    ) -> Freedom:
        """What is unknown when a coordinate's deviation is `sigma` pixels."""
        length = min((item[2] for item in self.lengths), default=math.inf)
        count = len(self.sightings.pixels)
        return Freedom(
            lens=self.lenses.directions(level),
            usual=self.lenses.usual,
            precision=tuple(sigma**2 * p for p in self.lenses.precision),
            delays=np.zeros(count, bool) if delays is None else delays,
            reference=self.reference,
            baseline=self.baseline,
            lengths=self.lengths,
            tolerance=LENGTH_TOLERANCE * length / sigma if self.lengths else math.inf,
        )

    def robust(self, bundle: Bundle, level: int, rounds: int = 3) -> Bundle:
        """Cauchy's estimate, its scale renewed and its points found anew."""
        for turn in range(rounds):
            used = self.plausible(bundle)
            sigma = spread(self.distance(bundle)[used])
            bundle = adjust(
                bundle,
                self.sightings,
                used,
                self.freedom(sigma, level),
                scale=2.4 * sigma,
                steps=15,
                least_gain=1e-3,  # the scale is a rough one, too
            )
            if turn < rounds - 1:
                bundle = self.found_anew(bundle, 6 * sigma)
        return bundle

    def settle(
        self, bundle: Bundle, delays: NDArray[np.bool_] | None = None
    ) -> tuple[Bundle, NDArray[np.bool_]]:
        """Least squares on the lights that fit, until these stay the same; and which."""
        used = np.zeros(self.sightings.weights.shape, bool)
        sigma = spread(self.distance(bundle)[self.plausible(bundle)])
        for turn in range(10):
            fits = alive(self.plausible(bundle) & (self.distance(bundle) < OUTLIER * sigma))
            if (fits == used).all():
                break
            used = fits
            if used.sum() < 2 * FEWEST_COMMON:
                raise UserError(UNEXPLAINED)
            bundle = adjust(
                bundle, self.sightings, used, self.freedom(sigma, 3, delays), steps=20
            )
            sigma = self.sigma(bundle, used)
            if turn == 0:  # once: else what is rejected would come back for ever
                bundle = self.found_anew(bundle, OUTLIER * sigma, lost=~used.any(axis=(0, 2)))
        return bundle, used

    def distance(self, bundle: Bundle) -> NDArray[np.float64]:
        """Of projected and observed lights, in pixels of mean weight, (C, F, K)."""
        error = residuals(bundle, self.sightings)
        return np.sqrt((error**2).sum(axis=-1) * self.sightings.weights)

    def plausible(self, bundle: Bundle) -> NDArray[np.bool_]:
        """Sightings of points that are there and that the lenses reach, (C, F, K)."""
        there = np.isfinite(self.distance(bundle))
        if self.timed:
            there &= np.isfinite(self.sightings.speeds[..., 0])
        return alive(there)

    def found_anew(
        self, bundle: Bundle, miss: float, lost: NDArray[np.bool_] | None = None
    ) -> Bundle:
        """Points anew from the cameras, of the frames that are `lost` (F,) or of all."""
        frames = np.ones(len(bundle.points), bool) if lost is None else lost
        if not frames.any():
            return bundle
        pixels = self.sightings.frames(frames).pixels
        rays, angle = rays_of(bundle.cameras, pixels)
        some = np.ones(len(rays), bool)
        start = Start(
            bundle.rotations, bundle.translations, bundle.points, some, ~some[:, None]
        )
        found = triangulate(rays, start, miss * angle)
        for first, second, length in self.lengths:
            apart = np.linalg.norm(found[:, first] - found[:, second], axis=-1)
            found[np.abs(apart / length - 1) > LENGTH_MISS] = np.nan
        points = bundle.points.copy()
        points[frames] = found
        return replace(bundle, points=points)

    def sigma(self, bundle: Bundle, used: NDArray[np.bool_]) -> float:
        """Deviation of a coordinate, freed from the fitted unknowns."""
        square = float((self.distance(bundle)[used] ** 2).sum())
        shared = self.freedom(1.0, 3).columns(bundle)[-1][2].stop
        frames = int(used.any(axis=(0, 2)).sum())
        unknown = shared + frames * (3 * used.shape[2] - len(self.lengths))
        measured = 2 * int(used.sum())
        if measured <= unknown:
            raise UserError("too few lights fit to judge the cameras: record more")
        return max(math.sqrt(square / (measured - unknown)), 1e-9)


def at_delays(
    sightings: Sightings, pixels: NDArray[np.float64], delays: NDArray[np.float64]
) -> Sightings:
    """What a camera with each of `delays` (C,), frames, saw at the common instants.

    `pixels` (C, F, K, 2) are its own frames; a parabola through three of them gives what was
    between. The speed is NaN where nothing is known beside a frame.
    """
    shifted, speeds = np.full(pixels.shape, np.nan), np.full(pixels.shape, np.nan)
    frames = pixels.shape[1]
    for c, delay in enumerate(delays.tolist()):
        whole = round(delay)
        rest = delay - whole
        padded = np.full((frames + 2, *pixels.shape[2:]), np.nan)
        source = np.arange(-1, frames + 1) - whole
        inside = (source >= 0) & (source < frames)
        padded[inside] = pixels[c, source[inside]]
        before, here, after = padded[:-2], padded[1:-1], padded[2:]
        # A wand's other end may come first in the next frame.
        before, after = (_like(here, other) for other in (before, after))
        # Where one of the three is missing, a line through the others.
        before = np.where(np.isfinite(before), before, 2 * here - after)
        after = np.where(np.isfinite(after), after, 2 * here - before)
        speed, bend = (after - before) / 2, after - 2 * here + before
        rough = np.linalg.norm(bend, axis=-1) > np.linalg.norm(speed, axis=-1) + JUMP
        speed[rough] = np.nan
        speeds[c] = speed - rest * bend
        shifted[c] = here - rest * speed + rest**2 / 2 * bend if rest else here
    return replace(sightings, pixels=shifted, speeds=speeds, delays=delays.copy())


def _like(here: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lights (F, K, 2) of another frame in the order in which they are nearest to `here`."""
    turned = other[:, ::-1]
    same, swapped = (((p - here) ** 2).sum(axis=(1, 2)) for p in (other, turned))
    return np.where((swapped < same)[:, None, None], turned, other)


def alive(used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those of `used` (C, F, K) in frames all of whose lights two cameras see."""
    return used & (used.sum(axis=0) >= 2).all(axis=-1)[:, None]


def spread(distance: NDArray[np.float64]) -> float:
    """Deviation of a coordinate by the median distance."""
    if not distance.size:
        raise UserError(UNEXPLAINED)
    return max(float(np.median(distance)) / math.sqrt(2 * math.log(2)), 1e-9)


def rays_of(
    cameras: tuple[CameraModel, ...], pixels: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit rays (C, F, K, 3) of pixels, and the angle of a pixel there, radians, (C,)."""
    rays = np.array([c.unproject(q) for c, q in zip(cameras, pixels, strict=True)])
    beside = np.array([c.unproject(q + [1.0, 0]) for c, q in zip(cameras, pixels, strict=True)])
    step = np.linalg.norm(beside - rays, axis=-1).reshape(len(rays), -1)
    angle = [float(np.median(s[np.isfinite(s)])) if np.isfinite(s).any() else 0.0 for s in step]
    return rays, np.array(angle)
