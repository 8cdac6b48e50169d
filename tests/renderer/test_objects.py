"""Objects and area lights of the scene file: materials, places, what they emit."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.renderer.inputs import scene_inputs
from chromeball.renderer.lights import area_lights
from chromeball.renderer.material import Material
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import corner_rays, path_trace
from chromeball.renderer.primitives import box
from chromeball.renderer.scene import baked, object_instances, object_meshes
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import srgb_decode
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Scene, parse_scene
from chromeball.scene.pose import Pose
from tests.renderer.asset_files import Gltf, cube, picture


def scene_of(*objects: str) -> Scene:
    text = "".join(f'[[object]]\nname = "o{i}"\n{o}\n' for i, o in enumerate(objects))
    return parse_scene('name = "s"\n' + text)


def materials_of(text: str, folder: Path = Path()) -> tuple[Material, ...]:
    ((instance,),) = object_instances(scene_of(text), folder)
    return instance.mesh.materials


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", Material.diffuse((0.5, 0.5, 0.5))),
        ("{ color = [0.1, 0.2, 0.3] }", Material.diffuse((0.1, 0.2, 0.3))),
        ('{ kind = "mirror" }', Material.mirror((0.5, 0.5, 0.5))),
        (
            '{ kind = "glass", color = [1, 1, 1], ior = 1.4 }',
            Material.glass((1.0, 1.0, 1.0), 1.4),
        ),
        (
            '{ kind = "thin_glass", color = [1, 1, 1], roughness = 0.1 }',
            Material((1.0, 1.0, 1.0), roughness=0.1, transmission=1.0, thin=True),
        ),
        (
            '{ kind = "metallic_roughness", metallic = 0.5, roughness = 0.2, specular = 0.4, '
            "clearcoat = 0.3, clearcoat_roughness = 0.1, transmission = 0.6, ior = 1.2, "
            "emission = [3, 2, 1], alpha = 0.7 }",
            Material(
                metallic=0.5,
                roughness=0.2,
                specular=0.4,
                clearcoat=0.3,
                clearcoat_roughness=0.1,
                transmission=0.6,
                ior=1.2,
                emission=(3.0, 2.0, 1.0),
                alpha=0.7,
                alpha_mode="blend",
            ),
        ),
    ],
)
def test_materials_of_the_scene_file(text: str, expected: Material) -> None:
    line = f"material = {text}" if text else ""
    assert materials_of(f'mesh = "sphere"\n{line}') == (expected,)


def test_the_files_own_material_is_used_unless_another_is_given(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(cube(gltf, pbrMetallicRoughness={"roughnessFactor": 0.25})))
    gltf.write(tmp_path / "cube.glb")
    (own,) = materials_of('mesh = "cube.glb"', tmp_path)
    assert own.roughness == 0.25
    (given,) = materials_of('mesh = "cube.glb"\nmaterial = { kind = "mirror" }', tmp_path)
    assert given == Material.mirror((0.5, 0.5, 0.5))


def test_textures_lie_beside_the_scene_and_need_uv(tmp_path: Path) -> None:
    codes = np.full((1, 1, 3), 128, np.uint8)
    (tmp_path / "images").mkdir()
    picture(tmp_path / "images/wood.png", codes)
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(cube(gltf)))
    gltf.write(tmp_path / "cube.gltf", "cube.bin")
    wood = 'material = { color_texture = "images/wood.png", wrap = "mirror" }'
    (material,) = materials_of(f'mesh = "cube.gltf"\n{wood}', tmp_path)
    assert material.base_color == (1.0, 1.0, 1.0)
    texture = material.base_color_texture
    assert texture is not None
    assert texture.wrap == ("mirror", "mirror")
    np.testing.assert_allclose(
        texture.pixels[0, 0], srgb_decode(np.array([128 / 255] * 3)), rtol=1e-6
    )
    with pytest.raises(UserError, match=r"\[\[object\]\] 'o0': a texture needs texture coord"):
        materials_of(f'mesh = "sphere"\n{wood}', tmp_path)
    with pytest.raises(UserError, match=r"\[\[object\]\] 'o0': .*none.png: no such picture"):
        materials_of(f'mesh = "cube.gltf"\n{wood.replace("wood", "none")}', tmp_path)
    names = scene_inputs(scene_of(f'mesh = "cube.gltf"\n{wood}'), tmp_path)
    assert {n.name for n in names} == {"cube.gltf", "cube.bin", "wood.png"}


def test_instances_share_a_mesh_and_stand_where_they_are_told(tmp_path: Path) -> None:
    text = (
        'mesh = "box"\nposition = [1, 0, 0]\nscale = 2\n'
        "instances = [{}, { rotation = [0, 90, 0], scale = [1, 2, 1], position = [0, 5, 0] }]"
    )
    scene = scene_of(text)
    ((first, second),) = object_instances(scene, tmp_path)
    assert first.mesh is second.mesh
    corner = np.array([0.5, 1, 0.5])
    np.testing.assert_allclose(first.matrix() @ [*corner, 1], [2, 2, 1])
    # (2, 2, 1) twice as high, a quarter about y (x to -z, z to x), then up by 5
    np.testing.assert_allclose(second.matrix() @ [*corner, 1], [1, 9, -2], atol=1e-12)
    (mesh,) = object_meshes(scene, tmp_path)
    assert len(mesh.faces) == 24
    both = [baked(i).vertices for i in (first, second)]
    np.testing.assert_allclose(mesh.vertices, np.concatenate(both))


def test_shared_parts_of_a_file_are_instances_and_others_one_mesh(tmp_path: Path) -> None:
    shared, single = Gltf(), Gltf()
    mesh = shared.mesh(cube(shared))
    for k in range(3):
        shared.node(mesh=mesh, translation=[k, 0, 0], scale=[1, -1, 1])
        single.node(mesh=single.mesh(cube(single)), translation=[k, 0, 0], scale=[1, -1, 1])
    shared.write(tmp_path / "shared.glb")
    single.write(tmp_path / "single.glb")
    place = "position = [0, 3, 0]\nscale = 2"
    scene = scene_of(f'mesh = "shared.glb"\n{place}', f'mesh = "single.glb"\n{place}')
    several, one = object_instances(scene, tmp_path)
    assert (len(several), len(one)) == (3, 1)
    assert len({id(i.mesh) for i in several}) == 1
    a, b = object_meshes(scene, tmp_path)
    np.testing.assert_allclose(a.vertices[a.faces], b.vertices[b.faces], atol=1e-6)
    p, q, r = np.moveaxis(a.vertices[a.faces].astype(float), 1, 0)
    volume = np.einsum("ij,ij->", np.cross(p, q), r) / 6
    assert volume == pytest.approx(3 * 8)  # outside stays outside through the mirror


def test_two_objects_of_one_file_share_its_triangles(tmp_path: Path) -> None:
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in box()[0])
    text += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in box()[1])
    (tmp_path / "box.obj").write_text(text)
    twice = object_instances(
        scene_of('mesh = "box.obj"', 'mesh = "box.obj"\nposition = [3, 0, 0]'), tmp_path
    )
    assert twice[0][0].mesh is twice[1][0].mesh
    ((smooth,),) = object_instances(scene_of('mesh = "box.obj"\nsmooth = 100'), tmp_path)
    assert smooth.mesh.normals is not None


# ---- area lights


def light_of(text: str, folder: Path = Path()) -> Mesh:
    scene = parse_scene(f'name = "s"\n[[light]]\nname = "l"\nkind = "area"\n{text}\n')
    (instance,) = area_lights(scene, folder)
    return baked(instance)


def seen(mesh: Mesh, eye: list[float], at: list[float], spp: int = 256) -> NDArray[np.float32]:
    """A picture of 1 x 1 pixels, narrow, towards a point."""
    pose = Pose.look_at(np.array(eye), np.array(at), np.array([0.0, 0.6, 0.8]))
    rays = corner_rays(CameraModel.pinhole((2, 2), math.radians(0.2), pose))
    return path_trace(mesh, rays, np.array(eye), spp=spp, max_bounces=1).mean(axis=(0, 1))


FLOOR = Mesh.of(
    np.array([[-9, 0, 9], [9, 0, 9], [9, 0, -9], [-9, 0, -9]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
    0.5,
)


@pytest.mark.parametrize("given", ["radiance = [2, 3, 4]", "power = [6.2832, 9.4248, 12.5664]"])
def test_a_disc_lights_the_floor_as_its_form_factor_says(given: str) -> None:
    """E = pi L R^2 / (R^2 + h^2) under a parallel disc; the power is that of radius 1 / pi."""
    radius = 0.75 if "radiance" in given else math.sqrt(1 / math.pi)
    disc = light_of(f"position = [0, 2, 0]\ndirection = [0, -1, 0]\nradius = {radius}\n{given}")
    floor = seen(Mesh.join([FLOOR, disc]), [4, 1, 0], [0, 0, 0], 4096)
    factor = radius**2 / (radius**2 + 4)
    np.testing.assert_allclose(floor, 0.5 * np.array([2, 3, 4]) * factor, rtol=0.02)
    # from behind it is black, unless it has two sides
    np.testing.assert_allclose(seen(disc, [0.1, 5, 0], [0.1, 2, 0.1]), 0, atol=1e-6)
    np.testing.assert_allclose(seen(disc, [0.1, 0.5, 0], [0.1, 2, 0.1]), [2, 3, 4], rtol=1e-3)
    both = light_of(
        f"position = [0, 2, 0]\ndirection = [0, -1, 0]\nradius = {radius}\n{given}\n"
        "two_sided = true"
    )
    sides = 1 if "radiance" in given else 0.5  # a power is shared by the sides
    expected = sides * np.array([2, 3, 4])
    np.testing.assert_allclose(seen(both, [0.1, 5, 0], [0.1, 2, 0.1]), expected, rtol=1e-3)


def test_the_image_of_an_area_light_is_upright(tmp_path: Path) -> None:
    """Seen from the front: red at the top left, green right of it, blue below."""
    codes = np.zeros((2, 2, 3), np.uint8)
    codes[0, 0], codes[0, 1], codes[1, 0] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    picture(tmp_path / "tv.png", codes)
    tv = light_of(
        'position = [0, 1, -2]\nlook_at = [0, 1, 0]\nsize = [2, 1]\ntexture = "tv.png"\n'
        "radiance = [5, 5, 5]",
        tmp_path,
    )
    corners = {(-0.9, 1.45): [5, 0, 0], (0.9, 1.45): [0, 5, 0], (-0.9, 0.55): [0, 0, 5]}
    for (x, y), expected in corners.items():
        np.testing.assert_allclose(
            seen(tv, [0, 1, 3], [x, y, -2], 64), expected, atol=0.2, err_msg=f"{x} {y}"
        )


def test_a_black_image_has_no_power(tmp_path: Path) -> None:
    picture(tmp_path / "black.png", np.zeros((2, 2, 3), np.uint8))
    text = 'position = [0, 1, 0]\ndirection = [0, 0, 1]\nradius = 1\ntexture = "black.png"\n'
    with pytest.raises(UserError, match=r"\[\[light\]\] 'l': .*the texture is black"):
        light_of(text + "power = [1, 1, 1]", tmp_path)
