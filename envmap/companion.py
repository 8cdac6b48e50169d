"""The small file beside an exported map that tells a program how to load it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

from chromeball.envmap.orientation import Convention, convention_of
from chromeball.scene.errors import UserError


@dataclass(frozen=True)
class Dome:
    """What a companion says.

    ``file`` is the map's name in the same folder. ``turned``: its pixels are turned already,
    else the program is told to turn it. ``intensity`` multiplies its values; ``absolute``: the
    product is cd/m^2. ``origin`` is where the map was seen from, metres, or None.
    """

    file: str
    turned: bool
    intensity: float
    absolute: bool
    origin: Sequence[float] | None


def companion(program: str, dome: Dome) -> tuple[str, str]:
    """Suffix and text of the file for a program of `orientation.CONVENTIONS`.

    Raises
    ------
    UserError
        For an unknown program, or a name that its files cannot hold.

    """
    convention = convention_of(program)
    if not dome.file.isprintable() or "@" in dome.file:
        raise UserError(f"{dome.file!r}: name it with letters, digits and _ . - alone")
    suffix, write = _WRITERS[program]
    return suffix, write(dome, convention)


def _usd(dome: Dome, convention: Convention) -> str:
    unit = "cd/m^2" if dome.absolute else "relative units"
    return f"""#usda 1.0
(
    defaultPrim = "Environment"
    doc = "The light around a point, in {unit}."
    metersPerUnit = 1
    upAxis = "Y"
)

def DomeLight "Environment"
{{
    float inputs:intensity = {dome.intensity:.9g}
    asset inputs:texture:file = @./{dome.file}@
    token inputs:texture:format = "latlong"
}}
"""


def _mitsuba(dome: Dome, convention: Convention) -> str:
    return f"""<!-- <include filename="..."/> this into a scene with +Y up. -->
<scene version="3.0.0">
    <emitter type="envmap">
        <string name="filename" value={quoteattr(dome.file)}/>
        <float name="scale" value="{dome.intensity:.9g}"/>
    </emitter>
</scene>
"""


def _blender(dome: Dome, convention: Convention) -> str:
    # the node turns the direction that is looked up, not the picture
    angle = 0.0 if dome.turned else -convention.yaw
    return f'''"""Run in Blender (blender --python): the map becomes the scene's world."""

import pathlib

import bpy

world = bpy.data.worlds.new("Environment")
if world.node_tree is None:
    world.use_nodes = True
nodes, links = world.node_tree.nodes, world.node_tree.links
nodes.clear()
coordinate = nodes.new("ShaderNodeTexCoord")
mapping = nodes.new("ShaderNodeMapping")
texture = nodes.new("ShaderNodeTexEnvironment")
background = nodes.new("ShaderNodeBackground")
output = nodes.new("ShaderNodeOutputWorld")
mapping.inputs["Rotation"].default_value[2] = {angle:.9g}
folder = pathlib.Path(globals().get("__file__", bpy.data.filepath)).resolve().parent
texture.image = bpy.data.images.load(str(folder / {dome.file!r}))
texture.image.colorspace_settings.name = "Linear Rec.709"
background.inputs["Strength"].default_value = {dome.intensity:.9g}
links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
links.new(texture.outputs["Color"], background.inputs["Color"])
links.new(background.outputs["Background"], output.inputs["Surface"])
bpy.context.scene.world = world
'''


def _note(dome: Dome, **more: object) -> str:
    note = {
        "file": dome.file,
        "colorSpace": "linear Rec.709",
        "intensity": dome.intensity,
        "unit": "cd/m^2" if dome.absolute else "relative",
        "origin": None if dome.origin is None else [float(v) for v in dome.origin],
        **more,
    }
    return json.dumps(note, indent=1) + "\n"


def _three(dome: Dome, convention: Convention) -> str:
    angle = 0.0 if dome.turned else convention.yaw
    rotation = [0.0, angle, 0.0]
    return _note(
        dome,
        mapping="EquirectangularReflectionMapping",
        environmentRotation=rotation,
        backgroundRotation=rotation,
    )


def _unreal(dome: Dome, convention: Convention) -> str:
    angle = 0.0 if dome.turned else math.degrees(convention.yaw)
    return _note(
        dome,
        import_as="TextureCube, long-lat",
        axes="X = our x, Y = our z, Z = our y, centimetres",
        SourceCubemapAngle=angle,
    )


_WRITERS: dict[str, tuple[str, Callable[[Dome, Convention], str]]] = {
    "blender": (".py", _blender),
    "usd": (".usda", _usd),
    "three": (".json", _three),
    "unreal": (".json", _unreal),
    "mitsuba": (".xml", _mitsuba),
}
