"""One map to another, area-correct, with the energy of small bright lights kept.

Reconstruction: a cubic histospline (its cell averages are the pixels) limited to stay above
the smallest neighbour, so that nothing turns negative; where the target is half again as
coarse, the pixels' own areas. What rises far above the mean is scattered as energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap import kernel
from chromeball.envmap.mapping import Mapping

#: A pixel's radiance above this many times the map's mean is scattered, not sampled; fewer
#: times in a small map, so that a pixel's sampled part is at most SHARE of the map's energy.
HOT = (4.0, 30.0)
SHARE = 1e-4


@dataclass(frozen=True)
class Warped:
    """A resampled map.

    ``radiance`` (H, W, 3) float32 is the mean over the part of the pixel that the source
    covers; ``coverage`` (H, W) float32 is that part, 0..1. Energies are sums of L dOmega per
    channel: ``source_energy`` of all valid source pixels, ``energy`` of the result
    (times coverage), ``outside`` of hot pixels that the target does not see.
    """

    radiance: NDArray[np.float32]
    coverage: NDArray[np.float32]
    source_energy: NDArray[np.float64]
    energy: NDArray[np.float64]
    outside: NDArray[np.float64]
    hot_pixels: int


def warp(
    radiance: NDArray[np.float32],
    source: Mapping,
    target: Mapping,
    *,
    rotation: NDArray[np.float64] | None = None,
    valid: NDArray[np.bool_] | None = None,
    smooth: bool | None = None,
) -> Warped:
    """Resample (H, W, 3) `radiance` of `source` to `target`.

    `rotation` turns the world: what lay at d lies at ``rotation @ d``. `valid` (H, W) marks
    the usable pixels; those outside the lens circle are left out in any case. `smooth`
    chooses the spline (True) or the pixels' areas (False); None decides by the density.

    Raises
    ------
    ValueError
        When an array does not fit its mapping, or radiance is negative or not finite.

    """
    if radiance.shape != (source.size[1], source.size[0], 3):
        raise ValueError(f"{radiance.shape} does not fit a map of {source.size}")
    solid = source.solid_angles()
    usable = solid > 0
    if valid is not None:
        usable &= valid
    radiance = np.ascontiguousarray(radiance, np.float32)
    red, green, blue = np.moveaxis(radiance, 2, 0)
    top = np.maximum(np.maximum(red, green), blue)  # NaN if any is
    lowest = np.minimum(np.minimum(red, green), blue)
    if not (usable <= (np.isfinite(top) & (lowest >= 0))).all():
        raise ValueError("radiance is negative or not finite")
    if not usable.all():
        top[~usable] = 0
    weight = np.where(usable, solid, 0.0)
    covered = float(weight.sum())
    mean = float((top * weight).sum()) / covered if covered > 0 else 0.0
    target_solid = target.solid_angles()
    if smooth is None:
        smooth = _density(target_solid) > _density(solid) / 1.5
    pixels = covered * _density(solid) ** 2  # pixels in the map
    cap = mean * float(np.clip(SHARE * pixels, *HOT)) if mean > 0 else 1.0
    turn = np.eye(3) if rotation is None else rotation
    source_from_target = source.rotation.T @ turn.T @ target.rotation
    out, coverage, hot, _, outside = kernel.warp(
        radiance,
        np.ascontiguousarray(usable),
        solid.astype(np.float32),
        target_solid.astype(np.float32),
        source.kernel,
        target.kernel,
        np.ascontiguousarray(source_from_target),
        cap,
        bool(smooth),
    )
    energy = np.einsum("hwc,hw->c", out, target_solid * coverage, dtype=np.float64)
    return Warped(
        radiance=out,
        coverage=coverage,
        source_energy=np.einsum("hwc,hw->c", radiance, weight, dtype=np.float64),
        energy=energy,
        outside=np.array(outside),
        hot_pixels=hot,
    )


def _density(solid: NDArray[np.float64]) -> float:
    """Pixels a radian, typically."""
    return float(1 / np.sqrt(np.median(solid[solid > 0][::31])))
