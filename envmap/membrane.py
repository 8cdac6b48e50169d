"""A patch from the surroundings: a membrane over ln radiance, or a picture on top of it.

The membrane (Perez et al. 2003, guidance zero) solves Laplace's equation, so that the fill lies
between the darkest and the brightest of its border and cannot ring.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

type Picture = NDArray[np.float32]
type Mask = NDArray[np.bool_]

#: Blur of the border, pixels: its grain would be smeared inwards.
GRAIN = 2.0


def membrane(radiance: Picture, hole: Mask, seen: Mask) -> Picture:
    """Radiance (H, W, 3) with the `hole` filled from its border, where that is `seen`.

    Elsewhere the membrane ends freely.

    Raises
    ------
    UserError
        When nothing about the hole is seen.

    """
    import cv2
    from scipy import sparse
    from scipy.sparse.linalg import splu

    known = seen & ~hole
    ring = np.asarray(cv2.dilate(hole.astype(np.uint8), np.ones((3, 3), np.uint8))) > 0
    if not (ring & known).any():
        raise UserError("nothing about the hole is seen: there is nothing to fill it from")
    # ln(L + m): black borders stay finite, and no value is cut off
    middle = float(np.median(radiance[ring & known].mean(axis=1)))
    m = max(0.01 * middle, 1e-12)
    smooth = _local(np.log(radiance + np.float32(m)), known)
    number = np.full(hole.shape, -1)
    number[hole] = np.arange(int(hole.sum()))
    height, width = hole.shape
    count = int(hole.sum())
    degree, right = np.zeros(count), np.zeros((count, 3))
    rows, columns = [], []
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        y, x = np.nonzero(hole)
        v, u = y + dy, x + dx
        inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
        me, v, u = number[y, x][inside], v[inside], u[inside]
        unknown, border = hole[v, u], known[v, u]
        np.add.at(degree, me[unknown | border], 1)
        np.add.at(right, me[border], smooth[v, u][border])
        rows.append(me[unknown])
        columns.append(number[v, u][unknown])
    # what hangs on no border (an island in the unseen) is held at the middle, softly
    weak = 1e-9
    row, column = np.concatenate(rows), np.concatenate(columns)
    matrix = sparse.csc_matrix((-np.ones(len(row)), (row, column)), shape=(count, count))
    matrix = matrix + sparse.diags(degree + weak)
    right += weak * smooth[ring & known].mean(axis=0)
    solved = splu(matrix.tocsc()).solve(right)
    result = radiance.copy()
    result[hole] = np.maximum(np.exp(solved) - m, 0)  # rounding alone
    return result


def pasted(
    base: Picture, hole: Mask, picture: Picture, opacity: Picture, *, match: bool = True
) -> Picture:
    """A `picture` (h, w, 3) of `opacity` (h, w) laid over the `hole` of a view (H, W, 3).

    It is fitted about the hole. With `match` it is as bright as what it covers, on average.
    """
    import cv2

    y, x = np.nonzero(hole)
    side_y, side_x = int(np.ptp(y)) + 1, int(np.ptp(x)) + 1
    rows, columns = slice(y.min(), y.min() + side_y), slice(x.min(), x.min() + side_x)
    way = cv2.INTER_AREA if picture.shape[0] > side_y else cv2.INTER_LINEAR
    laid = np.zeros_like(base)
    over = np.zeros(hole.shape, np.float32)
    weighted = picture * opacity[..., None]
    laid[rows, columns] = cv2.resize(weighted, (side_x, side_y), interpolation=way)
    over[rows, columns] = cv2.resize(opacity, (side_x, side_y), interpolation=way)
    over = np.where(hole, over, 0)
    if match:
        covered = float((base * over[..., None])[hole].sum(dtype=np.float64))
        given = float(laid[hole].sum(dtype=np.float64))
        if given <= 0:
            raise UserError("the patch is black or has no opacity over the hole")
        laid *= np.float32(covered / given)
    return np.where(hole[..., None], base * (1 - over[..., None]) + laid, base)


def _local(log: Picture, known: Mask) -> NDArray[np.float64]:
    import cv2

    weight = known.astype(np.float32)
    blurred = cv2.GaussianBlur(log * weight[..., None], (0, 0), GRAIN)
    total = np.maximum(cv2.GaussianBlur(weight, (0, 0), GRAIN), 1e-6)
    return np.asarray(blurred / np.asarray(total)[..., None], np.float64)
