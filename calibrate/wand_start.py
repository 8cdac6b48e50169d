"""Where cameras stand that saw moving lights, from rays alone: no pose is known beforehand.

Pairs of cameras give essential matrices (Nister 2004, by OpenCV's consensus), the best pair
the first points, and every other camera is placed before those (perspective-n-point). Rays are
turned to their mean first, so that fisheyes take part; those far off it wait for the
adjustment. The lights of a wand need no names: a camera sees them in order along the wand or
in the opposite one, and both are tried.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

#: Lights that two cameras must have in common.
FEWEST_COMMON = 12
#: Rays farther from their mean are left out of the start.
WIDEST = math.radians(70)
#: Rays to a point must differ by this much somewhere, else the cameras stand at one place.
LEAST_PARALLAX = math.radians(0.5)
#: Pairs of cameras tried as the first.
SEEDS = 4
#: Beyond this many common lights more tell a start nothing.
ENOUGH = 600
#: A camera is placed if this share of the lights it sees fits.
LEAST_SHARE = 0.3


@dataclass(frozen=True)
class Start:
    """Camera poses p_camera = R p + t of those `placed` (C,), and points (F, K, 3) or NaN.

    ``reversed`` (C, F): where a camera's lights are in the opposite order.
    """

    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    points: NDArray[np.float64]
    placed: NDArray[np.bool_]
    reversed: NDArray[np.bool_]


@dataclass(frozen=True)
class Pair:
    """Two cameras' relative pose, second from first, with `inliers` and median `parallax`."""

    first: int
    second: int
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    inliers: int
    parallax: float


def find_pairs(rays: NDArray[np.float64], tolerance: NDArray[np.float64]) -> list[Pair]:
    """Relative poses of all pairs that have lights in common, the most telling first.

    Parameters
    ----------
    rays
        Unit directions in the cameras' axes, (C, F, K, 3), NaN where not seen.
    tolerance
        Angle by which a ray of each camera may miss, radians, (C,).

    """
    pairs: list[Pair] = []
    for i, j in combinations(range(len(rays)), 2):
        common = np.isfinite(rays[[i, j]]).all(axis=(0, 2, 3))
        a, b = rays[i, common], rays[j, common]
        step = max(1, len(a) * a.shape[1] // ENOUGH)
        a, b = a[::step], b[::step]
        pair = _pair(a, b, float(max(tolerance[i], tolerance[j])))
        if pair is not None:
            rotation, translation, inliers, parallax = pair
            pairs.append(Pair(i, j, rotation, translation, inliers * step, parallax))
    # Parallax beyond a third of a right angle is as good as can be.
    return sorted(pairs, key=lambda p: -p.inliers * min(p.parallax, math.radians(30)))


def place(
    rays: NDArray[np.float64], tolerance: NDArray[np.float64], seeds: int = SEEDS
) -> Start | None:
    """All cameras that can be placed, from the best of the first `seeds` pairs; None for none.

    Parameters are those of :func:`find_pairs`.
    """
    best: Start | None = None
    for pair in find_pairs(rays, tolerance)[:seeds]:
        if pair.parallax < LEAST_PARALLAX:
            continue
        start = begin(rays, pair, tolerance)
        while not start.placed.all():
            grown = extend(rays, start, tolerance)
            if grown is None:
                break
            start = grown
        if best is None or _merit(start) > _merit(best):
            best = start
        if best.placed.all():
            break
    return best


def _merit(start: Start) -> tuple[int, int]:
    """More cameras first, then more lights."""
    return int(start.placed.sum()), int(np.isfinite(start.points[..., 0]).sum())


def begin(rays: NDArray[np.float64], pair: Pair, tolerance: NDArray[np.float64]) -> Start:
    """Two cameras, and the lights that they see."""
    count, frames = rays.shape[:2]
    start = Start(
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        np.full((frames, *rays.shape[2:]), np.nan),
        np.isin(np.arange(count), [pair.first, pair.second]),
        np.zeros((count, frames), bool),
    )
    start.rotations[pair.second] = pair.rotation
    start.translations[pair.second] = pair.translation
    if rays.shape[2] > 1:
        essential = _cross(pair.translation) @ pair.rotation
        a, b = rays[pair.first], rays[pair.second]
        same = np.abs(np.einsum("fki,ij,fkj->fk", b, essential, a)).max(axis=1)
        other = np.abs(np.einsum("fki,ij,fkj->fk", b[:, ::-1], essential, a)).max(axis=1)
        start.reversed[pair.second] = other < same
    return replace(start, points=triangulate(ordered(rays, start.reversed), start, tolerance))


def extend(
    rays: NDArray[np.float64], start: Start, tolerance: NDArray[np.float64]
) -> Start | None:
    """One camera more, the one that sees most of the points; None where none fits."""
    known = np.isfinite(start.points).all(axis=(1, 2))
    seen = np.isfinite(rays).all(axis=(2, 3)) & known
    order = np.argsort(-np.where(start.placed, -1, seen.sum(axis=1)))
    for camera in order[: int((~start.placed).sum())].tolist():
        frames = np.flatnonzero(seen[camera])
        if frames.size * rays.shape[2] < FEWEST_COMMON:
            break
        found = _resect(start.points[frames], rays[camera, frames], float(tolerance[camera]))
        if found is None:
            continue
        rotation, translation, swapped = found
        rotations, translations = start.rotations.copy(), start.translations.copy()
        rotations[camera], translations[camera] = rotation, translation
        placed, turned = start.placed.copy(), start.reversed.copy()
        placed[camera] = True
        turned[camera, frames] = swapped
        grown = replace(
            start,
            rotations=rotations,
            translations=translations,
            placed=placed,
            reversed=_match_new(rays, rotations, translations, start, camera, turned),
        )
        points = triangulate(ordered(rays, grown.reversed), grown, tolerance)
        return replace(grown, points=points)
    return None


def ordered(rays: NDArray[np.float64], swapped: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Rays or pixels (C, F, K, n), each camera's lights in the same order."""
    return np.where(swapped[..., None, None], rays[:, :, ::-1], rays)


def triangulate(
    rays: NDArray[np.float64], start: Start, tolerance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points (F, K, 3) by the two placed cameras with which most others agree; NaN for none.

    The closest point to both rays (Hartley and Sturm 1997, section 4); rays must meet it from
    the front.
    """
    frames, lights = rays.shape[1:3]
    best = np.full((frames, lights, 3), np.nan)
    score = np.zeros((frames, lights))
    placed: list[int] = np.flatnonzero(start.placed).tolist()
    centres = -np.einsum("cji,cj->ci", start.rotations, start.translations)
    world = np.einsum("cji,cfkj->cfki", start.rotations, rays)
    for i, j in combinations(placed, 2):
        point, sine = _meet(centres[i], world[i], centres[j], world[j])
        votes = np.zeros((frames, lights))
        for c in placed:
            to = point - centres[c]
            with np.errstate(invalid="ignore", divide="ignore"):
                off = np.linalg.norm(
                    to / np.linalg.norm(to, axis=-1, keepdims=True) - world[c], axis=-1
                )
                good = off < tolerance[c]
                share = off / tolerance[c]
            # A light votes once; the smaller its miss, the more, and never for nothing.
            votes += np.where(good, 1 - 0.5 * np.minimum(share, 1) ** 2, 0)
            if c in (i, j):
                votes[~good] = -np.inf
        votes = votes + np.minimum(sine, 0.5)  # of equals the wider angle
        better = (votes > score) & (sine > 0.003)
        best[better], score[better] = point[better], votes[better]
    return best


# ---- pieces


def _pair(
    a: NDArray[np.float64], b: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], int, float] | None:
    """Rotation, unit translation, inliers, parallax from rays (N, K, 3) of two cameras."""
    if a.shape[1] > 1:  # in the same order or in the opposite one
        a, b = np.concatenate([a, a]), np.concatenate([b, b[:, ::-1]])
    a, b = a.reshape(-1, 3), b.reshape(-1, 3)
    if len(a) < FEWEST_COMMON:
        return None
    turn_a, flat_a, near_a = _flattened(a)
    turn_b, flat_b, near_b = _flattened(b)
    near = near_a & near_b
    if near.sum() < FEWEST_COMMON:
        return None
    a, b = a[near], b[near]
    essential, _ = cv2.findEssentialMat(
        flat_a[near],
        flat_b[near],
        np.eye(3),
        method=cv2.USAC_ACCURATE,
        prob=0.9999,
        threshold=tolerance,
        maxIters=5000,
    )
    if np.shape(essential) != (3, 3) or not np.isfinite(essential).all():
        return None
    full = turn_b.T @ essential @ turn_a
    u, _, vt = np.linalg.svd(full)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    w = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    best: tuple[NDArray[np.float64], NDArray[np.float64], int, float] | None = None
    for turn in (w, w.T):
        rotation = u @ turn @ vt
        for translation in (u[:, 2], -u[:, 2]):
            back = b @ rotation  # in the first camera's axes
            point, sine = _meet(np.zeros(3), a, -rotation.T @ translation, back)
            to = point + rotation.T @ translation
            with np.errstate(invalid="ignore"):
                good = _near(point, a, tolerance) & _near(to, back, tolerance)
            count = int(good.sum())
            if count >= FEWEST_COMMON and (best is None or count > best[2]):
                angle = float(np.median(np.arcsin(np.clip(sine[good], 0, 1))))
                best = rotation, translation, count, angle
    return best


def _resect(
    points: NDArray[np.float64], rays: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]] | None:
    """Rotation, translation, and which frames are reversed, from points and rays (N, K, 3)."""
    lights = points.shape[1]
    p = points.reshape(-1, 3)
    r = rays.reshape(-1, 3)
    if lights > 1:
        p, r = np.concatenate([p, p]), np.concatenate([r, rays[:, ::-1].reshape(-1, 3)])
    turn, flat, near = _flattened(r)
    if near.sum() < FEWEST_COMMON:
        return None
    try:
        good, vector, shift, _ = cv2.solvePnPRansac(
            np.ascontiguousarray(p[near]),
            np.ascontiguousarray(flat[near]),
            np.eye(3),
            np.zeros(4),
            iterationsCount=2000,
            reprojectionError=tolerance,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # the solver's own word for a degenerate configuration
        return None
    if not good:
        return None
    rotation = turn.T @ cv2.Rodrigues(vector)[0]
    translation = turn.T @ shift[:, 0]
    seen = points @ rotation.T + translation
    same = _off(seen, rays).max(axis=-1)
    other = _off(seen, rays[:, ::-1]).max(axis=-1)
    fits = np.minimum(same, other) < tolerance
    if fits.mean() < LEAST_SHARE:
        return None
    return np.asarray(rotation, float), np.asarray(translation, float), other < same


def _match_new(
    rays: NDArray[np.float64],
    rotations: NDArray[np.float64],
    translations: NDArray[np.float64],
    start: Start,
    camera: int,
    swapped: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Orders of frames that no point is known of, beside one placed camera that sees them."""
    if rays.shape[2] == 1:
        return swapped
    open_frames = ~np.isfinite(start.points).all(axis=(1, 2))
    done = ~open_frames
    for other in np.flatnonzero(start.placed).tolist():
        both = ~done & np.isfinite(rays[np.array([camera, other])]).all(axis=(0, 2, 3))
        if not both.any():
            continue
        rotation = rotations[camera] @ rotations[other].T
        essential = _cross(translations[camera] - rotation @ translations[other]) @ rotation
        a = ordered(rays, swapped)[other, both]
        b = rays[camera, both]
        same = np.abs(np.einsum("fki,ij,fkj->fk", b, essential, a)).max(axis=1)
        turned = np.abs(np.einsum("fki,ij,fkj->fk", b[:, ::-1], essential, a)).max(axis=1)
        swapped[camera, both] = turned < same
        done |= both
    return swapped


def _meet(
    c1: NDArray[np.float64],
    d1: NDArray[np.float64],
    c2: NDArray[np.float64],
    d2: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Point midway between rays (..., 3) from two centres, and the sine of their angle.

    NaN where they meet behind a centre.
    """
    between = c2 - c1
    cosine = (d1 * d2).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = 1 - cosine**2
        along1, along2 = d1 @ between, d2 @ between
        s1 = (along1 - cosine * along2) / square
        s2 = (cosine * along1 - along2) / square
        point = (c1 + s1[..., None] * d1 + c2 + s2[..., None] * d2) / 2
        point[~((s1 > 0) & (s2 > 0))] = np.nan
    return point, np.sqrt(np.clip(square, 0, 1))


def _flattened(
    rays: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """A turn to the mean ray, the plane's coordinates there (N, 2), which are not far off."""
    axis = rays.mean(axis=0)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(axis, x), axis])
    turned = rays @ turn.T
    near = turned[:, 2] > math.cos(WIDEST)
    flat = turned[:, :2] / np.where(near, turned[:, 2], 1)[:, None]
    return turn, flat, near


def _off(points: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of unit directions, (...)."""
    unit = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return np.asarray(np.linalg.norm(unit - rays, axis=-1), float)


def _near(
    points: NDArray[np.float64], rays: NDArray[np.float64], tolerance: float
) -> NDArray[np.bool_]:
    return _off(points, rays) < tolerance


def _cross(v: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
