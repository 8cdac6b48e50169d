"""RAW: levels, demosaic, colour and noise, against truth, numpy and LibRaw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.bench.dng import MATRIX, Sensor, write_bracket, write_dng
from chromeball.scene import kernel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_exposure, read_header, read_image, read_rgb
from chromeball.scene.raw import (
    Mosaic,
    develop,
    develop_sigma,
    measured_white,
    read_mosaic,
    touched,
)
from chromeball.scene.tags import dng_noise_profile, read_canon, read_tags

DATA = Path(__file__).parents[2].parent / "shared/data/hdr"
DNG = DATA / "raw/colorchart.dng"
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
BLACK = (512, 520, 500, 530)

type Float = NDArray[np.float32]


def scene(height: int = 96, width: int = 128) -> Float:
    """Smooth camera RGB within 0 .. 0.9."""
    y, x = np.mgrid[0:height, 0:width] / 128
    waves = [0.45 + 0.4 * np.sin(5 * x + k) * np.cos(4 * y - k) for k in range(3)]
    return np.stack(waves, axis=2).astype(np.float32)


def demosaic(mosaic: Float, pattern: str) -> Float:
    red = pattern.index("R")
    return kernel.demosaic(np.ascontiguousarray(mosaic), red // 2, red % 2)


def info(folder: Path, shape: tuple[int, int], sensor: Sensor | None = None) -> Mosaic:
    write_dng(folder / "info.dng", np.full(shape, 5000, np.uint16), sensor or Sensor())
    return read_mosaic(folder / "info.dng")


# -- a numpy reference of the kernel: whole planes, one rule after the other ------------------


def at(plane: NDArray[np.float64], dy: int, dx: int) -> NDArray[np.float64]:
    return np.roll(plane, (-dy, -dx), (0, 1))


def reference(mosaic: Float, pattern: str) -> NDArray[np.float64]:
    pad = 16
    c = np.pad(mosaic.astype(np.float64), pad, mode="reflect")
    y, x = np.indices(c.shape)
    letter = np.array(list(pattern))[2 * (y % 2) + x % 2]
    cross = ((-1, 0), (1, 0), (0, -1), (0, 1))
    saltire = ((-1, -1), (1, 1), (-1, 1), (1, -1))
    mean = np.zeros_like(c)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            mean += at(c, dy, dx) * [0.25, 0.125, 0.0625][abs(dy) + abs(dx)]
    eps = 1e-6 * np.abs(mean) + 1e-30

    def share(first: tuple[int, int], second: tuple[int, int]) -> NDArray[np.float64]:
        sums = []
        for dy, dx in (first, second):
            d = [at(c, k * dy, k * dx) for k in range(-3, 4)]
            e = (d[0] - d[2] - d[4] + d[6] - 3 * (d[1] + d[5]) + 6 * d[3]) ** 2
            sums.append(at(e, -dy, -dx) + e + at(e, dy, dx))
        total = sums[0] + sums[1]
        s = np.where(total > 0, sums[0] / np.where(total > 0, total, 1), 0.5)
        around = sum(at(s, *step) for step in saltire) / 4
        return np.where(np.abs(0.5 - around) > np.abs(0.5 - s), around, s)

    def blend(
        grad: list[NDArray[np.float64]],
        value: list[NDArray[np.float64]],
        second: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        one = (grad[1] * value[0] + grad[0] * value[1]) / (grad[0] + grad[1])
        two = (grad[3] * value[2] + grad[2] * value[3]) / (grad[2] + grad[3])
        return one + second * (two - one)

    horizontal, rising = share((1, 0), (0, 1)), share((1, 1), (1, -1))
    grad, value = [], []
    for dy, dx in cross:
        n = [at(c, k * dy, k * dx) for k in range(5)]
        grad.append(
            eps
            + abs(n[1] - at(c, -dy, -dx))
            + abs(c - n[2])
            + abs(n[1] - n[3])
            + abs(n[2] - n[4])
        )
        there = at(mean, 2 * dy, 2 * dx)
        total = mean + there
        ratio = np.clip(n[1] / np.where(total > 0, total, 1), 0, 1)
        value.append(n[1] + np.where(total > 0, ratio, 0.5) * (mean - there))
    green = np.where(letter == "G", c, blend(grad, value, horizontal))
    planes = []
    for colour, other in (("R", "B"), ("B", "R")):
        grad, value = [], []
        for dy, dx in saltire:
            near, far = at(c, dy, dx), at(c, 3 * dy, 3 * dx)
            grad.append(
                eps + abs(near - at(c, -dy, -dx)) + abs(near - far)
                + abs(green - at(green, 2 * dy, 2 * dx))
            )  # fmt: skip
            value.append(near - at(green, dy, dx))
        least = np.minimum(np.min([at(c, *step) for step in saltire], axis=0), 0)
        corner = np.maximum(green + blend(grad, value, rising), least)
        plane = np.where(letter == colour, c, np.where(letter == other, corner, 0))
        grad, value = [], []
        for dy, dx in cross:
            near, far = at(plane, dy, dx), at(plane, 3 * dy, 3 * dx)
            grad.append(
                eps + abs(green - at(green, 2 * dy, 2 * dx))
                + abs(near - at(plane, -dy, -dx)) + abs(near - far)
            )  # fmt: skip
            value.append(near - at(green, dy, dx))
        least = np.minimum(np.min([at(plane, *step) for step in cross], axis=0), 0)
        beside = np.maximum(green + blend(grad, value, horizontal), least)
        planes.append(np.where(letter == "G", beside, plane))
    return np.stack([planes[0], green, planes[1]], axis=2)[pad:-pad, pad:-pad]


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("shape", [(41, 150), (20, 33)])
def test_demosaic_is_the_reference(pattern: str, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    mosaic = rng.lognormal(0, 1, shape).astype(np.float32) - np.float32(0.2)
    wanted = reference(mosaic, pattern)
    np.testing.assert_allclose(demosaic(mosaic, pattern), wanted, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_demosaic_keeps_samples_and_smooth_colour(pattern: str) -> None:
    truth = scene()
    sensor = Sensor(pattern=pattern)
    found = demosaic(sensor.mosaic(truth).astype(np.float32), pattern)
    np.testing.assert_array_equal(sensor.mosaic(found), sensor.mosaic(truth))
    inner = (found - truth)[8:-8, 8:-8]
    assert np.sqrt(np.mean(inner**2)) < 5e-4
    flat = np.broadcast_to(np.array([0.2, 0.7, 0.4], np.float32), (9, 7, 3))
    np.testing.assert_allclose(demosaic(sensor.mosaic(flat), pattern), flat, rtol=1e-5)
    scaled = demosaic(1e6 * sensor.mosaic(truth).astype(np.float32), pattern)
    np.testing.assert_allclose(scaled, 1e6 * found, rtol=1e-4)


@pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (1.0, 0.7, 0.4)])
@pytest.mark.parametrize("pattern", ["RGGB", "GRBG"])
def test_a_lamp_does_not_ring(colour: tuple[float, float, float], pattern: str) -> None:
    import cv2

    y, x = np.mgrid[0 : 96 * 8, 0 : 96 * 8] / 8
    disc = (np.hypot(x - 47.3, y - 48.7) < 14).astype(np.float32)
    sharp = cv2.resize(disc, (96, 96), interpolation=cv2.INTER_AREA)
    room = np.array([0.5, 0.8, 1.2], np.float32)
    for blur in (0.0, 0.5, 1.0):
        shape = cv2.GaussianBlur(sharp, (0, 0), blur) if blur else sharp
        truth = room + np.float32(1e4) * np.asarray(shape)[..., None] * np.array(
            colour, np.float32
        )
        found = demosaic(Sensor(pattern=pattern).mosaic(truth), pattern)
        dark = (np.asarray(shape) < 1e-7).astype(np.uint8)
        away = np.asarray(cv2.erode(dark, np.ones((7, 7), np.uint8))) > 0
        np.testing.assert_allclose(found[away], truth[away], rtol=1e-3)
        assert (found >= 0).all()
        if blur == 1:  # what a lens does to any lamp
            near = cv2.dilate(truth, np.ones((3, 3), np.uint8))
            assert (abs(found - truth) / np.asarray(near)).max() < 0.15


def test_demosaic_refuses_what_is_no_mosaic() -> None:
    with pytest.raises(ValueError, match="two rows"):
        kernel.demosaic(np.ones((1, 8), np.float32), 0, 0)
    with pytest.raises(ValueError, match="red"):
        kernel.demosaic(np.ones((8, 8), np.float32), 2, 0)


# -- files ------------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_bracket_of_known_radiance(tmp_path: Path, pattern: str) -> None:
    sensor = Sensor(pattern=pattern, black=BLACK, noise=(2e-5, 4e-8))
    truth, times = scene(), (1 / 100, 1 / 25, 1 / 6)
    radiance = 6 * truth
    paths = write_bracket(tmp_path, radiance, times, sensor, seed=3)
    for path, time in zip(paths, times, strict=True):
        mosaic = read_mosaic(path)
        assert "".join(mosaic.pattern) == pattern
        assert mosaic.black.ravel().tolist() == list(BLACK)
        assert mosaic.exposure.time == pytest.approx(time, rel=1e-4)
        assert (mosaic.exposure.aperture, mosaic.exposure.iso) == (4, 100)
        assert mosaic.white_balance == pytest.approx((1 / 0.45, 1, 1 / 0.65), rel=1e-4)
        assert (mosaic.white == sensor.white).all()
        wanted = sensor.mosaic(radiance) * time
        clear = wanted < 0.97
        a, b = sensor.noise
        step = (sensor.white - 512) ** -2 / 12
        z = ((mosaic.linear() - wanted) / np.sqrt(a * wanted + b + step))[clear]
        count = z.size  # five standard errors of mean and variance
        assert abs(z.mean()) < 5 / np.sqrt(count)
        assert abs(z.var() - 1) < 5 * np.sqrt(2 / count) + 0.01
        np.testing.assert_array_equal(mosaic.saturated()[wanted > 1.02], True)
        assert not mosaic.saturated()[wanted < 0.95].any()
        profile = dng_noise_profile(path)
        assert profile is not None
        np.testing.assert_array_equal(profile, [sensor.noise] * 3)


def test_white_is_taken_from_the_pixels_where_they_show_it() -> None:
    rng = np.random.default_rng(0)
    black, stated = np.full((2, 2), 512.0), np.full((2, 2), 16383.0)
    lit = rng.normal(9000, 2500, (200, 300)).clip(0, 12345).astype(np.uint16)
    np.testing.assert_array_equal(measured_white(lit, black, stated), 12345)
    spread = np.where(lit == 12345, lit - rng.integers(0, 3, lit.shape), lit).astype(np.uint16)
    white = measured_white(spread, black, stated)
    assert (np.abs(white - 12343) <= 1).all()
    # one place clips lower than the others; metadata lower than the pixels holds
    lit[1::2, ::2] = np.minimum(lit[1::2, ::2], 11000)
    np.testing.assert_array_equal(
        measured_white(lit, black, stated), [[12345, 12345], [11000, 12345]]
    )
    np.testing.assert_array_equal(measured_white(lit, black, np.full((2, 2), 10000.0)), 10000)


def test_a_bright_wall_is_not_taken_for_saturation() -> None:
    rng = np.random.default_rng(0)
    black, stated = np.full((2, 2), 512.0), np.full((2, 2), 16383.0)
    wall = rng.normal(12000, 12, (200, 300)).round().astype(np.uint16)  # cleaner than any
    for picture in (wall, np.full((40, 40), 512, np.uint16), np.zeros((2, 2), np.uint16)):
        np.testing.assert_array_equal(measured_white(picture, black, stated), stated)


def test_a_lower_white_is_said(tmp_path: Path) -> None:
    sensor = Sensor(white=12000)
    codes = sensor.expose(sensor.mosaic(scene()), 2.0, np.random.default_rng(0))
    write_dng(tmp_path / "a.dng", codes, sensor, white=16000)
    mosaic = read_mosaic(tmp_path / "a.dng")
    assert (mosaic.white == 12000).all()
    assert (mosaic.stated_white == 16000).all()
    assert mosaic.white_source == "pixels"
    assert read_image(tmp_path / "a.dng").attributes["raw:whiteSource"] == "pixels"


def test_development_has_the_colours_of_the_matrix(tmp_path: Path) -> None:
    mosaic = info(tmp_path, (64, 64))
    neutral = np.broadcast_to(np.array(Sensor().neutral, np.float32), (64, 64, 3))
    grey = Sensor().mosaic(neutral)
    np.testing.assert_allclose(develop(grey, mosaic), 1, atol=2e-5)
    plain = develop(grey, mosaic, "none", "camera")
    np.testing.assert_allclose(plain, neutral, rtol=1e-5)
    twice = develop(grey, mosaic, (4.0, 2.0, 1.0), "camera")
    np.testing.assert_allclose(twice, neutral * np.array([2, 1, 0.5], np.float32), rtol=1e-5)
    # under daylight balance D65 is white: what the matrix makes of XYZ of D65
    d65 = np.array(MATRIX) @ [0.9505, 1, 1.0891]
    light = Sensor().mosaic(np.broadcast_to((d65 / d65[1]).astype(np.float32), (64, 64, 3)))
    np.testing.assert_allclose(develop(light, mosaic, "daylight"), 1, atol=2e-3)
    dark = develop(-grey, mosaic)
    np.testing.assert_allclose(dark, -1, atol=2e-5)
    with pytest.raises(UserError, match="three positive"):
        develop(grey, mosaic, (1.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="mosaic"):
        develop(grey[:32], mosaic)


def test_a_file_without_a_matrix_says_so(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", np.full((64, 64), 900, np.uint16), Sensor(), matrix=None)
    mosaic = read_mosaic(tmp_path / "a.dng")
    assert mosaic.matrix is None
    with pytest.raises(UserError, match="no colour matrix"):
        develop(mosaic.linear(), mosaic)
    with pytest.raises(UserError, match="no daylight white balance"):
        develop(mosaic.linear(), mosaic, "daylight")
    assert read_image(tmp_path / "a.dng").attributes["raw:space"] == "camera"


def test_noise_through_the_development(tmp_path: Path) -> None:
    size, sd = 200, np.float32(0.02)
    mosaic = info(tmp_path, (size, size))
    flat = Sensor().mosaic(
        np.broadcast_to(np.array(Sensor().neutral, np.float32), (size, size, 3))
    )
    noise = np.random.default_rng(0).normal(0, sd, flat.shape).astype(np.float32)
    sigma = np.full(flat.shape, sd)
    for balance, space in (("none", "camera"), ("camera", "rec709")):
        found = develop(flat + noise, mosaic, balance, space)  # type: ignore[arg-type]
        wanted = develop_sigma(sigma, mosaic, balance, space)  # type: ignore[arg-type]
        ratio = found.std(axis=(0, 1)) / np.sqrt((wanted**2).mean(axis=(0, 1)))
        assert (np.abs(ratio - 1) < 0.2).all()
    sigma[50, 60] = np.inf
    wanted = develop_sigma(sigma, mosaic)
    np.testing.assert_array_equal(np.isinf(wanted).all(axis=2), touched(np.isinf(sigma)))
    assert not np.isnan(wanted).any()


def test_what_a_saturated_value_touches() -> None:
    rng = np.random.default_rng(2)
    shares = np.zeros((25, 25))
    for _ in range(60):
        base = rng.uniform(0.5, 1, (48, 48)).astype(np.float32)
        y, x = 22 + rng.integers(0, 2, 2)
        more = base.copy()
        more[y, x] *= 1.5
        change = np.abs(demosaic(more, "RGGB") - demosaic(base, "RGGB")).max(axis=2)
        shares += change[y - 12 : y + 13, x - 12 : x + 13] / (0.5 * base[y, x]) / 60
    mark = np.zeros((25, 25), bool)
    mark[12, 12] = True
    assert shares[~touched(mark)].max() < 0.08
    assert shares[~touched(mark, 10)].max() == 0


def test_a_single_picture_keeps_its_highlights_and_noise(tmp_path: Path) -> None:
    sensor = Sensor(noise=(2e-5, 1e-6))
    light = scene() * np.float32(2) * np.array(sensor.neutral, np.float32)
    light[:, :40] = 0
    codes = sensor.expose(sensor.mosaic(light), 1.0, np.random.default_rng(5))
    write_dng(tmp_path / "a.dng", codes, sensor, time=0.5)
    image = read_image(tmp_path / "a.dng")
    assert image.linear
    assert image.saturated is not None
    assert image.white is not None
    over = sensor.mosaic(light) > 1.01
    assert image.saturated[over].all()
    assert not image.saturated[:, :30].any()
    assert (image.pixels[:, :30] < 0).mean() > 0.3
    assert abs(image.pixels[:, :30].mean()) < 1e-4
    assert (image.radiance() >= 0).all()
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.dng"), image.radiance())
    assert image.exposure.time == 0.5


def test_levels_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    codes = np.full((64, 64), 900, np.uint16)
    write_dng(tmp_path / "a.dng", codes, Sensor(), white=400)
    with pytest.raises(UserError, match="black level"):
        read_mosaic(tmp_path / "a.dng")
    with pytest.raises(UserError, match="no such picture"):
        read_mosaic(tmp_path / "none.dng")


def test_other_patterns_are_left_to_libraw(tmp_path: Path) -> None:
    rows = ["GBGGRG", "RGRBGB", "GBGGRG", "GRGGBG", "BGBRGR", "GRGGBG"]
    pattern = bytes("RGB".index(letter) for row in rows for letter in row)
    letters = np.tile(np.frombuffer(pattern, np.uint8).reshape(6, 6), (90, 90))
    neutral = np.array(Sensor().neutral)
    codes = (512 + 0.5 * (15000 - 512) * neutral[letters]).round().astype(np.uint16)
    codes[40:60, 40:60] = 15000
    more: list[tuple[int, int, list[int] | bytes]] = [(33421, 3, [6, 6]), (33422, 1, pattern)]
    write_dng(tmp_path / "x.dng", codes, Sensor(), time=0.25, more=more)
    with pytest.raises(UserError, match="X-Trans"):
        read_mosaic(tmp_path / "x.dng")
    image = read_image(tmp_path / "x.dng")
    assert image.attributes["raw:developedBy"] == "LibRaw"
    assert image.exposure.time == 0.25
    assert image.pixels.dtype == np.float32
    assert image.saturated is not None
    assert image.saturated[44:56, 44:56].all()
    assert not image.saturated[:32, :32].any()
    np.testing.assert_allclose(image.pixels[8:30, 8:30], 0.5, atol=0.005)


# -- the real file ----------------------------------------------------------------------------


def test_the_real_file_beside_libraw() -> None:
    if not DNG.exists():
        pytest.skip(f"no data at {DNG}")
    import rawpy

    mosaic = read_mosaic(DNG)
    assert mosaic.pattern == ("RG", "GB")
    assert (mosaic.black == 2056).all()
    assert (mosaic.white == 15000).all()
    assert mosaic.white_source == "metadata"
    assert not mosaic.saturated().any()
    ours = develop(mosaic.linear(), mosaic, "none", "camera")
    with rawpy.imread(str(DNG)) as raw:
        theirs = raw.postprocess(
            gamma=(1, 1),
            no_auto_bright=True,
            output_bps=16,
            user_wb=[1, 1, 1, 1],
            output_color=rawpy.ColorSpace.raw,
            user_flip=0,
            adjust_maximum_thr=0.0,
        ) / np.float32(65535)

    def blocks(picture: NDArray[np.floating]) -> NDArray[np.floating]:
        return picture[:1152, :1728].reshape(72, 16, 108, 16, 3).mean(axis=(1, 3))

    ratio = blocks(ours) / blocks(theirs) - 1
    assert np.abs(np.median(ratio, axis=(0, 1))).max() < 1e-3
    lit = blocks(theirs).min(axis=2) > 0.05  # LibRaw clips noise at zero
    # two demosaics of the same noise
    assert (np.percentile(np.abs(ratio[lit]), 99, axis=0) < [0.015, 0.003, 0.012]).all()
    # samples are passed on: LibRaw's to its 16 bits, ours as they are
    there = np.abs(ours[::2, ::2, 0] - theirs[::2, ::2, 0])[10:-10, 10:-10]
    assert np.percentile(there, 99) < 2e-4
    assert dng_noise_profile(DNG) is None
    assert read_canon(DNG) is None


def test_canons_maker_note_of_real_pictures() -> None:
    path = DATA / "fisheye_lumilab/JPEG/IMG_6955.JPG"
    if not path.exists():
        pytest.skip(f"no data at {path}")
    canon = read_canon(path)
    assert canon is not None
    assert canon.time == pytest.approx(2 ** (11 / 3))  # EXIF says 13 s
    assert canon.aperture == pytest.approx(2**2.5)
    assert canon.iso == 100
    assert canon.nd is None  # this camera has none
    ghost = DATA / "hdrtoolbox/stack_ghost"
    steps = [getattr(read_canon(p), "bracket", None) for p in sorted(ghost.glob("*.JPG"))]
    assert steps == [0, -2, 2]


# -- broken files -----------------------------------------------------------------------------


@settings(deadline=None, max_examples=120)
@given(st.data())
def test_broken_dng_bytes_give_a_picture_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp()
    path = folder / "fuzzed.dng"
    write_dng(path, np.full((32, 34), 3000, np.uint16), Sensor(), time=0.1, iso=100)
    damaged = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged))) :]
    for _ in range(data.draw(st.integers(0, 4))):
        if damaged:
            place = data.draw(st.integers(0, min(len(damaged), 700) - 1))
            damaged[place] = data.draw(st.integers(0, 255))
    path.write_bytes(damaged)
    read_tags(path)
    dng_noise_profile(path)
    read_canon(path)
    for read in (read_mosaic, read_image, read_header, read_exposure):
        message = None
        try:
            read(path)
        except UserError as error:
            message = str(error)
        assert message is None or ("\n" not in message and message.startswith(str(path)))


@settings(deadline=None, max_examples=300)
@given(st.sampled_from([b"II*\0", b"MM\0*", b"\xff\xd8\xff\xe1"]), st.binary(max_size=300))
def test_any_bytes_have_tags_or_none(
    tmp_path_factory: pytest.TempPathFactory, head: bytes, rest: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.tif"
    path.write_bytes(head + rest)
    assert isinstance(read_tags(path), list)
    dng_noise_profile(path)
    read_canon(path)


@pytest.mark.parametrize(
    "values", [[1e-5, 1e-8], [1e-5, -1e-8], [np.nan, 1], [0, 0], [1, 2, 3]]
)
def test_noise_profiles_that_make_sense(tmp_path: Path, values: list[float]) -> None:
    more = [(51041, 12, values)]
    codes = np.full((64, 64), 900, np.uint16)
    write_dng(tmp_path / "a.dng", codes, Sensor(), noise_profile=False, more=more)
    profile = dng_noise_profile(tmp_path / "a.dng")
    if values == [1e-5, 1e-8]:
        np.testing.assert_array_equal(profile, [values] * 3)
    else:
        assert profile is None
