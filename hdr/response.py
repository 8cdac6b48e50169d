"""The response curve of a camera from a bracket (Debevec and Malik 1997; row P12).

Minimise over g, per channel, with every ln E_i eliminated,

    sum_ij { w(Z_ij) [ g(Z_ij) - ln E_i - ln dt_j ] }^2 + lambda sum_z [ w(z) g''(z) ]^2,

g''(z) = g(z-1) - 2 g(z) + g(z+1) for z = Zmin+1 .. Zmax-1, w the hat, g((Zmin+Zmax)/2) = 0.
The kernel sums the Schur complement over all pixels; what is left has the size of the code
range. Three things differ from the paper, all about noise:

- Z_ij is the mean code of a small patch (2 x 2 pixels; larger for large pictures) and may fall
  between two codes, where g is linear. Patches with an edge or a clipped pixel are left out.
- Each patch counts by the inverse of its code density, so that every brightness counts alike:
  with plain counts noise pulls each code down the slope of the histogram, whatever N is.
- The data are scaled to one observation a code: s = sum_z w(z)^2 / trace(H_gg). So lambda means
  the same for a thumbnail and for 21 megapixels.

Unknowns are few and the matrix is badly conditioned (1e5 - 1e9): float64 throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from chromeball.hdr import kernel
from chromeball.scene.errors import UserError

CODES = 256
MIDDLE = CODES // 2
#: lambda: of 3 .. 300 the best over 15 DoRF curves x 5 radiance maps, 7 x 1 EV and 5 x 2 EV
SMOOTHNESS = 30.0
#: codes over which a patch may spread
SPREAD = 16
#: patches are made larger until there are no more than this
MOST_PATCHES = 1_200_000
#: the least rise of g from one code to the next
LEAST_STEP = 1e-4

type Float = NDArray[np.float64]


def hat(codes: int = CODES) -> Float:
    """w(z) = z - Zmin below the middle, Zmax - z above it; shape (codes,)."""
    z = np.arange(codes, dtype=np.float64)
    return np.minimum(z, codes - 1 - z)


@dataclass(frozen=True)
class Sample:
    """What one frame gives: mean codes of its patches, and single pixels for the noise."""

    patches: NDArray[np.uint16]  # (N, C), 8.8 fixed point, 0xffff where unusable
    pixels: NDArray[np.uint16]  # (n, C), likewise
    patch: int
    dark: float  # share of values at the lowest code
    bright: float  # share at the highest


def sample(frame: NDArray[np.uint8], patch: int | None = None) -> Sample:
    """Reduce a frame (H, W, C) uint8 to what the solver needs; `patch` in pixels a side."""
    height, width = frame.shape[:2]
    if patch is None:
        least = 2 if height * width >= 40_000 else 1
        patch = max(least, int(np.ceil(np.sqrt(height * width / MOST_PATCHES))))
    if patch < 1 or patch > min(height, width):
        raise UserError(f"a patch of {patch} pixels does not fit {width} x {height}")
    stride = max(1, int(np.sqrt(height * width / 100_000)))
    lattice = np.ascontiguousarray(frame[::stride, ::stride])
    return Sample(
        patches=kernel.patches(frame, patch, SPREAD if patch > 1 else CODES),
        pixels=kernel.patches(lattice, 1, CODES),
        patch=patch,
        dark=float(np.mean(lattice == 0)),
        bright=float(np.mean(lattice == CODES - 1)),
    )


@dataclass(frozen=True)
class Solution:
    """Curves and how good they are.

    ``g`` and ``sigma`` (C, 256): ln exposure of each code and its standard error, noise and
    smoothing bias together (see :func:`solve`). ``log_exposures`` (P,): as given, or refined.
    ``rms`` (C,): weighted residual in ln units. ``code_noise`` (C,): standard deviation of a
    pixel in codes. ``observed`` (C, 256): patches that showed a code. ``repaired`` (C,): codes
    that were moved to make a curve rise. ``condition`` (C,): of the matrix solved, its
    diagonal scaled to one.
    """

    g: Float
    sigma: Float
    log_exposures: Float
    rms: Float
    code_noise: Float
    observed: Float
    used: NDArray[np.int64]
    repaired: NDArray[np.int64]
    condition: Float
    patch: int
    smoothness: float
    refined: bool
    rms_nominal: Float


def solve(
    samples: Sequence[Sample],
    exposures: Float,
    *,
    smoothness: float = SMOOTHNESS,
    refine_times: bool = False,
) -> Solution:
    """Solve for the response of every channel.

    `exposures` (P,) are relative and positive. With `refine_times` the log exposures are
    unknowns too, shared by the channels; see :func:`refine`.

    The variance of g is the diagonal of ``s^2 M^-1 B M^-1``, M = s H + lambda D'D, B the
    scatter of the patches' scores (a sandwich, so unequal noise is allowed for), plus what
    smoothing bends, ``lambda M^-1 D' c`` for c = w g'': once for c of random sign and the mean
    square found, once for the largest c found, everywhere of one sign. The bias that noise
    itself leaves (it shrinks with the patch) is not in it.

    Raises
    ------
    UserError
        When the bracket cannot determine a curve; the message says why.

    """
    log_exposures = np.log(exposures)
    _refuse(samples, log_exposures, smoothness)
    w = hat()
    codes = [frame.patches for frame in samples]
    share = kernel.shares(codes, w**2)
    H, observed, used = kernel.accumulate(codes, w**2, share)
    _refuse_few(samples, used, observed)
    observed_weight = np.trace(H[:, :CODES, :CODES], axis1=1, axis2=2)
    s = np.sum(w**2) / np.where(observed_weight > 0, observed_weight, np.inf)

    D = second_difference(w)

    def fit(tau: Float) -> tuple[Float, Float, Float, Float]:
        g, inverse, condition = _solve(H, s, tau, smoothness)
        B, within, freedom = kernel.residuals(codes, w**2, share, g, tau)
        half = s[:, None, None] * inverse
        noise = np.einsum("cij,cjk,cik->ci", half, B, half, optimize=True)
        curvature = np.abs(w[1:-1] * np.diff(g, 2)) * (observed[:, 1:-1] > 0)
        bend = smoothness * (inverse @ D.T)
        ripple = np.mean(curvature**2, axis=1)[:, None] * np.sum(bend**2, axis=2)
        sag = curvature.max(axis=1)[:, None] * bend.sum(axis=2)
        sigma = np.sqrt(np.maximum(noise, 0) + ripple + sag**2)
        return g, sigma, np.sqrt(within.sum(1) / freedom.sum(1)), condition

    g, sigma, rms, condition = fit(log_exposures)
    rms_nominal = rms
    if refine_times:
        log_exposures = refine(H, s, log_exposures, smoothness)
        g, sigma, rms, condition = fit(log_exposures)
    rise = g[:, 240] - g[:, 16]
    if np.any(rise <= 0):
        raise UserError(
            "the solved response falls with brightness: the exposure times are in another "
            "order than the pictures, or the pictures show different scenes"
        )
    risen = np.stack([strictly_rising(c, e) for c, e in zip(g, sigma, strict=True)])
    moved = np.abs(risen - g) > 1e-9
    risen -= risen[:, MIDDLE, None]
    return Solution(
        g=risen,
        sigma=np.maximum(sigma, np.abs(risen - g)),
        log_exposures=log_exposures,
        rms=rms,
        code_noise=_code_noise(samples, risen, log_exposures),
        observed=observed,
        used=used,
        repaired=moved.sum(axis=1),
        condition=condition,
        patch=samples[0].patch,
        smoothness=smoothness,
        refined=refine_times,
        rms_nominal=rms_nominal,
    )


def second_difference(w: Float) -> Float:
    """D with D g = w(z) g''(z) for z = 1 .. n-2; shape (n - 2, n)."""
    return np.diff(np.eye(len(w)), 2, axis=0) * w[1:-1, None]


def roughness(w: Float) -> Float:
    """R with g' R g = sum over z = 1 .. n-2 of (w(z) g''(z))^2; shape (n, n)."""
    D = second_difference(w)
    return D.T @ D


def refine(H: Float, s: Float, log_exposures: Float, smoothness: float) -> Float:
    """Log exposures and curves together: g is eliminated, q(tau) = tau' T tau is left.

    A common factor on all exponents cannot be observed (Grossberg and Nayar 2004), nor a
    common shift. So the mean and the span are kept: the regression of the refined on the given
    log exposures, each frame weighted by what it observes, has slope 1 and offset 0.
    """
    P = len(log_exposures)
    joint = np.zeros((P, P))
    observes = np.zeros(P)
    keep = np.arange(CODES) != MIDDLE
    penalty = smoothness * roughness(hat())[np.ix_(keep, keep)]
    for h, scale in zip(H, s, strict=True):
        gg, gt, tt = h[:CODES, :CODES], h[:CODES, CODES:][keep], h[CODES:, CODES:]
        M = scale * gg[np.ix_(keep, keep)] + penalty
        joint += scale * tt - scale**2 * gt.T @ np.linalg.solve(M, gt)
        observes += scale * np.diag(tt)
    # frames that observe nothing stay where they are
    stay = 1e-6 * np.trace(joint) / P * np.eye(P)
    observes /= observes.sum()
    centred = log_exposures - observes @ log_exposures
    # tau = given + d, d' A = 0: (T + stay, A; A' 0) (d; multipliers) = (-T given; 0)
    A = observes[:, None] * np.stack([np.ones(P), centred], axis=1)
    system = np.block([[joint + stay, A], [A.T, np.zeros((2, 2))]])
    right = np.concatenate([-joint @ centred, np.zeros(2)])
    return log_exposures + np.linalg.solve(system, right)[:P]


def strictly_rising(g: Float, sigma: Float) -> Float:
    """The nearest curve (weights 1/sigma^2) that rises by LEAST_STEP or more at every code."""
    ramp = LEAST_STEP * np.arange(len(g))
    if np.all(np.diff(g) >= LEAST_STEP):
        return g
    weights = 1 / np.maximum(sigma, 1e-6) ** 2
    risen = np.asarray(isotonic_regression(g - ramp, weights=weights).x, np.float64) + ramp
    return risen


@cache
def _compiled() -> Any:
    import jax
    import jax.numpy as jnp

    keep = np.delete(np.arange(CODES), MIDDLE)
    w = hat()
    R = roughness(w)

    def one(H: Any, s: Any, tau: Any, smoothness: Any) -> Any:
        M = (s * H[:CODES, :CODES] + smoothness * R)[jnp.ix_(keep, keep)]
        right = (-s * H[:CODES, CODES:] @ tau)[keep]
        d = 1 / jnp.sqrt(jnp.diag(M))
        scaled = M * d[:, None] * d
        both = jnp.concatenate([jnp.diag(d), (d * right)[:, None]], axis=1)
        solved = d[:, None] * jax.scipy.linalg.cho_solve(
            (jnp.linalg.cholesky(scaled), True), both
        )
        g = jnp.zeros(CODES).at[keep].set(solved[:, -1])
        inverse = jnp.zeros((CODES, CODES)).at[jnp.ix_(keep, keep)].set(solved[:, :-1])
        return g, inverse, scaled

    return jax.jit(jax.vmap(one, in_axes=(0, 0, None, None)))


def _solve(H: Float, s: Float, tau: Float, smoothness: float) -> tuple[Float, Float, Float]:
    """Curves (C, 256), M^-1 (C, 256, 256) with zeros at the middle code, conditions (C,)."""
    import jax

    with jax.enable_x64(True):
        found = _compiled()(H, s, tau, smoothness)
        g, inverse, scaled = (np.asarray(part, np.float64) for part in found)
    if not np.all(np.isfinite(g)):
        raise UserError(
            "the pictures do not determine a response (the matrix is singular): give more "
            "exposures, or a larger --smoothness"
        )
    values = np.linalg.eigvalsh(scaled)  # numpy's: compiling JAX's costs seconds
    return g, inverse, values[:, -1] / values[:, 0]


def _code_noise(samples: Sequence[Sample], g: Float, log_exposures: Float) -> Float:
    """Standard deviation of a single pixel in codes: residuals over the slope of g, (C,)."""
    pixels = [frame.pixels for frame in samples]
    w = hat()
    share = np.ones(pixels[0].shape, np.float32)
    _, within, freedom = kernel.residuals(pixels, w**2, share, g, log_exposures)
    slope = np.gradient(g, axis=1)
    return np.sqrt(within.sum(1) / np.maximum((freedom * slope**2).sum(1), 1e-300))


def _refuse(samples: Sequence[Sample], log_exposures: Float, smoothness: float) -> None:
    if len(samples) < 2:
        raise UserError("a response needs two pictures or more of different exposure")
    if len(samples) != len(log_exposures):
        raise UserError(f"{len(log_exposures)} exposures for {len(samples)} pictures")
    if not (np.isfinite(smoothness) and smoothness > 0):
        raise UserError(f"smoothness {smoothness} is not a positive number")
    if np.ptp(log_exposures) < 1e-3:
        raise UserError("all pictures have the same exposure: a response needs different ones")
    if all(frame.bright > 0.999 for frame in samples):
        raise UserError("all pictures are saturated: take shorter exposures")
    if all(frame.dark > 0.999 for frame in samples):
        raise UserError("all pictures are black: take longer exposures")


def _refuse_few(samples: Sequence[Sample], used: NDArray[np.int64], observed: Float) -> None:
    P, N = len(samples), int(used.min())
    if N * (P - 1) <= CODES - 1:
        raise UserError(
            f"only {N} patches of {samples[0].patch} pixels are well exposed in two pictures "
            f"or more; a response needs N (P - 1) > {CODES - 1}: give exposures closer "
            "together, or pictures that are less saturated and less dark"
        )
    seen = int((observed > 0).sum(axis=1).min())
    if seen < 3:
        raise UserError(f"the pictures show {seen} code values: too few for a curve")
