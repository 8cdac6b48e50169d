"""Cameras and lights from above, and what is left of the error, as PNG."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.figure import Figure

from chromeball.calibrate.wand_result import WandRig


def plot_wand(rig: WandRig, path: str | os.PathLike[str]) -> None:
    """Cameras with their fields of view and lights from above, and residuals by camera.

    Above is the direction in which the cameras spread least.
    """
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    plan, errors = figure.subplots(1, 2)
    points = rig.points[np.isfinite(rig.points).all(axis=-1)]
    everything = np.concatenate([rig.centres, points])
    middle = everything.mean(axis=0)
    across = _level(rig)
    flat = (points - middle) @ across.T
    plan.plot(*flat.T, ".", ms=1.5, color="0.6", label=f"{len(points)} lights")
    size = float(np.ptp(everything, axis=0).max()) / 12
    for name, camera in zip(rig.names, rig.cameras, strict=True):
        pose = camera.world_from_camera
        (x, y), (dx, dy) = (
            (pose.translation - middle) @ across.T,
            across @ pose.rotation[:, 2],
        )
        plan.plot([x], [y], "o", ms=6)
        plan.annotate(
            "", (x + size * dx, y + size * dy), (x, y), arrowprops={"arrowstyle": "->"}
        )
        plan.annotate(name, (x, y), xytext=(6, 6), textcoords="offset points", fontsize=8)
    unit = "m" if rig.unit == "m" else f"unit: {rig.unit}"
    plan.set(aspect="equal", xlabel=unit, title="From above")
    plan.legend(loc="best", fontsize=8)
    for c, name in enumerate(rig.names):
        left = rig.residuals[c].reshape(-1, 2)
        length = np.linalg.norm(left[np.isfinite(left[:, 0])], axis=-1)
        errors.hist(
            length, np.linspace(0, 4.5 * rig.sigma, 46), histtype="step", lw=1.5,
            label=f"{name}: RMS {rig.camera_rms()[c]:.3f} px, {rig.outliers[c].sum()} rejected",
        )  # fmt: skip
    errors.set(xlabel="residual, px", ylabel="sightings", title="What is left of the error")
    errors.legend(loc="best", fontsize=8)
    figure.savefig(path, dpi=110, format="png")


def _level(rig: WandRig) -> np.ndarray:
    """Two directions of the plan, (2, 3): across the mean up of the cameras, image up away."""
    up = -np.mean([c.world_from_camera.rotation[:, 1] for c in rig.cameras], axis=0)
    if np.linalg.norm(up) < 0.2:  # cameras every way up
        up = np.array([0.0, 1, 0])
    up = up / np.linalg.norm(up)
    helper = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[2]
    x = helper - (helper @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x)])
