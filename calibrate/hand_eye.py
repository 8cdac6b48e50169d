"""Where a camera sits on a tracker's sensor, and a board in the tracker's space: the start.

S X = Z D for every view, with S = tracker_from_sensor (the tracker), D = camera_from_board
inverted (the picture), X = sensor_from_camera and Z = tracker_from_board unknown. Rotations
first, from the singular vectors of a sum of Kronecker products (Shah 2013), then both
translations by linear least squares. Wrong poses are left out by trying threes of views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: Threes of views tried; with 40 % wrong poses one in five is sound.
TRIALS = 200
#: Turns about a second axis below this leave X open, radians.
LEAST_TURN = math.radians(2)
#: A pose more than so many median errors off takes no part in the start.
FAR = 4.0


@dataclass(frozen=True)
class Frames:
    """V poses: ``rotations`` (V, 3, 3), ``translations`` (V, 3)."""

    rotations: Array
    translations: Array

    @classmethod
    def of(cls, poses: list[Pose]) -> Frames:
        """From a list of poses."""
        return cls(
            np.array([p.rotation for p in poses]).reshape(-1, 3, 3),
            np.array([p.translation for p in poses]).reshape(-1, 3),
        )

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Frames:
        return Frames(self.rotations[chosen], self.translations[chosen])

    def __len__(self) -> int:
        return len(self.translations)

    def poses(self) -> list[Pose]:
        """As a list of poses."""
        return [Pose(r, t) for r, t in zip(self.rotations, self.translations, strict=True)]

    def inverse(self) -> Frames:
        """Every pose undone."""
        back = np.swapaxes(self.rotations, -1, -2)
        return Frames(back, -(back @ self.translations[..., None])[..., 0])


def hand_eye(sensor: Frames, board: Frames) -> tuple[Pose, Pose, NDArray[np.bool_]]:
    """``sensor_from_camera``, ``tracker_from_board`` and which views (V,) agree with them.

    `sensor` holds V poses ``tracker_from_sensor``, `board` as many ``board_from_camera``. Up to
    40 % of the views may be wrong. The same views give the same answer.

    Raises
    ------
    UserError
        For fewer than three views, or turns that leave the answer open.

    """
    count = len(sensor)
    if count < 3:
        raise UserError(
            f"{count} pictures with a pose of the tracker; three or more are needed"
        )
    refuse_single_axis(board)
    rng = np.random.default_rng(0)
    threes = np.array([rng.choice(count, 3, replace=False) for _ in range(TRIALS)])
    best, least = None, math.inf
    for chosen in [np.arange(count), *threes]:
        found = _closed_form(sensor[chosen], board[chosen])
        if found is None:
            continue
        turn, miss = view_errors(*found, sensor, board)
        score = math.log(np.median(turn) + 1e-12) + math.log(np.median(miss) + 1e-12)
        if score < least:
            best, least = found, score
    if best is None:
        raise UserError("the tracker's poses and the pictures' fit no common motion")
    agree = np.ones(count, bool)
    for _ in range(3):
        turn, miss = view_errors(*best, sensor, board)
        agree = (turn <= FAR * np.median(turn) + 1e-9) & (miss <= FAR * np.median(miss) + 1e-9)
        again = _closed_form(sensor[agree], board[agree])
        if agree.sum() < 3 or again is None:
            break
        best = again
    refuse_single_axis(board[agree])
    return (*best, agree)


def view_errors(
    sensor_from_camera: Pose, tracker_from_board: Pose, sensor: Frames, board: Frames
) -> tuple[Array, Array]:
    """By which angle (V,), radians, and distance (V,), metres, S X and Z D differ."""
    left = sensor.rotations @ sensor_from_camera.rotation
    right = tracker_from_board.rotation @ board.rotations
    # arccos is blind to small angles; the chord is not
    chord = np.linalg.norm(left - right, axis=(-2, -1)) / math.sqrt(8)
    turn = 2 * np.arcsin(np.clip(chord, 0, 1))
    there = sensor.rotations @ sensor_from_camera.translation + sensor.translations
    miss = np.linalg.norm(there - tracker_from_board.apply(board.translations), axis=-1)
    return turn, miss


def turns_between(frames: Frames) -> Array:
    """Rotation vectors from each view to each later one, in the former's axes, (P, 3)."""
    from scipy.spatial.transform import Rotation

    i, j = np.triu_indices(len(frames), 1)
    relative = np.swapaxes(frames.rotations[i], -1, -2) @ frames.rotations[j]
    return np.asarray(Rotation.from_matrix(relative).as_rotvec(), float)


def refuse_single_axis(board: Frames) -> None:
    """Refuse views without turns about two axes: they leave the camera's place open.

    Raises
    ------
    UserError
        With the direction that is open.

    """
    turns = turns_between(board)
    size, axes = np.linalg.eigh(turns.T @ turns / max(len(turns), 1))
    if math.sqrt(max(size[2], 0.0)) < LEAST_TURN:
        raise UserError(
            "the camera did not turn between the pictures, which leaves its place on the "
            "sensor open: tilt and roll it by 30 degrees or more, about two axes"
        )
    if math.sqrt(max(size[1], 0.0)) < LEAST_TURN:
        raise UserError(
            f"the camera turned about one axis only, {name_axis(axes[:, 2])}: its place along "
            "that axis and its turn about it stay open; turn it about a second axis, too"
        )


def name_axis(axis: Array) -> str:
    """A direction in camera axes as people say it."""
    k = int(np.argmax(np.abs(axis)))
    name = ("right (a tilt)", "down (a pan)", "forward (a roll)")[k]
    x, y, z = axis * np.sign(axis[k])
    return f"its {name}, {x:.2f} {y:.2f} {z:.2f} in its own axes"


def _closed_form(sensor: Frames, board: Frames) -> tuple[Pose, Pose] | None:
    """X and Z (Shah 2013, eqs. 17-21); None where the views do not determine them."""
    if len(sensor) < 3:
        return None
    # vec(R_Z) = sum (R_D kron R_S) vec(R_X), columns stacked
    total = np.einsum("vij,vkl->ikjl", board.rotations, sensor.rotations).reshape(9, 9)
    u, size, vt = np.linalg.svd(total)
    if size[0] - size[1] < 1e-6 * len(sensor):
        return None
    r_x, r_z = (_rotation(v.reshape(3, 3).T) for v in (vt[0], u[:, 0]))
    if r_x is None or r_z is None:
        return None
    # R_S t_X - t_Z = R_Z t_D - t_S
    count = len(sensor)
    left = np.concatenate([sensor.rotations, np.tile(-np.eye(3), (count, 1, 1))], axis=2)
    right = board.translations @ r_z.T - sensor.translations
    shift, _, rank, _ = np.linalg.lstsq(left.reshape(-1, 6), right.ravel(), rcond=1e-9)
    if rank < 6:
        return None
    return Pose(r_x, shift[:3]), Pose(r_z, shift[3:])


def _rotation(matrix: Array) -> Array | None:
    """The nearest rotation to a multiple of `matrix`, of either sign."""
    matrix = matrix * np.sign(np.linalg.det(matrix))
    u, size, vt = np.linalg.svd(matrix)
    if not size[2] > 1e-6 * size[0] or np.linalg.det(u @ vt) < 0:
        return None
    return np.asarray(u @ vt, float)
