"""The emulated sensor against its closed forms and against the laws of its noise."""

import numpy as np
import pytest

from chromeball.acquire.emulate.sensor import Sensor

FLAT = np.ones((128, 128, 3), np.float32)


def test_inverse_undoes_the_response():
    sensor = Sensor()
    codes = np.linspace(0, 1, 97)[:, None] * np.ones(3)
    np.testing.assert_allclose(sensor.response(sensor.inverse(codes)), codes, atol=1e-12)


def test_log_exposure_is_zero_at_the_middle_and_rises():
    g = Sensor().log_exposure()
    assert g.shape == (3, 256)
    assert np.isfinite(g).all()
    np.testing.assert_array_equal(g[:, 128], 0)
    assert (np.diff(g, axis=1) > 0).all()
    assert np.ptp(g, axis=1).min() > 7  # natural logarithm: over ten stops


def test_codes_say_the_exposure_through_the_true_curve():
    """ln(L t / middle) = g(code), for every channel and every level in range."""
    sensor = Sensor(full_well=1e7, read_noise=0.0)
    g = sensor.log_exposure()
    rng = np.random.default_rng(1)
    for radiance, time in ((1.0, 0.02), (0.05, 0.02), (3.0, 0.02), (200.0, 1e-4), (0.2, 0.05)):
        codes = sensor.expose(FLAT * np.float32(radiance), time, rng)
        for channel in range(3):
            half_a_code = np.abs(np.gradient(g[channel]))[int(codes[..., channel].mean())] / 2
            error = g[channel][codes[..., channel]] - np.log(radiance * time / sensor.middle)
            assert np.abs(error.mean()) <= half_a_code


def test_white_balance_and_full_well():
    rng = np.random.default_rng(2)
    grey = Sensor().expose(FLAT, 0.02, rng)
    np.testing.assert_allclose(grey.mean(axis=(0, 1)), 128, atol=0.2)
    assert Sensor().expose(FLAT, 10.0, rng).min() == 255
    assert Sensor().expose(0 * FLAT, 1.0, rng).mean() < 3


@pytest.mark.parametrize(
    ("radiance", "gain", "read_noise"),
    [
        (0.004, 20.0, 0.0),
        (0.02, 10.0, 0.0),
        (0.05, 10.0, 8.0),
        (0.5, 0.8, 0.0),
        (0.5, 0.8, 8.0),
    ],
)
def test_noise_has_the_variance_of_photons_and_readout(
    radiance: float, gain: float, read_noise: float
):
    """Through a linear table the counts' mean is N and their variance N + read_noise^2."""
    linear = Sensor(
        full_well=2000.0,
        read_noise=read_noise,
        gamma=(1.0, 1.0, 1.0),
        shoulder=(1.0, 1.0, 1.0),
        efficiency=(1.0, 1.0, 1.0),
        black=0.0,
        gain=gain,
    )
    electrons_per_code = 2000 / gain / 255
    n = 2000 * (128 / 255) * radiance  # middle: half full at radiance 1
    codes = linear.expose(FLAT * np.float32(radiance), linear.middle, np.random.default_rng(3))
    electrons = codes.astype(float) * electrons_per_code
    assert electrons.mean() == pytest.approx(n, rel=0.01, abs=0.02 * electrons_per_code)
    variance = n + read_noise**2 + electrons_per_code**2 / 12
    assert electrons.var() == pytest.approx(variance, rel=0.04)


def test_fixed_pattern_is_fixed():
    sensor = Sensor(prnu=0.05, full_well=1e8, read_noise=0.0)
    rng = np.random.default_rng(4)
    a, b = (sensor.expose(FLAT, 0.02, rng).astype(float) for _ in range(2))
    assert a.std() > 1.5
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.95


def test_a_seed_gives_the_same_picture():
    a, b = (Sensor().expose(FLAT, 0.01, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(a, b)
