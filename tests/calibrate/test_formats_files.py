"""Files of other tools as they come: the commands, what is refused, and any bytes at all."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from chromeball.calibrate.formats import (
    Hints,
    NamedCamera,
    read_camera,
    read_cameras,
    read_lenses,
    write_cameras,
)
from chromeball.calibrate.rig_file import Rig, RigCamera, write_rig
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

POSE = Pose.from_rotation_vector([0.3, -0.5, 0.2], [0.4, -1.3, 2.5])
LENS = CameraModel(
    "LENSMODEL_OPENCV5",
    np.array([400, 401, 321, 239, -0.2, 0.05, 0, 0, 0.01]),
    (640, 480),
    POSE,
)
FISHEYE = CameraModel("kb4", np.array([200, 200, 321, 239, 0.02, 0, 0, 0.0]), (640, 480))
DATA = Path(__file__).parents[2] / "../shared/data"


def run(*words: object) -> None:
    build_app()([str(word) for word in words], result_action="return_value")


def refusal(*words: object) -> str:
    with pytest.raises(UserError) as told:
        run(*words)
    assert "\n" not in str(told.value)
    return str(told.value)


# ---- commands


def test_convert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, camera in (("a", LENS), ("b", FISHEYE)):
        camera.write(tmp_path / f"{name}.cameramodel")
    a, b = tmp_path / "a.cameramodel", tmp_path / "b.cameramodel"
    run("calibrate", "convert", a, b, "-o", tmp_path / "chain.yaml", "--to", "kalibr")
    told = capsys.readouterr()
    assert "a: LENSMODEL_OPENCV5 as" in told.err
    assert "left behind: a chain has no world" in told.err
    record = json.loads((tmp_path / "chain.yaml.record.json").read_text())["figures"]
    (loss,) = record["conversions"]
    assert (loss["camera"], loss["was"]) == ("a", "LENSMODEL_OPENCV5")
    back = read_cameras([tmp_path / "chain.yaml"])
    relative = LENS.world_from_camera.inverse() @ FISHEYE.world_from_camera
    assert back[1].camera.world_from_camera.matrix() == pytest.approx(relative.matrix())

    run("calibrate", "convert", tmp_path / "chain.yaml", "-o", tmp_path / "rig", "--json")
    assert json.loads(capsys.readouterr().out)["format"] == "cameramodel"
    assert sorted(p.name for p in (tmp_path / "rig").glob("*.cameramodel")) == [
        "cam0.cameramodel",
        "cam1.cameramodel",
    ]
    one = tmp_path / "one.usda"
    run(
        "calibrate",
        "convert",
        tmp_path / "rig",
        "--camera",
        "cam1",
        "-o",
        one,
        "--model",
        "kb4",
    )
    assert one.read_text().count("def Camera") == 1
    run(
        "calibrate",
        "convert",
        a,
        b,
        "--origin",
        "a",
        "-o",
        tmp_path / "from_a",
        "--to",
        "colmap",
    )
    placed = {c.name: c.camera for c in read_cameras([tmp_path / "from_a"])}
    assert placed["a"].world_from_camera.matrix() == pytest.approx(np.eye(4))
    assert placed["b"].world_from_camera.matrix() == pytest.approx(relative.matrix())


def test_export_of_a_scene(tmp_path: Path) -> None:
    write_cameras(tmp_path / "plate.yml", [NamedCamera("plate", LENS)])
    (tmp_path / "scene.toml").write_text(
        'name = "set"\n[[view]]\nname = "front"\nplate = "p.exr"\ncamera = "plate.yml"\n'
        '[[view]]\nname = "side"\nmodel = "pinhole"\nsize = [320, 200]\nfov = 60\n'
        "position = [1, 2, 3]\n"
    )
    run("export", "usd", tmp_path / "scene.toml", "-o", tmp_path / "cameras.usda")
    pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    front, side = read_cameras([tmp_path / "cameras.usda"])
    assert (front.name, side.name) == ("front", "side")
    assert front.camera.intrinsics.tolist() == LENS.intrinsics.tolist()
    assert side.camera.world_from_camera.translation == pytest.approx([1, 2, 3])


def test_a_lens_of_any_format_undistorts(tmp_path: Path) -> None:
    from chromeball.scene.image import write_picture

    write_picture(tmp_path / "p.png", np.full((480, 640, 3), 99, np.uint8))
    write_cameras(tmp_path / "lens.xml", [NamedCamera("lens", LENS)])
    run(
        "calibrate", "undistort", tmp_path / "p.png", "--camera", tmp_path / "lens.xml",
        "-o", tmp_path / "flat.png",
    )  # fmt: skip
    assert (tmp_path / "flat.cameramodel").is_file()


def test_refusals(tmp_path: Path) -> None:
    LENS.write(tmp_path / "a.cameramodel")
    a, out = tmp_path / "a.cameramodel", tmp_path / "out"
    four = tmp_path / "four.json"
    matrix = [[400, 0, 320], [0, 401, 240], [0, 0, 1]]
    four.write_text(json.dumps({"K": matrix, "D": [0.1, 0, 0, 0], "image_size": [640, 480]}))
    unsized = tmp_path / "unsized.json"
    unsized.write_text(json.dumps({"K": matrix, "D": []}))
    (tmp_path / "latlong.cameramodel").write_text(CameraModel.latlong((64, 32)).text())
    for words, said in (
        ((a, "-o", out, "--to", "maya"), "one of cameramodel"),
        ((a, "-o", tmp_path / "b.obj"), "no format is written as .obj"),
        ((a, "-o", tmp_path / "b.yaml"), "--to opencv or --to kalibr"),
        ((a, "-o", tmp_path / "b.yaml", "--to", "colmap"), "written as a folder"),
        ((a, "-o", a), "is an input"),
        ((a, "-o", out, "--camera", "b"), "there is no camera 'b'"),
        ((a, "-o", out, "--model", "splined"), "one of pinhole"),
        ((a, "-o", out, "--to", "colmap", "--model", "opencv12"), "COLMAP's model has pinhole"),
        ((a, "-o", out, "--size", "640"), "640x480"),
        ((tmp_path / "none.yml", "-o", out), "no such file"),
        ((four, "-o", out), "add --fisheye or --no-fisheye"),
        ((unsized, "-o", out), "add --size"),
        ((tmp_path / "latlong.cameramodel", "-o", tmp_path / "b.yml"), "panorama"),
    ):
        assert said in refusal("calibrate", "convert", *words)
    assert not out.exists()
    run("calibrate", "convert", four, "--fisheye", "-o", tmp_path / "f.cameramodel")
    assert read_camera(tmp_path / "f.cameramodel").model == "kb4"
    run("calibrate", "convert", four, "--no-fisheye", "-o", tmp_path / "p.cameramodel")
    assert read_camera(tmp_path / "p.cameramodel").model == "LENSMODEL_OPENCV4"
    run("calibrate", "convert", unsized, "--size", "640x480", "-o", tmp_path / "u.cameramodel")
    assert read_camera(tmp_path / "u.cameramodel").size == (640, 480)


def test_where_one_camera_is_wanted(tmp_path: Path) -> None:
    rig = [NamedCamera(n, LENS, rig=True) for n in ("a", "b")]
    write_cameras(tmp_path / "pair.yml", rig)
    with pytest.raises(UserError, match="holds 2 cameras"):
        read_camera(tmp_path / "pair.yml")
    (tmp_path / "eucm.yaml").write_text(
        "cam0: {camera_model: eucm, intrinsics: [0.9, 2, 150, 150, 320, 240],\n"
        "  distortion_model: none, distortion_coeffs: [], resolution: [640, 480]}\n"
    )
    with pytest.raises(UserError, match="eucm-none lens is none of ours"):
        read_camera(tmp_path / "eucm.yaml")


def test_a_rig_folder_keeps_order_and_times(tmp_path: Path) -> None:
    """As `calibrate rig` writes it, and as `calibrate wand` does."""
    for name in "ab":
        LENS.write(tmp_path / f"{name}.cameramodel")
    rig = tmp_path / "rig.json"
    b = RigCamera("b", LENS, np.zeros((6, 6)), 0.1, 0.1, None, None, None, None)
    a = replace(b, name="a", time_offset=-0.02)
    write_rig(rig, Rig((b, a), "b counts as exact"))
    for source in (tmp_path, rig):
        found = read_cameras([source])
        assert [(c.name, c.time_shift, c.rig) for c in found] == [
            ("b", None, True),
            ("a", -0.02, True),
        ]
    cost = write_cameras(tmp_path / "c.yaml", found, "kalibr")
    assert [c.time_shift for c in read_cameras([tmp_path / "c.yaml"])] == [None, -0.02]
    assert len(cost.left_behind) == 1  # the place of the first
    write_rig(rig, Rig((b, a), "b counts as exact", unit="feet"))
    cost = write_cameras(tmp_path / "c.usda", read_cameras([tmp_path]))
    assert "b: places are in feet, not in metres" in cost.notes
    assert set(read_lenses(tmp_path)) == {"a", "b"}
    assert set(read_lenses(tmp_path / "a.cameramodel")) == {"a"}
    assert len(read_lenses(tmp_path / "c.yaml")) == 2
    write_rig(rig, Rig((b, replace(b, name="c")), "b counts as exact"))
    with pytest.raises(UserError, match="there is no c"):
        read_cameras([tmp_path])


def test_a_pose_keeps_what_else_is_known(tmp_path: Path) -> None:
    """`calibrate pose` moves a camera: covariance and mrcal's inputs stay in the file."""
    lens = replace(
        LENS, covariance=np.diag(np.arange(1.0, 10)), world_from_camera=Pose.identity()
    )
    text = lens.text().replace("{", "{ # of a rig\n 'optimization_inputs': b'kept',", 1)
    (tmp_path / "lens.cameramodel").write_text(text)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    place = Pose.look_at(
        np.array([0.5, 1.5, 3.0]), np.array([0.5, 0, 0.5]), np.array([0, 1.0, 0])
    )
    pixels = lens.posed(place).project_world(corners)
    (tmp_path / "align.json").write_text(json.dumps({"corners": corners.tolist()}))
    run(
        "calibrate", "pose", "--camera", tmp_path / "lens.cameramodel",
        "--align", tmp_path / "align.json",
        "--points", " ".join(f"{x},{y}" for x, y in pixels.tolist()),
        "-o", tmp_path / "posed.cameramodel",
    )  # fmt: skip
    posed = (tmp_path / "posed.cameramodel").read_text()
    assert "'optimization_inputs': b'kept'" in posed
    camera = read_camera(tmp_path / "posed.cameramodel")
    assert camera.covariance is not None
    assert camera.world_from_camera.translation == pytest.approx([0.5, 1.5, 3.0], abs=1e-4)


# ---- files of other people


def test_real_files_of_opencv() -> None:
    folder = DATA / "calibrate/opencv_stereo"
    if not folder.is_dir():
        pytest.skip("OpenCV's stereo set is not here")
    (left,) = read_cameras([folder / "left_intrinsics.yml"])
    assert left.camera.model == "LENSMODEL_OPENCV5"
    assert left.camera.intrinsics[[0, 2, 4]] == pytest.approx(
        [535.91573, 342.28315, -0.2663726]
    )
    with pytest.raises(UserError, match="add --size"):
        read_cameras([folder / "intrinsics.yml"])
    pair = read_cameras([folder / "intrinsics.yml"], Hints(size=(640, 480)))
    assert [c.name for c in pair] == ["left", "right"]
    assert pair[1].camera.intrinsics[:3] == pytest.approx([534.80327, 534.80327, 334.55745])
    with pytest.raises(UserError, match="no camera"):
        read_cameras([folder / "stereo_calib.xml"])


def test_real_cameras_of_a_room() -> None:
    """Four cameras, a file each, named by their folders; poses in a second notation."""
    files = sorted((DATA / "stand_in/uu_person").glob("cam*/config.xml"))
    if len(files) != 4:
        pytest.skip("the room of four cameras is not here")
    cameras = read_cameras(files, Hints(size=(644, 486)))
    assert [c.name for c in cameras] == [f"cam{i}_config" for i in (1, 2, 3, 4)]
    places = np.array([c.camera.world_from_camera.translation for c in cameras])
    middle = places.mean(axis=0)
    # they look at what stands between them
    for camera, place in zip(cameras, places, strict=True):
        forward = camera.camera.world_from_camera.rotation[:, 2]
        assert forward @ (middle - place) > 0.5 * np.linalg.norm(middle - place)


def test_extrinsics_in_a_second_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """OpenCV's stereo sample writes two files, by `cv2.FileStorage`."""
    import cv2

    k = np.array([[400, 0, 320], [0, 401, 240], [0, 0, 1.0]])
    first = cv2.FileStorage(str(tmp_path / "intrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (
        ("M1", k),
        ("D1", np.zeros((1, 14))),
        ("M2", k),
        ("D2", np.zeros((1, 5))),
    ):
        first.write(name, value)
    first.release()
    second = cv2.FileStorage(str(tmp_path / "extrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    inverse = POSE.inverse()
    for name, value in (("R", inverse.rotation), ("T", inverse.translation), ("Q", np.eye(4))):
        second.write(name, value)
    second.release()
    files = [tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"]
    left, right = read_cameras(files, Hints(size=(640, 480)))
    assert left.camera.world_from_camera.matrix().tolist() == np.eye(4).tolist()
    assert right.camera.world_from_camera.matrix() == pytest.approx(POSE.matrix())
    with pytest.raises(UserError, match="file with that before it"):
        read_cameras(files[1:])
    # the folder of both is the pair; without the second file nobody knows where one stands
    assert [c.camera.world_from_camera.matrix().tolist() for c in (left, right)] == [
        c.camera.world_from_camera.matrix().tolist()
        for c in read_cameras([tmp_path], Hints(size=(640, 480)))
    ]
    alone = read_cameras(files[:1], Hints(size=(640, 480)))
    assert not any(c.rig for c in alone)
    assert "not known" in alone[1].notes[0]
    assert "extrinsics.yml, which lies" in alone[1].notes[0]
    files[1].unlink()
    run("calibrate", "convert", files[0], "--size", "640x480", "-o", tmp_path / "rig")
    warned = capsys.readouterr().err
    assert "warning: right: no R and T" in warned
    assert "name the file that has them" in warned


def test_what_export_writes_is_read_back(tmp_path: Path) -> None:
    """A folder of OpenCV's files with their records, as the command leaves it."""
    rig = [NamedCamera("a", LENS), NamedCamera("b", FISHEYE.posed(Pose.identity()))]
    write_cameras(tmp_path / "rig", rig)
    run("export", "opencv", tmp_path / "rig", "-o", tmp_path / "storage")
    (tmp_path / "storage/notes.json").write_text('{"made": "on set"}')
    run("calibrate", "convert", tmp_path / "storage", "-o", tmp_path / "back")
    for there, here in zip(rig, read_cameras([tmp_path / "back"]), strict=True):
        assert here.name == there.name
        np.testing.assert_allclose(here.camera.intrinsics, there.camera.intrinsics)
        np.testing.assert_allclose(
            here.camera.world_from_camera.matrix(),
            there.camera.world_from_camera.matrix(),
            atol=1e-12,
        )
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no camera in this folder"):
        read_cameras([tmp_path / "empty"])
    pose = {"R": np.eye(3).tolist(), "T": [0, 0, 1]}
    (tmp_path / "storage/pose.json").write_text(json.dumps(pose))
    with pytest.raises(UserError, match=r"2 files of cameras and R and T apart .* pose\.json"):
        read_cameras([tmp_path / "storage"])


def test_single_cameras_of_kalibr_and_its_data(tmp_path: Path) -> None:
    """EuRoC's sensor.yaml: one camera at the root, radial-tangential."""
    file = tmp_path / "sensor.yaml"
    there = POSE.matrix()
    file.write_text(
        "%YAML:1.0\nsensor_type: camera\nrate_hz: 20\nresolution: [752, 480]\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: {there.ravel().tolist()}\n"
        "camera_model: pinhole\nintrinsics: [458.654, 457.296, 367.215, 248.375]\n"
        "distortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    (found,) = read_cameras([file])
    assert found.camera.model == "LENSMODEL_OPENCV4"
    np.testing.assert_allclose(found.camera.world_from_camera.matrix(), there, atol=1e-12)
    rig = [NamedCamera(n, LENS) for n in "abc"]
    assert write_cameras(tmp_path / "camchain.yaml", rig[:1]).losses[0][1].was == LENS.model
    write_cameras(tmp_path / "three.yaml", rig)  # more than a file of OpenCV's holds
    assert [c.name for c in read_cameras([tmp_path / "three.yaml"])] == ["cam0", "cam1", "cam2"]


def test_configurations_of_rigs(tmp_path: Path) -> None:
    """rig_config.json as COLMAP takes it: there and back, and what it leaves open."""
    lens = CameraModel("LENSMODEL_OPENCV4", LENS.intrinsics[:8], LENS.size)
    rig = [
        NamedCamera("left", lens, rig=True),
        NamedCamera("right", lens.posed(POSE), rig=True),
    ]
    write_cameras(tmp_path / "model", rig, "colmap")
    beside = tmp_path / "model" / "rig_config.json"
    alone = tmp_path / "rig_config.json"
    alone.write_text(beside.read_text())
    for file, hints in ((beside, Hints()), (alone, Hints(size=LENS.size))):
        for there, here in zip(rig, read_cameras([file], hints), strict=True):
            assert (here.name, here.rig, here.camera.size) == (there.name, True, LENS.size)
            np.testing.assert_allclose(here.camera.intrinsics, lens.intrinsics)
            np.testing.assert_allclose(
                here.camera.world_from_camera.matrix(),
                there.camera.world_from_camera.matrix(),
                atol=1e-12,
            )
    assert [c.name for c in read_cameras([tmp_path / "model" / "rigs.txt"])] == [
        "camera1",
        "camera2",
    ]
    with pytest.raises(
        UserError, match="left: it does not tell the picture's size: add --size"
    ):
        read_cameras([alone])
    config = json.loads(beside.read_text())
    del config[0]["cameras"][1]["cam_from_rig_rotation"]
    alone.write_text(json.dumps(config))
    assert "not known" in read_cameras([alone], Hints(size=LENS.size))[1].notes[0]
    for change, said in (
        (config * 2, "several rigs"),
        ([{"cameras": [{"image_prefix": "left/"}]}], "left: it says where .* but has no lens"),
        ([{"cameras": 3}], "no readable rig"),
        ([{"cameras": [{"ref_sensor": True}]}], "camera1: 'image_prefix' is missing"),
    ):
        alone.write_text(json.dumps(change))
        with pytest.raises(UserError, match=said):
            read_cameras([alone])


def test_ros_and_words_of_others(tmp_path: Path) -> None:
    ros = tmp_path / "ros.yaml"
    ros.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: head\n"
        "camera_matrix: {rows: 3, cols: 3, data: [400, 0, 320, 0, 4.01e2, 240, 0, 0, 1]}\n"
        "distortion_model: equidistant\n"
        "distortion_coefficients: {rows: 1, cols: 4, data: [0.01, 1e-3, 0, 0]}\n"
    )
    (camera,) = read_cameras([ros])
    assert (camera.name, camera.camera.model) == ("head", "kb4")
    assert camera.camera.intrinsics.tolist() == [400, 401, 320, 240, 0.01, 1e-3, 0, 0]
    ros.write_text(ros.read_text().replace("equidistant", "plumb_bob"))
    assert read_camera(ros).model == "LENSMODEL_OPENCV4"


def test_a_tilted_sensor_comes_near(tmp_path: Path) -> None:
    terms = [-0.2, 0.05, 0, 0, 0.01, 0, 0, 0, 0, 0, 0, 0, 0.01, -0.02]
    file = tmp_path / "t.json"
    matrix = [[400, 0, 320], [0, 401, 240], [0, 0, 1]]
    file.write_text(json.dumps({"K": matrix, "D": terms, "image_size": [640, 480]}))
    (named,) = read_cameras([file])
    assert named.camera.model == "LENSMODEL_OPENCV12"
    assert named.loss is not None
    assert 0 < named.loss.rms < 0.5


# ---- anything at all


def read_or_refuse(path: Path, hints: Hints) -> None:
    """Cameras, or one line."""
    try:
        assert read_cameras([path], hints)
        return
    except UserError as error:
        told = str(error)
    assert "\n" not in told


def test_no_tag_is_carried_out(tmp_path: Path) -> None:
    made = tmp_path / "made"
    file = tmp_path / "bad.yaml"
    for tag in ("!!python/object/apply:pathlib.Path.touch", "!!python/object/apply:os.mkdir"):
        file.write_text(f"cam0: {tag} ['{made}']\ncamera_matrix: {tag} ['{made}']\n")
        with pytest.raises(UserError):
            read_cameras([file])
        assert not made.exists()


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "{a: " * 5000, "- " * 50_000, '{"a":' * 50_000]
)
@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_deep_nesting_is_refused(text: str, suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"deep{suffix}"
    file.write_text(text)
    with pytest.raises(UserError):
        read_cameras([file])
    file.write_text("<a>" * 50_000)
    with pytest.raises(UserError):
        read_cameras([file])


CALM = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
NAMES = (
    "any.yml", "any.json", "any.xml", "any.cameramodel", "any.py", "cameras.txt", "cameras.bin",
    "any.usda",
)  # fmt: skip


@CALM
@given(data=st.binary(max_size=300), name=st.sampled_from(NAMES))
def test_any_bytes_are_cameras_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, name: str
) -> None:
    file = tmp_path_factory.mktemp("any") / name
    file.write_bytes(data)
    read_or_refuse(file, Hints((640, 480), fisheye=True))


VALUES = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8),
        st.sampled_from([640, 480, 0, -1, 400.0, "pinhole", "omni", "ds", "radtan", "none"]),
        st.just([400, 0, 320, 0, 400, 240, 0, 0, 1]), st.just([400, 400, 320, 240]),
        st.just([0.1, 0, 0, 0]), st.just(np.eye(4).tolist()), st.just([640, 480]),
    ),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.sampled_from(["rows", "cols", "data", "a"]), inner, max_size=3),
    max_leaves=8,
)  # fmt: skip
KALIBR = [
    "camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution",
    "T_cn_cnm1", "T_cam_imu", "timeshift_cam_imu",
]  # fmt: skip
OPENCV = [
    "camera_matrix", "distortion_coefficients", "image_width", "image_height", "fisheye_model",
    "R", "T", "K", "D", "M1", "D1", "M2", "D2", "camera_name", "distortion_model",
]  # fmt: skip


@CALM
@given(
    tree=st.one_of(
        st.dictionaries(st.sampled_from(OPENCV), VALUES),
        st.dictionaries(
            st.sampled_from(["cam0", "cam1", "cam7"]),
            st.dictionaries(st.sampled_from(KALIBR), VALUES),
        ),
    ),
    kind=st.sampled_from(["yml", "json"]),
)
def test_any_tree_is_cameras_or_refused(
    tmp_path_factory: pytest.TempPathFactory, tree: dict[str, object], kind: str
) -> None:
    file = tmp_path_factory.mktemp("tree") / f"any.{kind}"
    file.write_text(yaml.safe_dump(tree) if kind == "yml" else json.dumps(tree))
    read_or_refuse(file, Hints((640, 480)))


@CALM
@given(
    places=st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), max_size=4),
    cut=st.integers(0, 5000),
    stem=st.sampled_from(["cameras", "images", "rigs"]),
    binary=st.booleans(),
)
def test_broken_models_of_colmap(
    tmp_path_factory: pytest.TempPathFactory,
    places: list[tuple[int, int]],
    cut: int,
    stem: str,
    binary: bool,
) -> None:
    """A few bytes changed, the end cut off: refused at once, without waiting for ever."""
    folder = tmp_path_factory.mktemp("model")
    rig = [NamedCamera("a", LENS, rig=True), NamedCamera("b", FISHEYE, rig=True)]
    write_cameras(folder, rig, "colmap-binary" if binary else "colmap")
    file = folder / f"{stem}.{'bin' if binary else 'txt'}"
    data = bytearray(file.read_bytes())
    for at, value in places:
        data[at % len(data)] = value
    file.write_bytes(data[: max(1, cut)])
    read_or_refuse(folder, Hints())


@CALM
@given(name=st.text(max_size=12))
def test_any_name(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    """Of a camera: a file within the folder, or a sentence."""
    folder = tmp_path_factory.mktemp("names")
    for to in ("cameramodel", "opencv", "usd", "blender", "kalibr"):
        output = {"usd": "a.usda", "blender": "a.py", "kalibr": "a.yaml"}.get(to, to)
        try:
            write_cameras(folder / output, [NamedCamera(name, FISHEYE)], to)
        except UserError:
            continue
        source = folder / output
        files = list(source.iterdir()) if source.is_dir() else [source]
        assert len(files) == 1
        (back,) = read_cameras(files)
        assert back.camera.intrinsics.tolist() == FISHEYE.intrinsics.tolist()
        assert "/" not in files[0].name
