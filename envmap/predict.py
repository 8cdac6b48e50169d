"""What a map predicts for a frame (seeds.md A7; Aalborg 2004, section 8.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.mapping import LatLong, of_camera
from chromeball.envmap.resample import warp
from chromeball.envmap.robust import FLOOR, Blocks
from chromeball.envmap.several import Cast, ProbeMap, light_at
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import LUMINANCE
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]
type Picture = NDArray[np.float32]
type Mask = NDArray[np.bool_]

#: Blocks across a frame's longer side.
BLOCKS = 32
#: Uncertainty of a block that a misplaced map causes, as a part of the prediction's spread in
#: it, and what is left of the spread in an even one.
_EDGE = 0.05
#: A camera this near to the map's place sees the map as it is, metres.
_HERE = 1e-3


@dataclass(frozen=True)
class Frame:
    """Radiance (H, W, 3) of a calibrated camera that knows its pose.

    ``usable`` (H, W): pixels that are not clipped.
    """

    radiance: Picture
    camera: CameraModel
    usable: Mask


@dataclass(frozen=True)
class Comparison:
    """A frame beside its prediction.

    ``predicted`` (H, W, 3); ``valid`` (H, W); of N blocks that are mostly valid: ``blocks``,
    their ``pixels`` (N, 2) x, y of the middle, ``directions`` (N, 3) from the map's place to
    what they show, ``places`` (N, 3) and ``normals`` (N, 3) of it, places infinite where there
    is no geometry; ``solid`` (N,) sr seen from the camera; ``side`` pixels of a block.
    """

    frame: Frame
    predicted: Picture
    valid: Mask
    blocks: Blocks
    pixels: Array
    directions: Array
    places: Array
    normals: Array
    solid: Array
    side: int

    def means(self, picture: Picture) -> Array:
        """Of a picture (H, W, 3) over the valid pixels of each block, (N, 3)."""
        height, width = self.valid.shape
        rows, columns, side = height // self.side, width // self.side, self.side

        def sums(values: NDArray[np.floating]) -> Array:
            cut = values[: rows * side, : columns * side].astype(float)
            return cut.reshape(rows, side, columns, side, -1).sum(axis=(1, 3))

        part = self.valid[..., None].astype(float)
        mean = sums(picture * part) / np.maximum(sums(part), 1)
        x, y = (self.pixels // side).astype(int).T
        return mean[y, x]


def predict(env: ProbeMap, camera: CameraModel, cast: Cast | None) -> tuple[Picture, Picture]:
    """What `camera` would see if nothing had changed, (H, W, 3), and the map's part (H, W).

    Without geometry, `cast`, all light is at infinity. What the map did not see has part 0.
    """
    place = camera.world_from_camera.translation
    height, width = env.radiance.shape[:2]
    panorama = LatLong((width, height))
    radiance, seen = env.radiance, env.seen
    if cast is not None and np.linalg.norm(place - env.origin) > _HERE:
        moved = light_at([env], place, cast, width)
        radiance, seen = moved.radiance, moved.seen > 0.99
    target = of_camera(camera).turned(camera.world_from_camera.rotation)
    result = warp(radiance, panorama, target, valid=seen)
    return result.radiance, result.coverage


def compare(env: ProbeMap, frame: Frame, cast: Cast | None = None) -> Comparison:
    """The frame and its prediction, by blocks.

    Raises
    ------
    UserError
        When the frame does not fit its camera, or shows too little of the map.

    """
    height, width = frame.radiance.shape[:2]
    if frame.camera.size != (width, height):
        raise UserError(
            f"the camera's pictures are {frame.camera.size[0]}x{frame.camera.size[1]}, the "
            f"frame is {width}x{height}"
        )
    predicted, coverage = predict(env, frame.camera, cast)
    valid = (coverage > 0.99) & frame.usable & np.isfinite(frame.radiance).all(axis=2)
    side = max(2, -(-max(width, height) // BLOCKS))
    rows, columns = height // side, width // side
    if not rows * columns:
        raise UserError(f"a frame of {width}x{height} pixels is too small to compare")

    def sums(values: Array | Picture) -> Array:
        cut = values[: rows * side, : columns * side].astype(float)
        return cut.reshape(rows, side, columns, side, -1).sum(axis=(1, 3))

    part = valid[..., None].astype(float)
    count = sums(part)
    known = np.maximum(count, 1)
    seen = sums(np.where(valid[..., None], frame.radiance, 0)) / known
    mean = sums(predicted * part) / known
    square = sums(predicted.astype(float) ** 2 * part) / known
    spread = np.sqrt(np.maximum(square - mean**2, 0))
    enough = (count[..., 0] > 0.5 * side**2) & (mean @ LUMINANCE > 0)
    if enough.sum() < 4:
        raise UserError(
            "too little of the frame shows what the map holds: check the camera's pose, the "
            "stand-in and what is clipped"
        )
    typical = np.median(mean[enough], axis=0)
    sigma = np.hypot(np.hypot(FLOOR * mean, _EDGE * spread), np.maximum(0.005 * typical, 1e-12))
    y, x = np.nonzero(enough)
    pixels = np.stack([x, y], axis=1).astype(np.float64) * side + (side - 1) / 2
    corner = pixels - (side / 2)
    d = frame.camera.rays(pixels)
    # the block's solid angle, from the rays of its corners
    a, b, c = (frame.camera.rays(corner + step) for step in ([0, 0], [side, 0], [0, side]))
    solid = np.nan_to_num(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    places, normals = np.full(d.shape, np.inf), -d
    directions = d
    if cast is not None:
        eye = frame.camera.world_from_camera.translation
        t, n = cast(np.broadcast_to(eye, d.shape), d)
        met = np.isfinite(t)
        places = np.where(met[:, None], eye + np.where(met, t, 0)[:, None] * d, np.inf)
        normals = np.where(met[:, None], n, -d)
        v = np.where(met[:, None], places - env.origin, d)
        directions = v / np.maximum(np.linalg.norm(v, axis=1), 1e-12)[:, None]
    blocks = Blocks(seen[y, x], mean[y, x], sigma[y, x])
    return Comparison(
        frame, predicted, valid, blocks, pixels, directions, places, normals, solid, side
    )


def misplaced(comparison: Comparison) -> float:
    """By how many pixels the frame lies beside its prediction.

    0 where no shift brings them together.

    Phase correlation of edges, on at most 512 pixels: a camera that was moved.
    """
    import cv2

    step = max(1, max(comparison.valid.shape) // 512)

    def edges(rgb: Picture) -> NDArray[np.float32]:
        small = cv2.resize(rgb, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA)
        y = np.log(np.asarray(small, float) @ LUMINANCE + 1e-9)
        y -= np.asarray(cv2.GaussianBlur(y, (0, 0), 8))
        ok = cv2.resize(
            comparison.valid.astype(np.uint8), (y.shape[1], y.shape[0]),
            interpolation=cv2.INTER_NEAREST,
        )  # fmt: skip
        y[np.asarray(ok) == 0] = 0
        return np.clip(y, -1, 1).astype(np.float32)

    one, two = edges(comparison.predicted), edges(comparison.frame.radiance)
    if min(one.std(), two.std()) < 1e-3 or min(one.shape) < 16:
        return 0.0
    window = np.asarray(cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F), np.float32)
    (dx, dy), _ = cv2.phaseCorrelate(one, two, window)
    # only a shift that brings the two together says anything
    moved = np.roll(one, (round(dy), round(dx)), axis=(0, 1))
    before, after = (float((np.abs(two - first) * window).mean()) for first in (one, moved))
    return float(np.hypot(dx, dy) * step) if after < 0.7 * before else 0.0
