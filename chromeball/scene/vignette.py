"""A lens's fall-off towards the rim, ``vignette.json``, as every room takes it (seeds A1v).

Radiance reaches the sensor times

    V = (1 + c1 r^2 + c2 r^4 + ...) exp(m),

r the distance from a centre over a radius and m, where it is needed, a smooth map. What
measures it is :mod:`chromeball.calibrate.vignette` and the stitching of overlapping frames;
merging and mapping divide by it, the renderer multiplies with it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.record import decode, to_json

type Float = NDArray[np.float64]
type Source = Literal["given", "board", "flat", "overlap"]
type Given = Vignette | tuple[float, ...]

#: A fall-off below this is an error: a thousandth of the light is no measurement.
LEAST = 0.01
#: Nodes of the map and of the errors that are measured, down and across.
LATTICE = (7, 9)
#: EXR attribute of a picture whose fall-off was divided out.
REMOVED = "vignettingRemoved"
_Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]
_Positive = Annotated[float, Meta(gt=0, le=1e12)]
_Size = Annotated[int, Meta(ge=1, le=1_000_000)]


class Edge(Struct, frozen=True, forbid_unknown_fields=True):
    """A hard edge, mechanical vignetting or the image circle: a circle in pixels."""

    centre: tuple[_Finite, _Finite]
    radius: _Positive


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    version: int
    size: tuple[_Size, _Size]
    centre: tuple[_Finite, _Finite]
    radius: _Positive
    coefficients: list[_Finite]
    covariance: list[list[_Finite]]
    sigma: list[list[Annotated[float, Meta(ge=0, le=1e12)]]]
    map: list[list[_Finite]] | None
    covered: Annotated[float, Meta(ge=0, le=1e12)]
    edge: Edge | None
    source: Source
    aperture: float | None
    record: dict[str, Any]


@dataclass(frozen=True)
class Vignette:
    """The fall-off V of one lens, focus and aperture, for pictures of one ``size``.

    ``centre`` and ``radius`` in pixels; ``coefficients`` (K,) with their ``covariance`` (K, K).
    ``sigma`` (rows, columns): standard error of ln V on a lattice from the first pixel to the
    last; ``map`` (rows, columns) or None: m on the same lattice. ``covered``: the r up to which
    it was measured; ``edge``: beyond it no light comes, and V stays what it is there.
    """

    size: tuple[int, int]
    centre: tuple[float, float]
    radius: float
    coefficients: Float
    covariance: Float
    sigma: Float
    map: Float | None = None
    covered: float = 1.0
    edge: Edge | None = None
    source: Source = "given"
    aperture: float | None = None
    record: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @classmethod
    def of(
        cls,
        coefficients: Sequence[float],
        size: tuple[int, int],
        centre: tuple[float, float] | None = None,
        radius: float | None = None,
        covariance: Float | None = None,
    ) -> Vignette:
        """A known polynomial; r = 1 at half the diagonal about the middle by default."""
        width, height = size
        c = np.array(coefficients, float)
        known = cls(
            size,
            ((width - 1) / 2, (height - 1) / 2) if centre is None else centre,
            math.hypot(width, height) / 2 if radius is None else radius,
            c,
            np.zeros((len(c), len(c))) if covariance is None else covariance,
            np.zeros((2, 2)),
        )
        if covariance is None:
            return known
        q = lattice(size)
        r2 = ((q - known.centre) ** 2).sum(axis=-1) / known.radius**2
        slopes = log_slopes(r2, c)[1]
        variance = np.einsum("...c,cd,...d->...", slopes, covariance, slopes)
        return replace(known, sigma=np.sqrt(np.maximum(variance, 0)))

    def at(self, pixels: ArrayLike) -> Float:
        """V at `pixels` (..., 2), (...)."""
        q = np.asarray(pixels, float)
        x, y = q.reshape(-1, 2).T
        return self._value(x, y).reshape(q.shape[:-1])

    def sigma_at(self, pixels: ArrayLike) -> Float:
        """Relative standard error of V at `pixels` (..., 2), (...)."""
        q = np.asarray(pixels, float)
        x, y = q.reshape(-1, 2).T
        return _between(self.sigma, self.size, x, y).reshape(q.shape[:-1])

    def picture(
        self, size: tuple[int, int] | None = None, rows: tuple[int, int] | None = None
    ) -> NDArray[np.float32]:
        """V of the pixels of a picture of `size`, or of its `rows` from .. to, (H, W).

        Raises
        ------
        UserError
            A picture of other proportions; a fall-off below 1 % inside the picture.

        """
        width, height = size or self.size
        if abs(width * self.size[1] - height * self.size[0]) > max(width, height, *self.size):
            raise UserError(
                "the fall-off was measured on pictures of {}x{}, this one is {}x{}: a crop "
                "needs a measurement of its own".format(*self.size, width, height)
            )
        first, last = rows or (0, height)
        x = (np.arange(width) + 0.5) * (self.size[0] / width) - 0.5
        y = (np.arange(first, last) + 0.5) * (self.size[1] / height) - 0.5
        value = self._value(np.asarray(x[None, :], float), np.asarray(y[:, None], float))
        if value.size and value.min() < LEAST:
            raise UserError(
                "the vignetting falls below 1 % inside the picture: it holds only up to "
                f"{self.covered:.0%} of its radius"
            )
        return value.astype(np.float32)

    def beyond(self) -> float:
        """Share of the picture that lies farther out than what was measured."""
        width, height = self.size
        x, y = np.meshgrid(np.linspace(0, width - 1, 96), np.linspace(0, height - 1, 96))
        r2 = self._r2(x, y)
        inside = np.ones_like(r2, bool)
        if self.edge is not None:
            a, b = self.edge.centre
            inside = (x - a) ** 2 + (y - b) ** 2 < self.edge.radius**2
        out = (r2 > self.covered**2 * 1.0001)[inside]
        return float(out.mean()) if out.size else 0.0

    def _r2(self, x: Float, y: Float) -> Float:
        dx, dy = x - self.centre[0], y - self.centre[1]
        if self.edge is not None:  # beyond the edge the value of the edge
            ex, ey = x - self.edge.centre[0], y - self.edge.centre[1]
            far = np.sqrt(ex**2 + ey**2) / self.edge.radius
            shrink = 1 / np.maximum(far, 1)
            dx = self.edge.centre[0] + ex * shrink - self.centre[0]
            dy = self.edge.centre[1] + ey * shrink - self.centre[1]
        return (dx**2 + dy**2) / self.radius**2

    def _value(self, x: Float, y: Float) -> Float:
        value = polynomial(self._r2(x, y), self.coefficients)
        if self.map is not None:
            value = value * np.exp(_between(self.map, self.size, x, y))
        return value

    # ---- files

    def encode(self) -> bytes:
        """The bytes of a ``vignette.json``."""
        content = {
            "version": 1,
            "size": self.size,
            "centre": self.centre,
            "radius": self.radius,
            "coefficients": self.coefficients,
            "covariance": self.covariance,
            "sigma": np.round(self.sigma, 7),
            "map": None if self.map is None else np.round(self.map, 7),
            "covered": self.covered,
            "edge": None if self.edge is None else msgspec.to_builtins(self.edge),
            "source": self.source,
            "aperture": self.aperture,
            "record": self.record,
        }
        return msgspec.json.format(msgspec.json.encode(to_json(content)), indent=1) + b"\n"

    @classmethod
    def decode(cls, data: bytes, path: str | os.PathLike[str] = "vignette.json") -> Vignette:
        """As :func:`read_vignette`, from the bytes."""
        content = decode(data, _File, path)
        if content.version != 1:
            raise UserError(
                f"version {content.version}: this program reads version 1; measure it anew",
                file=path,
            )
        count = len(content.coefficients)
        covariance = _table(content.covariance, (count, count), "covariance", path)
        rows = len(content.sigma)
        shape = (rows, len(content.sigma[0]) if rows else 0)
        if min(shape) < 2:
            raise UserError("sigma needs a lattice of 2 x 2 or more", file=path)
        sigma = _table(content.sigma, shape, "sigma", path)
        grid = None if content.map is None else _table(content.map, shape, "map", path)
        if grid is not None and np.abs(grid).max() > 20:
            raise UserError("map holds factors beyond e^20", file=path)
        return cls(
            content.size,
            content.centre,
            content.radius,
            np.array(content.coefficients, float),
            covariance,
            sigma,
            grid,
            content.covered,
            content.edge,
            content.source,
            content.aperture,
            content.record,
        )


def lattice(size: tuple[int, int]) -> Float:
    """Pixels of the nodes of map and errors, (7, 9, 2), x first."""
    x = np.linspace(0, size[0] - 1, LATTICE[1])
    y = np.linspace(0, size[1] - 1, LATTICE[0])
    return np.stack(np.meshgrid(x, y), axis=-1)


def polynomial(r2: Float, coefficients: Float) -> Float:
    """1 + c1 r^2 + c2 r^4 + ... of `r2`, any shape."""
    value = np.zeros_like(r2)
    for c in coefficients[::-1]:
        value = (value + c) * r2
    return 1 + value


def log_slopes(r2: Float, coefficients: Float) -> tuple[Float, Float]:
    """V of `r2` (...), :data:`LEAST` or more, and slopes of ln V by the c_k, (..., K)."""
    value = np.maximum(polynomial(r2, coefficients), LEAST)  # less is beyond all samples
    powers = np.stack([r2 ** (k + 1) for k in range(len(coefficients))], axis=-1)
    return value, powers / value[..., None]


def read_vignette(path: str | os.PathLike[str]) -> Vignette:
    """Read and check a ``vignette.json``.

    Raises
    ------
    UserError
        Missing, not JSON, an unknown or missing key, wrong lengths, values out of bounds.

    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError as error:
        raise UserError(
            "no such fall-off; `calibrate vignette` measures one", file=path
        ) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror}", file=path) from error
    return Vignette.decode(data, path)


def resolved(
    given: Given,
    size: tuple[int, int],
    centre: tuple[float, float] | None = None,
    radius: float | None = None,
) -> Vignette:
    """The fall-off for pictures of `size`; mere coefficients count from `centre`."""
    if isinstance(given, Vignette):
        return given
    return Vignette.of(given, size, centre, radius)


def check_once(attributes: Mapping[str, Any], file: str | os.PathLike[str]) -> None:
    """Refuse to divide a picture twice.

    Raises
    ------
    UserError
        When its attributes say that its fall-off is out.

    """
    if REMOVED in attributes:
        raise UserError(
            f"its vignetting is divided out already ({attributes[REMOVED]}): leave it out here",
            file=file,
        )


def _between(grid: Float, size: tuple[int, int], x: Float, y: Float) -> Float:
    """Bilinear values of a lattice over the picture, its border beyond."""
    rows, columns = grid.shape
    u = np.clip(x * ((columns - 1) / max(size[0] - 1, 1)), 0, columns - 1)
    v = np.clip(y * ((rows - 1) / max(size[1] - 1, 1)), 0, rows - 1)
    i = np.minimum(u.astype(np.intp), columns - 2)
    j = np.minimum(v.astype(np.intp), rows - 2)
    u, v = u - i, v - j
    upper = grid[j, i] * (1 - u) + grid[j, i + 1] * u
    lower = grid[j + 1, i] * (1 - u) + grid[j + 1, i + 1] * u
    return upper * (1 - v) + lower * v


def _table(
    rows: list[list[float]], shape: tuple[int, int], name: str, path: str | os.PathLike[str]
) -> Float:
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise UserError(f"{name} needs {shape[0]} x {shape[1]} numbers", file=path)
    return np.array(rows, float).reshape(shape)
