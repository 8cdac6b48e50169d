"""A tracker's sensor on a camera: hand-eye, robot-world and delay by joint maximum likelihood.

The sensor's pose at a picture's time, S(t + delay), is measured by the tracker; the board's in
the camera, C, by the picture. With X = sensor_from_camera and Z = tracker_from_board,

    S X C = Z

holds for the true ones. Unknown are X, Z, the delay and every C. Their likelihood is that of
all pixels, through the whole lens, and of the tracker's positions and turns, each with its own
Gaussian noise. Derivatives are exact; the C are eliminated (Schur complement). The three
noises are estimated along with the rest (Foerstner's variance components, 1979): every sum of
squares is divided by its own redundancy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.hand_eye import Frames, hand_eye, view_errors
from chromeball.calibrate.tracker_adjust import Noise, Rows, State, adjust, covariance
from chromeball.calibrate.tracker_log import TrackerLog, reached, sample
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: Fewest pictures from which the tracker's noise can be told as well.
FEWEST_FOR_NOISE = 6
#: Squared distance of a sound pose that 1 in 1000 exceeds: chi-squared with 6 degrees.
OUTLIER = 22.46
#: Medians of chi-squared with 3 and 2 degrees of freedom.
MEDIAN_3, MEDIAN_2 = 2.366, 1.386
#: Standard errors beyond which an answer is none: radians, metres, seconds.
WORST_TURN, WORST_PLACE = math.radians(5), 0.1
#: The delay is searched so far to both sides, seconds, in steps of so much.
SEARCH, STEP = 0.5, 0.01


@dataclass(frozen=True)
class TrackerSolution:
    """A calibrated tracker.

    ``covariance`` (13, 13) of the turn of X about the sensor's axes (radians), its translation
    (metres), the same of Z about the tracker's axes, and the delay (seconds; zero where it was
    given). The turns are left perturbations, exp(w) R. ``noise`` of a pixel coordinate, of the
    tracker's position an axis (metres) and of its turn an axis (radians). ``used`` (V,) says
    which pictures fit; ``turn_errors`` (V,) and ``place_errors`` (V,) by how much tracker and
    picture differ, radians and metres, NaN for pictures outside the log; ``distances`` (V,) the
    same in standard errors, squared. ``second_axis`` is the RMS turn about the second axis of
    the motion, radians.
    """

    sensor_from_camera: Pose
    tracker_from_board: Pose
    delay: float
    delay_estimated: bool
    covariance: Array
    noise: Noise
    used: NDArray[np.bool_]
    turn_errors: Array
    place_errors: Array
    distances: Array
    condition: float

    @property
    def standard_errors(self) -> Array:
        """Of the 13 unknowns, in the order of ``covariance``."""
        return np.sqrt(np.diag(self.covariance))

    def world_from_camera(
        self, log: TrackerLog, times: Array, world_from_tracker: Pose | None = None
    ) -> list[Pose]:
        """Where the camera was at `times` (V,) on the pictures' clock; without a
        `world_from_tracker` in the tracker's axes.
        """  # noqa: D205
        there = world_from_tracker or Pose.identity()
        sensor = sample(log, np.asarray(times, float) + self.delay)
        return [
            there @ Pose(r, t) @ self.sensor_from_camera
            for r, t in zip(sensor.rotations, sensor.positions, strict=True)
        ]


def solve_tracker(
    camera: CameraModel,
    points: Array,
    pixels: Array,
    log: TrackerLog,
    times: Array | None = None,
    *,
    delay: float | None = None,
    position_noise: float | None = None,
    rotation_noise: float | None = None,
    window: float = 0.0,
    search: float = SEARCH,
    tell: Callable[[str], object] | None = None,
) -> TrackerSolution:
    """Where `camera` sits on the sensor and the board in the tracker's space.

    Parameters
    ----------
    camera
        The lens, taken as known.
    points
        Corners on the board, (N, 3), metres.
    pixels
        Where V pictures show them, (V, N, 2), NaN where not seen.
    log
        The tracker's samples; without times, V of them, one a picture.
    times
        When the pictures were taken, (V,) seconds, on a clock that runs as the log's.
    delay
        Log time minus picture time, seconds, where it is known; else it is estimated.
    position_noise, rotation_noise
        Standard deviations an axis, metres and radians, where known; else estimated.
    window
        Smoothing of the log, seconds (:func:`chromeball.calibrate.tracker_log.sample`).
    search
        How far the delay may be from zero, seconds.
    tell
        Hears what was found on the way.

    Raises
    ------
    UserError
        Too few pictures, a motion that leaves unknowns open, poses that fit no common motion.

    """
    say = tell or (lambda _: None)
    timed = log.times is not None
    count = len(pixels)
    if timed and times is None:
        raise UserError("the log has times; the pictures' are needed, too")
    if not timed and len(log.positions) != count:
        raise UserError(f"{len(log.positions)} poses of the tracker for {count} pictures")
    views, boards = _place_boards(camera, points, pixels, say)
    clock = np.asarray(times, float)[views] if timed and times is not None else np.zeros(0)
    if timed and delay is None:
        start = _search_delay(log, clock, boards, window, search)
        say(f"delay, roughly: {start * 1e3:.0f} ms")
    else:
        start = delay or 0.0
    if timed:
        inside = reached(log, clock + start, window)
        if (~inside).any():
            say(f"{int((~inside).sum())} pictures lie outside the log, or in a gap of it")
        views, boards, clock = views[inside], boards[inside], clock[inside]
    _enough(len(views), position_noise is None or rotation_noise is None)

    rows = Rows(camera, points, pixels[views], log, clock, window, views)
    sensor = rows.sensor(start)
    x, z, agree = hand_eye(Frames(sensor.rotations, sensor.positions), boards.inverse())
    free_delay = timed and delay is None
    state = State(x, z, start, boards.rotations, boards.translations)
    given = (position_noise, rotation_noise)
    noise = _first_noise(rows, state, agree, given)
    weights = agree.astype(float)
    for _ in range(4):  # Cauchy's weights: half at 2.4 deviations of six numbers
        state = adjust(rows, state, noise, weights, free_delay, steps=15)
        noise = _first_noise(rows, state, agree, given)
        weights = 1 / (1 + rows.distances(state, noise) / (2.4**2 * 6))
    used = np.zeros(len(views), bool)
    for _ in range(20):
        fits = rows.distances(state, noise) <= OUTLIER
        if (fits == used).all() and used.any():
            break
        used = fits
        _enough(int(used.sum()), None in given)
        state, noise = _settle(rows, state, noise, used, free_delay, given)
    spread, condition = covariance(rows, state, noise, used, free_delay)
    _refuse_open(spread)
    turn, place, distance = (np.full(count, np.nan) for _ in range(3))
    sensor = rows.sensor(state.delay)
    turn[views], place[views] = view_errors(
        state.sensor_from_camera,
        state.tracker_from_board,
        Frames(sensor.rotations, sensor.positions),
        Frames(state.rotations, state.translations).inverse(),
    )
    distance[views] = rows.distances(state, noise)
    everyone = np.zeros(count, bool)
    everyone[views[used]] = True
    return TrackerSolution(
        sensor_from_camera=state.sensor_from_camera,
        tracker_from_board=state.tracker_from_board,
        delay=state.delay,
        delay_estimated=free_delay,
        covariance=spread,
        noise=noise,
        used=everyone,
        turn_errors=turn,
        place_errors=place,
        distances=distance,
        condition=condition,
    )


def _place_boards(
    camera: CameraModel, points: Array, pixels: Array, say: Callable[[str], object]
) -> tuple[NDArray[np.intp], Frames]:
    """The pictures whose corners place the board, and ``camera_from_board`` of each."""
    from chromeball.calibrate.pose import solve_pose

    views: list[int] = []
    poses: list[Pose] = []
    for k, view in enumerate(pixels):
        seen = np.isfinite(view).all(axis=-1)
        try:
            found = solve_pose(camera, points[seen], view[seen], above_floor=False)
        except UserError as error:
            say(f"picture {k + 1} is left out: {error.what}")
            continue
        if found.ambiguous:
            say(f"picture {k + 1} is left out: its board may lie in two ways, go nearer")
            continue
        views.append(k)
        poses.append(found.world_from_camera.inverse())
    if len(views) < 3:
        raise UserError(f"only {len(views)} pictures place the board; three or more are needed")
    return np.array(views, np.intp), Frames.of(poses)


def _search_delay(
    log: TrackerLog, clock: Array, boards: Frames, window: float, search: float
) -> float:
    """The delay at which the angles between views are most alike for tracker and pictures.

    The angle of a turn does not depend on X and Z.
    """
    i, j = np.triu_indices(len(clock), 1)
    if len(i) > 4000:
        chosen = np.random.default_rng(0).choice(len(i), 4000, replace=False)
        i, j = i[chosen], j[chosen]
    seen = _angles(boards.rotations, i, j)
    best, least = 0.0, math.inf
    reach = 0
    for delay in sorted(np.arange(-search, search + STEP / 2, STEP).tolist(), key=abs):
        inside = reached(log, clock + delay, window)
        both = inside[i] & inside[j]
        if inside.sum() < 3 or inside.sum() < 0.8 * reach:
            continue
        reach = max(reach, int(inside.sum()))
        turned = np.zeros((len(clock), 3, 3))
        turned[inside] = sample(log, clock[inside] + delay, window).rotations
        told = _angles(turned, i[both], j[both])
        error = float(np.median(np.abs(told - seen[both])))
        if error < least - 1e-9:
            best, least = delay, error
    if not math.isfinite(least):
        raise UserError(
            "the log covers fewer than three of the pictures: are the clocks of both the same?"
        )
    return best


def _angles(rotations: Array, i: NDArray[np.intp], j: NDArray[np.intp]) -> Array:
    trace = np.einsum("pij,pij->p", rotations[i], rotations[j])
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def _enough(count: int, estimated: bool) -> None:
    least = FEWEST_FOR_NOISE if estimated else 3
    if count < least:
        more = " to tell the tracker's noise, too; or give both noises" if estimated else ""
        raise UserError(f"{count} pictures and poses fit together; {least} are needed{more}")


def _first_noise(
    rows: Rows,
    state: State,
    agree: NDArray[np.bool_],
    given: tuple[float | None, float | None],
) -> Noise:
    """Noises by medians, which wrong poses hardly move."""
    pixel, place, turn = rows.raw(state)
    square = (pixel[agree] ** 2).sum(axis=-1)
    sigma = math.sqrt(float(np.nanmedian(square)) / MEDIAN_2)
    position, rotation = (
        math.sqrt(float(np.median((v[agree] ** 2).sum(axis=-1))) / MEDIAN_3)
        for v in (place, turn)
    )
    return Noise(sigma, given[0] or position, given[1] or rotation).floored()


def _settle(
    rows: Rows,
    state: State,
    noise: Noise,
    used: NDArray[np.bool_],
    free_delay: bool,
    given: tuple[float | None, float | None],
) -> tuple[State, Noise]:
    """Least squares and the noises in turn, until both stay the same."""
    weights = used.astype(float)
    for _ in range(30):
        state = adjust(rows, state, noise, weights, free_delay)
        before = noise
        noise = rows.components(state, noise, used, free_delay)
        if given[0] is not None:
            noise = replace(noise, position=given[0])
        if given[1] is not None:
            noise = replace(noise, rotation=given[1])
        if noise.like(before):
            break
    return adjust(rows, state, noise, weights, free_delay), noise


def _refuse_open(spread: Array) -> None:
    """Refuse an answer whose standard errors say that it is none."""
    from chromeball.calibrate.hand_eye import name_axis

    for block, of in ((0, "camera on the sensor"), (6, "board in the tracker's space")):
        size, axes = np.linalg.eigh(spread[block : block + 3, block : block + 3])
        if not size[2] < WORST_TURN**2:
            about = f" about {name_axis(axes[:, 2])}" if block == 0 else ""
            raise UserError(
                f"the turn of the {of} stays open{about} (standard error "
                f"{math.degrees(math.sqrt(size[2])):.0f} degrees): turn the camera further, "
                "about two axes or three, or take more pictures"
            )
        size, axes = np.linalg.eigh(spread[block + 3 : block + 6, block + 3 : block + 6])
        if not size[2] < WORST_PLACE**2:
            raise UserError(
                f"the place of the {of} stays open (standard error {math.sqrt(size[2]):.2f} m): "
                "turn the camera further, about two axes or three, or take more pictures"
            )
