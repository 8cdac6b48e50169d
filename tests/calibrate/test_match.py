"""Camera and pose from one picture: truth, noise against covariance, what stays open."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.match import Match, match
from chromeball.calibrate.resection import POSE, Evidence, linearise, refine
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import write_picture
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

SIZE = (1600, 1200)
BLANK = CameraModel.pinhole(SIZE, 1.0)
RECTANGLE = np.array([[-0.3, 0, -0.2], [0.3, 0, -0.2], [0.3, 0, 0.2], [-0.3, 0, 0.2]])
CLOUD = np.random.default_rng(7).uniform(-0.2, 0.2, (8, 3))
BOX = np.array([[x, y, z] for x in (0, 0.2) for y in (0, 0.15) for z in (0, 0.25)])
EDGES = [
    (a, b, int(np.argmax(b - a)))
    for a in BOX
    for b in BOX
    if (b - a > 0).sum() == 1 and (b - a >= 0).all()
]
AXES = [axis for _, _, axis in EDGES]


def camera(
    fov: float = 55.0, place: tuple[float, float, float] = (0.35, 0.5, 0.8)
) -> CameraModel:
    pose = Pose.look_at(np.array(place), np.array([0.02, 0, 0.05]))
    return CameraModel.pinhole(SIZE, math.radians(fov)).posed(pose)


def ends(seen: CameraModel) -> Array:
    return np.array([seen.project_world(np.array([a, b])) for a, b, _ in EDGES])


def k1_of(lens: CameraModel) -> float:
    return float(lens.intrinsics[4]) if len(lens.intrinsics) > 4 else 0.0


def errors(found: Match, truth: CameraModel) -> Array:
    """Of the ten unknowns, in the covariance's order."""
    have, pose = found.camera, truth.world_from_camera
    turn = Pose(pose.rotation.T @ have.world_from_camera.rotation, np.zeros(3))
    return np.concatenate(
        [
            [math.log(have.intrinsics[0] / truth.intrinsics[0])],
            have.intrinsics[2:4] - truth.intrinsics[2:4],
            turn.rotation_vector(),
            have.world_from_camera.translation - pose.translation,
            [k1_of(have) - k1_of(truth)],
        ]
    )


@pytest.mark.parametrize("fov", [12.0, 55.0, 95.0])
def test_rectangle(fov: float) -> None:
    far = 0.55 / math.tan(math.radians(fov) / 2)
    truth = camera(fov, (0.4 * far, 0.5 * far, 0.8 * far))
    found = match(BLANK, RECTANGLE, truth.project_world(RECTANGLE), above_floor=True)
    np.testing.assert_allclose(errors(found, truth), 0, atol=1e-6)
    assert found.rms < 1e-6


def test_points_in_space() -> None:
    truth = camera()
    found = match(BLANK, CLOUD, truth.project_world(CLOUD))
    np.testing.assert_allclose(errors(found, truth), 0, atol=1e-6)
    assert found.rivals == ()


def test_edges_of_a_box() -> None:
    """Lines along three axes, or two, and two corners."""
    truth = camera()
    corners = BOX[[0, 4]]
    lines = ends(truth)
    found = match(BLANK, corners, truth.project_world(corners), axes=AXES, ends=lines)
    np.testing.assert_allclose(errors(found, truth), 0, atol=1e-6)
    two = np.array(AXES) != 1
    flat = match(
        BLANK, corners, truth.project_world(corners), axes=np.array(AXES)[two], ends=lines[two]
    )
    np.testing.assert_allclose(errors(flat, truth), 0, atol=1e-6)
    assert flat.standard_errors[0] > found.standard_errors[0]


def test_known_lens_and_zoomed_lens() -> None:
    """Distortion of a known lens; its focal length known, or another."""
    values = np.array([1500.0, 1510, 805, 590, -0.2, 0.06, 0.001, -0.0005])
    lens = CameraModel("LENSMODEL_OPENCV4", values, SIZE)
    pose = camera().world_from_camera
    known = match(lens, CLOUD, lens.posed(pose).project_world(CLOUD), focal_known=True)
    np.testing.assert_allclose(
        known.camera.world_from_camera.translation, pose.translation, atol=1e-8
    )
    assert known.standard_errors[0] == 0
    zoomed = CameraModel("LENSMODEL_OPENCV4", values * ([1.3] * 2 + [1.0] * 6), SIZE).posed(
        pose
    )
    found = match(lens, CLOUD, zoomed.project_world(CLOUD))
    np.testing.assert_allclose(found.camera.intrinsics, zoomed.intrinsics, rtol=1e-6)


def test_a_lens_that_bends_is_found_or_told() -> None:
    """Barrel distortion of 16 % at the corners, as a webcam's, and nobody said so."""
    values = np.array([1600.0, 1600, 799.5, 599.5, -0.4, 0, 0, 0])
    webcam = CameraModel("LENSMODEL_OPENCV4", values, SIZE, camera().world_from_camera)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.2, 0.2, 6))
    board = np.stack([x, 0 * x, y], axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    q = webcam.project_world(board) + rng.normal(0, 0.5, (54, 2))
    found = match(BLANK, board, q)
    off = errors(found, webcam)
    assert (np.abs(off) < 4 * found.standard_errors).all()
    assert abs(off[0]) < 0.05
    stiff = match(BLANK, board, q, bend_sigma=0.0)
    assert stiff.misfit > 2 * found.misfit


def test_derivatives_are_exact() -> None:
    truth = camera()
    evidence = Evidence(
        CLOUD, truth.project_world(CLOUD) + 3, 0.5, np.array(AXES, np.intp), ends(truth) + 1,
        truth.intrinsics[2:4] + 2, 10.0, 0.05,
    )  # fmt: skip
    free = np.ones(10, bool)
    values = np.array([*truth.intrinsics, -0.1, 0.02, 0.001, 0.002])
    truth = CameraModel("LENSMODEL_OPENCV4", values, SIZE, truth.world_from_camera)
    pose = truth.world_from_camera.inverse()
    here = linearise(truth, pose, evidence, free)
    for k in range(10):
        step = 1e-3 if k in (1, 2) else 1e-6
        change = np.zeros(10)
        change[k] = step
        values = truth.intrinsics * ([math.exp(change[0])] * 2 + [1.0] * 6)
        values[2:5] += change[[1, 2, 9]]
        turn = Pose.from_rotation_vector(change[3:6], np.zeros(3)).rotation
        moved = Pose(turn @ pose.rotation, turn @ pose.translation + change[6:9])
        there = linearise(CameraModel("LENSMODEL_OPENCV4", values, SIZE), moved, evidence, free)
        slope = (there.rows - here.rows) / step
        np.testing.assert_allclose(here.jacobian[:, k], slope, rtol=1e-3, atol=0.02)


@pytest.mark.parametrize("kind", ["rectangle", "box"])
def test_covariance_is_honest(kind: str) -> None:
    """Squared errors over the covariance follow chi-squared with 10 degrees of freedom.

    The principal point is off, too, and the lens bends, as far as it is believed.
    """
    rng = np.random.default_rng(2)
    distances: list[float] = []
    count = 8
    for _ in range(count):
        truth = camera()
        shift = rng.normal(0, 0.01 * SIZE[0], 2)
        corner = math.hypot(*SIZE) / 2 / truth.intrinsics[0]
        values = np.zeros(8)
        values[:5] = [*(truth.intrinsics + [0, 0, *shift]), rng.normal(0, 0.03) / corner**2]
        truth = CameraModel("LENSMODEL_OPENCV4", values, SIZE, truth.world_from_camera)
        if kind == "rectangle":
            q = truth.project_world(RECTANGLE) + rng.normal(0, 0.5, (4, 2))
            found = match(BLANK, RECTANGLE, q, above_floor=True)
        else:
            corners, lines = BOX[[0, 4]], ends(truth)
            q = truth.project_world(corners) + rng.normal(0, 0.5, (2, 2))
            noisy = lines + rng.normal(0, 0.5, lines.shape)
            found = match(BLANK, corners, q, axes=AXES, ends=noisy)
        error = errors(found, truth)
        distances.append(float(error @ np.linalg.solve(found.covariance, error)))
    # Three deviations of the mean.
    assert np.mean(distances) == pytest.approx(10, abs=3 * math.sqrt(20 / count))


def test_views_that_leave_it_open() -> None:
    rng = np.random.default_rng(0)
    above = Pose.look_at(np.array([0, 1.0, 0.001]), np.zeros(3), np.array([0, 0, -1.0]))
    frontal = CameraModel.pinhole(SIZE, 1.0).posed(above).project_world(RECTANGLE)
    for q in (frontal, frontal + rng.normal(0, 0.5, (4, 2))):
        with pytest.raises(UserError, match=r"focal length open.* plane that is tilted by \d+"):
            match(BLANK, RECTANGLE, q, above_floor=True)
    known = match(BLANK, RECTANGLE, frontal, above_floor=True, focal_known=True)
    np.testing.assert_allclose(known.camera.world_from_camera.translation[1], 1, atol=1e-3)


def test_a_wrong_point_is_named() -> None:
    """39 px among eight points, of which the fit shows 12 and hides the rest in the others."""
    truth, rng = camera(), np.random.default_rng(0)
    q = truth.project_world(CLOUD) + rng.normal(0, 0.5, (8, 2))
    assert match(BLANK, CLOUD, q).wrong == ()
    for k in (1, 5):
        wrong = q.copy()
        wrong[k] += [30, -25]
        with pytest.raises(UserError, match=rf"point {k + 1} lies \d\d\.\d px from where"):
            match(BLANK, CLOUD, wrong)


def test_mirrored_points_are_refused() -> None:
    """They fit a camera of 12000 px, to 88 %, that stands on the other side."""
    truth, rng = camera(), np.random.default_rng(0)
    q = truth.project_world(CLOUD) + rng.normal(0, 0.5, (8, 2))
    for points, pixels in (
        (CLOUD * [-1, 1, 1], q),
        (CLOUD, [0, SIZE[1] - 1] + q * [1, -1]),
    ):
        with pytest.raises(UserError, match="seen mirrored"):
            match(BLANK, points, np.asarray(pixels))


def test_clicks_that_leave_the_focal_length_open() -> None:
    """Points in another order: the misfit is in the standard errors, and those are refused."""
    q = camera().project_world(CLOUD)[[1, 0, 3, 2, 4, 5, 6, 7]]
    with pytest.raises(UserError, match=r"check (their|the) order"):
        match(BLANK, CLOUD, q)
    # few rows over: small residuals, open all the same
    near = CLOUD[:6] * [0.1, 0.1, 0.1]
    noise = np.random.default_rng(0).normal(0, 6, (6, 2))
    with pytest.raises(UserError, match="focal length open"):
        match(BLANK, near, camera().project_world(near) + noise)


def test_one_solution_is_told_once() -> None:
    """Steps along a flat valley end here and there: no other camera."""
    truth, rng = camera(), np.random.default_rng(1)
    for _ in range(12):
        points = rng.uniform(-0.2, 0.2, (5, 3))
        q = truth.project_world(points) + rng.normal(0, 0.5, (5, 2))
        assert match(BLANK, points, q).rivals == ()


def test_refusals() -> None:
    truth = camera()
    q, line = truth.project_world(RECTANGLE), ends(truth)
    for points, pixels, axes, lines, message in (
        (RECTANGLE[:3], q[:3], None, None, "3 points are too few"),
        (RECTANGLE, q[:3], None, None, "as many pixels, not 3"),
        (RECTANGLE, q + [2000, 0], None, None, "outside the picture of 1600x1200"),
        (RECTANGLE, q * np.nan, None, None, "must be finite"),
        (RECTANGLE, q[[0, 0, 2, 3]], None, None, "points 1 and 2 were clicked at the same"),
        (RECTANGLE, q[[0, 2, 1, 3]], None, None, "check their order"),
        (RECTANGLE, q[::-1], None, None, "below the floor"),
        (BOX[:1], q[:1], AXES, line, "click two points"),
        (BOX[:2], q[:2], [0, 0, 1], line[:3], "too few lines"),
        (BOX[:2], q[:2], [0, 0, 3], line[:3], "needs its axis"),
        (BOX[[0, 4]], truth.project_world(BOX[[0, 4]]), AXES, line[:, ::-1], "left-handed"),
    ):
        with pytest.raises(UserError, match=message):
            match(BLANK, points, pixels, axes=axes, ends=lines, above_floor=axes is None)


def test_refine_keeps_what_is_held() -> None:
    truth = camera()
    start = Pose.from_rotation_vector([0.02, 0, 0], [0.0, 0, 0.01]) @ (
        truth.world_from_camera.inverse()
    )
    fit = refine(truth, start, Evidence(CLOUD, truth.project_world(CLOUD)), POSE)
    assert fit is not None
    np.testing.assert_array_equal(fit.camera.intrinsics, truth.intrinsics)
    np.testing.assert_allclose(fit.rows, 0, atol=1e-6)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = camera()
    picture, output = tmp_path / "plate.png", tmp_path / "plate.cameramodel"
    write_picture(picture, np.full((SIZE[1], SIZE[0]), 90, np.uint8))
    corners = " ".join(f"{x:.4f},{y:.4f}" for x, y in truth.project_world(RECTANGLE))

    def run(*words: object) -> None:
        line = ["calibrate", "match", picture, "-o", output, *words]
        build_app()([str(w) for w in line], result_action="return_value")

    run("--rectangle", "0.6x0.4", "--corners", corners)
    assert "camera at 0.350, 0.500, 0.800 m" in capsys.readouterr().out
    found = CameraModel.read(output)
    np.testing.assert_allclose(found.intrinsics[:4], truth.intrinsics, rtol=1e-4)
    figures = read_json(f"{output}.record.json")["figures"]
    assert 0 < figures["sigma_focal_percent"] < 6
    points, lines = tmp_path / "points.csv", tmp_path / "lines.csv"
    rows = [
        (*p, *q) for p, q in zip(BOX[[0, 4]], truth.project_world(BOX[[0, 4]]), strict=True)
    ]
    points.write_text("x,y,z,u,v\n" + "\n".join(",".join(map(str, r)) for r in rows))
    # the first line written the other way round
    first, *rest = [(AXES[k], *e.ravel()) for k, e in enumerate(ends(truth))]
    turned = [("-" + "xyz"[first[0]], *first[3:], *first[1:3])]
    text = [*turned, *(("xyz"[r[0]], *r[1:]) for r in rest)]
    lines.write_text("axis,u1,v1,u2,v2\n" + "\n".join(",".join(map(str, r)) for r in text))
    run("--points", points, "--lines", lines, "--json")
    told = json.loads(capsys.readouterr().out)
    assert told["focal_px"] == pytest.approx(truth.intrinsics[0], rel=1e-5)
    assert told["line_residuals"] == pytest.approx([0] * 12, abs=1e-3)
    for words, message in (
        (["--corners", corners], "corners their --rectangle"),
        (["--rectangle", "0.6", "--corners", corners], "width x depth"),
        (["--rectangle", "0.6x0.4", "--corners", "1,2 3,4"], "2 corners were given"),
        (["--points", lines], "needs the first line x,y,z,u,v"),
        (["--points", points, "--focal", "known"], "needs the lens"),
        (["--points", tmp_path / "none.csv"], "no such file"),
        ([], r"picture alone tells no camera: .*--points.*--lines.*--rectangle.*--align"),
    ):
        with pytest.raises(UserError, match=message):
            run(*words)
