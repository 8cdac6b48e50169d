"""Image files as textures: 8-bit colours to linear, floats as they are."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.material import Texture, Wrap
from chromeball.scene.color import srgb_decode
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_header, read_image

#: Most pixels of one texture: 8192 x 8192.
MOST_PIXELS = 1 << 26
_MAGIC = {
    b"\x89PNG": ".png",
    b"\xff\xd8\xff": ".jpg",
    b"RIFF": ".webp",
    b"\x76\x2f\x31\x01": ".exr",
    b"#?": ".hdr",
}


def read_texture(
    path: Path, *, color: bool, wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
) -> Texture:
    """An image file as a texture; the integers of a `color` are decoded from sRGB.

    Raises
    ------
    UserError
        When the file is missing, broken, too large, or has pixels that are not finite.

    """
    if path.is_file():
        width, height = read_header(path).size
        if width * height > MOST_PIXELS:
            raise UserError(
                f"{width} x {height} pixels are too many for a texture; make it smaller",
                file=path,
            )
    pixels = read_image(path, straight_alpha=True).pixels
    linear = _decoded(pixels, color)
    if linear.shape[2] == 2:  # grey and alpha
        linear = linear[..., [0, 0, 0, 1]]
    elif linear.shape[2] > 4:
        linear = linear[..., :4]
    if color:
        linear = np.maximum(linear, 0)
    try:
        return Texture(np.ascontiguousarray(linear, np.float32), wrap)
    except UserError as error:
        raise UserError(error.what, file=path) from error


def texture_of_bytes(
    data: bytes, *, color: bool, wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
) -> Texture:
    """As :func:`read_texture`, from the bytes of an image file."""
    suffix = next((s for magic, s in _MAGIC.items() if data.startswith(magic)), None)
    if suffix is None:
        raise UserError("an embedded image is neither PNG, JPEG nor WebP")
    with tempfile.TemporaryDirectory() as folder:  # the library reads files alone
        path = Path(folder) / f"embedded{suffix}"
        path.write_bytes(data)
        try:
            return read_texture(path, color=color, wrap=wrap)
        except UserError as error:
            raise UserError(f"an embedded image: {error.what}") from error


class TextureCache:
    """Every image once, however many materials name it."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], Texture] = {}

    def get(self, key: tuple[object, ...], read: Callable[[], Texture]) -> Texture:
        """The texture of that key, read where it is new."""
        if key not in self._known:
            self._known[key] = read()
        return self._known[key]


def _decoded(pixels: NDArray[Any], color: bool) -> NDArray[np.float32]:
    if not np.issubdtype(pixels.dtype, np.integer):
        return pixels.astype(np.float32)
    codes = np.linspace(0, 1, np.iinfo(pixels.dtype).max + 1, dtype=np.float32)
    curve = srgb_decode(codes).astype(np.float32) if color else codes
    linear = curve[pixels]
    if pixels.shape[2] in (2, 4):  # alpha is linear always
        linear[..., -1] = codes[pixels[..., -1]]
    return linear
