"""Scene-linear Rec.709 and its display encoding."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: CIE 1931 xy of the Rec.709 primaries and D65, in OpenEXR's order (R, G, B, white).
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
#: Luminance of linear Rec.709 (ITU-R BT.709-6).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def luminance(rgb: ArrayLike) -> NDArray[np.floating]:
    """Luminance of linear RGB, ``(..., 3) -> (...)``."""
    return np.asarray(rgb) @ LUMINANCE


def srgb_encode(linear: ArrayLike) -> NDArray[np.floating]:
    """Linear 0..1 to sRGB 0..1 (IEC 61966-2-1); values outside are extended, not clipped."""
    x = np.asarray(linear)
    magnitude = np.abs(x)
    curve = 1.055 * np.maximum(magnitude, 0.0031308) ** (1 / 2.4) - 0.055
    return np.copysign(np.where(magnitude <= 0.0031308, 12.92 * magnitude, curve), x)


def srgb_decode(encoded: ArrayLike) -> NDArray[np.floating]:
    """SRGB 0..1 to linear 0..1, the inverse of :func:`srgb_encode`."""
    x = np.asarray(encoded)
    magnitude = np.abs(x)
    curve = ((np.maximum(magnitude, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.copysign(np.where(magnitude <= 0.04045, magnitude / 12.92, curve), x)
