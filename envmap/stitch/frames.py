"""Frames as radiance: merged EXRs, RAW, or 8- and 16-bit photographs made linear."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.picture import read_radiance
from chromeball.scene.color import srgb_decode
from chromeball.scene.errors import UserError
from chromeball.scene.image import Exposure, positive, read_header, read_image

if TYPE_CHECKING:
    from chromeball.hdr.response_file import Response

#: Share of the largest code from which a photograph's pixel is a lower bound.
SATURATED = 250 / 255


@dataclass(frozen=True)
class Frame:
    """One direction of a panorama.

    ``radiance`` (H, W, 3) float32; ``valid`` (H, W) or None for all; ``clipped`` (H, W) or
    None: lower bounds. ``source`` says how it became linear; ``focal35`` the focal length as
    it would be on 36 x 24 mm, from the metadata, or None. ``gathered``: exposure that was
    divided out; of a photograph ``radiance * gathered`` is what its codes say, from 0 to 1.
    ``sigma`` (H, W, 3): standard deviations of independent pixels, or None.
    """

    name: str
    radiance: NDArray[np.float32]
    valid: NDArray[np.bool_] | None = None
    clipped: NDArray[np.bool_] | None = None
    source: str = "radiance"
    focal35: float | None = None
    attributes: dict[str, Any] = field(default_factory=dict[str, Any])
    gathered: float = 1.0
    sigma: NDArray[np.float32] | None = None

    @property
    def assumed(self) -> bool:
        """Whether the camera's curve is a guess."""
        return self.source.startswith("sRGB")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.radiance.shape[1], self.radiance.shape[0]


def read_frame(path: str | os.PathLike[str], response: Response | None = None) -> Frame:
    """A frame of any kind as radiance.

    Photographs of codes become linear by `response`, or else as sRGB; what their metadata say
    of exposure time, aperture and ISO is divided out.

    Raises
    ------
    UserError
        When it is no picture, or not of the response's depth.

    """
    path = Path(path)
    header = read_header(path)
    focal = positive(header.attributes.get("Exif:FocalLengthIn35mmFilm"))
    image = read_image(path)
    if image.linear:
        found = read_radiance(path)
        clipped = found.clipped if image.saturated is None else image.saturated
        return Frame(
            path.stem,
            found.rgb,
            found.valid,
            clipped,
            focal35=focal,
            attributes=found.attributes,
            sigma=found.sigma,
        )
    codes = image.pixels[..., :3]
    if codes.shape[2] < 3:
        codes = np.repeat(codes[..., :1], 3, axis=2)
    depth = int(np.iinfo(codes.dtype).max)
    if response is None:
        table = srgb_decode(np.arange(depth + 1) / depth)[:, None].repeat(3, axis=1)
        source = "sRGB"
    else:
        if response.codes != depth + 1:
            raise UserError(
                f"a picture of {depth + 1} codes, and a response of {response.codes}", file=path
            )
        table = np.exp(np.broadcast_to(response.log_exposure, (3, depth + 1))).T
        source = "response"
    linear = np.stack([table[codes[..., c], c] for c in range(3)], axis=-1)
    gathered = _gathered(header.exposure)
    if gathered is not None:
        linear /= gathered
        source += ", exposure from metadata"
    return Frame(
        path.stem,
        linear.astype(np.float32),
        None,
        (codes >= SATURATED * depth).any(axis=2),
        source,
        focal,
        gathered=1.0 if gathered is None else gathered,
    )


def divided(frame: Frame, falloff: NDArray[np.float32]) -> Frame:
    """The frame without a lens's fall-off (H, W) that is known."""
    gain = np.float32(1) / falloff[..., None]
    sigma = None if frame.sigma is None else frame.sigma * gain
    return replace(frame, radiance=frame.radiance * gain, sigma=sigma)


def check_alike(frames: list[Frame]) -> None:
    """Refuse frames that cannot come from one lens.

    Raises
    ------
    UserError
        Sizes that differ, or metadata that tell different focal lengths.

    """
    first = frames[0]
    for frame in frames[1:]:
        if frame.size != first.size:
            turned = frame.size == first.size[::-1]
            raise UserError(
                f"{frame.name} is {frame.size[0]}x{frame.size[1]}, {first.name} "
                f"{first.size[0]}x{first.size[1]}: all frames are one camera's, as its sensor "
                "lies" + ("; turn it back" if turned else "")
            )
    told = {f.focal35 for f in frames if f.focal35}
    if len(told) > 1 and max(told) > 1.02 * min(told):
        raise UserError(
            f"the metadata tell focal lengths from {min(told):g} to {max(told):g} mm "
            "(at 36 mm): frames of one zoom setting are needed"
        )


def _gathered(exposure: Exposure) -> float | None:
    """Exposure time times ISO / 100 over f-number squared; None where the time is not told."""
    if exposure.time is None:
        return None
    value = exposure.time * (exposure.iso or 100.0) / 100
    value /= (exposure.aperture or 1.0) ** 2
    return value if math.isfinite(value) and value > 0 else None
