"""Frames against a map: what changed is found, whatever moves; the map follows."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from bench import virtual_room as room
from chromeball.cli.main import build_app
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.predict import Comparison, Frame, compare, misplaced, predict
from chromeball.envmap.robust import Blocks, fit
from chromeball.envmap.several import ProbeMap
from chromeball.envmap.update import (
    Change,
    find_change,
    ratio_map,
    regions,
    strange,
    typical_error,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json
from chromeball.stand_in.ply import write_stand_in
from tests.envmap.set import CAST, LEFT, panorama, photograph

#: A map far from everything: clouds, a wall of windows, a lamp.
WIDE = LatLong((256, 128))
EYE = CameraModel.pinhole((160, 120), math.radians(75))


def sky() -> np.ndarray:
    d = WIDE.directions()
    x, y, z = np.moveaxis(d, -1, 0)
    rgb = np.stack([1.5 + x + 0.3 * np.sin(9 * z), 1.6 + y, 1.4 + 0.5 * np.sin(5 * x * z)], -1)
    return rgb.astype(np.float32)


def looking(yaw: float) -> CameraModel:
    d = np.array([math.sin(yaw), 0.1, math.cos(yaw)])
    return EYE.posed(Pose.look_at(np.zeros(3), d))


def framed(camera: CameraModel, rgb: np.ndarray) -> Frame:
    return Frame(rgb.astype(np.float32), camera, np.ones(rgb.shape[:2], bool))


def compared(ratio: np.ndarray, yaws: tuple[float, ...] = (0.0,)) -> list[Comparison]:
    """Frames of the sky times `ratio` (H, W, 3), as the map predicts them."""
    later = ProbeMap((sky() * ratio).astype(np.float32), np.zeros(3))
    env = ProbeMap(sky(), np.zeros(3))
    cameras = [looking(yaw) for yaw in yaws]
    return [compare(env, framed(c, predict(later, c, None)[0])) for c in cameras]


def changed(comparisons: list[Comparison], kind: str | None = None) -> Change:
    return find_change(ProbeMap(sky(), np.zeros(3)), comparisons, None, kind)  # type: ignore[arg-type]


def test_prediction_in_a_known_set() -> None:
    """Through the geometry the frame is what the camera sees; without it, something else."""
    env = panorama(LEFT, 256, 2)
    camera = room.view([-2.4, 1.6, 1.7], [-0.5, 0.4, 0.0])
    truth = photograph(camera)
    errors = []
    for cast in (CAST, None):
        predicted, coverage = predict(env, camera, cast)
        seen = coverage > 0.99
        errors.append(np.abs(predicted - truth)[seen].mean() / truth.mean())
    assert errors[0] < 0.02 < 0.1 < errors[1]


def test_a_factor_for_all() -> None:
    rng = np.random.default_rng(0)
    g = np.array([1.31, 1.12, 0.84])
    (c,) = compared(np.broadcast_to(g, (128, 256, 3)).copy())
    noisy = c.frame.radiance * rng.normal(1, 0.05, c.frame.radiance.shape)
    again = compare(ProbeMap(sky(), np.zeros(3)), framed(c.frame.camera, noisy))
    change = changed([again])
    assert change.chosen.model.kind == "global"
    off = change.whole.s[0] - g
    # three channels, four standard errors each: wrong once in 5000 seeds
    assert (np.abs(off) < 4 * change.whole.sigma[0]).all()
    assert change.whole.sigma[0].max() < 1e-3
    assert typical_error([again], change) < 0.02


def test_people_walk_by() -> None:
    (c,) = compared(np.full((128, 256, 3), 0.5))
    crowd = c.frame.radiance.copy()
    crowd[20:120, 30:70] = 0.05
    crowd[60:110, 90:130] = [3, 0.2, 0.1]
    again = compare(ProbeMap(sky(), np.zeros(3)), framed(c.frame.camera, crowd))
    change = changed([again])
    assert change.chosen.model.kind == "global"
    np.testing.assert_allclose(change.whole.s[0], 0.5, rtol=0.003)
    left_out = (change.whole.weight == 0).mean()
    assert 0.25 < left_out < 0.4
    found, share = strange([again], change)
    assert share == pytest.approx(left_out, abs=0.03)
    assert len(found) == 2
    new, dark = (found if found[0].ratio > 1 else found[::-1])[:2]
    assert abs(new.pixel[0] - 110) < 6
    assert abs(new.pixel[1] - 85) < 6
    assert dark.ratio < 0.2
    assert dark.energy.max() < 0


def test_what_is_clipped_says_nothing() -> None:
    (c,) = compared(np.full((128, 256, 3), 2.0))
    top = c.frame.radiance.max(axis=2) > 4.0
    rgb = np.minimum(c.frame.radiance, 4.0)
    frame = Frame(rgb, c.frame.camera, ~top)
    change = changed([compare(ProbeMap(sky(), np.zeros(3)), frame)])
    np.testing.assert_allclose(change.whole.s[0], 2, rtol=1e-3)


def test_regions_where_the_light_changes_smoothly() -> None:
    d = WIDE.directions()
    ratio = np.repeat((1 + 0.5 * d[..., :1]), 3, axis=2)  # brighter on one side
    comparisons = compared(ratio, (0.0, 2.1, 4.2))
    change = changed(comparisons)
    assert change.chosen.model.kind == "regions"
    made = ratio_map(ProbeMap(sky(), np.zeros(3)), change, None)
    band = np.abs(d[..., 1]) < 0.3  # what the frames show
    assert np.abs(made - ratio)[band].mean() < 0.02
    plain = np.abs(change.whole.s[0] - ratio)[band].mean()
    assert plain > 0.2


def test_what_no_frame_shows_follows_the_whole() -> None:
    comparisons = compared(np.full((128, 256, 3), 1.7))
    change = changed(comparisons, "regions")
    made = ratio_map(ProbeMap(sky(), np.zeros(3)), change, None)
    np.testing.assert_allclose(made, 1.7, rtol=0.01)
    behind = regions(np.array([[0.0, 0, -1]]))[0].argmax()
    ahead = regions(np.array([[0.0, 0, 1]]))[0].argmax()
    assert change.chosen.fit.resolution[behind] < 0.5
    assert change.chosen.fit.resolution[ahead] > 0.5


def test_a_lamp_that_is_seen_far_away() -> None:
    """Without geometry a lamp has its own pixels, and all else one factor."""
    lit = sky()
    hot = WIDE.directions() @ (np.array([0.2, 0.1, 1]) / np.linalg.norm([0.2, 0.1, 1])) > 0.996
    lit[hot] = 300
    env = ProbeMap(lit, np.zeros(3))
    now = lit.copy()
    now[hot] *= 0.25
    camera = looking(0.0)
    c = compare(env, framed(camera, predict(ProbeMap(now, np.zeros(3)), camera, None)[0]))
    change = find_change(env, [c], None, "lamps")
    np.testing.assert_allclose(change.chosen.fit.s[:, 1], [0.25, 1], rtol=0.05)
    made = lit * ratio_map(env, change, None)
    solid = WIDE.solid_angles()
    energy = [float((light[..., 1] * solid).sum()) for light in (made, now)]
    assert energy[0] == pytest.approx(energy[1], rel=0.02)


@lru_cache
def _in_the_room() -> tuple[ProbeMap, list[CameraModel]]:
    place = np.array([-1.5, 1.2, 0.8])
    cameras = [
        room.view([2.2, 1.5, 1.6], [-1.5, 0.3, -0.3], (64, 48)),
        room.view([-2.2, 1.5, 1.6], [1.5, 0.3, 0.3], (64, 48)),
    ]
    return ProbeMap(room.panorama(place, width=128), place), cameras


@pytest.mark.parametrize("lamps", [(0.4, 1.0), (1.3, 0.0)])
def test_lamps_by_the_shading_of_the_set(lamps: tuple[float, float]) -> None:
    """A path-traced room whose lamps are dimmed one by one: the whole map follows."""
    env, cameras = _in_the_room()
    comparisons = [compare(env, framed(c, room.photograph(c, lamps)), CAST) for c in cameras]
    change = find_change(env, comparisons, CAST)
    assert change.chosen.model.kind == "lamps"
    assert change.sources is not None
    assert change.chosen.model.names == ("lamp 1", "lamp 2")  # no sky
    left = change.sources.lamps[0].direction[0] < change.sources.lamps[1].direction[0]
    s = change.chosen.fit.s if left else change.chosen.fit.s[::-1]
    np.testing.assert_allclose(s.mean(axis=1), lamps, atol=0.08)
    truth = room.panorama(env.origin, lamps, width=128)
    made = env.radiance * ratio_map(env, change, CAST)
    even = env.radiance * change.whole.s[0]

    def error(rgb: np.ndarray) -> float:
        return float(np.abs(rgb - truth).mean() / truth.mean())

    assert error(made) < 0.06
    assert error(made) < 0.25 * error(even)
    assert change.chosen.fit.condition < 10


def test_a_camera_that_was_moved_is_told() -> None:
    stripes = 1 + 0.5 * np.sin(40 * WIDE.directions()[..., :1])
    env = ProbeMap((sky() * stripes).astype(np.float32), np.zeros(3))
    camera, turned = looking(0.0), looking(0.06)
    right = framed(camera, predict(env, camera, None)[0])
    wrong = framed(camera, predict(env, turned, None)[0])
    assert misplaced(compare(env, right)) < 0.3
    focal = 80 / math.tan(math.radians(37.5))
    assert misplaced(compare(env, wrong)) == pytest.approx(0.06 * focal, rel=0.25)


def test_refusals() -> None:
    env = ProbeMap(sky(), np.zeros(3))
    camera = looking(0.0)
    with pytest.raises(UserError, match="the camera's pictures are 160x120"):
        compare(env, framed(camera, np.ones((10, 10, 3))))
    dark = Frame(np.ones((120, 160, 3), np.float32), camera, np.zeros((120, 160), bool))
    with pytest.raises(UserError, match="too little of the frame"):
        compare(env, dark)
    with pytest.raises(UserError, match="no lamp stands out"):
        find_change(env, [compare(env, framed(camera, np.ones((120, 160, 3))))], None, "lamps")


def test_the_fit_against_its_statistics() -> None:
    """Standard errors hold: 200 draws, the spread of estimates within 20 % of what is said."""
    rng = np.random.default_rng(1)
    design = np.repeat(rng.uniform(0, 1, (120, 2, 1)), 3, axis=2)
    truth = np.array([[1.2] * 3, [0.7] * 3])
    p = np.ones((120, 3))
    clean = np.einsum("nkc,kc->nc", design, truth)
    found, said, scales = [], [], []
    for _ in range(200):
        noisy = clean + rng.normal(0, 0.05, clean.shape)
        got = fit(Blocks(noisy, p, np.full_like(p, 0.01)), design, None, 1.0)
        found.append(got.s)
        said.append(got.sigma)
        scales.append(got.scale)
    spread, mean = np.std(found, axis=0), np.mean(said, axis=0)
    np.testing.assert_allclose(spread, mean, rtol=0.25)
    bias = np.abs(np.mean(found, axis=0) - truth)
    assert (bias < 4 * spread / math.sqrt(200)).all()
    assert np.mean(scales) == pytest.approx(5, rel=0.05)


def test_command(tmp_path: Path) -> None:
    env = tmp_path / "env.exr"
    alpha, clipped = np.ones(sky().shape[:2]), np.zeros(sky().shape[:2])
    alpha[-1], clipped[3, 4] = 0, 1
    marks = np.dstack([alpha, clipped, 2 * (1 - alpha), *np.moveaxis(0.01 * sky(), -1, 0)])
    names = ("R", "G", "B", "A", "clipped", "completed", "sigma.R", "sigma.G", "sigma.B")
    origin = {"origin": (0.0, 0.0, 0.0)}
    write_exr(env, np.dstack([sky(), marks]), channels=names, attributes=origin)
    camera = looking(0.4)
    camera.write(tmp_path / "witness.cameramodel")
    picture, _ = predict(ProbeMap(sky(), np.zeros(3)), camera, None)
    frames = [tmp_path / f"f{k}.exr" for k in range(3)]
    for k, path in enumerate(frames):
        write_exr(path, picture * (1 - 0.2 * k))

    def run(*arguments: object) -> None:
        build_app()(
            [str(a) for a in ("envmap", "update", env, *arguments)],
            exit_on_error=False,
            result_action="return_value",
        )

    out = tmp_path / "now.exr"
    common = ("--cameras", tmp_path / "witness.cameramodel", "-o", out)
    run("--frames", *frames, "--series", *common)
    figures = read_json(tmp_path / "now.exr.record.json")["figures"]
    assert figures["model"] == "global"
    drift = [row["global_factor"][1] for row in figures["drift"]]
    np.testing.assert_allclose(drift, [1, 0.8, 0.6], rtol=1e-3)
    assert (tmp_path / "now.drift.csv").read_text().count("\n") == 4
    for name in ("preview", "frame_preview", "drift_preview"):
        assert (tmp_path / figures[name]).is_file()
    np.testing.assert_allclose(
        np.array(figures["energy"]) / figures["energy_before"], 0.6, rtol=1e-3
    )
    now = read_image(out)
    assert now.channels == names[:6]  # the noise is not that of the map any more
    np.testing.assert_allclose(now.pixels[..., :3], 0.6 * sky(), rtol=2e-3)
    np.testing.assert_array_equal(now.pixels[..., 3:], marks[..., :3].astype(np.float32))
    assert figures["warnings"] == []
    two = [tmp_path / "witness.cameramodel"] * 2
    with pytest.raises(UserError, match="2 cameras for 3 frames"):
        run("--frames", *frames, "--cameras", *two, "-o", out)
    write_stand_in(tmp_path / "set.ply", room.stand_in())
    run("--frames", frames[0], "--stand-in", tmp_path / "set.ply", "--model", "global", *common)
