"""Pictures in and out: OpenImageIO for EXR, HDR, TIFF, PNG and JPEG, rawpy for camera RAW."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.color import REC709_CHROMATICITIES, srgb_encode
from chromeball.scene.errors import UserError
from chromeball.scene.record import atomic_output

RAW_SUFFIXES = frozenset(
    {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"}
)
#: attribute of a map that may hold negative values and is right
NEGATIVE_MEANING = "negativeMeaning"
LINEAR_SUFFIXES = frozenset({".exr", ".hdr", ".pfm"}) | RAW_SUFFIXES


@dataclass(frozen=True)
class Exposure:
    """What the metadata say of one exposure; ``None`` where they are silent.

    ``time`` in seconds, ``aperture`` as f-number, ``iso`` as ISO speed.
    """

    time: float | None = None
    aperture: float | None = None
    iso: float | None = None
    camera: str | None = None
    lens: str | None = None


@dataclass(frozen=True)
class Image:
    """A picture as it was stored.

    ``pixels`` is (H, W, C) in its own type: uint8, uint16 or float32 (half is widened).
    ``linear`` says that the values are proportional to radiance (EXR, HDR, RAW).

    RAW pictures are float32 linear Rec.709 shares of the sensor's white, nothing clipped:
    noise about black and colours outside the gamut are negative. Theirs alone are
    ``saturated`` (H, W), which pixels come from saturated sensor values, and ``white``, which
    no other pixel's colour exceeds.
    """

    pixels: NDArray[Any]
    linear: bool
    channels: tuple[str, ...]
    exposure: Exposure = field(default_factory=Exposure)
    attributes: Mapping[str, Any] = field(default_factory=dict[str, Any])
    saturated: NDArray[np.bool_] | None = None
    white: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def radiance(self) -> NDArray[np.float32]:
        """The pixels as float32; of a RAW picture, and a map merged from such, negative is 0.

        There it is noise and colours that Rec.709 cannot show, in other pictures a mistake
        that is left for the caller to see.
        """
        pixels = self.pixels.astype(np.float32, copy=False)
        meant = self.saturated is not None or NEGATIVE_MEANING in self.attributes
        return np.maximum(pixels, 0) if meant else pixels


def read_image(path: str | os.PathLike[str], *, straight_alpha: bool = False) -> Image:
    """Read a whole picture with its exposure metadata.

    Colours come multiplied by alpha, unless `straight_alpha` is asked for.

    Raises
    ------
    UserError
        When the file is missing, truncated, or no picture.

    """
    path = Path(path)
    if not path.is_file():
        raise UserError("no such picture", file=path)
    if path.suffix.lower() in RAW_SUFFIXES:
        from chromeball.scene.raw import read_developed

        raw = read_developed(path)
        return Image(
            pixels=raw.pixels,
            linear=True,
            channels=("R", "G", "B"),
            exposure=raw.exposure,
            attributes=raw.attributes,
            saturated=raw.saturated,
            white=raw.white,
        )
    if not _png_is_whole(path):  # asked first: libpng complains on stderr by itself
        raise UserError("truncated or damaged picture: the PNG is not whole", file=path)
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", int(straight_alpha))
    source = oiio.ImageInput.open(os.fspath(path), config)
    if source is None:
        raise UserError(f"not a readable picture: {_reason(oiio.geterror)}", file=path)
    try:
        spec = source.spec()
        base = {"uint8": "uint8", "uint16": "uint16"}.get(str(spec.format), "float")
        pixels = source.read_image(0, 0, 0, spec.nchannels, base)
        if pixels is None or source.has_error:
            raise UserError(
                f"truncated or damaged picture: {_reason(source.geterror)}", file=path
            )
    finally:
        source.close()
    if path.suffix.lower() in {".jpg", ".jpeg"} and not _jpeg_is_whole(path):
        raise UserError("truncated picture: the JPEG ends early", file=path)
    pixels = np.ascontiguousarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    attributes = {a.name: a.value for a in spec.extra_attribs}
    return Image(
        pixels=pixels,
        linear=path.suffix.lower() in LINEAR_SUFFIXES or base == "float",
        channels=tuple(spec.channelnames),
        exposure=exposure_of(attributes),
        attributes=attributes,
    )


@contextmanager
def linear_rows(
    path: str | os.PathLike[str], height: int = 64
) -> Generator[tuple[Header, Iterator[tuple[int, NDArray[np.float32]]]]]:
    """Read a scene-linear picture by rows: its header, and pairs of first row and pixels.

    Pixels (h, W, C) are float32, negative ones as :meth:`Image.radiance` has them; h is about
    `height`, whole tiles of a tiled file. A camera RAW is developed whole.

    Raises
    ------
    UserError
        When the file is missing, truncated, or no linear picture.

    """
    header = read_header(path)
    if Path(path).suffix.lower() not in LINEAR_SUFFIXES - RAW_SUFFIXES:
        image = read_image(path)
        if not image.linear:
            raise UserError(
                "not a scene-linear picture; merge it with `hdr merge` first", file=path
            )
        yield replace(header, channels=image.channels), iter([(0, image.radiance())])
        return
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(os.fspath(path))
    if source is None:
        raise UserError(f"not a readable picture: {_reason(oiio.geterror)}", file=path)
    meant = NEGATIVE_MEANING in header.attributes

    def rows() -> Iterator[tuple[int, NDArray[np.float32]]]:
        spec = source.spec()
        left, top = spec.x, spec.y
        tile = spec.tile_height
        step = max(1, height // tile) * tile if tile else height
        for first in range(0, spec.height, step):
            last = min(first + step, spec.height)
            if tile:
                area = (left, left + spec.width, top + first, top + last, 0, 1)
                part = source.read_tiles(*area, 0, spec.nchannels, "float")
            else:
                part = source.read_scanlines(
                    top + first, top + last, 0, 0, spec.nchannels, "float"
                )
            if part is None or source.has_error:
                raise UserError(
                    f"truncated or damaged picture: {_reason(source.geterror)}", file=path
                )
            pixels = np.asarray(part, np.float32).reshape(last - first, spec.width, -1)
            yield first, np.maximum(pixels, 0) if meant else pixels

    try:
        yield header, rows()
    finally:
        source.close()


@dataclass(frozen=True)
class Header:
    """What a picture says before its pixels: width and height, channels, metadata."""

    size: tuple[int, int]
    channels: tuple[str, ...]
    exposure: Exposure
    attributes: Mapping[str, Any]


def read_header(path: str | os.PathLike[str]) -> Header:
    """Read size, channels and metadata alone, without the pixels.

    Raises
    ------
    UserError
        When the file is missing or no picture.

    """
    path = Path(path)
    if not path.is_file():
        raise UserError("no such picture", file=path)
    if path.suffix.lower() in RAW_SUFFIXES:
        from chromeball.scene.raw import raw_header

        size, exposure, attributes = raw_header(path)
        return Header(size, ("R", "G", "B"), exposure, attributes)
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(os.fspath(path))
    if source is None:
        raise UserError(f"not a readable picture: {_reason(oiio.geterror)}", file=path)
    try:
        spec = source.spec()
        size, channels = (spec.width, spec.height), tuple(spec.channelnames)
        attributes = {a.name: a.value for a in spec.extra_attribs}
    finally:
        source.close()
    return Header(size, channels, exposure_of(attributes), attributes)


def read_exposure(path: str | os.PathLike[str]) -> Exposure:
    """Read the exposure metadata alone, without the pixels."""
    return read_header(path).exposure


def read_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height in pixels, without reading the pixels."""
    return read_header(path).size


def read_rgb(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a scene-linear picture as (H, W, 3) float32; grey is repeated, alpha left out.

    Of a RAW picture negative values are 0, see :meth:`Image.radiance`.

    Raises
    ------
    UserError
        When it is not linear, or holds NaN, infinite or negative values.

    """
    image = read_image(path)
    if not image.linear:
        raise UserError(
            "not a scene-linear picture; merge it with `hdr merge` first", file=path
        )
    pixels = image.radiance()
    names = list(image.channels)
    if all(name in names for name in "RGB"):
        rgb = pixels[..., [names.index(name) for name in "RGB"]]
    elif pixels.shape[2] >= 3:
        rgb = pixels[..., :3]
    else:
        rgb = np.repeat(pixels[..., :1], 3, axis=2)
    bad = ~np.isfinite(rgb) | (rgb < 0)
    if bad.any():
        y, x, _ = np.argwhere(bad)[0]
        raise UserError(
            f"{int(bad.any(axis=2).sum())} pixels are NaN, infinite or negative, "
            f"the first at x {x}, y {y}",
            file=path,
        )
    return np.ascontiguousarray(rgb)


def write_exr(
    path: str | os.PathLike[str],
    pixels: NDArray[Any],
    *,
    channels: Sequence[str] = ("R", "G", "B"),
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write (H, W, C) as float32 OpenEXR (zip), whole or not at all.

    Values of `attributes` are str, int, float or sequences of floats; ``chromaticities`` are
    Rec.709 unless given.
    """
    pixels = np.ascontiguousarray(pixels, np.float32)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    height, width, count = pixels.shape
    if count != len(channels):
        raise ValueError(f"{count} channels of pixels, {len(channels)} names")
    spec = _exr_spec((width, height), channels, attributes)
    with atomic_output(path) as temporary:
        _write(temporary, spec, pixels, path)


def write_mipmapped_exr(
    path: str | os.PathLike[str],
    levels: Sequence[NDArray[np.float32]],
    *,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """As :func:`write_exr`, tiled, with mip `levels` (H, W, 3), each half the one before.

    OpenEXR wants levels down to one pixel: averages of the last one follow it.
    """
    import OpenImageIO as oiio

    levels = list(levels)
    while max(levels[-1].shape[:2]) > 1:
        last = levels[-1]
        height, width = (max(1, n // 2) for n in last.shape[:2])
        even = last[: height * (last.shape[0] // height), : width * (last.shape[1] // width)]
        halves = even.reshape(height, -1, width, last.shape[1] // width, 3)
        levels.append(halves.mean(axis=(1, 3)))
    with atomic_output(path) as temporary:
        target = oiio.ImageOutput.create(os.fspath(temporary))
        if target is None:
            raise UserError(f"cannot write: {_reason(oiio.geterror)}", file=path)
        for i, level in enumerate(levels):
            height, width = level.shape[:2]
            spec = _exr_spec((width, height), ("R", "G", "B"), attributes)
            spec.tile_width = spec.tile_height = 64
            mode = "AppendMIPLevel" if i else "Create"
            if not (
                target.open(os.fspath(temporary), spec, mode)
                and target.write_image(np.ascontiguousarray(level, np.float32))
            ):
                raise UserError(f"cannot write: {_reason(target.geterror)}", file=path)
        if not target.close():
            raise UserError(f"cannot write: {_reason(target.geterror)}", file=path)


@contextmanager
def exr_rows(
    path: str | os.PathLike[str],
    size: tuple[int, int],
    *,
    channels: Sequence[str] = ("R", "G", "B"),
    attributes: Mapping[str, Any] | None = None,
) -> Generator[Callable[[NDArray[np.float32]], None]]:
    """As :func:`write_exr` for a picture of `size` (width, height) that comes by rows.

    Yields a function that appends rows (h, W, C) from the top.
    """
    import OpenImageIO as oiio

    width, height = size
    with atomic_output(path) as temporary:
        target = oiio.ImageOutput.create(os.fspath(temporary))
        if target is None or not target.open(
            os.fspath(temporary), _exr_spec(size, channels, attributes)
        ):
            raise UserError(f"cannot write: {_reason(oiio.geterror)}", file=path)
        top = 0

        def append(rows: NDArray[np.float32]) -> None:
            nonlocal top
            if rows.shape[1:] != (width, len(channels)):
                raise ValueError(f"rows of shape {rows.shape}")
            end = top + len(rows)
            if not target.write_scanlines(top, end, 0, np.ascontiguousarray(rows)):
                raise UserError(f"cannot write: {_reason(target.geterror)}", file=path)
            top = end

        try:
            yield append
            if top != height:
                raise ValueError(f"{top} rows of {height}")
        finally:
            closed = target.close()
        if not closed:
            raise UserError(f"cannot write: {_reason(target.geterror)}", file=path)


def _exr_spec(
    size: tuple[int, int], channels: Sequence[str], attributes: Mapping[str, Any] | None
) -> Any:
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(*size, len(channels), "float")
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    # without a DateTime, OpenImageIO gives the time of writing for the time of capture
    merged: dict[str, Any] = {
        "chromaticities": REC709_CHROMATICITIES,
        "DateTime": "",
        **(attributes or {}),
    }
    for name, value in merged.items():
        match value:
            case bool() | int():
                spec.attribute(name, int(value))
            case str():
                spec.attribute(name, value)
            case float():
                spec.attribute(name, float(value))
            case _:
                flat = tuple(float(v) for v in np.ravel(value))
                kind = "float" if len(flat) == 1 else f"float[{len(flat)}]"
                if name == "worldToCamera":
                    kind = "matrix"
                spec.attribute(name, oiio.TypeDesc(kind), flat)
    return spec


def write_picture(
    path: str | os.PathLike[str],
    pixels: NDArray[np.uint8] | NDArray[np.uint16],
    *,
    exposure: Exposure | None = None,
    quality: int = 95,
) -> None:
    """Write (H, W, C) codes as PNG, JPEG or TIFF with metadata, whole or not at all."""
    import OpenImageIO as oiio

    if pixels.ndim == 2:
        pixels = pixels[..., None]
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, str(pixels.dtype))
    if Path(path).suffix.lower() in {".jpg", ".jpeg"}:
        spec.attribute("Compression", f"jpeg:{quality}")
        spec.attribute("jpeg:subsampling", "4:4:4")
    if exposure is not None:
        if exposure.time is not None:
            spec.attribute("ExposureTime", float(exposure.time))
        if exposure.aperture is not None:
            spec.attribute("FNumber", float(exposure.aperture))
        if exposure.iso is not None:
            spec.attribute("Exif:PhotographicSensitivity", int(exposure.iso))
        if exposure.camera is not None:
            spec.attribute("Model", exposure.camera)
        if exposure.lens is not None:
            spec.attribute("Exif:LensModel", exposure.lens)
    with atomic_output(path) as temporary:
        _write(temporary, spec, np.ascontiguousarray(pixels), path)


def write_hdr(path: str | os.PathLike[str], rgb: NDArray[np.float32]) -> None:
    """Write (H, W, 3) as Radiance's RGBE, whole or not at all; 8 bits a channel."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(rgb.shape[1], rgb.shape[0], 3, "float")
    with atomic_output(path) as temporary:
        _write(temporary, spec, np.ascontiguousarray(rgb, np.float32), path)


def to_display(rgb: NDArray[Any], exposure: float = 1.0) -> NDArray[np.uint8]:
    """Scene-linear (H, W, 3) to 8-bit sRGB at `exposure`, for looking at (it clips)."""
    with np.errstate(over="ignore"):  # what becomes infinite is white
        light = np.clip(np.asarray(rgb, np.float32) * exposure, 0, 1)
    codes = 255 * srgb_encode(light) + 0.5
    return codes.astype(np.uint8)


def _write(
    temporary: Path, spec: Any, pixels: NDArray[Any], path: str | os.PathLike[str]
) -> None:
    import OpenImageIO as oiio

    target = oiio.ImageOutput.create(os.fspath(temporary))
    if target is None:
        raise UserError(f"no picture format for this name: {_reason(oiio.geterror)}", file=path)
    if not (target.open(os.fspath(temporary), spec) and target.write_image(pixels)):
        raise UserError(f"cannot write: {_reason(target.geterror)}", file=path)
    if not target.close():
        raise UserError(f"cannot write: {_reason(target.geterror)}", file=path)


def exposure_of(attributes: Mapping[str, Any]) -> Exposure:
    """Exposure metadata from OpenImageIO's attributes."""
    time = positive(attributes.get("ExposureTime"))
    apex = attributes.get("Exif:ShutterSpeedValue")
    if "ExposureTime" not in attributes and isinstance(apex, int | float) and abs(apex) < 64:
        time = positive(2.0**-apex)
    return Exposure(
        time=time,
        aperture=positive(attributes.get("FNumber")),
        iso=positive(
            attributes.get(
                "Exif:PhotographicSensitivity", attributes.get("Exif:ISOSpeedRatings")
            )
        ),
        camera=_text(attributes.get("Model")),
        lens=_text(attributes.get("Exif:LensModel")),
    )


def positive(value: Any) -> float | None:
    """A finite positive number, or the first of several; None for all else."""
    if isinstance(value, tuple) and value:
        value = value[0]
    if isinstance(value, int | float | np.number) and math.isfinite(value) and value > 0:
        return float(value)  # pyright: ignore[reportArgumentType]
    return None


def _text(value: Any) -> str | None:
    if not isinstance(value, str):
        return None
    return value.encode(errors="replace").decode().strip() or None  # bytes of no encoding: ?


def _jpeg_is_whole(path: Path) -> bool:
    """Whether an end-of-image marker is near the end (cameras append data of their own)."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 65536))
        return b"\xff\xd9" in file.read()


def _png_is_whole(path: Path) -> bool:
    """Whether the chunks of a PNG are sound and lead to its end; True for other files."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8) != b"\x89PNG\r\n\x1a\n":
            return True
        kind = b""
        while kind != b"IEND":
            head = file.read(8)
            length, kind = int.from_bytes(head[:4]), head[4:]
            if len(head) < 8 or file.tell() + length + 4 > size:
                return False
            if zlib.crc32(kind + file.read(length)) != int.from_bytes(file.read(4)):
                return False
    return True


def _reason(geterror: Callable[[], str]) -> str:
    """The last line of what OpenImageIO says, which may quote the file's own broken bytes."""
    try:
        lines = geterror().strip().splitlines()
    except UnicodeDecodeError:
        return "damaged header"
    return lines[-1] if lines else "unknown format"
