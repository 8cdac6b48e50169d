"""Pictures of a lens calibration for the report, as PNG."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from chromeball.calibrate.halves import Halves
from chromeball.calibrate.lens_result import Lens
from chromeball.calibrate.next_views import GOOD, slants
from chromeball.calibrate.verdict import Verdict

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


def plot_tilt(lens: Lens, path: str | os.PathLike[str]) -> None:
    """How each board was slanted against the ray to its middle, in degrees."""
    figure = Figure(figsize=(4.6, 4.4), layout="constrained")
    axes = figure.subplots()
    slant = np.degrees(slants(lens))
    reach = max(45.0, float(np.nanmax(np.abs(slant))) * 1.1)
    for ring in (20, 40):
        axes.add_patch(Circle((0, 0), ring, fill=False, ls=":", lw=0.8, color="0.5"))
        axes.annotate(f"{ring}°", (0, ring), fontsize=8, color="0.4")
    colours = mpl.colormaps["turbo"](np.linspace(0.05, 0.95, len(slant)))
    axes.scatter(slant[:, 0], slant[:, 1], s=28, c=colours, edgecolor="black", linewidth=0.4)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set_xlabel("right edge nearer, degrees", fontsize=9)
    axes.set_ylabel("top edge nearer, degrees", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_title("Slant of the boards", fontsize=10)
    _save(figure, path)


def plot_halves(lens: Lens, halves: Halves, path: str | os.PathLike[str]) -> None:
    """Where the lens of the odd views sees otherwise than that of the even ones."""
    figure, axes = _picture(lens)
    size = np.hypot(*np.moveaxis(halves.difference, -1, 0))
    x, y = halves.pixels[..., 0], halves.pixels[..., 1]
    filled = axes.contourf(
        x, y, np.minimum(size, LEVELS[-1]), levels=LEVELS, norm=BoundaryNorm(LEVELS, 256),
        cmap="YlGnBu_r",
    )  # fmt: skip
    bar = figure.colorbar(filled, ax=axes, label="difference, px", shrink=0.8)
    bar.set_ticks([float(v) for v in LEVELS], labels=[f"{v:g}" for v in LEVELS])
    hull = lens.hull()
    axes.plot(*np.vstack([hull, hull[:1]]).T, "--", lw=1, color="black", label="corners seen")
    axes.legend(loc="upper right", fontsize=8)
    axes.set_title(
        f"Lenses of two halves of the views: {halves.excess:.1f} times their noise "
        f"(chance: up to {halves.chance:.1f})"
    )
    _save(figure, path)


def plot_verdict(lens: Lens, verdict: Verdict, path: str | os.PathLike[str]) -> None:
    """The error over the picture, where it is good, and the boards to hold next."""
    figure, axes = _picture(lens)
    x, y = verdict.pixels[..., 0], verdict.pixels[..., 1]
    error = np.minimum(np.nan_to_num(verdict.error, posinf=LEVELS[-1]), LEVELS[-1])
    filled = axes.contourf(
        x, y, error, levels=LEVELS, norm=BoundaryNorm(LEVELS, 256), cmap="YlGnBu_r"
    )
    bar = figure.colorbar(filled, ax=axes, label="error, px", shrink=0.8)
    bar.set_ticks([float(v) for v in LEVELS], labels=[f"{v:g}" for v in LEVELS])
    if error.min() < GOOD < error.max():
        axes.contour(x, y, error, levels=[GOOD], colors="black", linewidths=1.2)
    for number, view in enumerate(verdict.views, 1):
        c = view.corners
        rim = np.stack([c[0, 0], c[0, -1], c[-1, -1], c[-1, 0], c[0, 0]])
        axes.plot(*rim.T, "-", lw=1.4, color="crimson")
        axes.annotate(str(number), tuple(c[0, 0]), color="crimson", fontsize=9)
    todo = ", boards to hold next in red" if verdict.views else ""
    axes.set_title(f"Error over the picture, line at {GOOD} px{todo}")
    _save(figure, path)


def plot_worst(
    lens: Lens, files: Sequence[str], path: str | os.PathLike[str], most: int = 3
) -> None:
    """Pictures of the views that fit worst: residuals as arrows, rejected corners crossed."""
    from chromeball.calibrate.detect import grey
    from chromeball.scene.image import read_image

    # A view that has no pose at all fits worse than any.
    order = np.argsort(-np.nan_to_num(lens.view_rms, nan=np.inf), kind="stable")[:most]
    width, height = lens.camera.size
    high = 0.7 + 3.5 * min(height / width, 1.4)
    figure = Figure(figsize=(3.6 * max(len(order), 2), high), layout="constrained")
    for axes, view in zip(np.atleast_1d(figure.subplots(1, len(order))), order, strict=True):
        picture = grey(read_image(files[int(view)]))
        step = max(1, max(picture.shape) // 900)
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        axes.imshow(picture[::step, ::step], cmap="gray", vmin=0, vmax=255, extent=extent)
        good = np.isfinite(lens.residuals[view][..., 0])
        q, r = lens.observed[view][good], lens.residuals[view][good]
        rms, lost = float(lens.view_rms[view]), int(lens.outliers[view].sum())
        if good.any():
            axes.quiver(
                *q.T, *r.T, angles="xy", scale_units="xy", color="tab:orange", width=0.005,
                scale=max(rms, 1e-9) / (width / 25),
            )  # fmt: skip
        axes.plot(*lens.observed[view][lens.outliers[view]].T, "x", color="crimson", ms=5)
        axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
        fit = f"{rms:.2f} px RMS" if good.any() else "fits no pose"
        axes.set_title(f"{Path(files[int(view)]).name}\n{fit}, {lost} rejected", fontsize=9)
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
