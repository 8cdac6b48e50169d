"""Rigs of any lenses: truth, honest errors, boards read from either end, refusals, clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.rig import calibrate_rig
from chromeball.calibrate.rig_result import RigSolution
from chromeball.calibrate.rig_start import place_boards, readings, start_rig
from chromeball.calibrate.target import Charuco, Chessboard, CircleGrid, Target
from chromeball.calibrate.virtual_rig import SIZE, observe, ring, scattered_boards, waved_board
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

BOARD = Chessboard(9, 6, 0.04)
NAMES = ("a", "b", "c", "d")
CAMERAS = ring(4, wide=(2,), seed=3)
POSES = scattered_boards(BOARD, CAMERAS, 22, seed=3)
MODELS = ("opencv4", "opencv4", "kb4", "opencv4")
#: Four cameras on one side of the room, which see the board together.
FAN = [
    replace(camera, world_from_camera=Pose.look_at([0.5 * i - 0.5, 0.1 * i, -1.3], [0.0, 0, 0]))
    for i, camera in enumerate(ring(3, seed=5))
]


def solve(
    corners: NDArray[np.float64], target: Target = BOARD, **options: object
) -> RigSolution:
    settings: dict[str, object] = {"models": MODELS[: len(corners)]} | options
    sizes = [SIZE] * len(corners)
    return calibrate_rig(corners, target, sizes, NAMES[: len(corners)], **settings)  # type: ignore[arg-type]


def misses(rig: RigSolution, truth: list[CameraModel]) -> NDArray[np.float64]:
    """Turn about the cameras' own axes and shift on the rig, off the truth, (6 (C - 1),)."""
    rig_from_world = truth[0].world_from_camera.inverse()
    off: list[NDArray[np.float64]] = []
    for found, camera in list(zip(rig.cameras, truth, strict=True))[1:]:
        true = rig_from_world @ camera.world_from_camera
        off.append((true.inverse() @ found.world_from_camera).rotation_vector())
        off.append(found.world_from_camera.translation - true.translation)
    return np.concatenate(off)


def test_truth_and_honest_errors() -> None:
    """Perspective lenses and a fisheye of 190 degrees, 5 % false corners, four noises.

    The poses' chi-square has 72 degrees of freedom: between .68 and 1.38 of that in 98 %.
    """
    scores: list[float] = []
    shifts, predicted = 0.0, 0.0
    for seed in range(4):
        rig = solve(observe(BOARD, CAMERAS, POSES, outliers=0.05, seed=seed))
        off, known = misses(rig, CAMERAS), rig.covariance[6:, 6:]
        scores.append(float(off @ np.linalg.solve(known, off)))
        shifts += float((off.reshape(-1, 6)[:, 3:] ** 2).sum())
        predicted += float((rig.position_errors**2).sum())
        np.testing.assert_allclose(rig.sigma, 0.2, rtol=0.12)
        assert 0.03 < rig.outliers.sum() / np.isfinite(rig.observed[..., 0]).sum() < 0.07
        assert rig.disagreement < 1.2
    assert 72 * 0.68 < sum(scores) < 72 * 1.38
    assert 0.5 < np.sqrt(shifts / predicted) < 1.5


def test_forty_percent_outliers_either_end_and_upside_down() -> None:
    """A camera that hangs upside down reads all boards from the other end, another one some."""
    turned = CAMERAS[1].world_from_camera
    down = Pose(turned.rotation @ np.diag([-1.0, -1, 1]), turned.translation)
    cameras = [CAMERAS[0], CAMERAS[1].posed(down), *CAMERAS[2:]]
    corners = observe(BOARD, cameras, POSES, outliers=0.4, seed=1)
    corners[1] = corners[1, :, ::-1, ::-1]
    corners[3, ::2] = corners[3, ::2, ::-1, ::-1]
    rig = solve(corners)
    assert rig.turned.any()
    errors = np.sqrt(np.diag(rig.covariance)[6:])
    assert np.abs(misses(rig, cameras) / errors).max() < 5
    assert rig.sigma.max() < 0.3


def test_swapped_and_repeated_pictures() -> None:
    """Two instants of one camera swapped are left out by name; repeats count once."""
    corners = observe(BOARD, FAN, [waved_board(BOARD, 0.7 * i) for i in range(14)])
    corners[1, [2, 9]] = corners[1, [9, 2]]
    alone = solve(corners, models=["opencv4"] * 3)
    assert alone.misread() == [(1, 2), (1, 9)]
    again = solve(np.concatenate([corners, corners[:, :6]], axis=1), models=["opencv4"] * 3)
    assert again.repeated == tuple(range(14, 20))
    np.testing.assert_allclose(again.covariance, alone.covariance, rtol=1e-6, atol=1e-15)
    assert np.abs(misses(alone, FAN) / np.sqrt(np.diag(alone.covariance)[6:])).max() < 5


def test_given_lenses_stay_and_refine() -> None:
    corners = observe(BOARD, CAMERAS, POSES, seed=4)
    known = {"a": CAMERAS[0], "c": CAMERAS[2]}
    rig = solve(corners, known=known)
    np.testing.assert_array_equal(rig.cameras[0].intrinsics, CAMERAS[0].intrinsics)
    assert not rig.lens_covariance[2].any()
    refined = solve(corners, known=known, refine=True)
    assert (refined.cameras[0].intrinsics != CAMERAS[0].intrinsics).all()
    assert rig.position_errors.max() < refined.position_errors.max()
    assert rig.cameras[2].covariance is None
    told = refined.cameras[2]
    assert told.covariance is not None
    np.testing.assert_array_equal(told.covariance, refined.lens_covariance[2])
    assert told.region is not None
    seen = corners[2][np.isfinite(corners[2][..., 0])]
    assert (np.abs(told.region.min(axis=0) - seen.min(axis=0)) < 20).all()
    small = {"a": replace(CAMERAS[0], size=(640, 480))}
    with pytest.raises(UserError, match="camera a: its lens is for pictures of 640x480"):
        solve(corners, known=small)
    with pytest.raises(UserError, match="no camera of the rig is called 'x'"):
        solve(corners, known={"x": CAMERAS[0]})


def test_lenses_of_other_cameras_are_refused() -> None:
    """A lens with another focal length, its own model and noise apart, is not taken."""
    corners = observe(BOARD, CAMERAS, POSES, seed=4)
    for c, told in ((0, "camera a: its given lens"), (2, "camera c: its given lens")):
        k = CAMERAS[c].intrinsics.copy()
        k[:2] *= 1.1
        wrong = {NAMES[c]: replace(CAMERAS[c], intrinsics=k)}
        with pytest.raises(UserError, match=told):
            solve(corners, known=wrong)
    heard: list[str] = []
    k = CAMERAS[0].intrinsics.copy()
    k[:2] *= 1.03
    slightly = {"a": replace(CAMERAS[0], intrinsics=k)}
    solve(corners, known=slightly, progress=heard.append)
    assert any("--refine would adapt it" in line for line in heard)


@pytest.mark.parametrize(
    ("target", "count"),
    [
        (BOARD, 2),
        (Chessboard(6, 6, 0.04), 4),
        (Charuco(9, 6, 0.04, 0.03, "4X4_50"), 1),
        (CircleGrid(4, 10, 0.02, asymmetric=True), 2),
        (CircleGrid(4, 11, 0.02, asymmetric=True), 1),
        (CircleGrid(7, 5, 0.02), 2),
    ],
    ids=lambda value: value.spec if not isinstance(value, int) else "",
)
def test_readings_move_the_board_onto_itself(target: Target, count: int) -> None:
    found = readings(target)
    assert len(found) == count
    points = target.points().reshape(-1, 3)
    for motion, order in found:
        moved = points @ motion[:3, :3].T + motion[:3, 3]
        np.testing.assert_allclose(moved, points[order], atol=1e-12)


def started(corners: NDArray[np.float64]) -> None:
    """The spanning tree through true lenses."""
    cameras = [replace(camera, world_from_camera=Pose.identity()) for camera in CAMERAS]
    placed = [
        place_boards(camera, BOARD.points(), views)
        for camera, views in zip(cameras, corners, strict=True)
    ]
    poses, saw = np.array([p for p, _ in placed]), np.array([s for _, s in placed])
    start_rig(NAMES, cameras, poses, saw, BOARD)


def test_disconnected_rigs_say_what_to_do() -> None:
    corners = observe(BOARD, CAMERAS, POSES, seed=5)
    started(corners)
    apart = corners.copy()
    half = np.arange(len(POSES)) % 2 == 0
    apart[:2, half], apart[2:, ~half] = np.nan, np.nan
    with pytest.raises(
        UserError, match=r"falls apart into \{a, b\} and \{c, d\}.*a \+ c, a \+ d"
    ):
        started(apart)
    lonely = corners.copy()
    lonely[3, np.isfinite(lonely[:3]).any(axis=(0, 2, 3, 4))] = np.nan
    lonely[3, 0], lonely[:3, 0] = corners[np.isfinite(corners[:, 0, 2, 4, 0]), 0][0], np.nan
    with pytest.raises(UserError, match="camera d never sees the board at once with another"):
        solve(lonely)
    blind = corners.copy()
    blind[1] = np.nan
    with pytest.raises(UserError, match="camera b saw no board"):
        solve(blind)


def test_wrong_pairs_and_mirrors_are_no_rig() -> None:
    corners = observe(BOARD, FAN, [waved_board(BOARD, 0.7 * i) for i in range(14)])
    shifted = corners.copy()
    shifted[2] = np.roll(shifted[2], 5, axis=0)
    with pytest.raises(UserError, match=r"see 14 boards at once, but these do not agree"):
        solve(shifted, models=["opencv4"] * 3)
    mirrored = corners.copy()
    mirrored[2] = mirrored[2, :, :, ::-1]
    mirrored[2, ..., 0] = SIZE[0] - 1 - mirrored[2, ..., 0]
    with pytest.raises(UserError, match="the pictures of one of them are mirrored"):
        solve(mirrored, models=["opencv4"] * 3)


def test_copies_shifts_and_moves_are_refused() -> None:
    """A folder twice, one numbered otherwise, a camera that was knocked between pictures."""
    corners = observe(BOARD, CAMERAS, POSES, seed=1)
    with pytest.raises(UserError, match="cameras b and d have the same pictures"):
        solve(corners[[0, 1, 2, 1]])
    shifted = corners.copy()
    shifted[1] = np.roll(corners[1], 1, axis=0)
    with pytest.raises(UserError, match=r"camera b: \d of its 12 boards do not fit the other"):
        solve(shifted)
    stood = CAMERAS[1].world_from_camera
    turn = Pose.from_rotation_vector([0, 0.02, 0.01], np.zeros(3)).rotation
    for pose in (
        Pose(stood.rotation @ turn, stood.translation),
        Pose(stood.rotation, stood.translation + [0.03, 0, 0.015]),
    ):
        after = observe(
            BOARD, [CAMERAS[0], CAMERAS[1].posed(pose), *CAMERAS[2:]], POSES, seed=1
        )
        mixed = corners.copy()
        mixed[1, 11:] = after[1, 11:]
        with pytest.raises(
            UserError, match=r"camera b was moved, .* between pictures 10 and 13"
        ):
            solve(mixed)


def test_too_few_boards_name_the_camera() -> None:
    corners = observe(BOARD, CAMERAS, POSES, seed=6)
    seen = np.flatnonzero(np.isfinite(corners[1, ..., 0]).any(axis=(1, 2)))
    corners[1, seen[2:]] = np.nan
    with pytest.raises(UserError, match="camera b: the board was found in 2 of its pictures"):
        solve(corners)


LATE = np.array([0.0, 0.09, -0.06])
WAVED = Chessboard(5, 4, 0.08)


def clocked(
    readout: float = 0.0, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A moving board, cameras 90 ms late and 60 ms early, rows read out over some time.

    Corners and stamps of pictures 100 ms apart: the late camera's belong to the next instant.
    """
    rng = np.random.default_rng(seed)
    stamps = 100 + 10 * seed + np.arange(30) * 0.1 + rng.uniform(0, 2e-3, (3, 30))
    corners = np.empty((3, 30, WAVED.rows, WAVED.columns, 2))
    for c, v in np.ndindex(3, 30):
        camera_from_world = FAN[c].world_from_camera.inverse()
        row = np.zeros((WAVED.rows, WAVED.columns))
        for _ in range(2 if readout else 1):
            for r, k in np.ndindex(row.shape):
                time = float(stamps[c, v] + LATE[c] + readout * row[r, k])
                pose = waved_board(WAVED, time, seed)
                point = camera_from_world.apply(pose.apply(WAVED.points()[r, k]))
                corners[c, v, r, k] = FAN[c].project(point)
            row = (corners[c, v, ..., 1] + 0.5) / SIZE[1] - 0.5
            if not readout:
                break
    return corners + rng.normal(0, 0.1, corners.shape), stamps


@pytest.mark.parametrize("readout", [0.0, 0.03])
def test_clocks(readout: float) -> None:
    corners, stamps = clocked(readout)
    corners[[0, 2], :3] = np.nan  # one camera alone tells how the board began to move
    known = dict(zip(NAMES, FAN, strict=False))
    rig = solve(corners, WAVED, known=known, stamps=stamps)
    assert rig.sync is not None
    assert rig.sync.rolling == (readout > 0)
    miss = rig.sync.motion.offsets - LATE
    assert np.abs(miss[1:] / rig.sync.offset_errors[1:]).max() < 5
    assert rig.sync.offset_errors.max() < 1e-3
    if readout:
        np.testing.assert_allclose(rig.sync.motion.readout, readout, atol=3e-3)
    assert rig.sync.rms_before > 10 * rig.sync.rms
    assert np.abs(misses(rig, FAN).reshape(-1, 6)[:, 3:]).max() < 2e-3


def test_clocks_of_many_sessions() -> None:
    """Always found, where boards leave a lens's field, too; errors of poses are honest.

    The mean square of twelve misses in each of three sessions, in predicted errors.
    """
    known = dict(zip(NAMES, FAN, strict=False))
    off: list[NDArray[np.float64]] = []
    for seed in (1, 2, 5):
        corners, stamps = clocked(seed=seed)
        rig = solve(corners, WAVED, known=known, stamps=stamps)
        assert rig.sync is not None
        off.append(misses(rig, FAN) / np.sqrt(np.diag(rig.covariance)[6:]))
    assert 0.6 < float(np.sqrt(np.mean(np.square(off)))) < 1.4


def test_cameras_that_look_at_once_stay_so() -> None:
    """Times are given, and of no use."""
    corners = observe(BOARD, FAN, [waved_board(BOARD, 0.1 * i) for i in range(14)])
    stamps = np.tile(np.arange(14) * 0.1, (3, 1))
    known = dict(zip(NAMES, FAN, strict=False))
    assert solve(corners, known=known, stamps=stamps).sync is None
