"""RAW brackets through the command, as a user has them: DNGs of a sensor that is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from chromeball.bench.dng import Sensor, write_bracket
from chromeball.cli.main import build_app
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, read_rgb, write_exr
from tests.hdr.camera import scene

TIMES = [1 / 64, 1 / 8, 1.0]


def run(*words: object) -> None:
    build_app()(
        [str(word) for word in words], result_action="return_value", exit_on_error=False
    )


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    radiance = scene(96, 130)
    radiance[20:40, 30:60] *= 20
    return write_bracket(tmp_path_factory.mktemp("raw"), radiance, TIMES, Sensor())


def test_a_raw_bracket_is_merged_as_a_mosaic(bracket: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "m.exr"
    run("hdr", "merge", *bracket, "--sigma", "-o", out)
    figures = json.loads((tmp_path / "m.exr.record.json").read_text())["figures"]
    assert figures["pattern"] == "RGGB"
    assert figures["noise_from"] == "bracket"
    assert 0.9 < figures["chi_square"][0] < 1.1  # per sensor value, where noise is exact
    assert figures["white_balance_from"] == "camera"
    assert figures["noise"][0][0] == pytest.approx(3.5e-6, rel=0.1)
    image = read_image(out)
    assert image.channels[:3] == ("R", "G", "B")
    balance = image.attributes["whiteBalance"]
    np.testing.assert_allclose(balance, [1 / 0.45, 1, 1 / 0.65], rtol=1e-3)
    assert np.all(read_rgb(out) >= 0)


def test_white_balance_is_as_asked(bracket: list[Path], tmp_path: Path) -> None:
    pictures = {}
    for name in ("camera", "none", "2,1,1.5"):
        out = tmp_path / f"{name}.exr"
        run("hdr", "merge", *bracket, "--white-balance", name, "-o", out)
        pictures[name] = read_image(out)
    # the matrix goes from balanced camera RGB: undo the balance of one to get the other
    means = {k: p.pixels[40:, 70:, :3].mean(axis=(0, 1)) for k, p in pictures.items()}
    assert not np.allclose(means["camera"], means["none"], rtol=0.05)
    np.testing.assert_allclose(pictures["2,1,1.5"].attributes["whiteBalance"], [2, 1, 1.5])
    for bad in ("warm", "1,2", "0,1,1"):
        with pytest.raises(UserError, match="balance"):
            run("hdr", "merge", *bracket, "--white-balance", bad, "-o", tmp_path / "x.exr")


def test_a_light_meter_makes_it_absolute(bracket: list[Path], tmp_path: Path) -> None:
    words = ("hdr", "merge", *bracket)
    out, other = tmp_path / "a.exr", tmp_path / "b.exr"
    run(*words, "--luminance", 250, "--at", "80,60,10,8", "-o", out)
    image = read_image(out)
    part = image.pixels[60:68, 80:90, :3] @ [0.2126, 0.7152, 0.0722]
    assert part.mean() == pytest.approx(250, rel=1e-3)
    assert image.attributes["whiteLuminance"] == 1
    run(*words[:2], *bracket[:2], "--scale-from", out, "-o", other)
    ratio = (
        read_image(other).pixels[60:68, 80:90, 1].mean() / image.pixels[60:68, 80:90, 1].mean()
    )
    assert ratio == pytest.approx(1, abs=0.02)
    run(*words, "--grey-card", 0.18, 1000, "--at", "84,64", "-o", out)
    part = read_image(out).pixels[61:68, 81:88, :3] @ [0.2126, 0.7152, 0.0722]
    assert part.mean() == pytest.approx(0.18 * 1000 / np.pi, rel=1e-3)


def test_mistakes(bracket: list[Path], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    out = tmp_path / "out" / "m.exr"
    relative = tmp_path / "relative.exr"
    run("hdr", "merge", *bracket, "-o", relative)
    cases: list[tuple[list[object], str]] = [
        (["--luminance", 3], "its place --at"),
        (["--at", "3,3"], "--luminance or --grey-card"),
        (["--luminance", 3, "--at", "3,x"], "whole pixels"),
        (["--luminance", 3, "--at", "3,4,5"], "x,y or x,y,width,height"),
        (["--luminance", 3, "--at", "128,4,9,9"], "not in the picture"),
        (["--luminance", -3, "--at", "60,60"], "positive"),
        (["--scale-from", relative], "not in cd/m^2"),
        (["--white", 3], "say what is white"),
        (["--nd", "a"], "give stops"),
        (["--nd", "1,2"], "2 ND filters for 3 pictures"),
    ]
    for words, message in cases:
        with pytest.raises(UserError) as caught:
            run("hdr", "merge", *bracket, *words, "-o", out)
        assert message in str(caught.value)
        assert list((tmp_path / "out").iterdir()) == []


def test_filters_count(bracket: list[Path], tmp_path: Path) -> None:
    a, b = tmp_path / "a.exr", tmp_path / "b.exr"
    run("hdr", "merge", *bracket, "-o", a)
    run("hdr", "merge", *bracket, "--nd", 3, "-o", b)
    ratio = np.median(read_image(b).pixels[..., 1] / read_image(a).pixels[..., 1])
    assert ratio == pytest.approx(8, rel=1e-4)


def _profiles() -> list[tuple[str, float, float]]:
    """Sensors of darktable's measured noise profiles: a quiet, a usual and a loud one."""
    data = Path(__file__).parents[2].parent / "shared/data/hdr/noise"
    path = data / "darktable_noiseprofiles.json"
    if not path.is_file():
        return []
    found = [
        (profile["name"], profile["a"][1], profile["b"][1])
        for maker in json.loads(path.read_text())["noiseprofiles"]
        for model in maker["models"]
        for profile in model["profiles"]
        if profile["a"][1] > 0 and profile["b"][1] > 1e-10
    ]
    found.sort(key=lambda row: row[1])
    return [found[int(share * (len(found) - 1))] for share in (0.02, 0.5, 0.95)]


@pytest.mark.skipif(not _profiles(), reason="the shared data set is absent")
@pytest.mark.parametrize("which", [0, 1, 2])
def test_brackets_of_measured_sensors(tmp_path: Path, which: int) -> None:
    _, a, b = _profiles()[which]
    sensor = Sensor(noise=(a, b))
    radiance = scene(160, 200)
    paths = write_bracket(tmp_path, radiance, TIMES, sensor, seed=which)
    out = tmp_path / "m.exr"
    run("hdr", "merge", *paths, "--white-balance", "none", "--sigma", "-o", out)
    figures = json.loads((tmp_path / "m.exr.record.json").read_text())["figures"]
    found_a, found_b = figures["noise"][0]
    assert found_a == pytest.approx(a, rel=0.15)
    rounding = 1 / 12 / (15000 - 512) ** 2
    assert found_b == pytest.approx(b + rounding, rel=0.5, abs=0.03 * a)
    assert figures["chi_square"][0] == pytest.approx(1, abs=0.06)
    assert figures["white_from"] == "metadata" or figures["white"][0][0] == pytest.approx(15000)


def test_a_scale_serves_one_camera(bracket: list[Path], tmp_path: Path) -> None:
    metered = tmp_path / "metered.exr"
    run("hdr", "merge", *bracket, "--luminance", 250, "--at", "80,60,10,8", "-o", metered)
    run("hdr", "merge", *bracket, "--nd", 2, "--scale-from", metered, "-o", tmp_path / "n.exr")
    linear = [tmp_path / f"{j}.exr" for j in range(2)]
    for j, path in enumerate(linear):
        write_exr(path, np.minimum(scene(24, 32) * 2**j, 1))
    words = ("hdr", "merge", *linear, "--times", "1,2", "--scale-from", metered)
    with pytest.raises(UserError, match="one scale"):
        run(*words, "-o", tmp_path / "x.exr")


def test_inputs_are_not_overwritten(tmp_path: Path) -> None:
    linear = [tmp_path / f"{j}.exr" for j in range(2)]
    for j, path in enumerate(linear):
        write_exr(path, np.minimum(scene(24, 32) * 2**j, 1))
    before = linear[0].read_bytes()
    with pytest.raises(UserError, match="is an input"):
        run("hdr", "merge", *linear, "--times", "1,2", "-o", linear[0])
    assert linear[0].read_bytes() == before


def test_a_hot_pixel_is_not_white(tmp_path: Path) -> None:
    """Frames that clip at 1 and hold one value of 50; and noise below black."""
    radiance = scene(48, 64) * 6
    paths = [tmp_path / f"{j}.exr" for j in range(3)]
    for path, t in zip(paths, (0.125, 0.5, 2.0), strict=True):
        frame = np.minimum(radiance * t, 1)
        frame[0, 0] = -1e-4
        if t == 2:
            frame[20, 20] = 50
        write_exr(path, frame)
    out = tmp_path / "m.exr"
    run("hdr", "merge", *paths, "--times", "0.125,0.5,2", "-o", out)
    assert json.loads((tmp_path / "m.exr.record.json").read_text())["figures"]["white"] == 1
    image = read_image(out)
    measured = image.pixels[..., 3] == 0
    measured[0, 0] = measured[20, 20] = False
    off = np.abs(image.pixels[..., :3] / radiance - 1)[measured]
    assert off.max() < 1e-4
    assert read_rgb(out)[0, 0].min() == 0
