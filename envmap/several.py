"""Light at a point from probes at known places (seeds.md P21, F16).

Each probe's map lies on the set's stand-in geometry. A ray from the point meets the set at q; q
is looked up in every probe that sees it, in the direction from that probe's place: parallax is
right wherever the geometry is. Probes are weighted as textures of a lumigraph (Buehler,
Bosse, McMillan, Gortler, Cohen 2001): by how finely they show q, and by how near the angle is
under which they see it. What the best probe does not see comes from the next; what none sees is
completed from its neighbourhood and marked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.mapping import LatLong
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
#: Rays, origins (N, 3) and unit directions (N, 3), to distances (N,), infinite where nothing
#: is met, and unit normals (N, 3) on the ray's side.
type Cast = Callable[[Array, Array], tuple[Array, Array]]

#: A surface this much nearer than a point, relatively, hides it.
_NEARER = 1e-3
#: Probes nearer to each other than this are at one place, metres.
_APART = 1e-3
#: Angles smaller than this are as good as none, radians.
_SAME = 0.05
#: Less of the sphere than this is nothing.
_SOMETHING = 1e-3
#: Rays that are followed at a time.
_RAYS = 1 << 19


@dataclass(frozen=True)
class ProbeMap:
    """A lat-long map ``radiance`` (H, W, 3) in the world's axes, taken at ``origin`` (3,).

    ``seen`` (H, W), where it was not completed; None for everywhere.
    """

    radiance: Picture
    origin: Array
    seen: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class LightAt:
    """The light at a point.

    ``radiance`` (h, w, 3); ``seen`` (h, w), the part of the pixel that some probe saw, the rest
    of it is completed; ``probe`` (h, w), which one counts most, -1 where none saw anything;
    ``shares`` (P,) of the sphere that come from each probe; ``lone``: the share that probe 0
    does not see and another does.
    """

    radiance: Picture
    seen: Picture
    probe: NDArray[np.int16]
    shares: Array
    lone: float

    @property
    def unseen(self) -> float:
        """The share of the sphere that no probe saw."""
        return 1 - float(self.shares.sum())


def light_at(
    probes: Sequence[ProbeMap], point: ArrayLike, cast: Cast, width: int, samples: int = 0
) -> LightAt:
    """The lat-long map, `width` across, that a probe at `point` (3,) would show.

    `samples`: rays a side of a pixel; 0: as many as the finest map asks for.

    Raises
    ------
    UserError
        When probes coincide, or none sees anything of what is seen from the point.

    """
    check_apart([probe.origin for probe in probes])
    x = np.asarray(point, float)
    height = width // 2
    finest = max(probe.radiance.shape[1] for probe in probes)
    side = samples or min(8, max(2, math.ceil(finest / width)))
    fine = LatLong((width * side, height * side))
    radiance = np.zeros((height, width, 3))
    seen, best = np.zeros((height, width)), np.full((height, width), -1, np.int16)
    shares, lone = np.zeros(len(probes)), 0.0
    solid = fine.solid_angles()[:, :1]
    sources = [_Source(probe) for probe in probes]
    rows = max(1, _RAYS // (width * side * side))
    for top in range(0, height, rows):
        part = np.s_[top : min(top + rows, height)]
        y, x_ = np.mgrid[part.start * side : part.stop * side, 0 : width * side]
        d = fine.unproject(np.stack([x_, y], -1).reshape(-1, 2)) @ fine.rotation.T
        weights = _weights(x, d, cast, sources)
        values = np.zeros((len(d), 3))
        total = weights.weight.sum(axis=0)
        normal = np.where(total > 0, total, 1)
        for i, source in enumerate(sources):
            at = weights.weight[i] > 0
            share = (weights.weight[i, at] / normal[at])[:, None]
            values[at] += share * source.radiance(weights.directions[i, at])
        omega = np.repeat(solid[part.start * side : part.stop * side], width * side, axis=1)
        flat = omega.ravel()
        shares += (weights.weight / normal) @ flat
        lone += float(flat[(weights.weight[0] == 0) & (total > 0)].sum())
        blocks = (part.stop - part.start, side, width, side)
        there = flat * (total > 0)
        covered = there.reshape(blocks).sum(axis=(1, 3))
        summed = (values * there[:, None]).reshape(*blocks, 3).sum(axis=(1, 3))
        radiance[part] = summed / np.where(covered > 0, covered, 1)[..., None]
        seen[part] = covered / flat.reshape(blocks).sum(axis=(1, 3))
        most = (weights.weight / normal * flat).reshape(len(probes), *blocks).sum(axis=(2, 4))
        best[part] = np.where(covered > 0, most.argmax(axis=0), -1)
    if not float(shares.sum()) > _SOMETHING * 4 * math.pi:
        raise UserError(
            "no probe sees anything of what is seen from that point: does it lie inside a "
            "piece of the stand-in?"
        )
    completed = fill(radiance.astype(np.float32), seen > 0)
    sphere = 4 * math.pi
    return LightAt(completed, seen.astype(np.float32), best, shares / sphere, lone / sphere)


def check_apart(places: Sequence[Array]) -> None:
    """Raise UserError where two places (3,) coincide."""
    for i, a in enumerate(places):
        for j in range(i):
            if np.linalg.norm(a - places[j]) < _APART:
                raise UserError(
                    f"probes {j + 1} and {i + 1} are at one place, {np.round(a, 4).tolist()}: "
                    "merge such shots first, or correct their attribute `origin`"
                )


@dataclass(frozen=True)
class _Weights:
    """Of each probe for each ray: ``weight`` (P, N), ``directions`` (P, N, 3) to look up."""

    weight: Array
    directions: Array


def _weights(x: Array, d: Array, cast: Cast, sources: Sequence[_Source]) -> _Weights:
    origins = np.broadcast_to(x, d.shape)
    t, n = cast(origins, d)
    met = np.isfinite(t)
    q = x + np.where(met, t, 0)[:, None] * d
    weight = np.zeros((len(sources), len(d)))
    towards = np.zeros((len(sources), *d.shape))
    for i, source in enumerate(sources):
        o = source.probe.origin
        v = q - o
        distance = np.linalg.norm(v, axis=1)
        near = met & (distance > 0)
        w = np.where(near[:, None], v / np.where(near, distance, 1)[:, None], d)
        first, _ = cast(np.broadcast_to(o, d.shape), w)
        cosine = -(w * n).sum(axis=1)  # negative: the probe is behind the surface
        there = near & (cosine > 0) & (first > distance * (1 - _NEARER))
        sees = np.where(met, there, np.isinf(first)) & source.sees(w)
        angle = np.arccos(np.clip((w * d).sum(axis=1), -1, 1))
        fine = cosine / np.where(near, distance, 1) ** 2  # solid angle of the surface
        apart = 1 / (float(np.sum((x - o) ** 2)) + _APART**2)
        weight[i] = sees * np.where(met, fine / (angle**2 + _SAME**2), apart)
        towards[i] = w
    return _Weights(weight, towards)


class _Source:
    """A probe's map, looked up bilinearly."""

    def __init__(self, probe: ProbeMap) -> None:
        self.probe = probe
        height, width = probe.radiance.shape[:2]
        self.mapping = LatLong((width, height))
        wide = np.pad(probe.radiance, ((0, 0), (1, 1), (0, 0)), mode="wrap")
        # over a pole lies the row's other half
        top = np.roll(wide[:1, 1:-1], width // 2, axis=1)
        bottom = np.roll(wide[-1:, 1:-1], width // 2, axis=1)
        caps = [np.pad(cap, ((0, 0), (1, 1), (0, 0)), mode="wrap") for cap in (top, bottom)]
        self.padded = np.concatenate([caps[0], wide, caps[1]])

    def sees(self, d: Array) -> NDArray[np.bool_]:
        """Whether the pixels that directions (N, 3) fall into were seen."""
        if self.probe.seen is None:
            return np.ones(len(d), bool)
        width, height = self.mapping.size
        x, y = np.rint(self.mapping.pixels_of(d)).astype(np.intp).T
        return self.probe.seen[np.clip(y, 0, height - 1), x % width]

    def radiance(self, d: Array) -> Array:
        pixels = self.mapping.pixels_of(d) + 1
        low = np.minimum(np.floor(pixels).astype(np.intp), np.array(self.mapping.size))
        u, v = np.moveaxis(pixels - low, -1, 0)
        x, y = low[:, 0], low[:, 1]
        p = self.padded
        upper = p[y, x] * (1 - u)[:, None] + p[y, x + 1] * u[:, None]
        lower = p[y + 1, x] * (1 - u)[:, None] + p[y + 1, x + 1] * u[:, None]
        return upper * (1 - v)[:, None] + lower * v[:, None]


def fill(radiance: Picture, known: NDArray[np.bool_]) -> Picture:
    """A lat-long map (H, W, 3) with what is not `known` (H, W) as the mean of what is near.

    Near grows from pixel to pixel until something known is reached.
    """
    import cv2

    result = radiance.copy()
    if known.all() or not known.any():
        return result
    missing = ~known
    height, width = known.shape
    value, weight = np.where(known[..., None], radiance, 0), known.astype(np.float32)
    sigma = 1.0
    while missing.any():
        pad = min(width, math.ceil(3 * sigma))

        def blurred(picture: Picture, pad: int = pad, sigma: float = sigma) -> Picture:
            around = np.take(picture, range(-pad, width + pad), 1, mode="wrap")
            wide = np.ascontiguousarray(around)
            soft = cv2.GaussianBlur(wide, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            return np.asarray(soft, np.float32)[:, pad : pad + width]

        near = blurred(weight)
        now = missing & (near > (0.05 if sigma < height else 0))
        result[now] = blurred(value)[now] / near[now][:, None]
        missing &= ~now
        sigma *= 1.6
        if sigma > 8 * height:
            result[missing] = radiance[known].mean(axis=0)
            break
    return result
