"""Detectors against virtual photographs whose corners are known, and against bad input."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate import detect_cache
from chromeball.calibrate.detect import (
    detect,
    grey,
    judge,
    larger_board,
    look,
)
from chromeball.calibrate.search import detect_files
from chromeball.calibrate.target import Charuco, Chessboard, Target, parse_target
from chromeball.calibrate.virtual import board_poses, photograph, project
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import Image, write_exr, write_picture

CHESSBOARD = Chessboard(9, 6, 0.025)
CHARUCO = Charuco(9, 6, 0.04, 0.03, "4X4_50")
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)


@pytest.mark.parametrize(
    ("target", "blur", "bound"),
    [
        (CHESSBOARD, 0.6, 0.03),
        (CHESSBOARD, 2.0, 0.06),
        (CHARUCO, 0.6, 0.025),
        (CHARUCO, 2.5, 0.035),
    ],
    ids=["chessboard", "blurred-chessboard", "charuco", "blurred-charuco"],
)
def test_corners(target: Target, blur: float, bound: float) -> None:
    """Corners with their identity, RMS of `bound` pixels, and the blur to a quarter."""
    poses = board_poses(target, CAMERA, 3, seed=3)
    truth = project(target, CAMERA, poses)
    errors: list[NDArray[np.float64]] = []
    for i, pose in enumerate(poses):
        picture = photograph(target, CAMERA, pose, blur=blur, seed=i)
        seen = look(picture, target)
        corners = seen.corners
        if isinstance(target, Chessboard) and np.abs(corners - truth[i]).max() > 5:
            corners = corners[::-1, ::-1]  # a chessboard does not tell its two ends
        # Interpolation adds to the edges' blur.
        assert seen.blur == pytest.approx(np.hypot(blur, 0.3), rel=0.25)
        errors.append(np.linalg.norm(corners - truth[i], axis=-1))
    found = np.isfinite(errors)
    assert found.mean() > 0.97
    assert np.sqrt(np.nanmean(np.square(errors))) < bound
    assert np.nanmax(errors) < 4.5 * bound


def test_half_hidden_charuco() -> None:
    """What is hidden is missing, what is seen has the right identity."""
    pose = board_poses(CHARUCO, CAMERA, 1, seed=5, size=0.7)[0]
    truth = project(CHARUCO, CAMERA, [pose])[0]
    picture = photograph(CHARUCO, CAMERA, pose)
    edge = int(truth[:, 4, 0].mean())
    picture[:, edge:] = 70
    corners = detect(picture, CHARUCO)
    found = np.isfinite(corners[..., 0])
    assert not found[truth[..., 0] > edge + 2].any()
    assert found[truth[..., 0] < edge - 20].all()
    assert np.abs(corners - truth)[found].max() < 0.3


def test_large_picture_is_searched_small() -> None:
    pose = board_poses(CHESSBOARD, CAMERA, 1, seed=2)[0]
    truth = project(CHESSBOARD, CAMERA, [pose])[0]
    picture = photograph(CHESSBOARD, CAMERA, pose, noise=0.0)
    large = cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    corners = (detect(np.asarray(large, np.uint8), CHESSBOARD) + 0.5) / 4 - 0.5
    assert min(np.abs(c - truth).max() for c in (corners, corners[::-1, ::-1])) < 0.3


def test_kinds_of_picture_agree() -> None:
    """8 and 16 bits, RGB, alpha and scene-linear radiance show the same corners."""
    pose = board_poses(CHARUCO, CAMERA, 1)[0]
    codes = photograph(CHARUCO, CAMERA, pose)[..., None]
    expected = detect(codes[..., 0], CHARUCO)
    alpha = np.full_like(codes, 255)
    linear = (codes / np.float32(255)) ** np.float32(2.2) * 40
    for pixels, is_linear in (
        (codes.astype(np.uint16) * 257, False),
        (np.repeat(codes, 3, axis=2), False),
        (np.concatenate([codes, alpha], axis=2), False),
        (linear, True),
    ):
        channels = tuple("RGBA"[: pixels.shape[2]])
        picture = grey(Image(pixels=pixels, linear=is_linear, channels=channels))
        found = detect(picture, CHARUCO)
        assert np.nanmax(np.abs(found - expected)) < 0.1
        assert np.isfinite(found).mean() > 0.95


def test_no_board_is_invented() -> None:
    rng = np.random.default_rng(0)
    for picture in (
        np.full((240, 320), 128, np.uint8),
        rng.integers(0, 256, (240, 320)).astype(np.uint8),
        np.zeros((3, 3), np.uint8),
    ):
        for target in (CHESSBOARD, CHARUCO):
            detection = judge(Path("x.png"), picture, target)
            assert not detection.usable
            assert detection.verdict == "no board"
            assert np.isnan(detection.corners).all()


def test_too_few_corners_are_named() -> None:
    pose = board_poses(CHARUCO, CAMERA, 1, seed=5, size=0.7)[0]
    truth = project(CHARUCO, CAMERA, [pose])[0]
    picture = photograph(CHARUCO, CAMERA, pose)
    picture[:, int(truth[:, 1, 0].max()) + 6 :] = 70
    detection = judge(Path("x.png"), picture, CHARUCO)
    assert not detection.usable or detection.count >= 8
    picture[:, int(truth[:, 0, 0].max()) + 6 :] = 70
    detection = judge(Path("x.png"), picture, CHARUCO)
    assert not detection.usable


def write(path: Path, picture: NDArray[Any]) -> Path:
    write_picture(path, picture)
    return path


def test_files(tmp_path: Path) -> None:
    pose = board_poses(CHARUCO, CAMERA, 1)[0]
    codes = photograph(CHARUCO, CAMERA, pose)
    files = [
        write(tmp_path / "board.png", codes),
        write(tmp_path / "nothing.png", np.full_like(codes, 90)),
        tmp_path / "radiance.exr",
    ]
    write_exr(files[2], (codes[..., None].repeat(3, axis=2) / 255.0) ** 2.2)
    heard: list[str] = []
    detections = detect_files(files, CHARUCO, lambda d: heard.append(d.verdict))
    assert [d.usable for d in detections] == [True, False, True]
    assert re.fullmatch(r"(39|40) of 40 corners, blur (0\.7|1\.0) px", heard[0])
    assert heard[1] == "no board"


def test_bad_files(tmp_path: Path) -> None:
    plain = np.full((120, 160), 90, np.uint8)
    files = [write(tmp_path / f"{i}.png", plain) for i in range(3)]
    with pytest.raises(UserError, match=r"chessboard:9x6:0\.025 was not seen in any of 3 pic"):
        detect_files(files, parse_target("chessboard:9x6:0.025"))
    other = write(tmp_path / "other.png", plain[:100])
    with pytest.raises(UserError, match=r"this picture is 160x100, .*0\.png is 160x120"):
        detect_files([*files, other], CHESSBOARD)
    with pytest.raises(UserError, match="no such picture"):
        detect_files([tmp_path / "missing.png"], CHESSBOARD)
    broken = tmp_path / "broken.png"
    broken.write_bytes(files[0].read_bytes()[:60])
    with pytest.raises(UserError, match=r"broken\.png"):
        detect_files([broken], CHESSBOARD)


def test_cache_and_processes(tmp_path: Path) -> None:
    """Two processes see what one does; what is kept is used by content, damage is mended."""
    pose = board_poses(CHESSBOARD, CAMERA, 1)[0]
    picture = photograph(CHESSBOARD, CAMERA, pose)
    files = [write(tmp_path / f"{i}.png", np.roll(picture, i, axis=1)) for i in range(8)]
    cache = tmp_path / "cache"
    alone = detect_files(files, CHESSBOARD, cache=cache)
    assert len(list(cache.iterdir())) == 8
    both = detect_files(files, CHESSBOARD, workers=2)
    for one, other in zip(alone, both, strict=True):
        np.testing.assert_array_equal(one.corners, other.corners)
        np.testing.assert_array_equal(one.sigma, other.sigma)
        assert (one.verdict, one.printed) == (other.verdict, other.printed)
    for kept in cache.iterdir():
        kept.write_bytes(kept.read_bytes()[:100])
    mended = detect_files(files[:1], CHESSBOARD, cache=cache)[0]
    np.testing.assert_array_equal(mended.corners, alone[0].corners)
    # The same content under another name is not searched again.
    entry = detect_cache.entry(cache, files[0], CHESSBOARD)
    detect_cache.store(entry, replace(mended, verdict="kept"))
    copy = write(tmp_path / "copy.png", picture)
    again = detect_files([copy], CHESSBOARD, cache=cache)[0]
    assert (again.file, again.verdict) == (copy, "kept")


def test_a_length_in_metres_changes_no_detection() -> None:
    """Boards of the same shape are read alike to the last bit, whatever their unit."""
    board = Charuco(9, 6, 0.04, 0.03, "4X4_50")
    pose = board_poses(board, CAMERA, 1, seed=3, size=0.3)[0]
    picture = photograph(board, CAMERA, pose, blur=1.2, noise=3.0)
    first = look(picture, board)
    assert np.isfinite(first.corners).any()
    for square, marker in ((0.08, 0.06), (0.1, 0.075), (0.7, 0.525)):
        again = look(picture, replace(board, square=square, marker=marker))
        np.testing.assert_array_equal(again.corners, first.corners)
        assert again.printed.target == replace(board, square=square, marker=marker)
    thirds = replace(board, square=0.03, marker=0.02)
    shown = photograph(thirds, CAMERA, board_poses(thirds, CAMERA, 1, seed=3)[0])
    assert np.isfinite(look(shown, thirds).corners).any()


def test_counts_that_are_wrong_are_named(tmp_path: Path) -> None:
    board = Chessboard(9, 6, 0.025)
    files = [tmp_path / f"{i}.png" for i in range(3)]
    for file, pose in zip(files, board_poses(board, CAMERA, 3, seed=1), strict=True):
        cv2.imwrite(str(file), photograph(board, CAMERA, pose))
    with pytest.raises(UserError, match="9x6 inner corners is there"):
        detect_files(files, Chessboard(10, 7, 0.02))
    assert "9x6 inner corners" in larger_board(files, Chessboard(8, 6, 0.025))
    assert not larger_board(files, Chessboard(6, 9, 0.025))
    assert not larger_board(files, Chessboard(10, 6, 0.025))
