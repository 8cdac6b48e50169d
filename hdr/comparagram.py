"""The response from comparagrams, with a prior over real curves: the default solver.

A comparagram (Mann 2000) is the joint histogram C[a, b] of what two frames show at one place:
a in the darker, b in the brighter, exposures t_i < t_j. Its ridge is the brightness transfer
function T (Grossberg and Nayar 2004), and one row of it says

    g(b) - g(T_ij(b)) = ln t_j / t_i,

T_ij(b) the *median* code of the darker frame where the brighter shows b. Four things make this
more exact than summing squares over pixels:

- conditioning on the brighter frame: a code's noise in ln exposure is many times larger in the
  darker one, and what is selected by a noisy code is biased by it;
- the median: it needs no assumption whether noise is symmetric in exposure or in codes, zeros
  and outliers (moving things, misaligned edges) do not pull it, it falls between two codes;
- what bias the brighter code leaves is known: the mean error of what shows code z is
  n(z) = -(v p)' / p = -d/dz (s^2 g' h) / h for a density h(z) of codes and code noise s^2(z)
  (Tweedie's formula); s^2(z) comes from the ridge's own width, by non-negative least squares;
- the prior (:mod:`chromeball.hdr.prior`) settles what a bracket cannot: exact EV steps leave a
  periodic part undamped. How rough the curve may be is chosen by the evidence.

At last each channel is told what the others say (:func:`share`): one that sees little light
takes the rest of its curve from them.

Rows are weighted by the inverse of: sampling variance of a median, rest of quantisation, and a
floor; the posterior's covariance is what the standard errors are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.sparse import csr_array

from chromeball.hdr.knots import KNOTS
from chromeball.hdr.posterior import posterior

type Float = NDArray[np.float64]

#: knots whose rows count: dark codes hold their quantisation, bright ones what saturates
DARKEST, BRIGHTEST = 3.0, 252.0
#: patches that a row needs
FEWEST = 20
#: standard deviation of a row that no number of pixels lowers, in ln units
FLOOR = 2e-3
#: and of what quantisation leaves in a median, in codes
PHASE = 0.08
#: rows of neighbouring codes and of pairs that share a frame are not independent
DEPENDENCE = 2.0
#: frames are paired up to this ratio of exposures (3.2 EV), and with the next in any case
WIDEST = np.log(2) * 3.2
#: darkness scatters by less than this many knots
PEDESTAL_SPREAD = 6.0
#: how much the curves of one camera's channels differ, in ln units, and over how many knots
ALIKE, ALIKE_REACH = 0.05, 40.0
#: knots of the piecewise linear code noise
NOISE_KNOTS = np.array([0.0, 8, 20, 40, 70, 110, 150, 190, 225, 255])

_CODES = np.arange(KNOTS)
_HATS: Float = np.stack([np.interp(_CODES, NOISE_KNOTS, row) for row in np.eye(10)], axis=1)


def pair(log_exposures: Float) -> list[tuple[int, int]]:
    """Pairs (darker, brighter) of frames, three a frame at most: those next to 1 .. 3 EV."""
    order = np.argsort(log_exposures, kind="stable")
    pairs: list[tuple[int, int]] = []
    for at, i in enumerate(order):
        brighter = order[at + 1 :]
        step = log_exposures[brighter] - log_exposures[i]
        apart = (step > 0.3) & (step <= WIDEST)
        chosen: list[int] = []
        if np.any(apart):
            for wish in np.log(2) * np.array([1, 2, 3]):
                chosen.append(int(np.argmin(np.where(apart, np.abs(step - wish), np.inf))))
        elif len(brighter):
            chosen.append(0 if step[-1] <= 0.3 else int(np.argmax(step > 0.3)))
        pairs += [(int(i), int(brighter[k])) for k in sorted(set(chosen))]
    return pairs


@dataclass(frozen=True)
class Rows:
    """Equations g(b) - g(T) = ln t_j / t_i of one channel, (n,) each.

    ``pair`` index of the pair, ``b`` knot in the brighter frame, ``T`` median knot in the
    darker, ``count`` patches, ``spread`` standard deviation about T in knots (from quartiles),
    ``density`` (K, 256) patches per knot of the brighter frame, smoothed. ``darkness``:
    the knot that no light shows, 0 but for film and raised blacks; knots up to ``pedestal`` may
    be it and noise.
    """

    pair: NDArray[np.intp]
    b: NDArray[np.intp]
    T: Float
    count: Float
    spread: Float
    density: Float
    darkness: float
    pedestal: float

    def spread_over(self, table: Float) -> Float:
        """``table(T)`` for a table over knots, (256,) or (256, k)."""
        low, u = self._split()
        upper = table[np.minimum(low + 1, KNOTS - 1)]
        if table.ndim == 2:
            u = u[:, None]
        return (1 - u) * table[low] + u * upper

    def design(self) -> csr_array:
        """D (n, 256) with (D g) = g(b) - g(T)."""
        low, u = self._split()
        n = len(self.b)
        column = np.stack([self.b, low, np.minimum(low + 1, KNOTS - 1)])
        value = np.stack([np.ones(n), u - 1, -u])
        row = np.tile(np.arange(n), (3, 1))
        return csr_array((value.ravel(), (row.ravel(), column.ravel())), shape=(n, KNOTS))

    def _split(self) -> tuple[NDArray[np.intp], Float]:
        low = np.floor(self.T).astype(np.intp)
        return low, self.T - low


def rows_of(ridge: Float, steps: Float) -> Rows:
    """The rows of one channel from the kernel's ridges (K, 4, 256): counts and quartiles.

    `steps` (K,) are the pairs' ln t_j / t_i.
    """
    count, lower, T, upper = np.moveaxis(ridge, 1, 0)
    spread = (upper - lower) / 1.349  # of a normal distribution
    shown = count >= FEWEST
    darkness, pedestal = _pedestal(np.where(shown, _CODES - T, np.nan), count, spread, steps)
    usable = shown & (pedestal + DARKEST <= T) & (_CODES <= BRIGHTEST) & (_CODES >= DARKEST)
    k, b = np.nonzero(usable)
    return Rows(k, b, T[k, b], count[k, b], spread[k, b], _smooth(count, 9), darkness, pedestal)


def _pedestal(fall: Float, count: Float, spread: Float, steps: Float) -> tuple[float, float]:
    """The knot of darkness (film base, raised black), and up to where noise takes it.

    `fall` (K, 256) is b - T(b), NaN where too few patches tell. A knot is dark where at least
    half of the pairs that tell of it see a fall of less than 1 knot for 1 EV; darkness itself
    is where they see none. Nothing is darker than darkness.
    """
    # what moved shows one code here and anything there
    tells = np.isfinite(fall) & (steps[:, None] > 0.5) & (spread < PEDESTAL_SPREAD)
    fallen = np.nan_to_num(fall, nan=np.inf)
    enough = np.maximum(tells.sum(axis=0), 1)

    def highest(least: Float | float) -> int:
        still = ((tells & (fallen < least)).sum(axis=0) * 2 >= enough) & np.any(tells, axis=0)
        still[int(BRIGHTEST) // 2 :] = False
        still[: int(DARKEST)] = False  # quantisation
        return int(np.flatnonzero(still)[-1]) if np.any(still) else 0

    dark = highest(steps[:, None] / np.log(2))
    if dark == 0:
        return 0.0, 0.0
    noise = float(np.median(spread[:, dark][tells[:, dark]]))
    darkness = highest(0.0)
    shown = count[:, int(DARKEST) :].sum(axis=0)
    darker = shown[: max(0, int(darkness - 3 * noise - 2 - DARKEST))].sum()
    if darker > 0.02 * shown.sum():
        return 0.0, 0.0
    return float(darkness), dark + 2 * noise


def _smooth(values: Float, width: int) -> Float:
    """Hann-weighted running mean over the last axis, the ends repeated."""
    kernel = np.hanning(width + 2)[1:-1]
    edges = [(0, 0)] * (values.ndim - 1) + [(width // 2, width // 2)]
    padded = np.pad(values, edges, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=-1)
    return windows @ (kernel / kernel.sum())


def slope_of(g: Float) -> Float:
    """The slope g' of a curve (256,), smoothed and positive."""
    return np.maximum(np.gradient(_smooth(g, 5)), 1e-4)


def code_variance(rows: Rows, slope: Float) -> Float:
    """s^2(z), the variance of a code (quantisation included), (256,), from the ridge's width.

    (spread g'(T))^2 = s^2(T) g'(T)^2 + s^2(b) g'(b)^2, s^2 piecewise linear and positive.
    """
    at_T = rows.spread_over(slope)
    features = (slope[rows.b, None] ** 2) * _HATS[rows.b] + (
        at_T[:, None] ** 2
    ) * rows.spread_over(_HATS)
    wide = (rows.spread * at_T) ** 2
    weight = np.sqrt(rows.count) / np.maximum(0.5 * features.sum(axis=1), 1e-7)
    # the normal equations are 10 x 10: a factor of them serves nnls
    F = weight[:, None] * features
    sizes, axes = np.linalg.eigh(F.T @ F)
    root = np.sqrt(np.maximum(sizes, 1e-12 * sizes[-1]))
    right = (axes.T @ (F.T @ (weight * wide))) / root
    # knots that few rows tell of follow their neighbours
    bend = np.diff(np.eye(len(NOISE_KNOTS)), 2, axis=0) * np.sqrt(1e-2 * sizes[-1])
    variance, _ = nnls(
        np.vstack([(axes * root).T, bend]), np.concatenate([right, np.zeros(len(bend))])
    )
    return _HATS @ np.maximum(variance, 1 / 12)


def selection_bias(rows: Rows, slope: Float, variance: Float) -> Float:
    """n(b), the mean error of ln exposure of what shows code b, (n,)."""
    h = rows.density
    flow = np.gradient(slope * variance * h, axis=1)
    bias = -flow / np.maximum(h, 1e-6 * h.sum(axis=1, keepdims=True) / KNOTS + 1e-12)
    most = slope * np.sqrt(variance)
    return np.clip(bias, -most, most)[rows.pair, rows.b]


def row_variance(rows: Rows, slope: Float, bias: Float) -> Float:
    """Variance of each row in ln units squared, (n,)."""
    at_T = rows.spread_over(slope)
    median = 0.5 * np.pi * (rows.spread * at_T) ** 2 / rows.count
    return DEPENDENCE * (FLOOR**2 + (PHASE * at_T) ** 2 + median + (0.25 * bias) ** 2)


@dataclass(frozen=True)
class Equations:
    """Weighted rows of one channel: D (g - m) - E d = y, weights w, d the time shifts."""

    D: csr_array
    E: Float
    y: Float
    w: Float
    variance: Float  # of a patch's code at each knot, (256,)


def equations(
    rows: Rows,
    pairs: Sequence[tuple[int, int]],
    log_exposures: Float,
    mean: Float,
    g: Float,
    misfit: Float | float = 1.0,
    *,
    correct: bool = True,
) -> Equations:
    """The rows with weights and corrections for the slope of `g`.

    `misfit` multiplies the rows' variances.
    """
    slope = slope_of(g)
    variance = code_variance(rows, slope)
    bias = selection_bias(rows, slope, variance) if correct else np.zeros(len(rows.b))
    i, j = np.array(pairs).T
    at = np.arange(len(rows.b))
    E = np.zeros((len(rows.b), len(log_exposures)))
    E[at, j[rows.pair]] += 1
    E[at, i[rows.pair]] -= 1
    # a ridge much wider than noise makes it holds what moved: its median says little
    at_T = rows.spread_over(slope)
    noise = rows.spread_over(slope**2 * variance) + (slope**2 * variance)[rows.b]
    wide = np.maximum((rows.spread * at_T) ** 2 / noise / 4, 1.0)
    D = rows.design()
    y = E @ log_exposures + bias - D @ mean
    return Equations(
        D, E, y, 1 / (misfit * wide**2 * row_variance(rows, slope, bias)), variance
    )


def misfit_of(e: Equations, residual: Float) -> Float:
    """Factors (n,) on the variances of rows that scatter by more than they should.

    The median chi-square, where that is above its expectation, and beyond it a Student
    distribution of 4 degrees of freedom: a row that nothing explains hardly counts.
    """
    chi_square = residual**2 * e.w
    scale = max(1.0, float(np.median(chi_square)) / 0.455)
    return scale * (4 + chi_square / scale) / 5


@dataclass(frozen=True)
class Fit:
    """What the rows of all channels say.

    ``g`` (C, 256) curves and ``covariance`` (C, 256, 256) at the given exposures; shifts d (P,)
    of log exposures have information S (P, P) with right side b (P,): S d = b, the curves
    eliminated. ``model`` (C,): index of the prior's roughness. ``equations``: of each channel;
    ``information`` (C, 256, 256) and ``right`` (C, 256, k): their normal equations.
    """

    g: Float
    covariance: Float
    S: Float
    b: Float
    model: NDArray[np.intp]
    equations: tuple[Equations, ...]
    information: Float
    right: Float

    def residuals(self, mean: Float) -> list[Float]:
        """Residuals in ln units of each channel's rows."""
        return [
            e.y - e.D @ (curve - mean) for e, curve in zip(self.equations, self.g, strict=True)
        ]

    def gain(self, free: Float) -> tuple[float, Float]:
        """Log evidence for shifts ``d = free @ x``, x normal of variance 1, and the best d."""
        M = free.T @ self.S @ free + np.eye(free.shape[1])
        right = free.T @ self.b
        x = np.linalg.solve(M, right)
        return float(0.5 * right @ x - 0.5 * np.linalg.slogdet(M)[1]), free @ x


def fit(
    channels: Sequence[Rows],
    pairs: Sequence[tuple[int, int]],
    log_exposures: Float,
    mean: Float,
    factors: Float,
) -> Fit:
    """Curves of all channels under the prior `mean` (256,), `factors` (M, 256, 256)."""
    curves = np.tile(mean, (len(channels), 1))
    misfit = [np.ones(len(rows.b)) for rows in channels]
    for final in (False, True):
        system = [
            equations(rows, pairs, log_exposures, mean, g, m, correct=final)
            for rows, g, m in zip(channels, curves, misfit, strict=True)
        ]
        H, X, tt, t0 = (
            np.stack(part) for part in zip(*(_normal(e) for e in system), strict=True)
        )
        # the first pass is for the slopes and the misfit alone
        all_QX, all_Q, logdet = posterior(H, X, factors if final else factors[:1])
        gain = 0.5 * np.einsum("cn,cmn->cm", X[..., 0], all_QX[..., 0]) - 0.5 * logdet
        model = np.argmax(gain, axis=1)
        at = np.arange(len(channels))
        QX, Q = all_QX[at, model], all_Q[at, model]
        curves = mean + QX[..., 0]
        if not final:
            misfit = [
                misfit_of(e, (e.y - e.D @ (g - mean)))
                for e, g in zip(system, curves, strict=True)
            ]
    P = len(log_exposures)
    gt, Qgt = X[..., 1 : P + 1], QX[..., 1 : P + 1]
    return Fit(
        g=curves,
        covariance=Q,
        S=(tt - np.swapaxes(gt, 1, 2) @ Qgt).sum(axis=0),
        b=(t0 - np.einsum("cnp,cn->cp", gt, QX[..., 0])).sum(axis=0),
        model=model,
        equations=tuple(system),
        information=H,
        right=X,
    )


def share(fit: Fit, mean: Float, factors: Float) -> Fit:
    """The fit with each channel told what the others say of it.

    The channels of one camera have nearly one curve: they differ by K, 5 % that vary over 40
    codes. What channel o adds to another is its likelihood, the posterior less the prior:
    (Q_o + K)^-1 - (S_o + K)^-1. Where a channel sees no light, the others' curves hold.
    """
    place = np.arange(KNOTS)
    nearness = np.exp(-0.5 * ((place[:, None] - place) / ALIKE_REACH) ** 2)
    K = ALIKE**2 * nearness + 1e-8 * np.eye(KNOTS)
    H, X = fit.information.copy(), fit.right.copy()
    for o, (g, cov, model) in enumerate(zip(fit.g, fit.covariance, fit.model, strict=True)):
        after = np.linalg.inv(cov + K)
        before = np.linalg.inv(factors[model] @ factors[model].T + K)
        said = after @ (g - mean)
        for c in range(len(H)):
            if c != o:
                H[c] += after - before
                X[c, :, 0] += said
    QX, Q, _ = posterior(H, X, factors)
    at = np.arange(len(H))
    return replace(
        fit,
        g=mean + QX[at, fit.model][..., 0],
        covariance=Q[at, fit.model],
        information=H,
        right=X,
    )


def _normal(e: Equations) -> tuple[Float, Float, Float, Float]:
    """D'WD, right sides (D'Wy, -D'WE, zeros up to a multiple of 16), E'WE, -E'Wy."""
    DW, EW = (e.D.multiply(e.w[:, None])).T, e.E.T * e.w
    X = np.concatenate([(DW @ e.y)[:, None], -(DW @ e.E)], axis=1)
    fewer_shapes = np.pad(X, [(0, 0), (0, -X.shape[1] % 16)])  # to compile
    return (DW @ e.D).toarray(), fewer_shapes, EW @ e.E, -EW @ e.y
