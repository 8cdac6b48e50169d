"""Cameras and lights from above, and what is left of the error, as PNG."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.figure import Figure

from chromeball.calibrate.wand_result import WandRig


def plot_wand(rig: WandRig, path: str | os.PathLike[str]) -> None:
    """Cameras with their fields of view and lights from above, and residuals by camera.

    The axes are the rig's own, in which its positions are printed.
    """
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    plan, errors = figure.subplots(1, 2)
    points = rig.points[np.isfinite(rig.points).all(axis=-1)]
    everything = np.concatenate([rig.centres, points])
    right, away, flipped = _plan_axes(rig)
    flat = points[:, [right, away]]
    plan.plot(*flat.T, ".", ms=1.5, color="0.6", label=f"{len(points)} lights")
    size = float(np.ptp(everything, axis=0).max()) / 12
    for name, camera in zip(rig.names, rig.cameras, strict=True):
        pose = camera.world_from_camera
        x, y = pose.translation[[right, away]]
        dx, dy = pose.rotation[[right, away], 2]
        plan.plot([x], [y], "o", ms=6)
        plan.annotate(
            "", (x + size * dx, y + size * dy), (x, y), arrowprops={"arrowstyle": "->"}
        )
        plan.annotate(
            name, (x, y), xytext=(0, 7), textcoords="offset points", ha="center", fontsize=8
        )
    unit = "m" if rig.unit == "m" else f"in the {rig.unit}"
    plan.set(
        aspect="equal", title="From above",
        xlabel=f"{'xyz'[right]}, {unit}", ylabel=f"{'xyz'[away]}, {unit}",
    )  # fmt: skip
    if flipped:
        plan.invert_yaxis()
    plan.margins(0.15)
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


def _plan_axes(rig: WandRig) -> tuple[int, int, bool]:
    """The rig's own axes to the right and upward in the plan, and whether the latter runs down.

    The plan leaves out the axis nearest to the cameras' mean up, and is seen from above.
    """
    up = -np.mean([c.world_from_camera.rotation[:, 1] for c in rig.cameras], axis=0)
    left_out = int(np.argmax(np.abs(up)))
    right, away = (axis for axis in range(3) if axis != left_out)
    toward_us = np.cross(np.eye(3)[right], np.eye(3)[away])[left_out]
    return right, away, bool(toward_us * up[left_out] < 0)
