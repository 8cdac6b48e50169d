"""A tracker on a camera beside the closed forms that others solve it by.

OpenCV 5 has no hand-eye any more; Park and Martin 1994 and Daniilidis 1999 are written out here
from their papers, as OpenCV 4 had them (its best was Daniilidis'), and Shah 2013 is our start.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.row import Row
from chromeball.calibrate.hand_eye import Frames, hand_eye
from chromeball.calibrate.pose import solve_pose
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.tracker import solve_tracker
from chromeball.calibrate.tracker_log import TrackerLog
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]
#: Sensor poses and camera_from_board -> sensor_from_camera.
type Solver = Callable[[Frames, Frames], Pose]

CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)
POINTS = Chessboard(9, 6, 0.03).points().reshape(-1, 3)
X = Pose.from_rotation_vector([0.3, -1.2, 0.8], [0.04, -0.06, 0.09])
Z = Pose.from_rotation_vector([-1.5, 0.2, 0.3], [0.5, -0.2, 0.3])
#: A Polhemus ISOTRAK's static accuracy: RMS of the distance and of the angle.
POSITION, ROTATION = 0.0024, math.radians(0.75)
PICTURES = 40


def rows(quick: bool) -> list[Row]:
    """Errors of the camera's turn and place on the sensor, median over seeds."""
    seeds = 2 if quick else 12
    peers: dict[str, Solver] = {
        "chromeball's start (Shah 2013)": lambda s, c: hand_eye(s, c.inverse())[0],
        "Park and Martin 1994": _park,
        "Daniilidis 1999": _daniilidis,
    }
    names = ["chromeball", *peers]
    seconds = {name: math.inf for name in names}
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for seed in range(seeds):
        pixels, log = _scene(seed)
        start = time.process_time()
        found = solve_tracker(CAMERA, POINTS, pixels, log).sensor_from_camera
        seconds["chromeball"] = min(seconds["chromeball"], time.process_time() - start)
        errors["chromeball"].append(_error(found))
        start = time.process_time()
        boards = Frames.of(
            [
                solve_pose(CAMERA, POINTS, q, above_floor=False).world_from_camera.inverse()
                for q in pixels
            ]
        )
        posed = time.process_time() - start
        for name, solve in peers.items():
            start = time.process_time()
            pose = solve(Frames(log.rotations, log.positions), boards)
            spent = posed + time.process_time() - start
            seconds[name] = min(seconds[name], spent)
            errors[name].append(_error(pose))
    what = f"tracker, {PICTURES} poses, noise 2.4 mm and 0.75 degree RMS, {seeds} seeds"
    return [
        Row("calibrate", f"{what}: {kind}", name, seconds[name],
            float(np.median([e[k] for e in errors[name]])), unit, "error on the sensor, median")
        for k, (kind, unit) in enumerate((("turn", "deg"), ("place", "mm")))
        for name in names
    ]  # fmt: skip


def _scene(seed: int) -> tuple[Array, TrackerLog]:
    """A camera tilted by up to 40 degrees and rolled by up to 60 before a board."""
    rng = np.random.default_rng(seed)
    middle = POINTS.mean(axis=0)
    poses: list[Pose] = []
    while len(poses) < PICTURES:
        turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * [0.7, 0.7, 1.05]).as_matrix()
        there = np.array([0, 0, 0.5]) + rng.uniform(-0.1, 0.1, 3)
        pose = Pose(turn, there - turn @ middle)
        seen = CAMERA.project(pose.apply(POINTS))
        if ((seen > 5) & (seen < np.array(CAMERA.size) - 6)).all():
            poses.append(pose)
    sensor = [Z @ pose.inverse() @ X.inverse() for pose in poses]
    noise = rng.normal(0, ROTATION / math.sqrt(3), (PICTURES, 3))
    turned = Rotation.from_matrix([s.rotation for s in sensor]) * Rotation.from_rotvec(noise)
    shift = rng.normal(0, POSITION / math.sqrt(3), (PICTURES, 3))
    log = TrackerLog(np.array([s.translation for s in sensor]) + shift, turned.as_matrix())
    pixels = np.array([CAMERA.project(pose.apply(POINTS)) for pose in poses])
    return pixels + rng.normal(0, 0.1, pixels.shape), log


def _error(found: Pose) -> tuple[float, float]:
    turn = Pose(found.rotation @ X.rotation.T, np.zeros(3)).rotation_vector()
    shift = found.translation - X.translation
    return math.degrees(np.linalg.norm(turn)), 1e3 * float(np.linalg.norm(shift))


def _motions(sensor: Frames, board: Frames) -> tuple[Frames, Frames]:
    """A and B of A X = X B for all pairs of views."""
    i, j = np.triu_indices(len(sensor), 1)

    def between(frames: Frames) -> Frames:
        """From view j to view i, in the frame's own axes."""
        back = np.swapaxes(frames.rotations[i], 1, 2)
        shift = frames.translations[j] - frames.translations[i]
        return Frames(back @ frames.rotations[j], (back @ shift[..., None])[..., 0])

    return between(sensor), between(board.inverse())


def _shift(a: Frames, b: Frames, turn: Array) -> Array:
    """(R_A - I) t = R_X t_B - t_A."""
    left = (a.rotations - np.eye(3)).reshape(-1, 3)
    right = b.translations @ turn.T - a.translations
    return np.linalg.lstsq(left, right.ravel(), rcond=None)[0]


def _park(sensor: Frames, board: Frames) -> Pose:
    """Rotation by the motions' rotation vectors, then translation (Park and Martin 1994)."""
    a, b = _motions(sensor, board)
    alpha, beta = (Rotation.from_matrix(f.rotations).as_rotvec() for f in (a, b))
    u, _, vt = np.linalg.svd(alpha.T @ beta)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return Pose(turn, _shift(a, b, turn))


def _daniilidis(sensor: Frames, board: Frames) -> Pose:
    """Both at once by dual quaternions (Daniilidis 1999, eqs. 31-35)."""
    a, b = _motions(sensor, board)
    (qa, da), (qb, db) = (_dual(f) for f in (a, b))
    keep = np.abs(qa[:, 0]) < math.cos(math.radians(5))
    same = np.sign(qa[:, 0] * qb[:, 0])[:, None]
    qb, db = qb * same, db * same
    qa, da, qb, db = (v[keep] for v in (qa, da, qb, db))
    t = np.zeros((len(qa), 6, 8))
    t[:, :3, 0] = t[:, 3:, 4] = qa[:, 1:] - qb[:, 1:]
    t[:, :3, 1:4] = t[:, 3:, 5:] = _cross(qa[:, 1:] + qb[:, 1:])
    t[:, 3:, 0] = da[:, 1:] - db[:, 1:]
    t[:, 3:, 1:4] = _cross(da[:, 1:] + db[:, 1:])
    v1, v2 = np.linalg.svd(t.reshape(-1, 8))[2][-2:]
    u1, w1, u2, w2 = v1[:4], v1[4:], v2[:4], v2[4:]
    best = (-1.0, 0.0)
    for s in np.roots([u1 @ w1, u1 @ w2 + u2 @ w1, u2 @ w2]).real:
        best = max(best, (float(s * s * (u1 @ u1) + 2 * s * (u1 @ u2) + u2 @ u2), float(s)))
    size, s = best
    l2 = math.sqrt(1 / size)
    q, d = (s * l2 * first + l2 * second for first, second in ((u1, u2), (w1, w2)))
    turn = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    shift = 2 * (q[0] * d[1:] - d[0] * q[1:] + np.cross(q[1:], d[1:]))
    return Pose(turn, shift)


def _dual(frames: Frames) -> tuple[Array, Array]:
    """Quaternion (w first) and its dual part, t q / 2."""
    q = Rotation.from_matrix(frames.rotations).as_quat()[:, [3, 0, 1, 2]]
    t = frames.translations
    dual = np.empty_like(q)
    dual[:, 0] = -0.5 * (t * q[:, 1:]).sum(axis=1)
    dual[:, 1:] = 0.5 * (q[:, :1] * t + np.cross(t, q[:, 1:]))
    return q, dual


def _cross(v: Array) -> Array:
    return np.cross(v[:, None, :], np.eye(3)).swapaxes(1, 2)
