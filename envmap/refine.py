"""Turns of overlapping shots from what they see together: Lucas and Kanade 1981, on a sphere.

Each shot comes as a lat-long map of its own, placed by its nominal direction. A search over
turns compares local contrast of log luminance. Gauss-Newton, coarse to fine, with Tukey's
weights over all pairs at once, ends on log luminance itself, with a smooth ratio of each pair
(harmonics of order 2: exposure, vignetting, flare) solved for besides. Shot 0 stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.harmonics import sh_basis
from chromeball.envmap.mapping import LatLong
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]
type Plane = NDArray[np.float32]

#: Correlation below which an overlap proves nothing, and turns beyond which it is not believed.
WEAK = 0.7
FARTHEST = math.radians(15)
REACH = math.radians(12)
_COARSEST = 360  # pixels across: of a ring 10 degrees wide some pixels remain
_STEP = math.radians(2)  # the search's grid
_SAMPLES = 5000
_CANDIDATES = 16
_CLEAR = 0.9  # correlation that needs no search
_INTERPOLATION = 0.03  # pixels: what interpolation may pull an estimate by
_BLOCK = math.radians(3)  # residuals nearer than this are not independent


@dataclass(frozen=True)
class Refined:
    """What `refine_turns` found.

    ``turns`` (N, 3, 3): what a shot shows at d in its nominal place is at ``turns[n] @ d``.
    ``angles`` (N,) their sizes and ``sigma`` (N,) standard errors of a turn about the worst
    axis, radians; ``correlation`` of local contrast in the overlaps before and after.
    ``significance`` weighs the latter by the overlap's size. ``reason`` says why the turns
    should not be trusted, or is empty.
    """

    turns: Array
    angles: Array
    sigma: Array
    correlation: tuple[float, float]
    significance: float
    reason: str


def refine_turns(
    luminances: Sequence[Plane], weights: Sequence[Plane], reach: float = REACH
) -> Refined:
    """Refine shots given as lat-long maps (H, W) of luminance and of weight, 0 where unseen.

    Turns are searched up to `reach` about each axis, radians.

    Turns that are not better than the nominal directions, too uncertain or too far from them
    have a `reason`.
    """
    count, width = len(luminances), luminances[0].shape[1]
    sizes = [width]
    while sizes[-1] // 2 >= _COARSEST:
        sizes.append(sizes[-1] // 2)
    problem = _Problem.of(luminances, weights, sizes[-1])
    if not problem.pairs:
        still = np.stack([np.eye(3)] * count)
        open_ = np.full(count, np.inf)
        return Refined(still, np.zeros(count), open_, (0.0, 0.0), 0.0, "no two shots overlap")
    turns = problem.solve(np.stack([np.eye(3)] * count))
    if problem.correlation(turns) < _CLEAR:
        turns = problem.search(reach)
    for size in reversed(sizes):
        problem = _Problem.of(luminances, weights, size)
        turns = problem.solve(turns)
    whole = _Problem.of(luminances, weights, width, local=False)
    turns = whole.solve(turns)
    still = np.stack([np.eye(3)] * count)
    before, after = problem.correlation(still), problem.correlation(turns)
    sigma = whole.sigma(turns)
    angles = np.array(
        [np.linalg.norm(Pose(turn, np.zeros(3)).rotation_vector()) for turn in turns]
    )
    reason = ""
    if not after > WEAK:
        reason = f"what the shots share is too plain, or differs (correlation {after:.2f})"
    elif angles.max() > FARTHEST:
        reason = f"the overlap asks for a turn of {math.degrees(angles.max()):.0f} degrees"
    elif after <= before:
        reason = "the given directions fit as well"
    elif not sigma.max() < max(float(angles.max()), math.radians(0.1)):
        reason = f"the overlap leaves {math.degrees(sigma.max()):.2f} degrees open"
    return Refined(turns, angles, sigma, (before, after), problem.significance(turns), reason)


@dataclass(frozen=True)
class _Layer:
    """A shot at one size: a signal s (H, W), its turning gradient d x grad s, and weights."""

    signal: Plane
    gradient: Plane
    weight: Plane


@dataclass(frozen=True)
class _Views:
    """All shots in M directions: solid angles, blocks, and signal, gradient, weight each."""

    directions: Array
    solid: Array
    blocks: NDArray[np.int64]
    sampled: tuple[tuple[Array, Array, Array], ...]


@dataclass(frozen=True)
class _Problem:
    width: int
    directions: Array
    solid: Array
    layers: tuple[_Layer, ...]
    pairs: tuple[tuple[int, int], ...]
    local: bool

    @cached_property
    def grown(self) -> list[Plane]:
        """Weights with a margin of some pixels."""
        import cv2

        kernel = np.ones((9, 9), np.uint8)
        return [
            np.asarray(cv2.dilate(_wrapped(layer.weight, 8), kernel), np.float32)[:, 8:-8]
            for layer in self.layers
        ]

    @cached_property
    def fields(self) -> list[Plane]:
        """All that is sampled, with two columns beyond each seam."""
        return [
            np.ascontiguousarray(_wrapped(np.dstack([s.signal, s.gradient, s.weight]), 2))
            for s in self.layers
        ]

    @classmethod
    def of(
        cls,
        luminances: Sequence[Plane],
        weights: Sequence[Plane],
        width: int,
        local: bool = True,
    ) -> _Problem:
        """Of local contrast, or of log luminance with smooth ratios to be solved for."""
        mapping = LatLong((width, width // 2))
        d = mapping.directions()
        solid = mapping.solid_angles()
        layers = tuple(
            _layer(luminance, weight, d, width, local)
            for luminance, weight in zip(luminances, weights, strict=True)
        )
        pairs: list[tuple[int, int]] = []
        for i in range(len(layers)):
            for j in range(i + 1, len(layers)):
                both = (layers[i].weight > 0) & (layers[j].weight > 0)
                if solid[both].sum() > 0.01:
                    pairs.append((i, j))
        return cls(width, d, solid, layers, tuple(pairs), local)

    def views(self, turns: Array) -> _Views:
        """All shots as turned, where two or more see."""
        seen = [self._seen(k, turn) for k, turn in enumerate(turns)]
        active = np.flatnonzero(np.sum(seen, axis=0) >= 2)
        d = self.directions.reshape(-1, 3)[active]
        sampled = [self._sampled(k, turn, d) for k, turn in enumerate(turns)]
        y, x = np.divmod(active, self.width)
        block = max(1, round(_BLOCK * self.width / (2 * math.pi)))
        blocks = (y // block) * (self.width // block + 1) + x // block
        return _Views(d, self.solid.reshape(-1)[active], blocks, tuple(sampled))

    def _seen(self, k: int, turn: Array) -> NDArray[np.bool_]:
        """Where shot k may have weight, at a quarter of the size and then grown."""
        coarse = np.ascontiguousarray(self.directions[::4, ::4])
        seen = (self._nearest(self.grown[k], coarse @ turn) > 0).astype(np.uint8)
        height = self.directions.shape[0]
        return np.repeat(np.repeat(seen, 4, axis=0), 4, axis=1)[:height, : self.width] > 0

    def _sampled(self, k: int, turn: Array, d: Array) -> tuple[Array, Array, Array]:
        """Signal, gradient and weight of shot k as turned, in directions d (M, 3)."""
        import cv2

        x, y = self._pixels(d @ turn)
        rows = np.zeros((2, -(-len(d) // 1024) * 1024), np.float32)  # remap takes pictures
        rows[0, : len(d)], rows[1, : len(d)] = x + 2, y
        x, y = rows.reshape(2, -1, 1024)
        got = cv2.remap(self.fields[k], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        got = np.asarray(got, np.float64).reshape(-1, 5)[: len(d)]
        # the gradient was taken in the map's own axes
        return got[:, 0], got[:, 1:4] @ turn.T, got[:, 4]

    def search(self, reach: float) -> Array:
        """Each shot against the placed one that it shares most with, over a grid of turns."""
        turns = np.stack([np.eye(3)] * len(self.layers))
        placed, waiting = {0}, set(range(1, len(self.layers)))
        while waiting:
            shared = [
                (
                    float(
                        (
                            self.solid
                            * np.minimum(self.layers[i].weight, self.layers[k].weight)
                        ).sum()
                    ),
                    i,
                    k,
                )
                for i, k in ((i, k) for i in placed for k in waiting)
                if (min(i, k), max(i, k)) in self.pairs
            ]
            if not shared:
                break
            _, i, k = max(shared)
            turns[k] = turns[i] @ self._best(i, k, reach)
            placed.add(k)
            waiting.remove(k)
        return turns

    def _best(self, i: int, k: int, reach: float) -> Array:
        """The turn of shot k within reach that correlates best with shot i."""
        ticks = np.arange(-reach, reach + _STEP / 2, _STEP)
        vectors = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(
            -1, 3
        )
        mine, other = self.layers[i], self.layers[k]
        a, b = (np.clip(_blur(layer.signal, 1.5), -0.5, 0.5) for layer in (mine, other))
        near = other.weight > 0
        for vector in vectors[np.abs(vectors).min(axis=1) > reach - _STEP / 2]:
            near |= self._nearest(other.weight, self.directions @ _turn(vector)) > 0
        usable = np.flatnonzero(near & (mine.weight > 0))
        usable = np.random.default_rng(0).permutation(usable)[:_SAMPLES]
        d = self.directions.reshape(-1, 3)[usable]
        a, solid = a.reshape(-1)[usable], self.solid.reshape(-1)[usable]
        least = 0.3 * float(solid[other.weight.reshape(-1)[usable] > 0].sum())
        scores = np.full(len(vectors), -1.0)
        for n, vector in enumerate(vectors):
            there = d @ _turn(vector)
            w = solid * (self._nearest(other.weight, there) > 0)
            c = self._nearest(b, there)
            square = float(w @ (a * a)) * float(w @ (c * c))
            if w.sum() > least and square > 0:
                scores[n] = float(w @ (a * c)) / math.sqrt(square)
        # the grid is coarse: the best few are refined before they are compared
        best, found = -math.inf, np.eye(3)
        pair = replace(self, layers=(mine, other), pairs=((0, 1),))
        for n in np.argsort(-scores)[:_CANDIDATES]:
            turns = pair.solve(np.stack([np.eye(3), _turn(vectors[n])]), 8)
            score = pair.significance(turns)
            if score > best:
                best, found = score, turns[1]
        return found

    def _nearest(self, field: Plane, d: Array) -> Plane:
        x, y = self._pixels(d)
        rows, columns = np.rint(y).astype(int), np.rint(x).astype(int)
        return field[np.clip(rows, 0, len(field) - 1), columns % self.width]

    def _pixels(self, d: Array) -> tuple[Plane, Plane]:
        """Of unit directions in the lat-long, single precision."""
        x, y, z = np.moveaxis(d.astype(np.float32), -1, 0)
        turn = np.float32(self.width / (2 * math.pi))
        column = np.float32(self.width / 2 - 0.5) - np.arctan2(x, z) * turn
        row = np.float32(self.width / 4 - 0.5) - np.arcsin(np.clip(y, -1, 1)) * turn
        return column, row

    def solve(self, turns: Array, rounds: int = 25) -> Array:
        """Gauss-Newton from `turns`."""
        turns = turns.copy()
        n = len(turns)
        for _ in range(rounds):
            normal, right, _ = self._normal(turns)
            if n == 1:
                return turns
            damping = 1e-6 * np.trace(normal) / len(normal) + 1e-300
            step = np.linalg.solve(normal + damping * np.eye(len(normal)), right).reshape(-1, 3)
            longest = float(np.linalg.norm(step, axis=1).max())
            step *= min(1.0, math.radians(8) / max(longest, 1e-12))
            for k in range(1, n):
                turns[k] = _turn(step[k - 1]) @ turns[k]
            if longest < 1e-3 * 2 * math.pi / self.width:
                break
        return turns

    def _normal(self, turns: Array, scatter: bool = False) -> tuple[Array, Array, Array]:
        """Normal equations over the turns of shots 1..; on request the sandwich's middle."""
        n = len(turns)
        normal, right = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
        middle = np.zeros((3 * n, 3 * n))
        views = self.views(turns)
        for i, j in self.pairs:
            (si, gi, wi), (sj, gj, wj) = views.sampled[i], views.sampled[j]
            w = views.solid * np.minimum(wi, wj)
            used = w > 0
            if not used.any():
                continue
            r = (si - sj)[used]
            # s(turn^-1 d) changes by -w . (d x grad s) for a further turn w
            jacobian = np.concatenate([-gi[used], gj[used]], axis=1)
            scale = 1.4826 * np.median(np.abs(r)) + 1e-9
            tukey = np.clip(1 - (r / (4.685 * scale)) ** 2, 0, None) ** 2
            weight = w[used] * tukey
            if not self.local:
                # variable projection: what a smooth ratio explains is taken out of both
                smooth = sh_basis(views.directions[used])
                both = np.column_stack([r, jacobian])
                gram = smooth.T @ (smooth * weight[:, None])
                gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
                fit = np.linalg.solve(gram, smooth.T @ (both * weight[:, None]))
                both -= smooth @ fit
                r, jacobian = both[:, 0], both[:, 1:]
            here = np.r_[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
            weighted = jacobian * weight[:, None]
            normal[np.ix_(here, here)] += weighted.T @ jacobian
            right[here] -= weighted.T @ r
            if not scatter:
                continue
            # neighbours err together: scores are summed over blocks first (cluster sandwich)
            _, of_block = np.unique(views.blocks[used], return_inverse=True)
            scores = np.zeros((int(of_block.max(initial=-1)) + 1, 6))
            np.add.at(scores, of_block, weighted * r[:, None])
            middle[np.ix_(here, here)] += scores.T @ scores
        return normal[3:, 3:], right[3:], middle[3:, 3:]

    def sigma(self, turns: Array) -> Array:
        """Standard errors about the worst axis, (N,), the first 0."""
        normal, _, middle = self._normal(turns, scatter=True)
        bread = np.linalg.pinv(normal, hermitian=True)
        covariance = bread @ middle @ bread
        # an axis without any gradient is open
        weakest = np.linalg.eigvalsh(normal)
        result = np.zeros(len(turns))
        for k in range(1, len(turns)):
            own = np.s_[3 * k - 3 : 3 * k]
            scatter = math.sqrt(max(float(np.linalg.eigvalsh(covariance[own, own])[-1]), 0.0))
            result[k] = math.hypot(scatter, _INTERPOLATION * 2 * math.pi / self.width)
        if weakest[0] <= 1e-9 * weakest[-1]:
            result[1:] = np.inf
        return result

    def significance(self, turns: Array) -> float:
        """Fisher's z of the correlation by the root of the overlap: a sliver proves little."""
        views = self.views(turns)
        shared = sum(
            float(views.solid[(views.sampled[i][2] > 0) & (views.sampled[j][2] > 0)].sum())
            for i, j in self.pairs
        )
        return math.atanh(min(self.correlation(turns), 0.999)) * math.sqrt(shared)

    def correlation(self, turns: Array) -> float:
        """Of the shots' contrasts where both see, over all pairs."""
        views = self.views(turns)
        ab = aa = bb = 0.0
        for i, j in self.pairs:
            (si, _, wi), (sj, _, wj) = views.sampled[i], views.sampled[j]
            w = views.solid * np.minimum(wi, wj)
            # bounded, so that one strong edge does not decide
            a, b = np.clip(si, -1, 1), np.clip(sj, -1, 1)
            ab += float((w * a * b).sum())
            aa += float((w * a * a).sum())
            bb += float((w * b * b).sum())
        return ab / math.sqrt(aa * bb) if aa > 0 and bb > 0 else 0.0


def _layer(luminance: Plane, weight: Plane, d: Array, width: int, local: bool) -> _Layer:
    import cv2

    size = (width, width // 2)
    seen = (weight > 0).astype(np.float32)
    positive = luminance[(luminance > 0) & (weight > 0)]
    floor = 1e-3 * float(np.median(positive)) if positive.size else 1.0
    share = cv2.resize(seen, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(luminance * seen, size, interpolation=cv2.INTER_AREA)
    level = np.maximum(mean / np.maximum(share, 1e-6), 0) + max(floor, 1e-30)
    log = np.log(level).astype(np.float32)
    inside = _shrunk((share > 0.999).astype(np.float32), 1)
    if local:  # less the mean over some 6 pixels, the seen ones alone
        around = _blur(log * inside, 3.0) / np.maximum(_blur(inside, 3.0), np.float32(1e-3))
        log = np.asarray(log - around, np.float32)
    share = np.maximum(_blur(inside, 0.7), np.float32(1e-3))
    signal = _blur(np.asarray(log * inside, np.float32), 0.7) / share * inside
    signal = np.asarray(signal, np.float32)
    down, right = _derivatives(signal)
    edge = _shrunk(inside, 2) * np.asarray(
        cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    )
    # grad s on the sphere: image right and down are unit tangents times cos lat and 1
    east = np.stack([-d[..., 2], np.zeros(d.shape[:2]), d[..., 0]], axis=-1)
    cosine = np.linalg.norm(east, axis=-1)
    east /= np.maximum(cosine, 1e-9)[..., None]
    south = np.cross(d, east)
    radian = width / (2 * math.pi)
    slope = right[..., None] * (radian / np.maximum(cosine, 0.05))[..., None] * east
    slope = slope + (down * radian)[..., None] * south
    edge = np.where(cosine > 0.05, edge, 0)  # the poles' rows have no gradient of their own
    gradient = np.cross(d, slope)
    return _Layer(
        signal.astype(np.float32), gradient.astype(np.float32), edge.astype(np.float32)
    )


def _wrapped(plane: Plane, pad: int) -> Plane:
    return np.concatenate([plane[:, -pad:], plane, plane[:, :pad]], axis=1)


def _shrunk(plane: Plane, pixels: int) -> Plane:
    """A mask without its outermost pixels."""
    import cv2

    kernel = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    wide = cv2.erode(_wrapped(plane, 2 * pixels), kernel)
    return np.asarray(wide, np.float32)[:, 2 * pixels : -2 * pixels]


def _blur(plane: Plane, sigma: float) -> Plane:
    import cv2

    pad = math.ceil(4 * sigma)
    wide = cv2.GaussianBlur(_wrapped(plane, pad), (0, 0), sigma)
    return np.asarray(wide, np.float32)[:, pad:-pad]


def _derivatives(plane: Plane) -> tuple[Array, Array]:
    wide = _wrapped(plane, 2)
    down = np.gradient(wide, axis=0)[:, 2:-2]
    right = np.gradient(wide, axis=1)[:, 2:-2]
    return np.asarray(down, float), np.asarray(right, float)


def _turn(vector: Array) -> Array:
    return Pose.from_rotation_vector(vector, np.zeros(3)).rotation
