"""How much light each frame was given, and how much light that is in cd/m^2.

Cameras name their shutter times: 1/30 is 1/32 s, 13 s is 12.7 s (a series of exact thirds of a
stop); :func:`exact_times` undoes that. :func:`contradictions` compares what EXIF and maker
notes say, :func:`check_exposures` what the pictures show. :func:`luminance_scale` makes
radiance absolute from a reading; without one none is claimed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.color import LUMINANCE, srgb_decode
from chromeball.scene.errors import UserError
from chromeball.scene.image import positive, read_header
from chromeball.scene.tags import read_canon

type Float = NDArray[np.float64]

#: stops by which two statements of one exposure may differ: names are rounded by up to 0.18
AGREE = 0.3
#: ln exposure from which a frame is suspicious, with the response known and unknown: beyond
#: cameras' rounding and the drift of light, below a factor of two
SUSPICIOUS, SUSPICIOUS_UNKNOWN = 0.25, 0.4
#: codes of 255 between which a frame measures, unknown response
_USABLE = (12, 243)
#: pixels that two frames must both measure
_FEWEST = 50


# -- metadata ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Statement:
    """One thing that metadata state: ``time`` in s, ``aperture`` or ``iso``, and where."""

    quantity: str
    source: str
    value: float


def statements(path: str | os.PathLike[str]) -> list[Statement]:
    """All that a picture's EXIF and maker note state of its exposure; nonsense is left out.

    Raises
    ------
    UserError
        When the file is missing or no picture.

    """
    attributes = read_header(path).attributes
    found = [
        ("time", "ExposureTime", positive(attributes.get("ExposureTime"))),
        ("time", "ShutterSpeedValue", _apex(attributes.get("Exif:ShutterSpeedValue"), -1.0)),
        ("aperture", "FNumber", positive(attributes.get("FNumber"))),
        ("aperture", "ApertureValue", _apex(attributes.get("Exif:ApertureValue"), 0.5)),
        ("iso", "ISO", positive(attributes.get("Exif:PhotographicSensitivity"))),
        ("iso", "ISOSpeedRatings", positive(attributes.get("Exif:ISOSpeedRatings"))),
        ("iso", "ISOSpeed", positive(attributes.get("Exif:ISOSpeed"))),
    ]
    canon = read_canon(path)
    if canon is not None:
        found += [
            ("time", "Canon's maker note", canon.time),
            ("aperture", "Canon's maker note", canon.aperture),
            ("iso", "Canon's maker note", canon.iso),
        ]
    return [Statement(what, where, value) for what, where, value in found if value is not None]


def contradictions(path: str | os.PathLike[str]) -> list[str]:
    """What a picture's metadata say against themselves or leave open, a sentence each.

    Statements that differ by more than :data:`AGREE` stops (an f-number by half as many, for
    its square counts), and a built-in neutral-density filter, whose density is not stated.
    """
    found: list[str] = []
    by_quantity: dict[str, list[Statement]] = {}
    for statement in statements(path):
        by_quantity.setdefault(statement.quantity, []).append(statement)
    for quantity, said in by_quantity.items():
        first = said[0]
        weight = 2 if quantity == "aperture" else 1
        for other in said[1:]:
            if weight * abs(math.log2(other.value / first.value)) > AGREE:
                found.append(
                    f"{first.source} says {_named(quantity, first.value)}, "
                    f"{other.source} {_named(quantity, other.value)}"
                )
    canon = read_canon(path)
    if canon is not None and canon.nd:
        found.append("the camera's own ND filter was in: give its density with --nd")
    return found


def transmissions(stops: Sequence[float], frames: int) -> Float:
    """Transmission of neutral-density filters of `stops`, one for all frames or one a frame.

    Raises
    ------
    UserError
        Another number of filters, or a density that is negative or not finite.

    """
    if len(stops) not in (1, frames):
        raise UserError(
            f"{len(stops)} ND filters for {frames} pictures: give one, or one a picture"
        )
    for value in stops:
        if not (math.isfinite(value) and 0 <= value <= 60):
            raise UserError(f"an ND filter of {value:g} stops: give 0 to 60, 3 for an ND8")
    return np.broadcast_to(np.exp2(-np.array(stops, np.float64)), (frames,)).copy()


#: What cameras write, in thirds and halves of a stop from 1 s up; below one second they write
#: 1/N with N from the second list (EXIF and dials of Canon, Nikon, Sony and others)
_LONG = {
    3: "1 1.3 1.6 2 2.5 3.2 4 5 6 8 10 13 15 20 25 30",
    2: "1 1.5 2 3 4 6 8 10 15 20 30",
}
_SHORT = {
    3: "1 1.25 1.6 2 2.5 3 4 5 6 8 10 13 15 20 25 30 40 50 60 80 100 125 160 200 250 320 400 "
    "500 640 800 1000 1250 1600 2000 2500 3200 4000 5000 6400 8000 10000 12800 16000",
    2: "1 1.5 2 3 4 6 8 10 15 20 30 45 60 90 125 180 250 350 500 750 1000 1500 2000 3000 4000 "
    "6000 8000 12000 16000",
}
#: the same step under another name
_ALSO = {
    3: {3.0: 5, 0.3: -5, 1 / 3.2: -5, 0.4: -4, 0.5: -3, 0.6: -2, 0.8: -1},
    2: {0.7: -1},
}


def exact_times(times: Sequence[float]) -> Float | None:
    """The exact times 2^(k/3) or 2^(k/2) s behind a bracket's nominal ones, in s.

    None unless every time is a name of one series (thirds are tried first): times that were
    measured, or typed in exactly, are left alone.
    """
    for parts in (3, 2):
        table = _series(parts)
        steps: list[int] = []
        for time in times:
            near = min(table, key=lambda name: abs(math.log(name / time)))
            if abs(near / time - 1) > 0.01:
                break
            steps.append(table[near])
        else:
            return np.exp2(np.array(steps, np.float64) / parts)
    return None


def _series(parts: int) -> dict[float, int]:
    table = {float(name): k for k, name in enumerate(_LONG[parts].split())}
    table |= {1 / float(name): -k for k, name in enumerate(_SHORT[parts].split())}
    return table | _ALSO[parts]


def _apex(value: Any, power: float) -> float | None:
    """2^(power value) of an APEX value; 0 stands in empty EXIF as often as in true ones."""
    if isinstance(value, int | float) and math.isfinite(value) and value and abs(value) < 32:
        return float(2.0 ** (power * value))
    return None


def _named(quantity: str, value: float) -> str:
    return {"time": seconds(value), "aperture": f"f/{value:.3g}"}.get(
        quantity, f"ISO {value:g}"
    )


def seconds(time: float) -> str:
    """``1/30 s`` or ``2.5 s``."""
    return f"1/{1 / time:.4g} s" if time < 0.3 else f"{time:.4g} s"


# -- the pictures -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Suspicion:
    """A frame whose brightness does not fit its stated exposure.

    ``ratio`` is the exposure that the pictures show over the stated one, ``error`` its standard
    error in ln units (NaN where the response is unknown); ``exposure`` the better value.
    """

    frame: int
    stated: float
    exposure: float
    ratio: float
    error: float

    def message(self, name: str) -> str:
        """A sentence about the frame called `name`."""
        spread = "" if math.isnan(self.error) else f" +- {100 * self.error:.1f} %"
        return (
            f"{name}: its exposure is stated as {self.stated:.4g}, but its brightness beside "
            f"the other frames' says {self.exposure:.4g} ({self.ratio:.3g} times{spread})"
        )


def lattice(pixels: NDArray[Any], count: int = 100_000) -> NDArray[Any]:
    """About `count` pixels of (H, W, C) on a square grid, (N, C); the same for equal sizes."""
    step = max(1, int(math.sqrt(pixels.shape[0] * pixels.shape[1] / count)))
    return pixels[step // 2 :: step, step // 2 :: step].reshape(-1, pixels.shape[2])


def check_exposures(
    samples: Sequence[NDArray[Any]],
    exposures: ArrayLike,
    log_exposure: Float | None = None,
    white: float | None = None,
) -> list[Suspicion]:
    """Frames whose brightness contradicts their exposures: swapped, repeated, off by a factor.

    The ln exposure between neighbours is the median over the pixels that both measure, so that
    moved things do not count. Summed up and taken from the stated ones, a wrong frame stands
    out from the median of all.

    Parameters
    ----------
    samples
        Codes or linear values of the same pixels in each frame, (N, C), see :func:`lattice`.
    exposures
        What is stated, (P,).
    log_exposure
        The response, (C, codes), if it is known. Otherwise, for integers, a rough one is
        fitted on the way, for which most exposures must be right; of two frames it shows the
        order alone.
    white
        The saturated value of linear samples (uint16 or float), by default the largest.

    Returns
    -------
    list[Suspicion]
        In the frames' order; empty when all fits.

    Raises
    ------
    UserError
        When numbers or shapes do not fit.

    """
    stated = np.log(np.asarray(exposures, np.float64))
    if len(samples) != stated.size or stated.size < 2:
        raise UserError(
            f"{stated.size} exposures for {len(samples)} frames: two or more needed"
        )
    if len({s.shape for s in samples}) != 1 or len({s.dtype for s in samples}) != 1:
        raise UserError("the frames of a bracket must have one size and one depth")
    known = log_exposure is not None or np.issubdtype(samples[0].dtype, np.floating)
    order = np.argsort([_rank(s) for s in samples], kind="stable")
    wanted = np.diff(stated[order])
    values = _log_values(samples, log_exposure, white)
    pairs = [_common(values[a], values[b]) for a, b in pairwise(order)]
    if known:
        measured = [_median(b - a) for a, b in pairs]
        steps, errors = np.array(measured).T
    else:
        steps, errors = _fitted_steps(pairs, wanted), np.full(len(pairs), math.nan)
    seen = np.isfinite(steps)
    # across a gap that no pixel bridges, the stated step stands
    shown = np.concatenate([[0], np.cumsum(np.where(seen, steps, wanted))])
    off = shown - stated[order]
    off -= np.median(off) if off.size > 2 else off[0]
    variance = np.concatenate([[0], np.cumsum(np.where(seen, errors, 0) ** 2)])
    found: list[Suspicion] = []
    for k, frame in enumerate(order):
        error = math.sqrt(variance[k]) if known else math.nan
        if abs(off[k]) > (SUSPICIOUS + 4 * error if known else SUSPICIOUS_UNKNOWN):
            before, ratio = math.exp(stated[frame]), math.exp(off[k])
            found.append(Suspicion(int(frame), before, before * ratio, ratio, error))
    return sorted(found, key=lambda suspicion: suspicion.frame)


def _rank(sample: NDArray[Any]) -> float:
    """Brightness of a frame for ordering; finite for all finite pictures."""
    values = sample.astype(np.float64)
    return float(np.mean(np.sqrt(np.maximum(values[np.isfinite(values)], 0))))


def _log_values(
    samples: Sequence[NDArray[Any]], log_exposure: Float | None, white: float | None
) -> list[Float]:
    """Ln exposure of each value, NaN where it is black or saturated."""
    if np.issubdtype(samples[0].dtype, np.floating):
        top = white or max(float(np.nanmax(s)) for s in samples)
        floor = 2e-3 * top
        return [
            np.where((s > floor) & (s < 0.98 * top), np.log(np.maximum(s, floor)), np.nan)
            for s in (sample.astype(np.float64) for sample in samples)
        ]
    top = white or float(np.iinfo(samples[0].dtype).max)
    low, high = (share / 255 * top for share in _USABLE)
    out: list[Float] = []
    for sample in samples:
        z = np.arange(int(np.iinfo(sample.dtype).max) + 1)
        if log_exposure is None:
            values = np.log(np.maximum(srgb_decode(z / top), 1e-6))[sample]
        else:
            if log_exposure.shape != (sample.shape[1], z.size):
                raise UserError(
                    f"a response of {log_exposure.shape} for {sample.shape[1]} channels of "
                    f"{sample.dtype} codes: it is of another camera"
                )
            values = log_exposure[np.arange(sample.shape[1]), sample]
        out.append(np.where((sample > low) & (sample < high), values, np.nan))
    return out


def _common(a: Float, b: Float) -> tuple[Float, Float]:
    """The values that both frames measure; none where they are too few to tell."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < _FEWEST:
        both[:] = False
    return a[both], b[both]


def _median(values: Float) -> tuple[float, float]:
    """The median with its standard error, from the quartiles; NaN of nothing."""
    if not values.size:
        return math.nan, math.nan
    quarter, middle, three = np.percentile(values, [25, 50, 75])
    # 1.2533 sigma / sqrt(n); neighbouring pixels are alike: a tenth of them count
    error = 1.2533 * (three - quarter) / 1.349 / math.sqrt(values.size / 10)
    return float(middle), float(error)


def _fitted_steps(pairs: Sequence[tuple[Float, Float]], wanted: Float) -> Float:
    """Steps in ln exposure by a response g(u) = c . (u, x, x^2), x = e^u, fitted to them.

    u is the ln exposure of sRGB. Each pair gives equations g(u_b) - g(u_a) = wanted, medians
    over groups of equal brightness; pairs weigh 1 / |misfit| (least absolute deviations), so
    that a minority of wrong exposures does not bend the curve. Of two frames, the step is the
    wanted one with the sign that the pictures show.
    """
    seen = [k for k, (a, _) in enumerate(pairs) if a.size]
    steps = np.full(len(pairs), math.nan)
    if len(pairs) == 1 and seen:
        shown, _ = _median(pairs[0][1] - pairs[0][0])
        steps[0] = abs(wanted[0]) if shown > 0.05 else min(0.0, shown)
        return steps
    groups = [_groups(*pairs[k]) for k in seen]
    wanted = np.abs(wanted)  # the frames come from dark to bright, and a response rises
    plain = np.array([1.0, 0, 0])
    # a curve for three pictures or fewer is their contrast alone
    stiffness = np.diag([0.01, *([0.05] * 2 if len(seen) > 2 else [1e6] * 2)])
    c, weights = plain, np.ones(len(seen))
    for _ in range(30):
        normal, right = stiffness.copy(), stiffness @ plain
        for group, target, weight in zip(groups, wanted[seen], weights, strict=True):
            normal += weight * group.T @ group / len(group)
            right += weight * group.mean(axis=0) * target
        c = np.linalg.solve(normal, right)
        misfit = np.array([(g @ c).mean() for g in groups]) - wanted[seen]
        weights = 1 / np.maximum(np.abs(misfit), 0.03)
    steps[seen] = [np.median(g @ c) for g in groups]
    return steps


def _groups(a: Float, b: Float, count: int = 24) -> Float:
    """Median differences of (u, x, x^2) over groups of pixels of one brightness, (count, 3)."""
    order = np.argsort(a + b, kind="stable")
    basis = [np.stack([v, np.exp(v), np.exp(2 * v)], axis=1) for v in (a, b)]
    difference = (basis[1] - basis[0])[order]
    parts = np.array_split(difference, min(count, max(1, a.size // 20)))
    return np.array([np.median(part, axis=0) for part in parts])


# -- absolute luminance -----------------------------------------------------------------------


@dataclass(frozen=True)
class Luminance:
    """A calibration to cd/m^2: ``scale`` is the luminance of value 1.

    ``luminance`` of the measured place in cd/m^2, ``mean`` of its values, and ``error``, the
    relative standard error of that mean over its ``pixels``.
    """

    scale: float
    luminance: float
    mean: float
    error: float
    pixels: int

    def attributes(self, *, scaled: bool = False) -> dict[str, float]:
        """OpenEXR's ``whiteLuminance``; 1 where the pixels were multiplied by ``scale``."""
        return {"whiteLuminance": 1.0 if scaled else self.scale}


def grey_card(reflectance: float, illuminance: float) -> float:
    """Luminance in cd/m^2 of a matt card of `reflectance` under `illuminance` lux, rho E / pi.

    Raises
    ------
    UserError
        When the reflectance is not in 0 .. 1, or the illuminance not positive.

    """
    if not 0 < reflectance <= 1:
        raise UserError(f"a reflectance of {reflectance:g}: give a share, 0.18 for a grey card")
    if not (math.isfinite(illuminance) and illuminance > 0):
        raise UserError(f"an illuminance of {illuminance:g} lux: give a positive number")
    return reflectance * illuminance / math.pi


def luminance_scale(
    radiance: NDArray[np.floating],
    place: tuple[int, int] | tuple[int, int, int, int],
    luminance: float,
    *,
    clipped: NDArray[np.bool_] | None = None,
    radius: int = 3,
) -> Luminance:
    """Calibrate radiance by a light-meter reading of a place in the picture.

    Parameters
    ----------
    radiance
        (H, W, C), C of 1 or 3 (linear Rec.709).
    place
        A point x, y (the square of `radius` about it counts) or a rectangle x, y, width,
        height, in pixels.
    luminance
        The reading in cd/m^2, or :func:`grey_card`.
    clipped
        Pixels that are no measurement, (H, W).
    radius
        Half the side of a point's square.

    Raises
    ------
    UserError
        A place that is empty, not wholly in the picture, clipped, black or negative, or a
        reading that is not positive.

    """
    if not (math.isfinite(luminance) and luminance > 0):
        raise UserError(f"a reading of {luminance:g} cd/m^2: give a positive number")
    height, width = radiance.shape[:2]
    if len(place) == 2:
        x, y = place[0] - radius, place[1] - radius
        across = down = 2 * radius + 1
    else:
        x, y, across, down = place
    text = f"{across} x {down} pixels at x {x}, y {y}"
    if across < 1 or down < 1:
        raise UserError(f"the measured place is empty: {text}")
    if x < 0 or y < 0 or x + across > width or y + down > height:
        raise UserError(
            f"the measured place, {text}, is not in the picture of {width} x {height}"
        )
    part = radiance[y : y + down, x : x + across].astype(np.float64)
    if not np.isfinite(part).all():
        raise UserError(f"the measured place, {text}, holds NaN or infinite values")
    if clipped is not None:
        count = int(clipped[y : y + down, x : x + across].sum())
        if count:
            raise UserError(
                f"{count} pixels of the measured place, {text}, are clipped: take shorter or "
                "longer exposures, or another place"
            )
    values = part @ LUMINANCE if part.shape[2] == 3 else part[..., 0]
    mean = float(values.mean())
    if not mean > 0:
        raise UserError(f"the measured place, {text}, is black: choose a lit one")
    error = float(values.std() / mean / math.sqrt(values.size))
    return Luminance(luminance / mean, luminance, mean, error, values.size)
