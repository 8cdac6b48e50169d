"""Broken mesh files of every kind: a UserError or a sound mesh, and nothing else."""

from __future__ import annotations

import resource
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from chromeball.renderer.assets import read_parts
from chromeball.renderer.inputs import mesh_inputs
from chromeball.renderer.part import face_areas
from chromeball.scene.errors import UserError
from tests.renderer.asset_files import Gltf, cube, picture, ply
from tests.renderer.test_assets import MTL, OBJ, PYRAMID, SIDES

#: What a number, a name or a list is replaced by.
NASTY = [
    -1,
    0,
    1,
    3,
    255,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**53,
    2**63,
    10**30,
    1e308,
    -0.5,
    1e-320,
]
WORDS = [
    *(
        b"-1",
        b"0",
        b"4294967295",
        b"99999999999999999999",
        b"1e999",
        b"nan",
        b"-inf",
        b"/",
        b"//",
    ),
    *(
        b"\0",
        b"\n",
        b" ",
        b"\\\n",
        b"\xff",
        b"\xff\xff\xff\xff",
        b"\x7f\xff\xff\xff",
        b"f ",
        b"v ",
    ),
    *(
        b"list",
        b"uchar",
        b"double",
        b"element vertex 7\n",
        b"usemtl ",
        b"mtllib ",
        b"end_header\n",
    ),
]
type Damage = tuple[int, int, int, bytes]
DAMAGE = st.lists(
    st.tuples(
        st.integers(0, 4), st.integers(0, 1 << 16), st.integers(1, 24), st.sampled_from(WORDS)
    ),
    min_size=1,
    max_size=6,
)


def damaged(data: bytes, damage: list[Damage]) -> bytes:
    """Words put in, bytes taken out, copied and flipped, the end cut off."""
    out = bytearray(data)
    for kind, place, size, word in damage:
        at = place % (len(out) + 1)
        match kind:
            case 0:
                out[at:at] = word
            case 1:
                del out[at : at + size]
            case 2 if at < len(out):
                out[at] ^= 1 << size % 8
            case 3:
                out[at:at] = out[at : at + size] * 2
            case 4 if size > 20:
                del out[at:]
            case _:
                pass
    return bytes(out)


def survives(file: Path) -> bool:
    """Whether the file is read; it must be a sound mesh then, and else a UserError."""
    mesh_inputs(file)
    try:
        parts = read_parts(file)
    except UserError as error:
        assert "\n" not in str(error)  # noqa: PT017
        assert str(file.parent) in str(error)  # noqa: PT017
        return False
    assert parts
    for part in parts:
        assert part.faces.max() < len(part.vertices)
        assert (face_areas(part.vertices, part.faces) > 0).all()
        assert np.isfinite(part.pose).all()
        for rows, width in ((part.vertices, 3), (part.normals, 3), (part.uv, 2)):
            assert rows is None or rows.shape == (len(part.vertices), width)
            assert rows is None or np.isfinite(rows).all()
        if part.materials:
            assert len(part.material) == len(part.faces)
            assert part.material.max() < len(part.materials)
    return True


def textured() -> Gltf:
    """A document with most of what is read."""
    gltf = Gltf()
    gltf.add("images", {"uri": "wood.png"})
    gltf.add("samplers", {"wrapS": 33071})
    gltf.add("textures", {"source": 0, "sampler": 0})
    use = {"index": 0, "extensions": {"KHR_texture_transform": {"offset": [0.5, 0]}}}
    primitive = cube(
        gltf,
        pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 1], "baseColorTexture": use},
        emissiveFactor=[0.5, 0.5, 0.5],
        alphaMode="BLEND",
        extensions={"KHR_materials_ior": {"ior": 1.4}},
    )
    mesh = gltf.mesh(primitive)
    child = gltf.node(root=False, mesh=mesh, rotation=[0, 0, 0, 1], scale=[1, 2, 1])
    gltf.node(children=[child], matrix=np.eye(4).reshape(-1).tolist())
    places = gltf.accessor(np.eye(3, dtype=np.float32))
    many = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}
    gltf.node(mesh=mesh, extensions=many)
    return gltf


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the files that others name."""
    folder = tmp_path_factory.mktemp("fuzz")
    picture(folder / "wood.png", np.full((2, 2, 3), 99, np.uint8))
    (folder / "wood.mtl").write_text(MTL)
    return folder


BASES: dict[str, Callable[[Path], bytes]] = {
    "text.ply": lambda _: ply("ascii", PYRAMID, SIDES),
    "little.ply": lambda _: ply("binary_little_endian", PYRAMID, SIDES),
    "big.ply": lambda _: ply("binary_big_endian", PYRAMID, SIDES, real="f8"),
    "board.obj": lambda _: OBJ.encode(),
    "cube.glb": lambda folder: textured().write(folder / "whole.glb").read_bytes(),
    "cube.gltf": lambda folder: textured().write(folder / "whole.gltf").read_bytes(),
}
FUZZ = settings(
    max_examples=120,
    deadline=2000,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.mark.parametrize("name", BASES)
def test_damaged_files(folder: Path, name: str) -> None:
    whole = BASES[name](folder)
    (folder / name).write_bytes(whole)
    assert survives(folder / name)

    @FUZZ
    @given(DAMAGE)
    def check(damage: list[Damage]) -> None:
        (folder / name).write_bytes(damaged(whole, damage))
        survives(folder / name)

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    check()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 512 << 10  # KiB


@FUZZ
@given(damage=DAMAGE)
def test_damaged_materials(folder: Path, damage: list[Damage]) -> None:
    (folder / "board.obj").write_bytes(OBJ.encode())
    (folder / "wood.mtl").write_bytes(damaged(MTL.encode(), damage))
    survives(folder / "board.obj")
    (folder / "wood.mtl").write_text(MTL)


@FUZZ
@given(data=st.data())
def test_gltf_with_any_value_replaced(folder: Path, data: st.DataObject) -> None:
    """JSON that is sound, with numbers, names and lists that are not."""
    gltf = textured()
    for _ in range(data.draw(st.integers(1, 2))):
        place: Any = gltf.json
        while True:
            keys: list[Any] = list(range(len(place)) if isinstance(place, list) else place)
            key = data.draw(st.sampled_from(keys))
            inner = place[key]
            if not isinstance(inner, dict | list) or not inner or data.draw(st.booleans()):
                break
            place = inner
        place[key] = data.draw(
            st.sampled_from([*NASTY, None, "", "x", [], {}, [[]], [1, 2, 3], True])
        )
    survives(gltf.write(folder / "replaced.glb"))


def test_absurd_counts_ask_for_no_memory(tmp_path: Path) -> None:
    file = tmp_path / "large.ply"
    for vertices, faces in ((10**17, 1), (4 * 10**9, 1), (3, 10**15)):
        file.write_text(
            f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n"
            "property float x\nproperty float y\nproperty float z\n"
            f"element face {faces}\nproperty list uint int vertex_indices\nend_header\n"
            + "0"
            * 100
        )
        with pytest.raises(UserError, match="truncated"):
            read_parts(file)
    file.write_text(
        "ply\nformat ascii 1.0\nelement nothing 999999999999\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 1 0 0 0 1 0 3 0 1 2\n"
    )
    assert len(read_parts(file)[0].faces) == 1  # an element without properties has no bytes


def test_a_picture_of_absurd_size_is_refused(tmp_path: Path) -> None:
    side = 8200

    def chunk(kind: bytes, body: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + check

    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)  # one bit a pixel
    rows = zlib.compress(bytes((1 + side // 8) * side), 1)
    png = chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    (tmp_path / "wood.png").write_bytes(b"\x89PNG\r\n\x1a\n" + png)
    file = textured().write(tmp_path / "bomb.gltf")
    with pytest.raises(UserError, match="8200 x 8200 pixels are too many"):
        read_parts(file)
