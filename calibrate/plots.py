"""Pictures of a lens calibration for the report, as PNG."""

from __future__ import annotations

import os
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from chromeball.calibrate.lens_result import Lens

#: Levels of the uncertainty map, pixels.
LEVELS = (0, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 100)


def plot_residuals(lens: Lens, path: str | os.PathLike[str]) -> None:
    """Residual of every corner as an arrow, enlarged; rejected corners as crosses."""
    figure, axes = _picture(lens)
    good = np.isfinite(lens.residuals[..., 0])
    q, r = lens.observed[good], lens.residuals[good]
    length = np.hypot(*r.T)
    # The arrow of a typical residual is a fortieth of the picture wide.
    enlarge = lens.camera.size[0] / 40 / max(lens.rms, 1e-9)
    arrows = axes.quiver(
        *q.T, *r.T, length, angles="xy", scale_units="xy", scale=1 / enlarge,
        width=0.002, cmap="viridis", clim=(0, float(np.percentile(length, 98))),
    )  # fmt: skip
    figure.colorbar(arrows, ax=axes, label="residual, px", shrink=0.8)
    axes.plot(
        *lens.observed[lens.outliers].T, "x", color="crimson", ms=5,
        label=f"{lens.outliers.sum()} rejected",
    )  # fmt: skip
    if lens.outliers.any():
        axes.legend(loc="upper right", fontsize=8)
    axes.set_title(f"Residuals x {enlarge:.0f}, RMS {lens.rms:.3f} px per corner")
    _save(figure, path)


def plot_coverage(lens: Lens, path: str | os.PathLike[str]) -> None:
    """Where the corners fell, a colour for each view."""
    figure, axes = _picture(lens)
    colours = mpl.colormaps["turbo"](np.linspace(0.05, 0.95, len(lens.observed)))
    for view, colour in zip(lens.observed, colours, strict=True):
        axes.plot(view[..., 0], view[..., 1], ".", ms=3, color=colour)
        axes.plot(view[..., 0].T, view[..., 1].T, "-", lw=0.4, alpha=0.6, color=colour)
    axes.set_title(f"{len(lens.observed)} views cover {lens.coverage():.0%} of the picture")
    _save(figure, path)


def plot_uncertainty(lens: Lens, path: str | os.PathLike[str]) -> None:
    """Uncertainty of projection at infinity over the picture, with the corners' hull."""
    figure, axes = _picture(lens)
    pixels, values = lens.uncertainty(columns=48)
    norm = BoundaryNorm(LEVELS, 256)
    filled = axes.contourf(
        pixels[..., 0], pixels[..., 1], np.minimum(values, LEVELS[-1]),
        levels=LEVELS, norm=norm, cmap="YlGnBu_r",
    )  # fmt: skip
    bar = figure.colorbar(filled, ax=axes, label="standard deviation, px", shrink=0.8)
    bar.set_ticks([float(v) for v in LEVELS], labels=[f"{v:g}" for v in LEVELS])
    hull = lens.hull()
    axes.plot(*np.vstack([hull, hull[:1]]).T, "--", lw=1, color="black", label="corners seen")
    axes.legend(loc="upper right", fontsize=8)
    axes.set_title("Uncertainty of projection from corner noise")
    _save(figure, path)


def _picture(lens: Lens) -> tuple[Figure, Axes]:
    """Axes in the shape of the camera's picture."""
    width, height = lens.camera.size
    figure = Figure(figsize=(7.2, 0.4 + 6.0 * min(height / width, 1.4)), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.tick_params(labelsize=8)
    axes.set_facecolor("0.97")
    return figure, axes


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    options: dict[str, Any] = {"dpi": 110, "format": "png"}
    figure.savefig(path, **options)
