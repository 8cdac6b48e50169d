"""COLMAP's ``rig_config.json``: where a rig's cameras stand, and their lenses if told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.formats import colmap
from chromeball.calibrate.formats.named import Hints, NamedCamera, numbers
from chromeball.calibrate.formats.tree import read_root
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Size = tuple[int, int]


def holds(tree: list[Any]) -> bool:
    """Whether the root of a file is a list of rigs."""
    return bool(tree) and all(isinstance(rig, dict) and "cameras" in rig for rig in tree)


def read(path: Path, hints: Hints) -> list[NamedCamera]:
    """The cameras of the one rig, named as the folders of their pictures, on the rig.

    The file tells no picture's size: that of `hints` counts, else that of the same lens in a
    model that lies beside it.

    Raises
    ------
    UserError
        The file is broken, has several rigs, or a camera without a lens or size.

    """
    try:
        (rig,) = read_root(path)
    except ValueError as error:
        raise UserError(
            "it has several rigs: cut the file into one for each", file=path
        ) from error
    if not isinstance(rig["cameras"], list):
        raise UserError("no readable rig: its cameras are no list", file=path)
    found: list[NamedCamera] = []
    for index, entry in enumerate(rig["cameras"]):
        name = f"camera{index + 1}"
        try:
            name = str(entry["image_prefix"]).strip("/") or name
            found.append(_camera(name, entry, path, hints))
        except UserError as error:
            raise UserError(f"{name}: {error.what}", file=path) from error
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            missing = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise UserError(f"{name}: {missing[:120]}", file=path) from error
    return found


def _camera(name: str, entry: dict[str, Any], path: Path, hints: Hints) -> NamedCamera:
    if "camera_model_name" not in entry or "camera_params" not in entry:
        raise UserError(
            "it says where the camera stands, but has no lens (camera_model_name and "
            "camera_params): take the model that COLMAP made with it"
        )
    model, params = str(entry["camera_model_name"]), numbers(entry["camera_params"])
    known = [hints.size] if hints.size else _sizes_beside(model, params, path)
    if not known:
        raise UserError("it does not tell the picture's size: add --size WIDTHxHEIGHT")
    lens, cost = colmap.lens_of(model, known[0], params)
    rig_from_camera, notes = Pose.identity(), tuple[str, ...]()
    if "cam_from_rig_rotation" in entry:
        turn = numbers(entry["cam_from_rig_rotation"], 4)
        shift = numbers(entry["cam_from_rig_translation"], 3)
        rig_from_camera = colmap.pose_of(np.concatenate([turn, shift])).inverse()
    elif not entry.get("ref_sensor"):
        notes = ("no cam_from_rig: where it stands is not known, and it is put at the origin",)
    camera = lens.posed(rig_from_camera)
    return NamedCamera(name, camera, loss=cost, rig=not notes, notes=notes)


def _sizes_beside(model: str, params: NDArray[np.float64], path: Path) -> list[Size]:
    """Of the pictures by the same lens in the model that lies beside the file."""
    if not colmap.is_model(path.parent):
        return []
    cameras = [named.camera for named in colmap.read(path.parent, Hints())]
    return [
        camera.size
        for camera in cameras
        if (lens := colmap.lens_of(model, camera.size, params)[0]).model == camera.model
        and np.allclose(lens.intrinsics, camera.intrinsics, rtol=1e-12)
    ]
