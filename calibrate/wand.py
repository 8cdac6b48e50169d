"""Cameras of a room from a light, or a wand with several, that all of them saw move.

No board and no order of the cameras is needed. Two-view geometries on rays start the solution
(:mod:`chromeball.calibrate.wand_start`); then poses, lights and, if unknown, lenses are
adjusted together (:mod:`chromeball.calibrate.wand_stages`). Scale comes from the wand's length
or from a distance of cameras; without both the unit is the distance of the first two cameras.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.wand_adjust import Bundle, Sightings
from chromeball.calibrate.wand_check import check_tracks, judge, lens_errors
from chromeball.calibrate.wand_lens import (
    MODELS,
    candidates,
    known,
    learned,
    refinable,
    unknown,
)
from chromeball.calibrate.wand_result import Tracks, WandRig
from chromeball.calibrate.wand_stages import Stages, at_delays, rays_of, spread
from chromeball.calibrate.wand_start import Start, ordered, place
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: By how much a ray may miss in the start, pixels: more and more, as cameras may not be
#: synchronous, and more where the lens is a guess.
MISSES = (3.0, 10.0, 30.0)
BLIND_MISSES = (6.0, 20.0)
#: Frames that the search for lenses looks at.
SEARCHED = 150
#: Two starts that end with focal lengths and errors so close found the same lenses.
SAME_FOCAL = 0.02
#: Lenses that were given are others' if free ones leave so small a share of the error.
WRONG_LENS = 0.4
#: Delays count if they shrink the error by this share.
LEAST_GAIN = 0.03
#: They are looked for if this share of the sightings has neighbours in time.
LEAST_TIMED = 0.3
MOST_TURNS = 8

type Lengths = tuple[tuple[int, int, float], ...]


def solve_wand(
    tracks: Tracks,
    cameras: tuple[CameraModel, ...] | None = None,
    *,
    model: str = "opencv4",
    refine: bool = False,
    lengths: Lengths = (),
    distance: tuple[int, int, float] | None = None,
    synchronous: bool = False,
) -> WandRig:
    """Poses of the cameras that saw the lights of `tracks`, and their lenses if not given.

    Parameters
    ----------
    tracks
        Where the cameras saw the lights.
    cameras
        Their lenses; None to estimate them: square pixels, a principal point near the middle.
    model
        What the lenses are then: pinhole, opencv4 or kb4.
    refine
        Estimate given lenses, too, from where they are.
    lengths
        Distances on the wand, (first light, second light, metres).
    distance
        Distance of two cameras, (first, second, metres), where there are no `lengths`.
    synchronous
        The cameras are known to be; else a constant delay of each is looked for.

    Raises
    ------
    UserError
        When the tracks do not determine the cameras; it says why.

    """
    if model not in MODELS:
        raise UserError(f"unknown lens model {model!r}; one of {', '.join(MODELS)}")
    check_tracks(tracks, cameras)
    reference, second = (0, 1) if distance is None else distance[:2]
    gauge = (reference, None if lengths else second)
    misses: tuple[float, ...] = MISSES
    blind = cameras is None
    if cameras is None:
        cameras = _search(tracks, model, lengths)
        free = unknown(cameras)
        misses = BLIND_MISSES
    else:
        free = unknown(cameras) if refine else known(cameras)
    start = _place(tracks, cameras, misses)
    pixels = _oriented(ordered(tracks.pixels, start.reversed), start.points, lengths)
    bundle = _bundle(cameras, start, gauge, lengths)
    stages = Stages(_sightings(tracks, pixels), free, *gauge, lengths)
    for level in free.levels:
        bundle = stages.robust(bundle, level)
    if not free.free:
        _check_given(stages, bundle, tracks)
    bundle, used = stages.settle(bundle)
    if blind:
        errors = lens_errors(stages, bundle, used)
        stages = replace(stages, lenses=learned(free, bundle.cameras, errors))
        bundle, used = stages.settle(bundle)
    delays = np.zeros(len(cameras), bool)
    if not synchronous:
        bundle, used, stages, delays = _delayed(bundle, used, stages, pixels)
    rig = judge(stages, bundle, used, delays, tracks)
    return rig if distance is None else rig.moved(Pose.identity(), distance[2])


# ---- start


def _place(
    tracks: Tracks, cameras: tuple[CameraModel, ...], misses: tuple[float, ...]
) -> Start:
    """All cameras, or a refusal that names those that could not be placed."""
    rays, angle = rays_of(cameras, tracks.pixels)
    start: Start | None = None
    for miss in misses:
        start = place(rays, miss * angle)
        if start is not None and start.placed.all():
            return start
    if start is None:
        raise UserError(
            "no two cameras saw the lights from different places in a way that one moving "
            "light explains: are the recordings of the same moment, the cameras apart?"
        )
    there, lost = (
        ", ".join(n for n, p in zip(tracks.names, start.placed, strict=True) if p == want)
        for want in (True, False)
    )
    raise UserError(
        f"{lost} cannot be placed beside {there}: move the lights where both see them, and "
        "check that its recording is of the same moment and its lens its own"
    )


def _bundle(
    cameras: tuple[CameraModel, ...],
    start: Start,
    gauge: tuple[int, int | None],
    lengths: Lengths,
) -> Bundle:
    """The start in the axes and the unit of the solution."""
    reference, baseline = gauge
    bundle = Bundle(
        cameras, start.rotations, start.translations, start.points, np.zeros(len(cameras))
    ).turned_to(reference)
    if baseline is not None:
        return bundle.scaled(1 / float(np.linalg.norm(bundle.centres()[baseline])))
    first, second, length = lengths[0]
    apart = np.linalg.norm(bundle.points[:, first] - bundle.points[:, second], axis=-1)
    return bundle.scaled(length / float(np.nanmedian(apart)))


def _oriented(
    pixels: NDArray[np.float64], points: NDArray[np.float64], lengths: Lengths
) -> NDArray[np.float64]:
    """Sightings (C, F, K, 2) with the wand's first light first: three tell which it is."""
    if points.shape[1] < 3 or not lengths:
        return pixels
    measured = [np.linalg.norm(points[:, i] - points[:, j], axis=-1) for i, j, _ in lengths]
    turned = points[:, ::-1]
    other = [np.linalg.norm(turned[:, i] - turned[:, j], axis=-1) for i, j, _ in lengths]
    truth = np.array([length for _, _, length in lengths])
    truth /= truth.sum()

    def off(found: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        share = np.array(found) / np.sum(found, axis=0)
        return np.abs(share - truth[:, None]).sum(axis=0)

    swap = off(other) < off(measured)
    points[swap] = turned[swap]
    return np.where(swap[:, None, None], pixels[:, :, ::-1], pixels)


def _search(tracks: Tracks, model: str, lengths: Lengths) -> tuple[CameraModel, ...]:
    """Lenses of the field of view under which the lights fit best, focal lengths refined."""
    seen = tracks.seen()
    frames = np.flatnonzero(seen.sum(axis=0) >= 2)
    some = frames[:: max(1, len(frames) // SEARCHED)]
    pixels = tracks.pixels[:, some]
    tried: list[tuple[float, tuple[CameraModel, ...]]] = []
    for miss, cameras in product(BLIND_MISSES, candidates(model, tracks.sizes)):
        if tried and miss > BLIND_MISSES[0]:
            break
        rays, angle = rays_of(cameras, pixels)
        start = place(rays, miss * angle, seeds=2)
        if start is None or not start.placed.all():
            continue
        own = _oriented(ordered(pixels, start.reversed), start.points, lengths)
        gauge = (0, None if lengths else 1)
        stages = Stages(_sightings(tracks, own, some), unknown(cameras), *gauge, lengths)
        bundle = _bundle(cameras, start, gauge, lengths)
        for level in (1, 2):
            bundle = stages.robust(bundle, level, rounds=2)
        distance = stages.distance(bundle)
        distance = np.where(stages.plausible(bundle), distance, math.inf)
        error = float(np.median(distance[seen[:, some]]))
        tried.append((error, bundle.cameras))
        tried.sort(key=lambda item: item[0])
        if len(tried) > 1 and _agree(*tried[:2]):
            break
    if not tried:
        raise UserError(
            f"no {model} lenses explain where the lights were seen: give the lenses, or record "
            "more lights that all cameras see"
        )
    return tried[0][1]


def _agree(
    one: tuple[float, tuple[CameraModel, ...]], other: tuple[float, tuple[CameraModel, ...]]
) -> bool:
    """Two starts ended in the same lenses, which explain the lights equally well."""
    focals = [np.array([c.intrinsics[0] for c in cameras]) for _, cameras in (one, other)]
    same = np.abs(focals[0] / focals[1] - 1).max() < SAME_FOCAL
    return bool(same and other[0] < (1 + SAME_FOCAL) * one[0])


# ---- end


def _check_given(stages: Stages, bundle: Bundle, tracks: Tracks) -> None:
    """Refuse lenses that are not those of the cameras: others fit far better."""
    if not all(refinable(c) for c in bundle.cameras):
        return
    free = replace(stages, lenses=unknown(bundle.cameras))
    other = bundle
    for level in (1, 2):
        other = free.robust(other, level)
    given, best = (spread(stages.distance(b)[stages.plausible(b)]) for b in (bundle, other))
    if best < WRONG_LENS * given:
        changes = [
            abs(new.intrinsics[0] / old.intrinsics[0] - 1)
            for new, old in zip(other.cameras, bundle.cameras, strict=True)
        ]
        worst = int(np.argmax(changes))
        raise UserError(
            f"the lights fit {given / best:.0f} times better with other lenses, most of all "
            f"for {tracks.names[worst]}: are they in the cameras' order? else refine them"
        )


def _sightings(
    tracks: Tracks, pixels: NDArray[np.float64], frames: NDArray[np.intp] | None = None
) -> Sightings:
    errors = tracks.errors if frames is None else tracks.errors[:, frames]
    seen = np.isfinite(pixels).all(axis=-1) & np.isfinite(errors)
    weights = np.zeros(errors.shape)
    weights[seen] = errors[seen] ** -2
    weights /= weights[seen].mean()
    return Sightings(pixels, weights, np.zeros(pixels.shape), np.zeros(len(pixels)))


def _delayed(
    bundle: Bundle,
    used: NDArray[np.bool_],
    stages: Stages,
    pixels: NDArray[np.float64],
) -> tuple[Bundle, NDArray[np.bool_], Stages, NDArray[np.bool_]]:
    """The solution with a delay for each camera but the first, if that explains what is left.

    Lenses are frozen while delays are looked for: they would take a part of them.
    """
    none = np.zeros(len(pixels), bool)
    free = np.arange(len(pixels)) != stages.reference
    frozen = replace(
        stages,
        sightings=at_delays(stages.sightings, pixels, bundle.delays),
        lenses=known(bundle.cameras),
        timed=True,
    )
    if frozen.plausible(bundle).sum() < LEAST_TIMED * used.sum():
        return bundle, used, stages, none
    alone, some = frozen.settle(bundle)
    before = frozen.sigma(alone, some)
    found, some = frozen.settle(alone, free)
    if frozen.sigma(found, some) > (1 - LEAST_GAIN) * before:
        return bundle, used, stages, none
    for _ in range(MOST_TURNS):
        frozen = replace(frozen, sightings=at_delays(stages.sightings, pixels, found.delays))
        previous = found.delays
        found, some = frozen.settle(found, free)
        if np.abs(found.delays - previous).max() < 1e-3:
            break
    last = replace(frozen, lenses=stages.lenses)
    found, some = last.settle(found, free)
    return found, some, last, free
