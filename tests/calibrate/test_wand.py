"""Cameras from moving lights: truth, honest errors, refusals; virtual and real sets."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.virtual_wand import path, room, watch
from chromeball.calibrate.wand import solve_wand
from chromeball.calibrate.wand_files import read_lens, read_points
from chromeball.calibrate.wand_lens import candidate, learned, unknown
from chromeball.calibrate.wand_result import Tracks, WandRig
from chromeball.calibrate.wand_world import as_surveyed, on_floor, upright
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

DATA = Path(__file__).resolve().parents[3] / (
    "shared/data/calibrate/multicamselfcal/strawlab/test-data"
)


def centre_error(rig: WandRig, truth: list[CameraModel]) -> float:
    """RMS distance of the centres from the truth, mm, the best similarity taken out."""
    return 1000 * as_surveyed(rig, centres(truth))[1].rms


def centres(cameras: list[CameraModel]) -> NDArray[np.float64]:
    return np.array([c.world_from_camera.translation for c in cameras])


@pytest.mark.parametrize(("outliers", "bar"), [(0.03, 0.4), (0.4, 0.7)])
def test_given_lenses(outliers: float, bar: float) -> None:
    cameras = room(5, seed=5)
    tracks = watch(cameras, path(500, extent=1.2, seed=5), outliers=outliers, seed=1)
    rig = solve_wand(tracks, tuple(cameras))
    assert centre_error(rig, cameras) < bar
    assert rig.sigma == pytest.approx(0.3, rel=0.07)
    assert rig.synchronous
    assert rig.unit == "distance of cam0 and cam1"
    assert np.linalg.norm(rig.centres[1] - rig.centres[0]) == pytest.approx(1)
    np.testing.assert_allclose(rig.cameras[0].world_from_camera.matrix(), np.eye(4), atol=1e-12)
    assert "distance to cam1" in rig.gauge()
    # Most sightings that are wrong are told so, few right ones are.
    assert abs(rig.outliers.mean() - outliers) < 0.05


def test_fisheye_among_others() -> None:
    """A fisheye of 190 degrees in the middle of the room sees lights beyond 90 degrees."""
    fisheye = CameraModel(
        "kb4", np.array([290.0, 291, 650, 470, -0.02, 0.01, -0.004, 0.0006]), (1280, 960),
        Pose.look_at(np.array([0.0, 0.2, 0]), np.array([0, 1.2, 0.0]), np.array([0.0, 0, 1])),
        math.radians(95),
    )  # fmt: skip
    cameras = [*room(3, seed=2), fisheye]
    points = path(400, extent=1.2, seed=2)
    tracks = watch(cameras, points, outliers=0.05, seed=2)
    axis = fisheye.world_from_camera.rotation[:, 2]
    seen = points[tracks.seen()[3], 0] - fisheye.world_from_camera.translation
    assert (seen @ axis / np.linalg.norm(seen, axis=1)).min() < 0.05
    rig = solve_wand(tracks, tuple(cameras))
    assert centre_error(rig, cameras) < 1.0
    assert rig.camera_rms().max() < 0.45


def test_wand_gives_scale_and_lenses() -> None:
    """Two lights whose order nobody knows: scale, focal lengths and distortion."""
    cameras = room(4, seed=3, distortion=(-0.2, 0.05))
    points = path(300, extent=1.2, lights=2, length=0.5, seed=3)
    tracks = watch(cameras, points, outliers=0.03, seed=3)
    rig = solve_wand(tracks, lengths=((0, 1, 0.5),))
    assert rig.unit == "m"
    assert centre_error(rig, cameras) < 2.0
    between = np.linalg.norm(rig.centres[2] - rig.centres[0])
    truth = np.linalg.norm(centres(cameras)[2] - centres(cameras)[0])
    assert between == pytest.approx(truth, rel=1e-3)
    for found, camera, errors in zip(rig.cameras, cameras, rig.lens_errors, strict=True):
        off = np.abs(found.intrinsics - camera.intrinsics)
        assert (off < 4.5 * errors + 1e-9).all()
        assert errors[0] < 1.0


def test_principal_points_teach_each_other() -> None:
    """Offsets no larger than their errors hold the centres in the middle; large ones do not."""
    cameras = tuple(candidate("opencv4", (1000, 800), 1.0) for _ in range(6))
    start = unknown(cameras)
    errors = tuple(np.full(8, 2.0) for _ in cameras)
    before = start.precision[0][2]
    for offset, least, most in ((1.0, 0.5, 1.3), (12.0, 10.0, 13.0)):
        sign = np.array([0, 0, 1.0, -1, 0, 0, 0, 0])
        moved = tuple(
            replace(c, intrinsics=c.intrinsics + (-1) ** i * offset * sign)
            for i, c in enumerate(cameras)
        )
        after = learned(start, moved, errors).precision[0]
        assert after[2] > before
        assert least < after[2] ** -0.5 < most
        assert after[4] == start.precision[0][4]


def test_three_lights_know_their_ends() -> None:
    cameras = room(3, seed=4)
    points = path(200, extent=1.0, lights=3, length=0.6, seed=4)
    along = points[:, 2] - points[:, 0]
    points[:, 1] = points[:, 0] + along / 3
    tracks = watch(cameras, points, seed=4)
    rig = solve_wand(tracks, tuple(cameras), lengths=((0, 1, 0.2), (1, 2, 0.4), (0, 2, 0.6)))
    assert centre_error(rig, cameras) < 1.0
    near = np.linalg.norm(rig.points[:, 1] - rig.points[:, 0], axis=-1)
    np.testing.assert_allclose(near[np.isfinite(near)], 0.2, atol=2e-4)


def test_delays() -> None:
    """Cameras that are not synchronous: constant delays of up to two frames."""
    cameras = room(3, seed=6)
    late = np.array([0, 1.3, -0.4])
    fine = path(4000, extent=1.2, pace=0.05, seed=6)
    tracks = watch(cameras, fine[:10], seed=6)
    rng = np.random.default_rng(0)
    frames = np.arange(50, 380)
    pixels = np.array(
        [
            camera.project_world(fine[10 * frames + round(10 * d)])
            for camera, d in zip(cameras, late.tolist(), strict=True)
        ]
    )
    pixels += 0.3 * rng.standard_normal(pixels.shape)
    tracks = Tracks(tracks.names, tracks.sizes, pixels, np.ones(pixels.shape[:3]))
    rig = solve_wand(tracks, tuple(cameras))
    assert (np.abs(rig.delays - late)[1:] < 4 * rig.delay_errors[1:]).all()
    assert rig.delay_errors[1:].max() < 0.01
    assert centre_error(rig, cameras) < 1.0
    assert solve_wand(tracks, tuple(cameras), synchronous=True).sigma > 3 * rig.sigma


def test_errors_are_honest() -> None:
    """Centres and turns from sampled noise are as far off as they say: ratio .8 to 1.2.

    24 draws x 3 cameras x 6, correlated within a camera: the ratio's own deviation is 5 %.
    """
    cameras = room(4, seed=7)
    points = path(80, extent=1.2, seed=7)
    reference = cameras[0].world_from_camera
    scale = float(np.linalg.norm(centres(cameras)[1] - centres(cameras)[0]))
    ratios: list[NDArray[np.float64]] = []
    for seed in range(24):
        tracks = watch(cameras, points, seed=100 + seed)
        rig = solve_wand(tracks, tuple(cameras), synchronous=True)
        for c in range(1, 4):
            truth = reference.inverse() @ cameras[c].world_from_camera
            place = rig.centres[c] - truth.translation / scale
            turn = truth.rotation.T @ rig.cameras[c].world_from_camera.rotation
            vector = Pose(turn, np.zeros(3)).rotation_vector()
            off = np.concatenate([vector, place])
            if c == 1:  # its distance counts as exact
                values, axes = np.linalg.eigh(rig.covariance[c])
                off = axes[:, 1:].T @ off
                ratios.append(off**2 / values[1:])
            else:
                ratios.append(off @ np.linalg.solve(rig.covariance[c], off) / 6 * np.ones(6))
    assert 0.8 < math.sqrt(float(np.mean(np.concatenate(ratios)))) < 1.2


def test_axes() -> None:
    cameras = room(3, seed=8)
    points = path(120, extent=1.0, seed=8)
    points[[3, 50, 90], 0] = [[0, 0, 0], [0.8, 0, 0], [0.2, 0, 0.9]]
    tracks = watch(cameras, points, noise=0.02, seed=8)
    rig = solve_wand(
        tracks, tuple(cameras),
        distance=(0, 1, float(np.linalg.norm(np.diff(centres(cameras)[:2], axis=0)))),
    )  # fmt: skip
    floor = on_floor(rig, (3, 50, 90))
    assert floor.unit == "m"
    # x along, y up to the cameras: the axes that the points were made in.
    np.testing.assert_allclose(floor.centres, centres(cameras), atol=2e-3)
    level = upright(rig).cameras[0].world_from_camera
    np.testing.assert_allclose(level.rotation @ [0, -1, 0], [0, 1, 0], atol=1e-12)
    moved = rig.moved(Pose.look_at([1.0, 2, 3], [0.0, 0, 0]), 2.0)
    np.testing.assert_allclose(moved.sigma_rotation, rig.sigma_rotation)
    size = [np.linalg.norm(r.sigma_position[2]) for r in (moved, rig)]
    assert size[0] == pytest.approx(2 * size[1])
    with pytest.raises(UserError, match="must not lie in a line"):
        on_floor(rig, (3, 50, 50))
    with pytest.raises(UserError, match="from 0 to 119"):
        on_floor(rig, (3, 50, 120))


def test_surveyed_centres() -> None:
    """What fits is told; another order, mirrored axes and a wrong line are named."""
    cameras = room(6, seed=5)
    truth = centres(cameras)
    rig = solve_wand(watch(cameras, path(120, seed=5), noise=0.02, seed=5), tuple(cameras))
    moved, survey = as_surveyed(rig, truth)
    np.testing.assert_allclose(moved.centres, truth, atol=2e-3)
    assert survey.rms < 1e-3
    assert survey.doubtful is None
    np.testing.assert_allclose(survey.rms, np.sqrt((survey.misses**2).mean()))

    off = truth.copy()
    off[4, 0] += 0.15  # not the most central: 5 % of the rig's radius, told but taken
    doubted = as_surveyed(rig, off)[1]
    assert doubted.doubtful == 4
    assert doubted.misses.argmax() == 4
    off[4, 0] += 2
    for given, message in (
        (off, "all but cam4 fit"),
        (truth[[1, 0, 2, 3, 4, 5]], "another order: line 2 is cam0's, line 1 is cam1's"),
        (truth * [1, 1, -1], "mirrored"),
        (np.random.default_rng(1).normal(size=(6, 3)), "in this order"),
    ):
        with pytest.raises(UserError, match=message):
            as_surveyed(rig, given)


def test_in_step() -> None:
    """Delays of a few thousandths of a frame are not told as cameras out of step."""
    cameras = room(3, seed=4)
    rig = solve_wand(watch(cameras, path(60, seed=4), noise=0.02, seed=4), tuple(cameras))
    assert replace(rig, delays=np.array([0, 0.006, -0.005])).synchronous
    assert not replace(rig, delays=np.array([0, 0.06, -0.005])).synchronous


def refused(tracks: Tracks, cameras: list[CameraModel], **options: Any) -> str:
    with pytest.raises(UserError) as caught:
        solve_wand(tracks, tuple(cameras), **options)
    return str(caught.value)


def test_refusals() -> None:
    cameras = room(4, seed=9)
    points = path(150, extent=1.0, seed=9)
    tracks = watch(cameras, points, seed=9)

    apart = tracks.pixels.copy()
    apart[:2, 75:], apart[2:, :75] = np.nan, np.nan
    message = refused(replace(tracks, pixels=apart), cameras)
    assert "2 groups that no light connects: cam0, cam1; cam2, cam3" in message

    few = tracks.pixels.copy()
    few[2, 5:] = np.nan
    assert "cam2 saw the light in" in refused(replace(tracks, pixels=few), cameras)

    line = points[:, :, :1] * np.array([1.0, 0.3, 0.5]) + np.array([0, 1.2, 0])
    assert "line" in refused(watch(cameras, line, seed=9), cameras)
    plane = points * np.array([1.0, 0, 1]) + np.array([0, 1.2, 0])
    assert "plane" in refused(watch(cameras, plane, seed=9), cameras)

    there = cameras[0].world_from_camera
    turned = [
        c.posed(there @ Pose.from_rotation_vector([0.02 * i, 0.03 * i, 0.1 * i], np.zeros(3)))
        for i, c in enumerate(cameras)
    ]
    assert "different places" in refused(watch(turned, points, seed=9), turned)

    twice = tracks.pixels.copy()
    twice[2] = twice[1] + np.random.default_rng(1).normal(0, 0.2, twice[1].shape)
    message = refused(replace(tracks, pixels=twice), cameras)
    assert "cam1 and cam2 show the light at the same pixels" in message

    strange = tracks.pixels.copy()
    strange[3] = np.random.default_rng(1).permutation(strange[3])
    assert "cam3 cannot be placed beside" in refused(replace(tracks, pixels=strange), cameras)

    assert "two or more" in refused(
        Tracks(("a",), ((9, 9),), tracks.pixels[:1], tracks.errors[:1]), cameras[:1]
    )
    assert "as many lenses, not 2" in refused(tracks, cameras[:2])
    assert "same order" in refused(tracks, [cameras[0].scaled(0.5), *cameras[1:]])


def test_lenses_in_the_wrong_order() -> None:
    """Very different lenses swapped: refused."""
    cameras = [*room(2, seed=1), *room(2, seed=2, fov=0.5)]
    cameras = [
        c.posed(p.world_from_camera) for c, p in zip(cameras, room(4, seed=3), strict=True)
    ]
    tracks = watch(cameras, path(300, extent=0.6, seed=3), seed=3)
    with pytest.raises(UserError, match="better with other lenses"):
        solve_wand(tracks, (cameras[3], cameras[1], cameras[2], cameras[0]))


@pytest.mark.skipif(not DATA.is_dir(), reason="the real sets are not here")
def test_real_set_given() -> None:
    """.31 px is pycolmap's; the centres agree with the owner's to .022 of their unit."""
    folder = DATA / "caldata20130726_122220"
    tracks = read_points(folder)
    lenses = [read_lens(folder / f"basename{i + 1}.rad", tracks.sizes[i]) for i in range(4)]
    rig = solve_wand(tracks, tuple(lenses))
    assert rig.rms < 0.26
    assert rig.outliers.sum() < 0.08 * tracks.seen().sum()
    truth = np.loadtxt(folder / "original_cam_centers.dat")
    assert as_surveyed(rig, truth)[1].rms < 0.023


@pytest.mark.skipif(not DATA.is_dir(), reason="the real sets are not here")
def test_real_set_blind() -> None:
    """Strong distortion, nothing known: the lenses that were measured otherwise."""
    folder = DATA / "caldata20130726_122220"
    tracks = read_points(folder)
    rig = solve_wand(tracks, synchronous=True)
    assert rig.rms < 0.16
    for i, camera in enumerate(rig.cameras):
        lens = read_lens(folder / f"basename{i + 1}.rad", tracks.sizes[i])
        focal = float(lens.intrinsics[:2].mean())
        assert camera.intrinsics[0] == pytest.approx(focal, rel=0.03)
