import numpy as np
from numpy.typing import NDArray

def demosaic(
    mosaic: NDArray[np.float32], row: int, column: int
) -> NDArray[np.float32]: ...
