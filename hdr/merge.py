"""A bracket to radiance: weighted average over the exposures (row P13).

8-bit pictures: E = sum_j w(z_j) X(z_j) / t_j / sum_j w(z_j), X = e^g. The error of a code is
constant in code units (quantisation, JPEG, the camera's own processing), so ln X has variance
v(z) = (g'(z) sigma_z)^2 + sigma_g(z)^2, and w = taper / v. The weight stands for the variance
of ln X, not of X / t_j: the factor X^2 / t_j^2 that separates them is E^2, one for all frames,
while taking it from each frame's own noisy code would bias dark pixels down.

Linear frames: E = sum w (x / t) / sum w, w = t^2 / (a E t + b) at the Poisson estimate
sum x / sum t, for a sensor with var x = a x + b (Hanji et al. 2020; Granados et al. 2010).

Where no frame measures a pixel it gets the best bound, is marked and counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.response import CODES
from chromeball.hdr.response_file import Response
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]

#: (a, b) of var x = a x + b, x of full scale: the median of 256 cameras at ISO 100 in
#: darktable's measured noise profiles
SENSOR_NOISE = (3.5e-6, 3.9e-9)
#: linear values from this share of white on are saturated
SATURATED = 0.99
#: codes over which the weight falls to zero at the dark end and below saturation
TAPER = (4, 16)


@dataclass(frozen=True)
class Radiance:
    """What a merge makes.

    ``radiance`` (H, W, C) float32; ``sigma`` its standard error, infinite where it is a bound;
    ``clipped`` (H, W) int8: 1 where a channel is saturated in all frames (the pixel is a lower
    bound), -1 where one is black in all (an upper bound), else 0; ``high`` and ``low`` (C,)
    count such values per channel.
    """

    radiance: NDArray[np.float32]
    sigma: NDArray[np.float32] | None
    clipped: NDArray[np.int8]
    high: NDArray[np.int64]
    low: NDArray[np.int64]


def weights(response: Response) -> Float:
    """w(z) = taper(z) / variance of ln X(z); (C, 256), zero at the ends."""
    slope = np.gradient(response.log_exposure, axis=1)
    # no pixel is read better than its quantisation
    noise = np.maximum(response.code_noise, 12**-0.5)[:, None]
    # a saturated pixel shows lower codes too, by the noise that came after it (JPEG)
    brightest = CODES - 1 - np.floor(3 * noise)
    z = np.arange(CODES)
    dark, bright = TAPER
    taper = np.clip(np.minimum(z / dark, (brightest - z) / bright), 0, 1)
    variance = (slope * noise) ** 2 + response.sigma**2
    # a code that leaves its exposure open by a factor of e or more measures nothing
    return np.where(variance < 1, taper / variance, 0)


def merge_frames(
    frames: Sequence[NDArray[np.uint8]],
    exposures: Float,
    response: Response,
    *,
    sigma: bool = False,
) -> Radiance:
    """Merge 8-bit frames (H, W, C), C of 1 or 3, with the response of their camera."""
    shape = _shape(frames, exposures)
    if shape[2] != len(response.channels):
        raise UserError(
            f"the pictures have {shape[2]} channels, the response has "
            f"{len(response.channels)}: it is of another camera"
        )
    order = np.argsort(exposures, kind="stable")
    merged = kernel.merge_codes(
        [_flat(frames[j]) for j in order],
        weights(response),
        np.exp(response.log_exposure),
        np.ascontiguousarray(exposures[order]),
        sigma,
    )
    return _radiance(merged, shape)


def merge_linear(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    *,
    white: float | None = None,
    noise: tuple[float, float] = SENSOR_NOISE,
    sigma: bool = False,
) -> Radiance:
    """Merge linear frames (H, W, C), uint16 or float32.

    `white` is the value of a saturated pixel: 65535 for uint16 unless given, for float32 the
    largest value of all frames (a sensor goes no higher). `noise` is (a, b) of
    var x = a x + b with x as share of white.
    """
    shape = _shape(frames, exposures)
    kind = frames[0].dtype
    if kind != np.uint16 and kind != np.float32:
        raise UserError(f"linear pictures of {kind} values: 16-bit or float ones are needed")
    if white is None:
        white = 65535.0 if kind == np.uint16 else max(float(f.max()) for f in frames)
    if kind == np.uint16 and white > 65535:
        raise UserError(f"16-bit pictures hold no white of {white:g}; it is at most 65535")
    if not (np.isfinite(white) and white > 0):
        raise UserError("all pictures are black: take longer exposures")
    if not (noise[0] >= 0 and noise[1] > 0 and np.all(np.isfinite(noise))):
        raise UserError("sensor noise needs two numbers a,b with a >= 0 and b > 0")
    order = np.argsort(exposures, kind="stable")
    times = np.ascontiguousarray(exposures[order])
    a, b = noise[0] * white, noise[1] * white**2
    flat = [_flat(frames[j]) for j in order]
    limit = SATURATED * white
    if kind == np.uint16:
        merged = kernel.merge_linear_u16(
            cast("list[NDArray[np.uint16]]", flat), times, float(int(limit)), a, b, sigma
        )
    else:
        merged = kernel.merge_linear_f32(
            cast("list[NDArray[np.float32]]", flat), times, limit, a, b, sigma
        )
    return _radiance(merged, shape)


def stops(merged: Radiance) -> float:
    """Dynamic range: log2 of the brightest over the darkest measured value (99.99 / 0.01 %)."""
    measured = merged.radiance[merged.clipped == 0]
    measured = measured[measured > 0]
    if measured.size == 0:
        return 0.0
    low, high = np.percentile(measured[:: max(1, measured.size // 2_000_000)], [0.01, 99.99])
    return float(np.log2(high / low))


def preview(merged: Radiance, width: int = 640) -> NDArray[np.uint8]:
    """A small tone-mapped picture (Reinhard et al. 2002, global) to look at, (h, w, 3)."""
    import cv2

    from chromeball.scene.image import to_display

    pixels = merged.radiance
    scale = min(1.0, width / pixels.shape[1])
    size = (
        max(1, round(pixels.shape[1] * scale)),
        max(1, round(pixels.shape[0] * scale)),
    )
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.float64)
    small = small.reshape(size[1], size[0], -1)
    luminance = small @ [0.2126, 0.7152, 0.0722] if small.shape[2] == 3 else small[..., 0]
    measured = luminance[luminance > np.percentile(luminance, 99.9) * 1e-6]
    key = 0.18 / np.exp(np.mean(np.log(measured))) if measured.size else 1.0
    scaled = luminance * key
    white = max(1.0, float(np.percentile(scaled, 99.5)))
    gain = key * (1 + scaled / white**2) / (1 + scaled)
    return to_display(np.broadcast_to(small * gain[..., None], (size[1], size[0], 3)))


def _shape(frames: Sequence[NDArray[Any]], exposures: Float) -> tuple[int, int, int]:
    if len(frames) == 0:
        raise UserError("no pictures to merge")
    if len(frames) != len(exposures):
        raise UserError(f"{len(exposures)} exposures for {len(frames)} pictures")
    if not (np.all(np.isfinite(exposures)) and np.all(exposures > 0)):
        raise UserError("exposures must be positive numbers")
    if len(frames) > 1 and np.ptp(np.log(exposures)) < 1e-3:
        raise UserError("all pictures have the same exposure: a bracket needs different ones")
    shape = frames[0].shape
    if len(shape) != 3 or shape[2] not in (1, 3):
        raise UserError(f"pictures of shape {shape}: RGB or grey ones are needed")
    if any(f.shape != shape or f.dtype != frames[0].dtype for f in frames):
        raise UserError("the pictures of a bracket must have one size and one depth")
    return shape[0], shape[1], shape[2]


def _flat(frame: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(frame).reshape(-1, frame.shape[2])


def _radiance(
    merged: tuple[
        NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.int8], NDArray[np.int64]
    ],
    shape: tuple[int, int, int],
) -> Radiance:
    pixels, sigma, clipped, counts = merged
    return Radiance(
        radiance=pixels.reshape(shape),
        sigma=None if sigma is None else sigma.reshape(shape),
        clipped=clipped.reshape(shape[:2]),
        high=counts[:, 0],
        low=counts[:, 1],
    )
