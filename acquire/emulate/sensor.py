"""An emulated sensor: radiance and exposure time in, 8-bit codes out, the response known.

Photons are counted (Poisson), read out with noise, amplified, digitised and sent through a
tone curve of its own for each channel. The curve has a closed form both ways, so that
:meth:`Sensor.log_exposure` is the truth and no estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

CODES = 256
_ADC = 65536  # the tone curve is applied to the digitised signal, as a camera's table is
_SKEW = 0.05  # above this skewness shot noise is drawn from Poisson's law itself

type Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Sensor:
    """A colour sensor with one tone curve a channel.

    Parameters
    ----------
    middle
        Radiance times seconds that gives code 128 in all channels at ``gain`` 1: the picture
        is white-balanced there, so radiance merged with the true response is radiance / middle.
    full_well
        Electrons of the most sensitive channel at code 255.
    read_noise
        Electrons, standard deviation.
    gain
        Amplification before the converter: brighter, noisier.
    efficiency
        Electrons of a channel relative to the best one, for equal codes.
    gamma, toe, shoulder, black
        The tone curve, x = fraction of the full well, v the code / 255:
        u = ((x + toe)^gamma - toe^gamma) / ((1 + toe)^gamma - toe^gamma),
        v = (1 + black) u / (u + shoulder (1 - u)) - black, cut at 0 and 1.
    prnu
        Standard deviation of the pixels' own sensitivity, a fixed pattern of ``seed``.

    """

    middle: float = 0.02
    full_well: float = 20000.0
    read_noise: float = 8.0
    gain: float = 1.0
    efficiency: Rgb = (0.6, 1.0, 0.7)
    gamma: Rgb = (0.44, 0.45, 0.47)
    toe: float = 0.004
    shoulder: Rgb = (0.85, 0.80, 0.75)
    black: float = 0.004
    prnu: float = 0.0
    seed: int = 0

    def response(self, x: ArrayLike) -> NDArray[np.float64]:
        """Tone curve f: fraction of the full well (..., 3) to codes 0..1 before rounding."""
        gamma, shoulder = np.array(self.gamma), np.array(self.shoulder)
        low = self.toe**gamma
        u = ((np.clip(x, 0, 1) + self.toe) ** gamma - low) / ((1 + self.toe) ** gamma - low)
        v = u / (u + shoulder * (1 - u))
        return np.clip((1 + self.black) * v - self.black, 0, 1)

    def inverse(self, v: ArrayLike) -> NDArray[np.float64]:
        """f^-1: codes 0..1 (..., 3) to fractions of the full well; above 0 even for code 0."""
        gamma, shoulder = np.array(self.gamma), np.array(self.shoulder)
        low = self.toe**gamma
        w = (np.asarray(v, np.float64) + self.black) / (1 + self.black)
        u = shoulder * w / (1 - w + shoulder * w)
        return (u * ((1 + self.toe) ** gamma - low) + low) ** (1 / gamma) - self.toe

    def log_exposure(self) -> NDArray[np.float64]:
        """(3, 256) natural logarithm of the exposure at each code's middle, 0 at code 128."""
        codes = np.arange(CODES) / (CODES - 1)
        g = np.log(self.inverse(codes[:, None])).T
        return g - g[:, 128:129]

    def expose(
        self, radiance: NDArray[np.floating], time: float, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Photograph (H, W, 3) scene-linear radiance for `time` seconds: (H, W, 3) codes.

        Values below 0 are dark. A bright pixel fills its well and stays at 255; nothing
        blooms into its neighbours.
        """
        well = self.full_well * np.array(self.efficiency)
        scale = (well * self.inverse(np.full(3, 128 / 255)) * time / self.middle).astype("f4")
        signal = np.maximum(radiance, 0, dtype=np.float32) * scale
        if self.prnu:
            signal *= 1 + np.float32(self.prnu) * _pattern(self.seed, signal.shape)
        np.minimum(signal, 2 * well.astype("f4"), out=signal)  # keeps Poisson's law in range
        variance = signal + np.float32(self.read_noise**2)
        # Shot and read noise together are all but normal where their sum's skewness is small.
        skewed = signal > _SKEW * variance**1.5
        noise = rng.standard_normal(signal.shape, np.float32)
        electrons = signal + np.sqrt(variance) * noise
        if skewed.any():
            electrons[skewed] = rng.poisson(signal[skewed]) + self.read_noise * noise[skewed]
        electrons *= (self.gain * (_ADC - 1) / well).astype("f4")
        electrons += 0.5
        np.clip(electrons, 0, _ADC - 1, out=electrons)
        codes = np.empty(signal.shape, np.uint8)
        table, counts = _table(self), electrons.astype(np.uint16)
        for channel in range(3):
            codes[..., channel] = table[channel][counts[..., channel]]
        return codes


@lru_cache(maxsize=4)
def _table(sensor: Sensor) -> NDArray[np.uint8]:
    """(3, 65536) codes for each digitised count."""
    x = np.arange(_ADC)[:, None] / (_ADC - 1)
    return np.ascontiguousarray(np.rint(255 * sensor.response(x)).astype(np.uint8).T)


@lru_cache(maxsize=4)
def _pattern(seed: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.random.default_rng(seed).standard_normal(shape, np.float32)
