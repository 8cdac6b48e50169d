"""The response solver against cameras that are known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.comparagram import pair
from chromeball.hdr.knots import (
    DEPTHS,
    at_codes,
    at_knots,
    code_count,
    codes_at_knots,
    coordinate,
)
from chromeball.hdr.posterior import posterior, solve_normal
from chromeball.hdr.prior import distances, from_curves, inverse_curves, known_cameras
from chromeball.hdr.response import (
    LEAST_STEP,
    Solution,
    check,
    darkened,
    sample,
    solve,
    span_kept,
    strictly_rising,
)
from chromeball.scene.errors import UserError
from tests.hdr.camera import TIMES, log_exposure, photograph, scene

DATA = Path(__file__).parents[2].parent / "shared/data/hdr"

type Frames = Sequence[NDArray[np.uint8]]


def solved(frames: Frames, times: NDArray[np.float64] = TIMES) -> Solution:
    return solve([sample(f) for f in frames], times)


@pytest.fixture(scope="module")
def frames() -> list[NDArray[np.uint8]]:
    return photograph(scene())


@pytest.fixture(scope="module")
def plain(frames: list[NDArray[np.uint8]]) -> Solution:
    return solved(frames)


def seen_by(*solutions: Solution) -> NDArray[np.bool_]:
    """Codes that all of them have many patches of."""
    return np.min([s.observed for s in solutions], axis=0) > 100


# ---- the kernels against plain numpy


@pytest.mark.parametrize(("codes", "size"), [(256, 1), (256, 3), (4096, 2), (65536, 1)])
def test_patches_equal_their_reference(codes: int, size: int) -> None:
    rng = np.random.default_rng(1)
    kind = np.uint8 if codes == 256 else np.uint16
    frame: NDArray[Any] = rng.integers(0, codes, (13, 17, 3)).astype(kind)
    frame[:4, :6] = frame[:4, :6] % (codes // 40) + codes // 2
    frame[0, 0] = codes - 1
    knot = np.round(256 * coordinate(codes)).astype(np.uint16)
    found = kernel.patches(frame, knot, size, 16)
    k = knot[frame].astype(np.int64)
    rows, columns = 13 // size, 17 // size
    k = k[: rows * size, : columns * size].reshape(rows, size, columns, size, 3)
    mean = (k.sum(axis=(1, 3)) + size * size // 2) // (size * size)
    low, high = k.min(axis=(1, 3)), k.max(axis=(1, 3))
    usable = (high < knot[-1]) & (high - low <= 16 * 256)
    np.testing.assert_array_equal(
        found, np.where(usable, mean, 0xFFFF).reshape(-1, 3).astype(np.uint16)
    )
    assert usable.any()
    assert not usable.all()


def test_codes_beyond_the_table_are_an_error() -> None:
    knot = np.round(256 * coordinate(1024)).astype(np.uint16)
    with pytest.raises(ValueError, match="beyond"):
        kernel.patches(np.full((4, 4, 1), 1024, np.uint16), knot, 1, 16)


def test_ridges_are_the_quartiles_of_comparagrams() -> None:
    rng = np.random.default_rng(2)
    z = rng.integers(0, 250 * 256, (5000, 2)).astype(np.uint16)
    darker = (z * 0.6 + rng.normal(0, 400, z.shape)).clip(0, 250 * 256).astype(np.uint16)
    z[::50] = 0xFFFF
    skip = (rng.uniform(size=5000) < 0.1).astype(np.uint8)
    C = kernel.comparagrams([darker, z], [(0, 1)], skip)
    use = (z != 0xFFFF) & (skip == 0)[:, None]
    np.testing.assert_allclose(C.sum(axis=(2, 3))[0], use.sum(axis=0), rtol=1e-5)
    # bilinear shares keep the mean code
    mean = np.einsum("kcab,a->kc", C, np.arange(256.0)) / C.sum(axis=(2, 3))
    expected = [darker[use[:, c], c].mean() / 256 for c in range(2)]
    np.testing.assert_allclose(mean[0], expected, rtol=1e-4)
    ridge = kernel.ridges([darker, z], [(0, 1)], skip)
    for c in range(2):
        np.testing.assert_allclose(ridge[0, c, 0], C[0, c].sum(axis=0), rtol=1e-5, atol=1e-3)
        for b in (40, 117, 201):
            below = np.concatenate([[0], np.cumsum(C[0, c, :, b], dtype=float)])
            for q in (1, 2, 3):
                a = np.interp(q / 4 * below[-1], below, np.arange(257) - 0.5)
                assert ridge[0, c, q, b] == pytest.approx(a, abs=1e-3)


def test_what_exposure_does_not_change_is_marked() -> None:
    frames = [np.full((6, 3), value * 256, np.uint16) for value in (60, 90, 130)]
    for f in frames:
        f[0] = 100 * 256  # a border
        f[1] = 5 * 256  # darkness: tells nothing
        f[2] = 0xFFFF  # unusable throughout
    assert kernel.unchanging(frames, 3.0, 24.0).tolist() == [1, 0, 0, 0, 0, 0]


def test_posterior_equals_plain_linear_algebra() -> None:
    rng = np.random.default_rng(3)
    n = 9
    G = rng.normal(size=(2, n, n))
    H = G @ G.transpose(0, 2, 1)
    A = rng.normal(size=(3, n, n))
    X = rng.normal(size=(2, n, 4))
    QX, Q, logdet = posterior(H, X, A)
    for c in range(2):
        for m in range(3):
            expected = np.linalg.inv(H[c] + np.linalg.inv(A[m] @ A[m].T))
            np.testing.assert_allclose(Q[c, m], expected, rtol=1e-6, atol=1e-8)
            np.testing.assert_allclose(QX[c, m], expected @ X[c], rtol=1e-6, atol=1e-7)
            inside = np.eye(n) + A[m].T @ H[c] @ A[m]
            assert logdet[c, m] == pytest.approx(np.linalg.slogdet(inside)[1], rel=1e-9)
    x, inverse, scaled = solve_normal(H, X[..., 0])
    np.testing.assert_allclose(x[0], np.linalg.solve(H[0], X[0, :, 0]), rtol=1e-6)
    np.testing.assert_allclose(inverse[1], np.linalg.inv(H[1]), rtol=1e-6)
    np.testing.assert_allclose(np.diag(scaled[0]), 1, rtol=1e-12)


def test_float32_would_not_do(plain: Solution) -> None:
    """The solve's condition is beyond float32: in it the curve is another one."""
    assert plain.condition.max() > 1e6
    assert plain.condition.max() < 1e12


# ---- knots and the prior


@pytest.mark.parametrize("codes", DEPTHS)
def test_knots(codes: int) -> None:
    k = np.arange(256)
    z = codes_at_knots(codes)
    assert z[0] == 0
    assert z[255] == codes - 1
    wide = np.concatenate([[True], np.diff(z) > 2])  # between codes, where there are some
    np.testing.assert_allclose(
        np.interp(z, np.arange(codes), coordinate(codes))[wide], k[wide], atol=0.02
    )
    g = np.sort(np.random.default_rng(0).normal(size=(2, 256)), axis=1)
    curves = at_codes(g, codes)
    assert curves.shape == (2, codes)
    assert np.all(np.diff(curves, axis=1) >= 0)
    if codes >= 65536:
        np.testing.assert_allclose(at_knots(curves), g, atol=5e-3)
    assert code_count(codes - 1) == codes


def test_prior_is_zero_at_the_middle_and_positive_definite() -> None:
    for codes in (256, 65536):
        mean, factors = known_cameras().at(codes)
        assert mean[128] == 0
        assert np.all(np.diff(mean) > 0)
        for A in factors:
            S = A @ A.T
            assert np.linalg.eigvalsh(S)[0] > 0
            assert 0.1 < np.sqrt(S[60, 60]) < 2
            assert S[128, 128] < 1e-3


def test_prior_of_curves_counts_families_once() -> None:
    z = np.arange(256)
    curves = np.stack([gamma * np.log((z + 1) / 129) for gamma in (1.8, 2.0, 2.2)])
    once = from_curves(curves)
    copies = from_curves(np.concatenate([curves, np.repeat(curves[:1], 5, axis=0)]))
    np.testing.assert_allclose(copies.mean, once.mean, atol=1e-9)
    np.testing.assert_allclose(
        copies.components.T @ copies.components, once.components.T @ once.components, atol=1e-8
    )
    assert distances(curves)[0, 2] == pytest.approx(
        np.sqrt(np.mean((0.4 * np.log((z + 1) / 129))[5:251] ** 2))
    )


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data set is absent")
def test_the_prior_is_what_its_database_gives() -> None:
    curves = np.load(DATA / "dorf.npz")
    fresh = from_curves(
        inverse_curves(curves["irradiance"].astype(float), curves["brightness"].astype(float))
    )
    np.testing.assert_allclose(fresh.mean, known_cameras().mean, atol=1e-4)
    np.testing.assert_allclose(
        fresh.components.T @ fresh.components,
        known_cameras().components.T @ known_cameras().components,
        atol=2e-3,
    )


# ---- the curve


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.6])
def test_known_response_is_recovered_within_its_errors(gamma: float) -> None:
    found = solved(photograph(scene(), gamma=gamma))
    z = np.arange(256)
    inside = (z >= 24) & (z < 251) & (z != 128)
    difference = (found.g - log_exposure(gamma))[:, inside]
    assert np.sqrt(np.mean(difference**2)) < 0.004
    chi = (difference / found.sigma[:, inside]) ** 2
    assert 0.05 < np.mean(chi) < 4
    assert np.all(found.repaired == 0)
    assert np.all(np.isfinite(found.g))
    assert np.all(np.diff(found.g, axis=1) > 0)
    assert found.wrong == ()
    assert not found.refined
    # codes that no picture shows are the prior's, and say so
    dark = np.abs(found.g - log_exposure(gamma))[:, 4:12]
    assert np.all(dark < 6 * found.sigma[:, 4:12])


def test_code_noise_is_measured(plain: Solution) -> None:
    """Shot noise of 20000 e-, read noise and rounding, carried through the curve."""
    x = (np.arange(20, 240) / 255) ** 2.2
    slope = 255 / 2.2 * x ** (1 / 2.2 - 1)
    true = np.sqrt(slope**2 * (x / 20000 + (4 / 20000) ** 2) + 1 / 12)
    np.testing.assert_allclose(plain.code_noise, np.median(true), rtol=0.1)


@pytest.mark.parametrize("codes", [1024, 4096, 65536])
def test_more_than_256_codes(codes: int) -> None:
    radiance, rng = scene(), np.random.default_rng(1)
    samples = []
    for t in TIMES:
        x = rng.poisson(np.minimum(radiance * t, 2) * 20000) + rng.normal(0, 4, radiance.shape)
        z = np.round((codes - 1) * np.clip(x / 20000, 0, 1) ** (1 / 2.2)).astype(np.uint16)
        samples.append(sample(z, codes))
    found = solve(samples, TIMES)
    assert found.g.shape == (3, codes)
    z = np.arange(codes)
    truth = 2.2 * np.log(np.maximum(z, 0.5) / (codes // 2))
    inside = slice(codes // 8, int(0.98 * codes))
    assert np.sqrt(np.mean((found.g - truth)[:, inside] ** 2)) < 0.005
    assert np.all(np.diff(found.g, axis=1) > 0)
    assert np.all(found.g[:, codes // 2] == 0)


# ---- the same curve, whatever is given


def test_the_order_and_the_unit_of_time_change_nothing(
    frames: list[NDArray[np.uint8]], plain: Solution
) -> None:
    order = [3, 0, 6, 2, 5, 1, 4]
    other = solved([frames[j] for j in order], 1000 * TIMES[order])
    np.testing.assert_allclose(other.g, plain.g, atol=1e-9)
    np.testing.assert_allclose(
        other.log_exposures, np.log(1000) + plain.log_exposures[order], atol=1e-9
    )


@pytest.mark.parametrize("stride", [2, 3])
def test_the_resolution_changes_less_than_half_a_percent(stride: int) -> None:
    frames = photograph(scene(384, 512))
    whole = solved(frames)
    part = solved([np.ascontiguousarray(f[::stride, ::stride]) for f in frames])
    both = seen_by(whole, part)
    assert both.sum() > 600
    assert np.quantile(np.abs(part.g - whole.g)[both], 0.95) < 0.005


@pytest.mark.parametrize("subset", [[0, 1, 2, 3], [1, 2, 3, 4, 5], [3, 4, 5, 6], [0, 2, 4, 6]])
def test_a_subset_of_frames_changes_less_than_half_a_percent(
    subset: list[int], frames: list[NDArray[np.uint8]], plain: Solution
) -> None:
    part = solved([frames[j] for j in subset], TIMES[subset])
    both = seen_by(plain, part)
    assert np.quantile(np.abs(part.g - plain.g)[both], 0.95) < 0.005


def test_black_surround_changes_nothing(
    frames: list[NDArray[np.uint8]], plain: Solution
) -> None:
    framed = solved([np.pad(f, ((64, 64), (64, 64), (0, 0))) for f in frames])
    both = seen_by(plain, framed)
    np.testing.assert_allclose(framed.g[both], plain.g[both], atol=1e-6)


def test_borders_and_captions_change_nothing(
    frames: list[NDArray[np.uint8]], plain: Solution
) -> None:
    marked = [np.pad(f, ((20, 20), (0, 0), (0, 0)), constant_values=90) for f in frames]
    for f in marked:
        f[100:130, 40:200] = (200, 30, 20)
    found = solved(marked)
    assert 0.1 < found.unchanging < 0.4
    both = seen_by(plain, found)
    assert np.quantile(np.abs(found.g - plain.g)[both], 0.95) < 0.005


def test_moving_things_hardly_move_the_curve(
    frames: list[NDArray[np.uint8]], plain: Solution
) -> None:
    rng = np.random.default_rng(8)
    moved = []
    for f in frames:
        g = f.copy()
        y, x = rng.integers(0, 100), rng.integers(0, 150)
        thing = rng.integers(20, 230, 3) + rng.normal(0, 12, (40, 40, 3))
        g[y : y + 40, x : x + 40] = thing.clip(0, 255).astype(np.uint8)
        moved.append(g)
    found = solved(moved)
    both = seen_by(plain, found)
    assert np.quantile(np.abs(found.g - plain.g)[both], 0.9) < 0.01


def test_film_base_is_darkness(frames: list[NDArray[np.uint8]]) -> None:
    """Codes up from 15: below them no light, and no exposure may be read from it."""
    rng = np.random.default_rng(3)
    raised = []
    for f in frames:
        dark = f.astype(float)
        dark[:60] *= 0.02  # deep shadow
        noisy = 15 + dark * (240 / 255) + rng.normal(0, 0.7, f.shape)  # a scanner's noise
        raised.append(np.clip(noisy.round(), 0, 255).astype(np.uint8))
    found = solved(raised)
    assert all(13 <= v <= 18 for v in found.extra["darkness"])
    assert np.all(found.sigma[:, :14] >= 1)
    assert np.all(found.g[:, 24] - found.g[:, 10] > 3)
    z = np.arange(45, 245)
    truth = 2.2 * np.log((z - 15) / 113)
    assert np.sqrt(np.mean((found.g[:, 45:245] - truth) ** 2)) < 0.02


def test_darkened_continues_value_and_slope() -> None:
    z = np.arange(256)
    g = np.log(np.maximum(z - 20, 0.1) / 108)
    found = darkened(g, 20.0, 26.0)
    np.testing.assert_array_equal(found[29:], g[29:])
    np.testing.assert_allclose(found[24:29], g[24:29], atol=0.05)
    assert np.all(np.diff(found) > 0)
    np.testing.assert_array_equal(darkened(g, 0.0, 0.0), g)


def test_two_frames_suffice(frames: list[NDArray[np.uint8]], plain: Solution) -> None:
    found = solved(frames[2:4], TIMES[2:4])
    both = seen_by(plain, found)
    assert both.sum() > 250
    assert np.quantile(np.abs(found.g - plain.g)[both], 0.95) < 0.01


def test_a_channel_without_light_follows_the_others() -> None:
    """Blue reaches code 70 at most: above it, the curve is that of red and green."""
    picture = scene()
    picture[..., 2] *= 0.008
    found = solved(photograph(picture))
    assert np.all(found.observed[2, 90:] == 0)
    difference = found.g - log_exposure()
    assert np.sqrt(np.mean(difference[2, 40:250] ** 2)) < 0.01
    assert np.sqrt(np.mean(difference[:2, 24:250] ** 2)) < 0.004
    # it is told apart from what was measured
    assert np.median(found.sigma[2, 120:240]) > 2 * np.median(found.sigma[1, 120:240])


def test_several_scenes_are_not_compared_with_each_other() -> None:
    a, b = photograph(scene(seed=3)), photograph(scene(seed=4))
    samples = [sample(f, scene=0) for f in a] + [sample(f, scene=1) for f in b]
    found = solve(samples, np.tile(TIMES, 2))
    z = slice(24, 250)
    assert np.sqrt(np.mean((found.g[:, z] - log_exposure()[z]) ** 2)) < 0.004
    alone = solved(a)
    assert np.median(found.sigma) < np.median(alone.sigma)


# ---- exposures


@pytest.mark.parametrize("wrong", [0, 3, 6])
@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_an_exposure_off_by_a_factor_is_found(
    wrong: int, factor: float, frames: list[NDArray[np.uint8]], plain: Solution
) -> None:
    times = TIMES.copy()
    times[wrong] *= factor
    found = solved(frames, times)
    assert [k for k, _ in found.wrong] == [wrong]
    assert found.wrong[0][1] == pytest.approx(1 / factor, rel=0.02)
    both = seen_by(plain, found)
    assert np.quantile(np.abs(found.g - plain.g)[both], 0.95) < 0.01


def test_a_duplicated_time_is_found_and_a_duplicated_frame_does_no_harm(
    frames: list[NDArray[np.uint8]], plain: Solution
) -> None:
    times = TIMES.copy()
    times[3] = times[4]
    assert [k for k, _ in solved(frames, times).wrong] == [3]
    again = solved([*frames, frames[3]], np.append(TIMES, TIMES[3]))
    assert again.wrong == ()
    both = seen_by(plain, again)
    assert np.quantile(np.abs(again.g - plain.g)[both], 0.95) < 0.005


def test_nominal_times_are_refined_where_the_pictures_say_so() -> None:
    rng = np.random.default_rng(2)
    wrong = np.exp(np.log(TIMES) + rng.normal(0, 0.05, len(TIMES)))
    samples = [sample(f) for f in photograph(scene())]
    kept = solve(samples, wrong, refine_times=False)
    found = solve(samples, wrong)
    assert found.refined
    assert not kept.refined
    assert found.rms.max() < 0.5 * kept.rms.max()
    np.testing.assert_allclose(found.rms_nominal, kept.rms, rtol=0.1)
    # up to the span and the mean, which cannot be known
    slope, offset = np.polyfit(found.log_exposures, np.log(TIMES), 1)
    rest = slope * found.log_exposures + offset - np.log(TIMES)
    assert np.abs(rest).max() < 0.005
    assert abs(slope - 1) < 0.1


def test_span_and_mean_are_kept() -> None:
    tau = np.log(TIMES)
    observes = np.array([1.0, 5, 5, 5, 5, 5, 0])
    B = span_kept(tau, observes)
    assert B.shape == (7, 5)
    w = observes / observes.sum()
    np.testing.assert_allclose(w @ B, 0, atol=1e-12)
    np.testing.assert_allclose((w * (tau - w @ tau)) @ B, 0, atol=1e-12)


def test_pairs() -> None:
    tau = np.log(2) * np.arange(5.0)
    assert pair(tau) == [
        (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4),
    ]  # fmt: skip
    far = np.log(2) * np.array([0.0, 15, 16])
    assert pair(far) == [(0, 1), (1, 2)]
    assert pair(far[::-1]) == [(2, 1), (1, 0)]
    assert pair(np.zeros(3)) == [(0, 1), (1, 2)]


# ---- a stored curve


def test_a_stored_curve_is_checked_against_new_pictures(plain: Solution) -> None:
    other = [sample(f) for f in photograph(scene(seed=9), seed=4)]
    chi_square, rms = check(other, TIMES, plain.g, plain.sigma)
    assert chi_square.max() < 1
    assert rms.max() < 0.01
    changed = [sample(f) for f in photograph(scene(seed=9), seed=4, gamma=2.4)]
    chi_square, rms = check(changed, TIMES, plain.g, plain.sigma)
    assert chi_square.min() > 20
    assert rms.min() > 0.03


# ---- what does not determine a curve


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
        ([_flat(255), _flat(0)], [1.0, 2.0], "closer together"),
        ([_flat(40), _flat(60), _flat(90)], [1.0, 2.0, 4.0], "code values"),
        ([_flat(60)[:1, :1], _flat(90)[:1, :1]], [1.0, 2.0], "closer together"),
    ],
)
def test_what_cannot_determine_a_curve_is_refused(
    frames: list[NDArray[np.uint8]], times: list[float], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        solve([sample(f, 256, 1) for f in frames], np.array(times))


def test_times_in_the_wrong_order_are_refused(frames: list[NDArray[np.uint8]]) -> None:
    with pytest.raises(UserError, match="another order"):
        solved(frames, TIMES[::-1].copy())


def test_exposures_too_far_apart_are_refused() -> None:
    times = np.array([1.0, 2.0**15]) / 300
    with pytest.raises(UserError, match="closer together"):
        solved(photograph(scene(), times), times)


def test_a_response_flat_over_forty_codes() -> None:
    """f jumps: the codes 100 .. 140 are never shown, and g must rise over them all the same."""
    frames = [
        np.where(f < 120, f * (100 / 120), 140 + (f.astype(float) - 120) * (115 / 135))
        .round()
        .astype(np.uint8)
        for f in photograph(scene())
    ]
    found = solved(frames)
    assert np.all(np.diff(found.g, axis=1) > 0)
    assert np.all(np.isfinite(found.sigma))
    z = np.arange(256.0)
    back = np.where(z < 100, z * 1.2, 120 + (z - 140) * (135 / 115))
    truth = 2.2 * np.log(np.maximum(back, 0.5) / 128)
    for part in (slice(24, 98), slice(143, 246)):
        off = (found.g - truth)[:, part]
        assert np.std(off) < 0.02
