"""Arrowhead normal equations against dense ones, and the descent on a curved problem."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.arrow import Arrowhead, cauchy, descend

BLOCKS, ROWS, SHARED, LOCAL = 5, 9, 4, 3


def problem(seed: int = 0) -> tuple[NDArray[np.float64], ...]:
    """Derivatives by shared and local unknowns, residuals, weights."""
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(BLOCKS, ROWS, SHARED)),
        rng.normal(size=(BLOCKS, ROWS, LOCAL)),
        rng.normal(size=(BLOCKS, ROWS)),
        rng.uniform(0.5, 2, (BLOCKS, ROWS)),
    )


def dense(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """All derivatives as one matrix, the shared unknowns first."""
    whole = np.zeros((BLOCKS * ROWS, SHARED + BLOCKS * LOCAL))
    whole[:, :SHARED] = a.reshape(-1, SHARED)
    for v in range(BLOCKS):
        first = SHARED + v * LOCAL
        whole[v * ROWS : (v + 1) * ROWS, first : first + LOCAL] = b[v]
    return whole


def test_step_and_covariance_are_those_of_the_dense_equations() -> None:
    a, b, e, w = problem()
    system = Arrowhead.of(a, b, e, w)
    precision, value = np.arange(1.0, 1 + SHARED), np.linspace(-1, 1, SHARED)
    system.know(precision, value)
    j, root = dense(a, b), np.sqrt(w.ravel())
    known = np.zeros((SHARED, j.shape[1]))
    known[:, :SHARED] = np.diag(np.sqrt(precision))
    j = np.concatenate([root[:, None] * j, known])
    right = -np.concatenate([root * e.ravel(), np.sqrt(precision) * value])
    expected = np.linalg.lstsq(j, right)[0]
    step = system.step(0.0)
    assert step is not None
    np.testing.assert_allclose(np.concatenate([step[0], step[1].ravel()]), expected, atol=1e-12)
    covariance, condition = system.covariance()
    np.testing.assert_allclose(covariance, np.linalg.inv(j.T @ j)[:SHARED, :SHARED], atol=1e-12)
    assert 1 <= condition < 1e4


def test_parts_know_some_columns_and_blocks() -> None:
    """Two parts put together are the whole whose other derivatives are zero."""
    a, b, e, w = problem()
    whole = Arrowhead.empty(SHARED, BLOCKS, LOCAL)
    full = Arrowhead.empty(SHARED, BLOCKS, LOCAL)
    for columns, blocks in (([0, 2], [4, 1, 0]), ([1, 2, 3], [1, 3])):
        c, v = np.array(columns), np.array(blocks)
        whole.include(Arrowhead.of(a[v][..., c], b[v], e[v], w[v]), c, v)
        padded = np.zeros((len(v), ROWS, SHARED))
        padded[..., c] = a[v][..., c]
        full.include(Arrowhead.of(padded, b[v], e[v], w[v]), np.arange(SHARED), v)
    for name in ("shared", "between", "local", "shared_gradient", "local_gradient"):
        np.testing.assert_allclose(getattr(whole, name), getattr(full, name), atol=1e-13)


def test_singular_equations_say_so() -> None:
    a, b, e, w = problem()
    assert Arrowhead.of(a, 0 * b, e, w).step(0.0) is None
    covariance, condition = Arrowhead.of(a, 0 * b, e, w).covariance()
    assert math.isinf(condition)
    assert np.isnan(covariance).all()


@pytest.mark.parametrize("scale", [math.inf, 1.0])
def test_descent_finds_a_common_decay(scale: float) -> None:
    """y = amplitude_v exp(-rate t): the rate is shared; one point in nine is wrong."""
    t = np.linspace(0, 3, ROWS)
    rate, amplitude = 0.7, np.linspace(1, 3, BLOCKS)
    y = amplitude[:, None] * np.exp(-rate * t)
    if math.isfinite(scale):
        y[:, 4] += 50

    def linearise(x: NDArray[np.float64]) -> tuple[float, Arrowhead]:
        decay = np.exp(-x[0] * t)
        error = x[1:, None] * decay - y
        cost, weight = cauchy(error**2, np.ones(error.shape, bool), scale)
        by_rate = (-t * x[1:, None] * decay)[..., None]
        by_amplitude = np.broadcast_to(decay[:, None], (BLOCKS, ROWS, 1))
        return cost, Arrowhead.of(by_rate, by_amplitude, error, weight)

    def move(
        x: NDArray[np.float64], shared: NDArray[np.float64], local: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return x + np.concatenate([shared, local.ravel()])

    start = np.concatenate([[0.5], np.full(BLOCKS, 2.0)])
    found = descend(start, linearise, move, steps=100, least_gain=0.0)
    tolerance = 1e-6 if math.isinf(scale) else 0.02
    np.testing.assert_allclose(found, [rate, *amplitude], atol=tolerance)
