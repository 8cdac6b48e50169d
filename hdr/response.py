"""The response curve of a camera from a bracket (row P12): what goes in, what comes out.

Two solvers: the comparagram solve with a prior over real curves
(:mod:`chromeball.hdr.comparagram`), the default, and Debevec and Malik's
(:mod:`chromeball.hdr.debevec`), exactly as published. Exposures are checked on the way: one
that contradicts the pictures is found, named and replaced by what they show, and nominal times
are refined where that explains the pictures better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from chromeball.hdr import comparagram, debevec, kernel
from chromeball.hdr.comparagram import Rows
from chromeball.hdr.knots import (
    KNOTS,
    MIDDLE,
    as_codes,
    at_codes,
    at_knots,
    codes_at_knots,
    fixed_point,
)
from chromeball.hdr.prior import Prior, known_cameras
from chromeball.hdr.response_file import Exposed, Response
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]
type Method = Literal["comparagram", "debevec"]

#: knots over which a patch may spread
SPREAD = 16
#: patches are made larger until there are no more than this
MOST_PATCHES = 1_200_000
#: the least rise of g from one knot to the next
LEAST_STEP = 1e-4
#: standard deviation of nominal times, in ln units
NOMINAL = 0.1
#: log evidence that speaks for other exposures than those given
DECISIVE = 10.0
#: a single exposure off by more than this (ln units) is an error, not a rounding
WRONG = 0.2
#: knots by which a patch must change to be light, and how bright it must be to tell
UNCHANGING, BRIGHT_ENOUGH = 3.0, 24.0
#: knots that rows must tell of
FEWEST_KNOTS = 12


@dataclass(frozen=True)
class Sample:
    """What one frame gives: knots of its patches, and single pixels for the noise."""

    patches: NDArray[np.uint16]  # (N, C), 8.8 fixed point, 0xffff where unusable
    pixels: NDArray[np.uint16]  # (n, C), likewise
    patch: int
    codes: int
    dark: float  # share of values at the lowest code
    bright: float  # share at the highest
    scene: int = 0  # frames of one scene and view share this number


def sample(
    frame: NDArray[Any], codes: int = KNOTS, patch: int | None = None, scene: int = 0
) -> Sample:
    """Reduce a frame (H, W, C), uint8 or uint16, to what the solvers need.

    `patch` in pixels a side; 1 keeps every pixel. Only frames of one `scene` are compared.
    """
    frame = np.ascontiguousarray(as_codes(frame, codes))
    height, width = frame.shape[:2]
    if patch is None:
        least = 2 if height * width >= 40_000 else 1
        patch = max(least, int(np.ceil(np.sqrt(height * width / MOST_PATCHES))))
    if patch < 1 or patch > min(height, width):
        raise UserError(f"a patch of {patch} pixels does not fit {width} x {height}")
    stride = max(1, int(np.sqrt(height * width / 100_000)))
    lattice = np.ascontiguousarray(frame[::stride, ::stride])
    knot = fixed_point(codes)
    return Sample(
        patches=kernel.patches(frame, knot, patch, SPREAD if patch > 1 else KNOTS),
        pixels=kernel.patches(lattice, knot, 1, KNOTS),
        patch=patch,
        codes=codes,
        dark=float(np.mean(lattice == 0)),
        bright=float(np.mean(lattice == codes - 1)),
        scene=scene,
    )


@dataclass(frozen=True)
class Solution:
    """Curves and how good they are.

    ``g`` and ``sigma`` (C, codes): ln exposure of each code, zero at the middle one, and its
    standard error. ``log_exposures`` (P,): as given, corrected, or refined. ``rms`` and
    ``rms_nominal`` (C,): residual in ln units, of the equations solved. ``chi_square`` (C,):
    of the same over its expectation. ``code_noise`` (C,): standard deviation of a pixel in
    codes, the median over those observed. ``observed`` (C, 256): patches that tell of a knot.
    ``repaired`` (C,): knots that were moved to make a curve rise. ``condition`` (C,): of the
    matrix solved. ``wrong``: frames whose exposure contradicts the pictures, with the factor
    to what was given. ``unchanging``: share of patches that no exposure changes.
    ``frame_residual`` (P,): RMS residual in ln units of the equations that a frame takes part
    in, NaN where it takes part in none. ``extra``: figures of the one method.
    """

    method: Method
    g: Float
    sigma: Float
    log_exposures: Float
    rms: Float
    rms_nominal: Float
    chi_square: Float
    code_noise: Float
    observed: Float
    used: NDArray[np.int64]
    repaired: NDArray[np.int64]
    condition: Float
    patch: int
    refined: bool
    wrong: tuple[tuple[int, float], ...]
    unchanging: float
    frame_residual: Float
    extra: dict[str, Any]


def solve(
    samples: Sequence[Sample],
    exposures: Float,
    *,
    method: Method = "comparagram",
    prior: Prior | None = None,
    smoothness: float = debevec.SMOOTHNESS,
    refine_times: bool | None = None,
) -> Solution:
    """Solve for the response of every channel.

    `exposures` (P,) are relative and positive. With `refine_times` the log exposures are
    unknowns too, shared by the channels, their span kept; ``None`` refines them where the
    pictures say so decisively (comparagrams only). `prior` is that of known cameras unless
    given; `smoothness` is Debevec and Malik's lambda.

    Raises
    ------
    UserError
        When the bracket cannot determine a curve; the message says why.

    """
    order = np.argsort(exposures, kind="stable")
    samples = [samples[k] for k in order]
    log_exposures = np.log(exposures[order])
    _refuse(samples, log_exposures, smoothness)
    if method == "debevec":
        found = _debevec(samples, log_exposures, smoothness, bool(refine_times))
    else:
        found = _comparagram(samples, log_exposures, prior or known_cameras(), refine_times)
    back = np.argsort(order, kind="stable")
    return replace(
        found,
        log_exposures=found.log_exposures[back],
        frame_residual=found.frame_residual[back],
        wrong=tuple(sorted((int(order[k]), factor) for k, factor in found.wrong)),
    )


def _comparagram(
    samples: Sequence[Sample], log_exposures: Float, prior: Prior, refine: bool | None
) -> Solution:
    codes = samples[0].codes
    channels, pairs, unchanging = observe(samples, log_exposures)
    _refuse_few(channels, samples)
    if 2 * np.sum([_brighter(rows) for rows in channels]) < len(channels):
        _refuse_falling()
    mean, factors = prior.at(codes)
    P = len(log_exposures)
    fit = comparagram.fit(channels, pairs, log_exposures, mean, factors)
    given = fit.residuals(mean)

    wrong: dict[int, float] = {}
    while P >= 3 and len(wrong) < P // 3:
        k, off = _worst(fit, exclude=wrong)
        if k is None:
            break
        wrong[k] = off
        log_exposures = log_exposures.copy()
        log_exposures[k] += off
        channels, pairs, unchanging = observe(samples, log_exposures)
        fit = comparagram.fit(channels, pairs, log_exposures, mean, factors)

    shift = np.zeros(P)
    if refine is not False and P >= 3:
        gain, moved = fit.gain(NOMINAL * span_kept(log_exposures, np.diag(fit.S)))
        if refine or gain > DECISIVE:
            shift = moved
    refined = bool(np.any(shift))
    if refined:
        log_exposures = log_exposures + shift
        for far in np.flatnonzero(np.abs(shift) > WRONG).tolist():
            wrong[far] = wrong.get(far, 0.0) + float(shift[far])
        fit = comparagram.fit(channels, pairs, log_exposures, mean, factors)
    if len(channels) > 1:
        fit = comparagram.share(fit, mean, factors)
    g = np.stack(
        [
            darkened(c, rows.darkness, rows.pedestal)
            for c, rows in zip(fit.g, channels, strict=True)
        ]
    )
    rise = g[:, 240] - g[:, 16]
    if np.any(rise <= 0):
        _refuse_falling()
    residuals = fit.residuals(mean)
    middle = fit.covariance[:, MIDDLE, MIDDLE, None]
    variance = (
        np.diagonal(fit.covariance, axis1=1, axis2=2) + middle - 2 * fit.covariance[:, MIDDLE]
    )
    chi_square = np.array(
        [np.mean(r**2 * e.w) for r, e in zip(residuals, fit.equations, strict=True)]
    )
    # rows that scatter by more than they should make the curve as much less certain
    sigma = np.sqrt(np.maximum(variance, 0) * np.maximum(chi_square, 1)[:, None])
    risen = np.stack([strictly_rising(c, e) for c, e in zip(g, sigma, strict=True)])
    moved_knots = (np.abs(risen - g) > 1e-9).sum(axis=1)
    risen -= risen[:, MIDDLE, None]
    sigma = np.maximum(sigma, np.abs(risen - (g - g[:, MIDDLE, None])))
    for error, rows in zip(sigma, channels, strict=True):
        if rows.pedestal > 0:  # darkness tells nothing of exposure
            error[: int(np.ceil(rows.pedestal))] = np.maximum(
                error[: int(np.ceil(rows.pedestal))], 1.0
            )
    observed = np.stack([_observed(rows) for rows in channels])
    return Solution(
        method="comparagram",
        g=_zeroed(at_codes(risen, codes)),
        sigma=at_codes(sigma, codes),
        log_exposures=log_exposures,
        rms=_rms(residuals),
        rms_nominal=_rms(given),
        chi_square=chi_square,
        code_noise=_code_noise(samples, log_exposures, risen, fit),
        observed=observed,
        used=np.array([int(rows.count.sum()) for rows in channels]),
        repaired=moved_knots,
        condition=np.array(
            [_condition(e, factors[q]) for e, q in zip(fit.equations, fit.model, strict=True)]
        ),
        patch=samples[0].patch,
        refined=refined,
        wrong=tuple((k, float(np.exp(v))) for k, v in sorted(wrong.items())),
        unchanging=unchanging,
        frame_residual=_by_frame(residuals, channels, pairs, P),
        extra={
            "roughness": fit.model,
            "pairs": len(pairs),
            "darkness": [rows.darkness for rows in channels],
        },
    )


def observe(
    samples: Sequence[Sample],
    log_exposures: Float,
    what: Literal["patches", "pixels"] = "patches",
) -> tuple[list[Rows], list[tuple[int, int]], float]:
    """Rows of each channel, their pairs of frames, and the share of what nothing changes."""
    pairs: list[tuple[int, int]] = []
    ridges: list[Float] = []
    still: list[NDArray[np.uint8]] = []
    for scene in sorted({s.scene for s in samples}):
        own = np.array([k for k, s in enumerate(samples) if s.scene == scene])
        frames = [getattr(samples[k], what) for k in own]
        among = comparagram.pair(log_exposures[own])
        if not among:
            continue
        still.append(kernel.unchanging(frames, UNCHANGING, BRIGHT_ENOUGH))
        ridges.append(kernel.ridges(frames, among, still[-1]))
        pairs += [(int(own[i]), int(own[j])) for i, j in among]
    steps = np.array([log_exposures[j] - log_exposures[i] for i, j in pairs])
    table = np.concatenate(ridges)
    channels = [comparagram.rows_of(table[:, c], steps) for c in range(table.shape[1])]
    return channels, pairs, float(np.concatenate(still).mean())


def span_kept(log_exposures: Float, observes: Float) -> Float:
    """Directions (P, P - 2) of shifts that keep mean and span of the log exposures.

    A common factor on all exponents cannot be observed (Grossberg and Nayar 2004), nor a
    common shift: the regression of the refined on the given exposures, each frame weighted by
    what it observes, has slope 1 and offset 0.
    """
    weight = np.maximum(observes, 1e-12 * observes.max()) / observes.sum()
    centred = log_exposures - weight @ log_exposures
    kept = weight[:, None] * np.stack([np.ones(len(centred)), centred], axis=1)
    return np.linalg.qr(kept, mode="complete")[0][:, 2:]


def _worst(fit: comparagram.Fit, exclude: dict[int, float]) -> tuple[int | None, float]:
    """The frame whose exposure the pictures contradict most, and the shift they ask for."""
    best, at, shift = DECISIVE, None, 0.0
    for k in range(len(fit.b)):
        if k in exclude:
            continue
        alone = np.zeros((len(fit.b), 1))
        alone[k] = 1.0
        gain, d = fit.gain(alone)
        if gain > best:
            best, at, shift = gain, k, float(d[k])
    return (at, shift) if abs(shift) > WRONG else (None, 0.0)


def check(
    samples: Sequence[Sample], exposures: Float, g: Float, sigma: Float
) -> tuple[Float, Float]:
    """How a known response, `g` and `sigma` (C, codes), fits a bracket: chi-square and RMS.

    Both (C,), of the comparagrams' rows; RMS in ln units; chi-square over its expectation, the
    curve's own standard errors and roundings of the times allowed for.

    Raises
    ------
    UserError
        When the bracket tells too little of a response to check one by it.

    """
    order = np.argsort(exposures, kind="stable")
    samples = [samples[k] for k in order]
    log_exposures = np.log(exposures[order])
    channels, pairs, _ = observe(samples, log_exposures)
    _refuse_few(channels, samples)
    curves, errors = at_knots(g), at_knots(sigma)
    zero = np.zeros(KNOTS)
    system = [
        comparagram.equations(rows, pairs, log_exposures, zero, curve)
        for rows, curve in zip(channels, curves, strict=True)
    ]
    variance = [
        1 / e.w + error[rows.b] ** 2 + rows.spread_over(error) ** 2
        for e, rows, error in zip(system, channels, errors, strict=True)
    ]
    off = [e.y - e.D @ curve for e, curve in zip(system, curves, strict=True)]
    if len(samples) > 2:
        tt = sum(e.E.T @ (e.E / v[:, None]) for e, v in zip(system, variance, strict=True))
        t0 = -sum(e.E.T @ (r / v) for e, r, v in zip(system, off, variance, strict=True))
        free = NOMINAL * span_kept(log_exposures, np.diag(np.asarray(tt)))
        d = free @ np.linalg.solve(free.T @ tt @ free + np.eye(free.shape[1]), free.T @ t0)
        off = [r + e.E @ d for r, e in zip(off, system, strict=True)]
    chi_square = np.array([np.mean(r**2 / v) for r, v in zip(off, variance, strict=True)])
    return chi_square, _rms(off)


def _debevec(
    samples: Sequence[Sample], log_exposures: Float, smoothness: float, refine: bool
) -> Solution:
    codes = samples[0].codes
    found = debevec.solve(
        [s.patches for s in samples],
        [s.scene for s in samples],
        log_exposures,
        smoothness=smoothness,
        refine_times=refine,
    )
    if np.any(found.g[:, 240] - found.g[:, 16] <= 0):
        _refuse_falling()
    risen = np.stack([strictly_rising(c, e) for c, e in zip(found.g, found.sigma, strict=True)])
    moved = (np.abs(risen - found.g) > 1e-9).sum(axis=1)
    risen -= risen[:, MIDDLE, None]
    return Solution(
        method="debevec",
        g=_zeroed(at_codes(risen, codes)),
        sigma=at_codes(np.maximum(found.sigma, np.abs(risen - found.g)), codes),
        log_exposures=found.log_exposures,
        rms=found.rms,
        rms_nominal=found.rms_nominal,
        chi_square=np.full(len(risen), np.nan),
        code_noise=_code_noise(samples, found.log_exposures, risen, None),
        observed=found.observed,
        used=found.used,
        repaired=moved,
        condition=found.condition,
        patch=samples[0].patch,
        refined=refine,
        wrong=(),
        unchanging=0.0,
        frame_residual=np.full(len(samples), np.nan),
        extra={"smoothness": smoothness, "paper_lambda": found.paper_lambda},
    )


def from_solution(
    solution: Solution,
    channels: tuple[str, ...],
    files: list[Path],
    exposures: Float,
    record: Mapping[str, Any],
) -> Response:
    """The contract's form of what the solver found."""
    rows = zip(files, exposures, np.exp(solution.log_exposures), strict=True)
    return Response(
        channels=channels,
        log_exposure=solution.g,
        sigma=solution.sigma,
        code_noise=solution.code_noise,
        method=solution.method,
        refined=solution.refined or bool(solution.wrong),
        exposures=tuple(Exposed(f.name, float(given), float(used)) for f, given, used in rows),
        record=record,
    )


def darkened(g: Float, darkness: float, pedestal: float) -> Float:
    """The curve (256,) with a code of darkness: ln (z - z0) below the codes that tell of light.

    z0 continues value and slope there, but is not below `darkness`: codes down from it are no
    light at all, which the steep rest of the curve says.
    """
    if pedestal <= 0:
        return g
    z = np.arange(KNOTS)
    first = int(np.ceil(pedestal + comparagram.DARKEST))
    z0 = first - 1 / max(comparagram.slope_of(g)[first], 1 / (first - 1))
    low = z < first
    z0 = min(max(z0, darkness), first - 1.0)
    light = np.maximum(z[low] - z0, 0.25)
    dark = np.minimum(z[low] - z0 - 0.25, 0.0)
    result = g.copy()
    result[low] = g[first] + np.log(light / (first - z0)) + dark
    return result


def strictly_rising(g: Float, sigma: Float) -> Float:
    """The nearest curve (weights 1/sigma^2) that rises by LEAST_STEP or more at every knot."""
    ramp = LEAST_STEP * np.arange(len(g))
    if np.all(np.diff(g) >= LEAST_STEP):
        return g
    weights = 1 / np.maximum(sigma, 1e-6) ** 2
    risen = np.asarray(isotonic_regression(g - ramp, weights=weights).x, np.float64) + ramp
    return risen


def _code_noise(
    samples: Sequence[Sample],
    log_exposures: Float,
    g: Float,
    fit: comparagram.Fit | None,
) -> Float:
    """Standard deviation of a single pixel in codes, the median over knots, (C,)."""
    width = np.gradient(codes_at_knots(samples[0].codes))  # codes a knot
    channels, _, _ = observe(samples, log_exposures, "pixels")
    noise = np.empty(len(g))
    for c, (rows, curve) in enumerate(zip(channels, g, strict=True)):
        if len(rows.b) >= FEWEST_KNOTS:
            variance = comparagram.code_variance(rows, comparagram.slope_of(curve))
        elif fit is not None:  # too few single pixels: what patches say of one
            variance = samples[0].patch ** 2 * fit.equations[c].variance
        else:
            raise UserError(
                "too few pixels are well exposed in two pictures to tell their noise: give "
                "exposures closer together"
            )
        seen = _observed(rows) > 0
        noise[c] = np.median((np.sqrt(variance) * width)[seen if np.any(seen) else slice(None)])
    return noise


def _by_frame(
    residuals: Sequence[Float],
    channels: Sequence[Rows],
    pairs: Sequence[tuple[int, int]],
    frames: int,
) -> Float:
    """RMS residual of the rows of each frame, (P,)."""
    table = np.array(pairs)
    members = np.concatenate([table[rows.pair] for rows in channels])
    squares = np.concatenate(residuals)[:, None] ** 2 * np.ones(2)
    count = np.bincount(members.ravel(), minlength=frames)
    total = np.bincount(members.ravel(), squares.ravel(), minlength=frames)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _observed(rows: Rows) -> Float:
    """Patches that tell of each knot, (256,)."""
    low = np.floor(rows.T).astype(np.intp)
    return np.bincount(rows.b, rows.count, KNOTS) + np.bincount(low, rows.count, KNOTS)


def _condition(e: comparagram.Equations, factor: Float) -> float:
    H = ((e.D.multiply(e.w[:, None])).T @ e.D).toarray()
    values = np.linalg.eigvalsh(factor.T @ H @ factor)
    return float((1 + values[-1]) / (1 + max(values[0], 0)))


def _brighter(rows: Rows) -> bool:
    """Whether longer exposures are brighter, by most of the patches."""
    return bool(np.sum(rows.count * np.sign(rows.b - rows.T)) >= 0)


def _zeroed(g: Float) -> Float:
    return g - g[:, g.shape[1] // 2, None]


def _rms(residuals: Sequence[Float]) -> Float:
    return np.array([np.sqrt(np.mean(r**2)) for r in residuals])


def _refuse_falling() -> None:
    raise UserError(
        "longer exposures are not brighter: the exposure times are in another order than "
        "the pictures, or the pictures show different scenes"
    )


def _refuse(samples: Sequence[Sample], log_exposures: Float, smoothness: float) -> None:
    if len(samples) < 2:
        raise UserError("a response needs two pictures or more of different exposure")
    if len(samples) != len(log_exposures):
        raise UserError(f"{len(log_exposures)} exposures for {len(samples)} pictures")
    if not (np.isfinite(smoothness) and smoothness > 0):
        raise UserError(f"smoothness {smoothness} is not a positive number")
    groups: dict[int, list[float]] = {s.scene: [] for s in samples}
    for s, log_exposure in zip(samples, log_exposures, strict=True):
        groups[s.scene].append(log_exposure)
    if max(np.ptp(group) for group in groups.values()) < 1e-3:
        raise UserError("all pictures have the same exposure: a response needs different ones")
    if all(frame.bright > 0.999 for frame in samples):
        raise UserError("all pictures are saturated: take shorter exposures")
    if all(frame.dark > 0.999 for frame in samples):
        raise UserError("all pictures are black: take longer exposures")


def _refuse_few(channels: Sequence[Rows], samples: Sequence[Sample]) -> None:
    knots = [len({*rows.b.tolist(), *np.floor(rows.T).tolist()}) for rows in channels]
    told = min(knots)
    which = ""
    if told < max(knots):
        which = f" in channel {knots.index(told) + 1} of {len(knots)}"
    if told == 0:
        raise UserError(
            f"no code{which} is shown by {comparagram.FEWEST} patches of {samples[0].patch} "
            "pixels that are well exposed in two pictures: give exposures closer together, or "
            "pictures that are larger, less saturated and less dark"
        )
    if told < FEWEST_KNOTS:
        raise UserError(
            f"the pictures tell of {told} code values{which}: too few for a curve; photograph "
            "a scene of more brightnesses"
        )
