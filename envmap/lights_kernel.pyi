import numpy as np
from numpy.typing import NDArray

def moments(
    radiance: NDArray[np.float32], rows: int, cols: int, /
) -> tuple[NDArray[np.float64], int]: ...
def variance_cut(
    cells: NDArray[np.float64], count: int, relax: int, /
) -> tuple[NDArray[np.int32], NDArray[np.float64]]: ...
def summary(
    cells: NDArray[np.float64], /
) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...
