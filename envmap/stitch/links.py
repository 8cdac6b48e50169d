"""Which frames show the same, and how they are turned to each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.stitch.features import RATIO, Features, match
from chromeball.envmap.stitch.lens import Freedom, pixel_focal, refinable, scaled_focal
from chromeball.envmap.stitch.pairs import LEAST, Link, believable, find_rotations
from chromeball.envmap.stitch.rotations import angle_between
from chromeball.scene.camera import CameraModel

type Array = NDArray[np.float64]

#: Features of a frame that look for partners when nothing says where it looked.
BLIND = 1000
#: Share of the best rotation's matches with which another one is as likely.
ALIKE = 0.3
#: Ratio test where the place is known to a degree.
GUIDED_RATIO = 0.85
#: Focal lengths that are tried where the lens is not certain, times the given one.
FOCALS = np.exp(np.linspace(math.log(0.6), math.log(1.7), 15))


@dataclass(frozen=True)
class Prior:
    """What a tracker or the session says: ``rotations`` (N, 3, 3) world_from_camera.

    ``sigma`` (N,) radians an axis, infinite for frames that it says nothing about.
    """

    rotations: Array
    sigma: Array


def overlapping(rotations: Array, camera: CameraModel, reach: float) -> list[tuple[int, int]]:
    """Pairs of frames that see common directions, or such as lie within `reach` radians."""
    width, height = camera.size
    x, y = np.meshgrid(np.linspace(0, width - 1, 13), np.linspace(0, height - 1, 11))
    d = camera.unproject(np.stack([x.ravel(), y.ravel()], axis=-1))
    d = d[np.isfinite(d).all(axis=1)]
    if len(d) == 0:
        return []
    step = 1.5 * max(width / 12, height / 10) / pixel_focal(camera)
    near = math.cos(min(step + reach, math.pi))
    world = np.einsum("nab,mb->nma", rotations, d)
    return [
        (i, j)
        for i in range(len(rotations))
        for j in range(i + 1, len(rotations))
        if (world[i] @ world[j].T).max() > near
    ]


def tolerance_of(camera: CameraModel, freedom: Freedom) -> float:
    """How far matches of a right rotation may lie apart, radians."""
    pixels = 3 / pixel_focal(camera)
    return max(math.radians(0.25), pixels) + (math.radians(0.8) if freedom.count else 0.0)


def _links_of(
    features: Sequence[Features],
    directions: Sequence[Array],
    camera: CameraModel,
    pair: tuple[int, int],
    found: NDArray[np.int64],
    tolerance: float,
    rng: np.random.Generator,
    most: int,
) -> list[Link]:
    """Believable rotations between two frames from their matches, best first."""
    i, j = pair
    if len(found) < LEAST:
        return []
    a, b = directions[i][found[:, 0]], directions[j][found[:, 1]]
    result: list[Link] = []
    for rotation, agree in find_rotations(a, b, tolerance, rng, most):
        seen = camera.project(np.nan_to_num(b) @ rotation.T)
        inside = _inside(seen, camera.size)
        if believable(int(agree.sum()), int((inside | agree).sum())):
            result.append(Link(i, j, rotation, found[agree], len(found)))
    return result


def _near(
    features: Sequence[Features],
    directions: Sequence[Array],
    camera: CameraModel,
    rotations: tuple[Array, Array],
    pair: tuple[int, int],
    gate: float,
    ratio: float,
) -> NDArray[np.int64]:
    """Matches of two frames within `gate` radians of where `rotations` put them."""
    i, j = pair
    a, b = directions[i] @ rotations[0].T, directions[j] @ rotations[1].T
    # only what the other frame can see
    of_a = _sees(camera, a @ rotations[1], gate)
    of_b = _sees(camera, b @ rotations[0], gate)
    found = match(
        _subset(features[i], of_a), _subset(features[j], of_b), (a[of_a], b[of_b]), gate, ratio
    )
    return np.stack([of_a[found[:, 0]], of_b[found[:, 1]]], axis=1)


def _sees(camera: CameraModel, directions: Array, gate: float) -> NDArray[np.intp]:
    """Which directions (N, 3) in camera axes a camera sees, give or take `gate` radians."""
    width, height = camera.size
    x, y = np.meshgrid(np.linspace(0, width - 1, 13), np.linspace(0, height - 1, 9))
    grid = camera.unproject(np.stack([x.ravel(), y.ravel()], axis=-1))
    grid = grid[np.isfinite(grid).all(axis=1)].astype(np.float32)
    step = 0.75 * max(width / 12, height / 8) / pixel_focal(camera)
    near = np.nan_to_num(directions).astype(np.float32) @ grid.T
    return np.flatnonzero(near.max(axis=1, initial=-1) > math.cos(min(gate + step, math.pi)))


def rescued_links(
    features: Sequence[Features],
    camera: CameraModel,
    parts: Sequence[Sequence[int]],
    rotations: Array,
    tolerance: float,
    rng: np.random.Generator,
) -> list[Link]:
    """Links of lone frames with the largest group, whose frames vote together.

    A frame of sky has few features in common with each neighbour, but enough with all.
    """
    directions = [camera.unproject(f.pixels) for f in features]
    links: list[Link] = []
    for lone in (k for part in parts[1:] for k in part):
        matches = {i: match(features[i], features[lone]) for i in parts[0]}
        world = np.concatenate(
            [directions[i][m[:, 0]] @ rotations[i].T for i, m in matches.items()]
        )
        own = np.concatenate([directions[lone][m[:, 1]] for m in matches.values()])
        for turn, agree in find_rotations(world, own, tolerance, rng, 1):
            if not believable(int(agree.sum()), 0) or agree.sum() < 2 * LEAST:
                continue
            ends = np.cumsum([len(m) for m in matches.values()])
            chosen = np.split(agree, ends[:-1])
            for (i, m), own_agree in zip(matches.items(), chosen, strict=True):
                if own_agree.any():
                    a, b = min(i, lone), max(i, lone)
                    relative = rotations[i].T @ turn
                    turned = relative if a == i else relative.T
                    pairs = m[own_agree] if a == i else m[own_agree][:, ::-1]
                    links.append(Link(a, b, turned, pairs, len(m)))
    return links


def _inside(pixels: Array, size: tuple[int, int]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return ((pixels > -0.5) & (pixels < np.array(size) - 0.5)).all(axis=-1)


def tracked_links(
    features: Sequence[Features],
    camera: CameraModel,
    prior: Prior,
    freedom: Freedom,
    rng: np.random.Generator,
) -> list[Link]:
    """Links between frames that the tracker says overlap, near its rotations."""
    tolerance = tolerance_of(camera, freedom)
    directions = [camera.unproject(f.pixels) for f in features]
    known = np.flatnonzero(np.isfinite(prior.sigma))
    widest = float(prior.sigma[known].max(initial=0))
    links: list[Link] = []
    for a, b in overlapping(prior.rotations[known], camera, 3 * widest):
        i, j = int(known[a]), int(known[b])
        gate = 4 * math.hypot(prior.sigma[i], prior.sigma[j]) + tolerance
        if freedom.focal:
            gate += math.radians(4)
        turned = prior.rotations[i], prior.rotations[j]
        found = _near(features, directions, camera, turned, (i, j), gate, RATIO)
        links += _links_of(features, directions, camera, (i, j), found, tolerance, rng, 1)
    return links


def blind_links(
    features: Sequence[Features],
    camera: CameraModel,
    frames: Sequence[int],
    freedom: Freedom,
    rng: np.random.Generator,
) -> tuple[list[Link], CameraModel, list[str]]:
    """Links of `frames` with all others, wherever they may look, and the lens they want."""
    few = [_subset(f, np.arange(min(len(f.pixels), BLIND))) for f in features]
    chosen, given = set(frames), camera
    matched: dict[tuple[int, int], NDArray[np.int64]] = {}
    for i in range(len(few)):
        for j in range(i + 1, len(few)):
            if i in chosen or j in chosen:
                found = match(few[i], few[j])
                if len(found) >= LEAST:
                    matched[i, j] = found
    notes: list[str] = []
    if freedom.focal and matched:
        camera, notes = _search_focal(few, camera, matched, rng)
    tolerance = tolerance_of(camera, freedom)
    directions = [camera.unproject(f.pixels) for f in few]
    links: list[Link] = []
    for pair, found in matched.items():
        links += _links_of(few, directions, camera, pair, found, tolerance, rng, 3)
    if not links:  # chance agreements say nothing of the lens
        return [], given, []
    return links, camera, notes


def look_alike(links: Sequence[Link], tolerance: float) -> list[tuple[int, int]]:
    """Pairs of frames that fit each other in several ways, nearly as well: repeats."""
    best: dict[tuple[int, int], Link] = {}
    doubtful: set[tuple[int, int]] = set()
    for link in sorted(links, key=lambda link: -len(link.matches)):
        pair = (link.first, link.second)
        first = best.setdefault(pair, link)
        apart = angle_between(first.rotation[None], link.rotation[None])[0]
        if apart > 10 * tolerance and len(link.matches) > ALIKE * len(first.matches):
            doubtful.add(pair)
    return sorted(doubtful)


def likeliest(
    features: Sequence[Features], cameras: Sequence[CameraModel], seed: int = 1
) -> CameraModel:
    """The lens of `cameras`, and the focal length, that most matches agree with."""
    rng = np.random.default_rng(seed)
    few = [_subset(f, np.arange(min(len(f.pixels), BLIND))) for f in features]
    matched: dict[tuple[int, int], NDArray[np.int64]] = {}
    for i in range(len(few)):
        for j in range(i + 1, min(i + 4, len(few))):  # neighbours in time are so in space
            matched[i, j] = match(few[i], few[j])
    best: tuple[int, CameraModel] | None = None
    for camera in cameras:
        lens, _ = refinable(camera)
        votes = _votes(few, lens, matched, rng)
        k = int(np.argmax(votes))
        if best is None or votes[k] > best[0]:
            best = votes[k], scaled_focal(lens, float(FOCALS[k]))
    if best is None:
        raise ValueError("no lens to choose from")
    return best[1]


def _votes(
    features: Sequence[Features],
    camera: CameraModel,
    matched: dict[tuple[int, int], NDArray[np.int64]],
    rng: np.random.Generator,
) -> list[int]:
    """How many matches of the best pairs agree on rotations, for each of `FOCALS`."""
    best = sorted(matched, key=lambda pair: -len(matched[pair]))[:10]
    votes: list[int] = []
    for factor in FOCALS:
        lens = scaled_focal(camera, float(factor))
        total = 0
        for i, j in best:
            found = matched[i, j][:300]
            a = lens.unproject(features[i].pixels[found[:, 0]])
            b = lens.unproject(features[j].pixels[found[:, 1]])
            # in pixels: a short lens makes all angles large
            for _, agree in find_rotations(a, b, 8 / pixel_focal(lens), rng, 1):
                total += int(agree.sum())
        votes.append(total)
    return votes


def _search_focal(
    features: Sequence[Features],
    camera: CameraModel,
    matched: dict[tuple[int, int], NDArray[np.int64]],
    rng: np.random.Generator,
) -> tuple[CameraModel, list[str]]:
    """The focal length with which most matches of the best pairs agree on rotations."""
    votes = _votes(features, camera, matched, rng)
    k = int(np.argmax(votes))
    if votes[k] < 1.15 * votes[int(np.argmin(np.abs(FOCALS - 1)))]:
        return camera, []
    factor = float(FOCALS[k])
    note = f"the pictures ask for about {factor:.2f} times the focal length that was given"
    return scaled_focal(camera, factor), [note]


def _subset(features: Features, chosen: NDArray[np.intp]) -> Features:
    return replace(
        features,
        pixels=features.pixels[chosen],
        scale=features.scale[chosen],
        descriptors=features.descriptors[chosen],
    )


def guided_links(
    features: Sequence[Features],
    camera: CameraModel,
    rotations: Array,
    gate: float,
    rng: np.random.Generator,
) -> list[Link]:
    """Links of all frames that overlap, matches within `gate` of where they should be."""
    directions = [camera.unproject(f.pixels) for f in features]
    links: list[Link] = []
    for i, j in overlapping(rotations, camera, 0.0):
        turned = rotations[i], rotations[j]
        found = _near(features, directions, camera, turned, (i, j), gate, GUIDED_RATIO)
        links += _links_of(features, directions, camera, (i, j), found, gate / 2, rng, 1)
    return links
