"""Mirror balls in photographs: rays traced from scratch against the mapping."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.envmap.ball import BallCamera, ball_in_circle, find_ball
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

CAMERA = CameraModel.pinhole((640, 480), math.radians(50))


def traced(ball: BallCamera, pixel: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The reflection by the quadratic equation, a pixel at a time."""
    ray = ball.camera.unproject(pixel)
    middle = ball.distance * ball.middle
    b, c = -2 * ray @ middle, middle @ middle - 1
    if b * b < 4 * c:
        return None
    t = (-b - math.sqrt(b * b - 4 * c)) / 2
    n = t * ray - middle
    return np.asarray(ray - 2 * (ray @ n) * n)


@settings(deadline=None, max_examples=60)
@given(
    st.floats(-0.35, 0.35),
    st.floats(-0.25, 0.25),
    st.floats(1.3, 200),
    st.integers(0, 2**32 - 1),
)
def test_mapping_is_reflection(x: float, y: float, distance: float, seed: int) -> None:
    middle = np.array([x, y, 1.0]) / math.sqrt(x * x + y * y + 1)
    ball = BallCamera(CAMERA, middle, distance)
    rng = np.random.default_rng(seed)
    alpha = ball.hidden
    side = np.linalg.svd(middle[None])[2][1:]
    r, phi = math.tan(alpha) * np.sqrt(rng.uniform(0, 0.998, 50)), rng.uniform(0, 6.3, 50)
    rays = middle + r[:, None] * (
        np.cos(phi)[:, None] * side[0] + np.sin(phi)[:, None] * side[1]
    )
    pixels = CAMERA.project(rays)
    got = ball.unproject(pixels)
    for pixel, direction in zip(pixels, got, strict=True):
        truth = traced(ball, pixel)
        assert truth is not None
        np.testing.assert_allclose(direction, truth, atol=1e-9)
    np.testing.assert_allclose(ball.project(got), pixels, atol=1e-5)


def test_what_lies_behind_the_ball_is_not_seen() -> None:
    ball = BallCamera(CAMERA, np.array([0.0, 0.0, 1.0]), 3.0)
    limit = math.asin(1 / 3)
    for angle, seen in ((limit * 0.99, False), (limit * 1.01, True)):
        d = np.array([math.sin(angle), 0.0, math.cos(angle)])
        assert np.isfinite(ball.project(d)).all() == seen
    assert not np.isfinite(ball.unproject(np.array([[0.0, 0.0]]))).any()  # beside the ball


@pytest.mark.parametrize("distance", [1.5, 6.0, 80.0, 3000.0])
def test_outline_gives_the_ball_back(distance: float) -> None:
    middle = np.array([0.21, -0.13, 1.0])
    middle /= np.linalg.norm(middle)
    side = np.linalg.svd(middle[None])[2][1:]
    phi = np.linspace(0, 5, 11)  # not even the whole outline
    t = math.tan(math.asin(1 / distance))
    rim = CAMERA.project(
        middle + t * (np.cos(phi)[:, None] * side[0] + np.sin(phi)[:, None] * side[1])
    )
    ball = find_ball(CAMERA, rim)
    np.testing.assert_allclose(ball.middle, middle, atol=1e-9)
    assert ball.distance == pytest.approx(distance, rel=1e-6)


def test_without_a_camera_the_ball_is_the_ideal_one() -> None:
    ball = ball_in_circle((200, 100), (120.0, 40.0), 30.0)
    q = np.array([[120.0, 40.0], [135.0, 40.0], [120.0, 61.0], [100.0, 52.0]])
    # s = x / sqrt(2 (z + 1)): the normal halves the way from the camera to what is reflected
    n = (q - [120.0, 40.0]) / 30
    n = np.column_stack([n, -np.sqrt(1 - np.sum(n * n, axis=1))])
    truth = np.array([0, 0, 1.0]) - 2 * n[:, 2:] * n
    np.testing.assert_allclose(ball.unproject(q), truth, atol=2e-4)


def test_no_ball_is_refused() -> None:
    with pytest.raises(UserError, match="3 points"):
        find_ball(CAMERA, np.array([[1.0, 2.0], [3.0, 4.0]]))
    with pytest.raises(UserError, match="one point"):
        find_ball(CAMERA, np.full((4, 2), 7.0))
    with pytest.raises(UserError, match=r"line|close"):
        find_ball(CAMERA, np.array([[10.0, 10.0], [20.0, 20.0], [30.0, 30.0], [40.0, 40.0]]))
    with pytest.raises(UserError, match="outside"):
        ball_in_circle((100, 100), (120.0, 50.0), 30.0)
    with pytest.raises(UserError, match="too small"):
        ball_in_circle((100, 100), (50.0, 50.0), math.nan)
