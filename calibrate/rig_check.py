"""Rigs that cannot be: copied folders, wrong pairs, a camera that was moved meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

#: Two cameras of a rig never see one board at the same pixels, to this.
SAME_PIXELS = 1e-3
#: A board does not fit where so large a share of its corners was rejected.
UNFIT = 0.6
#: A camera with so large a share of boards that do not fit has other pictures.
MOST_UNFIT = 0.4
#: A camera may have moved if so many of its boards do not fit, or it is so many times less
#: exact in the rig than by itself.
DOUBTED, LESS_EXACT = 0.1, 1.2
#: It did if its pose before one other camera scatters so many times less about two places.
PARTED = 2.5
#: Boards on each side of a move.
FEWEST_BOARDS = 3


@dataclass(frozen=True)
class Move:
    """Two cameras that stand ``shift`` metres otherwise at ``after`` than at ``before``.

    These are instants. Poses scatter ``clear`` times less about two places than about one.
    """

    pair: tuple[int, int]
    before: int
    after: int
    shift: float
    clear: float


def check_copies(corners: NDArray[np.float64], names: Sequence[str]) -> None:
    """No two cameras have the same pictures, by their `corners` (C, F, rows, columns, 2)."""
    for a, b in combinations(range(len(corners)), 2):
        off = np.abs(corners[a] - corners[b]).max(axis=-1)
        both = np.isfinite(off).any(axis=(1, 2))
        same = np.nanmax(np.where(both[:, None, None], off, 0), axis=(1, 2))[both] < SAME_PIXELS
        if same.sum() > 1 and same.mean() > 0.5:
            raise UserError(
                f"cameras {names[a]} and {names[b]} have the same pictures: one of the folders "
                "is a copy of the other"
            )


def unfit_boards(
    corners: NDArray[np.float64], error: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """How many boards of each camera do not fit, (C,), of how many that others see, too."""
    found, fits = np.isfinite(corners[..., 0]), np.isfinite(error[..., 0])
    count = found.sum(axis=(2, 3))
    common = (count > 0) & ((count > 0).sum(axis=0) > 1)
    unfit = common & (fits.sum(axis=(2, 3)) < (1 - UNFIT) * count)
    return unfit.sum(axis=1), common.sum(axis=1)


def check_fit(
    corners: NDArray[np.float64],
    error: NDArray[np.float64],
    poses: NDArray[np.float64],
    exactness: NDArray[np.float64],
    names: Sequence[str],
    labels: Sequence[str],
) -> None:
    """All cameras stood still, and their pictures are paired.

    `corners` and `error` (C, F, rows, columns, 2), the latter NaN where rejected; `poses`
    (C, F, 4, 4) camera_from_board by itself, NaN where there is none; `exactness` (C,) how
    many times less exact a camera is here than by itself.

    Raises
    ------
    UserError
        When a camera moved, or too many of its boards do not fit.

    """
    unfit, common = unfit_boards(corners, error)
    share = unfit / np.maximum(common, 1)
    doubted = (share > DOUBTED) | (exactness > LESS_EXACT)
    if doubted.any() and (moves := find_moves(poses)):
        often = np.bincount([c for move in moves for c in move.pair])
        most = [names[int(c)] for c in np.flatnonzero(often == often.max())]
        move = max(moves, key=lambda move: move.clear)
        raise UserError(
            f"camera {' or '.join(most)} was moved, by {1000 * move.shift:.2g} mm or so, "
            f"between pictures {labels[move.before]} and {labels[move.after]}: calibrate those "
            "before and after apart"
        )
    worst = int(share.argmax())
    if share[worst] > MOST_UNFIT and unfit[worst] > 1:
        raise UserError(
            f"camera {names[worst]}: {unfit[worst]} of its {common[worst]} boards do not fit "
            "the other cameras: are its pictures paired with theirs (names, numbers, --times), "
            "and is it the same board?"
        )


def find_moves(poses: NDArray[np.float64]) -> list[Move]:
    """Pairs of cameras that stand otherwise from some instant on.

    Each board that both see gives the pose of one before the other. Their summed distances to
    a median are compared with those to two medians, before and after (least absolute
    deviations: a stray board does not count).
    """
    moves: list[Move] = []
    for pair in combinations(range(len(poses)), 2):
        both = np.flatnonzero(np.isfinite(poses[list(pair)]).all(axis=(0, 2, 3)))
        if len(both) < 2 * FEWEST_BOARDS:
            continue
        stands = _relative(*poses[list(pair)][:, both])
        splits = range(FEWEST_BOARDS, len(both) - FEWEST_BOARDS + 1)
        parted = [_scatter(stands[:k]) + _scatter(stands[k:]) for k in splits]
        best = int(np.argmin(parted))
        clear = _scatter(stands) / max(parted[best], 1e-300)
        if clear > PARTED:
            k = splits[best]
            jump = np.median(stands[k:], axis=0) - np.median(stands[:k], axis=0)
            shift = float(np.linalg.norm(jump[3:]))
            moves.append(Move(pair, int(both[k - 1]), int(both[k]), shift, clear))
    return moves


def _relative(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn from a middle pose, times the distance of the board, and place, (N, 6).

    A turn counts as it shows at the board.
    """
    from scipy.spatial.transform import Rotation

    frames = first @ np.linalg.inv(second)
    turns = Rotation.from_matrix(frames[:, :3, :3])
    far = float(np.median(np.linalg.norm(first[:, :3, 3], axis=1)))
    return np.hstack([far * (turns[0].inv() * turns).as_rotvec(), frames[:, :3, 3]])


def _scatter(values: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(values - np.median(values, axis=0), axis=1).sum())
