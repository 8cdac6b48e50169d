"""Cameras as a model of COLMAP's: text, binary, and the configuration of a rig."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

from chromeball.calibrate.formats.colmap import quaternion, written
from chromeball.calibrate.formats.named import NamedCamera, files_of
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

TITLE = "COLMAP's model"
#: Models that the format holds as they are.
MODELS = (
    "pinhole",
    *(f"LENSMODEL_OPENCV{n}" for n in (4, 8)),
    "kb4",
    "kb4_decentred",
    "latlong",
)


def encode(cameras: Sequence[NamedCamera], path: Path) -> dict[str, bytes]:
    """Text files by name; lenses are of :data:`MODELS`.

    An image stands for each camera, named as it. Cameras of one rig become a rig of COLMAP's
    with one frame, and its ``rig_config.json`` for folders of pictures named as the cameras;
    others that share a lens become images of one camera.
    """
    rig = len(cameras) > 1 and all(camera.rig for camera in cameras)
    keys = _keys([named.camera for named in cameras], rig)
    lenses = {key: named.camera for key, named in zip(keys, cameras, strict=True)}
    poses = [named.camera.world_from_camera.inverse() for named in cameras]
    files = {
        "cameras.txt": [_camera(key, camera) for key, camera in lenses.items()],
        "images.txt": [
            f"{i} {_numbers(quaternion(pose))} {key} {named.name}\n"
            for i, (key, pose, named) in enumerate(zip(keys, poses, cameras, strict=True), 1)
        ],
        "points3D.txt": [],
    }
    if rig:
        sensors = [f"CAMERA {keys[0]}"]
        data = [f"CAMERA {key} {i}" for i, key in enumerate(keys, 1)]
        for key, pose in zip(keys[1:], poses[1:], strict=True):
            sensors.append(f"CAMERA {key} 1 {_numbers(quaternion(pose @ poses[0].inverse()))}")
        files["rigs.txt"] = [f"1 {len(keys)} {' '.join(sensors)}"]
        frame = f"1 1 {_numbers(quaternion(poses[0]))} {len(keys)} {' '.join(data)}"
        files["frames.txt"] = [frame]
    else:
        files["rigs.txt"] = [f"{key} 1 CAMERA {key}" for key in lenses]
        files["frames.txt"] = [
            f"{i} {key} {_numbers(quaternion(pose))} 1 CAMERA {key} {i}"
            for i, (key, pose) in enumerate(zip(keys, poses, strict=True), 1)
        ]
    found = {name: "".join(f"{line}\n" for line in lines) for name, lines in files.items()}
    if rig:
        found["rig_config.json"] = _configuration(cameras, poses)
    return {name: text.encode() for name, text in found.items()}


def encode_binary(cameras: Sequence[NamedCamera], path: Path) -> dict[str, bytes]:
    """As :func:`encode`, turned into binary files by COLMAP itself."""
    import pycolmap

    texts = encode(cameras, path)
    with tempfile.TemporaryDirectory() as folder:
        for name, text in texts.items():
            (Path(folder) / name).write_bytes(text)
        model = pycolmap.Reconstruction()
        model.read_text(folder)
        model.write_binary(folder)
        found = {file.name: file.read_bytes() for file in Path(folder).glob("*.bin")}
    return found | {n: t for n, t in texts.items() if n.endswith(".json")}


def left_behind(cameras: Sequence[NamedCamera]) -> list[str]:
    """What of `cameras` the format does not hold, a line each."""
    wide = [
        c.name
        for c in cameras
        if c.camera.model.startswith("kb4") and c.camera.max_angle > 1.58
    ]
    return [f"COLMAP sees nothing beyond 90 degrees: {', '.join(wide)}"] if wide else []


def _keys(cameras: Sequence[CameraModel], rig: bool) -> list[int]:
    """Numbers from 1; images by one lens share theirs unless each stands on the rig."""
    seen: dict[tuple[object, ...], int] = {}
    keys: list[int] = []
    for index, camera in enumerate(cameras):
        lens = (camera.model, camera.size, *camera.intrinsics.tolist(), index if rig else 0)
        keys.append(seen.setdefault(lens, len(seen) + 1))
    return keys


def _camera(key: int, camera: CameraModel) -> str:
    name, params = written(camera)
    return f"{key} {name} {camera.size[0]} {camera.size[1]} {_numbers(params)}"


def _configuration(cameras: Sequence[NamedCamera], poses: Sequence[Pose]) -> str:
    """COLMAP's rig_config.json, for `colmap rig_configurator`."""
    folders = list(files_of({camera.name: camera for camera in cameras}))
    entries: list[dict[str, object]] = []
    for index, (named, folder, pose) in enumerate(zip(cameras, folders, poses, strict=True)):
        model, params = written(named.camera)
        entry: dict[str, object] = {"image_prefix": f"{folder}/"}
        if index == 0:
            entry["ref_sensor"] = True
        else:
            values = quaternion(pose @ poses[0].inverse())
            entry["cam_from_rig_rotation"] = values[:4]
            entry["cam_from_rig_translation"] = values[4:]
        entries.append(entry | {"camera_model_name": model, "camera_params": params})
    return json.dumps([{"cameras": entries}], indent=1) + "\n"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(v) for v in values)
