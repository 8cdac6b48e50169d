"""Rigid poses, named for what they do: ``world_from_camera @ p_camera``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Pose:
    """``p_out = rotation @ p_in + translation``; metres.

    ``rotation`` is (3, 3) float64 and orthonormal with determinant 1, ``translation`` (3,).
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def __post_init__(self) -> None:
        r = np.array(self.rotation, float).reshape(3, 3)
        t = np.array(self.translation, float).reshape(3)
        if not (np.allclose(r @ r.T, np.eye(3), atol=1e-6) and np.linalg.det(r) > 0):
            raise ValueError("rotation is not a proper orthonormal matrix")
        if not np.isfinite(t).all():
            raise ValueError("translation is not finite")
        object.__setattr__(self, "rotation", r)
        object.__setattr__(self, "translation", t)

    @classmethod
    def identity(cls) -> Pose:
        """The pose that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """From a (3, 4) or (4, 4) matrix."""
        m = np.asarray(matrix, float)
        return cls(m[:3, :3], m[:3, 3])

    @classmethod
    def from_rotation_vector(cls, rotation: ArrayLike, translation: ArrayLike) -> Pose:
        """From an axis times angle in radians (Rodrigues) and a translation."""
        v = np.asarray(rotation, float).reshape(3)
        if not np.isfinite(v).all():
            raise ValueError("rotation is not finite")
        angle = float(np.linalg.norm(v))
        x, y, z = v / angle if angle > 0 else v
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        r = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
        return cls(r, np.asarray(translation, float))

    @classmethod
    def look_at(cls, position: ArrayLike, target: ArrayLike, up: ArrayLike = (0, 1, 0)) -> Pose:
        """``world_from_camera`` of a camera (x right, y down, z forward) at `position`.

        Raises ``ValueError`` when the view direction is zero or parallel to `up`.
        """
        p = np.asarray(position, float)
        z = np.asarray(target, float) - p
        x = np.cross(z, np.asarray(up, float))
        if np.linalg.norm(x) < 1e-9 * max(1.0, float(np.linalg.norm(z))):
            raise ValueError("the view direction is zero or parallel to up")
        z = z / np.linalg.norm(z)
        x = x / np.linalg.norm(x)
        return cls(np.stack([x, np.cross(z, x), z], axis=1), p)

    def matrix(self) -> NDArray[np.float64]:
        """The (4, 4) matrix."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.rotation, self.translation
        return m

    def rotation_vector(self) -> NDArray[np.float64]:
        """Axis times angle in radians, (3,), angle in 0..pi."""
        r = self.rotation
        v = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
        sine, cosine = float(np.linalg.norm(v)), (float(np.trace(r)) - 1) / 2
        angle = float(np.arctan2(sine, cosine))
        if cosine > 0:
            return v * (angle / sine) if sine > 0 else v
        # v fades towards half a turn; the symmetric part, cos I + (1 - cos) a a', does not.
        outer = (r + r.T) / 2 - cosine * np.eye(3)
        axis = outer[:, int(np.diagonal(outer).argmax())]
        axis = axis / np.linalg.norm(axis)
        return angle * (axis if axis @ v >= 0 else -axis)

    def inverse(self) -> Pose:
        """The pose that undoes this one."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Transform points, ``(..., 3) -> (..., 3)``."""
        return np.asarray(points, float) @ self.rotation.T + self.translation

    def rotate(self, directions: ArrayLike) -> NDArray[np.float64]:
        """Rotate directions, ``(..., 3) -> (..., 3)``."""
        return np.asarray(directions, float) @ self.rotation.T

    def __matmul__(self, other: Pose) -> Pose:
        """``(a_from_b @ b_from_c)`` is ``a_from_c``."""
        return Pose(self.rotation @ other.rotation, self.apply(other.translation))
