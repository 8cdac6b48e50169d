"""Poses of boards of which many corners are false."""

from __future__ import annotations

import numpy as np
import pytest

from chromeball.calibrate.board_pose import board_poses
from chromeball.calibrate.pose import start_poses
from chromeball.calibrate.target import Chessboard
from chromeball.scene.pose import Pose

POINTS = Chessboard(9, 6, 0.025).points().reshape(-1, 3)
POSE = Pose.from_rotation_vector(np.array([0.4, -0.3, 0.1]), np.array([-0.1, -0.05, 0.5]))


def rays(share: float, seed: int) -> np.ndarray:
    """Unit directions to the corners, a `share` of them up to 3 degrees off."""
    rng = np.random.default_rng(seed)
    seen = POSE.apply(POINTS)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    seen += rng.normal(scale=1e-4, size=seen.shape)
    wrong = rng.permutation(len(seen)) < round(share * len(seen))
    seen[wrong] += rng.normal(scale=0.05, size=(int(wrong.sum()), 3))
    return seen / np.linalg.norm(seen, axis=1, keepdims=True)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.55])
def test_false_corners_do_not_move_the_board(share: float) -> None:
    for seed in range(5):
        seen = rays(share, seed)
        best = min(board_poses(POINTS, seen), key=lambda p: abs(p.translation[2] - 0.5))
        np.testing.assert_allclose(best.translation, POSE.translation, atol=1.5e-3)
        turn = np.linalg.norm(best.rotation - POSE.rotation)
        assert turn < 0.02
        if share >= 0.3:
            plain = start_poses(POINTS, seen)[0]
            assert np.linalg.norm(plain.rotation - POSE.rotation) > 2 * turn


def test_corners_in_a_line_are_no_board() -> None:
    line = POINTS[:9]
    seen = POSE.apply(line)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    for pose in board_poses(line, seen):
        np.testing.assert_allclose(pose.apply(line)[:, 2] > 0, True)
    assert board_poses(POINTS[:3], rays(0, 0)[:3]) == []
    backwards = np.concatenate([rays(0, 0), -rays(0, 0)])
    assert board_poses(np.tile(POINTS, (2, 1)), backwards) == []
