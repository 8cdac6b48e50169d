"""Final gathering: the light in a diffuse set, solved once and looked up by every camera.

Irradiance is path-traced at the vertices of a tessellation; a camera's path then ends at its
second diffuse surface, where the light that leaves is known. Errors of the look-up are averaged
over a whole hemisphere; near surfaces, whose errors would not be, are followed as usual
(Jensen 2001, chapter 9.5, with irradiance in place of a photon map).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import core
from chromeball.renderer.mesh import Mesh
from chromeball.renderer.path import path_trace
from chromeball.renderer.world import world


@dataclass(frozen=True)
class LitSet:
    """A set with its light: ``irradiance`` (V, 3) at the vertices of ``mesh``.

    NaN where nothing is known; look-ups start ``near`` metres from the surface that gathers.
    """

    mesh: Mesh
    irradiance: NDArray[np.float32]
    near: float

    def with_mesh(self, mesh: Mesh) -> LitSet:
        """The same light with one more mesh, which leaves the light of the rest as it is."""
        unknown = np.full((len(mesh.vertices), 3), np.nan, np.float32)
        return replace(
            self,
            mesh=Mesh.join([self.mesh, mesh]),
            irradiance=np.concatenate([self.irradiance, unknown]),
        )

    def radiance(
        self, rays: NDArray[np.float32], origin: NDArray[np.float64], *, spp: int, seed: int = 0
    ) -> NDArray[np.float32]:
        """Radiance (H, W, 3) that a camera sees, as :func:`path_trace`."""
        return path_trace(
            self.mesh,
            rays,
            origin,
            spp=spp,
            seed=seed,
            irradiance=self.irradiance,
            gather_from=self.near,
        )


def light_set(
    mesh: Mesh, *, edge: float = 0.25, spp: int = 256, seed: int = 0, max_bounces: int = 12
) -> LitSet:
    """Solve the light of a set of flat diffuse faces, on the side they are seen from outside.

    Triangles longer than `edge` metres are divided and lit; smaller ones (objects) are left to
    be followed by the paths.
    """
    divided, lit, inward = tessellate(mesh, edge)
    irradiance = np.full((len(divided.vertices), 3), np.nan, np.float32)
    if lit.any():
        corners = divided.vertices[divided.faces].astype(float)
        face_normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = np.zeros_like(divided.vertices, float)
        normal[divided.faces] = face_normal[:, None]
        n = normal[lit] / np.linalg.norm(normal[lit], axis=1, keepdims=True)
        irradiance[lit] = core.irradiance(
            world([mesh]),
            inward[lit],
            np.ascontiguousarray(n, np.float32),
            spp,
            seed,
            max_bounces,
        )[:, 0]
    return LitSet(divided, irradiance, 1.5 * edge)


def tessellate(mesh: Mesh, edge: float) -> tuple[Mesh, NDArray[np.bool_], NDArray[np.float32]]:
    """Divide triangles longer than `edge`; none of the new ones share vertices across them.

    Returns the mesh, which vertices (V,) belong to divided triangles, and places (V, 3) a
    little inside their triangle, where a point is not in the plane of a neighbouring wall.
    """
    corners = mesh.vertices[mesh.faces].astype(float)
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.ceil(lengths / edge).astype(int)
    vertices, faces, parents = [mesh.vertices.astype(float)], [], []
    inward = [mesh.vertices.astype(float)]
    count = len(mesh.vertices)
    small = np.flatnonzero(pieces <= 1)
    faces.append(mesh.faces[small].astype(np.int64))
    parents.append(small)
    for face in np.flatnonzero(pieces > 1):
        k = int(pieces[face])
        i, j = np.meshgrid(np.arange(k + 1), np.arange(k + 1), indexing="ij")
        keep = i + j <= k
        number = np.full((k + 1, k + 1), -1)
        number[keep] = count + np.arange(keep.sum())
        a, b, c = corners[face]
        points = a + (i[keep] / k)[:, None] * (b - a) + (j[keep] / k)[:, None] * (c - a)
        to_centre = (a + b + c) / 3 - points
        distance = np.maximum(np.linalg.norm(to_centre, axis=1, keepdims=True), 1e-9)
        vertices.append(points)
        inward.append(points + to_centre * np.minimum(1, 0.04 * edge / distance))
        up = (i + j <= k - 1) & (i < k) & (j < k)
        down = (i + j <= k - 2) & (i < k) & (j < k)
        u, v = i[up], j[up]
        s, t = i[down], j[down]
        faces.append(np.stack([number[u, v], number[u + 1, v], number[u, v + 1]], axis=1))
        faces.append(
            np.stack([number[s + 1, t], number[s + 1, t + 1], number[s, t + 1]], axis=1)
        )
        parents.append(np.full(k * k, face))
        count += int(keep.sum())
    parent = np.concatenate(parents)
    everything = np.concatenate(vertices)

    def grown(values: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        if values is None:
            return None
        more = np.zeros((count - len(values), values.shape[1]), np.float32)
        return np.concatenate([values, more])

    divided = Mesh(
        everything.astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
        mesh.material[parent],
        mesh.materials,
        grown(mesh.normals),
        grown(mesh.uv),
    )
    lit = np.arange(count) >= len(mesh.vertices)
    return divided, lit, np.concatenate(inward).astype(np.float32)
