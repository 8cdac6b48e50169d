"""Rigid poses: a group, and names that keep their promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.scene.pose import Pose

number = st.floats(-1e3, 1e3)
vectors = st.tuples(number, number, number).map(list)
angles = st.tuples(*[st.floats(-4, 4)] * 3).map(list)
poses = st.builds(Pose.from_rotation_vector, angles, vectors)


@settings(deadline=None)
@given(poses, poses, vectors)
def test_poses_compose_and_undo_each_other(a: Pose, b: Pose, point: list[float]) -> None:
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-9)
    np.testing.assert_allclose((a @ a.inverse()).matrix(), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(a.inverse().apply(a.apply(point)), point, atol=1e-9)
    np.testing.assert_allclose(a.rotate(point), a.apply(point) - a.translation, atol=1e-9)
    np.testing.assert_array_equal(Pose.from_matrix(a.matrix()).matrix(), a.matrix())
    np.testing.assert_array_equal((Pose.identity() @ a).matrix(), a.matrix())


@settings(deadline=None)
@given(angles)
def test_rotation_vectors_are_found_again(vector: list[float]) -> None:
    pose = Pose.from_rotation_vector(vector, [0, 0, 0])
    found = pose.rotation_vector()
    assert np.linalg.norm(found) <= math.pi + 1e-12
    again = Pose.from_rotation_vector(found, [0, 0, 0])
    np.testing.assert_allclose(again.rotation, pose.rotation, atol=1e-7)
    if np.linalg.norm(vector) < 3:
        np.testing.assert_allclose(found, vector, atol=1e-7)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-5, math.pi - 1e-9, math.pi])
def test_tiny_and_half_turns(size: float) -> None:
    axis = np.array([1.0, 2, 2]) / 3
    pose = Pose.from_rotation_vector(axis * size, [0, 0, 0])
    np.testing.assert_allclose(pose.rotate(axis), axis, atol=1e-12)
    across = np.array([2.0, -2, 1]) / 3
    turned = math.cos(size) * across + math.sin(size) * np.cross(axis, across)
    np.testing.assert_allclose(pose.rotate(across), turned, atol=1e-12)


@settings(deadline=None)
@given(vectors, vectors)
def test_look_at_puts_the_target_ahead_and_up_above(
    position: list[float], target: list[float]
) -> None:
    view = np.subtract(target, position)
    if np.hypot(view[0], view[2]) < 1e-3:
        with_up = [0.0, 0.0, 1.0]
        if abs(view[1]) < 1e-3:
            return
    else:
        with_up = [0.0, 1.0, 0.0]
    pose = Pose.look_at(position, target, with_up)
    ahead = pose.inverse().apply(target)
    np.testing.assert_allclose(ahead[:2], 0, atol=1e-8)
    assert ahead[2] == pytest.approx(np.linalg.norm(view))
    assert pose.inverse().rotate(with_up)[1] < 0  # y points down
    assert np.linalg.det(pose.rotation) == pytest.approx(1)


def test_what_is_no_pose_is_refused() -> None:
    with pytest.raises(ValueError, match="parallel to up"):
        Pose.look_at([0, 0, 0], [0, 5, 0])
    with pytest.raises(ValueError, match="parallel to up"):
        Pose.look_at([1, 2, 3], [1, 2, 3])
    for broken in (2 * np.eye(3), np.diag([1.0, 1, -1]), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match="proper orthonormal"):
            Pose(broken, np.zeros(3))
    with pytest.raises(ValueError, match="translation is not finite"):
        Pose(np.eye(3), np.array([0, math.inf, 0]))
    with pytest.raises(ValueError, match="rotation is not finite"):
        Pose.from_rotation_vector([0, math.inf, 0], [0, 0, 0])
