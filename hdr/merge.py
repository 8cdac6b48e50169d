"""A bracket to radiance: weighted average over the exposures (row P13).

Codes: E = sum_j w(z_j) X(z_j) / t_j / sum_j w(z_j), X = e^g, w = 1 / var ln X (see
:mod:`chromeball.hdr.noise`). The weight stands for the variance of ln X, not of X / t_j: the
factor X^2 / t_j^2 that separates them is E^2, one for all frames, while taking it from each
frame's own noisy code would bias dark pixels down. For the same reason pixels whose error is
large (WEAK) are weighed again, by the variance at the exposure E t_j that the first estimate
predicts: weights at noisy dark codes favour the codes that noise made brighter.

Linear frames: E = sum_j w_j x_j / t_j / sum_j w_j, w = t^2 / (a E0 t + b), for a sensor with
var x = a x + b (Granados et al. 2010; Hanji et al. 2020), one step from the pilot
E0 = max(0, sum t x / sum t^2). With e0 the pilot's error, r_j = x_j - E t_j,
c_j = cov(e0, r_j), V_j = a E t_j + b, I = sum t^2 / V and S = sum a t^3 / V^2, the step's bias
to second order is

    S sum(t c / V) / I^2 - sum(a t^2 c / V^2) / I.

The Poisson pilot sum x / sum t has c_j = V_j / sum t, which leaves S / (I T) ... > 0: in deep
shadow 1 - 2 %. This pilot has c_j = t_j V_j / sum t^2, and the bias a (T3 / T2)(...) vanishes
both where read noise rules (V constant) and where photons do (V proportional to t), so that no
second step is needed. Negative values after black subtraction are kept: cutting them off would
bring the bias back.

Saturation is decided over the frames: once a sample is saturated, no longer exposure of it
counts, whatever it shows (a sun that turns dark in the longest frames). Where no frame measures
a pixel it gets the best bound, is marked and counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.knots import as_codes
from chromeball.hdr.noise import CodeNoise, slopes
from chromeball.hdr.response_file import Response
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]
#: a number, or an array: see :func:`merge_linear`
type Level = float | int | tuple[float, ...] | NDArray[Any]

#: (a, b) of var x = a x + b, x of full scale: the median of 256 cameras at ISO 100 in
#: darktable's measured noise profiles
SENSOR_NOISE = (3.5e-6, 3.9e-9)
#: linear values from this share of white on are saturated
SATURATED = 0.99
#: codes (of 256) below saturation over which the weight rises from zero
TAPER = 8
#: pixels with a larger relative error are weighed by predicted exposures
WEAK = 0.05


@dataclass(frozen=True)
class Radiance:
    """What a merge makes.

    ``radiance`` (H, W, C) float32; ``sigma`` its standard error, infinite where it is a bound;
    ``clipped`` (H, W) int8: 1 where a channel is saturated in all frames (the pixel is a lower
    bound), -1 where one is black in all (an upper bound), else 0; ``high`` and ``low`` (C,)
    count such values per channel, ``negative`` (C,) those below black, which are kept.
    """

    radiance: NDArray[np.float32]
    sigma: NDArray[np.float32] | None
    clipped: NDArray[np.int8]
    high: NDArray[np.int64]
    low: NDArray[np.int64]
    negative: NDArray[np.int64]


@dataclass(frozen=True)
class CodeWeights:
    """The tables of a merge of codes.

    ``weight``, ``taper`` (C, codes): taper over the variance of ln X, and the taper alone,
    which falls to zero at saturation; ``saturated`` (C,): the code it begins with; ``expected``
    (C, 2^15) float32: 1 / variance at an exposure X, by the upper 16 bits of its float32.
    """

    weight: Float
    taper: Float
    saturated: NDArray[np.int64]
    expected: NDArray[np.float32]


def code_weights(response: Response, noise: CodeNoise | None = None) -> CodeWeights:
    """The tables of a response; `noise` is the response's constant code noise unless given."""
    noise = noise or CodeNoise.of(response)
    g = response.log_exposure
    N = g.shape[1]
    step = (N - 1) / 255
    z = np.arange(N)
    a, b = noise.shot[:, None], noise.read[:, None]
    # a saturated pixel shows lower codes too, by the noise that came after it (JPEG)
    brightest = N - 1 - 3 * np.maximum(response.code_noise, 12**-0.5)[:, None]
    taper = np.clip((brightest - z) / (TAPER * step), 0, 1) * (z > 0)
    saturated = np.ceil(np.maximum(brightest[:, 0], N / 2)).astype(np.int64)

    def variance(slope: Float, ln_x: Float) -> Float:
        # no pixel is read better than its quantisation
        floor = (slope * 12**-0.5) ** 2
        model = (slope * noise.code[:, None]) ** 2 + a * np.exp(-ln_x) + b * np.exp(-2 * ln_x)
        return np.maximum(model, floor)

    at_codes = variance(slopes(g), g) + response.sigma**2
    # where the curve leaves a code's exposure open by a factor of e or more it measures nothing
    known = (slopes(g) ** 2 / 12 + response.sigma**2 < 1) & (taper > 0)
    bits = np.minimum(np.arange(1 << 15, dtype=np.uint32), 0x7F00) << 16 | 1 << 15
    x = np.clip(bits.view(np.float32).astype(np.float64), 1e-30, 1e30)
    grid = np.log(np.broadcast_to(x, (len(g), len(x))))
    interval = np.stack(
        [np.searchsorted(c, r, side="right") for c, r in zip(g, grid, strict=True)]
    )
    interval = np.clip(interval - 1, 0, N - 2)
    slope = np.take_along_axis(np.diff(g, axis=1), interval, axis=1)
    inside = np.clip(grid, g[:, :1], g[:, -1:])
    doubt = np.stack(
        [np.interp(r, c, s**2) for r, c, s in zip(inside, g, response.sigma, strict=True)]
    )
    return CodeWeights(
        weight=np.where(known, taper / at_codes, 0),
        taper=taper,
        saturated=saturated,
        expected=(1 / (variance(slope, inside) + doubt)).astype(np.float32),
    )


def weights(response: Response, noise: CodeNoise | None = None) -> Float:
    """w(z) = taper(z) / variance of ln X(z); (C, codes), zero at the ends."""
    return code_weights(response, noise).weight


def merge_frames(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    response: Response,
    *,
    tables: CodeWeights | None = None,
    sigma: bool = False,
) -> Radiance:
    """Merge frames of codes (H, W, C), C of 1 or 3, with the response of their camera.

    uint16 frames hold as many codes as the response has, 256 to 65536. `tables` are
    those of :func:`code_weights`, with the response's own constant noise unless given.

    Raises
    ------
    UserError
        Frames that do not fit together, the exposures or the response.

    """
    shape = _shape(frames, exposures)
    codes = response.log_exposure.shape[1]
    kind = frames[0].dtype
    if kind != np.uint8 and kind != np.uint16:
        raise UserError(f"pictures of {kind} values: 8-bit or 16-bit codes are needed")
    if kind == np.uint8 and codes != 256:
        raise UserError(
            f"8-bit pictures, but the response has {codes} codes: solve the response from "
            "pictures of the same depth"
        )
    if shape[2] != len(response.channels):
        raise UserError(
            f"the pictures have {shape[2]} channels, the response has "
            f"{len(response.channels)}: it is of another camera"
        )
    order = np.argsort(exposures, kind="stable")
    tables = tables or code_weights(response)
    held = [as_codes(frames[j], codes) for j in order]
    # the kernel's tables go to the end of the type, where no code of fewer bits is
    beyond = ((0, 0), (0, np.iinfo(held[0].dtype).max + 1 - codes))
    merge = kernel.merge_codes_u8 if held[0].dtype == np.uint8 else kernel.merge_codes_u16
    merged = _empty(shape, sigma)
    counts = merge(
        [_flat(frame) for frame in held],
        np.pad(tables.weight, beyond),
        np.exp(np.pad(response.log_exposure, beyond, mode="edge")),
        np.pad(tables.taper, beyond),
        tables.expected,
        tables.saturated,
        np.ascontiguousarray(exposures[order]),
        WEAK**-2,
        *merged,
    )
    return _radiance(merged, counts, shape)


def merge_linear(
    frames: Sequence[NDArray[Any]],
    exposures: Float,
    *,
    black: Level = 0.0,
    white: Level | None = None,
    noise: Level = SENSOR_NOISE,
    sigma: bool = False,
) -> Radiance:
    """Merge linear frames (H, W, C), uint16 or float32; a mosaic is (H, W, 1).

    `black` and `white`, the values without light and of a saturated pixel, are numbers or
    (2, 2), by the parity of row and column. `white` is 65535 for uint16 unless given, for
    float32 the largest value of all frames (a sensor goes no higher). `noise` is (a, b) of
    var x = a x + b with x = (value - black) / (white - black): (2,), per channel (C, 2), or per
    parity (2, 2, 1, 2). Radiance is in (value - black) per unit of exposure.

    Raises
    ------
    UserError
        Frames that do not fit together or the exposures; levels or noise that make no sense.

    """
    shape = _shape(frames, exposures)
    kind = frames[0].dtype
    if kind != np.uint16 and kind != np.float32:
        raise UserError(f"linear pictures of {kind} values: 16-bit or float ones are needed")
    if white is None:
        white = 65535.0 if kind == np.uint16 else max(float(f.max()) for f in frames)
    order = np.argsort(exposures, kind="stable")
    merge = kernel.merge_linear_u16 if kind == np.uint16 else kernel.merge_linear_f32
    merged = _empty(shape, sigma)
    counts = merge(
        [_flat(frames[j]) for j in order],
        np.ascontiguousarray(exposures[order]),
        levels(black, white, noise, shape[2], 65535.0 if kind == np.uint16 else np.inf),
        shape[1],
        *merged,
    )
    return _radiance(merged, counts, shape)


def levels(
    black: Level, white: Level, noise: Level, channels: int, most: float = np.inf
) -> NDArray[np.float32]:
    """(2, 2, C, 5): black, first saturated value, a / scale, b and scale = white - black."""
    dark, top = (
        _by_parity(level, name) for level, name in ((black, "black"), (white, "white"))
    )
    if np.any(top > most):
        raise UserError(f"16-bit pictures hold no white of {top.max():g}; it is at most 65535")
    if np.all(top <= 0):
        raise UserError("all pictures are black: take longer exposures")
    if np.any(top <= dark):
        raise UserError(
            f"the white level {top.min():g} is not above the black level {dark.max():g}"
        )
    model = np.asarray(noise, np.float64)
    if (
        model.shape not in ((2,), (channels, 2), (2, 2, 1, 2))
        or not np.all(np.isfinite(model))
        or np.any(model[..., 0] < 0)
        or np.any(model[..., 1] <= 0)
    ):
        raise UserError("sensor noise needs two numbers a,b with a >= 0 and b > 0")
    scale = top - dark
    table = np.empty((2, 2, channels, 5))
    table[..., 0] = dark
    table[..., 1] = dark + SATURATED * scale
    table[..., 2] = model[..., 0] / scale
    table[..., 3] = model[..., 1]
    table[..., 4] = scale
    return table.astype(np.float32)


def _by_parity(level: Level, name: str) -> Float:
    values = np.asarray(level, np.float64)
    if values.shape not in ((), (2, 2)) or not np.all(np.isfinite(values)):
        raise UserError(f"the {name} level is one number, or 2 x 2 by row and column")
    return np.broadcast_to(values, (2, 2))[..., None]


def stops(radiance: NDArray[np.float32]) -> float:
    """Dynamic range of measured values: log2 of their 99.99 over their 0.01 % quantile."""
    measured = radiance[radiance > 0]
    if measured.size == 0:
        return 0.0
    low, high = np.percentile(measured, [0.01, 99.99])
    return float(np.log2(high / low))


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


type _Merged = tuple[NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.int8]]


def _empty(shape: tuple[int, int, int], sigma: bool) -> _Merged:
    flat = shape[0] * shape[1], shape[2]
    deviation = np.empty(flat, np.float32) if sigma else None
    return np.empty(flat, np.float32), deviation, np.empty(flat[0], np.int8)


def _radiance(
    merged: _Merged, counts: NDArray[np.int64], shape: tuple[int, int, int]
) -> Radiance:
    pixels, sigma, clipped = merged
    return Radiance(
        radiance=pixels.reshape(shape),
        sigma=None if sigma is None else sigma.reshape(shape),
        clipped=clipped.reshape(shape[:2]),
        high=counts[:, 0],
        low=counts[:, 1],
        negative=counts[:, 2],
    )
