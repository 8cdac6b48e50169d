"""KTX 2.0 files of cube maps and tables with mip levels (Khronos KTX File Format 2.0).

PyPI's bindings of libktx have no build for Linux, and OpenImageIO reads DDS but does not write
it; uncompressed levels of floats are a small part of the specification.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.record import write_bytes

_IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
#: VkFormat and bits of a channel for each number of channels: half, then float.
_FORMATS = {(2, 16): 83, (4, 16): 97, (2, 32): 103, (4, 32): 109}
#: The largest value of a half.
HALF = 65504.0


def write_ktx2(path: str | os.PathLike[str], levels: Sequence[NDArray[np.float32]]) -> str:
    """Write levels, largest first: (6, N, N, 3) of a cube or (H, W, 2) of a table.

    Half floats where they hold every value, else floats; the answer says which. A cube gets
    an alpha of 1. Faces are +X -X +Y -Y +Z -Z, rows go down, values are linear Rec.709.
    """
    cube = levels[0].ndim == 4
    half = max(float(level.max()) for level in levels) <= HALF
    bits = 16 if half else 32
    images = [_image(level, half) for level in levels]
    channels = images[0].shape[-1]
    texel = channels * bits // 8
    descriptor = _descriptor(channels, bits)
    notes = _notes({"KTXorientation": "rd", "KTXwriter": f"chromeball {version('chromeball')}"})
    at_descriptor = 80 + 24 * len(images)
    at_notes = at_descriptor + len(descriptor)
    position = at_notes + len(notes)
    body = bytearray()
    index: list[tuple[int, int]] = []
    for image in reversed(images):  # the smallest level comes first
        padding = -(position + len(body)) % max(texel, 4)
        body += b"\0" * padding
        data = image.tobytes()
        index.insert(0, (position + len(body), len(data)))
        body += data
    height, width = images[0].shape[-3:-1]
    head = _IDENTIFIER + struct.pack(
        "<9I",
        _FORMATS[channels, bits],
        bits // 8,
        width,
        height,
        0,
        0,
        6 if cube else 1,
        len(images),
        0,
    )
    head += struct.pack("<4I2Q", at_descriptor, len(descriptor), at_notes, len(notes), 0, 0)
    for offset, size in index:
        head += struct.pack("<3Q", offset, size, size)
    write_bytes(path, head + descriptor + notes + bytes(body))
    return f"float{bits}"


def _image(level: NDArray[np.float32], half: bool) -> NDArray[np.generic]:
    if level.shape[-1] == 3:
        level = np.concatenate([level, np.ones_like(level[..., :1])], axis=-1)
    return np.ascontiguousarray(level, "<f2" if half else "<f4")


def _descriptor(channels: int, bits: int) -> bytes:
    """Khronos basic data format: RGBSDA, BT.709, linear, signed floats."""
    block = struct.pack("<IHHBBBB4B8B", 0, 2, 24 + 16 * channels, 1, 1, 1, 0,
                        0, 0, 0, 0, channels * bits // 8, *[0] * 7)  # fmt: skip
    for k, channel in enumerate((0, 1, 2, 15)[:channels]):
        one, minus_one = 0x3F800000, 0xBF800000
        block += struct.pack("<HBB4B2I", k * bits, bits - 1, channel | 0xC0, 0, 0, 0, 0,
                             minus_one, one)  # fmt: skip
    return struct.pack("<I", 4 + len(block)) + block


def _notes(values: dict[str, str]) -> bytes:
    result = b""
    for key, value in sorted(values.items()):
        pair = key.encode() + b"\0" + value.encode() + b"\0"
        result += struct.pack("<I", len(pair)) + pair + b"\0" * (-len(pair) % 4)
    return result
