import numpy as np
from numpy.typing import NDArray

type _Array = NDArray[np.float64]

def irradiance(cells: _Array, normals: _Array, /) -> _Array: ...
def prefilter(cells: _Array, directions: _Array, alpha: float, opening: float, /) -> _Array: ...
def reflected(
    cells: _Array, normals: _Array, views: _Array, alpha: float, /
) -> _Array: ...
