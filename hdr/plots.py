"""Plots: a response with its band, D log E, residuals, comparagrams; a map's histogram."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.comparagram import pair
from chromeball.hdr.knots import coordinate
from chromeball.hdr.preview import Glance
from chromeball.hdr.response import BRIGHT_ENOUGH, UNCHANGING, Sample, Solution
from chromeball.hdr.response_file import Response

type Float = NDArray[np.float64]

HIGH, LOW = (0.85, 0.2, 0.15), (0.2, 0.35, 0.85)
COLORS = {"R": "#c0392b", "G": "#27853d", "B": "#2c5fa8"}


def plot_response(response: Response, path: str | os.PathLike[str]) -> None:
    """Draw the curve and its band, D log E, standard errors and residuals per exposure, PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.5), layout="constrained")
    ((curve, density), (error, frames)) = figure.subplots(2, 2)
    z = np.arange(response.codes)
    for name, g, sigma in zip(
        response.channels, response.log_exposure, response.sigma, strict=True
    ):
        color = COLORS.get(name, "#444444")
        curve.plot(z, g, color=color, lw=1.5, label=name)
        curve.fill_between(z, g - 2 * sigma, g + 2 * sigma, color=color, alpha=0.2, lw=0)
        density.plot(g / np.log(2), z / (response.codes - 1), color=color, lw=1.5)
        density.fill_betweenx(
            z / (response.codes - 1),
            (g - 2 * sigma) / np.log(2),
            (g + 2 * sigma) / np.log(2),
            color=color,
            alpha=0.2,
            lw=0,
        )
        shown = sigma > 0
        error.semilogy(z[shown], sigma[shown], color=color, lw=1.2)
    curve.set(xlabel="code", ylabel="ln exposure", title="response, ± 2 standard errors")
    density.set(
        xlabel="log2 exposure (stops from the middle code)",
        ylabel="code, share of white",
        title="D log E",
    )
    error.set(xlabel="code", ylabel="standard error of ln exposure", title="standard error")
    low, high = response.log_exposure.min(), response.log_exposure.max()
    curve.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    density.set_xlim(max(low, -9) / np.log(2) - 0.3, high / np.log(2) + 0.3)
    for axes in (curve, error):
        axes.set_xlim(0, response.codes - 1)
    curve.legend(frameon=False)
    _per_exposure(frames, response)
    for axes in (curve, density, error, frames):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110, format="png", metadata={"Software": None})


def _per_exposure(axes: Any, response: Response) -> None:
    """Residual of each exposure, and by how much it was changed, both in stops."""
    rows = response.record.get("frames")
    if not isinstance(rows, list) or not rows:
        axes.set_title("no exposures are recorded with this response")
        return
    rows = sorted(rows, key=lambda row: row["given"])  # pyright: ignore[reportUnknownLambdaType, reportUnknownVariableType, reportUnknownArgumentType]
    at = np.arange(len(rows))  # pyright: ignore[reportUnknownArgumentType]
    stops = 1 / np.log(2)
    residual = [(row["residual"] or np.nan) * stops for row in rows]  # pyright: ignore[reportUnknownVariableType]
    change = [row["change_ev"] for row in rows]  # pyright: ignore[reportUnknownVariableType]
    axes.bar(at, residual, color="#8a8a8a", label="RMS residual")
    axes.plot(at, change, "o", color="#c0392b", ms=4, label="change of the exposure")
    axes.axhline(0, color="#444444", lw=0.8)
    axes.set_xticks(at, [f"{row['given']:.3g}" for row in rows], rotation=60, fontsize=7)  # pyright: ignore[reportUnknownVariableType]
    axes.set(xlabel="exposure as given", ylabel="stops", title="exposures")
    axes.legend(frameon=False, fontsize=8)


def plot_radiance(
    glance: Glance, channels: Sequence[str], path: str | os.PathLike[str]
) -> None:
    """Draw the histogram in stops and where no frame measured, PNG."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    height, width = glance.clipped.shape
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    histogram, clipped = figure.subplots(1, 2)
    used = np.flatnonzero(glance.histogram.sum(axis=0))
    first, last = (int(used[0]), int(used[-1]) + 1) if used.size else (0, 1)
    for name, counts in zip(channels, glance.histogram, strict=True):
        share = 100 * counts[first:last] / max(1, counts.sum())
        edges = glance.edges[first : last + 1]
        histogram.stairs(share, edges, color=COLORS.get(name, "#444444"), lw=1.3, label=name)
    histogram.set(
        xlabel="log2 radiance (stops)",
        ylabel="% of the measured pixels a bin",
        title="histogram",
    )
    histogram.legend(frameon=False)
    histogram.grid(alpha=0.3)
    grey = glance.picture.mean(axis=2, keepdims=True).repeat(3, axis=2) / 255 * 0.8
    grey[glance.clipped == 1] = HIGH
    grey[glance.clipped == -1] = LOW
    clipped.imshow(grey, extent=(0, width, height, 0), interpolation="nearest")
    clipped.set_axis_off()
    clipped.set_title("where no frame measured a channel")
    clipped.legend(
        handles=[
            Patch(color=HIGH, label="saturated in all: lower bound"),
            Patch(color=LOW, label="black in all: upper bound"),
        ],
        loc="lower center",
        bbox_to_anchor=(0.5, -0.14),
        ncols=2,
        frameon=False,
        fontsize=8,
    )
    figure.savefig(path, dpi=110, format="png", metadata={"Software": None})


def plot_comparagrams(
    samples: Sequence[Sample],
    found: Solution,
    paths: Sequence[Path],
    path: str | os.PathLike[str],
    most: int = 6,
) -> None:
    """Joint histograms of neighbouring exposures, green or grey, under the curve found, PNG."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    c = found.g.shape[0] // 2
    pairs: list[tuple[int, int]] = []
    cells: list[Float] = []
    for scene in sorted({s.scene for s in samples}):
        own = [k for k, s in enumerate(samples) if s.scene == scene]
        frames = [np.ascontiguousarray(samples[k].patches[:, c : c + 1]) for k in own]
        among = pair(found.log_exposures[own])
        among = among[:: max(1, -(-len(among) // most))][:most]
        if not among:
            continue
        still = kernel.unchanging(frames, UNCHANGING, BRIGHT_ENOUGH)
        cells += list(kernel.comparagrams(frames, among, still)[:, 0].astype(np.float64))
        pairs += [(own[i], own[j]) for i, j in among]
    chosen = np.linspace(0, len(pairs) - 1, min(most, len(pairs))).astype(int)
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.5 * rows), layout="constrained")
    grid = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    knot = coordinate(found.g.shape[1])
    for axes, k in zip(grid, chosen, strict=False):
        i, j = pairs[k]
        C = cells[k]
        axes.imshow(
            np.where(C >= 0.5, C, np.nan),
            origin="lower",
            cmap="viridis",
            norm=LogNorm(1, max(10.0, float(C.max()))),
            interpolation="nearest",
        )
        step = found.log_exposures[j] - found.log_exposures[i]
        g = found.g[c]
        brighter = np.interp(g + step, g, knot, right=np.nan)
        axes.plot(brighter, knot, color="#e74c3c", lw=1)
        axes.set(
            xlim=(0, 255),
            ylim=(0, 255),
            xlabel=paths[j].name,
            ylabel=paths[i].name,
            title=f"{step / np.log(2):.2f} EV",
        )
    for axes in grid[len(chosen) :]:
        axes.axis("off")
    figure.suptitle("comparagrams, and the response (red)")
    figure.savefig(path, dpi=110, format="png", metadata={"Software": None})
