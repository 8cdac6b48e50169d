"""Lenses: recovered truth within its standard errors, real sets, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.choose import choose_model, held_out_errors, pose_errors
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.search import detect_files
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.virtual import board_poses, project
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

BOARD = Chessboard(9, 6, 0.025)
SIZE = (640, 480)
TRUTH = np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008])
CAMERA = CameraModel("LENSMODEL_OPENCV4", TRUTH, SIZE)
NOISE = 0.2
DATA = Path(__file__).parents[2].parent / "shared/data/calibrate"


def corners(views: int = 15, seed: int = 0, **options: float) -> NDArray[np.float64]:
    poses = board_poses(BOARD, CAMERA, views, seed=1)
    return project(BOARD, CAMERA, poses, noise=NOISE, seed=seed, **options)


def test_standard_errors_are_honest() -> None:
    """Errors over standard errors have unit variance, over 8 noises and 8 intrinsics."""
    scores: list[NDArray[np.float64]] = []
    sigmas: list[float] = []
    for seed in range(8):
        lens = calibrate_lens(corners(seed=seed), BOARD, SIZE, "opencv4")
        scores.append((lens.camera.intrinsics - TRUTH) / lens.standard_errors)
        sigmas.append(lens.sigma)
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1, abs=0.35)
    assert np.max(np.abs(scores)) < 4.5
    assert np.mean(sigmas) == pytest.approx(NOISE, rel=0.03)


def test_projection_uncertainty_is_honest() -> None:
    """Spread of projections of solved cameras against the prediction, in the middle.

    A turn of all boards and the camera together shows in no picture, so that the best turn is
    taken out of each solution first, as the definition of the uncertainty does.
    """
    x, y = np.meshgrid(np.linspace(160, 480, 5), np.linspace(120, 360, 5))
    q = np.stack([x.ravel(), y.ravel()], axis=-1)
    seen = corners().reshape(-1, 2)
    rays, corner_rays = CAMERA.unproject(q), CAMERA.unproject(seen)
    ratios: list[float] = []
    for seed in range(12):
        lens = calibrate_lens(corners(seed=seed), BOARD, SIZE, "opencv4")
        u, _, vt = np.linalg.svd(lens.camera.unproject(seen).T @ corner_rays)
        miss = lens.camera.project(rays @ (u @ vt).T) - q
        predicted = lens.projection_covariance(rays)
        ratios.append(float((miss**2).sum() / predicted.trace(axis1=-2, axis2=-1).sum()))
    assert 0.8 < np.sqrt(np.mean(ratios)) < 1.2
    lens = calibrate_lens(corners(), BOARD, SIZE, "opencv4")
    pixels, worst = lens.uncertainty(columns=7)
    variance = lens.projection_covariance(lens.camera.unproject(pixels))
    np.testing.assert_allclose(worst, np.sqrt(np.linalg.eigvalsh(variance)[..., 1]))


def test_bow_and_field_of_view() -> None:
    lens = calibrate_lens(corners(20, bow=0.001), BOARD, SIZE, "opencv4")
    assert abs(abs(lens.bow[0]) - 0.001) < 2e-4
    assert abs(lens.bow[1]) < 2e-4
    across, down = lens.field_of_view()
    assert across == pytest.approx(2 * np.arctan(640 / (2 * 520)), rel=5e-3)
    assert down == pytest.approx(2 * np.arctan(480 / (2 * 523)), rel=5e-3)
    true_across, _ = lens.true_field_of_view()
    ends = CAMERA.unproject(np.array([[-0.5, 228], [639.5, 228]]))
    assert true_across == pytest.approx(np.arccos(ends[0] @ ends[1]), rel=5e-3)


def test_outliers_are_rejected() -> None:
    """5 % of the corners are off by 3 to 8 pixels, and one in ten is missing."""
    rng = np.random.default_rng(7)
    observed = corners(20)
    shape = observed.shape[:3]
    wrong = rng.random(shape) < 0.05
    turn = rng.uniform(0, 2 * np.pi, shape)
    far = rng.uniform(3, 8, shape)
    observed[wrong] += np.stack([far * np.cos(turn), far * np.sin(turn)], axis=-1)[wrong]
    missing = (rng.random(shape) < 0.1) & ~wrong
    observed[missing] = np.nan
    lens = calibrate_lens(observed, BOARD, SIZE, "opencv4")
    assert lens.outliers[wrong].mean() > 0.97
    assert lens.outliers[~wrong].sum() <= 5
    assert not lens.outliers[missing].any()
    assert np.isnan(lens.residuals[missing]).all()
    scores = (lens.camera.intrinsics - TRUTH) / lens.standard_errors
    assert np.sqrt(np.mean(scores**2)) < 2


def test_two_corners_in_five_are_wrong() -> None:
    """By 5 to 40 pixels: the lens is still the one that was there."""
    rng = np.random.default_rng(3)
    observed = corners(20)
    wrong = rng.random(observed.shape[:3]) < 0.4
    turn, far = rng.uniform(0, 2 * np.pi, wrong.shape), rng.uniform(5, 40, wrong.shape)
    off = np.stack([far * np.cos(turn), far * np.sin(turn)], axis=-1)
    lens = calibrate_lens(np.where(wrong[..., None], observed + off, observed), BOARD, SIZE)
    assert lens.outliers[wrong].mean() > 0.99
    assert lens.outliers[~wrong].mean() < 0.01
    assert abs(lens.camera.intrinsics[0] - TRUTH[0]) < 4 * lens.standard_errors[0]


@pytest.mark.parametrize("model", ["opencv5", "opencv8", "splined"])
def test_richer_models_predict_as_well(model: str) -> None:
    """Views that were left out are seen within the noise: sqrt 2 of it per point."""
    observed = corners(24)
    lens = calibrate_lens(observed[:16], BOARD, SIZE, model)
    errors = pose_errors(lens, observed[16:], BOARD)
    assert np.median(errors) < 1.25 * np.sqrt(2) * NOISE


def test_cahvore() -> None:
    """Gennery's lens comes back, its moving pupil told beside it, and mrcal reads the rest."""
    truth = np.array([500.0, 501, 321, 242, 0.01, -0.015, 0, -0.15, 0.04, 0, 0, 0])
    camera = CameraModel("LENSMODEL_CAHVORE_linearity=0.37", truth, SIZE)
    poses = board_poses(BOARD, camera, 14, seed=1)
    corners = project(BOARD, camera, poses, noise=NOISE, seed=1)
    lens = calibrate_lens(corners, BOARD, SIZE, "cahvore")
    own = lens.standard_errors > 0
    assert own.sum() == 8
    off = (lens.camera.intrinsics - truth)[own] / lens.standard_errors[own]
    assert np.abs(off).max() < 4
    np.testing.assert_array_equal(lens.camera.intrinsics[~own], 0)
    np.testing.assert_array_equal(lens.pupil, 0)
    assert lens.names[7] == "r1"
    rays = lens.camera.unproject(corners[0])
    np.testing.assert_allclose(lens.camera.project(rays), corners[0], atol=1e-3)

    travelling = project(BOARD, camera, poses, noise=NOISE, seed=1, pupil=0.04)
    lens = calibrate_lens(travelling, BOARD, SIZE, "cahvore")
    off = (lens.camera.intrinsics - truth)[own] / lens.standard_errors[own]
    assert np.abs(off).max() < 4
    assert lens.pupil @ [0.25, 0.0625] == pytest.approx(0.04 * 0.25, rel=0.3)


def test_focal_lengths_need_no_guess() -> None:
    for focal in (200.0, 420.0, 1500.0, 4000.0):
        camera = CameraModel("pinhole", np.array([focal, focal, 325, 235]), SIZE)
        poses = board_poses(BOARD, camera, 12, seed=2)
        observed = project(BOARD, camera, poses, noise=0.1)
        lens = calibrate_lens(observed, BOARD, SIZE, "pinhole")
        assert abs(lens.camera.intrinsics[0] - focal) < 4 * lens.standard_errors[0]


def test_auto_prefers_what_predicts() -> None:
    """The lens is OpenCV's of four terms: richer ones predict no better."""
    choice = choose_model(corners(20), BOARD, SIZE)
    assert choice.model == "opencv4"
    assert "simple" in choice.reason
    error = choice.errors["opencv4"]
    assert error < 1.1 * min(choice.errors.values())
    assert error < 1.2 * np.sqrt(2) * NOISE
    pinhole = held_out_errors(corners(20), BOARD, SIZE, "pinhole", folds=2)
    assert np.median(pinhole) > 3 * error


def test_same_data_same_answer() -> None:
    a, b = (calibrate_lens(corners(), BOARD, SIZE, "opencv8") for _ in range(2))
    np.testing.assert_array_equal(a.camera.intrinsics, b.camera.intrinsics)


def test_file_reads_back(tmp_path: Path) -> None:
    import mrcal

    lens = calibrate_lens(corners(), BOARD, SIZE, "opencv8", [f"{i}.png" for i in range(15)])
    path = tmp_path / "lens.cameramodel"
    lens.write(path)
    read = CameraModel.read(path)
    assert read.model == "LENSMODEL_OPENCV8"
    assert read.size == SIZE
    np.testing.assert_allclose(read.intrinsics, lens.camera.intrinsics, rtol=1e-8)
    kept = mrcal.cameramodel(str(path)).optimization_inputs()  # pyright: ignore[reportAttributeAccessIssue]
    assert kept is not None
    assert kept["observations_board"].shape == (15, 6, 9, 3)
    assert read.covariance is not None
    np.testing.assert_allclose(read.covariance, lens.covariance, rtol=1e-7)


def test_refusals() -> None:
    good = corners()
    with pytest.raises(UserError, match="found in 1 picture; a lens needs 3"):
        calibrate_lens(good[:1], BOARD, SIZE)
    with pytest.raises(UserError, match="unknown lens model 'opencv9'"):
        calibrate_lens(good, BOARD, SIZE, "opencv9")
    frontal = [
        Pose.from_rotation_vector([0, 0, 0.3 * i], [-0.1 + 0.02 * i, -0.06, 0.35 + 0.01 * i])
        for i in range(8)
    ]
    for noise in (0.0, 0.2):
        flat = project(BOARD, CAMERA, frontal, noise=noise)
        with pytest.raises(UserError, match=r"parallel to itself|focal length open"):
            calibrate_lens(flat, BOARD, SIZE, "opencv4")
    few = good[:3].copy()
    few[:, 2:] = np.nan
    few[:, :, 5:] = np.nan
    with pytest.raises(UserError, match="30 corners are too few for opencv8"):
        calibrate_lens(few, BOARD, SIZE)


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared calibration pictures are not here")
def test_real_perspective_set() -> None:
    """OpenCV's left camera: published RMS .39 to .47 px, focal length 534 to 536."""
    files = sorted((DATA / "opencv_stereo").glob("left[01]*.jpg"))
    detections = detect_files(files, BOARD)
    assert all(d.count == 54 for d in detections)
    observed = np.array([d.corners for d in detections])
    lens = calibrate_lens(observed, BOARD, SIZE, "opencv5")
    assert lens.rms < 0.2
    assert np.median(held_out_errors(observed, BOARD, SIZE, "opencv5")) < 0.2
    assert 531 < lens.camera.intrinsics[0] < 536


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared calibration pictures are not here")
def test_real_fisheye_set() -> None:
    """Improved OCamCalib's fish_1 without a focal guess; the best peer held out: .97 px."""
    board = Chessboard(8, 6, 0.0325)
    files = sorted((DATA / "ocam/test_images/fish_1").glob("*.*g"))
    observed = np.array([d.corners for d in detect_files(files, board) if d.usable])
    assert len(observed) >= 14
    size = detect_files(files[:1], board)[0].size
    assert np.median(held_out_errors(observed, board, size, "opencv8")) < 0.5
