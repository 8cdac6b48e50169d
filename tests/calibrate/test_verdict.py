"""Verdicts: right about what is lacking, and their advice better than other views."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.halves import compare_halves
from chromeball.calibrate.lens import calibrate_lens
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.lit import brightest, lit_places
from chromeball.calibrate.next_views import GOOD, candidates, knowledge, next_views, slants
from chromeball.calibrate.one_lens import lens_change, magnifications
from chromeball.calibrate.regions import named, thirds
from chromeball.calibrate.solve import Fit, fit_start
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.verdict import common_residual, judge_lens
from chromeball.calibrate.virtual import board_poses, project, surrounding_poses
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

BOARD = Chessboard(9, 6, 0.025)
SIZE = (640, 480)
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4", np.array([520.0, 523, 331, 228, -0.24, 0.09, 0.001, -0.0008]), SIZE
)
NOISE = 0.2
MIDDLE = np.array([0.1, 0.0625, 0.0])


def held(count: int, turn: float, aside: float, seed: int = 0) -> list[Pose]:
    """Boards turned by up to `turn` radians, up to `aside` times the distance off the axis."""
    rng = np.random.default_rng(seed)
    poses: list[Pose] = []
    while len(poses) < count:
        rotation = Pose.from_rotation_vector(rng.uniform(-turn, turn, 3), np.zeros(3)).rotation
        away = rng.uniform(0.4, 0.65)
        place = np.array([*rng.uniform(-aside, aside, 2) * away, away])
        pose = Pose(rotation, place - rotation @ MIDDLE)
        seen = CAMERA.project(pose.apply(BOARD.points().reshape(-1, 3)))
        if (seen > 4).all() and (seen < np.array(SIZE) - 5).all():
            poses.append(pose)
    return poses


@cache
def start() -> Fit:
    """A start for all solutions here, so that none searches for it."""
    poses = board_poses(BOARD, CAMERA, 9, seed=1)
    return fit_start(project(BOARD, CAMERA, poses, noise=NOISE), BOARD, SIZE)


def lens_of(corners: NDArray[np.float64]) -> Lens:
    return calibrate_lens(corners, BOARD, SIZE, "opencv4", start=start())


def solved(poses: list[Pose], seed: int = 0) -> Lens:
    return lens_of(project(BOARD, CAMERA, poses, noise=NOISE, seed=seed))


@pytest.fixture(scope="module")
def random() -> Lens:
    return solved(board_poses(BOARD, CAMERA, 15, seed=1))


@pytest.fixture(scope="module")
def good(random: Lens) -> Lens:
    """Views all over the picture, as large and as tilted as they are asked for."""
    known = knowledge(random, BOARD, random.uncertainty(18)[0].reshape(-1, 2))
    large = [v.camera_from_board for v in candidates(known, BOARD) if v.size > 0.3]
    return solved([*large[::3], *large[1::3]])


def test_two_routes_to_one_uncertainty(random: Lens) -> None:
    """The views' information summed, and the solver's covariance."""
    pixels, deviation = random.uncertainty(18)
    known = knowledge(random, BOARD, pixels.reshape(-1, 2))
    np.testing.assert_allclose(known.deviation(), deviation.ravel(), rtol=1e-3)
    fisheye = CameraModel(
        "kb4", np.array([290.0, 291, 655, 470, -0.02, 0.01, -0.004, 0.0006]), (1280, 960),
        max_angle=math.radians(95),
    )  # fmt: skip
    poses = surrounding_poses(BOARD, fisheye, 12, seed=1)
    corners = project(BOARD, fisheye, poses, noise=NOISE, pupil=0.01)
    lens = calibrate_lens(corners, BOARD, fisheye.size, "kb4")
    assert lens.pupil.any()
    pixels, deviation = lens.uncertainty(9)
    known = knowledge(lens, BOARD, pixels.reshape(-1, 2))
    seen = np.isfinite(deviation.ravel())
    np.testing.assert_allclose(known.deviation()[seen], deviation.ravel()[seen], rtol=0.02)


def test_a_good_set_needs_nothing(good: Lens) -> None:
    halves = compare_halves(good, BOARD, "opencv4", start())
    verdict = judge_lens(good, BOARD, halves=halves)
    assert verdict.good
    assert verdict.advice == ()
    assert verdict.sentence.startswith("good to 0.")
    assert verdict.figures["good_share"] > 0.95


def test_frontal_views_are_to_be_tilted() -> None:
    verdict = judge_lens(solved(held(14, 0.1, 0.3)), BOARD)
    assert not verdict.good
    assert "never tilted by more than" in verdict.sentence
    assert verdict.advice[0].startswith("tilt the board by 30 degrees")
    assert all(view.tilt.startswith("its") for view in verdict.views[:2])


def test_views_in_the_middle_are_to_be_taken_elsewhere() -> None:
    verdict = judge_lens(solved(held(14, 0.5, 0.02)), BOARD)
    assert not verdict.good
    assert "unconstrained: take" in verdict.sentence
    assert verdict.views
    assert all(view.place != "middle" for view in verdict.views)
    assert any("not known yet" in line for line in verdict.advice)


def test_a_missing_side_is_named() -> None:
    """Views of the left two thirds alone."""
    everywhere = board_poses(BOARD, CAMERA, 80, seed=3, size=0.8)
    left = [
        pose
        for pose in everywhere
        if CAMERA.project(pose.apply(BOARD.points().reshape(-1, 3)))[:, 0].max() < 420
    ]
    verdict = judge_lens(solved(left), BOARD)
    assert "the right side" in verdict.sentence
    assert verdict.views[0].corners[..., 0].max() > 600


def test_few_views_are_said() -> None:
    verdict = judge_lens(solved(board_poses(BOARD, CAMERA, 4, seed=2)), BOARD)
    assert "4 views are few" in verdict.sentence
    assert len(verdict.views) >= 6


def test_advised_views_help_more_than_others() -> None:
    """As many views elsewhere, three times: always less certain, and farther from the truth."""
    poses = held(12, 0.5, 0.15)
    verdict = judge_lens(solved(poses), BOARD)
    count = len(verdict.views)
    assert count >= 2
    advised = solved([*poses, *(v.camera_from_board for v in verdict.views)])

    def left(lens: Lens) -> float:
        return float(np.log(np.hypot(lens.uncertainty(18)[1], GOOD)).mean())

    def miss(lens: Lens) -> float:
        x, y = np.meshgrid(np.linspace(0, 639, 15), np.linspace(0, 479, 11))
        q = np.stack([x.ravel(), y.ravel()], axis=-1)
        a, b = lens.camera.unproject(q), CAMERA.unproject(q)
        u, _, vt = np.linalg.svd(b.T @ a)
        far = np.linalg.norm(CAMERA.project(a @ (u @ vt).T) - q, axis=-1)
        return float(np.sqrt(np.mean(far**2)))

    others = [
        solved([*poses, *board_poses(BOARD, CAMERA, count, seed=20 + s)], seed=s)
        for s in range(3)
    ]
    assert left(advised) < min(left(lens) for lens in others)
    assert miss(advised) < float(np.median([miss(lens) for lens in others]))


def test_what_is_predicted_comes_true() -> None:
    """The uncertainty after the advised views, before and when they are there."""
    poses = held(12, 0.5, 0.15)
    lens = solved(poses)
    known = knowledge(lens, BOARD, lens.uncertainty(18)[0].reshape(-1, 2))
    views, after = next_views(known, BOARD, most=4)
    found = solved([*poses, *(v.camera_from_board for v in views)]).uncertainty(18)[1].ravel()
    ratio = float(np.sqrt(np.mean(found**2) / np.mean(after.deviation() ** 2)))
    assert 0.85 < ratio < 1.15


def test_halves_of_noise_and_of_a_lens_that_changed() -> None:
    poses = board_poses(BOARD, CAMERA, 16, seed=1)
    steady = [
        compare_halves(solved(poses, seed=seed), BOARD, "opencv4", start()) for seed in range(4)
    ]
    assert sum(half.excess > half.chance for half in steady) <= 1
    ratio = np.sqrt(np.mean([half.excess**2 for half in steady]))
    assert 0.4 < ratio < 1.7  # about two degrees of freedom each
    assert np.mean([half.misfit for half in steady]) == pytest.approx(1.0, abs=0.08)
    values = CAMERA.intrinsics.copy()
    values[:2] *= 1.02
    breathed = replace(CAMERA, intrinsics=values)
    corners = project(BOARD, CAMERA, poses, noise=NOISE)
    corners[1::2] = project(BOARD, breathed, poses, noise=NOISE)[1::2]
    lens = lens_of(corners)
    halves = compare_halves(lens, BOARD, "opencv4", start())
    assert halves.excess > 1.5 * halves.chance
    verdict = judge_lens(lens, BOARD, halves=halves)
    assert not verdict.good
    assert "two halves of the views differ" in verdict.sentence
    assert "focus and zoom fixed" in verdict.advice[-1]


def test_residuals_in_common() -> None:
    """A ripple of the glass, 0.25 px, that no term of the model has; and noise alone."""
    poses = board_poses(BOARD, CAMERA, 25, seed=1)
    corners = project(BOARD, CAMERA, poses, noise=NOISE)
    assert not common_residual(lens_of(corners))[1]
    ripple = 0.25 * np.sin(corners[..., :1] / 20 + corners[..., 1:] / 25) * [1, 1]
    size, certain = common_residual(lens_of(corners + ripple))
    assert certain
    assert 0.05 < size < 0.36


def test_misread_views_bent_boards_and_blur_are_told(good: Lens) -> None:
    outliers = good.outliers.copy()
    outliers[3, :2] = True
    files = [f"view_{i}.jpg" for i in range(len(outliers))]
    bent = replace(good, outliers=outliers, bow=np.array([0.0015, 0]))
    advice = judge_lens(bent, BOARD, files=files, blur=3.1).advice
    assert [line.split()[:2] for line in advice] == [
        ["take", "view_3.jpg"],
        ["fix", "the"],
        ["sharper", "pictures:"],
    ]
    assert "18 of its 54" in advice[0]
    assert "1.5 mm out of 200 mm" in advice[1]


def zoomed(factor: float, views: int, seed: int = 0) -> NDArray[np.float64]:
    """Fourteen views, the last of which by a lens zoomed by `factor`."""
    scale = np.array([factor, factor, 1, 1, 1, 1, 1, 1])
    other = replace(CAMERA, intrinsics=CAMERA.intrinsics * scale)
    first, last = (
        project(BOARD, c, board_poses(BOARD, c, n, seed=seed + i), noise=NOISE, seed=seed + i)
        for i, (c, n) in enumerate(((CAMERA, 14 - views), (other, views)))
    )
    return np.concatenate([first, last])


@pytest.mark.parametrize(("factor", "views"), [(1.25, 4), (1.25, 7), (1.03, 7)])
def test_a_lens_that_was_zoomed(factor: float, views: int) -> None:
    """Where and by how much is told, and no more views are asked for."""
    lens = lens_of(zoomed(factor, views))
    change = lens_change(lens, BOARD)
    assert change is not None
    assert change.first == 14 - views
    assert abs(change.magnification - factor) < 3 * change.error
    assert change.error < 0.1 * factor
    verdict = judge_lens(lens, BOARD, halves=compare_halves(lens, BOARD, "opencv4", start()))
    assert not verdict.good
    assert f"the lens changed before view {14 - views}" in verdict.sentence
    assert "zoom or focus changed" in verdict.advice[0]
    assert not verdict.views


def test_one_lens_is_one() -> None:
    """Magnifications are their errors apart, and chance is no change."""
    off: list[float] = []
    for seed in range(4):
        lens = lens_of(zoomed(1.0, 7, 10 + 2 * seed))
        found, errors = magnifications(lens, BOARD)
        off += list(np.log(found) / errors)
        assert lens_change(lens, BOARD) is None
    assert 0.7 < float(np.sqrt(np.mean(np.square(off)))) < 1.3


def test_views_that_do_not_fit_count(good: Lens) -> None:
    poses, outliers = good.camera_from_board.copy(), good.outliers.copy()
    poses[[1, 4]], outliers[[1, 4]] = np.nan, True
    partial = replace(
        good,
        camera_from_board=poses,
        outliers=outliers,
        residuals=np.where(outliers[..., None], np.nan, good.residuals),
    )
    verdict = judge_lens(partial, BOARD)
    assert f"2 of {len(poses)} views do not fit" in verdict.sentence
    assert "take view 1, view 4 again or leave out" in verdict.advice[0]
    assert verdict.good == (0.1 * len(poses) >= 2)
    poses[: len(poses) // 5] = np.nan
    assert not judge_lens(replace(partial, camera_from_board=poses), BOARD).good


def test_slants_are_those_of_the_boards() -> None:
    lens = solved(held(8, 0.4, 0.1))
    pose = Pose.from_rotation_vector(np.array([0.3, 0.0, 0.0]), np.array([0.0, 0.0, 0.5]))
    other = Pose.from_rotation_vector(np.array([0.0, 0.2, 0.0]), np.array([0.0, 0.0, 0.5]))
    rows = [[*p.rotation_vector(), *p.translation] for p in (pose, other)]
    lens = replace(lens, camera_from_board=np.array(rows))
    np.testing.assert_allclose(slants(lens), [[0, 0.3], [0.2, 0]], atol=1e-12)
    # The edge that is nearer is nearer.
    points = pose.apply(BOARD.points())
    assert points[0, 4, 2] < points[-1, 4, 2]
    points = other.apply(BOARD.points())
    assert points[3, -1, 2] < points[3, 0, 2]


def test_regions_in_words() -> None:
    for places, words, plural in (
        ({(0, 0), (2, 0)}, "the left corners", True),
        ({(0, 0), (1, 0), (2, 0)}, "the left side", False),
        ({(0, 0), (0, 2), (2, 0), (2, 2)}, "the corners", True),
        ({(1, 2)}, "the right edge", False),
        ({(0, 1), (2, 2)}, "the top edge and the bottom right corner", True),
        ({(r, c) for r in range(3) for c in range(3)} - {(1, 1)}, "everything but the middle",
         False),
    ):  # fmt: skip
        assert named(places) == (words, plural)
    pixels = np.array([[10.0, 10], [12, 12], [600, 400]])
    assert thirds(np.array([True, False, False]), pixels, SIZE) == {(0, 0)}


def test_the_circle_of_a_fisheye() -> None:
    y, x = np.mgrid[0:480, 0:640]
    inside = np.hypot(x - 320, y - 240) < 230
    noise = np.random.default_rng(0).integers(0, 12, inside.shape)
    picture = np.where(inside, 120, noise).astype(np.uint8)
    picture[200:280, 300:380] = 0  # a dark thing inside is no rim
    lit = lit_places(brightest(picture, (14, 18)))
    assert lit[4:10, 5:13].all()
    assert not lit[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert lit.mean() == pytest.approx(inside.mean(), abs=0.12)
    other = brightest(np.full((480, 640), 90, np.uint8), (14, 18), brightest(picture, (14, 18)))
    assert lit_places(other).all()


def test_dark_rims_do_not_count(random: Lens) -> None:
    pixels, _ = random.uncertainty(18)
    circle = np.linalg.norm(pixels - [320, 240], axis=-1) < 240
    whole, inner = judge_lens(random, BOARD), judge_lens(random, BOARD, lit=circle)
    assert inner.figures["good_share"] > whole.figures["good_share"]
    assert "of the lens's circle" in inner.sentence
    reached: list[NDArray[np.float64]] = [v.corners.reshape(-1, 2) for v in inner.views]
    assert all((np.linalg.norm(c - [320, 240], axis=-1) < 280).all() for c in reached)
