"""Exposure of each frame and the lens's fall-off, from where frames overlap (seeds.md F1s).

ln L_i(p) = ln L(p) + e_i + ln(1 + c1 r^2 + c2 r^4 + c3 r^6), r = 1 at the picture's corner or
the rim of its circle; differences between frames are rid of L(p) (after Goldman 2010).
Gauss-Newton. Weights follow local contrast, what moved or gleams is voted down. The mean of all
e_i stays zero: the panorama keeps its exposure.

Of photographs whose response is not given it is an unknown as well: sum_k h_k phi_k(L_i t_i) is
added to ln L_i, with phi_k by which real cameras differ from sRGB (Grossberg and Nayar 2004)
and t_i the frame's exposure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import Radial, of_camera
from chromeball.envmap.stitch.frames import Frame
from chromeball.hdr.prior import known_cameras
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import srgb_decode
from chromeball.scene.vignette import Edge, Vignette, log_slopes, polynomial

type Array = NDArray[np.float64]

#: Directions that frames are compared in, and the width of the pictures that are compared.
DIRECTIONS, SMALL = 30_000, 320
#: Where the curve is assumed (sRGB), all samples of an overlap share an error of this ln, and
#: exposures told by metadata are trusted to as much.
CURVE = 0.1
FEW = 200  # samples of an overlap that tell half as much as many
#: Prior standard deviations of e_i, of the c_k, and the relative noise of a sample.
EXPOSURE, FALLOFF, NOISE = 1.0, 1.0, 0.002
#: Terms of the fall-off, and of the response where it is unknown.
TERMS, CURVES = 3, 5
#: ln sRGB at its codes but the first, on which response's terms are given.
LEVELS = np.log(srgb_decode(np.arange(1, 256) / 255))
#: Weights of R, G and B in what is compared.
GREY = np.array([0.25, 0.5, 0.25])
LEAST = 30  # samples below which nothing is solved


@dataclass(frozen=True)
class Photometric:
    """``exposure`` (N, 3): ln of what each frame is brighter than the panorama, per channel.

    ``falloff`` (TERMS,): c1, c2, ... of 1 + c1 r^2 + c2 r^4 + ..., as `envmap probe` takes it.
    ``exposure_sigma`` (N,) are standard errors, ``falloff_covariance`` (TERMS, TERMS), and
    ``covered`` the r that the overlaps reach; ``curve`` (255,): ln of
    the camera's response over sRGB at LEVELS, zeros where the response is known; ``scatter``
    the robust relative scatter of overlaps before and after; ``left`` (N,): median by which
    each frame still differs from its neighbours, relative; ``samples`` how many comparisons;
    ``applied``: what was found is more than its error.
    """

    exposure: Array
    falloff: Array
    exposure_sigma: Array
    falloff_covariance: Array
    curve: Array
    scatter: tuple[float, float]
    left: Array
    samples: int
    applied: bool
    covered: float = 1.0

    @property
    def falloff_sigma(self) -> Array:
        """Standard errors of the fall-off, (TERMS,)."""
        return np.sqrt(np.maximum(np.diag(self.falloff_covariance), 0))

    @property
    def falloff_told(self) -> bool:
        """Whether the fall-off by itself is more than its error."""
        return self.applied and _tells(self.falloff, self.falloff_covariance)

    def vignette(self, camera: CameraModel) -> Vignette:
        """The fall-off of the lens, for pictures of other sessions."""
        centre, reach, circle = optics(camera)
        known = Vignette.of(
            self.falloff.tolist(), camera.size, centre, reach, self.falloff_covariance
        )
        edge = Edge(centre, reach) if circle else None
        return replace(known, covered=self.covered, edge=edge, source="overlap")

    def corrected(self, frame: Frame, index: int, camera: CameraModel) -> Frame:
        """Frame number `index` with its light on the panorama's scale."""
        if not self.applied:
            return frame
        width, height = camera.size
        x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        r2 = radius2(camera, np.stack([x, y], axis=-1))
        fall = polynomial(r2, self.falloff)
        gain = (np.exp(-self.exposure[index]) / fall[..., None]).astype(np.float32)
        if frame.assumed and self.curve.any():
            level = np.log(np.maximum(frame.radiance * frame.gathered, 1e-9))
            gain *= np.exp(np.interp(level, LEVELS, self.curve)).astype(np.float32)
        sigma = None if frame.sigma is None else frame.sigma * gain
        return replace(frame, radiance=frame.radiance * gain, sigma=sigma)


def unchanged(count: int) -> Photometric:
    """Frames that are taken as they are."""
    terms, frames = np.zeros(TERMS), np.zeros(count)
    return Photometric(
        exposure=np.zeros((count, 3)),
        falloff=terms,
        exposure_sigma=frames,
        falloff_covariance=np.zeros((TERMS, TERMS)),
        curve=np.zeros(len(LEVELS)),
        scatter=(0.0, 0.0),
        left=frames,
        samples=0,
        applied=False,
    )


def optics(camera: CameraModel) -> tuple[tuple[float, float], float, bool]:
    """Where r is 0, the pixels to where it is 1, and whether that is the rim of a circle."""
    mapping = of_camera(camera)
    width, height = camera.size
    reach = math.hypot(width, height) / 2
    if isinstance(mapping, Radial):
        rim = abs(mapping.focal[0]) * mapping.rim
        return mapping.centre, min(reach, rim), rim < reach
    return ((width - 1) / 2, (height - 1) / 2), reach, False


def radius2(camera: CameraModel, pixels: Array) -> Array:
    """r^2 of `pixels` (..., 2), 1 at the corner of the picture or the rim of its circle."""
    middle, reach, _ = optics(camera)
    return np.minimum((((pixels - middle) / reach) ** 2).sum(axis=-1), 1.0)


def solve(
    frames: Sequence[Frame],
    camera: CameraModel,
    rotations: Array,
    *,
    white_balance: bool = False,
    exposure: bool = True,
    falloff: bool = True,
) -> Photometric:
    """Exposures, fall-off and, where it is unknown, response that make frames agree.

    `rotations` (N, 3, 3) are world_from_camera. With `white_balance` the channels have
    exposures of their own.
    """
    count = len(frames)
    log, weight, r2 = _samples(frames, camera, rotations)
    seen = weight > 0
    first, second, where = [], [], []
    for i in range(count):
        for j in range(i + 1, count):
            both = np.flatnonzero(seen[i] & seen[j])
            first.append(np.full(len(both), i))
            second.append(np.full(len(both), j))
            where.append(both)
    a, b, p = (np.concatenate(v) if v else np.zeros(0, np.intp) for v in (first, second, where))
    if len(p) < LEAST or not (exposure or falloff):
        return unchanged(count)
    grey = log @ GREY
    ra, rb = r2[a, p], r2[b, p]
    sigma2 = 1 / weight[a, p] + 1 / weight[b, p]
    told_by_camera = all("metadata" in frame.source for frame in frames)
    assumed = any(frame.assumed for frame in frames)
    trust = CURVE if told_by_camera else EXPOSURE
    phi = _deviations() if assumed else np.zeros((0, len(LEVELS)))
    exposed = np.array([math.log(f.gathered) if f.assumed else np.nan for f in frames])
    bent = _compared(phi, log, exposed, a, p) - _compared(phi, log, exposed, b, p)
    shared = TERMS + len(phi)
    columns = count + shared
    prior = np.r_[
        np.full(count, 1 / trust**2 if exposure else 1e12),
        np.full(TERMS, 1 / FALLOFF**2 if falloff else 1e12),
        np.ones(len(phi)),
    ]

    def normal(w: Array, y: Array, powers: Array) -> tuple[Array, Array]:
        matrix = np.diag(prior)
        right = np.zeros(columns)
        pair = np.zeros((count, count))
        np.add.at(pair, (a, b), w)
        pair += pair.T
        matrix[:count, :count] += np.diag(pair.sum(axis=1)) - pair
        wp = w[:, None] * powers
        for sign, index in ((1.0, a), (-1.0, b)):
            cross = np.stack(
                [np.bincount(index, wp[:, k], count) for k in range(shared)], axis=-1
            )
            matrix[:count, count:] += sign * cross
            matrix[count:, :count] += sign * cross.T
            right[:count] += sign * np.bincount(index, w * y, count)
        matrix[count:, count:] += wp.T @ powers
        right[count:] = wp.T @ y
        return matrix, right

    def model(x: Array) -> tuple[Array, Array]:
        """Differences that unknowns explain, and their slopes by the c_k and h_k."""
        c, h = np.split(x[count:], [TERMS])
        (va, sa), (vb, sb) = log_slopes(ra, c), log_slopes(rb, c)
        said = x[a] - x[b] + np.log(va / vb) - bent @ h
        return said, np.concatenate([sa - sb, -bent], axis=1)

    y = grey[a, p] - grey[b, p]
    x, scale, matrix = np.zeros(columns), 0.0, np.eye(columns)
    powers = np.zeros((len(p), shared))
    for _ in range(30):
        said, powers = model(x)
        t = (y - said) / np.sqrt(sigma2)
        scale = 1.4826 * float(np.median(np.abs(t)))
        w = 1 / (1 + (t / max(2 * scale, 1e-9)) ** 2) ** 2 / sigma2
        if assumed:
            # many samples of one overlap know no more than the curve, and none is wrong
            w = 1 / np.maximum(np.abs(t) / max(1.5 * scale, 1e-9), 1)
            pair = a * count + b
            number = np.bincount(pair)[pair]
            w *= number / (number + FEW) / (np.bincount(pair, w)[pair] * CURVE**2)
        matrix, right = normal(w, y - said, powers)
        step = np.linalg.solve(matrix, right - prior * x)
        # a fall-off that is not positive, or a response that does not rise, is a step too far
        while not _possible(x[count:] + step[count:], phi):
            step = step / 2
        x = x + step
        if float(np.abs(step).max()) < 1e-9:
            break
    covariance = np.linalg.inv(matrix)
    if not assumed:
        covariance *= max(scale, 1e-9) ** 2
    # exposures against their mean, which the frames leave open
    mean = np.eye(columns)
    mean[:count, :count] -= 1 / count
    covariance = mean @ covariance @ mean.T
    error = np.sqrt(np.maximum(np.diag(covariance), 0))
    channels = np.repeat(x[:count, None], 3, axis=1)
    if white_balance and exposure:
        w = 1 / sigma2
        for c in range(3):
            off = log[a, p, c] - log[b, p, c] - model(x)[0]
            spread = max(1.4826 * float(np.median(np.abs(off))), 1e-9)
            matrix, right = normal(w / (1 + (off / spread / 2) ** 2) ** 2, off, powers)
            channels[:, c] += np.linalg.solve(matrix[:count, :count], right[:count])
    channels -= channels.mean(axis=0)
    fitted = y - model(x)[0]
    before = 1.4826 * float(np.median(np.abs(y)))
    e = x[:count] - x[:count].mean()
    fall, h = np.split(x[count:], [TERMS])
    told = bool(
        (np.abs(e) > 3 * error[:count]).any() or _tells(x[count:], covariance[count:, count:])
    )
    told |= white_balance
    return Photometric(
        exposure=channels if told else np.zeros((count, 3)),
        falloff=fall if told else np.zeros(TERMS),
        exposure_sigma=error[:count],
        falloff_covariance=covariance[count : count + TERMS, count : count + TERMS],
        curve=h @ phi if told else np.zeros(len(LEVELS)),
        scatter=(before, 1.4826 * float(np.median(np.abs(fitted)))),
        left=_left(fitted if told else y, a, b, count),
        samples=len(p),
        applied=told,
        covered=float(np.sqrt(np.quantile(np.concatenate([ra, rb]), 0.99))),
    )


def _deviations() -> Array:
    """Phi (CURVES, 255): how far real responses are from sRGB, ln exposure at its codes."""
    cameras = known_cameras()
    srgb = LEVELS - LEVELS[127]  # zero at code 128
    return np.vstack([cameras.mean[1:] - srgb, cameras.components[: CURVES - 1, 1:]])


def _compared(
    phi: Array, log: Array, exposed: Array, frame: NDArray[np.intp], place: NDArray[np.intp]
) -> Array:
    """Phi (S, CURVES) of samples of frames, none for those whose response is known."""
    level = log[frame, place] + np.nan_to_num(exposed)[frame, None]
    values = [np.interp(level, LEVELS, one) @ GREY for one in phi]
    table = np.stack(values, axis=-1) if values else np.zeros((len(frame), 0))
    return np.where(np.isnan(exposed)[frame, None], 0, table)


def _possible(shared: Array, phi: Array) -> bool:
    """Whether the fall-off is positive and the response rises."""
    c, h = np.split(shared, [TERMS])
    rises = bool((np.diff(LEVELS + h @ phi) > 0).all())
    return rises and float(polynomial(np.linspace(0, 1, 65), c).min()) >= 0.02


def _left(differences: Array, a: NDArray[np.intp], b: NDArray[np.intp], count: int) -> Array:
    """Median of |differences| of each frame, (N,); 0 for one without overlaps."""
    both, size = np.concatenate([a, b]), np.tile(np.abs(differences), 2)
    return np.array(
        [np.median(size[both == k]) if (both == k).any() else 0.0 for k in range(count)]
    )


def _tells(values: Array, covariance: Array) -> bool:
    """Whether values are more than their errors: a chi-square over 25."""
    return bool(values @ np.linalg.pinv(covariance) @ values > 25)


def _samples(
    frames: Sequence[Frame], camera: CameraModel, rotations: Array
) -> tuple[Array, Array, Array]:
    """Log radiance (N, P, 3), weights (N, P) and r^2 (N, P) in directions over the sphere."""
    import cv2

    k = np.arange(DIRECTIONS) + 0.5
    z, turn = 1 - 2 * k / DIRECTIONS, k * np.pi * (1 + 5**0.5)  # Fibonacci's lattice
    flat = np.sqrt(1 - z * z)
    world = np.stack([flat * np.cos(turn), z, flat * np.sin(turn)], axis=-1)
    mapping = of_camera(camera)
    width, height = camera.size
    step = max(1, round(max(width, height) / SMALL))
    size = (max(1, width // step), max(1, height // step))
    shape = (len(frames), DIRECTIONS)
    log, weight, r2 = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
    circle = mapping.solid_angles() > 0
    scale = np.array([size[0] / width, size[1] / height])
    for i, frame in enumerate(frames):
        # only what is seen whole, not clipped and not dark counts
        usable = circle & (frame.radiance.min(axis=2) > 0)
        if frame.valid is not None:
            usable &= frame.valid
        if frame.clipped is not None:
            usable &= ~frame.clipped
        whole = cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        small = cv2.resize(frame.radiance, size, interpolation=cv2.INTER_AREA)
        floor = 0.02 * float(np.median(small[whole > 0.999])) if (whole > 0.999).any() else 0.0
        small = np.log(np.maximum(small, max(floor, 1e-30)))
        whole[small.min(axis=2) <= np.log(max(floor, 1e-30)) + 1e-6] = 0
        grey = small.mean(axis=2)
        contrast = np.hypot(
            cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)
        )
        contrast = cv2.dilate(contrast / 8, np.ones((3, 3), np.uint8))
        whole = cv2.erode(whole, np.ones((3, 3), np.uint8), borderValue=0.0)
        q = mapping.turned(rotations[i]).pixels_of(world)
        inside = np.isfinite(q).all(axis=1)
        q = np.where(inside[:, None], q, -10.0)
        at = ((q + 0.5) * scale - 0.5).astype(np.float32)[None]
        maps = at[..., 0], at[..., 1]
        log[i] = cv2.remap(small, *maps, cv2.INTER_LINEAR)[0]
        noise = NOISE**2 + (0.2 * cv2.remap(contrast, *maps, cv2.INTER_LINEAR)[0]) ** 2
        seen = cv2.remap(whole, *maps, cv2.INTER_LINEAR, borderValue=0.0)[0] > 0.999
        weight[i] = np.where(seen & inside, 1 / noise, 0.0)
        r2[i] = radius2(camera, q)
    return log, weight, r2
