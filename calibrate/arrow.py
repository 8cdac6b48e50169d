"""Least squares whose unknowns form an arrowhead: local blocks that meet in shared ones alone.

Boards, points and poses are local, lenses and what else all of them share is shared. The local
blocks are eliminated (the Schur complement of Triggs et al. 2000, section 6.1); steps are
Levenberg-Marquardt's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Arrowhead:
    """Normal equations J'WJ x = -J'We of s shared unknowns and V blocks of l local ones.

    ``shared`` (s, s), ``between`` (V, l, s), ``local`` (V, l, l), and the gradients J'We,
    ``shared_gradient`` (s,) and ``local_gradient`` (V, l).
    """

    shared: NDArray[np.float64]
    between: NDArray[np.float64]
    local: NDArray[np.float64]
    shared_gradient: NDArray[np.float64]
    local_gradient: NDArray[np.float64]

    @classmethod
    def empty(cls, shared: int, blocks: int, local: int) -> Arrowhead:
        """Of no residuals yet."""
        return cls(
            np.zeros((shared, shared)),
            np.zeros((blocks, local, shared)),
            np.zeros((blocks, local, local)),
            np.zeros(shared),
            np.zeros((blocks, local)),
        )

    @classmethod
    def of(
        cls,
        by_shared: NDArray[np.float64],
        by_local: NDArray[np.float64],
        error: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> Arrowhead:
        """Of n residuals a block.

        Derivatives `by_shared` (V, n, s) and `by_local` (V, n, l), residuals `error` (V, n)
        and their weights (V, n).
        """
        blocks, n, s = by_shared.shape
        local_t = np.swapaxes(weight[..., None] * by_local, 1, 2)
        flat = by_shared.reshape(blocks * n, s)
        weighted = weight.reshape(-1, 1) * flat
        return cls(
            weighted.T @ flat,
            local_t @ by_shared,
            local_t @ by_local,
            error.reshape(-1) @ weighted,
            (local_t @ error[..., None])[..., 0],
        )

    def include(self, part: Arrowhead, columns: NDArray[Any], blocks: NDArray[Any]) -> None:
        """Add a `part` that knows the shared unknowns `columns` and these `blocks` alone.

        `blocks` are distinct, and so are `columns`.
        """
        self.shared[np.ix_(columns, columns)] += part.shared
        self.shared_gradient[columns] += part.shared_gradient
        width = np.arange(self.local.shape[1])
        self.between[np.ix_(blocks, width, columns)] += part.between
        self.local[blocks] += part.local
        self.local_gradient[blocks] += part.local_gradient

    def know(self, precision: NDArray[np.float64], value: NDArray[np.float64]) -> None:
        """Add what is known beforehand: shared unknowns `value` (s,) off, (s,) precise."""
        self.shared[np.diag_indices_from(self.shared)] += precision
        self.shared_gradient[:] += precision * value

    def reduced(
        self, damping: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Schur complement (s, s), inverses of the local blocks, those times the coupling.

        Raises ``LinAlgError`` where a block is singular.
        """
        flat = (self.between.shape[0] * self.between.shape[1], len(self.shared))
        axis = np.arange(self.local.shape[1])
        damped = self.local.copy()
        damped[:, axis, axis] *= 1 + damping
        inverse = np.linalg.inv(damped)
        coupling = inverse @ self.between
        schur = self.shared + damping * np.diag(np.diag(self.shared))
        schur -= self.between.reshape(flat).T @ coupling.reshape(flat)
        return schur, inverse, coupling

    def step(self, damping: float) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Change of the shared (s,) and local (V, l) unknowns; None where singular."""
        try:
            schur, inverse, coupling = self.reduced(damping)
            own = (inverse @ self.local_gradient[..., None])[..., 0]
            right = np.einsum("vls,vl->s", self.between, own) - self.shared_gradient
            size = np.sqrt(np.abs(np.diag(schur))) + 1e-300
            shared = np.linalg.solve(schur / np.outer(size, size), right / size) / size
        except np.linalg.LinAlgError:
            return None
        local = -own - coupling @ shared
        if not (np.isfinite(shared).all() and np.isfinite(local).all()):
            return None
        return shared, local

    def covariance(self) -> tuple[NDArray[np.float64], float]:
        """Covariance (s, s) of the shared unknowns for unit weights, and the condition.

        The first is the block of (J'WJ)^-1 over all unknowns, the second the condition number
        of the reduced equations scaled to a unit diagonal, infinite (the covariance NaN) where
        they are singular.
        """
        if not len(self.shared):
            return self.shared.copy(), 1.0
        try:
            schur, _, _ = self.reduced(0.0)
            size = np.sqrt(np.diag(schur))
            scaled = schur / np.outer(size, size)
            return np.linalg.inv(scaled) / np.outer(size, size), float(np.linalg.cond(scaled))
        except np.linalg.LinAlgError:
            return np.full_like(self.shared, np.nan), math.inf


class System(Protocol):
    """Normal equations that know their damped step."""

    def step(self, damping: float) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Change of the shared (s,) and local (V, l) unknowns; None where singular."""
        ...


def descend[E](
    start: E,
    linearise: Callable[[E], tuple[float, System]],
    move: Callable[[E, NDArray[np.float64], NDArray[np.float64]], E | None],
    *,
    steps: int,
    least_gain: float = 1e-10,
) -> E:
    """The estimate of least cost by Levenberg and Marquardt.

    Parameters
    ----------
    start
        Returned as it is where its cost is infinite.
    linearise
        Cost and normal equations at an estimate; the cost infinite where it is impossible.
    move
        The estimate changed by a step, shared (s,) and local (V, l); None where impossible.
    steps
        The most steps.
    least_gain
        The relative gain of the cost below which a step is the last.

    """
    estimate, damping = start, 1e-4
    cost, system = linearise(estimate)
    for _ in range(steps if math.isfinite(cost) else 0):
        step = system.step(damping)
        candidate = None if step is None else move(estimate, *step)
        new_cost, new_system = math.inf, system
        if candidate is not None:
            new_cost, new_system = linearise(candidate)
        if candidate is not None and new_cost <= cost:
            gain = cost - new_cost
            estimate, cost, system = candidate, new_cost, new_system
            damping = max(damping / 10, 1e-10)
            if gain <= least_gain * cost:
                break
        elif damping > 1e8:
            break
        else:
            damping *= 10
    return estimate


def cauchy(
    square: NDArray[np.float64], used: NDArray[np.bool_], scale: float
) -> tuple[float, NDArray[np.float64]]:
    """Cost and weights of squared distances; one of `scale` counts half, of infinity fully.

    `square` is zero where not `used`.
    """
    if math.isinf(scale):
        return float(square.sum()), used.astype(float)
    ratio = square / scale**2
    return float(scale**2 * np.log1p(ratio).sum()), used / (1 + ratio)
