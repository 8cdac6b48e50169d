"""Where the cameras of a rig stand, roughly: relative poses on a maximum spanning tree.

Two cameras that see the board at once know each other's pose; of all such instants the one
that agrees best with the others is taken (the medoid), so that misread boards do not matter.
A plain chessboard may be read from either end: both readings are tried.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.adjust import Estimate, adjust, residuals
from chromeball.calibrate.board_pose import board_poses
from chromeball.calibrate.rig_solve import FEWEST_CORNERS, RigEstimate
from chromeball.calibrate.target import Chessboard, CircleGrid, Target
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.pose import Pose

#: Boards placed by two cameras agree within this share of their distance, and boards that may
#: have moved between the two.
AGREES, MOVED = 0.06, 0.2
#: Of three or more boards seen at once so many must agree, else the pair is not trusted.
LEAST_AGREEING = 0.3

type Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """A rig to begin with.

    ``estimate`` has a pose for each camera and each instant that was ``placed`` (F,);
    ``turned`` (C, F) says which reading of the board each camera had, an index of
    :func:`readings`; ``common`` (C, C) counts instants that two cameras share and ``agreeing``
    (C, C) those that agree on the cameras' relative pose.
    """

    estimate: RigEstimate
    placed: NDArray[np.bool_]
    turned: NDArray[np.intp]
    common: NDArray[np.intp]
    agreeing: NDArray[np.intp]


def readings(target: Target) -> list[tuple[Matrix, NDArray[np.intp]]]:
    """Ways to read a board that looks the same when turned.

    Each is a motion (4, 4) of the board onto itself, and the flat indices (rows * columns,) in
    which the turned reading has the first one's corners.
    """
    board = target.points().reshape(-1, 3)
    index = np.arange(target.rows * target.columns).reshape(target.rows, target.columns)
    found = [(np.eye(4), index.ravel())]
    turns: list[int] = []
    match target:
        case Chessboard() | CircleGrid(asymmetric=False):
            turns = [1, 2, 3] if target.rows == target.columns else [2]
        case CircleGrid() if target.rows % 2 == 0:
            turns = [2]
        case _:
            pass
    middle = board.mean(axis=0)
    for quarter in turns:
        order = np.rot90(index, quarter).ravel()
        # The motion that takes each corner to the place of the one that is read there.
        u, _, vt = np.linalg.svd((board[order] - middle)[:, :2].T @ (board - middle)[:, :2])
        motion = np.eye(4)
        motion[:2, :2] = u @ vt
        motion[:3, 3] = middle - motion[:3, :3] @ middle
        found.append((motion, order))
    return found


def place_boards(
    camera: CameraModel, board: Matrix, corners: Matrix, *, refine: bool = True
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Poses camera_from_board (F, 4, 4) of views (F, rows, columns, 2), and which have one.

    By rays first, which is all unless to `refine`; then each of the two poses that a plane
    allows is fitted to the pixels with Cauchy's weights, and the better one taken.
    """
    found = np.isfinite(corners[..., 0])
    starts: list[tuple[int, list[Pose]]] = []
    rays = np.full((*found.shape, 3), np.nan)
    rays[found] = camera.unproject(corners[found])
    for view, seen in enumerate(np.isfinite(rays).all(axis=-1)):
        if seen.sum() < FEWEST_CORNERS:
            continue
        if rivals := board_poses(board[seen], rays[view][seen]):
            starts.append((view, rivals))
    poses = np.tile(np.eye(4), (len(corners), 1, 1))
    least = np.full(len(corners), math.inf)
    if not refine:
        for view, (first, *_) in starts:
            poses[view], least[view] = first.matrix(), 0.0
        return poses, np.isfinite(least)
    none = np.zeros(len(camera.intrinsics) + 4)
    for rival in range(2):
        chosen = [(view, p[rival]) for view, p in starts if len(p) > rival]
        if not chosen:
            continue
        views = np.array([view for view, _ in chosen])
        start = Estimate(
            camera,
            np.zeros(2),
            np.array([p.rotation for _, p in chosen]),
            np.array([p.translation for _, p in chosen]),
        )
        seen = found[views] & np.isfinite(residuals(start, board, corners[views])[..., 0])
        typical = _medians(start, board, corners[views])
        scale = max(3 * float(np.median(typical)), 1e-6)
        fitted = adjust(
            start, board, corners[views], seen,
            free=none > 0, precision=none, scale=scale, steps=20, least_gain=1e-6,
        )  # fmt: skip
        miss = _medians(fitted, board, corners[views])
        better = miss < least[views]
        least[views[better]] = miss[better]
        poses[views[better], :3, :3] = fitted.rotations[better]
        poses[views[better], :3, 3] = fitted.translations[better]
    return poses, np.isfinite(least)


def start_rig(
    names: Sequence[str],
    cameras: Sequence[CameraModel],
    camera_from_board: Matrix,
    seen: NDArray[np.bool_],
    target: Target,
    agrees: float = AGREES,
) -> Start:
    """A rig from boards (C, F, 4, 4) placed by each camera alone, where `seen` (C, F).

    Two cameras agree on a board that both place within so much of its distance.

    Raises
    ------
    UserError
        When the cameras fall into groups that never see the board at once.

    """
    motions = np.array([motion for motion, _ in readings(target)])
    board = target.points()[:: target.rows - 1, :: target.columns - 1].reshape(-1, 3)
    board = np.concatenate([board, np.ones((len(board), 1))], axis=1)
    count = len(cameras)
    common = seen.astype(int) @ seen.T.astype(int)
    agreeing = np.zeros((count, count), np.intp)
    pairs: dict[tuple[int, int], Matrix] = {}
    for a, b in combinations(range(count), 2):
        both = np.flatnonzero(seen[a] & seen[b])
        if not len(both):
            continue
        relative, agree = _relative(
            camera_from_board[a, both], camera_from_board[b, both], motions, board, agrees
        )
        if agree >= max(1, LEAST_AGREEING * len(both)):
            agreeing[a, b] = agreeing[b, a] = agree
            pairs[a, b], pairs[b, a] = relative, np.linalg.inv(relative)
    if len(groups(agreeing)) > 1:
        text = disconnected(names, agreeing)
        quarrels = np.where(agreeing > 0, 0, common) * ~np.eye(count, dtype=bool)
        if quarrels.any():
            a, b = (int(i) for i in np.unravel_index(quarrels.argmax(), quarrels.shape))
            both = np.flatnonzero(seen[a] & seen[b])
            first, second = camera_from_board[a, both], camera_from_board[b, both]
            mirrored = _mirrored(second, target)
            text += f"; {names[a]} and {names[b]} see {len(both)} boards at once, but "
            if _relative(first, mirrored, motions, board, agrees)[1] > 0.5 * len(both) > 1:
                text += "the pictures of one of them are mirrored"
            else:
                text += (
                    "these do not agree on where the cameras stand: are the pictures paired "
                    "rightly, and of the same board?"
                )
        raise UserError(text)
    camera_from_rig = _spanning_tree(pairs, agreeing)
    rig_from_board, turned = _boards(camera_from_rig, camera_from_board, seen, motions, board)
    estimate = RigEstimate(
        cameras=tuple(cameras),
        rotations=camera_from_rig[:, :3, :3],
        translations=camera_from_rig[:, :3, 3],
        bow=np.zeros(2),
        board_rotations=rig_from_board[:, :3, :3],
        board_translations=rig_from_board[:, :3, 3],
    )
    return Start(estimate, seen.any(axis=0), turned, common, agreeing)


# ---- relative poses, tree, boards


def _misfits(
    poses: Matrix, first: Matrix, second: Matrix, motions: Matrix, board: Matrix
) -> Matrix:
    """How far boards `second` (V, 4, 4), moved by `poses` (N, 4, 4), fall from `first`.

    (N, V, S): RMS over the outermost corners as a share of the distance, for S readings.
    """
    here = np.einsum("vij,kj->vki", first, board)[..., :3]
    there = np.einsum("nij,vjk,skl,ml->nvsmi", poses, second, motions, board, optimize=True)
    off = ((there[..., :3] - here[None, :, None]) ** 2).sum(axis=-1).mean(axis=-1)
    far = (here**2).sum(axis=-1).mean(axis=-1)
    return np.asarray(np.sqrt(off / far[None, :, None]), float)


def _relative(
    first: Matrix, second: Matrix, motions: Matrix, board: Matrix, agrees: float
) -> tuple[Matrix, int]:
    """first_from_second that boards (V, 4, 4) seen by both agree on best, and how many do."""
    candidates = first[:, None] @ np.linalg.inv(second[:, None] @ motions)
    candidates = candidates.reshape(-1, 4, 4)
    if len(candidates) > 400:  # enough to choose from
        candidates = candidates[:: len(candidates) // 200]
    misfit = _misfits(candidates, first, second, motions, board).min(axis=-1)
    # Ties, as of a single instant, go to the reading as it was made.
    best = int(np.argmin(np.round(np.minimum(misfit, 2 * agrees).mean(axis=1), 12)))
    return candidates[best], int((misfit[best] < agrees).sum())


def _spanning_tree(pairs: dict[tuple[int, int], Matrix], agreeing: NDArray[np.intp]) -> Matrix:
    """camera_from_rig (C, 4, 4) along the pairs with most instants in common (Prim 1957)."""
    count = len(agreeing)
    poses = np.tile(np.eye(4), (count, 1, 1))
    joined = {0}
    while len(joined) < count:
        weights = {
            (b, a): int(agreeing[a, b])
            for a in joined
            for b in range(count)
            if b not in joined and (b, a) in pairs
        }
        b, a = max(weights, key=lambda pair: weights[pair])
        poses[b] = pairs[b, a] @ poses[a]
        joined.add(b)
    return poses


def groups(connected: NDArray[np.intp]) -> list[list[int]]:
    """Cameras that are `connected` (C, C) directly or by others."""
    left, found = set(range(len(connected))), list[list[int]]()
    while left:
        group, front = set[int](), [min(left)]
        while front:
            at = front.pop()
            group.add(at)
            front += [b for b in left - group if connected[at, b] and b not in front]
        left -= group
        found.append(sorted(group))
    return found


def disconnected(names: Sequence[str], connected: NDArray[np.intp]) -> str:
    """Which cameras form groups, and which pairs would connect them."""
    found = groups(connected)
    shown = " and ".join("{" + ", ".join(names[c] for c in g) + "}" for g in found)
    pairs = [
        f"{names[a]} + {names[b]}" for x, y in combinations(found, 2) for a in x for b in y
    ]
    more = f" or {len(pairs) - 6} other pairs" if len(pairs) > 6 else ""
    return (
        f"the rig falls apart into {shown}: show the board at once to {', '.join(pairs[:6])}"
        f"{more}"
    )


def _mirrored(camera_from_board: Matrix, target: Target) -> Matrix:
    """The poses (V, 4, 4) that the boards would have were the pictures mirrored."""
    camera, board = np.diag([-1.0, 1, 1, 1]), np.diag([-1.0, 1, 1, 1])
    board[0, 3] = target.points()[..., 0].max()
    return camera @ camera_from_board @ board


def _boards(
    camera_from_rig: Matrix,
    camera_from_board: Matrix,
    seen: NDArray[np.bool_],
    motions: Matrix,
    board: Matrix,
) -> tuple[Matrix, NDArray[np.intp]]:
    """rig_from_board (F, 4, 4), and each camera's reading (C, F).

    Of an instant's boards the one is taken that agrees best with the others.
    """
    count, instants = seen.shape
    poses = np.tile(np.eye(4), (instants, 1, 1))
    turned = np.zeros((count, instants), np.intp)
    for v in range(instants):
        cameras = np.flatnonzero(seen[:, v])
        if not len(cameras):
            continue
        rig = np.linalg.inv(camera_from_rig[cameras])
        placed = rig @ camera_from_board[cameras, v]
        # (c, d, s): the board by camera d in reading s against that by camera c.
        points = np.einsum("cij,kj->cki", placed, board)[..., :3]
        others = np.einsum("dij,sjk,mk->dsmi", placed, motions, board, optimize=True)[..., :3]
        off = ((others[None] - points[:, None, None]) ** 2).sum(axis=-1).mean(axis=-1)
        distance = np.linalg.norm(points - rig[:, None, :3, 3], axis=-1).mean(axis=1)
        misfit = np.sqrt(off) / distance[:, None, None]
        best = int(np.argmin(np.minimum(misfit.min(axis=-1), 2 * AGREES).mean(axis=1)))
        poses[v] = placed[best]
        turned[cameras, v] = misfit[best].argmin(axis=-1)
    return poses, turned


def _medians(estimate: Estimate, board: Matrix, corners: Matrix) -> Matrix:
    """Median distance of each view's corners, infinite where the lens does not see it."""
    error = residuals(estimate, board, corners)
    length = np.hypot(error[..., 0], error[..., 1])
    length[np.isfinite(corners[..., 0]) & np.isnan(length)] = math.inf
    return np.nanmedian(length.reshape(len(corners), -1), axis=1)
