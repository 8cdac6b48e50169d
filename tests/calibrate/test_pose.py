"""Poses against truth, noise against covariance, and clicks that cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.pose import solve_pose
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

RECTANGLE = np.array([[-0.3, 0, -0.2], [0.3, 0, -0.2], [0.3, 0, 0.2], [-0.3, 0, 0.2]])
LENS = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)
FISHEYE = CameraModel.fisheye("equisolid", (800, 800), np.radians(190))
PLACES = [(0.2, 0.8, 1.0), (-0.9, 0.5, 0.4), (0.05, 1.6, 0.1), (0.7, 0.25, -0.9)]


def see(
    lens: CameraModel, place: tuple[float, float, float], target: tuple[float, float, float]
) -> CameraModel:
    return lens.posed(Pose.look_at(np.array(place), np.array(target)))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("lens", [LENS, FISHEYE], ids=["distorted", "fisheye"])
def test_round_trip(lens: CameraModel, place: tuple[float, float, float]) -> None:
    camera = see(lens, place, (0.05, 0.0, -0.02))
    found = solve_pose(lens, RECTANGLE, camera.project_world(RECTANGLE))
    truth = camera.world_from_camera
    np.testing.assert_allclose(found.world_from_camera.translation, place, atol=1e-7)
    np.testing.assert_allclose(found.world_from_camera.rotation, truth.rotation, atol=1e-7)
    assert found.rms < 1e-6


def test_many_points_in_space() -> None:
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    camera = see(LENS, (0.3, 1.0, 1.5), (0, 0, 0))
    found = solve_pose(LENS, points, camera.project_world(points))
    np.testing.assert_allclose(found.world_from_camera.translation, [0.3, 1, 1.5], atol=1e-7)
    assert found.rival_rms is None


def test_fisheye_looking_away() -> None:
    """The rectangle near the rim, part of it beyond 90 degrees from the axis."""
    camera = see(FISHEYE, (0.1, 0.3, 0.25), (0.1, 0.9, -3.0))
    inside = camera.world_from_camera.inverse().apply(RECTANGLE)
    assert inside[:, 2].min() < 0
    pixels = camera.project_world(RECTANGLE)
    found = solve_pose(FISHEYE, RECTANGLE, pixels)
    np.testing.assert_allclose(found.world_from_camera.translation, [0.1, 0.3, 0.25], atol=1e-7)


@pytest.mark.parametrize("lens", [LENS, FISHEYE], ids=["distorted", "fisheye"])
def test_covariance_is_honest(lens: CameraModel) -> None:
    """Squared errors over the covariance follow chi-squared with 6 degrees of freedom."""
    camera = see(lens, (0.4, 0.8, 1.0), (0, 0, 0))
    truth = camera.world_from_camera
    pixels = camera.project_world(RECTANGLE)
    rng = np.random.default_rng(4)
    distances: list[float] = []
    for _ in range(100):
        clicks = pixels + rng.normal(0, 0.3, pixels.shape)
        found = solve_pose(lens, RECTANGLE, clicks, sigma=0.3)
        turn = Pose(truth.rotation.T @ found.world_from_camera.rotation, np.zeros(3))
        shift = found.world_from_camera.translation - truth.translation
        error = np.concatenate([turn.rotation_vector(), shift])
        distances.append(float(error @ np.linalg.solve(found.covariance, error)))
    # The mean of 100 such values has standard deviation sqrt(12 / 100) = 0.35.
    assert np.mean(distances) == pytest.approx(6, abs=1.1)


def test_residuals_tell_the_clicks_noise() -> None:
    """Eight numbers less six unknowns: the sum of squares is 2 sigma^2 on average."""
    camera = see(LENS, (0.4, 0.8, 1.0), (0, 0, 0))
    pixels = camera.project_world(RECTANGLE)
    rng = np.random.default_rng(5)
    sums = [
        4 * solve_pose(LENS, RECTANGLE, pixels + rng.normal(0, 0.5, (4, 2))).rms ** 2
        for _ in range(100)
    ]
    assert np.mean(sums) == pytest.approx(2 * 0.5**2, rel=0.35)


def test_far_rectangle_is_called_ambiguous() -> None:
    far = see(LENS, (3.0, 9.0, 12.0), (0, 0, 0))
    found = solve_pose(LENS, RECTANGLE, far.project_world(RECTANGLE), sigma=0.5)
    assert found.ambiguous
    assert found.rival_rms is not None
    near = see(LENS, (0.3, 0.6, 0.8), (0, 0, 0))
    assert not solve_pose(LENS, RECTANGLE, near.project_world(RECTANGLE)).ambiguous


def clicks() -> NDArray[np.float64]:
    return see(LENS, (0.2, 0.8, 1.0), (0, 0, 0)).project_world(RECTANGLE)


def test_wrong_order_is_refused() -> None:
    with pytest.raises(UserError, match=r"check their order|below the floor"):
        solve_pose(LENS, RECTANGLE, clicks()[[0, 2, 1, 3]])
    with pytest.raises(UserError, match="below the floor"):
        solve_pose(LENS, RECTANGLE, clicks()[::-1])


def test_degenerate_points_are_refused() -> None:
    q = clicks()
    line = np.column_stack([np.linspace(-1, 1, 4), np.zeros(4), np.zeros(4)])
    with pytest.raises(UserError, match="four points or more, not 3"):
        solve_pose(LENS, RECTANGLE[:3], q[:3])
    with pytest.raises(UserError, match="as many pixels, not 3"):
        solve_pose(LENS, RECTANGLE, q[:3])
    with pytest.raises(UserError, match="world points lie in a line"):
        solve_pose(LENS, line, q)
    with pytest.raises(UserError, match="pixels lie in a line"):
        solve_pose(LENS, RECTANGLE, [[100, 100], [200, 200], [300, 300], [400, 400]])
    with pytest.raises(UserError, match="points 1 and 2 were clicked at the same pixel"):
        solve_pose(LENS, RECTANGLE, [q[0], q[0], q[2], q[3]])
    with pytest.raises(UserError, match="outside the picture of 640x480"):
        solve_pose(LENS, RECTANGLE, q + np.array([600, 0]))
    with pytest.raises(UserError, match="must be finite"):
        solve_pose(LENS, RECTANGLE, q * np.nan)
    with pytest.raises(UserError, match="does not see pixel 5,5"):
        solve_pose(FISHEYE, RECTANGLE, [[5, 5], *q[1:]])
