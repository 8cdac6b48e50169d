"""From rotations between pairs to rotations of all: who hangs together, and who lies.

Links that close loops with others are trusted first; a tree of the best gives a start; links
that then contradict it (a tiled wall looks the same one tile on) give way to their rivals or
are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.stitch.pairs import Link, nearest
from chromeball.envmap.stitch.rotations import angle_between, exp, log

type Array = NDArray[np.float64]

#: How far cameras that nobody tracks are rolled and tilted, radians.
ROLL, PITCH = math.radians(3), math.radians(25)


def groups(count: int, pairs: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Frames that hang together by `pairs`, largest group first."""
    parent = list(range(count))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for i, j in pairs:
        parent[root(i)] = root(j)
    found: dict[int, list[int]] = {}
    for i in range(count):
        found.setdefault(root(i), []).append(i)
    return sorted(found.values(), key=lambda group: (-len(group), group))


def closed_loops(links: Sequence[Link], tolerance: float) -> list[int]:
    """How many triangles each link closes within `tolerance` radians."""
    turn: dict[tuple[int, int], Array] = {}
    for link in links:
        turn.setdefault((link.first, link.second), link.rotation)
        turn.setdefault((link.second, link.first), link.rotation.T)
    neighbours: dict[int, set[int]] = {}
    for i, j in turn:
        neighbours.setdefault(i, set()).add(j)
    result: list[int] = []
    for link in links:
        i, j = link.first, link.second
        others = sorted(neighbours[i] & neighbours[j])
        if not others:
            result.append(0)
            continue
        around = np.stack([turn[i, k] @ turn[k, j] for k in others])
        result.append(int((angle_between(around, link.rotation) < tolerance).sum()))
    return result


def spread(
    count: int, links: Sequence[Link], tolerance: float
) -> tuple[Array, list[Link], list[Link]]:
    """Rotations (N, 3, 3) in the axes of each group's first frame; links kept, links refused.

    `links` may hold several rotations of one pair: rivals. At most one of each is kept.
    """
    loops = closed_loops(links, tolerance)
    order = sorted(range(len(links)), key=lambda k: -(1 + loops[k]) * len(links[k].matches))
    rotations = np.tile(np.eye(3), (count, 1, 1))
    member = list(range(count))
    for k in order:  # Kruskal's tree of the most trusted; groups turn as they join
        link = links[k]
        a, b = member[link.first], member[link.second]
        if a == b:
            continue
        turn = rotations[link.first] @ link.rotation @ rotations[link.second].T
        for frame in [f for f in range(count) if member[f] == b]:
            rotations[frame] = turn @ rotations[frame]
            member[frame] = a
    for _ in range(3):
        rotations = _averaged(rotations, links, tolerance)
    off = [
        float(angle_between(rotations[ln.first].T @ rotations[ln.second], ln.rotation))
        for ln in links
    ]
    kept: dict[tuple[int, int], int] = {}
    for k in sorted(range(len(links)), key=lambda k: off[k]):
        pair = (links[k].first, links[k].second)
        if off[k] < 2 * tolerance:
            kept.setdefault(pair, k)
    good = [links[k] for k in sorted(kept.values())]
    refused = [ln for ln in links if (ln.first, ln.second) not in kept]
    return rotations, good, refused


def _averaged(rotations: Array, links: Sequence[Link], tolerance: float) -> Array:
    """One step of robust rotation averaging (Chatterjee and Govindu 2013)."""
    count = len(rotations)
    normal, right = np.eye(count) * 1e-9, np.zeros((count, 3))
    for link in links:
        i, j = link.first, link.second
        # rotation of the link in world axes against that of the frames
        w = log((rotations[i] @ link.rotation @ rotations[j].T)[None])[0]
        weight = len(link.matches) / (1 + (np.linalg.norm(w) / tolerance) ** 2) ** 2
        for a, b, sign in ((i, j, -1.0), (j, i, 1.0)):
            normal[a, a] += weight
            normal[a, b] -= weight
            right[a] += sign * weight * w
    step = np.linalg.lstsq(normal, right, rcond=None)[0]
    return exp(step) @ rotations


def to_prior(
    rotations: Array, prior: Array, sigma: Array, group: Sequence[int]
) -> tuple[Array, list[int]]:
    """The turn G (3, 3) that brings a group's rotations to the tracker's, and who agrees.

    The one that most of the group agree with: a few flipped readings have no say.
    """
    have = [i for i in group if np.isfinite(sigma[i])]
    turns = np.stack([prior[i] @ rotations[i].T for i in have])
    widths = np.array([sigma[i] for i in have])
    off = angle_between(turns[:, None], turns[None, :])
    near = off < 4 * np.sqrt(widths[:, None] ** 2 + widths[None, :] ** 2)
    # ties go to the one nearest to all
    best = min(range(len(have)), key=lambda k: (-int(near[k].sum()), float(off[k].sum())))
    turn = nearest(turns[near[best]].sum(axis=0))
    return turn, [have[k] for k in np.flatnonzero(near[best])]


def level(rotations: Array) -> Array:
    """The turn that stands an untracked panorama upright, its first frame ahead (+Z).

    A photographer turns the camera about the vertical: the picture's right is level in all
    frames (Brown and Lowe 2007, section 5), and less surely its axis: up is the least
    eigenvector of sum x x^T / ROLL^2 + z z^T / PITCH^2. Of cameras held upright, which go round
    far enough to tell, the picture's bottom is level, and its right is up.
    """
    x, y, z = np.moveaxis(rotations, -1, 0)
    aimed = z.T @ z / PITCH**2
    (wide, up), (tall, side) = (
        (values[0], vectors[:, 0])
        for values, vectors in (np.linalg.eigh(v.T @ v / ROLL**2 + aimed) for v in (x, y))
    )
    tops = -y.sum(axis=0)
    if tall + 0.5 * len(rotations) < wide:
        up, tops = side, x.sum(axis=0)
    if up @ tops < 0:
        up = -up
    ahead = rotations[0][:, 2]
    ahead = ahead - (ahead @ up) * up
    if np.linalg.norm(ahead) < 1e-3:  # the first frame looks straight up or down
        ahead = -rotations[0][:, 1] - (-rotations[0][:, 1] @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.asarray(np.stack([np.cross(up, ahead), up, ahead]), float)
