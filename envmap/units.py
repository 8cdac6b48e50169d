"""Absolute units: a map brought to cd/m^2 from readings of a lux meter or a spot meter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.irradiance import irradiance
from chromeball.envmap.mapping import LatLong
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: Standard errors beyond which readings contradict each other.
CONTRADICTION = 3.0


@dataclass(frozen=True)
class Lux:
    """An illuminance meter's reading: ``value`` lux on a surface with that ``normal``."""

    value: float
    normal: Array


@dataclass(frozen=True)
class Spot:
    """A luminance meter's reading: ``value`` cd/m^2 of x, y, width, height px."""

    value: float
    region: tuple[int, int, int, int]


type Reading = Lux | Spot


@dataclass(frozen=True)
class Units:
    """``factor`` makes the map's values cd/m^2; ``sigma`` is its relative standard error.

    ``expected`` (N,) is what the map says for each reading in its own units,
    ``deviations`` (N,) how far each reading is above what the factor says, relative.
    ``chi_square`` is over N - 1.
    """

    factor: float
    sigma: float
    expected: Array
    deviations: Array
    chi_square: float
    warnings: tuple[str, ...]


def absolute_units(
    radiance: Picture,
    readings: Sequence[Reading],
    *,
    accuracy: float = 0.05,
    clipped: NDArray[np.bool_] | None = None,
    valid: NDArray[np.bool_] | None = None,
) -> Units:
    """The factor of a lat-long map (H, W, 3), the weighted mean of what the readings say.

    `accuracy` is the relative standard error of a reading. Where the light of `clipped` pixels
    or of those that are not `valid` reaches the meter, that is told.

    Raises
    ------
    UserError
        Without readings, for one that is none, or where the map is black.

    """
    if not readings:
        raise UserError("no reading: give --lux, or --luminance with its place")
    if not 0 < accuracy < 1:
        raise UserError(f"an accuracy of {accuracy:g}: a part of the reading, as 0.05")
    y = (radiance @ LUMINANCE.astype(np.float32)).astype(np.float32)
    expected = np.array([_expected(radiance, y, r) for r in readings])
    for number, (reading, value) in enumerate(zip(readings, expected, strict=True), 1):
        if not 0 < reading.value < math.inf:
            raise UserError(f"reading {number}, {reading.value:g}: it must be positive")
        if not value > 0:
            raise UserError(f"reading {number}: the map is black where the meter looked")
    logs = np.log([r.value for r in readings]) - np.log(expected)
    # the meter's own accuracy is each reading's; all count alike
    mean = float(logs.mean())
    deviations = np.expm1(logs - mean)
    chi = float(np.sum((logs - mean) ** 2) / accuracy**2)
    freedom = len(readings) - 1
    excess = max(1.0, math.sqrt(chi / freedom)) if freedom else 1.0
    warnings: list[str] = []
    if len(readings) == 2 and chi > CONTRADICTION**2:
        apart = 100 * math.expm1(abs(float(logs[1] - logs[0])))
        warnings.append(f"the two readings differ by {apart:.0f} %")
    elif freedom > 1:
        others = _against_others(logs)
        worst = int(np.argmax(np.abs(others)))
        off = float(others[worst])
        if abs(off) > CONTRADICTION * accuracy * math.sqrt(1 + 1 / freedom):
            told = 100 * math.expm1(off)
            warnings.append(f"reading {worst + 1} is {told:+.0f} % off what the others say")
    for mask, what in (
        (clipped, "was too bright for every exposure: the factor is too large"),
        (None if valid is None else ~valid, "was not seen"),
    ):
        share = _share(radiance, mask, readings)
        if share > 0.01:
            warnings.append(f"{100 * share:.0f} % of the metered light {what}")
    return Units(
        factor=math.exp(mean),
        sigma=excess * accuracy / math.sqrt(len(readings)),
        expected=expected,
        deviations=deviations,
        chi_square=chi,
        warnings=tuple(warnings),
    )


def _against_others(logs: Array) -> Array:
    """Each logarithm's distance from the mean of the others, (N,) with N > 1."""
    n = len(logs)
    return (n * logs - logs.sum()) / (n - 1)


def _expected(radiance: Picture, y: Picture, reading: Reading) -> float:
    match reading:
        case Lux():
            n = np.asarray(reading.normal, float)
            if not (np.isfinite(n).all() and n.any()):
                raise UserError("a normal of length 0 faces nowhere")
            return float(irradiance(radiance, n / np.linalg.norm(n)) @ LUMINANCE)
        case Spot():
            rows, columns = _place(y, reading)
            solid = LatLong((y.shape[1], y.shape[0])).solid_angles()[rows, columns]
            return float((y[rows, columns] * solid).sum() / solid.sum())


def _place(y: Picture, spot: Spot) -> tuple[slice, slice]:
    left, top, across, down = spot.region
    height, width = y.shape
    inside = 0 <= left <= left + across <= width and 0 <= top <= top + down <= height
    if min(across, down) < 1 or not inside:
        raise UserError(
            f"the place {left},{top},{across},{down} lies outside the map of {width}x{height}"
        )
    return np.s_[top : top + down], np.s_[left : left + across]


def _share(
    radiance: Picture, mask: NDArray[np.bool_] | None, readings: Sequence[Reading]
) -> float:
    """The largest part of any reading's light that comes from marked pixels."""
    if mask is None or not mask.any():
        return 0.0
    marked = np.where(mask[..., None], radiance, np.float32(0))
    if not marked.any():
        return 0.0
    both = [marked @ LUMINANCE.astype(np.float32), radiance @ LUMINANCE.astype(np.float32)]
    parts = [
        _expected(marked, both[0].astype(np.float32), r)
        / max(_expected(radiance, both[1].astype(np.float32), r), 1e-300)
        for r in readings
    ]
    return max(parts)
