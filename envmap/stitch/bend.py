"""Frames bent a little so that they meet where the camera moved between them (parallax).

Rotations cannot explain what a hand-held camera sees: near things shift. Each frame gets a
smooth field of shifts on a coarse grid, such that matches meet and the fields stay small and
even (after the smoothly varying warps of Zaragoza et al. 2013). Sparse least squares, with
Geman and McClure's weights; every fifth match is held out and tells how well it works.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chromeball.envmap.stitch.frames import Frame
from chromeball.envmap.stitch.lens import pixel_angle
from chromeball.envmap.stitch.rotations import Adjusted, Matches
from chromeball.scene.camera import CameraModel

type Array = NDArray[np.float64]

#: Nodes across and down the picture.
NODES = (16, 12)
#: Weight of a pixel of difference between neighbouring nodes, and of a pixel of shift.
EVEN, SMALL = 0.2, 0.02
#: Median residual of all matches from which frames are bent (px).
PARALLAX = 1.0
ITERATIONS = 12


@dataclass(frozen=True)
class Bends:
    """``shifts`` (N, ny, nx, 2) pixels at the nodes: what lies at q belongs to q + shift.

    ``before``, ``after`` median and RMS of the residuals (px) of the matches that count, and
    ``inliers`` their number; ``held_out`` median residual before and after of matches that had
    no part in it; ``largest`` shift at a node that matches reach.
    """

    shifts: Array
    before: tuple[float, float]
    after: tuple[float, float]
    inliers: int
    held_out: tuple[float, float]
    largest: float


def parallax(adjusted: Adjusted) -> float:
    """Median residual of all matches, pixels: more than features scatter when frames shift."""
    return float(np.median(adjusted.residuals)) if len(adjusted.residuals) else 0.0


def bend(matches: Matches, adjusted: Adjusted, *, seed: int = 1) -> Bends:
    """Shifts of all frames from their matches, with the rotations and lens as they are."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    camera, rotations = adjusted.camera, adjusted.rotations
    count, nodes = len(rotations), NODES[0] * NODES[1]
    out = np.random.default_rng(seed).permutation(len(matches.frames)) % 5 == 0
    pull = _evenness()
    rule = sparse.block_diag([pull] * (2 * count), format="csr")
    x = np.zeros(2 * count * nodes)
    e, jacobian = _equations(matches, camera, rotations)
    first = np.linalg.norm(e, axis=1)

    def left(x: Array) -> Array:
        return e + (jacobian @ x).reshape(-1, 3)

    scale = float(np.median(first))
    for _ in range(ITERATIONS):
        norm = np.linalg.norm(left(x), axis=1)
        scale = max(0.5 * scale, float(np.median(norm)), 0.3)
        weight = np.where(out, 0, 1 / (1 + (norm / (2 * scale)) ** 2) ** 2)
        rows = sparse.diags(np.repeat(weight, 3))
        normal = (jacobian.T @ rows @ jacobian + rule.T @ rule).tocsc()
        x = np.asarray(spsolve(normal, -(jacobian.T @ (np.repeat(weight, 3) * e.ravel()))))
    norm = np.linalg.norm(left(x), axis=1)
    good = norm < 2.5 * max(float(np.median(norm)), 0.3)

    def told(values: Array) -> tuple[float, float]:
        return float(np.median(values)), float(np.sqrt(np.mean(values**2)))

    shifts = np.moveaxis(x.reshape(count, 2, NODES[1], NODES[0]), 1, -1)
    at_matches = [
        np.abs(_shift_at(shifts[k], camera.size, matches.first[matches.frames[:, 0] == k]))
        for k in range(count)
    ]
    return Bends(
        shifts=shifts,
        before=told(first[good]),
        after=told(norm[good]),
        inliers=int(good.sum()),
        held_out=(float(np.median(first[out])), float(np.median(norm[out]))),
        largest=max((float(a.max()) for a in at_matches if a.size), default=0.0),
    )


def bent(frame: Frame, shifts: Array) -> Frame:
    """The frame as its camera would have seen it from the common place: resampled, linear."""
    import cv2

    width, height = frame.size
    y, x = np.mgrid[:height, :width].astype(np.float32)
    scale = (np.array(NODES) - 1) / np.array([width - 1, height - 1])
    nodes = np.ascontiguousarray(shifts, np.float32)
    at = np.stack([x, y], axis=-1)
    for _ in range(4):  # q + s(q) = p by fixed point: shifts are small and even
        u, v = at[..., 0] * np.float32(scale[0]), at[..., 1] * np.float32(scale[1])
        here = cv2.remap(nodes, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        at = np.stack([x, y], axis=-1) - np.asarray(here, np.float32)
    maps = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    inside = (at >= 0).all(axis=-1) & (at <= [width - 1, height - 1]).all(axis=-1)

    def mask(given: NDArray[np.bool_]) -> NDArray[np.bool_]:
        got = cv2.remap(given.astype(np.uint8), *maps, cv2.INTER_NEAREST)
        return np.asarray(got) > 0

    def moved(picture: NDArray[np.float32]) -> NDArray[np.float32]:
        got = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(got, np.float32)

    return replace(
        frame,
        radiance=moved(frame.radiance),
        valid=inside if frame.valid is None else inside & mask(frame.valid),
        clipped=None if frame.clipped is None else mask(frame.clipped),
        sigma=None if frame.sigma is None else moved(frame.sigma),
    )


def bent_all(frames: Sequence[Frame], bends: Bends) -> list[Frame]:
    """All frames, bent."""
    return [bent(frame, s) for frame, s in zip(frames, bends.shifts, strict=True)]


def _equations(matches: Matches, camera: CameraModel, rotations: Array) -> tuple[Array, Any]:
    """Differences (M, 3) of the ends in pixels, and their sparse derivatives by the shifts."""
    from scipy import sparse

    nodes = NODES[0] * NODES[1]
    a, b = pixel_angle(camera, matches.first), pixel_angle(camera, matches.second)
    width = np.sqrt((a**2 + b**2) / 2)
    e = np.zeros((len(width), 3))
    rows, columns, values = [], [], []
    for end, sign in ((0, 1.0), (1, -1.0)):
        frame = matches.frames[:, end]
        q = (matches.first, matches.second)[end]
        turn = rotations[frame]
        e += sign * np.einsum("mab,mb->ma", turn, camera.unproject(q)) / width[:, None]
        index, weight = _corners(camera.size, q)
        for axis in (0, 1):
            step = np.eye(2)[axis] / 2
            slope = camera.unproject(q + step) - camera.unproject(q - step)
            slope = sign * np.einsum("mab,mb->ma", turn, slope) / width[:, None]
            column = (2 * frame + axis)[:, None] * nodes + index  # (M, 4)
            value = slope[:, :, None] * weight[:, None, :]  # (M, 3, 4)
            row = np.arange(3 * len(q)).reshape(-1, 3, 1)
            rows.append(np.broadcast_to(row, value.shape).ravel())
            columns.append(np.broadcast_to(column[:, None, :], value.shape).ravel())
            values.append(value.ravel())
    jacobian = sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(3 * len(width), 2 * len(rotations) * nodes),
    )
    return e, jacobian


def _corners(size: tuple[int, int], pixels: Array) -> tuple[NDArray[np.intp], Array]:
    """The four nodes about each pixel (..., 2) and their bilinear weights, (..., 4)."""
    nx, ny = NODES
    at = np.clip(pixels / (np.array(size) - 1.0) * [nx - 1, ny - 1], 0, [nx - 1, ny - 1])
    low = np.minimum(at.astype(np.intp), [nx - 2, ny - 2])
    u, v = np.moveaxis(at - low, -1, 0)
    base = low[..., 1] * nx + low[..., 0]
    index = np.stack([base, base + 1, base + nx, base + nx + 1], axis=-1)
    weight = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=-1)
    return index, weight


def _shift_at(shifts: Array, size: tuple[int, int], pixels: Array) -> Array:
    """Shifts (ny, nx, 2) between their nodes, at `pixels` (..., 2)."""
    index, weight = _corners(size, pixels)
    return np.asarray((shifts.reshape(-1, 2)[index] * weight[..., None]).sum(axis=-2))


def _evenness() -> Any:
    """What keeps one component's nodes even and small, as rows over the nodes."""
    from scipy import sparse

    nx, ny = NODES

    def steps(count: int) -> Any:
        return sparse.csr_matrix(np.diff(np.eye(count), axis=0))

    across = sparse.kron(sparse.eye(ny), steps(nx))
    down = sparse.kron(steps(ny), sparse.eye(nx))
    return sparse.vstack([EVEN * across, EVEN * down, SMALL * sparse.eye(nx * ny)])
