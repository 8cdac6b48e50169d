from numpy import float32, uint32
from numpy.typing import NDArray

class RayBench:
    def __init__(self, vertices: NDArray[float32], faces: NDArray[uint32]) -> None: ...
    def shadow_ours(
        self,
        points: NDArray[float32],
        normals: NDArray[float32],
        lights: NDArray[float32],
        irradiance: NDArray[float32],
    ) -> None: ...
    def shadow_bare(
        self,
        origins: NDArray[float32],
        directions: NDArray[float32],
        visible: NDArray[float32],
    ) -> None: ...
    def look_ours(
        self,
        corners: NDArray[float32],
        camera: tuple[float, float, float],
        distance: NDArray[float32],
    ) -> None: ...
    def look_bare(
        self,
        camera: tuple[float, float, float],
        directions: NDArray[float32],
        distance: NDArray[float32],
    ) -> None: ...
