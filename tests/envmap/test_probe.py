"""Shots to a panorama: place, overlap, vignetting, completion."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.envmap.ball import BallCamera
from chromeball.envmap.complete import from_border, from_plate, ground
from chromeball.envmap.mapping import LatLong, Lens, of_camera, pixel_grid
from chromeball.envmap.probe import (
    Shot,
    combine,
    refined,
    rotation,
    trimmed,
    vignetting_gain,
    without_vignetting,
    world_from_shots,
)
from chromeball.envmap.refine_lens import refine_lenses
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.errors import UserError

LENS = CameraModel.fisheye("equisolid", (400, 400), math.radians(190))


def world_radiance(d: NDArray[np.float64]) -> NDArray[np.float32]:
    x, y, z = np.moveaxis(np.nan_to_num(d), -1, 0)
    return np.stack([2 + x, 2 + np.sin(3 * y), 2 + z * x], axis=-1).astype(np.float32)


def photograph(turn: NDArray[np.float64], sun: NDArray[np.float64] | None = None) -> Shot:
    mapping = of_camera(LENS).turned(turn)
    d = np.nan_to_num(mapping.directions())
    radiance = world_radiance(d)
    if sun is not None:
        radiance[d @ sun > math.cos(math.radians(0.8))] = 1e5
    return Shot(radiance, of_camera(LENS))


def turned(shot: Shot, yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Shot:
    return replace(shot, yaw=yaw, pitch=pitch, roll=roll)


def test_two_shots_make_the_world() -> None:
    base = WORLD_FROM_LATLONG.rotation
    shots = [
        turned(photograph(base), 0.0),
        turned(photograph(rotation(math.pi, 0.0, 0.0) @ base), math.pi),
    ]
    result = combine(shots, world_from_shots(shots), 256)
    truth = world_radiance(LatLong((256, 128)).directions())
    assert result.alpha.min() == pytest.approx(1)
    assert np.sqrt(np.mean((result.radiance - truth) ** 2)) < 0.01
    (overlap,) = result.overlaps
    assert overlap.ratio == pytest.approx(1, abs=0.01)
    assert overlap.spread < 0.02
    # the zone between 85 and 95 degrees, less the rim's own pixels
    assert overlap.solid_angle == pytest.approx(
        4 * math.pi * math.sin(math.radians(5)), rel=0.3
    )
    assert max(abs(e) for e in result.energy_error) < 1e-3


@pytest.mark.parametrize("angle", [60, 86, 89, 90, 92, 94])
def test_a_sun_in_the_overlap_keeps_its_energy(angle: float) -> None:
    """Both shots see it: as much as either, whatever the weights."""
    base, t = WORLD_FROM_LATLONG.rotation, math.radians(angle)
    sun = np.array([math.sin(t) * 0.8, math.sin(t) * 0.6, math.cos(t)])
    turns = [base, rotation(math.pi, 0.0, 0.0) @ base]
    shots = [turned(photograph(turns[0], sun), 0.0), turned(photograph(turns[1], sun), math.pi)]
    result = combine(shots, world_from_shots(shots), 512)
    solid = LatLong((512, 256)).solid_angles()
    near = LatLong((512, 256)).directions() @ sun > math.cos(math.radians(3))
    energy = (result.radiance[..., 0] * solid)[near].sum()
    # what the pixels of either shot hold: the disc of 0.8 degrees lights only a dozen of them
    held: list[float] = []
    for turn in turns:
        source = of_camera(LENS).turned(turn)
        lit = np.nan_to_num(source.directions()) @ sun > math.cos(math.radians(0.8))
        if lit.any():
            held.append(1e5 * float(source.solid_angles()[lit].sum()))
    assert len(held) == (2 if angle > 85.5 else 1)
    assert 0.995 * min(held) < energy < 1.005 * max(held)


def test_tilted_shots_and_alignment_of_the_second() -> None:
    """Three shots with yaw, pitch and roll, in a world that only shot 1 was aligned to."""
    base = WORLD_FROM_LATLONG.rotation
    angles = [(0.3, 0.1, -0.2), (2.4, -0.15, 0.05), (-1.9, 0.2, 0.1)]
    blank = Shot(np.zeros((400, 400, 3), np.float32), of_camera(LENS))
    world = rotation(0.8, 0.0, 0.0)  # the world's axes are turned about the vertical
    poses = [
        world @ rotation(yaw, 0.0, 0.0) @ base @ base.T @ rotation(0.0, pitch, roll) @ base
        for yaw, pitch, roll in angles
    ]
    shots = [turned(photograph(p), *a) for p, a in zip(poses, angles, strict=True)]
    got = world_from_shots(shots, 1, poses[1])
    for expected, found in zip(poses, got, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    result = combine(shots, got, 200)
    truth = world_radiance(LatLong((200, 100)).directions())
    seen = result.alpha > 0.999
    assert seen.mean() > 0.95
    assert np.abs(result.radiance - truth)[seen].max() < 0.05
    assert len(result.overlaps) == 3
    # pitch up and roll clockwise, as the words say
    looks = world_from_shots([turned(blank, 0.0, 0.3)])[0] @ [0, 0, 1]
    assert looks[1] == pytest.approx(math.sin(0.3))
    right = world_from_shots([turned(blank, 0.0, 0.0, 0.2)])[0] @ [1, 0, 0]
    assert right[1] == pytest.approx(-math.sin(0.2))


def test_vignetting_is_divided_out() -> None:
    c1, c2 = 0.17, -0.52
    shot = photograph(WORLD_FROM_LATLONG.rotation)
    gain = vignetting_gain(of_camera(LENS), [c1, c2])
    y, x = 199, 330
    r = math.hypot(x - 199.5, y - 199.5) / 200
    assert gain[y, x] == pytest.approx(1 / (1 + c1 * r**2 + c2 * r**4), rel=1e-9)
    dimmed = Shot((shot.radiance / gain[..., None]).astype(np.float32), of_camera(LENS))
    turns = world_from_shots([shot])
    plain = combine([shot], turns, 128)
    mended = combine([without_vignetting(dimmed, [c1, c2])], turns, 128)
    np.testing.assert_allclose(mended.radiance, plain.radiance, rtol=1e-4)


def test_noise_is_carried_with_the_light() -> None:
    """Sigma of the map is the scatter of many maps; half where two shots see the same."""
    rng = np.random.default_rng(0)
    lens = of_camera(CameraModel.fisheye("equisolid", (64, 64), 3.8))
    even = np.ones((64, 64, 3), np.float32)
    shots = [Shot(even, lens, yaw) for yaw in (0.0, math.pi)]
    level = np.full((64, 64, 3), 0.1, np.float32) * [0.5, 1, 2]
    turns = world_from_shots(shots)
    told = combine([replace(s, sigma=level.astype(np.float32)) for s in shots], turns, 64)
    assert told.sigma is not None

    def noisy(shot: Shot) -> Shot:
        return replace(shot, radiance=(even + rng.normal(size=even.shape) * level).astype("f4"))

    many = [combine([noisy(s) for s in shots], turns, 64).radiance for _ in range(100)]
    seen = told.alpha > 0.99
    ratio = np.std(many, axis=0)[seen] / told.sigma[seen]
    # neighbours are correlated by the spline: the mean of variances is compared
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1, abs=0.1)
    assert combine(shots, turns, 64).sigma is None


def test_bad_vignetting() -> None:
    with pytest.raises(UserError, match="vignetting falls"):
        vignetting_gain(of_camera(LENS), [-2.0])
    with pytest.raises(UserError, match="image circle"):
        vignetting_gain(of_camera(CameraModel.pinhole((64, 48), 1.0)), [0.1])


def test_the_unseen_part_is_marked_and_sober() -> None:
    """A grey world with a lamp at the rim: the lamp is not smeared around the back."""
    mapping = of_camera(LENS).turned(WORLD_FROM_LATLONG.rotation)
    d = np.nan_to_num(mapping.directions())
    elevation = np.full((400, 400, 3), 1.0, np.float32) + (d[..., 1:2] > 0)
    elevation[d @ np.array([1, 0.1, 0]) > 0.99] = 500
    shot = Shot(elevation.astype(np.float32), of_camera(LENS))
    result = combine([shot], world_from_shots([shot]), 256)
    world, solid = LatLong((256, 128)).directions(), LatLong((256, 128)).solid_angles()
    missing = result.alpha == 0
    assert (result.radiance[missing] == 0).all()
    filled = from_border(result.radiance, missing)
    np.testing.assert_array_equal(filled, missing)
    back = world[..., 2] < -0.2
    assert (result.alpha[back] == 0).all()
    unseen = float((solid * (1 - result.alpha)).sum())
    assert unseen == pytest.approx(2 * math.pi * (1 - math.sin(math.radians(5))), rel=0.01)
    up, down = back & (world[..., 1] > 0.4), back & (world[..., 1] < -0.4)
    np.testing.assert_allclose(result.radiance[up], 2, rtol=1e-5)
    np.testing.assert_allclose(result.radiance[down], 1, rtol=1e-5)
    assert result.radiance[back].max() < 2.01
    assert np.isfinite(result.radiance).all()


@functools.cache
def blobs() -> NDArray[np.float32]:
    """A lat-long with something to see everywhere, (512, 1024)."""
    rng = np.random.default_rng(5)
    d = LatLong((1024, 512)).directions().reshape(-1, 3).astype(np.float32)
    log = np.zeros(len(d), np.float32)
    for _ in range(150):
        centre = rng.normal(size=3).astype(np.float32)
        width, level = rng.uniform(0.03, 0.25), np.float32(rng.uniform(-0.7, 0.9))
        log += level * np.exp(
            (d @ (centre / np.linalg.norm(centre)) - 1) / np.float32(width**2)
        )
    return np.exp(log).reshape(512, 1024)


def detail(d: NDArray[np.float64]) -> NDArray[np.float32]:
    """The world of blobs in directions (H, W, 3)."""
    q = np.nan_to_num(LatLong((1024, 512)).pixels_of(np.nan_to_num(d))).astype(np.float32)
    wide = np.concatenate([blobs()[:, -2:], blobs(), blobs()[:, :2]], axis=1)
    grey = cv2.remap(
        wide, q[..., 0] + 2, q[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(grey, np.float32)[..., None] * np.array([1, 0.9, 0.8], np.float32)


def angle_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return math.degrees(math.acos(min(1.0, (float(np.trace(a @ b.T)) - 1) / 2)))


@pytest.mark.parametrize("fov", [190, 210])
def test_hemispheres_are_turned_until_they_agree(fov: float) -> None:
    """Shot 1 is 3 degrees off its nominal place and a third darker; both have vignetting."""
    lens = of_camera(CameraModel.fisheye("equisolid", (300, 300), math.radians(fov)))
    base = WORLD_FROM_LATLONG.rotation
    off = rotation(0.03, -0.035, 0.025)
    poses = [base, off @ rotation(math.pi, 0.0, 0.0) @ base]
    fall_off = vignetting_gain(lens, [-0.3]).astype(np.float32)
    shots = [
        Shot(detail(lens.turned(pose).directions()) * gain / fall_off[..., None], lens, yaw)
        for pose, gain, yaw in zip(poses, (1, np.float32(0.67)), (0.0, math.pi), strict=True)
    ]
    nominal = world_from_shots(shots)
    assert angle_between(nominal[1], poses[1]) > 2.9
    turns, found = refined(shots, nominal)
    assert found.reason == ""
    left = angle_between(turns[1], poses[1])
    assert left < 0.06
    assert left < 4 * math.degrees(found.sigma[1])
    np.testing.assert_array_equal(turns[0], poses[0])
    if fov > 200:  # the other one may be held instead: the same, turned back
        again, _ = refined(shots, nominal, fixed=1)
        np.testing.assert_allclose(again[1], nominal[1], atol=1e-12)
        np.testing.assert_allclose(again[1].T @ again[0], turns[1].T @ turns[0], atol=1e-9)


def test_an_overlap_that_proves_nothing_changes_nothing() -> None:
    lens = of_camera(CameraModel.fisheye("equisolid", (200, 200), math.radians(190)))
    rng = np.random.default_rng(1)
    base = WORLD_FROM_LATLONG.rotation
    noise = [rng.uniform(0.5, 1.5, (200, 200, 1)) * np.ones(3) for _ in range(2)]
    for pictures in ([np.full((200, 200, 3), 2.0)] * 2, noise):
        shots = [
            Shot(picture.astype(np.float32), lens, yaw)
            for picture, yaw in zip(pictures, (0.0, math.pi), strict=True)
        ]
        nominal = world_from_shots(shots)
        turns, found = refined(shots, nominal)
        assert found.reason
        np.testing.assert_array_equal(turns, nominal)
    narrow = of_camera(CameraModel.fisheye("equisolid", (100, 100), math.radians(150)))
    apart = [Shot(np.ones((100, 100, 3), np.float32), narrow, yaw) for yaw in (0.0, math.pi)]
    assert "overlap" in refined(apart, [base, rotation(math.pi, 0.0, 0.0) @ base])[1].reason


def photographed_ball(pose: NDArray[np.float64], distance: float) -> Shot:
    """A photograph of a ball by ray tracing, the photographer black in it."""
    camera = CameraModel.pinhole((600, 600), math.radians(12))
    middle = np.array([0.01, -0.006, 1.0]) / np.linalg.norm([0.01, -0.006, 1.0])
    ball, part = BallCamera(camera, middle, distance).cut_out()
    size = (part[1].stop - part[1].start, part[0].stop - part[0].start)
    fine = 3  # sub-samples a side
    total = np.zeros((size[1], size[0], 3), np.float32)
    for j in range(fine):
        for i in range(fine):
            offset = (np.array([i, j]) + 0.5) / fine - 0.5
            d = ball.unproject(pixel_grid(size) + offset)
            seen = detail(d @ pose.T)
            seen[np.nan_to_num(d) @ -middle > math.cos(math.radians(15))] = 0.01
            total += seen / fine**2
    return Shot(total, Lens(size, camera=ball), photographer=math.radians(16))


def test_two_mirror_balls_make_the_world() -> None:
    """P14b: at a finite distance, 90 degrees apart, one of them 3 degrees off its place."""
    base = WORLD_FROM_LATLONG.rotation
    poses = [base, rotation(0.03, 0.03, -0.02) @ rotation(math.pi / 2, 0.0, 0.0) @ base]
    shots = [photographed_ball(pose, 12.0) for pose in poses]
    shots[1] = turned(shots[1], math.pi / 2)
    nominal = world_from_shots(shots)
    turns, found = refined(shots, nominal)
    assert found.reason == ""
    assert angle_between(turns[1], poses[1]) < 0.1
    result = combine(shots, turns, 256)
    assert result.alpha.min() > 0.99  # each fills the other's photographer and shadow
    truth = detail(LatLong((256, 128)).directions())
    error = np.abs(result.radiance / truth - 1)
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.99) < 0.15
    (overlap,) = result.overlaps
    assert overlap.ratio == pytest.approx(1, abs=0.01)
    assert overlap.spread < 0.05


def test_ground_is_lit_by_what_was_seen() -> None:
    """An even sky of radiance 2: E = 2 pi, so that ground of 0.3 has radiance 0.6."""
    up = LatLong((128, 64)).directions()[..., 1]
    radiance = np.where((up > 0)[..., None], np.float32(2), np.float32(0)) * np.ones(
        3, np.float32
    )
    missing = up <= 0
    filled = ground(radiance, missing, np.array([0.3, 0.2, 0.1]), ~missing)
    np.testing.assert_array_equal(filled, missing & (up < 0))
    np.testing.assert_allclose(
        radiance[up < 0],
        2 * np.array([[0.3, 0.2, 0.1]]) * np.ones(((up < 0).sum(), 1)),
        rtol=1e-3,
    )


def test_a_photograph_fills_what_it_sees() -> None:
    camera = CameraModel.pinhole((200, 150), math.radians(60))
    mapping = of_camera(camera).turned(rotation(2.0, -0.2, 0.0) @ WORLD_FROM_LATLONG.rotation)
    target = LatLong((256, 128))
    truth = world_radiance(target.directions())
    radiance, missing = truth.copy(), target.directions()[..., 2] < 0
    radiance[missing] = 0
    plate = (world_radiance(mapping.directions()) / 2).astype(np.float32)
    filled, ratio = from_plate(radiance, missing, plate, mapping)
    assert 0.02 < filled.mean() < 0.2
    assert (filled <= missing).all()
    np.testing.assert_allclose(radiance[filled], truth[filled] / 2, rtol=0.01)
    assert ratio == pytest.approx(2, rel=0.01)


def test_a_soft_rim_is_trimmed() -> None:
    shot = photograph(WORLD_FROM_LATLONG.rotation)
    less = trimmed(shot, math.radians(3))
    result = combine([less], world_from_shots([shot]), 256)
    solid = LatLong((256, 128)).solid_angles()
    seen = float((solid * result.alpha).sum())
    assert seen == pytest.approx(2 * math.pi * (1 - math.cos(math.radians(92))), rel=0.003)
    with pytest.raises(UserError, match="cannot lose"):
        trimmed(shot, math.radians(60))


def test_a_lens_is_refined_from_the_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Said to be 190 degrees and centred; it is 201, its circles off by two pixels of 180."""
    truth = CameraModel.fisheye(
        "equidistant", (180, 180), math.radians(201), centre=(91.0, 88.0), radius=86.5
    )
    said = CameraModel.fisheye(
        "equidistant", (180, 180), math.radians(190), centre=(89.5, 89.5), radius=86.5
    )
    base = WORLD_FROM_LATLONG.rotation
    poses = [base, rotation(0.02, -0.01, 0.015) @ rotation(math.pi, 0.0, 0.0) @ base]
    shots = [
        Shot(detail(of_camera(truth).turned(pose).directions()), of_camera(said), yaw)
        for pose, yaw in zip(poses, (0.0, math.pi), strict=True)
    ]
    monkeypatch.setattr("chromeball.envmap.refine_lens._COARSE", 192)  # small pictures
    found = refine_lenses(shots, world_from_shots(shots))
    assert math.degrees(found.fov) == pytest.approx(201, abs=0.5)
    assert abs(math.degrees(found.fov) - 201) < 4 * math.degrees(found.fov_sigma)
    # a shift of both circles and a turn look alike on the ring: what both give is compared
    result = combine(found.shots, found.rotations, 256)
    (overlap,) = result.overlaps
    assert overlap.spread < 0.1
    assert found.correlation > 0.95


def test_a_lens_without_an_overlap_is_refused() -> None:
    narrow = of_camera(CameraModel.fisheye("equisolid", (100, 100), math.radians(120)))
    shots = [Shot(np.ones((100, 100, 3), np.float32), narrow, yaw) for yaw in (0.0, math.pi)]
    with pytest.raises(UserError, match="cannot be refined"):
        refine_lenses(shots, world_from_shots(shots))
    with pytest.raises(UserError, match="two shots"):
        refine_lenses(shots[:1], world_from_shots(shots[:1]))
