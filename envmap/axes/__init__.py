"""World axes from any mix of what a picture shows of them (seeds.md F3, F4, F15).

A rectangle on floor, ceiling or wall, vertical edges, the horizon, the sun at a known time and
place, a point of known bearing: one weighted least squares on angles, for whatever lens. Each
observation is weighted by the clicks' noise as the lens turns it to an angle, and by how plumb,
level or sharp such things are in the world.
"""

from chromeball.envmap.axes.observations import (
    Bearing,
    Horizon,
    Observation,
    Rectangle,
    Vertical,
    direction,
    pairs,
)
from chromeball.envmap.axes.solve import Axes, axes_json, solve_axes
from chromeball.envmap.axes.terms import Term

__all__ = [
    "Axes",
    "Bearing",
    "Horizon",
    "Observation",
    "Rectangle",
    "Term",
    "Vertical",
    "axes_json",
    "direction",
    "pairs",
    "solve_axes",
]
