"""Frames to one panorama: where they looked, exposures, seams, bands; what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.cli.main import build_app
from chromeball.cli.stages import stages
from chromeball.envmap.mapping import LatLong, of_camera
from chromeball.envmap.probe import rotation
from chromeball.envmap.resample import warp
from chromeball.envmap.stitch.bend import bend, bent
from chromeball.envmap.stitch.blend import compose
from chromeball.envmap.stitch.directions import read_directions
from chromeball.envmap.stitch.features import Features, find
from chromeball.envmap.stitch.frames import Frame
from chromeball.envmap.stitch.graph import level
from chromeball.envmap.stitch.lens import (
    Freedom,
    fov_of_frame,
    full_frame,
    parse_lens,
    pixel_focal,
)
from chromeball.envmap.stitch.links import Prior
from chromeball.envmap.stitch.orient import Oriented, orient
from chromeball.envmap.stitch.photometric import Photometric, radius2, solve, unchanged
from chromeball.envmap.stitch.rotations import Matches, adjust, angle_between, exp
from chromeball.envmap.stitch.seams import find_seams
from chromeball.scene.camera import WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.color import srgb_decode, srgb_encode
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.manifest import read_scene
from chromeball.scene.record import read_json

type Array = NDArray[np.float64]

SIZE = (300, 200)
LENS = full_frame("equisolid", SIZE, 10.5 / 23.6 * SIZE[0])
BASE = WORLD_FROM_LATLONG.rotation
SIGMA = math.radians(0.7)


def world(d: Array) -> NDArray[np.float32]:
    """A world of smooth blots, lat-long features of a few degrees, the same from anywhere."""
    rng = np.random.default_rng(5)
    d = np.nan_to_num(d)
    total = np.zeros(d.shape[:-1])
    waves = rng.normal(size=(60, 3)) * rng.uniform(6, 28, (60, 1))
    for k, wave in enumerate(waves):
        total += np.sin(d @ wave + k)
    level = np.exp(total / 10)
    tint = 1 + 0.2 * np.stack([d[..., 0], d[..., 1], -d[..., 0]], axis=-1)
    return (level[..., None] * tint).astype(np.float32)


def turns() -> Array:
    """Six around, held upright, and one up: as a photographer would."""
    rng = np.random.default_rng(3)
    around = [(60 * k, -5.0, -90.0) for k in range(6)] + [(10.0, 80.0, 0.0)]
    noisy = np.radians(np.array(around) + rng.normal(size=(7, 3)))
    return np.array([rotation(*a) @ BASE for a in noisy])


@cache
def pictures() -> tuple[NDArray[np.float32], ...]:
    mapping = of_camera(LENS)
    return tuple(world(mapping.turned(r).directions()) for r in turns())


@cache
def features() -> tuple[Features, ...]:
    return tuple(find(picture) for picture in pictures())


def tracker(noise: float = SIGMA) -> Prior:
    rng = np.random.default_rng(8)
    off = exp(rng.normal(size=(7, 3)) * noise)
    return Prior(off @ turns(), np.full(7, SIGMA))


def misplaced(found: Array, true: Array) -> float:
    """RMS angle in degrees, the common turn left out."""
    u, _, vt = np.linalg.svd(np.einsum("nab,ncb->ac", true, found))
    off = angle_between((u @ vt) @ found, true)
    return math.degrees(math.sqrt(float(np.mean(off**2))))


def solved(**options: object) -> Oriented:
    return orient(features(), LENS, **options)  # type: ignore[arg-type]


# ---- rotations


@pytest.mark.parametrize("tracked", [True, False])
def test_frames_are_found_to_a_hundredth_of_a_degree(tracked: bool) -> None:
    found = solved(prior=tracker()) if tracked else solved()
    # a pixel is .43 degree here
    assert misplaced(found.rotations, turns()) < 0.05
    assert len(found.groups) == 1
    assert np.degrees(found.adjusted.sigma).max() < 0.05
    assert found.adjusted.condition < 1e6
    if not tracked:  # upright, the first frame ahead
        assert abs((found.rotations[0] @ [0, 0, 1.0])[0]) < 1e-9
        up = turns()[6] @ [0, 0, 1.0]
        assert (found.rotations[6] @ [0, 0, 1.0]) @ [0, 1.0, 0] == pytest.approx(
            up[1], abs=0.03
        )


def test_standard_errors_are_those_of_many_trials() -> None:
    rng = np.random.default_rng(2)
    true = turns()
    camera = of_camera(LENS)
    pairs, first, second = [], [], []
    d = rng.normal(size=(6000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = [camera.turned(r).pixels_of(d) for r in true]
    inside = [
        np.isfinite(q).all(axis=1) & (q > 0).all(axis=1) & (q < np.array(SIZE) - 1).all(axis=1)
        for q in seen
    ]
    for i in range(7):
        for j in range(i + 1, 7):
            both = np.flatnonzero(inside[i] & inside[j])[:60]
            pairs += [[i, j]] * len(both)
            first.append(seen[i][both])
            second.append(seen[j][both])
    a, b = np.concatenate(first), np.concatenate(second)
    off, told = [], []
    for _ in range(30):
        noise = rng.normal(size=(2, *a.shape)) * 0.5
        matches = Matches(np.array(pairs), a + noise[0], b + noise[1], np.ones(len(a)))
        found = adjust(matches, true, LENS)
        turned = found.rotations @ np.swapaxes(true, 1, 2)
        v = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=-1)
        off.append(v - v.mean(axis=0))
        told.append(found.sigma)
    # the worst axis of each frame: the median of 7 that scatter by 13 % each
    got = np.sqrt(np.mean(np.square(off), axis=0)).max(axis=1)
    assert np.median(got / np.mean(told, axis=0)) == pytest.approx(1, abs=0.25)


def test_a_wrong_focal_length_is_found() -> None:
    values = LENS.intrinsics.copy()
    values[0] *= 1.2
    wrong = CameraModel(LENS.model, values, SIZE, max_angle=LENS.max_angle)
    for prior in (None, tracker()):
        found = orient(features(), wrong, freedom=Freedom(True, True), prior=prior)
        assert misplaced(found.rotations, turns()) < 0.1
        q = np.array([[20.0, 30.0], [280.0, 100.0], [149.5, 190.0]])
        same = found.camera.unproject(q) @ LENS.unproject(q).T
        assert np.degrees(np.arccos(np.minimum(np.diag(same), 1))).max() < 0.2


def test_a_flipped_reading_is_recognised() -> None:
    prior = tracker()
    flipped = prior.rotations.copy()
    flipped[2] = rotation(math.pi, 0.0, 0.0) @ flipped[2]
    found = solved(prior=Prior(flipped, prior.sigma))
    assert found.doubted == (2,)
    assert misplaced(found.rotations, turns()) < 0.05
    assert any("tracker is wrong" in note and "3 by 1" in note for note in found.notes)


def test_a_drifting_tracker_is_recognised() -> None:
    prior = tracker(0.0)
    drift = np.array([rotation(math.radians(1.0 * k), 0.0, 0.0) for k in range(7)])
    found = solved(prior=Prior(drift @ prior.rotations, prior.sigma))
    assert misplaced(found.rotations, turns()) < 0.05
    assert any("drifts" in note for note in found.notes)


def test_frames_without_overlap() -> None:
    apart = [0, 1, 3]  # 120 degrees between the last and the others
    few = [features()[k] for k in apart]
    with pytest.raises(UserError, match=r"2 groups .* a, b; c"):
        orient(few, LENS, names=["a", "b", "c"])
    prior = tracker()
    found = orient(
        few,
        LENS,
        prior=Prior(prior.rotations[apart], prior.sigma[apart]),
        names=["a", "b", "c"],
    )
    assert [list(g) for g in found.groups] == [[0, 1], [2]]
    assert any("placed by the tracker alone" in note for note in found.notes)
    assert angle_between(found.rotations[2], prior.rotations[3]) < math.radians(0.8)
    # what the pictures tell is as exact as without the third, which is the tracker's
    pair = orient(few[:2], LENS, prior=Prior(prior.rotations[:2], prior.sigma[:2]))
    np.testing.assert_allclose(found.adjusted.sigma[:2], pair.adjusted.sigma, rtol=0.3)
    assert found.adjusted.sigma[2] == prior.sigma[3]


def test_matches_by_chance_say_nothing_of_the_lens() -> None:
    rng = np.random.default_rng(0)
    noise = [cv2.GaussianBlur(rng.normal(size=(*SIZE[::-1], 3)), (0, 0), 2.0) for _ in range(3)]
    seen = [find(np.exp(4 * n).astype(np.float32)) for n in noise]
    prior = Prior(tracker().rotations[[0, 2, 4]], tracker().sigma[[0, 2, 4]])
    found = orient(seen, LENS, freedom=Freedom(True, True), prior=prior)
    assert not found.adjusted.inliers.any()
    assert pixel_focal(found.camera) == pytest.approx(pixel_focal(LENS), rel=1e-4)


def test_tiles_are_told_apart_by_the_tracker() -> None:
    def tiled(d: Array) -> NDArray[np.float32]:
        x, y, z = np.moveaxis(np.nan_to_num(d), -1, 0)
        lon, lat = np.arctan2(x, z), np.arcsin(np.clip(y, -1, 1))
        # the same every 15 degrees around
        a, b = 24 * lon, 20 * lat
        mark = np.sin(a) * np.cos(b) + 0.6 * np.sin(2 * a + 1) * np.sin(3 * b) + np.cos(b / 2)
        return np.exp(np.stack([mark] * 3, axis=-1)).astype(np.float32)

    mapping = of_camera(LENS)
    true = turns()[:6]
    seen = [find(tiled(mapping.turned(r).directions())) for r in true]
    prior = Prior(tracker().rotations[:6], tracker().sigma[:6])
    found = orient(seen, LENS, prior=prior)
    assert misplaced(found.rotations, true) < 0.1


# ---- light


@pytest.mark.parametrize("yaws", [(0, 45), (0, 3, 6, 9), tuple(range(0, 360, 45))])
@pytest.mark.parametrize(("pitch", "roll"), [(0, 0), (-8, 0), (0, -90), (20, -90)])
def test_untracked_frames_stand_upright(yaws: tuple[int, ...], pitch: int, roll: int) -> None:
    if roll and max(yaws) < 45:
        pytest.skip("all held upright and facing one way: nothing tells that from lying")
    rng = np.random.default_rng(1)
    held = np.array(
        [
            rotation(math.radians(yaw), 0.0, 0.0)
            @ BASE
            @ (BASE.T @ rotation(0.0, *np.radians(rng.normal([pitch, roll], 0.5))) @ BASE)
            for yaw in yaws
        ]
    )
    anyhow = exp(np.array([0.4, -1.0, 2.0]))
    up = (level(anyhow @ held) @ anyhow @ held @ np.swapaxes(held, 1, 2))[:, 1, 1]
    # two frames 45 degrees apart make .5 of roll 1.3; one way, up is not told from tilted
    limit = {8: 1, 2: 3}.get(len(yaws), 3 + abs(pitch))
    assert np.degrees(np.arccos(np.clip(up, -1, 1))).max() < limit


def test_frames_that_fit_in_several_ways_are_told() -> None:
    """Walls that repeat: eight frames that were turned seem to look one way."""
    mapping = of_camera(LENS)

    def wall(d: Array) -> NDArray[np.float32]:
        x, y, z = np.moveaxis(np.nan_to_num(d), -1, 0)
        a, b = 8 * np.arctan2(x, z), 20 * np.arcsin(np.clip(y, -1, 1))  # every 45 degrees
        mark = np.sin(a) * np.cos(b) + 0.6 * np.sin(2 * a + 1) * np.sin(3 * b) + np.cos(b / 2)
        return np.exp(np.stack([mark] * 3, axis=-1)).astype(np.float32)

    turned = [rotation(math.radians(45 * k), 0.0, 0.0) @ BASE for k in range(4)]
    seen = [find(wall(mapping.turned(r).directions())) for r in turned]
    found = orient(seen, LENS)
    told = [n for n in found.notes if "several ways" in n or "same way" in n]
    assert told or misplaced(found.rotations, np.array(turned)) < 0.1
    assert not [n for n in orient(features(), LENS).notes if "way" in n]


def test_exposures_and_fall_off_are_found_and_the_energy_stays() -> None:
    rng = np.random.default_rng(4)
    given = rng.normal(size=7) * 0.2
    given -= given.mean()
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    r2 = radius2(LENS, np.stack([x, y], axis=-1))
    fall = (1 - 0.3 * r2 + 0.05 * r2**2)[..., None]
    frames = [
        Frame(str(k), (p * fall * math.exp(e)).astype(np.float32))
        for k, (p, e) in enumerate(zip(pictures(), given, strict=True))
    ]
    light = solve(frames, LENS, turns())
    assert not light.curve.any()  # radiance has no response
    assert np.abs(light.exposure[:, 1] - given).max() < 2e-3
    at = np.linspace(0, 1, 5)[:, None] ** np.arange(1, 4)
    assert np.abs(at @ light.falloff - (-0.3 * at[:, 0] + 0.05 * at[:, 1])).max() < 5e-3
    width = 512
    result = compose(frames, LENS, turns(), width, light)
    target = LatLong((width, width // 2))
    truth, solid = world(target.directions()), target.solid_angles()
    seen = result.alpha > 0.999
    energy = [float((p.sum(axis=2) * solid)[seen].sum()) for p in (result.radiance, truth)]
    assert energy[0] == pytest.approx(energy[1], rel=3e-3)
    inner = seen & (solid > 0.3 * solid.max())
    error = np.abs(result.radiance / truth - 1)[inner]
    assert np.percentile(error, 99) < 0.05


def test_a_response_that_is_not_srgb_is_found() -> None:
    """Photographs of known exposures, with the contrast that cameras add."""
    times = np.exp2(np.array([0.0, -1.0, 1.0, -0.5, 0.5, -1.5, 0.0]))
    brightest = max(float(p.max()) for p in pictures())
    frames: list[Frame] = []
    for k, (picture, t) in enumerate(zip(pictures(), times, strict=True)):
        v = srgb_encode(np.clip(0.5 * picture / brightest * t, 0, 1))
        codes = np.round(255 * (v - 0.07 * np.sin(2 * np.pi * v)))
        linear = (srgb_decode(codes / 255) / t).astype(np.float32)
        frames.append(Frame(
            str(k), linear, None, (codes >= 250).any(axis=2), "sRGB, exposure from metadata",
            gathered=float(t),
        ))  # fmt: skip

    def error(light: Photometric) -> float:
        parts: list[NDArray[np.float64]] = []
        for k, (frame, truth) in enumerate(zip(frames, pictures(), strict=True)):
            assert frame.clipped is not None
            use = ~frame.clipped & (truth.min(axis=2) > 0.02 * brightest)
            made = light.corrected(frame, k, LENS).radiance
            parts.append(np.log(made[use] / truth[use]).ravel())
        off = np.concatenate(parts)
        return float(np.std(off))

    found = solve(frames, LENS, turns())
    assert np.abs(found.exposure).max() < 0.1
    assert error(unchanged(7)) > 0.15
    assert error(found) < 0.35 * error(unchanged(7))
    assert found.left.max() < 0.03
    # photographs that are sRGB stay so
    for k, frame in enumerate(frames):
        v = srgb_encode(np.clip(0.5 * pictures()[k] / brightest * times[k], 0, 1))
        linear = srgb_decode(np.round(255 * v) / 255) / times[k]
        frames[k] = replace(frame, radiance=linear.astype(np.float32))
    assert error(solve(frames, LENS, turns())) < 0.03


def test_exposures_that_agree_are_kept() -> None:
    frames = [Frame(str(k), p) for k, p in enumerate(pictures())]
    light = solve(frames, LENS, turns())
    result = compose(frames, LENS, turns(), 512, light)
    solid = LatLong((512, 256)).solid_angles()
    truth = world(LatLong((512, 256)).directions())
    seen = result.alpha > 0.999
    energy = [float((p.sum(axis=2) * solid)[seen].sum()) for p in (result.radiance, truth)]
    assert energy[0] == pytest.approx(energy[1], rel=1e-3)
    assert abs(result.blend_energy) < 1e-4
    assert result.seams.moved_solid_angle == 0


def test_clipped_light_stays_marked() -> None:
    """A lamp that every frame clips is marked where it is, once, in its size."""
    lamp = np.array([math.sin(0.55), 0.1, math.cos(0.55)])
    lamp /= np.linalg.norm(lamp)
    mapping, reach = of_camera(LENS), math.radians(4)
    frames = []
    for k, (picture, turn) in enumerate(zip(pictures(), turns(), strict=True)):
        on = mapping.turned(turn).directions() @ lamp > math.cos(reach)
        lit = np.where(on[..., None], np.float32(20), picture)
        frames.append(Frame(str(k), lit, clipped=on))
    target = LatLong((512, 256))
    result = compose(frames, LENS, turns(), 512, unchanged(7))
    assert result.clipped is not None
    solid, d = target.solid_angles(), target.directions()
    marked = float((result.clipped * solid).sum())
    assert marked == pytest.approx(2 * math.pi * (1 - math.cos(reach)), rel=0.1)
    assert result.clipped[d @ lamp < math.cos(reach + 0.02)].max() == 0
    plain = [Frame(str(k), p) for k, p in enumerate(pictures())]
    assert compose(plain, LENS, turns(), 512, unchanged(7)).clipped is None


def test_noise_is_that_of_the_frame_that_is_seen() -> None:
    noise = [(0.02 + 0.01 * k) * p for k, p in enumerate(pictures())]
    brighter = np.exp(np.linspace(-0.3, 0.3, 7))
    frames = [
        Frame(str(k), p * np.float32(e), sigma=(s * e).astype(np.float32))
        for k, (p, s, e) in enumerate(zip(pictures(), noise, brighter, strict=True))
    ]
    result = compose(frames, LENS, turns(), 512, solve(frames, LENS, turns()))
    assert result.sigma is not None
    source = of_camera(LENS).turned(turns()[2])
    sigma = noise[2].astype(np.float32)
    alone = warp(pictures()[2], source, LatLong((512, 256)), sigma=sigma)
    own = (result.labels == 2) & (alone.coverage > 0.999)
    assert own.sum() > 1000
    assert alone.sigma is not None
    np.testing.assert_allclose(result.sigma[own], alone.sigma[own], rtol=0.02)
    frames[3] = replace(frames[3], sigma=None)
    assert compose(frames, LENS, turns(), 512, unchanged(7)).sigma is None


def test_a_sun_is_one_sun_and_does_not_ring() -> None:
    sun = np.array([math.sin(0.55), 0.1, math.cos(0.55)])  # on a seam
    sun /= np.linalg.norm(sun)
    mapping = of_camera(LENS)
    frames = []
    for k, (picture, turn) in enumerate(zip(pictures(), turns(), strict=True)):
        q = mapping.turned(turn).pixels_of(sun[None])[0]
        lit = picture.copy()
        if np.isfinite(q).all() and (q > 0).all() and (q < np.array(SIZE) - 1).all():
            x, y = np.round(q).astype(int)
            lit[y, x] += 1e6 / mapping.solid_angles()[y, x] * 1e-5
        frames.append(Frame(str(k), lit))
    plain = [Frame(str(k), p) for k, p in enumerate(pictures())]
    light = unchanged(7)
    with_sun = compose(frames, LENS, turns(), 512, light)
    without = compose(plain, LENS, turns(), 512, light)
    extra = with_sun.radiance - without.radiance
    solid = LatLong((512, 256)).solid_angles()
    for c in range(3):
        assert float((extra[..., c] * solid).sum()) == pytest.approx(10.0, rel=0.02)
    d = LatLong((512, 256)).directions()
    far = d @ sun < math.cos(math.radians(6))
    assert np.abs(extra[far]).max() < 0.02
    assert with_sun.radiance.min() >= 0


def test_what_moved_is_taken_whole_from_one_frame() -> None:
    """A person stands in the overlap of two frames at two places: each is there or not."""
    mapping = of_camera(LENS)
    places = {0: 0.45, 1: 0.62}  # yaw in radians, in both frames
    frames = []
    for k, (picture, turn) in enumerate(zip(pictures(), turns(), strict=True)):
        person = picture.copy()
        if k in places:
            # turned by +yaw is towards +X of the world's left
            at = np.array([math.sin(places[k]), 0.0, math.cos(places[k])])
            near = np.nan_to_num(mapping.turned(turn).directions()) @ at
            person[near > math.cos(math.radians(4))] = 5.0
        frames.append(Frame(str(k), person))
    result = compose(frames, LENS, turns(), 512, unchanged(7))
    d = LatLong((512, 256)).directions()
    for yaw in places.values():
        at = np.array([math.sin(yaw), 0.0, math.cos(yaw)])
        inside = d @ at > math.cos(math.radians(3))
        share = np.abs(result.radiance[inside] / 5.0 - 1).max(axis=1) < 0.1
        # whole, or gone
        assert share.mean() > 0.97 or share.mean() < 0.1
    assert result.seams.places >= 1
    plain = compose(
        [Frame(str(k), p) for k, p in enumerate(pictures())], LENS, turns(), 512, unchanged(7)
    )
    assert ((result.alpha > 0) == (plain.alpha > 0)).all()  # nothing is lost to it


def test_a_place_that_its_frame_sees_in_part_has_no_hole() -> None:
    rng = np.random.default_rng(9)
    radiance = np.ones((3, 64, 128, 3), np.float32)
    radiance[1, 20:40, 30:60] = 4.0
    radiance[2, 22:44, 50:90] = 9.0
    covered = np.ones((3, 64, 128), np.float32)
    covered[1, :, 58:] = 0
    covered[2, :, :48] = 0
    covered[0, :, 86:] = 0
    sights = (covered * rng.uniform(0.5, 1, (3, 1, 1))).astype(np.float32)
    seams = find_seams(radiance, covered, sights, np.zeros((3, 64, 128), np.float32), 1e9)
    seen = covered > 0.99
    assert np.take_along_axis(seen, seams.labels[None].astype(np.intp), axis=0).all()


# ---- the lens


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("equisolid", 4 * math.asin(23.6 / (4 * 10.5))),
        ("pinhole", 2 * math.atan(23.6 / 21)),
        ("equidistant", 23.6 / 10.5),
    ],
)
def test_field_of_view_of_a_frame(model: str, expected: float) -> None:
    fov = fov_of_frame(model, 23.6, 10.5)
    assert fov == pytest.approx(expected)
    lens, guess = parse_lens(f"{model}:10.5mm:23.6", (401, 267))
    assert not guess
    edge = lens.unproject(np.array([-0.5, 133.0]))
    assert math.acos(edge[2]) == pytest.approx(fov / 2, abs=1e-9)


@pytest.mark.parametrize("spec", ["equisolid:1mm:50", "nonsense", "pinhole:190", "equisolid:x"])
def test_lenses_that_are_none(spec: str) -> None:
    with pytest.raises(UserError):
        parse_lens(spec, (400, 300))


# ---- the command


def run(*arguments: object) -> None:
    build_app()([str(a) for a in arguments], result_action="return_value")


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = []
    for k, picture in enumerate(pictures()):
        files.append(tmp_path / f"f{k}.exr")
        write_exr(files[-1], picture)
    rows = [
        {"file": f"f{k}.exr", "world_from_camera": r.tolist()}
        for k, r in enumerate(tracker().rotations)
    ]
    (tmp_path / "t.json").write_text(json.dumps({"sigma_degrees": 0.7, "frames": rows}))
    out = tmp_path / "env.exr"
    run(
        *("envmap", "stitch", *files, "--lens", "equisolid:10.5mm:23.6", "--refine", "none"),
        *("--directions", tmp_path / "t.json", "--width", 256, "-o", out, "--json"),
    )
    figures = json.loads(capsys.readouterr().out)
    assert figures["connected"] == 7
    assert figures["residual_px"]["median"] < 0.5
    assert max(figures["sigma_degrees"]) < 0.05
    assert abs(figures["check_ratio"][0] - 1) < 0.02
    image = read_image(out)
    assert image.size == (256, 128)
    assert image.channels == ("R", "G", "B", "A", "completed")
    for suffix in ("preview.png", "seams.png", "check.png", "cameramodel", "directions.json"):
        assert (tmp_path / f"env.{suffix}").is_file()
    assert read_json(tmp_path / "env.exr.record.json")["stage"] == "envmap stitch"
    # its own directions and lens are understood
    again = read_directions(tmp_path / "env.directions.json", [f"f{k}" for k in range(7)])
    assert misplaced(again.rotations, turns()) < 0.05
    assert CameraModel.read(tmp_path / "env.cameramodel").size == SIZE


def test_a_scene_is_planned_and_stitched(tmp_path: Path) -> None:
    (tmp_path / "build").mkdir()
    shots = ""
    for k in range(3):
        write_exr(tmp_path / f"build/f{k}.exr", pictures()[k])
        shots += f'[[bracket]]\nname = "f{k}"\nframes = ["r{k}.exr", "s{k}.exr"]\n'
        shots += "times = [1, 2]\n"
        for name in "rs":
            write_exr(tmp_path / f"{name}{k}.exr", pictures()[k])
        shots += f'[[probe.shot]]\nbracket = "f{k}"\nyaw = {60 * k}\nroll = -90\npitch = -5\n'
    LENS.write(tmp_path / "lens.cameramodel")
    text = (
        f'name = "test"\n[env]\nwidth = 128\n[probe]\nstitch = true\nsigma = 3\n'
        f'camera = "lens.cameramodel"\n{shots}'
    )
    (tmp_path / "scene.toml").write_text(text)
    plan = stages(read_scene(tmp_path / "scene.toml"), tmp_path / "scene.toml")
    (stage,) = [s for s in plan if s.name.startswith("envmap stitch")]
    assert stage.needed
    assert stage.inputs[-1] == "lens.cameramodel"
    assert "--yaw" in stage.command
    run("envmap", "stitch", tmp_path / "scene.toml", "-o", tmp_path / "build/env.exr")
    found = read_directions(tmp_path / "build/env.directions.json", ["f0", "f1", "f2"])
    assert misplaced(found.rotations, turns()[:3]) < 0.05
    for wrong in ("refine = false", "trim = 1"):
        (tmp_path / "scene.toml").write_text(text.replace("sigma = 3", wrong))
        with pytest.raises(UserError, match="stitch"):
            read_scene(tmp_path / "scene.toml")


def test_a_moving_camera_is_bent_to_meet() -> None:
    """Features that shift by their nearness: bent, what was held out meets as well."""
    rng = np.random.default_rng(6)
    true = turns()[:2]
    d = rng.normal(size=(9000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    near = d[:, 1] * 0.02 - 0.01  # the ground is nearer than the sky
    moved = d + near[:, None] * np.array([1.0, 0, 0])
    a, b = (LENS.project(x @ r) for x, r in zip((d, moved), true, strict=True))
    with np.errstate(invalid="ignore"):
        inside = ((a > 0) & (b > 0) & (a < [299, 199]) & (b < [299, 199])).all(axis=1)
    a, b = a[inside], b[inside]
    matches = Matches(np.tile([0, 1], (len(a), 1)), a, b, np.ones(len(a)))
    found = adjust(matches, true, LENS)
    bends = bend(matches, found)
    assert bends.held_out[0] > 0.15
    assert bends.held_out[1] < 0.4 * bends.held_out[0]
    frame = bent(Frame("a", pictures()[0]), bends.shifts[0])
    assert frame.valid is not None
    assert frame.radiance.shape == pictures()[0].shape
    assert 0.9 < frame.valid.mean() <= 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--pitch", "0,0"], "need --yaw"),
        (["--yaw", "0,180", "--directions", "x.json"], "not both"),
        (["--sigma", "1"], "--sigma"),
        (["--lens", "pinhole:60", "--camera", "x.cameramodel"], "not both"),
        (["--yaw", "0,1,2"], "2 numbers"),
        (["--lens", "foo:50"], "one of pinhole, equidistant"),
        (["--lens", "pinhole:190"], "below 170"),
    ],
)
def test_mistakes(tmp_path: Path, options: list[str], message: str) -> None:
    files = [tmp_path / "a.exr", tmp_path / "b.exr"]
    with pytest.raises(UserError, match=message):
        run("envmap", "stitch", *files, *options, "-o", tmp_path / "env.exr")
