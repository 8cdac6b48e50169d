"""Merges against what is true: the Cramer-Rao bound, other depths, other orders."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.hdr.merge import code_weights, merge_frames, merge_linear
from chromeball.hdr.noise import (
    CodeNoise,
    chi_square,
    measure_codes,
    measure_linear,
    unsaturated,
)
from chromeball.hdr.response_file import Response
from chromeball.hdr.select import choose
from tests.hdr.camera import TIMES, log_exposure, photograph, scene

WELL, READ = 15000.0, 5.0


def electrons(
    level: float, t: NDArray[np.float64], n: int, seed: int = 0
) -> tuple[float, NDArray[np.float64]]:
    """Radiance that gives `level` electrons in the longest exposure; (P, n, n, 1) of it."""
    rng = np.random.default_rng(seed)
    radiance = level / t.max()
    shape = (len(t), n, n, 1)
    light = rng.poisson(radiance * t[:, None, None, None], shape)
    return radiance, light + rng.normal(0, READ, shape)


@pytest.mark.parametrize("step", [1.0, 2.0])
@pytest.mark.parametrize("level", [13.0, 50.0, 1000.0, 30000.0])
def test_linear_merge_reaches_the_cramer_rao_bound(step: float, level: float) -> None:
    """360 000 pixels: the RMS is known to 0.12 %, the bias to sigma / 600 (one deviation)."""
    t = np.exp2(step * np.arange(7 if step == 1 else 5))
    radiance, x = electrons(level, t / t.max(), 600)
    t /= t.max()
    raw = np.clip(np.round(x + 512), 0, WELL + 512).astype(np.uint16)
    read = READ**2 + 1 / 12
    merged = merge_linear(
        list(raw),
        t,
        black=512.0,
        white=WELL + 512,
        noise=(1 / WELL, read / WELL**2),
        sigma=True,
    )
    kept = radiance * t < 0.99 * WELL
    bound = np.sum(t[kept] ** 2 / (radiance * t[kept] + read)) ** -0.5
    error = merged.radiance.astype(float) - radiance
    assert np.sqrt(np.mean(error**2)) / bound < 1.01
    assert abs(error.mean()) < 0.005 * radiance + 3 * bound / 600
    assert merged.sigma is not None
    if np.all(np.abs(radiance * t - 0.99 * WELL) > 500):  # no frame on the brink of saturation
        assert np.mean((error / merged.sigma) ** 2) == pytest.approx(1, abs=0.08)
    assert (merged.negative.sum() > 0) == (level == 13)


def test_levels_by_parity() -> None:
    """Four sensors in one mosaic: each parity as if it were alone."""
    rng = np.random.default_rng(1)
    black = np.array([[100.0, 120.0], [90.0, 256.0]])
    white = np.array([[4000.0, 4095.0], [3900.0, 4095.0]])
    t = TIMES[1:6]
    raw = [rng.integers(0, 4096, (21, 35, 1)).astype(np.uint16) for _ in t]
    whole = merge_linear(raw, t, black=black, white=white, sigma=True)
    assert whole.sigma is not None
    for r in range(2):
        for c in range(2):
            alone = merge_linear(
                [f[r::2, c::2] for f in raw],
                t,
                black=float(black[r, c]),
                white=float(white[r, c]),
                sigma=True,
            )
            assert alone.sigma is not None
            radiance, sigma = whole.radiance[r::2, c::2], whole.sigma[r::2, c::2]
            np.testing.assert_array_max_ulp(radiance, alone.radiance, maxulp=2)
            np.testing.assert_array_max_ulp(sigma, alone.sigma, maxulp=2)
            np.testing.assert_array_equal(whole.clipped[r::2, c::2], alone.clipped)


def test_depths_agree() -> None:
    """u16 against f32; u8 codes against the same codes times 257."""
    picture = scene(40, 50)
    sensor = [
        np.minimum(picture * t * 20000 + 700, 65535).round().astype(np.uint16) for t in TIMES
    ]
    levels: dict[str, Any] = {"black": 700.0, "white": 60000.0, "sigma": True}
    a = merge_linear(sensor, TIMES, **levels)
    b = merge_linear([f.astype(np.float32) for f in sensor], TIMES, **levels)
    # The compiler may contract a kernel's ends of rows otherwise than their middles.
    np.testing.assert_array_max_ulp(a.radiance, b.radiance, maxulp=2)
    assert a.sigma is not None
    assert b.sigma is not None
    np.testing.assert_array_max_ulp(a.sigma, b.sigma, maxulp=2)

    frames = photograph(picture)
    small = Response.from_log_exposure(np.stack([log_exposure()] * 3))
    z = np.arange(65536) / 257
    fine = np.stack([np.interp(z, np.arange(256), g) for g in small.log_exposure])
    large = Response(small.channels, fine, np.zeros_like(fine), small.code_noise * 257)
    noise = np.full(3, 0.5), np.full(3, 3e-4), np.full(3, 1e-6)
    c = merge_frames(
        frames, TIMES, small, tables=code_weights(small, CodeNoise(*noise)), sigma=True
    )
    d = merge_frames(
        [f.astype(np.uint16) * np.uint16(257) for f in frames],
        TIMES,
        large,
        tables=code_weights(large, CodeNoise(noise[0] * 257, *noise[1:])),
        sigma=True,
    )
    np.testing.assert_allclose(c.radiance, d.radiance, rtol=1e-6)
    assert c.sigma is not None
    assert d.sigma is not None
    np.testing.assert_allclose(c.sigma, d.sigma, rtol=1e-5)
    np.testing.assert_array_equal(c.clipped, d.clipped)


@pytest.mark.parametrize("kind", ["codes", "u16", "f32"])
def test_no_dark_sun(kind: str) -> None:
    """A sun that saturates the short frames and turns dark in the long ones stays bright."""
    dtype = {"codes": np.uint8, "u16": np.uint16, "f32": np.float32}[kind]
    most = {"codes": 255, "u16": 65535, "f32": 1}[kind]
    frames = [np.full((3, 3, 3), most * 0.3, dtype) for _ in range(5)]
    values = [0.4, 1.0, 1.0, 0.2, 0.0]
    for frame, value in zip(frames, values, strict=True):
        frame[1, 1] = most * value
    for frame in frames:
        frame[2, 2] = most if frame is frames[0] else 0.1 * most
    t = TIMES[:5]
    if kind == "codes":
        curve = Response.from_log_exposure(np.stack([log_exposure(1.0)] * 3))
        merged, unit = merge_frames(frames, t, curve), 255 / 128
    else:
        merged, unit = merge_linear(frames, t, white=float(most)), float(most)
    np.testing.assert_allclose(merged.radiance[1, 1] / unit, 0.4 / t[0], rtol=0.01)
    assert merged.clipped[1, 1] == 0
    np.testing.assert_allclose(merged.radiance[2, 2] / unit, 1 / t[0], rtol=1e-5)
    assert merged.clipped[2, 2] == 1


def test_the_noise_of_a_sensor_is_measured() -> None:
    rng = np.random.default_rng(2)
    radiance = np.exp(rng.uniform(np.log(20), np.log(WELL), 30_000))
    t = TIMES / 8
    x = rng.poisson(radiance * t[:, None]) + rng.normal(0, READ, (len(t), len(radiance)))
    x = np.minimum(x / WELL, 1)
    found = measure_linear(x, t, unsaturated(x, 0.99))
    assert found is not None
    np.testing.assert_allclose(found, [1 / WELL, READ**2 / WELL**2], rtol=0.05)


def test_the_noise_of_codes_is_measured_and_chi_square_is_one() -> None:
    frames = photograph(scene(200, 200), well=WELL, read=READ)
    curve = Response.from_log_exposure(np.stack([log_exposure()] * 3))
    values = [f.reshape(-1, 3) for f in frames]
    noise = measure_codes(values, TIMES, curve)
    assert noise is not None
    scale = (255 / 128) ** 2.2  # X = 1 at code 128
    np.testing.assert_allclose(noise.shot, scale / WELL, rtol=0.15)
    assert np.all(noise.code < 0.6)
    tables = code_weights(curve, noise)
    z, channel = np.stack(values).astype(int), np.arange(3)
    w = tables.weight[channel, z] * unsaturated(z, tables.saturated)
    y = curve.log_exposure[channel, z] - np.log(TIMES)[:, None, None]
    fit = chi_square(
        y, np.where(w > 0, tables.taper[channel, z], 1) / np.where(w > 0, w, 1), w > 0
    )
    np.testing.assert_allclose(fit.chi_square, 1, atol=0.1)
    np.testing.assert_allclose(fit.by_range, 1, atol=0.25)


def test_few_samples_measure_no_noise() -> None:
    curve = Response.from_log_exposure(log_exposure())
    assert measure_codes([np.full((10, 1), 90, np.uint8)] * 3, TIMES[:3], curve) is None
    assert measure_linear(np.full((3, 10), 0.1), TIMES[:3], np.ones((3, 10), bool)) is None


def test_exposures_that_are_not_needed_are_left_out() -> None:
    """Three frames measure all values; a copy and a dark frame add too little."""
    information = np.zeros((5, 3000))
    information[0, :1000] = 1e4
    information[1, 1000:2000] = 1e4
    information[2, 2000:] = 1e4
    information[3] = 50
    choice = choose(information, 50.0)
    assert choice.kept == (0, 1, 2)
    assert set(choice.left_out) == {3, 4}
    assert choice.cost == (0, 0)
    # a target that only all together reach keeps all that add to it
    assert choose(information, 1e3).kept == (0, 1, 2)
    rare = information.copy()
    rare[3, :100] = 1e5
    assert 3 in choose(rare, 200.0).kept
