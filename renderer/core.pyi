from numpy import float32, float64, uint8, uint16, uint32
from numpy.typing import NDArray

class World:
    def __init__(self) -> None: ...
    def add_light(
        self,
        position: tuple[float, float, float] | None,
        intensity: tuple[float, float, float],
        direction: tuple[float, float, float],
        cos_inner: float,
        cos_outer: float,
    ) -> None: ...
    def add_texture(self, pixels: NDArray[float32], wrap: tuple[int, int]) -> int: ...
    def add_material(
        self,
        *,
        base: tuple[float, float, float],
        metallic: float,
        roughness: float,
        specular: float,
        ior: float,
        transmission: float,
        thin: bool,
        clearcoat: float,
        clearcoat_roughness: float,
        emission: tuple[float, float, float],
        alpha: float,
        alpha_mode: int,
        alpha_cutoff: float,
        normal_scale: float,
        textures: tuple[int, int, int, int],
    ) -> int: ...
    def add_mesh(
        self,
        vertices: NDArray[float32],
        normals: NDArray[float32] | None,
        uv: NDArray[float32] | None,
        faces: NDArray[uint32],
        material: NDArray[uint32],
    ) -> int: ...
    def place(self, mesh: int, matrices: NDArray[float64]) -> int: ...
    def commit(self) -> None: ...
    def hits(
        self, origins: NDArray[float32], directions: NDArray[float32]
    ) -> NDArray[float32]: ...
    def evaluate(
        self,
        origin: tuple[float, float, float],
        ray: tuple[float, float, float],
        directions: NDArray[float32],
    ) -> NDArray[float32]: ...
    def scatter(
        self,
        origin: tuple[float, float, float],
        ray: tuple[float, float, float],
        count: int,
        seed: int,
    ) -> NDArray[float32]: ...
    def transmittance(
        self, origins: NDArray[float32], directions: NDArray[float32]
    ) -> NDArray[float32]: ...

class Camera:
    def __init__(
        self,
        *,
        corners: NDArray[float32],
        origin: tuple[float, float, float],
        filter: NDArray[float32] | None,
        radius: float,
        focus: float,
        axis: tuple[float, float, float],
        shutter: bool,
        shift: tuple[float, float, float],
        pivot: tuple[float, float, float],
        angle: float,
    ) -> None: ...

def path_trace(
    world: World,
    camera: Camera,
    spp: int,
    seed: int,
    bounces: int,
    environment: NDArray[float32] | None,
    irradiance: NDArray[float32] | None,
    gather_from: float,
) -> NDArray[float32]: ...
def irradiance(
    world: World,
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
        objects: World,
        stand_in: StandIn,
        environment: NDArray[float32],
        origin: tuple[float, float, float],
        bounces: int,
        seed: int,
        samples: int,
    ) -> None: ...
    def set_gloss(self, reflectance: float, roughness: float) -> None: ...
    def place(self, objects: World) -> None: ...
    def set_others(
        self, environments: list[NDArray[float32]], origins: NDArray[float32]
    ) -> None: ...
    def move(self, object: int, matrices: NDArray[float64]) -> None: ...
    def add(
        self,
        camera: Camera,
        plate: NDArray[float32],
        difference: bool,
        reflects_plate: bool,
        counts: NDArray[uint16],
        caustics: tuple[int, int, int],
        film: NDArray[float32],
    ) -> int: ...
    def background(self, camera: Camera, count: int) -> NDArray[float32]: ...
    def irradiance(
        self, point: tuple[float, float, float], normal: tuple[float, float, float]
    ) -> list[float]: ...

class Direct:
    def __init__(self, scene: Compositor, seed: int) -> None: ...
    def objects_moved(self) -> None: ...
    def begin(self, height: int, width: int) -> None: ...
    def add(
        self, corners: NDArray[float32], camera: tuple[float, float, float], samples: int
    ) -> int: ...
    def resolve(
        self,
        corners: NDArray[float32],
        camera: tuple[float, float, float],
        plate: NDArray[float32],
        difference: bool,
        filter: bool,
        layers: bool,
    ) -> tuple[NDArray[float32], NDArray[float32], int]: ...
