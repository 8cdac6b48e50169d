"""A mirror ball in a photograph (seeds.md P14b): what each pixel of it reflects.

The camera and the ball's outline give the geometry whole: rays that touch a ball make one
angle with the ray to its middle, whatever the lens. Reflection at the true point of the ball,
seen from the true place, is the finite-distance correction; without a camera the ball is as
far away as `FAR` radii, which is the ideal mirror ball.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

type Array = NDArray[np.float64]

FAR = 1e4
_TABLE = 4096


@dataclass(frozen=True)
class BallCamera:
    """Pixels of a photograph of a mirror ball to the directions reflected there, and back.

    Directions are in the axes of `camera` (x right, y down, z forward), of an environment at
    infinity. ``middle`` (3,) unit, towards the ball; ``distance`` of the ball's middle, in its
    radii. The ball hides a cone of asin(1 / distance) about `middle` behind it. ``corner`` is
    the photograph's pixel that is (0, 0) here, for a picture that was cut out.
    """

    camera: CameraModel
    middle: Array
    distance: float
    corner: tuple[int, int] = (0, 0)

    @property
    def hidden(self) -> float:
        """Half angle of the cone behind the ball that it does not reflect, radians."""
        return math.asin(1 / self.distance)

    def project(self, directions: ArrayLike) -> Array:
        """Reflected directions to pixels, ``(..., 3) -> (..., 2)``; NaN where unseen."""
        w = np.asarray(directions, float)
        w = w / np.linalg.norm(w, axis=-1, keepdims=True)
        along = -(w @ self.middle)
        across = w + along[..., None] * self.middle
        rho = np.linalg.norm(across, axis=-1)
        phi = np.arctan2(rho, along)  # from the direction back to the camera
        seen = phi < math.pi - self.hidden
        beta = self._normal_angle(np.where(seen, phi, 0.0))
        u = across / np.where(rho > 0, rho, 1.0)[..., None]
        normal = -np.cos(beta)[..., None] * self.middle + np.sin(beta)[..., None] * u
        pixels = self.camera.project(self.distance * self.middle + normal)
        pixels[~seen] = np.nan
        return pixels - self.corner

    def outline(self, count: int = 256) -> Array:
        """Points around the ball's outline, (count, 2) pixels."""
        phi = np.linspace(0, 2 * math.pi, count, endpoint=False)[:, None]
        side = np.linalg.svd(self.middle[None])[2][1:]
        reach = math.tan(self.hidden)
        rim = self.middle + reach * (np.cos(phi) * side[0] + np.sin(phi) * side[1])
        return self.camera.project(rim) - self.corner

    def cut_out(self) -> tuple[BallCamera, tuple[slice, slice]]:
        """The same of the picture's part that holds the ball, and that part (rows, columns)."""
        rim = self.outline()
        width, height = self.camera.size
        low = np.clip(np.floor(rim.min(axis=0)) - 1, 0, None).astype(int)
        high = np.minimum(np.ceil(rim.max(axis=0)) + 2, (width, height)).astype(int)
        corner = (self.corner[0] + int(low[0]), self.corner[1] + int(low[1]))
        part = np.s_[int(low[1]) : int(high[1]), int(low[0]) : int(high[0])]
        return replace(self, corner=corner), part

    def unproject(self, pixels: ArrayLike) -> Array:
        """Pixels to reflected unit directions, ``(..., 2) -> (..., 3)``; NaN off the ball."""
        ray = self.camera.unproject(np.asarray(pixels, float) + self.corner)
        ahead = ray @ self.middle
        # distance of the ray from the middle, squared, without cancellation for far balls
        off = ray - ahead[..., None] * self.middle
        miss = self.distance**2 * np.sum(off * off, axis=-1)
        with np.errstate(invalid="ignore"):
            hit = (miss <= 1) & (ahead > 0)
        depth = np.sqrt(np.where(hit, 1 - miss, 0.0))
        # from the middle: to the foot of the perpendicular, then towards the camera
        foot = self.distance * (ahead[..., None] * ray - self.middle)
        normal = foot - depth[..., None] * ray
        reflected = ray - 2 * np.sum(ray * normal, axis=-1, keepdims=True) * normal
        reflected[~hit] = np.nan
        return reflected

    def _normal_angle(self, phi: Array) -> Array:
        """The normal: phi = beta + atan2(D sin beta, D cos beta - 1), the normal's angle."""
        d = self.distance
        grazing = math.acos(1 / d)

        def reflected(beta: Array) -> Array:
            return np.asarray(beta + np.arctan2(d * np.sin(beta), d * np.cos(beta) - 1))

        table = np.linspace(0, grazing, _TABLE)
        beta = np.asarray(np.interp(phi, reflected(table), table))
        for _ in range(2):  # Newton; the table is good to 1e-7
            c, s = np.cos(beta), np.sin(beta)
            slope = 1 + (d * d - d * c) / ((d * c - 1) ** 2 + (d * s) ** 2)
            beta = np.asarray(np.clip(beta - (reflected(beta) - phi) / slope, 0, grazing))
        return beta


def find_ball(camera: CameraModel, rim: ArrayLike) -> BallCamera:
    """The ball whose outline passes through `rim` (N, 2) pixels, N >= 3.

    Rays d to the outline lie on a cone: d . m = cos alpha, with m the ray to the middle and
    sin alpha = 1 / distance. Linear least squares of d . (m / cos alpha) = 1.

    Raises
    ------
    UserError
        When the points are no outline that the camera sees.

    """
    q = np.atleast_2d(np.asarray(rim, float))
    if len(q) < 3:
        raise UserError(f"a ball's outline needs 3 points or more, not {len(q)}")
    d = camera.unproject(q)
    if not np.isfinite(d).all():
        raise UserError("the ball's outline lies outside what the camera sees")
    towards = d.mean(axis=0)
    towards /= np.linalg.norm(towards)
    # d = towards + small: solved in the small part, so that a far ball keeps its digits
    side = np.linalg.svd(towards[None])[2][1:].T
    x = d @ side
    centre = x.mean(axis=0)
    reach = np.linalg.norm(x - centre, axis=1).max()
    if not reach > 1e-9:
        raise UserError("the points of the ball's outline are one point")
    lack = 1 - d @ towards  # 1 - cos, by halves to keep digits
    lack = np.where(lack < 1e-3, np.sum((d - towards) ** 2, axis=1) / 2, lack)
    # (1 - lack) a + x . b = 1 with a = 1 + e:  e + x . b = lack (1 + e)
    system = np.column_stack([1 - lack, x])
    solution, _, rank, _ = np.linalg.lstsq(system, lack, rcond=None)
    if rank < 3:
        raise UserError("the points of the ball's outline lie on one line")
    m = (1 + solution[0]) * towards + side @ solution[1:]
    norm2 = 2 * solution[0] + solution[0] ** 2 + float(solution[1:] @ solution[1:])
    # |m / cos alpha|^2 - 1 = tan^2 alpha
    if not norm2 > 0:
        raise UserError("the points of the ball's outline do not close around a ball")
    alpha = math.atan(math.sqrt(norm2))
    return BallCamera(camera, m / np.linalg.norm(m), 1 / math.sin(alpha))


def ball_in_circle(
    size: tuple[int, int],
    centre: tuple[float, float],
    radius: float,
    camera: CameraModel | None = None,
) -> BallCamera:
    """The ball of a circle of `radius` about `centre`, pixels.

    With a calibrated `camera`, the outline is followed through its lens; without one the
    ball is far away.

    Raises
    ------
    UserError
        When the circle is none, or reaches out of the picture by more than half.

    """
    width, height = size
    if not (math.isfinite(radius) and radius >= 2):
        raise UserError(f"a ball of radius {radius:g} px is too small")
    if not (0 <= centre[0] <= width - 1 and 0 <= centre[1] <= height - 1):
        raise UserError(
            f"the ball's middle ({centre[0]:g}, {centre[1]:g}) lies outside the picture"
        )
    if camera is None:
        f = radius * math.sqrt(FAR**2 - 1)  # f tan alpha = radius
        far = CameraModel("pinhole", np.array([f, f, *centre]), size)
        return BallCamera(far, np.array([0.0, 0.0, 1.0]), FAR)
    phi = np.linspace(0, 2 * math.pi, 64, endpoint=False)
    rim = np.array(centre) + radius * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    return find_ball(camera, rim)
