"""The virtual set: a room of diffuse and emissive triangles, in metres, +Y up.

The world's origin is the middle of the carpet, a rectangle of known size on the floor, so that
the axes of a perfect alignment are the axes of the set.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer.mesh import Mesh, Values

type RGB = tuple[float, float, float]

WIDTH, HEIGHT, DEPTH = 6.0, 3.0, 7.0
CARPET = (1.2, 0.8)
#: (x, z) of the middle, half sizes along x and z, height, turn about +Y in degrees, albedo
BOXES: list[tuple[tuple[float, float], tuple[float, float], float, float, RGB]] = [
    ((-1.55, -0.75), (0.35, 0.35), 0.70, 20.0, (0.55, 0.42, 0.18)),
    ((1.45, -1.30), (0.40, 0.30), 1.30, -15.0, (0.25, 0.38, 0.55)),
]

FLOOR: RGB = (0.42, 0.38, 0.33)
CARPET_COLOR: RGB = (0.20, 0.26, 0.34)
WALL: RGB = (0.62, 0.60, 0.56)
RED_WALL: RGB = (0.60, 0.28, 0.22)
CEILING: RGB = (0.75, 0.75, 0.73)
LAMP: RGB = (46.0, 40.0, 30.0)
WINDOW: RGB = (20.0, 26.0, 34.0)
BLACK: RGB = (0.0, 0.0, 0.0)


def quads(corners: Values, albedo: Values, emission: Values = BLACK) -> Mesh:
    """Quadrilaterals ``(N, 4, 3)``, counter-clockwise seen from their front, a colour each."""
    points = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    count = len(points)
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], axis=1).reshape(-1, 3)

    def per_face(color: Values) -> NDArray[np.float32]:
        return np.repeat(np.broadcast_to(np.asarray(color, np.float32), (count, 3)), 2, axis=0)

    return Mesh.of(points.reshape(-1, 3), faces, per_face(albedo), per_face(emission))


def rectangle(centre: Values, u: Values, v: Values) -> NDArray[np.float64]:
    """Corners (4, 3) of centre +- u +- v; the front is along u x v."""
    c, u, v = (np.asarray(a, float) for a in (centre, u, v))
    return np.stack([c - u - v, c + u - v, c + u + v, c - u + v])


def box_footprint(
    middle: tuple[float, float], half: tuple[float, float], turn: float
) -> NDArray[np.float64]:
    """Corners (4, 2) of a box on the floor, (x, z)."""
    a = np.radians(turn)
    u = np.array([np.cos(a), -np.sin(a)]) * half[0]
    v = np.array([np.sin(a), np.cos(a)]) * half[1]
    c = np.asarray(middle, float)
    return np.stack([c - u - v, c + u - v, c + u + v, c - u + v])


def box(footprint: NDArray[np.float64], height: float, albedo: RGB) -> Mesh:
    """Four sides and a top over a footprint (4, 2)."""
    low = np.stack([footprint[:, 0], np.zeros(4), footprint[:, 1]], axis=1)
    high = low + [0, height, 0]
    sides = [np.stack([low[(i + 1) % 4], low[i], high[i], high[(i + 1) % 4]]) for i in range(4)]
    return quads(np.stack([*sides, high[::-1]]), albedo)


def carpet_corners() -> NDArray[np.float64]:
    """The rectangle of known size, (4, 3): first to second along +X, in order around."""
    x, z = CARPET[0] / 2, CARPET[1] / 2
    return np.array([[-x, 0, z], [x, 0, z], [x, 0, -z], [-x, 0, -z]])


def room() -> Mesh:
    """The set without any synthetic object."""
    w, h, d = WIDTH / 2, HEIGHT, DEPTH / 2
    x, y, z = np.eye(3)
    lift = 1e-3  # what lies on a surface lies this far in front of it
    parts = [
        quads(rectangle([0, 0, 0], d * z, w * x), FLOOR),
        quads(rectangle([0, h, 0], w * x, d * z), CEILING),
        quads(rectangle([-w, h / 2, 0], -d * z, h / 2 * y), RED_WALL),
        quads(rectangle([w, h / 2, 0], d * z, h / 2 * y), WALL),
        quads(rectangle([0, h / 2, -d], w * x, h / 2 * y), WALL),
        quads(rectangle([0, h / 2, d], -w * x, h / 2 * y), WALL),
        quads(carpet_corners() + lift * y, CARPET_COLOR),
        # two lamps under the ceiling and a window in the right wall
        quads(rectangle([-1.2, h - lift, -0.6], 0.3 * x, 0.3 * z), BLACK, LAMP),
        quads(rectangle([1.2, h - lift, 0.9], 0.3 * x, 0.3 * z), BLACK, LAMP),
        quads(rectangle([w - lift, 1.6, 0.2], 0.75 * z, 0.6 * y), BLACK, WINDOW),
        # pictures on the walls, so that a panorama has something to look at
        quads(rectangle([-w + lift, 1.5, -0.8], -0.6 * z, 0.4 * y), (0.15, 0.3, 0.2)),
        quads(rectangle([-0.8, 1.6, -d + lift], 0.7 * x, 0.5 * y), (0.6, 0.5, 0.15)),
        quads(rectangle([0.9, 1.1, d - lift], -0.45 * x, 1.1 * y), (0.3, 0.2, 0.12)),
    ]
    for middle, half, height, turn, albedo in BOXES:
        parts.append(box(box_footprint(middle, half, turn), height, albedo))
    return Mesh.join(parts)
