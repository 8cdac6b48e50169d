"""Square markers in a picture: black rims with a code inside, read however small or blurred.

OpenCV's search for quadrangles is kept, its reading is not. It decides bit by bit, and where
bits are hardly wider than the blur one wrong decision loses the marker. Here the cells of every
quadrangle, those that it gave up included, are compared as a whole with the board's own codes,
blurred alike. Markers whose corners touch, as an AprilGrid's, run into one another in the
search; there the picture's dark parts are first thinned by a few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from chromeball.calibrate.aprilgrid import Code

#: Least correlation of a quadrangle's cells with a code.
LEAST_SCORE = 0.7
#: By how much the best code must be ahead of the second.
LEAST_LEAD = 0.06
#: Least standard deviation of a marker's cells, codes.
LEAST_CONTRAST = 3.0
#: Spreads of the blur that codes are compared at, in cells.
BLURS = (0.2, 0.5, 0.8)
#: Samples along a cell.
FINE = 4
#: Pixels by which dark parts are thinned where markers touch.
THINNED = (3, 5, 9)
#: Enough of a board's markers to look no further.
ENOUGH = 0.8
#: How far a neighbour may be from where a marker expects it, in sides of the marker and steps.
NEIGHBOUR = 0.3


@dataclass(frozen=True)
class Markers:
    """What was read: ``numbers`` (N,) rows of :attr:`Code.bits`, ``scores`` (N,).

    ``outlines`` (N, 4, 2) are pixels, clockwise from the code's own upper left corner.
    """

    numbers: NDArray[np.int_]
    outlines: NDArray[np.float64]
    scores: NDArray[np.float64]


def read_markers(picture: NDArray[np.uint8], code: Code, touching: bool) -> Markers:
    """Each marker of `code` once, where it fits best; `touching` says that corners may meet."""
    templates = _templates(code)
    best: dict[int, tuple[float, NDArray[np.float64]]] = {}
    for search, margin in _variants(picture, touching):
        quads = _widened(_quadrangles(search), margin)
        if len(quads):
            for number, outline, score in _decode(picture, quads, code, templates):
                if score > best.get(number, (0.0, outline))[0]:
                    best[number] = score, outline
        if len(best) >= ENOUGH * len(code.bits):
            break
    numbers = sorted(best)
    return Markers(
        numbers=np.array(numbers, int),
        outlines=np.array([best[n][1] for n in numbers]).reshape(-1, 4, 2),
        scores=np.array([best[n][0] for n in numbers]),
    )


def consistent(markers: Markers, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the N `markers` agree on one board, (N,): the largest group of neighbours.

    `places` (K, 4, 2) are the outlines on the board. A marker's own homography says where its
    nearest neighbours should be, and theirs where it should be.
    """
    count = len(markers.numbers)
    board, seen = places[markers.numbers], markers.outlines
    centre, middle = board.mean(axis=1), seen.mean(axis=1)
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1)
    side = np.linalg.norm(board[:, 1] - board[:, 0], axis=-1)
    expects = np.zeros((count, count), bool)
    for i in range(count):
        h = _homographies(board[i : i + 1], seen[i : i + 1])[0]
        size = np.sqrt(abs(cv2.contourArea(seen[i].astype(np.float32))))
        near = [j for j in np.argsort(apart[i], kind="stable").tolist() if j != i][:8]
        for j in near:
            mapped = h @ [*centre[j], 1.0]
            if mapped[2] <= 0:
                continue
            miss = np.linalg.norm(mapped[:2] / mapped[2] - middle[j])
            expects[i, j] = miss < NEIGHBOUR * size * apart[i, j] / side[i]
    group = np.arange(count)
    for i, j in np.argwhere(expects & expects.T).tolist():
        group[group == group[j]] = group[i]
    if not count:
        return np.zeros(0, bool)
    names, sizes = np.unique(group, return_counts=True)
    return np.asarray(group == names[np.argmax(sizes)])


# ---- quadrangles


def _variants(
    picture: NDArray[np.uint8], touching: bool
) -> list[tuple[NDArray[np.uint8], float]]:
    """Pictures to search, and by how many pixels their quadrangles are too small."""
    if touching:
        thinned = [
            (np.asarray(cv2.dilate(picture, np.ones((k, k))), np.uint8), (k - 1) / 2)
            for k in THINNED
        ]
        return [*thinned, (picture, 0.0)]
    soft = cv2.GaussianBlur(picture, (0, 0), 2.5)
    sharp = np.asarray(cv2.addWeighted(picture, 3, soft, -2, 0), np.uint8)
    return [(picture, 0.0), (sharp, 0.0)]


def _quadrangles(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Dark quadrangles (N, 4, 2), clockwise, whatever is in them."""
    aruco: Any = cv2.aruco
    search = aruco.DetectorParameters()
    search.adaptiveThreshWinSizeMin = 5
    search.adaptiveThreshWinSizeMax = max(25, min(picture.shape) // 12 | 1)
    search.adaptiveThreshWinSizeStep = max(8, (search.adaptiveThreshWinSizeMax - 5) // 5)
    search.minMarkerPerimeterRate = 0.01
    search.polygonalApproxAccuracyRate = 0.05
    search.minDistanceToBorder = 1
    # One marker of many bits: its reading costs nothing, and all quadrangles are rejected.
    none = aruco.Dictionary(np.zeros((1, 8, 4), np.uint8), 8, 0)
    found, _, rejected = aruco.ArucoDetector(none, search).detectMarkers(picture)
    return np.array([*found, *rejected], float).reshape(-1, 4, 2)


def _widened(quads: NDArray[np.float64], margin: float) -> NDArray[np.float64]:
    """Sides (N, 4) moved outwards by `margin` pixels."""
    along = np.roll(quads, -1, axis=1) - quads
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    sound = (length[..., 0] > 1).all(axis=1)
    quads, along = quads[sound], along[sound] / length[sound]
    # In y-down pixels, clockwise, the outside is to the left of each side: (y, -x).
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    offset = (normal * quads).sum(axis=-1) + margin
    lines, before = normal, np.roll(normal, 1, axis=1)
    matrix = np.stack([before, lines], axis=-2)
    right = np.stack([np.roll(offset, 1, axis=1), offset], axis=-1)
    sound = (np.abs(np.linalg.det(matrix)) > 0.05).all(axis=1)
    return np.asarray(np.linalg.solve(matrix[sound], right[sound][..., None])[..., 0], float)


# ---- codes


def _templates(code: Code) -> NDArray[np.float64]:
    """Unit vectors of the inner cells, (blurs, K, 4 turns, b * b)."""
    b, n = code.bits.shape[1], code.cells
    whole = np.zeros((len(code.bits), n + 4, n + 4), np.float32)
    whole[:] = 1  # the paper about it
    whole[:, 2:-2, 2:-2] = 0
    whole[:, 2 + code.border : -2 - code.border, 2 + code.border : -2 - code.border] = code.bits
    first = (2 + code.border) * FINE
    vectors: list[NDArray[np.float64]] = []
    for blur in BLURS:
        inner = np.empty((len(whole), 4, b * b))
        for k, cells in enumerate(whole):
            fine = cv2.GaussianBlur(
                np.kron(cells, np.ones((FINE, FINE), np.float32)), (0, 0), blur * FINE
            )
            coarse = _inner(fine[None], first, b)[0]
            for turn in range(4):
                inner[k, turn] = np.rot90(coarse, turn).ravel()
        inner -= inner.mean(axis=-1, keepdims=True)
        vectors.append(inner / np.linalg.norm(inner, axis=-1, keepdims=True))
    return np.array(vectors)


def _inner(fine: NDArray[Any], first: int, b: int) -> NDArray[np.float64]:
    """Means of `b` x `b` cells from sample `first` on, (N, b, b)."""
    block = fine[:, first : first + b * FINE, first : first + b * FINE]
    return np.asarray(block.reshape(len(fine), b, FINE, b, FINE).mean(axis=(2, 4)), float)


def _decode(
    picture: NDArray[np.uint8],
    quads: NDArray[np.float64],
    code: Code,
    templates: NDArray[np.float64],
) -> list[tuple[int, NDArray[np.float64], float]]:
    """Number, outline and score of every quadrangle that is one of the codes."""
    b, n = code.bits.shape[1], code.cells
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    h = _homographies(np.broadcast_to(square, quads.shape), quads)
    steps = (np.arange(n * FINE) + 0.5) / (n * FINE)
    x, y = np.meshgrid(steps, steps)
    mapped = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.swapaxes(h, 1, 2)
    pixels = (mapped[..., :2] / mapped[..., 2:]).astype(np.float32)
    seen = cv2.remap(picture, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
    fine = np.asarray(seen, np.float32).reshape(len(quads), n * FINE, n * FINE)
    inner = _inner(fine, code.border * FINE, b).reshape(len(quads), -1)
    rim = np.ones((n * FINE, n * FINE), bool)
    rim[FINE:-FINE, FINE:-FINE] = False
    darker = fine[:, rim].mean(axis=1) < inner.mean(axis=1)
    spread = inner.std(axis=1)
    vector = inner - inner.mean(axis=1, keepdims=True)
    vector /= np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-9)
    shape = templates.shape[:3]
    scores = (vector @ templates.reshape(-1, b * b).T).reshape(len(quads), *shape).max(axis=1)
    flat = np.sort(scores.reshape(len(quads), -1), axis=1)
    lead = flat[:, -1] - flat[:, -2] if flat.shape[1] > 1 else flat[:, -1]
    sure = darker & (spread > LEAST_CONTRAST) & (flat[:, -1] > LEAST_SCORE)
    sure &= lead > LEAST_LEAD
    found: list[tuple[int, NDArray[np.float64], float]] = []
    for i in np.flatnonzero(sure).tolist():
        number, turn = divmod(int(scores[i].argmax()), 4)
        # Seen turned to the left by `turn` quarters, the code's first corner is that many back.
        found.append((number, np.roll(quads[i], turn, axis=0), float(flat[i, -1])))
    return found


def _homographies(
    places: NDArray[np.float64], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Exact homographies of four points each, (N, 4, 2) twice -> (N, 3, 3)."""
    x, y = places[..., 0], places[..., 1]
    u, v = pixels[..., 0], pixels[..., 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=-1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=-1),
        ],
        axis=1,
    )
    right = np.concatenate([u, v], axis=1)[..., None]
    sound = np.abs(np.linalg.det(rows)) > 1e-12
    h = np.tile(np.eye(3), (len(x), 1, 1)).reshape(-1, 9)
    h[sound, :8] = np.linalg.solve(rows[sound], right[sound])[..., 0]
    return h.reshape(-1, 3, 3)
