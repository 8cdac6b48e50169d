from typing import Self

import numpy as np
from numpy.typing import NDArray

class Projection:
    @classmethod
    def latlong(cls, width: int, height: int, /) -> Self: ...
    @classmethod
    def octahedral(cls, width: int, height: int, /) -> Self: ...
    @classmethod
    def cube(
        cls,
        width: int,
        height: int,
        face: int,
        axes: NDArray[np.float32],
        places: NDArray[np.float32],
        /,
    ) -> Self: ...
    @classmethod
    def radial(
        cls,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        max_angle: float,
        rim: float,
        radius: NDArray[np.float32],
        angle: NDArray[np.float32],
        density: NDArray[np.float32],
        /,
    ) -> Self: ...
    @classmethod
    def table(
        cls,
        width: int,
        height: int,
        nodes: int,
        pixels: NDArray[np.float32],
        directions: NDArray[np.float32],
        /,
    ) -> Self: ...
    def project(self, directions: NDArray[np.float64], /) -> NDArray[np.float64]: ...
    def unproject(self, pixels: NDArray[np.float64], /) -> NDArray[np.float64]: ...

class SolidAngles:
    def __init__(
        self,
        map: Projection,
        values: NDArray[np.float32],
        lines: NDArray[np.int64],
        columns: NDArray[np.int32],
        /,
    ) -> None: ...
    def rows(self, first: int, last: int, /) -> NDArray[np.float32]: ...
    def total(self) -> float: ...

class Resampling:
    def __init__(
        self,
        rgb: NDArray[np.float32],
        valid: NDArray[np.bool_] | None,
        variance: NDArray[np.float32] | None,
        source: SolidAngles,
        target: SolidAngles,
        source_from_target: NDArray[np.float64],
        cap: float,
        typical: float,
        smooth: bool,
        reach: float,
    ) -> None: ...
    def scatter(self, hot: NDArray[np.int64], /) -> None: ...
    def rows(
        self, first: int, last: int, /
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float32],
        NDArray[np.float32] | None,
        NDArray[np.float64],
    ]: ...
    def fast(
        self, energy: list[float] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64], list[float]]: ...
    def forget(self) -> None: ...
    def outside(self) -> list[float]: ...

def survey(
    rgb: NDArray[np.float32],
    valid: NDArray[np.bool_] | None,
    solid: SolidAngles,
    cap: float,
) -> tuple[NDArray[np.float64], int]: ...
def hot_pixels(
    rgb: NDArray[np.float32],
    valid: NDArray[np.bool_] | None,
    solid: SolidAngles,
    cap: float,
) -> NDArray[np.int64]: ...
