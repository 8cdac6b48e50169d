"""Direction <-> pixel of every environment map (seeds.md P14), with exact pixel solid angles.

All maps share one orientation: centre +Z, up +Y, image right -X (OpenEXR's). The mirror ball
alone is a photograph of a reflection, so its image right is +X. Inside, directions are in
camera axes (x right, y down, z forward); ``world_from_camera`` turns them to the world.
Pixel centres are at integers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.kernel import Projection
from chromeball.scene.camera import CUBE_FACES as FACES
from chromeball.scene.camera import FISHEYE_MODELS, WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(6)
_TABLE = 8192  # entries of a radial table: 3e-5 px at a radius of 1800 px
_NODES = 512  # nodes a side of a face of an arbitrary lens's table


@dataclass(frozen=True)
class Mapping(ABC):
    """A picture of the sphere: ``size`` is width and height in pixels."""

    size: tuple[int, int]
    rotation: Array = field(default_factory=lambda: WORLD_FROM_LATLONG.rotation)

    def turned(self, world_from_camera: Array) -> Mapping:
        """The same picture, turned in the world."""
        return replace(self, rotation=np.asarray(world_from_camera, float))

    @abstractmethod
    def project(self, directions: ArrayLike) -> Array:
        """Directions in camera axes to pixels, ``(..., 3) -> (..., 2)``; NaN where unseen."""

    @abstractmethod
    def unproject(self, pixels: ArrayLike) -> Array:
        """Pixels to unit directions in camera axes, ``(..., 2) -> (..., 3)``; NaN outside."""

    @abstractmethod
    def solid_angles(self) -> Array:
        """Exact solid angle of the valid part of each pixel, (H, W) steradians."""

    @cached_property
    @abstractmethod
    def kernel(self) -> Projection:
        """The same mapping for the C++ kernel."""

    def pixels_of(self, world: ArrayLike) -> Array:
        """Directions in world axes to pixels, ``(..., 3) -> (..., 2)``; NaN where unseen."""
        return self.project(np.asarray(world, float) @ self.rotation)

    def directions(self) -> Array:
        """World directions of all pixel centres, (H, W, 3); NaN outside the map."""
        return self.unproject(pixel_grid(self.size)) @ self.rotation.T


def pixel_grid(size: tuple[int, int], offset: float = 0.0, more: int = 0) -> Array:
    """All pixel centres moved by `offset`, ``(H + more, W + more, 2)``, x first."""
    x, y = np.meshgrid(
        np.arange(size[0] + more, dtype=float) + offset,
        np.arange(size[1] + more, dtype=float) + offset,
    )
    return np.stack([x, y], axis=-1)


class LatLong(Mapping):
    """Longitude across, latitude down; a 2:1 panorama."""

    @cached_property
    def _camera(self) -> CameraModel:
        return CameraModel.latlong(self.size)

    @override
    def project(self, directions: ArrayLike) -> Array:
        return self._camera.project(directions)

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        return self._camera.unproject(pixels)

    @override
    def solid_angles(self) -> Array:
        width, height = self.size
        edges = np.linspace(-math.pi / 2, math.pi / 2, height + 1)
        # sin b - sin a without cancellation
        middle, half = (edges[1:] + edges[:-1]) / 2, math.pi / (2 * height)
        row = 2 * np.cos(middle) * math.sin(half) * (2 * math.pi / width)
        return np.repeat(row[:, None], width, axis=1)

    @cached_property
    @override
    def kernel(self) -> Projection:
        return Projection.latlong(*self.size)


class Cube(Mapping):
    """A cube as a horizontal cross, 4:3: +X, +Z, -X, -Z in the middle row, +-Y about +Z."""

    @property
    def face(self) -> int:
        """Pixels a side of a face."""
        return self.size[0] // 4

    @override
    def project(self, directions: ArrayLike) -> Array:
        d = np.asarray(directions, float)
        pixels = np.full((*d.shape[:-1], 2), np.nan)
        best = np.full(d.shape[:-1], -np.inf)
        for forward, right, down, (column, row, _) in FACES:
            w = d @ np.array(forward, float)
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = d @ np.array(right, float) / w, d @ np.array(down, float) / w
            here = (w > best) & (w > 0)
            best = np.where(here, w, best)
            q = np.stack([column + (a + 1) / 2, row + (b + 1) / 2], axis=-1) * self.face - 0.5
            pixels[here] = q[here]
        return pixels

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        q = (np.asarray(pixels, float) + 0.5) / self.face
        d = np.full((*q.shape[:-1], 3), np.nan)
        for forward, right, down, (column, row, _) in FACES:
            a, b = 2 * (q[..., 0] - column) - 1, 2 * (q[..., 1] - row) - 1
            here = (a >= -1) & (a < 1) & (b >= -1) & (b < 1)
            v = np.array(forward) + a[here, None] * np.array(right)
            v = v + b[here, None] * np.array(down)
            d[here] = v / np.linalg.norm(v, axis=-1, keepdims=True)
        return d

    @override
    def solid_angles(self) -> Array:
        n = self.face
        edge = np.linspace(-1, 1, n + 1)
        a, b = np.meshgrid(edge, edge)
        corner = np.arctan2(a * b, np.sqrt(a * a + b * b + 1))
        one = np.diff(np.diff(corner, axis=0), axis=1)
        solid = np.zeros((3 * n, 4 * n))
        for *_, (column, row, _) in FACES:
            solid[row * n : (row + 1) * n, column * n : (column + 1) * n] = one
        return solid

    @cached_property
    @override
    def kernel(self) -> Projection:
        return Projection.cube(*self.size)


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
    def solid_angles(self) -> Array:
        """By Green: Omega = closed integral of (1 - cos theta(min(r, rim))) dphi.

        Large pictures use it at the rim and the centre alone; elsewhere the density
        J + laplace(J) / 24 is exact to the fourth order of the pixel over the focal length.
        """
        xs = np.arange(self.size[0]) - self.centre[0]
        ys = np.arange(self.size[1]) - self.centre[1]
        fx, fy = np.abs(self.focal)
        r2 = (xs / fx)[None, :] ** 2 + (ys / fy)[:, None] ** 2
        pixel = 1 / min(fx, fy)
        exact = r2 < (self.rim + 2 * pixel) ** 2
        solid = np.zeros(r2.shape)
        if exact.sum() > 200_000:
            inner = max(self.rim - 4 * pixel, 0.0) ** 2
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


@dataclass(frozen=True, kw_only=True)
class Lens(Mapping):
    """Any other camera, by its own projection."""

    camera: CameraModel

    @override
    def project(self, directions: ArrayLike) -> Array:
        q = self.camera.project(directions)
        width, height = self.size
        with np.errstate(invalid="ignore"):
            x, y = q[..., 0], q[..., 1]
            seen = (x >= -0.5) & (y >= -0.5) & (x <= width - 0.5) & (y <= height - 0.5)
            # a distortion polynomial folds back far outside: only what round-trips is seen
            back = self.camera.unproject(np.where(seen[..., None], q, 0.0))
            d = np.asarray(directions, float)
            cosine = np.sum(back * d, axis=-1) / np.linalg.norm(d, axis=-1)
        q[~(seen & (cosine > 1 - 1e-6))] = np.nan
        return q

    @override
    def unproject(self, pixels: ArrayLike) -> Array:
        return self.camera.unproject(pixels)

    @override
    def solid_angles(self) -> Array:
        """Of the spherical quadrilaterals between the rays of the pixel corners."""
        d = self._corners()
        a, b, c, e = d[:-1, :-1], d[:-1, 1:], d[1:, 1:], d[1:, :-1]
        solid = np.abs(_triangle(a, b, c)) + np.abs(_triangle(a, c, e))
        return np.where(np.isfinite(solid), solid, 0.0)

    def _corners(self) -> Array:
        return self.camera.unproject(pixel_grid(self.size, -0.5, more=1))

    @cached_property
    @override
    def kernel(self) -> Projection:
        edge = np.linspace(-1, 1, _NODES)
        a, b = np.meshgrid(edge, edge)
        faces = [
            np.array(f) + a[..., None] * np.array(r) + b[..., None] * np.array(d)
            for f, r, d, _ in FACES
        ]
        pixels = self._project_margin(np.stack(faces))
        return Projection.table(
            *self.size,
            _NODES,
            np.ascontiguousarray(pixels, np.float32),
            np.ascontiguousarray(self._corners(), np.float32),
        )

    def _project_margin(self, directions: Array) -> Array:
        """As `project`, with a margin around the picture so that its border interpolates."""
        q = self.camera.project(directions)
        margin = 0.1 * max(self.size)
        with np.errstate(invalid="ignore"):
            near = np.all((q > -margin) & (q < np.array(self.size) + margin), axis=-1)
            back = self.camera.unproject(np.where(near[..., None], q, 0.0))
            unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
            near &= np.sum(back * unit, axis=-1) > 1 - 1e-6
        q[~near] = np.nan
        return q


def _triangle(a: Array, b: Array, c: Array) -> Array:
    """Solid angle of spherical triangles (Van Oosterom and Strackee 1983)."""
    triple = np.sum(a * np.cross(b, c), axis=-1)
    ab, bc, ca = (np.sum(u * v, axis=-1) for u, v in ((a, b), (b, c), (c, a)))
    return 2 * np.arctan2(triple, 1 + ab + bc + ca)


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


def of_camera(camera: CameraModel) -> Mapping:
    """The mapping of a camera; its pose is left out (`turned` gives it one)."""
    if camera.model == "latlong":
        return LatLong(camera.size)
    if camera.model not in FISHEYE_MODELS:
        return Lens(camera.size, camera=camera)
    values = camera.intrinsics
    fx, fy, cx, cy = values[:4] if camera.model == "kb4" else values[[0, 0, 1, 2]]

    def radius(theta: Array) -> Array:
        d = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
        # the sign: at 180 degrees sin theta rounds to either side of zero
        return np.abs(camera.project(d)[..., 0] - cx) / fx

    def angle(r: Array) -> Array:
        d = camera.unproject(np.stack([cx + fx * r, np.full_like(r, cy)], axis=-1))
        theta = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2])
        # rounding at the rim
        return np.where(np.isfinite(theta), theta, camera.max_angle)

    return Radial(
        camera.size,
        focal=(float(fx), float(fy)),
        centre=(float(cx), float(cy)),
        radius=radius,
        angle=angle,
        max_angle=camera.max_angle,
    )


@dataclass(frozen=True)
class Entry:
    """One kind of map: how to make it, and its width over its height."""

    make: Callable[[tuple[int, int]], Mapping]
    aspect: tuple[int, int]


#: Every map that needs its size alone. A fisheye comes from its camera, `of_camera`.
MAPPINGS: dict[str, Entry] = {
    "latlong": Entry(LatLong, (2, 1)),
    "mirror": Entry(mirror, (1, 1)),
    "angular": Entry(angular, (1, 1)),
    "paraboloid": Entry(paraboloid, (1, 1)),
    "cube": Entry(Cube, (4, 3)),
}


def make_mapping(name: str, size: tuple[int, int]) -> Mapping:
    """A named map of that size.

    Raises
    ------
    UserError
        For an unknown name or a size of the wrong shape.

    """
    if name not in MAPPINGS:
        raise UserError(f"unknown mapping {name!r}; one of {', '.join(MAPPINGS)}, fisheye")
    across, down = MAPPINGS[name].aspect
    width, height = size
    if width * down != height * across or width % across or min(size) < 2:
        raise UserError(
            f"{width}x{height} is no {name} map: it must be {across}:{down}"
            + (", a horizontal cross" if name == "cube" else "")
        )
    return MAPPINGS[name].make(size)


def sized(name: str, width: int) -> tuple[int, int]:
    """Width and height of a named map `width` pixels across."""
    if name not in MAPPINGS:
        raise UserError(f"unknown mapping {name!r}; one of {', '.join(MAPPINGS)}, fisheye")
    across, down = MAPPINGS[name].aspect
    return width, width * down // across


def parse_lens(spec: str, size: tuple[int, int]) -> CameraModel:
    """``equisolid:FOV[:cx,cy,radius]``, degrees and pixels, as a fisheye on `size`.

    An empty centre or radius is the picture's own.

    Raises
    ------
    UserError
        When it cannot be read.

    """
    model, _, rest = spec.partition(":")
    fov_text, _, circle_text = rest.partition(":")
    try:
        fov = float(fov_text)
        cx, cy, radius = (
            float(v) if v.strip() else None for v in (circle_text or ",,").split(",")
        )
        if not 0 < fov <= 360 or (radius is not None and not 0 < radius < math.inf):
            raise ValueError
        if (cx is None) != (cy is None):
            raise ValueError
    except ValueError as error:
        raise UserError(
            f"--lens {spec!r}: write MODEL:FOV or MODEL:FOV:cx,cy,radius, e.g. equisolid:186"
        ) from error
    return CameraModel.fisheye(
        model,
        size,
        math.radians(fov),
        centre=None if cx is None or cy is None else (cx, cy),
        radius=radius,
    )
