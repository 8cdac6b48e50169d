from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.hdr.merge import (
    SATURATED,
    SENSOR_NOISE,
    WEAK,
    code_weights,
    merge_frames,
    merge_linear,
    stops,
    weights,
)
from chromeball.hdr.noise import unsaturated
from chromeball.hdr.response_file import Response
from chromeball.scene.errors import UserError
from tests.hdr.camera import TIMES, log_exposure, photograph, scene


def camera(gamma: float = 2.2, noise: float = 1.0) -> Response:
    known = Response.from_log_exposure(np.stack([log_exposure(gamma)] * 3))
    return Response(
        channels=known.channels,
        log_exposure=known.log_exposure,
        sigma=known.sigma,
        code_noise=np.full(3, noise),
    )


def reference(
    frames: list[NDArray[Any]], times: NDArray[np.float64], response: Response
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Row P13 in plain numpy: radiance, its error, marks per channel."""
    tables, g = code_weights(response), response.log_exposure
    order = np.argsort(times)
    z = np.stack([frames[j] for j in order]).astype(int)
    t = times[order][:, None, None, None]
    channel = np.arange(z.shape[3])
    counts = unsaturated(z, tables.saturated)
    X, w, taper = np.exp(g[channel, z]), tables.weight[channel, z] * counts, tables.taper
    used, total = w, w.sum(axis=0)
    lost = total == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        value = (w * X / t).sum(axis=0) / total
        for _ in range(2):
            bits = np.nan_to_num(value * t).astype(np.float32).view(np.uint32) >> 16
            again = (w > 0) * taper[channel, z] * tables.expected[channel, bits]
            used = np.where(total < WEAK**-2, again, used)
            total = used.sum(axis=0)
            value = (used * X / t).sum(axis=0) / total
        sigma = value / np.sqrt(total)
    half = response.log_exposure.shape[1] // 2
    high = lost & (z >= half).any(axis=0)
    shortest = np.argmax(z >= half, axis=0)
    chosen = np.where(high, shortest, len(frames) - 1)
    bound = np.take_along_axis(X / t, chosen[None], axis=0)[0]
    return (
        np.where(lost, bound, value),
        np.where(lost, np.inf, sigma),
        high * 1 - (lost & ~high) * 1,
    )


@pytest.mark.parametrize("shape", [(7, 5), (64, 80)])
def test_merge_equals_the_numpy_reference(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (*shape, 3)).astype(np.uint8) for _ in range(5)]
    for f in frames:
        f[:2] = 255
        f[2:4] = 0
    frames[0][5] = 0
    for f in frames[1:]:
        f[5] = 255
    merged = merge_frames(frames, TIMES[:5], camera(), sigma=True)
    E, sigma, marks = reference(frames, TIMES[:5], camera())
    np.testing.assert_allclose(merged.radiance, E, rtol=1e-6)
    assert merged.sigma is not None
    np.testing.assert_allclose(merged.sigma, sigma, rtol=2e-6)
    np.testing.assert_array_equal(merged.high, (marks == 1).sum(axis=(0, 1)))
    np.testing.assert_array_equal(merged.low, (marks == -1).sum(axis=(0, 1)))
    np.testing.assert_array_equal(
        merged.clipped, np.where((marks == 1).any(2), 1, marks.min(axis=2))
    )
    assert merged.high.min() >= 3 * shape[1]
    assert merged.low.min() >= 2 * shape[1]


def test_grey_pictures() -> None:
    grey = [f[..., :1] for f in photograph(scene(32, 32))]
    curve = Response.from_log_exposure(log_exposure())
    merged = merge_frames(grey, TIMES, curve)
    E, _, _ = reference(grey, TIMES, curve)
    np.testing.assert_allclose(merged.radiance, E, rtol=1e-6)


def test_radiance_and_energy_are_kept() -> None:
    picture = scene()
    merged = merge_frames(photograph(picture), TIMES, camera())
    scale = 128**2.2 / 255**2.2  # g is zero at code 128
    estimate = merged.radiance * scale
    measured = merged.clipped == 0
    assert measured.mean() > 0.9
    ratio = estimate[measured] / picture[measured]
    assert abs(np.median(ratio) - 1) < 0.002
    assert np.median(np.abs(ratio - 1)) < 0.01
    assert estimate[measured].sum() / picture[measured].sum() == pytest.approx(1, abs=0.003)


def test_sigma_predicts_the_error() -> None:
    """Constant noise in code units is what the weights assume."""
    rng = np.random.default_rng(4)
    picture = scene()
    frames = [
        np.clip(
            np.round(
                255 * np.minimum(picture * t, 1) ** (1 / 2.2) + rng.normal(0, 2, picture.shape)
            ),
            0,
            255,
        ).astype(np.uint8)
        for t in TIMES
    ]
    merged = merge_frames(frames, TIMES, camera(noise=np.sqrt(4 + 1 / 12)), sigma=True)
    assert merged.sigma is not None
    usable = (
        (merged.clipped == 0)[..., None]
        & (picture * TIMES[-1] > 0.05)
        & (picture * TIMES[0] < 0.5)
    )
    error = merged.radiance * (128 / 255) ** 2.2 - picture
    chi2 = (error / (merged.sigma * (128 / 255) ** 2.2))[usable] ** 2
    assert 0.8 < chi2.mean() < 1.25


def test_the_order_of_frames_changes_nothing() -> None:
    frames = photograph(scene(40, 40))
    order = [4, 1, 6, 0, 3, 5, 2]
    first = merge_frames(frames, TIMES, camera(), sigma=True)
    second = merge_frames([frames[j] for j in order], TIMES[order], camera(), sigma=True)
    np.testing.assert_array_equal(first.radiance, second.radiance)
    np.testing.assert_array_equal(first.clipped, second.clipped)


@pytest.mark.parametrize("kind", ["uint16", "float32"])
def test_linear_merge_equals_its_reference(kind: str) -> None:
    rng = np.random.default_rng(6)
    E = np.exp(rng.normal(-2, 2, (33, 41, 3)))
    white = 65535.0 if kind == "uint16" else 1.0
    x = [
        np.minimum(E * t + rng.normal(0, 1e-3, E.shape).clip(-E * t), 1) * white for t in TIMES
    ]
    frames = [(v.round() if kind == "uint16" else v).astype(kind) for v in x]
    merged = merge_linear(frames, TIMES, white=white, sigma=True)
    stack = np.stack(frames).astype(float)
    keep = unsaturated(stack, np.float32(SATURATED * white))
    t = TIMES[:, None, None, None]
    a, b = SENSOR_NOISE[0] * white, SENSOR_NOISE[1] * white**2
    with np.errstate(invalid="ignore", divide="ignore"):
        pilot = (keep * stack * t).sum(0) / (keep * t**2).sum(0)
        w = keep * t**2 / (a * np.maximum(pilot, 0) * t + b)
        expected = (w * stack / t).sum(0) / w.sum(0)
        error = 1 / np.sqrt(w.sum(0))
    lost = ~keep.any(0)
    expected[lost] = (stack[0] / TIMES[0])[lost]
    error[lost] = np.inf
    np.testing.assert_allclose(merged.radiance, expected, rtol=3e-6)
    assert merged.sigma is not None
    np.testing.assert_allclose(merged.sigma, error, rtol=1e-5)
    np.testing.assert_array_equal(merged.high, lost.sum((0, 1)))
    assert lost.sum() > 0
    clean = ~lost & (E * TIMES[-1] > 0.05)
    assert np.median(np.abs(merged.radiance[clean] / white / E[clean] - 1)) < 0.01


def test_linear_extremes() -> None:
    huge = [np.full((2, 2, 3), v, np.float32) for v in (1e30, 2e30, 3e30)]
    merged = merge_linear(huge, np.array([1.0, 2.0, 4.0]), white=1e31)
    assert np.all(np.isfinite(merged.radiance))
    black = merge_linear([np.zeros((2, 2, 3), np.uint16)] * 2, np.array([1.0, 2.0]))
    assert np.all(black.clipped == -1)
    assert np.all(black.radiance == 0)
    assert stops(black.radiance) == 0


def test_bad_input_is_refused() -> None:
    frames = photograph(scene(16, 16))
    with pytest.raises(UserError, match="another camera"):
        merge_frames([f[..., :1] for f in frames], TIMES, camera())
    with pytest.raises(UserError, match="6 exposures for 7 pictures"):
        merge_frames(frames, TIMES[:6], camera())
    with pytest.raises(UserError, match="same exposure"):
        merge_frames(frames, np.ones(7), camera())
    with pytest.raises(UserError, match="one size"):
        merge_frames([frames[0], frames[1][:8]], TIMES[:2], camera())
    with pytest.raises(UserError, match="black"):
        merge_linear([np.zeros((2, 2, 3), np.float32)] * 2, TIMES[:2])
    with pytest.raises(UserError, match="float64"):
        merge_linear([np.zeros((2, 2, 3))] * 2, TIMES[:2])


def test_weights_vanish_at_the_ends_and_where_the_curve_is_unknown() -> None:
    w = weights(camera())
    assert np.all(w[:, [0, 255]] == 0)
    assert np.all(w[:, 20:230] > 0)
    unknown = camera()
    sigma = unknown.sigma.copy()
    sigma[:, :40] = 2
    doubtful = Response(unknown.channels, unknown.log_exposure, sigma, unknown.code_noise)
    assert np.all(weights(doubtful)[:, :40] == 0)
