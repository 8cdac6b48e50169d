"""A tracker on a camera: truth, noise against covariance, delays, wrong poses, open motions."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from chromeball.calibrate.hand_eye import Frames, hand_eye
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.tracker import TrackerSolution, solve_tracker
from chromeball.calibrate.tracker_file import camera_poses, read_tracker
from chromeball.calibrate.tracker_log import TrackerLog, read_log, right_jacobian, sample
from chromeball.calibrate.virtual import board_poses, photograph
from chromeball.cli.main import build_app
from chromeball.envmap.stitch.directions import read_directions
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)
BOARD = Chessboard(7, 5, 0.04)
POINTS = BOARD.points().reshape(-1, 3)
X = Pose.from_rotation_vector([0.3, -1.2, 0.8], [0.04, -0.06, 0.09])
Z = Pose.from_rotation_vector([-1.5, 0.2, 0.3], [0.5, -0.2, 0.3])
POSITION, ROTATION = 0.0024, math.radians(0.75)
DELAY = 0.0473


def sensor_poses(camera_from_board: list[Pose]) -> list[Pose]:
    return [Z @ pose.inverse() @ X.inverse() for pose in camera_from_board]


def noisy_log(
    poses: list[Pose], rng: np.random.Generator, noise: float, times: Array | None = None
) -> TrackerLog:
    count = len(poses)
    turn = Rotation.from_rotvec(rng.normal(0, noise * ROTATION, (count, 3)))
    rotations = (Rotation.from_matrix([p.rotation for p in poses]) * turn).as_matrix()
    shift = rng.normal(0, noise * POSITION, (count, 3))
    positions = np.array([p.translation for p in poses]) + shift
    files = None if times is not None else tuple(map(str, range(count)))
    return TrackerLog(positions, rotations, times, files)


def still(
    count: int, seed: int, noise: float = 1.0, pixel: float = 0.1
) -> tuple[Array, TrackerLog]:
    """Pictures of a board, and as many poses of the tracker."""
    poses = board_poses(BOARD, CAMERA, count, seed=seed, size=0.5)
    rng = np.random.default_rng(seed)
    pixels = np.array([CAMERA.project(p.apply(POINTS)) for p in poses])
    pixels = pixels + rng.normal(0, pixel, pixels.shape)
    return pixels, noisy_log(sensor_poses(poses), rng, noise)


def moving(
    seed: int, noise: float = 1.0, speed: float = 1.0
) -> tuple[Array, TrackerLog, Array]:
    """A camera waved before the board for 8 s, the tracker at 60 Hz, pictures at 3 Hz."""
    rng = np.random.default_rng(seed)
    size, phase = rng.normal(0, 0.6, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
    reach = np.array([0.25, 0.25, 0.3, 0.05, 0.04, 0.06])

    def pose(t: float) -> Pose:
        wave = np.sin(2 * np.pi * np.array([0.23, 0.41, 0.67]) * t * speed + phase)
        v = (size * wave).sum(axis=1) * reach
        turn = Pose.from_rotation_vector(v[:3], np.zeros(3)).rotation
        return Pose(turn, np.array([0, 0, 0.6]) + v[3:] - turn @ POINTS.mean(axis=0))

    times = np.arange(-0.7, 8.7, 1 / 60)
    log = noisy_log(sensor_poses([pose(t) for t in times]), rng, noise, times + DELAY)
    clock = np.arange(0.1, 8, 1 / 3)
    pixels = np.array([CAMERA.project(pose(t).apply(POINTS)) for t in clock])
    return pixels + rng.normal(0, 0.1, pixels.shape), log, clock


def errors(found: TrackerSolution) -> Array:
    """Of the 13 unknowns, in the covariance's order."""
    parts: list[Array] = []
    for have, truth in ((found.sensor_from_camera, X), (found.tracker_from_board, Z)):
        turn = Pose(have.rotation @ truth.rotation.T, np.zeros(3)).rotation_vector()
        parts += [turn, have.translation - truth.translation]
    return np.concatenate([*parts, [found.delay - DELAY]])


def test_exact_poses_give_the_exact_answer() -> None:
    pixels, log = still(6, 1, noise=0.0, pixel=0.0)
    found = solve_tracker(CAMERA, POINTS, pixels, log)
    np.testing.assert_allclose(errors(found)[:12], 0, atol=1e-9)
    assert found.used.all()
    assert found.scale == pytest.approx(1, abs=1e-8)


def test_closed_form_alone() -> None:
    poses = board_poses(BOARD, CAMERA, 4, seed=3)
    sensor = Frames.of(sensor_poses(poses))
    x, z, agree = hand_eye(sensor, Frames.of(poses).inverse())
    np.testing.assert_allclose(x.matrix(), X.matrix(), atol=1e-9)
    np.testing.assert_allclose(z.matrix(), Z.matrix(), atol=1e-9)
    assert agree.all()


def test_derivatives_are_exact() -> None:
    """Of the tracker's rows by all unknowns, against differences."""
    from chromeball.calibrate.tracker_adjust import Noise, Rows, State, moved

    pixels, log, clock = moving(0)
    rows = Rows(CAMERA, POINTS, pixels[:3], log, clock[:3], 0.0, np.arange(3))
    turns = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-0.2, 0.4, 0], [0.3, 0, -0.5]]).as_matrix()
    state = State(X, Z, 0.02, turns, np.array([[0.1, 0, 1], [0, 0.2, 0.8], [0.1, 0.1, 1.2]]))
    noise = Noise(0.1, 0.002, 0.01)
    residual, own, shared = rows.tracker_rows(state, noise, True)
    step = 1e-6
    for k in range(13):
        d = np.zeros(13)
        d[k] = step
        there = replace(
            state,
            sensor_from_camera=moved(X, d[:6]),
            tracker_from_board=moved(Z, d[6:12]),
            delay=state.delay + d[12],
        )
        slope = (rows.tracker_rows(there, noise, True)[0] - residual) / step
        np.testing.assert_allclose(shared[:, :, k], slope, rtol=2e-3, atol=0.05)
    for k in range(6):
        d = np.zeros(6)
        d[k] = step
        turned = [moved(Pose(r, t), d) for r, t in zip(turns, state.translations, strict=True)]
        frames = Frames.of(turned)
        # the turn and the shift are independent: exp(w) R and t + d
        there = replace(
            state,
            rotations=frames.rotations,
            translations=frames.translations,
        )
        slope = (rows.tracker_rows(there, noise, True)[0] - residual) / step
        np.testing.assert_allclose(own[:, :, k], slope, rtol=2e-3, atol=0.05)


def test_covariance_is_honest() -> None:
    """Squared errors over the covariance follow chi-squared with 12 degrees of freedom."""
    distances, noises = list[float](), list[Array]()
    for seed in range(16):
        pixels, log = still(14, seed)
        found = solve_tracker(CAMERA, POINTS, pixels, log)
        error = errors(found)[:12]
        distances.append(float(error @ np.linalg.solve(found.covariance[:12, :12], error)))
        noise = found.noise
        noises.append(np.array([noise.pixel, noise.position, noise.rotation]))
    # Of 16 values the mean has the deviation sqrt(24 / 16) = 1.22; the noises, told from 36
    # redundancies each, add a few per cent.
    assert np.mean(distances) == pytest.approx(12, abs=3.7)
    ratio = np.mean(noises, axis=0) / [0.1, POSITION, ROTATION]
    np.testing.assert_allclose(ratio, 1, atol=0.1)


def test_delay_and_its_error() -> None:
    found = [solve_tracker(CAMERA, POINTS, *moving(seed)) for seed in range(6)]
    off = np.array([f.delay - DELAY for f in found]) / [f.standard_errors[12] for f in found]
    assert (off**2).sum() == pytest.approx(6, abs=10.4)  # chi-squared with 6 degrees: 3 sigma
    assert max(f.standard_errors[12] for f in found) < 0.003
    distances = [
        float(e @ np.linalg.solve(f.covariance, e)) for f in found if (e := errors(f)).any()
    ]
    assert np.mean(distances) == pytest.approx(13, abs=6)


def test_a_given_delay_is_kept_and_a_window_helps() -> None:
    pixels, log, clock = moving(3)
    given_delay = solve_tracker(CAMERA, POINTS, pixels, log, clock, delay=DELAY)
    assert given_delay.delay == DELAY
    assert given_delay.standard_errors[12] == 0
    smooth = solve_tracker(CAMERA, POINTS, pixels, log, clock, delay=DELAY, window=0.2)
    assert (smooth.standard_errors[:12] < given_delay.standard_errors[:12]).all()
    assert (np.abs(errors(smooth)[:12]) < 4 * smooth.standard_errors[:12]).all()


def test_pictures_taken_at_rest_leave_the_delay_open() -> None:
    """The log's noise alone has slopes, too: they must not pass for motion."""
    poses = board_poses(BOARD, CAMERA, 10, seed=2, size=0.5)
    times = np.arange(0, 10, 1 / 30)
    rng = np.random.default_rng(0)
    log = noisy_log(sensor_poses([poses[int(t)] for t in times]), rng, 1.0, times)
    pixels = np.array([CAMERA.project(p.apply(POINTS)) for p in poses])
    pixels += rng.normal(0, 0.1, pixels.shape)
    clock = np.linspace(0.5, 9.5, 10)
    with pytest.raises(UserError, match="leaves the delay open"):
        solve_tracker(CAMERA, POINTS, pixels, log, clock)
    assert solve_tracker(CAMERA, POINTS, pixels, log, clock, delay=0.0).used.sum() >= 9


def test_wrong_poses_are_found() -> None:
    pixels, log = still(25, 4)
    rng = np.random.default_rng(4)
    bad = rng.choice(25, 10, replace=False)
    log.positions[bad] += rng.normal(0, 0.2, (10, 3))
    log.rotations[bad] = (
        Rotation.from_rotvec(rng.normal(0, 0.4, (10, 3))).as_matrix() @ (log.rotations[bad])
    )
    found = solve_tracker(CAMERA, POINTS, pixels, log)
    assert not found.used[bad].any()
    assert found.used.sum() >= 14
    error = errors(found)[:12]
    assert error @ np.linalg.solve(found.covariance[:12, :12], error) < 40


def test_boards_read_upside_down_are_turned() -> None:
    pixels, log = still(12, 6)
    truth = solve_tracker(CAMERA, POINTS, pixels, log)
    pixels[[1, 5, 7]] = pixels[[1, 5, 7], ::-1]
    heard: list[str] = []
    found = solve_tracker(CAMERA, POINTS, pixels, log, tell=heard.append)
    assert any("3 boards were read upside down" in line for line in heard)
    np.testing.assert_allclose(errors(found), errors(truth), atol=1e-6)


def turned_about(axes: list[list[float]]) -> tuple[Array, TrackerLog]:
    """A camera that turns about these axes only, before a far board."""
    rng = np.random.default_rng(0)
    poses: list[Pose] = []
    for k in range(12):
        turn = Rotation.from_rotvec(np.array(axes[k % len(axes)]) * rng.uniform(-0.3, 0.3))
        away = np.array([0, 0, 0.8]) + rng.uniform(-0.05, 0.05, 3)
        middle = POINTS.mean(axis=0)
        poses.append(Pose(turn.as_matrix(), away - turn.as_matrix() @ middle))
    pixels = np.array([CAMERA.project(p.apply(POINTS)) for p in poses])
    pixels += rng.normal(0, 0.1, pixels.shape)
    return pixels, noisy_log(sensor_poses(poses), rng, 0.2)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ([[0.0, 1, 0]], r"about one axis only, its down \(a pan\)"),
        ([[0.0, 0, 1]], r"about one axis only, its forward \(a roll\)"),
        ([[0.0, 0, 0]], "did not turn"),
    ],
)
def test_motions_that_leave_it_open(axes: list[list[float]], message: str) -> None:
    pixels, log = turned_about(axes)
    with pytest.raises(UserError, match=message):
        solve_tracker(CAMERA, POINTS, pixels, log)


def refused(change: Callable[[Array, TrackerLog], tuple[Array, Array, TrackerLog]]) -> str:
    pixels, log = still(12, 5)
    points, pixels, log = change(pixels, log)
    with pytest.raises(UserError) as caught:
        solve_tracker(CAMERA, points, pixels, log)
    return str(caught.value)


def test_inputs_that_do_not_belong_together() -> None:
    assert "times as far as the pictures say: measure the board's square, 0.7" in refused(
        lambda q, log: (POINTS * 1.3, q, log)
    )
    assert "motion is not the pictures'" in refused(
        lambda q, log: (POINTS, np.roll(q, 1, axis=0), log)
    )
    mirror = np.array([CAMERA.size[0] - 1.0, 0])
    assert "mirrored" in refused(lambda q, log: (POINTS, mirror + q * [-1, 1], log))
    assert "2 poses" in refused(
        lambda q, log: (POINTS, q, TrackerLog(log.positions[:2], log.rotations[:2]))
    )
    assert "only 2 pictures place" in refused(
        lambda q, log: (POINTS, q * np.where(np.arange(12) < 2, 1, np.nan)[:, None, None], log)
    )


def test_a_wrong_square_is_refused_and_a_small_error_told() -> None:
    """A sound tracker's metre is true to 1 %; 5 % are a printer's."""
    pixels, log = still(20, 5, noise=0.3)
    heard: list[str] = []
    solve_tracker(CAMERA, POINTS, pixels, log, tell=heard.append)
    assert heard == []
    found = solve_tracker(CAMERA, POINTS * 1.02, pixels, log, tell=heard.append)
    assert found.scale == pytest.approx(1 / 1.02, abs=4 * found.sigma_scale)
    assert len(heard) == 1
    assert heard[0].startswith("warning: the tracker moved 0.98")
    assert "measure the board's square" in heard[0]
    with pytest.raises(UserError, match=r"moved 0\.95\d \+- .* measure the board's square"):
        solve_tracker(CAMERA, POINTS * 1.05, pixels, log)


def test_a_wrong_given_delay_is_told() -> None:
    pixels, log, clock = moving(2)
    heard: list[str] = []
    solve_tracker(CAMERA, POINTS, pixels, log, clock, delay=DELAY, tell=heard.append)
    assert heard == []
    found = solve_tracker(CAMERA, POINTS, pixels, log, clock, delay=0.0, tell=heard.append)
    assert found.delay == 0
    assert re.search(r"warning: the log says that the delay is 4[67]\.\d \+- ", heard[-1])
    assert log.times is not None
    late = replace(log, times=log.times + 0.073)
    with pytest.raises(
        UserError, match=r"delay 0 s that was given, but with 0\.1[12]\d s it does"
    ):
        solve_tracker(CAMERA, POINTS, pixels, late, clock, delay=0.0)


def test_a_delay_beyond_the_search() -> None:
    pixels, log, clock = moving(2)
    assert log.times is not None
    far = replace(log, times=log.times + 0.9)
    with pytest.raises(UserError, match=r"delay of 0\.947 s, farther .* add --search 1\.9"):
        solve_tracker(CAMERA, POINTS, pixels, far, clock)
    heard: list[str] = []
    solve_tracker(CAMERA, POINTS, pixels, log, clock, search=0.05, tell=heard.append)
    assert any("at the limit of the search, 0.05 s" in line for line in heard)


def quaternions(order: list[int], log: TrackerLog) -> TrackerLog:
    """The log with x, y, z, w in another order."""
    turns = Rotation.from_matrix(log.rotations).as_quat()[:, order]
    return replace(log, rotations=Rotation.from_quat(turns).as_matrix())


def euler(seq: str, factor: float, order: list[int], log: TrackerLog) -> TrackerLog:
    """The log's angles, in the order z, y, x, written otherwise."""
    angles = Rotation.from_matrix(log.rotations).as_euler(seq, degrees=True)[:, order] * factor
    turns = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    return replace(log, rotations=turns, angles=angles)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (lambda log: replace(log, rotations=log.rotations.swapaxes(1, 2)), "signs of qx, qy"),
        (partial(quaternions, [1, 2, 3, 0]), "named qw, qx, qy, qz hold x, y, z, w"),
        (partial(quaternions, [3, 0, 1, 2]), "named qx, qy, qz, qw hold w, x, y, z"),
        (lambda log: replace(log, positions=-log.positions), "left-handed, or the pictures"),
        (partial(euler, "ZYX", 1.0, [2, 1, 0]), "hold roll, elevation, azimuth"),
        (partial(euler, "ZYX", 1.0, [1, 2, 0]), "hold elevation, roll, azimuth"),
        (partial(euler, "ZYX", math.pi / 180, [0, 1, 2]), "its angles are radians"),
        (partial(euler, "zyx", 1.0, [0, 1, 2]), "axes that stay"),
    ],
)
def test_another_reading_that_fits_is_named(
    written: Callable[[TrackerLog], TrackerLog], message: str
) -> None:
    pixels, log = still(10, 3)
    with pytest.raises(UserError, match=f"fits the pictures only if .*{message}"):
        solve_tracker(CAMERA, POINTS, pixels, written(log))


def test_pictures_without_a_board_are_told_by_who_looked() -> None:
    pixels, log = still(10, 3)
    pixels[[2, 7]] = np.nan
    heard: list[str] = []
    found = solve_tracker(CAMERA, POINTS, pixels, log, tell=heard.append)
    assert found.used.sum() == 8
    assert heard == []


# ---- the log


def test_between_samples() -> None:
    """A steady screw is met exactly; a parabola is, by the window."""
    times = np.arange(20) / 10
    turn = Rotation.from_rotvec(times[:, None] * [0.4, -0.7, 0.2]).as_matrix()
    at = np.array([0.512, 1.03])
    log = TrackerLog(times[:, None] * [1.0, 2, 3], turn, times)
    curve = TrackerLog(times[:, None] ** 2 * [1.0, 2, 3], turn, times)
    line, window = sample(log, at), sample(curve, at, 0.6)
    np.testing.assert_allclose(line.positions, at[:, None] * [1, 2, 3])
    np.testing.assert_allclose(line.velocities, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(window.positions, at[:, None] ** 2 * [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(window.velocities, 2 * at[:, None] * [1, 2, 3], atol=1e-9)
    truth = Rotation.from_rotvec(at[:, None] * [0.4, -0.7, 0.2]).as_matrix()
    for found in (line, window):
        np.testing.assert_allclose(found.rotations, truth, atol=1e-12)
        np.testing.assert_allclose(found.spins, [[0.4, -0.7, 0.2]] * 2, atol=1e-12)
    np.testing.assert_allclose(line.variance, [0.12**2 + 0.88**2, 0.3**2 + 0.7**2])
    assert (window.variance < 0.7).all()
    with pytest.raises(UserError, match="holds 2 samples"):
        sample(log, at, 0.2)


def test_through_gimbal_lock() -> None:
    """An elevation that passes 90 degrees: azimuth and roll jump, the pose does not."""
    times = np.linspace(0, 1, 20)
    truth = Rotation.from_euler("ZYX", [(20.0, 80 + 20 * t, 10.0) for t in times], degrees=True)
    angles = truth.as_euler("ZYX", degrees=True)
    assert np.ptp(angles[:, 0]) > 170
    log = TrackerLog(np.zeros((20, 3)), truth.as_matrix(), times)
    middle = sample(log, times[:-1] + 1 / 38)
    expected = Rotation.from_euler(
        "ZYX", [(20.0, 80 + 20 * (t + 1 / 38), 10.0) for t in times[:-1]], degrees=True
    )
    off = Rotation.from_matrix(middle.rotations) * expected.inv()
    assert np.abs(off.as_rotvec()).max() < 1e-9


def test_right_jacobian() -> None:
    phi, d = np.array([0.5, -0.9, 0.3]), np.array([1e-6, 2e-6, -1e-6])
    moved = Rotation.from_rotvec(phi).inv() * Rotation.from_rotvec(phi + d)
    np.testing.assert_allclose(moved.as_rotvec(), right_jacobian(phi) @ d, rtol=1e-5)


def test_polhemus_angles_and_units(tmp_path: Path) -> None:
    plain, inches = tmp_path / "a.csv", tmp_path / "b.csv"
    plain.write_text(
        "t,x,y,z,qw,qx,qy,qz\n0,0.254,0,0,1,0,0,0\n1,0,0,0,0.7071068,0,0.7071068,0\n"
    )
    inches.write_text(
        "t,x_in,y_in,z_in,azimuth,elevation,roll\n0,10,0,0,0,0,0\n1,0,0,0,0,90,0\n"
    )
    one, two = read_log(plain), read_log(inches)
    np.testing.assert_allclose(one.positions, two.positions)
    np.testing.assert_allclose(one.rotations, two.rotations, atol=1e-7)
    # azimuth about z first, then elevation about the new y, then roll about the newest x
    inches.write_text(
        "t,x_cm,y_cm,z_cm,azimuth,elevation,roll\n0,1,0,0,90,0,0\n1,0,0,0,90,0,90\n"
    )
    turned = read_log(inches)
    np.testing.assert_allclose(turned.rotations[0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turned.rotations[1] @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    assert turned.positions[0, 0] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no samples"),
        ("t,x,y,z\n0,0,0,0\n", "needs columns qw, qx, qy, qz, or azimuth"),
        ("t,qw,qx,qy,qz\n0,1,0,0,0\n", "needs columns x, y, z in metres"),
        ("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n", "needs a column t in seconds"),
        ("t,x,y,z,qw,qx,qy,qz,w\n0,0,0,0,1,0,0,0,1\n", "unknown column w"),
        ("t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n0,0,0,0,1,0,0,0\n", "sample 2 is not later"),
        ("t,x,y,z,qw,qx,qy,qz\n0,0,0,0,2,0,0,0\n", "length is 2, not 1"),
        ("t,x,y,z,qw,qx,qy,qz\n0,0,a,0,1,0,0,0\n", "sample 1: y 'a' is no number"),
        ("t,x,y,z,qw,qx,qy,qz\n0,0,0\n", "row 1 has 3 fields, the first line 8"),
        ("t,x,y,z,qw,qx,qy,qz\n0,0,0,nan,1,0,0,0\n", "is not finite"),
        ("t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n", "one sample is no log"),
    ],
)
def test_broken_logs(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=message):
        read_log(path)


@settings(max_examples=60, deadline=None)
@given(st.text(alphabet='tfilexyzqw0123456789.,\n"-e', max_size=120), st.booleans())
def test_any_text_is_a_log_or_refused(
    tmp_path_factory: pytest.TempPathFactory, text: str, head: bool
) -> None:
    path = tmp_path_factory.mktemp("log") / "log.csv"
    path.write_text(("t,x,y,z,qw,qx,qy,qz\n" if head else "") + text)
    try:
        log = read_log(path)
    except UserError:
        return
    assert np.isfinite(log.positions).all()


# ---- the commands


@pytest.mark.parametrize("name", ["lens.cameramodel", "tracker.json.record.json"])
def test_files_beside_the_trackers(tmp_path: Path, name: str) -> None:
    CAMERA.write(tmp_path / name)
    with pytest.raises(
        UserError, match=r"needed is the tracker\.json that `calibrate tracker`"
    ):
        read_tracker(tmp_path / name)


def _on_wall(camera_from_board: Pose) -> Pose:
    return Pose(np.diag([1.0, -1, -1]), np.zeros(3)) @ camera_from_board.inverse()


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Photographs, a log in centimetres and a list of times: tracker.json near the truth."""
    from chromeball.scene.image import write_picture

    camera = CameraModel.pinhole((400, 300), 0.9)
    poses = board_poses(BOARD, camera, 8, seed=2, size=0.7)
    files = [tmp_path / f"{k}.png" for k in range(8)]
    for k, file in enumerate(files):
        write_picture(file, photograph(BOARD, camera, poses[k], seed=k))
    lens, log, times = (tmp_path / n for n in ("a.cameramodel", "log.csv", "times.csv"))
    camera.write(lens)
    lines = ["t,x_cm,y_cm,z_cm,qw,qx,qy,qz"]
    rng = np.random.default_rng(0)
    for k, pose in enumerate(sensor_poses(poses)):
        pose = pose @ Pose.from_rotation_vector(rng.normal(0, 0.003, 3), rng.normal(0, 1e-3, 3))
        q = Rotation.from_matrix(pose.rotation).as_quat()[[3, 0, 1, 2]]
        for t in np.arange(k, k + 1, 0.1):
            lines.append(",".join(f"{v:.9f}" for v in (t, *pose.translation * 100, *q)))
    log.write_text("\n".join(lines))
    times.write_text("file,t\n" + "".join(f"{k}.png,{k + 0.45}\n" for k in range(8)))
    output = tmp_path / "tracker.json"
    words = ["calibrate", "tracker", *files, "--camera", lens, "--target", BOARD.spec]
    words += ["--log", log, "--times", times, "-o", output]

    def run(*more: object) -> None:
        build_app()([str(w) for w in (*words, *more)], result_action="return_value")

    with pytest.raises(UserError, match="leaves the delay open"):
        run()
    assert not output.exists()
    run("--delay", -0.01, "--json")
    figures = json.loads(capsys.readouterr().out)
    assert figures["pictures_used"] == 8
    found = read_tracker(output)
    assert found.delay == -0.01
    x, z = found.sensor_from_camera.pose(), found.tracker_from_board.pose()
    np.testing.assert_allclose(x.translation, X.translation, atol=0.01)
    np.testing.assert_allclose(z.rotation, Z.rotation, atol=0.01)
    record = read_json(f"{output}.record.json")
    assert len(record["inputs"]) == 11
    assert record["figures"]["delay_estimated"] is False
    there, sigma = camera_poses(found, read_log(log), np.array([2.45]))
    truth = Z @ poses[2].inverse()
    np.testing.assert_allclose(there[0].translation, truth.translation, atol=0.01)
    assert 0 < sigma[0] < 0.05
    assert output.with_name(record["figures"]["plots"]["differences"]).is_file()

    # other pictures by the same tracker, and what envmap stitch makes of it
    times.write_text("file,t\n2.png,2.45\n")
    directions = tmp_path / "directions.json"
    track = ["calibrate", "track", output, "--log", log, "--times", times, "-o", directions]
    build_app()([str(w) for w in track], result_action="return_value")
    prior = read_directions(directions, ["2"])
    np.testing.assert_allclose(prior.rotations[0], truth.rotation, atol=0.02)
    np.testing.assert_allclose(prior.sigma, sigma)
    build_app()([str(w) for w in (*track, "--world", "wall")], result_action="return_value")
    upright = read_json(directions)["frames"][0]["world_from_camera"]
    # the camera stands before the board, which faces +z
    np.testing.assert_allclose(upright, _on_wall(poses[2]).matrix(), atol=0.03)
    times.write_text("file,t\n2.png,99\n")
    with pytest.raises(UserError, match="does not cover picture 1"):
        build_app()([str(w) for w in track], result_action="return_value")
    times.write_text("file,t\n0.png,1\n")
    for more, message in (
        (["--delay", 0], r"says nothing of 1\.png"),
        (["--window", -1], "seconds, or 0"),
        (["--rotation-noise", 0], "it is positive"),
    ):
        with pytest.raises(UserError, match=message):
            run(*more)
