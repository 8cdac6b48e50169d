"""Wavefront OBJ with its materials (MTL, with the extension for physically based ones).

tinyobjloader crashes on broken files and reads NaN as 0: the text is read by the C++ core.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chromeball.renderer import files, mtl
from chromeball.renderer.material import Color, Material, Texture, Wrap
from chromeball.renderer.part import Part, say
from chromeball.renderer.read_ply import triangles
from chromeball.renderer.texture import TextureCache, read_texture
from chromeball.scene.errors import UserError


def read_obj(path: Path) -> list[Part]:
    """The one part of an OBJ file, with the materials of its libraries.

    Raises
    ------
    UserError
        With the line, when a number is none or a face names what is not there; when a
        material is not to be found or is broken.

    """
    try:
        p, t, n, vertices, sizes, corners, material, names, libraries, left_out = (
            files.read_obj(path.read_bytes())
        )
        if len(sizes) == 0:
            raise UserError("the mesh has no faces", file=path)
        if left_out:
            say(path, f"{left_out} lines and points are left out")
        bad = int((~np.isfinite(p).all(axis=1)).sum())
        if bad:
            raise UserError(f"{bad} vertices are NaN or infinite; repair the mesh", file=path)
        positions = p[vertices[:, 0]]
        uv = normals = None
        if (vertices[:, 1] >= 0).any():
            uv = np.where(vertices[:, 1:2] >= 0, t[vertices[:, 1]], np.float32(0))
            uv[:, 1] = 1 - uv[:, 1]  # v is up in OBJ
        if (vertices[:, 2] >= 0).any():
            normals = np.where(vertices[:, 2:] >= 0, n[vertices[:, 2]], np.float32(0))
        if (sizes == 3).all():
            faces, of = triangles(positions, sizes, corners), None
        else:
            at, of = files.triangulate(positions, sizes, corners)
            faces = corners[at].view(np.uint32)
    except ValueError as error:
        raise UserError(f"not a readable mesh: {error}", file=path) from error
    face_material = material if of is None else material[of]
    used = np.unique(face_material)
    if len(used) == 1 and used[0] < 0:
        return [Part(positions, faces, normals, uv)]
    if len(used) > 65535:
        raise UserError(f"{len(used)} materials are too many", file=path)
    known = _libraries(path, libraries)
    missing = [names[i] for i in used if i >= 0 and names[i] not in known]
    if missing and libraries:
        raise UserError(
            f"no material {missing[0]!r} in {', '.join(libraries)}; export it again", file=path
        )
    if missing:  # named, but no library: as if it had none
        return [Part(positions, faces, normals, uv)]
    materials = tuple(Material() if i < 0 else known[names[i]] for i in used)
    index = np.searchsorted(used, face_material).astype(np.uint16)
    return [Part(positions, faces, normals, uv, index, materials)]


def _libraries(path: Path, libraries: list[str]) -> dict[str, Material]:
    known: dict[str, Material] = {}
    cache = TextureCache()
    for library in libraries:
        files_ = mtl.library_files(path, library)
        if not files_:
            raise UserError(
                f"its materials {library!r} are not there; put them beside", file=path
            )
        for file in files_:
            for name, lines in mtl.blocks(file).items():
                try:
                    known[name] = _Mtl(file, name, lines, cache).material()
                except UserError as error:
                    where = error.file or file
                    raise UserError(f"material {name!r}: {error.what}", file=where) from error
    return known


class _Mtl:
    """One material of a library."""

    def __init__(
        self, file: Path, name: str, lines: dict[str, str], cache: TextureCache
    ) -> None:
        self.file, self.name, self.lines, self.cache = file, name, lines, cache

    def number(self, key: str, default: float) -> float:
        text = self.lines.get(key)
        if text is None:
            return default
        word = text.split()[0]
        if not mtl.is_number(word):
            raise UserError(f"{key} {text:.40} is no number")
        return float(word)

    def color(self, key: str, default: float) -> Color:
        text = self.lines.get(key)
        if text is None:
            return default, default, default
        words = text.split()
        if words[0] in ("spectral", "xyz") or not all(map(mtl.is_number, words[:3])):
            raise UserError(f"{key} {text:.40} is no RGB colour")
        values = [float(word) for word in words[:3]]
        r, g, b = values if len(values) == 3 else values[:1] * 3
        return r, g, b

    def texture(self, key: str, *, color: bool) -> Texture | None:
        text = self.lines.get(key)
        if text is None:
            return None
        map_ = mtl.parse_map(text)
        if map_.left_out:
            say(self.file, f"{self.name}: {key} without its {', '.join(map_.left_out)}")
        path = mtl.beside(self.file, map_.name)
        if "\0" in map_.name or not path.is_file():
            raise UserError(f"its {key}, {map_.name!r}, is not there; put it beside")
        mode: Wrap = "clamp" if map_.clamp else "repeat"
        wrap = (mode, mode)
        return self.cache.get(
            (path, color, wrap), lambda: read_texture(path, color=color, wrap=wrap)
        )

    def material(self) -> Material:
        illum = round(self.number("illum", 2.0))
        alpha = self.number("d", 1 - self.number("Tr", 0.0))
        emission = self.color("Ke", 0.0)
        base = self.color("Kd", 0.5)
        specular = max(self.color("Ks", 0.0)) > 0 and illum not in (0, 1)
        rough = (2 / (max(self.number("Ns", 0.0), 0.0) + 2)) ** 0.25  # Blinn to GGX
        physical = "Pr" in self.lines or "Pm" in self.lines
        if illum in (4, 6, 7, 9) and not physical:
            tint = self.color("Tf", 1.0)
            return Material.glass(tint, max(1.0, self.number("Ni", 1.5)))
        if illum in (3, 5) and not physical and max(base) == 0:
            return Material.mirror(self.color("Ks", 1.0))
        for key in ("map_Bump", "map_bump", "bump", "disp", "map_Ks", "map_Ns", "refl"):
            if key in self.lines:
                say(self.file, f"{self.name}: {key} is not used")
        strength = mtl.parse_map(self.lines["norm"]).strength if "norm" in self.lines else 1.0
        cut = "map_d" in self.lines
        return Material(
            base_color=base,
            metallic=self.number("Pm", 0.0),
            roughness=self.number("Pr", 0.5) if physical else rough,
            specular=1.0 if physical or specular else 0.0,
            ior=max(1.0, self.number("Ni", 1.5)),
            clearcoat=self.number("Pc", 0.0),
            clearcoat_roughness=self.number("Pcr", 0.0),
            emission=emission,
            alpha=alpha,
            alpha_mode="blend" if alpha < 1 or cut else "opaque",
            normal_scale=strength,
            base_color_texture=self.base_texture(),
            metallic_roughness_texture=self.rough_texture(),
            normal_texture=self.texture("norm", color=False),
            emission_texture=self.texture("map_Ke", color=True),
        )

    def base_texture(self) -> Texture | None:
        """``map_Kd`` with ``map_d`` as its alpha."""
        color, alpha = self.texture("map_Kd", color=True), self.texture("map_d", color=False)
        if alpha is None:  # an alpha channel is not meant where no map_d says so
            if color is None or color.pixels.shape[2] < 4:
                return color
            return Texture(np.ascontiguousarray(color.pixels[..., :3]), color.wrap)
        share = alpha.pixels[..., -1:] if alpha.pixels.shape[2] == 4 else alpha.pixels[..., :1]
        if color is None:
            rgb = np.ones((*share.shape[:2], 3), np.float32)
            return Texture(np.concatenate([rgb, share], axis=2), alpha.wrap)
        rgb = np.broadcast_to(color.pixels[..., :3], (*color.pixels.shape[:2], 3))
        if rgb.shape[:2] != share.shape[:2]:
            raise UserError("map_Kd and map_d differ in size; make them equal")
        return Texture(np.concatenate([rgb, share], axis=2), color.wrap)

    def rough_texture(self) -> Texture | None:
        """``map_Pr`` and ``map_Pm`` as glTF has them: channels 1 and 2."""
        rough = self.texture("map_Pr", color=False)
        metal = self.texture("map_Pm", color=False)
        one = rough or metal
        if one is None:
            return None
        if rough and metal and rough.pixels.shape[:2] != metal.pixels.shape[:2]:
            raise UserError("map_Pr and map_Pm differ in size; make them equal")
        pixels = np.ones((*one.pixels.shape[:2], 3), np.float32)
        for channel, texture in ((1, rough), (2, metal)):
            if texture is not None:
                pixels[..., channel] = texture.pixels[..., 0]
        return Texture(pixels, one.wrap)
