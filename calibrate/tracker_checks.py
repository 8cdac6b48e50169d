"""Whether a tracker's solution is one: scale, likeness of both motions, what stays open."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.hand_eye import Frames, name_axis, turns_between
from chromeball.calibrate.tracker_adjust import Noise, Rows, State
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

#: Standard errors beyond which an answer is none: radians, metres, seconds.
WORST_TURN, WORST_PLACE = math.radians(5), 0.1
#: Noise above this share of the motion means that the poses do not belong together.
UNLIKE = 0.25
#: A sound tracker's metre is true to this: 2.4 mm, an ISOTRAK's, over a quarter of a metre. One
#: that is three times worse has another unit, or the board another size.
SOUND_SCALE, WORST_SCALE = 0.01, 0.03
#: So many standard errors from 1 a scale is no chance.
SURE = 4.0
CHECKS = (
    "check which sample belongs to which picture, both clocks, the order of the angles, and "
    "that the pictures are not mirrored"
)


def refuse_unlike(rows: Rows, state: State, noise: Noise) -> None:
    """Refuse poses of the tracker that have little to do with the pictures'."""
    sensor = rows.sensor(state.delay)
    turns = turns_between(Frames(sensor.rotations, sensor.positions))
    moved = math.sqrt(float((turns**2).sum(axis=1).mean()) / 6)
    spread = float(np.linalg.norm(np.std(sensor.positions, axis=0)) / math.sqrt(3))
    if noise.rotation > UNLIKE * moved or noise.position > max(UNLIKE * spread, 0.02):
        raise UserError(
            "the tracker's motion is not the pictures' (they differ by "
            f"{math.degrees(noise.rotation):.1f} degrees and {noise.position * 1e3:.0f} mm): "
            f"{CHECKS}"
        )


def check_scale(
    rows: Rows, state: State, used: NDArray[np.bool_], say: Callable[[str], object]
) -> tuple[float, float]:
    """How many times as far the tracker moved as the pictures say, and its standard error.

    `say` hears of one that is not 1.

    Raises
    ------
    UserError
        When that is far from one.

    """
    sensor = rows.sensor(state.delay)
    board = Frames(state.rotations, state.translations).inverse()[used]
    far = board.translations @ state.tracker_from_board.rotation.T
    eye = np.tile(-np.eye(3), (len(far), 1, 1))
    left = np.concatenate([sensor.rotations[used], eye, -far[..., None]], axis=2)
    share = 1 / np.sqrt(sensor.variance * sensor.shared)[used, None]
    left, right = left * share[..., None], -sensor.positions[used] * share
    left = left.reshape(-1, 7)
    found = np.linalg.lstsq(left, right.ravel(), rcond=None)[0]
    error = left @ found - right.ravel()
    sigma = math.sqrt(float(error @ error) / max(error.size - 7, 1))
    spread = sigma * math.sqrt(float(np.linalg.pinv(left.T @ left)[6, 6]))
    scale = float(found[6])
    if scale < 0.1:
        raise UserError(f"the tracker's motion is not the pictures': {CHECKS}")
    if abs(scale - 1) > max(SOUND_SCALE, SURE * spread):
        told = (
            f"the tracker moved {scale:.3f} +- {spread:.3f} times as far as the pictures say: "
            f"measure the board's square, {scale:.3f} of what was given would fit (printers "
            "shrink to the page); else check the log's unit, and keep a magnetic tracker off "
            "metal"
        )
        if abs(scale - 1) > WORST_SCALE:
            raise UserError(told)
        say(f"warning: {told}")
    return scale, spread


def refuse_open(spread: Array) -> None:
    """Refuse an answer whose standard errors say that it is none."""
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
                f"the place of the {of} stays open (standard error "
                f"{math.sqrt(size[2]):.2f} m): turn the camera further, about two "
                "axes or three, or take more pictures"
            )
