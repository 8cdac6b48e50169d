"""A calibrated lens with all that tells how good it is, whichever solver found it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.uncertainty import projection_covariance, worst_direction
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose
from chromeball.scene.record import write_text

#: Boards must differ by this angle somewhere, else they do not determine a focal length.
LEAST_TILT = math.radians(5)
PARALLEL = (
    "the board is parallel to itself in all pictures, which leaves the focal length "
    "open: tilt it by 20 to 45 degrees in different directions"
)
#: Relative standard error of the focal length beyond which a calibration is no calibration.
WORST_FOCAL = 0.05
OPENCV_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class Lens:
    """A calibrated lens with all that tells how good it is.

    V views of a board of R x C corners; pixels throughout, NaN where there is no corner.
    ``observed`` (V, R, C, 2) and ``residuals`` (V, R, C, 2) projected minus observed, NaN for
    outliers; ``outliers`` (V, R, C). ``rms`` per point over inliers; ``sigma`` the estimated
    standard deviation of one coordinate of a corner, freed from the fitted unknowns.
    ``covariance`` (k, k) of the intrinsics. ``bow`` (2,) the board's deflection, metres along x
    and y; ``pupil`` (2,) the travel of the entrance pupil, metres, zeros where it stands
    (:class:`chromeball.calibrate.adjust.Estimate`). ``camera_from_board`` (V, 6), rotation
    vector and translation; NaN for a view that was misread. ``condition`` of the normal
    equations; ``solution``, mrcal's camera model with its optimisation inputs where mrcal found
    it.
    """

    camera: CameraModel
    observed: NDArray[np.float64]
    residuals: NDArray[np.float64]
    outliers: NDArray[np.bool_]
    rms: float
    sigma: float
    covariance: NDArray[np.float64]
    bow: NDArray[np.float64]
    pupil: NDArray[np.float64]
    camera_from_board: NDArray[np.float64]
    condition: float
    solution: Any = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intrinsics."""
        model, count = self.camera.model, len(self.camera.intrinsics)
        if model.startswith("kb4"):
            return ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")[:count]
        if model.startswith("LENSMODEL_SPLINED"):
            return (*OPENCV_NAMES[:4], *(f"s{i}" for i in range(count - 4)))
        if model.startswith("LENSMODEL_CAHVORE"):
            return (*OPENCV_NAMES[:4], "alpha", "beta", "r0", "r1", "r2", "e0", "e1", "e2")
        return OPENCV_NAMES[:count] if count > 3 else ("f", "cx", "cy")

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the ``.cameramodel``, with what mrcal's solution was made of."""
        known = replace(
            self.camera, covariance=self.covariance, region=outline(self._used_corners())
        )
        if self.solution is None:
            known.write(path)
            return
        self.solution.write(os.fspath(path), note=f"RMS {self.rms:.4f} px per point")
        text = Path(path).read_text()
        write_text(path, text[: text.rindex("}")] + known.text_of_knowledge() + "}\n")

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """Of the intrinsics, (k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def view_rms(self) -> NDArray[np.float64]:
        """RMS per point of each view over its inliers, (V,)."""
        square = (self.residuals**2).sum(axis=-1)
        return np.sqrt([np.nanmean(s) if np.isfinite(s).any() else np.nan for s in square])

    def field_of_view(self) -> tuple[float, float]:
        """2 atan(w / 2 f) across and down, radians (seeds A1): what an undistorted picture of
        this size and focal length shows.
        """  # noqa: D205
        (width, height), (fx, fy) = self.camera.size, self._core()[:2]
        return 2 * math.atan(width / (2 * fx)), 2 * math.atan(height / (2 * fy))

    def true_field_of_view(self) -> tuple[float, float]:
        """Angle between the rays through the middles of opposite edges, across and down,
        radians; distortion included. NaN where the model does not reach the edge.
        """  # noqa: D205
        (width, height), (cx, cy) = self.camera.size, self._core()[2:]
        ends = np.array([[[-0.5, cy], [width - 0.5, cy]], [[cx, -0.5], [cx, height - 0.5]]])
        rays = self._rays(ends)
        # Each half to the axis, so that more than 180 degrees come out right.
        halves = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        across, down = halves.sum(axis=1)
        return float(across), float(down)

    def coverage(self) -> float:
        """Share of the picture inside the convex hull of all corners."""
        import cv2

        return float(cv2.contourArea(self.hull()) / (self.camera.size[0] * self.camera.size[1]))

    def hull(self) -> NDArray[np.float32]:
        """Convex hull of the corners that were used, (N, 2), pixels."""
        return outline(self._used_corners())[:-1]

    def tilt(self) -> float:
        """Largest angle between two boards, radians."""
        return largest_tilt(self.camera_from_board)

    def uncertainty(self, columns: int = 30) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Standard deviation of projection in the worst direction over the picture, pixels.

        Returns pixels (h, `columns`, 2) over the picture and values (h, `columns`), NaN where
        the model does not reach. It is :meth:`projection_covariance`'s larger axis.
        """
        width, height = self.camera.size
        rows = max(2, round(columns * height / width))
        x, y = np.meshgrid(np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows))
        pixels = np.stack([x, y], axis=-1)
        return pixels, worst_direction(self.projection_covariance(self._rays(pixels)))

    def projection_covariance(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance (..., 2, 2) of where points at infinity along unit `rays` are seen, px^2.

        See :func:`chromeball.calibrate.uncertainty.projection_covariance`.
        """
        support = self._rays(self._used_corners())
        return projection_covariance(self.camera, self.covariance, support, rays)

    def figures(self) -> dict[str, Any]:
        """Figures of quality for the record."""
        pixels, uncertainty = self.uncertainty()
        hull = self.hull()
        import cv2

        inside = np.array(
            [
                cv2.pointPolygonTest(hull, (x, y), False) >= 0
                for x, y in pixels.reshape(-1, 2).tolist()
            ]
        ).reshape(uncertainty.shape)
        return {
            "rms": self.rms,
            "sigma": self.sigma,
            "condition": self.condition,
            "corners": int(np.isfinite(self.observed[..., 0]).sum()),
            "outliers": int(self.outliers.sum()),
            "intrinsics": dict(zip(self.names, self.camera.intrinsics, strict=True)),
            "standard_errors": dict(zip(self.names, self.standard_errors, strict=True)),
            "bow_metres": self.bow,
            "pupil_metres": self.pupil,
            "fov_degrees": np.degrees(self.field_of_view()),
            "true_fov_degrees": np.degrees(self.true_field_of_view()),
            "coverage": self.coverage(),
            "tilt_degrees": math.degrees(self.tilt()),
            "uncertainty_median": _finite(np.nanmedian, uncertainty),
            "uncertainty_covered": _finite(np.nanmax, uncertainty[inside]),
            "uncertainty_unreached": float(np.isnan(uncertainty).mean()),
        }

    def _core(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point."""
        k = self.camera.intrinsics
        fx, fy, cx, cy = k[:4] if len(k) > 3 else k[[0, 0, 1, 2]]
        return float(fx), float(fy), float(cx), float(cy)

    def _used_corners(self) -> NDArray[np.float64]:
        return self.observed[np.isfinite(self.residuals[..., 0])]

    def _rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit rays, NaN where they do not project back: there the lens model folds."""
        rays = self.camera.unproject(pixels)
        with np.errstate(invalid="ignore"):
            miss = np.linalg.norm(self.camera.project(rays) - pixels, axis=-1)
            rays[~(miss < 0.1)] = np.nan
        return rays


def outline(corners: NDArray[np.float64]) -> NDArray[np.float32]:
    """Convex hull of `corners` (N, 2), closed: its first point comes last again, (M, 2)."""
    import cv2

    hull = np.asarray(cv2.convexHull(corners.astype(np.float32)), np.float32).reshape(-1, 2)
    return np.concatenate([hull, hull[:1]])


def largest_tilt(camera_from_board: NDArray[np.float64]) -> float:
    """Largest angle between two of the boards (V, 6), radians; NaN rows are left out."""
    seen = camera_from_board[np.isfinite(camera_from_board).all(axis=-1)]
    normals = np.array([Pose.from_rotation_vector(r[:3], r[3:]).rotation[:, 2] for r in seen])
    return float(np.arccos(np.clip(normals @ normals.T, -1, 1)).max())


def _finite(
    statistic: Callable[[NDArray[np.float64]], Any], values: NDArray[np.float64]
) -> float:
    return float(statistic(values)) if np.isfinite(values).any() else math.nan


def check_focal(
    intrinsics: NDArray[np.float64], errors: NDArray[np.float64], focals: int
) -> None:
    """Refuse intrinsics whose first `focals`, the focal lengths, are left open."""
    focal = float(np.max(errors[:focals] / np.abs(intrinsics[:focals])))
    if not focal < WORST_FOCAL or intrinsics[:focals].min() <= 0:
        raise UserError(
            f"these pictures leave the focal length open (standard error {focal:.0%}): tilt "
            "the board by 20 to 45 degrees in different directions and fill the picture with it"
        )


def check_count(corners: NDArray[np.float64], model: str, intrinsics: int) -> None:
    """Refuse `corners` (V, rows, columns, 2) that are too few for so many `intrinsics`."""
    unknowns = intrinsics + 6 * len(corners) + 2
    measured = int(np.isfinite(corners[..., 0]).sum())
    if measured < unknowns:
        raise UserError(
            f"{measured} corners are too few for {model} with {unknowns} unknowns: "
            "take more pictures or choose a simpler model"
        )
