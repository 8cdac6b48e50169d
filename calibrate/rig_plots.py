"""Pictures of a rig calibration for the report, as PNG."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from chromeball.calibrate.rig_result import RigSolution


def plot_residuals(rig: RigSolution, path: str | os.PathLike[str]) -> None:
    """Residuals of every camera as arrows, enlarged alike; rejected corners as crosses."""
    across = math.ceil(math.sqrt(len(rig.names)))
    down = math.ceil(len(rig.names) / across)
    figure = Figure(figsize=(3.4 * across, 0.4 + 2.8 * down), layout="constrained")
    panels: Any = figure.subplots(down, across, squeeze=False)
    good = np.isfinite(rig.residuals[..., 0])
    length = np.hypot(rig.residuals[..., 0], rig.residuals[..., 1])
    most = float(np.percentile(length[good], 98))
    for c, axes in enumerate(panels.flat):
        if c >= len(rig.names):
            axes.set_axis_off()
            continue
        width, height = rig.cameras[c].size
        q, r = rig.observed[c][good[c]], rig.residuals[c][good[c]]
        enlarge = width / 25 / max(float(np.median(length[good])), 1e-9)
        axes.quiver(
            *q.T, *r.T, length[c][good[c]], angles="xy", scale_units="xy", scale=1 / enlarge,
            width=0.003, cmap="viridis", clim=(0, most),
        )  # fmt: skip
        axes.plot(*rig.observed[c][rig.outliers[c]].T, "x", color="crimson", ms=3)
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
        axes.tick_params(labelsize=7)
        axes.set_title(
            f"{rig.names[c]}: {rig.rms[c]:.3f} px, {int(rig.outliers[c].sum())} rejected",
            fontsize=9,
        )
    figure.colorbar(
        ScalarMappable(Normalize(0, most), "viridis"),
        ax=panels,
        label="residual, px",
        shrink=0.6,
    )
    _save(figure, path)


def plot_layout(rig: RigSolution, path: str | os.PathLike[str]) -> None:
    """The cameras from above and from the side, their positions' errors enlarged."""
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    top, side = figure.subplots(1, 2)
    places = np.array([camera.world_from_camera.translation for camera in rig.cameras])
    known = np.isfinite(rig.rig_from_board[:, 0, 0])
    boards = rig.rig_from_board[known, :3, 3]
    extent = float(np.ptp(np.concatenate([places, boards]), axis=0).max())
    largest = float(rig.position_errors.max())
    # An ellipse of the largest error is a twentieth of the rig.
    enlarge = _round(extent / 20 / max(largest, 1e-12))
    for axes, (i, j), labels in (
        (top, (0, 2), ("x, m (right)", "z, m (forward)")),
        (side, (2, 1), ("z, m (forward)", "y, m (down)")),
    ):
        _draw_layout(axes, rig, places, boards, (i, j), extent / 10, enlarge)
        axes.set(xlabel=labels[0], ylabel=labels[1], aspect="equal")
        axes.margins(0.12)
    side.invert_yaxis()
    top.set_title("from above", fontsize=10)
    side.set_title("from the left", fontsize=10)
    figure.suptitle(
        f"Rig in the axes of {rig.names[0]}; dots: boards; ellipses: errors x {enlarge:g}"
    )
    _save(figure, path)


def plot_sync(rig: RigSolution, path: str | os.PathLike[str]) -> None:
    """How much later each camera looked than each other one, and what knowing it is worth."""
    sync = rig.sync
    if sync is None:
        raise ValueError("the cameras were not found unsynchronised")
    figure = Figure(figsize=(8.6, 4.2), layout="constrained")
    pairs, worth = figure.subplots(1, 2, width_ratios=(3, 2))
    late = 1000 * (sync.motion.offsets[:, None] - sync.motion.offsets)
    most = max(float(np.abs(late).max()), 1e-9)
    shown = pairs.imshow(late, cmap="RdBu_r", vmin=-most, vmax=most)
    for a, b in np.ndindex(late.shape):
        if a != b:
            colour = "white" if abs(late[a, b]) > 0.6 * most else "black"
            pairs.text(b, a, f"{late[a, b]:.0f}", ha="center", va="center", color=colour)
    names = list(rig.names)
    pairs.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
    pairs.set_yticks(range(len(names)), names, fontsize=8)
    pairs.set_title("row's camera later than column's, ms", fontsize=10)
    figure.colorbar(shown, ax=pairs, shrink=0.8)
    labels = ("at once", "offsets", "offsets and\nread-out")
    colours = ["0.7", "C0" if not sync.rolling else "0.7", "C0" if sync.rolling else "0.7"]
    worth.bar(labels, sync.held_out, color=colours)
    worth.set_ylabel("median distance on the half left out, px")
    worth.set_title("what the clocks explain", fontsize=10)
    worth.tick_params(labelsize=8)
    _save(figure, path)


def _draw_layout(
    axes: Axes,
    rig: RigSolution,
    places: NDArray[np.float64],
    boards: NDArray[np.float64],
    plane: tuple[int, int],
    length: float,
    enlarge: float,
) -> None:
    """Cameras as arrows along their axes, with ellipses and names."""
    i, j = plane
    axes.plot(boards[:, i], boards[:, j], ".", ms=3, color="0.7", zorder=1)
    for c, (name, camera) in enumerate(zip(rig.names, rig.cameras, strict=True)):
        at, ahead = places[c], length * camera.world_from_camera.rotation[:, 2]
        axes.annotate(
            "", (at[i] + ahead[i], at[j] + ahead[j]), (at[i], at[j]),
            arrowprops={"arrowstyle": "-|>", "color": f"C{c % 10}", "lw": 1.5},
        )  # fmt: skip
        axes.plot(at[i], at[j], "s", ms=5, color=f"C{c % 10}")
        axes.annotate(name, (at[i], at[j]), (4, 4), textcoords="offset points", fontsize=8)
        if not c:
            continue
        first = 6 * c + 3
        block = rig.covariance[first : first + 3, first : first + 3][np.ix_(plane, plane)]
        values, vectors = np.linalg.eigh(block)
        major, minor = enlarge * np.sqrt(np.maximum(values[::-1], 0))
        angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
        axes.add_patch(
            Ellipse(
                (float(at[i]), float(at[j])), float(2 * major), float(2 * minor), angle=angle,
                fill=False, color=f"C{c % 10}", lw=1,
            )
        )  # fmt: skip


def _round(value: float) -> float:
    """The next smaller 1, 2 or 5 times a power of ten."""
    if not math.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return max(f * power for f in (1, 2, 5) if f * power <= value * (1 + 1e-9))


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    options: dict[str, Any] = {"dpi": 110, "format": "png"}
    figure.savefig(path, **options)
