"""mrcal's ``.cameramodel`` and ours: one camera a file, and folders of them, rigs too."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from chromeball.calibrate.formats.named import Hints, NamedCamera, files_of
from chromeball.calibrate.rig_file import read_rig
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

TITLE = "mrcal's camera model"
SUFFIX = ".cameramodel"


def read(path: Path, hints: Hints) -> list[NamedCamera]:
    """The camera of a file, or those of a folder; a folder with ``rig.json`` is a rig.

    Raises
    ------
    UserError
        A file is missing or broken, or the folder has none.

    """
    if path.name == "rig.json":
        path = path.parent
    if not path.is_dir():
        return [NamedCamera(path.stem, CameraModel.read(path), source=path)]
    files = sorted(path.glob(f"*{SUFFIX}"))
    if not files:
        raise UserError(f"no {SUFFIX} in this folder", file=path)
    cameras = [NamedCamera(file.stem, CameraModel.read(file), source=file) for file in files]
    return _of_rig(cameras, path / "rig.json") if (path / "rig.json").is_file() else cameras


def _of_rig(cameras: Sequence[NamedCamera], file: Path) -> list[NamedCamera]:
    """`cameras` in the order of ``rig.json``, with its offsets in time and its unit."""
    rig = read_rig(file)
    there = {named.name: named for named in cameras}
    if missing := [own.name for own in rig.cameras if own.name not in there]:
        raise UserError(f"there is no {missing[0]}{SUFFIX} beside it", file=file)
    notes = () if rig.unit == "m" else (f"places are in {rig.unit[:40]}, not in metres",)
    return [
        replace(there[own.name], time_shift=own.time_offset, rig=True, notes=notes)
        for own in rig.cameras
    ]


def encode(cameras: Sequence[NamedCamera], path: Path) -> dict[str, bytes]:
    """``NAME.cameramodel`` for each camera, or ``{"": bytes}`` where `path` is such a file.

    A camera whose lens is that of its source keeps all else that stands there, mrcal's
    optimisation inputs among it.
    """
    texts = {named.name: _text(named).encode() for named in cameras}
    if path.suffix == SUFFIX:
        if len(texts) > 1:
            raise UserError("a .cameramodel holds one camera: name a folder", file=path)
        return {"": next(iter(texts.values()))}
    return {f"{name}{SUFFIX}": text for name, text in files_of(texts).items()}


def _text(named: NamedCamera) -> str:
    if named.source is None:
        return named.camera.text()
    there = CameraModel.read(named.source)
    same = replace(there, world_from_camera=named.camera.world_from_camera)
    if same.text() != named.camera.text():
        return named.camera.text()
    return posed_text(named.source, named.camera.world_from_camera)


def posed_text(path: Path, world_from_camera: Pose) -> str:
    """The text of a ``.cameramodel`` with another pose and all else as it stands.

    Raises
    ------
    UserError
        The file is missing or broken.

    """
    camera = CameraModel.read(path)  # refuses what is none
    text = path.read_text()
    camera_from_world = world_from_camera.inverse()
    rt = [*camera_from_world.rotation_vector(), *camera_from_world.translation]
    written = f"[ {', '.join(repr(float(v)) for v in rt)} ]"
    tree = ast.parse(text.strip(), mode="eval").body
    if not isinstance(tree, ast.Dict):
        return camera.posed(world_from_camera).text()
    for key, value in zip(tree.keys, tree.values, strict=True):
        if isinstance(key, ast.Constant) and key.value in ("rt_cam_ref", "extrinsics"):
            before, after = _around(text.strip(), value)
            return f"{before}{written}{after}\n"
    before, after = _around(text.strip(), tree)
    inside = text.strip()[len(before) + 1 : len(text.strip()) - len(after)]
    return f"{before}{{\n    'rt_cam_ref': {written},{inside}{after}\n"


def _around(text: str, node: ast.expr) -> tuple[str, str]:
    """What stands before and after `node`; the parser's columns count bytes."""
    lines = text.encode().splitlines(keepends=True)
    if node.end_lineno is None or node.end_col_offset is None:
        raise ValueError("the parser gave no place")
    before = b"".join(lines[: node.lineno - 1]) + lines[node.lineno - 1][: node.col_offset]
    after = lines[node.end_lineno - 1][node.end_col_offset :] + b"".join(
        lines[node.end_lineno :]
    )
    return before.decode(), after.decode()


def left_behind(cameras: Sequence[NamedCamera]) -> list[str]:
    """What of `cameras` the format does not hold, a line each."""
    return []
