"""The scene turned onto the picture by one, two and more pairs of points."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from chromeball.calibrate.realign import realign
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json

LENS = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)
TRUE = LENS.posed(Pose.look_at(np.array([0.3, 1.0, 1.5]), np.zeros(3)))
POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (6, 3))
TURN = Pose.from_rotation_vector([0.02, -0.03, 0.04], np.zeros(3))
TURNED = LENS.posed(TRUE.world_from_camera @ TURN)
MOVED = LENS.posed(
    Pose(np.eye(3), np.array([0.05, -0.02, 0.04])) @ TRUE.world_from_camera @ TURN
)


def test_one_pair_turns_by_the_least_angle() -> None:
    point = POINTS[:1]
    found = realign(TURNED, point, TRUE.project_world(point))
    assert found.after[0] < 1e-6
    assert found.freedom == 2
    np.testing.assert_allclose(
        found.camera.world_from_camera.translation, TURNED.world_from_camera.translation
    )
    here, there = (
        c.world_from_camera.inverse().apply(point[0]) for c in (TURNED, found.camera)
    )
    angle = math.acos(here @ there / np.linalg.norm(here) / np.linalg.norm(there))
    assert found.turn == pytest.approx(angle, rel=1e-6)


def test_two_pairs_turn_fully_and_more_move() -> None:
    two = realign(TURNED, POINTS[:2], TRUE.project_world(POINTS[:2]))
    np.testing.assert_allclose(
        two.camera.world_from_camera.matrix(), TRUE.world_from_camera.matrix(), atol=1e-8
    )
    assert two.freedom == 3
    assert two.turn == pytest.approx(float(np.linalg.norm([0.02, -0.03, 0.04])), rel=1e-6)
    more = realign(MOVED, POINTS, TRUE.project_world(POINTS))
    np.testing.assert_allclose(
        more.camera.world_from_camera.matrix(), TRUE.world_from_camera.matrix(), atol=1e-7
    )
    three = realign(MOVED, POINTS[:3], TRUE.project_world(POINTS[:3]))
    assert three.after.max() < 1e-6
    kept = realign(MOVED, POINTS, TRUE.project_world(POINTS), keep_place=True)
    assert 0.1 < kept.after.max() < kept.before.max()
    assert kept.freedom == 3


def test_moving_the_model_instead_looks_the_same() -> None:
    found = realign(MOVED, POINTS, TRUE.project_world(POINTS))
    model = found.model_from_model.apply(POINTS)
    np.testing.assert_allclose(
        MOVED.project_world(model), found.camera.project_world(POINTS), atol=1e-6
    )


def test_covariance_is_honest() -> None:
    """Squared errors over the covariance: chi-squared with 6 degrees of freedom."""
    rng, truth = np.random.default_rng(1), TRUE.world_from_camera
    distances: list[float] = []
    for _ in range(30):
        q = TRUE.project_world(POINTS) + rng.normal(0, 0.5, (6, 2))
        found = realign(MOVED, POINTS, q)
        pose = found.camera.world_from_camera
        turn = Pose(truth.rotation.T @ pose.rotation, np.zeros(3)).rotation_vector()
        error = np.concatenate([turn, pose.translation - truth.translation])
        distances.append(float(error @ np.linalg.solve(found.covariance, error)))
    # The mean of 30 has the deviation sqrt(12 / 30) = 0.63.
    assert np.mean(distances) == pytest.approx(6, abs=2)


def test_a_wrong_pair_is_named() -> None:
    """47 px off among eight pairs puts the camera off by 0.17 m if it counts."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.4, 0.4, (12, 3))
    clicks = TRUE.project_world(points) + rng.normal(0, 0.5, (12, 2))
    sound = realign(MOVED, points, clicks)
    assert sound.wrong == ()
    assert sound.misfit < 1.5
    far, near = clicks.copy(), clicks.copy()
    far[3] += [40, -25]
    with pytest.raises(UserError, match=r"pair 4 lies \d\d\.\d px from .* correct or remove"):
        realign(MOVED, points[:8], far[:8])
    near[5] += [0, 3.8]  # eight deviations
    told = realign(MOVED, points, near)
    assert [click.index for click in told.wrong] == [5]
    assert told.misfit > 1.5
    swapped = clicks[[1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 10, 11]]
    with pytest.raises(UserError, match=r"the pairs do not fit together, they stay \d+"):
        realign(MOVED, points, swapped)


def test_sloppy_clicks_are_not_accused() -> None:
    """Said to be good to 0.5 px, they are to 2: standard errors follow, nobody is named."""
    rng = np.random.default_rng(4)
    accused, misfits = 0, list[float]()
    for _ in range(20):
        clicks = TRUE.project_world(POINTS) + rng.normal(0, 2, (6, 2))
        found = realign(MOVED, POINTS, clicks)
        accused += len(found.wrong)
        misfits.append(found.misfit)
    assert accused == 0
    # chi-squared with 6 degrees of freedom: the mean of 20 squares to 13 %
    assert np.mean(np.square(misfits)) == pytest.approx(16, rel=0.4)


def test_refusals() -> None:
    q = TRUE.project_world(POINTS)
    line = np.linspace(0, 1, 4)[:, None] * [0.1, 0.2, 0.1]
    behind = TURNED.world_from_camera.apply(np.array([[0.0, 0, -1]]))
    same = np.array([POINTS[0], TURNED.world_from_camera.translation])
    same[1] = 0.5 * (same[0] + same[1])
    for points, pixels, message in (
        (POINTS[:0], q[:0], "one pair at least"),
        (POINTS, q[:2], "needs its pixel"),
        (POINTS * np.nan, q, "must be finite"),
        (behind, q[:1], "not before the camera"),
        (line, TRUE.project_world(line), "in a line"),
        (same, np.array([q[0], q[0] + 0.1]), "one line of sight"),
    ):
        with pytest.raises(UserError, match=message):
            realign(TURNED, points, pixels)
    around = LENS.posed(
        TRUE.world_from_camera @ Pose.from_rotation_vector([0.0, 0, 2], [0.0] * 3)
    )
    with pytest.raises(UserError, match="turn the camera by 1"):
        realign(around, POINTS[:2], TRUE.project_world(POINTS[:2]))


def test_pairs_that_do_not_fit_are_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, pairs = tmp_path / "a.cameramodel", tmp_path / "pairs.csv"
    TURNED.write(before)
    q = TRUE.project_world(POINTS[:2]) + [[0, 0], [9, 0]]
    rows = np.concatenate([POINTS[:2], q], axis=1).tolist()
    pairs.write_text("x,y,z,u,v\n" + "\n".join(",".join(map(str, r)) for r in rows))
    words = ["calibrate", "realign", before, "--pairs", pairs, "-o", tmp_path / "b.cameramodel"]
    build_app()([str(w) for w in words], result_action="return_value")
    assert "times as far off as --sigma says" in capsys.readouterr().err


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, pairs, output = (
        tmp_path / n for n in ("a.cameramodel", "pairs.csv", "b.cameramodel")
    )
    TURNED.write(before)
    rows = np.concatenate([POINTS[:2], TRUE.project_world(POINTS[:2])], axis=1)
    pairs.write_text("u,v,x,y,z\n" + "\n".join(
        ",".join(map(str, (*r[3:], *r[:3]))) for r in rows.tolist()
    ))  # fmt: skip
    words = ["calibrate", "realign", before, "--pairs", pairs, "-o", output]
    build_app()([str(w) for w in words], result_action="return_value")
    assert "moved by 0.0 mm" in capsys.readouterr().out
    found = CameraModel.read(output)
    np.testing.assert_allclose(
        found.project_world(POINTS), TRUE.project_world(POINTS), atol=1e-5
    )
    figures = read_json(f"{output}.record.json")["figures"]
    assert max(figures["after_px"]) < 1e-5 < min(figures["before_px"])
