"""What people type, and what all commands of the group print and write."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.mapping import Mapping
    from chromeball.scene.camera import CameraModel
    from chromeball.scene.manifest import Probe, Shot

type Out = Annotated[Path, Parameter(name=["--output", "-o"])]
type Json = Annotated[bool, Parameter(negative="")]


def parse_numbers(text: str | None, option: str, count: int | None) -> list[float]:
    """Numbers with commas between; `count` of them unless None."""
    try:
        values = [float(part) for part in (text or "").split(",")]
    except ValueError as error:
        raise UserError(f"{option} {text!r}: numbers with commas between") from error
    if not all(math.isfinite(value) for value in values):
        raise UserError(f"{option} {text!r}: the numbers must be finite")
    if count is not None and len(values) != count:
        raise UserError(f"{option} {text!r}: {count} numbers are needed, not {len(values)}")
    return values


def parse_points(text: str) -> list[list[float]]:
    """The four corners, each ``x,y``."""
    points = [parse_numbers(pair, "--points", 2) for pair in text.split()]
    if len(points) != 4:
        raise UserError(f"--points: four corners are needed, not {len(points)}")
    return points


def parse_size(text: str) -> tuple[int, int]:
    """`WxH`."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError as error:
        raise UserError(f"--size {text!r}: write it as 640x480") from error
    if min(width, height) < 1:
        raise UserError(f"--size {text!r}: it must be positive")
    return width, height


def check_panorama_width(width: int) -> None:
    """Refuse what no lat-long map can have."""
    if not 2 <= width <= 65536 or width % 2:
        raise UserError(f"--width {width}: a lat-long map's width is even, from 2 to 65536")


def need_size(picture: Path) -> tuple[int, int]:
    """Width and height of a picture that must exist."""
    from chromeball.scene.image import read_size

    return read_size(picture)


def picture_size(picture: Path | None) -> tuple[int, int] | None:
    """Width and height, or None without a picture."""
    return None if picture is None else need_size(picture)


def read_camera(path: Path, size: tuple[int, int] | None, picture: Path | None) -> CameraModel:
    """A camera model that fits pictures of `size`."""
    from chromeball.calibrate.formats import read_camera as read_any

    model = read_any(path)
    if size is not None and model.size != size:
        raise UserError(
            f"the camera's pictures are {model.size[0]}x{model.size[1]}, "
            f"{picture or '--size'} is {size[0]}x{size[1]}",
            file=path,
        )
    return model


def read_mask(path: Path, size: tuple[int, int], file: Path) -> Any:
    """(H, W) bool, true where the mask is brighter than half."""
    from chromeball.scene.image import read_image

    image = read_image(path)
    pixels = image.pixels[..., : min(3, image.pixels.shape[2])].astype(float).mean(axis=2)
    if pixels.shape != (size[1], size[0]):
        raise UserError(
            f"{pixels.shape[1]}x{pixels.shape[0]}, but {file.name} is {size[0]}x{size[1]}",
            file=path,
        )
    white = 1.0 if image.linear else float(2 ** (8 * image.pixels.dtype.itemsize) - 1)
    return pixels > white / 2


def source_fisheye(
    lens: str | None, camera: Path | None, size: tuple[int, int], picture: Path
) -> Mapping:
    """The fisheye that --lens or --camera says, for pictures of `size`."""
    from chromeball.envmap.mapping import of_camera, parse_lens

    if (lens is None) == (camera is None):
        raise UserError("a fisheye needs --lens or --camera, one of the two")
    if camera is not None:
        return of_camera(read_camera(camera, size, picture))
    return of_camera(parse_lens(lens or "", size))


def lens_of(
    probe: Probe, shot: Shot, size: tuple[int, int], root: Path, picture: Path | None
) -> CameraModel:
    """The camera of a probe's shot as the scene file says."""
    from chromeball.cli.stages import lens_text
    from chromeball.envmap.mapping import parse_lens

    lens = shot.lens or probe.lens
    if (lens is None) == (probe.camera is None):
        raise UserError("[probe] needs a lens or a camera, one of the two")
    if probe.camera is not None:
        return read_camera(root / probe.camera, size, picture)
    assert lens is not None
    return parse_lens(lens_text(lens), size)


def clicked_shot(
    names: Sequence[str], clicked: int | None, picture: str | None, aligned: Path
) -> int:
    """Index of the shot that was aligned: --clicked, else that of `picture`, else the first."""
    if clicked is not None:
        if not 1 <= clicked <= len(names):
            raise UserError(f"--clicked {clicked}: there are {len(names)} shots")
        return clicked - 1
    if picture is None:
        return 0
    if picture in names:
        return names.index(picture)
    raise UserError(
        f"aligned in {picture!r}, which is none of the shots {', '.join(names)}; "
        "say which with --clicked",
        file=aligned,
    )


def write_panorama(
    stage: Any,
    output: Path,
    radiance: Any,
    alpha: Any,
    kept: dict[str, Any],
    origin: Any,
    completed: Any,
    clipped: Any = None,
    sigma: Any = None,
) -> None:
    """A lat-long map with alpha, marks (H, W), attributes and preview.

    `sigma` (H, W, 3) of what is completed is as large as its light.
    """
    import numpy as np

    from chromeball.envmap.picture import (
        latlong_attributes,
        tone_mapped,
        write_map,
        write_preview,
    )

    marks = {"A": alpha, "completed": completed}
    if clipped is not None:
        marks["clipped"] = clipped
    if sigma is not None:
        noise = np.where((alpha > 0)[..., None], sigma, radiance)
        marks |= {f"sigma.{name}": noise[..., k] for k, name in enumerate("RGB")}
    for name in ("origin", "worldToCamera"):
        kept.pop(name, None)
    stage.figures["preview"] = write_preview(output, "preview", tone_mapped(radiance, alpha))
    with stage.output(output) as temporary:
        write_map(temporary, radiance, marks, latlong_attributes(kept, origin))


def print_figures(figures: dict[str, object], as_json: bool, output: Path) -> None:
    """The output's name and its figures, or all as JSON."""
    from chromeball.scene.record import to_json

    if as_json:
        print(json.dumps({"output": str(output), **to_json_dict(figures)}, indent=1))
        return
    print(output)
    for name, value in figures.items():
        print(f"  {name}: {to_json(value)}")


def to_json_dict(figures: dict[str, object]) -> dict[str, object]:
    """Figures as plain JSON values."""
    from chromeball.scene.record import to_json

    return {name: to_json(value) for name, value in figures.items()}
