"""Settling: analytic ratios, and statistics over many emulated shutter changes."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.acquire.bracket import capture_bracket, match_times
from chromeball.acquire.emulate.camera import Transition, VideoCamera
from chromeball.acquire.emulate.direct import DirectCamera
from chromeball.acquire.emulate.sensor import Sensor
from chromeball.acquire.settle import (
    Curve,
    Reference,
    compare,
    generic_curve,
    read_curve,
    sample,
)
from chromeball.acquire.take import Take
from chromeball.acquire.visca_packets import MODELS
from chromeball.scene.errors import DeviceError, UserError

type Scene = NDArray[np.float32]

MODEL = MODELS["evi-d100p"]
TRUE = Curve(Sensor().log_exposure(), "response")
FIELD_MIXES = Transition()
GAIN_SETTLES = Transition(delay=(2, 6), drift=0.4)


def direct(scene: Scene, seed: int = 0, transition: Transition = FIELD_MIXES) -> DirectCamera:
    return DirectCamera(VideoCamera(scene, MODEL, transition=transition, seed=seed))


def wrong_labels(device: DirectCamera, take: Take, tolerance: float = 0.07) -> int:
    """How many frames were not what the take says; both fields count."""
    wrong = 0
    for frame in take.frames:
        assert frame.row.monotonic is not None
        truth = device.truth(frame.row.monotonic)
        errors = [abs(math.log(field / frame.time)) for field in (truth.even, truth.odd)]
        wrong += max(errors) > tolerance
    return wrong


# ---- the ratio


@pytest.mark.parametrize("step", [0.25, 0.83, 1.0, 3.0])
def test_the_measured_ratio_is_the_true_one(scene: Scene, step: float):
    rng = np.random.default_rng(1)
    sensor, time = Sensor(), 1 / 100
    before = Reference(sample(sensor.expose(scene, time, rng)), time)
    after = sample(sensor.expose(scene, time * step, rng))
    now = compare(after, time * step, before, TRUE)
    assert now.measured == pytest.approx(math.log(step), abs=max(0.02, 5 * now.error))
    assert abs(now.fields) < 0.05
    assert now.count > 500
    # The old exposure, taken for the new one, is off by the whole step.
    old = compare(before.samples, time * step, before, TRUE)
    assert old.residual == pytest.approx(-math.log(step), abs=1e-12)


def test_fields_of_two_exposures_are_told_apart(scene: Scene):
    rng = np.random.default_rng(2)
    sensor = Sensor()
    before = Reference(sample(sensor.expose(scene, 0.01, rng)), 0.01)
    mixed = sensor.expose(scene, 0.01, rng)
    mixed[1::2] = sensor.expose(scene, 0.02, rng)[1::2]
    now = compare(sample(mixed), 0.02, before, TRUE)
    assert now.fields == pytest.approx(-math.log(2), abs=0.05)


def test_too_few_pixels_are_no_measurement():
    dark = Reference(np.zeros((2, 5000, 3), np.uint8), 0.01)
    assert math.isnan(compare(dark.samples, 0.02, dark, TRUE).measured)
    assert compare(dark.samples, 0.02, dark, TRUE).count == 0


@given(st.integers(2, 70), st.integers(1, 70))
def test_samples_pair_rows_of_any_size(height: int, width: int):
    rows = np.repeat(np.arange(height, dtype=np.uint8), width).reshape(height, width, 1)
    even, odd = sample(np.repeat(rows, 3, axis=2))
    assert (even % 2 == 0).all()
    np.testing.assert_array_equal(odd, even + 1)


def test_the_generic_curve_is_centred_and_rises():
    h = generic_curve().log_exposure
    assert (np.diff(h[:, 1:]) > 0).all()
    assert (h[:, 128] == 0).all()


# ---- statistics


@pytest.mark.parametrize(
    ("curve", "transition", "brackets", "most"),
    [
        (TRUE, FIELD_MIXES, 60, 8.0),
        (TRUE, GAIN_SETTLES, 30, 20.0),
        (generic_curve(), FIELD_MIXES, 60, 8.0),
    ],
    ids=["response", "response, gain settles", "generic"],
)
def test_no_frame_is_labelled_wrongly(
    tmp_path: Path,
    scene: Scene,
    curve: Curve,
    transition: Transition,
    brackets: int,
    most: float,
):
    """No wrong label in N changes: at 95 % confidence fewer than 3 / N of them are wrong."""
    rng = np.random.default_rng(4)
    speeds = MODEL.times[3:16]
    wrong, changes, waited = 0, 0, list[int]()
    for seed in range(brackets):
        device = direct(scene, seed, transition)
        times = sorted(rng.choice(speeds, 5, replace=False), reverse=True)
        take = capture_bracket(device, device, times, tmp_path, curve=curve)
        wrong += wrong_labels(device, take)
        changes += len(take.frames)
        for frame in take.frames:
            assert frame.row.settle is not None
            assert frame.row.settle.verdict == "settled"
            waited.append(frame.row.settle.frames_waited)
    assert changes == 5 * brackets
    assert wrong == 0
    assert 2 <= float(np.mean(waited)) < most


def test_slow_shutter_repeats_frames_and_is_waited_for(tmp_path: Path, scene: Scene):
    for seed in range(6):
        device = direct(scene, seed)
        take = capture_bracket(device, device, [1 / 3, 1 / 6, 1 / 12], tmp_path)
        assert wrong_labels(device, take) == 0


# ---- changes that never show


class Stuck(VideoCamera):
    """A register that takes every command, and a shutter that does not move."""

    def set_shutter(self, position: int) -> bool:
        self.position = position
        return True


@pytest.mark.parametrize("curve", [TRUE, None], ids=["response", "generic"])
def test_a_shutter_that_does_not_move_is_an_error(
    tmp_path: Path, scene: Scene, curve: Curve | None
):
    device = DirectCamera(Stuck(scene, MODEL))
    with pytest.raises(
        DeviceError, match="the picture never came to what 1/50 s must look like"
    ):
        capture_bracket(device, device, [1 / 50, 1 / 100], tmp_path / "t", curve=curve)
    assert list((tmp_path / "t").iterdir()) == []


class Mislabelled(VideoCamera):
    """A camera whose 1/215 is half of what its table says."""

    def _change(self) -> None:
        super()._change()
        if self.position == 9:
            self._target = 0.5 / 215


def test_a_wrong_plateau_is_flagged_and_counted_with_its_measured_time(
    tmp_path: Path, scene: Scene
):
    device = DirectCamera(Mislabelled(scene, MODEL))
    take = capture_bracket(device, device, [1 / 50, 1 / 100, 1 / 215], tmp_path, curve=TRUE)
    frame = take.frames[0]
    assert frame.row.settle is not None
    assert frame.row.settle.verdict == "plateau"
    assert frame.row.settle.ratio == pytest.approx(0.5, rel=0.05)
    assert frame.row.read_back_time == 1 / 215
    assert frame.time == pytest.approx(0.5 / 215, rel=0.05)
    assert wrong_labels(device, take) == 0


def test_pictures_that_cannot_tell_are_said_to_be_unverified(tmp_path: Path):
    device = direct(np.full((32, 32, 3), 1e-9, np.float32))
    take = capture_bracket(device, device, [1 / 50, 1 / 1000], tmp_path, curve=TRUE)
    for frame in take.frames:
        assert frame.row.settle is not None
        assert frame.row.settle.verdict == "unverified"
        assert frame.row.settle.frames_waited >= 12
        assert frame.row.settle.ratio is None
    assert wrong_labels(device, take) == 0


# ---- brackets


def test_a_take_says_what_happened(tmp_path: Path, scene: Scene):
    device = direct(scene)
    said: list[str] = []
    take = capture_bracket(
        device, device, [0.02, 0.0049], tmp_path / "t", curve=TRUE, average=3, say=said.append
    )
    short, long = (frame.row for frame in take.frames)
    assert short.requested_time == 0.0049
    assert short.read_back_time == 1 / 215
    assert short.measured_time == pytest.approx(1 / 215, rel=0.06)
    assert long.averaged == 3
    assert long.wall is not None
    assert long.wall.startswith("1970-01-01T00:00:0")
    assert long.device == "EVI-D100P"
    assert take.size == (64, 48)
    assert len(said) == 2
    record = json.loads((tmp_path / "t/take.json.record.json").read_text())
    assert record["figures"]["verdicts"] == ["settled", "settled"]
    assert not (tmp_path / "t/journal.jsonl").exists()


def test_averaging_lowers_the_noise(tmp_path: Path):
    from chromeball.scene.image import read_image

    smooth = np.geomspace(0.1, 3, 64 * 48).reshape(48, 64, 1) * np.ones(3)
    deviations = []
    for average in (1, 8):
        device = direct(smooth.astype(np.float32))
        take = capture_bracket(
            device, device, [1 / 50, 1 / 75], tmp_path / str(average), average=average
        )
        pixels = read_image(take.paths[-1]).pixels.astype(float)
        ideal = 255 * Sensor().response(
            Sensor().inverse(np.full(3, 128 / 255)) * smooth * take.times[-1] / Sensor().middle
        )
        deviations.append((pixels - ideal).std())
    assert deviations[1] < 0.6 * deviations[0]


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([1.0], r"no shutter time near 1 s; the nearest is 1/3 s"),
        ([1 / 17], r"near 1/17 s; the nearest is 1/"),
        ([1 / 50, 1 / 51], "1/50 s and 1/51 s are both the camera's 1/50 s"),
    ],
)
def test_times_the_camera_does_not_have(times: list[float], message: str):
    with pytest.raises(UserError, match=message):
        match_times(times, MODEL.times)


def test_times_near_a_speed_are_taken():
    assert match_times([0.3, 1 / 90, 1e-4], MODEL.times) == [1 / 3, 1 / 100, 1 / 10000]


def test_no_times_or_no_frames_to_average(tmp_path: Path, scene: Scene):
    device = direct(scene)
    with pytest.raises(UserError, match="needs exposure times"):
        capture_bracket(device, device, [], tmp_path)
    with pytest.raises(UserError, match="cannot average 0 frames"):
        capture_bracket(device, device, [0.02], tmp_path, average=0)


# ---- breaking off and going on


class Dying(DirectCamera):
    """Stops answering after some shutter changes."""

    left = 4

    def set_shutter(self, time: float) -> float:
        self.left -= 1
        if self.left < 0:
            raise DeviceError("the camera stopped answering", file="dev")
        return super().set_shutter(time)


TIMES = [1 / 25, 1 / 50, 1 / 100, 1 / 215, 1 / 425]


def test_a_bracket_that_broke_off_goes_on(tmp_path: Path, scene: Scene):
    dying = Dying(VideoCamera(scene, MODEL, seed=1))
    with pytest.raises(DeviceError, match=r"dev: .*3 of 5 frames are kept"):
        capture_bracket(dying, dying, TIMES, tmp_path)
    assert not (tmp_path / "take.json").exists()
    kept = {p.name: p.read_bytes() for p in tmp_path.glob("*.png")}
    assert len(kept) == 3

    device = direct(scene, seed=2)
    take = capture_bracket(device, device, TIMES, tmp_path)
    assert take.times == sorted(TIMES)
    assert {name: (tmp_path / name).read_bytes() for name in kept} == kept
    record = json.loads((tmp_path / "take.json.record.json").read_text())
    assert record["figures"]["resumed_frames"] == 3
    assert not (tmp_path / "journal.jsonl").exists()


@pytest.mark.parametrize("change", ["light", "scene", "picture", "times"])
def test_a_bracket_starts_over_when_something_changed(
    tmp_path: Path, scene: Scene, change: str
):
    dying = Dying(VideoCamera(scene, MODEL, seed=1))
    with pytest.raises(DeviceError):
        capture_bracket(dying, dying, TIMES, tmp_path)
    now, times = scene, TIMES
    match change:
        case "light":
            now = scene * np.float32(1.3)
        case "scene":
            now = np.ascontiguousarray(scene[:, ::-1])
        case "picture":
            (tmp_path / "frame_00.png").write_bytes(b"damaged")
        case _:
            times = TIMES[1:]
    device = direct(now, seed=2)
    take = capture_bracket(device, device, times, tmp_path)
    assert len(take.frames) == len(times)
    assert wrong_labels(device, take) == 0  # the truth of this device alone: none was reused
    record = json.loads((tmp_path / "take.json.record.json").read_text())
    assert record["figures"]["resumed_frames"] == 0


def test_an_older_take_does_not_outlive_its_pictures(tmp_path: Path, scene: Scene):
    device = direct(scene)
    capture_bracket(device, device, TIMES, tmp_path)
    dying = Dying(VideoCamera(scene, MODEL, seed=1))
    with pytest.raises(DeviceError):
        capture_bracket(dying, dying, TIMES, tmp_path)
    assert not (tmp_path / "take.json").exists()
    assert not (tmp_path / "take.json.record.json").exists()


# ---- response.json


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "log_exposure is missing"),
        ({"log_exposure": [1, 2]}, "1 or 3 rows of 256"),
        ({"log_exposure": [["x"]]}, "log_exposure is missing"),
        ({"log_exposure": [[0.0] * 256]}, "does not rise"),
    ],
)
def test_broken_responses(tmp_path: Path, content: object, message: str):
    (tmp_path / "r.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=message):
        read_curve(tmp_path / "r.json")
