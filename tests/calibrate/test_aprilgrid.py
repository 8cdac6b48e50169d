"""Boards of markers, AprilGrid and ChArUco: odd prints, hidden parts, mirrors, blur."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.aprilgrid import AprilGrid
from chromeball.calibrate.detect import Seen, judge, look
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.target import Charuco, Target, parse_target
from chromeball.calibrate.virtual import board_poses, photograph, project, surrounding_poses
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

GRID = AprilGrid(4, 3, 0.088, 0.3)
CHARUCO = Charuco(6, 8, 0.04, 0.03, "4X4_50")
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)
FISHEYE = CameraModel(
    "kb4",
    np.array([180.0, 181, 399, 301, -0.02, 0.01, -0.004, 0.0006]),
    (800, 600),
    max_angle=math.radians(95),
)
REAL = Path(__file__).resolve().parents[3] / "shared/data/calibrate/ccrs_single"


def view(
    target: Target, blur: float = 0.8, size: float = 0.6, seed: int = 3
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A picture and its true corners."""
    pose = board_poses(target, CAMERA, 1, seed=seed, size=size)[0]
    return photograph(target, CAMERA, pose, blur=blur), project(target, CAMERA, [pose])[0]


def misses(seen: Seen, truth: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(seen.corners - truth, axis=-1)


def test_parse() -> None:
    grid = parse_target("aprilgrid:6x6:0.088:0.3")
    assert grid == AprilGrid(6, 6, 0.088, 0.3)
    assert parse_target("aprilgrid:6x6:0.088:0.3:1") == AprilGrid(6, 6, 0.088, 0.3, border=1)
    assert (grid.rows, grid.columns, grid.count) == (12, 12, 144)
    np.testing.assert_allclose(grid.points()[0, :4, 0], [0, 0.088, 0.1144, 0.2024])
    for spec, message in (
        ("aprilgrid:6x6:0.088", "is no target"),
        ("aprilgrid:6x6:0.088:wide", "is no ratio"),
        ("aprilgrid:6x6:0.088:0.01", "the gap is"),
        ("aprilgrid:6x6:0.088:0.3:3", "1 or 2 bits"),
        ("aprilgrid:30x30:0.088:0.3", "4 to 587 tags"),
    ):
        with pytest.raises(UserError, match=message):
            parse_target(spec)


def test_cells_are_kalibrs_board() -> None:
    """OpenCV, told of rims of 2 bits, reads each tag upside down at its place on the board."""
    grid = AprilGrid(3, 2, 0.08, 0.3)
    cells = grid.cells()
    assert cells.shape == (2 * 80 + 184, 2 * 80 + 288)
    search = cv2.aruco.DetectorParameters()
    search.markerBorderBits = 2
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    reader = cv2.aruco.ArucoDetector(family, search)
    for number, outline in enumerate(grid.outlines()):
        left, top = np.round((outline[0] + 1) * 80).astype(int).tolist()
        tag = np.pad(cells[top : top + 80, left : left + 80], 20, constant_values=255)
        found, ids, _ = reader.detectMarkers(tag)
        assert ids.ravel().tolist() == [number]
        assert np.abs(found[0][0, 2] - 20).max() < 2
    # The joints are as dark as the tags, the paper between them is white.
    assert cells[70, 70] == 0
    assert cells[70, 120] == 255


@pytest.mark.parametrize("border", [1, 2])
def test_any_rim(border: int) -> None:
    """A board printed with the other rim than it was named with is read as well."""
    picture, truth = view(AprilGrid(4, 3, 0.088, 0.3, border=3 - border))
    miss = misses(look(picture, AprilGrid(4, 3, 0.088, 0.3, border=border)), truth)
    assert np.isfinite(miss).all()
    assert np.sqrt((miss**2).mean()) < 0.04


def test_odd_spacing() -> None:
    """A gap that is no simple fraction of a tag, as people measure it."""
    grid = AprilGrid(4, 3, 0.088, 0.2954)
    picture, truth = view(grid)
    assert np.sqrt((misses(look(picture, grid), truth) ** 2).mean()) < 0.04


def test_fisheye() -> None:
    """A lens of 190 degrees; poses from its middle to its rim."""
    poses = surrounding_poses(GRID, FISHEYE, 4, seed=5)
    truth = project(GRID, FISHEYE, poses)
    miss = np.array(
        [
            misses(look(photograph(GRID, FISHEYE, pose, seed=i), GRID), place)
            for i, (pose, place) in enumerate(zip(poses, truth, strict=True))
        ]
    )
    assert np.isfinite(miss).mean() > 0.9
    assert np.sqrt(np.nanmean(miss**2)) < 0.06


def test_partial_grid_keeps_its_names() -> None:
    picture, truth = view(GRID)
    edge = int(truth[:, 4, 0].min()) - 3
    picture[:, edge:] = 60
    seen = look(picture, GRID)
    found = np.isfinite(seen.sigma)
    assert not found[truth[..., 0] > edge + 2].any()
    assert found[truth[..., 0] < edge - 15].mean() > 0.95
    assert np.nanmax(misses(seen, truth)) < 0.15


@pytest.mark.parametrize("target", [GRID, CHARUCO], ids=["aprilgrid", "charuco"])
def test_turned_inverted_mirrored(target: Target) -> None:
    picture, truth = view(target)
    turned = look(np.ascontiguousarray(picture[::-1, ::-1]), target)
    assert np.nanmax(np.linalg.norm([639, 479] - turned.corners - truth, axis=-1)) < 0.15
    inverted = misses(look(np.asarray(255 - picture, np.uint8), target), truth)
    assert np.isfinite(inverted).mean() > 0.95
    assert np.nanmax(inverted) < 0.15
    mirrored = judge(Path("x.png"), np.ascontiguousarray(picture[:, ::-1]), target)
    assert not mirrored.usable
    assert mirrored.verdict == "the board is seen in a mirror: flip the picture"


def test_charuco_of_older_opencv() -> None:
    picture, truth = view(replace(CHARUCO, legacy=True))
    miss = misses(look(picture, CHARUCO), truth)
    assert np.isfinite(miss).mean() > 0.95
    assert np.nanmax(miss) < 0.15


@pytest.mark.parametrize("size", [0.9, 0.5])
def test_charuco_under_heavy_blur(size: float) -> None:
    """At 2.5 pixels 97 % of the corners are found to 0.1; bits are 3 to 6 pixels wide."""
    target = Charuco(9, 6, 0.04, 0.03, "4X4_50")
    miss = np.array(
        [misses(look(p, target), t) for p, t in (view(target, 2.5, size, s) for s in (7, 8))]
    )
    assert (miss < 0.1).mean() > 0.97


@pytest.mark.parametrize(("target", "blur"), [(GRID, 0.8), (CHARUCO, 1.8)])
def test_standard_errors(target: Target, blur: float) -> None:
    """Errors over their standard errors are of order one: 0.75 to 1.25 for 250 coordinates."""
    normalised: list[NDArray[np.float64]] = []
    for seed in (3, 4, 5):
        picture, truth = view(target, blur, seed=seed)
        seen = look(picture, target)
        normalised.append((seen.corners - truth) / seen.sigma[..., None])
    assert 0.75 < np.sqrt(np.nanmean(np.square(normalised))) < 1.25


def test_nothing_is_invented() -> None:
    rng = np.random.default_rng(0)
    for picture in (
        rng.integers(0, 256, (120, 160)).astype(np.uint8),
        cv2.GaussianBlur(rng.integers(0, 256, (120, 160)).astype(np.uint8), (0, 0), 3) * 3,
        view(CHARUCO)[0],
    ):
        assert judge(Path("x.png"), np.asarray(picture, np.uint8), GRID).verdict == "no board"


def test_solvers_of_even_boards_refuse_it() -> None:
    corners = np.zeros((3, GRID.rows, GRID.columns, 2))
    with pytest.raises(UserError, match="not an AprilGrid: take another model"):
        calibrate_lens(corners, GRID, (640, 480), "splined")


def test_opencv_models_take_it() -> None:
    """Its corners are not evenly spaced, which mrcal's boards are: our own solution stands."""
    k = np.array([520.0, 523, 331, 228, -0.2, 0.05, 0, 0])
    camera = CameraModel("LENSMODEL_OPENCV4", k, (640, 480))
    corners = project(GRID, camera, board_poses(GRID, camera, 10, seed=1), noise=0.1)
    lens = calibrate_lens(corners, GRID, camera.size, "opencv4")
    miss = np.abs(lens.camera.intrinsics - camera.intrinsics)
    assert np.all(miss < 4.5 * lens.standard_errors)
    assert lens.sigma == pytest.approx(0.1, rel=0.1)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real pictures are not here")
@pytest.mark.parametrize("name", ["euroc.png", "tum_vi_with_chart.png"])
def test_real_boards(name: str) -> None:
    """Kalibr's board by two fisheyes: every corner, plane to the lens's distortion."""
    picture = np.asarray(cv2.imread(str(REAL / name), 0), np.uint8)
    seen = look(picture, AprilGrid(6, 6, 0.088, 0.3))
    assert np.isfinite(seen.sigma).all()
    # Its eight neighbours place a corner but for the distortion's local curvature.
    points = AprilGrid(6, 6, 0.088, 0.3).points()[..., :2]
    miss: list[float] = []
    for r, c in np.ndindex(10, 10):
        block = np.s_[r : r + 3, c : c + 3]
        board, pixels = points[block].reshape(-1, 2), seen.corners[block].reshape(-1, 2)
        others = np.arange(9) != 4
        h, _ = cv2.findHomography(board[others], pixels[others])
        there = cv2.perspectiveTransform(board[4][None, None], np.asarray(h))[0, 0]
        miss.append(float(np.linalg.norm(there - pixels[4])))
    assert np.median(miss) < 0.3
    assert max(miss) < 1.0
