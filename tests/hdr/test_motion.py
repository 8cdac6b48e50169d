"""Hand-held brackets through the commands, and their ``motion.json``."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.cli.main import build_app
from chromeball.hdr.motion import parse_motion, read_motion
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr, write_picture
from tests.hdr.camera import log_exposure, photograph

TIMES = np.exp2([-2.0, 0, 2])
LIST = ",".join(f"{t}" for t in TIMES)
SHIFTS = ((5.4, -3.6), (0.0, 0.0), (-7.2, 2.3))


def run(*words: object) -> None:
    build_app()(
        [str(word) for word in words], result_action="return_value", exit_on_error=False
    )


def texture(height: int, width: int) -> NDArray[np.float64]:
    """Patches of many sizes and colours over some five stops."""
    rng = np.random.default_rng(7)
    picture = np.zeros((height, width, 3))
    for scale in (4, 8, 16, 48):
        small = rng.normal(0, 0.55, (height // scale + 2, width // scale + 2, 3))
        grown = cv2.resize(small, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        picture += grown[:height, :width]
    return 0.18 * np.exp(picture * 0.8)


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("hand")
    radiance = texture(320, 400)
    paths: list[Path] = []
    for j, ((dx, dy), t) in enumerate(zip(SHIFTS, TIMES, strict=True)):
        moved = cv2.warpAffine(
            radiance, np.array([[1, 0, -dx], [0, 1, -dy]]), (400, 320), flags=cv2.INTER_CUBIC
        )
        moved = np.maximum(moved[16:-16, 16:-16], 1e-4)
        if j == 0:  # something went out of the picture
            moved[200:250, 120:180] = 0.9
        paths.append(folder / f"{j}.png")
        write_picture(paths[-1], photograph(moved, np.array([t]), seed=j)[0])
    return paths


def test_a_hand_held_bracket(bracket: list[Path], tmp_path: Path) -> None:
    motion = tmp_path / "motion.json"
    run("hdr", "align", *bracket, "--times", LIST, "-o", motion)
    found = read_motion(motion)
    assert found.needed
    base = next(k for k, p in enumerate(bracket) if p == found.reference)
    for transform, (dx, dy) in zip(found.transforms, SHIFTS, strict=True):
        wanted = np.array([dx - SHIFTS[base][0], dy - SHIFTS[base][1]])
        centre = transform @ [180, 140, 1]
        np.testing.assert_allclose(centre[:2] / centre[2] - [180, 140], wanted, atol=0.2)
    words = (*bracket, "--times", LIST)
    response = tmp_path / "r.json"
    run("hdr", "response", *words, "--motion", motion, "-o", response)
    g = np.array(json.loads(response.read_text())["log_exposure"])
    z = slice(40, 230)
    assert np.sqrt(np.mean((g[:, z] - log_exposure()[z]) ** 2)) < 0.03
    error = {}
    for name, options in {
        "plain": [],
        "aligned": ["--motion", motion],
        "ghost": ["--motion", motion, "--deghost"],
    }.items():
        out = tmp_path / f"{name}.exr"
        run("hdr", "merge", *words, "--response", response, *options, "--sigma", "-o", out)
        image = read_image(out)
        pixels = image.pixels
        clipped = pixels[..., image.channels.index("clipped")]
        dx, dy = SHIFTS[base]
        truth = cv2.warpAffine(
            texture(320, 400),
            np.array([[1, 0, -dx], [0, 1, -dy]]),
            (400, 320),
            flags=cv2.INTER_CUBIC,
        )[16:-16, 16:-16]
        ratio = pixels[..., :3] * (128 / 255) ** 2.2 / truth
        inner = np.s_[12:-12, 12:-12]
        measured = clipped[inner] == 0
        # what moved may be shown there or not, but not half
        gone = pixels[..., :3] * (128 / 255) ** 2.2 / 0.9
        off = np.minimum(np.abs(ratio - 1), np.abs(gone - 1))[inner][measured]
        error[name] = float(np.median(off)), float(np.quantile(off, 0.99))
    assert error["aligned"][0] < 0.5 * error["plain"][0]
    assert error["aligned"][1] > 0.2
    assert error["ghost"][1] < 0.5 * error["aligned"][1]
    figures = json.loads((tmp_path / "ghost.exr.record.json").read_text())["figures"]
    assert figures["ghost_regions"] >= 1
    assert 0.01 < figures["ghost_share"] < 0.1


def test_a_bracket_on_a_tripod_is_not_resampled(tmp_path: Path) -> None:
    radiance = texture(288, 368)
    paths = [tmp_path / f"{j}.png" for j in range(3)]
    for j, (path, t) in enumerate(zip(paths, TIMES, strict=True)):
        write_picture(path, photograph(radiance, np.array([t]), seed=j)[0])
    motion = tmp_path / "motion.json"
    run("hdr", "align", *paths, "--times", LIST, "-o", motion)
    assert not read_motion(motion).needed
    response = tmp_path / "r.json"
    run("hdr", "response", *paths, "--times", LIST, "-o", response)
    for name, options in {"a": [], "b": ["--motion", motion]}.items():
        words = ("hdr", "merge", *paths, "--times", LIST, "--response", response)
        run(*words, *options, "-o", tmp_path / f"{name}.exr")
    a, b = (read_image(tmp_path / f"{name}.exr").pixels for name in "ab")
    np.testing.assert_array_equal(a, b)


def test_mistakes(bracket: list[Path], tmp_path: Path) -> None:
    motion = tmp_path / "motion.json"
    run("hdr", "align", *bracket[:2], "--times", "1,4", "-o", motion)
    linear = [tmp_path / f"{j}.exr" for j in range(2)]
    for j, path in enumerate(linear):
        moved = np.roll(texture(160, 200), 4 * j, axis=1)
        write_exr(path, np.minimum(moved * 2**j, 3))
    shifted = tmp_path / "linear.json"
    run("hdr", "align", *linear, "--times", "1,2", "-o", shifted)
    out = tmp_path / "out.exr"
    cases: list[tuple[list[object], str]] = [
        (["response", *bracket, "--times", LIST, "--motion", motion], "2.png: not in"),
        (
            ["merge", *bracket, "--times", LIST, "--motion", tmp_path / "no.json"],
            "no such file",
        ),
        (["merge", *linear, "--times", "1,2", "--motion", shifted], "linear values"),
    ]
    for words, message in cases:
        with pytest.raises(UserError, match=message):
            run("hdr", *words, "-o", out)


def test_wrong_files_are_refused() -> None:
    frame = {
        "file": "a",
        "transform": np.eye(3).tolist(),
        "sigma": 0.1,
        "displacement": 1.0,
        "flag": "",
    }
    good = {
        "size": [4, 4],
        "model": "shift",
        "reference": "a",
        "needed": True,
        "frames": [frame],
        "version": 1,
    }
    assert parse_motion(json.dumps(good).encode()).needed
    for change, message in (
        ({"frames": [frame | {"transform": np.zeros((3, 3)).tolist()}]}, "singular"),
        ({"frames": [frame | {"transform": [[1, 2]] * 3}]}, "length"),
        ({"frames": []}, "length"),
        ({"version": 2}, "version 2"),
        ({"more": 1}, "more"),
    ):
        with pytest.raises(UserError, match=message):
            parse_motion(json.dumps(good | change).encode())


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_give_one_error(data: bytes) -> None:
    with pytest.raises(UserError):
        parse_motion(data)
