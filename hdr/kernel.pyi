from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

def patches(image: NDArray[np.uint8], size: int, spread: int) -> NDArray[np.uint16]: ...
def shares(
    frames: Sequence[NDArray[np.uint16]], weights: NDArray[np.float64]
) -> NDArray[np.float32]: ...
def accumulate(
    frames: Sequence[NDArray[np.uint16]],
    weights: NDArray[np.float64],
    share: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]: ...
def residuals(
    frames: Sequence[NDArray[np.uint16]],
    weights: NDArray[np.float64],
    share: NDArray[np.float32],
    g: NDArray[np.float64],
    tau: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...
def merge_codes(
    frames: Sequence[NDArray[np.uint8]],
    weight: NDArray[np.float64],
    exposure: NDArray[np.float64],
    times: NDArray[np.float64],
    with_sigma: bool,
) -> tuple[
    NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.int8], NDArray[np.int64]
]: ...
def merge_linear_u16(
    frames: Sequence[NDArray[np.uint16]],
    times: NDArray[np.float64],
    white: float,
    gain: float,
    read: float,
    with_sigma: bool,
) -> tuple[
    NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.int8], NDArray[np.int64]
]: ...
def merge_linear_f32(
    frames: Sequence[NDArray[np.float32]],
    times: NDArray[np.float64],
    white: float,
    gain: float,
    read: float,
    with_sigma: bool,
) -> tuple[
    NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.int8], NDArray[np.int64]
]: ...
