"""The sun in a map: found and fitted as a disc; restored where every exposure clipped it.

What a map lacks is found from the light that falls on a surface: a light meter's reading, the
ratio of a card lit to the card in shadow, or a matt ball. Only what is missing is added: the
glare around a clipped sun, part of its light, is not counted twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.envmap.irradiance import irradiance
from chromeball.envmap.mapping import LatLong
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]

#: The real one's angular radius, radians (mean over the year).
SUN_RADIUS = math.radians(0.2666)
#: A sun stands this many times above what surrounds it, and is smaller than this, radians.
_ABOVE, _LARGEST = 20.0, math.radians(4)


@dataclass(frozen=True)
class Sun:
    """A disc of even radiance.

    ``direction`` (3,) unit, world, with ``sigma_direction`` (radians); ``angular_radius`` with
    ``sigma_radius``; ``irradiance`` (3,) on a surface that faces it, above the ``background``
    (3,) radiance; ``clipped``: some of it was too bright for every exposure, so that irradiance
    is a lower bound, and the radius an upper one, of the glare.
    """

    direction: Array
    sigma_direction: float
    angular_radius: float
    sigma_radius: float
    irradiance: Array
    background: Array
    clipped: bool

    @property
    def radiance(self) -> Array:
        """Mean over the disc, (3,)."""
        return self.irradiance / (math.pi * math.sin(self.angular_radius) ** 2)


def find_sun(radiance: Picture, clipped: NDArray[np.bool_] | None = None) -> Sun | None:
    """The brightest small light of a lat-long map (H, W, 3), or None where it has none.

    `clipped` (H, W) marks lower bounds. The centre is the centroid of what exceeds a tenth of
    the peak, the radius that of an even disc as concentrated as the light is.
    """
    height, width = radiance.shape[:2]
    mapping = LatLong((width, height))
    y = radiance @ LUMINANCE.astype(np.float32)
    if not float(y.max()) > 0:
        return None
    # what was clipped was brighter than it looks
    marks = clipped
    if marks is not None and not (y[marks] > 0.3 * y.max()).any():
        marks = None
    peaks = y if marks is None else np.where(marks, y, -1)
    top, left = np.unravel_index(int(peaks.argmax()), y.shape)
    d, solid = mapping.directions(), mapping.solid_angles()
    peak = d[top, left]
    near = d @ peak
    pixel = math.pi / height
    reach = max(_LARGEST, 3 * pixel)
    ring = (near < math.cos(1.25 * reach)) & (near > math.cos(2 * reach))
    background = np.median(radiance[ring], axis=0).astype(float)
    dim = float(background @ LUMINANCE)
    # of a clipped one little is left
    above = _ABOVE if marks is None else 1.0
    bright = y > 0.3 * y.max() if marks is None else marks
    if float(y[top, left]) < above * max(dim, 1e-30) or (bright & ring).any():
        return None  # dim, or part of something larger
    inside = near > math.cos(reach)
    excess = np.maximum(radiance[inside] - background, 0).astype(float)
    lum, omega, where = excess @ LUMINANCE, solid[inside], d[inside]
    marked = None if clipped is None else clipped[inside]
    is_clipped = marked is not None and bool(marked.any())
    core = lum > 0.1 * lum.max()
    if is_clipped and marked is not None:
        core = marked
    weight = np.where(core, lum * omega, 0)
    m = weight @ where
    direction = m / np.linalg.norm(m)
    # an even disc of solid angle A has (sum e w)^2 / sum e^2 w = A
    area = float(weight.sum() ** 2 / (weight * np.where(core, lum, 0)).sum())
    if is_clipped:
        area = float(omega[core].sum())
    radius = math.acos(max(1 - area / (2 * math.pi), 0))
    if radius > _LARGEST:
        return None
    parts = float(weight.sum() ** 2 / (weight**2).sum())  # pixels that make the centroid
    close = where @ direction > math.cos(max(3 * radius, 1.5 * pixel))
    e = (excess * (omega * (where @ direction))[:, None])[close].sum(axis=0)
    return Sun(
        direction=direction,
        sigma_direction=pixel / math.sqrt(6 * parts),
        angular_radius=radius,
        sigma_radius=pixel / math.sqrt(12 * parts),
        irradiance=e,
        background=background,
        clipped=is_clipped,
    )


def without_sun(radiance: Picture, sun: Sun) -> Picture:
    """The map with its background where the sun and its near glare were."""
    mapping = LatLong((radiance.shape[1], radiance.shape[0]))
    reach = max(3 * sun.angular_radius, 1.5 * math.pi / radiance.shape[0])
    hidden = mapping.directions() @ sun.direction > math.cos(reach)
    result = radiance.copy()
    result[hidden] = np.minimum(result[hidden], sun.background.astype(np.float32))
    return result


def add_disc(
    radiance: Picture, direction: ArrayLike, radius: float, missing: ArrayLike
) -> Picture:
    """The map and a disc more, which gives `missing` (3,) irradiance facing it, exactly."""
    height, width = radiance.shape[:2]
    mapping = LatLong((width, height))
    axis = np.asarray(direction, float)
    rows, columns = np.nonzero(
        mapping.directions() @ axis > math.cos(radius + 2 * math.pi / height)
    )
    solid = mapping.solid_angles()[rows, columns]
    cut = (np.arange(16) + 0.5) / 16 - 0.5
    share = np.zeros(len(rows))
    facing = np.zeros(len(rows))
    for v in cut:
        for u in cut:
            pixels = np.stack([columns + u, rows + v], axis=1)
            along = mapping.unproject(pixels) @ mapping.rotation.T @ axis
            within = along > math.cos(radius)
            share += within / 256
            facing += within * along / 256
    if not facing.any():  # smaller than the samples
        k = int((mapping.directions()[rows, columns] @ axis).argmax())
        share[k] = facing[k] = 1.0
    scale = np.asarray(missing, float) / float((facing * solid).sum())
    result = radiance.copy()
    result[rows, columns] += (share[:, None] * scale).astype(np.float32)
    return result


@dataclass(frozen=True)
class Restored:
    """A map with its sun.

    ``sun``: as it is now; ``sigma``: relative standard error of its irradiance; ``added`` (3,):
    irradiance facing the sun that the map lacked.
    """

    radiance: Picture
    sun: Sun
    sigma: float
    added: Array


def restore_from_reading(
    radiance: Picture,
    sun: Sun,
    reading: float,
    normal: ArrayLike,
    *,
    accuracy: float = 0.05,
    color: ArrayLike | None = None,
    radius: float = SUN_RADIUS,
) -> Restored:
    """The sun that makes the map's luminous irradiance on `normal` equal to a `reading`.

    The reading is in the map's units (lux for a map in cd/m^2), right to the part `accuracy`;
    `color` (3,) of the sun's light, that of its glare in the map unless given.

    Raises
    ------
    UserError
        When the surface does not face the sun, or the map has as much light as that already.

    """
    n = np.asarray(normal, float) / np.linalg.norm(np.asarray(normal, float))
    own = float(irradiance(radiance, n) @ LUMINANCE)
    tint = _tint(sun, color)
    cosine = _facing(n, sun)
    lack = (reading - own) / cosine
    if lack <= 0:
        raise UserError(
            f"the map gives {own:.5g} on that surface, the reading is {reading:.5g}: there is "
            "no light missing; check the normal, the units and the exposure"
        )
    spread = math.hypot(accuracy * reading / cosine, lack * math.tan(math.acos(cosine)) * 0.01)
    return _restored(radiance, sun, lack * tint, spread, radius)


def restore_from_ratio(
    radiance: Picture,
    sun: Sun,
    ratio: ArrayLike,
    normal: ArrayLike,
    *,
    accuracy: float = 0.05,
    color: ArrayLike | None = None,
    radius: float = SUN_RADIUS,
) -> Restored:
    """The sun that makes a card `ratio` times as bright in the light as in the sun's shadow.

    `ratio`: (3,) of R, G, B, or (1,) of luminance, where `color` (3,) is the sun's, that of its
    glare in the map unless given. In the shadow the card sees the rest of the map.

    Raises
    ------
    UserError
        As :func:`restore_from_reading`, and for a ratio that is not above 1.

    """
    times = np.asarray(ratio, float)
    if not (times > 1).all():
        raise UserError(
            "a card in the sun is brighter than in its shadow: the ratio is above 1"
        )
    n = np.asarray(normal, float) / np.linalg.norm(np.asarray(normal, float))
    cosine = _facing(n, sun)
    shade = irradiance(without_sun(radiance, sun), n)
    lack = (times * shade - irradiance(radiance, n)) / cosine
    if times.size == 1:
        lack = float(lack @ LUMINANCE) * _tint(sun, color)
    if not float(lack @ LUMINANCE) > 0 or lack.min() < 0:
        raise UserError("the map has as much sun as that ratio says: there is no light missing")
    spread = accuracy * float((times * shade) @ LUMINANCE) / cosine
    return _restored(radiance, sun, lack, spread, radius)


def ratio_of_ball(
    radiance: Picture, sun: Sun, normals: ArrayLike, seen: ArrayLike
) -> tuple[Array, Array]:
    """Lit over shadowed irradiance, facing the sun, by a matt ball: (3,) and standard errors.

    `seen` (N, 3) is the ball's radiance where its surface has the `normals` (N, 3): k E_sky(n)
    + k E_sun max(0, n.s), k its reflectance over pi, solved for k and k E_sun by least squares.

    Raises
    ------
    UserError
        When too little of the ball is lit or shadowed to tell the two apart.

    """
    n, values = np.asarray(normals, float), np.asarray(seen, float)
    shade = without_sun(radiance, sun)
    sky, facing = irradiance(shade, n), np.maximum(n @ sun.direction, 0)
    at_sun = irradiance(shade, sun.direction)
    ratio, sigma = np.zeros(3), np.zeros(3)
    for c in range(3):
        a = np.stack([sky[:, c], facing * sky[:, c].mean()], axis=1)
        if np.linalg.cond(a) > 1e3 or len(n) < 10:
            raise UserError("lit and shadowed parts of the ball must both be seen, and in size")
        (k, direct), left, *_ = np.linalg.lstsq(a, values[:, c])
        if not (k > 0 and direct > 0):
            raise UserError("the ball's shading does not fit the sun's direction; is it matt?")
        noise = float(left[0]) / (len(n) - 2) if len(left) else 0.0
        covariance = noise * np.linalg.inv(a.T @ a)
        share = sky[:, c].mean() / at_sun[c]
        ratio[c] = 1 + direct / k * share
        gradient = share * np.array([-direct / k**2, 1 / k])
        sigma[c] = math.sqrt(float(gradient @ covariance @ gradient))
    return ratio, sigma


def _tint(sun: Sun, color: ArrayLike | None) -> Array:
    """The colour of the sun's light, its luminance 1."""
    tint = np.asarray(sun.irradiance if color is None else color, float)
    if not (tint >= 0).all() or not float(tint @ LUMINANCE) > 0:
        raise UserError("the sun's colour must be positive")
    return tint / float(tint @ LUMINANCE)


def _facing(n: Array, sun: Sun) -> float:
    cosine = float(n @ sun.direction)
    if cosine < 0.05:
        raise UserError(
            f"that surface is {math.degrees(math.acos(max(cosine, -1.0))):.0f} degrees away "
            "from the sun: measure on one that it shines on"
        )
    return cosine


def _restored(
    radiance: Picture, sun: Sun, lack: Array, spread: float, radius: float
) -> Restored:
    whole = sun.irradiance + lack
    found = Sun(
        direction=sun.direction,
        sigma_direction=sun.sigma_direction,
        angular_radius=radius,
        sigma_radius=0.0 if radius == SUN_RADIUS else sun.sigma_radius,
        irradiance=whole,
        background=sun.background,
        clipped=False,
    )
    return Restored(
        add_disc(radiance, sun.direction, radius, lack),
        found,
        spread / float(whole @ LUMINANCE),
        lack,
    )
