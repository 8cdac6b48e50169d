"""The stand-in mesh file: what goes in comes out, and what is broken is refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.scene.errors import UserError
from chromeball.stand_in.ply import StandInMesh, read_stand_in, write_stand_in


def mesh(vertices: int = 5, faces: int = 4, seed: int = 0) -> StandInMesh:
    random = np.random.default_rng(seed)
    return StandInMesh(
        random.normal(size=(vertices, 3)).astype(np.float32),
        random.normal(size=(vertices, 3)).astype(np.float32),
        np.array([random.permutation(vertices)[:3] for _ in range(faces)], np.uint32),
        random.integers(0, 2, faces).astype(np.uint8),
    )


@settings(deadline=None)
@given(st.integers(3, 40), st.integers(1, 60), st.integers(0, 2**32 - 1))
def test_round_trip_is_exact(
    tmp_path_factory: pytest.TempPathFactory, vertices: int, faces: int, seed: int
) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    before = mesh(vertices, faces, seed)
    write_stand_in(path, before)
    after = read_stand_in(path)
    for name in ("vertices", "original", "faces", "surface"):
        a, b = getattr(before, name), getattr(after, name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_other_programs_read_it(tmp_path: Path) -> None:
    import pymeshlab

    write_stand_in(tmp_path / "a.ply", before := mesh())
    others = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]
    others.load_new_mesh(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(others.current_mesh().vertex_matrix(), before.vertices)
    np.testing.assert_array_equal(others.current_mesh().face_matrix(), before.faces)


def test_every_truncation_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_stand_in(path, mesh())
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(UserError, match=r"^.*a\.ply: .+$"):
            read_stand_in(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(UserError, match="too long"):
        read_stand_in(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"PLY\n", "not a PLY file"),
        (b"binary_little_endian", b"ascii", "binary_little_endian 1.0' expected"),
        (b"property float wz\n", b"", "'property float wz' expected"),
        (b"property float x\n", b"property double x\n", "'property double x' found"),
        (b"element vertex 5", b"element vertex -5", "'element vertex N' expected"),
        (b"element vertex 5", b"element vertex 5000000000", "too many"),
        (b"element vertex 5", b"element vertex 999999999", "truncated"),
        (b"surface\nend", b"surface\nproperty uchar more\nend", "unexpected"),
        (b"comment", b"comm\xffnt", "not text"),
    ],
)
def test_other_headers_are_refused(
    tmp_path: Path, old: bytes, new: bytes, message: str
) -> None:
    path = tmp_path / "a.ply"
    write_stand_in(path, mesh())
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(UserError, match=message):
        read_stand_in(path)


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("vertices", (2, 1), np.nan, "position of vertex 2 is not finite"),
        ("original", (4, 0), np.inf, "wx wy wz of vertex 4 is not finite"),
        ("faces", (3, 1), 5, "face 3 names vertex 5, but there are 5"),
        ("faces", (1, 2), None, "face 1 names a vertex twice"),
        ("surface", (2,), 2, "face 2 has surface 2"),
    ],
)
def test_broken_meshes_are_refused(
    tmp_path: Path, name: str, index: tuple[int, ...], value: float | None, message: str
) -> None:
    path = tmp_path / "a.ply"
    good = mesh()
    write_stand_in(path, good)
    array = getattr(good, name)
    array[index] = array[index[0], 0] if value is None else value
    write_stand_in(path, good)  # arrays stay writable: only the reader can catch this
    with pytest.raises(UserError, match=message):
        read_stand_in(path)


def test_negative_and_four_sided_faces_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_stand_in(path, mesh())
    whole = path.read_bytes()
    path.write_bytes(whole[:-5] + b"\xff\xff\xff\xff" + whole[-1:])
    with pytest.raises(UserError, match="face 3 names a negative vertex"):
        read_stand_in(path)
    path.write_bytes(whole[:-14] + b"\x04" + whole[-13:])
    with pytest.raises(UserError, match="face 3 is no triangle"):
        read_stand_in(path)


def test_no_file_and_no_faces(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such stand-in mesh"):
        read_stand_in(tmp_path / "none.ply")
    with pytest.raises(UserError, match="cannot read: Is a directory"):
        read_stand_in(tmp_path)
    with pytest.raises(UserError, match="no faces"):
        mesh(faces=1).__class__(
            np.zeros((3, 3), np.float32),
            np.zeros((3, 3), np.float32),
            np.zeros((0, 3), np.uint32),
            np.zeros(0, np.uint8),
        )


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_any_bytes_give_a_mesh_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.ply"
    write_stand_in(path, mesh())
    damaged = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(damaged)))
        cut = data.draw(st.integers(0, 3))
        damaged[at : at + cut] = data.draw(st.binary(max_size=cut + 1))
    path.write_bytes(damaged)
    message = None
    try:
        read = read_stand_in(path)
    except UserError as error:
        message = str(error)
    else:
        assert np.isfinite(read.vertices).all()
        assert read.faces.max() < len(read.vertices)
    if message is not None:
        assert "\n" not in message
        assert message.startswith(str(path))
