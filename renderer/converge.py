"""How far a picture that gets ever more samples is from its limit."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.composite import Composite


@dataclass
class Convergence:
    """The relative error of a picture: RMS of the changed pixels over their mean.

    ``path`` counts the scatter of its samples (which is more than the error of samples that
    are spread well). ``direct`` does so for shadows and matt light alone, so its pictures P are
    judged by themselves: P_m of m samples contains P_n, so E (P_m - P_n)^2 = s^2 (1/n - 1/m),
    and P_m's own variance s^2 / m is (P_m - P_n)^2 n / (m - n). Looked at whenever the
    samples have doubled, and not below what the doubling before lets expect, as rare light may
    have kept away; what both have in common, a bias, does not show.
    """

    #: whether ``standard_error`` of the composites holds all noise
    counts_all_noise: bool
    _error: float | None = None
    _latest: float = 0.0
    _n: int = 0
    _picture: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0, 3), "f4"))

    def least(self) -> int:
        """Samples a pixel before the error is to be believed: rare light may be to come."""
        return 16 if self.counts_all_noise else 64

    def is_due(self, samples: int) -> bool:
        """Whether there is more to say than the last time."""
        return samples > 1 if self.counts_all_noise else samples >= 2 * self._n

    def error(self, composite: Composite, samples: int) -> float | None:
        """The error of the newest `composite`; None while it is not known."""
        if self.counts_all_noise:
            return composite.relative_error() if samples > 1 else None
        m, n = samples, self._n
        if m < 2 * n:
            return self._error
        if n:
            pixels = composite.changed | (self._picture != composite.rgb).any(axis=2)
            latest = 0.0
            if pixels.any():
                step = (composite.rgb - self._picture)[pixels].mean(axis=1).astype(float)
                mean = float(composite.rgb[pixels].mean())
                rms = math.sqrt(float(np.mean(step**2)) * n / (m - n))
                latest = rms / mean if mean > 0 else 0.0
            self._error = max(latest, self._latest * math.sqrt(n / m))
            self._latest = latest
        self._picture, self._n = composite.rgb, m
        return self._error
