"""The maps that ``envmap warp`` reads and writes, from what people type."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chromeball.cli.envmap.arguments import source_fisheye
from chromeball.scene.errors import UserError

if TYPE_CHECKING:
    from chromeball.envmap.mapping import Mapping
    from chromeball.envmap.picture import Radiance

#: Where the name of a face stands in the names of six files.
PLACE = "{}"


@dataclass(frozen=True)
class Optics:
    """Cameras and distances that a size alone does not say."""

    lens: str | None = None
    to_lens: str | None = None
    camera: Path | None = None
    ball_distance: float | None = None
    focal: float | None = None

    def check(self, from_: str, to: str) -> None:
        """Refuse what has no use or is missing."""
        kinds = (from_, to)
        fisheyes = kinds.count("fisheye")
        if self.to_lens is not None and fisheyes < 2:
            raise UserError("--to-lens is for a fisheye made of a fisheye; use --lens")
        if (self.camera or self.lens) and not fisheyes:
            raise UserError("neither map is a fisheye: --lens and --camera have no use")
        if fisheyes == 2 and self.to_lens is None:
            raise UserError("--to-lens is missing: both maps are fisheyes")
        near = (self.ball_distance, self.focal)
        if any(value is not None for value in near):
            if "mirror" not in kinds:
                raise UserError("neither map is a mirror ball: its distance has no use")
            if None not in near:
                raise UserError("--ball-distance or --focal, one of the two")
            if self.focal is not None and not 0 < self.focal < math.inf:
                raise UserError(f"--focal {self.focal:g}: it must be positive")


def files_of(pattern: Path, kind: str) -> list[Path]:
    """The files that a path stands for: six of ``cube-files``, else itself."""
    from chromeball.envmap.mapping import SIX

    if kind != "cube-files":
        return [pattern]
    if PLACE not in pattern.name:
        raise UserError(
            f"six files are named with {PLACE} in place of px, nx, py, ny, pz, nz", file=pattern
        )
    return [pattern.with_name(pattern.name.replace(PLACE, face)) for face in SIX]


def read_map(picture: Path, kind: str) -> Radiance:
    """The picture, or six faces side by side."""
    import numpy as np

    from chromeball.envmap.picture import read_radiance

    faces = [read_radiance(file) for file in files_of(picture, kind)]
    first = faces[0]
    if len(faces) == 1:
        return first
    for face, file in zip(faces, files_of(picture, kind), strict=True):
        if face.size != (first.size[0], first.size[0]):
            raise UserError(f"faces are squares of one size, {first.size[0]} px", file=file)

    def joined(of: Any) -> Any:
        parts = [of(face) for face in faces]
        return None if any(part is None for part in parts) else np.concatenate(parts, axis=1)

    return replace(
        first,
        rgb=joined(lambda face: face.rgb),
        valid=joined(lambda face: face.valid),
        clipped=joined(lambda face: face.clipped),
        sigma=joined(lambda face: face.sigma),
    )


def source_map(kind: str, size: tuple[int, int], optics: Optics, picture: Path) -> Mapping:
    """What the picture is."""
    from chromeball.envmap.mapping import make_mapping

    if kind == "fisheye":
        return source_fisheye(optics.lens, optics.camera, size, picture)
    try:
        mapping = make_mapping(_table_name(kind), size)
        return _ball(size, optics) if kind == "mirror" else mapping
    except UserError as error:
        raise UserError(error.what, file=picture) from error


def target_map(kind: str, width: int | None, optics: Optics, source: Mapping) -> Mapping:
    """What is made: as fine as the source resolves, unless a width is given.

    The width of ``cube-files`` is that of a face.
    """
    from chromeball.calibrate.formats import read_camera
    from chromeball.envmap.mapping import (
        MAPPINGS,
        LatLong,
        make_mapping,
        of_camera,
        parse_lens,
        sized,
    )

    if kind == "fisheye":
        lens = optics.to_lens or optics.lens
        if optics.camera is not None and optics.to_lens is None:
            if optics.lens is not None:
                raise UserError("a fisheye needs --lens or --camera, one of the two")
            model = read_camera(optics.camera)
            scale = width / model.size[0] if width else 1.0
            return of_camera(model.scaled(scale))
        if lens is None:
            raise UserError("a fisheye needs --lens or --camera, one of the two")
        wide = width or resolved(of_camera(parse_lens(lens, (256, 256))), source, 1)
        return of_camera(parse_lens(lens, (wide, wide)))
    name = _table_name(kind)
    faces = 6 if kind == "cube-files" else 1
    entry = MAPPINGS[name]
    if width is None:
        step = entry.step
        size = sized(name, 48 * step * entry.aspect[0])
        made = make_mapping(name, size)
        alike = isinstance(source, LatLong) and isinstance(made, LatLong)
        wide = source.size[0] if alike else resolved(made, source, step)
    else:
        wide = width * faces
    size = sized(name, wide)
    mapping = make_mapping(name, size)
    return _ball(size, optics) if kind == "mirror" else mapping


def resolved(model: Mapping, source: Mapping, step: int) -> int:
    """The width at which a map like `model` is as fine as `source`, a multiple of `step`."""
    wide = model.size[0] * source.density / model.density
    return max(1, round(wide / step)) * step


def _table_name(kind: str) -> str:
    return "cube-strip" if kind == "cube-files" else kind


def _ball(size: tuple[int, int], optics: Optics) -> Mapping:
    from chromeball.envmap.mapping import ball_distance, mirror_ball

    if optics.focal is not None:
        return mirror_ball(size, ball_distance(optics.focal, size[0] / 2))
    far = math.inf if optics.ball_distance is None else optics.ball_distance
    return mirror_ball(size, far)
