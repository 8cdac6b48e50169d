"""Maps in and out: lat-long EXRs with their attributes, and pictures of them to look at."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.color import luminance
from chromeball.scene.errors import UserError
from chromeball.scene.image import linear_rows, to_display, write_exr, write_picture
from chromeball.scene.vignette import REMOVED

#: What a map says about itself and is handed on, by OpenImageIO's names: `DateTime` is
#: OpenEXR's capDate, `Copyright` its owner.
KEPT = (
    *("chromaticities", "whiteLuminance", "origin", "worldToCamera"),
    *("DateTime", "utcOffset", "Copyright", "longitude", "latitude", "altitude"),
    REMOVED,
)


@dataclass(frozen=True)
class Radiance:
    """A scene-linear picture.

    ``rgb`` (H, W, 3) float32; ``valid`` (H, W), or None for all; ``clipped`` (H, W) marks lower
    bounds, saturated in every exposure, or None where the file does not say; ``attributes``
    worth keeping. ``sigma`` (H, W, 3), the standard deviations of channels ``sigma.R`` ..., or
    None.
    """

    rgb: NDArray[np.float32]
    valid: NDArray[np.bool_] | None
    clipped: NDArray[np.bool_] | None
    attributes: dict[str, Any]
    sigma: NDArray[np.float32] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.rgb.shape[1], self.rgb.shape[0]


def read_radiance(path: str | os.PathLike[str]) -> Radiance:
    """Read a scene-linear picture with its validity.

    Pixels whose alpha is 0, NaN or infinite pixels under alpha 0 included, are not valid;
    without an alpha channel all are (None).

    Raises
    ------
    UserError
        When the file is no linear picture, or a valid pixel is NaN, infinite or negative.

    """
    with linear_rows(path) as (header, parts):
        names = list(header.channels)
        width, height = header.size
        if all(name in names for name in "RGB"):
            colours = [names.index(name) for name in "RGB"]
        elif len(names) in (1, 2):
            colours = [0, 0, 0]
        else:
            raise UserError(f"no channels R, G, B: it holds {', '.join(names)}", file=path)
        noise = [names.index(f"sigma.{name}") for name in "RGB" if f"sigma.{name}" in names]
        rgb = np.empty((height, width, 3), np.float32)
        valid = np.empty((height, width), bool) if "A" in names else None
        clipped = np.empty((height, width), bool) if "clipped" in names else None
        sigma = np.empty((height, width, 3), np.float32) if len(noise) == 3 else None
        count, where = 0, (0, 0)
        for first, pixels in parts:
            rows = slice(first, first + len(pixels))
            part = pixels[..., colours]
            bad = ~(np.isfinite(part) & (part >= 0)).all(axis=2)
            if valid is not None:
                valid[rows] = pixels[..., names.index("A")] > 0
                part[bad & ~valid[rows]] = 0
                bad &= valid[rows]
            if bad.any() and not count:
                y, x = np.argwhere(bad)[0]
                where = (int(x), first + int(y))
            count += int(bad.sum())
            rgb[rows] = part
            if clipped is not None:
                clipped[rows] = pixels[..., names.index("clipped")] > 0
            if sigma is not None:
                sigma[rows] = pixels[..., noise]
    if count:
        raise UserError(
            f"{count} pixels are NaN, infinite or negative, the first at x {where[0]}, "
            f"y {where[1]}",
            file=path,
        )
    kept = {name: header.attributes[name] for name in KEPT if name in header.attributes}
    return Radiance(rgb, valid, clipped, kept, sigma)


def read_latlong(path: str | os.PathLike[str]) -> Radiance:
    """As :func:`read_radiance`, a lat-long map.

    Raises
    ------
    UserError
        As there, and when the picture is not 2:1.

    """
    found = read_radiance(path)
    width, height = found.size
    if width != 2 * height:
        raise UserError(f"{width}x{height} is no latlong map: it must be 2:1", file=path)
    return found


def read_marks(path: str | os.PathLike[str]) -> dict[str, NDArray[np.float32]]:
    """What a picture says beside its radiance, each channel (H, W): A, clipped, sigma.R, ...

    Raises
    ------
    UserError
        When the file is no linear picture.

    """
    with linear_rows(path) as (header, parts):
        names = list(header.channels)
        colours = {"R", "G", "B"} if "R" in names else {names[0]}
        marks = {
            name: np.empty(header.size[::-1], np.float32)
            for name in names
            if name not in colours
        }
        for first, pixels in parts:
            for name, plane in marks.items():
                plane[first : first + len(pixels)] = pixels[..., names.index(name)]
    return marks


def write_map(
    path: str | os.PathLike[str],
    radiance: NDArray[np.float32],
    marks: Mapping[str, NDArray[Any]],
    attributes: Mapping[str, Any],
) -> None:
    """Write a map (H, W, 3) and its `marks`, each (H, W) under its channel's name."""
    pixels = np.dstack([radiance, *marks.values()])
    write_exr(path, pixels, channels=("R", "G", "B", *marks), attributes=attributes)


def latlong_attributes(
    kept: Mapping[str, Any], origin: Any = None, rotation: NDArray[np.float64] | None = None
) -> dict[str, Any]:
    """Attributes of a lat-long EXR; OpenImageIO writes `textureformat` as OpenEXR's envmap.

    `origin` (3,) metres is where the map was seen from. `rotation` (3, 3) is what the map's
    axes are to the world's, ``d_map = rotation @ d_world``; without it, and without a
    ``worldToCamera`` among `kept`, they are the same.
    """
    attributes: dict[str, Any] = {**kept, "textureformat": "LatLong Environment"}
    if origin is not None:
        attributes["origin"] = np.asarray(origin, float)
    if rotation is not None or origin is not None or "worldToCamera" not in kept:
        turn = np.eye(3) if rotation is None else rotation
        place = np.ravel(attributes.get("origin", np.zeros(3)))
        matrix = np.eye(4)  # OpenEXR multiplies rows: p_camera = p_world @ matrix
        matrix[:3, :3], matrix[3, :3] = turn.T, -turn @ place
        attributes["worldToCamera"] = matrix
    return attributes


def map_from_world(attributes: Mapping[str, Any]) -> NDArray[np.float64]:
    """The rotation (3, 3) of :func:`latlong_attributes`, from a map's attributes.

    Raises
    ------
    UserError
        When ``worldToCamera`` turns nothing, but distorts.

    """
    if "worldToCamera" not in attributes:
        return np.eye(3)
    turn = np.asarray(attributes["worldToCamera"], float).reshape(4, 4)[:3, :3].T
    if not (np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0):
        raise UserError("its attribute worldToCamera is no rotation; remove it")
    return turn


def tone_mapped(
    rgb: NDArray[np.float32], alpha: NDArray[np.float32] | None = None, width: int = 1024
) -> NDArray[np.uint8]:
    """For looking at: the median at a quarter grey, highlights rolled off; no measurement.

    Pixels of alpha 0 are darkened. At most `width` pixels across.
    """
    import cv2

    step = max(1.0, rgb.shape[1] / width)
    size = (round(rgb.shape[1] / step), max(1, round(rgb.shape[0] / step)))
    small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.float32)
    y = luminance(small)
    lit = y[y > 0]
    scale = 0.25 / float(np.median(lit)) if lit.size else 1.0
    y = y * scale
    # Reinhard et al. 2002, eq. 4, white at 16 times the middle
    small = small * (scale * (1 + y / 16) / (1 + y))[..., None]
    if alpha is not None:
        seen = np.asarray(cv2.resize(alpha, size, interpolation=cv2.INTER_AREA))
        small = small * (0.35 + 0.65 * np.clip(seen, 0, 1))[..., None]
    return to_display(small)


class Preview:
    """A small picture of a large one, `size` is width and height, that comes by rows.

    Whole blocks of pixels are averaged, down to a width of 1024 to 2048.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._step = max(1, size[0] // 1024)
        self._rgba: list[NDArray[np.float32]] = []
        self._rest = np.zeros((0, size[0], 4), np.float32)

    def add(self, rgb: NDArray[np.float32], alpha: NDArray[np.float32]) -> None:
        """Append rows (h, W, 3) and (h, W)."""
        step = self._step
        rows = np.concatenate([self._rest, np.dstack([rgb, alpha])])
        count = len(rows) // step
        if count:
            self._rgba.append(self._blocks(rows[: count * step]))
        self._rest = rows[count * step :]

    def picture(self) -> NDArray[np.uint8]:
        """All rows so far, :func:`tone_mapped`."""
        rest = [self._blocks(self._rest)] if len(self._rest) else []
        rgba = np.concatenate([*self._rgba, *rest])
        return tone_mapped(np.ascontiguousarray(rgba[..., :3]), rgba[..., 3])

    def _blocks(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        at = [np.arange(0, n, self._step) for n in rows.shape[:2]]
        down = np.add.reduceat(np.add.reduceat(rows, at[0], axis=0), at[1], axis=1)
        counts = [np.diff([*k, n]) for k, n in zip(at, rows.shape[:2], strict=True)]
        return (down / np.multiply.outer(*counts)[..., None]).astype(np.float32)


def write_preview(output: Path, kind: str, display: NDArray[np.uint8]) -> str:
    """Write ``env.KIND.png`` beside ``env.exr``; its name, for the record's figures."""
    path = output.with_name(f"{output.stem}.{kind}.png")
    write_picture(path, display)
    return path.name
