"""The lens of all frames, in a form that a bundle adjustment can refine.

Radial lenses become Kannala and Brandt's (2006), r = f (theta + k1 theta^3 + ... + k4 theta^9),
whose parameters have plain derivatives. Lenses that mrcal calibrated are kept as they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.camera import FISHEYE_MODELS, CameraModel
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

#: Diagonal of the 36 x 24 mm that equivalent focal lengths are told for, in mm.
FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)
#: Standard deviations of what a lens may be before the pictures have spoken: ln f, k1, k2, and
#: the centre in shares of f.
PRIOR = {"focal": 0.3, "k1": 0.2, "k2": 0.1, "centre": 0.03}


@dataclass(frozen=True)
class Freedom:
    """Which parameters of the shared lens are unknown: ln f, k1 and k2, cx and cy."""

    focal: bool = False
    radial: bool = False
    centre: bool = False

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return int(self.focal) + 2 * int(self.radial) + 2 * int(self.centre)

    def sigmas(self, focal: float) -> Array:
        """Standard deviations of the priors, in the order of the unknowns."""
        values: list[float] = []
        if self.focal:
            values.append(PRIOR["focal"])
        if self.radial:
            values += [PRIOR["k1"], PRIOR["k2"]]
        if self.centre:
            values += [PRIOR["centre"] * focal] * 2
        return np.array(values)


KNOWN = Freedom()


def is_radial(camera: CameraModel) -> bool:
    """Whether the lens is radially symmetric, so that it can be refined here."""
    return camera.model == "pinhole" or camera.model in FISHEYE_MODELS


def refinable(camera: CameraModel) -> tuple[CameraModel, float]:
    """The same lens as ``kb4``, and the largest difference in pixels over the picture.

    Raises
    ------
    UserError
        For a lens that is not radially symmetric.

    """
    if camera.model == "kb4":
        return camera, 0.0
    if not is_radial(camera):
        raise UserError(
            f"{camera.model} is a calibrated lens without a radial form: it is kept as it is; "
            "leave out --refine"
        )
    width, height = camera.size
    values = camera.intrinsics
    pinhole = camera.model == "pinhole"
    fx, fy = (values[0], values[1]) if pinhole else (values[0], values[0])
    cx, cy = values[2:4] if pinhole else values[1:3]
    corners = np.array([[0.0, 0], [width, 0], [0, height], [width, height]]) - 0.5
    reach = np.hypot(*((corners - [cx, cy]) / [fx, fy]).T).max()
    theta_max = min(camera.max_angle, math.pi)
    if pinhole:
        theta_max = min(math.atan(reach), math.radians(75))
    else:
        line = camera.unproject(
            np.stack([cx + fx * np.linspace(0, reach, 512), np.full(512, cy)], axis=-1)
        )
        angles = np.arctan2(np.hypot(line[:, 0], line[:, 1]), line[:, 2])
        theta_max = min(theta_max, float(np.nanmax(angles)) + 1e-9)
    theta = np.linspace(0, theta_max, 257)[1:]
    d = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
    r = np.abs(camera.project(d)[:, 0] - cx) / fx
    powers = np.stack([theta ** (2 * k + 1) for k in range(1, 5)], axis=-1)
    k, *_ = np.linalg.lstsq(powers, r - theta, rcond=None)
    error = float(np.abs(powers @ k + theta - r).max() * fx)
    made = CameraModel(
        "kb4",
        np.array([fx, fy, cx, cy, *k]),
        camera.size,
        camera.world_from_camera,
        # a wider picture than assumed must not be cut off while the focal length is searched
        camera.max_angle if not pinhole else min(1.2 * theta_max, math.radians(85)),
    )
    return made, error


def scaled_focal(camera: CameraModel, factor: float) -> CameraModel:
    """A ``kb4`` lens of `factor` times the focal length."""
    values = camera.intrinsics.copy()
    values[:2] *= factor
    return replace(camera, intrinsics=values)


def moved(camera: CameraModel, freedom: Freedom, step: Array) -> CameraModel:
    """The lens with its unknowns moved by `step`."""
    values = camera.intrinsics.copy()
    rest = list(step)
    if freedom.focal:
        values[:2] *= math.exp(rest.pop(0))
    if freedom.radial:
        values[4] += rest.pop(0)
        values[5] += rest.pop(0)
    if freedom.centre:
        values[2] += rest.pop(0)
        values[3] += rest.pop(0)
    return replace(camera, intrinsics=values)


def unknowns(camera: CameraModel, freedom: Freedom, start: CameraModel) -> Array:
    """How far the lens has moved from `start`, in the order of the unknowns."""
    now, then = camera.intrinsics, start.intrinsics
    values: list[float] = []
    if freedom.focal:
        values.append(math.log(now[0] / then[0]))
    if freedom.radial:
        values += [now[4] - then[4], now[5] - then[5]]
    if freedom.centre:
        values += [now[2] - then[2], now[3] - then[3]]
    return np.array(values)


def rays(camera: CameraModel, freedom: Freedom, pixels: Array) -> tuple[Array, Array]:
    """Unit directions (N, 3) of `pixels` and their derivatives (N, 3, freedom.count).

    With theta(r) the inverse of r(theta): d theta / d ln f = -r / r', d theta / d k_i =
    -theta^(2i+1) / r'.
    """
    d = camera.unproject(pixels)
    if freedom.count == 0:
        return d, np.zeros((len(pixels), 3, 0))
    fx, fy, cx, cy, *k = camera.intrinsics
    x, y = ((pixels - [cx, cy]) / [fx, fy]).T
    r = np.hypot(x, y)
    safe = np.where(r > 1e-12, r, 1.0)
    cosine, sine = np.where(r > 1e-12, x / safe, 1.0), np.where(r > 1e-12, y / safe, 0.0)
    theta = np.arctan2(np.hypot(d[:, 0], d[:, 1]), d[:, 2])
    slope = 1 + sum((2 * i + 3) * k[i] * theta ** (2 * i + 2) for i in range(4))
    along = np.stack([np.cos(theta) * cosine, np.cos(theta) * sine, -np.sin(theta)], axis=-1)
    across = np.stack([-sine, cosine, np.zeros_like(r)], axis=-1)
    columns: list[Array] = []
    if freedom.focal:
        columns.append(along * (-r / slope)[:, None])
    if freedom.radial:
        columns += [along * (-(theta**p) / slope)[:, None] for p in (3, 5)]
    if freedom.centre:
        turn = np.where(r > 1e-12, np.sin(theta) / safe, 1.0)
        columns.append(
            -(along * (cosine / slope)[:, None] - across * (sine * turn)[:, None]) / fx
        )
        columns.append(
            -(along * (sine / slope)[:, None] + across * (cosine * turn)[:, None]) / fy
        )
    return d, np.stack(columns, axis=-1)


def pixel_angle(camera: CameraModel, pixels: Array) -> Array:
    """How wide a pixel is at `pixels` (N, 2), radians: the root of its solid angle."""
    ahead = camera.unproject(pixels + [0.5, 0.0]) - camera.unproject(pixels - [0.5, 0.0])
    below = camera.unproject(pixels + [0.0, 0.5]) - camera.unproject(pixels - [0.0, 0.5])
    return np.sqrt(np.linalg.norm(np.cross(ahead, below), axis=-1))


def pixel_focal(camera: CameraModel) -> float:
    """Pixels a radian at the middle of the picture."""
    middle = (np.array([camera.size], float) - 1) / 2
    return float(1 / pixel_angle(camera, middle)[0])


def fov_of_frame(model: str, frame: float, focal: float) -> float:
    """The angle across a `frame` (mm) of a lens of `focal` (mm), radians.

    For an equisolid fisheye FOV = 4 asin(frame / (4 f)) (seeds.md F2).

    Raises
    ------
    UserError
        When the lens cannot see so far, or the model is unknown.

    """
    share = frame / (2 * focal)
    limits = {
        "pinhole": math.inf,
        "equidistant": math.pi,
        "equisolid": 2.0,
        "stereographic": math.inf,
        "orthographic": 1.0,
    }
    if model not in limits:
        raise UserError(f"unknown lens {model!r}; one of {', '.join(limits)}")
    if not 0 < share <= limits[model]:
        raise UserError(
            f"no {model} lens of {focal:g} mm fills {frame:g} mm: check focal length and frame"
        )
    match model:
        case "pinhole":
            return 2 * math.atan(share)
        case "equidistant":
            return 2 * share
        case "equisolid":
            return 4 * math.asin(share / 2)
        case "stereographic":
            return 4 * math.atan(share / 2)
        case _:
            return 2 * math.asin(share)


def full_frame(model: str, size: tuple[int, int], pixels: float) -> CameraModel:
    """A lens of focal length `pixels` that fills the picture to its corners.

    Raises
    ------
    UserError
        When the model is unknown.

    """
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    if model == "pinhole":
        return CameraModel("pinhole", np.array([pixels, pixels, *centre]), size)
    diagonal = math.hypot(*size) / pixels
    limit = {"equisolid": 3.999, "orthographic": 1.999, "equidistant": 2 * math.pi}.get(
        model, 1e9
    )
    fov = fov_of_frame(model, min(diagonal, limit), 1.0)
    return CameraModel(model, np.array([pixels, *centre]), size, max_angle=fov / 2)


def parse_lens(
    spec: str, size: tuple[int, int], focal35: float | None = None
) -> tuple[CameraModel, bool]:
    """The lens that a user names, and whether its focal length is a guess.

    ``MODEL`` alone: of unknown focal length, `focal35` (mm on 36 x 24 mm) where metadata tell
    it. ``pinhole:FOV`` across the picture, degrees; ``MODEL:FOV[:cx,cy,radius]`` a fisheye's
    image circle; ``MODEL:10.5mm:23.6`` focal length and width of the sensor in mm.

    Raises
    ------
    UserError
        When it cannot be read.

    """
    from chromeball.envmap.mapping import parse_lens as parse_circle

    model, _, rest = spec.partition(":")
    first, _, second = rest.partition(":")
    named = ("pinhole", *(name for name in FISHEYE_MODELS if name != "kb4"))
    if model not in named:
        raise UserError(f"--lens {spec!r}: unknown lens {model!r}; one of {', '.join(named)}")
    try:
        if not rest:
            return guessed(model, size, focal35), True
        if first.endswith("mm"):
            focal, frame = float(first[:-2]), float(second)
            fov_of_frame(model, frame, focal)
            return full_frame(model, size, focal / frame * size[0]), False
        if model == "pinhole":
            if second:
                raise ValueError
            if not 0 < float(first) < 170:
                raise UserError(f"--lens {spec!r}: a pinhole sees above 0, below 170 degrees")
            return CameraModel.pinhole(size, math.radians(float(first))), False
    except ValueError as error:
        raise UserError(
            f"--lens {spec!r}: write MODEL, MODEL:FOV, MODEL:FOV:cx,cy,radius or "
            "MODEL:10.5mm:23.6 (focal length and sensor width)"
        ) from error
    return parse_circle(spec, size), False


def guessed(model: str, size: tuple[int, int], focal35: float | None = None) -> CameraModel:
    """A lens to begin a search with: the metadata's, or a common one."""
    diagonal = math.hypot(*size)
    if focal35 is not None:
        return full_frame(model, size, focal35 / FULL_FRAME_DIAGONAL * diagonal)
    if model == "pinhole":
        return full_frame(model, size, 28 / FULL_FRAME_DIAGONAL * diagonal)
    share = {"equisolid": 2 * math.sqrt(2), "orthographic": 2.0, "stereographic": 4.0}
    return full_frame(model, size, diagonal / share.get(model, math.pi))  # 180 degrees
