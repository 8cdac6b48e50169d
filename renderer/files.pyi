from numpy import float32, int32, uint32
from numpy.typing import NDArray

def read_obj(
    data: bytes,
) -> tuple[
    NDArray[float32],
    NDArray[float32],
    NDArray[float32],
    NDArray[int32],
    NDArray[int32],
    NDArray[int32],
    NDArray[int32],
    list[str],
    list[str],
    int,
]:
    """Positions (P, 3), uv (T, 2), normals (N, 3); vertices (V, 3) that name them, -1: none;
    corners of each face (F,), vertices of the corners (C,), material of each face (F,), -1:
    none; names of materials, libraries; how many lines and points were left out. ValueError
    says what is wrong in which line."""

def read_ply_rows(
    data: bytes, offset: int, format: int, count: int, properties: list[tuple[str, str, bool]]
) -> tuple[list[tuple[NDArray[int32], NDArray[float32] | NDArray[int32]]], int]:
    """`count` rows of an element from `offset`: sizes (of lists) and values of each property,
    and where the rows end. `format`: 0 text, 1 little endian, 2 big endian; a property is the
    type of its list's length or "", its own type (b B h H i I f d), and whether to keep it."""

def triangulate(
    vertices: NDArray[float32], sizes: NDArray[int32], corners: NDArray[int32]
) -> tuple[NDArray[uint32], NDArray[uint32]]:
    """Polygons as triangles: (T, 3) places in `corners`, (T,) the polygon of each."""
