"""Cameras kept or not: the stated risk, changes that show, views that would show none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.reuse import Check, check_reuse
from chromeball.calibrate.target import Charuco, Chessboard
from chromeball.calibrate.virtual import board_poses, photograph, project
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import write_picture
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json, to_json

BOARD = Chessboard(9, 6, 0.025)
SIZE = (640, 480)
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4", np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]), SIZE
)


@cache
def old() -> tuple[CameraModel, dict[str, Any]]:
    """A camera and the figures of its record."""
    poses = board_poses(BOARD, CAMERA, 25, seed=1, size=0.8)
    lens = calibrate_lens(project(BOARD, CAMERA, poses, noise=0.2), BOARD, SIZE, "opencv4")
    figures: Any = to_json(
        lens.figures()
        | {
            "view_rms": {str(i): v for i, v in enumerate(lens.view_rms)},
            "taken_with": {"Model": "X100", "FocalLength": 35.0},
        }
    )
    return lens.camera, figures


def checked(
    camera: CameraModel,
    seed: int = 0,
    views: int = 1,
    now: dict[str, str | float] | None = None,
) -> Check:
    """The old camera on pictures that `camera` took."""
    poses = board_poses(BOARD, camera, views, seed=100 + seed, size=0.9)
    corners = project(BOARD, camera, poses, noise=0.2, seed=seed)
    return check_reuse(*old(), BOARD, corners, SIZE, now or {}, same_board=True)


def test_an_unchanged_camera_is_kept() -> None:
    """At a risk of one in a hundred: of 60 single views at most 3 are refused as changed."""
    checks = [checked(CAMERA, seed) for seed in range(60)]
    missed = [c for c in checks if not c.kept and "would not show" not in c.reason]
    assert len(missed) <= 3
    assert sum(c.kept for c in checks) > 20
    scores = [c.figures["focal_change"] / c.figures["focal_change_error"] for c in checks]
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3
    assert checked(CAMERA, views=4).kept


def test_changes_show() -> None:
    for by in (1.01, 0.99):
        values = CAMERA.intrinsics.copy()
        values[:2] *= by
        check = checked(replace(CAMERA, intrinsics=values), views=3)
        assert not check.kept
        assert "miss it by" in check.reason or "standard errors" in check.reason


def test_a_frontal_view_does_not_do() -> None:
    pose = Pose(np.eye(3), np.array([-0.1, -0.06, 0.5]))
    corners = project(BOARD, CAMERA, [pose], noise=0.2)
    check = check_reuse(*old(), BOARD, corners, SIZE, {}, same_board=True)
    assert not check.kept
    assert "tilt the board" in check.reason


def test_metadata_and_sizes() -> None:
    assert checked(CAMERA, views=3, now={"Model": "X100", "FocalLength": 35.0}).kept
    for now, reason in (
        ({"Model": "X200"}, "the body is X200, not X100"),
        ({"FocalLength": 23.0}, "the focal length is 23.0, not 35.0"),
    ):
        assert checked(CAMERA, now=dict(now)).reason == reason
    corners = project(BOARD, CAMERA, board_poses(BOARD, CAMERA, 1, seed=1))
    check = check_reuse(*old(), BOARD, corners, (1280, 960), {}, same_board=True)
    assert check.reason == "the pictures are 1280x960, the camera's 640x480"
    camera, _ = old()
    assert (
        "how well it fitted" in check_reuse(camera, {}, BOARD, corners, SIZE, {}, True).reason
    )


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Kept with one picture; solved again, and why, when the lens was another."""
    board = Charuco(9, 6, 0.04, 0.03, "4X4_50")
    values = np.array([330.0, 332, 208, 152, -0.2, 0.06, 0.0005, -0.0006])
    camera = CameraModel("LENSMODEL_OPENCV4", values, (420, 300))
    zoomed = replace(camera, intrinsics=values * [1.05, 1.05, *np.ones(6)])
    files: list[Path] = []
    poses = board_poses(board, camera, 8, seed=2, size=0.75)
    for i, pose in enumerate(poses):
        files.append(tmp_path / f"{i}.png")
        write_picture(files[-1], photograph(board, camera, pose, seed=i))
    first, second = tmp_path / "first.cameramodel", tmp_path / "second.cameramodel"
    options = ["--target", board.spec, "--model", "opencv4"]

    def run(*words: object) -> None:
        build_app()(
            [str(w) for w in ("calibrate", "lens", *words)], result_action="return_value"
        )

    run(*files[:7], *options, "-o", first)
    run(files[7], *options, "--reuse", first, "-o", second)
    assert "is kept: the new views fit it" in capsys.readouterr().out
    assert second.read_bytes() == first.read_bytes()
    figures = read_json(f"{second}.record.json")["figures"]
    assert figures["sigma"] == read_json(f"{first}.record.json")["figures"]["sigma"]
    for i, pose in enumerate(poses):
        write_picture(files[i], photograph(board, zoomed, pose, seed=i))
    run(*files, *options, "--reuse", first, "-o", second)
    assert "is not kept: the new views" in capsys.readouterr().err
    again = CameraModel.read(second)
    assert again.intrinsics[0] == pytest.approx(zoomed.intrinsics[0], abs=2)
