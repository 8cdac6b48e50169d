"""What was seen of moving lights, and the cameras that follow from it with their errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.wand_lens import lens_names
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

#: Smaller delays, in frames, are those of cameras that run in step.
IN_STEP = 0.01


@dataclass(frozen=True)
class Tracks:
    """What C cameras saw in F frames of a wand with K lights, in order along the wand.

    ``names`` and ``sizes`` (width, height) of the cameras; ``pixels`` (C, F, K, 2), NaN where
    not all lights of the wand were seen; ``errors`` (C, F, K), standard errors of a coordinate
    in pixels, or all one. Which end of the wand comes first is free in every picture.
    """

    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    pixels: NDArray[np.float64]
    errors: NDArray[np.float64]

    def seen(self) -> NDArray[np.bool_]:
        """Where a camera saw the whole wand, (C, F)."""
        return np.isfinite(self.pixels).all(axis=(2, 3))


@dataclass(frozen=True)
class WandRig:
    """The cameras in the frame of `reference`, and how well all that is known.

    ``cameras`` posed, ``world_from_camera``; ``unit`` is metres or what else the scale is in.
    ``points`` (F, K, 3), NaN where a light was not found by two cameras; ``residuals``
    (C, F, K, 2) projected minus observed, NaN where not used. ``outliers`` (C, F, K). ``rms``
    per light over inliers, ``sigma`` the deviation of a coordinate, pixels. ``covariance``
    (C, 6, 6) of each camera's turn about its own axes and its position, relative to the
    reference camera, whose pose and, where no wand gave the scale, whose distance to the
    ``baseline`` camera count as exact. ``lens_errors`` (k,) for each camera, zero where given.
    ``delays`` (C,) and ``delay_errors``, frames; zero where the cameras are synchronous.
    """

    names: tuple[str, ...]
    cameras: tuple[CameraModel, ...]
    unit: str
    points: NDArray[np.float64]
    observed: NDArray[np.float64]
    residuals: NDArray[np.float64]
    outliers: NDArray[np.bool_]
    rms: float
    sigma: float
    covariance: NDArray[np.float64]
    lens_errors: tuple[NDArray[np.float64], ...]
    delays: NDArray[np.float64]
    delay_errors: NDArray[np.float64]
    condition: float
    reference: int
    baseline: int | None

    @property
    def centres(self) -> NDArray[np.float64]:
        """Where the cameras stand, (C, 3)."""
        return np.array([c.world_from_camera.translation for c in self.cameras])

    @property
    def sigma_rotation(self) -> NDArray[np.float64]:
        """Standard errors of turns about the cameras' axes, radians, (C, 3)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, :3])

    @property
    def sigma_position(self) -> NDArray[np.float64]:
        """Standard errors of positions along the rig's axes, (C, 3)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, 3:])

    @property
    def synchronous(self) -> bool:
        """The cameras run in step."""
        return bool(np.abs(self.delays).max() < IN_STEP)

    def camera_rms(self) -> NDArray[np.float64]:
        """RMS per light of each camera over its inliers, (C,)."""
        return np.sqrt(np.nanmean((self.residuals**2).sum(axis=-1), axis=(1, 2)))

    def moved(self, world_from_rig: Pose, factor: float = 1.0, unit: str = "m") -> WandRig:
        """In other axes, made `factor` times as large first; covariances go with it."""
        cameras = tuple(
            c.posed(
                world_from_rig
                @ Pose(c.world_from_camera.rotation, c.world_from_camera.translation * factor)
            )
            for c in self.cameras
        )
        change = np.eye(6)
        change[3:, 3:] = factor * world_from_rig.rotation
        return replace(
            self,
            cameras=cameras,
            unit=unit,
            points=world_from_rig.apply(self.points * factor),
            covariance=change @ self.covariance @ change.T,
        )

    def figures(self) -> dict[str, Any]:
        """Figures of quality for the record."""
        rms = self.camera_rms()
        used = np.isfinite(self.residuals[..., 0])
        return {
            "rms": self.rms,
            "sigma": self.sigma,
            "unit": self.unit,
            "lights": int(np.isfinite(self.points[..., 0]).sum()),
            "sightings": int(used.sum()),
            "outliers": int(self.outliers.sum()),
            "condition": self.condition,
            "gauge": self.gauge(),
            "synchronous": self.synchronous,
            "cameras": {
                name: {
                    "position": camera.world_from_camera.translation,
                    "sigma_position": self.sigma_position[c],
                    "sigma_rotation_degrees": np.degrees(self.sigma_rotation[c]),
                    "rms": rms[c],
                    "sightings": int(used[c].sum()),
                    "outliers": int(self.outliers[c].sum()),
                    "delay_frames": self.delays[c],
                    "delay_error_frames": self.delay_errors[c],
                    "intrinsics": dict(zip(lens_names(camera), camera.intrinsics, strict=True)),
                    "standard_errors": dict(
                        zip(lens_names(camera), self.lens_errors[c], strict=True)
                    ),
                }
                for c, (name, camera) in enumerate(zip(self.names, self.cameras, strict=True))
            },
        }

    def gauge(self) -> str:
        """What the standard errors are relative to."""
        first = f"the pose of {self.names[self.reference]} counts as exact"
        if self.baseline is None:
            return first
        return f"{first}, and so does its distance to {self.names[self.baseline]}"
