"""Merges of files: bands, spooled formats, memory, exposures left out."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from chromeball.cli.main import build_app
from chromeball.hdr import stream
from chromeball.hdr.bracket import read_bracket
from chromeball.hdr.preview import Preview
from chromeball.hdr.response_file import Response, encode_response
from chromeball.hdr.stream import Frames
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr, write_picture
from tests.hdr.camera import TIMES, log_exposure, photograph, scene

LIST = ",".join(f"{t}" for t in TIMES)


def run(*words: object) -> None:
    build_app()(
        [str(word) for word in words], result_action="return_value", exit_on_error=False
    )


def figures(output: Path) -> dict[str, Any]:
    return json.loads(output.with_name(output.name + ".record.json").read_text())["figures"]


def write_response(path: Path) -> Path:
    path.write_bytes(
        encode_response(Response.from_log_exposure(np.stack([log_exposure()] * 3)))
    )
    return path


@pytest.mark.parametrize("kind", ["jpg", "progressive", "png", "tif", "exr"])
def test_bands_are_the_picture(kind: str, tmp_path: Path, monkeypatch: Any) -> None:
    """Frames read again by rows, or from the temporary file, are the frames."""
    monkeypatch.setattr(stream, "BAND", 1)
    suffix = "jpg" if kind == "progressive" else kind
    for j, frame in enumerate(photograph(scene(70, 45), TIMES[:3])):
        path = tmp_path / f"{j}.{suffix}"
        if kind == "exr":
            write_exr(path, frame.astype(np.float32))
        elif kind == "progressive":
            cv2.imwrite(str(path), frame[..., ::-1], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
        else:
            write_picture(path, frame)
    paths = sorted(tmp_path.glob(f"*.{suffix}"))
    bracket = read_bracket(paths, [1.0, 2.0, 4.0])
    held: list[np.memmap[Any, Any]] = []
    spooled = Frames._spooled  # pyright: ignore[reportPrivateUsage]

    def count(self: Frames, pixels: Any) -> Any:
        held.append(pixels)
        return spooled(self, pixels)

    monkeypatch.setattr(Frames, "_spooled", count)
    with Frames(bracket, lambda _: None, memory=0, spool=tmp_path) as frames:
        bands = list(frames.bands([2, 0]))
        assert [top for top, _ in bands] == [0, 16, 32, 48, 64]
        for k, j in enumerate([2, 0]):
            whole = np.concatenate([rows[k] for _, rows in bands])
            np.testing.assert_array_equal(whole, read_image(paths[j]).pixels)
    assert len(held) == (3 if kind == "progressive" else 0)
    assert sorted(tmp_path.iterdir()) == paths


def test_memory_and_order_change_nothing(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(stream, "BAND", 1 << 16)
    for j, frame in enumerate(photograph(scene())):
        write_picture(tmp_path / f"{j}.png", frame)
    paths = [tmp_path / f"{j}.png" for j in range(len(TIMES))]
    curve = write_response(tmp_path / "response.json")
    options = "--response", curve, "--sigma", "-o"
    run("hdr", "merge", *paths, "--times", LIST, *options, tmp_path / "a.exr")
    back = ",".join(f"{t}" for t in TIMES[::-1])
    run(
        *("hdr", "merge", *paths[::-1], "--times", back, "--memory", 0),
        *(*options, tmp_path / "b.exr"),
    )
    a, b = (read_image(tmp_path / f"{k}.exr").pixels for k in "ab")
    np.testing.assert_array_equal(a, b)
    found = figures(tmp_path / "a.exr")
    assert found["noise_from"] == "bracket"
    np.testing.assert_allclose(found["chi_square"], 1, atol=0.15)
    assert found["measure_nothing"] == {}


def test_exposures_left_out_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [*TIMES, 1e-10, 1e4]
    for j, frame in enumerate(photograph(scene(100, 120), np.array(times), read=0.0)):
        write_picture(tmp_path / f"{j}.png", frame)
    paths = [tmp_path / f"{j}.png" for j in range(len(times))]
    curve = write_response(tmp_path / "response.json")
    words = "--times", ",".join(f"{t}" for t in times), "--response", curve
    run("hdr", "merge", *paths, *words, "-o", tmp_path / "all.exr")
    nothing = {"7.png": "black everywhere", "8.png": "saturated everywhere"}
    assert figures(tmp_path / "all.exr")["measure_nothing"] == nothing
    shown = capsys.readouterr().err
    assert "7.png measures nothing: black" in shown
    assert "8.png measures nothing: saturated" in shown
    run("hdr", "merge", *paths, *words, "--snr", 20, "-o", tmp_path / "few.exr")
    found = figures(tmp_path / "few.exr")
    left_out = {row["file"] for row in found["left_out"]}
    assert {"7.png", "8.png"} < left_out
    assert found["pictures"] == len(paths) - len(left_out)
    assert "left out" in capsys.readouterr().err
    every, few = (read_image(tmp_path / f"{k}.exr").pixels[..., :3] for k in ("all", "few"))
    measured = read_image(tmp_path / "few.exr").pixels[..., 3] == 0
    assert np.quantile(np.abs(np.log(few / every))[measured], 0.99) < 3 / 20
    with pytest.raises(UserError, match="positive number"):
        run("hdr", "merge", *paths, *words, "--snr", -1, "-o", tmp_path / "no.exr")


_PEAK = """
import resource, sys
from chromeball.cli.main import build_app
build_app()(sys.argv[1:], result_action="return_value", exit_on_error=False)
assert "jax" not in sys.modules
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


def test_many_frames_need_the_memory_of_a_few(tmp_path: Path) -> None:
    """40 frames hold 104 MB more than 8 do; the merge of 40 needs no 50 MB more."""
    curve = write_response(tmp_path / "response.json")
    frame = np.kron(photograph(scene(150, 200))[3], np.ones((6, 6, 1), np.uint8))
    write_picture(tmp_path / "0.jpg", frame)
    data = (tmp_path / "0.jpg").read_bytes()
    for j in range(1, 40):
        (tmp_path / f"{j}.jpg").write_bytes(data)
    peaks: list[int] = []
    for count in (8, 40):
        paths = [str(tmp_path / f"{j}.jpg") for j in range(count)]
        times = ",".join(f"{1 + j / 100}" for j in range(count))
        words = ["hdr", "merge", *paths, "--times", times, "--response", str(curve)]
        words += ["--memory", "0", "-o", str(tmp_path / "out" / "m.exr")]
        done = subprocess.run(
            [sys.executable, "-c", _PEAK, *words], capture_output=True, text=True, check=True
        )
        peaks.append(int(done.stdout.split()[-1]))
    assert peaks[1] - peaks[0] < 50
    names = {"m.exr", "m.preview.png", "m.histogram.png"}
    names |= {f"{name}.record.json" for name in names}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names


def test_a_preview_is_the_area_mean() -> None:
    rng = np.random.default_rng(0)
    picture = rng.random((37, 50, 3)).astype(np.float32)
    whole, parts = Preview(37, 50, 13), Preview(37, 50, 13)
    clipped = np.zeros((37, 50), np.int8)
    clipped[3, 4], clipped[20, 30], clipped[20, 31] = 1, -1, 1
    whole.add(0, picture, clipped, 3)
    for top in range(0, 37, 7):
        parts.add(top, picture[top : top + 7], clipped[top : top + 7], 3)
    a, b = whole.finish(), parts.finish()
    np.testing.assert_array_equal(a.picture, b.picture)
    assert a.picture.shape == (10, 13, 3)
    np.testing.assert_array_equal(a.clipped, b.clipped)
    assert a.clipped[0, 1] == 1
    assert a.clipped[5, 7] == 1  # saturated outweighs black
    assert np.count_nonzero(a.clipped) == 2
    np.testing.assert_array_equal(a.histogram, b.histogram)
    lit = clipped[::3, ::3] == 0
    expected = np.histogram(np.log2(picture[::3, ::3, 1][lit]), a.edges)[0]
    np.testing.assert_array_equal(a.histogram[1], expected)
