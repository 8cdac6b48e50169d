"""One camera class: every model inverts itself, has its derivative, and survives files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.scene.camera import FISHEYE_MODELS, WORLD_FROM_LATLONG, CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

SIZE = (640, 480)
CORE = [500.0, 510.0, 322.0, 238.0]
POSE = Pose.from_rotation_vector([0.3, -1.2, 0.7], [1.0, 2.0, -3.0])
SPLINED = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=11_Ny=8_fov_x_deg=110"


def fisheye(model: str, degrees: float) -> CameraModel:
    return CameraModel.fisheye(
        model, SIZE, math.radians(degrees), centre=(322.0, 238.0), radius=230.0, pose=POSE
    )


def mrcal_model(name: str, *distortion: float) -> CameraModel:
    return CameraModel(name, np.array([*CORE, *distortion]), SIZE, POSE)


def splined() -> CameraModel:
    knots = np.random.default_rng(0).normal(size=2 * 11 * 8) * 0.01
    return mrcal_model(SPLINED, *knots)


CAMERAS = {
    "pinhole": CameraModel("pinhole", np.array(CORE), SIZE, POSE),
    "equidistant": fisheye("equidistant", 220),
    "equisolid": fisheye("equisolid", 190),
    "stereographic": fisheye("stereographic", 200),
    "orthographic": fisheye("orthographic", 170),
    "kb4": CameraModel(
        "kb4", np.array([150.0, 151, 322, 238, 0.02, -0.01, 0.002, -0.0002]), SIZE, POSE, 1.8
    ),
    "latlong": CameraModel.latlong(SIZE, POSE),
    "opencv4": mrcal_model("LENSMODEL_OPENCV4", -0.1, 0.02, 0.001, -0.002),
    "opencv5": mrcal_model("LENSMODEL_OPENCV5", -0.1, 0.02, 0.001, -0.002, 0.003),
    "opencv8": mrcal_model(
        "LENSMODEL_OPENCV8", -0.1, 0.02, 0.001, -0.002, 0.003, 0.02, -0.01, 0.001
    ),
    "opencv12": mrcal_model(
        "LENSMODEL_OPENCV12", -0.1, 0.02, 1e-3, -2e-3, 3e-3, 0.02, -0.01, 1e-3, *[1e-3] * 4
    ),
    "cahvor": mrcal_model("LENSMODEL_CAHVOR", 0.01, 0.02, 0.0, -0.05, 0.01),
    "mrcal stereographic": mrcal_model("LENSMODEL_STEREOGRAPHIC"),
    "mrcal latlon": mrcal_model("LENSMODEL_LATLON"),
    "mrcal lonlat": mrcal_model("LENSMODEL_LONLAT"),
    "splined": splined(),
}
EVERY = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


def seen_pixels(camera: CameraModel, count: int = 200) -> np.ndarray:
    """Pixels that the lens sees, a little inside its circle."""
    pixels = np.random.default_rng(5).uniform(1, np.array(SIZE) - 2, (count, 2))
    directions = camera.unproject(pixels)
    angle = np.arccos(np.clip(directions[:, 2], -1, 1))
    return pixels[angle < 0.97 * camera.max_angle]


@EVERY
def test_projection_inverts_itself(camera: CameraModel) -> None:
    pixels = seen_pixels(camera)
    assert len(pixels) > 30
    directions = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    scale = np.random.default_rng(6).uniform(0.01, 100, (len(pixels), 1))
    np.testing.assert_allclose(camera.project(directions * scale), pixels, atol=1e-5)


@EVERY
def test_jacobian_is_the_derivative(camera: CameraModel) -> None:
    points = camera.unproject(seen_pixels(camera)) * 2.5
    jacobian = camera.project_with_jacobian(points)[1]
    step = 1e-6
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        slope = (camera.project(points + offset) - camera.project(points - offset)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., axis], slope, rtol=2e-5, atol=2e-4)


@EVERY
def test_shapes_follow_their_input(camera: CameraModel) -> None:
    pixels = seen_pixels(camera)[:12].reshape(3, 4, 2)
    directions = camera.unproject(pixels)
    assert directions.shape == (3, 4, 3)
    projected, jacobian = camera.project_with_jacobian(directions)
    assert projected.shape == (3, 4, 2)
    assert jacobian.shape == (3, 4, 2, 3)
    assert camera.project(directions[0, 0]).shape == (2,)


@EVERY
def test_world_rays_and_world_points_agree(camera: CameraModel) -> None:
    pixels = seen_pixels(camera)
    points = camera.world_from_camera.translation + 3 * camera.rays(pixels)
    np.testing.assert_allclose(camera.project_world(points), pixels, atol=1e-5)


@EVERY
def test_files_keep_everything(camera: CameraModel, tmp_path: Path) -> None:
    camera.write(tmp_path / "a.cameramodel")
    read = CameraModel.read(tmp_path / "a.cameramodel")
    assert (read.model, read.size) == (camera.model, camera.size)
    np.testing.assert_array_equal(read.intrinsics, camera.intrinsics)
    np.testing.assert_allclose(
        read.world_from_camera.matrix(), camera.world_from_camera.matrix(), atol=1e-12
    )
    assert read.max_angle == camera.max_angle
    pixels = seen_pixels(camera)
    np.testing.assert_allclose(read.rays(pixels), camera.rays(pixels), atol=1e-12)


@pytest.mark.parametrize("name", [n for n, c in CAMERAS.items() if "LENSMODEL" in c.model])
def test_mrcal_reads_ours_and_we_read_mrcals(name: str, tmp_path: Path) -> None:
    import mrcal

    camera = CAMERAS[name]
    camera.write(tmp_path / "ours.cameramodel")
    theirs = mrcal.cameramodel(str(tmp_path / "ours.cameramodel"))  # pyright: ignore[reportAttributeAccessIssue]
    rt = np.array(theirs.Rt_ref_cam())
    np.testing.assert_allclose(rt[:3], camera.world_from_camera.rotation, atol=1e-12)
    np.testing.assert_allclose(rt[3], camera.world_from_camera.translation, atol=1e-12)
    theirs.write(str(tmp_path / "theirs.cameramodel"))
    again = CameraModel.read(tmp_path / "theirs.cameramodel")
    pixels = seen_pixels(camera)
    np.testing.assert_allclose(again.rays(pixels), camera.rays(pixels), atol=1e-9)


@EVERY
def test_scaling_the_sensor_keeps_the_rays(camera: CameraModel) -> None:
    doubled = camera.scaled(2.0)
    assert doubled.size == (1280, 960)
    pixels = seen_pixels(camera)
    np.testing.assert_allclose(
        doubled.rays((pixels + 0.5) * 2 - 0.5), camera.rays(pixels), atol=1e-7
    )
    np.testing.assert_allclose(
        camera.scaled(2.0).scaled(0.5).intrinsics, camera.intrinsics, rtol=1e-12
    )


def test_lat_long_axes_are_openexrs() -> None:
    camera = CameraModel.latlong((360, 180))
    middle_y = 89.5
    for pixel, direction in (
        ([179.5, middle_y], [0, 0, 1]),  # centre +Z
        ([269.5, middle_y], [-1, 0, 0]),  # a quarter to the right: -X
        ([89.5, middle_y], [1, 0, 0]),
        ([-0.5, middle_y], [0, 0, -1]),  # both edges: -Z
        ([359.5, middle_y], [0, 0, -1]),
        ([179.5, -0.5], [0, 1, 0]),  # top edge: up
        ([179.5, 179.5], [0, -1, 0]),
    ):
        np.testing.assert_allclose(camera.rays(pixel), direction, atol=1e-12)
    np.testing.assert_allclose(camera.project_world([0, 0, 1]), [179.5, 89.5])
    assert np.linalg.det(WORLD_FROM_LATLONG.rotation) == pytest.approx(1)


def test_fisheye_radius_is_where_the_field_ends() -> None:
    for model in ("equidistant", "equisolid", "stereographic", "orthographic"):
        camera = CameraModel.fisheye(model, (1000, 800), math.radians(170), radius=350.0)
        theta = math.radians(85)
        pixel = camera.project([math.sin(theta), 0, math.cos(theta)])
        np.testing.assert_allclose(pixel, [499.5 + 350, 399.5], atol=1e-9)
        assert np.isnan(camera.project([math.sin(1.6), 0, math.cos(1.6)])).all()
        assert np.isnan(camera.unproject([499.5 + 351, 399.5])).all()


def test_equisolid_keeps_areas() -> None:
    """Solid angle per pixel is 1 / f^2 everywhere, which is what gives it its name."""
    camera = fisheye("equisolid", 190)
    pixels = seen_pixels(camera)
    across, down = 0.01 * np.eye(2)
    dx = (camera.unproject(pixels + across) - camera.unproject(pixels - across)) / 0.02
    dy = (camera.unproject(pixels + down) - camera.unproject(pixels - down)) / 0.02
    area = np.linalg.norm(np.cross(dx, dy), axis=1)
    np.testing.assert_allclose(area, 1 / camera.intrinsics[0] ** 2, rtol=1e-5)


@pytest.mark.parametrize("name", ["pinhole", "opencv8", "cahvor"])
def test_what_lies_behind_is_not_seen(name: str) -> None:
    pixels, jacobian = CAMERAS[name].project_with_jacobian([[0.1, 0.2, -1], [0.1, 0.2, 1]])
    assert np.isnan(pixels[0]).all()
    assert np.isnan(jacobian[0]).all()
    assert np.isfinite(pixels[1]).all()


def test_pinhole_spans_its_field_of_view() -> None:
    camera = CameraModel.pinhole((200, 100), math.radians(90))
    np.testing.assert_allclose(camera.project([1.0, 0, 1]), [199.5, 49.5])
    np.testing.assert_allclose(camera.project([0, 0, 1.0]), [99.5, 49.5])


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        ("nonsense", [1.0], "unknown camera model 'nonsense'"),
        ("LENSMODEL_NONSENSE", [1.0], "mrcal knows no lens model"),
        ("pinhole", [1.0, 2, 3], "pinhole has 4 intrinsics, not 3"),
        ("LENSMODEL_OPENCV8", CORE, "has 12 intrinsics, not 4"),
        ("equisolid", [math.nan, 1, 2], "must be finite"),
    ],
)
def test_broken_cameras_are_refused(model: str, values: list[float], message: str) -> None:
    with pytest.raises(UserError, match=message):
        CameraModel(model, np.array(values), SIZE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a readable camera model"),
        ("{", "not a readable camera model"),
        ("[" * 100_000, "not a readable camera model"),
        ("(" * 150 + ")" * 150, "not a readable camera model"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE'}", "KeyError"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'imagersize': [1e999, 2]}", "OverflowError"),
        ("[1, 2]", "not a readable camera model"),
        ("__import__('os').system('true')", "not a readable camera model"),
        (
            "{'lensmodel': 'CHROMEBALL_NONE', 'intrinsics': [1], 'imagersize': [2, 2]}",
            "unknown camera model 'none'",
        ),
        (
            "{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [1,1,1,1], 'imagersize': [2, 2],"
            " 'rt_cam_ref': [0, 0]}",
            "not a readable camera model",
        ),
    ],
)
def test_broken_files_are_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.cameramodel"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        CameraModel.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such camera model"):
        CameraModel.read(tmp_path / "none.cameramodel")
    (tmp_path / "b").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not a readable camera model"):
        CameraModel.read(tmp_path / "b")


@settings(deadline=None, max_examples=300)
@given(st.sampled_from(sorted(CAMERAS)), st.data())
def test_any_file_gives_a_camera_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    text = CAMERAS[name].text()
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text)))
        end = data.draw(st.integers(start, min(len(text), start + 30)))
        insert = data.draw(
            st.text(max_size=4)
            | st.sampled_from(["nan", "1e400", "-", "[", "]", ",", "None", "'", "1_0", "{"])
        )
        text = text[:start] + insert + text[end:]
    path = tmp_path_factory.getbasetemp() / "fuzzed.cameramodel"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    message = None
    try:
        camera = CameraModel.read(path)
    except UserError as error:
        message = str(error)
    else:
        assert np.isfinite(camera.intrinsics).all()
        assert min(camera.size) >= 1
    if message is not None:
        assert "\n" not in message
        assert message.startswith(str(path))


def test_fisheye_models_are_all_tested() -> None:
    assert set(FISHEYE_MODELS) <= set(CAMERAS)
