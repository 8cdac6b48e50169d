"""Shots to a panorama: place, overlap, vignetting, completion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong, of_camera
from chromeball.envmap.probe import (
    Shot,
    combine,
    rotation,
    vignetting_gain,
    world_from_shots,
)
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
    return Shot(radiance, LENS)


def turned(shot: Shot, yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Shot:
    return Shot(shot.radiance, shot.camera, yaw, pitch, roll)


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
    assert result.missing == pytest.approx(0, abs=1e-4)
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
    blank = Shot(np.zeros((400, 400, 3), np.float32), LENS)
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
    gain = vignetting_gain(LENS, [c1, c2])
    y, x = 199, 330
    r = math.hypot(x - 199.5, y - 199.5) / 200
    assert gain[y, x] == pytest.approx(1 / (1 + c1 * r**2 + c2 * r**4), rel=1e-9)
    dimmed = Shot((shot.radiance / gain[..., None]).astype(np.float32), LENS)
    turns = world_from_shots([shot])
    plain, mended = combine([shot], turns, 128), combine([dimmed], turns, 128, [c1, c2])
    np.testing.assert_allclose(mended.radiance, plain.radiance, rtol=1e-4)


def test_bad_vignetting() -> None:
    with pytest.raises(UserError, match="vignetting falls"):
        vignetting_gain(LENS, [-2.0])
    with pytest.raises(UserError, match="image circle"):
        vignetting_gain(CameraModel.pinhole((64, 48), 1.0), [0.1])


def test_the_unseen_part_is_marked_and_sober() -> None:
    """A grey world with a lamp at the rim: the lamp is not smeared around the back."""
    mapping = of_camera(LENS).turned(WORLD_FROM_LATLONG.rotation)
    d = np.nan_to_num(mapping.directions())
    elevation = np.full((400, 400, 3), 1.0, np.float32) + (d[..., 1:2] > 0)
    elevation[d @ np.array([1, 0.1, 0]) > 0.99] = 500
    shot = Shot(elevation.astype(np.float32), LENS)
    result = combine([shot], world_from_shots([shot]), 256)
    world = LatLong((256, 128)).directions()
    back = world[..., 2] < -0.2
    assert (result.alpha[back] == 0).all()
    assert result.missing == pytest.approx(
        2 * math.pi * (1 - math.sin(math.radians(5))), rel=0.01
    )
    up, down = back & (world[..., 1] > 0.4), back & (world[..., 1] < -0.4)
    np.testing.assert_allclose(result.radiance[up], 2, rtol=1e-5)
    np.testing.assert_allclose(result.radiance[down], 1, rtol=1e-5)
    assert result.radiance[back].max() < 2.01
    assert 0 < result.completed_share < 0.5
    assert np.isfinite(result.radiance).all()
