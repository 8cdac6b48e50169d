"""Lenses that nobody has measured, from lights alone: what is unknown of them, and the start.

Pixels are square and the principal point is near the middle (weak knowledge, stated below);
distortion follows. A start tries lenses of many fields of view, each on a share of the frames,
and keeps the one under which the lights fit best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

#: Models of unknown lenses: their name as a camera model.
MODELS = {"pinhole": "pinhole", "opencv4": "LENSMODEL_OPENCV4", "kb4": "kb4"}
#: Fields of view across the longer side tried as a start, degrees, usual ones first.
FIELDS_OF_VIEW = {
    "pinhole": (55, 75, 65, 45, 90, 35, 105, 25, 18),
    "opencv4": (55, 75, 65, 45, 90, 35, 105, 25, 18),
    "kb4": (100, 150, 125, 75, 180, 50, 215),
}
#: Deviations of what is usual: the principal point in widths, distortion.
CENTRE_DEVIATION = 0.02
DISTORTION_DEVIATION = 0.3


@dataclass(frozen=True)
class Unknown:
    """What is unknown of C lenses.

    ``directions`` by level, in which each camera's intrinsics (k,) may change: none when given,
    else focal length; distortion, too; the principal point, too. ``usual`` (k,) for each
    camera, and ``precision`` (k,), the inverse variance of what is usual.
    """

    usual: tuple[NDArray[np.float64], ...]
    precision: tuple[NDArray[np.float64], ...]
    models: tuple[str, ...]
    free: bool

    def directions(self, level: int) -> tuple[NDArray[np.float64], ...]:
        """A basis (k, m) for each camera."""
        if not self.free:
            return tuple(np.zeros((len(k), 0)) for k in self.usual)
        return tuple(
            _directions(m, len(k), level) for m, k in zip(self.models, self.usual, strict=True)
        )

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels of freedom to go through."""
        return (1, 2, 3) if self.free else (3,)


def learned(
    lenses: Unknown, cameras: tuple[CameraModel, ...], errors: tuple[NDArray[np.float64], ...]
) -> Unknown:
    """How far principal points lie from the middle, as the cameras themselves show it.

    Efron and Morris 1973: what their offsets vary more than their standard `errors` (k,) is
    the lenses' own; it is never taken for less than the uncertainty of that difference, nor
    for more than what was known before.
    """
    offsets = [c.intrinsics[2:4] - u[2:4] for c, u in zip(cameras, lenses.usual, strict=True)]
    square = float(np.mean(np.square(offsets)))
    noise = float(np.mean([np.mean(e[2:4] ** 2) for e in errors]))
    own = max(square - noise, noise * math.sqrt(2 / (2 * len(cameras))))
    precision = [p.copy() for p in lenses.precision]
    for p in precision:
        p[2:4] = np.maximum(p[2:4], 1 / own)
    return replace(lenses, precision=tuple(precision))


def known(cameras: tuple[CameraModel, ...]) -> Unknown:
    """Lenses as they are given."""
    values = tuple(c.intrinsics for c in cameras)
    return Unknown(
        values, tuple(np.zeros(len(k)) for k in values), tuple(c.model for c in cameras), False
    )


def refinable(camera: CameraModel) -> bool:
    """Whether lights can improve a lens of this model."""
    return camera.model in ("pinhole", "kb4") or camera.model.startswith("LENSMODEL_OPENCV")


def unknown(cameras: tuple[CameraModel, ...]) -> Unknown:
    """Lenses to be estimated, from where they are."""
    for camera in cameras:
        if not refinable(camera):
            raise UserError(
                f"a lens of model {camera.model} is not refined by lights; "
                f"one of {', '.join(MODELS)}, or take it as it is"
            )
    precision: list[NDArray[np.float64]] = []
    for camera in cameras:
        known = np.zeros(len(camera.intrinsics))
        known[2:4] = (CENTRE_DEVIATION * max(camera.size)) ** -2
        known[4:] = DISTORTION_DEVIATION**-2
        precision.append(known)
    return Unknown(
        tuple(c.intrinsics for c in cameras),
        tuple(precision),
        tuple(c.model for c in cameras),
        True,
    )


def candidates(model: str, sizes: tuple[tuple[int, int], ...]) -> list[tuple[CameraModel, ...]]:
    """Lenses of one field of view across each camera's longer side, for many."""
    return [
        tuple(candidate(model, size, math.radians(degrees)) for size in sizes)
        for degrees in FIELDS_OF_VIEW[model]
    ]


def candidate(model: str, size: tuple[int, int], fov: float) -> CameraModel:
    """A lens without distortion, of which the picture's longer side shows `fov` radians."""
    half = max(size) / 2
    f = half / (fov / 2 if model == "kb4" else math.tan(fov / 2))
    centre = [(size[0] - 1) / 2, (size[1] - 1) / 2]
    extra = 0 if model == "pinhole" else 4
    return CameraModel(MODELS[model], np.array([f, f, *centre, *[0.0] * extra]), size)


def lens_names(camera: CameraModel) -> tuple[str, ...]:
    """Names of a camera's intrinsics."""
    count = len(camera.intrinsics)
    core = ("fx", "fy", "cx", "cy") if count > 3 else ("f", "cx", "cy")
    if camera.model.startswith("LENSMODEL_OPENCV"):
        rest = ("k1", "k2", "p1", "p2", *(f"k{i}" for i in range(3, 11)))
    else:
        rest = tuple(f"k{i + 1}" for i in range(max(0, count - 4)))
    return (*core, *rest[: count - len(core)])


def _directions(model: str, count: int, level: int) -> NDArray[np.float64]:
    """Focal length; from level 2 two terms of distortion; from 3 the centre and the rest.

    The tangential terms of ``opencv4`` stay: they are hardly told from the centre.
    """
    axes = np.eye(count)
    columns = [axes[:2].sum(axis=0)]
    if level >= 2:
        columns.extend(axes[4:6])
    if level >= 3:
        columns.extend(axes[2:4])
        columns.extend(axes[6:] if model == "kb4" else [])
    return np.array(columns).T
