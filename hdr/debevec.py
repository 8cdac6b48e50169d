"""The response as Debevec and Malik (1997) define it (row P12), from all pixels.

Minimise over g, per channel, with every ln E_i eliminated,

    sum_ij { w(Z_ij) [ g(Z_ij) - ln E_i - ln dt_j ] }^2 + lambda sum_z [ w(z) g''(z) ]^2,

g''(z) = g(z-1) - 2 g(z) + g(z+1) for z = Zmin+1 .. Zmax-1, w the hat, g((Zmin+Zmax)/2) = 0.
The kernel sums the Schur complement over the pixels; what is left has the size of the code
range. ``smoothness`` is lambda at one observation a code: the data are scaled by
s = sum_z w(z)^2 / trace(H_gg), so that it means the same for a thumbnail and for 21
megapixels; the paper's own lambda is smoothness / s.

The matrix is badly conditioned (1e5 - 1e13): float64 throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.knots import KNOTS, MIDDLE
from chromeball.hdr.posterior import solve_normal
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]

#: lambda: of 3 .. 300 the best over 15 DoRF curves x 5 radiance maps, 7 x 1 EV and 5 x 2 EV
SMOOTHNESS = 30.0


def hat() -> Float:
    """w(z) = z - Zmin below the middle, Zmax - z above it; (256,)."""
    z = np.arange(KNOTS, dtype=np.float64)
    return np.minimum(z, KNOTS - 1 - z)


@dataclass(frozen=True)
class Curves:
    """What the solve finds.

    ``g`` and ``sigma`` (C, 256): ln exposure and its standard error, noise and smoothing bias
    together. ``log_exposures`` (P,) as given or refined; ``rms``, ``rms_nominal``,
    ``condition``, ``paper_lambda`` (C,); ``observed`` (C, 256) and ``used`` (C,): pixels.
    """

    g: Float
    sigma: Float
    log_exposures: Float
    rms: Float
    rms_nominal: Float
    condition: Float
    paper_lambda: Float
    observed: Float
    used: NDArray[np.int64]


def solve(
    pixels: Sequence[NDArray[np.uint16]],
    scenes: Sequence[int],
    log_exposures: Float,
    *,
    smoothness: float = SMOOTHNESS,
    refine_times: bool = False,
) -> Curves:
    """Solve from knots (N, C) of P frames, 8.8 fixed point; `scenes` numbers their scenes.

    The variance of g is the diagonal of ``s^2 M^-1 B M^-1``, M = s H + lambda D'D, B the
    scatter of the pixels' scores (a sandwich, so unequal noise is allowed for), plus what
    smoothing bends, ``lambda M^-1 D' c`` for c = w g'': once for c of random sign and the mean
    square found, once for the largest c found, everywhere of one sign.

    Raises
    ------
    UserError
        Too few pixels for a curve, by N (P - 1) > Zmax - Zmin, or a singular matrix.

    """
    w = hat()
    groups = [
        [k for k, scene in enumerate(scenes) if scene == number]
        for number in sorted(set(scenes))
    ]
    parts = [kernel.accumulate([pixels[k] for k in own], w**2) for own in groups]
    P, C = len(pixels), pixels[0].shape[1]
    H = np.zeros((C, KNOTS + P, KNOTS + P))
    for (part, _, _), own in zip(parts, groups, strict=True):
        place = np.concatenate([np.arange(KNOTS), KNOTS + np.array(own)])
        H[np.ix_(np.arange(C), place, place)] += part
    observed = np.sum([seen for _, seen, _ in parts], axis=0)
    used = np.sum([count for _, _, count in parts], axis=0)
    N = int(used.min())
    if N * (P - 1) <= KNOTS - 1:
        raise UserError(
            f"only {N} pixels are well exposed in two pictures or more; a response needs "
            f"N (P - 1) > {KNOTS - 1}: give exposures closer together, or pictures that are "
            "less saturated and less dark"
        )
    s = np.sum(w**2) / np.trace(H[:, :KNOTS, :KNOTS], axis1=1, axis2=2)
    D = second_difference(w)
    keep = np.arange(KNOTS) != MIDDLE
    penalty = smoothness * D.T @ D

    def fit(tau: Float) -> tuple[Float, Float, Float, Float]:
        M = (s[:, None, None] * H[:, :KNOTS, :KNOTS] + penalty)[:, keep][:, :, keep]
        right = (-s[:, None] * (H[:, :KNOTS, KNOTS:] @ tau))[:, keep]
        found, found_inverse, scaled = solve_normal(M, right)
        if not np.all(np.isfinite(found)):
            raise UserError(
                "the pictures do not determine a response (the matrix is singular): give "
                "more exposures, or a larger --smoothness"
            )
        g, inverse = np.zeros((len(s), KNOTS)), np.zeros((len(s), KNOTS, KNOTS))
        g[:, keep] = found
        inverse[np.ix_(np.arange(len(s)), keep, keep)] = found_inverse
        B, within, freedom = (
            np.sum(sums, axis=0)
            for sums in zip(
                *(
                    kernel.residuals([pixels[k] for k in own], w**2, g, tau[own])
                    for own in groups
                ),
                strict=True,
            )
        )
        half = s[:, None, None] * inverse
        noise = np.einsum("cij,cjk,cik->ci", half, B, half, optimize=True)
        curvature = np.abs(w[1:-1] * np.diff(g, 2)) * (observed[:, 1:-1] > 0)
        bend = smoothness * (inverse @ D.T)
        ripple = np.mean(curvature**2, axis=1)[:, None] * np.sum(bend**2, axis=2)
        sag = curvature.max(axis=1)[:, None] * bend.sum(axis=2)
        sigma = np.sqrt(np.maximum(noise, 0) + ripple + sag**2)
        values = np.linalg.eigvalsh(scaled)  # numpy's: compiling JAX's costs seconds
        return g, sigma, np.sqrt(within.sum(1) / freedom.sum(1)), values[:, -1] / values[:, 0]

    g, sigma, rms, condition = fit(log_exposures)
    rms_nominal = rms
    if refine_times:
        log_exposures = refine(H, s, log_exposures, smoothness)
        g, sigma, rms, condition = fit(log_exposures)
    return Curves(
        g, sigma, log_exposures, rms, rms_nominal, condition, smoothness / s, observed, used
    )


def second_difference(w: Float) -> Float:
    """D with D g = w(z) g''(z) for z = 1 .. n-2; shape (n - 2, n)."""
    return np.diff(np.eye(len(w)), 2, axis=0) * w[1:-1, None]


def refine(H: Float, s: Float, log_exposures: Float, smoothness: float) -> Float:
    """Log exposures and curves together: g is eliminated, q(tau) = tau' T tau is left.

    A common factor on all exponents cannot be observed (Grossberg and Nayar 2004), nor a
    common shift. So the mean and the span are kept: the regression of the refined on the given
    log exposures, each frame weighted by what it observes, has slope 1 and offset 0.
    """
    P = len(log_exposures)
    joint = np.zeros((P, P))
    observes = np.zeros(P)
    keep = np.arange(KNOTS) != MIDDLE
    D = second_difference(hat())
    penalty = smoothness * (D.T @ D)[np.ix_(keep, keep)]
    for h, scale in zip(H, s, strict=True):
        gg, gt, tt = h[:KNOTS, :KNOTS], h[:KNOTS, KNOTS:][keep], h[KNOTS:, KNOTS:]
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
