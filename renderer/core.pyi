from numpy import float32, uint8, uint32
from numpy.typing import NDArray

class Mesh:
    def __init__(
        self,
        vertices: NDArray[float32],
        normals: NDArray[float32] | None,
        faces: NDArray[uint32],
        albedo: NDArray[float32],
        emission: NDArray[float32],
        kind: NDArray[uint8],
        ior: NDArray[float32],
    ) -> None: ...

def path_trace(
    mesh: Mesh,
    corners: NDArray[float32],
    origin: tuple[float, float, float],
    spp: int,
    seed: int,
    bounces: int,
    environment: NDArray[float32] | None,
    irradiance: NDArray[float32] | None,
    gather_from: float,
) -> NDArray[float32]: ...
def irradiance(
    mesh: Mesh,
    points: NDArray[float32],
    normals: NDArray[float32],
    spp: int,
    seed: int,
    bounces: int,
) -> NDArray[float32]: ...
