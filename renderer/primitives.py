"""Sphere, box and cylinder of unit size, standing on y = 0."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

type Triangles = tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32] | None]


def sphere(rings: int = 128, segments: int = 256) -> Triangles:
    """Diameter 1 about (0, 0.5, 0), smooth normals: vertices, faces, normals."""
    theta = np.linspace(0, math.pi, rings + 1)[:, None]
    phi = np.linspace(0, 2 * math.pi, segments, endpoint=False)[None]
    normals = np.stack(
        [
            np.sin(theta) * np.sin(phi),
            np.broadcast_to(np.cos(theta), (rings + 1, segments)),
            np.sin(theta) * np.cos(phi),
        ],
        axis=-1,
    ).reshape(-1, 3)
    faces = _lattice(rings, segments)
    # the triangles between equal vertices at the poles
    top = faces[:, [0, 1, 2]] < segments
    bottom = faces[:, [0, 1, 2]] >= rings * segments
    faces = faces[(top.sum(1) < 2) & (bottom.sum(1) < 2)]
    vertices = 0.5 * normals + [0, 0.5, 0]
    return vertices.astype(np.float32), faces, normals.astype(np.float32)


def cylinder(segments: int = 256) -> Triangles:
    """Diameter 1 and height 1 on y = 0, smooth round the side: vertices, faces, normals."""
    phi = np.linspace(0, 2 * math.pi, segments, endpoint=False)
    ring = np.stack([np.sin(phi), np.zeros(segments), np.cos(phi)], axis=1)
    up = np.array([0.0, 1.0, 0.0])
    vertices = [
        0.5 * ring + up,
        0.5 * ring,
        0.5 * ring + up,
        0.5 * ring,
        up[None],
        0 * up[None],
    ]
    normals = [ring, ring, ring * 0 + up, ring * 0 - up, up[None], -up[None]]
    i = np.arange(segments)
    j = (i + 1) % segments
    top, bottom, centre = 2 * segments, 3 * segments, 4 * segments
    lid = np.stack([top + i, top + j, np.full(segments, centre)], axis=1)
    foot = np.stack([bottom + j, bottom + i, np.full(segments, centre + 1)], axis=1)
    faces = np.concatenate([_lattice(1, segments), lid, foot]).astype(np.uint32)
    return (
        np.concatenate(vertices).astype(np.float32),
        faces,
        np.concatenate(normals).astype(np.float32),
    )


def box() -> Triangles:
    """Side 1 on y = 0, flat: vertices, faces, no normals."""
    corners = np.array([[x, y, z] for y in (0, 1) for z in (-0.5, 0.5) for x in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [[(a, b, c), (a, c, d)] for a, b, c, d in quads]
    return corners.astype(np.float32), np.array(faces, np.uint32).reshape(-1, 3), None


def _lattice(rows: int, segments: int) -> NDArray[np.uint32]:
    """Triangles between rows of a closed grid, counter-clockwise from outside."""
    i, j = np.meshgrid(np.arange(rows), np.arange(segments), indexing="ij")
    a, b = i * segments + j, i * segments + (j + 1) % segments
    c, d = a + segments, b + segments
    quads = np.stack([np.stack([a, c, d], -1), np.stack([a, d, b], -1)], axis=2)
    return quads.reshape(-1, 3).astype(np.uint32)


PRIMITIVES = {"sphere": sphere, "box": box, "cylinder": cylinder}
