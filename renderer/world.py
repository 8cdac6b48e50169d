"""Objects for the C++ core: each mesh once, however often it stands in the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from chromeball.renderer import core
from chromeball.renderer.delta_light import DeltaLight
from chromeball.renderer.material import Material, Texture, Wrap
from chromeball.renderer.mesh import Instance, Mesh, Values
from chromeball.scene.errors import UserError

#: Metres from where the core counts; far beyond, squares of areas leave float32.
_FARTHEST = 1e8
_ALPHA_MODES = ("opaque", "mask", "blend")
_WRAPS: tuple[Wrap, ...] = get_args(Wrap.__value__)


def world(
    objects: Sequence[Mesh | Instance],
    lights: Sequence[DeltaLight] = (),
    about: Values = (0.0, 0.0, 0.0),
) -> core.World:
    """The core's scene of these objects, in their order; a mesh stands where its vertices are.

    The core counts from the place ``about``, so that its float32 are fine where the scene is,
    however far that is from the world's origin.

    Objects that share a :class:`Mesh` share one copy of it and one BVH; materials and textures
    that are equal are stored once. Raises UserError for objects 1e8 m away or large.
    """
    built = core.World()
    textures: dict[Texture, int] = {}
    materials: dict[Material, int] = {}
    meshes: dict[int, int] = {}

    def texture(value: Texture | None) -> int:
        if value is None:
            return -1
        if value not in textures:
            pixels = np.ascontiguousarray(value.pixels, np.float32)
            wrap = (_WRAPS.index(value.wrap[0]), _WRAPS.index(value.wrap[1]))
            textures[value] = built.add_texture(pixels, wrap)
        return textures[value]

    def material(m: Material) -> int:
        if m not in materials:
            materials[m] = built.add_material(
                base=m.base_color,
                metallic=m.metallic,
                roughness=m.roughness,
                specular=m.specular,
                ior=m.ior,
                transmission=m.transmission,
                thin=m.thin,
                clearcoat=m.clearcoat,
                clearcoat_roughness=m.clearcoat_roughness,
                emission=m.emission,
                alpha=m.alpha,
                alpha_mode=_ALPHA_MODES.index(m.alpha_mode),
                alpha_cutoff=m.alpha_cutoff,
                normal_scale=m.normal_scale,
                textures=(
                    texture(m.base_color_texture),
                    texture(m.metallic_roughness_texture),
                    texture(m.normal_texture),
                    texture(m.emission_texture),
                ),
            )
        return materials[m]

    def mesh(m: Mesh) -> int:
        if id(m) not in meshes:
            numbers = np.array([material(x) for x in m.materials], np.uint32)
            meshes[id(m)] = built.add_mesh(
                np.ascontiguousarray(m.vertices, np.float32),
                None if m.normals is None else np.ascontiguousarray(m.normals, np.float32),
                None if m.uv is None else np.ascontiguousarray(m.uv, np.float32),
                np.ascontiguousarray(m.faces, np.uint32),
                numbers[m.material],
            )
        return meshes[id(m)]

    for thing in objects:
        instance = thing if isinstance(thing, Instance) else Instance(thing)
        steps = np.array([moved_back(matrix, about) for matrix in instance.matrices()])
        check_reach(extent(instance.mesh.vertices), steps)
        built.place(mesh(instance.mesh), steps)
    for light in lights:
        p = light.position
        built.add_light(
            None if p is None else triple(np.subtract(p, about)),
            light.intensity,
            light.direction,
            light.cos_inner,
            light.cos_outer,
        )
    built.commit()
    return built


def extent(vertices: NDArray[np.float32]) -> NDArray[np.float64]:
    """The largest magnitude of each coordinate (3,) of vertices (V, 3); 0 of none."""
    return np.abs(vertices).max(axis=0, initial=0).astype(float)


def check_reach(extent: NDArray[np.float64], steps: NDArray[np.float64]) -> None:
    """Raise UserError where transforms (..., 3, 4) put a mesh of that extent too far away."""
    reach = float((np.abs(steps[..., :3]) @ extent + np.abs(steps[..., 3])).max())
    if not reach <= _FARTHEST:
        raise UserError(
            f"an object reaches {reach:.3g} m from the light probe, {_FARTHEST:.0e} m is the "
            "most: is its scale right?"
        )


def moved_back(matrix: NDArray[np.float64], about: Values) -> NDArray[np.float64]:
    """A (3, 4) transform into coordinates that count from ``about``."""
    return np.column_stack([matrix[:, :3], matrix[:, 3] - np.asarray(about, float)])


def triple(value: Values) -> tuple[float, float, float]:
    """Three numbers as the core takes them."""
    x, y, z = (float(v) for v in np.asarray(value, float))
    return x, y, z
