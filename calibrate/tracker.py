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

from chromeball.calibrate.hand_eye import FAR, Frames, hand_eye, refuse_single_axis, view_errors
from chromeball.calibrate.tracker_adjust import Noise, Rows, State, adjust, covariance
from chromeball.calibrate.tracker_checks import check_scale, refuse_open, refuse_unlike
from chromeball.calibrate.tracker_delay import SEARCH, STEP, search_delay
from chromeball.calibrate.tracker_log import TrackerLog, reached, usual_window
from chromeball.calibrate.tracker_readings import alternatives
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: Fewest pictures from which the tracker's noise can be told as well.
FEWEST_FOR_NOISE = 6
#: Share of sound poses that lie farther off than what counts as an outlier.
OUTLIER = 1e-3
#: Medians of chi-squared with 3 and 2 degrees of freedom.
MEDIAN_3, MEDIAN_2 = 2.366, 1.386
#: A given delay so many standard errors from the log's own is none.
DELAY_OFF = 5.0


@dataclass(frozen=True)
class TrackerSolution:
    """A calibrated tracker.

    ``covariance`` (13, 13) of the turn of X about the sensor's axes (radians), its translation
    (metres), the same of Z about the tracker's axes, and the delay (seconds; zero where it was
    given). The turns are left perturbations, exp(w) R. ``noise`` of a pixel coordinate, of the
    tracker's position an axis (metres) and of its turn an axis (radians). ``used`` (V,) says
    which pictures fit; ``turn_errors`` (V,) and ``place_errors`` (V,) by how much tracker and
    picture differ, radians and metres, NaN for pictures outside the log; ``distances`` (V,) the
    same in standard errors, squared. ``scale`` is how many times as far the tracker moved as
    the pictures say, a check that takes no part in the solution.
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
    scale: float
    sigma_scale: float

    @property
    def standard_errors(self) -> Array:
        """Of the 13 unknowns, in the order of ``covariance``."""
        return np.sqrt(np.diag(self.covariance))


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
    window: float | None = None,
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
        Smoothing of the log, seconds (:func:`chromeball.calibrate.tracker_log.sample`); by
        default eight samples, and 0 is none.
    search
        How far the delay may be from zero, seconds.
    tell
        Hears what was found on the way, and warnings.

    Raises
    ------
    UserError
        Too few pictures, a motion that leaves unknowns open, poses that fit no common motion;
        with the reading of the log under which they do, if there is one.

    """
    say = tell or (lambda _: None)
    timed = log.times is not None
    count = len(pixels)
    if timed and times is None:
        raise UserError("the log has times; the pictures' are needed, too")
    if not timed and len(log.positions) != count:
        raise UserError(f"{len(log.positions)} poses of the tracker for {count} pictures")
    views, boards = _place_boards(camera, points, pixels, say)
    refuse_single_axis(boards.inverse())
    task = _Task(
        camera, points, pixels, views, boards,
        times=np.asarray(times, float)[views] if timed and times is not None else np.zeros(0),
        noises=(position_noise, rotation_noise), window=window, search=search,
    )  # fmt: skip
    delay = delay if timed else 0.0
    try:
        found = _solve(task, log, delay, say)
    except UserError as error:
        for words, other, shift, reach in alternatives(log, delay, search):
            try:
                fits = _solve(replace(task, search=reach), other, shift, lambda _: None)
            except UserError:
                continue  # neither this
            raise UserError(
                words.format(delay=fits.delay, search=2 * abs(fits.delay))
            ) from error
        raise
    if timed and delay is not None:
        _check_delay(task, log, found, say)
    return found


@dataclass(frozen=True)
class _Task:
    """What stays the same whatever is tried: pictures, their ``times`` (V,) and ``boards``."""

    camera: CameraModel
    points: Array
    pixels: Array
    views: NDArray[np.intp]
    boards: Frames
    times: Array
    noises: tuple[float | None, float | None]
    window: float | None
    search: float


def _check_delay(
    task: _Task, log: TrackerLog, found: TrackerSolution, say: Callable[[str], object]
) -> None:
    """Warn of a given delay that the log contradicts."""
    try:
        free = _solve(task, log, None, lambda _: None)
    except UserError:
        return  # pictures at rest: they leave it open, and any will do
    off, sigma = free.delay - found.delay, free.standard_errors[12]
    better = free.noise.rotation <= found.noise.rotation and free.used.sum() >= found.used.sum()
    if better and abs(off) > DELAY_OFF * sigma:
        say(
            f"warning: the log says that the delay is {free.delay * 1e3:.1f} +- "
            f"{sigma * 1e3:.1f} ms, not {found.delay * 1e3:.1f} as given, and fits better so: "
            "leave --delay out"
        )


def _solve(
    task: _Task, log: TrackerLog, delay: float | None, say: Callable[[str], object]
) -> TrackerSolution:
    """The solution for one reading of the log; `delay` None is estimated."""
    camera, points, pixels = task.camera, task.points, task.pixels
    views, boards, clock = task.views, task.boards, task.times
    timed, count = log.times is not None, len(pixels)
    position_noise, rotation_noise = task.noises
    window = usual_window(log) if task.window is None else task.window
    if timed and delay is None:
        start = search_delay(log, clock, boards, window, task.search)
        say(f"delay, roughly: {start * 1e3:.0f} ms")
        if abs(start) > task.search - 1.5 * STEP:
            say(
                f"warning: that is at the limit of the search, {task.search:g} s: look farther "
                f"with --search {2 * task.search:g}"
            )
    else:
        start = delay or 0.0
    if timed:
        inside = reached(log, clock + start, window)
        if (~inside).any():
            say(f"{int((~inside).sum())} pictures lie outside the log, or in a gap of it")
        views, boards, clock = views[inside], boards[inside], clock[inside]
    _enough(len(views), position_noise is None or rotation_noise is None)

    rows = Rows(camera, points, pixels[views], log, clock, window, views)
    sensed = rows.sensor(start)
    sensor = Frames(sensed.rotations, sensed.positions)
    x, z, agree = hand_eye(sensor, boards.inverse())
    turned = _upside_down(points, x, z, sensor, boards, agree)
    if turned.any():
        say(f"{int(turned.sum())} boards were read upside down, as the tracker shows")
        half = _half_turn(points)
        boards = Frames.of(
            [b @ half if t else b for b, t in zip(boards.poses(), turned, strict=True)]
        )
        read = np.where(turned[:, None, None], rows.pixels[:, ::-1], rows.pixels)
        rows = replace(rows, pixels=read)
        agree |= turned
    free_delay = timed and delay is None
    state = State(x, z, start, boards.rotations, boards.translations)
    given = (position_noise, rotation_noise)
    noise = _first_noise(rows, state, agree, given)
    weights = agree.astype(float)
    for _ in range(4):  # Cauchy's weights: half at 2.4 deviations of six numbers
        state = adjust(rows, state, noise, weights, False, steps=15)
        noise = _first_noise(rows, state, agree, given)
        weights = 1 / (1 + rows.distances(state, noise) / (2.4**2 * 6))
    used = np.zeros(len(views), bool)
    if free_delay:  # refused here, before it can wander
        covariance(rows, state, noise, weights > 0.5, True)
    for _ in range(20):
        fits = rows.distances(state, noise) <= _limit(int(used.sum()), None in given)
        if (fits == used).all() and used.any():
            break
        used = fits
        _enough(int(used.sum()), None in given)
        state, noise = _settle(rows, state, noise, used, free_delay, given)
    scale, sigma_scale = check_scale(rows, state, used, say)
    refuse_unlike(rows, state, noise)
    spread, condition = covariance(rows, state, noise, used, free_delay)
    refuse_open(spread)
    turn, place, distance = (np.full(count, np.nan) for _ in range(3))
    sensed = rows.sensor(state.delay)
    turn[views], place[views] = view_errors(
        state.sensor_from_camera,
        state.tracker_from_board,
        Frames(sensed.rotations, sensed.positions),
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
        scale=scale,
        sigma_scale=sigma_scale,
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
        if not seen.any():
            continue  # no board: who looked for it has told
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


def _half_turn(points: Array) -> Pose:
    """The board turned by 180 degrees in its plane."""
    return Pose(np.diag([-1.0, -1, 1]), (points[0] + points[-1]) * [1, 1, 0])


def _upside_down(
    points: Array,
    x: Pose,
    z: Pose,
    sensor: Frames,
    boards: Frames,
    agree: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Views (V,) that fit only if their board was read the other way round.

    A board that looks alike after half a turn, or nearly so, is read either way.
    """
    half = _half_turn(points)
    if not np.allclose(half.apply(points), points[::-1]):
        return np.zeros(len(boards), bool)
    other = Frames.of([b @ half for b in boards.poses()])
    turn, place = view_errors(x, z, sensor, boards.inverse())
    new_turn, new_place = view_errors(x, z, sensor, other.inverse())
    fits = (new_turn <= FAR * np.median(turn[agree])) & (
        new_place <= FAR * np.median(place[agree])
    )
    return np.asarray(fits & ~agree, bool)


def _enough(count: int, estimated: bool) -> None:
    least = FEWEST_FOR_NOISE if estimated else 3
    if count < least:
        more = " to tell the tracker's noise, too; or give both noises" if estimated else ""
        raise UserError(f"{count} pictures and poses fit together; {least} are needed{more}")


def _limit(count: int, estimated: bool) -> float:
    """Squared distance of a pose beyond which it is wrong, of noises from `count` poses."""
    from scipy import stats

    redundancy = 6 * count - 12 if estimated and count else 1e6
    return float(6 * stats.f.ppf(1 - OUTLIER, 6, redundancy))


def _first_noise(
    rows: Rows,
    state: State,
    agree: NDArray[np.bool_],
    given: tuple[float | None, float | None],
) -> Noise:
    """Noises by medians, which wrong poses hardly move.

    Both unknown poses are fitted, two views' worth: few views differ less than their noise
    (Rousseeuw and Leroy 1987, 1 + 5 / (n - p)).
    """
    pixel, place, turn = rows.raw(state)
    few = 1 + 5 / max(int(agree.sum()) - 2, 1)
    square = (pixel[agree] ** 2).sum(axis=-1)
    sigma = math.sqrt(float(np.nanmedian(square)) / MEDIAN_2)
    position, rotation = (
        few * math.sqrt(float(np.median((v[agree] ** 2).sum(axis=-1))) / MEDIAN_3)
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
