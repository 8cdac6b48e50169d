"""``chromeball render`` as a user calls it, on scenes of a few pixels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from chromeball.renderer.render import Budget, virtual_camera
from chromeball.renderer.scene import read_mesh
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.manifest import View
from chromeball.scene.pose import Pose
from tests.renderer.asset_files import Gltf, cube, picture
from tests.renderer.scenes import SCENE, run, write_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path)


def test_a_view_becomes_an_exr_with_layers_and_a_png(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("render", scene, "--json")
    figures = json.loads(capsys.readouterr().out)
    assert figures["spp"] == 4
    assert 0 < figures["changed_pixels"] <= 1200
    assert figures["png"] == "main.png"
    image = read_image(scene.parent / "build/main.exr")
    assert image.size == (40, 30)
    assert set(image.channels) == {
        *"RGBA",
        *(f"quotient.{c}" for c in "RGB"),
        *(f"objects.{c}" for c in "RGB"),
        "error.Y",
        "depth.Z",
    }
    alpha = image.pixels[..., image.channels.index("A")]
    assert alpha.max() == 1
    assert figures["coverage"] == pytest.approx(float(alpha.mean()), rel=1e-5)
    assert read_image(scene.parent / "build/main.png").size == (40, 30)
    record = json.loads((scene.parent / "build/main.exr.record.json").read_text())
    assert record["figures"]["exposure"] > 0
    assert any(name.endswith("env.exr") for name in record["inputs"])


def test_the_plate_is_kept_bit_for_bit_from_file_to_file(scene: Path) -> None:
    plate = np.random.default_rng(0).uniform(0.1, 1, (30, 40, 3)).astype(np.float32)
    write_exr(scene.parent / "build/shot.exr", plate)
    pose = Pose.look_at(np.array([0.0, 1.0, 1.5]), np.array([0.0, 0.9, -3.0]))
    CameraModel.pinhole((40, 30), 1.0, pose).write(scene.parent / "build/main.cameramodel")
    text = SCENE.replace('name = "main"', 'name = "main"\nplate = "build/shot.exr"')
    scene.write_text(text)
    run("render", scene, "--spp", "8")
    image = read_image(scene.parent / "build/main.exr")
    rgb = image.pixels[..., [image.channels.index(c) for c in "RGB"]]
    same = (rgb == plate).all(axis=2)
    assert same[:12].all()  # the sky
    assert not same.all()


def test_seconds_and_error_end_the_work(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("render", scene, "--error", "0.02", "--json")
    figures = json.loads(capsys.readouterr().out)
    assert figures["relative_error"] <= 0.02
    run("render", scene, "--seconds", "0.3", "--json", "-o", scene.parent / "timed.exr")
    figures = json.loads(capsys.readouterr().out)
    assert figures["seconds"] >= 0.3
    assert figures["spp"] >= 8
    assert (scene.parent / "timed.png").is_file()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("[[view]]\nname", '[[view]]\nname = "other"\n[[view]]\nname'),
            "choose one with --view",
        ),
        (('mesh = "sphere"', 'mesh = "spere.obj"'), "no such mesh"),
        (("size = [40, 30]", 'plate = "p.exr"'), "no such picture"),
        (("size = [40, 30]", "look_at = [0, 1, 1.5]"), "choose another point"),
        (("size = [40, 30]", "fov = 200"), "fov below 179"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    scene: Path, change: tuple[str, str], message: str
) -> None:
    scene.write_text(SCENE.replace(*change))
    before = sorted(scene.parent.rglob("*"))
    with pytest.raises(UserError, match=message) as error:
        run("render", scene)
    assert "\n" not in str(error.value)
    assert sorted(scene.parent.rglob("*")) == before


def test_an_environment_without_origin_is_refused(scene: Path) -> None:
    write_exr(scene.parent / "build/env.exr", np.ones((8, 16, 3), np.float32))
    with pytest.raises(UserError, match="no attribute `origin`"):
        run("render", scene)


def test_budgets_must_be_positive() -> None:
    with pytest.raises(UserError, match="--spp is 0"):
        Budget(spp=0)
    with pytest.raises(UserError, match="--error is nan"):
        Budget(error=float("nan"))


def test_a_virtual_camera_looks_at_its_point_from_the_origin() -> None:
    origin = np.array([0.5, 1.0, 2.0])
    for model in ("pinhole", "equisolid"):
        view = View(name="v", model=model, size=(80, 60), look_at=(0.0, 0.3, -1.0))
        camera = virtual_camera(view, origin)
        np.testing.assert_allclose(
            camera.project_world(np.array([view.look_at])), [[39.5, 29.5]], atol=1e-6
        )
    down = virtual_camera(View(name="v", look_at=(0.5, 0.0, 2.0)), origin)
    np.testing.assert_allclose(down.rays(np.array([[319.5, 239.5]])), [[0, -1, 0]], atol=1e-9)
    around = virtual_camera(View(name="v", model="latlong", size=(64, 32)), origin)
    np.testing.assert_allclose(around.rays(np.array([[31.5, 15.5]])), [[0, 0, 1]], atol=1e-9)


def test_mesh_files_are_read_and_broken_ones_refused(tmp_path: Path) -> None:
    good = tmp_path / "good.obj"
    good.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\n")
    vertices, faces, _ = read_mesh(good)
    assert len(faces) == 1  # the other has no area
    assert vertices.shape[1] == 3
    empty = tmp_path / "empty.obj"
    empty.write_text("v 0 0 0\n")
    with pytest.raises(UserError, match="no faces"):
        read_mesh(empty)
    garbage = tmp_path / "garbage.ply"
    garbage.write_bytes(b"\x00garbage")
    with pytest.raises(UserError, match="not a readable mesh"):
        read_mesh(garbage)
    nan = tmp_path / "nan.ply"
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    nan.write_text(header + "0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(UserError, match="1 vertices are NaN"):
        read_mesh(nan)
    out = tmp_path / "range.ply"
    out.write_text(header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")
    with pytest.raises(UserError, match="not a readable mesh"):
        read_mesh(out)
    out = tmp_path / "range.obj"
    out.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1/1/1 2//2 9\n")
    with pytest.raises(UserError, match="names vertex 9, the mesh has 3"):
        read_mesh(out)


def test_a_plate_whose_camera_file_holds_the_pose(scene: Path) -> None:
    plate = np.random.default_rng(0).uniform(0.1, 1, (30, 40, 3)).astype(np.float32)
    write_exr(scene.parent / "plate.exr", plate)
    pose = Pose.look_at(np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.2, 0.0]))
    CameraModel.pinhole((40, 30), 0.8, pose).write(scene.parent / "posed.cameramodel")
    text = scene.read_text().replace(
        "size = [40, 30]", 'plate = "plate.exr"\ncamera = "posed.cameramodel"'
    )
    scene.write_text(text)
    run("render", scene)
    composite = read_image(scene.parent / "build/main.exr")
    alpha = composite.pixels[..., composite.channels.index("A")]
    assert 0 < alpha.mean() < 1


def test_samples_are_steered_inside_a_fisheyes_circle_too(scene: Path) -> None:
    text = scene.read_text().replace(
        "size = [40, 30]", 'model = "equisolid"\nfov = 120\nsize = [40, 40]'
    )
    scene.write_text(text)
    from chromeball.renderer.render import prepare
    from chromeball.scene.manifest import read_scene

    parsed = read_scene(scene)
    job = prepare(parsed, scene.parent, parsed.view[0], 32)
    for _ in range(4):
        job.compositor.refine(8)
    counts = job.compositor.samples_per_pixel()
    seen = counts > 0
    assert 0.5 < seen.mean() < 0.9
    assert counts[seen].mean() == pytest.approx(32, rel=0.02)
    assert counts[seen].std() > 4


def test_objects_and_lights_of_all_kinds_from_files(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A textured glTF in several places, an OBJ, an area light and a spot, by the command."""
    gltf = Gltf()
    picture(scene.parent / "wood.png", np.full((2, 2, 3), 200, np.uint8))
    gltf.add("images", {"uri": "wood.png"})
    gltf.add("textures", {"source": 0})
    paint = {"baseColorTexture": {"index": 0}, "roughnessFactor": 0.6, "metallicFactor": 0}
    gltf.node(mesh=gltf.mesh(cube(gltf, pbrMetallicRoughness=paint)))
    gltf.write(scene.parent / "crate.gltf", "crate.bin")
    text = (
        'name = "ball"\nmesh = "crate.gltf"\nscale = 0.4\n'
        "instances = [{}, { position = [0.8, 0, 0], rotation = [0, 45, 0] }]"
    )
    lights = (
        '[[light]]\nname = "panel"\nkind = "area"\nposition = [-1, 1, 0]\n'
        "look_at = [0, 0, 0]\nsize = [0.4, 0.4]\nradiance = [9, 9, 9]\n"
        '[[light]]\nname = "spot"\nkind = "spot"\nposition = [0, 2, 0]\n'
        "direction = [0, -1, 0]\nangle = 30\nintensity = [2, 2, 2]\n"
    )
    whole = SCENE.replace('name = "ball"\nmesh = "sphere"\nscale = 0.5', text) + lights
    scene.write_text(whole)
    run("render", scene, "--json")
    figures = json.loads(capsys.readouterr().out)
    assert figures["changed_pixels"] > 100
    record = json.loads((scene.parent / "build/main.exr.record.json").read_text())
    inputs = {Path(name).name for name in record["inputs"]}
    assert {"crate.gltf", "crate.bin", "wood.png"} <= inputs
    run("render", scene, "--integrator", "direct", "--spp", "16", "-o", scene.parent / "d.exr")
    bright = [
        np.mean(read_image(scene.parent / name).pixels[..., :3])
        for name in ("build/main.exr", "d.exr")
    ]
    assert bright[1] == pytest.approx(bright[0], rel=0.1)
    with pytest.raises(UserError, match="ambient occlusion knows no lights"):
        run("render", scene, "--integrator", "ao")
