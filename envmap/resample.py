"""One map to another, area-correct, with the energy of small bright lights kept.

Reconstruction: a cubic histospline (its cell averages are the pixels) limited to stay above
the smallest neighbour, so that nothing turns negative; where the target is half again as
coarse, the pixels' own areas. What rises far above the mean is scattered as energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap import kernel
from chromeball.envmap.mapping import Mapping

#: A pixel's radiance above this many times the mean is scattered, not sampled. The mean is that
#: of what is not scattered, so a sun does not raise it.
HOT = 20.0

type Quality = Literal["best", "fast"]


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
    shape = (source.size[1], source.size[0], 3)
    for array in (radiance, sigma):
        if array is not None and array.shape != shape:
            raise ValueError(f"{array.shape} does not fit a map of {source.size}")
    radiance = np.ascontiguousarray(radiance, np.float32)
    mask = None if valid is None else np.ascontiguousarray(valid)
    found = survey(lambda cap: kernel.survey(radiance, mask, source.omega, cap), source)
    hot = kernel.hot_pixels(radiance, mask, source.omega, found.cap)
    variance = None
    if sigma is not None:
        variance = np.square(np.where(np.isfinite(sigma), sigma, 0), dtype=np.float32)
    job = resampling(radiance, source, target, found, rotation, mask, smooth, variance)
    job.scatter(hot)
    balance: tuple[float, ...] = (1.0, 1.0, 1.0)
    if quality == "fast" and is_smooth(source, target, smooth) and variance is None:
        whole = mask is None and source.whole and target.whole
        out, coverage, energy, factors = job.fast(found.energy.tolist() if whole else None)
        balance = tuple(factors)
    else:
        out, coverage, variance, energy = job.rows(0, target.size[1])
    return Warped(
        radiance=out,
        coverage=coverage,
        source_energy=found.energy,
        energy=energy.sum(axis=0),
        outside=np.array(job.outside()),
        hot_pixels=len(hot),
        sigma=None if variance is None else np.sqrt(variance),
        balance=balance,
    )


def carry(
    mask: NDArray[np.bool_],
    source: Mapping,
    target: Mapping,
    *,
    rotation: NDArray[np.float64] | None = None,
    valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """The share of each target pixel, (H, W), that marked source pixels (H, W) cover.

    A mark is not lost between samples: where few are set they are scattered.
    """
    marks = np.repeat(mask.astype(np.float32)[..., None], 3, axis=2)
    share = warp(marks, source, target, rotation=rotation, valid=valid, smooth=False)
    # pieces that fall to one side or the other of a pixel's edge add up to a little over 1
    return np.minimum(share.radiance[..., 0], np.float32(1))


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


def resampling(
    radiance: NDArray[np.float32],
    source: Mapping,
    target: Mapping,
    found: Survey,
    rotation: NDArray[np.float64] | None,
    valid: NDArray[np.bool_] | None,
    smooth: bool | None,
    variance: NDArray[np.float32] | None,
) -> kernel.Resampling:
    """The kernel set up; rows of the result can be asked for in any order."""
    turn = np.eye(3) if rotation is None else rotation
    return kernel.Resampling(
        radiance,
        valid,
        source.omega,
        target.omega,
        variance,
        source.kernel,
        target.kernel,
        np.ascontiguousarray(source.rotation.T @ turn.T @ target.rotation),
        found.cap,
        found.typical,
        is_smooth(source, target, smooth),
    )


def is_smooth(source: Mapping, target: Mapping, wish: bool | None = None) -> bool:
    """Whether a target is fine enough for the spline, or for linear samples."""
    return target.density > source.density / 1.5 if wish is None else wish
