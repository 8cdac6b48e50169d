"""The scene file: one typed TOML that names every source, and nothing it does not know.

Paths are relative to the file. Angles are degrees here, where a person types; metres
throughout. An unknown key is an error that names the nearest known one.
"""

from __future__ import annotations

import difflib
import itertools
import math
import os
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import msgspec
from msgspec import Meta, Struct

from chromeball.scene.errors import UserError

type Positive = Annotated[float, Meta(gt=0)]
type Point = tuple[float, float]
type Vector = tuple[float, float, float]
type Quad = tuple[Point, Point, Point, Point]
#: Meshes that need no file.
PRIMITIVES = ("sphere", "box", "cylinder")
type Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]


class Table(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the scene file."""


class Emulate(Table, frozen=True):
    """A virtual camera on a pseudo-terminal, in place of a device.

    ``radiance``: the EXR that stands before its lens. ``standard``: video system.
    """

    radiance: str
    seed: int = 0


class Bracket(Table, frozen=True):
    """One exposure bracket: a take of a device, or photographs that lie in a folder.

    ``frames`` are paths or patterns; ``times`` their exposure times (seconds or "1/30") where
    the pictures' metadata is silent. With ``device`` (``visca:/dev/ttyUSB0``) and ``video``
    (``v4l2:/dev/video0``), `acquire bracket` makes ``take``. ``nd``: stops of the
    neutral-density filter, one for all frames or one a frame. ``handheld``: the frames are
    aligned; ``moving``: what moved is taken from one exposure. ``vignetting``: the lens's
    fall-off, a vignette.json, that the merge divides by.
    """

    name: Name
    frames: list[str] = []
    times: list[float | str] = []
    take: str | None = None
    device: str | None = None
    video: str | None = None
    emulate: Emulate | None = None
    nd: list[float] = []
    handheld: bool = False
    moving: bool = False
    vignetting: str | None = None


class Meter(Table, frozen=True):
    """A light-meter reading: what makes radiance absolute, in all brackets of the scene.

    In the merged picture of ``bracket``, the place ``at`` (x, y or x, y, width, height in
    pixels) has ``luminance`` cd/m^2, or is a grey card of ``reflectance`` under ``illuminance``
    lux.
    """

    bracket: Name
    at: list[int]
    luminance: Positive | None = None
    reflectance: Positive | None = None
    illuminance: Positive | None = None


class Hdr(Table, frozen=True):
    """Response and merge. ``response``: a known curve; else it is solved from ``solve_from``.

    ``method``: ``comparagram``, with a prior over real curves, or ``debevec`` as published,
    ``smoothness`` its lambda. ``refine_times``: the metadata's times are nominal, solved too,
    their span fixed; unless given, where the pictures say so. ``reuse``: a stored curve of the
    camera, kept while it fits the pictures. ``snr``: exposures that are not needed for this
    signal-to-noise ratio are left out. ``white_balance`` of RAW brackets: camera, daylight,
    none or "r,g,b".
    """

    response: str | None = None
    solve_from: list[Name] = []
    method: Literal["comparagram", "debevec"] = "comparagram"
    smoothness: Positive | None = None
    refine_times: bool | None = None
    reuse: str | None = None
    snr: Positive | None = None
    white_balance: str | None = None
    meter: Meter | None = None


class Lens(Table, frozen=True):
    """An ideal fisheye: ``fov`` across the image circle of ``radius`` pixels at ``centre``."""

    model: Literal["equidistant", "equisolid", "stereographic", "orthographic"]
    fov: Annotated[float, Meta(gt=0, le=360)]
    radius: Positive | None = None
    centre: Point | None = None


class Shot(Table, frozen=True):
    """One direction of the light probe: its bracket and its turn about the vertical.

    ``ball``: centre and radius of a mirror ball's outline in the picture, pixels; then yaw is
    where its camera looks. ``lens``: where it is not the probe's. ``mask``: a picture, white
    where this one may be used.
    """

    bracket: Name
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    ball: tuple[float, float, Positive] | None = None
    lens: Lens | None = None
    mask: str | None = None


class Probe(Table, frozen=True):
    """The light probe: shots with one lens, a model of it or a ``camera`` file.

    ``vignetting``: a vignette.json, or c1, c2, ... of the fall-off 1 + c1 r^2 + c2 r^4 + ...,
    r = 1 at the rim of the image circle; measured values are divided by it. ``trim``: degrees
    at the rim of the circle that are left out. ``refine``: turn the shots from what they see
    together;
    ``refine_lens``: and solve for the lens' field of view and the circles' centres.
    Of mirror balls: ``camera`` is the one that photographed them (far away without),
    ``reflectance`` is divided by, and ``photographer`` degrees about the direction to the
    camera are left out.
    ``stitch``: the shots' angles are rough, and the pictures say the rest, with the lens's
    fall-off; ``directions`` is a file of a tracker's in place of the angles, ``sigma`` how far
    either is off, degrees an axis.
    """

    shot: list[Shot]
    lens: Lens | None = None
    camera: str | None = None
    vignetting: list[float] | str = []
    trim: Annotated[float, Meta(ge=0)] = 0.0
    refine: bool = True
    refine_lens: bool = False
    reflectance: Vector = (1.0, 1.0, 1.0)
    photographer: Annotated[float, Meta(ge=0, lt=120)] = 20.0
    stitch: bool = False
    directions: str | None = None
    sigma: Positive | None = None

    def __post_init__(self) -> None:
        if self.stitch and len(self.shot) < 2:
            raise ValueError("stitch needs two shots or more")
        if self.stitch and (
            self.trim or not self.refine or self.reflectance != (1.0, 1.0, 1.0)
        ):
            raise ValueError("trim, refine and reflectance are not for stitch = true")
        if self.stitch and any(shot.ball or shot.mask or shot.lens for shot in self.shot):
            raise ValueError("stitch is for shots of one lens, without ball, mask or own lens")
        if not self.stitch and (self.directions or self.sigma):
            raise ValueError("directions and sigma are for stitch = true")


class Align(Table, frozen=True):
    """World axes and scale from the four corners of a rectangle, and from what else is clicked.

    ``picture``: the name of the probe shot's bracket that the points were clicked in, or
    ``env`` for a finished panorama. ``width`` is the length from the first corner to the
    second, ``depth`` from the second to the third; one of them or ``camera_height`` in metres.
    The world's origin is the middle of the rectangle, +X runs along its width, +Y is up.

    Beside the rectangle, on a ``plane``, or in its place: ``verticals``, pairs of points, the
    lower first; ``horizon``, points of it; ``sun``, a point, with ``time`` (ISO 8601 with its
    zone), ``latitude`` and ``longitude`` in degrees; ``north``, a point of that ``bearing``.
    Without a rectangle +X is east and the origin on the floor below the camera.
    """

    picture: str
    points: Quad | None = None
    plane: Literal["floor", "ceiling", "wall"] = "floor"
    width: Positive | None = None
    depth: Positive | None = None
    camera_height: Positive | None = None
    verticals: list[tuple[Point, Point]] = []
    horizon: list[Point] = []
    sun: Point | None = None
    time: str | None = None
    latitude: float | None = None
    longitude: float | None = None
    north: Point | None = None
    bearing: float = 0.0

    def __post_init__(self) -> None:
        place = (self.time, self.latitude, self.longitude)
        if (self.sun is None) != all(value is None for value in place) or (
            self.sun is not None and None in place
        ):
            raise ValueError("sun, time, latitude and longitude are given together")
        if self.bearing and self.north is None:
            raise ValueError("bearing is for north, and there is none")
        if self.points is None and (self.width or self.depth or self.plane != "floor"):
            raise ValueError("width, depth and plane are for points, and there are none")
        if self.points is None and self.sun is None and self.north is None:
            raise ValueError("points, sun or north: one of them gives the heading")


class Sun(Table, frozen=True):
    """What gives back the light of a sun that every exposure clipped: `envmap sun`.

    ``meter``: lux on a surface of ``normal`` ("up", "sun": it faced the sun, or a direction);
    or ``ratio``: how much brighter a card is in the light than in the sun's shadow. ``at``:
    the sun's direction where the map does not show it; ``radius`` of its disc, degrees;
    ``accuracy`` of the reading, as a part of it; ``color`` of the sun's light.
    """

    meter: Positive | None = None
    # msgspec 0.22: no bounded float beside a tuple
    ratio: float | Vector | None = None
    normal: Literal["up", "sun"] | Vector = "up"
    at: Vector | None = None
    clipped: Positive | None = None
    color: Vector | None = None
    radius: Annotated[float, Meta(ge=0.01, le=10)] = 0.2666
    accuracy: Annotated[float, Meta(gt=0, lt=1)] = 0.05


class Env(Table, frozen=True):
    """The lat-long map. ``file``: a finished panorama, so that nothing is stitched.

    ``lights``: how many light samples `envmap lights` writes. What no shot saw is completed
    from the plate of the view ``fill``, as matt ground of reflectance ``ground``, or from the
    border of what was seen. ``realtime``: harmonics, irradiance and, where an object is
    glossy, prefiltered maps for real-time engines. ``others``: finished maps from other places,
    with the attribute `origin`: what the first does not see has their light.
    """

    width: Annotated[int, Meta(ge=16, le=32768)] = 1024
    file: str | None = None
    lights: Annotated[int, Meta(ge=1, le=65536)] = 64
    others: list[str] = []
    ground: Vector | None = None
    fill: Name | None = None
    sun: Sun | None = None
    realtime: bool = False


class StandIn(Table, frozen=True):
    """One piece of stand-in geometry.

    ``plane``: a rectangle of ``size`` metres on the floor about the world's origin.
    ``polygon``: corners on the floor. ``box``: a polygon raised to ``height``.
    ``room``: a polygon raised to ``height`` and seen from inside.
    Corners are ``points``, pixels in env.exr, or ``corners``, (x, z) in metres on the floor;
    ``height`` in metres, or ``height_point``, the pixel above the first corner.
    ``outline`` says how they draw the base: a polygon by its corners, a square by its diagonal
    (2), a rectangle by one side and a point of the opposite side (3), a circle by three points.
    ``surface``: support receives shadows and light of the objects, environment only emits.
    For a room the floor is ``surface`` and walls and ceiling are environment.
    """

    name: Name
    kind: Literal["plane", "polygon", "box", "room"]
    points: list[Point] = []
    corners: list[Point] = []
    outline: Literal["polygon", "square", "rectangle", "circle"] = "polygon"
    size: tuple[Positive, Positive] | None = None
    height: Positive | None = None
    height_point: Point | None = None
    surface: Literal["support", "environment"] = "support"


class Material(Table, frozen=True):
    """What an object is made of, after glTF's metallic-roughness model.

    ``color``: albedo of diffuse, reflectance of mirror, transmittance of glass and of
    thin_glass (a sheet without refraction), base colour of metallic_roughness; 0.5 unless
    given, 1 under a texture. The other keys are as in
    :class:`chromeball.renderer.material.Material`, and each kind takes those that mean
    something to it. Textures are image files, multiplied in; 8-bit colours are sRGB.
    """

    kind: Literal["diffuse", "mirror", "glass", "thin_glass", "metallic_roughness"] = "diffuse"
    color: Vector | None = None
    metallic: float | None = None
    roughness: float | None = None
    specular: float | None = None
    ior: float | None = None
    transmission: float | None = None
    thin: bool | None = None
    clearcoat: float | None = None
    clearcoat_roughness: float | None = None
    emission: Vector | None = None
    alpha: float | None = None
    alpha_mode: Literal["opaque", "mask", "blend"] | None = None
    alpha_cutoff: float | None = None
    normal_scale: float | None = None
    color_texture: str | None = None
    metallic_roughness_texture: str | None = None
    normal_texture: str | None = None
    emission_texture: str | None = None
    wrap: Literal["repeat", "clamp", "mirror"] | None = None

    def __post_init__(self) -> None:
        given = {name: v for name in _MATERIAL if (v := getattr(self, name)) is not None}
        for name, value in given.items():
            if self.kind not in (kinds := _MATERIAL[name]):
                raise ValueError(f"{name} is not for {self.kind}, but {', '.join(kinds)}")
            share = name not in ("ior", "normal_scale")
            if isinstance(value, float) and share and not 0 <= value <= 1:
                raise ValueError(f"{name} lies between 0 and 1")
        if self.color is not None and not all(0 <= c <= 1 for c in self.color):
            raise ValueError("color lies between 0 and 1")
        if self.ior is not None and not 1 <= self.ior <= 4:
            raise ValueError("ior lies between 1 and 4")
        if self.emission is not None and min(self.emission) < 0:
            raise ValueError("emission is 0 or more")
        if self.wrap is not None and not self.textures():
            raise ValueError("wrap is for textures, and there is none")
        if self.normal_scale is not None and self.normal_texture is None:
            raise ValueError("normal_scale is for normal_texture, and there is none")
        if self.alpha_cutoff is not None and self.alpha_mode != "mask":
            raise ValueError('alpha_cutoff is for alpha_mode = "mask"')
        if self.alpha is not None and self.alpha_mode == "opaque":
            raise ValueError('alpha is for alpha_mode = "blend" or "mask"')

    def textures(self) -> list[str]:
        """The image files that it names."""
        names = [name for name in _MATERIAL if name.endswith("_texture")]
        return [file for name in names if (file := getattr(self, name)) is not None]


_MATT = ("diffuse", "metallic_roughness")
_CLEAR = ("glass", "thin_glass", "metallic_roughness")
_GENERAL = ("metallic_roughness",)
#: Which kinds of material have a key.
_MATERIAL: dict[str, tuple[str, ...]] = {
    "roughness": _CLEAR,
    "ior": _CLEAR,
    **dict.fromkeys(
        (
            *("emission", "alpha", "alpha_mode", "alpha_cutoff", "normal_scale", "wrap"),
            *("color_texture", "normal_texture", "emission_texture"),
        ),
        _MATT,
    ),
    **dict.fromkeys(
        (
            *("metallic", "specular", "transmission", "thin", "clearcoat"),
            *("clearcoat_roughness", "metallic_roughness_texture"),
        ),
        _GENERAL,
    ),
}


def has_key(kind: str, key: str) -> bool:
    """Whether a kind of material has a key."""
    return kind in _MATERIAL.get(key, (kind,))


class Placement(Table, frozen=True):
    """One more place of an object: scaled, then rotated (degrees), then moved."""

    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    scale: float | tuple[float, float, float] = 1.0

    def __post_init__(self) -> None:
        _check_scale(self.scale)


class ObjectKey(Table, frozen=True):
    """Where an object is at a ``frame`` of a sequence; what is left out has no key here."""

    frame: float
    position: Vector | None = None
    rotation: Vector | None = None
    scale: float | tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        _check_scale(self.scale)


class Object(Table, frozen=True):
    """A synthetic object.

    ``mesh`` is sphere, box or cylinder (unit size, standing on y = 0), or a mesh file; scaled,
    then rotated (degrees about x, y, z in turn), then moved to ``position``. ``material``: in
    place of the file's own. ``smooth``: a mesh file without normals is smooth across edges
    flatter than so many degrees. ``instances``: the object, as it stands by its own keys, is
    copied to each of these places. ``key`` moves it over the frames of a sequence
    (:mod:`chromeball.scene.sequence`); ``interpolation``: positions run straight from key to
    key, or along a ``cubic`` curve (Catmull-Rom).
    """

    name: Name
    mesh: str
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    # msgspec 0.22 corrupts memory on a bounded float beside a tuple: bounds are checked below
    scale: float | tuple[float, float, float] = 1.0
    material: Material | None = None
    smooth: float | None = None
    instances: list[Placement] = []
    key: list[ObjectKey] = []
    interpolation: Literal["linear", "cubic"] = "linear"

    def __post_init__(self) -> None:
        _check_scale(self.scale)
        if self.smooth is not None and not 0 < self.smooth <= 180:
            raise ValueError("smooth is an angle between 0 and 180 degrees")
        if self.smooth is not None and self.mesh in PRIMITIVES:
            raise ValueError("smooth is for mesh files; primitives have their normals")


class Light(Table, frozen=True):
    """A synthetic light.

    ``point``: ``intensity`` (W/sr, in the map's units of radiance times m^2) at ``position``.
    ``spot``: the same within ``angle`` degrees of its axis, full within ``inner_angle`` (0
    unless given). ``sun``: ``irradiance`` on a surface that faces it, from infinitely far.
    ``area``: a rectangle of ``size`` (width, height) or a disc of ``radius`` metres about
    ``position``, with ``radiance``, or ``power`` in all; ``texture`` is an image that is
    multiplied in, its top up. It is black behind unless ``two_sided``.
    The axis is ``direction``, into which it shines, or leads to the point ``look_at``.
    """

    name: Name
    kind: Literal["point", "spot", "sun", "area"]
    position: Vector | None = None
    direction: Vector | None = None
    look_at: Vector | None = None
    intensity: Vector | None = None
    irradiance: Vector | None = None
    radiance: Vector | None = None
    power: Vector | None = None
    angle: float | None = None
    inner_angle: float | None = None
    size: tuple[float, float] | None = None
    radius: float | None = None
    texture: str | None = None
    two_sided: bool = False

    def __post_init__(self) -> None:
        needed, either, allowed = _LIGHT[self.kind]
        given = {
            name
            for name in self.__struct_fields__
            if name not in ("name", "kind") and (value := getattr(self, name)) is not None
            if value is not False
        }
        for name in needed:
            if name not in given:
                raise ValueError(f"{_LIGHT_NAMES[self.kind]} needs {name}")
        for names in either:
            if len(given & {*names}) != 1:
                raise ValueError(
                    f"{_LIGHT_NAMES[self.kind]} needs one of {' and '.join(names)}"
                )
        known = {*needed, *allowed, *sum(either, ())}
        for name in sorted(given - known):
            raise ValueError(
                f"{_LIGHT_NAMES[self.kind]} has no {name}; it has {', '.join(sorted(known))}"
            )
        for name in ("intensity", "irradiance", "radiance", "power", "size"):
            value = getattr(self, name)
            if value is not None and not min(value) >= 0:
                raise ValueError(f"{name} is 0 or more")
        if self.size is not None and not min(self.size) > 0:
            raise ValueError("size must be positive")
        if self.radius is not None and not self.radius > 0:
            raise ValueError("radius must be positive")
        inner = self.inner_angle or 0.0
        if self.angle is not None and not (0 < self.angle <= 180 and 0 <= inner <= self.angle):
            raise ValueError("angles: 0 <= inner_angle <= angle <= 180 degrees, angle not 0")
        if self.direction is not None and not any(self.direction):
            raise ValueError("direction is zero")
        if self.look_at is not None and self.look_at == self.position:
            raise ValueError("look_at is the light's own position")


_AXIS = ("direction", "look_at")
_LIGHT_NAMES = {
    "point": "a point light",
    "spot": "a spot light",
    "sun": "a sun",
    "area": "an area light",
}
#: What a kind of light needs, of which it needs one, and what it may have.
_LIGHT: dict[str, tuple[tuple[str, ...], tuple[tuple[str, ...], ...], tuple[str, ...]]] = {
    "point": (("position", "intensity"), (), ()),
    "spot": (("position", "intensity", "angle"), (_AXIS,), ("inner_angle",)),
    "sun": (("direction", "irradiance"), (), ()),
    "area": (
        ("position",),
        (_AXIS, ("radiance", "power"), ("size", "radius")),
        ("texture", "two_sided"),
    ),
}


class ViewKey(Table, frozen=True):
    """Where a virtual camera is at a ``frame``; what is left out has no key here."""

    frame: float
    position: Vector | None = None
    look_at: Vector | None = None
    rotation: Vector | None = None
    fov: float | None = None


class Look(Table, frozen=True):
    """The plate camera's own faults, given to what is synthetic.

    ``noise``: of the plate's variance and grain, from its ``sigma`` channels (`hdr merge
    --sigma`) where it has them. ``softness``: edges as soft as the plate's. ``vignetting``: a
    vignette.json, or c1, c2, ... of the fall-off 1 + c1 r^2 + c2 r^4 + ..., r = 1 at half the
    plate's diagonal; a plate whose own was divided out gets it back as well.
    ``response``: `plate`, the curve that the plate was merged with, or a response.json; makes
    VIEW.camera.png, the codes that the camera would have given at the exposure of the plate's
    frame number ``frame`` (from 0; unless given, the one that shows most). ``jpeg``: quality
    of a VIEW.camera.jpg beside it.
    """

    noise: bool = False
    softness: bool = False
    vignetting: list[float] | str = []
    response: str | None = None
    frame: Annotated[int, Meta(ge=0)] | None = None
    jpeg: Annotated[int, Meta(ge=1, le=100)] | None = None

    def __post_init__(self) -> None:
        if self.response is None and (self.frame is not None or self.jpeg is not None):
            raise ValueError("frame and jpeg say how `response` is applied: give it too")


class View(Table, frozen=True):
    """A picture to make, or a sequence of them.

    With ``bracket`` or ``plate`` (a radiance EXR) a photograph is the background; its camera is
    the calibrated one (``camera`` names a file, default the result of `calibrate lens`) and its
    place follows from ``points``, where the four corners of the `align` rectangle lie in the
    plate. Without, the panorama is the background, seen by a virtual camera: ``model``,
    ``size``, ``fov`` degrees, at ``position`` (the probe's place unless given), turned to
    ``look_at`` (a point in metres) or by ``rotation``: it looks along -z, +y up, and is turned
    by so many degrees about x, y, z in turn.

    A sequence has ``frames`` ("1-48", "1-48:2", "7"), and ``plate`` and ``camera`` may hold
    the frame's number (``plates/%04d.exr``); ``key`` moves a virtual camera as an object's.

    ``aperture``, the lens's diameter in metres, or ``f_number`` and ``focal_length`` (metres)
    blur what is out of focus: ``focus_distance`` in metres or ``focus_at``, a point.
    ``shutter`` is the share of a frame for which it is open: what has keys moves meanwhile, and
    the camera, by its keys or to the pose in ``closing_camera``, a file. A photograph is taken
    to be blurred already. ``cube`` is a horizontal cross of six faces, 4:3.
    """

    name: Name
    bracket: Name | None = None
    plate: str | None = None
    camera: str | None = None
    points: Quad | None = None
    model: Literal[
        "pinhole",
        "equidistant",
        "equisolid",
        "stereographic",
        "orthographic",
        "latlong",
        "cube",
    ] = "pinhole"
    size: tuple[Annotated[int, Meta(ge=1)], Annotated[int, Meta(ge=1)]] = (640, 480)
    fov: Annotated[float, Meta(gt=0, le=360)] = 60.0
    look_at: Vector = (0.0, 0.0, 0.0)
    position: Vector | None = None
    rotation: Vector | None = None
    exposure: Positive | None = None
    frames: str | None = None
    key: list[ViewKey] = []
    interpolation: Literal["linear", "cubic"] = "linear"
    look: Look = Look()
    aperture: Positive | None = None
    f_number: Positive | None = None
    focal_length: Positive | None = None
    focus_distance: Positive | None = None
    focus_at: Vector | None = None
    shutter: Annotated[float, Meta(ge=0, le=1)] = 0.0
    closing_camera: str | None = None


class Calibrate(Table, frozen=True):
    """The view camera: photographs of a target, or a finished ``camera``."""

    images: list[str] = []
    target: str | None = None
    model: str = "auto"
    camera: str | None = None


class Gloss(Table, frozen=True):
    """The support surfaces' reflection beside their diffuse part.

    ``reflectance`` at normal incidence; ``roughness`` of GGX as in glTF 2.0.
    """

    reflectance: Annotated[float, Meta(ge=0, le=0.9)] = 0.04
    roughness: Annotated[float, Meta(ge=0, le=1)] = 0.1


class Render(Table, frozen=True):
    """How the objects are rendered into the views.

    ``integrator``: ``path`` is the reference, all light between objects and set (``bounces``);
    ``direct`` the fast one: light of the set on the objects and their shadows; ``ao`` the same
    under an even white sky, for a plate without a light probe. ``denoise``: Open Image Denoise
    smooths what is kept of the plate and what is added to it, not the plate. ``filter``: how
    ``path`` weighs what is synthetic about a pixel's middle: ``box``, the pixel's area as a
    sensor's, ``gaussian`` (deviation half a pixel) or ``blackman-harris`` (3 pixels wide). The
    plate is not filtered. ``reflect``: what mirrors and glass show of support surfaces by
    ``path``: the ``plate``, where the camera sees them, or the ``map`` alone. ``gloss``:
    support surfaces mirror the objects, by ``path``.
    """

    integrator: Literal["path", "direct", "ao"] = "path"
    denoise: bool = False
    spp: Annotated[int, Meta(ge=1)] = 64
    seed: Annotated[int, Meta(ge=0, le=2**62)] = 0
    bounces: Annotated[int, Meta(ge=0, le=100_000)] = 2
    composite: Literal["quotient", "difference"] = "quotient"
    reflect: Literal["plate", "map"] = "plate"
    gloss: Gloss | None = None
    filter: Literal["box", "gaussian", "blackman-harris"] = "box"


class Truth(Table, frozen=True):
    """What an example knows about itself. Only the report reads it."""

    folder: str


class Scene(Table, frozen=True):
    """A whole scene file. ``folder`` holds what the stages make."""

    name: str
    folder: str = "build"
    bracket: list[Bracket] = []
    hdr: Hdr = Hdr()
    calibrate: Calibrate | None = None
    probe: Probe | None = None
    align: Align | None = None
    env: Env = Env()
    stand_in: list[StandIn] = []
    object: list[Object] = []
    light: list[Light] = []
    view: list[View] = []
    render: Render = Render()
    truth: Truth | None = None

    def find_bracket(self, name: str) -> Bracket:
        """The bracket of that name, or a :class:`UserError`."""
        for bracket in self.bracket:
            if bracket.name == name:
                return bracket
        near = _nearest(name, [bracket.name for bracket in self.bracket])
        raise UserError(f"there is no [[bracket]] named {name!r}{near}")

    def find_view(self, name: str) -> View:
        """The view of that name, or a :class:`UserError`."""
        for view in self.view:
            if view.name == name:
                return view
        near = _nearest(name, [view.name for view in self.view])
        raise UserError(f"there is no [[view]] named {name!r}{near}")

    def photograph_of(self, view: View) -> tuple[str, str]:
        """A view's photograph and the file with its camera and pose, relative to the scene.

        Raises :class:`UserError` for a view without a photograph.
        """
        if not (view.bracket or view.plate):
            raise UserError(f"view {view.name!r} has no photograph: no bracket, no plate")
        build = self.folder.rstrip("/")
        plate = f"{build}/{view.bracket}.exr" if view.bracket else str(view.plate)
        # posed by four points, or a file that holds the pose
        if view.camera and not view.points:
            return plate, view.camera
        return plate, f"{build}/{view.name}.cameramodel"


def _check_scale(scale: float | tuple[float, float, float] | None) -> None:
    sides = scale if isinstance(scale, tuple) else (1.0 if scale is None else scale,)
    if not all(0 < side < math.inf for side in sides):
        raise ValueError("scale must be positive")


def read_scene(path: str | os.PathLike[str]) -> Scene:
    """Read and check a scene file.

    Raises
    ------
    UserError
        With the place in the file: no such file, not TOML, an unknown key (the nearest known
        one is named), a wrong type or value, a name used twice or never defined.

    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UserError("no such scene file", file=path) from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"not a readable text file: {error}", file=path) from error
    return parse_scene(text, path)


def parse_scene(text: str, path: str | os.PathLike[str] = "scene.toml") -> Scene:
    """As :func:`read_scene`, from the text; `path` is for messages alone."""
    try:
        value = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise UserError(f"not valid TOML: {error}", file=path) from error
    try:
        scene = msgspec.convert(value, Scene)
        _check_names(scene)
        _check_numbers(scene)
    except msgspec.ValidationError as error:
        raise UserError(_explain(str(error)), file=path) from error
    except UserError as error:
        raise UserError(error.what, file=path) from error
    return scene


def parse_time(value: float | str) -> float:
    """An exposure time in seconds from a number, "0.5" or "1/30"."""
    try:
        numerator, slash, denominator = str(value).partition("/")
        seconds = float(numerator) / (float(denominator) if slash else 1.0)
    except (ValueError, ZeroDivisionError, OverflowError) as error:
        raise UserError(f"{value!r:.40} is no exposure time: write 0.5 or 1/30") from error
    if not 0 < seconds < 1e6:
        raise UserError(f"{value!r:.40} is no exposure time: it must be positive and finite")
    return seconds


def _check_names(scene: Scene) -> None:
    for kind, entries in (
        ("bracket", scene.bracket),
        ("stand_in", scene.stand_in),
        ("object", scene.object),
        ("light", scene.light),
        ("view", scene.view),
    ):
        names = [entry.name for entry in entries]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"two [[{kind}]] are named {name!r}")
    used = [shot.bracket for shot in (scene.probe.shot if scene.probe else [])]
    used += [view.bracket for view in scene.view if view.bracket]
    used += scene.hdr.solve_from
    if scene.hdr.meter is not None:
        used.append(scene.hdr.meter.bracket)
    for name in used:
        scene.find_bracket(name)
    for bracket in scene.bracket:
        for time in bracket.times:
            parse_time(time)
    _check_hdr(scene.hdr, scene.bracket)
    for view in scene.view:
        _check_view(view)
        _check_keys(view.name, view.key)
    for entry in scene.object:
        _check_keys(entry.name, entry.key)


def _check_keys(name: str, keys: Sequence[ObjectKey | ViewKey]) -> None:
    if any(b.frame <= a.frame for a, b in itertools.pairwise(keys)):
        raise UserError(f"{name!r}: the frames of its keys must rise")


def _check_view(view: View) -> None:
    name = f"view {view.name!r}"
    if view.frames is not None:
        parse_frames(view.frames)
    for value in (view.plate, view.camera, view.closing_camera):
        if value and len(re.findall(r"%0?\d*d", value)) > 1:
            raise UserError(f"{name}: {value!r} holds more than one number")
    moved = view.position is not None or view.rotation is not None or bool(view.key)
    if moved and (view.bracket or view.plate):
        raise UserError(
            f"{name} has a photograph, and its camera is where that was taken: leave out "
            "position, rotation and key; a moving camera has one file a frame, camera = "
            '"cameras/%04d.cameramodel"'
        )
    for key in view.key:
        if key.fov is not None and not 0 < key.fov <= 360:
            raise UserError(f"{name}: fov at frame {key.frame:g} is not between 0 and 360")
        if key.rotation is not None and key.look_at is not None:
            raise UserError(f"{name}: a key has look_at or rotation, not both")
    _check_lens(view, name)
    turned = view.rotation is not None or any(key.rotation is not None for key in view.key)
    if turned and any(key.look_at is not None for key in view.key):
        raise UserError(f"{name} has keys of look_at and a rotation; keep one of the two")


def _check_lens(view: View, name: str) -> None:
    stop = (view.f_number, view.focal_length)
    if (None in stop) != (stop == (None, None)):
        raise UserError(f"{name}: f_number and focal_length tell the aperture together")
    if view.aperture is not None and view.f_number is not None:
        raise UserError(f"{name} has an aperture and an f_number; keep one")
    wide = view.aperture is not None or view.f_number is not None
    focused = (view.focus_distance is not None) + (view.focus_at is not None)
    if wide and focused != 1:
        raise UserError(f"{name}: an aperture needs focus_distance or focus_at, one of them")
    if focused and not wide:
        raise UserError(f"{name}: without an aperture all is in focus; give one, or no focus")
    if view.closing_camera is not None and not (view.shutter and (view.bracket or view.plate)):
        raise UserError(
            f"{name}: closing_camera is where a photograph's camera is when its shutter "
            "closes: it needs a plate and a shutter"
        )


_NONE = (None, None, None)


def parse_frames(text: str) -> list[int]:
    """Frame numbers of ``7``, ``1-48``, ``1-48:2`` or several of these with commas, rising."""
    frames: set[int] = set()
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,9})(?:-(\d{1,9})(?::(\d{1,9}))?)?\s*", part)
        first, last, step = (int(g) if g else None for g in found.groups()) if found else _NONE
        if first is None or step == 0 or (last is not None and last < first):
            raise UserError(f"{text!r:.60} are no frames: write 7, 1-48 or 1-48:2")
        chosen = range(first, (first if last is None else last) + 1, step or 1)
        if len(frames) + len(chosen) > 1_000_000:
            raise UserError(f"{text!r:.60} are more than a million frames")
        frames.update(chosen)
    return sorted(frames)


def _check_hdr(hdr: Hdr, brackets: Sequence[Bracket]) -> None:
    for bracket in brackets:
        if not all(0 <= stops <= 60 for stops in bracket.nd):
            raise UserError(f"bracket {bracket.name!r}: nd is 0 to 60 stops, 3 for an ND8")
    named = hdr.white_balance in (None, "camera", "daylight", "none")
    number = r"\s*\d*\.?\d+\s*"
    if not named and not re.fullmatch(",".join([number] * 3), hdr.white_balance or ""):
        raise UserError('hdr.white_balance is camera, daylight, none or "r,g,b"')
    if hdr.smoothness is not None and hdr.method != "debevec":
        raise UserError('hdr.smoothness is lambda of method = "debevec": leave it out')
    meter = hdr.meter
    if meter is None:
        return
    if len(meter.at) not in (2, 4):
        raise UserError("hdr.meter.at: give x, y or x, y, width, height in pixels")
    card = (meter.reflectance, meter.illuminance)
    if (meter.luminance is None) == (None in card) or (
        meter.luminance is not None and card != (None, None)
    ):
        raise UserError("hdr.meter needs luminance, or reflectance and illuminance")


def _check_numbers(scene: Scene) -> None:
    """TOML knows inf and nan, and bounds let them pass."""
    where = _not_finite(msgspec.to_builtins(scene), "")
    if where is not None:
        raise UserError(f"{where.lstrip('.')} is not a finite number")


def _not_finite(value: object, where: str) -> str | None:
    """Where in nested tables and lists a number is infinite or NaN, or None."""
    match value:
        case float():
            return None if math.isfinite(value) else where
        case dict():
            places = [_not_finite(v, f"{where}.{key}") for key, v in value.items()]
        case list() | tuple():
            places = [_not_finite(v, f"{where}[{i}]") for i, v in enumerate(value)]
        case _:
            return None
    return next((place for place in places if place is not None), None)


def _explain(message: str) -> str:
    """Msgspec's message, with the nearest known key for an unknown one."""
    found = re.search(r"unknown field `(.*?)`(?: - at `(.*)`)?", message)
    if not found:
        return message.replace("`$.", "`")
    field, where = found[1], found[2] or "$"
    table: Any = Scene
    for part in re.findall(r"\.(\w+)", where):
        table = _table_of(get_type_hints(table)[part])
    place = re.sub(r"^\$\.?", "", where).replace("[...]", "")
    return f"unknown key {field!r} in {f'[{place}]' if place else 'the file'}" + _nearest(
        field, table.__struct_fields__
    )


def _table_of(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, Struct):
        return annotation
    for argument in get_args(annotation):
        if (table := _table_of(argument)) is not None:
            return table
    return None


def _nearest(name: str, known: tuple[str, ...] | list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {', '.join(sorted(known))}" if known else ""
