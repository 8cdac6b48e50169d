"""The hole under the tripod: filled by a shot of the ground, or by a patch (seeds.md F2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.complete import Source
from chromeball.envmap.ground_view import down_mapping, down_view
from chromeball.envmap.mapping import LatLong, Mapping
from chromeball.envmap.membrane import membrane, pasted
from chromeball.envmap.resample import carry, warp
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import luminance
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
type Mask = NDArray[np.bool_]

#: The hole without a word about it: what has alpha 0 this far below the horizon.
BELOW = math.radians(20)
#: Ground around the hole that is seen with it, and the farthest from the nadir, radians.
RING, FARTHEST = math.radians(30), math.radians(72)
#: Side of the view on which a patch is made, at most: it is smooth.
SMOOTH = 320


@dataclass(frozen=True)
class Hole:
    """``mask`` (H, W) of the map, and its largest angle from the nadir, radians."""

    mask: Mask
    reach: float

    @property
    def view_reach(self) -> float:
        """What the view downwards sees to all sides, radians."""
        return min(FARTHEST, max(self.reach + RING, math.radians(50)))


@dataclass(frozen=True)
class Match:
    """How the shot's light was matched: ``gain`` (3,), ``scatter`` of ln L over the ring.

    ``pixels`` of the map that both see.
    """

    gain: Array
    scatter: float
    pixels: int


@dataclass(frozen=True)
class Shot:
    """A shot as the map sees it: (H, W, 3) and (H, W); ``energy_error`` of its resampling."""

    radiance: Picture
    coverage: Picture
    clipped: Picture | None
    energy_error: float


def find_hole(alpha: Picture, cone: float | None = None, picture: Mask | None = None) -> Hole:
    """The hole of a lat-long: a `cone` about the nadir (radians), a mask, or alpha 0.

    Raises
    ------
    UserError
        When there is none, or it reaches up to the horizon.

    """
    height, width = alpha.shape
    down = LatLong((width, height)).directions()[..., 1]
    if cone is not None:
        mask = down < -math.cos(cone)
    elif picture is not None:
        mask = picture & (down < 0)
    else:
        mask = (alpha == 0) & (down < -math.sin(BELOW))
    if not mask.any():
        raise UserError(
            "there is no hole below: nothing has alpha 0 there; say it with --hole, degrees "
            "about the nadir or a mask picture"
        )
    reach = math.acos(float(np.clip(-down[mask].max(), -1, 1))) + math.pi / height
    if reach > FARTHEST - math.radians(5):
        raise UserError(
            f"the hole reaches {math.degrees(reach):.0f} degrees from the nadir: "
            f"{math.degrees(FARTHEST) - 5:.0f} at most are ground enough"
        )
    return Hole(mask, reach)


def edge_of(hole: Hole) -> Array:
    """World directions (N, 3) on the hole's edge."""
    import cv2

    wide = np.pad(hole.mask.astype(np.uint8), ((0, 0), (1, 1)), mode="wrap")
    inner = cv2.erode(wide, np.ones((3, 3), np.uint8), borderValue=1)
    rim = hole.mask & (np.asarray(inner)[:, 1:-1] == 0)
    height, width = hole.mask.shape
    return LatLong((width, height)).directions()[rim]


def look_down(
    radiance: Picture, valid: Mask, reach: float, largest: int = 2048
) -> tuple[CameraModel, Picture, Mask]:
    """The view downwards of a lat-long: its camera, (S, S, 3) and what it sees."""
    height, width = valid.shape
    density = min(width / (2 * math.pi), largest / (2 * math.tan(reach)))
    view = down_view(reach, density)
    seen = warp(radiance, LatLong((width, height)), down_mapping(view), valid=valid)
    return view, seen.radiance, seen.coverage > 0.999


def seen_from_map(
    shot: Picture,
    mapping: Mapping,
    size: tuple[int, int],
    valid: Mask | None,
    clipped: Mask | None,
) -> Shot:
    """The shot on a lat-long of `size`, by the mapping of its rays through the plane."""
    target = LatLong(size)
    found = warp(shot, mapping, target, valid=valid)
    seeable = float((found.source_energy - found.outside).sum())
    marks = None
    if clipped is not None and clipped.any():
        marks = carry(clipped, mapping, target, valid=valid)
    error = float(found.energy.sum()) / seeable - 1 if seeable > 0 else 0.0
    return Shot(found.radiance, found.coverage, marks, error)


def match_light(
    radiance: Picture,
    valid: Mask,
    hole: Hole,
    shot: Shot,
    *,
    channels: bool = False,
) -> Match:
    """The gain under which shot and map agree over the ring: one, or one of each channel.

    Medians of logarithms, weighted by nothing: the feet's shadow is outvoted.

    Raises
    ------
    UserError
        When the two share no lit ground.

    """
    height, width = hole.mask.shape
    target = LatLong((width, height))
    angle = np.arccos(np.clip(-target.directions()[..., 1], -1, 1))
    near = valid & ~hole.mask & (shot.coverage > 0.999) & (angle < hole.reach + RING)
    own, other = radiance[near].astype(float), shot.radiance[near].astype(float)
    lit = (own.min(axis=1) > 0) & (other.min(axis=1) > 0)
    if lit.sum() < 50:
        raise UserError(
            "the shot shows no lit ground outside the hole: its exposure cannot be matched; "
            "take in a ring around it, or keep it with --exposure keep"
        )
    own, other = own[lit], other[lit]
    weight = target.solid_angles()[near][lit]
    tone = np.log(luminance(own) / luminance(other))
    middle = _weighted_median(tone, weight)
    gain = np.full(3, math.exp(middle))
    if channels:
        ratio = np.log(own / other)
        gain = np.exp([_weighted_median(ratio[:, c], weight) for c in range(3)])
    scatter = 1.4826 * _weighted_median(np.abs(tone - middle), weight)
    return Match(np.asarray(gain, float), scatter, int(lit.sum()))


def blend_weight(hole: Hole, valid: Mask, shot: Shot, feather: float) -> Picture:
    """The shot's share of each pixel of the map, (H, W).

    All of the hole that it sees; outside it falls to none over `feather` radians, and towards
    the edge of what the shot sees (its mask), measured on the ground.
    """
    import cv2

    height, width = hole.mask.shape
    source = LatLong((width, height))
    density = min(width / (2 * math.pi), 1024 / (2 * math.tan(hole.view_reach)))
    view = down_view(hole.view_reach, density)
    target = down_mapping(view)
    inside = carry(hole.mask, source, target) > 0.5
    covered = warp(
        np.repeat(shot.coverage[..., None], 3, axis=2), source, target, smooth=False
    ).radiance[..., 0]
    focal = view.intrinsics[0]
    out = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    blind = (covered < 0.999).astype(np.uint8)
    far = cv2.distanceTransform(1 - blind, cv2.DIST_L2, 5) if blind.any() else out * 0 + focal
    reach = max(feather * focal, 1.0)

    def soft(x: Array) -> Array:
        x = np.clip(x, 0, 1)
        return x * x * (3 - 2 * x)

    share = soft(1 - np.asarray(out) / reach) * soft(np.asarray(far) / reach)
    rim = LatLong((width, height)).directions()
    q = target.pixels_of(rim).astype(np.float32)
    q = np.nan_to_num(q, nan=-10.0)
    weight = cv2.remap(
        share.astype(np.float32), q[..., 0], q[..., 1], cv2.INTER_LINEAR, borderValue=0.0
    )
    seen = shot.coverage > 0.999
    weight = np.where(seen, weight, 0)
    weight[(hole.mask | ~valid) & seen & (weight > 0)] = 1
    weight[hole.mask & seen] = 1
    return np.asarray(weight, np.float32)


@dataclass(frozen=True)
class Lightmap:
    """A map: radiance (H, W, 3), alpha, `completed` (H, W), and the clipped share or None."""

    radiance: Picture
    alpha: Picture
    completed: Picture
    clipped: Picture | None

    @property
    def solid_angles(self) -> Array:
        """Of each pixel, (H, W) sr."""
        return LatLong((self.alpha.shape[1], self.alpha.shape[0])).solid_angles()

    def energy(self, where: Mask | None = None) -> float:
        """Radiance times solid angle, all channels, over all or a part of the map."""
        light = self.radiance.sum(axis=2, dtype=np.float64) * self.solid_angles
        return float(light.sum() if where is None else light[where].sum())


def with_shot(before: Lightmap, hole: Hole, shot: Shot, weight: Picture) -> Lightmap:
    """The map with the shot, its gain applied, blended in by its weight (H, W)."""
    share = weight[..., None]
    mixed = before.radiance + share * (shot.radiance - before.radiance)
    mine = hole.mask & (weight > 0)
    clipped = before.clipped
    if clipped is not None or shot.clipped is not None:
        none = np.zeros(weight.shape, np.float32)
        own = none if clipped is None else clipped
        its = none if shot.clipped is None else shot.clipped
        clipped = np.asarray(own + weight * (its - own), np.float32)
    # where the map saw nothing, in the ring as well, the shot is what was seen
    mine |= (weight == 1) & (before.alpha == 0)
    return Lightmap(
        np.asarray(np.where(share > 0, mixed, before.radiance), np.float32),
        np.where(mine, np.float32(1), before.alpha),
        np.where(mine, np.float32(Source.NADIR), before.completed),
        clipped,
    )


def with_patch(before: Lightmap, left: Mask, patch: Picture) -> Lightmap:
    """The map with the `patch` (H, W, 3) where something is `left`: alpha 0, marked."""
    return Lightmap(
        np.where(left[..., None], patch, before.radiance),
        np.where(left, np.float32(0), before.alpha),
        np.where(left, np.float32(Source.PATCH), before.completed),
        None if before.clipped is None else np.where(left, np.float32(0), before.clipped),
    )


def make_patch(
    before: Lightmap,
    hole: Hole,
    left: Mask,
    picture: tuple[Picture, Picture] | None = None,
    *,
    match: bool = True,
) -> Picture:
    """What fills `left` of a lat-long, (H, W, 3): a membrane, or a picture and its opacity.

    Raises
    ------
    UserError
        When nothing about it is seen, or the picture is black.

    """
    height, width = left.shape
    source = LatLong((width, height))
    valid = (before.alpha > 0) & ~left
    largest = SMOOTH if picture is None else 2048
    view, seen, sees = look_down(before.radiance, valid, hole.view_reach, SMOOTH)
    target = down_mapping(view)
    gap = carry(left, source, target) > 0
    made = membrane(seen, gap, sees)
    if picture is not None:
        fine, _, _ = look_down(before.radiance, valid, hole.view_reach, largest)
        made = warp(made, target, down_mapping(fine)).radiance
        target = down_mapping(fine)
        gap = carry(left, source, target) > 0.5
        made = pasted(made, gap, *picture, match=match)
    return warp(made, target, source).radiance


def _weighted_median(values: Array, weight: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
