"""The plate's noise, measured, and made anew for what is synthetic (row A4).

Noise has a variance for each radiance, v(L) per channel, and a grain: the correlation between
neighbouring pixels and between channels that demosaicing, noise reduction and JPEG leave. Both
come from patches of the plate that show nothing but a slope of brightness. A patch's residual
r = Q x, Q taking a plane out, has E r r' = Q C Q for noise of covariance C; over lags l that is
linear in the autocovariance c(k),

    E sum_p r(p) r(p + l) = sum_k A(l, k) c(k),    A(l, k) = sum_{q - p = l} (Q T_k Q)(p, q),

T_k being 1 where two pixels of the patch lie at lag k. So c is found without the bias that
taking a plane out brings, for all lags of 7 x 7 at once.

Which patches are flat is not known. Their variances follow v chi^2_m / m with the m degrees of
freedom of correlated noise, m = (tr QCQ)^2 / tr (QCQ)^2; texture only adds. The mean of what
lies below the 97.5 % quantile, over what that mean should be, is v at its fixed point (compare
Pyatykh et al. 2013, Liu et al. 2006).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]

#: lags of the autocovariance on either side, and pixels a side of a patch
LAGS, PATCH = 3, 16
#: flat patches that tell of the noise at one radiance, and levels of radiance at most
_PER_LEVEL, _MOST_LEVELS = 24, 16
#: patches looked at
_MOST_PATCHES = 20_000
#: quantile of flat patches' variances beyond which a patch is textured
_FLAT = 0.975
#: pixels a side of the kernel that makes grain from white noise
_KERNEL = 32


@dataclass(frozen=True)
class Noise:
    """Noise of a picture with C channels.

    ``radiance``, ``variance`` (K, C): variance of a pixel at K rising radiances. ``linear``
    (2, C): a, b of a L + b, which goes on beyond the ends. ``correlation`` (7, 7, C, C): of
    channel i at a pixel with channel j at the pixel of each lag (dy, dx) in -3 .. 3.
    ``patches``: how many flat patches it was measured on. ``ratio`` (C,): measured standard
    deviation over the one that the plate's own sigma states, NaN without sigma.
    """

    radiance: Float
    variance: Float
    linear: Float
    correlation: Float
    patches: int
    ratio: Float

    def at(self, rgb: NDArray[np.floating]) -> NDArray[np.float32]:
        """Variance (..., C) of pixels whose true radiance is `rgb` (..., C)."""
        out = np.empty(rgb.shape, np.float32)
        for c in range(rgb.shape[-1]):
            level = np.maximum(rgb[..., c], 0)
            a, b = self.linear[:, c]
            # the ratio to a L + b is held at the ends
            ratio = self.variance[:, c] / np.maximum(a * self.radiance[:, c] + b, 1e-300)
            out[..., c] = np.interp(level, self.radiance[:, c], ratio) * (a * level + b)
        return out

    def figures(self) -> dict[str, object]:
        """What was measured, for the record."""
        middle = len(self.radiance) // 2
        side = self.correlation[LAGS]
        return {
            "flat_patches": self.patches,
            "radiance": self.radiance[middle],
            "standard_deviation": np.sqrt(self.variance[middle]),
            "shot": self.linear[0],
            "read": self.linear[1],
            "correlation_right": np.diagonal(side[LAGS + 1]),
            "correlation_below": np.diagonal(self.correlation[LAGS + 1, LAGS]),
            "correlation_channels": side[LAGS][np.triu_indices(side.shape[-1], 1)],
            "measured_over_sigma": [None if np.isnan(r) else float(r) for r in self.ratio],
        }


def measure_noise(
    picture: NDArray[np.floating],
    *,
    sigma: NDArray[np.floating] | None = None,
    usable: NDArray[np.bool_] | None = None,
) -> Noise:
    """The noise of `picture` (H, W, C), scene-linear.

    `sigma` (H, W, C), the pixels' known standard errors (`hdr merge --sigma`; infinite where a
    pixel is a bound), gives the variances; the picture then gives the grain alone. Pixels that
    are not `usable` (H, W), clipped ones, are left out.

    Raises
    ------
    UserError
        Where the picture has too few flat patches to tell.

    """
    x, mean, spread = _patches(picture, usable)
    if len(x) < 2 * _PER_LEVEL:
        raise UserError(
            f"the plate has {len(x)} whole patches of {PATCH} x {PATCH} unclipped pixels, too "
            f"few to measure its noise ({2 * _PER_LEVEL} are needed): switch look.noise off"
        )
    correlation = np.zeros((2 * LAGS + 1,) * 2 + (x.shape[-1],) * 2)
    correlation[LAGS, LAGS] = np.eye(x.shape[-1])
    curves, flat = _curves(mean, spread, correlation)
    for _ in range(2):
        correlation = _correlation(x, mean, curves, flat)
        curves, flat = _curves(mean, spread, correlation)
    if flat.sum() < _PER_LEVEL:
        raise UserError(
            f"only {flat.sum()} patches of the plate are flat, too few to measure its noise: "
            "switch look.noise off"
        )
    measured = _noise(curves, correlation, int(flat.sum()))
    if sigma is None:
        return measured
    stated = _stated(picture, sigma)
    known = _noise(stated, correlation, int(flat.sum()))
    level = mean[flat]
    ratio = np.sqrt(np.median(measured.at(level) / known.at(level), axis=0))
    return replace(known, ratio=ratio.astype(float))


def grain(
    shape: tuple[int, int], correlation: Float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Gaussian noise (H, W, C) of unit variance with that correlation (7, 7, C, C).

    White noise through the square root of the spectrum. Where the measured correlation, an
    estimate, is not one that noise can have, its spectrum is cut at zero.
    """
    from scipy import signal  # takes as long to load as a small picture to render

    height, width = shape
    channels = correlation.shape[-1]
    kernel = _kernel(correlation)
    margin = _KERNEL // 2
    padded = (height + 2 * margin, width + 2 * margin, channels)
    white = rng.standard_normal(padded, np.float32)
    out = np.zeros((height, width, channels), np.float32)
    for i in range(channels):
        for j in range(channels):
            if np.abs(kernel[..., i, j]).max() > 1e-4:
                out[..., i] += signal.oaconvolve(white[..., j], kernel[..., i, j], "valid")[
                    :height, :width
                ]
    return out


def autocovariance(noise: NDArray[np.floating], lags: int = LAGS) -> Float:
    """Products of a field (H, W, C) with itself at lags (dy, dx), (2n + 1, 2n + 1, C, C)."""
    height, width, channels = noise.shape
    spectrum = np.fft.rfft2(noise, (height + lags, width + lags), axes=(0, 1))
    out = np.empty((2 * lags + 1,) * 2 + (channels,) * 2)
    away = np.abs(np.arange(-lags, lags + 1))
    pairs = np.outer(height - away, width - away)
    for i in range(channels):
        for j in range(channels):
            product = np.fft.irfft2(
                spectrum[..., i].conj() * spectrum[..., j], (height + lags, width + lags)
            )
            out[..., i, j] = np.roll(product, (lags, lags), (0, 1))[
                : 2 * lags + 1, : 2 * lags + 1
            ]
    return out / pairs[..., None, None]


def _patches(
    picture: NDArray[np.floating], usable: NDArray[np.bool_] | None
) -> tuple[Float, Float, Float]:
    """Residuals (P, 256, C) of planes, mean (P, C), and sums of squared residuals (P, C)."""
    height, width, channels = picture.shape
    rows, columns = height // PATCH, width // PATCH
    if not (rows and columns):
        none = np.zeros((0, channels))
        return np.zeros((0, PATCH**2, channels)), none, none
    cut = picture[: rows * PATCH, : columns * PATCH]
    good = cut < picture.max(axis=(0, 1))  # what is brightest may be cut off
    if usable is not None:
        good &= usable[: rows * PATCH, : columns * PATCH, None]

    def split(a: NDArray[Any]) -> NDArray[Any]:
        blocks = a.reshape(rows, PATCH, columns, PATCH, channels).swapaxes(1, 2)
        return blocks.reshape(-1, PATCH**2, channels)

    chosen = np.flatnonzero(split(good).mean(axis=(1, 2)) > 0.98)
    chosen = chosen[:: max(1, -(-len(chosen) // _MOST_PATCHES))]
    x = split(cut)[chosen].astype(float)
    plane = _plane()
    residual = x - plane @ (plane.T @ x)
    return residual, x.mean(axis=1), (residual**2).sum(axis=1)


@lru_cache(maxsize=1)
def _plane() -> Float:
    """Orthonormal basis (256, 3) of planes over a patch."""
    y, x = np.mgrid[:PATCH, :PATCH].reshape(2, -1)
    return np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1).astype(float))[0]


@lru_cache(maxsize=1)
def _lag_system() -> tuple[Float, NDArray[np.intp]]:
    """A (49, 49), and for each pair of a patch's pixels the number of its lag, 49 for far."""
    at = np.mgrid[:PATCH, :PATCH].reshape(2, -1)
    dy, dx = at[:, None, :] - at[:, :, None]
    side = 2 * LAGS + 1
    near = (np.abs(dy) <= LAGS) & (np.abs(dx) <= LAGS)
    number = np.where(near, (dy + LAGS) * side + dx + LAGS, side**2).astype(np.intp)
    plane = _plane()
    Q = np.eye(PATCH**2) - plane @ plane.T
    A = np.empty((side**2, side**2))
    for k in range(side**2):
        seen = Q @ (number == k).astype(float) @ Q
        A[:, k] = np.bincount(number.ravel(), seen.ravel(), side**2 + 1)[:-1]
    return A, number


def _freedom(correlation: Float) -> tuple[Float, Float]:
    """tr(QCQ) and m, both (C,), for each channel's own correlation."""
    _, number = _lag_system()
    plane = _plane()
    trace, freedom = [], []
    for c in range(correlation.shape[-1]):
        matrix = np.append(correlation[..., c, c].ravel(), 0)[number]
        matrix = matrix - plane @ (plane.T @ matrix)
        matrix = matrix - (matrix @ plane) @ plane.T
        trace.append(np.trace(matrix))
        freedom.append(np.trace(matrix) ** 2 / (matrix * matrix.T).sum())
    return np.array(trace), np.array(freedom)


type _Curves = tuple[Float, Float]  # radiance, variance (K, C)


def _curves(
    mean: Float, spread: Float, correlation: Float
) -> tuple[_Curves, NDArray[np.bool_]]:
    """Variance against radiance, and which patches are flat in all channels."""
    trace, freedom = _freedom(correlation)
    levels = int(np.clip(len(mean) // (2 * _PER_LEVEL), 1, _MOST_LEVELS))
    channels = mean.shape[1]
    radiance, variance = np.zeros((levels, channels)), np.zeros((levels, channels))
    flat = np.ones(len(mean), bool)
    for c in range(channels):
        m = freedom[c]
        # the quantile of chi^2_m over m
        limit = 2 * special.gammaincinv(m / 2, _FLAT) / m
        # E of chi^2_m / m below its quantile
        share = special.gammainc((m + 2) / 2, limit * m / 2) / _FLAT
        order = np.argsort(mean[:, c], kind="stable")
        for k, part in enumerate(np.array_split(order, levels)):
            s2 = spread[part, c] / trace[c]
            v = np.quantile(s2, 0.25) * m / (2 * special.gammaincinv(m / 2, 0.25))
            keep = np.ones(len(s2), bool)
            for _ in range(50):
                keep = s2 <= v * limit
                new = s2[keep].mean() / share if keep.any() else v
                if abs(new - v) <= 1e-6 * v:
                    break
                v = new
            flat[part[~keep]] = False
            radiance[k, c] = mean[part[keep], c].mean() if keep.any() else mean[part, c].mean()
            variance[k, c] = v
    return (radiance, variance), flat


def _correlation(x: Float, mean: Float, curves: _Curves, flat: NDArray[np.bool_]) -> Float:
    """Correlation (7, 7, C, C) of the flat patches' residuals."""
    scale = np.sqrt(np.maximum(_noise(curves, np.zeros((1, 1, 1, 1)), 0).at(mean), 1e-300))
    unit = (x / scale[:, None, :])[flat].reshape(-1, PATCH, PATCH, x.shape[-1])
    size = (PATCH + LAGS,) * 2
    spectrum = np.fft.rfft2(unit, size, axes=(1, 2))
    products = np.einsum("pyxi,pyxj->yxij", spectrum.conj(), spectrum, optimize=True)
    sums = np.roll(np.fft.irfft2(products, size, axes=(0, 1)), (LAGS, LAGS), (0, 1))
    side = 2 * LAGS + 1
    observed = sums[:side, :side].reshape(side**2, -1)
    A, _ = _lag_system()
    c = np.linalg.solve(A, observed).reshape(side, side, x.shape[-1], x.shape[-1])
    # c_ij(l) = c_ji(-l)
    c = (c + c[::-1, ::-1].swapaxes(2, 3)) / 2
    deviation = np.sqrt(np.maximum(np.diagonal(c[LAGS, LAGS]), 1e-300))
    return c / deviation[:, None] / deviation


def _noise(curves: _Curves, correlation: Float, patches: int) -> Noise:
    from scipy import optimize  # takes long to load

    radiance, variance = curves
    linear = np.empty((2, radiance.shape[1]))
    for c in range(radiance.shape[1]):
        w = 1 / np.maximum(variance[:, c], 1e-300 + 1e-6 * variance[:, c].max())
        basis = np.stack([radiance[:, c], np.ones(len(radiance))], axis=1)
        unit = np.maximum(np.abs(basis).max(axis=0), 1e-300)
        found, _ = optimize.nnls(basis / unit * w[:, None], variance[:, c] * w)
        linear[:, c] = found / unit
    return Noise(
        radiance, variance, linear, correlation, patches, np.full(radiance.shape[1], np.nan)
    )


def _stated(picture: NDArray[np.floating], sigma: NDArray[np.floating]) -> _Curves:
    """Variance against radiance as the pixels' own standard errors state it."""
    channels = picture.shape[2]
    stride = max(1, int(np.sqrt(picture[..., 0].size / 1e6)))
    value, error = (a[::stride, ::stride].reshape(-1, channels) for a in (picture, sigma))
    # where exposures change places the variance jumps: more levels than patches could tell
    levels = 4 * _MOST_LEVELS
    radiance, variance = np.zeros((levels, channels)), np.zeros((levels, channels))
    for c in range(channels):
        good = np.isfinite(error[:, c]) & (error[:, c] > 0)
        if good.sum() < levels:
            raise UserError(
                "sigma of the plate is unknown nearly everywhere: merge it anew with --sigma"
            )
        order = np.argsort(value[good, c], kind="stable")
        for k, part in enumerate(np.array_split(order, levels)):
            radiance[k, c] = np.mean(value[good, c][part], dtype=float)
            variance[k, c] = np.median(error[good, c][part].astype(float) ** 2)
    return radiance, variance


def _kernel(correlation: Float) -> Float:
    """Kernel (32, 32, C, C) that turns white noise into noise of that correlation."""
    channels = correlation.shape[-1]
    lags = correlation.shape[0] // 2
    c = np.zeros((_KERNEL, _KERNEL, channels, channels))
    c[: 2 * lags + 1, : 2 * lags + 1] = correlation
    # noise n_i = sum_j k_ij * w_j has E n_i(p) n_j(p + l) = ifft(conj(K) K^T)_ij
    S = np.fft.fft2(np.roll(c, (-lags, -lags), (0, 1)), axes=(0, 1)).conj()
    values, vectors = np.linalg.eigh((S + S.conj().swapaxes(2, 3)) / 2)
    root = np.sqrt(np.maximum(values, 0))
    K = np.einsum("yxik,yxk,yxjk->yxij", vectors, root, vectors.conj())
    kernel = np.fft.ifft2(K, axes=(0, 1)).real
    kernel /= np.sqrt((kernel**2).sum(axis=(0, 1, 3)))[:, None]
    return np.roll(kernel, (_KERNEL // 2, _KERNEL // 2), (0, 1))
