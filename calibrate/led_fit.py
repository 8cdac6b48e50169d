"""The place of a spot by an elliptical Gaussian, free of the bias of saturated pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.led_frames import FULL

STEPS = 25
#: No spot is placed better than this, pixels: pixels are not points.
LEAST_ERROR = 0.02
#: A fit this uncertain, or this far from the patch's light, is none.
WORST_ERROR = 1.0


def fit_spot(
    patch: NDArray[np.float32], saturated: NDArray[np.bool_], noise: float
) -> tuple[NDArray[np.float64], float] | None:
    """Place (x, y) in the patch and standard error of a coordinate, pixels; None for no spot.

    The model is A exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2), by Levenberg and Marquardt over
    the pixels of `patch` (h, w), NaN where they are another's. A `saturated` pixel pulls only
    while the model is below it.
    """
    known = np.isfinite(patch)
    y, x = (v.astype(float) for v in np.nonzero(known))
    value, full = patch[known].astype(float), saturated[known]
    state = _start(x, y, value)
    if state is None:
        return None
    damping = 1e-3
    error, jacobian = _linearise(state, x, y, value, full)
    for _ in range(STEPS):
        normal = jacobian.T @ jacobian
        damped = normal + damping * np.diag(np.diag(normal) + 1e-12)
        step = np.linalg.solve(damped, -jacobian.T @ error)
        trial = state + step
        if trial[0] > 0 and trial[3] > 0 and trial[3] * trial[5] > trial[4] ** 2:
            new_error, new_jacobian = _linearise(trial, x, y, value, full)
            if new_error @ new_error <= error @ error:
                state, error, jacobian = trial, new_error, new_jacobian
                damping = max(damping / 10, 1e-9)
                if np.abs(step[1:3]).max() < 1e-4:
                    break
                continue
        damping *= 10
        if damping > 1e8:
            break
    normal = jacobian.T @ jacobian
    size = np.sqrt(np.diag(normal))
    if not (size > 0).all() or np.linalg.cond(normal / np.outer(size, size)) > 1e10:
        return None
    count = max(int((jacobian != 0).any(axis=1).sum()) - 6, 1)
    variance = max((noise / FULL) ** 2, float(error @ error) / count)
    spread = variance * np.linalg.inv(normal)[1:3, 1:3]
    deviation = float(np.sqrt(max(np.linalg.eigvalsh(spread)[-1], LEAST_ERROR**2)))
    height, width = patch.shape
    inside = -0.5 <= state[1] <= width - 0.5 and -0.5 <= state[2] <= height - 0.5
    return (state[1:3], deviation) if inside and deviation < WORST_ERROR else None


def _start(
    x: NDArray[np.float64], y: NDArray[np.float64], value: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Amplitude, centre and inverse covariance by moments of the brighter half."""
    weight = np.clip(value - 0.3 * value.max(initial=0.0), 0, None)
    total = weight.sum()
    if total <= 0:
        return None
    cx, cy = (weight @ x) / total, (weight @ y) / total
    dx, dy = x - cx, y - cy
    xx, yy, xy = (float((weight @ p) / total) for p in (dx * dx, dy * dy, dx * dy))
    inverse = np.linalg.inv(np.array([[xx + 0.3, xy], [xy, yy + 0.3]]))
    return np.array([value.max(), cx, cy, inverse[0, 0], inverse[0, 1], inverse[1, 1]])


def _linearise(
    state: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    value: NDArray[np.float64],
    full: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Model minus picture, (N,), and its derivatives, (N, 6)."""
    height, cx, cy, a, b, c = state
    dx, dy = x - cx, y - cy
    shape = np.exp(-0.5 * np.minimum(a * dx * dx + 2 * b * dx * dy + c * dy * dy, 60))
    model = height * shape
    jacobian = np.stack(
        [
            shape,
            model * (a * dx + b * dy),
            model * (b * dx + c * dy),
            -0.5 * model * dx * dx,
            -model * dx * dy,
            -0.5 * model * dy * dy,
        ],
        axis=1,
    )
    error = model - value
    free = full & (error > 0)
    error[free], jacobian[free] = 0.0, 0.0
    return error / FULL, jacobian / FULL
