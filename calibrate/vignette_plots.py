"""Pictures of a measured fall-off for the report, as PNG."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from chromeball.scene.vignette import Vignette


def plot_vignette(
    vignette: Vignette,
    path: str | os.PathLike[str],
    pixels: NDArray[np.float64] | None = None,
    residuals: NDArray[np.float64] | None = None,
) -> None:
    """Fall-off by radius with its errors, and over the picture with what measured it.

    `pixels` (N, 2) of the samples and their `residuals` (N,) of ln radiance, NaN for outliers.
    """
    width, height = vignette.size
    figure = Figure(figsize=(11, 4.3), layout="constrained")
    curve, field = figure.subplots(1, 2)
    x, y = np.meshgrid(np.linspace(0, width - 1, 161), np.linspace(0, height - 1, 121))
    q = np.stack([x, y], axis=-1)
    V, sigma = vignette.at(q), vignette.sigma_at(q)
    r = np.linalg.norm(q - vignette.centre, axis=-1) / vignette.radius
    bins = np.linspace(0, float(r.max()), 41)
    number = np.clip(np.digitize(r, bins) - 1, 0, 39).ravel()
    count = np.maximum(np.bincount(number, minlength=40), 1)
    mean, error = (np.bincount(number, v.ravel(), minlength=40) / count for v in (V, V * sigma))
    middle = (bins[1:] + bins[:-1]) / 2
    if pixels is not None and residuals is not None:
        good = np.isfinite(residuals)
        far = np.linalg.norm(pixels - vignette.centre, axis=1) / vignette.radius
        seen = vignette.at(pixels) * np.exp(np.nan_to_num(residuals))
        curve.plot(
            far[good], seen[good], ".", ms=2, color="0.6", alpha=0.5, label="measured",
            rasterized=True,
        )  # fmt: skip
        field.plot(*pixels[good].T, ".", ms=1.5, color="white", alpha=0.5)
        field.plot(*pixels[~good].T, "x", ms=4, color="crimson")
    curve.fill_between(
        middle, mean - 2 * error, mean + 2 * error, alpha=0.35, color="tab:blue", lw=0,
        label="two standard errors",
    )  # fmt: skip
    curve.plot(middle, mean, color="tab:blue", label="mean over the circle")
    curve.axvline(vignette.covered, ls="--", lw=1, color="black", label="measured up to here")
    curve.set(xlabel="radius", ylabel="fall-off", xlim=(0, bins[-1]))
    curve.set_ylim(max(0.0, float(np.nanmin(mean)) - 0.12), float(mean.max()) + 0.05)
    curve.grid(alpha=0.3)
    curve.legend(fontsize=8, loc="lower left")
    filled = field.contourf(x, y, V, levels=20, cmap="viridis")
    figure.colorbar(filled, ax=field, label="fall-off", shrink=0.85)
    for radius, centre, style in (
        (vignette.covered * vignette.radius, vignette.centre, "--"),
        *([] if vignette.edge is None else [(vignette.edge.radius, vignette.edge.centre, "-")]),
    ):
        field.add_patch(Circle(centre, radius, fill=False, ls=style, color="black"))
    field.plot(*vignette.centre, "+", color="black", ms=9)
    field.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    figure.savefig(path, dpi=110, format="png")
