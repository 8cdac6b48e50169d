"""Exposures: metadata that contradict themselves, brightness against times, cd/m^2."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.hdr.exposure import (
    Luminance,
    check_exposures,
    contradictions,
    exact_times,
    grey_card,
    lattice,
    luminance_scale,
    statements,
    transmissions,
)
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_exposure, read_header, read_image, write_exr
from tests.hdr.camera import TIMES, log_exposure, photograph, scene

DATA = Path(__file__).parents[2].parent / "shared/data/hdr"


def write_tagged(path: Path, **tags: float) -> Path:
    """A JPEG with EXIF through OpenImageIO alone; ``Exif_X`` for ``Exif:X``."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(16, 16, 3, "uint8")
    for name, value in tags.items():
        spec.attribute(name.replace("_", ":"), value)
    target = oiio.ImageOutput.create(str(path))
    assert target is not None
    assert target.open(str(path), spec)
    assert target.write_image(np.zeros((16, 16, 3), np.uint8))
    assert target.close()
    return path


# -- metadata -------------------------------------------------------------------------------


def test_metadata_that_agree_say_nothing(tmp_path: Path) -> None:
    path = write_tagged(
        tmp_path / "a.jpg",
        ExposureTime=1 / 30,
        Exif_ShutterSpeedValue=5.0,  # 1/32 s
        FNumber=5.6,
        Exif_ApertureValue=5.0,  # f/5.66
        Exif_PhotographicSensitivity=100,
    )
    said = {(s.quantity, s.source): s.value for s in statements(path)}
    assert said["time", "ShutterSpeedValue"] == pytest.approx(1 / 32)
    assert said["aperture", "ApertureValue"] == pytest.approx(32**0.5)
    assert said["iso", "ISO"] == 100
    assert contradictions(path) == []


def test_contradictions_are_named(tmp_path: Path) -> None:
    path = write_tagged(
        tmp_path / "a.jpg",
        ExposureTime=1 / 30,
        Exif_ShutterSpeedValue=7.0,
        FNumber=8.0,
        Exif_ApertureValue=5.0,
    )
    assert contradictions(path) == [
        "ExposureTime says 1/30 s, ShutterSpeedValue 1/128 s",
        "FNumber says f/8, ApertureValue f/5.66",
    ]


@settings(deadline=None, max_examples=60)
@given(
    st.dictionaries(
        st.sampled_from(
            ["ExposureTime", "Exif_ShutterSpeedValue", "FNumber", "Exif_ApertureValue",
             "Exif_PhotographicSensitivity", "Exif_ISOSpeed"]
        ),
        st.one_of(st.floats(width=32), st.integers(-(2**31), 2**31 - 1)),
    )
)  # fmt: skip
def test_odd_values_are_left_out(
    tmp_path_factory: pytest.TempPathFactory, tags: dict[str, Any]
) -> None:
    path = write_tagged(tmp_path_factory.getbasetemp() / "odd.jpg", **tags)
    for statement in statements(path):
        assert math.isfinite(statement.value)
        assert statement.value > 0
    for sentence in contradictions(path):
        assert "\n" not in sentence
    seen = read_exposure(path)
    assert seen.time is None or 0 < seen.time < math.inf


def test_real_brackets_contradict_nothing_and_have_exact_times() -> None:
    folder = DATA / "fisheye_lumilab/JPEG"
    if not folder.is_dir():
        pytest.skip(f"no data at {folder}")
    paths = sorted(folder.glob("*.JPG"))
    times = [read_exposure(path).time or 0.0 for path in paths]
    exact = exact_times(times)
    assert exact is not None
    # the dial's thirds: whole stops, and two thirds at the end
    np.testing.assert_allclose(-np.diff(np.log2(exact))[:-1], 1, atol=1e-12)
    assert -np.log2(exact)[-1] == 13
    assert [s for path in paths for s in contradictions(path)] == []


def test_exact_times_of_names() -> None:
    def check(times: list[float], wanted: list[float]) -> None:
        found = exact_times(times)
        assert found is not None
        np.testing.assert_allclose(found, wanted)

    check([1 / 30, 1 / 60, 1 / 125], [1 / 32, 1 / 64, 1 / 128])
    check([13.0, 6.0, 0.3], [2 ** (11 / 3), 2 ** (8 / 3), 2 ** (-5 / 3)])
    check([1 / 45, 1 / 90, 1 / 20], [2**-5.5, 2**-6.5, 2**-4.5])
    check([1 / 8000, 30.0], [2**-13, 32])
    assert exact_times([12.7, 6.35]) is None  # exact already
    assert exact_times([1 / 30, 0.0117]) is None
    assert exact_times([1 / 45, 1 / 50]) is None  # a half and a third


def test_filters() -> None:
    np.testing.assert_array_equal(transmissions([3.0], 2), [1 / 8, 1 / 8])
    np.testing.assert_array_equal(transmissions([0.0, 10.0], 2), [1, 2**-10])
    for stops, frames in (([1.0, 2.0], 3), ([-1.0], 1), ([math.nan], 1)):
        with pytest.raises(UserError, match="ND filter"):
            transmissions(stops, frames)


# -- pictures -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frames() -> list[NDArray[np.uint8]]:
    return [lattice(f, 20000) for f in photograph(scene(), gamma=2.6)]


def named(
    frames: list[NDArray[Any]], exposures: NDArray[np.float64], **more: Any
) -> dict[int, float]:
    return {s.frame: s.ratio for s in check_exposures(frames, exposures, **more)}


def response(gamma: float = 2.6) -> NDArray[np.float64]:
    return np.tile(log_exposure(gamma), (3, 1))


@pytest.mark.parametrize("known", [True, False])
def test_right_exposures_are_not_suspected(
    frames: list[NDArray[np.uint8]], known: bool
) -> None:
    log = response() if known else None
    for order in (slice(None), slice(None, None, -1), [3, 0, 5, 1]):
        some = [frames[j] for j in np.arange(7)[order]]
        assert named(some, TIMES[order], log_exposure=log) == {}


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("frame", range(7))
def test_a_frame_off_by_a_factor_of_two(
    frames: list[NDArray[np.uint8]], known: bool, factor: float, frame: int
) -> None:
    times = TIMES.copy()
    times[frame] *= factor
    found = named(frames, times, log_exposure=response() if known else None)
    assert list(found) == [frame]
    assert found[frame] * factor == pytest.approx(1, abs=0.03 if known else 0.3)


@pytest.mark.parametrize("known", [True, False])
def test_swapped_and_repeated_times(frames: list[NDArray[np.uint8]], known: bool) -> None:
    log = response() if known else None
    times = TIMES.copy()
    times[[2, 3]] = times[[3, 2]]
    assert list(named(frames, times, log_exposure=log)) == [2, 3]
    times = TIMES.copy()
    times[4] = times[5]
    assert list(named(frames, times, log_exposure=log)) == [4]
    twice = [*frames[:4], frames[3], *frames[4:]]  # one picture under two times
    times = np.insert(TIMES, 4, TIMES[3] * 2**0.75)
    assert list(named(twice, times, log_exposure=log)) == [4]
    assert len(named(frames, TIMES[::-1].copy(), log_exposure=log)) >= 6


def test_two_frames_show_their_order(frames: list[NDArray[np.uint8]]) -> None:
    assert named(frames[2:4], TIMES[2:4]) == {}
    assert named(frames[2:4], 3 * TIMES[2:4]) == {}
    assert len(named(frames[2:4], TIMES[2:4][::-1].copy())) == 1
    assert len(named([frames[2], frames[2]], TIMES[2:4])) == 1
    found = check_exposures(frames[2:4], np.array([1.0, 4.0]), response())
    assert len(found) == 1
    assert found[0].ratio == pytest.approx(0.5, rel=0.02)
    assert 0 < found[0].error < 0.02
    message = found[0].message("b.jpg")
    assert message.startswith("b.jpg: its exposure is stated as 4, but its brightness")
    assert "0.5" in message


def test_linear_frames_need_no_response() -> None:
    radiance = scene()
    rng = np.random.default_rng(0)
    linear = [
        lattice(np.minimum(radiance * t + rng.normal(0, 2e-4, radiance.shape), 1), 20000)
        for t in TIMES
    ]
    assert named(linear, TIMES) == {}
    times = TIMES * [1, 1, 1, 1, 1, 0.5, 1]
    assert named(linear, times)[5] == pytest.approx(2, rel=0.01)
    codes = [np.round(65535 * np.maximum(x, 0)).astype(np.uint16) for x in linear]
    ramp = np.tile(np.log(np.maximum(np.arange(65536), 0.5) / 32768), (3, 1))
    assert list(named(codes, times, log_exposure=ramp)) == [5]


def test_moved_things_do_not_count(frames: list[NDArray[np.uint8]]) -> None:
    moved = [frame.copy() for frame in frames]
    rng = np.random.default_rng(0)
    for frame in moved:
        start = rng.integers(0, len(frame) * 3 // 4)
        frame[start : start + len(frame) // 5] = rng.integers(0, 256, 3)
    assert named(moved, TIMES) == {}
    times = TIMES * [1, 1, 2, 1, 1, 1, 1]
    assert list(named(moved, times)) == [2]


def test_a_gap_that_nothing_bridges_is_not_judged(frames: list[NDArray[np.uint8]]) -> None:
    black, white = np.zeros_like(frames[0]), np.full_like(frames[0], 255)
    assert named([black, white], np.array([1.0, 30000.0])) == {}
    assert named([black, black, black], np.array([1.0, 2.0, 4.0])) == {}
    with pytest.raises(UserError, match="1 exposures for 2 frames"):
        check_exposures([black, white], [1.0])
    with pytest.raises(UserError, match="one size"):
        check_exposures([black, white[:5]], [1.0, 2.0])
    with pytest.raises(UserError, match="another camera"):
        check_exposures([black, white], [1.0, 2.0], np.zeros((1, 256)))


def test_real_brackets_and_every_factor_of_two_in_one() -> None:
    folder = DATA / "fisheye_lumilab/JPEG"
    if not folder.is_dir():
        pytest.skip(f"no data at {folder}")
    paths = sorted(folder.glob("*.JPG"))[4:13]
    times = np.array([read_exposure(path).time for path in paths])
    samples: list[NDArray[Any]] = [lattice(read_image(path).pixels, 20000) for path in paths]
    assert named(samples, times) == {}
    for frame in range(len(paths)):
        wrong = times.copy()
        wrong[frame] *= 2
        assert list(named(samples, wrong)) == [frame]


# -- cd/m^2 ---------------------------------------------------------------------------------


def test_a_reading_makes_luminance(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(90, 110, (40, 60, 3))
    relative = (truth / 250).astype(np.float32)
    where = (10, 5, 20, 30)
    reading = float((truth[5:35, 10:30] @ [0.2126, 0.7152, 0.0722]).mean())
    found = luminance_scale(relative, where, reading)
    assert found.scale == pytest.approx(250, rel=1e-6)
    assert found.pixels == 600
    assert 0 < found.error < 0.01
    point = luminance_scale(relative, (20, 20), 100.0)
    assert point.pixels == 49
    assert abs(point.scale / 250 - 1) < 0.02
    grey = luminance_scale(relative[..., 1:2], where, 100.0)
    assert grey.scale == pytest.approx(100 / relative[5:35, 10:30, 1].mean(), rel=1e-6)
    write_exr(tmp_path / "a.exr", relative, attributes=found.attributes())
    white = read_header(tmp_path / "a.exr").attributes["whiteLuminance"]
    assert white == pytest.approx(250, rel=1e-6)
    assert found.attributes(scaled=True) == {"whiteLuminance": 1.0}


def test_a_grey_card() -> None:
    assert grey_card(0.18, 1000.0) == pytest.approx(57.2958, rel=1e-5)
    for reflectance, lux in ((0.0, 1.0), (18.0, 1.0), (0.18, 0.0), (0.18, math.inf)):
        with pytest.raises(UserError, match="give a"):
            grey_card(reflectance, lux)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ((0, 0, 0, 5), "empty"),
        ((0, 0, 5, -1), "empty"),
        ((-1, 0, 5, 5), "not in the picture"),
        ((58, 0, 5, 5), "not in the picture"),
        ((1, 20), "not in the picture"),
        ((30, 30), "9 pixels of the measured place, .* clipped"),
        ((45, 10), "black"),
        ((15, 15), "NaN"),
    ],
)
def test_places_that_measure_nothing_are_refused(
    place: tuple[int, int] | tuple[int, int, int, int], message: str
) -> None:
    picture = np.ones((40, 60, 3), np.float32)
    picture[:20, 40:50] = -0.1
    picture[15, 15, 1] = np.nan
    clipped = np.zeros((40, 60), bool)
    clipped[29:32, 29:32] = True
    with pytest.raises(UserError, match=message):
        luminance_scale(picture, place, 100.0, clipped=clipped)
    for reading in (0.0, -1.0, math.nan):
        with pytest.raises(UserError, match="reading"):
            luminance_scale(picture, (5, 5), reading)


def test_records_are_plain() -> None:
    assert Luminance(2.0, 100.0, 50.0, 0.01, 9).attributes() == {"whiteLuminance": 2.0}
