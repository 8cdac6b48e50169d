"""A rig's pictures, its pairs, rig.json and the command."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chromeball.calibrate.rig_file import read_rig, rig_of, write_rig
from chromeball.calibrate.rig_result import RigSolution
from chromeball.calibrate.rig_views import Plan, Source, find_sources, look, plan_pairs
from chromeball.calibrate.target import Chessboard
from chromeball.calibrate.virtual import photograph
from chromeball.calibrate.virtual_rig import see, waved_board
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

BOARD = Chessboard(6, 5, 0.05)


def run(*words: str) -> None:
    build_app()(list(words), result_action="return_value")


def source(name: str, *files: str) -> Source:
    return Source(name, tuple(Path(name) / f for f in files), None)


def pairs(plan: Plan) -> dict[str, list[int]]:
    return {label: plan.frames[:, v].tolist() for v, label in enumerate(plan.labels)}


def test_pairs_by_name_and_number() -> None:
    """Equal names first, then last numbers; 10 comes after 9; every second."""
    alike = [source("a", "x.png", "y.png"), source("b", "y.png", "z.png")]
    assert pairs(plan_pairs(alike)) == {"x": [0, -1], "y": [1, 0], "z": [-1, 1]}
    numbers = [source("a", "l9.png", "l10.png"), source("b", "r_10.jpg", "r_09.jpg")]
    plan = plan_pairs(numbers)
    assert pairs(plan) == {"9": [0, 1], "10": [1, 0]}
    assert list(plan.labels) == ["9", "10"]
    assert plan.stamps is None
    assert plan_pairs(numbers, every=2).labels == ("9",)
    with pytest.raises(UserError, match="no two cameras have pictures of one name or number"):
        plan_pairs([source("a", "x1.png"), source("b", "y2.png")])
    with pytest.raises(UserError, match="camera a has two pictures number 1"):
        plan_pairs([source("a", "x1.png", "y1.png"), source("b", "z1.png")])
    with pytest.raises(UserError, match="--every 0"):
        plan_pairs(numbers, every=0)


def test_pairs_by_times(tmp_path: Path) -> None:
    cameras = [source("cam_1", "p1.png", "p2.png"), source("right", "q7.png", "q8.png")]
    table = tmp_path / "times.csv"
    table.write_text("camera,frame,time\n1,1,0.0\n1,p2.png,1.0\nright,q8,0.1\nright,7,1.2\n")
    plan = plan_pairs(cameras, table)
    assert plan.frames.tolist() == [[0, 1], [1, 0]]
    assert plan.stamps is not None
    np.testing.assert_allclose(plan.stamps, [[0, 1], [0.1, 1.2]])
    table.write_text(
        "sync_index,cam_id,frame_index,frame_time\n5,1,1,9\n6,1,2,10\n6,right,7,9\n5,right,8,9\n"
    )
    assert pairs(plan_pairs(cameras, table)) == {"5": [0, 1], "6": [1, 0]}
    for text, complaint in (
        ("camera,frame\n1,1\n", "no column time"),
        ("camera,frame,time\n1,1,soon\n", "line 2: 'soon' is no time"),
        ("camera,frame,time\n1,1,nan\n", "line 2: 'nan' is no time"),
        ("camera,frame,time\n1,1,0\n", "no times of camera right"),
    ):
        table.write_text(text)
        with pytest.raises(UserError, match=complaint):
            plan_pairs(cameras, table)
    with pytest.raises(UserError, match="not a readable table"):
        plan_pairs(cameras, tmp_path / "none.csv")


def test_sources(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.png").touch()
    (tmp_path / "left" / "notes.txt").touch()
    assert [s.name for s in find_sources([tmp_path])] == ["left", "right"]
    assert len(find_sources([tmp_path / "left", tmp_path / "right"])[0].files) == 1
    with pytest.raises(UserError, match="two cameras or more"):
        find_sources([tmp_path / "left"])
    with pytest.raises(UserError, match="two cameras are called 'left'"):
        find_sources([tmp_path / "left", tmp_path / "left"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no pictures in it"):
        find_sources([tmp_path / "left", tmp_path / "empty"])


def solution() -> RigSolution:
    """Two cameras that were solved, by hand."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * 1e-3
    covariance = np.zeros((12, 12))
    covariance[6:, 6:] = root @ root.T
    lens = CameraModel("kb4", np.array([300.0, 301, 320, 240, 0.01, 0, 0, 0]), (640, 480))
    pose = Pose.from_rotation_vector([0.1, 0.2, 0.3], [0.12, 0.0, 0.05])
    corners = rng.uniform(0, 400, (2, 3, 5, 6, 2))
    return RigSolution(
        names=("left", "right"),
        cameras=(lens, lens.posed(pose)),
        covariance=covariance,
        lens_covariance=(np.eye(8), np.eye(8)),
        bow=np.array([1e-4, 0]),
        observed=corners,
        residuals=rng.normal(0, 0.1, corners.shape),
        sigma=np.full(2, 0.1),
        alone=np.full(2, 0.1),
        rig_from_board=np.tile(np.eye(4), (3, 1, 1)),
        turned=np.zeros((2, 3), bool),
        repeated=(),
        condition=10.0,
        sync=None,
    )


def test_rig_json_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    written = rig_of(solution())
    write_rig(path, written)
    rig = read_rig(path)
    assert rig.covariance is not None
    assert written.covariance is not None
    np.testing.assert_array_equal(rig.covariance, written.covariance)
    assert (rig.unit, rig.gauge, rig.pairs) == ("m", written.gauge, (("left", "right", 3),))
    for a, b in zip(rig.cameras, written.cameras, strict=True):
        assert (a.name, a.rms, a.sigma, a.time_offset) == (b.name, b.rms, b.sigma, None)
        np.testing.assert_array_equal(a.camera.intrinsics, b.camera.intrinsics)
        np.testing.assert_array_equal(a.covariance, b.covariance)
        pose, other = a.camera.world_from_camera, b.camera.world_from_camera
        np.testing.assert_allclose(pose.matrix(), other.matrix(), atol=1e-15)
    length, error = rig.distance("left", "right")
    assert length == pytest.approx(0.13)
    along = np.array([0.12, 0, 0.05]) / 0.13
    assert error == pytest.approx(np.sqrt(along @ rig.covariance[9:, 9:] @ along))
    with pytest.raises(UserError, match="has no camera 'top'; its cameras are left, right"):
        rig["top"]
    told = json.loads(path.read_text())
    assert told["pairs"] == [{"cameras": ["left", "right"], "boards": 3}]
    path.write_text(json.dumps(told | {"covariance": None}))
    with pytest.raises(UserError, match="not known: the pose of left counts as exact"):
        read_rig(path).distance("left", "right")
    told["covariance"].pop()
    path.write_text(json.dumps(told))
    with pytest.raises(UserError, match="not 12 x 12"):
        read_rig(path)
    with pytest.raises(UserError, match="cannot be read"):
        read_rig(tmp_path / "none.json")


@given(st.binary(max_size=60))
def test_no_rig_is_no_rig(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "broken.json"
    path.write_bytes(content)
    with pytest.raises(UserError):
        read_rig(path)


def test_videos_are_searched_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames in two processes as in one; from the cache without decoding; a short video."""
    camera = CameraModel("pinhole", np.array([380.0, 380, 160, 120]), (320, 240))
    videos: list[Source] = []
    for name in ("left", "right"):
        file = tmp_path / f"{name}.avi"
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25, (320, 240))
        for i in range(6):
            place = Pose.from_rotation_vector([0.02 * i, 0.1, 0], [-0.12, -0.1, 0.5])
            picture = photograph(BOARD, camera, place, seed=10 * len(videos) + i)
            writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
        writer.release()
        videos.append(Source(name, (), file))
    plan = plan_pairs(videos, every=2)
    alone = look(videos, plan, BOARD)
    assert np.isfinite(alone.corners).all()
    cache, heard = tmp_path / "cache", list[str]()
    cache.mkdir()
    both = look(videos, plan, BOARD, workers=2, cache=cache, progress=heard.append)
    np.testing.assert_array_equal(both.corners, alone.corners)
    assert len(list(cache.iterdir())) == len(heard) == 6
    assert heard[4].startswith("right 2: 30 of 30 corners")

    def never(*_: object) -> None:
        raise AssertionError("searched again")

    monkeypatch.setattr("chromeball.calibrate.search.judge", never)
    again = look(videos, plan, BOARD, cache=cache)
    np.testing.assert_array_equal(again.corners, alone.corners)
    beyond = Plan(np.array([[0, 9], [0, -1]]), None, ("0", "9"))
    with pytest.raises(UserError, match="the video ends at frame 6, before its time"):
        look(videos, beyond, BOARD, cache=cache)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Virtual photographs of two cameras: models, rig.json, plots, records, the scale told."""
    size = (400, 300)
    truth = {
        "left": CameraModel("pinhole", np.array([380.0, 380, 200, 150]), size),
        "right": CameraModel("pinhole", np.array([390.0, 390, 198, 151]), size),
    }
    truth["left"] = truth["left"].posed(Pose.look_at([-0.15, 0, -0.62], [0.0, 0, 0]))
    truth["right"] = truth["right"].posed(Pose.look_at([0.15, 0.02, -0.62], [0.0, 0, 0]))
    count = 0
    for time in np.arange(0, 20, 0.9).tolist():
        board = waved_board(BOARD, time, turns=1.3)
        middle = board.apply(BOARD.points().mean(axis=(0, 1)))
        board = Pose(board.rotation, board.translation - 0.75 * middle)
        if not all(np.isfinite(see(BOARD, c, board)).all() for c in truth.values()):
            continue
        for name, camera in truth.items():
            (tmp_path / name).mkdir(exist_ok=True)
            there = camera.world_from_camera.inverse() @ board
            picture = photograph(BOARD, camera, there, seed=count)
            cv2.imwrite(str(tmp_path / name / f"{name}{count}.png"), picture)
        count += 1
        if count == 7:
            break
    assert count == 7
    out = tmp_path / "rig"
    command = [
        "calibrate", "rig", str(tmp_path / "left"), str(tmp_path / "right"),
        "--target", "chessboard:6x5:0.05", "-o", str(out),
    ]  # fmt: skip
    run(*command, "--model", "pinhole", "--distance", "left:right:0.4", "--json")
    printed = capsys.readouterr()
    figures = json.loads(printed.out)
    assert figures["rms"] < 0.15
    assert "the board's squares are 1.3" in printed.err
    rig = read_rig(out / "rig.json")
    true = truth["left"].world_from_camera.inverse() @ truth["right"].world_from_camera
    off = rig["right"].camera.world_from_camera.translation - true.translation
    assert np.abs(off).max() < 0.004
    read = CameraModel.read(out / "right.cameramodel")
    np.testing.assert_allclose(
        read.world_from_camera.matrix(), rig["right"].camera.world_from_camera.matrix()
    )
    names = {p.name for p in out.iterdir()}
    assert {"layout.png", "residuals.png", "rig.json.record.json"} <= names
    for extra, complaint in (
        (["--model", "x=kb4"], "the cameras are called left, right"),
        (["--model", "splined"], "unknown lens model 'splined'"),
        (["--distance", "left:left:1"], "write LEFT:RIGHT:METRES"),
        (["--refine"], "--refine is for lenses given by --lens"),
    ):
        with pytest.raises(UserError, match=complaint):
            run(*command, *extra)
