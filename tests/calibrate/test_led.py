"""Lights followed in rendered videos, and the way from videos to cameras."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.led import LightTrack, together, track_lights
from chromeball.calibrate.led_fit import fit_spot
from chromeball.calibrate.rig_file import read_rig
from chromeball.calibrate.virtual_wand import film, path, room
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import write_picture
from chromeball.scene.record import read_json

SIZE = (400, 300)
FRAMES = 110
LENGTH = 0.4


def wand(pace: float = 0.15, lights: int = 2) -> NDArray[np.float64]:
    """A path of four steps a frame."""
    return path(FRAMES * 4, extent=0.8, lights=lights, length=LENGTH, pace=pace, seed=1)


def write_video(file: Path, camera: CameraModel, points: NDArray[np.float64]) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 30, SIZE)
    for picture in film(camera, points, frames=len(points) // 4, seed=3):
        writer.write(picture)
    writer.release()


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], list[CameraModel]]:
    """Two saturated lights, their reflections and a lamp, by three cameras."""
    folder = tmp_path_factory.mktemp("videos")
    cameras = room(3, seed=1, size=SIZE)
    files = [folder / f"cam{c}.mp4" for c in range(3)]
    for file, camera in zip(files, cameras, strict=True):
        write_video(file, camera, wand())
    return files, cameras


def test_two_lights(videos: tuple[list[Path], list[CameraModel]]) -> None:
    files, cameras = videos
    track = track_lights(files[0], 2)
    points = wand()[::4]
    truth = np.stack([cameras[0].project_world(points[:, k]) for k in range(2)], axis=1)
    swapped = track.pixels[:, ::-1]
    off = [np.linalg.norm(p - truth, axis=-1).max(axis=-1) for p in (track.pixels, swapped)]
    miss = np.minimum(*off)[2:-2]
    assert np.isfinite(miss).mean() > 0.9
    assert np.nanmedian(miss) < 0.1
    assert np.nanmean(miss > 1) < 0.03
    assert track.rate == 30
    assert track.size == SIZE


def test_streaks_without_bias(tmp_path: Path) -> None:
    """A fast light leaves streaks; the middle of the exposure is measured."""
    camera = room(3, seed=1, size=SIZE)[0]
    points = wand(pace=0.5, lights=1)
    write_video(tmp_path / "a.mp4", camera, points)
    track = track_lights(tmp_path / "a.mp4")
    truth = camera.project_world(points[::4, 0])
    speed = np.linalg.norm(np.gradient(truth, axis=0), axis=1)
    miss = np.linalg.norm(track.pixels[:, 0] - truth, axis=1)
    fast = speed > np.median(speed)
    assert np.median(speed[fast]) > 5
    assert np.nanmedian(miss[fast]) < 0.1
    assert np.nanmean(miss > 1) < 0.05
    assert np.isfinite(miss).mean() > 0.8


def test_pictures_in_a_folder(tmp_path: Path) -> None:
    camera = room(3, seed=1, size=SIZE)[0]
    points = wand(lights=1)[: 4 * 12]
    points = np.concatenate([points[::8], points[::8]])
    for f, picture in enumerate(film(camera, points, frames=12, steps=1, seed=1)):
        write_picture(tmp_path / f"{f:03}.png", picture)
    track = track_lights(tmp_path)
    assert track.name == tmp_path.name
    assert track.rate is None
    assert track.none == 0
    miss = np.linalg.norm(track.pixels[:, 0] - camera.project_world(points[:, 0]), axis=1)
    assert np.nanmedian(miss) < 0.1
    write_picture(tmp_path / "999.png", np.zeros((20, 30), np.uint8))
    with pytest.raises(UserError, match="the others 400 x 300"):
        track_lights(tmp_path)


def test_saturation_does_not_bias() -> None:
    """Where the brightest pixels are cut, the flanks tell the place; the error is honest."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:15, :17].astype(float)
    for peak in (150.0, 1500.0):
        off: list[float] = []
        for _ in range(60):
            place = np.array([8, 7]) + rng.uniform(-0.5, 0.5, 2)
            dx, dy = x - place[0], y - place[1]
            picture = peak * np.exp(-(0.12 * dx**2 + 0.1 * dx * dy + 0.2 * dy**2))
            picture = np.clip(picture + 8 * rng.standard_normal(x.shape), -50, 255)
            fit = fit_spot(picture.astype(np.float32), picture > 248, 8.0)
            assert fit is not None
            off.extend(((fit[0] - place) / fit[1]).tolist())
        assert abs(np.mean(off)) < 0.5
        # The error is that of the worse direction.
        assert 0.6 < np.std(off) < 1.2


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such video"):
        track_lights(tmp_path / "no.mp4")
    (tmp_path / "broken.mp4").write_bytes(b"\0" * 100)
    with pytest.raises(UserError, match="not a readable video"):
        track_lights(tmp_path / "broken.mp4")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(UserError, match="holds no pictures"):
        track_lights(empty)
    for f in range(5):
        write_picture(empty / f"{f}.png", np.full((60, 80), 40, np.uint8))
    with pytest.raises(UserError, match="shows no moving light"):
        track_lights(empty)
    nothing = np.zeros((4, 1, 2))
    one = LightTrack("a", (9, 9), 30.0, nothing, nothing[..., 0], 0, 0, 0)
    other = LightTrack("b", (9, 9), 25.0, nothing, nothing[..., 0], 0, 0, 0)
    with pytest.raises(UserError, match="25 and 30 frames a second"):
        together([one, other])
    with pytest.raises(UserError, match="two recordings are called a"):
        together([one, one])


def test_command(
    videos: tuple[list[Path], list[CameraModel]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Three videos of a wand to posed cameras in metres."""
    files, cameras = videos
    lenses = [tmp_path / f"{c}.cameramodel" for c in range(3)]
    for lens, camera in zip(lenses, cameras, strict=True):
        camera.write(lens)
    output = tmp_path / "rig"
    words = ["calibrate", "wand", *files, "--lens", *lenses, "--wand", LENGTH, "-o", output]
    build_app()([str(w) for w in [*words, "--json"]], result_action="return_value")
    captured = capsys.readouterr()
    figures = json.loads(captured.out)
    assert "cam1.mp4: " in captured.err
    assert figures["unit"] == "m"
    assert figures["sigma"] < 0.15
    assert figures["tracks"]["cam0"]["frames"] == FRAMES
    rig = read_rig(output / "rig.json")
    truth = cameras[0].world_from_camera.inverse()
    for c in (1, 2):
        there = rig[f"cam{c}"].camera.world_from_camera.translation
        expected = (truth @ cameras[c].world_from_camera).translation
        assert np.linalg.norm(there - expected) < 0.006
    assert len(read_json(output / "rig.json.record.json")["inputs"]) == 6


def test_command_refuses(tmp_path: Path) -> None:
    output = tmp_path / "rig"
    for words, message in (
        ([], "name a video or folder"),
        (["--points", tmp_path, tmp_path], "name a video or folder"),
        (["--points", tmp_path, "--wand", "0.5"], "hold one light"),
        ([tmp_path, "--wand", "half"], "write the distance of two lights"),
        ([tmp_path, "--wand", "1,2,3"], "write the distance of two lights"),
        ([tmp_path, "--wand", "0.5", "--lights", "3"], "as many as --wand says"),
        ([tmp_path, "--wand", "0.5", "--distance", "a,b,2"], "choose one"),
    ):
        with pytest.raises(UserError, match=message):
            build_app()(
                [str(w) for w in ("calibrate", "wand", "-o", output, *words)],
                result_action="return_value",
            )
    assert not list(output.glob("*"))
