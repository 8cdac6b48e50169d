"""The command as a user calls it, and undistortion against an analytic picture."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chromeball.calibrate.target import Charuco
from chromeball.calibrate.undistort import undistort, undistorted_camera
from chromeball.calibrate.virtual import board_poses, photograph
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr, write_picture
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json, write_json

TARGET = Charuco(9, 6, 0.04, 0.03, "4X4_50")
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([330.0, 332, 208, 152, -0.2, 0.06, 0.0005, -0.0006]),
    (420, 300),
)
RECTANGLE = np.array([[-0.3, 0, -0.2], [0.3, 0, -0.2], [0.3, 0, 0.2], [-0.3, 0, 0.2]])


def run(*words: object) -> None:
    build_app()([str(word) for word in ("calibrate", *words)], result_action="return_value")


def test_lens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Photographs to a camera: truth within 4 standard errors, record, plots, skipped views."""
    files: list[Path] = []
    for i, pose in enumerate(board_poses(TARGET, CAMERA, 9, seed=2, size=0.75)):
        files.append(tmp_path / f"{i}.png")
        write_picture(files[-1], photograph(TARGET, CAMERA, pose, seed=i))
    files.append(tmp_path / "empty.png")
    write_picture(files[-1], np.full((300, 420), 80, np.uint8))
    output = tmp_path / "build" / "lens.cameramodel"
    words = ["lens", *files, "--target", TARGET.spec, "--model", "opencv4", "--no-cache"]
    words += ["-o", output]
    run(*words, "--json")
    captured = capsys.readouterr()
    assert "empty.png: no board" in captured.err
    figures: dict[str, Any] = json.loads(captured.out)
    assert figures["views_used"] == 9
    assert figures["skipped"] == [str(files[-1])]
    assert figures["rms"] < 0.12
    assert figures["verdict"].startswith("good to 0.3 px over")
    assert set(figures["plots"]) >= {"verdict", "halves", "tilt", "worst", "uncertainty"}
    for (name, value), truth in zip(
        figures["intrinsics"].items(), CAMERA.intrinsics, strict=True
    ):
        # Systematic parts of the corners' errors are not in the standard errors.
        assert abs(value - truth) < 5 * figures["standard_errors"][name] + 0.1, name
    record = read_json(f"{output}.record.json")
    assert record["stage"] == "calibrate lens"
    assert len(record["inputs"]) == 10
    for name in record["figures"]["plots"].values():
        plot = read_image(output.with_name(name))
        assert 500 < plot.size[0] < 1200
    assert CameraModel.read(output).size == CAMERA.size


def test_lens_refusals(tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    write_picture(picture, np.full((300, 420), 80, np.uint8))
    output = tmp_path / "lens.cameramodel"
    for words, message in (
        (["--target", "chessboard:9x6:0.02", "-o", output], "was not seen in"),
        (["--target", "chess", "-o", output], "is no target"),
        (["--target", TARGET.spec, "-o", output, "--model", "kb9"], "unknown lens model 'kb9'"),
        (["--target", TARGET.spec, "-o", tmp_path / "lens.txt"], r"ends in \.cameramodel"),
    ):
        with pytest.raises(UserError, match=message):
            run("lens", picture, "--no-cache", *words)
    assert sorted(tmp_path.iterdir()) == [picture]


def test_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed = CAMERA.posed(Pose.look_at(np.array([0.3, 0.9, 1.1]), np.array([0.0, 0.0, 0.0])))
    lens, align, output = (
        tmp_path / n for n in ("lens.cameramodel", "align.json", "view.cameramodel")
    )
    CAMERA.write(lens)
    write_json(align, {"corners": RECTANGLE})
    points = " ".join(f"{x:.6f},{y:.6f}" for x, y in posed.project_world(RECTANGLE))
    words = ["pose", "--camera", lens, "--align", align, "-o", output, "--points"]
    run(*words, points)
    assert "camera at 0.300, 0.900, 1.100 m" in capsys.readouterr().out
    found = CameraModel.read(output)
    np.testing.assert_allclose(found.world_from_camera.translation, [0.3, 0.9, 1.1], atol=1e-5)
    np.testing.assert_array_equal(found.intrinsics, CAMERA.intrinsics)
    assert read_json(f"{output}.record.json")["figures"]["rms"] < 1e-4
    output.unlink()
    for bad, message in (
        ("1,2 3,4 5,6", "3 points were given"),
        ("1,2 3,4 5,6 seven", "'seven' is no pixel"),
        ("1,2 3,4 5,6 7,8", "lie in a line"),
    ):
        with pytest.raises(UserError, match=message):
            run(*words, bad)
    write_json(align, {"width": 1})
    with pytest.raises(UserError, match="no world corners in it"):
        run(*words, points)
    assert not output.exists()


def test_undistort_is_the_perspective_picture() -> None:
    """A smooth function of direction, seen through the lens and by a perfect camera."""

    def shade(camera: CameraModel) -> np.ndarray[Any, Any]:
        d = camera.unproject(camera.pixel_grid())
        x, y = d[..., 0] / d[..., 2], d[..., 1] / d[..., 2]
        return np.stack([1 + np.sin(9 * x) * np.cos(7 * y), 1 + x, 1 + y], axis=-1)

    for target in (undistorted_camera(CAMERA), undistorted_camera(CAMERA, math.radians(50))):
        picture, unseen = undistort(shade(CAMERA).astype(np.float32), CAMERA, target)
        seen = (picture > 0).any(axis=-1)
        assert unseen == (~seen).sum()
        assert np.median(np.abs(picture - shade(target))[seen]) < 3e-4
        assert np.percentile(np.abs(picture - shade(target))[seen], 99.5) < 5e-3


def test_undistort_keeps_an_edge_within_its_values() -> None:
    picture = np.full((300, 420, 1), 10, np.uint8)
    picture[:, 200:] = 250
    result, _ = undistort(picture, CAMERA, undistorted_camera(CAMERA, math.radians(45)))
    assert result.dtype == np.uint8
    assert result.min() == 10
    assert result.max() == 250


def test_undistort_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lens, picture, output = (
        tmp_path / n for n in ("lens.cameramodel", "plate.exr", "flat.exr")
    )
    CAMERA.write(lens)
    write_exr(picture, np.full((300, 420, 3), 0.25, np.float32))
    run("undistort", picture, "--camera", lens, "--fov", 50, "-o", output)
    assert "50.00 degrees across, 0 pixels unseen" in capsys.readouterr().out
    np.testing.assert_allclose(read_image(output).pixels, 0.25)
    flat = CameraModel.read(tmp_path / "flat.cameramodel")
    assert flat.model == "pinhole"
    assert 2 * math.atan(420 / (2 * flat.intrinsics[0])) == pytest.approx(math.radians(50))
    with pytest.raises(UserError, match="is written as EXR"):
        run("undistort", picture, "--camera", lens, "-o", tmp_path / "flat.png")
    with pytest.raises(UserError, match="less than 175 degrees"):
        run("undistort", picture, "--camera", lens, "--fov", 180, "-o", output)
    write_exr(picture, np.ones((200, 420, 3)))
    with pytest.raises(UserError, match="is for pictures of 420x300, this one is 420x200"):
        run("undistort", picture, "--camera", lens, "-o", output)
