"""A rig as it was solved: its cameras, and how well all of it is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.rig_sync import Sync
from chromeball.scene.camera import CameraModel


@dataclass(frozen=True)
class RigSolution:
    """C cameras before F instants of a board of R x K corners, and how well they are known.

    ``cameras`` are posed, world_from_camera = rig_from_camera, the first at the origin.
    ``covariance`` (6C, 6C): for each camera the turn about its own axes (radians) and its
    position on the rig (metres), zero for the first. ``lens_covariance`` (k, k) of each lens,
    zero for one that was given. ``observed`` (C, F, R, K, 2) and ``residuals``, projected minus
    observed, NaN for outliers. ``sigma`` and ``alone`` (C,): deviation of a coordinate of a
    corner here and in each camera by itself. ``rig_from_board`` (F, 4, 4), NaN where unknown.
    ``turned`` (C, F): boards that were read from another end than their instant's.
    ``repeated`` instants that show what an earlier one shows, and count for nothing.
    ``condition`` of the reduced normal equations. ``sync`` where the cameras did not look at
    once and the times are known.
    """

    names: tuple[str, ...]
    cameras: tuple[CameraModel, ...]
    covariance: NDArray[np.float64]
    lens_covariance: tuple[NDArray[np.float64], ...]
    bow: NDArray[np.float64]
    observed: NDArray[np.float64]
    residuals: NDArray[np.float64]
    sigma: NDArray[np.float64]
    alone: NDArray[np.float64]
    rig_from_board: NDArray[np.float64]
    turned: NDArray[np.bool_]
    repeated: tuple[int, ...]
    condition: float
    sync: Sync | None

    @property
    def outliers(self) -> NDArray[np.bool_]:
        """Corners that do not fit, (C, F, R, K)."""
        return np.isfinite(self.observed[..., 0]) & np.isnan(self.residuals[..., 0])

    @property
    def rms(self) -> NDArray[np.float64]:
        """RMS per corner of each camera over its inliers, pixels, (C,)."""
        square = (self.residuals**2).sum(axis=-1)
        return np.sqrt(np.nanmean(square.reshape(len(square), -1), axis=1))

    @property
    def disagreement(self) -> float:
        """How many times less exact the cameras are together than alone."""
        return float(np.median(self.sigma / self.alone))

    @property
    def common(self) -> NDArray[np.intp]:
        """Instants that two cameras share, (C, C)."""
        seen = np.isfinite(self.residuals[..., 0]).any(axis=(2, 3)).astype(np.intp)
        return seen @ seen.T

    @property
    def position_errors(self) -> NDArray[np.float64]:
        """Standard errors of the cameras' positions on the rig, metres, (C, 3)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 6)[:, 3:]

    @property
    def turn_errors(self) -> NDArray[np.float64]:
        """Standard errors of the cameras' turns about their own axes, radians, (C, 3)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 6)[:, :3]

    def misread(self) -> list[tuple[int, int]]:
        """Camera and instant of views of which no corner fits."""
        found = np.isfinite(self.observed[..., 0]).any(axis=(2, 3))
        fits = np.isfinite(self.residuals[..., 0]).any(axis=(2, 3))
        return [(int(c), int(v)) for c, v in np.argwhere(found & ~fits)]
