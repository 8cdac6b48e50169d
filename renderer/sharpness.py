"""How soft a picture is, from its own edges, and synthetic layers made as soft (row A4).

A straight step in focus is seen as a + b Phi(d / s) + g . x, d the distance from the edge and s
the width of all that blurs: lens, the pixels' area, demosaicing, JPEG. The model is fitted to
windows around the strongest gradients (Gauss-Newton, all windows at once; the idea of measuring
on natural edges is van Zwanenberg et al.'s, 2021). Edges of things out of focus, round or
shaded ones are wider or fit badly, never sharper: the lower quartile speaks for the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Float = NDArray[np.float64]

#: half the side of a window, pixels
_HALF = 7
#: windows looked at; edges that must be found
_MOST_WINDOWS, LEAST_EDGES = 2000, 12
#: largest residual of a fit, as a share of the step
_MISFIT = 0.04
#: steps below this share of their mean brightness, and this many noise deviations, are too low
_LEAST_CONTRAST, _LEAST_SNR = 0.2, 15
_WIDTHS = 0.15, 4.0


@dataclass(frozen=True)
class Softness:
    """``width`` (C,): standard deviation of the blur across an edge, pixels; ``edges``: found.

    ``spread``: interquartile range of the edges' widths over their lower quartile.
    """

    width: Float
    edges: int
    spread: float

    def figures(self) -> dict[str, object]:
        """What was measured, for the record."""
        return {"width": self.width, "edges": self.edges, "spread": self.spread}


def measure_softness(picture: NDArray[np.floating]) -> Softness:
    """Softness of a scene-linear picture (H, W, 3), per channel.

    Raises
    ------
    UserError
        Where it shows too few straight edges.

    """
    grey = np.asarray(picture, float) @ LUMINANCE
    centres, angle = _candidates(grey)
    fit = _fit(_windows(grey, centres), angle, np.zeros(len(centres)), np.ones(len(centres)))
    good = fit.good
    if good.sum() < LEAST_EDGES:
        raise UserError(
            f"the plate shows {int(good.sum())} straight edges that tell how soft it is, "
            f"{LEAST_EDGES} are needed: switch look.softness off"
        )
    centres, angle, offset, width = (
        centres[good],
        fit.angle[good],
        fit.offset[good],
        fit.width[good],
    )
    channels = [
        _fit(_windows(np.asarray(picture[..., c], float), centres), angle, offset, width)
        for c in range(picture.shape[2])
    ]
    quartiles = np.percentile(width, [25, 75])
    return Softness(
        # a channel without contrast of its own is taken to be as soft as the luminance
        np.array(
            [
                np.percentile(c.width[c.good], 25)
                if c.good.sum() >= LEAST_EDGES
                else quartiles[0]
                for c in channels
            ]
        ),
        int(good.sum()),
        float((quartiles[1] - quartiles[0]) / quartiles[0]),
    )


def pixel_area(x: Float) -> Float:
    """The edge as a pixel's area sees it: the covered share for an edge x pixels away."""
    return np.clip(x + 0.5, 0, 1)


def softening(width: float, edge: Callable[[Float], Float] = pixel_area) -> Float:
    """Kernel (2 n + 1,) along one axis that makes edges `width` pixels soft.

    `edge` (x): how an edge looks without it, the pixels' area alone unless given. Of all
    kernels without negative parts (which would leave coverages outside 0 .. 1) it is the one
    whose sum of shifted edges is nearest to Phi(x / width); a sampled Gaussian is not, below a
    pixel. A picture that is softer already gets [1].
    """
    from scipy import optimize  # takes long to load

    reach = int(np.ceil(4 * width)) + 1
    x = np.linspace(-reach - 2, reach + 2, 32 * (2 * reach + 4) + 1)
    sides = [edge(x - n) + edge(x + n) if n else edge(x) for n in range(reach + 1)]
    basis = np.stack(sides, axis=1)
    # far rows hold the kernel's sum at 1
    half, _ = optimize.nnls(basis, special.ndtr(x / width))
    kernel = np.concatenate([half[:0:-1], half])
    used = np.flatnonzero(kernel > 1e-6 * kernel.sum())
    kernel = kernel[used[0] : len(kernel) - used[0]]
    return kernel / kernel.sum()


def soften(layer: NDArray[np.floating], kernel: Float) -> NDArray[np.float32]:
    """The layer (H, W) through `kernel` along both axes; its borders are continued."""
    out = np.asarray(layer, float)
    for axis in (0, 1):
        out = ndimage.correlate1d(out, kernel, axis, mode="nearest")
    return out.astype(np.float32)


def _candidates(grey: Float) -> tuple[NDArray[np.intp], Float]:
    """Centres (N, 2), y first, of windows with one strong gradient, and its angle (N,)."""
    gradient: Any = ndimage.gaussian_filter  # its stub knows no order by axis
    gy, gx = (gradient(grey, 1, order) for order in ((1, 0), (0, 1)))
    strength = np.hypot(gx, gy) / np.maximum(ndimage.gaussian_filter(grey, 3), 1e-300)
    inside = np.zeros(grey.shape, bool)
    inside[_HALF:-_HALF, _HALF:-_HALF] = True
    peak = ndimage.maximum_filter(strength, 2 * _HALF + 1)
    at = np.argwhere(inside & (strength == peak) & (strength > 0.05))
    order = np.argsort(-strength[tuple(at.T)], kind="stable")[:_MOST_WINDOWS]
    at = at[order]
    y, x = at.T
    return at, np.arctan2(gy[y, x], gx[y, x])


def _windows(channel: Float, centres: NDArray[np.intp]) -> Float:
    """Windows (N, 225) about the centres."""
    if len(centres) == 0:
        return np.zeros((0, (2 * _HALF + 1) ** 2))
    views = np.lib.stride_tricks.sliding_window_view(channel, (2 * _HALF + 1,) * 2)
    y, x = (centres - _HALF).T
    return views[y, x].reshape(len(centres), -1)


@dataclass(frozen=True)
class _Fit:
    angle: Float
    offset: Float
    width: Float
    good: NDArray[np.bool_]


def _fit(values: Float, angle: Float, offset: Float, width: Float) -> _Fit:
    """Edge models of windows (N, 225) from a start; all unknowns move together."""
    y, x = np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1].reshape(2, -1).astype(float)
    # a disc, so that no angle is favoured
    disc = x * x + y * y <= (_HALF + 0.5) ** 2
    x, y, values = x[disc], y[disc], values[:, disc]
    scale = np.maximum(np.ptp(values, axis=1, keepdims=True), 1e-300)
    z = values / scale
    angle, offset, log_s = angle.copy(), offset.copy(), np.log(width)
    step, residual = np.zeros(len(z)), np.zeros_like(z)
    for _ in range(25):
        cos, sin, s = np.cos(angle)[:, None], np.sin(angle)[:, None], np.exp(log_s)[:, None]
        d = (x * cos + y * sin - offset[:, None]) / s
        Phi = special.ndtr(d)
        one = np.ones_like(d)
        linear = np.stack([one, Phi, x * one, y * one], axis=2)
        # linear unknowns first, solved exactly, then a step of all (variable projection's
        # spirit with a plain Gauss-Newton matrix)
        c = _least_squares(linear, z)
        residual = z - np.einsum("npk,nk->np", linear, c)
        step = c[:, 1]
        phi = step[:, None] * np.exp(-d * d / 2) / np.sqrt(2 * np.pi)
        moves = np.stack([phi * (y * cos - x * sin) / s, -phi / s, -phi * d], axis=2)
        delta = _least_squares(np.concatenate([linear, moves], axis=2), residual)[:, 4:]
        delta = np.clip(delta, -0.3, 0.3)
        angle, offset = angle + delta[:, 0], np.clip(offset + delta[:, 1], -_HALF, _HALF)
        log_s = np.clip(log_s + delta[:, 2], np.log(_WIDTHS[0]), np.log(_WIDTHS[1]))
    rms = np.sqrt((residual**2).mean(axis=1))
    mean = np.abs(z.mean(axis=1))
    s = np.exp(log_s)
    good = (
        (rms < _MISFIT * step)
        & (step > _LEAST_CONTRAST * mean)
        & (step > _LEAST_SNR * rms)
        & (np.abs(offset) < 2)
        & (s > _WIDTHS[0] * 1.01)
        & (s < _WIDTHS[1] * 0.75)
    )
    return _Fit(angle, offset, s, good)


def _least_squares(J: Float, r: Float) -> Float:
    """Solutions (N, K) of J c = r, a little damped."""
    normal = np.einsum("npk,npl->nkl", J, J, optimize=True)
    normal += 1e-9 * np.einsum("nkk->n", normal)[:, None, None] * np.eye(J.shape[2])
    return np.linalg.solve(normal, np.einsum("npk,np->nk", J, r)[..., None])[..., 0]
