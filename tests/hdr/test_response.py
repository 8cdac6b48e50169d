from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.response import (
    LEAST_STEP,
    hat,
    refine,
    roughness,
    sample,
    solve,
    strictly_rising,
)
from chromeball.scene.errors import UserError
from tests.hdr.camera import TIMES, log_exposure, photograph, scene

DATA = Path(__file__).parents[2].parent / "shared/data/hdr"


def test_schur_complement_equals_dense_normal_equations() -> None:
    """Two routes: all unknowns at once (the paper's matrix), and ln E eliminated."""
    rng = np.random.default_rng(5)
    P, N = 4, 60
    radiance = rng.uniform(0.02, 1, N)
    codes = np.stack([np.clip(255 * (radiance * t) ** 0.45, 1, 254) for t in TIMES[:P]])
    fixed = np.round(codes * 256).astype(np.uint16)
    w = hat()
    share = rng.uniform(0.5, 1, (N, 1)).astype(np.float32)
    tau = np.log(TIMES[:P])
    rows, right = [], []
    for i in range(N):
        for j in range(P):
            z, u = fixed[j, i] >> 8, (fixed[j, i] & 255) / 256
            weight = ((1 - u) * w[z] ** 2 + u * w[z + 1] ** 2) * share[i, 0]
            row = np.zeros(256 + N)
            row[z], row[z + 1], row[256 + i] = 1 - u, u, -1
            rows.append(np.sqrt(weight) * row)
            right.append(np.sqrt(weight) * tau[j])
    A, b = np.array(rows), np.array(right)
    H, observed, used = kernel.accumulate([f[:, None] for f in fixed], w**2, share)
    assert used[0] == N
    assert observed.sum() == pytest.approx(N * P)
    normal = A.T @ A
    schur = normal[:256, :256] - normal[:256, 256:] @ np.linalg.solve(
        normal[256:, 256:], normal[256:, :256]
    )
    np.testing.assert_allclose(H[0, :256, :256], schur, rtol=1e-9, atol=1e-6)
    # the whole solve, with smoothness and g(128) = 0, dense and reduced
    smooth = np.zeros((256 + N, 256 + N))
    smooth[:256, :256] = 30 * roughness(w)
    keep = np.arange(256 + N) != 128
    dense = np.zeros(256 + N)
    dense[keep] = np.linalg.lstsq((normal + smooth)[np.ix_(keep, keep)], (A.T @ b)[keep])[0]
    keep = keep[:256]
    reduced = np.zeros(256)
    M = H[0, :256, :256] + smooth[:256, :256]
    reduced[keep] = np.linalg.solve(M[np.ix_(keep, keep)], (-H[0, :256, 256:] @ tau)[keep])
    np.testing.assert_allclose(reduced, dense[:256], atol=1e-6)


def test_statistics_do_not_depend_on_sizes_that_change_nothing() -> None:
    frame = scene(40, 64)
    samples = [sample(f, 2) for f in photograph(frame)]
    codes = [s.patches for s in samples]
    share = kernel.shares(codes, hat() ** 2)
    once = kernel.accumulate(codes, hat() ** 2, share)[0]
    twice = kernel.accumulate(
        [np.tile(c, (2, 1)) for c in codes], hat() ** 2, np.tile(share, (2, 1))
    )
    np.testing.assert_allclose(twice[0], 2 * once, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.6])
def test_known_response_is_recovered_within_its_errors(gamma: float) -> None:
    frames = photograph(scene(), gamma=gamma)
    found = solve([sample(f) for f in frames], TIMES)
    z = np.arange(256)
    inside = (z >= 10) & (z < 246) & (z != 128)
    seen = (found.observed > 0) & inside
    difference = found.g - log_exposure(gamma)
    assert np.sqrt(np.mean(difference[seen] ** 2)) < 0.012
    chi = np.abs(difference / np.maximum(found.sigma, 1e-9))
    assert 0.05 < np.mean(chi[seen] ** 2) < 3  # neighbours are correlated: bounds on the mean
    assert np.all(chi[~seen & inside] < 4)  # codes that no picture shows: extrapolated
    assert np.all(found.repaired == 0)
    assert np.all(np.isfinite(found.g))
    assert np.all(np.diff(found.g, axis=1) > 0)
    assert np.all(found.condition < 1e9)


def test_standard_errors_predict_the_scatter_over_brackets() -> None:
    """The sandwich against brute force: many brackets of one scene."""
    picture = scene(128, 128)
    runs = [
        solve([sample(f, 2) for f in photograph(picture, seed=seed)], TIMES)
        for seed in range(10, 16)
    ]
    g = np.stack([run.g for run in runs])
    scatter = np.sqrt(np.mean(np.var(g, axis=0, ddof=1)[:, 20:240]))
    predicted = np.sqrt(np.mean(runs[0].sigma[:, 20:240] ** 2))
    # sigma holds the smoothing bias too, so it may be larger
    assert 0.6 < predicted / scatter < 5


def test_black_surround_changes_nothing() -> None:
    frames = photograph(scene(128, 128))
    framed = [np.pad(f, ((64, 64), (64, 64), (0, 0))) for f in frames]
    plain = solve([sample(f, 2) for f in frames], TIMES)
    surrounded = solve([sample(f, 2) for f in framed], TIMES)
    np.testing.assert_allclose(surrounded.g, plain.g, atol=1e-9)


def test_the_curve_does_not_depend_on_the_order_or_the_unit_of_time() -> None:
    frames = photograph(scene(128, 128))
    samples = [sample(f, 2) for f in frames]
    plain = solve(samples, TIMES)
    order = [3, 0, 6, 2, 5, 1, 4]
    other = solve([samples[j] for j in order], 1000 * TIMES[order])
    np.testing.assert_allclose(other.g, plain.g, atol=1e-9)


def test_refined_times_undo_rounded_ones() -> None:
    rng = np.random.default_rng(2)
    wrong = np.log(TIMES) + rng.normal(0, 0.1, len(TIMES))
    samples = [sample(f) for f in photograph(scene())]
    nominal = solve(samples, np.exp(wrong))
    refined = solve(samples, np.exp(wrong), refine_times=True)
    assert refined.rms.max() < 0.5 * nominal.rms.max()
    np.testing.assert_array_equal(refined.rms_nominal, nominal.rms)
    # up to the span and the mean, which cannot be known
    slope, offset = np.polyfit(refined.log_exposures, np.log(TIMES), 1)
    rest = slope * refined.log_exposures + offset - np.log(TIMES)
    assert np.abs(rest).max() < 0.01
    assert abs(slope - 1) < 0.1


def test_a_frame_that_sees_nothing_keeps_its_time() -> None:
    frames = [*photograph(scene(128, 128)), np.zeros((128, 128, 3), np.uint8)]
    times = np.append(TIMES, 1e-4)
    found = solve([sample(f, 2) for f in frames], times, refine_times=True)
    assert found.log_exposures[-1] == pytest.approx(np.log(1e-4), abs=1e-6)


def test_isotonic_repair() -> None:
    g = np.linspace(-3, 3, 256)
    np.testing.assert_array_equal(strictly_rising(g, np.ones(256)), g)
    bent = g.copy()
    bent[40] += 0.5
    risen = strictly_rising(bent, np.ones(256))
    assert np.all(np.diff(risen) > 0.99 * LEAST_STEP)
    assert 1 < np.sum(np.abs(risen - bent) > 1e-9) < 30


def _flat(value: int) -> NDArray[np.uint8]:
    return np.full((64, 64, 3), value, np.uint8)


@pytest.mark.parametrize(
    ("frames", "times", "message"),
    [
        ([_flat(9)], [1.0], "two pictures"),
        ([_flat(9), _flat(9)], [1.0, 1.0], "same exposure"),
        ([_flat(255)] * 3, [1.0, 2.0, 4.0], "saturated"),
        ([_flat(0)] * 3, [1.0, 2.0, 4.0], "black"),
        ([_flat(255), _flat(0)], [1.0, 2.0], "only 0 patches"),
        ([_flat(60)] * 3, [1.0, 2.0, 4.0], "code values"),
    ],
)
def test_what_cannot_determine_a_curve_is_refused(
    frames: list[NDArray[np.uint8]], times: list[float], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        solve([sample(f, 1) for f in frames], np.array(times))


def test_times_in_the_wrong_order_are_refused() -> None:
    samples = [sample(f) for f in photograph(scene())]
    with pytest.raises(UserError, match="another order"):
        solve(samples, TIMES[::-1].copy())


def test_few_pixels_are_refused_by_the_papers_inequality() -> None:
    frames = photograph(scene(6, 6))
    with pytest.raises(UserError, match=r"N \(P - 1\) > 255"):
        solve([sample(f) for f in frames], TIMES)


@pytest.mark.parametrize("gamma", [1.6, 2.4])
def test_closer_than_the_papers_own_solver(gamma: float) -> None:
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
    ours = solve([sample(f) for f in frames], TIMES).g[1]
    error = [np.sqrt(np.mean((curve - truth)[middle] ** 2)) for curve in (ours, theirs)]
    assert np.sqrt(np.mean((ours - theirs)[middle] ** 2)) < 0.1  # the same curve
    assert error[0] < error[1]


def test_refine_leaves_exact_times_alone() -> None:
    samples = [sample(f) for f in photograph(scene(), well=1e7, read=0)]
    codes = [s.patches for s in samples]
    share = kernel.shares(codes, hat() ** 2)
    H, _, _ = kernel.accumulate(codes, hat() ** 2, share)
    s = np.sum(hat() ** 2) / np.trace(H[:, :256, :256], axis1=1, axis2=2)
    refined = refine(H, s, np.log(TIMES), 30.0)
    assert np.abs(refined - np.log(TIMES)).max() < 0.01
