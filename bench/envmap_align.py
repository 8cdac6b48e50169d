"""Alignment: tilt from four corners with a pixel of click noise, at 4k."""

from __future__ import annotations

import math
import time

import numpy as np
from numpy.typing import NDArray

from bench.row import Row
from chromeball.envmap.align import align, closed_form
from chromeball.envmap.axes import Rectangle as Clicked
from chromeball.envmap.axes import Vertical, pairs, solve_axes
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]

#: Width, depth, height of the camera, and how far away the middle is; metres.
RECTANGLES = {
    "A2 sheet at 1 m": (0.594, 0.42, 1.0, 1.0),
    "1 x 0.6 m at 1.5 m": (1.0, 0.6, 1.5, 1.5),
    "3 x 2 m underfoot": (3.0, 2.0, 1.5, 0.0),
}


def rows(quick: bool) -> list[Row]:
    """Median error of the tilt over many cameras, ours beside the closed form alone."""
    trials = 100 if quick else 600
    found: list[Row] = []
    for name, (width, depth, height, away) in RECTANGLES.items():
        errors: dict[str, list[float]] = {}
        seconds: dict[str, float] = {}
        rng = np.random.default_rng(1)
        for _ in range(trials):
            for tool, error, cost in _trial(rng, width, depth, height, away):
                errors.setdefault(tool, []).append(error)
                seconds[tool] = min(seconds.get(tool, math.inf), cost)
        for tool, values in errors.items():
            refused = sum(math.isnan(v) for v in values)
            found.append(
                Row(
                    "envmap",
                    f"align, {name}, 1 px clicks at 4k: median tilt",
                    tool,
                    seconds[tool],
                    math.degrees(float(np.nanmedian(values))),
                    "degrees",
                    f"{trials} cameras" + (f", {refused} refused" if refused else ""),
                )
            )
    return found


def _trial(
    rng: np.random.Generator, width: float, depth: float, height: float, away: float
) -> list[tuple[str, float, float]]:
    """Tool, error in radians, CPU seconds."""
    camera = CameraModel.latlong((4096, 2048))
    turn = Pose.from_rotation_vector(rng.normal(scale=0.1, size=3), np.zeros(3)).rotation
    yaw = Pose.from_rotation_vector(
        np.array([0, rng.uniform(-math.pi, math.pi), 0]), np.zeros(3)
    ).rotation
    truth = Pose(yaw @ np.diag([1.0, -1, -1]) @ turn, np.array([0, height, 0]))
    posed = camera.posed(truth)
    x, z = np.array([-1, 1, 1, -1]) * width / 2, np.array([1, 1, -1, -1]) * depth / 2 - away
    corners = np.stack([x, np.zeros(4), z], axis=1)
    q = posed.project_world(corners) + rng.normal(size=(4, 2))
    uprights = np.array([[-2, 0.3, -3], [-2, 2.3, -3], [2.5, 0.3, 1], [2.5, 2.3, 1]])
    edges = posed.project_world(uprights) + rng.normal(size=(4, 2))
    result: list[tuple[str, float, float]] = []
    for tool, solve in (
        ("closed form", lambda: closed_form(camera.unproject(q)).T[1]),
        ("chromeball", lambda: _up(align(camera, q, width=width).world_from_camera)),
        ("chromeball, 2 verticals more", lambda: _mixed(camera, q, width, pairs(edges))),
    ):
        start = time.process_time()
        try:
            up = np.asarray(solve(), float)
            error = float(np.arccos(np.clip(up @ truth.rotation[1], -1, 1)))
        except UserError:
            error = math.nan
        result.append((tool, error, time.process_time() - start))
    return result


def _up(world_from_camera: Pose) -> Array:
    return world_from_camera.rotation[1]


def _mixed(camera: CameraModel, q: Array, width: float, edges: list[Vertical]) -> Array:
    return _up(solve_axes(camera, [Clicked(q, width=width), *edges]).world_from_camera)
