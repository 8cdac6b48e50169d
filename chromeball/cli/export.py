"""``chromeball export``: the cameras of a scene or a rig as other programs read them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from chromeball.scene.errors import UserError
from chromeball.scene.record import Stage

if TYPE_CHECKING:
    from chromeball.calibrate.formats import NamedCamera

type Program = Literal["usd", "blender", "colmap", "kalibr", "opencv", "cameramodel"]


def export(
    program: Program,
    source: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["-o", "--output"])],
    json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> None:
    """Write the cameras of a scene, a rig or a camera file as another program reads them.

    Parameters
    ----------
    program
        Who is to read it.
    source
        scene.toml, with a camera for each view; or any file or folder of cameras that
        `calibrate convert` reads.
    output
        .usda for usd, .py for blender; as `calibrate convert` writes them.
    json
        Print the figures as JSON.

    """
    from chromeball.calibrate.formats import read_cameras
    from chromeball.cli.calibrate.convert import inputs_of, write_as

    if source.suffix == ".toml":
        cameras, inputs = _views(source)
    else:
        cameras, inputs = read_cameras([source]), inputs_of([source])
    write_as(cameras, Stage("export", inputs, program=program), output, program, None, json)


def _views(file: Path) -> tuple[list[NamedCamera], list[Path]]:
    """The cameras of a scene's views, and the files they came from."""
    import numpy as np

    from chromeball.calibrate.formats import NamedCamera, read_camera
    from chromeball.renderer.render import virtual_camera
    from chromeball.scene.manifest import read_scene

    scene = read_scene(file)
    cameras: list[NamedCamera] = []
    inputs = [file]
    for view in scene.view:
        if view.frames is not None:
            raise UserError(
                f"view {view.name!r} is a sequence: export its camera files one by one",
                file=file,
            )
        if view.bracket or view.plate:
            _, name = scene.photograph_of(view)
            camera = read_camera(file.parent / name)
            inputs.append(file.parent / name)
        elif view.position is None:
            raise UserError(
                f"view {view.name!r} stands where the light probe did: give it a position",
                file=file,
            )
        else:
            camera = virtual_camera(view, np.array(view.position, float))
        cameras.append(NamedCamera(view.name, camera))
    if not cameras:
        raise UserError("the scene has no [[view]]", file=file)
    return cameras, inputs
