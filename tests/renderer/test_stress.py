"""Scenes at the edges: sizes, places, broken triangles, strange light, odd cameras."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.composite import CapturedSet, Composite, Compositor, Integrator
from chromeball.renderer.material import Material, Texture
from chromeball.renderer.mesh import Kind, Mesh
from chromeball.renderer.path import corner_rays
from chromeball.renderer.primitives import sphere
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import write_exr
from chromeball.scene.pose import Pose
from chromeball.stand_in.ply import SUPPORT, StandInMesh

SIZE = (40, 30)
INTEGRATORS: list[Integrator] = ["path", "direct"]


def sky() -> NDArray[np.float32]:
    light = np.full((32, 64, 3), 0.3, np.float32)
    light[5:9, 20:30] = 12
    return light


def scene(
    scale: float,
    at: NDArray[np.float64],
    integrator: Integrator,
    environment: NDArray[np.float32] | None = None,
    more: list[Mesh] | None = None,
    kind: Kind = Kind.DIFFUSE,
) -> Compositor:
    """A ball that sinks into a floor a little, all of it `scale` large and moved to `at`."""
    vertices, faces, normals = sphere(32, 64)
    ball = Mesh.of(vertices, faces, 0.5, kind=kind, normals=normals).placed(
        Pose(np.eye(3), at - np.array([0, 0.05 * scale, 0])), 0.6 * scale
    )
    v = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]]) * scale + at
    floor = StandInMesh(
        v.astype(np.float32),
        v.astype(np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        np.full(2, SUPPORT, np.uint8),
    )
    eye = at + np.array([0.3, 1.2, 1.8]) * scale
    view = CameraModel.pinhole(
        SIZE, 0.9, Pose.look_at(eye, at + np.array([0, 0.2 * scale, 0]), np.array([0.0, 1, 0]))
    )
    return Compositor(
        [ball, *(more or [])],
        CapturedSet(sky() if environment is None else environment,
                    at + np.array([0, 1.0 * scale, 0]), floor),
        corner_rays(view),
        view.world_from_camera.translation,
        np.full((SIZE[1], SIZE[0], 3), 0.4, np.float32),
        bounces=1,
        integrator=integrator,
        filtered=False,
    )  # fmt: skip


def rendered(job: Compositor, samples: int = 64) -> Composite:
    job.add(samples)
    result = job.result()
    assert np.isfinite(result.rgb).all()
    return result


def difference(a: Composite, b: Composite) -> float:
    return float(np.sqrt(np.mean((a.rgb - b.rgb) ** 2)) / a.rgb.mean())


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_the_size_of_a_scene_does_not_matter(integrator: Integrator, scale: float) -> None:
    unit = rendered(scene(1, np.zeros(3), integrator))
    other = rendered(scene(scale, np.zeros(3), integrator))
    assert difference(unit, other) < 0.05
    assert other.rgb.mean() == pytest.approx(unit.rgb.mean(), rel=3e-3)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_scene_may_lie_far_from_the_origin(integrator: Integrator) -> None:
    near = rendered(scene(1, np.zeros(3), integrator))
    far = rendered(scene(1, np.array([3e3, -500.0, 2e3]), integrator))
    assert far.rgb.mean() == pytest.approx(near.rgb.mean(), rel=0.01)
    assert far.alpha.sum() == pytest.approx(near.alpha.sum(), rel=0.01)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_slivers_points_and_doubles_do_no_harm(integrator: Integrator) -> None:
    a, b, c = [0.3, 0.2, 0], [-0.5, 0.3, 0], [0.5, 0.3, 0]
    v = np.array([a, a, a, b, c, [0.5000001, 0.3, 0], [0, 0.1, 0.4], [0.1, 0.1, 0.4], b])
    f = np.array([[0, 1, 2], [3, 4, 5], [3, 3, 4], [6, 7, 8], [6, 7, 8]], np.uint32)
    rendered(scene(1, np.zeros(3), integrator, more=[Mesh.of(v, f, 0.5)]))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_one_pixel_and_black_environments(integrator: Integrator) -> None:
    one = rendered(scene(1, np.zeros(3), integrator, np.ones((1, 2, 3), np.float32)))
    even = rendered(scene(1, np.zeros(3), integrator, np.ones((16, 32, 3), np.float32)))
    assert difference(even, one) < 0.05
    black = rendered(scene(1, np.zeros(3), integrator, np.zeros((4, 8, 3), np.float32)))
    assert float(black.objects.max()) == 0
    assert (black.rgb[black.alpha == 0] == np.float32(0.4)).all()  # nothing to take away


@pytest.mark.parametrize("value", [np.nan, -0.1, np.inf])
def test_an_environment_that_is_no_light_is_refused_with_its_count(value: float) -> None:
    light = sky()
    light[3, 4:7, 1] = value
    with pytest.raises(UserError, match="3"):
        scene(1, np.zeros(3), "path", light)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_camera_inside_glass_sees_out(integrator: Integrator) -> None:
    shell = sphere(32, 64)
    glass = Mesh.of(shell[0], shell[1], 1.0, kind=Kind.GLASS, normals=shell[2]).placed(
        Pose(np.eye(3), np.array([0.3, 0.95, 1.8])), 0.5
    )
    result = rendered(scene(1, np.zeros(3), integrator, more=[glass]), 16)
    assert (result.alpha == 1).all()
    assert 0.05 < float(result.rgb.mean()) < 5


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_lamp_among_the_objects_and_one_inside_another(integrator: Integrator) -> None:
    shell = sphere(16, 32)
    lamp = Mesh.of(shell[0], shell[1], 0.0, emission=50.0).placed(
        Pose(np.eye(3), np.array([0.0, 0.1, 0.0])), 0.2
    )
    inside = rendered(scene(1, np.zeros(3), integrator, more=[lamp]))
    without = rendered(scene(1, np.zeros(3), integrator))
    # the lamp is inside the ball: its light does not come out
    assert difference(without, inside) < 0.05


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_pictures_without_pixels_are_refused(integrator: Integrator) -> None:
    job = scene(1, np.zeros(3), integrator)
    with pytest.raises((UserError, ValueError), match="pixel"):
        job.look(np.zeros((1, 1, 3), np.float32), np.zeros(3), np.zeros((0, 0, 3), np.float32))


def test_memory_that_runs_out_is_said(tmp_path: Path) -> None:
    (tmp_path / "build").mkdir()
    light = np.ones((16, 32, 3), np.float32)
    write_exr(tmp_path / "build/env.exr", light, attributes={"origin": (0.0, 1.0, 1.5)})
    (tmp_path / "scene.toml").write_text(
        'name = "big"\n[[object]]\nname = "b"\nmesh = "sphere"\n'
        '[[view]]\nname = "v"\nmodel = "latlong"\nsize = [120000, 60000]\n'
    )
    program = (
        "import resource, sys\n"
        "from chromeball.cli.main import main\n"
        "resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))\n"
        f"sys.argv = ['chromeball', 'render', {str(tmp_path / 'scene.toml')!r}, '--spp', '1']\n"
        "main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("chromeball: not enough memory")
    assert not list((tmp_path / "build").glob("v*"))


def test_objects_too_far_for_float32_are_refused() -> None:
    shell = sphere(8, 16)
    far = Mesh.of(shell[0] * np.float32(1e12), shell[1], 0.5)
    with pytest.raises(UserError, match=r"reaches 1e\+12 m"):
        scene(1, np.zeros(3), "path", more=[far])


def test_texture_coordinates_that_overflow_are_texels_all_the_same() -> None:
    vertices = np.array([[-1, 0.3, 0], [1, 0.3, 0], [0, 1, 0]], np.float32)
    uv = np.array([[3e38, 3e38], [-3e38, 3e38], [3e38, -3e38]], np.float32)
    picture = Texture(np.full((2, 3, 3), 0.5, np.float32))
    material = Material(specular=0.0, base_color_texture=picture)
    faces = np.array([[0, 1, 2]], np.uint32)
    rendered(
        scene(1, np.zeros(3), "path", more=[Mesh.of(vertices, faces, material=material, uv=uv)])
    )
