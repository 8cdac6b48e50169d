"""What a camera has beyond a pinhole: a pixel filter, an aperture, a shutter (rows A4, F14)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import core
from chromeball.renderer.mesh import Values
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import View
from chromeball.scene.pose import Pose

#: Reconstruction filters without negative parts: coverages stay in 0 .. 1, and samples can be
#: drawn from the filter instead of being weighted by it, so that a pixel's samples are its own.
type Filter = Literal["box", "gaussian", "blackman-harris"]

#: pixels: half the width of each filter, and the deviation of the Gaussian
_RADIUS = {"box": 0.5, "gaussian": 2.0, "blackman-harris": 1.5}
_SIGMA = 0.5
_QUANTILES = 513


@dataclass(frozen=True)
class Lens:
    """How a camera gathers light; unless given, as a pinhole, over a pixel's area, in no time.

    ``filter``: reconstruction filter of what is synthetic. ``aperture``: diameter of the lens,
    metres. ``focus``: distance in focus, metres: of a plane across ``axis`` (3,), a unit vector
    in the world, or without it of a sphere. ``motion``: poses (world from camera) when the
    shutter opens and when it closes. ``shutter``: rays have times, so that what moves is
    blurred; implied by motion.
    """

    filter: Filter = "box"
    aperture: float = 0.0
    focus: float = np.inf
    axis: NDArray[np.float64] | None = None
    motion: tuple[Pose, Pose] | None = None
    shutter: bool = False

    def __post_init__(self) -> None:
        if not (self.aperture >= 0 and np.isfinite(self.aperture)):
            raise UserError(f"an aperture of {self.aperture} m: it must be finite, 0 or more")
        if not self.focus > 0:
            raise UserError(f"a focus at {self.focus} m: it must lie before the camera")

    @property
    def plain(self) -> bool:
        """Whether it is a pinhole that sees the pixels' area at one moment."""
        return self.filter == "box" and self.aperture == 0 and not (self.shutter or self.motion)

    def core(self, rays: NDArray[np.float32], origin: Values) -> core.Camera:
        """The core's camera with `rays` (H + 1, W + 1, 3) at the pixels' corners."""
        x, y, z = (float(v) for v in np.asarray(origin, float))
        turn, shift = np.zeros(3), np.zeros(3)
        if self.motion is not None:
            start, end = self.motion
            turn = Pose(end.rotation @ start.rotation.T, np.zeros(3)).rotation_vector()
            shift = end.translation - start.translation
        angle = float(np.linalg.norm(turn))
        return core.Camera(
            corners=np.ascontiguousarray(rays, np.float32),
            origin=(x, y, z),
            filter=None if self.filter == "box" else quantiles(self.filter),
            radius=self.aperture / 2,
            focus=self.focus,
            axis=_triple(np.zeros(3) if self.axis is None else self.axis),
            shutter=self.shutter or self.motion is not None,
            shift=_triple(shift),
            pivot=_triple(turn / angle if angle > 0 else turn),
            angle=angle,
        )


@lru_cache
def quantiles(name: Filter) -> NDArray[np.float32]:
    """Places (513,), pixels from the centre, below which even shares of the filter lie."""
    r = _RADIUS[name]
    x = np.linspace(-r, r, 20_001)
    match name:
        case "box":
            density = np.ones_like(x)
        case "gaussian":  # cut smoothly: it is 0 at its radius
            density = np.exp(-((x / _SIGMA) ** 2) / 2) - np.exp(-((r / _SIGMA) ** 2) / 2)
        case "blackman-harris":
            a = np.pi * (x / r + 1)
            density = 0.35875 - 0.48829 * np.cos(a) + 0.14128 * np.cos(2 * a)
            density -= 0.01168 * np.cos(3 * a)
    below = np.cumsum(density) - density / 2
    shares = np.linspace(0, 1, _QUANTILES)
    found = np.interp(shares, below / density.sum(), x)
    found[[0, -1]] = -r, r
    return found.astype(np.float32)


def edge(name: Filter, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """How a step looks through the filter: its cumulative distribution at x pixels."""
    if name == "box":
        return np.clip(x + 0.5, 0, 1)
    return np.interp(x, quantiles(name), np.linspace(0, 1, _QUANTILES))


def focus_axis(camera: CameraModel) -> NDArray[np.float64] | None:
    """The optical axis (3,) in the world of a camera that focuses on planes, else None."""
    names = ("LENSMODEL_OPENCV", "LENSMODEL_CAHVOR", "LENSMODEL_PINHOLE")
    flat = camera.model == "pinhole" or camera.model.startswith(names)
    return camera.world_from_camera.rotation[:, 2] if flat else None


def view_lens(
    view: View, kind: Filter, camera: CameraModel, closing: Pose | None = None
) -> Lens:
    """The lens that the scene file gives a view; `closing`: its camera at the shutter's close.

    Raises
    ------
    UserError
        Where it is to focus behind the camera.

    """
    aperture = view.aperture or 0.0
    if view.f_number is not None and view.focal_length is not None:
        aperture = view.focal_length / view.f_number
    axis, focus = focus_axis(camera), np.inf
    if view.focus_distance is not None:
        focus = view.focus_distance
    elif view.focus_at is not None:
        to = np.array(view.focus_at, float) - camera.world_from_camera.translation
        focus = float(np.linalg.norm(to) if axis is None else to @ axis)
        if not focus > 0:
            raise UserError(f"view {view.name!r}: focus_at lies behind the camera")
    motion = None if closing is None else (camera.world_from_camera, closing)
    return Lens(kind, aperture, focus, axis, motion, view.shutter > 0)


def _triple(value: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in value)
    return x, y, z
