"""Weighted least squares on the angles, its covariance, and what contradicts the rest."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from chromeball.envmap.axes.observations import Array, open_axis
from chromeball.envmap.axes.terms import State, TermOf
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: Standard errors beyond which an observation contradicts the others.
CONTRADICTION = 4.0


def best_of(
    terms: Sequence[TermOf],
    starts: Sequence[State],
    heading: bool,
    edges: Array,
) -> tuple[State, list[State]]:
    """The best attitude, and others that fit as well though they are tilted against it.

    `edges` (N, 3) lead up along clicked verticals, camera axes. Where nothing else tells up
    from down, the camera is upright.
    """
    cost = [float(np.sum(whitened(terms, s) ** 2)) for s in starts]
    refined: list[tuple[float, State]] = []
    for k in np.argsort(cost):
        state = refine(terms, starts[int(k)], heading)
        refined.append((float(np.sum(whitened(terms, state) ** 2)), state))
    least = min(c for c, _ in refined)
    equal = [s for c, s in refined if c < least + 9]
    # edges lead up, and camera y points down
    equal.sort(key=lambda s: (int((edges @ s.turn[:, 1] < 0).sum()), float(s.turn[1, 1])))
    best = equal[0]
    upright = len(edges) > 0 or best.turn[1, 1] < -0.3
    others = [
        s
        for s in equal
        if math.radians(3) < angle(s.turn[:, 1], best.turn[:, 1])
        and not (upright and s.turn[:, 1] @ best.turn[:, 1] < -0.99)
        and (edges @ s.turn[:, 1] >= 0).all()
    ]
    return best, others


def _weights(terms: Sequence[TermOf], state: State) -> list[Array]:
    """What turns each term's angles into standard errors."""
    return [np.linalg.inv(np.linalg.cholesky(term.spread(state))) for term in terms]


def whitened(
    terms: Sequence[TermOf], state: State, weights: Sequence[Array] | None = None
) -> Array:
    """Angles over their standard errors."""
    weights = _weights(terms, state) if weights is None else weights
    return np.concatenate(
        [w @ term.angles(state) for w, term in zip(weights, terms, strict=True)]
    )


def _moved(state: State, step: Array, heading: bool) -> State:
    turn = state.turn @ Pose.from_rotation_vector(step[:3], np.zeros(3)).rotation
    north = state.north + (step[3] if heading else 0.0)
    rectangle = state.rectangle
    if rectangle is not None:
        own = turn @ rectangle.plane
        rectangle = rectangle.with_rotation(own, step[3 + heading :])
    return State(turn, float(north), rectangle)


def _unknowns(state: State, heading: bool) -> int:
    return 3 + heading + (4 if state.rectangle is not None else 0)


def _jacobian(terms: Sequence[TermOf], state: State, heading: bool) -> Array:
    """Central differences of the whitened angles."""
    weights = _weights(terms, state)
    columns: list[Array] = []
    for step in 1e-6 * np.eye(_unknowns(state, heading)):
        ahead = whitened(terms, _moved(state, step, heading), weights)
        behind = whitened(terms, _moved(state, -step, heading), weights)
        columns.append((ahead - behind) / 2e-6)
    return np.stack(columns, axis=1)


def refine(terms: Sequence[TermOf], state: State, heading: bool) -> State:
    """Gauss-Newton with damping (Levenberg, Marquardt)."""
    damping = 1e-3
    r = whitened(terms, state)
    for _ in range(60):
        j, weights = _jacobian(terms, state, heading), _weights(terms, state)
        normal = j.T @ j
        diagonal = np.diag(np.maximum(np.diag(normal), 1e-9))
        for _ in range(12):
            step = -np.linalg.solve(normal + damping * diagonal, j.T @ r)
            step *= min(1.0, 0.5 / max(float(np.abs(step[:3]).max()), 1e-300))
            trial = _moved(state, step, heading)
            moved = whitened(terms, trial, weights)
            if moved @ moved <= r @ r:
                state, r = trial, whitened(terms, trial)
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
        else:
            break
        if np.abs(step).max() < 1e-10:
            break
    return state


def covariance_of(terms: Sequence[TermOf], state: State, heading: bool) -> Array:
    """Of the unknowns; refuses with the open axis's name."""
    j = _jacobian(terms, state, heading)
    scale = np.linalg.norm(j, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, s, vt = np.linalg.svd(j / scale, full_matrices=True)
    full = np.zeros(j.shape[1])
    full[: len(s)] = s
    open_ = vt[full < 1e-7 * full.max()] / scale
    for v in open_:
        tilt, yaw = float(np.hypot(v[0], v[2])), abs(float(v[1]))
        raise UserError(open_axis("heading" if yaw > 20 * tilt else "tilt", "by nothing"))
    inverse = vt.T @ np.diag(1 / full**2) @ vt
    return inverse / np.outer(scale, scale)


def chi_square(terms: Sequence[TermOf], state: State, heading: bool) -> tuple[float, int]:
    """Sum of the squared standard errors, and the degrees of freedom left."""
    r = whitened(terms, state)
    return float(r @ r), len(r) - _unknowns(state, heading)


def limit(freedom: int) -> float:
    """Chi-square that 1 in 10000 exceeds (Wilson and Hilferty 1931)."""
    return freedom * (1 - 2 / (9 * freedom) + 3.719 * math.sqrt(2 / (9 * freedom))) ** 3


def without(
    terms: Sequence[TermOf], k: int, state: State, heading: bool
) -> tuple[State, float, int]:
    """The fit without term `k`: its state, chi-square and freedom."""
    rest = [t for i, t in enumerate(terms) if i != k]
    state = refine(rest, state, heading)
    return state, *chi_square(rest, state, heading)


def culprits_of(terms: Sequence[TermOf], best: State, heading: bool) -> list[int]:
    """Observations without which the rest agree, the rectangle excepted; those that are alike.

    One is clearly to blame when no other's removal explains nearly as much.
    """
    found: list[tuple[float, int]] = []
    for k, term in enumerate(terms):
        if term.name == "rectangle":
            continue
        rest = [t for i, t in enumerate(terms) if i != k]
        try:
            state, chi, freedom = without(terms, k, best, heading)
            covariance_of(rest, state, heading)
        except (UserError, np.linalg.LinAlgError):
            continue  # without it an axis is open: it cannot be judged
        if chi <= (limit(freedom) if freedom > 0 else 1e-9 + 0.0):
            found.append((chi, k))
    found.sort()
    if not found:
        return []
    return [k for chi, k in found if chi < found[0][0] + CONTRADICTION**2]


def angle(a: Array, b: Array) -> float:
    """Radians between two directions."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
