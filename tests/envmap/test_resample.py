"""Resampling: a plain reference, constants, suns, rotation, validity, no negative values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.envmap.mapping import (
    MAPPINGS,
    LatLong,
    Mapping,
    make_mapping,
    of_camera,
    pixel_grid,
    sized,
)
from chromeball.envmap.probe import rotation
from chromeball.envmap.resample import Quality, Warping, carry, warp
from chromeball.scene.camera import CameraModel

NAMES = [name for name, entry in MAPPINGS.items() if entry.total > 12]


def at_width(name: str, width: int) -> Mapping:
    """About that width: faces of a cube are whole pixels."""
    return make_mapping(name, sized(name, width - width % MAPPINGS[name].step))


def fisheye(size: int, fov: float = 190.0) -> Mapping:
    return of_camera(CameraModel.fisheye("equisolid", (size, size), math.radians(fov)))


def truth(d: NDArray[np.float64]) -> NDArray[np.float64]:
    """A smooth radiance function of direction, (..., 3) -> (..., 3)."""
    x, y, z = np.nan_to_num(d[..., 0]), np.nan_to_num(d[..., 1]), np.nan_to_num(d[..., 2])
    return np.stack(
        [1.2 + np.sin(4 * x + y), 1.5 + np.cos(5 * y) * z, 0.6 + 0.5 * np.sin(6 * z - 2 * x)],
        axis=-1,
    )


def area_mean(mapping: Mapping, cut: int = 4) -> NDArray[np.float32]:
    """Radiance of each pixel, averaged over cut x cut sub-samples."""
    total = np.zeros((mapping.size[1], mapping.size[0], 3))
    for j in range(cut):
        for i in range(cut):
            offset = np.array([i + 0.5, j + 0.5]) / cut - 0.5
            d = mapping.unproject(pixel_grid(mapping.size) + offset) @ mapping.rotation.T
            total += truth(d)
    return (total / cut**2).astype(np.float32)


def with_sun(
    mapping: Mapping, sun: NDArray[np.float64], degrees: float = 0.5
) -> NDArray[np.float32]:
    radiance = truth(mapping.directions())
    lit = np.nan_to_num(mapping.directions()) @ sun > math.cos(math.radians(degrees))
    if not lit.any():
        x, y = np.round(mapping.pixels_of(sun)).astype(int)
        lit[min(y, mapping.size[1] - 1), x % mapping.size[0]] = True
    radiance[lit] = 1e5
    return radiance.astype(np.float32)


def suns(count: int, seed: int) -> NDArray[np.float64]:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("to", [*MAPPINGS, "fisheye"])
@pytest.mark.parametrize("width", [24, 128])
def test_constant_stays_constant(to: str, width: int) -> None:
    source = LatLong((96, 48))
    target = fisheye(width) if to == "fisheye" else at_width(to, width)
    result = warp(np.full((48, 96, 3), 0.7, np.float32), source, target)
    seen = target.solid_angles() > 0
    np.testing.assert_allclose(result.radiance[seen], 0.7, rtol=1e-5)
    np.testing.assert_allclose(result.coverage[seen], 1)
    assert (result.coverage[~seen] == 0).all()


def as_fine(width: int, fine: bool) -> list[tuple[str, int]]:
    """Widths of all whole maps, coarse or about as fine as a lat-long of `width`."""
    share = {"latlong": 1.0, "cube-vertical": 0.75, "cube-strip": 1.5, "cube-column": 0.25}
    scale = 1.0 if fine else 0.3
    return [(name, int(scale * width * share.get(name, 0.75))) for name in NAMES]


@pytest.mark.parametrize(("to", "width"), [*as_fine(160, True), *as_fine(160, False)])
def test_smooth_radiance_against_the_analytic_function(to: str, width: int) -> None:
    source = LatLong((160, 80))
    target = at_width(to, width)
    result = warp(area_mean(source, 2), source, target)
    solid = target.solid_angles()
    # the sub-samples of a reference pixel that a rim cuts are not comparable
    whole = solid > 0.98 * np.median(solid[solid > 0]) if to != "latlong" else solid > 0
    expected = area_mean(target)
    inner = whole & np.isfinite(target.directions()).all(axis=2)
    rms = np.sqrt(np.mean((result.radiance[inner] - expected[inner]) ** 2))
    assert rms < (0.008 if len(expected) > 48 else 0.012)  # the reference's own in the poles


@pytest.mark.parametrize("position", range(6))
@pytest.mark.parametrize("width", [64, 256, 512])
def test_fisheye_to_latlong_keeps_a_sun(position: int, width: int) -> None:
    """The bar: energy to 0.1 % with a sun of 1e5, up and down."""
    sun = suns(6, 5)[position] * [1, 1, 0] + [0, 0, abs(suns(6, 5)[position][2])]
    source = fisheye(320)
    radiance = with_sun(source, sun)
    result = warp(radiance, source, LatLong((width, width // 2)))
    assert result.hot_pixels > 0
    np.testing.assert_allclose(result.energy, result.source_energy, rtol=1e-3)
    assert result.radiance.min() >= 0
    assert (result.outside == 0).all()


@pytest.mark.parametrize(("to", "width"), [*as_fine(192, True), *as_fine(192, False)])
def test_every_map_keeps_suns(to: str, width: int) -> None:
    source = LatLong((192, 96))
    target = at_width(to, width)
    solid, directions = target.solid_angles(), np.nan_to_num(target.directions())
    poles = np.array([[0, 1, 0], [0, -1, 0], [0, 0, -1], [-1e-3, 0, -1]], float)
    for sun in np.concatenate([suns(2, 6), poles]):
        sun = sun / np.linalg.norm(sun)
        result = warp(with_sun(source, sun, 1.5), source, target)
        np.testing.assert_allclose(result.energy, result.source_energy, rtol=1e-3)
        assert result.radiance.min() >= 0
        # and where it was: the centroid of what is brighter than anything around
        hot = result.radiance[..., 0] * solid * (result.radiance[..., 0] > 50)
        centroid = np.einsum("hw,hwk->k", hot, directions)
        cosine = centroid @ sun / np.linalg.norm(centroid)
        pixel = math.sqrt(4 * math.pi / (solid > 0).sum())
        assert cosine > math.cos(1.5 * pixel + math.radians(1))


def test_hot_texels_alone_are_kept_exactly() -> None:
    """A black map with one hot texel: all energy is scattered."""
    source = LatLong((64, 32))
    solid = source.solid_angles()
    for y, x in ((16, 0), (0, 10), (31, 63), (9, 40)):
        radiance = np.zeros((32, 64, 3), np.float32)
        radiance[y, x] = [1e5, 5e4, 1e3]
        for name in NAMES:
            result = warp(radiance, source, at_width(name, 160))
            np.testing.assert_allclose(result.energy, radiance[y, x] * solid[y, x], rtol=2e-3)


def test_histospline_keeps_cell_averages_and_never_undershoots() -> None:
    """Magnified by an integer, the mean over each source pixel is the pixel."""
    rng = np.random.default_rng(8)
    source = LatLong((64, 32))
    radiance = (rng.random((32, 64, 3)) ** 6 * 20).astype(np.float32)
    result = warp(radiance, source, LatLong((512, 256)), smooth=True)
    cells = result.radiance.reshape(32, 8, 64, 8, 3)
    middle = slice(6, 26)  # away from the poles, where area and angle part
    np.testing.assert_allclose(
        cells.mean(axis=(1, 3))[middle], radiance[middle], rtol=0.03, atol=0.03
    )
    padded = np.pad(radiance, ((1, 1), (0, 0), (0, 0)), mode="edge")
    padded = np.pad(padded, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    lowest = np.min(
        [padded[j : j + 32, i : i + 64] for j in range(3) for i in range(3)], axis=0
    )
    assert (cells[1:-1].min(axis=(1, 3)) >= lowest[1:-1] - 1e-4).all()


def test_area_mode_against_a_plain_reference() -> None:
    """Numpy: every source pixel's sub-samples fall into target pixels, weighted by area."""
    rng = np.random.default_rng(9)
    source, target = LatLong((256, 128)), make_mapping("angular", (32, 32))
    radiance = rng.random((128, 256, 3)).astype(np.float32)
    got = warp(radiance, source, target, smooth=False)
    cut, total, weight = 8, np.zeros((32, 32, 3)), np.zeros((32, 32))
    for j in range(cut):
        for i in range(cut):
            offset = np.array([i + 0.5, j + 0.5]) / cut - 0.5
            pixels = pixel_grid((256, 128)) + offset
            d = source.unproject(pixels)
            area = np.cos(np.arcsin(np.clip(d[..., 1], -1, 1)))
            q = np.floor(target.project(d) + 0.5).astype(int).clip(0, 31)
            np.add.at(total, (q[..., 1], q[..., 0]), area[..., None] * radiance)
            np.add.at(weight, (q[..., 1], q[..., 0]), area)
    solid = target.solid_angles()
    inner = solid > 0.3 * solid.max()
    expected = total[inner] / weight[inner][:, None]
    error = got.radiance[inner] - expected
    assert np.sqrt(np.mean(error**2)) < 0.015  # the pixels themselves vary by 0.29


def test_rotations_compose() -> None:
    source = LatLong((256, 128))
    a, b = rotation(0.7, -0.3, 0.2), rotation(-1.1, 0.4, 0.9)
    radiance = area_mean(source, 2)
    once = warp(radiance, source, source, rotation=b @ a).radiance
    twice = warp(
        warp(radiance, source, source, rotation=a).radiance, source, source, rotation=b
    ).radiance
    weight = source.solid_angles()[..., None]
    assert math.sqrt(((once - twice) ** 2 * weight).sum() / weight.sum() / 3) < 3e-3
    back = warp(once, source, source, rotation=(b @ a).T).radiance
    assert math.sqrt(((back - radiance) ** 2 * weight).sum() / weight.sum() / 3) < 3e-3


def test_rotation_turns_the_world() -> None:
    """What lay ahead (+Z) moves to +X by a yaw of 90 degrees, up by a pitch."""
    source = LatLong((64, 32))
    radiance = with_sun(source, np.array([0, 0, 1.0]), 6)
    for turn, place in (
        (rotation(math.pi / 2, 0.0, 0.0), [1, 0, 0]),
        (rotation(0.0, math.pi / 2, 0.0), [0, 1, 0]),
    ):
        result = warp(radiance, source, source, rotation=turn)
        brightest = np.unravel_index(result.radiance[..., 0].argmax(), (32, 64))
        assert source.directions()[brightest] @ np.array(place) > 0.98


def test_turned_maps_and_validity() -> None:
    source = fisheye(200, 180.0).turned(rotation(math.pi, 0.0, 0.0) @ fisheye(2).rotation)
    valid = np.ones((200, 200), bool)
    valid[:, :100] = False
    radiance = np.ones((200, 200, 3), np.float32)
    radiance[:, :100] = np.nan  # nothing of it may be read
    target = LatLong((128, 64))
    result = warp(radiance, source, target, valid=valid)
    d = target.directions()
    right = d[..., 0] > 0.05  # the right half of a picture that looks along -Z
    behind = d[..., 2] < -0.05
    assert result.coverage[right & behind].min() == pytest.approx(1)
    assert result.coverage[(d[..., 0] < -0.05) | (d[..., 2] > 0.05)].max() == 0
    np.testing.assert_allclose(result.radiance[right & behind], 1, rtol=1e-6)
    seen = float((target.solid_angles() * result.coverage).sum())
    assert seen == pytest.approx(math.pi, rel=0.005)


def test_a_sun_the_target_does_not_see_is_counted() -> None:
    source = LatLong((64, 32))
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[16, 0] = 1e4  # behind
    result = warp(radiance, source, make_mapping("paraboloid", (32, 32)))
    np.testing.assert_allclose(result.outside, result.source_energy, rtol=2e-2)
    assert result.radiance.max() == 0


@pytest.mark.parametrize("to", ["latlong", "cube", "angular"])
@pytest.mark.parametrize("smooth", [True, False])
def test_rows_are_the_whole_bit_for_bit(to: str, smooth: bool) -> None:
    source, target = LatLong((300, 150)), at_width(to, 120)
    lit = with_sun(source, np.array([0.3, 0.5, 0.81]), 4)
    turn, sigma = rotation(0.7, -0.3, 0.2), 0.1 * np.ones_like(lit)
    job = Warping(lit, source, target, rotation=turn, smooth=smooth, sigma=sigma)
    bands = list(job.bands(17))
    again = Warping(lit, source, target, rotation=turn, smooth=smooth, sigma=sigma)
    whole = again.rows(0, target.size[1])
    for name in ("radiance", "coverage", "sigma"):
        parts = np.concatenate([getattr(band, name) for band in bands])
        np.testing.assert_array_equal(parts, getattr(whole, name))
    assert (job.energy == again.energy).all()
    assert job.seen == again.seen == pytest.approx(4 * math.pi, rel=1e-5)
    assert (job.rows(3, 9).radiance == whole.radiance[3:9]).all()  # after what was freed


def test_same_inputs_same_outputs() -> None:
    source, target = fisheye(256), LatLong((200, 100))
    radiance = with_sun(source, np.array([0.3, 0.5, 0.81]), 4)
    first, again = (warp(radiance, source, target).radiance for _ in range(2))
    assert (first == again).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_bad_radiance(value: float) -> None:
    radiance = np.ones((16, 32, 3), np.float32)
    radiance[3, 4, 1] = value
    with pytest.raises(ValueError, match="negative or not finite"):
        warp(radiance, LatLong((32, 16)), LatLong((16, 8)))


def test_wrong_size() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        warp(np.ones((16, 30, 3), np.float32), LatLong((32, 16)), LatLong((16, 8)))


def test_black_and_enormous_maps() -> None:
    source, target = LatLong((32, 16)), make_mapping("cube", (64, 48))
    assert warp(np.zeros((16, 32, 3), np.float32), source, target).radiance.max() == 0
    huge = np.full((16, 32, 3), 1e30, np.float32)
    result = warp(huge, source, target)
    np.testing.assert_allclose(result.radiance[target.solid_angles() > 0], 1e30, rtol=1e-5)
    tiny = np.full((16, 32, 3), 1e-30, np.float32)
    result = warp(tiny, source, target)
    np.testing.assert_allclose(result.radiance[target.solid_angles() > 0], 1e-30, rtol=1e-5)


@pytest.mark.parametrize("to", NAMES)
def test_fast_way_keeps_the_energy_and_is_linear(to: str) -> None:
    source = LatLong((320, 160))
    target = at_width(to, 320)
    smooth = area_mean(source, 2)
    result = warp(smooth, source, target, quality="fast")
    # a strip of 320 px is so coarse that it is made from areas, without a balance
    exact = 1e-4 if to == "cube-strip" else 1e-6
    np.testing.assert_allclose(result.energy, result.source_energy, rtol=exact)
    np.testing.assert_allclose(result.balance, 1, atol=3e-3)
    best = warp(smooth, source, target)
    seen = target.solid_angles() > 0.5 * np.median(target.solid_angles()[result.coverage > 0])
    difference = result.radiance[seen] - best.radiance[seen]
    assert np.sqrt(np.mean(difference**2)) < 0.01
    lit = warp(with_sun(source, suns(1, 11)[0], 2), source, target, quality="fast")
    assert lit.hot_pixels > 0
    np.testing.assert_allclose(lit.energy, lit.source_energy, rtol=exact)
    assert lit.radiance.min() >= 0


def test_fast_way_between_the_pixels_by_hand() -> None:
    """A lat-long twice as wide: samples at a quarter of a pixel; the sky's seam is crossed."""
    rng = np.random.default_rng(4)
    source, target = LatLong((32, 16)), LatLong((64, 32))
    radiance = (1 + rng.random((16, 32, 3))).astype(np.float32)
    got = warp(radiance, source, target, quality="fast")
    x, y = (np.arange(64) + 0.5) / 2 - 0.5, (np.arange(4, 28) + 0.5) / 2 - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = (x - i)[None, :, None], (y - j)[:, None, None]

    def at(b: int, a: int) -> NDArray[np.float32]:
        return radiance[(j + b)[:, None], (i + a)[None, :] % 32]

    expected = (1 - t) * ((1 - s) * at(0, 0) + s * at(0, 1)) + t * (
        (1 - s) * at(1, 0) + s * at(1, 1)
    )
    np.testing.assert_allclose(got.radiance[4:28], expected * got.balance, rtol=2e-4)


def test_fast_way_of_a_part_of_the_sphere() -> None:
    source, target = fisheye(200), LatLong((256, 128))
    radiance = np.full((200, 200, 3), 0.5, np.float32)
    valid = np.ones((200, 200), bool)
    valid[:, :40] = False
    result = warp(radiance, source, target, quality="fast", valid=valid)
    seen = result.coverage > 0
    np.testing.assert_allclose(result.radiance[seen], 0.5, rtol=1e-5)
    assert (result.radiance[~seen] == 0).all()
    assert result.balance == (1, 1, 1)  # what is unseen is not made up for
    expected = float((source.solid_angles() * valid).sum())
    assert float((result.coverage * target.omega).sum()) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("to", "width"), [("latlong", 64), ("latlong", 128), ("cube", 64)])
def test_sigma_is_the_scatter_of_repeated_noise(to: str, width: int) -> None:
    """Two routes: propagated through the weights, and counted over 200 noisy maps."""
    rng = np.random.default_rng(12)
    source, target = LatLong((64, 32)), at_width(to, width)
    clean = area_mean(source, 2) + 3
    sigma = (0.02 + 0.05 * rng.random((32, 64, 3))).astype(np.float32)
    runs = [
        warp(
            (clean + sigma * rng.normal(size=clean.shape)).astype(np.float32),
            source,
            target,
            smooth=True,
        ).radiance
        for _ in range(200)
    ]
    counted = np.std(runs, axis=0, ddof=1)
    found = warp(clean, source, target, sigma=sigma, smooth=True)
    assert found.sigma is not None
    inner = target.solid_angles() > 0.5 * np.median(target.omega[target.omega > 0])
    ratio = (found.sigma / np.maximum(counted, 1e-9))[inner]
    # the scatter of a deviation counted in 200 is 5 %; at faces' edges neighbours are guessed
    assert abs(np.median(ratio) - 1) < 0.03
    assert np.quantile(np.abs(ratio - 1), 0.95) < 0.2
    plain = warp(clean, source, target, smooth=True)
    np.testing.assert_array_equal(found.radiance, plain.radiance)


def test_sigma_of_larger_pixels_is_a_mean() -> None:
    source, target = LatLong((256, 128)), LatLong((32, 16))
    ones = np.ones((128, 256, 3), np.float32)
    found = warp(ones, source, target, sigma=0.1 * ones)
    assert found.sigma is not None
    # sub-samples do not meet all 64 pixels equally often
    np.testing.assert_allclose(found.sigma[4:12], 0.1 / 8, rtol=0.12)


def test_marks_are_carried_along() -> None:
    source = LatLong((256, 128))
    mask = np.zeros((128, 256), bool)
    mask[60, 17] = mask[20:30, 100:140] = True
    marked = float((source.solid_angles() * mask).sum())
    for to, width in (("cube", 64), ("angular", 300), ("octahedral", 20)):
        target = at_width(to, width)
        share = carry(mask, source, target)
        assert share.max() <= 1
        assert float((share * target.omega).sum()) == pytest.approx(marked, rel=2e-3)


@pytest.mark.parametrize("quality", ["best", "fast"])
@pytest.mark.parametrize("size", [(2, 1), (4, 2)])
def test_tiny_maps(size: tuple[int, int], quality: Quality) -> None:
    tiny = LatLong(size)
    radiance = np.full((size[1], size[0], 3), 2.0, np.float32)
    for name in NAMES:
        target = at_width(name, 48)
        out = warp(radiance, tiny, target, quality=quality)
        np.testing.assert_allclose(out.radiance[target.solid_angles() > 0], 2, rtol=1e-5)
        back = warp(out.radiance, target, tiny, quality=quality)
        np.testing.assert_allclose(back.radiance, 2, rtol=1e-4)
    one = make_mapping("angular", (1, 1))
    out = warp(radiance, tiny, one, quality=quality)
    np.testing.assert_allclose(out.radiance, 2, rtol=1e-5)
    np.testing.assert_allclose(warp(out.radiance, one, tiny).radiance, 2, rtol=1e-5)


@pytest.mark.parametrize("quality", ["best", "fast"])
def test_a_sun_of_1e9_and_a_single_pixel(quality: Quality) -> None:
    source = LatLong((128, 64))
    for ground in (0.0, 1.0):
        radiance = np.full((64, 128, 3), ground, np.float32)
        radiance[20, 31] = 1e9
        for name in NAMES:
            for width in (24, 192):
                target = at_width(name, width)
                result = warp(radiance, source, target, quality=quality)
                np.testing.assert_allclose(result.energy, result.source_energy, rtol=1e-5)
                assert np.isfinite(result.radiance).all()
                assert result.radiance.min() >= 0
                assert result.hot_pixels == 1


@pytest.mark.parametrize("name", ["cube", "cube-strip", "octahedral", "latlong"])
def test_no_seam_where_sheets_meet(name: str) -> None:
    """A smooth world through a map and back: as good over its folds and edges as within."""
    panorama = LatLong((256, 128))
    source = at_width(name, 576 if name == "cube-strip" else 384)
    result = warp(area_mean(source, 3), source, panorama)
    error = np.abs(result.radiance - area_mean(panorama, 3)).max(axis=2)
    assert error.max() < 0.03


def test_a_disc_that_the_frame_cuts() -> None:
    """A fisheye whose circle is larger than the picture: what is outside is not seen."""
    lens = CameraModel.fisheye(
        "equidistant", (120, 80), math.radians(180), centre=(60.0, 40.0), radius=58.0
    )
    source, target = of_camera(lens), LatLong((256, 128))
    found = warp(np.ones((80, 120, 3), np.float32), source, target)
    np.testing.assert_allclose(found.energy, found.source_energy, rtol=2e-3)
    assert found.radiance[found.coverage > 0].min() == pytest.approx(1, rel=1e-5)
