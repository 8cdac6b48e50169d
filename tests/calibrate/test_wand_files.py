"""Files of tracks and lenses: read, refused, and the command as a user calls it."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from chromeball.calibrate.rig_file import read_rig
from chromeball.calibrate.virtual_wand import path, room, watch
from chromeball.calibrate.wand_files import read_centres, read_lens, read_points
from chromeball.calibrate.wand_result import Tracks
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image
from chromeball.scene.record import read_json


def write_points(folder: Path, tracks: Tracks) -> None:
    folder.mkdir(exist_ok=True)
    pixels = tracks.pixels[:, :, 0]
    rows = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2)
    np.savetxt(folder / "points.dat", rows.transpose(0, 2, 1).reshape(-1, pixels.shape[1]))
    np.savetxt(folder / "IdMat.dat", tracks.seen())
    np.savetxt(folder / "Res.dat", tracks.sizes, fmt="%d")
    (folder / "camera_order.txt").write_text("\n".join(tracks.names))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[CameraModel], Tracks]:
    cameras = room(3, seed=1)
    tracks = watch(cameras, path(150, extent=1.2, seed=1), missing=0.05, seed=1)
    folder = tmp_path_factory.mktemp("points")
    write_points(folder, tracks)
    for i, camera in enumerate(cameras):
        camera.write(folder / f"{i}.cameramodel")
    centres = [c.world_from_camera.translation for c in cameras]
    np.savetxt(folder / "centres.txt", centres)
    return folder, cameras, tracks


def test_points_come_back(scene: tuple[Path, list[CameraModel], Tracks]) -> None:
    folder, _, tracks = scene
    found = read_points(folder)
    assert found.names == tracks.names
    assert found.sizes == tracks.sizes
    np.testing.assert_allclose(found.pixels, tracks.pixels, rtol=1e-12)


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    name=st.sampled_from(["points.dat", "IdMat.dat", "Res.dat", "camera_order.txt", "a.rad"]),
    content=st.one_of(
        st.binary(max_size=80),
        st.text("0123456789.-+eE naif\n=Kk", max_size=80).map(str.encode),
    ),
)
def test_broken_files(tmp_path: Path, name: str, content: bytes) -> None:
    """Whatever stands in a file: tracks, or one sentence."""
    tracks = Tracks(("a", "b"), ((4, 3), (4, 3)), np.ones((2, 3, 1, 2)), np.ones((2, 3, 1)))
    write_points(tmp_path, tracks)
    (tmp_path / name).write_bytes(content)
    with suppress(UserError):
        found = read_points(tmp_path)
        assert found.pixels.shape[2:] == (1, 2)
        assert len(found.names) == len(found.sizes) == len(found.pixels)
    with suppress(UserError):
        read_lens(tmp_path / "a.rad", (4, 3))


def test_rad(tmp_path: Path) -> None:
    file = tmp_path / "a.rad"
    text = "K11 = 400.5\nK12 = 0\nK13 = 320\nK22 = 401\nK23 = 240\n\nkc1 = -.3\nkc2 = .1\n"
    file.write_text(text + "kc3 = 0.001\nkc4 = -0.002\n")
    camera = read_lens(file, (640, 480))
    assert camera.model == "LENSMODEL_OPENCV4"
    np.testing.assert_array_equal(
        camera.intrinsics, [400.5, 401, 320, 240, -0.3, 0.1, 0.001, -0.002]
    )
    file.write_text(text)
    with pytest.raises(UserError, match="no kc3, kc4 in it"):
        read_lens(file, (640, 480))


def run(*words: object) -> None:
    build_app()(
        [str(word) for word in ("calibrate", "wand", *words)], result_action="return_value"
    )


def test_command(
    scene: tuple[Path, list[CameraModel], Tracks],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, cameras, _ = scene
    lenses = [folder / f"{i}.cameramodel" for i in range(3)]
    output = tmp_path / "rig"
    words = ["--points", folder, "--lens", *lenses, "-o", output]
    run(*words, "--centres", folder / "centres.txt")
    out = capsys.readouterr().out
    assert "3 cameras, RMS" in out
    assert "lengths in metres" in out
    rig = read_rig(output / "rig.json")
    assert rig.unit == "m"
    for name, camera in zip(("cam0", "cam1", "cam2"), cameras, strict=True):
        there = CameraModel.read(output / f"{name}.cameramodel").world_from_camera
        told = rig[name].camera.world_from_camera
        np.testing.assert_allclose(there.matrix(), told.matrix(), atol=1e-14)
        assert rig[name].covariance.shape == (6, 6)
        np.testing.assert_allclose(
            there.translation, camera.world_from_camera.translation, atol=3e-3
        )
    record = read_json(output / "rig.json.record.json")
    assert "from the centres given:" in out
    assert max(record["figures"]["centres"]["misses"].values()) < 3e-3
    assert len(record["inputs"]) == 7
    assert read_image(output / record["figures"]["plots"]["rig"]).size[0] > 800

    run(*words, "--up", "camera", "--json")
    captured = capsys.readouterr()
    figures = json.loads(captured.out)
    assert figures["unit"] == "distance of cam0 and cam1"
    assert "nothing tells the scale" in captured.err


def test_command_refuses(scene: tuple[Path, list[CameraModel], Tracks], tmp_path: Path) -> None:
    folder, _, _ = scene
    lens = folder / "0.cameramodel"
    output = tmp_path / "rig"
    for words, message in (
        (["--up", "camera", "--floor", "1,2,3"], "choose one"),
        (["--centres", lens, "--distance", "cam0,cam1,2"], "choose one"),
        (["--refine"], "name them with --lens"),
        (["--lens", lens, lens], "a lens each or one for all, not 2"),
        (["--distance", "cam0,cam9,2"], "write two of cam0, cam1, cam2 and metres"),
        (["--distance", "cam0,cam1,-2"], "write two of"),
        (["--lens", lens, "--floor", "1,b,3"], "write three frames"),
        (["--lens", lens, "--centres", lens], "not lines of equally many numbers"),
    ):
        with pytest.raises(UserError, match=message):
            run("--points", folder, "-o", output, *words)
    assert not list(output.glob("*.cameramodel"))
    with pytest.raises(UserError, match="3 lines of x y z"):
        read_centres(folder / "Res.dat", 3)
    with pytest.raises(UserError, match="no such file"):
        run("--points", tmp_path, "-o", output)
