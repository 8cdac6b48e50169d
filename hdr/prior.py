"""What response curves look like: mean and covariance of ln f^-1 over real cameras and films.

The numbers in ``prior.json`` are statistics of the 111 curves of the Database of Response
Functions (Grossberg and Nayar, "Modeling the space of camera response functions", 2004): a
mean and principal components at the 256 codes. Many of those curves are near copies of one
another, so each counts by one over the number of curves within 3 % RMS of it. The benchmark
judges each curve by a prior from which all of its like are left out.

``python -m chromeball.hdr.prior dorf.npz`` makes the file anew.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chromeball.hdr.knots import KNOTS, MIDDLE, codes_at_knots

type Float = NDArray[np.float64]

#: curves that differ by less (RMS of ln exposure, codes 5 .. 250) are one family
FAMILY = 0.03
#: deviations of single curves from what the components span: variance, and reach in codes
SMOOTH, SMOOTH_REACH = 1e-4, 20.0
#: rougher deviations, the likeliest of which the data choose: variances, and reach in codes
ROUGH, ROUGH_REACH = (1e-7, 1e-5, 1e-4), 20.0

#: dark codes that no picture shows: below this code the slope of g over ln z is a random walk,
#: so that curves of no camera in the database go on as they came, and less and less certain
DARK_END, DARK_BEND = 48.0, 0.1


@dataclass(frozen=True)
class Prior:
    """``mean`` (256,) and ``components`` (R, 256) of ln exposure over codes, zero at 128."""

    mean: Float
    components: Float

    def at(self, codes: int) -> tuple[Float, Float]:
        """Mean (256,) and covariance factors (models, 256, 256) at the knots of `codes` codes.

        The covariance of model q is ``factors[q] @ factors[q].T``.
        """
        z = codes_at_knots(codes) * ((KNOTS - 1) / (codes - 1))  # in 8-bit codes
        table = np.vstack([self.mean, self.components])
        curves = np.stack([np.interp(z, np.arange(KNOTS), row) for row in table])
        # below the first code ln exposure goes on as a power of the code
        few = z < 1
        start = np.log(np.maximum(z[few], z[z > 0].min() / 4))
        steep = (table[:, 4] - table[:, 1]) / np.log(4)
        curves[:, few] = table[:, 1, None] + steep[:, None] * start
        middle = np.array([np.interp(z[MIDDLE], np.arange(KNOTS), row) for row in table])
        curves -= middle[:, None]
        # dark knots of many codes lie close together and still differ: by ratio, not by step
        place = z if codes == KNOTS else z + 6 * np.log(z + 0.02)
        distance = np.abs(place[:, None] - place)
        smooth = SMOOTH * np.exp(-0.5 * (distance / SMOOTH_REACH) ** 2)
        r = np.sqrt(3) * distance / ROUGH_REACH
        rough = (1 + r) * np.exp(-r)  # Matern 3/2: once differentiable
        depth = np.log(DARK_END / np.clip(z, 0.25, DARK_END))
        least = np.minimum(depth[:, None], depth)
        bend = least**3 / 3 + np.abs(depth[:, None] - depth) * least**2 / 2
        deviations = smooth + DARK_BEND**2 * bend + 1e-10 * np.eye(KNOTS)
        factors = [
            np.linalg.cholesky(curves[1:].T @ curves[1:] + deviations + variance * rough)
            for variance in ROUGH
        ]
        return curves[0], np.stack(factors)


def from_curves(g: Float) -> Prior:
    """Mean and components of curves `g` (N, 256), ln exposure over code, zero at 128."""
    within = distances(g) < FAMILY
    weight = 1 / within.sum(axis=1)
    weight /= weight.sum()
    mean = weight @ g
    _, sizes, axes = np.linalg.svd(np.sqrt(weight)[:, None] * (g - mean), full_matrices=False)
    kept = sizes**2 > 0.001 * SMOOTH * KNOTS
    return Prior(mean, sizes[kept, None] * axes[kept])


def distances(g: Float) -> Float:
    """RMS differences of curves (N, 256) over the codes 5 .. 250, (N, N)."""
    return np.array([np.sqrt(np.mean((g - one)[:, 5:251] ** 2, axis=1)) for one in g])


def inverse_curves(irradiance: Float, brightness: Float) -> Float:
    """Ln exposure at the 256 codes of curves given as brightness over irradiance, (N, n) each.

    Code 0 is no exposure at all: its value goes on from those above it.
    """
    z = np.arange(KNOTS) / (KNOTS - 1)
    g = np.empty((len(irradiance), KNOTS))
    for row, x, y in zip(g, irradiance, brightness, strict=True):
        rising = np.maximum.accumulate(y) + 1e-9 * np.arange(len(y))
        row[:] = np.log(np.maximum(np.interp(z, rising, x), 1e-9))
        row[0] = 2 * row[1] - row[2]
    return g - g[:, MIDDLE, None]


@cache
def known_cameras() -> Prior:
    """The prior that comes with chromeball."""
    table = json.loads(Path(__file__).with_name("prior.json").read_text())
    return Prior(np.array(table["mean"]), np.array(table["components"]))


def main(database: str) -> None:
    """Write ``prior.json`` from DoRF's curves (``irradiance`` and ``brightness``, (N, n))."""
    curves = np.load(database)
    prior = from_curves(
        inverse_curves(
            curves["irradiance"].astype(np.float64), curves["brightness"].astype(np.float64)
        )
    )
    rows = {
        "source": "statistics of 111 response curves, DoRF (Grossberg and Nayar 2004)",
        "mean": [round(float(v), 4) for v in prior.mean],
        "components": [[round(float(v), 4) for v in row] for row in prior.components],
    }
    text = json.dumps(rows).replace("], ", "],\n ").replace('"mean"', '\n "mean"')
    Path(__file__).with_name("prior.json").write_text(text + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
