"""Mesh files read as they were written: triangles, normals, uv, materials and places."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.renderer import files
from chromeball.renderer.assets import read_parts
from chromeball.renderer.inputs import mesh_inputs
from chromeball.renderer.material import Material
from chromeball.renderer.part import Part, face_areas, smooth
from chromeball.renderer.primitives import box, cylinder, sphere
from chromeball.scene.color import srgb_decode
from chromeball.scene.errors import UserError
from tests.renderer.asset_files import Gltf, cube, picture, ply

DATA = Path(__file__).parents[2] / "../shared/data/render"
PYRAMID = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0.5, 0.7, 0.5]])
SIDES = [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]


def corners(part: Part) -> NDArray[np.float64]:
    """The corners of each triangle in the world, (F, 3, 3)."""
    points = part.vertices @ part.pose[:3, :3].T + part.pose[:3, 3]
    return points[part.faces]


def as_set(triangles: NDArray[Any]) -> set[Any]:
    """Triangles whatever their order and first corner."""
    turned = [tuple(sorted(map(tuple, np.round(t, 5).tolist()))) for t in triangles]
    return set(turned)


# ---- PLY


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("real", ["f4", "f8"])
def test_ply_of_every_format_is_read(tmp_path: Path, kind: str, real: str) -> None:
    file = tmp_path / "pyramid.ply"
    file.write_bytes(ply(kind, PYRAMID, SIDES, real=real))
    (part,) = read_parts(file)
    assert part.faces.shape == (6, 3)
    np.testing.assert_array_equal(part.vertices, PYRAMID.astype(np.float32))
    slope = math.hypot(0.7, 0.5) / 2
    assert face_areas(part.vertices, part.faces).sum() == pytest.approx(1 + 4 * slope)
    assert part.normals is None
    assert part.materials == ()


def test_ply_has_normals_and_uv(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "quad.ply"
    names = ["x", "y", "z", "nx", "ny", "nz", "s", "t"]
    file.write_text(
        "ply\r\nformat ascii 1.0\r\nelement vertex 3\r\n"
        + "".join(f"property float {n}\r\n" for n in names)
        + "".join(f"property uchar {n}\r\n" for n in ("red", "green", "blue"))
        + "element face 1\r\nproperty list uchar int vertex_index\r\nend_header\r\n"
        "0 0 0 0 0 1 0.25 0 1 2 3\r\n1 0 0 0 0 1 1 0 1 2 3\r\n0 1 0 0 0 1 0 1 1 2 3\r\n"
        "3 0 1 2\r\n",
        newline="",
    )
    (part,) = read_parts(file)
    assert part.normals is not None
    assert part.uv is not None
    np.testing.assert_array_equal(part.normals, [[0, 0, 1]] * 3)
    np.testing.assert_array_equal(part.uv, [[0.25, 1], [1, 1], [0, 0]])  # v is down here
    assert "colours of vertices are not used" in capsys.readouterr().err


def test_three_routes_to_one_mesh(tmp_path: Path) -> None:
    """The same pyramid from PLY and OBJ, and the OBJ read by MeshLab too."""
    import pymeshlab

    (tmp_path / "a.ply").write_bytes(ply("ascii", PYRAMID, SIDES))
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in PYRAMID)
    text += "".join("f " + " ".join(str(i + 1) for i in p) + "\n" for p in SIDES)
    (tmp_path / "a.obj").write_text(text)
    found = [as_set(corners(read_parts(tmp_path / f"a.{e}")[0])) for e in ("ply", "obj")]
    assert found[0] == found[1]
    meshes = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]
    meshes.load_new_mesh(str(tmp_path / "a.obj"))
    mesh = meshes.current_mesh()
    theirs = as_set(mesh.vertex_matrix()[mesh.face_matrix()])
    sides = {t for t in found[0] if any(y > 0.5 for _, y, _ in t)}
    assert sides == {t for t in theirs if any(y > 0.5 for _, y, _ in t)}  # diagonals may differ


@pytest.mark.skipif(not DATA.is_dir(), reason="the render data are not there")
def test_the_scenes_meshes_are_the_same_as_meshlab_reads_them() -> None:
    import pymeshlab

    (part,) = read_parts(DATA / "knot.ply")
    meshes = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]
    meshes.load_new_mesh(str(DATA / "knot.ply"))
    mesh = meshes.current_mesh()
    np.testing.assert_array_equal(part.faces, mesh.face_matrix())
    np.testing.assert_allclose(part.vertices, mesh.vertex_matrix(), rtol=1e-6)
    assert part.normals is not None
    np.testing.assert_allclose(part.normals, mesh.vertex_normal_matrix(), atol=1e-4)


# ---- polygons


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.1, 1), min_size=4, max_size=24),
    st.integers(0, 2),
    st.booleans(),
)
def test_a_polygon_is_cut_into_its_own_area(
    radii: list[float], axis: int, reverse: bool
) -> None:
    """Star-shaped polygons, convex or not: all triangles lie the same way round."""
    angle = np.linspace(0, 2 * math.pi, len(radii), endpoint=False)
    flat = np.stack([np.cos(angle), np.sin(angle)], 1) * np.array(radii)[:, None]
    points = np.insert(flat, axis, 0.5, axis=1).astype(np.float32)
    order = np.arange(len(radii), dtype=np.int32)[:: -1 if reverse else 1].copy()
    at, of = files.triangulate(points, np.array([len(radii)], np.int32), order)
    assert len(at) == len(radii) - 2
    assert not of.any()
    a, b, c = np.moveaxis(points[order[at]].astype(float), 1, 0)
    areas = np.cross(b - a, c - a)[:, axis] / 2
    x, y = flat[order].T
    whole = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    whole *= -1 if axis == 1 else 1
    assert areas.sum() == pytest.approx(whole, rel=1e-4)
    assert (areas * np.sign(whole) > -1e-6).all()


def test_corners_out_of_range_are_refused_by_the_core() -> None:
    points = np.zeros((3, 3), np.float32)
    for sizes, at in (([3], [0, 1, 3]), ([3], [0, 1, -1]), ([4], [0, 1, 2]), ([-1], [])):
        with pytest.raises(ValueError, match=r"face|sizes"):
            files.triangulate(points, np.array(sizes, np.int32), np.array(at, np.int32))


# ---- OBJ

OBJ = """\
mtllib wood.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
usemtl plank
f 1/1/1 2/2/1 \\
  3/3/1 4/4/1
usemtl lamp
f -4//-1 -3//-1 -2//-1
"""
MTL = """\
newmtl plank
Kd 0.5 0.25 1
Pr 0.3
Pm 0.75
Pc 0.5
map_Kd -clamp on wood.png
newmtl lamp   # shines
Ke 3 2 1
Kd 0 0 0
d 0.5
"""


def test_obj_with_materials(tmp_path: Path) -> None:
    codes = np.zeros((2, 2, 3), np.uint8)
    codes[0, 1] = 188, 0, 255
    picture(tmp_path / "wood.png", codes)
    (tmp_path / "wood.mtl").write_text(MTL)
    (tmp_path / "board.obj").write_text(OBJ)
    (part,) = read_parts(tmp_path / "board.obj")
    assert len(part.faces) == 3
    assert part.uv is not None
    assert part.normals is not None
    plank, lamp = (part.materials[part.material[i]] for i in (0, 2))
    assert plank.base_color == (0.5, 0.25, 1.0)
    assert (plank.metallic, plank.roughness, plank.clearcoat) == (0.75, 0.3, 0.5)
    texture = plank.base_color_texture
    assert texture is not None
    assert texture.wrap == ("clamp", "clamp")
    expected = srgb_decode(np.array([188, 0, 255]) / 255)
    np.testing.assert_allclose(texture.pixels[0, 1], expected, rtol=1e-6)
    assert lamp.emission == (3, 2, 1)
    assert (lamp.alpha, lamp.alpha_mode, lamp.specular) == (0.5, "blend", 0)
    corner = part.faces[0][0]
    np.testing.assert_array_equal(part.uv[corner], [0, 1])  # v is down here
    np.testing.assert_array_equal(part.normals[corner], [0, 0, 1])
    names = {path.name for path in mesh_inputs(tmp_path / "board.obj")}
    assert names == {"board.obj", "wood.mtl", "wood.png"}


def test_classic_materials_of_obj(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nmtllib a b.mtl\nusemtl {}\nf 1 2 3\n"
    (tmp_path / "a b.mtl").write_text(
        "newmtl glass\nillum 7\nNi 1.4\nTf 0.9 1 0.8\nnewmtl mirror\nillum 3\nKd 0 0 0\n"
        "Ks 0.7 0.8 0.9\nnewmtl matt\nKd 0.2 0.3 0.4\nillum 1\n"
    )
    expected = {
        "glass": Material.glass((0.9, 1.0, 0.8), 1.4),
        "mirror": Material.mirror((0.7, 0.8, 0.9)),
    }
    for name, material in expected.items():
        (tmp_path / "t.obj").write_text(text.format(name))
        assert read_parts(tmp_path / "t.obj")[0].materials == (material,)
    (tmp_path / "t.obj").write_text(text.format("matt"))
    (matt,) = read_parts(tmp_path / "t.obj")[0].materials
    assert (matt.base_color, matt.specular) == ((0.2, 0.3, 0.4), 0)
    (tmp_path / "t.obj").write_text(text.format("mat"))
    with pytest.raises(UserError, match="no material 'mat' in a b"):
        read_parts(tmp_path / "t.obj")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("v 1 x 2", "line 5: 'x' is no number"),
        ("v 1 2", "line 5: 3 numbers expected"),
        ("f 1 2 9", "a face names vertex 9, the mesh has 3"),
        ("f 1 2 0", "a face names vertex 0"),
        ("f 1 2 -4", "a face names vertex -4"),
        ("f 1/1 2/1 3/1", "a face names texture coordinate 1, the mesh has 0"),
        ("f 1//2 2//2 3//2", "a face names normal 2, the mesh has 0"),
        ("f 1/2/3/4 2 3", "more than three numbers"),
        ("f 1 2 99999999999999999999", "is no number of a vertex"),
        ("v nan 0 0\nf 1 2 4", "1 vertices are NaN"),
        ("v 1e999 0 0\nf 1 2 4", "1 vertices are NaN"),
    ],
)
def test_broken_obj_lines_are_named(tmp_path: Path, line: str, message: str) -> None:
    file = tmp_path / "broken.obj"
    file.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n{line}\n")
    with pytest.raises(UserError, match=message):
        read_parts(file)


# ---- glTF


def test_gltf_is_the_same_embedded_beside_and_binary(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(cube(gltf)), translation=[1, 2, 3])
    paths = [
        gltf.write(tmp_path / "a.gltf"),
        gltf.write(tmp_path / "b.gltf", "data b.bin"),
        gltf.write(tmp_path / "c.glb"),
    ]
    vertices, faces, _ = box()
    for path in paths:
        (part,) = read_parts(path)
        np.testing.assert_array_equal(part.faces, faces)
        np.testing.assert_allclose(
            corners(part), vertices[faces].astype(float) + [1, 2, 3], rtol=1e-6
        )
        assert part.materials == (Material(base_color=(1.0, 1.0, 1.0), metallic=1.0),)
    assert [p.name for p in mesh_inputs(paths[1])] == ["b.gltf", "data b.bin"]


def test_gltf_nodes_carry_each_other_and_share_their_mesh(tmp_path: Path) -> None:
    gltf = Gltf()
    mesh = gltf.mesh(cube(gltf))
    s = math.sqrt(0.5)
    leaf = gltf.node(root=False, mesh=mesh, scale=[1, 2, 3], translation=[1, 0, 0])
    gltf.node(children=[leaf], rotation=[0, s, 0, s])  # a quarter about +y: x to -z
    matrix = np.eye(4)
    matrix[:3, 3] = 7, 8, 9
    gltf.node(mesh=mesh, matrix=matrix.T.reshape(-1).tolist())
    first, second = read_parts(gltf.write(tmp_path / "nodes.glb"))
    assert first.vertices is second.vertices
    expected = np.array([[0, 0, 3, 0], [0, 2, 0, 0], [-1, 0, 0, -1], [0, 0, 0, 1]])
    np.testing.assert_allclose(first.pose, expected, atol=1e-12)
    np.testing.assert_allclose(second.pose, matrix)


def test_gltf_instancing_extension(tmp_path: Path) -> None:
    gltf = Gltf()
    places = np.array([[0, 0, 0], [5, 0, 0], [0, 0, -4]], np.float32)
    scales = np.array([[1, 1, 1], [2, 2, 2], [1, 3, 1]], np.float32)
    many = {"TRANSLATION": gltf.accessor(places), "SCALE": gltf.accessor(scales)}
    gltf.node(
        mesh=gltf.mesh(cube(gltf)),
        translation=[0, 1, 0],
        extensions={"EXT_mesh_gpu_instancing": {"attributes": many}},
    )
    gltf.json["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    parts = read_parts(gltf.write(tmp_path / "many.glb"))
    np.testing.assert_allclose([p.pose[:3, 3] for p in parts], places + [0, 1, 0])
    np.testing.assert_allclose([np.diag(p.pose)[:3] for p in parts], scales)


def test_gltf_strips_fans_and_what_is_no_surface(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gltf = Gltf()
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    strip = {"attributes": {"POSITION": gltf.accessor(square)}, "mode": 5}
    round_ = square[[0, 1, 3, 2]]
    fan = {"attributes": {"POSITION": gltf.accessor(round_)}, "mode": 6}
    lines = {"attributes": {"POSITION": gltf.accessor(square)}, "mode": 1}
    gltf.node(mesh=gltf.mesh(strip, fan, lines))
    (part,) = read_parts(gltf.write(tmp_path / "strip.glb"))
    a, b, c = np.moveaxis(corners(part), 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 1]] * 4)  # all one way round
    assert "1 sets of points and lines" in capsys.readouterr().err


def test_gltf_quantized_strided_and_sparse(tmp_path: Path) -> None:
    gltf = Gltf()
    vertices, faces, _ = box()
    codes = np.round(vertices * 127).astype(np.int8)
    padded = np.concatenate([codes, np.zeros((8, 1), np.int8)], axis=1)
    view = gltf.view(padded.tobytes(), byteStride=4)
    accessor: dict[str, Any] = {
        "bufferView": view,
        "componentType": 5120,
        "count": 8,
        "type": "VEC3",
        "normalized": True,
    }
    moved = gltf.view(np.array([[0, 127, 0]], np.int8).tobytes())
    where = gltf.view(np.array([7], np.uint8).tobytes())
    accessor["sparse"] = {
        "count": 1,
        "indices": {"bufferView": where, "componentType": 5121},
        "values": {"bufferView": moved},
    }
    gltf.json["accessors"].append(accessor)
    position = len(gltf.json["accessors"]) - 1
    index = gltf.accessor(faces.astype(np.uint8).reshape(-1))
    gltf.node(mesh=gltf.mesh({"attributes": {"POSITION": position}, "indices": index}))
    (part,) = read_parts(gltf.write(tmp_path / "quantized.glb"))
    expected = codes.astype(np.float32) / 127
    expected[7] = 0, 1, 0
    np.testing.assert_allclose(part.vertices, expected, rtol=1e-6)


def test_gltf_materials(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gltf = Gltf()
    codes = np.array([[[255, 128, 0, 64], [10, 20, 30, 255]]], np.uint8)
    image = picture(tmp_path / "color map.png", codes)
    gltf.add("images", {"uri": "color%20map.png"})
    gltf.add("images", {"bufferView": gltf.view(image.read_bytes()), "mimeType": "image/png"})
    sampler = gltf.add("samplers", {"wrapS": 33071, "wrapT": 33648})
    gltf.add("textures", {"source": 0, "sampler": sampler})
    gltf.add("textures", {"source": 1})
    moved = {"KHR_texture_transform": {"offset": [0.5, 0.25], "scale": [2, 3]}}
    primitive = cube(
        gltf,
        name="all",
        pbrMetallicRoughness={
            "baseColorFactor": [0.1, 0.2, 0.3, 0.4],
            "metallicFactor": 0.5,
            "roughnessFactor": 0.6,
            "baseColorTexture": {"index": 0, "extensions": moved},
            "metallicRoughnessTexture": {"index": 1, "extensions": moved},
        },
        normalTexture={"index": 1, "scale": 0.7, "extensions": moved},
        emissiveTexture={"index": 0},
        emissiveFactor=[1, 0.5, 0.25],
        alphaMode="MASK",
        alphaCutoff=0.3,
        doubleSided=True,
        extensions={
            "KHR_materials_emissive_strength": {"emissiveStrength": 8},
            "KHR_materials_clearcoat": {
                "clearcoatFactor": 0.9,
                "clearcoatRoughnessFactor": 0.1,
                "clearcoatTexture": {"index": 0},
            },
            "KHR_materials_transmission": {"transmissionFactor": 0.8},
            "KHR_materials_ior": {"ior": 1.33},
            "KHR_materials_specular": {"specularFactor": 0.35},
        },
    )
    gltf.node(mesh=gltf.mesh(primitive))
    (part,) = read_parts(gltf.write(tmp_path / "material.gltf"))
    (m,) = part.materials
    expected = Material(
        base_color=(0.1, 0.2, 0.3),
        metallic=0.5,
        roughness=0.6,
        specular=0.35,
        ior=1.33,
        transmission=0.8,
        thin=True,
        clearcoat=0.9,
        clearcoat_roughness=0.1,
        emission=(8.0, 4.0, 2.0),
        alpha=0.4,
        alpha_mode="mask",
        alpha_cutoff=0.3,
        normal_scale=0.7,
        base_color_texture=m.base_color_texture,
        metallic_roughness_texture=m.metallic_roughness_texture,
        normal_texture=m.normal_texture,
    )
    assert m == expected
    assert m.base_color_texture is not None
    assert m.normal_texture is not None
    assert m.base_color_texture.wrap == ("clamp", "mirror")
    linear = srgb_decode(codes / 255)
    linear[..., 3] = codes[..., 3] / 255
    np.testing.assert_allclose(m.base_color_texture.pixels, linear, rtol=1e-6)
    np.testing.assert_allclose(m.normal_texture.pixels, codes / 255, rtol=1e-6)
    assert m.normal_texture is m.metallic_roughness_texture  # read once
    vertices, _, _ = box()
    assert part.uv is not None
    uv = (vertices[:, :2] + 0.5) * [2, 3] + [0.5, 0.25]
    np.testing.assert_allclose(part.uv, uv, rtol=1e-6)
    said = capsys.readouterr().err
    assert "its emission texture is left out, having other coordinates" in said
    assert "textures of clearcoat and transmission are not used" in said
    names = [p.name for p in mesh_inputs(tmp_path / "material.gltf")]
    assert names == ["material.gltf", "color map.png"]


def test_texture_coordinates_turn_as_the_extension_says(tmp_path: Path) -> None:
    """A quarter turn, counter-clockwise as seen with v down: (1, 0) becomes (0, -1)."""
    picture(tmp_path / "a.png", np.zeros((1, 1, 3), np.uint8))
    gltf = Gltf()
    gltf.add("images", {"uri": "a.png"})
    gltf.add("textures", {"source": 0})
    moved = {"KHR_texture_transform": {"rotation": math.pi / 2, "scale": [2, 1]}}
    use = {"index": 0, "extensions": moved}
    primitive = cube(gltf, pbrMetallicRoughness={"baseColorTexture": use})
    gltf.node(mesh=gltf.mesh(primitive))
    (part,) = read_parts(gltf.write(tmp_path / "turned.gltf"))
    u, v = (box()[0][:, :2] + 0.5).T
    assert part.uv is not None
    np.testing.assert_allclose(part.uv, np.stack([v, -2 * u], axis=1), atol=1e-6)


def test_thick_transmission_is_glass(tmp_path: Path) -> None:
    gltf = Gltf()
    extensions = {
        "KHR_materials_transmission": {"transmissionFactor": 1},
        "KHR_materials_volume": {"thicknessFactor": 0.1},
    }
    gltf.node(mesh=gltf.mesh(cube(gltf, extensions=extensions)))
    (part,) = read_parts(gltf.write(tmp_path / "glass.glb"))
    assert not part.materials[0].thin


def broken(name: str) -> Gltf:
    """A document with one thing wrong."""
    gltf = Gltf()
    child = gltf.node(mesh=gltf.mesh(cube(gltf)))
    accessors, views = gltf.json["accessors"], gltf.json["bufferViews"]
    match name:
        case "loop":
            gltf.json["nodes"][child]["children"] = [child]
        case "beyond":
            accessors[0]["count"] = 9
        case "huge":
            accessors[0]["count"] = 2**40
        case "empty":
            del accessors[0]["bufferView"]
            accessors[0]["count"] = 2**40
        case "view":
            views[0]["byteLength"] = 10**9
        case "index":
            accessors[2] = accessors[2] | {"count": 3}
            gltf.json["accessors"][0]["count"] = 1
        case "draco":
            gltf.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
        case "web":
            gltf.add("images", {"uri": "https://example.org/a.png"})
            gltf.add("textures", {"source": 0})
            use = {"baseColorTexture": {"index": 0}}
            gltf.json["meshes"][0]["primitives"][0]["material"] = gltf.add(
                "materials", {"pbrMetallicRoughness": use}
            )
        case "shader":
            gltf.json["meshes"][0]["primitives"][0]["material"] = gltf.add(
                "materials", {"pbrMetallicRoughness": {"roughnessFactor": 3}}
            )
        case "version":
            gltf.json["asset"]["version"] = "1.0"
        case "quaternion":
            gltf.json["nodes"][0]["rotation"] = [0, 0, 0, 0]
        case "nothing":
            gltf.json["nodes"][0]["scale"] = [1, 0, 1]
        case _:
            raise ValueError(name)
    return gltf


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("loop", "node 0 has two parents, or is its own"),
        ("beyond", "an accessor reaches beyond"),
        ("huge", "an accessor reaches beyond"),
        ("empty", "has 1099511627776 rows and no data"),
        ("view", "a bufferView reaches beyond its buffer"),
        ("index", "a face names a vertex that is not among the 1"),
        ("draco", "it needs KHR_draco_mesh_compression; export it without"),
        ("web", "files beside it alone are read"),
        ("shader", r"material '0': roughness is 3.0; it lies between 0 and 1"),
        ("version", "glTF version 1.0; export it as 2.0"),
        ("quaternion", "a rotation is zero"),
        ("nothing", "the mesh has no faces"),
    ],
)
@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_broken_gltf_is_refused(tmp_path: Path, name: str, message: str, suffix: str) -> None:
    file = broken(name).write(tmp_path / f"broken.{suffix}")
    with pytest.raises(UserError, match=message) as error:
        read_parts(file)
    assert str(error.value).startswith(str(file))
    assert "\n" not in str(error.value)


# ---- smooth normals


def stripped(mesh: tuple[NDArray[np.float32], NDArray[np.uint32], object]) -> Part:
    return Part(mesh[0], mesh[1])


def test_a_sphere_becomes_smooth() -> None:
    """To the sphere's own normals, the nearer the finer it is."""
    worst: list[float] = []
    for rings in (16, 64):
        part = smooth(stripped(sphere(rings, 2 * rings)), math.radians(40))
        exact = (part.vertices - [0, 0.5, 0]) / 0.5
        assert part.normals is not None
        cosine = np.einsum("ij,ij->i", part.normals, exact)
        worst.append(math.degrees(math.acos(cosine.min())))
    assert worst[0] < 1.5
    assert worst[1] < 0.3 * worst[0]


def test_a_crease_stays_sharp() -> None:
    part = smooth(stripped(cylinder(64)), math.radians(45))
    assert part.normals is not None
    cap = np.abs(part.normals[:, 1]) > 0.5
    np.testing.assert_allclose(np.abs(part.normals[cap, 1]), 1, atol=1e-6)
    np.testing.assert_allclose(part.normals[~cap, 1], 0, atol=1e-6)
    side = part.vertices[~cap][:, [0, 2]] / 0.5
    np.testing.assert_allclose(part.normals[~cap][:, [0, 2]], side, atol=1e-5)
    cubic = smooth(stripped(box()), math.radians(89))
    assert len(cubic.vertices) == 24
    round_ = smooth(stripped(box()), math.radians(91))
    assert len(round_.vertices) == 8
    assert round_.normals is not None
    np.testing.assert_allclose(np.abs(round_.normals), 3**-0.5, atol=1e-6)


def test_seams_of_uv_stay_smooth_and_keep_their_uv() -> None:
    """Two triangles that share an edge, its vertices written twice with other uv."""
    vertices = np.array(
        [[0, 0, 0], [0, 1, 0], [-1, 0, 0.2], [0, 1, 0], [0, 0, 0], [1, 0, 0.2]], np.float32
    )
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.uint32)
    uv = np.arange(12, dtype=np.float32).reshape(6, 2)
    part = smooth(replace(Part(vertices, faces), uv=uv), math.radians(60))
    assert part.normals is not None
    assert part.uv is not None
    np.testing.assert_array_equal(part.uv[part.faces.reshape(-1)], uv)
    n = part.normals[part.faces]
    np.testing.assert_allclose(n[0, 0], n[1, 1], atol=1e-6)
    np.testing.assert_allclose(n[0, 1], n[1, 0], atol=1e-6)
    sharp = smooth(replace(Part(vertices, faces), uv=uv), math.radians(10))
    assert sharp.normals is not None
    assert np.abs(sharp.normals[sharp.faces[0]] - sharp.normals[sharp.faces[0][0]]).max() < 1e-6


# ---- what the checks say


def test_instances_are_checked_once_and_faces_dropped_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gltf = Gltf()
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], np.float32)
    index = gltf.accessor(np.array([0, 1, 2, 0, 1, 3], np.uint32))
    mesh = gltf.mesh({"attributes": {"POSITION": gltf.accessor(points)}, "indices": index})
    gltf.node(mesh=mesh)
    gltf.node(mesh=mesh, translation=[1, 0, 0])
    first, second = read_parts(gltf.write(tmp_path / "twice.glb"))
    assert capsys.readouterr().err.count("1 faces without area") == 1
    assert first.faces is second.faces
    assert len(first.faces) == 1


def test_a_large_mesh_is_read_without_loops(tmp_path: Path) -> None:
    """A million triangles: no time is asserted, Python loops would be noticed."""
    n = 708
    x, z = np.meshgrid(np.arange(n, dtype=np.float32), np.arange(n, dtype=np.float32))
    vertices = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3)
    at = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate(
        [np.stack([at, at + n, at + 1], 1), np.stack([at + 1, at + n, at + n + 1], 1)]
    )
    rows = np.empty(len(faces), [("n", "u1"), ("v", "<i4", 3)])
    rows["n"], rows["v"] = 3, faces
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    file = tmp_path / "large.ply"
    file.write_bytes(head.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
    (part,) = read_parts(file)
    np.testing.assert_array_equal(part.faces, faces)
    assert face_areas(part.vertices, part.faces).sum() == pytest.approx((n - 1) ** 2)


def test_a_mirrored_part_keeps_its_outside(tmp_path: Path) -> None:
    """Its faces and normals look outward at the new place too."""
    vertices, faces, normals = sphere(8, 16)
    pose = np.diag([-1.0, 2, 1, 1])
    pose[:3, 3] = 3, 0, 0
    part = Part(vertices, faces, normals, pose=pose).baked()
    a, b, c = np.moveaxis(part.vertices[part.faces].astype(float), 1, 0)
    n = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", n, (a + b + c) / 3 - [3, 1, 0]) > 0).all()
    assert part.normals is not None
    exact = (part.vertices - np.array([3, 1, 0])) / np.array([0.25, 1, 0.25])
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    np.testing.assert_allclose(part.normals, exact, atol=1e-5)
