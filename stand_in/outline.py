"""Outlines on the floor: drawn by few points, checked, wound and triangulated.

Everything here is in floor coordinates (x, z). A ring is counter-clockwise when its floor
normal is +Y, that is, when sum(z_i x_i+1 - x_i z_i+1) is positive.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.errors import UserError

#: How a ring follows from the points that a person gives, and how many they must be.
OUTLINES = {"polygon": None, "square": 2, "rectangle": 3, "circle": 3}
#: Sides of a circle: the inscribed ring lacks 0.16 % of its area.
CIRCLE_SIDES = 64
#: Relative to the outline's extent, below which lengths count as nothing.
_TINY = 1e-9


def ring(outline: str, points: ArrayLike) -> NDArray[np.float64]:
    """The closed ring that `points` (N, 2) draw, (M, 2), first point kept first.

    ``square`` by its diagonal, ``rectangle`` by one side and a point of the opposite side,
    ``circle`` by three points of its circumference (Felinto et al., section 6.1; seeds F5),
    ``polygon`` by its corners. The result is simple, wound so that its normal is +Y, and has
    no corner on a straight side.

    Raises
    ------
    UserError
        For a wrong number of points, points that coincide or lie on a line, and sides that
        cross or touch.

    """
    p = np.asarray(points, float).reshape(-1, 2)
    if outline not in OUTLINES:
        raise UserError(f"unknown outline {outline!r}; one of {', '.join(OUTLINES)}")
    wanted = OUTLINES[outline]
    if wanted is not None and len(p) != wanted:
        raise UserError(f"a {outline} is drawn by {wanted} points, not {len(p)}")
    if wanted is None and len(p) < 3:
        raise UserError(f"a polygon needs at least 3 points, not {len(p)}")
    if not np.isfinite(p).all():
        raise UserError("a point is not finite")
    match outline:
        case "square":
            return _wound(_square(p))
        case "rectangle":
            return _wound(_rectangle(p))
        case "circle":
            return _wound(_circle(p))
        case _:
            _check_simple(p)
            return _without_straight_corners(_wound(p))


def area(ring: NDArray[np.float64]) -> float:
    """Signed area, positive when the floor normal is +Y."""
    x, z = ring[:, 0], ring[:, 1]
    return float((z * np.roll(x, -1) - x * np.roll(z, -1)).sum() / 2)


def triangulate(ring: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangles (N - 2, 3) of indices of a simple ring with positive area, wound like it.

    Ears are cut off one by one, the bluntest first. A cut changes its two neighbours alone:
    a corner that keeps another from being an ear is reflex, so it is never the one cut
    (Meisters 1975; Eberly, Triangulation by Ear Clipping).
    """
    left = np.arange(len(ring))
    bluntness = np.array([_bluntness(ring, left, place) for place in range(len(ring))])
    triangles: list[NDArray[np.int64]] = []
    while len(left) > 3:
        place = int(bluntness.argmax())
        if bluntness[place] <= 0:  # a simple ring has two ears
            raise ValueError("not a simple ring with positive area")
        triangles.append(left[[place - 1, place, (place + 1) % len(left)]])
        left, bluntness = np.delete(left, place), np.delete(bluntness, place)
        for near in (place - 1, place % len(left)):
            bluntness[near] = _bluntness(ring, left, near)
    return np.array([*triangles, left])


def _bluntness(ring: NDArray[np.float64], left: NDArray[np.int64], place: int) -> float:
    """The sine of the sharpest angle of the ear at `place`, zero when it is none."""
    ear = left[[place - 1, place, (place + 1) % len(left)]]
    a, b, c = ring[ear]
    if _turn(a, b, c) <= 0:
        return 0.0
    others = ring[left[~np.isin(left, ear)]]
    inside = (
        (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
    )
    if inside.any():
        return 0.0
    sides = np.sort(np.linalg.norm(ring[ear] - ring[np.roll(ear, 1)], axis=1))
    return float(_turn(a, b, c) / (sides[1] * sides[2]))


def _turn(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> NDArray[np.float64]:
    """Twice the signed area of the triangle a b c, positive when its normal is +Y."""
    u, v = np.asarray(b) - np.asarray(a), np.asarray(c) - np.asarray(a)
    return np.asarray(u[..., 1] * v[..., 0] - u[..., 0] * v[..., 1])


def _square(p: NDArray[np.float64]) -> NDArray[np.float64]:
    middle, half = p.mean(axis=0), (p[1] - p[0]) / 2
    if not np.hypot(*half) > 0:
        raise UserError("both ends of the square's diagonal are the same point")
    side = np.array([-half[1], half[0]])
    return np.array([p[0], middle + side, p[1], middle - side])


def _rectangle(p: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b, c = p
    length = float(np.hypot(*(b - a)))
    if not length > 0:
        raise UserError("the first two points of the rectangle are the same")
    normal = np.array([-(b - a)[1], (b - a)[0]]) / length
    depth = float((c - a) @ normal)
    if abs(depth) <= _TINY * length:
        raise UserError("the third point of the rectangle lies on its first side")
    return np.array([a, b, b + depth * normal, a + depth * normal])


def _circle(p: NDArray[np.float64]) -> NDArray[np.float64]:
    # |x - centre| = radius at all three: 2 (p_i - p_0) . centre = |p_i|^2 - |p_0|^2
    u = p[1:] - p[0]
    if abs(np.linalg.det(u)) <= _TINY * (np.ptp(p, axis=0) ** 2).sum():
        raise UserError("the three points of the circle lie on a line")
    offset = np.linalg.solve(2 * u, (u**2).sum(axis=1))
    turn = np.arange(CIRCLE_SIDES) * (2 * np.pi / CIRCLE_SIDES)
    start = -offset
    side = np.array([-start[1], start[0]])
    return p[0] + offset + np.cos(turn)[:, None] * start + np.sin(turn)[:, None] * side


def _wound(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    signed = area(ring)
    if abs(signed) <= _TINY * (np.ptp(ring, axis=0) ** 2).sum():
        raise UserError("the points lie on a line: the outline has no area")
    return ring if signed > 0 else np.roll(ring[::-1], 1, axis=0)


def _without_straight_corners(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    turn = _turn(np.roll(ring, 1, axis=0), ring, np.roll(ring, -1, axis=0))
    return ring[np.abs(turn) > _TINY * (np.ptp(ring, axis=0) ** 2).sum()]


def _check_simple(p: NDArray[np.float64]) -> None:
    """Refuse sides that cross, touch or fold back; sides are numbered from 1."""
    count = len(p)
    q = np.roll(p, -1, axis=0)
    tiny = _TINY * float((np.ptp(p, axis=0) ** 2).sum())
    same = ((p[:, None] - p[None]) ** 2).sum(axis=2) <= tiny * _TINY
    for i, j in itertools.combinations(range(count), 2):
        if same[i, j]:
            raise UserError(f"points {i + 1} and {j + 1} are the same")
    for i in range(count):
        before, after = p[i - 1] - p[i], q[i] - p[i]
        if abs(_turn(p[i], q[i], p[i - 1])) <= tiny and before @ after > 0:
            raise UserError(f"the outline folds back on itself at point {i + 1}")
    for i, j in itertools.combinations(range(count), 2):
        if j - i in (1, count - 1):
            continue
        apart = _turn(p[i], q[i], p[j]) * _turn(p[i], q[i], q[j])
        across = _turn(p[j], q[j], p[i]) * _turn(p[j], q[j], q[i])
        if apart <= 0 and across <= 0 and _boxes_meet(p[i], q[i], p[j], q[j]):
            raise UserError(f"sides {i + 1} and {j + 1} of the outline cross; order the points")


def _boxes_meet(*ends: NDArray[np.float64]) -> bool:
    a, b, c, d = ends
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    return bool((low <= high).all())
