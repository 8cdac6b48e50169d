"""The fall-off of a lens from pictures of what is evenly bright (seeds.md A1v, A 5.2).

A sample n of group g (a view of a board, a picture of a flat field) says

    ln I_n = ln V(q_n) + a_g + s_n' w + z_n' u_g + e_n,
    V = (1 + c1 r^2 + c2 r^4 + ...) exp(m),

a_g its light and exposure, u_g how its light varies over the board, w a light that all pictures
share (a flat field's gradient, turned with the pictures). The u_g are random with variances
that the pictures tell themselves (restricted maximum likelihood by EM; Laird and Ware 1982):
the gradient of a lamp on a small board looks like a fall-off, and only many boards tell them
apart. The c_k and the centre are solved by Gauss-Newton, outliers are left out, and a term
stays only if it is two standard errors large. m, bilinear on a lattice, is added if the
residuals ask for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.vignette_data import Samples
from chromeball.calibrate.vignette_map import bilinear, normal, smooth
from chromeball.scene.errors import UserError
from chromeball.scene.vignette import (
    LATTICE,
    Edge,
    Source,
    Vignette,
    lattice,
    log_slopes,
    polynomial,
)

type Float = NDArray[np.float64]
type Index = NDArray[np.intp]

#: Most and fewest terms, and the standard errors that one more must measure.
TERMS, FEWEST, EARNED = 4, 2, 2.0
#: Prior standard deviations: of a c_k, and of the centre over the radius, about the lens's
#: principal point and about the middle.
COEFFICIENT, PRINCIPAL, MIDDLE = 3.0, 0.02, 0.05
#: Most steps of a fit; the variances of light that hardly varies settle slowly.
STEPS = 60
#: Residuals beyond so many robust deviations are outliers.
OUTLIER = 4.0
#: The map is asked for when it explains so many standard deviations of chi-square too much,
#: and is at least so large.
ASKED, WORTH = 6.0, 0.002
#: r that the samples must reach, and the relative error of V there that is no measurement.
REACH, WORST = 0.5, 0.05


@dataclass(frozen=True)
class Solved:
    """``vignette`` and what tells how good it is.

    ``residuals`` (N,) of ln I, NaN for outliers; ``scatter`` their robust deviation before and
    after the fall-off is out, light fitted in both; ``light_sigma``: by how much lights vary,
    ln, for each kind; ``inflation`` of the standard errors by what clusters say against each
    other; ``condition`` of the scaled normal matrix; ``map_chi_square``: by how much the map
    improves chi-square, per deviation of chance.
    """

    vignette: Vignette
    residuals: Float
    scatter: tuple[float, float]
    light_sigma: tuple[float, ...]
    shared: Float
    inflation: float
    condition: float
    map_chi_square: float

    @property
    def outliers(self) -> int:
        """How many samples were left out."""
        return int(np.isnan(self.residuals).sum())


@dataclass(frozen=True)
class _Fit:
    """Columns: K coefficients, centre (2) over the radius, M shared, lattice."""

    x: Float
    covariance: Float
    residuals: Float
    variances: Float
    scale: float
    inflation: float
    condition: float
    chi_square: float
    map_freedom: float


def solve(
    samples: Samples,
    size: tuple[int, int],
    *,
    source: Source,
    centre: tuple[float, float] | None = None,
    radius: float | None = None,
    free_centre: bool = True,
    edge: Edge | None = None,
    terms: int = TERMS,
    with_map: bool | None = None,
) -> Solved:
    """The fall-off that makes each group's light smooth.

    `centre` is the first guess, the lens's or the middle; r = 1 at `radius`, by default half
    the diagonal. `with_map` forces the map or forbids it; by default the residuals decide.

    Raises
    ------
    UserError
        When samples are too few, or only the middle was seen, or the pictures leave the
        fall-off open.

    """
    width, height = size
    middle = np.array(centre or ((width - 1) / 2, (height - 1) / 2), float)
    reach = math.hypot(width, height) / 2 if radius is None else radius
    far = np.linalg.norm(samples.pixels - middle, axis=1) / reach
    if len(far) < 30:
        raise UserError(
            f"{len(far)} places of even light were found; a fall-off needs 30 or more"
        )
    covered = float(np.quantile(far, 0.99))
    if covered < REACH:
        raise UserError(
            f"only the middle was seen, to {covered:.0%} of the way to the corner: bring the "
            "light or the board to the corners, too"
        )
    stray = MIDDLE if centre is None else PRINCIPAL
    problem = _Problem(samples, size, middle, reach, free_centre, stray)
    keep = np.ones(len(far), bool)
    fit = problem.fit(terms, keep)
    for _ in range(3):  # outliers by the robust scatter of what is left
        spread = 1.4826 * float(np.median(np.abs(fit.residuals[keep] / samples.sigma[keep])))
        now = np.abs(fit.residuals) <= OUTLIER * max(spread, 1e-12) * samples.sigma
        if (now == keep).all():
            break
        keep, fit = now, problem.fit(terms, now, fit)
    count = terms
    while count > FEWEST and abs(fit.x[count - 1]) < EARNED * math.sqrt(
        fit.covariance[count - 1, count - 1]
    ):
        count -= 1
        fit = problem.fit(count, keep)
    plain, gain = fit, 0.0
    mapped = False
    if with_map is not False:
        flat, tried = (
            problem.fit(count, keep, plain, mapped=m, fixed=True) for m in (False, True)
        )
        # what errs together must not ask for a map
        drop = (flat.chi_square - tried.chi_square) / plain.inflation**2
        gain = (drop - tried.map_freedom) / math.sqrt(2 * max(tried.map_freedom, 1.0))
        values = tried.x[-LATTICE[0] * LATTICE[1] :]
        mapped = bool(with_map) or (gain > ASKED and float(np.std(values)) > WORTH)
        if mapped:
            fit = problem.fit(count, keep, plain, mapped=True)
    found = problem.vignette(fit, count, mapped, source, edge, covered)
    worst = _error_at_reach(found, samples.pixels)
    if not worst < WORST:
        uneven = float(np.sqrt(fit.variances.max())) if fit.variances.size else 0.0
        raise UserError(
            f"the pictures leave the fall-off open to {worst:.0%} where they reach, for the "
            f"light varies by {uneven:.0%} within them: take more, under even light, what is "
            "bright large and near the corners"
        )
    after = np.where(keep, fit.residuals, np.nan)
    bare = problem.fit(0, keep, plain)
    before, left = (
        1.4826 * float(np.nanmedian(np.abs(r[keep]))) for r in (bare.residuals, after)
    )
    shared = samples.shared.shape[1]
    start = count + 2 * free_centre
    return Solved(
        found,
        after,
        (before, left),
        tuple(float(v) for v in np.sqrt(fit.variances)),
        fit.x[start : start + shared],
        fit.inflation,
        fit.condition,
        gain,
    )


def _error_at_reach(found: Vignette, pixels: Float) -> float:
    """Relative standard error of V where the outermost tenth of the samples lies."""
    far = np.linalg.norm(pixels - found.centre, axis=1)
    return float(np.median(found.sigma_at(pixels[far >= np.quantile(far, 0.9)])))


@dataclass(frozen=True)
class _Problem:
    samples: Samples
    size: tuple[int, int]
    middle: Float
    reach: float
    free_centre: bool
    stray: float

    def fit(
        self,
        count: int,
        keep: NDArray[np.bool_],
        start: _Fit | None = None,
        *,
        mapped: bool = False,
        fixed: bool = False,
    ) -> _Fit:
        """Gauss-Newton on the fall-off, EM on the variances, unless these are `fixed`."""
        s = self.samples
        groups, L = int(s.group.max()) + 1, s.light.shape[1]
        nodes = bilinear(s.pixels, self.size) if mapped else np.zeros((len(s.log), 0))
        centre = 2 * self.free_centre if count else 0
        head = count + centre
        columns = head + s.shared.shape[1] + nodes.shape[1]
        prior = np.zeros((columns, columns))
        prior[:count, :count] = np.eye(count) / COEFFICIENT**2
        prior[count:head, count:head] = np.eye(centre) / self.stray**2
        if mapped:
            prior[-nodes.shape[1] :, -nodes.shape[1] :] = smooth()
        local = np.concatenate([np.ones((len(s.log), 1)), s.light], axis=1)
        weight = np.where(keep, 1 / s.sigma**2, 0.0)
        kinds = np.array(s.kinds, int)
        variances = np.full(kinds.max() + 1 if L else 0, 0.05**2)
        scale = float(np.median(np.abs(s.log - np.median(s.log)))) / float(np.median(s.sigma))
        if start is not None:
            scale = start.scale
            variances = start.variances.copy()
        x = np.zeros(columns)
        if start is not None and count and len(start.x) >= head:
            x[:head] = start.x[:head]
        freedom = 1.0
        step = 0
        while True:
            step += 1
            value, J = self._model(x, count, nodes)
            y = s.log - value
            w = weight / max(scale, 1e-9) ** 2
            D = np.concatenate([[0.0], 1 / np.maximum(variances[kinds], 1e-12)])
            A, B, blocks, gx, gl = normal(J, local, y, w, s.group, groups)
            blocks = blocks + np.diag(D)
            # a group that a single sample saw says nothing about its light
            blocks[:, range(L + 1), range(L + 1)] += 1e-9
            inverse = np.linalg.inv(blocks)
            through = inverse @ B  # (G, L + 1, columns)
            schur = A - np.einsum("glc,gld->cd", B, through) + prior
            right = gx - np.einsum("glc,gl->c", through, gl) - prior @ x
            own = 1 / np.sqrt(np.maximum(np.diag(schur), 1e-300))
            scaled = schur * own[:, None] * own
            covariance = np.linalg.inv(scaled) * own[:, None] * own if columns else schur
            delta = covariance @ right
            while count and not self._possible(x + delta, count):
                delta = delta / 2
            x = x + delta
            u = np.einsum("glm,gm->gl", inverse, gl - B @ delta)
            residual = y - J @ delta - np.einsum("nl,nl->n", local, u[s.group])
            # the variances: E-step with the unknowns' own uncertainty
            spread = inverse + through @ covariance @ np.swapaxes(through, 1, 2)
            second = u[:, 1:] ** 2 + np.diagonal(spread, axis1=1, axis2=2)[:, 1:]
            new = np.array([second[:, kinds == k].mean() for k in range(len(variances))])
            new = variances if fixed else np.maximum(new, 1e-8)  # ln 1e-4 is even light
            used = float((w * residual**2).sum())
            # effective unknowns: trace of the hat matrix
            hat = columns - float(np.trace(covariance @ prior)) + groups
            shrunk = np.diagonal(spread, axis1=1, axis2=2)[:, 1:] * D[1:]
            hat += float((1 - shrunk).sum())
            freedom = max(float(keep.sum()) - hat, 1.0)
            ratio = 1.0 if fixed else used / freedom
            calm = float(np.abs(delta[:count]).max()) < 1e-7 if count else True
            calm = calm and abs(ratio - 1) < 1e-3
            if len(new):
                calm = calm and bool(np.abs(np.log(new / variances)).max() < 0.02)
            scale *= math.sqrt(ratio)
            variances = new
            if (calm and step > 3) or step == STEPS:
                break
        inflation = self._inflation(J, local, through, covariance, residual, w, head)
        condition = float(np.linalg.cond(scaled)) if columns else 1.0
        prior_cost = float((u[:, 1:] ** 2 * D[1:]).sum() + x @ prior @ x)
        told = np.eye(columns) - covariance @ prior
        freedom = float(np.trace(told[columns - nodes.shape[1] :, columns - nodes.shape[1] :]))
        return _Fit(
            x,
            np.asarray(covariance * inflation**2, float),
            residual,
            variances,
            scale,
            inflation,
            condition,
            used + prior_cost,
            freedom,
        )

    def vignette(
        self,
        fit: _Fit,
        count: int,
        mapped: bool,
        source: Source,
        edge: Edge | None,
        covered: float,
    ) -> Vignette:
        """What is written, with errors on the lattice that know all unknowns' covariance."""
        offset = self.reach * fit.x[count : count + 2] if self.free_centre else np.zeros(2)
        centre = self.middle + offset
        nodes = lattice(self.size).reshape(-1, 2)
        grid = fit.x[-len(nodes) :].copy() if mapped else np.zeros(len(nodes))
        slopes = self._slopes(nodes, fit.x, count)[1]
        shared = self.samples.shared.shape[1]
        by = np.concatenate([slopes, np.zeros((len(nodes), shared))], axis=1)
        if mapped:  # against the map's own value at the centre: V is 1 there
            at = bilinear(centre[None], self.size)
            grid -= at[0] @ grid
            by = np.concatenate([by, np.eye(len(nodes)) - at], axis=1)
        sigma = np.sqrt(np.maximum(np.einsum("nc,cd,nd->n", by, fit.covariance, by), 0))
        return Vignette(
            self.size,
            (float(centre[0]), float(centre[1])),
            self.reach,
            fit.x[:count],
            fit.covariance[:count, :count],
            sigma.reshape(LATTICE),
            grid.reshape(LATTICE) if mapped else None,
            covered,
            edge,
            source,
        )

    def _model(self, x: Float, count: int, nodes: Float) -> tuple[Float, Float]:
        s = self.samples
        value, slopes = self._slopes(s.pixels, x, count)
        J = np.concatenate([slopes, s.shared, nodes], axis=1)
        rest = slopes.shape[1]
        return value + J[:, rest:] @ x[rest:], J

    def _slopes(self, pixels: Float, x: Float, count: int) -> tuple[Float, Float]:
        """Ln V of the polynomial, and its slopes by coefficients and centre."""
        if not count:
            return np.zeros(len(pixels)), np.zeros((len(pixels), 0))
        place = (pixels - self.middle) / self.reach
        if self.free_centre:
            place = place - x[count : count + 2]
        r2 = (place**2).sum(axis=1)
        V, slopes = log_slopes(r2, x[:count])
        if self.free_centre:
            k = np.arange(1, count + 1)
            by_r2 = (k * x[:count] * r2[:, None] ** (k - 1)).sum(axis=1) / V
            slopes = np.concatenate([slopes, -2 * place * by_r2[:, None]], axis=1)
        return np.log(V), slopes

    def _possible(self, x: Float, count: int) -> bool:
        """Positive wherever there are samples."""
        place = (self.samples.pixels - self.middle) / self.reach
        if self.free_centre:
            if np.abs(x[count : count + 2]).max() > 1:
                return False
            place = place - x[count : count + 2]
        r2 = np.linspace(0, float((place**2).sum(axis=1).max()), 65)
        return float(polynomial(r2, x[:count]).min()) > 0.02

    def _inflation(
        self,
        J: Float,
        local: Float,
        through: Float,
        covariance: Float,
        residual: Float,
        w: Float,
        head: int,
    ) -> float:
        """How much larger errors are by what whole clusters say (Liang and Zeger 1986)."""
        s = self.samples
        clusters = int(s.cluster.max()) + 1
        if clusters < 8 or not head:
            return 1.0
        free = J - np.einsum("nl,nlc->nc", local, through[s.group])  # light eliminated
        score = np.zeros((clusters, J.shape[1]))
        np.add.at(score, s.cluster, free * (w * residual)[:, None])
        score *= math.sqrt(clusters / (clusters - 1))
        step = score @ covariance[:, :head]
        # in units of the model's own errors, averaged over the picture's samples
        slopes = J[:, :head]
        told = np.einsum("nc,cd,nd->n", slopes, covariance[:head, :head], slopes)
        said = ((slopes @ step.T) ** 2).sum(axis=1)
        return math.sqrt(max(1.0, float(said.mean() / max(float(told.mean()), 1e-300))))
