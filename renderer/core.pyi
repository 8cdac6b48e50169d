from numpy import float32, uint8, uint16, uint32
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

class StandIn:
    def __init__(
        self,
        vertices: NDArray[float32],
        original: NDArray[float32],
        faces: NDArray[uint32],
        surface: NDArray[uint8],
    ) -> None: ...

class Compositor:
    def __init__(
        self,
        objects: Mesh,
        bounds: NDArray[float32],
        stand_in: StandIn,
        environment: NDArray[float32],
        origin: tuple[float, float, float],
        bounces: int,
        seed: int,
        samples: int,
    ) -> None: ...
    def add(
        self,
        corners: NDArray[float32],
        camera: tuple[float, float, float],
        plate: NDArray[float32],
        difference: bool,
        counts: NDArray[uint16],
        film: NDArray[float32],
    ) -> int: ...
    def background(
        self, corners: NDArray[float32], camera: tuple[float, float, float], count: int
    ) -> NDArray[float32]: ...
    def irradiance(
        self, point: tuple[float, float, float], normal: tuple[float, float, float]
    ) -> list[float]: ...
