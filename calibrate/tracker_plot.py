"""How far tracker and pictures differ, picture by picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from chromeball.calibrate.tracker import TrackerSolution

GOOD, BAD = "#2a6f97", "#c1121f"


def plot_differences(found: TrackerSolution, files: Sequence[Path], path: Path) -> None:
    """Write a PNG: angle and distance for each picture, beside what the noise explains.

    The lines are the root mean square of three axes' noise. Rejected pictures are red and
    named; bars end at five times the line, with their value.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5), layout="constrained", dpi=110)
    panels = figure.subplots(2, 1, sharex=True)
    number = np.arange(len(files)) + 1
    for panel, values, noise, unit in (
        (panels[0], np.degrees(found.turn_errors), np.degrees(found.noise.rotation), "degrees"),
        (panels[1], found.place_errors * 1e3, found.noise.position * 1e3, "mm"),
    ):
        line = np.sqrt(3) * noise
        there = np.isfinite(values)
        top = 5 * line
        colours = np.where(found.used, GOOD, BAD)[there]
        panel.bar(number[there], np.minimum(values[there], top), color=list(colours))
        panel.axhline(line, color="0.3", lw=1, label=f"noise, {line:.3g} {unit}")
        for k in np.flatnonzero(there & (values > top)):
            panel.annotate(f"{values[k]:.3g}", (number[k], top), ha="center", va="bottom")
        panel.set_ylabel(unit)
        panel.set_ylim(0, 1.12 * top)
        panel.legend(loc="upper right", frameon=False)
    panels[0].set_title("tracker against pictures")
    left_out = ", ".join(str(k) for k in number[~found.used][:12])
    panels[1].set_xlabel("picture" + (f" (left out: {left_out})" if left_out else ""))
    panels[1].xaxis.get_major_locator().set_params(integer=True)
    figure.savefig(path, format="png")
