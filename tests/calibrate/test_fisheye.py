"""Fisheye lenses by our own solver: truth, honest errors, outliers, refusals, real sets."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, adjust, covariance, gradients
from chromeball.calibrate.choose import choose_model, held_out_errors, pose_errors
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.search import detect_files
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.uncertainty import camera_uncertainty, worst_direction
from chromeball.calibrate.virtual import board_poses, project, surrounding_poses
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

BOARD = Chessboard(9, 6, 0.025)
SIZE = (1280, 960)
TRUTH = np.array([290.0, 291, 655, 470, -0.02, 0.01, -0.004, 0.0006])
CAMERA = CameraModel("kb4", TRUTH, SIZE, max_angle=math.radians(95))
POSES = surrounding_poses(BOARD, CAMERA, 20, seed=1)
NOISE = 0.2
DATA = Path(__file__).parents[2].parent / "shared/data/calibrate"


def corners(seed: int = 0, **options: float) -> NDArray[np.float64]:
    return project(BOARD, CAMERA, POSES, noise=NOISE, seed=seed, **options)


def field() -> NDArray[np.float64]:
    """Unit rays up to 90 degrees from the axis."""
    theta, phi = np.meshgrid(np.linspace(0.05, np.pi / 2, 12), np.arange(0, 2 * np.pi, 0.5))
    across = np.sin(theta)
    rays = [across * np.cos(phi), across * np.sin(phi), np.cos(theta)]
    return np.stack(rays, axis=-1).reshape(-1, 3)


def aligned(camera: CameraModel, truth: CameraModel) -> NDArray[np.float64]:
    """Where `camera` sees the field, minus where it should; the turn that
    fits best over the corners is taken out.
    """
    seen = truth.unproject(project(BOARD, truth, POSES).reshape(-1, 2))
    u, _, vt = np.linalg.svd(camera.unproject(truth.project(seen)).T @ seen)
    return camera.project(field() @ (u @ vt).T) - truth.project(field())


def scattered(
    observed: NDArray[np.float64], share: float, seed: int = 7
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """`share` of the corners 5 to 40 pixels off."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(observed.shape[:3]) < share
    turn, far = rng.uniform(0, 2 * np.pi, wrong.shape), rng.uniform(5, 40, wrong.shape)
    off = np.stack([far * np.cos(turn), far * np.sin(turn)], axis=-1)
    return np.where(wrong[..., None], observed + off, observed), wrong


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        CameraModel("kb4_decentred", np.array([*TRUTH, 0.003, -0.002]), SIZE),
        CameraModel.fisheye("equisolid", SIZE, math.pi, radius=450.0),
        CameraModel("pinhole", np.array([500.0, 510, 640, 470]), SIZE),
        CameraModel(
            "LENSMODEL_OPENCV4", np.array([500.0, 510, 640, 470, 0.1, 0, 0, 0.01]), SIZE
        ),
    ],
    ids=lambda camera: camera.model,
)
def test_gradients_are_differences(camera: CameraModel) -> None:
    points = np.random.default_rng(0).uniform([-1, -1, 0.5], [1, 1, 2], (30, 3))
    points[0] = [0, 0, 1]
    _, by_point, by_intrinsics = gradients(camera, points)
    for i, value in enumerate(camera.intrinsics):
        step = 1e-5 * max(1, abs(value))
        up, down = (
            CameraModel(camera.model, camera.intrinsics + s * np.eye(len(camera.intrinsics))[i],
                        SIZE).project(points)
            for s in (step, -step)
        )  # fmt: skip
        np.testing.assert_allclose(by_intrinsics[..., i], (up - down) / (2 * step), atol=1e-4)
    for i, e in enumerate(np.eye(3) * 1e-6):
        slope = (camera.project(points + e) - camera.project(points - e)) / 2e-6
        np.testing.assert_allclose(by_point[..., i], slope, rtol=1e-4, atol=1e-3)


def test_agrees_with_mrcal() -> None:
    """The same lens model, poses and bow by mrcal and by ours, from mrcal's solution shaken."""
    camera = CameraModel("LENSMODEL_OPENCV4", np.array([520, 523, 331, 228, -0.24, 0.09, 0, 0]),
                         (640, 480))  # fmt: skip
    observed = project(BOARD, camera, board_poses(BOARD, camera, 12, seed=1), noise=0.1)
    theirs = calibrate_lens(observed, BOARD, camera.size, "opencv4")
    assert theirs.solution is not None
    poses = [Pose.from_rotation_vector(r[:3], r[3:]) for r in theirs.camera_from_board]
    start = Estimate(
        CameraModel(theirs.camera.model, theirs.camera.intrinsics * 1.02, camera.size),
        np.zeros(2),
        np.array([p.rotation for p in poses]),
        np.array([p.translation for p in poses]),
    )
    used, none = ~theirs.outliers, np.zeros(12)
    board = BOARD.points()
    free = np.arange(12) < 10
    ours = adjust(start, board, observed, used, free=free, precision=none, steps=60)
    errors = theirs.standard_errors
    assert np.all(np.abs(ours.camera.intrinsics - theirs.camera.intrinsics) < 0.05 * errors)
    known, _ = covariance(ours, board, observed, used, none, free)
    ratio = theirs.sigma * np.sqrt(np.diag(known)[:8]) / errors
    np.testing.assert_allclose(ratio, 1, rtol=0.03)
    np.testing.assert_allclose(ours.bow, theirs.bow, atol=2e-6)


def test_truth_and_honest_errors() -> None:
    """Eight noises: the truth within .18 px up to 90 degrees; errors as large as predicted.

    The intrinsics' chi-square has 64 degrees of freedom: its bounds hold 98 % of cases. The
    field's errors hang together more, so that theirs are wider.
    """
    errors: list[NDArray[np.float64]] = []
    scores: list[float] = []
    predicted = 0.0
    for seed in range(100, 108):
        lens = calibrate_lens(corners(seed, bow=0.0005), BOARD, SIZE, "kb4")
        assert lens.sigma == pytest.approx(NOISE, rel=0.06)
        assert abs(abs(lens.bow[0]) - 0.0005) < 6e-5
        miss = lens.camera.intrinsics - TRUTH
        scores.append(float(miss @ np.linalg.solve(lens.covariance, miss)))
        errors.append(aligned(lens.camera, CAMERA))
        predicted += float(lens.projection_covariance(field()).trace(axis1=-2, axis2=-1).sum())
    assert 8 * len(scores) * 0.64 < sum(scores) < 8 * len(scores) * 1.46
    assert 0.7 < np.sqrt(np.square(errors).sum() / predicted) < 1.3
    assert np.sqrt(2 * np.mean(np.square(errors))) < 0.18


def test_pupil_and_decentring() -> None:
    """Near boards, a pupil that travels 4 mm and elements off the axis: four noises.

    Without the two the lens would be bent, which the field at infinity shows.
    """
    near = Chessboard(9, 6, 0.008)
    camera = CameraModel("kb4_decentred", np.array([*TRUTH, 0.002, -0.001]), SIZE,
                         max_angle=math.radians(95))  # fmt: skip
    poses = surrounding_poses(near, camera, 24, seed=1)
    scores: list[float] = []
    for seed in range(4):
        observed = project(near, camera, poses, noise=NOISE, seed=seed, pupil=0.004)
        lens = calibrate_lens(observed, near, SIZE, "kb4_decentred")
        theta = np.linspace(0, 1.5, 40)
        travel = np.stack([theta**2, theta**4], axis=-1) @ lens.pupil
        assert np.abs(travel - 0.004 * theta**2).max() < 0.001
        miss = lens.camera.intrinsics - camera.intrinsics
        scores.append(float(miss @ np.linalg.solve(lens.covariance, miss)))
        assert np.sqrt((aligned(lens.camera, camera) ** 2).sum(axis=-1).mean()) < 0.3
    assert 40 * 0.5 < sum(scores) < 40 * 1.6  # chi-square of 40, 99 % of cases
    observed = project(near, camera, poses, noise=NOISE, pupil=0.004)
    plain = calibrate_lens(observed, near, SIZE, "equisolid")
    assert not plain.pupil.any()


def test_one_parameter_fisheyes() -> None:
    for model in ("equidistant", "equisolid", "stereographic"):
        camera = CameraModel.fisheye(model, SIZE, math.radians(185), radius=470.0)
        poses = surrounding_poses(BOARD, camera, 10, seed=3)
        lens = calibrate_lens(project(BOARD, camera, poses, noise=0.1), BOARD, SIZE, model)
        assert lens.names == ("f", "cx", "cy")
        miss = np.abs(lens.camera.intrinsics - camera.intrinsics)
        assert np.all(miss < 4 * lens.standard_errors), model
        assert lens.figures()["sigma"] == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("fov", [35, 80, 130, 220])
def test_fields_of_view_need_no_guess(fov: float) -> None:
    """From a normal lens to a dome that sees backwards."""
    camera = CameraModel.fisheye("equidistant", SIZE, math.radians(fov), radius=620.0)
    k = np.array([*camera.intrinsics[[0, 0, 1, 2]], 0.01, -0.004, 0, 0])
    wide = fov > 100
    camera = CameraModel("kb4", k, SIZE, max_angle=camera.max_angle if wide else 1.0)
    poses = (surrounding_poses if wide else board_poses)(BOARD, camera, 14, seed=2)
    lens = calibrate_lens(project(BOARD, camera, poses, noise=0.1), BOARD, SIZE, "kb4")
    assert lens.rms < 0.17
    assert abs(lens.camera.intrinsics[0] - k[0]) < 4 * lens.standard_errors[0]


@pytest.mark.parametrize("share", [0.05, 0.4])
def test_outliers(share: float) -> None:
    observed, wrong = scattered(corners(), share)
    lens = calibrate_lens(observed, BOARD, SIZE, "kb4")
    assert lens.outliers[wrong].mean() > 0.98
    assert lens.outliers[~wrong].mean() < 0.01
    assert np.sqrt((aligned(lens.camera, CAMERA) ** 2).sum(axis=-1).mean()) < 0.25


def test_misread_views_count_for_nothing() -> None:
    """Two boards with their corners in the wrong order, and a partly hidden one."""
    observed = corners()
    observed[3] = (
        observed[3].reshape(-1, 2)[np.random.default_rng(1).permutation(54)].reshape(6, 9, 2)
    )
    observed[8] = observed[8, :, ::-1].swapaxes(0, 1).reshape(6, 9, 2)
    observed[5, :, 5:] = np.nan
    lens = calibrate_lens(observed, BOARD, SIZE, "kb4")
    assert np.isnan(lens.view_rms).nonzero()[0].tolist() == [3, 8]
    assert np.isnan(lens.camera_from_board[[3, 8]]).all()
    assert lens.outliers[[3, 8]].all()
    assert not lens.outliers[5, :, 5:].any()
    assert lens.rms < 1.5 * NOISE
    assert np.isfinite(lens.tilt())


def test_refusals() -> None:
    frontal = [
        Pose.from_rotation_vector([0, 0, 0.3 * i], [-0.1 + 0.02 * i, -0.06, 0.2 + 0.01 * i])
        for i in range(8)
    ]
    for noise in (0.0, 0.2):
        flat = project(BOARD, CAMERA, frontal, noise=noise)
        with pytest.raises(UserError, match=r"parallel to itself|focal length open"):
            calibrate_lens(flat, BOARD, SIZE, "kb4")
    same = np.repeat(corners()[:1], 6, axis=0)
    with pytest.raises(UserError, match=r"parallel to itself|focal length open|not determine"):
        calibrate_lens(same, BOARD, SIZE, "kb4")
    noise_alone = np.random.default_rng(0).uniform(0, 900, (8, 6, 9, 2))
    with pytest.raises(UserError, match=r"no lens explains|fit one lens|focal length open"):
        calibrate_lens(noise_alone, BOARD, SIZE, "kb4")
    few = corners()[:3]
    few[:, 2:], few[:, :, 4:] = np.nan, np.nan
    with pytest.raises(UserError, match="24 corners are too few for kb4"):
        calibrate_lens(few, BOARD, SIZE, "kb4")


def test_auto_finds_the_fisheye() -> None:
    """OpenCV's models end at 90 degrees; what they refuse does not stop the choice."""
    choice = choose_model(corners()[:12], BOARD, SIZE)
    assert choice.model == "kb4"
    assert choice.errors["kb4"] < 1.2 * math.sqrt(2) * NOISE


def test_same_data_same_answer_and_file_reads_back(tmp_path: Path) -> None:
    lens, again = (calibrate_lens(corners()[:10], BOARD, SIZE, "kb4") for _ in range(2))
    np.testing.assert_array_equal(lens.camera.intrinsics, again.camera.intrinsics)
    lens.write(tmp_path / "lens.cameramodel")
    read = CameraModel.read(tmp_path / "lens.cameramodel")
    assert (read.model, read.size, read.max_angle) == ("kb4", SIZE, lens.camera.max_angle)
    np.testing.assert_array_equal(read.intrinsics, lens.camera.intrinsics)
    assert read.covariance is not None
    np.testing.assert_allclose(read.covariance, lens.covariance, rtol=1e-8)
    said = camera_uncertainty(read, field())
    known = lens.projection_covariance(field())
    # The turn is taken out over the region here, over the corners there.
    ratio = worst_direction(said) / worst_direction(known)
    assert 0.7 < np.median(ratio) < 1.3
    half = read.scaled(0.5)
    np.testing.assert_allclose(worst_direction(camera_uncertainty(half, field())),
                               worst_direction(said) / 2, rtol=0.05)  # fmt: skip
    with pytest.raises(UserError, match="does not say how well"):
        camera_uncertainty(CAMERA, field())


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared calibration pictures are not here")
@pytest.mark.parametrize(
    ("folder", "board", "bar"),
    [
        ("camodocal", Chessboard(9, 6, 0.08), 0.470),
        ("ocam/test_images/fish_1", Chessboard(8, 6, 0.0325), 0.969),
        ("ocam/test_images/fish_2", Chessboard(8, 6, 0.117), 0.337),
    ],
)
def test_real_sets(folder: str, board: Chessboard, bar: float) -> None:
    """No focal guess; held-out RMS over all corners no worse than the best peer's."""
    detections = detect_files(sorted((DATA / folder).glob("*.*g")), board)
    observed = np.array([d.corners for d in detections if d.usable])
    even = np.arange(len(observed)) % 2 == 0
    lens = calibrate_lens(observed[even], board, detections[0].size, "kb4")
    assert np.sqrt(np.mean(pose_errors(lens, observed[~even], board) ** 2)) < bar


def test_held_out_error_of_the_wrong_lens_is_larger() -> None:
    right, wrong = (
        np.median(held_out_errors(corners()[:12], BOARD, SIZE, model, folds=2))
        for model in ("kb4", "equisolid")
    )
    assert wrong > 3 * right
