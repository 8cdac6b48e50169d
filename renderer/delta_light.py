"""Lights without size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.material import Color


@dataclass(frozen=True)
class DeltaLight:
    """A light without size: point, spot or sun.

    ``position`` (3,) metres; none: a sun, infinitely far along -``direction``. ``intensity``
    W/sr, of a sun W/m^2 on a surface that faces it, RGB. Full within the angle whose cosine is
    ``cos_inner`` about ``direction`` (unit, into which it shines), dark beyond ``cos_outer``,
    in between the square of a linear ramp in the cosine (KHR_lights_punctual).
    """

    position: tuple[float, float, float] | None
    intensity: Color
    direction: tuple[float, float, float] = (0.0, -1.0, 0.0)
    cos_inner: float = -1.0
    cos_outer: float = -2.0

    def irradiance(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Irradiance (..., 3) at places (..., 3) on surfaces that face it, unshadowed."""
        if self.position is None:
            return np.broadcast_to(np.array(self.intensity), x.shape).copy()
        to = x - np.array(self.position)
        square = np.maximum(np.einsum("...i,...i->...", to, to), 1e-30)
        cosine = np.einsum("...i,i->...", to, np.array(self.direction)) / np.sqrt(square)
        ramp = np.clip(
            (cosine - self.cos_outer) / max(self.cos_inner - self.cos_outer, 1e-6), 0, 1
        )
        return (ramp**2 / square)[..., None] * np.array(self.intensity)
