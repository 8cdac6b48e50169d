"""Grids of circles: virtual photographs whose centres are known, identity, refusals, a lens."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.detect import detect, judge, look
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.target import CircleGrid, parse_target
from chromeball.calibrate.virtual import board_poses, photograph, project
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

CIRCLES = CircleGrid(7, 5, 0.04)
ASYMMETRIC = CircleGrid(4, 11, 0.02, asymmetric=True)
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]),
    (640, 480),
)
REAL = Path(__file__).resolve().parents[3] / "shared/data/calibrate/visp/calibration"


def same_way(corners: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """A symmetric grid does not tell its two ends: the way nearer to the truth."""
    turned = corners[::-1, ::-1]
    nearer = np.nanmedian(np.abs(corners - truth)) < np.nanmedian(np.abs(turned - truth))
    return corners if nearer else turned


def test_parse() -> None:
    assert parse_target("circles:7x5:0.04") == CIRCLES
    assert parse_target("acircles:4x11:0.02") == ASYMMETRIC
    assert ASYMMETRIC.points().shape == (11, 8, 3)
    assert ASYMMETRIC.count == 44
    # OpenCV's own places of this board: ((2 j + i % 2) s, i s).
    assert ASYMMETRIC.places()[[0, 1, 4, 5, 43]].tolist() == [
        [0, 0], [2, 0], [1, 1], [3, 1], [6, 10],
    ]  # fmt: skip
    for spec in ("circles:2x5:0.1", "acircles:1x11:0.1", "circles:7x5"):
        with pytest.raises(UserError, match=r"needs [23]x3 or more|is no target"):
            parse_target(spec)


@pytest.mark.parametrize(
    ("target", "blur"), [(CIRCLES, 0.6), (ASYMMETRIC, 1.0), (ASYMMETRIC, 2.0)]
)
def test_centres(target: CircleGrid, blur: float) -> None:
    """RMS of 0.07 pixels with strong distortion and tilt, well below OpenCV's."""
    poses = [board_poses(target, CAMERA, 8, seed=3, size=0.6)[i] for i in (4, 5, 6)]
    truth = project(target, CAMERA, poses)
    errors: list[NDArray[np.float64]] = []
    theirs: list[float] = []
    column, row = target.places().T
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    for pose, place in zip(poses, truth, strict=True):
        picture = photograph(target, CAMERA, pose, blur=blur)
        found = look(picture, target)
        corners, measured = found.corners, found.blur
        # A pixel's own width, interpolation and noise add to the edges' blur.
        assert measured == pytest.approx(np.hypot(blur, 0.5), rel=0.25)
        if not target.asymmetric:
            corners = same_way(corners, place)
        errors.append(np.linalg.norm(corners - place, axis=-1)[row, column])
        ok, raw = cv2.findCirclesGrid(picture, (target.across, target.down), flags=kind)
        if ok:
            true = place[row, column]
            theirs.extend(
                min(
                    (
                        np.linalg.norm(way - true, axis=-1).tolist()
                        for way in (raw.reshape(-1, 2), raw.reshape(-1, 2)[::-1])
                    ),
                    key=sum,
                )
            )
    assert np.isfinite(errors).mean() > 0.95
    ours = float(np.sqrt(np.nanmean(np.square(errors))))
    assert ours < 0.07
    assert theirs
    assert ours < 0.6 * np.sqrt(np.mean(np.square(theirs)))


def test_identity_of_an_asymmetric_grid() -> None:
    """The picture turned by half a turn shows the same circles under the same names."""
    pose = board_poses(ASYMMETRIC, CAMERA, 8, seed=3, size=0.6)[4]
    picture = photograph(ASYMMETRIC, CAMERA, pose)
    corners = detect(picture, ASYMMETRIC)
    assert np.isfinite(corners[..., 0]).sum() == 44
    turned = detect(np.ascontiguousarray(picture[::-1, ::-1]), ASYMMETRIC)
    assert np.nanmax(np.abs([639, 479] - turned - corners)) < 0.02


@pytest.mark.parametrize("target", [CIRCLES, ASYMMETRIC], ids=lambda t: t.spec)
def test_mirrored_pictures_are_not_read_mirrored(target: CircleGrid) -> None:
    """A right-handed board: x to the right of y down, whatever the picture."""
    pose = board_poses(target, CAMERA, 8, seed=3, size=0.6)[4]
    picture = np.ascontiguousarray(photograph(target, CAMERA, pose)[:, ::-1])
    corners = detect(picture, target)
    found = np.isfinite(corners[..., 0])
    if found.any():
        h, _ = cv2.findHomography(np.argwhere(found)[:, ::-1].astype(float), corners[found])
        assert np.linalg.det(np.asarray(h)) > 0


def test_hidden_disc_is_left_out_and_a_part_refused() -> None:
    pose = board_poses(CIRCLES, CAMERA, 8, seed=3, size=0.6)[4]
    truth = project(CIRCLES, CAMERA, [pose])[0]
    picture = photograph(CIRCLES, CAMERA, pose)
    part = picture.copy()
    part[:, int(truth[:, 4, 0].mean()) :] = 110
    detection = judge(Path("x.png"), part, CIRCLES)
    assert (detection.usable, detection.verdict) == (False, "no board")
    whole = judge(Path("x.png"), picture, CIRCLES)
    assert whole.usable
    assert whole.verdict.startswith("35 of 35 corners, blur ")


def test_no_circles_are_invented() -> None:
    rng = np.random.default_rng(0)
    for picture in (
        np.full((240, 320), 128, np.uint8),
        rng.integers(0, 256, (240, 320)).astype(np.uint8),
    ):
        for target in (CIRCLES, ASYMMETRIC):
            assert np.isnan(detect(picture, target)).all()


def test_lens() -> None:
    """Photographs of circles give the lens back, the empty places of the grid no corners."""
    values = np.array([330.0, 332, 208, 152, -0.2, 0.06, 0.0005, -0.0006])
    camera = CameraModel("LENSMODEL_OPENCV4", values, (420, 300))
    poses = board_poses(ASYMMETRIC, camera, 10, seed=3, size=0.65)
    views = [detect(photograph(ASYMMETRIC, camera, pose), ASYMMETRIC) for pose in poses]
    corners = np.array([v for v in views if np.isfinite(v).any()])
    assert len(corners) >= 6
    lens = calibrate_lens(corners, ASYMMETRIC, camera.size, "opencv4")
    assert lens.rms < 0.1
    assert lens.outliers.sum() < 0.05 * np.isfinite(corners[..., 0]).sum()
    np.testing.assert_allclose(lens.camera.intrinsics[:2], values[:2], rtol=5e-3)
    np.testing.assert_allclose(lens.camera.intrinsics[2:4], values[2:4], atol=1.5)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real pictures are not here")
def test_real_pictures() -> None:
    """A printed 6 x 6 grid by a webcam: found in all pictures, plane to its distortion."""
    target = CircleGrid(6, 6, 0.034)
    for path in sorted(REAL.glob("grid36-*.png")):
        corners = detect(np.asarray(cv2.imread(str(path), 0), np.uint8), target)
        found = np.isfinite(corners[..., 0])
        assert found.sum() >= 32
        board = np.argwhere(found)[:, ::-1].astype(float)
        h, _ = cv2.findHomography(board, corners[found])
        miss = cv2.perspectiveTransform(board[:, None], np.asarray(h))[:, 0] - corners[found]
        assert np.sqrt((miss**2).sum(axis=-1).mean()) < 1.0
