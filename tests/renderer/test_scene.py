"""Mesh files that are broken, and what is said of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from chromeball.renderer.scene import read_mesh
from chromeball.scene.errors import UserError


@pytest.mark.parametrize("face", ["1 2", "1 1 2", "1 1 1"])
def test_an_obj_face_without_three_corners_is_named(tmp_path: Path, face: str) -> None:
    file = tmp_path / "broken.obj"
    file.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf {face}\n")
    with pytest.raises(UserError, match="fewer than three corners"):
        read_mesh(file)


def test_a_format_whose_reader_crashes_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "empty.fbx"
    file.touch()
    with pytest.raises(UserError, match="no mesh format that is read here"):
        read_mesh(file)


def test_faces_without_area_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "flat.obj"
    file.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\n")
    _, faces, _ = read_mesh(file)
    assert len(faces) == 1
    assert "1 faces without area" in capsys.readouterr().err
