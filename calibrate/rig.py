"""A rig of cameras from pictures of one board: lenses, poses and bow in one solution.

Each camera is calibrated by itself, the cameras are placed along a spanning tree, and then all
is estimated together: with Cauchy's weights first, then by least squares on the corners that
fit. Lens models may be mixed. Where the cameras disagree far more than each with itself and the
pictures' times are known, their clocks are solved for (:mod:`chromeball.calibrate.rig_sync`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate import rig_solve
from chromeball.calibrate.lens_result import check_focal, outline
from chromeball.calibrate.rig_check import check_copies, check_fit
from chromeball.calibrate.rig_lenses import (
    DOUBTED_LENS,
    WRONG_LENS,
    Alone,
    calibrate_alone,
    off_own_lens,
    place_alone,
)
from chromeball.calibrate.rig_result import RigSolution
from chromeball.calibrate.rig_solve import Layout, RigEstimate
from chromeball.calibrate.rig_start import (
    AGREES,
    MOVED,
    disconnected,
    groups,
    readings,
    start_rig,
)
from chromeball.calibrate.rig_sync import Sync, synchronise
from chromeball.calibrate.solve import bounded
from chromeball.calibrate.target import Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: Together so many times less exact than each alone: the cameras did not look at once.
DISAGREEMENT = 2.0
#: Offsets are believed when they leave less than this share of the held-out error.
WORTH = 0.8
#: Reduced normal equations worse conditioned than this determine nothing.
WORST_CONDITION = 1e13


def calibrate_rig(
    corners: NDArray[np.float64],
    target: Target,
    sizes: Sequence[tuple[int, int]],
    names: Sequence[str],
    *,
    models: Sequence[str],
    known: Mapping[str, CameraModel] | None = None,
    refine: bool = False,
    stamps: NDArray[np.float64] | None = None,
    labels: Sequence[str] | None = None,
    progress: Callable[[str], object] | None = None,
) -> RigSolution:
    """Lenses and poses of all cameras of a rig.

    Parameters
    ----------
    corners
        Pixels, (C, F, rows, columns, 2) for C cameras and F instants, NaN where missing.
    target
        The board.
    sizes, names, models
        Each camera's picture size, name and lens model, of
        :data:`chromeball.calibrate.rig_lenses.MODELS`.
    known, refine
        Lenses that are given, by their cameras' names, and whether to refine them.
    stamps
        When each frame was taken, (C, F) seconds; only then can clocks be solved for.
    labels
        Names of the instants; their numbers from 0 where they are not given.
    progress
        Hears of each step.

    Raises
    ------
    UserError
        When a camera's pictures do not determine its lens, the cameras fall into groups that
        never see the board at once, or do not agree.

    """
    say: Callable[[str], object] = progress or (lambda _: None)
    given = dict(known or {})
    if len(names) < 2:
        raise UserError("a rig has two cameras or more; for one take `calibrate lens`")
    if unknown := sorted(set(given) - set(names)):
        raise UserError(
            f"no camera of the rig is called {unknown[0]!r}; they are {', '.join(names)}"
        )
    repeated = _repeated(corners)
    corners = corners.copy()
    corners[:, list(repeated)] = np.nan
    _check_boards(corners, names)
    check_copies(corners, names)
    alone: list[Alone] = []
    for name, views, size, model in zip(names, corners, sizes, models, strict=True):
        alone.append(_alone(name, views, target, size, model, given.get(name)))
        say(f"{name}: {int(alone[-1].saw.sum())} boards, corner noise {alone[-1].sigma:.3f} px")
        if name in given and not refine:
            _check_given(name, views, target, alone[-1], say)
    saw = np.array([a.saw for a in alone])
    poses = np.array([a.camera_from_board for a in alone])
    cameras = [_open(a.camera) for a in alone]
    agrees = AGREES if stamps is None else MOVED
    start = start_rig(names, cameras, poses, saw, target, agrees)
    corners = np.where(saw[..., None, None, None], corners, np.nan)
    corners = _reread(corners, start.turned, target)

    board, share = target.points(), np.array([a.sigma for a in alone])
    frozen = tuple(np.zeros(len(c.intrinsics), bool) for c in cameras)
    free = tuple(
        np.full(len(camera.intrinsics), refine or name not in given)
        for name, camera in zip(names, cameras, strict=True)
    )
    fixed = rig_solve.robust(
        start.estimate, board, corners, Layout.of(frozen, bow=False), share, rounds=3
    )
    layout = Layout.of(free, bow=True)
    estimate = rig_solve.robust(fixed, board, corners, layout, share)
    estimate, used, sigma = rig_solve.settle(estimate, board, corners, layout, share)
    ratio = float(np.median(sigma / share))
    say(f"together: {np.median(sigma):.3f} px, {ratio:.1f} times each camera alone")
    sync: Sync | None = None
    if ratio > DISAGREEMENT and stamps is not None:
        seen = np.isfinite(rig_solve.residuals(fixed, board, corners))
        corners = np.where(seen, corners, np.nan)
        tried = synchronise(fixed, corners, board, stamps, share)
        if tried.held_out[1] < WORTH * tried.held_out[0]:
            sync = tried
            say(
                "the cameras did not look at once: with their time offsets "
                f"{tried.rms_before:.2f} px become {tried.rms:.2f}"
            )
    lenses = [a.covariance for a in alone]
    if sync is not None:
        estimate, covariance, sigma = (
            _unmiddled(sync.motion.rig, board),
            sync.covariance,
            sync.sigma,
        )
        error = np.full(corners.shape, np.nan)
        found = np.isfinite(corners[..., 0])
        error[found] = np.where(sync.used[:, None], _errors(sync), np.nan)
        condition = math.nan
    else:
        system = rig_solve.linearise(estimate, board, corners, used, layout, sigma)[1]
        everything, condition = system.covariance()
        if not condition < WORST_CONDITION:
            raise UserError(
                "these pictures do not determine the rig: take more, with the board tilted and "
                "all over the pictures of neighbouring cameras"
            )
        columns = np.concatenate(layout.pose)
        covariance = everything[np.ix_(columns, columns)]
        for c, chosen in enumerate(layout.free):
            if chosen.any():
                lenses[c] = everything[np.ix_(layout.lens[c], layout.lens[c])]
                values, spread = estimate.cameras[c].intrinsics, np.sqrt(np.diag(lenses[c]))
                _check_lens(names[c], values, spread, ratio)
        error = rig_solve.residuals(estimate, board, corners)
        error[~used] = np.nan
    _check_connected(error, names)
    seen = np.where(saw[..., None, None], poses, np.nan)
    told = labels or [str(v) for v in range(corners.shape[1])]
    if sync is None:
        check_fit(corners, error, seen, sigma / share, names, told)
    return RigSolution(
        names=tuple(names),
        cameras=tuple(
            _posed(estimate, c, _known(alone[c].camera, estimate, c, lenses[c], corners, error))
            for c in range(len(names))
        ),
        covariance=_on_rig(estimate, covariance),
        lens_covariance=tuple(lenses),
        bow=estimate.bow,
        observed=corners,
        residuals=error,
        sigma=sigma,
        alone=share,
        rig_from_board=_boards(estimate, np.isfinite(error[..., 0]).any(axis=(0, 2, 3))),
        turned=start.turned > 0,
        repeated=repeated,
        condition=condition,
        sync=sync,
    )


# ---- steps


def _repeated(corners: NDArray[np.float64]) -> tuple[int, ...]:
    """Instants that show in every camera what an earlier one shows, to the last bit."""
    first: dict[bytes, int] = {}
    again: list[int] = []
    for v in range(corners.shape[1]):
        content = np.nan_to_num(corners[:, v], nan=-1.0)
        if (content >= 0).any() and first.setdefault(content.tobytes(), v) != v:
            again.append(v)
    return tuple(again)


def _check_boards(corners: NDArray[np.float64], names: Sequence[str]) -> None:
    """Every camera sees boards, and some of them with another camera."""
    seen = np.isfinite(corners[..., 0]).any(axis=(2, 3))
    for c, name in enumerate(names):
        if not seen[c].any():
            raise UserError(f"camera {name} saw no board: is its folder the right one?")
        others = np.delete(seen, c, axis=0).any(axis=0)
        if not (seen[c] & others).any():
            raise UserError(
                f"camera {name} never sees the board at once with another camera: show it to "
                f"{name} and a neighbour together, and check that their pictures have the same "
                "names, numbers or times"
            )


def _alone(
    name: str,
    corners: NDArray[np.float64],
    target: Target,
    size: tuple[int, int],
    model: str,
    lens: CameraModel | None,
) -> Alone:
    if lens is None:
        return _named(name, calibrate_alone, corners, target, size, model)
    if lens.size != size:
        raise UserError(
            "camera {}: its lens is for pictures of {}x{}, these are {}x{}".format(
                name, *lens.size, *size
            )
        )
    return _named(name, place_alone, corners, target, lens)


def _check_given(
    name: str,
    corners: NDArray[np.float64],
    target: Target,
    alone: Alone,
    say: Callable[[str], object],
) -> None:
    """Refuse a given lens that is not this camera's: one of its pictures' own is far off it."""
    off, excess = off_own_lens(corners, target, alone)
    if not (off > DOUBTED_LENS[0] and excess > DOUBTED_LENS[1]):
        return
    text = (
        f"its given lens is {off:.2g} px off one of its pictures' own, {excess:.0f} times "
        "what that is good to"
    )
    if off > WRONG_LENS[0] and excess > WRONG_LENS[1]:
        raise UserError(
            f"camera {name}: {text}: is it another camera's, or was zoom or focus changed? "
            "leave --lens out, or --refine it"
        )
    say(f"{name}: {text}; --refine would adapt it")


def _named[T](name: str, function: Callable[..., T], *arguments: Any) -> T:
    """What `function` returns; its complaints with the camera's name."""
    try:
        return function(*arguments)
    except UserError as error:
        raise UserError(f"camera {name}: {error.what}") from error


def _check_lens(
    name: str, intrinsics: NDArray[np.float64], spread: NDArray[np.float64], ratio: float
) -> None:
    """Refuse a lens left open; where the cameras disagree, that is why."""
    try:
        check_focal(intrinsics, spread, 2 if len(intrinsics) > 3 else 1)
    except UserError as error:
        why = error.what
        if ratio > DISAGREEMENT:
            why = (
                f"together the cameras are {ratio:.0f} times less exact than each alone, and "
                "leave its lens open: pair the pictures rightly, hold the board still while "
                "they look, or give --times"
            )
        raise UserError(f"camera {name}: {why}") from error


def _open(camera: CameraModel) -> CameraModel:
    """Without pose, and a fisheye without an end to its field."""
    return replace(camera, world_from_camera=Pose.identity(), max_angle=math.pi)


def _reread(
    corners: NDArray[np.float64], turned: NDArray[np.intp], target: Target
) -> NDArray[np.float64]:
    """`corners` with the readings that the cameras agree on."""
    flat = corners.reshape(*corners.shape[:2], -1, 2).copy()
    for reading, (_, order) in enumerate(readings(target)):
        if reading:
            flat[turned == reading] = flat[turned == reading][:, order]
    return flat.reshape(corners.shape)


def _errors(sync: Sync) -> NDArray[np.float64]:
    from chromeball.calibrate.rig_motion import errors

    return errors(sync.motion, sync.seen)


def _unmiddled(rig: RigEstimate, board: NDArray[np.float64]) -> RigEstimate:
    """Board poses of its first corner instead of its middle."""
    middle = board.mean(axis=(0, 1))
    return replace(
        rig, board_translations=rig.board_translations - rig.board_rotations @ middle
    )


def _check_connected(error: NDArray[np.float64], names: Sequence[str]) -> None:
    """The corners that fit still hold the cameras together."""
    seen = np.isfinite(error[..., 0]).any(axis=(2, 3)).astype(np.intp)
    if not seen.any(axis=1).all():
        c = int(seen.any(axis=1).argmin())
        raise UserError(
            f"no board of camera {names[c]} fits the other cameras: are its pictures paired "
            "rightly with theirs, and the board the same?"
        )
    if len(groups(seen @ seen.T)) > 1:
        raise UserError(f"without misread boards {disconnected(names, seen @ seen.T)}")


def _known(
    alone: CameraModel,
    estimate: RigEstimate,
    c: int,
    covariance: NDArray[np.float64],
    corners: NDArray[np.float64],
    error: NDArray[np.float64],
) -> CameraModel:
    """The lens of camera `c` with its `covariance` and the region of its corners that fit.

    A lens that was given and not refined stays as it is, with all that its file said.
    """
    camera = estimate.cameras[c]
    if not covariance.any():
        return alone
    region = outline(corners[c][np.isfinite(error[c, ..., 0])])
    return bounded(replace(camera, covariance=covariance, region=region))


def _posed(estimate: RigEstimate, c: int, camera: CameraModel) -> CameraModel:
    u, _, vt = np.linalg.svd(estimate.rotations[c])  # rounding alone
    camera_from_rig = Pose(u @ vt, estimate.translations[c])
    return camera.posed(camera_from_rig.inverse())


def _on_rig(estimate: RigEstimate, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the turns about the cameras' axes and their positions on the rig, (6C, 6C).

    From that (6 (C - 1), 6 (C - 1)) of w and dt, exp(w) C, d + dt: the position is c = -C'd, so
    that dc = -C' [d] w - C' dt.
    """
    count = len(estimate.rotations)
    change = np.zeros((6 * count, 6 * (count - 1)))
    for c in range(1, count):
        back, d = estimate.rotations[c].T, estimate.translations[c]
        at, own = 6 * c, 6 * (c - 1)
        change[at : at + 3, own : own + 3] = -np.eye(3)
        change[at + 3 : at + 6, own : own + 3] = back @ np.cross(np.eye(3), d).T
        change[at + 3 : at + 6, own + 3 : own + 6] = -back
    return change @ covariance @ change.T


def _boards(estimate: RigEstimate, known: NDArray[np.bool_]) -> NDArray[np.float64]:
    poses = np.full((len(known), 4, 4), np.nan)
    poses[known] = np.eye(4)
    poses[known, :3, :3] = estimate.board_rotations[known]
    poses[known, :3, 3] = estimate.board_translations[known]
    return poses
