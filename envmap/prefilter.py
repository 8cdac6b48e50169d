"""GGX-prefiltered maps for real-time engines: the split sum of Karis 2013.

A level holds P(r) = integral of L(l) K dl / integral of K dl with K = D(h) G2 / (n.v), the lobe
of n = v = r: what a mirror of that roughness shows when it is seen from straight above (Karis
weights with D (n.l) instead, which errs there, too). With F0 A + B of the table it stands for
the reflection's integral. Level i of n has the perceptual roughness i / (n - 1), alpha is its
square. The convolution draws no samples: every cell of the map is counted in each texel, near
ones by themselves and far ones by the branch (Barnes and Hut 1986), so that suns neither
flicker nor fade.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap import convolve_kernel
from chromeball.envmap.irradiance import COLUMNS, ROWS, spread_directions
from chromeball.envmap.lights import Survey, survey
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.resample import warp

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: A branch as wide as this part of its distance, or of the lobe, is taken as a whole.
_OPENING = 0.12
#: Faces in the order of every graphics interface, and s to the right, t down in each of them:
#: ``texture(cube, d)`` with d in world axes returns the light from d.
FACES = (
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, -1, 0)),
)


@dataclass(frozen=True)
class Prefiltered:
    """Levels of growing roughness.

    ``levels``: (6, N, N, 3) float32 of a cube's faces, or (H, W, 3) of a lat-long map, each
    half as large as the one before; ``roughness`` of each, perceptual; ``energy``: the sums
    L dOmega of each over the map's, all channels.
    """

    levels: tuple[Picture, ...]
    roughness: tuple[float, ...]
    energy: tuple[float, ...]


def prefilter_cube(radiance: Picture, size: int = 256, levels: int = 6) -> Prefiltered:
    """Cube maps of a lat-long map (H, W, 3), `size` pixels a side at roughness 0.

    Raises
    ------
    ValueError
        When `size` is not divisible as often as there are levels, or there is but one.
    UserError
        When the map is black, or a pixel is negative or not finite.

    """
    _check(size, levels)
    sky = survey(radiance, ROWS, COLUMNS)
    sides = [size >> i for i in range(levels)]
    first = cube_of(radiance, size)
    rest = [_level(sky, _cube_texels, side, i, levels) for i, side in enumerate(sides) if i]
    return _result(sky, [first, *rest], [cube_solid_angles(side) for side in sides])


def prefilter_latlong(radiance: Picture, width: int = 512, levels: int = 6) -> Prefiltered:
    """As :func:`prefilter_cube`, lat-long maps, `width` pixels across at roughness 0."""
    _check(width // 2, levels)
    sky = survey(radiance, ROWS, COLUMNS)
    widths = [width >> i for i in range(levels)]
    target = LatLong((width, width // 2))
    source = LatLong((radiance.shape[1], radiance.shape[0]))
    first = warp(radiance, source, target).radiance
    rest = [_level(sky, _latlong_texels, w, i, levels) for i, w in enumerate(widths) if i]
    solids = [LatLong((w, w // 2)).solid_angles() for w in widths]
    return _result(sky, [first, *rest], solids)


def _check(size: int, levels: int) -> None:
    if levels < 2 or size < 1 or size % (1 << (levels - 1)):
        raise ValueError(f"{size} pixels cannot be halved for {levels} levels")


def _level(
    sky: Survey, texels: Callable[[int, int], Array], size: int, i: int, levels: int
) -> Picture:
    alpha = (i / (levels - 1)) ** 2
    # so many samples a texel that none of the lobe falls between them
    texel = math.pi / (2 * size) if texels is _cube_texels else 2 * math.pi / size
    cut = int(np.clip(math.ceil(texel / (0.6 * alpha)), 1, 6))
    d = texels(size, cut)
    flat = np.ascontiguousarray(d.reshape(-1, cut * cut, 3))
    found = convolve_kernel.prefilter(sky.cells, flat, alpha, _OPENING)
    return found.reshape(*d.shape[:-2], 3).astype(np.float32)


def _result(sky: Survey, levels: Sequence[Picture], solids: Sequence[Array]) -> Prefiltered:
    total = sky.cells[..., :3].sum()
    count = len(levels)
    return Prefiltered(
        levels=tuple(levels),
        roughness=tuple(i / (count - 1) for i in range(count)),
        energy=tuple(
            float((level * solid[..., None]).sum(dtype=float) / total)
            for level, solid in zip(levels, solids, strict=True)
        ),
    )


# ---- texels


def cube_directions(size: int, cut: int = 1) -> Array:
    """Unit directions of `cut` x `cut` samples of each texel, (6, N, N, cut^2, 3)."""
    at = (np.arange(size * cut) + 0.5) * 2 / (size * cut) - 1
    t, s = np.meshgrid(at, at, indexing="ij")
    d = np.stack(
        [np.array(f, float) + s[..., None] * r + t[..., None] * dn for f, r, dn in _axes()]
    )
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    d = d.reshape(6, size, cut, size, cut, 3).transpose(0, 1, 3, 2, 4, 5)
    return d.reshape(6, size, size, cut * cut, 3)


def _axes() -> list[tuple[Array, Array, Array]]:
    return [(np.array(f, float), np.array(r, float), np.array(d, float)) for f, r, d in FACES]


def cube_solid_angles(size: int) -> Array:
    """Solid angles of a face's texels, (N, N)."""
    edge = np.linspace(-1, 1, size + 1)
    a, b = np.meshgrid(edge, edge)
    corner = np.arctan2(a * b, np.sqrt(a * a + b * b + 1))
    return np.diff(np.diff(corner, axis=0), axis=1)


def _cube_texels(size: int, cut: int) -> Array:
    return cube_directions(size, cut)


def _latlong_texels(width: int, cut: int) -> Array:
    d = LatLong((width * cut, width // 2 * cut)).directions()
    d = d.reshape(width // 2, cut, width, cut, 3).transpose(0, 2, 1, 3, 4)
    return d.reshape(width // 2, width, cut * cut, 3)


def cube_of(radiance: Picture, size: int) -> Picture:
    """A lat-long map as faces (6, size, size, 3), area-correct, the suns' energy kept."""
    from chromeball.envmap.mapping import make_mapping

    cross = make_mapping("cube", (4 * size, 3 * size))
    source = LatLong((radiance.shape[1], radiance.shape[0]))
    found = warp(radiance, source, cross).radiance
    d = cube_directions(size)[..., 0, :]
    pixels = np.rint(cross.pixels_of(d)).astype(int)
    return np.ascontiguousarray(found[pixels[..., 1], pixels[..., 0]])


# ---- the table, and the error of it all


def brdf_table(size: int = 64, samples: int = 1024) -> NDArray[np.float32]:
    """A and B of F0 A + B (Karis 2013), (size, size, 2): rows roughness, columns n.v.

    Texel centres at (k + 1/2) / size. GGX with Smith's height-correlated shadowing; visible
    normals are sampled (Heitz 2018) at the points of an R2 sequence.
    """
    u1, u2 = _r2(samples)
    nv = ((np.arange(size) + 0.5) / size)[:, None]
    table = np.empty((size, size, 2), np.float32)
    for row in range(size):
        table[row] = _scale_and_bias(((row + 0.5) / size) ** 2, nv, u1, u2)
    return table


def _r2(samples: int) -> tuple[Array, Array]:
    """Points of the unit square (Roberts 2018: the plastic number's powers)."""
    k = np.arange(samples, dtype=np.float64) + 0.5
    return np.mod(k * 0.7548776662466927, 1.0), np.mod(k * 0.5698402909980532, 1.0)


def _scale_and_bias(alpha: float, nv: Array, u1: Array, u2: Array) -> Array:
    vx = np.sqrt(1 - nv**2)
    # stretched view (in the x z plane), a point of the projected hemisphere, and back
    sx, sz = alpha * vx, nv
    length = np.hypot(sx, sz)
    sx, sz = sx / length, sz / length
    r, phi = np.sqrt(u1), 2 * math.pi * u2
    t1, t2 = r * np.cos(phi), r * np.sin(phi)
    s = (1 + sz) / 2
    t2 = (1 - s) * np.sqrt(1 - t1**2) + s * t2
    rest = np.sqrt(np.maximum(1 - t1**2 - t2**2, 0))
    # frame about the view: across (y), and across x view
    hx, hy, hz = -sz * t2 + rest * sx, t1, sx * t2 + rest * sz
    hx, hy, hz = alpha * hx, alpha * hy, np.maximum(hz, 0)
    norm = np.sqrt(hx**2 + hy**2 + hz**2)
    hx, hz = hx / norm, hz / norm
    vh = vx * hx + nv * hz
    nl = 2 * vh * hz - nv
    a2 = alpha * alpha
    with np.errstate(invalid="ignore", divide="ignore"):
        lv = np.sqrt(nv**2 * (1 - a2) + a2) / nv
        ll = np.sqrt(nl**2 * (1 - a2) + a2) / nl
        weight = np.where(nl > 0, (1 + lv) / (lv + ll), 0)  # G2 / G1
    fc = (1 - np.clip(vh, 0, 1)) ** 5
    return np.stack([((1 - fc) * weight).mean(axis=1), (fc * weight).mean(axis=1)], axis=-1)


@dataclass(frozen=True)
class SplitSumError:
    """RMS error of the split sum, relative to the mean reflection, with F0 = 0.04 and 1.

    ``angle``: between normal and view, degrees; 0 is n = v = r, where the levels are exact but
    for their own resolution.
    """

    roughness: float
    angle: float
    error: tuple[float, float]


def split_sum_error(
    radiance: Picture,
    roughness: Sequence[float],
    angles: Sequence[float] = (0.0, 45.0, 75.0),
    count: int = 24,
) -> list[SplitSumError]:
    """P(r) (F0 A + B) against the reflection's integral over the map, cell by cell.

    Over `count` normals, each seen from one side at each of the `angles` (degrees).
    """
    sky = survey(radiance, ROWS // 2, COLUMNS // 2)
    n = spread_directions(count)
    side = np.cross(n, np.roll(n, 1, axis=1))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    found: list[SplitSumError] = []
    for rough in roughness:
        alpha = rough**2
        for angle in angles:
            turn = math.radians(angle)
            v = math.cos(turn) * n + math.sin(turn) * side
            r = 2 * math.cos(turn) * n - v
            truth = convolve_kernel.reflected(sky.cells, n, v, alpha)
            seen = convolve_kernel.prefilter(sky.cells, r[:, None, :], alpha, _OPENING)
            u1, u2 = _r2(4096)
            a, b = _scale_and_bias(alpha, np.array([[math.cos(turn)]]), u1, u2)[0]
            errors: list[float] = []
            for f0 in (0.04, 1.0):
                exact = f0 * truth[:, 0] + truth[:, 1] if f0 < 1 else truth.sum(axis=1)
                own = seen * (f0 * a + b)
                errors.append(float(np.sqrt(np.mean((own - exact) ** 2)) / exact.mean()))
            found.append(SplitSumError(rough, angle, (errors[0], errors[1])))
    return found
