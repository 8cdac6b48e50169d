"""The second look: corners that a solved camera helps to find."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import chromeball.calibrate.look_again as module
from chromeball.calibrate.adjust import Estimate
from chromeball.calibrate.detect import judge
from chromeball.calibrate.detection import Detection
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.look_again import look_again, look_with, refine
from chromeball.calibrate.printed import Printed
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.virtual import photograph, project, surrounding_poses
from chromeball.scene.camera import CameraModel
from chromeball.scene.image import write_picture

BOARD = Chessboard(7, 5, 0.04)
CAMERA = CameraModel(
    "kb4",
    np.array([150.0, 151, 322, 238, -0.02, 0.01, -0.004, 0.0006]),
    (640, 480),
    max_angle=math.radians(95),
)


def test_known_camera_finds_the_board() -> None:
    """At the rim of a lens of 190 degrees, black and white exchanged; not where it is not."""
    pose = surrounding_poses(BOARD, CAMERA, 5, seed=2)[3]
    truth = project(BOARD, CAMERA, [pose])[0].reshape(-1, 2)
    picture = photograph(BOARD, CAMERA, pose)
    view = Estimate(CAMERA, np.zeros(2), pose.rotation[None], pose.translation[None])
    found = refine(picture, Printed(BOARD, False), view, 1.0)
    miss = found.pixels - truth
    assert np.isfinite(found.sigma).mean() > 0.9
    assert 0.7 < np.sqrt(np.nanmean((miss / found.sigma[:, None]) ** 2)) < 1.3
    inverted = np.asarray(255 - picture, np.uint8)
    assert np.isfinite(refine(inverted, Printed(BOARD, True), view, 1.0).sigma).mean() > 0.9
    for wrong in (Printed(BOARD, True), Printed(replace(BOARD, square=0.02), False)):
        assert np.isnan(refine(picture, wrong, view, 1.0).sigma).mean() > 0.8
    turned = replace(view, rotations=-view.rotations, translations=-view.translations)
    assert np.isnan(refine(picture, Printed(BOARD, False), turned, 1.0).sigma).all()


def test_corners_are_won(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Corners that the first look lost come back, and count unless they make it worse."""
    detections: list[Detection] = []
    truth: list[NDArray[np.float64]] = []
    for i, pose in enumerate(surrounding_poses(BOARD, CAMERA, 5, seed=4)):
        path = tmp_path / f"{i}.png"
        picture = photograph(BOARD, CAMERA, pose, seed=i)
        write_picture(path, picture)
        detection = judge(path, picture, BOARD)
        if detection.usable:
            lost = detection.corners.copy()
            lost[0, :3] = np.nan
            detections.append(replace(detection, corners=lost))
            truth.append(project(BOARD, CAMERA, [pose])[0])
    assert len(detections) >= 4
    first = calibrate_lens(np.array([d.corners for d in detections]), BOARD, CAMERA.size, "kb4")
    for seen, before, true in zip(
        look_with(detections, first, BOARD), detections, truth, strict=True
    ):
        assert seen.count >= before.count + 2
        miss = min(np.nanmax(np.abs(seen.corners - t)) for t in (true, true[::-1, ::-1]))
        assert miss < 0.2
    for errors, kept in ((iter([0.2, 0.2]), True), (iter([0.2, 0.3]), False)):
        monkeypatch.setattr(module, "_held_out", lambda *_, e=errors: next(e))
        monkeypatch.setattr(module, "calibrate_lens", lambda *_: replace(first, sigma=9.0))
        second = look_again(detections, first, BOARD, "kb4")
        assert second.won >= 2 * len(detections)
        assert second.kept == kept
        assert (second.lens.sigma == 9.0) == kept
        assert (second.detections[0] is detections[0]) != kept
