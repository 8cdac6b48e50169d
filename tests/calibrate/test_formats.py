"""Cameras in other tools' files: round trips, and their conventions by the tools themselves."""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import mrcal
import numpy as np
import pycolmap
import pytest

from chromeball.calibrate.formats import (
    Hints,
    NamedCamera,
    prepared,
    read_camera,
    read_cameras,
    write_cameras,
)
from chromeball.calibrate.formats.nearest import directions
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

POSE = Pose.from_rotation_vector([0.3, -0.5, 0.2], [0.4, -1.3, 2.5])
SIZE = (640, 480)
FIGUEROA = Path(__file__).parents[2] / "../shared/data/calibrate/mrcal_figueroa"
CORE = [431.7, 428.2, 331.3, 236.6]
BROWN = [-0.21, 0.06, 0.0007, -0.0011, 0.013, 0.021, -0.004, 0.002, 1e-3, -2e-4, 3e-4, 1e-4]


def brown(count: int, pose: Pose = POSE) -> CameraModel:
    name = f"LENSMODEL_OPENCV{count}" if count else "pinhole"
    return CameraModel(name, np.array([*CORE, *BROWN[:count]]), SIZE, pose)


def kb4(pose: Pose = POSE) -> CameraModel:
    values = [210.4, 209.1, 322.2, 235.9, 0.02, -0.008, 0.002, -0.0004]
    return CameraModel("kb4", np.array(values), SIZE, pose, 1.75)


def decentred() -> CameraModel:
    values = np.array([*kb4().intrinsics, 2e-4, -3e-4])
    return CameraModel("kb4_decentred", values, SIZE, POSE, 1.75)


def splined() -> CameraModel:
    name = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=11_Ny=8_fov_x_deg=100"
    rng = np.random.default_rng(3)
    values = np.concatenate([CORE, rng.normal(0, 0.002, 2 * 11 * 8)])
    return CameraModel(name, values, SIZE, POSE)


def distance(a: CameraModel, b: CameraModel, *, world: bool = True) -> float:
    """Largest distance, px, between where two cameras see points before the first."""
    pixels, rays = directions(a)
    depth = np.linspace(0.5, 5, len(rays))[:, None]
    points = rays * depth
    if not world:
        return float(np.abs(a.project(points) - b.project(points)).max())
    points = a.world_from_camera.apply(points)
    assert np.abs(a.project_world(points) - pixels).max() < 1e-3
    return float(np.abs(a.project_world(points) - b.project_world(points)).max())


FLAT = [brown(n) for n in (0, 4, 5, 8, 12)]
#: format, name of the output, and the cameras that it holds
HOLDS: list[tuple[str, str, list[CameraModel]]] = [
    ("cameramodel", "one.cameramodel", [*FLAT, kb4(), decentred(), splined()]),
    ("opencv", "one.yml", [*FLAT, kb4()]),
    ("opencv", "one.yaml", [*FLAT, kb4()]),
    ("opencv", "one.json", [*FLAT, kb4()]),
    ("opencv", "one.xml", [*FLAT, kb4()]),
    ("colmap", "model", [*FLAT[:4], kb4(), decentred()]),
    ("colmap-binary", "model", [*FLAT[:4], kb4(), decentred()]),
    ("usd", "one.usda", [*FLAT, kb4(), decentred(), splined()]),
    ("blender", "one.py", [*FLAT, kb4(), decentred()]),
    ("kalibr", "chain.yaml", [c.posed(Pose.identity()) for c in (*FLAT[:2], kb4())]),
]


@pytest.mark.parametrize(("to", "name", "cameras"), HOLDS, ids=lambda v: str(v)[:20])
def test_round_trip(to: str, name: str, cameras: list[CameraModel], tmp_path: Path) -> None:
    for camera in cameras:
        cost = write_cameras(tmp_path / name, [NamedCamera("one", camera)], to)
        if to != "blender":
            assert cost.losses == []
        (back,) = read_cameras([tmp_path / name])
        assert (back.name, back.loss) == ("cam0" if to == "kalibr" else "one", None)
        assert back.camera.size == camera.size
        assert distance(camera, back.camera) < 1e-6, camera.model
        assert distance(camera, read_camera(tmp_path / name)) < 1e-6


def ring(count: int = 3) -> list[NamedCamera]:
    lenses = [brown(0), kb4(), brown(4)]
    first = Pose.identity()
    poses = [first, POSE, Pose.from_rotation_vector([-1, 2, 0.4], [-1.0, 0, 3])]
    return [
        NamedCamera(name, camera.posed(pose), rig=True, time_shift=shift)
        for name, camera, pose, shift in zip(
            ("left", "middle", "right"), lenses, poses, (0.0, 0.012, -0.004), strict=True
        )
    ][:count]


@pytest.mark.parametrize(
    ("to", "name"),
    [
        ("cameramodel", "rig"),
        ("opencv", "rig"),
        ("colmap", "rig"),
        ("colmap-binary", "rig"),
        ("kalibr", "rig.yaml"),
        ("usd", "rig.usda"),
        ("blender", "rig.py"),
    ],
)
def test_rigs_round_trip(to: str, name: str, tmp_path: Path) -> None:
    rig = ring()
    write_cameras(tmp_path / name, rig, to)
    source = tmp_path / name
    files = sorted(source.glob("*.yml")) if to == "opencv" else [source]
    back = read_cameras(files)
    for there, here in zip(rig, back, strict=True):
        if to != "kalibr":
            assert here.name == there.name
        assert distance(there.camera, here.camera) < 1e-6
    assert all(here.rig for here in back) == (to not in ("cameramodel", "opencv"))
    if to == "kalibr":
        assert [here.time_shift for here in back] == [0.0, 0.012, -0.004]


@pytest.mark.parametrize("name", ["pair.yml", "pair.json", "pair.xml"])
def test_stereo_pairs(name: str, tmp_path: Path) -> None:
    pair = [
        NamedCamera("a", brown(5, Pose.identity())),
        NamedCamera("b", replace(brown(5), intrinsics=brown(5).intrinsics * 1.01)),
    ]
    write_cameras(tmp_path / name, pair, "opencv")
    back = read_cameras([tmp_path / name])
    assert [c.name for c in back] == ["a", "b"]
    assert max(distance(x.camera, y.camera) for x, y in zip(pair, back, strict=True)) < 1e-6


# ---- the tools themselves


def opencv_sees(storage: Path, points: np.ndarray) -> np.ndarray:
    """Pixels of world points by OpenCV, from the file as OpenCV reads it."""
    file = cv2.FileStorage(str(storage), cv2.FILE_STORAGE_READ)
    k, d, r, t = (
        file.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients", "R", "T")
    )
    assert (file.getNode("image_width").real(), file.getNode("image_height").real()) == SIZE
    fisheye = bool(file.getNode("fisheye_model").real())
    file.release()
    rvec = cv2.Rodrigues(r)[0]
    if fisheye:
        q, _ = cv2.fisheye.projectPoints(points[None], rvec, t, k, d)
    else:
        q, _ = cv2.projectPoints(points, rvec, t, k, d)
    return q.reshape(-1, 2)


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_opencv_sees_the_same(suffix: str, tmp_path: Path) -> None:
    for camera in (*FLAT, kb4()):
        _, rays = directions(camera)
        points = camera.world_from_camera.apply(rays[rays[:, 2] > 0.1] * 3)
        write_cameras(tmp_path / f"a{suffix}", [NamedCamera("a", camera)], "opencv")
        seen = opencv_sees(tmp_path / f"a{suffix}", points)
        assert seen == pytest.approx(camera.project_world(points), abs=1e-6)


def test_colmap_sees_the_same(tmp_path: Path) -> None:
    """Half a pixel apart: its pixels are counted from the corner of the picture."""
    for to in ("colmap", "colmap-binary"):
        for i, camera in enumerate((*FLAT[:4], kb4(), decentred(), LATLONG)):
            folder = tmp_path / f"{to}{i}"
            write_cameras(folder, [NamedCamera("a.png", camera)], to)
            model = pycolmap.Reconstruction(folder)
            image = model.find_image_with_name("a.png")
            _, rays = directions(camera)
            rays = rays[rays[:, 2] > 0.1]
            points = camera.world_from_camera.apply(rays * 2)
            seen = [image.project_point(p) for p in points[::50]]
            ours = camera.project_world(points[::50])
            assert np.array(seen) == pytest.approx(ours + 0.5, abs=1e-6)


LATLONG = CameraModel.latlong((640, 320), POSE)


def test_colmap_knows_the_rig(tmp_path: Path) -> None:
    rig = [replace(c, camera=c.camera.posed(POSE @ c.camera.world_from_camera)) for c in ring()]
    for to in ("colmap", "colmap-binary"):
        write_cameras(tmp_path / to, rig, to)
        model = pycolmap.Reconstruction(tmp_path / to)
        (found,), (frame,) = model.rigs.values(), model.frames.values()
        assert (found.num_sensors(), len(list(frame.image_ids))) == (3, 3)
        for named in rig:
            image = model.find_image_with_name(named.name)
            expected = named.camera.world_from_camera.inverse().matrix()[:3]
            assert image.cam_from_world().matrix() == pytest.approx(expected, abs=1e-12)
        (config,) = pycolmap.read_rig_config(tmp_path / to / "rig_config.json")
        middle = config.cameras[1]
        relative = rig[1].camera.world_from_camera.inverse() @ rig[0].camera.world_from_camera
        assert config.cameras[0].ref_sensor
        assert middle.image_prefix == "middle/"
        assert middle.cam_from_rig is not None
        assert middle.cam_from_rig.matrix() == pytest.approx(relative.matrix()[:3], abs=1e-12)


@pytest.mark.parametrize(
    "model", [m for m in pycolmap.CameraModelId.__members__ if m not in ("INVALID",)]
)
def test_every_lens_of_colmap(model: str, tmp_path: Path) -> None:
    """COLMAP's own file of each of its models, against its own projection."""
    kind = pycolmap.CameraModelId.__members__[model]
    lens = pycolmap.Camera.create_from_model_id(1, kind, 400.0, *SIZE)
    lens.camera_id = 1
    if model != "EQUIRECTANGULAR":
        extra = lens.extra_params_idxs()
        params = np.array(lens.params)
        params[list(extra)] += (
            0.01 * (-1) ** np.arange(len(extra)) / (1 + np.arange(len(extra)))
        )
        params[list(lens.principal_point_idxs())] += [5, -7]
        if model == "FOV":
            params[4] = 0.9
        if model == "EUCM":
            params[4:] = [0.55, 1.1]
        lens.params = params.tolist()
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(lens)
    image = pycolmap.Image(name="a b.jpg", camera_id=1, image_id=1)
    pose = pycolmap.Rigid3d(POSE.inverse().matrix()[:3])
    reconstruction.add_image_with_trivial_frame(image, pose)
    for name, write in (
        ("text", reconstruction.write_text),
        ("binary", reconstruction.write_binary),
    ):
        folder = tmp_path / name
        folder.mkdir()
        write(folder)
        (named,) = read_cameras([folder])
        assert named.name == "a b.jpg"
        _, rays = directions(named.camera)
        rays = rays[rays[:, 2] > 0.1]
        points = named.camera.world_from_camera.apply(rays * 2)
        seen = np.array([reconstruction.image(1).project_point(p) for p in points[::40]])
        error = np.linalg.norm(seen - 0.5 - named.camera.project_world(points[::40]), axis=1)
        if named.loss is None:
            assert error.max() < 1e-6
        else:
            assert error.max() < 2 * named.loss.worst
            assert named.loss.rms < 0.2, named.loss


@pytest.mark.parametrize("kind", ["omni-radtan", "omni-none", "eucm-none", "ds-none"])
def test_lenses_of_kalibr_come_near(kind: str, tmp_path: Path) -> None:
    """By a second route: the formulas as their papers have them, one point at a time."""
    model, distortion = kind.split("-")
    own = {"omni": [0.8], "eucm": [0.6, 1.1], "ds": [-0.2, 0.6]}[model]
    core = [470.0, 468.0, 322.0, 238.0] if model == "omni" else [300.0, 299.0, 322.0, 238.0]
    terms = [-0.05, 0.01, 3e-4, -2e-4] if distortion == "radtan" else []
    file = tmp_path / "camchain.yaml"
    file.write_text(
        f"cam0:\n  camera_model: {model}\n  distortion_model: {distortion}\n"
        f"  distortion_coeffs: {terms}\n  intrinsics: {own + core}\n"
        "  resolution: [640, 480]\n"
    )
    (named,) = read_cameras([file])
    assert named.loss is not None
    assert named.loss.rms < 0.1
    _, rays = directions(named.camera)
    for ray in rays[::37]:
        x, y, z = ray.tolist()
        match model:
            case "omni":
                u, v = x / (z + own[0]), y / (z + own[0])
            case "eucm":
                rho = math.sqrt(own[1] * (x * x + y * y) + z * z)
                scale = own[0] * rho + (1 - own[0]) * z
                u, v = x / scale, y / scale
            case _:
                d2 = math.sqrt(x * x + y * y + (own[0] + z) ** 2)
                scale = own[1] * d2 + (1 - own[1]) * (own[0] + z)
                u, v = x / scale, y / scale
        if terms:
            k1, k2, p1, p2 = terms
            r = u * u + v * v
            s = 1 + k1 * r + k2 * r * r
            u, v = (
                u * s + 2 * p1 * u * v + p2 * (r + 2 * u * u),
                v * s + p1 * (r + 2 * v * v) + 2 * p2 * u * v,
            )
        q = [core[0] * u + core[2], core[1] * v + core[3]]
        assert named.camera.project(ray) == pytest.approx(q, abs=2 * named.loss.worst)


def test_mrcal_sees_the_same(tmp_path: Path) -> None:
    for camera in (*FLAT, splined()):
        write_cameras(tmp_path / "a.cameramodel", [NamedCamera("a", camera)])
        model: Any = mrcal.cameramodel(str(tmp_path / "a.cameramodel"))
        _, rays = directions(camera)
        points = camera.world_from_camera.apply(rays)
        seen = mrcal.project(
            mrcal.transform_point_Rt(model.Rt_cam_ref(), points), *model.intrinsics()
        )
        assert seen == pytest.approx(camera.project_world(points), abs=1e-6)


def test_usd_sees_the_same(tmp_path: Path) -> None:
    """OpenUSD's own frustum of the file, for perspective, off centre and with tall pixels."""
    usd, geometry, gf = (
        pytest.importorskip(f"pxr.{name}", reason="usd-core is not installed")
        for name in ("Usd", "UsdGeom", "Gf")
    )
    camera = brown(0)
    write_cameras(tmp_path / "a.usda", [NamedCamera("a b", camera)])
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    assert geometry.GetStageUpAxis(stage) == "Y"
    frustum = geometry.Camera(stage.GetPrimAtPath("/Cameras/a_b")).GetCamera().frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    _, rays = directions(camera)
    points = camera.world_from_camera.apply(rays * 3)
    seen = np.array([matrix.Transform(gf.Vec3d(*p.tolist())) for p in points[::40]])
    pixels = np.stack([(seen[:, 0] + 1) / 2 * 640, (1 - seen[:, 1]) / 2 * 480], axis=1) - 0.5
    # UsdGeom holds floats of 24 bits
    assert pixels == pytest.approx(camera.project_world(points[::40]), abs=2e-4)


def test_usd_of_other_programs(tmp_path: Path) -> None:
    """+Z up, centimetres, a parent that turns and scales, nothing but UsdGeom; and NVIDIA's."""
    pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    file = tmp_path / "theirs.usda"
    file.write_text(
        """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Z"
)
def Xform "Group"
{
    double3 xformOp:translate = (100, 0, 0)
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def Camera "eye" {
        float focalLength = 35
        float horizontalAperture = 36
        float verticalAperture = 24
        double3 xformOp:translate = (0, 0, 50)
        float xformOp:rotateX = 90
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    }
    def Camera "lens" (prepend apiSchemas = ["OmniLensDistortionOpenCvFisheyeAPI"]) {
        token omni:lensdistortion:model = "opencvFisheye"
        int2 omni:lensdistortion:opencvFisheye:imageSize = (640, 480)
        float omni:lensdistortion:opencvFisheye:fx = 200
        float omni:lensdistortion:opencvFisheye:fy = 200
        float omni:lensdistortion:opencvFisheye:cx = 320
        float omni:lensdistortion:opencvFisheye:cy = 240
        float omni:lensdistortion:opencvFisheye:k1 = 0.015625
    }
}
"""
    )
    eye, lens = read_cameras([file], Hints(size=(900, 600)))
    assert eye.camera.intrinsics == pytest.approx([875, 875, 449.5, 299.5])
    # On a stage with +Z up turned by 90 degrees about x it looks along +Y, which is our -Z.
    assert eye.camera.world_from_camera.translation == pytest.approx([1, 1, 0])
    assert eye.camera.rays([449.5, 299.5]) == pytest.approx([0, 0, -1])
    assert eye.camera.rays([449.5, 0])[1] > 0  # upright
    assert lens.camera.model == "kb4"
    assert lens.camera.intrinsics == pytest.approx([200, 200, 319.5, 239.5, 0.015625, 0, 0, 0])


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed")
def test_blender_sees_the_same(tmp_path: Path) -> None:
    """Cycles' own rays: where each pixel's centre hits a sphere around the camera."""
    shifted = CameraModel("kb4", kb4().intrinsics * [1, 210.4 / 209.1, 1, 1, 1, 1, 1, 1], SIZE)
    views = {"pinhole": brown(0), "kb4": replace(shifted, world_from_camera=POSE)}
    for name, camera in views.items():
        cost = write_cameras(tmp_path / f"{name}.py", [NamedCamera("eye", camera)])
        allowed = 1e-3 if name == "pinhole" else cost.losses[0][1].worst + 2e-3
        view = Path(__file__).with_name("blender_rays.py")
        done = subprocess.run(
            [sys.executable, str(view), str(tmp_path / f"{name}.py"), str(tmp_path / "p.npy")],
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        pixels, points = np.split(np.load(tmp_path / "p.npy"), [2], axis=1)
        world = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)
        miss = np.linalg.norm(camera.project_world(world) - pixels, axis=1)
        assert len(miss) > 100
        assert np.nanmax(miss) < allowed


def test_what_a_format_cannot_hold_is_told(tmp_path: Path) -> None:
    """The error that is told is the error of the file that was written."""
    stereographic = CameraModel.fisheye("stereographic", SIZE, 2.6, radius=330.0, pose=POSE)
    for camera, to, name, most in (
        (brown(8, Pose.identity()), "kalibr", "a.yaml", 1.0),
        (splined(), "colmap", "a", 3.0),
        (stereographic, "opencv", "a.yml", 0.1),
        (decentred(), "opencv", "b.yml", 0.5),
    ):
        cost = write_cameras(tmp_path / name, [NamedCamera("a", camera)], to)
        ((_, loss),) = cost.losses
        assert loss.was == camera.model
        assert 0 < loss.rms < most, (to, loss)
        back = read_camera(tmp_path / name)
        pixels, rays = directions(camera)
        # by their directions in the world: a splined lens is turned
        there = back.world_from_camera.translation + camera.world_from_camera.rotate(rays)
        miss = np.linalg.norm(back.project_world(there) - pixels, axis=1)
        assert math.sqrt(np.mean(miss**2)) == pytest.approx(loss.rms, rel=1e-6)
        assert miss.max() == pytest.approx(loss.worst, rel=1e-6)


def test_a_splined_lens_that_is_turned() -> None:
    """mrcal's splines may hide a turn, which the new pose takes: rays in the world stay."""
    source = FIGUEROA / "splined-0.cameramodel"
    if not source.is_file():
        pytest.skip("the data of mrcal's figueroa are not here")
    camera = read_camera(source)
    done = prepared([NamedCamera("a", camera)], "cameramodel", "kb4_decentred")
    ((_, loss),) = done.losses
    assert loss.part == "its calibrated part"
    assert math.degrees(loss.turned) == pytest.approx(4.0, abs=0.2)
    assert loss.rms < 1
    found = done.cameras[0].camera
    assert camera.region is not None
    middle = np.mean(camera.region, axis=0) + np.random.default_rng(0).normal(0, 600, (50, 2))
    seen = found.project_world(found.world_from_camera.translation + camera.rays(middle))
    assert np.linalg.norm(seen - middle, axis=1).max() < 2 * loss.worst


def test_a_wide_lens_in_a_flat_model_says_what_it_leaves_out() -> None:
    cost = prepared([NamedCamera("a", kb4())], "colmap", "opencv8")
    ((_, loss),) = cost.losses
    _, rays = directions(kb4())
    assert loss.left_out == pytest.approx(float((rays[:, 2] <= 0.09).mean()))
    assert loss.rms < 5


def test_special_cases_lose_nothing() -> None:
    plain = replace(brown(8), intrinsics=np.array([*CORE, *BROWN[:4], 0, 0, 0, 0]))
    for camera, model, count in (
        (plain, "opencv4", 8),
        (brown(0), "opencv8", 12),
        (CameraModel.fisheye("equidistant", SIZE, 3.0), "kb4", 8),
        (kb4(), "kb4_decentred", 10),
    ):
        done = prepared([NamedCamera("a", camera)], "cameramodel", model)
        assert done.losses == []
        assert len(done.cameras[0].camera.intrinsics) == count
        assert distance(camera, done.cameras[0].camera) < 1e-9


def test_optimisation_inputs_stay(tmp_path: Path) -> None:
    """Of mrcal's own file, moved: all that it holds but the pose, as mrcal reads it."""
    source = FIGUEROA / "opencv8-0.cameramodel"
    if not source.is_file():
        pytest.skip("the data of mrcal's figueroa are not here")
    (named,) = read_cameras([source])
    moved = replace(named, camera=named.camera.posed(POSE))
    write_cameras(tmp_path / "moved.cameramodel", [moved])
    models: list[Any] = [
        mrcal.cameramodel(str(f)) for f in (source, tmp_path / "moved.cameramodel")
    ]
    before, after = models
    expected = POSE.inverse()
    rt = [*expected.rotation_vector(), *expected.translation]
    assert after.rt_cam_ref() == pytest.approx(rt, abs=1e-12)
    assert after.intrinsics()[1].tolist() == before.intrinsics()[1].tolist()
    inputs = before.optimization_inputs()
    kept = after.optimization_inputs()
    assert inputs is not None
    assert kept["observations_board"].tobytes() == inputs["observations_board"].tobytes()
    # another lens is not what those were for
    write_cameras(tmp_path / "kb4.cameramodel", [moved], model="kb4")
    assert "optimization_inputs" not in (tmp_path / "kb4.cameramodel").read_text()


def test_json_of_plain_lists(tmp_path: Path) -> None:
    file = tmp_path / "c.json"
    matrix = [[400, 0, 320], [0, 401, 240], [0, 0, 1]]
    file.write_text(
        json.dumps({"mtx": matrix, "dist": [[0.1, 0, 0, 0, 0.01]], "image_size": [640, 480]})
    )
    camera = read_camera(file)
    assert camera.intrinsics.tolist() == [400, 401, 320, 240, 0.1, 0, 0, 0, 0.01]
