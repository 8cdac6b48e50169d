"""Debevec and Malik's solve: two routes to its matrix, its errors, the paper's own solver."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.debevec import hat, refine, second_difference
from chromeball.hdr.response import Solution, sample, solve
from chromeball.scene.errors import UserError
from tests.hdr.camera import TIMES, log_exposure, photograph, scene


def debevec(frames: list[NDArray[np.uint8]], times: NDArray[np.float64] = TIMES) -> Solution:
    return solve([sample(f, 256, 1) for f in frames], times, method="debevec")


def test_schur_complement_equals_dense_normal_equations() -> None:
    """Two routes: all unknowns at once (the paper's matrix), and ln E eliminated."""
    rng = np.random.default_rng(5)
    P, N = 4, 60
    radiance = rng.uniform(0.02, 1, N)
    codes = np.stack([np.clip(255 * (radiance * t) ** 0.45, 1, 254) for t in TIMES[:P]])
    fixed = np.round(codes * 256).astype(np.uint16)
    w = hat()
    tau = np.log(TIMES[:P])
    rows, right = [], []
    for i in range(N):
        for j in range(P):
            z, u = fixed[j, i] >> 8, (fixed[j, i] & 255) / 256
            weight = (1 - u) * w[z] ** 2 + u * w[z + 1] ** 2
            row = np.zeros(256 + N)
            row[z], row[z + 1], row[256 + i] = 1 - u, u, -1
            rows.append(np.sqrt(weight) * row)
            right.append(np.sqrt(weight) * tau[j])
    A, b = np.array(rows), np.array(right)
    H, observed, used = kernel.accumulate([f[:, None] for f in fixed], w**2)
    assert used[0] == N
    assert observed.sum() == pytest.approx(N * P)
    normal = A.T @ A
    schur = normal[:256, :256] - normal[:256, 256:] @ np.linalg.solve(
        normal[256:, 256:], normal[256:, :256]
    )
    np.testing.assert_allclose(H[0, :256, :256], schur, rtol=1e-9, atol=1e-6)
    # the whole solve, with smoothness and g(128) = 0, dense and reduced
    smooth = np.zeros((256 + N, 256 + N))
    smooth[:256, :256] = 30 * second_difference(w).T @ second_difference(w)
    keep = np.arange(256 + N) != 128
    dense = np.zeros(256 + N)
    dense[keep] = np.linalg.lstsq((normal + smooth)[np.ix_(keep, keep)], (A.T @ b)[keep])[0]
    keep = keep[:256]
    reduced = np.zeros(256)
    M = H[0, :256, :256] + smooth[:256, :256]
    reduced[keep] = np.linalg.solve(M[np.ix_(keep, keep)], (-H[0, :256, 256:] @ tau)[keep])
    np.testing.assert_allclose(reduced, dense[:256], atol=1e-6)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.6])
def test_known_response_is_recovered(gamma: float) -> None:
    found = debevec(photograph(scene(), gamma=gamma))
    seen = found.observed > 0
    seen[:, :10] = seen[:, 246:] = False
    difference = found.g - log_exposure(gamma)
    # noise pulls codes along the slope of the histogram: the method's own bias, not in sigma
    assert np.sqrt(np.mean(difference[seen] ** 2)) < 0.04
    assert np.all(np.diff(found.g, axis=1) > 0)
    assert np.all(found.condition < 1e13)
    assert np.all(found.extra["paper_lambda"] > 0)


def test_standard_errors_predict_the_scatter_over_brackets() -> None:
    """The sandwich against brute force: many brackets of one scene."""
    picture = scene(128, 128)
    runs = [debevec(photograph(picture, seed=seed)) for seed in range(10, 16)]
    g = np.stack([run.g for run in runs])
    scatter = np.sqrt(np.mean(np.var(g, axis=0, ddof=1)[:, 20:240]))
    predicted = np.sqrt(np.mean(runs[0].sigma[:, 20:240] ** 2))
    # sigma holds the smoothing bias too, so it may be larger
    assert 0.6 < predicted / scatter < 5


def test_several_scenes_add_up() -> None:
    """Frames of two scenes: the same as if the scenes were halves of one picture."""
    a, b = photograph(scene(96, 64, seed=3)), photograph(scene(96, 64, seed=4))
    whole = debevec([np.hstack(pair) for pair in zip(a, b, strict=True)])
    samples = [sample(f, 256, 1, scene=0) for f in a] + [sample(f, 256, 1, scene=1) for f in b]
    parts = solve(samples, np.tile(TIMES, 2), method="debevec")
    np.testing.assert_allclose(parts.g, whole.g, atol=1e-8)


def test_few_pixels_are_refused_by_the_papers_inequality() -> None:
    with pytest.raises(UserError, match=r"N \(P - 1\) > 255"):
        debevec(photograph(scene(6, 6)))


def test_refine_leaves_exact_times_alone() -> None:
    codes = [sample(f, 256, 2).patches for f in photograph(scene(), well=1e7, read=0)]
    H, _, _ = kernel.accumulate(codes, hat() ** 2)
    s = np.sum(hat() ** 2) / np.trace(H[:, :256, :256], axis1=1, axis2=2)
    refined = refine(H, s, np.log(TIMES), 30.0)
    assert np.abs(refined - np.log(TIMES)).max() < 0.01


def test_refined_times_undo_rounded_ones() -> None:
    rng = np.random.default_rng(2)
    wrong = np.exp(np.log(TIMES) + rng.normal(0, 0.1, len(TIMES)))
    samples = [sample(f, 256, 1) for f in photograph(scene())]
    refined = solve(samples, wrong, method="debevec", refine_times=True)
    assert refined.rms.max() < 0.7 * refined.rms_nominal.max()
    slope, offset = np.polyfit(refined.log_exposures, np.log(TIMES), 1)
    rest = slope * refined.log_exposures + offset - np.log(TIMES)
    assert np.abs(rest).max() < 0.02


@pytest.mark.parametrize("gamma", [1.6, 2.4])
def test_the_same_curve_as_the_papers_own_solver(gamma: float) -> None:
    """colour-hdri solves the same objective on a few hundred single pixels."""
    colour = pytest.importorskip("colour_hdri.calibration")
    picture = scene()
    frames = photograph(picture, gamma=gamma)
    pixels = np.stack([f[::16, ::16].reshape(-1, 3) for f in frames], axis=-1)
    flat = pixels.transpose(0, 2, 1)  # (samples, exposures, channels)
    g, _ = colour.g_solve(
        flat[..., 1],
        np.log(TIMES),
        l_s=30,
        w=lambda z: 2 * np.minimum(z, 1 - z),
    )
    truth = log_exposure(gamma)
    middle = slice(20, 236)
    theirs = np.ravel(g) - np.ravel(g)[128]
    ours = debevec(frames).g[1]
    assert np.sqrt(np.mean((ours - theirs)[middle] ** 2)) < 0.02
    assert np.sqrt(np.mean((ours - truth)[middle] ** 2)) < 0.02


def test_float64_is_needed_and_suffices() -> None:
    """The normal equations in float32 fail or are far off; in float64 they equal a QR."""
    pixels = [sample(f, 256, 1).patches for f in photograph(scene(96, 128))]
    w = hat()
    H = kernel.accumulate(pixels, w**2)[0][0]
    D = second_difference(w)
    keep = np.arange(256) != 128
    scale = np.sum(w**2) / np.trace(H[:256, :256])
    M = (scale * H[:256, :256] + 30 * D.T @ D)[np.ix_(keep, keep)]
    right = (-scale * H[:256, 256:] @ np.log(TIMES))[keep]
    # a route without normal equations: their factor [sqrt(s) L'; sqrt(30) D], by QR
    values, vectors = np.linalg.eigh(H[:256, :256])
    root = np.sqrt(scale * np.maximum(values, 0))[:, None] * vectors.T
    A = np.vstack([root, np.sqrt(30) * D])[:, keep]
    Q, R = np.linalg.qr(A)
    b = np.concatenate(
        [
            (vectors.T @ (-scale * H[:256, 256:] @ np.log(TIMES)))
            / np.sqrt(scale * np.maximum(values, 1e-9 * values[-1])),
            np.zeros(len(D)),
        ]
    )
    exact = np.linalg.solve(R, Q.T @ b)
    double = np.linalg.solve(M, right)
    assert np.abs(double - exact).max() < 1e-4
    single = np.linalg.solve(M.astype(np.float32), right.astype(np.float32))
    assert np.abs(single - double).max() > 100 * np.abs(double - exact).max()
