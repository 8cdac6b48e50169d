"""Cameras of scene files: cubes, focus, shutters, and travel away from the probe."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Compositor
from chromeball.renderer.lens import view_lens
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import box
from chromeball.renderer.render import virtual_camera
from chromeball.renderer.travel import unseen
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image
from chromeball.scene.manifest import View, parse_scene
from chromeball.scene.pose import Pose
from chromeball.scene.sequence import at, posed
from chromeball.stand_in.ply import StandInMesh
from tests.renderer.scenes import SCENE, run, write_scene


def test_cube_faces_agree_with_the_panorama() -> None:
    """Both see one smooth environment; the cross is empty beside the faces."""
    cube, panorama = CameraModel.cube((128, 96)), CameraModel.latlong((256, 128))
    y, x = np.mgrid[:64, :128]
    lon, lat = (x + 0.5) / 128 * 2 * np.pi, (y + 0.5) / 64 * np.pi
    sky = np.stack(
        [1 + np.sin(lon) * np.sin(lat), 1 + np.cos(lat), 1 + np.cos(lon) * np.sin(lat)], axis=2
    ).astype(np.float32)
    captured = CapturedSet(sky, np.zeros(3))

    def seen(camera: CameraModel) -> NDArray[np.float32]:
        return Compositor([], captured, corner_rays(camera), (0, 0, 0), plate_samples=16).plate

    one, other = seen(cube), seen(panorama)
    d = cube.rays(cube.pixel_grid())
    inside = np.isfinite(d).all(axis=2)
    assert inside.sum() == 6 * 32 * 32
    assert (one[~inside] == 0).all()
    x, y = np.rint(panorama.project_world(d[inside])).astype(np.intp).T
    np.testing.assert_allclose(one[inside], other[np.minimum(y, 127), x % 256], atol=0.02)


def test_a_cube_projects_where_it_unprojects() -> None:
    rng = np.random.default_rng(0)
    cube = CameraModel.cube((64, 48), Pose.from_rotation_vector([0.3, 1.0, -0.2], np.zeros(3)))
    d = rng.standard_normal((500, 3))
    q, jacobian = cube.project_with_jacobian(d)
    back = cube.unproject(q)
    np.testing.assert_allclose(back, d / np.linalg.norm(d, axis=1, keepdims=True), atol=1e-12)
    step = 1e-6
    for k in range(3):
        moved = d.copy()
        moved[:, k] += step
        slope = (cube.project(moved) - q) / step
        same = np.abs(slope).max(axis=1) < 1e4  # not over an edge
        np.testing.assert_allclose(jacobian[same, :, k], slope[same], atol=1e-2, rtol=1e-3)
    with pytest.raises(UserError, match="take 64 x 48"):
        CameraModel.cube((64, 40))


def test_a_cube_and_what_moves_it_in_a_scene_file() -> None:
    view = View(name="v", model="cube", size=(8, 6), position=(1.0, 2.0, 3.0))
    camera = virtual_camera(view, np.zeros(3))
    np.testing.assert_allclose(camera.rays(np.array([[3.5 - 0.5, 2.5]]))[0, 2], 1, atol=0.2)
    np.testing.assert_array_equal(camera.world_from_camera.translation, [1, 2, 3])


def test_the_lens_of_a_view() -> None:
    pose = Pose.look_at([0, 1, 3], [0, 1, 0])
    camera = CameraModel.pinhole((40, 30), 0.8, pose)
    view = View(name="v", f_number=2.0, focal_length=0.05, focus_at=(0.5, 1.0, 1.0))
    lens = view_lens(view, "box", camera)
    assert lens.aperture == pytest.approx(0.025)
    assert lens.focus == pytest.approx(2.0)  # of the plane through the point
    assert view_lens(View(name="v"), "box", camera).plain
    behind = View(name="v", aperture=0.1, focus_at=(0.0, 1.0, 5.0))
    with pytest.raises(UserError, match="behind the camera"):
        view_lens(behind, "box", camera)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("f_number = 2", "f_number and focal_length"),
        ("aperture = 0.1", "needs focus_distance or focus_at"),
        ("focus_distance = 2", "without an aperture"),
        ("aperture = 0.1\nf_number = 2\nfocal_length = 0.05\nfocus_distance = 2", "keep one"),
        ('closing_camera = "a.cameramodel"', "needs a plate and a shutter"),
        ("shutter = 1.5", "<= 1"),
        ('model = "cube"\nsize = [40, 31]', "a cross of 4 x 3 faces"),
    ],
)
def test_cameras_that_cannot_be(keys: str, message: str, tmp_path: Path) -> None:
    text = SCENE.replace("size = [40, 30]", keys)
    with pytest.raises(UserError, match=message):
        run("render", write_scene(tmp_path, text))


def test_a_still_of_a_sequence_keeps_what_moves_while_its_shutter_is_open() -> None:
    text = SCENE.replace(
        "scale = 0.5",
        "scale = 0.5\ninterpolation = 'cubic'\n"
        "key = [{ frame = 1, position = [0, 0, 0] }, { frame = 3, position = [2, 0, 0] }]",
    ).replace("size = [40, 30]", "size = [40, 30]\nshutter = 0.5\nframes = '1-3'")
    still = at(parse_scene(text), 2)
    ball = still.object[0]
    assert ball.position == pytest.approx((1, 0, 0))
    assert [key.frame for key in ball.key] == [0, 0.5]
    assert ball.key[1].position == pytest.approx(
        posed(parse_scene(text), 2.5).object[0].position
    )
    frozen = at(parse_scene(text.replace("shutter = 0.5\n", "")), 2)
    assert frozen.object[0].key == []


def test_a_moving_ball_is_blurred_from_scene_file_to_picture(tmp_path: Path) -> None:
    keys = (
        "key = [{ frame = 1, position = [-0.6, 0, 0] }, { frame = 2, position = [0.6, 0, 0] }]"
    )
    moving = SCENE.replace("scale = 0.5", f"scale = 0.5\n{keys}").replace(
        "size = [40, 30]", 'size = [40, 30]\nframes = "1"\nshutter = 1.0'
    )
    file = write_scene(tmp_path, moving)
    run("render", file, "--spp", "64")
    image = read_image(tmp_path / "build/main.0001.exr")
    alpha = image.pixels[..., image.channels.index("A")]
    still = write_scene(tmp_path, moving.replace("shutter = 1.0", "shutter = 0.0"))
    run("render", still, "--spp", "64", "--force")
    sharp_image = read_image(tmp_path / "build/main.0001.exr")
    sharp = sharp_image.pixels[..., sharp_image.channels.index("A")]
    assert alpha.max() < 0.75
    assert sharp.max() == 1
    assert (alpha > 0).any(axis=0).sum() > 1.8 * (sharp > 0).any(axis=0).sum()
    # the same coverage, spread (the ball nears the camera's axis on its way)
    assert alpha.sum() == pytest.approx(sharp.sum(), rel=0.1)


def test_a_direct_render_with_an_aperture_is_refused(tmp_path: Path) -> None:
    text = SCENE.replace("size = [40, 30]", "aperture = 0.1\nfocus_distance = 1")
    with pytest.raises(UserError, match="take path"):
        run("render", write_scene(tmp_path, text), "--integrator", "direct")


def room_with_a_box() -> CapturedSet:
    """A floor with a box on it, the map's origin straight above at 2 m in front of it."""
    v = np.array([[-9, 0, 9], [9, 0, 9], [9, 0, -9], [-9, 0, -9]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    vertices, more, _ = box()
    v = np.concatenate([v, vertices]).astype(np.float32)
    faces = np.concatenate([faces, more + 4]).astype(np.uint32)
    floor = StandInMesh(v, v, faces, np.zeros(len(faces), np.uint8))
    return CapturedSet(np.ones((8, 16, 3), np.float32), np.array([0.0, 2.0, 2.0]), floor)


def test_travel_finds_what_the_probe_did_not_see() -> None:
    captured = room_with_a_box()
    origin = np.asarray(captured.origin)
    home = CameraModel.latlong((64, 32), CameraModel.latlong((2, 1)).world_from_camera)
    home = home.posed(Pose(home.world_from_camera.rotation, origin))
    assert unseen(captured, home).sum() == 0
    # hidden are the box's back, seen down from its upper edge, and the floor behind it: the ray
    # from (2, 2) over that edge at (1, -0.5) meets the floor at z = -3
    pose = Pose.look_at([0, 9, -1.7], [0, 0, -1.7], [0, 0, -1])
    above = CameraModel.pinhole((200, 200), 1.0, pose)
    ends = above.project_world(np.array([[0.0, 0.0, -3.0], [0.0, 1.0, -0.5]]))[:, 1]
    rows = np.flatnonzero(unseen(captured, above)[:, 100])
    assert rows.min() == pytest.approx(ends.min(), abs=1)
    assert rows.max() == pytest.approx(ends.max(), abs=1)
    assert len(rows) == rows.max() - rows.min() + 1


def test_travel_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = SCENE.replace("size = [40, 30]", "size = [40, 30]\nposition = [0, 1, 2.5]")
    run("render", write_scene(tmp_path, text), "--json")
    figures = json.loads(capsys.readouterr().out)
    assert figures["metres_from_probe"] == pytest.approx(1.0)
    assert figures["unseen_by_probe"] == 0
