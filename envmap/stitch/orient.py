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

from chromeball.envmap.stitch.features import Features
from chromeball.envmap.stitch.graph import groups, level, spread, to_prior
from chromeball.envmap.stitch.lens import KNOWN, Freedom, refinable
from chromeball.envmap.stitch.links import (
    Prior,
    blind_links,
    guided_links,
    look_alike,
    rescued_links,
    tolerance_of,
    tracked_links,
)
from chromeball.envmap.stitch.pairs import LEAST, Link
from chromeball.envmap.stitch.rotations import Adjusted, Matches, adjust, angle_between, log
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

#: Frames that are turned by less than this lie on each other, radians.
SAME = math.radians(2)


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
        links = tracked_links(features, camera, prior, freedom, rng)
    blind = (
        [k for group in groups(count, _pairs_of(links))[1:] for k in group]
        if links
        else list(range(count))
    )
    if blind and count > 1:
        say(f"matching {len(blind)} frames with all others")
        found, camera, searched = blind_links(features, camera, blind, freedom, rng)
        notes += searched
        links += found
    tolerance = tolerance_of(camera, freedom)
    alike = look_alike(links, tolerance) if prior is None else []
    if alike:
        listed = ", ".join(f"{names[i]}-{names[j]}" for i, j in alike[:6])
        more = f" and {len(alike) - 6} more" if len(alike) > 6 else ""
        notes.append(
            f"these frames fit each other in several ways (repeats?): {listed}{more}; look at "
            "the map, and say where they looked with --yaw or --directions"
        )
    start, kept, refused = spread(count, links, 2 * tolerance)
    parts = groups(count, _pairs_of(kept))
    if len(parts) > 1 and blind:
        say(f"looking harder for {sum(map(len, parts[1:]))} frames that nothing connects yet")
        kept += rescued_links(features, camera, parts, start, tolerance, rng)
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
        kept = guided_links(features, lens, rotations, gate, rng)
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
        notes += _same_way(adjusted.rotations)
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


def _same_way(rotations: Array) -> list[str]:
    """What is to be said of untracked frames most of which lie on others."""
    count = len(rotations)
    apart = angle_between(rotations[:, None], rotations[None]) + np.eye(count) * math.pi
    same = int((apart.min(axis=1) < SAME).sum())
    if same < max(2, count / 2):
        return []
    return [
        f"{same} of {count} frames look the same way: if the camera was turned between them, "
        "what it saw repeats (tiles, windows): say where it looked with --yaw or --directions"
    ]


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
