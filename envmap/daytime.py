"""A map for a time between templates of the day (seeds.md A7; Aalborg 2004, section 8.5).

Two maps faded into each other have two suns. Here each sun is split off as a disc; its
direction moves along its arc, its light and the rest of the map are blended. The arc is the
circle through the suns of all templates where there are three (over a day the sun keeps its
distance from the celestial pole), else the great circle through two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.sun import Sun, add_disc, find_sun, without_sun
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
type Blend = Literal["log", "linear"]

#: A circle whose suns turn about its pole by less than this is not told from a great circle.
_ARC = math.radians(10)
#: Suns whose heights (sines) differ by less are equally high.
_LEVEL = 0.05


@dataclass(frozen=True)
class Template:
    """A lat-long map (H, W, 3) taken at ``hour`` of the day; ``sun``: found in it, or None."""

    hour: float
    radiance: Picture
    sun: Sun | None

    @classmethod
    def of(
        cls, hour: float, radiance: Picture, clipped: NDArray[np.bool_] | None = None
    ) -> Template:
        """With the sun that the map shows."""
        return cls(hour, radiance, find_sun(radiance, clipped))


@dataclass(frozen=True)
class Between:
    """A map between two templates.

    ``share`` of the later one; ``direction`` (3,) and ``irradiance`` (3,) of the sun, None
    where there is none; ``pole`` (3,) that it turns about, by ``turn`` radians in all between
    the two.
    """

    radiance: Picture
    share: float
    earlier: float
    later: float
    direction: Array | None
    irradiance: Array | None
    pole: Array | None
    turn: float


def at_hour(templates: Sequence[Template], hour: float, blend: Blend = "log") -> Between:
    """The map at `hour`, between the nearest templates before and after.

    `blend`: each direction's brightness changes evenly in its logarithm, or in itself; the
    whole follows the sun's height where both templates show the sun.

    Raises
    ------
    UserError
        When there are fewer than two templates, two of one hour or of different sizes, or the
        hour is not between the first and the last.

    """
    if len(templates) < 2:
        raise UserError("at least two maps of different hours are needed")
    ordered = sorted(templates, key=lambda t: t.hour)
    hours = [t.hour for t in ordered]
    if min(np.diff(hours)) <= 0:
        raise UserError("two maps are of the same hour; leave one out")
    if len({t.radiance.shape for t in ordered}) > 1:
        raise UserError("the maps differ in size: make them alike with `envmap warp --width`")
    if not hours[0] <= hour <= hours[-1]:
        raise UserError(
            f"{clock(hour)} is not between {clock(hours[0])} and {clock(hours[-1])}: the light "
            "outside the templates is unknown"
        )
    k = min(max(int(np.searchsorted(hours, hour, side="right")), 1), len(hours) - 1)
    one, two = ordered[k - 1], ordered[k]
    u = (hour - one.hour) / (two.hour - one.hour)
    rests = [
        t.radiance if t.sun is None else without_sun(t.radiance, t.sun) for t in (one, two)
    ]
    radiance = _mixed(rests[0], rests[1], u, blend)
    suns = [sun for sun in (one.sun, two.sun) if sun is not None]
    if not suns:
        return Between(radiance, u, one.hour, two.hour, None, None, None, 0.0)
    pole, turn, direction = None, 0.0, suns[0].direction
    if one.sun is not None and two.sun is not None:
        pole = arc_pole([t.sun.direction for t in ordered if t.sun is not None])
        turn = _turn(pole, one.sun.direction, two.sun.direction)
        direction = _between(pole, turn, one.sun.direction, two.sun.direction, u)
        light = _blended(one.sun.irradiance, two.sun.irradiance, u, blend)
        more = _by_height(one.sun.direction, two.sun.direction, direction, u) - u
        radiance *= (_gain(rests[0], rests[1]) ** more).astype(np.float32)
        light = light * _gain(one.sun.irradiance, two.sun.irradiance) ** more
    else:  # it rose, set, or went behind a cloud in between
        light = suns[0].irradiance * ((1 - u) if one.sun is not None else u)
    radius = float(np.interp(u, [0, 1], [suns[0].angular_radius, suns[-1].angular_radius]))
    lit = add_disc(radiance, direction, radius, light) if light.any() else radiance
    return Between(lit, u, one.hour, two.hour, direction, light, pole, turn)


def left_out(templates: Sequence[Template], blend: Blend = "log") -> dict[float, float]:
    """Each inner template against what the others make of its hour, by its hour.

    RMS over six normals of the irradiance's error, relative to the mean irradiance.
    """
    from chromeball.envmap.irradiance import irradiance
    from chromeball.envmap.lights import NORMALS

    ordered = sorted(templates, key=lambda t: t.hour)
    errors: dict[float, float] = {}
    for k in range(1, len(ordered) - 1):
        others = [*ordered[:k], *ordered[k + 1 :]]
        made = irradiance(at_hour(others, ordered[k].hour, blend).radiance, NORMALS)
        truth = irradiance(ordered[k].radiance, NORMALS)
        errors[ordered[k].hour] = float(np.sqrt(np.mean((made - truth) ** 2)) / truth.mean())
    return errors


def arc_pole(directions: Sequence[Array]) -> Array:
    """The pole (3,) of the circle on the sphere through unit directions, in their order."""
    d = np.array(directions)
    great = np.cross(d[0], d[-1])
    length = float(np.linalg.norm(great))
    great = great / length if length > 1e-9 else np.array([0.0, 1.0, 0.0])
    if len(d) < 3:
        return great
    # the suns of a day lie in a plane
    _, spread, axes = np.linalg.svd(d - d.mean(axis=0))
    pole = axes[2] * (1 if np.sum(np.cross(d[:-1], d[1:]) @ axes[2]) >= 0 else -1)
    turn = _turn(pole, d[0], d[-1])
    bent = spread[1] > 1e-3 * spread[0]  # else they lie on a line: any circle fits
    return pole if bent and abs(turn) > _ARC else great


def parse_clock(text: str) -> float:
    """``14:30`` or ``14.5`` as hours.

    Raises
    ------
    UserError
        When it is no time of a day.

    """
    hours, colon, minutes = text.partition(":")
    try:
        value = int(hours) + int(minutes) / 60 if colon else float(hours)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 24 or (colon and not 0 <= int(minutes) < 60):
        raise UserError(f"{text!r} is no time of a day: write it as 14:30")
    return value


def clock(hour: float) -> str:
    """Hours as ``14:30``."""
    minutes = round(hour * 60)
    return f"{minutes // 60:02}:{minutes % 60:02}"


def _mixed(a: Picture, b: Picture, u: float, blend: Blend) -> Picture:
    return _blended(a, b, u, blend).astype(np.float32)


def _blended(a: Picture | Array, b: Picture | Array, u: float, blend: Blend) -> Array:
    linear = np.asarray(a * (1 - u) + b * u, np.float64)
    if blend == "linear" or not 0 < u < 1:
        return linear
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.exp(np.log(a) * (1 - u) + np.log(b) * u)
    # where one is black nothing is known of how it fades
    return np.where((a > 0) & (b > 0), even, linear)


def _by_height(a: Array, b: Array, now: Array, u: float) -> float:
    """The share of the way from a to b by the sun's height, which daylight follows.

    That of the time, `u`, where both are as high.
    """
    span = float(b[1] - a[1])
    return u if abs(span) < _LEVEL else float(np.clip((now[1] - a[1]) / span, -0.5, 1.5))


def _gain(a: Picture | Array, b: Picture | Array) -> Array:
    """The light of b over that of a, by channel."""
    one, two = (v.reshape(-1, 3).mean(axis=0, dtype=float) for v in (a, b))
    return np.where((one > 0) & (two > 0), two / np.where(one > 0, one, 1), 1.0)


def _turn(pole: Array, a: Array, b: Array) -> float:
    """The angle about `pole` from a to b, radians."""
    a, b = (v - (v @ pole) * pole for v in (a, b))
    return math.atan2(float(np.cross(a, b) @ pole), float(a @ b))


def _between(pole: Array, turn: float, a: Array, b: Array, u: float) -> Array:
    """On the way from a to b about `pole`; the ends are met whatever the fit."""
    forth = Pose.from_rotation_vector(pole * (turn * u), np.zeros(3)).rotate(a)
    back = Pose.from_rotation_vector(-pole * (turn * (1 - u)), np.zeros(3)).rotate(b)
    mean = (1 - u) * forth + u * back
    return mean / np.linalg.norm(mean)
