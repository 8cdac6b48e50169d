"""One map to another, area-correct, with the energy of small bright lights kept.

Reconstruction: a cubic histospline (its cell averages are the pixels) limited to stay above
the smallest neighbour, so that nothing turns negative; where the target is half again as
coarse, the pixels' own areas. What rises far above the mean is scattered as energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap import kernel
from chromeball.envmap.mapping import Mapping

#: A pixel's radiance above this many times the mean is scattered, not sampled. The mean is that
#: of what is not scattered, so a sun does not raise it.
HOT = 20.0

type Quality = Literal["best", "fast"]

#: How far a piece of a hot pixel may reach from its middle, in target pixels.
_REACH: dict[Quality, float] = {"best": 0.25, "fast": 0.5}


@dataclass(frozen=True)
class Warped:
    """A resampled map.

    ``radiance`` (H, W, 3) float32 is the mean over the part of the pixel that the source
    covers; ``coverage`` (H, W) float32 is that part, 0..1. Energies are sums of L dOmega per
    channel: ``source_energy`` of all valid source pixels, ``energy`` of the result
    (times coverage), ``outside`` of hot pixels that the target does not see. ``sigma``
    (H, W, 3) is the radiance's standard deviation, where the source's was given. ``balance``:
    the factors by which the fast way put the channels' energies right.
    """

    radiance: NDArray[np.float32]
    coverage: NDArray[np.float32]
    source_energy: NDArray[np.float64]
    energy: NDArray[np.float64]
    outside: NDArray[np.float64]
    hot_pixels: int
    sigma: NDArray[np.float32] | None = None
    balance: tuple[float, ...] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Survey:
    """What a source holds: ``energy`` (3,), and the radiance ``cap`` that hot pixels exceed."""

    energy: NDArray[np.float64]
    cap: float
    typical: float  # solid angle of a usable pixel


def warp(
    radiance: NDArray[np.float32],
    source: Mapping,
    target: Mapping,
    *,
    rotation: NDArray[np.float64] | None = None,
    valid: NDArray[np.bool_] | None = None,
    smooth: bool | None = None,
    sigma: NDArray[np.float32] | None = None,
    quality: Quality = "best",
) -> Warped:
    """Resample (H, W, 3) `radiance` of `source` to `target`.

    `rotation` turns the world: what lay at d lies at ``rotation @ d``. `valid` (H, W) marks
    the usable pixels; those outside the lens circle are left out in any case. `smooth`
    chooses the spline (True) or the pixels' areas (False); None decides by the density.

    `quality` fast takes one bilinear sample a pixel and, where both maps are whole spheres,
    puts the energy right by one factor a channel; a coarser target is made from the pixels'
    areas in any case.

    `sigma` (H, W, 3), standard deviations of independent pixels, is carried along through the
    weights of the base. Neighbours in the result share source pixels, so their errors are
    correlated: do not add their variances up.

    Raises
    ------
    ValueError
        When an array does not fit its mapping, or radiance is negative or not finite.

    """
    job = Warping(
        radiance,
        source,
        target,
        rotation=rotation,
        valid=valid,
        smooth=smooth,
        sigma=sigma,
        quality=quality,
    )
    band = job.rows(0, target.size[1])
    return Warped(
        radiance=band.radiance,
        coverage=band.coverage,
        source_energy=job.source_energy,
        energy=job.energy,
        outside=job.outside,
        hot_pixels=job.hot_pixels,
        sigma=band.sigma,
        balance=job.balance,
    )


@dataclass(frozen=True)
class Band:
    """Rows ``first`` .. ``last`` - 1 of a result, arrays as those of :class:`Warped`."""

    first: int
    last: int
    radiance: NDArray[np.float32]
    coverage: NDArray[np.float32]
    sigma: NDArray[np.float32] | None


class Warping:
    """A resampling set up, for results that are made by rows; arguments as :func:`warp`.

    It holds the source, the spline around the rows made last, 36 bytes a source pixel there,
    and 32 bytes for each pair of a hot pixel and a pixel it falls on. The rows are the same,
    bit for bit, however they are asked for; the fast way makes its result at once and holds it.
    Energies are those of the rows made so far, each once.
    """

    def __init__(
        self,
        radiance: NDArray[np.float32],
        source: Mapping,
        target: Mapping,
        *,
        rotation: NDArray[np.float64] | None = None,
        valid: NDArray[np.bool_] | None = None,
        smooth: bool | None = None,
        sigma: NDArray[np.float32] | None = None,
        quality: Quality = "best",
    ) -> None:
        shape = (source.size[1], source.size[0], 3)
        for array in (radiance, sigma):
            if array is not None and array.shape != shape:
                raise ValueError(f"{array.shape} does not fit a map of {source.size}")
        radiance = np.ascontiguousarray(radiance, np.float32)
        mask = None if valid is None else np.ascontiguousarray(valid)
        found = survey(lambda cap: kernel.survey(radiance, mask, source.solid, cap), source)
        hot = kernel.hot_pixels(radiance, mask, source.solid, found.cap)
        variance = None
        if sigma is not None:
            variance = np.square(np.where(np.isfinite(sigma), sigma, 0), dtype=np.float32)
        turn = np.eye(3) if rotation is None else rotation
        smooth = is_smooth(source, target, smooth)
        self._kernel = kernel.Resampling(
            radiance,
            mask,
            variance,
            source.solid,
            target.solid,
            np.ascontiguousarray(source.rotation.T @ turn.T @ target.rotation),
            found.cap,
            found.typical,
            smooth,
            _REACH[quality],
        )
        self._kernel.scatter(hot)
        self._sums: list[NDArray[np.float64]] = []
        self._height = target.size[1]
        self._fast: Band | None = None
        self.source_energy = found.energy
        self.hot_pixels = len(hot)
        self.balance: tuple[float, ...] = (1.0, 1.0, 1.0)
        if quality == "fast" and smooth and variance is None:
            whole = mask is None and source.whole and target.whole
            out, coverage, sums, factors = self._kernel.fast(
                found.energy.tolist() if whole else None
            )
            self.balance = tuple(factors)
            self._fast = Band(0, self._height, out, coverage, None)
            self._sums.append(sums)

    def rows(self, first: int, last: int) -> Band:
        """Rows `first` .. `last` - 1."""
        if self._fast is not None:
            return replace(
                self._fast,
                first=first,
                last=last,
                radiance=self._fast.radiance[first:last],
                coverage=self._fast.coverage[first:last],
            )
        out, coverage, variance, sums = self._kernel.rows(first, last)
        self._sums.append(sums)
        sigma = None if variance is None else np.sqrt(variance)
        return Band(first, last, out, coverage, sigma)

    def bands(self, height: int = 64) -> Iterator[Band]:
        """All rows from the top, `height` at a time; what is no longer needed is freed."""
        for first in range(0, self._height, height):
            yield self.rows(first, min(first + height, self._height))
            self._kernel.forget()

    @property
    def energy(self) -> NDArray[np.float64]:
        """Sums of L dOmega per channel of the rows made so far."""
        return self._totals()[:3]

    @property
    def seen(self) -> float:
        """Solid angle that the source covers of the rows made so far, sr."""
        return float(self._totals()[3])

    @property
    def outside(self) -> NDArray[np.float64]:
        """Energy of hot pixels that the target does not see, once all rows are made."""
        return np.array(self._kernel.outside())

    def _totals(self) -> NDArray[np.float64]:
        # all at once: the sum does not depend on the bands
        return np.concatenate(self._sums or [np.zeros((1, 4))]).sum(axis=0)


class Marks:
    """The share of each target pixel that marked source pixels cover, made by rows."""

    def __init__(self, job: Warping) -> None:
        self._job = job

    def rows(self, first: int, last: int) -> NDArray[np.float32]:
        """Rows `first` .. `last` - 1, (last - first, W), 0 .. 1."""
        share = self._job.rows(first, last).radiance[..., 0]
        # pieces that fall to one side or the other of a pixel's edge add up to a little over 1
        return np.minimum(share, np.float32(1))

    @property
    def solid_angle(self) -> float:
        """What is marked in the rows made so far, sr."""
        return float(self._job.energy[0])


def marking(
    mask: NDArray[np.bool_],
    source: Mapping,
    target: Mapping,
    *,
    rotation: NDArray[np.float64] | None = None,
    valid: NDArray[np.bool_] | None = None,
) -> Marks:
    """Marked source pixels (H, W) carried along: none is lost between samples.

    Where few are set they are scattered. It holds 12 bytes a source pixel.
    """
    marks = np.repeat(mask.astype(np.float32)[..., None], 3, axis=2)
    return Marks(Warping(marks, source, target, rotation=rotation, valid=valid, smooth=False))


def carry(
    mask: NDArray[np.bool_],
    source: Mapping,
    target: Mapping,
    *,
    rotation: NDArray[np.float64] | None = None,
    valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """The share of each target pixel, (H, W), that marked source pixels (H, W) cover."""
    found = marking(mask, source, target, rotation=rotation, valid=valid)
    return found.rows(0, target.size[1])


def survey(
    sums_of: Callable[[float], tuple[NDArray[np.float64], int]], source: Mapping
) -> Survey:
    """The survey from ``sums_of(cap)``: sums of each row (H, 5), and the number of bad pixels.

    The sums are over the solid angles: 1, the largest channel under the cap, R, G, B.

    Raises
    ------
    ValueError
        When radiance is negative or not finite.

    """
    sums, bad = sums_of(math.inf)
    if bad:
        raise ValueError(f"radiance of {bad} pixels is negative or not finite")
    covered, top, *energy = sums.sum(axis=0)
    cap = HOT * float(top / covered) if top > 0 else 1.0
    for _ in range(4 if top > 0 else 0):
        before, cap = cap, HOT * float(sums_of(cap)[0][:, 1].sum() / covered)
        if cap > 0.8 * before:
            break
    return Survey(energy=np.array(energy), cap=cap, typical=1 / source.density**2)


def is_smooth(source: Mapping, target: Mapping, wish: bool | None = None) -> bool:
    """Whether a target is fine enough for the spline, or for linear samples."""
    return target.density > source.density / 1.5 if wish is None else wish
