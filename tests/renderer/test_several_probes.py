"""Two maps of a set with a screen in it: what the first does not see has the second's light."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.stages import stages
from chromeball.renderer.composite import CapturedSet, Compositor, Integrator
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import sphere
from chromeball.renderer.render import captured_set
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import write_exr
from chromeball.scene.manifest import read_scene
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import write_stand_in
from tests.envmap.set import BEHIND, LEFT, MESH, RIGHT, panorama, photograph

VIEW = CameraModel.pinhole(
    (48, 36),
    math.radians(70),
    Pose.look_at(np.array([1.0, 1.3, 0.9]), np.array([2.0, 0.6, -1.5])),
)
SPOT = VIEW.world_from_camera.translation


def compositor(captured: CapturedSet, things: list[Mesh], integrator: Integrator) -> Compositor:
    return Compositor(
        things, captured, corner_rays(VIEW), SPOT, integrator=integrator, samples=32
    )


def captured(width: int, others: bool) -> CapturedSet:
    left, right = panorama(LEFT, width), panorama(RIGHT, width)
    more = ((right.radiance, right.origin),) if others else ()
    return CapturedSet(left.radiance, left.origin, MESH, more)


def test_the_set_is_seen_behind_the_screen() -> None:
    truth = photograph(VIEW)
    errors = []
    for others in (False, True):
        plate = compositor(captured(256, others), [], "path").plate
        errors.append(float(np.abs(plate - truth).mean() / truth.mean()))
    assert errors[1] < 0.02 < 0.2 < errors[0]


@pytest.mark.parametrize("integrator", ["path", "direct"])
def test_an_object_has_the_light_of_its_place(integrator: Integrator) -> None:
    """A white ball behind the screen, against the irradiance of the true map there."""
    vertices, faces, normals = sphere()
    at = BEHIND - np.array([0.0, 0.3, 0.0])
    ball = Mesh.of(
        (vertices * 0.6 + at).astype(np.float32),
        faces,
        normals=normals,
        material=Material.diffuse((1.0, 1.0, 1.0)),
    )
    one, two = captured(128, False), captured(128, True)
    here = panorama(BEHIND)
    exact = CapturedSet(here.radiance, here.origin, MESH)
    found = []
    for light in (one, two, exact):
        job = compositor(light, [ball], integrator)
        job.add(48)
        result = job.result()
        inside = result.alpha == 1
        assert inside.sum() > 10
        found.append(result.rgb[inside].mean(axis=0))
    np.testing.assert_allclose(found[1], found[2], rtol=0.03)
    assert np.abs(found[0] / found[2] - 1).max() > 0.06


def test_a_second_map_of_the_same_changes_nothing() -> None:
    """Where the first map sees everything the bits are those of one map."""
    left = panorama(LEFT, 64)
    near = LEFT + np.array([0.0, 0.05, 0.0])
    floor = MESH
    view = CameraModel.pinhole(
        (24, 18), math.radians(40), Pose.look_at(LEFT, np.array([-2.9, 0.5, 0.5]))
    )
    plates = []
    for others in ((), ((np.full((32, 64, 3), 99, np.float32), near),)):
        job = Compositor(
            [], CapturedSet(left.radiance, left.origin, floor, others), corner_rays(view), LEFT
        )
        plates.append(job.plate)
    np.testing.assert_array_equal(*plates)


def test_in_a_scene(tmp_path: Path) -> None:
    """`env.others`: read, a prerequisite of the picture, refused where it cannot be."""
    left, right = panorama(LEFT, 64), panorama(RIGHT, 64)
    (tmp_path / "build").mkdir()
    write_exr(tmp_path / "build/env.exr", left.radiance, attributes={"origin": left.origin})
    write_exr(tmp_path / "b.exr", right.radiance, attributes={"origin": right.origin})
    write_stand_in(tmp_path / "build/stand_in.ply", MESH)
    text = """
    name = "two"
    [env]
    file = "a.exr"
    others = ["b.exr"]
    [[stand_in]]
    name = "floor"
    kind = "plane"
    size = [4, 4]
    [[object]]
    name = "ball"
    mesh = "sphere"
    [[view]]
    name = "main"
    """
    (tmp_path / "scene.toml").write_text(text)
    scene = read_scene(tmp_path / "scene.toml")
    light, inputs = captured_set(scene, tmp_path)
    assert len(light.others) == 1
    np.testing.assert_allclose(light.others[0][1], RIGHT, atol=1e-6)
    assert tmp_path / "b.exr" in inputs
    plan = {stage.name: stage for stage in stages(scene, tmp_path / "scene.toml")}
    assert "b.exr" in plan["render main"].inputs
    write_exr(tmp_path / "b.exr", right.radiance, attributes={"origin": left.origin})
    with pytest.raises(UserError, match=r"b.exr: two maps are of one place"):
        captured_set(scene, tmp_path)
    write_exr(tmp_path / "b.exr", right.radiance)
    with pytest.raises(UserError, match="no attribute `origin`"):
        captured_set(scene, tmp_path)
