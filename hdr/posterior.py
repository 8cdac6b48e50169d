"""Linear algebra of the response solvers in JAX: float64, compiled once for good.

Compiled code is kept in the user's cache folder (JAX's persistent compilation cache), so that
a command pays for compiling once, not at each start. ``CHROMEBALL_CACHE`` names another folder.
"""

from __future__ import annotations

import os
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

type Float = NDArray[np.float64]


def cache_folder() -> Path:
    """Where compiled code is kept: $CHROMEBALL_CACHE, else chromeball in the user's cache."""
    named = os.environ.get("CHROMEBALL_CACHE")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "chromeball"


@cache
def _jax() -> Any:
    import jax

    config: Any = jax.config
    config.update("jax_compilation_cache_dir", str(cache_folder() / "jax"))
    config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return jax


@cache
def _lineax() -> Any:
    return import_module("lineax")  # it has no types


@cache
def _posterior() -> Any:
    jax = _jax()
    import jax.numpy as jnp

    lx = _lineax()

    def one(H: Any, X: Any, A: Any) -> Any:
        K = jnp.eye(A.shape[1]) + A.T @ H @ A
        operator = lx.MatrixLinearOperator(K, lx.positive_semidefinite_tag)
        solver = lx.Cholesky()
        state = solver.init(operator, {})

        def solve(column: Any) -> Any:
            return lx.linear_solve(operator, column, solver, state=state, throw=False).value

        AX = A.T @ X
        Z = jax.vmap(solve, in_axes=1, out_axes=1)(jnp.concatenate([AX, A.T], axis=1))
        width = X.shape[1]
        logdet = 2 * jnp.log(jnp.abs(jnp.diag(state[0]))).sum()
        return A @ Z[:, :width], A @ Z[:, width:], logdet

    over_models = jax.vmap(one, in_axes=(None, None, 0))
    return jax.jit(jax.vmap(over_models, in_axes=(0, 0, None)))


def posterior(H: Float, X: Float, A: Float) -> tuple[Float, Float, Float]:
    """Gaussian posteriors for information H (C, n, n) and prior covariances A A' (M, n, n).

    With Q = A (I + A' H A)^-1 A': gives Q X (C, M, n, k) for right sides X (C, n, k), the
    covariances Q (C, M, n, n), and ln det(I + A' H A) (C, M).
    """
    jax = _jax()
    with jax.enable_x64(True):
        QX, Q, logdet = _posterior()(H, X, A)
        return np.asarray(QX), np.asarray(Q), np.asarray(logdet)


@cache
def _pinned() -> Any:
    jax = _jax()
    import jax.numpy as jnp

    lx = _lineax()

    def one(M: Any, right: Any) -> Any:
        d = 1 / jnp.sqrt(jnp.diag(M))
        scaled = M * d[:, None] * d
        operator = lx.MatrixLinearOperator(scaled, lx.positive_semidefinite_tag)
        solver = lx.Cholesky()
        state = solver.init(operator, {})

        def solve(column: Any) -> Any:
            return lx.linear_solve(operator, column, solver, state=state, throw=False).value

        columns = jnp.concatenate([(d * right)[:, None], jnp.diag(d)], axis=1)
        solved = d[:, None] * jax.vmap(solve, in_axes=1, out_axes=1)(columns)
        return solved[:, 0], solved[:, 1:], scaled

    return jax.jit(jax.vmap(one))


def solve_normal(M: Float, right: Float) -> tuple[Float, Float, Float]:
    """Solve M x = right for (C, n, n), (C, n): x, M^-1, and M with its diagonal scaled to 1.

    The Cholesky factor is of the scaled matrix. Where M is singular x is not finite.
    """
    jax = _jax()
    with jax.enable_x64(True):
        x, inverse, scaled = _pinned()(M, right)
        return np.asarray(x), np.asarray(inverse), np.asarray(scaled)
