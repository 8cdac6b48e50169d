"""Four corners: exact on exact clicks, predicted noise on noisy ones, bad clicks refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.envmap.align import align, alignment_json, read_alignment
from chromeball.envmap.overlay import Drawn, overlay
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import write_json

LENS = CameraModel.fisheye("equisolid", (1200, 1200), math.radians(190))
PANORAMA = CameraModel.latlong((2048, 1024))


def clicks(
    camera: CameraModel, pose: Pose, width: float, depth: float, side: int = -1
) -> np.ndarray:
    """Pixels of a rectangle about the origin; `side` is where along Z the third corner is."""
    x, z = np.array([-1, 1, 1, -1]) * width / 2, np.array([-1, -1, 1, 1]) * side * depth / 2
    return camera.posed(pose).project_world(np.stack([x, np.zeros(4), z], axis=1))


def pose_over(height: float, yaw: float, pitch: float, roll: float, x: float, z: float) -> Pose:
    """A camera at (x, height, z), held nearly upright."""
    turn = Pose.from_rotation_vector([0, yaw, 0], [0, 0, 0]).rotation
    level = turn @ np.diag([1.0, -1, -1])  # looks along -Z
    tilt = Pose.from_rotation_vector([pitch, 0, 0], [0, 0, 0]).rotation
    spin = Pose.from_rotation_vector([0, 0, roll], [0, 0, 0]).rotation
    return Pose(level @ tilt @ spin, np.array([x, height, z]))


@settings(max_examples=60, deadline=None)
@given(
    height=st.floats(0.5, 3),
    yaw=st.floats(-3, 3),
    pitch=st.floats(-0.6, 0.6),
    roll=st.floats(-0.6, 0.6),
    x=st.floats(-1, 1),
    z=st.floats(-1, 1),
    width=st.floats(0.5, 3),
    depth=st.floats(0.5, 3),
    side=st.sampled_from([-1, 1]),
)
def test_exact_clicks_give_the_pose_back(
    height: float,
    yaw: float,
    pitch: float,
    roll: float,
    x: float,
    z: float,
    width: float,
    depth: float,
    side: int,
) -> None:
    pose = pose_over(height, yaw, pitch, roll, x, z)
    points = clicks(PANORAMA, pose, width, depth, side)
    result = align(PANORAMA, points, width=width)
    np.testing.assert_allclose(result.world_from_camera.matrix(), pose.matrix(), atol=1e-7)
    assert result.depth == pytest.approx(depth, rel=1e-6)
    assert result.camera_height == pytest.approx(height, rel=1e-6)
    assert result.residual < 1e-9
    back = PANORAMA.posed(result.world_from_camera).project_world(result.corners)
    np.testing.assert_allclose(back, points, atol=1e-5)


@pytest.mark.parametrize("given", ["width", "depth", "camera_height"])
def test_one_length_gives_the_others(given: str) -> None:
    pose = pose_over(1.4, 0.3, 0.5, 0.05, 0.1, 1.2)
    lengths = {"width": 1.2, "depth": 0.8, "camera_height": 1.4}
    width, depth, height = (v if k == given else None for k, v in lengths.items())
    points = clicks(LENS, pose, 1.2, 0.8)
    result = align(LENS, points, width=width, depth=depth, camera_height=height)
    for name, length in lengths.items():
        assert getattr(result, name) == pytest.approx(length, rel=1e-6)
    assert result.disagreement is None


def test_disagreeing_sides_are_reported() -> None:
    pose = pose_over(1.4, 0.3, 0.5, 0.05, 0.1, 1.2)
    points = clicks(LENS, pose, 1.2, 0.8)
    assert align(LENS, points, width=1.2, depth=0.8).disagreement == pytest.approx(0, abs=1e-6)
    result = align(LENS, points, width=1.2, depth=1.0)
    assert result.disagreement == pytest.approx(0.25, rel=1e-5)
    assert result.width == pytest.approx(1.2)
    assert any("disagree" in warning for warning in result.warnings)
    wrong = align(LENS, points, width=1.2, camera_height=2.0)
    assert any("camera height" in warning for warning in wrong.warnings)


def test_perspective_camera() -> None:
    camera = CameraModel(
        "LENSMODEL_OPENCV8",
        np.array([560.0, 561, 316, 243, -0.19, 0.06, 0.001, -0.0007, 0, 0, 0, 0]),
        (640, 480),
    )
    pose = Pose.look_at([1.1, 1.4, 2.4], [0, 0, 0])
    result = align(camera, clicks(camera, pose, 1.2, 0.9), width=1.2)
    np.testing.assert_allclose(result.world_from_camera.matrix(), pose.matrix(), atol=1e-6)


@pytest.mark.parametrize(
    ("camera", "height", "width", "depth"),
    [(PANORAMA, 1.5, 1.0, 0.6), (LENS, 1.2, 1.0, 0.8), (PANORAMA, 1.5, 3.0, 2.0)],
)
def test_click_noise_has_the_predicted_covariance(
    camera: CameraModel, height: float, width: float, depth: float
) -> None:
    """250 noisy solutions: the sample's variance over the predicted, chi-square bounds.

    sigma_tilt^2 is a sum of two variances, whose sample has at least 250 degrees of freedom:
    at 99.99 % it lies within 0.69 .. 1.4 of the truth; linearisation is allowed 10 %.
    """
    rng = np.random.default_rng(4)
    pose = pose_over(height, 0.2, 0.3, 0.1, 0.2, 1.3)
    points = clicks(camera, pose, width, depth)
    noise = 0.3
    predicted = align(camera, points, width=width, click=noise)
    errors: list[list[float]] = []
    heights: list[float] = []
    for _ in range(250):
        noisy = points + rng.normal(scale=noise, size=(4, 2))
        got = align(camera, noisy, width=width, click=noise)
        error = got.world_from_camera.rotation @ pose.rotation.T
        errors.append(
            [error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]
        )
        heights.append(got.camera_height)
    e = np.array(errors) / 2
    tilt, yaw = np.mean(e[:, 0] ** 2 + e[:, 2] ** 2), np.mean(e[:, 1] ** 2)
    assert 0.62 < tilt / predicted.sigma_tilt**2 < 1.54
    assert 0.62 < yaw / predicted.sigma_yaw**2 < 1.54
    assert 0.62 < np.mean((np.array(heights) - height) ** 2) / predicted.sigma_height**2 < 1.54


def test_least_squares_beats_the_closed_form() -> None:
    """The noisy rectangle's own axes stand at right angles, and the fit is at a minimum."""
    rng = np.random.default_rng(5)
    pose = pose_over(1.5, 0.4, 0.3, 0.1, 0.4, 1.2)
    points = clicks(PANORAMA, pose, 1.0, 0.6) + rng.normal(scale=1.0, size=(4, 2))
    result = align(PANORAMA, points, width=1.0)
    sides = np.diff(result.corners, axis=0)
    assert abs(sides[0] @ sides[1]) < 1e-9
    rays = PANORAMA.unproject(points)

    def cost(turn: np.ndarray) -> float:
        r = Pose.from_rotation_vector(turn, np.zeros(3)).rotation
        position = result.world_from_camera.translation
        w = (result.corners - position) @ (r @ result.world_from_camera.rotation)
        w /= np.linalg.norm(w, axis=1, keepdims=True)
        return float(np.sum(np.arccos(np.clip(np.sum(w * rays, axis=1), -1, 1)) ** 2))

    best = cost(np.zeros(3))
    assert best == pytest.approx(4 * result.residual**2, rel=1e-3)
    for axis in np.eye(3):
        assert cost(1e-4 * axis) > best
        assert cost(-1e-4 * axis) > best


def test_small_rectangle_warns() -> None:
    pose = pose_over(1.5, 0.4, 0.3, 0.1, 0.4, 2.0)
    result = align(PANORAMA, clicks(PANORAMA, pose, 0.5, 0.4), width=0.5)
    assert any("small rectangle" in warning for warning in result.warnings)


GOOD = clicks(PANORAMA, pose_over(1.5, 0.4, 0.3, 0.1, 0.4, 1.0), 1.0, 0.8)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (GOOD[[0, 2, 1, 3]], "crosses itself"),
        (GOOD[[0, 1, 1, 3]], "same point"),
        (np.array([[1000, 700], [1000, 720], [1000, 740], [1000, 760.0]]), "line"),
        (GOOD[[0, 1, 2]], "four corners"),
        (GOOD + [0, 5000], "outside"),
        (np.stack([GOOD[:, 0], 1023 - GOOD[:, 1]], axis=1), "above the horizon"),
        (
            np.stack(
                [
                    GOOD[0],
                    GOOD[1],
                    GOOD[2],
                    PANORAMA.project(PANORAMA.unproject(GOOD[:3]).mean(axis=0)[None])[0],
                ]
            ),
            "inside the other three",
        ),
        (GOOD.mean(axis=0) + [[0, 0], [1, 0], [1, 0.6], [0, 0.6]], "larger rectangle"),
    ],
)
def test_bad_corners(points: np.ndarray, message: str) -> None:
    with pytest.raises(UserError, match=message):
        align(PANORAMA, points, width=1.0)


def test_a_ceiling_is_allowed_when_asked_for() -> None:
    points = np.stack([GOOD[:, 0], 1023 - GOOD[:, 1]], axis=1)
    result = align(PANORAMA, points, width=1.0, any_plane=True)
    assert result.world_from_camera.translation[1] == pytest.approx(1.5, rel=1e-3)


@pytest.mark.parametrize(("width", "depth"), [(None, None), (-1.0, None), (None, 0.0)])
def test_bad_lengths(width: float | None, depth: float | None) -> None:
    with pytest.raises(UserError, match=r"in metres|positive metres"):
        align(PANORAMA, GOOD, width=width, depth=depth)


def test_overlay_and_file(tmp_path: Path) -> None:
    result = align(PANORAMA, GOOD, width=1.0)
    picture = np.full((1024, 2048, 3), 90, np.uint8)
    drawn = overlay(picture, PANORAMA, result.world_from_camera, Drawn(result.corners, GOOD))
    assert drawn.shape == picture.shape
    # the horizon passes where the direction is level
    level = PANORAMA.posed(result.world_from_camera).project_world(
        result.world_from_camera.translation + 1e6 * np.array([[1, 0, 0], [0, 0, -1.0]])
    )
    for x, y in np.round(level).astype(int):
        patch = drawn[y - 3 : y + 4, x - 3 : x + 4].astype(int)
        assert ((patch[..., 0] > 200) & (patch[..., 2] < 120)).any()
    assert (picture == 90).all()
    path = tmp_path / "align.json"
    write_json(path, alignment_json(result, "front", GOOD.tolist()))
    pose, name = read_alignment(path)
    np.testing.assert_allclose(pose.matrix(), result.world_from_camera.matrix())
    assert name == "front"
    path.write_text('{"world_from_camera": [[1, 2], [3, 4]]}')
    with pytest.raises(UserError, match=r"not an align\.json"):
        read_alignment(path)
