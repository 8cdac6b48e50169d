from numpy import float32, uint32
from numpy.typing import NDArray

class ShadowBench:
    def __init__(self, vertices: NDArray[float32], faces: NDArray[uint32]) -> None: ...
    def ours(
        self,
        points: NDArray[float32],
        normals: NDArray[float32],
        lights: NDArray[float32],
        irradiance: NDArray[float32],
    ) -> None: ...
    def bare(
        self,
        origins: NDArray[float32],
        directions: NDArray[float32],
        visible: NDArray[float32],
    ) -> None: ...
