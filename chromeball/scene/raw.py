"""Camera RAW: the sensor's own values, and their development to linear colour.

A bracket is best merged as a mosaic, where each value has one exposure, one noise model and one
saturation level, and demosaiced once: :func:`read_mosaic`, merge, :func:`develop`. A single
picture goes the same way through :func:`chromeball.scene.image.read_image`.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.image import Exposure, exposure_of, positive

#: Values from this share of white on are saturated (sensors bend just below it).
SATURATED = 0.99
#: Pixels around a saturated sensor value that are developed from it for more than about 4 %
#: (mean over random mosaics; the rest reaches 10 pixels far, by gradients).
FOOTPRINT = 2

# Variance of interpolated values over a sample's, and the correlation of a pixel's channels,
# both measured on flat mosaics with equal noise in all pixels.
_GREEN, _BESIDE, _CORNER = 0.43, 0.75, 0.5
_CORRELATION = np.array([[1, 0.6, 0.4], [0.6, 1, 0.57], [0.4, 0.57, 1]])

type Balance = Literal["camera", "daylight", "none"] | tuple[float, float, float]
type Space = Literal["rec709", "camera"]


@dataclass(frozen=True)
class Mosaic:
    """What a Bayer sensor recorded, in its own orientation.

    ``pixels`` (H, W) uint16, the visible area; ``pattern`` the 2 x 2 letters of its colours by
    row; ``black`` and ``white`` (2, 2), the codes of no light and of saturation at those
    places, ``white`` the lower of ``stated_white`` (metadata) and what the pixels show
    (:func:`measured_white`). ``white_balance`` and ``daylight`` are multipliers of camera RGB,
    green 1: the camera's own and those that make daylight (D65) white; ``matrix`` (3, 3) takes
    balanced camera RGB to linear Rec.709, white to white. None where the file is silent.
    """

    pixels: NDArray[np.uint16]
    pattern: tuple[str, str]
    black: NDArray[np.float64]
    white: NDArray[np.float64]
    stated_white: NDArray[np.float64]
    white_balance: tuple[float, float, float] | None
    daylight: tuple[float, float, float] | None
    matrix: NDArray[np.float64] | None
    exposure: Exposure

    @property
    def white_source(self) -> str:
        """Where ``white`` comes from: ``metadata`` or ``pixels``."""
        return "pixels" if np.any(self.white < self.stated_white) else "metadata"

    def linear(self) -> NDArray[np.float32]:
        """(x - black) / (white - black), (H, W); below 0 where noise is, above 1 over white."""
        shape = self.pixels.shape
        scale = tiled((1 / (self.white - self.black)).astype(np.float32), shape)
        above = self.pixels.astype(np.float32) - tiled(self.black.astype(np.float32), shape)
        return above * scale

    def saturated(self) -> NDArray[np.bool_]:
        """Where the sensor is saturated, (H, W)."""
        limit = self.black + SATURATED * (self.white - self.black)
        return self.pixels >= tiled(limit.astype(np.float32), self.pixels.shape)

    def multipliers(self, white_balance: Balance) -> NDArray[np.float64]:
        """The (3,) multipliers of camera RGB that `white_balance` stands for, green 1."""
        match white_balance:
            case "none":
                return np.ones(3)
            case "camera" | "daylight":
                known = self.white_balance if white_balance == "camera" else self.daylight
                if known is None:
                    raise UserError(
                        f"the RAW picture states no {white_balance} white balance: "
                        "give three multipliers or none"
                    )
                return np.array(known)
            case _:
                given = np.array(white_balance, np.float64)
                if not (np.all(np.isfinite(given)) and np.all(given > 0)):
                    raise UserError(f"white balance {white_balance}: three positive numbers")
                return given / given[1]


def tiled(cell: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """A (2, 2) cell repeated over `shape`."""
    height, width = shape[:2]
    return np.tile(cell, (-(-height // 2), -(-width // 2)))[:height, :width]


def read_mosaic(path: str | os.PathLike[str]) -> Mosaic:
    """Read the sensor values of a RAW picture with a Bayer pattern.

    Raises
    ------
    UserError
        When the file is missing or damaged, or its sensor has no Bayer pattern of red, green
        and blue.

    """
    path = Path(path)
    with open_raw(path) as raw:
        reason = _no_bayer(raw)
        if reason:
            raise UserError(f"no Bayer mosaic: {reason}", file=path)
        index = np.asarray(raw.raw_colors_visible[:2, :2])
        letters = raw.color_desc.decode()
        pattern = tuple("".join(letters[k] for k in row) for row in index)
        pixels = raw.raw_image_visible.copy()
        black = np.array(raw.black_level_per_channel, np.float64)[index]
        levels = raw.camera_white_level_per_channel
        top = np.float64(raw.white_level)
        stated = np.full((2, 2), top)
        if levels is not None and min(levels) > 0:
            stated = np.minimum(stated, np.array(levels, np.float64)[index])
        matrix = np.array(raw.color_matrix, np.float64)[:, :3]
        known = bool(np.isfinite(matrix).all() and np.abs(np.linalg.det(matrix)) > 1e-9)
        balance = _multipliers(raw.camera_whitebalance)
        daylight = _multipliers(raw.daylight_whitebalance) if known else None
        exposure = _exposure(raw, path)
    if np.any(stated <= black):
        raise UserError(
            f"black level {black.max():g} is not below white level {stated.min():g}", file=path
        )
    return Mosaic(
        pixels=pixels,
        pattern=(pattern[0], pattern[1]),
        black=black,
        white=measured_white(pixels, black, stated),
        stated_white=stated,
        white_balance=balance,
        daylight=daylight,
        matrix=matrix if known else None,
        exposure=exposure,
    )


def no_bayer(path: str | os.PathLike[str]) -> str | None:
    """Why a RAW picture is no Bayer mosaic of red, green and blue; None if it is one.

    Raises
    ------
    UserError
        When the file is missing or damaged.

    """
    with open_raw(Path(path)) as raw:
        return _no_bayer(raw)


def measured_white(
    pixels: NDArray[np.uint16], black: NDArray[np.float64], stated: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The (2, 2) codes from which the pixels of each place are saturated.

    A clipped sensor piles its values up at the top of the histogram, within a code or two;
    light alone spreads by its shot noise. Where the brightest five codes that hold 32 pixels
    hold ten times as many as the fifty codes below, an equal number of codes compared, and
    nearly nothing is above, their lower edge is the white; otherwise `stated` holds. It is
    never above `stated`.
    """
    white = stated.copy()
    for y in range(2):
        for x in range(2):
            counts = np.bincount(pixels[y::2, x::2].ravel(), minlength=65536)
            lit = counts[int(np.ceil(black[y, x])) :]  # saturation is far above black
            window = np.convolve(lit, np.ones(5, np.int64))[4:]  # [k]: codes k .. k + 4
            full = np.flatnonzero(window >= 32)
            if not full.size or full[-1] < 64:
                continue
            low = int(full[-1]) - 4
            start = max(low, 0) + int(np.argmax(window[max(low, 0) : full[-1] + 1]))
            spike = int(window[start])
            above = int(lit[start + 5 :].sum())
            below = int(lit[start - 52 : start - 2].sum()) / 10 if start >= 52 else np.inf
            if spike >= 10 * below and above <= 0.01 * spike:
                codes = lit[start : start + 5]
                level = start + int(np.argmax(codes >= codes.max() / 10))
                white[y, x] = min(white[y, x], level + int(np.ceil(black[y, x])))
    return white


def develop(
    mosaic: NDArray[np.float32],
    info: Mosaic,
    white_balance: Balance = "camera",
    space: Space = "rec709",
) -> NDArray[np.float32]:
    """Demosaic (H, W) linear values of any range, black subtracted, to (H, W, 3).

    Parameters
    ----------
    mosaic
        In the pattern of `info`; may be negative (noise about black) or of high dynamic range:
        no value rings around a lamp. Nothing is clipped.
    info
        The picture, or one of the bracket, that it comes from.
    white_balance
        ``camera`` as the camera chose, ``daylight`` for one balance for all pictures of a
        session (the colour of the light stays in the picture), ``none``, or multipliers of
        camera RGB; all are scaled to leave green as it is.
    space
        ``rec709``: linear Rec.709 by the file's matrix, colours outside its gamut negative;
        ``camera``: balanced camera RGB.

    Raises
    ------
    UserError
        When the file has no such balance, or no colour matrix for ``rec709``.

    """
    from chromeball.scene import kernel

    if mosaic.shape != info.pixels.shape:
        raise ValueError(f"mosaic {mosaic.shape} of a picture {info.pixels.shape}")
    wanted = info.multipliers(white_balance)
    # near to grey is where a demosaic sees edges best, whatever balance is wanted
    if white_balance == "none":
        used = np.array(info.white_balance or info.daylight or (1.0, 1.0, 1.0))
    else:
        used = wanted
    cell = np.array([[used["RGB".index(letter)] for letter in row] for row in info.pattern])
    balanced = mosaic * tiled(cell.astype(np.float32), mosaic.shape)
    red = "".join(info.pattern).index("R")
    rgb = kernel.demosaic(np.ascontiguousarray(balanced), red // 2, red % 2)
    transform = _matrix(info, space) * (wanted / used)
    return rgb if np.array_equal(transform, np.eye(3)) else rgb @ transform.T.astype(np.float32)


def develop_sigma(
    sigma: NDArray[np.float32],
    info: Mosaic,
    white_balance: Balance = "camera",
    space: Space = "rec709",
) -> NDArray[np.float32]:
    """Standard error (H, W, 3) of :func:`develop`'s values, given the mosaic's (H, W).

    Variance through the demosaic, correlation of the channels after it, as measured for white
    noise: in flat parts true within some 20 %, at edges an estimate. Infinite (a bound, not a
    measurement) in, infinite out wherever the value is used.
    """
    import cv2

    multipliers = info.multipliers(white_balance)
    bound = ~np.isfinite(sigma)
    variance = np.where(bound, 0, sigma) ** 2
    letters = np.array([list(row) for row in info.pattern])
    c, e = _CORNER / 4, _BESIDE / 2
    weights = {
        "G": np.array([[0, _GREEN / 4, 0], [_GREEN / 4, 1, _GREEN / 4], [0, _GREEN / 4, 0]])
    }
    weights["R"] = weights["B"] = np.array([[c, e, c], [e, 1, e], [c, e, c]])
    planes: list[NDArray[np.float32]] = []
    for letter, multiplier in zip("RGB", multipliers, strict=True):
        own = variance * tiled((letters == letter) * multiplier**2, sigma.shape)
        plane = cv2.filter2D(own, -1, weights[letter], borderType=cv2.BORDER_REFLECT_101)
        planes.append(np.asarray(plane, np.float32))
    if space == "camera":
        total = np.stack(planes, axis=2)
    else:
        # rows . diag(s) C diag(s) . rows: six products of s, three of them squares
        r, g, b = (np.sqrt(plane) for plane in planes)
        products = np.stack([*planes, r * g, r * b, g * b], axis=2)
        m = _matrix(info, space)
        first, second = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
        twice = np.array([1, 1, 1, 2, 2, 2])
        total = products @ (m[:, first] * m[:, second] * _CORRELATION[first, second] * twice).T
        total = np.maximum(total, 0)
    total[touched(bound)] = np.inf
    return np.sqrt(total).astype(np.float32)


def touched(saturated: NDArray[np.bool_], radius: int = FOOTPRINT) -> NDArray[np.bool_]:
    """The pixels that are developed from a marked sensor value, (H, W) -> (H, W)."""
    import cv2

    around = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(saturated.astype(np.uint8), around)) > 0


@dataclass(frozen=True)
class Developed:
    """A single RAW picture in linear Rec.709, see :class:`chromeball.scene.image.Image`."""

    pixels: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    white: float
    exposure: Exposure
    attributes: Mapping[str, Any]


def read_developed(path: Path) -> Developed:
    """Read and develop one RAW picture; sensors without a Bayer pattern are LibRaw's to do.

    Values are shares of the sensor's white, with the camera's white balance (daylight's where
    it states none; ``raw:whiteBalance`` says which).

    Raises
    ------
    UserError
        When the file is missing or damaged, or states neither a white balance nor a matrix.

    """
    with open_raw(path) as raw:
        if _no_bayer(raw):
            return _by_libraw(raw, path)
    mosaic = read_mosaic(path)
    balance: Balance = "camera" if mosaic.white_balance else "daylight"
    try:
        space: Space = "rec709" if mosaic.matrix is not None else "camera"
        pixels = develop(mosaic.linear(), mosaic, balance, space)
        multipliers = mosaic.multipliers(balance)
    except UserError as error:
        raise UserError(error.what, file=path) from error
    # no colour that the sensor tells from saturation gets higher than this
    white = float((np.maximum(_matrix(mosaic, space), 0) @ multipliers).max())
    return Developed(
        pixels=pixels,
        saturated=touched(mosaic.saturated()),
        white=white,
        exposure=mosaic.exposure,
        attributes={
            "raw:whiteBalance": f"{balance} {' '.join(f'{m:.6g}' for m in multipliers)}",
            "raw:space": space,
            "raw:black": mosaic.black.ravel().tolist(),
            "raw:white": mosaic.white.ravel().tolist(),
            "raw:whiteSource": mosaic.white_source,
        },
    )


def raw_header(path: Path) -> tuple[tuple[int, int], Exposure, Mapping[str, Any]]:
    """Width and height, exposure, and all metadata of a RAW picture."""
    with open_raw(path) as raw:
        size = raw.sizes.width, raw.sizes.height
        return size, _exposure(raw, path), _attributes(path) or {}


@contextmanager
def open_raw(path: Path) -> Generator[Any]:
    """A RAW picture in LibRaw; what it complains about is a :class:`UserError`."""
    import rawpy

    if not path.is_file():
        raise UserError("no such picture", file=path)
    try:
        with rawpy.imread(os.fspath(path)) as raw:
            yield raw
    except (rawpy.LibRawError, OSError) as error:
        reason = error.args[0] if error.args else error
        if isinstance(reason, bytes):
            reason = reason.decode(errors="replace")
        raise UserError(
            f"unknown, truncated or damaged RAW picture: {reason}", file=path
        ) from error


def _no_bayer(raw: Any) -> str | None:
    """Why a picture cannot be read as a Bayer mosaic; None where it can."""
    try:
        pattern = raw.raw_pattern
    except NotImplementedError:  # rawpy knows patterns of 2 x 2 and 6 x 6
        return "its colours repeat in neither 2 x 2 nor 6 x 6 pixels"
    if pattern is None or raw.raw_image_visible.ndim != 2:
        return "its pixels hold all colours (linear DNG, Foveon)"
    if pattern.shape != (2, 2):
        return f"a pattern of {pattern.shape[0]} x {pattern.shape[1]} colours (X-Trans)"
    height, width = raw.raw_image_visible.shape
    if height < 2 or width < 2:
        return f"{width} x {height} pixels"
    letters = raw.color_desc.decode(errors="replace")
    rows = ["".join(letters[k] for k in row) for row in raw.raw_colors_visible[:2, :2]]
    if tuple(rows) not in {("RG", "GB"), ("BG", "GR"), ("GR", "BG"), ("GB", "RG")}:
        return f"the colours are {' / '.join(rows)}"
    return None


def _by_libraw(raw: Any, path: Path) -> Developed:
    """LibRaw's own demosaic and colour; it clips at white and at zero."""
    import rawpy

    linear: dict[str, Any] = {
        "gamma": (1, 1),
        "no_auto_bright": True,
        "output_bps": 16,
        "adjust_maximum_thr": 0.0,  # else each picture is scaled to its own brightest pixel
    }
    pixels = raw.postprocess(
        use_camera_wb=True, output_color=rawpy.ColorSpace.sRGB, user_flip=0, **linear
    )
    # the sensor's own channels say what is saturated; the colour matrix would hide it
    sensor = raw.postprocess(
        user_wb=[1, 1, 1, 1], output_color=rawpy.ColorSpace.raw, user_flip=0, **linear
    )
    return Developed(
        pixels=pixels.astype(np.float32) / 65535,
        saturated=(sensor >= SATURATED * 65535).any(axis=2),
        white=1.0,
        exposure=_exposure(raw, path),
        attributes={"raw:developedBy": "LibRaw"},
    )


def _matrix(info: Mosaic, space: Space) -> NDArray[np.float64]:
    if space == "camera":
        return np.eye(3)
    if info.matrix is None:
        raise UserError("the RAW picture states no colour matrix: ask for camera RGB")
    return info.matrix


def _multipliers(values: Any) -> tuple[float, float, float] | None:
    """LibRaw's r, g, b, g2 with green 1."""
    r, g, b = (float(v) for v in values[:3])
    if not (np.all(np.isfinite([r, g, b])) and min(r, g, b) > 0):
        return None
    return r / g, 1.0, b / g


def _exposure(raw: Any, path: Path) -> Exposure:
    """From the EXIF where OpenImageIO reads it, else from LibRaw.

    LibRaw makes 1 s and f/1 of metadata that is there and empty.
    """
    attributes = _attributes(path)
    if attributes is not None:
        return exposure_of(attributes)
    return Exposure(
        time=positive(raw.other.shutter_speed),
        aperture=positive(raw.other.aperture),
        iso=positive(raw.other.iso_speed),
    )


def _attributes(path: Path) -> dict[str, Any] | None:
    """OpenImageIO's metadata of a RAW container that it knows (DNG and most others: TIFF)."""
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(os.fspath(path))
    if source is None:
        oiio.geterror()  # forget it: LibRaw knows more containers
        return None
    try:
        return {a.name: a.value for a in source.spec().extra_attribs}
    finally:
        source.close()
