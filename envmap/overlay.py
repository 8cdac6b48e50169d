"""World axes drawn back over the picture that they were found in (seeds.md F3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.axes import direction
from chromeball.scene.camera import CameraModel
from chromeball.scene.pose import Pose

type Array = NDArray[np.float64]
type Color = tuple[int, int, int]

_CLICK: Color = (255, 0, 255)


@dataclass(frozen=True)
class Drawn:
    """What is drawn beside horizon, grid and axes.

    ``corners`` (4, 3) world metres and ``points`` (4, 2) px of a rectangle; ``verticals`` pairs
    of points (2, 2) px; ``marks`` named points (2,) px; ``sun`` azimuth and elevation, and
    ``north``, the azimuth of -Z, radians.
    """

    corners: Array | None = None
    points: Array | None = None
    verticals: Sequence[Array] = ()
    marks: Sequence[tuple[str, Array]] = ()
    sun: tuple[float, float] | None = None
    north: float | None = None


def overlay(
    display: NDArray[np.uint8], camera: CameraModel, world_from_camera: Pose, drawn: Drawn
) -> NDArray[np.uint8]:
    """Horizon (yellow), floor grid (grey), axes X Y Z (red, green, blue), clicks (magenta).

    Where verticals were clicked, true ones run through them (green); the sun as computed is a
    white ring. `display` (H, W, 3) uint8 is the picture that was clicked in.
    """
    import cv2

    picture = np.array(display, np.uint8, order="C")
    thickness = max(1, round(max(camera.size) / 700))
    posed = camera.posed(world_from_camera)
    origin = world_from_camera.translation
    width, height = camera.size

    def line(world: Array, color: Color, weight: int = thickness) -> None:
        q = posed.project_world(world)
        inside = np.isfinite(q).all(axis=1)
        for a, b, ok in zip(q[:-1], q[1:], inside[:-1] & inside[1:], strict=True):
            if ok and np.abs(a - b).max() < max(width, height) / 8:
                start, end = (
                    (round(float(p[0]) * 16), round(float(p[1]) * 16)) for p in (a, b)
                )
                cv2.line(picture, start, end, color, weight, cv2.LINE_AA, 4)

    def mark(p: Array, text: str, color: Color = _CLICK, radius: int = 4) -> None:
        x, y = round(float(p[0])), round(float(p[1]))
        cv2.circle(picture, (x, y), radius * thickness, color, thickness, cv2.LINE_AA)
        place = (x + 6 * thickness, y - 6 * thickness)
        font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * thickness
        cv2.putText(picture, text, place, font, size, color, thickness, cv2.LINE_AA)

    t = np.linspace(0, 1, 200)[:, None]
    half = 4.0
    if drawn.corners is not None:
        half = 2 * float(np.linalg.norm(drawn.corners[1:3] - drawn.corners[:2], axis=1).max())
    if origin[1] > 0:  # the camera is above the grid's plane
        for k in np.linspace(-1, 1, 9):
            for i, j in ((0, 2), (2, 0)):
                a = np.zeros((200, 3))
                a[:, i], a[:, j] = (2 * t[:, 0] - 1) * half, k * half
                line(a, (110, 110, 110), 1)
        for axis, color in zip(
            np.eye(3), ((255, 60, 60), (60, 220, 60), (80, 120, 255)), strict=True
        ):
            line(t * axis * half / 2, color, 2 * thickness)
    phi = np.linspace(0, 2 * math.pi, 721)
    ring = np.stack([np.cos(phi), np.zeros_like(phi), np.sin(phi)], axis=1)
    line(origin + 1e6 * ring, (255, 220, 0))
    for edge in drawn.verticals:
        rays = posed.world_from_camera.rotate(camera.unproject(edge))
        side = np.asarray(rays.sum(axis=0))
        azimuth = math.atan2(side[0], -side[2])
        heights = np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
        low, high = float(heights.min()) - 0.15, float(heights.max()) + 0.15
        far = [direction(azimuth, float(e)) for e in np.linspace(low, high, 60)]
        line(origin + 1e6 * np.array(far), (60, 220, 60))
        for p in edge:
            mark(p, "")
    if drawn.sun is not None and drawn.north is not None:
        there = direction(drawn.sun[0] - drawn.north, drawn.sun[1])
        q = posed.project_world(origin + 1e6 * there)
        if np.isfinite(q).all():
            mark(q, "", (255, 255, 255), 8)
    if drawn.north is not None:
        q = posed.project_world(origin + 1e6 * direction(-drawn.north, 0.0))
        if np.isfinite(q).all():
            mark(q, "N", (255, 220, 0))
    if drawn.corners is not None:
        closed = np.roll(drawn.corners, -1, axis=0)
        sides = [a + (b - a) * t for a, b in zip(drawn.corners, closed, strict=True)]
        line(np.concatenate(sides), _CLICK)
    if drawn.points is not None:
        for number, p in enumerate(drawn.points, 1):
            mark(p, str(number))
    for text, p in drawn.marks:
        mark(p, text)
    return np.asarray(picture, np.uint8)
