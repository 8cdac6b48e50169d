from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

def patches(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    knot: NDArray[np.uint16],
    size: int,
    spread: int,
) -> NDArray[np.uint16]: ...
def unchanging(
    frames: Sequence[NDArray[np.uint16]], least: float, bright: float
) -> NDArray[np.uint8]: ...
def comparagrams(
    frames: Sequence[NDArray[np.uint16]],
    pairs: Sequence[tuple[int, int]],
    skip: NDArray[np.uint8],
) -> NDArray[np.float32]: ...
def ridges(
    frames: Sequence[NDArray[np.uint16]],
    pairs: Sequence[tuple[int, int]],
    skip: NDArray[np.uint8],
) -> NDArray[np.float64]: ...
def accumulate(
    frames: Sequence[NDArray[np.uint16]], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]: ...
def residuals(
    frames: Sequence[NDArray[np.uint16]],
    weights: NDArray[np.float64],
    g: NDArray[np.float64],
    tau: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...
def merge_codes_u8(
    frames: Sequence[NDArray[np.uint8]],
    weight: NDArray[np.float64],
    exposure: NDArray[np.float64],
    taper: NDArray[np.float64],
    expected: NDArray[np.float32],
    saturated: NDArray[np.int64],
    times: NDArray[np.float64],
    weak: float,
    radiance: NDArray[np.float32],
    sigma: NDArray[np.float32] | None,
    clipped: NDArray[np.int8],
) -> NDArray[np.int64]: ...
def merge_codes_u16(
    frames: Sequence[NDArray[np.uint16]],
    weight: NDArray[np.float64],
    exposure: NDArray[np.float64],
    taper: NDArray[np.float64],
    expected: NDArray[np.float32],
    saturated: NDArray[np.int64],
    times: NDArray[np.float64],
    weak: float,
    radiance: NDArray[np.float32],
    sigma: NDArray[np.float32] | None,
    clipped: NDArray[np.int8],
) -> NDArray[np.int64]: ...
def merge_linear_u16(
    frames: Sequence[NDArray[np.uint16]],
    times: NDArray[np.float64],
    levels: NDArray[np.float32],
    columns: int,
    radiance: NDArray[np.float32],
    sigma: NDArray[np.float32] | None,
    clipped: NDArray[np.int8],
) -> NDArray[np.int64]: ...
def merge_linear_f32(
    frames: Sequence[NDArray[np.float32]],
    times: NDArray[np.float64],
    levels: NDArray[np.float32],
    columns: int,
    radiance: NDArray[np.float32],
    sigma: NDArray[np.float32] | None,
    clipped: NDArray[np.int8],
) -> NDArray[np.int64]: ...
def warp_u8(
    frame: NDArray[np.uint8], inverse: NDArray[np.float64], white: float, held: bool = True
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]: ...
def warp_u16(
    frame: NDArray[np.uint16], inverse: NDArray[np.float64], white: float, held: bool = True
) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]: ...
def warp_f32(
    frame: NDArray[np.float32], inverse: NDArray[np.float64], white: float, held: bool = True
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]: ...
def ghost_scores(
    frames: Sequence[NDArray[np.uint8]],
    table: NDArray[np.float64],
    ranges: NDArray[np.int32],
    valid: Sequence[NDArray[np.bool_]],
    misaligned: float,
) -> NDArray[np.uint8]: ...
