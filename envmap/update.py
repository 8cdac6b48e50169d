"""A map brought up to date from frames taken later (seeds.md A7; Aalborg 2004, section 8.5).

Three models of what has changed, from simple to rich: one factor for all light, one for each
lamp, one for each region of the sphere. The simplest whose cross-validated error is within two
standard errors of the best one's is taken (after Breiman, Friedman, Olshen, Stone 1984).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal
from typing import cast as cast_type

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.irradiance import spread_directions
from chromeball.envmap.lamps import find_lamps
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.predict import Comparison, predict
from chromeball.envmap.robust import Blocks, Fit, fit, residuals
from chromeball.envmap.several import Cast, ProbeMap
from chromeball.envmap.shading import Sources, find_sources, owners
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
type Kind = Literal["global", "lamps", "regions"]

#: By how much lamps and regions may differ from the whole, as prior standard deviations: a lamp
#: may be switched off, a region differs mildly.
_LAMPS = 3.0
_REGIONS = (0.15, 0.8)
#: Regions of the sphere, and how sharp they are (1 / variance of the angle's chord).
_COUNT, _SHARP = 32, 6.0
_FOLDS = 4
#: A block that differs by more standard errors than these is not explained.
_STRANGE = 4.685
#: A richer model has to be better by this part to be worth it.
_MATTERS = 0.05
#: A loss that is none: the frames are explained.
_NOTHING = 1e-3


@dataclass(frozen=True)
class Model:
    """A way in which light may have changed.

    ``names`` of its K factors; ``design`` (N, K, 3): how the blocks follow them; ``spread``:
    their prior standard deviation about the global factor, None for no prior.
    """

    kind: Kind
    names: tuple[str, ...]
    design: Array
    spread: float | None


@dataclass(frozen=True)
class Candidate:
    """A fitted model; ``score``: cross-validated bounded loss, mean over blocks, (N,) each."""

    model: Model
    fit: Fit
    losses: Array

    @property
    def score(self) -> float:
        """Mean of the losses."""
        return float(self.losses.mean())


@dataclass(frozen=True)
class Change:
    """What has changed: the models tried, ``chosen`` among them, ``why`` in words."""

    tried: tuple[Candidate, ...]
    chosen: Candidate
    whole: Fit
    why: str
    sources: Sources | None


@dataclass(frozen=True)
class Strange:
    """Something that the updated map does not explain, seen in one direction.

    ``ratio``: seen over expected luminance; ``solid_angle`` sr; ``energy`` (3,): what is seen
    more, L dOmega; ``pixel`` (2,) in frame number ``frame``.
    """

    direction: Array
    ratio: float
    solid_angle: float
    energy: Array
    frame: int
    pixel: Array


def find_change(
    env: ProbeMap,
    comparisons: Sequence[Comparison],
    cast: Cast | None = None,
    kind: Kind | None = None,
) -> Change:
    """The change that explains frames of one moment; `kind` forbids all but one model.

    Raises
    ------
    UserError
        When too little of the frames shows what the map holds; for lamps where there are none.

    """
    blocks = joined(comparisons)
    n = len(blocks.seen)
    directions = np.concatenate([c.directions for c in comparisons])
    even = Model("global", ("all",), np.ones((n, 1, 3)), None)
    whole = fit(blocks, even.design, None, 1.0)
    g = whole.s[0]
    models, sources = [even], None
    if kind in (None, "lamps"):
        try:
            sources = find_sources(env, cast) if cast is not None else None
            model = _lamps(env, comparisons, cast, sources)
            models.append(model)
        except UserError:
            if kind == "lamps":
                raise
    if kind in (None, "regions"):
        phi = np.repeat(regions(directions)[..., None], 3, axis=2)
        names = tuple(f"region {k + 1}" for k in range(_COUNT))
        models += [Model("regions", names, phi, spread) for spread in _REGIONS]
    folds = _folds(comparisons)
    fits = [
        fit(blocks, m.design, None if m.spread is None else g, m.spread or 1.0) for m in models
    ]
    unit = min(f.scale for f in fits)
    tried = tuple(
        Candidate(m, f, _validated(blocks, m, folds, unit))
        for m, f in zip(models, fits, strict=True)
    )
    chosen, why = _choose(tried, kind)
    return Change(tried, chosen, whole, why, sources)


def joined(comparisons: Sequence[Comparison]) -> Blocks:
    """The blocks of all frames."""
    parts = [c.blocks for c in comparisons]
    return Blocks(
        np.concatenate([b.seen for b in parts]),
        np.concatenate([b.predicted for b in parts]),
        np.concatenate([b.sigma for b in parts]),
    )


def regions(directions: Array) -> Array:
    """Shares of the regions in unit directions (..., 3): (..., K), sums are 1; smooth."""
    centres = spread_directions(_COUNT)
    bell = np.exp(_SHARP * (directions @ centres.T - 1))
    return bell / bell.sum(axis=-1, keepdims=True)


def ratio_map(env: ProbeMap, change: Change, cast: Cast | None) -> Picture:
    """By what the map is multiplied, (H, W, 3)."""
    height, width = env.radiance.shape[:2]
    s, model = change.chosen.fit.s, change.chosen.model
    if model.kind == "global":
        return np.broadcast_to(s[0], env.radiance.shape).astype(np.float32)
    import cv2

    coarse = LatLong((128, 64))
    d = coarse.directions()
    if model.kind == "regions":
        small = regions(d) @ s
    elif change.sources is None or cast is None:
        small = np.broadcast_to(s[-1], (64, 128, 3))
    else:
        small = _shaded(env, change.sources, cast, d.reshape(-1, 3), s).reshape(64, 128, 3)
    # bilinear across the seam
    wide = np.pad(small.astype(np.float32), ((0, 0), (4, 4), (0, 0)), mode="wrap")
    scale = width / 128
    x, y = np.meshgrid(
        (np.arange(width, dtype=np.float32) + 0.5) / scale - 0.5 + 4,
        (np.arange(height, dtype=np.float32) + 0.5) / scale - 0.5,
    )
    ratio = np.asarray(
        cv2.remap(wide, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
    )
    if model.kind == "lamps":
        owner = _owner(env, change.sources)
        own = owner >= 0
        ratio[own] = s[owner[own]]
    return ratio


def strange(
    comparisons: Sequence[Comparison], change: Change, most: int = 5
) -> tuple[list[Strange], float]:
    """What the change leaves unexplained, largest first, and its share of the blocks.

    Neighbouring blocks make one thing.
    """
    from scipy import ndimage

    blocks, chosen = joined(comparisons), change.chosen
    design, s = chosen.model.design, chosen.fit.s
    expected = np.einsum("nkc,kc->nc", design * blocks.predicted[:, None, :], s)
    off = residuals(blocks, design, s) / chosen.fit.scale > _STRANGE
    found: list[Strange] = []
    start = 0
    for number, c in enumerate(comparisons):
        part = np.s_[start : start + len(c.pixels)]
        start += len(c.pixels)
        cells = (c.pixels // c.side).astype(int)
        grid = np.full(cells.max(axis=0) + 1, -1)
        grid[cells[:, 0], cells[:, 1]] = np.arange(len(cells))
        hot = np.zeros(grid.shape, bool)
        hot[cells[off[part], 0], cells[off[part], 1]] = True
        labels, count = cast_type(
            "tuple[NDArray[np.int32], int]", ndimage.label(hot, np.ones((3, 3)))
        )
        for k in range(1, count + 1):
            here = grid[labels == k]
            seen, before = blocks.seen[part][here], expected[part][here]
            solid = c.solid[here]
            more = solid @ (seen - before)
            weight = solid * (np.abs(seen - before) @ LUMINANCE)
            m = weight @ c.directions[here]
            found.append(
                Strange(
                    m / max(float(np.linalg.norm(m)), 1e-12),
                    float(solid @ (seen @ LUMINANCE))
                    / max(float(solid @ (before @ LUMINANCE)), 1e-12),
                    float(solid.sum()),
                    more,
                    number,
                    (weight @ c.pixels[here]) / max(float(weight.sum()), 1e-30),
                )
            )
    found.sort(key=lambda one: -abs(float(one.energy @ LUMINANCE)))
    return found[:most], float(off.mean())


def _lamps(
    env: ProbeMap,
    comparisons: Sequence[Comparison],
    cast: Cast | None,
    sources: Sources | None,
) -> Model:
    """Lamps where they are seen, and by the shading of surfaces where there is geometry."""
    owner = _owner(env, sources)
    names = sources.names if sources else (*(f"lamp {k + 1}" for k in range(owner.max() + 1)),)
    if owner.max() < 0 and not sources:
        raise UserError("no lamp stands out of the map: take global or regions")
    if sources is None:
        names = (*names, "everything else")
    k = len(names)
    parts: list[Array] = []
    for c in comparisons:
        q = c.directions
        share = np.zeros((len(q), k, 3))
        for j in range(int(owner.max()) + 1):  # prediction is linear in the map
            alone = np.where((owner == j)[..., None], env.radiance, np.float32(0))
            light, _ = predict(replace(env, radiance=alone), c.frame.camera, cast)
            share[:, j] = c.means(light) / np.maximum(c.blocks.predicted, 1e-30)
        share = np.clip(share, 0, 1)
        lit = np.minimum(share.sum(axis=1), 1)
        rest = np.zeros((len(q), k, 3))
        if sources is not None and cast is not None:
            near = np.isfinite(c.places[:, 0])
            rest[near] = sources.shares(c.places[near], c.normals[near], cast)
            if "sky" in names:
                rest[~near, names.index("sky")] = 1
            else:
                rest[~near] = np.nan
        else:
            rest[:, -1] = 1
        design = share + (1 - lit)[:, None, :] * rest
        parts.append(design)
    design = np.concatenate(parts)
    bad = ~np.isfinite(design).all(axis=(1, 2))
    design[bad] = 0  # explained by nothing: counts as moved
    return Model("lamps", names, design, _LAMPS)


def _owner(env: ProbeMap, sources: Sources | None) -> NDArray[np.int16]:
    if sources is not None:
        return sources.owner
    found, rest = find_lamps(env.radiance)
    return owners(env.radiance, rest, found)


def _shaded(env: ProbeMap, sources: Sources, cast: Cast, d: Array, s: Array) -> Array:
    """Factors of what the map shows in directions (N, 3), lamps apart."""
    t, n = cast(np.broadcast_to(env.origin, d.shape), d)
    met = np.isfinite(t)
    sky = s[sources.names.index("sky")] if "sky" in sources.names else np.ones(3)
    factors = np.broadcast_to(sky, d.shape).copy()
    points = env.origin + t[met, None] * d[met]
    shares = sources.shares(points, n[met], cast)
    unlit = ~np.isfinite(shares).all(axis=(1, 2))
    shares[unlit] = 1 / len(sources.names)
    factors[met] = np.einsum("nkc,kc->nc", shares, s)
    return factors


def _folds(comparisons: Sequence[Comparison]) -> NDArray[np.int64]:
    """Which part each block is left out with: squares of 3 x 3 blocks, by chance."""
    rng = np.random.default_rng(0)
    parts: list[NDArray[np.int64]] = []
    for c in comparisons:
        square = (c.pixels // (3 * c.side)).astype(int)
        table = rng.integers(0, _FOLDS, square.max(axis=0) + 1)
        parts.append(table[square[:, 0], square[:, 1]])
    return np.concatenate(parts)


def _validated(blocks: Blocks, model: Model, folds: NDArray[np.int64], unit: float) -> Array:
    """Bounded loss of each block by a fit without its fold."""
    losses = np.ones(len(folds))
    for k in range(_FOLDS):
        out = folds == k
        if not out.any() or (~out).sum() < 8:
            continue
        kept = Blocks(blocks.seen[~out], blocks.predicted[~out], blocks.sigma[~out])
        prior = None
        if model.spread is not None:
            even = np.ones((len(kept.seen), 1, 3))
            prior = fit(kept, even, None, 1.0).s[0]
        found = fit(kept, model.design[~out], prior, model.spread or 1.0)
        held = Blocks(blocks.seen[out], blocks.predicted[out], blocks.sigma[out])
        u = residuals(held, model.design[out], found.s) / unit
        losses[out] = np.minimum((u / _STRANGE) ** 2, 1)
    return losses


def _choose(tried: Sequence[Candidate], kind: Kind | None) -> tuple[Candidate, str]:
    if kind is not None:
        own = [c for c in tried if c.model.kind == kind]
        return min(own, key=lambda c: c.score), "asked for"
    best = min(tried, key=lambda c: c.score)
    for candidate in tried:
        difference = candidate.losses - best.losses
        error = float(difference.std()) / math.sqrt(len(difference))
        near = float(difference.mean()) <= max(2 * error, _MATTERS * best.score, _NOTHING)
        if near or candidate is best:
            why = (
                f"{candidate.model.kind}: cross-validated loss {candidate.score:.4g}, the "
                f"simplest within two standard errors of the best ({best.model.kind}, "
                f"{best.score:.4g})"
            )
            return candidate, why
    raise AssertionError("the best is among them")


def typical_error(comparisons: Sequence[Comparison], change: Change) -> float:
    """The median over blocks of what is left, relative to what is seen; luminance."""
    blocks = joined(comparisons)
    s, design = change.chosen.fit.s, change.chosen.model.design
    model = np.einsum("nkc,kc->nc", design * blocks.predicted[:, None, :], s)
    seen = blocks.seen @ LUMINANCE
    return float(np.median(np.abs(model @ LUMINANCE - seen) / np.maximum(seen, 1e-30)))
