"""Where each frame looked: features, pairs, and one adjustment over all (seeds.md F1s).

>>> found = orient([detect(perceptual(r)) for r in frames], camera)      # doctest: +SKIP
>>> found.rotations                                                      # doctest: +SKIP
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.stitch.features import RATIO, Features, match
from chromeball.envmap.stitch.graph import groups, level, spread, to_prior
from chromeball.envmap.stitch.lens import (
    KNOWN,
    Freedom,
    pixel_focal,
    refinable,
    scaled_focal,
)
from chromeball.envmap.stitch.pairs import LEAST, Link, believable, find_rotations
from chromeball.envmap.stitch.rotations import Adjusted, Matches, adjust, log
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

#: Features of a frame that look for partners when nothing says where it looked.
BLIND = 1000
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


@dataclass(frozen=True)
class Oriented:
    """All frames in one world.

    ``adjusted`` holds rotations, lens, residuals and errors; ``matches`` what they come from;
    ``groups`` frames that hang together by matches, largest first; ``refused`` pairs whose
    pictures match in a way that the other frames or the tracker contradict; ``doubted`` frames
    whose tracker reading the pictures contradict; ``notes`` all of it in sentences.
    """

    adjusted: Adjusted
    matches: Matches
    groups: tuple[tuple[int, ...], ...]
    refused: tuple[tuple[int, int], ...]
    doubted: tuple[int, ...]
    notes: tuple[str, ...]

    @property
    def rotations(self) -> Array:
        """world_from_camera, (N, 3, 3)."""
        return self.adjusted.rotations

    @property
    def camera(self) -> CameraModel:
        """The lens, refined."""
        return self.adjusted.camera


def orient(
    features: Sequence[Features],
    camera: CameraModel,
    *,
    freedom: Freedom = KNOWN,
    prior: Prior | None = None,
    names: Sequence[str] | None = None,
    seed: int = 1,
    progress: Callable[[str], None] | None = None,
) -> Oriented:
    """Rotations of all frames and the lens they share.

    With `freedom.focal` the focal length is searched first, from .6 to 1.7 times the given.
    Without a `prior` the world stands upright as the frames do, the first one ahead (+Z).

    Raises
    ------
    UserError
        When frames do not hang together and no tracker says how they lie, naming them.

    """
    count = len(features)
    names = [str(k + 1) for k in range(count)] if names is None else names
    say = progress or (lambda text: None)
    rng = np.random.default_rng(seed)
    notes: list[str] = []
    if freedom.count:
        camera, _ = refinable(camera)
    known = np.zeros(count, bool) if prior is None else np.isfinite(prior.sigma)
    links: list[Link] = []
    if prior is not None:
        say("matching where the tracker says that frames overlap")
        links = _tracked_links(features, camera, prior, freedom, rng)
    blind = (
        [k for group in groups(count, _pairs_of(links))[1:] for k in group]
        if links
        else list(range(count))
    )
    if blind and count > 1:
        say(f"matching {len(blind)} frames with all others")
        found, camera, searched = _blind_links(features, camera, blind, freedom, rng)
        notes += searched
        links += found
    tolerance = _tolerance(camera, freedom)
    start, kept, refused = spread(count, links, 2 * tolerance)
    parts = groups(count, _pairs_of(kept))
    if len(parts) > 1 and blind:
        say(f"looking harder for {sum(map(len, parts[1:]))} frames that nothing connects yet")
        kept += _rescued(features, camera, parts, start, tolerance, rng)
        start, kept, again = spread(count, kept, 2 * tolerance)
        refused += again
        parts = groups(count, _pairs_of(kept))
    start = _placed(start, parts, prior, known, names, notes)
    gates = [4 * tolerance, 1.5 * tolerance] if freedom.count else [1.5 * tolerance]
    matches = _matches(features, kept)
    adjusted = _adjust(matches, start, camera, freedom, prior, count)
    for gate in gates:
        say("matching again, where the frames are now known to overlap")
        rotations = start if adjusted is None else adjusted.rotations
        lens = camera if adjusted is None else adjusted.camera
        kept = _guided(features, lens, rotations, gate, rng)
        matches = _matches(features, kept)
        adjusted = _adjust(matches, rotations, lens, freedom, prior, count)
    if adjusted is None:
        adjusted = _unmatched(start, camera, prior)
    inlying = matches.frames[adjusted.inliers]
    pairs, counts = np.unique(inlying.reshape(-1, 2), axis=0, return_counts=True)
    linked = [(int(i), int(j)) for (i, j), n in zip(pairs, counts, strict=True) if n >= LEAST]
    parts = groups(count, linked)
    if prior is None:
        if len(parts) > 1:
            raise _apart(parts, names)
        turned = level(adjusted.rotations) @ adjusted.rotations
        adjusted = replace(adjusted, rotations=turned)
    doubted = _doubted(adjusted, prior, parts, names, notes)
    if len(parts) > 1:
        alone = ["+".join(names[k] for k in part) for part in parts[1:]]
        notes.append(
            f"placed by the tracker alone, no picture connects them: {', '.join(alone)}"
        )
    wrong = sorted({(ln.first, ln.second) for ln in refused} - set(linked))
    if wrong:
        listed = ", ".join(f"{names[i]}-{names[j]}" for i, j in wrong[:6])
        more = f" and {len(wrong) - 6} more" if len(wrong) > 6 else ""
        notes.append(
            f"these pairs look alike but the other frames contradict them (repeats?): "
            f"{listed}{more}"
        )
    return Oriented(
        adjusted=adjusted,
        matches=matches,
        groups=tuple(tuple(part) for part in parts),
        refused=tuple(wrong),
        doubted=doubted,
        notes=tuple(notes),
    )


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


# ---- pairs


def _tolerance(camera: CameraModel, freedom: Freedom) -> float:
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


def _rescued(
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


def _tracked_links(
    features: Sequence[Features],
    camera: CameraModel,
    prior: Prior,
    freedom: Freedom,
    rng: np.random.Generator,
) -> list[Link]:
    """Links between frames that the tracker says overlap, near its rotations."""
    tolerance = _tolerance(camera, freedom)
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


def _blind_links(
    features: Sequence[Features],
    camera: CameraModel,
    frames: Sequence[int],
    freedom: Freedom,
    rng: np.random.Generator,
) -> tuple[list[Link], CameraModel, list[str]]:
    """Links of `frames` with all others, wherever they may look, and the lens they want."""
    few = [_subset(f, np.arange(min(len(f.pixels), BLIND))) for f in features]
    chosen = set(frames)
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
    tolerance = _tolerance(camera, freedom)
    directions = [camera.unproject(f.pixels) for f in few]
    links: list[Link] = []
    for pair, found in matched.items():
        links += _links_of(few, directions, camera, pair, found, tolerance, rng, 3)
    return links, camera, notes


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


def _guided(
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


def _matches(features: Sequence[Features], links: Sequence[Link]) -> Matches:
    """The matches of all links in one list; large features are placed less exactly."""
    frames, first, second, sigma = [], [], [], []
    for link in links:
        a, b = features[link.first], features[link.second]
        i, j = link.matches.T
        frames.append(np.tile([link.first, link.second], (len(i), 1)))
        first.append(a.pixels[i])
        second.append(b.pixels[j])
        sigma.append(np.sqrt(1 + (a.scale[i] ** 2 + b.scale[j] ** 2) / 32))
    if not frames:
        empty = np.zeros((0, 2))
        return Matches(np.zeros((0, 2), np.int64), empty, empty, np.zeros(0))
    return Matches(
        np.concatenate(frames),
        np.concatenate(first),
        np.concatenate(second),
        np.concatenate(sigma),
    )


def _adjust(
    matches: Matches,
    start: Array,
    camera: CameraModel,
    freedom: Freedom,
    prior: Prior | None,
    count: int,
) -> Adjusted | None:
    if len(matches.frames) == 0:
        return None
    return adjust(
        matches,
        start,
        camera,
        freedom=freedom,
        prior=None if prior is None else prior.rotations,
        prior_sigma=None if prior is None else prior.sigma,
    )


def _unmatched(start: Array, camera: CameraModel, prior: Prior | None) -> Adjusted:
    """No picture matches another: the tracker's word alone."""
    count = len(start)
    sigma = np.full(count, math.inf) if prior is None else prior.sigma
    return Adjusted(
        rotations=start,
        camera=camera,
        inliers=np.zeros(0, bool),
        residuals=np.zeros(0),
        sigma=sigma,
        lens_sigma=np.zeros(0),
        condition=math.inf,
        prior_residual=np.zeros(count),
        iterations=0,
    )


# ---- the tracker against the pictures


def _pairs_of(links: Sequence[Link]) -> list[tuple[int, int]]:
    return [(link.first, link.second) for link in links]


def _apart(parts: Sequence[Sequence[int]], names: Sequence[str]) -> UserError:
    listed = "; ".join(", ".join(names[k] for k in part) for part in parts)
    return UserError(
        f"the frames fall into {len(parts)} groups that no picture connects: {listed}. Give "
        "--directions or --yaw, add frames between them, or stitch the groups alone"
    )


def _placed(
    start: Array,
    parts: Sequence[Sequence[int]],
    prior: Prior | None,
    known: NDArray[np.bool_],
    names: Sequence[str],
    notes: list[str],
) -> Array:
    """Each group turned to where the tracker saw it."""
    if prior is None:
        if len(parts) > 1:
            raise _apart(parts, names)
        return start
    placed = start.copy()
    for part in parts:
        have = [k for k in part if known[k]]
        if not have:
            raise UserError(
                f"{', '.join(names[k] for k in part)}: no picture connects them to the others, "
                "and no direction is given; add frames between them, or leave them out"
            )
        turn, agree = to_prior(start, prior.rotations, prior.sigma, part)
        for k in part:
            placed[k] = turn @ start[k]
        if len(have) > 2 and 2 * len(agree) <= len(have):
            notes.append(
                f"the tracker agrees with the pictures in {len(agree)} of {len(have)} frames "
                "only: check its axes, or whether it was disturbed"
            )
    return placed


def _doubted(
    adjusted: Adjusted,
    prior: Prior | None,
    parts: Sequence[Sequence[int]],
    names: Sequence[str],
    notes: list[str],
) -> tuple[int, ...]:
    """Frames whose tracker reading lies far from what the pictures say."""
    if prior is None:
        return ()
    off, sigma = adjusted.prior_residual, prior.sigma
    with np.errstate(invalid="ignore"):
        far = np.isfinite(off) & (off > 4 * sigma * math.sqrt(3))
    doubted = tuple(int(k) for k in np.flatnonzero(far))
    if doubted:
        listed = ", ".join(f"{names[k]} by {math.degrees(off[k]):.1f}" for k in doubted)
        notes.append(f"the tracker is wrong in these frames, degrees: {listed}")
    fine = [k for k in range(len(off)) if np.isfinite(off[k]) and k not in doubted]
    if len(fine) < 4:
        return doubted
    rms = math.sqrt(float(np.mean(off[fine] ** 2)) / 3)
    given = math.sqrt(float(np.mean(sigma[fine] ** 2)))
    turned = log(adjusted.rotations[fine] @ np.swapaxes(prior.rotations[fine], 1, 2))
    slope = np.polyfit(np.array(fine, float), turned, 1)[0]
    drift = float(np.linalg.norm(slope)) * (fine[-1] - fine[0])
    if drift > 4 * given * math.sqrt(12 / len(fine)):
        notes.append(
            f"the tracker drifts by {math.degrees(drift):.1f} degrees from first to last frame"
        )
    elif rms > 1.5 * given:  # 1 in 1000 for 7 frames
        notes.append(
            f"the tracker scatters by {math.degrees(rms):.2f} degree an axis, not "
            f"{math.degrees(given):.2f}"
        )
    return doubted
