"""What a surface is made of: the metallic-roughness model of glTF 2.0, and glass.

The parameters are those of glTF 2.0 (Khronos 2021) and its extensions KHR_materials_clearcoat,
_transmission, _ior, _emissive_strength; textures multiply them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chromeball.scene.errors import UserError

type Color = tuple[float, float, float]
type Wrap = Literal["repeat", "clamp", "mirror"]


@dataclass(frozen=True, eq=False)
class Texture:
    """Pixels (h, w, C) float32, linear, row 0 at v = 0 as glTF has it; C is 1, 3 or 4."""

    pixels: NDArray[np.float32]
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")

    def __post_init__(self) -> None:
        if self.pixels.ndim != 3 or self.pixels.shape[2] not in (1, 3, 4):
            raise UserError(f"a texture of shape {self.pixels.shape}: (h, w, 1, 3 or 4) needed")
        if not self.pixels.size or not np.isfinite(self.pixels).all():
            raise UserError("a texture is empty, or has pixels that are NaN or infinite")


@dataclass(frozen=True)
class Material:
    """One material. All colours are linear.

    ``transmission`` of 1 is glass: smooth where ``roughness`` is 0, a sheet without refraction
    where ``thin``. A mirror is ``metallic`` 1, ``roughness`` 0. ``specular`` scales the
    reflectance of a dielectric that follows from ``ior``, and is what any surface reflects at
    grazing angles; 0 is a purely diffuse surface, or a metal alike at all angles.
    ``alpha_mode`` as in glTF: ``mask`` cuts at ``alpha_cutoff``, ``blend`` lets the share
    1 - alpha of the light straight through. ``metallic_roughness_texture``: roughness in
    channel 1, metallic in channel 2. ``normal_texture``: tangent space, 0..1.
    """

    base_color: Color = (0.5, 0.5, 0.5)
    metallic: float = 0.0
    roughness: float = 1.0
    specular: float = 1.0
    ior: float = 1.5
    transmission: float = 0.0
    thin: bool = False
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    emission: Color = (0.0, 0.0, 0.0)
    alpha: float = 1.0
    alpha_mode: Literal["opaque", "mask", "blend"] = "opaque"
    alpha_cutoff: float = 0.5
    normal_scale: float = 1.0
    base_color_texture: Texture | None = None
    metallic_roughness_texture: Texture | None = None
    normal_texture: Texture | None = None
    emission_texture: Texture | None = None

    def __post_init__(self) -> None:
        for name in (
            "metallic",
            "roughness",
            "specular",
            "transmission",
            "clearcoat",
            "clearcoat_roughness",
            "alpha",
            "alpha_cutoff",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise UserError(f"{name} is {getattr(self, name)}; it lies between 0 and 1")
        if not all(0 <= c <= 1 for c in self.base_color):
            raise UserError(f"base_color is {self.base_color}; it lies between 0 and 1")
        if not all(0 <= c < math.inf for c in self.emission):
            raise UserError(f"emission is {self.emission}; it is 0 or more, and finite")
        if not 1 <= self.ior <= 4:
            raise UserError(f"ior is {self.ior}; it lies between 1 and 4")

    def is_textured(self) -> bool:
        """Whether it needs texture coordinates."""
        textures = (
            self.base_color_texture,
            self.metallic_roughness_texture,
            self.normal_texture,
            self.emission_texture,
        )
        return any(texture is not None for texture in textures)

    @classmethod
    def diffuse(cls, color: Color, emission: Color = (0.0, 0.0, 0.0)) -> Material:
        """A Lambertian surface, without any gloss."""
        return cls(color, specular=0.0, emission=emission)

    @classmethod
    def mirror(cls, color: Color) -> Material:
        """A perfect mirror of the given reflectance."""
        return cls(color, metallic=1.0, roughness=0.0, specular=0.0)

    @classmethod
    def glass(cls, color: Color, ior: float = 1.5) -> Material:
        """Clear smooth glass; `color` is its transmittance at each surface."""
        return cls(color, roughness=0.0, ior=ior, transmission=1.0)
