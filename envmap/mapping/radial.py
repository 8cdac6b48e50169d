"""Discs and fisheyes: the radius in the picture depends on the angle to the axis alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import override

import numpy as np
from numpy.typing import ArrayLike

from chromeball.envmap.kernel import Projection
from chromeball.envmap.mapping.base import Array, Mapping, Pattern, each_its_own, mirrored
from chromeball.scene.errors import UserError

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(6)
_TABLE = 8192  # entries of a radial table: 3e-5 px at a radius of 1800 px
_MANY = 5_000  # pixels from which on a smooth density stands for most


@dataclass(frozen=True, kw_only=True)
class Radial(Mapping):
    """``pixel = centre + (fx, fy) r(theta) (cos phi, sin phi)``: discs and fisheyes.

    ``radius`` and ``angle`` are r(theta) and its inverse for theta in 0 .. ``max_angle``.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    radius: Callable[[Array], Array]
    angle: Callable[[Array], Array]
    max_angle: float

    @cached_property
    def rim(self) -> float:
        """r(max_angle)."""
        return float(self.radius(np.array([self.max_angle]))[0])

    @override
    def project(self, directions: ArrayLike) -> Array:
        d = np.asarray(directions, float)
        rho = np.hypot(d[..., 0], d[..., 1])
        theta = np.arctan2(rho, d[..., 2])
        seen = theta <= self.max_angle * (1 + 1e-9)
        r = self.radius(np.where(seen, np.minimum(theta, self.max_angle), 0.0))
        scale = np.where(rho > 0, r / np.where(rho > 0, rho, 1), 0.0)
        q = d[..., :2] * scale[..., None] * self.focal + self.centre
        q[~seen] = np.nan
        return q

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        xy = (np.asarray(pixels, float) - self.centre) / self.focal
        r = np.hypot(xy[..., 0], xy[..., 1])
        seen = r <= self.rim * (1 + 1e-9)
        theta = self.angle(np.where(seen, np.minimum(r, self.rim), 0.0))
        scale = np.where(r > 0, np.sin(theta) / np.where(r > 0, r, 1), 0.0)
        d = np.concatenate([xy * scale[..., None], np.cos(theta)[..., None]], axis=-1)
        d[~seen] = np.nan
        return d

    @override
    def pattern(self) -> Pattern:
        middle = ((self.size[0] - 1) / 2, (self.size[1] - 1) / 2)
        if self.centre != middle:
            xs, ys = (
                np.arange(n, dtype=float) - c
                for n, c in zip(self.size, self.centre, strict=True)
            )
            return each_its_own(self._solid_angles(xs, ys))
        xs, ys = (np.arange((n + 1) // 2, dtype=float) + (n + 1) % 2 / 2 for n in self.size)
        return mirrored(self._solid_angles(xs, ys), self.size)

    def _solid_angles(self, xs: Array, ys: Array) -> Array:
        """Of pixels at these distances from the centre, (len(ys), len(xs)).

        By Green: Omega = closed integral of (1 - cos theta(min(r, rim))) dphi.

        Large pictures use it at the rim and the centre alone; elsewhere the density
        J + laplace(J) / 24 is exact to the fourth order of the pixel over the focal length.
        """
        fx, fy = np.abs(self.focal)
        r2 = (xs / fx)[None, :] ** 2 + (ys / fy)[:, None] ** 2
        pixel = 1 / min(fx, fy)
        exact = r2 < (self.rim + 2 * pixel) ** 2
        solid = np.zeros(r2.shape)
        if exact.sum() > _MANY:
            inner = max(self.rim - 8 * pixel, 0.0) ** 2
            smooth = (r2 < inner) & (r2 > (8 * pixel) ** 2)
            table = np.linspace(0, self.rim**2, _TABLE)
            solid[smooth] = np.interp(r2[smooth], table, self._mean_density(np.sqrt(table)))
            exact &= ~smooth
        j, i = np.nonzero(exact)
        x0, x1 = (xs[i] - 0.5) / fx, (xs[i] + 0.5) / fx
        y0, y1 = (ys[j] - 0.5) / fy, (ys[j] + 0.5) / fy
        # dphi = (x dy - y dx) / r^2 around the pixel
        around = self._edge(x0, x1, y1) - self._edge(x0, x1, y0)
        around += self._edge(y0, y1, x1) - self._edge(y0, y1, x0)
        solid[j, i] = np.maximum(around, 0.0)
        return solid

    def _mean_density(self, r: Array) -> Array:
        """Solid angle of a pixel at radius r, by differences of 1 - cos theta(r)."""
        fx, fy = np.abs(self.focal)
        h = 1 / math.sqrt(fx * fy)
        r = np.clip(r, 2 * h, self.rim - 2 * h)
        edges = np.stack([r + k * h for k in (-1.5, -0.5, 0.5, 1.5)])
        cap = 2 * np.sin(self.angle(edges) / 2) ** 2
        density = np.diff(cap, axis=0) / (h * (edges[1:] + edges[:-1]) / 2)  # mean over a ring
        low, middle, high = density
        # a ring's mean has J'' + 2 J' / r where a square's has J'' + J' / r
        return h * h * (middle - (high - low) / (2 * h) / r * h * h / 24)

    def _edge(self, t0: Array, t1: Array, s: Array) -> Array:
        """Integral of s (1 - cos theta) / r^2 dt from t0 to t1 along the line at s."""
        limit = 2 * math.sin(self.max_angle / 2) ** 2
        half_chord = np.sqrt(np.maximum(self.rim**2 - s**2, 0.0))
        crossing = np.minimum(t1, half_chord) > np.maximum(t0, -half_chord)
        a = np.where(crossing, np.maximum(t0, -half_chord), t0)
        b = np.where(crossing, np.minimum(t1, half_chord), t0)
        # beyond the rim 1 - cos theta is constant, and the integral is an angle
        total = limit * (_swept(t0, a, s) + _swept(b, t1, s))
        for node, weight in zip(_GAUSS_NODES, _GAUSS_WEIGHTS, strict=True):
            r2 = ((a + b) / 2 + (b - a) / 2 * node) ** 2 + s**2
            cap = 2 * np.sin(self.angle(np.minimum(np.sqrt(r2), self.rim)) / 2) ** 2
            total += weight * (b - a) / 2 * s * cap / np.where(r2 > 0, r2, 1.0)
        return total

    @cached_property
    @override
    def kernel(self) -> Projection:
        theta = np.linspace(0, self.max_angle, _TABLE)
        u = np.linspace(0, 1, _TABLE)
        r = self.rim * (1 - (1 - u) ** 2)
        angle = self.angle(r)
        # dOmega / (r dr dphi) = d(1 - cos theta) / d(r^2 / 2), by differences across a step
        step = 0.5 / _TABLE
        low, high = np.maximum(u - step, 0.0), np.minimum(u + step, 1.0)
        r0, r1 = (self.rim * (1 - (1 - v) ** 2) for v in (low, high))
        t0, t1 = self.angle(r0), self.angle(r1)
        cap = 2 * np.sin((t0 + t1) / 2) * np.sin((t1 - t0) / 2)
        density = cap / ((r1 - r0) * (r1 + r0) / 2)
        tables = (self.radius(theta), angle, density)
        return Projection.radial(
            *self.size,
            *self.focal,
            *self.centre,
            self.max_angle,
            self.rim,
            *(np.ascontiguousarray(table, np.float32) for table in tables),
        )


def _swept(t0: Array, t1: Array, s: Array) -> Array:
    """Integral of s / (t^2 + s^2) from t0 to t1."""
    return np.arctan2(s * (t1 - t0), s * s + t0 * t1)


def _disc(
    size: tuple[int, int],
    radius: Callable[[Array], Array],
    angle: Callable[[Array], Array],
    max_angle: float,
    mirrored: bool = False,
) -> Radial:
    """A disc inscribed in a square picture, r = 1 at its rim."""
    f = size[0] / 2
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    focal = (-f if mirrored else f, f)
    return Radial(
        size, focal=focal, centre=centre, radius=radius, angle=angle, max_angle=max_angle
    )


def mirror(size: tuple[int, int]) -> Radial:
    """An orthographic photograph of a mirror ball: s = x / sqrt(2 (z + 1)), |s| = sin(t/2)."""
    return _disc(size, lambda t: np.sin(t / 2), lambda r: 2 * np.arcsin(r), math.pi, True)


def angular(size: tuple[int, int]) -> Radial:
    """Debevec's light probe: s = x r, r = arccos(z) / (pi sqrt(x^2 + y^2))."""
    return _disc(size, lambda t: t / math.pi, lambda r: r * math.pi, math.pi)


def paraboloid(size: tuple[int, int]) -> Radial:
    """Heidrich and Seidel's paraboloid, one hemisphere: s = x / (1 + z), |s| = tan(t/2)."""
    return _disc(size, lambda t: np.tan(t / 2), lambda r: 2 * np.arctan(r), math.pi / 2)


def mirror_ball(size: tuple[int, int], distance: float) -> Radial:
    """A perspective photograph of a mirror ball in the picture's middle, cropped to it.

    `distance` from the camera to the ball's centre is in ball radii. A ray at the angle alpha
    to the axis meets the ball's normal at i, sin i = distance sin alpha, and leaves at
    theta = 2 i - alpha. What lies within asin(1 / distance) of the point behind the ball is
    not seen. The map is that of light from far away; `distance` inf is :func:`mirror`.

    Raises
    ------
    UserError
        When the camera is not outside the ball.

    """
    if not distance > 1:
        raise UserError(
            f"a ball {distance:g} radii away: the camera must be outside of it, more than 1"
        )
    if math.isinf(distance):
        return mirror(size)
    rim = math.asin(1 / distance)

    def radius(theta: Array) -> Array:
        incident = np.asarray(np.asarray(theta, float) / 2)
        # theta(i) is convex below its end: Newton's steps are monotonous, slope >= 1
        for _ in range(60):
            sine = np.sin(incident) / distance
            slope = 2 - np.cos(incident) / (distance * np.sqrt(1 - sine * sine))
            step = (2 * incident - np.arcsin(sine) - theta) / slope
            incident = np.asarray(np.clip(incident - step, 0, math.pi / 2))
            if np.abs(step).max(initial=0.0) < 1e-15:
                break
        return np.asarray(np.tan(np.arcsin(np.sin(incident) / distance)) / math.tan(rim))

    def angle(r: Array) -> Array:
        alpha = np.arctan(np.asarray(r, float) * math.tan(rim))
        return np.asarray(2 * np.arcsin(np.minimum(distance * np.sin(alpha), 1)) - alpha)

    return _disc(size, radius, angle, math.pi - rim, mirrored=True)


def ball_distance(focal: float, radius: float) -> float:
    """Distance to a ball's centre in ball radii: it appears `radius` px large, focal in px."""
    return 1 / math.sin(math.atan(radius / focal))
