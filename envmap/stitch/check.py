"""The panorama through the photograph's own lens, beside the photograph (seeds.md F2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong, of_camera
from chromeball.envmap.picture import tone_mapped
from chromeball.envmap.resample import warp
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import luminance

type Array = NDArray[np.float64]

#: Width of the check's pictures.
WIDTH = 640


@dataclass(frozen=True)
class Check:
    """A frame beside the panorama seen through its lens.

    ``picture`` (h, 3 w, 3) 8-bit: photograph, panorama, their difference (grey: none; a
    quarter brighter or darker is white or black). ``ratio`` the median of panorama over
    photograph, ``difference`` the median of their relative difference, ``far`` the share of
    pixels that differ by more than a quarter.
    """

    picture: NDArray[np.uint8]
    ratio: float
    difference: float
    far: float


def through_lens(
    panorama: NDArray[np.float32],
    alpha: NDArray[np.float32],
    camera: CameraModel,
    rotation: Array,
    photograph: NDArray[np.float32],
) -> Check:
    """Compare a `photograph` (H, W, 3) of `camera` with the `panorama` (h, w, 3) it went into.

    `rotation` is world_from_camera; `photograph` has its gains already.
    """
    import cv2

    small = camera.scaled(min(1.0, WIDTH / camera.size[0]))
    own = cv2.resize(photograph, small.size, interpolation=cv2.INTER_AREA)
    source = LatLong((panorama.shape[1], panorama.shape[0]))
    seen = warp(panorama, source, of_camera(small).turned(rotation), valid=alpha > 0.5)
    both = (seen.coverage > 0.999) & (luminance(own) > 0)
    a, b = luminance(own), luminance(seen.radiance)
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.where(both & (b > 0), np.log(b / a), 0.0)
    values = log[both] if both.any() else np.zeros(1)
    grey = np.clip(127.5 + log * (127.5 / np.log(1.25)), 0, 255).astype(np.uint8)
    pair = tone_mapped(
        np.concatenate([own, seen.radiance], axis=1).astype(np.float32), width=2 * small.size[0]
    )
    picture = np.concatenate([pair, np.repeat(grey[..., None], 3, axis=2)], axis=1)
    return Check(
        picture=picture,
        ratio=float(np.exp(np.median(values))),
        difference=float(np.median(np.abs(np.expm1(values)))),
        far=float((np.abs(values) > np.log(1.25)).mean()),
    )


def outlines(
    display: NDArray[np.uint8],
    labels: NDArray[np.int16],
    camera: CameraModel,
    rotations: Array,
) -> NDArray[np.uint8]:
    """The panorama with each frame's border in a colour of its own and the seams in white."""
    import cv2

    height, width = display.shape[:2]
    picture = np.ascontiguousarray(display)
    owner = cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST)
    seam = (owner != np.roll(owner, 1, axis=1)) | (owner != np.roll(owner, 1, axis=0))
    seam[0] = False
    picture[seam] = 255
    target = LatLong((width, height))
    w, h = camera.size
    x, y = np.linspace(0, w - 1, 4 * WIDTH), np.linspace(0, h - 1, 4 * WIDTH)
    zero, one = np.zeros_like(x), np.ones_like(x)
    border = np.concatenate(
        [
            np.stack(p, -1)
            for p in ((x, zero), (x, one * (h - 1)), (zero, y), (one * (w - 1), y))
        ]
    )
    d = camera.unproject(border)
    if not np.isfinite(d).all():  # the image circle is the border there
        turn = np.linspace(0, 2 * np.pi, 8 * WIDTH)
        reach = camera.max_angle * (1 - 1e-6)
        circle = np.stack(
            [
                np.sin(reach) * np.cos(turn),
                np.sin(reach) * np.sin(turn),
                np.full_like(turn, np.cos(reach)),
            ],
            -1,
        )
        q = camera.project(circle)
        with np.errstate(invalid="ignore"):
            inside = ((q > -0.5) & (q < np.array([w, h]) - 0.5)).all(axis=1)
        d = np.concatenate([d[np.isfinite(d).all(axis=1)], circle[inside]])
    for k, rotation in enumerate(rotations):
        at = np.round(target.pixels_of(d @ rotation.T)).astype(int)
        hue = np.array([[[int(180 * k / len(rotations)), 255, 255]]], np.uint8)
        colour = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0]
        picture[at[:, 1] % height, at[:, 0] % width] = colour
    return picture
