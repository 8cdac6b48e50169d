"""Which format a file has, and reading and writing through it; formats load in use."""

from __future__ import annotations

import importlib
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from chromeball.calibrate.formats.named import Hints, Loss, NamedCamera, files_of
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.record import write_bytes

#: After `--to`: the module and what it calls its encoder, and the suffixes that mean it.
FORMATS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "cameramodel": ("cameramodel", "encode", (".cameramodel",)),
    "opencv": ("opencv", "encode", (".yml", ".yaml", ".json", ".xml")),
    "colmap": ("colmap_write", "encode", ()),
    "colmap-binary": ("colmap_write", "encode_binary", ()),
    "kalibr": ("kalibr", "encode", (".yaml", ".yml")),
    "usd": ("usd", "encode", (".usda",)),
    "blender": ("blender", "encode", (".py",)),
}
#: A lens that was changed while reading by more than this, px, is no camera without a word.
_UNTOLD = 0.01

_TREES = (".yml", ".yaml", ".json", ".xml")
_USD = (".usd", ".usda", ".usdc", ".usdz")


def _module(name: str) -> Any:
    return importlib.import_module(f"chromeball.calibrate.formats.{name}")


# ---- in


def read_camera(path: str | os.PathLike[str]) -> CameraModel:
    """The one camera of a file of any format.

    Raises
    ------
    UserError
        There is none in it, or several, or one whose lens is none of ours.

    """
    file = Path(path)
    if file.suffix == ".cameramodel" and not file.is_dir():
        return CameraModel.read(file)
    found = read_cameras([file])
    if len(found) > 1:
        names = ", ".join(named.name for named in found[:5])
        raise UserError(
            f"it holds {len(found)} cameras ({names}{', ...' if len(found) > 5 else ''}): take "
            "one out with `chromeball calibrate convert ... --camera NAME -o NAME.cameramodel`",
            file=path,
        )
    return _own_lens(found[0], file)


def read_lenses(path: str | os.PathLike[str]) -> dict[str, CameraModel]:
    """The cameras of a file or folder of any format, by name; a single one by its file's.

    Raises
    ------
    UserError
        There is none in it, or one whose lens is none of ours.

    """
    file = Path(path)
    found = read_cameras([file])
    if len(found) == 1:
        return {file.stem: _own_lens(found[0], file)}
    return {named.name: _own_lens(named, file) for named in found}


def _own_lens(named: NamedCamera, path: Path) -> CameraModel:
    """The camera, if its lens was not changed in reading it."""
    cost = named.loss
    if cost is not None and cost.worst > _UNTOLD:
        raise UserError(
            f"its {cost.was} lens is none of ours, {cost.now} comes within {cost.rms:.2g} px "
            "of it: if that will do, take it from `chromeball calibrate convert`",
            file=path,
        )
    return named.camera


def read_cameras(
    paths: Sequence[str | os.PathLike[str]], hints: Hints | None = None
) -> list[NamedCamera]:
    """All cameras of files and folders, of any formats.

    A file of OpenCV's with nothing but R and T belongs to the file before it. Names that
    several files use get the names of their folders in front.

    Raises
    ------
    UserError
        A file is missing, broken, of no known format, or leaves something open that `hints`
        do not say.

    """
    known = hints or Hints()
    files: list[_Source] = []
    for path in map(Path, paths):
        for source in _opened(path):
            if source.kind != "extrinsics":
                files.append(source)
            elif files and files[-1].kind == "opencv":
                before = files.pop()
                files.append(replace(before, tree={**source.tree, **before.tree}))
            else:
                raise UserError(
                    "it has R and T, but no camera matrix: name the file with that before it",
                    file=source.path,
                )
    found: list[tuple[Path, list[NamedCamera]]] = []
    for source in files:
        module, path = _module(source.kind), source.path
        match source.kind:
            case "opencv":
                found.append((path, module.cameras_of(source.tree, path, known)))
            case "kalibr":
                found.append((path, module.cameras_of(source.tree, path)))
            case _:
                found.append((path, module.read(path, known)))
    return _renamed(found)


@dataclass(frozen=True)
class _Source:
    """A file or folder, its reader's module, and its ``tree`` where that has been read."""

    path: Path
    kind: str
    tree: dict[str, Any] = field(default_factory=dict)


def _opened(path: Path) -> list[_Source]:
    """What `path` stands for: itself, or the camera files of a folder, R and T of a pair last.

    In a folder files without a camera are passed over: records lie there, and reports.
    """
    own = path.is_dir() and (
        any(path.glob("*.cameramodel"))
        or (path / "rig.json").is_file()
        or _module("colmap").is_model(path)
    )
    if own or not path.is_dir():
        source = _recognised(path)
        if source is None:
            raise UserError("it has no camera of OpenCV's, ROS's or Kalibr's", file=path)
        return [source]
    found = [
        source
        for file in sorted(path.iterdir())
        if file.suffix.lower() in (*_TREES, *_USD)
        and file.is_file()
        and not file.name.endswith(".record.json")
        and (source := _recognised(file)) is not None
    ]
    cameras = [source for source in found if source.kind != "extrinsics"]
    if not cameras:
        ends = ", ".join((".cameramodel", *_TREES, *_USD))
        raise UserError(f"no camera in this folder: neither COLMAP's nor {ends}", file=path)
    poses = [source for source in found if source.kind == "extrinsics"]
    if poses and len(found) > 2:
        raise UserError(
            f"it holds {len(cameras)} files of cameras and R and T apart from them, in "
            f"{poses[0].path.name}: name the files one by one, R and T after their pair",
            file=path,
        )
    return cameras + poses


def _recognised(path: Path) -> _Source | None:
    """By its name, or by what stands in it; None where no camera does."""
    if not path.exists():
        raise UserError("no such file", file=path)
    suffix = path.suffix.lower()
    if path.name == "rig.json":
        return _Source(path, "cameramodel")
    if _module("colmap").is_model(path):
        return _Source(path, "colmap")
    if path.is_dir() or suffix == ".cameramodel":
        return _Source(path, "cameramodel")
    if suffix in _USD:
        return _Source(path, "usd")
    if suffix == ".py":
        return _Source(path, "blender")
    if suffix not in _TREES:
        raise UserError(
            "no camera file: .cameramodel, .yml, .yaml, .json, .xml, .usd, .py (Blender's, "
            "written here) and folders of COLMAP's or of camera files are read",
            file=path,
        )
    from chromeball.calibrate.formats.tree import read_root

    tree = read_root(path)
    if isinstance(tree, list) and _module("colmap_rig").holds(tree):
        return _Source(path, "colmap_rig")
    if not isinstance(tree, dict):
        return None
    if _module("kalibr").holds(tree):
        return _Source(path, "kalibr", tree)
    opencv = _module("opencv")
    if opencv.holds(tree):
        return _Source(path, "opencv", tree)
    if opencv.holds_pose(tree):
        return _Source(path, "extrinsics", tree)
    return None


def _renamed(found: Sequence[tuple[Path, list[NamedCamera]]]) -> list[NamedCamera]:
    """All of them; names that stand in several files with those of the folders in front."""
    counts = Counter(named.name for _, cameras in found for named in cameras)
    return [
        replace(named, name=f"{path.resolve().parent.name}_{named.name}")
        if counts[named.name] > 1
        else named
        for path, cameras in found
        for named in cameras
    ]


# ---- out


@dataclass(frozen=True)
class Prepared:
    """Cameras as a format holds them.

    ``losses``: what changes of lens models cost, reading included, by camera. ``left_behind``:
    what else the format does not hold, ``notes``: what the files read left open, a line each.
    """

    cameras: list[NamedCamera]
    losses: list[tuple[str, Loss]]
    left_behind: list[str]
    notes: list[str]


def format_for(path: str | os.PathLike[str], to: str | None = None, cameras: int = 1) -> str:
    """The format of an output: `to`, or what its name and the number of `cameras` say.

    Raises
    ------
    UserError
        The name says nothing, several, or another format than `to`.

    """
    suffix = Path(path).suffix.lower()
    fits = [name for name, (_, _, ends) in FORMATS.items() if suffix in ends]
    if to is None:
        if not suffix:
            return "cameramodel"
        if not fits:
            raise UserError(f"no format is written as {suffix}", file=path)
        # Kalibr's own name for it; and OpenCV's file holds two cameras at most.
        if "kalibr" in fits and ("camchain" in Path(path).stem or cameras > 2):
            return "kalibr"
        if len(fits) > 1 and suffix != ".yml":
            raise UserError(f"say which: --to {' or --to '.join(fits)}", file=path)
        return fits[0]
    if to not in FORMATS:
        raise UserError(f"--to {to}: one of {', '.join(FORMATS)}")
    ends = FORMATS[to][2]
    folder = to in ("cameramodel", "opencv") or not ends
    if suffix in ends or (not suffix and folder):
        return to
    names = " or ".join([*ends, *(["a folder"] if folder else [])])
    raise UserError(f"{to} is written as {names}: name it so", file=path)


def prepared(cameras: Sequence[NamedCamera], to: str, model: str | None = None) -> Prepared:
    """`cameras` with lenses that the format `to` holds, or of the lens `model`.

    Raises
    ------
    UserError
        A lens comes near nothing that the format holds, or `model` is not in it.

    """
    from chromeball.calibrate.formats.nearest import MODELS, nearest

    module = _module(FORMATS[to][0])
    held = getattr(module, "MODELS", None)
    wanted = None
    if model is not None:
        if model not in MODELS:
            raise UserError(f"--model {model}: one of {', '.join(MODELS)}")
        wanted = MODELS[model]
        if held is not None and wanted not in held:
            words = [name for name, value in MODELS.items() if value in held]
            raise UserError(f"--model {model}: {module.TITLE} has {', '.join(words)}")
    found: list[NamedCamera] = []
    losses = [(named.name, named.loss) for named in cameras if named.loss is not None]
    for named in cameras:
        camera, cost = named.camera, None
        try:
            if wanted is not None:
                camera, cost = nearest(camera, (wanted,))
            elif held is not None:
                camera, cost = nearest(camera, held)
            if cost is not None:
                losses.append((named.name, cost))
            if to == "blender" and (cost := module.cost(camera)) is not None:
                losses.append((named.name, cost))
        except UserError as error:
            raise UserError(f"{named.name}: {error.what}", file=error.file) from error
        found.append(replace(named, camera=camera))
    notes = [f"{named.name}: {note}" for named in cameras for note in named.notes]
    behind: list[str] = module.left_behind(found)
    if any(
        there.camera.covariance is not None and here.camera.covariance is None
        for there, here in zip(cameras, found, strict=True)
    ) or (to != "cameramodel" and any(c.camera.covariance is not None for c in found)):
        behind.append("the lens's uncertainty: only its .cameramodel holds it")
    if to != "kalibr" and any(named.time_shift for named in cameras):
        behind.append("offsets in time: only Kalibr's chain holds them here")
    return Prepared(found, losses, behind, notes)


def encoded(
    cameras: Sequence[NamedCamera], path: str | os.PathLike[str], to: str
) -> dict[str, bytes]:
    """The files that `prepared` cameras make: bytes by name, ``""`` for `path` itself.

    Raises
    ------
    UserError
        The format does not hold so many cameras in a file, or their names.

    """
    if not cameras:
        raise UserError("no cameras to write")
    module, encoder, ends = FORMATS[to]
    encode = getattr(_module(module), encoder)
    if to == "opencv" and Path(path).suffix.lower() not in ends:
        names = files_of({named.name: named for named in cameras})
        return {
            f"{name}.yml": encode([named], Path(f"{name}.yml"))[""]
            for name, named in names.items()
        }
    found: dict[str, bytes] = encode(cameras, Path(path))
    return found


def write_cameras(
    path: str | os.PathLike[str],
    cameras: Sequence[NamedCamera],
    to: str | None = None,
    model: str | None = None,
) -> Prepared:
    """Write cameras as a format; what that costs is returned. Files appear whole.

    Raises
    ------
    UserError
        As :func:`format_for`, :func:`prepared` and :func:`encoded` do.

    """
    kind = format_for(path, to, len(cameras))
    found = prepared(cameras, kind, model)
    for name, data in encoded(found.cameras, path, kind).items():
        write_bytes(Path(path) / name if name else path, data)
    return found
