"""One camera class over mrcal's lens models, fisheye projections and lat-long panoramas.

Camera axes are x right, y down, z forward; pixel centres are at integers. A lat-long camera
is the panorama itself as a camera; :data:`WORLD_FROM_LATLONG` turns its axes to OpenEXR's
(centre +Z, image right -X, up +Y).
"""

from __future__ import annotations

import ast
import math
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import write_text

#: Rotation from the axes of a lat-long camera to the world's.
WORLD_FROM_LATLONG = Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))

#: Fisheye projections: r = f * radius(theta), and its inverse, and the derivative.
type Radial = Callable[[Any], Any]
_FISHEYE: dict[str, tuple[Radial, Radial, Radial, float]] = {
    "equidistant": (lambda t: t, lambda r: r, lambda t: np.ones_like(t), math.pi),
    "equisolid": (
        lambda t: 2 * np.sin(t / 2),
        lambda r: 2 * np.arcsin(np.clip(r / 2, -1, 1)),
        lambda t: np.cos(t / 2),
        math.pi,
    ),
    "stereographic": (
        lambda t: 2 * np.tan(t / 2),
        lambda r: 2 * np.arctan(r / 2),
        lambda t: 1 / np.cos(t / 2) ** 2,
        math.pi * 0.999,
    ),
    "orthographic": (
        np.sin,
        lambda r: np.arcsin(np.clip(r, -1, 1)),
        np.cos,
        math.pi / 2,
    ),
}
FISHEYE_MODELS = (*_FISHEYE, "kb4")
MODELS = ("pinhole", *FISHEYE_MODELS, "kb4_decentred", "latlong", "cube")

#: Faces of the cube in camera axes: forward, right, down, and column and row in the cross.
CUBE_FACES: tuple[tuple[tuple[int, int, int], ...], ...] = (
    ((0, 0, 1), (1, 0, 0), (0, 1, 0), (1, 1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0), (2, 1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, 1, 0), (3, 1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 0)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1), (1, 0, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, -1), (1, 2, 0)),
)


@dataclass(frozen=True)
class CameraModel:
    """A calibrated camera with its pose.

    ``model``
        ``pinhole`` (fx fy cx cy); ``equidistant``, ``equisolid``, ``stereographic``,
        ``orthographic`` (f cx cy); ``kb4``, Kannala and Brandt 2006 (fx fy cx cy k1 k2 k3 k4,
        r = theta + k1 theta^3 + ...); ``kb4_decentred``, the same with p1 p2 for elements
        off the axis (COLMAP's thin-prism fisheye without the prism); ``latlong`` and ``cube``
        (none): a cube is a horizontal cross, 4:3, forward in its second column and the back in
        the last, up and down about
        forward; or one of mrcal's names, ``LENSMODEL_...``, with mrcal's intrinsics.
    ``size``
        Width and height in pixels.
    ``max_angle``
        Largest angle from the optical axis that a fisheye sees, radians.
    ``covariance``, ``region``
        Of a calibrated lens: the intrinsics' covariance (k, k), and the corners (N, 2) of the
        part of the picture that was calibrated, pixels, the first also the last.
    """

    model: str
    intrinsics: NDArray[np.float64]
    size: tuple[int, int]
    world_from_camera: Pose = field(default_factory=Pose.identity)
    max_angle: float = math.pi
    covariance: NDArray[np.float64] | None = None
    region: NDArray[np.floating[Any]] | None = None

    def __post_init__(self) -> None:
        values = np.array(self.intrinsics, float).reshape(-1)
        object.__setattr__(self, "intrinsics", values)
        if self.model.startswith("LENSMODEL_"):
            import mrcal

            try:
                expected = mrcal.lensmodel_num_params(self.model)  # pyright: ignore[reportAttributeAccessIssue]
            except (RuntimeError, TypeError) as error:
                raise UserError(f"mrcal knows no lens model {self.model!r}") from error
        elif self.model in MODELS:
            known = {"pinhole": 4, "kb4": 8, "kb4_decentred": 10, "latlong": 0, "cube": 0}
            expected = known.get(self.model, 3)
        else:
            raise UserError(f"unknown camera model {self.model!r}; one of {', '.join(MODELS)}")
        if len(values) != expected:
            raise UserError(f"{self.model} has {expected} intrinsics, not {len(values)}")
        if not np.isfinite(values).all() or min(self.size) < 1:
            raise UserError(f"{self.model}: intrinsics and size must be finite and positive")
        width, height = self.size
        if self.model == "cube" and (3 * width != 4 * height or width % 4):
            raise UserError(
                f"a cube is a cross of 4 x 3 faces: {width} x {height} pixels are none; "
                f"take {max(4, width // 4 * 4)} x {max(3, width // 4 * 3)}"
            )

    # ---- constructors

    @classmethod
    def pinhole(
        cls, size: tuple[int, int], fov: float, pose: Pose | None = None
    ) -> CameraModel:
        """A perfect perspective camera; `fov` is horizontal, in radians."""
        width, height = size
        f = width / (2 * math.tan(fov / 2))
        intrinsics = np.array([f, f, (width - 1) / 2, (height - 1) / 2])
        return cls("pinhole", intrinsics, size, pose or Pose.identity())

    @classmethod
    def fisheye(
        cls,
        model: str,
        size: tuple[int, int],
        fov: float,
        *,
        centre: tuple[float, float] | None = None,
        radius: float | None = None,
        pose: Pose | None = None,
    ) -> CameraModel:
        """A fisheye whose image circle of `radius` pixels spans `fov` radians."""
        if model not in _FISHEYE:
            raise UserError(f"unknown fisheye {model!r}; one of {', '.join(_FISHEYE)}")
        width, height = size
        cx, cy = centre or ((width - 1) / 2, (height - 1) / 2)
        rim = float(_FISHEYE[model][0](np.float64(fov / 2)))
        f = (min(size) / 2 if radius is None else radius) / rim
        return cls(model, np.array([f, cx, cy]), size, pose or Pose.identity(), fov / 2)

    @classmethod
    def latlong(cls, size: tuple[int, int], pose: Pose | None = None) -> CameraModel:
        """A panorama; without a pose its axes are OpenEXR's in world space."""
        return cls("latlong", np.zeros(0), size, pose or WORLD_FROM_LATLONG)

    @classmethod
    def cube(cls, size: tuple[int, int], pose: Pose | None = None) -> CameraModel:
        """The six faces of a cube as a cross; without a pose its axes are a panorama's."""
        return cls("cube", np.zeros(0), size, pose or WORLD_FROM_LATLONG)

    def posed(self, world_from_camera: Pose) -> CameraModel:
        """The same camera elsewhere."""
        return replace(self, world_from_camera=world_from_camera)

    # ---- the mapping, in camera axes

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points in camera axes to pixels, ``(..., 3) -> (..., 2)``; NaN where not seen."""
        return self.project_with_jacobian(points)[0]

    def project_with_jacobian(
        self, points: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """As :meth:`project`, and d pixel / d point, ``(..., 2, 3)``."""
        p = np.ascontiguousarray(points, float)
        if self.model.startswith("LENSMODEL_") or self.model == "pinhole":
            import mrcal

            name = "LENSMODEL_PINHOLE" if self.model == "pinhole" else self.model
            q, dq_dp, _ = mrcal.project(p, name, self.intrinsics, get_gradients=True)
            q, dq_dp = np.array(q, float), np.array(dq_dp, float)
            if not sees_behind(name):
                behind = p[..., 2] <= 0
                q[behind], dq_dp[behind] = np.nan, np.nan
            return q, dq_dp
        project = {"latlong": self._project_latlong, "cube": self._project_cube}.get(
            self.model, self._project_fisheye
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            q, dq_dp = project(p.reshape(-1, 3))
        return q.reshape(*p.shape[:-1], 2), dq_dp.reshape(*p.shape[:-1], 2, 3)

    def unproject(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Pixels to unit directions in camera axes, ``(..., 2) -> (..., 3)``; NaN outside."""
        q = np.ascontiguousarray(pixels, float)
        if self.model.startswith("LENSMODEL_") or self.model == "pinhole":
            import mrcal

            name = "LENSMODEL_PINHOLE" if self.model == "pinhole" else self.model
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)
                return np.array(
                    mrcal.unproject(q, name, self.intrinsics, normalize=True), float
                )
        if self.model == "latlong":
            lon = ((q[..., 0] + 0.5) / self.size[0] - 0.5) * 2 * math.pi
            lat = ((q[..., 1] + 0.5) / self.size[1] - 0.5) * math.pi
            return np.stack(
                [np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)], axis=-1
            )
        if self.model == "cube":
            return self._unproject_cube(q)
        fx, fy, cx, cy, _ = self._fisheye_parameters()
        plane = (q.reshape(-1, 2) - [cx, cy]) / [fx, fy]
        theta, along = self._angle_along(plane)
        if self.model == "kb4_decentred":
            for _ in range(10):  # each round leaves a hundredth of the error or less
                off, _ = self._decentring(theta[:, None] * along)
                theta, along = self._angle_along(plane - off)
        d = np.concatenate([np.sin(theta)[:, None] * along, np.cos(theta)[:, None]], axis=-1)
        d[~(theta <= self.max_angle * (1 + 1e-9))] = np.nan
        return d.reshape(*q.shape[:-1], 3)

    # ---- in world axes

    def rays(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Unit directions in world axes through `pixels`, ``(..., 2) -> (..., 3)``."""
        return self.world_from_camera.rotate(self.unproject(pixels))

    def project_world(self, points: ArrayLike) -> NDArray[np.float64]:
        """World points to pixels, ``(..., 3) -> (..., 2)``; NaN where not seen."""
        return self.project(self.world_from_camera.inverse().apply(points))

    def pixel_grid(self) -> NDArray[np.float64]:
        """All pixel centres, ``(H, W, 2)``, x first."""
        width, height = self.size
        x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        return np.stack([x, y], axis=-1)

    def scaled(self, factor: float) -> CameraModel:
        """The same lens on a sensor with `factor` times as many pixels a side."""
        size = (round(self.size[0] * factor), round(self.size[1] * factor))
        if self.model in ("latlong", "cube"):
            return replace(self, size=size)
        focal = 1 if self.model in _FISHEYE else 2
        sx, sy = size[0] / self.size[0], size[1] / self.size[1]
        by = np.ones(len(self.intrinsics))
        by[: focal + 2] = [sx, sx, sy] if focal == 1 else [sx, sy, sx, sy]
        values = self.intrinsics * by
        values[focal : focal + 2] += [(sx - 1) / 2, (sy - 1) / 2]
        covariance, region = self.covariance, self.region
        if covariance is not None:
            covariance = by[:, None] * covariance * by
        if region is not None:
            region = (region + 0.5) * [sx, sy] - 0.5
        return replace(self, intrinsics=values, size=size, covariance=covariance, region=region)

    # ---- files, in mrcal's text format

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> CameraModel:
        """Read a ``.cameramodel``; a missing or broken one is a :class:`UserError`."""
        try:
            text = Path(path).read_text()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SyntaxWarning)
                value: Any = ast.literal_eval(text.strip())
            rt = np.array(value.get("rt_cam_ref", value.get("extrinsics", np.zeros(6))), float)
            width, height = (int(n) for n in value["imagersize"])
            name = str(value["lensmodel"])
            if name == "LENSMODEL_PINHOLE" or name.startswith("CHROMEBALL_"):
                name = name.partition("_")[2].lower()
            return cls(
                name,
                np.array(value["intrinsics"], float),
                (width, height),
                Pose.from_rotation_vector(rt[:3], rt[3:]).inverse(),
                float(value.get("max_angle", math.pi)),
                _knowledge(value, "intrinsics_covariance", len(value["intrinsics"])),
                _knowledge(value, "valid_intrinsics_region", 2),
            )
        except FileNotFoundError as error:
            raise UserError("no such camera model", file=path) from error
        except UserError as error:
            raise UserError(error.what, file=path) from error
        except (
            OSError,
            SyntaxError,
            ValueError,
            TypeError,
            KeyError,
            AttributeError,
            OverflowError,
            MemoryError,  # the parser's word for brackets nested too deep
            RecursionError,
        ) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(f"not a readable camera model ({reason})", file=path) from error

    def text(self) -> str:
        """The ``.cameramodel`` text: mrcal reads it whenever the lens is one of mrcal's."""
        camera_from_world = self.world_from_camera.inverse()
        rt = [*camera_from_world.rotation_vector(), *camera_from_world.translation]
        if self.model == "pinhole":
            name = "LENSMODEL_PINHOLE"
        elif self.model.startswith("LENSMODEL_"):
            name = self.model
        else:
            name = f"CHROMEBALL_{self.model.upper()}"
        lines = [
            f"    'lensmodel':  '{name}',",
            f"    'intrinsics': [ {', '.join(repr(float(v)) for v in self.intrinsics)} ],",
            f"    'rt_cam_ref': [ {', '.join(repr(float(v)) for v in rt)} ],",
            f"    'imagersize': [ {self.size[0]}, {self.size[1]} ],",
        ]
        if self.model in (*FISHEYE_MODELS, "kb4_decentred"):
            lines.append(f"    'max_angle':  {self.max_angle!r},")
        return "{\n" + "\n".join(lines) + "\n" + self.text_of_knowledge() + "}\n"

    def text_of_knowledge(self) -> str:
        """The lines of ``.cameramodel`` that say how well the lens is known, if it is known."""
        known = {
            "intrinsics_covariance": self.covariance,
            "valid_intrinsics_region": self.region,
        }
        lines = [
            f"    '{name}': [{', '.join(_numbers(row) for row in rows)}],\n"
            for name, rows in known.items()
            if rows is not None
        ]
        return "".join(lines)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the ``.cameramodel``, whole or not at all."""
        write_text(path, self.text())

    # ---- formulas

    def _fisheye_parameters(self) -> tuple[float, float, float, float, NDArray[np.float64]]:
        if self.model.startswith("kb4"):
            fx, fy, cx, cy = self.intrinsics[:4]
            return fx, fy, cx, cy, self.intrinsics[4:8]
        f, cx, cy = self.intrinsics
        return f, f, cx, cy, np.zeros(0)

    def _radius(
        self, theta: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance from the principal point over f, and its derivative."""
        if self.model.startswith("kb4"):
            k = self.intrinsics[4:8]
            powers = np.stack([theta ** (2 * i + 1) for i in range(5)], axis=-1)
            slopes = np.stack([(2 * i + 1) * theta ** (2 * i) for i in range(5)], axis=-1)
            coefficients = np.concatenate([[1.0], k])
            return powers @ coefficients, slopes @ coefficients
        radius, _, slope, _ = _FISHEYE[self.model]
        return radius(theta), slope(theta)

    def _angle(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of `_radius`; NaN where the lens has no such radius."""
        if not self.model.startswith("kb4"):
            limit = _FISHEYE[self.model][3]
            rim = _FISHEYE[self.model][0](np.float64(min(limit, math.pi)))
            return np.where(r <= rim, _FISHEYE[self.model][1](r), np.nan)
        # Newton from a table of the monotone part, so that it converges everywhere on it.
        table = np.linspace(0, self.max_angle, 1024)
        radii, slopes = self._radius(table)
        rising = np.cumprod(slopes > 0).astype(bool)
        table, radii = table[rising], radii[rising]
        theta = np.interp(r, radii, table, right=np.nan)
        for _ in range(4):
            radius, slope = self._radius(theta)
            theta = theta - (radius - r) / slope
        return theta

    def _angle_along(
        self, plane: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angle (N,) and unit direction in the picture (N, 2) of places (N, 2) over f."""
        r = np.hypot(plane[:, 0], plane[:, 1])
        return self._angle(r), plane / np.where(r > 0, r, 1)[:, None]

    def _decentring(
        self, uv: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What p1 and p2 add at angle times direction (N, 2), and its derivative (N, 2, 2)."""
        p1, p2 = self.intrinsics[8:]
        u, v = uv[:, 0], uv[:, 1]
        add = np.stack(
            [
                2 * p1 * u * v + p2 * (3 * u * u + v * v),
                2 * p2 * u * v + p1 * (u * u + 3 * v * v),
            ],
            axis=-1,
        )
        across = 2 * (p1 * u + p2 * v)
        rows = [6 * p2 * u + 2 * p1 * v, across, across, 2 * p2 * u + 6 * p1 * v]
        return add, np.stack(rows, axis=-1).reshape(-1, 2, 2)

    def _project_fisheye(
        self, p: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        fx, fy, cx, cy, _ = self._fisheye_parameters()
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        rho = np.hypot(x, y)
        norm2 = rho**2 + z**2
        theta = np.arctan2(rho, z)
        r, slope = self._radius(theta)
        on_axis = rho == 0
        safe = np.where(on_axis, 1.0, rho)
        ux, uy = np.where(on_axis, 1.0, x / safe), np.where(on_axis, 0.0, y / safe)
        # r / rho tends to slope / z on the axis.
        tangential = np.where(on_axis, slope / np.where(z == 0, np.nan, z), r / safe)
        radial = slope * z / norm2
        q = np.stack([fx * tangential * x + cx, fy * tangential * y + cy], axis=-1)
        # d(r u)/dp = slope u dtheta/dp + (r / rho) (dp_xy - u u' dp_xy)
        dx = np.stack(
            [
                radial * ux * ux + tangential * uy * uy,
                (radial - tangential) * ux * uy,
                -slope * rho / norm2 * ux,
            ],
            axis=-1,
        )
        dy = np.stack(
            [
                (radial - tangential) * ux * uy,
                radial * uy * uy + tangential * ux * ux,
                -slope * rho / norm2 * uy,
            ],
            axis=-1,
        )
        jacobian = np.stack([dx, dy], axis=-2)
        if self.model == "kb4_decentred":
            # u = theta x / rho: an equidistant lens in place of r(theta).
            flat = np.where(on_axis, 1 / np.where(z == 0, np.nan, z), theta / safe)
            add, slopes = self._decentring(flat[:, None] * p[:, :2])
            along = np.stack([ux, uy], axis=-1)
            outer = along[:, :, None] * along[:, None, :]
            by_xy = (z / norm2)[:, None, None] * outer + flat[:, None, None] * (
                np.eye(2) - outer
            )
            by_z = -(rho / norm2)[:, None] * along
            by = np.concatenate([by_xy, by_z[:, :, None]], axis=-1)
            q = q + [fx, fy] * add
            jacobian = jacobian + slopes @ by
        jacobian = np.array([fx, fy])[:, None] * jacobian
        unseen = ~(theta <= self.max_angle * (1 + 1e-9)) | (norm2 == 0)
        q[unseen], jacobian[unseen] = np.nan, np.nan
        return q, jacobian

    def _project_latlong(
        self, p: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        width, height = self.size
        rho2 = x**2 + z**2
        rho, norm2 = np.sqrt(rho2), rho2 + y**2
        q = np.stack(
            [
                (np.arctan2(x, z) / (2 * math.pi) + 0.5) * width - 0.5,
                (np.arctan2(y, rho) / math.pi + 0.5) * height - 0.5,
            ],
            axis=-1,
        )
        zero = np.zeros_like(x)
        du = np.stack([z / rho2, zero, -x / rho2], axis=-1) * (width / (2 * math.pi))
        dv = np.stack([-x * y / rho, rho, -z * y / rho], axis=-1)
        dv = dv / norm2[..., None] * (height / math.pi)
        q[norm2 == 0] = np.nan
        return q, np.stack([du, dv], axis=-2)

    def _unproject_cube(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        q = (pixels + 0.5) / (self.size[0] // 4)
        d = np.full((*q.shape[:-1], 3), np.nan)
        for forward, right, down, (column, row, _) in CUBE_FACES:
            a, b = 2 * (q[..., 0] - column) - 1, 2 * (q[..., 1] - row) - 1
            here = (np.abs(a) <= 1) & (np.abs(b) <= 1)  # edges are common to two faces
            v = np.array(forward) + a[here, None] * np.array(right)
            v = v + b[here, None] * np.array(down)
            d[here] = v / np.linalg.norm(v, axis=-1, keepdims=True)
        return d

    def _project_cube(
        self, p: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        n = self.size[0] // 4
        q, jacobian = np.full((len(p), 2), np.nan), np.full((len(p), 2, 3), np.nan)
        best = np.zeros(len(p))
        for forward, right, down, (column, row, _) in CUBE_FACES:
            w = p @ np.array(forward, float)
            here = w > best
            best = np.where(here, w, best)
            for axis, (side, first) in enumerate(((right, column), (down, row))):
                a = (p @ np.array(side, float)) / w
                slope = (np.array(side) - a[:, None] * np.array(forward)) / w[:, None]
                q[here, axis] = ((first + (a + 1) / 2) * n - 0.5)[here]
                jacobian[here, axis] = (slope * n / 2)[here]
        return q, jacobian


def _numbers(row: NDArray[np.floating[Any]]) -> str:
    return "[" + ", ".join(f"{float(v):.9g}" for v in row) + "]"


def _knowledge(value: dict[str, Any], name: str, columns: int) -> NDArray[np.float64] | None:
    """A table of numbers (N, columns) of a .cameramodel; None where it has none."""
    if value.get(name) is None or not len(value[name]):
        return None
    table = np.array(value[name], float)
    if table.ndim != 2 or table.shape[1] != columns or not np.isfinite(table).all():
        raise UserError(f"{name} is no table of {columns} columns")
    return table


def sees_behind(lensmodel: str) -> bool:
    """Whether one of mrcal's lens models is defined beyond 90 degrees."""
    return lensmodel.startswith(
        ("LENSMODEL_STEREOGRAPHIC", "LENSMODEL_LATLON", "LENSMODEL_LONLAT", "LENSMODEL_SPLINED")
    )
