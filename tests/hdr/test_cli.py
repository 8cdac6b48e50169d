"""The two commands as a user calls them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.main import build_app
from chromeball.scene.errors import UserError
from chromeball.scene.image import Exposure, read_image, write_exr, write_picture
from tests.hdr.camera import TIMES, log_exposure, photograph, scene

LIST = ",".join(f"{t}" for t in TIMES)


def run(*words: object) -> None:
    build_app()(
        [str(word) for word in words], result_action="return_value", exit_on_error=False
    )


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("bracket")
    paths = [folder / f"frame{j}.png" for j in range(len(TIMES))]
    for path, frame in zip(paths, photograph(scene()), strict=True):
        write_picture(path, frame)
    return paths


def test_response_then_merge(bracket: list[Path], tmp_path: Path) -> None:
    run("hdr", "response", *bracket, "--times", LIST, "-o", tmp_path / "response.json")
    content = json.loads((tmp_path / "response.json").read_text())
    difference = np.array(content["log_exposure"])[:, 20:240] - log_exposure()[20:240]
    assert np.sqrt(np.mean(difference**2)) < 0.012
    figures = json.loads((tmp_path / "response.json.record.json").read_text())["figures"]
    assert (tmp_path / figures["plot"]).is_file()
    assert max(figures["residual_rms"]) < 0.1
    assert figures["monotonicity_repairs"] == [0, 0, 0]
    out = tmp_path / "radiance.exr"
    run(
        *("hdr", "merge", *bracket, "--times", LIST),
        *("--response", tmp_path / "response.json", "--sigma", "-o", out),
    )
    image = read_image(out)
    planes = {name: image.pixels[..., k] for k, name in enumerate(image.channels)}
    assert set(planes) == {*"RGB", "sigma.R", "sigma.G", "sigma.B", "clipped"}
    measured = planes["clipped"] == 0
    for k, name in enumerate("RGB"):
        ratio = (planes[name] * (128 / 255) ** 2.2 / scene()[..., k])[measured]
        assert np.median(np.abs(ratio - 1)) < 0.015
        sigma = (planes[f"sigma.{name}"] / planes[name])[measured]
        assert 0.001 < np.median(sigma) < 0.1
    figures = json.loads((tmp_path / "radiance.exr.record.json").read_text())["figures"]
    assert (tmp_path / figures["preview"]).is_file()
    assert 4 < figures["dynamic_range_stops"] < 15
    assert image.attributes["exposureScale"] == "time"


def test_metadata_give_times_and_one_scale(tmp_path: Path) -> None:
    radiance = scene(32, 48)
    for j, time in enumerate(TIMES):
        write_picture(
            tmp_path / f"{j}.jpg",
            photograph(radiance, np.array([time]))[0],
            exposure=Exposure(time=time, aperture=4.0, iso=200.0),
            quality=98,
        )
    paths = sorted(tmp_path.glob("*.jpg"))
    run("hdr", "response", *paths, "--patch", 1, "-o", tmp_path / "r.json", "--refine-times")
    run("hdr", "merge", *paths, "--response", tmp_path / "r.json", "-o", tmp_path / "m.exr")
    image = read_image(tmp_path / "m.exr")
    assert image.attributes["exposureScale"] == "time * ISO/100 / N^2"
    scale = 2 / 16 * (128 / 255) ** 2.2
    ratio = image.pixels[..., :3] * scale / radiance
    assert abs(np.median(ratio) - 1) < 0.03


def test_a_take_is_an_input(bracket: list[Path], tmp_path: Path) -> None:
    from chromeball.acquire.take import TakeFrame, encode_take

    frames = [
        TakeFrame(file=str(path), requested_time=float(t))
        for path, t in zip(bracket, TIMES, strict=True)
    ]
    (tmp_path / "take.json").write_bytes(encode_take(frames, (256, 192)))
    run("hdr", "response", tmp_path, "-o", tmp_path / "a" / "response.json")
    run("hdr", "response", *bracket, "--times", LIST, "-o", tmp_path / "b" / "response.json")
    a, b = (json.loads((tmp_path / k / "response.json").read_text()) for k in "ab")
    assert a["log_exposure"] == b["log_exposure"]


def test_linear_pictures_need_no_response(tmp_path: Path) -> None:
    radiance = scene(24, 32)
    for j, t in enumerate(TIMES):
        write_exr(tmp_path / f"{j}.exr", np.minimum(radiance * t, 1))
    paths = sorted(tmp_path.glob("*.exr"))
    run("hdr", "merge", *paths, "--times", LIST, "-o", tmp_path / "out" / "m.exr")
    image = read_image(tmp_path / "out" / "m.exr")
    measured = image.pixels[..., 3] == 0
    assert measured.mean() > 0.95
    np.testing.assert_allclose(image.pixels[..., :3][measured], radiance[measured], rtol=1e-5)


def test_a_stored_response_is_kept_while_it_fits(
    bracket: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    words = ("hdr", "response", "--times", LIST)
    run(*words, *bracket, "--reuse", first, "-o", first)
    assert "no stored response" in capsys.readouterr().err
    run(*words, *bracket, "--reuse", first, "-o", second)
    assert "stored response fits" in capsys.readouterr().err
    a, b = (json.loads(path.read_text()) for path in (first, second))
    assert a["log_exposure"] == b["log_exposure"]
    assert b["record"]["reused_for"] == [path.name for path in bracket]
    other = [tmp_path / f"other{j}.png" for j in range(len(TIMES))]
    for path, frame in zip(other, photograph(scene(), gamma=1.6), strict=True):
        write_picture(path, frame)
    run(*words, *other, "--reuse", first, "-o", second)
    assert "no longer fits" in capsys.readouterr().err
    c = json.loads(second.read_text())
    difference = np.array(c["log_exposure"])[:, 30:240] - log_exposure(1.6)[30:240]
    assert np.sqrt(np.mean(difference**2)) < 0.01


def test_pictures_of_12_bits(tmp_path: Path) -> None:
    """12 bits in 16-bit files: the response has 4096 codes, and the merge takes it."""
    radiance, rng = scene(), np.random.default_rng(1)
    paths = [tmp_path / f"{j}.png" for j in range(len(TIMES))]
    for path, t in zip(paths, TIMES, strict=True):
        x = rng.poisson(np.minimum(radiance * t, 2) * 20000) / 20000
        z = np.round(4095 * np.clip(x, 0, 1) ** (1 / 2.2)).astype(np.uint16)
        write_picture(path, z)
    run("hdr", "response", *paths, "--times", LIST, "-o", tmp_path / "r.json")
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["codes"] == 4096
    run(
        *("hdr", "merge", *paths, "--times", LIST),
        *("--response", tmp_path / "r.json", "-o", tmp_path / "m.exr"),
    )
    pixels = read_image(tmp_path / "m.exr").pixels
    measured = pixels[..., 3] == 0
    assert measured.mean() > 0.95
    ratio = pixels[..., :3] * (2048 / 4095) ** 2.2 / radiance
    assert np.median(np.abs(ratio[measured] - 1)) < 0.015


def test_a_wrong_exposure_is_named_and_mended(
    bracket: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = TIMES.copy()
    times[3] *= 2
    wrong = ",".join(f"{t}" for t in times)
    run("hdr", "response", *bracket, "--times", wrong, "-o", tmp_path / "r.json")
    assert "frame3.png: its exposure contradicts" in capsys.readouterr().out
    run(
        *("hdr", "merge", *bracket, "--times", wrong),
        *("--response", tmp_path / "r.json", "-o", tmp_path / "m.exr"),
    )
    pixels = read_image(tmp_path / "m.exr").pixels
    measured = pixels[..., 3] == 0
    ratio = pixels[..., :3] * (128 / 255) ** 2.2 / scene()
    assert np.median(np.abs(ratio[measured] - 1)) < 0.015


def test_a_merge_names_exposures_that_contradict_the_pictures(
    bracket: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a stored response, and with linear pictures that need none."""
    run("hdr", "response", *bracket, "--times", LIST, "-o", tmp_path / "r.json")
    times = TIMES.copy()
    times[2] *= 2
    wrong = ",".join(f"{t}" for t in times)
    known = ("--response", tmp_path / "r.json")
    run("hdr", "merge", *bracket, "--times", wrong, *known, "-o", tmp_path / "m.exr")
    assert "frame2.png: its exposure is stated as 1" in capsys.readouterr().err
    figures = json.loads((tmp_path / "m.exr.record.json").read_text())["figures"]
    assert figures["suspicious_exposures"]["frame2.png"] == pytest.approx(0.5, abs=0.02)
    run("hdr", "merge", *bracket, "--times", LIST, *known, "-o", tmp_path / "m.exr")
    assert "its exposure is" not in capsys.readouterr().err
    linear = [tmp_path / f"{j}.exr" for j in range(len(TIMES))]
    for path, t in zip(linear, TIMES, strict=True):
        write_exr(path, np.minimum(scene(64, 80) * t, 1))
    run("hdr", "merge", *linear, "--times", wrong, "-o", tmp_path / "m.exr")
    assert "2.exr: its exposure is stated as 1" in capsys.readouterr().err


def test_exact_times_are_powers_of_two(bracket: list[Path], tmp_path: Path) -> None:
    named = "1/8,1/4,1/2,1,2,4,8"
    run("hdr", "response", *bracket, "--times", named, "-o", tmp_path / "r.json")
    words = ("hdr", "merge", *bracket, "--response", tmp_path / "r.json")
    names = "1/15,1/8,1/4,1/2,1,2,4"  # 1/15 stands for 1/16
    run(*words, "--times", names, "--exact-times", "-o", tmp_path / "m.exr")
    exposures = read_image(tmp_path / "m.exr").attributes["exposures"]
    np.testing.assert_allclose(sorted(exposures), np.exp2(np.arange(-4.0, 3)), rtol=1e-6)
    with pytest.raises(UserError, match="not those of a shutter's series"):
        run(*words, "--times", "1/7,1/5,1/2,1,2,4,8", "--exact-times", "-o", tmp_path / "n.exr")


def test_merge_does_not_load_jax(bracket: list[Path], tmp_path: Path) -> None:
    run("hdr", "response", *bracket, "--times", LIST, "-o", tmp_path / "r.json")
    words = ["hdr", "merge", *bracket, "--times", LIST]
    words += ["--response", tmp_path / "r.json", "-o", tmp_path / "m.exr"]
    program = (
        "import sys\n"
        "from chromeball.cli.main import build_app\n"
        f"build_app()({[str(w) for w in words]}, result_action='return_value')\n"
        "assert 'jax' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)


def test_mistakes_are_one_sentence_and_leave_nothing(
    bracket: list[Path], tmp_path: Path
) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(bracket[0].read_bytes()[:2000])
    small = tmp_path / "small.png"
    write_picture(small, np.zeros((8, 8, 3), np.uint8))
    nan = tmp_path / "nan.exr"
    write_exr(nan, np.full((4, 4, 3), np.nan))
    whole = tmp_path / "whole.exr"
    write_exr(whole, np.ones((4, 4, 3)))
    white = tmp_path / "white.png"
    write_picture(white, np.full((64, 64, 3), 255, np.uint8))
    deep = tmp_path / "deep.png"
    write_picture(deep, np.zeros((64, 64, 3), np.uint16))
    (tmp_path / "out").mkdir()
    out = tmp_path / "out" / "response.json"
    exr = tmp_path / "out" / "radiance.exr"
    known = tmp_path / "response.json"
    run("hdr", "response", *bracket, "--times", LIST, "-o", known)
    cases: list[tuple[list[object], str]] = [
        (["response", tmp_path / "no.png", "-o", out], "no such picture"),
        (["response", bracket[0], "-o", out], "frame0.png: no exposure time in its metadata"),
        (["response", bracket[0], broken, "--times", "1,2", "-o", out], "broken.png"),
        (["response", bracket[0], small, "--times", "1,2", "-o", out], "small.png: 8 x 8"),
        (["response", *bracket, "--times", "1,2", "-o", out], "2 exposure times for 7"),
        (["response", *bracket[:2], "--times", "1,1", "-o", out], "same exposure"),
        (["response", *bracket[:2], "--times", "1,-1", "-o", out], "positive"),
        (["response", *bracket[:2], "--times", "1,two", "-o", out], "is no exposure time"),
        (["response", white, white, "--times", "1,2", "-o", out], "saturated"),
        (["response", deep, deep, "--times", "1,2", "-o", out], "black"),
        (
            ["response", *bracket, "--times", LIST, "--smoothness", "3", "-o", out],
            "lambda of --method debevec",
        ),
        (["response", whole, whole, "--times", "1,2", "-o", out], "needs no response"),
        (["merge", *bracket, "--times", LIST, "-o", exr], "need their camera's response"),
        (["merge", nan, nan, "--times", "1,2", "-o", exr], "nan.exr: 16 pixels are NaN"),
        (
            ["merge", white, white, "--times", "1,2", "--response", known, "-o", exr],
            "every pixel is saturated",
        ),
        (
            ["merge", *bracket, "--times", LIST, "--response", tmp_path / "x.json", "-o", exr],
            "no such response",
        ),
    ]
    for words, message in cases:
        with pytest.raises(UserError) as caught:
            run("hdr", *words)
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)
        assert caught.value.exit_code == 2
        assert list((tmp_path / "out").iterdir()) == []
