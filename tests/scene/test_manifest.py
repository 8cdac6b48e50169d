"""The scene file: typed, forgiving nothing, and every mistake is one line that helps."""

from __future__ import annotations

import gc
import math
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Scene, parse_scene, parse_time, read_scene

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*/scene.toml"))
FULL = """
name = "full"
folder = "made"

[[bracket]]
name = "front"
device = "visca:/dev/ttyUSB0"
take = "takes/front"
times = ["1/30", 0.5, 2]
emulate = { radiance = "truth/front.exr", seed = 3 }

[[bracket]]
name = "plate"
frames = ["plate/*.jpg"]

[hdr]
solve_from = ["front"]
method = "debevec"
smoothness = 30

[calibrate]
images = ["board/*.png"]
target = "charuco:9x6:0.04:0.03:4X4_50"

[probe]
lens = { model = "equisolid", fov = 190, radius = 400.5 }
vignetting = [-0.1, 0.02]
[[probe.shot]]
bracket = "front"
yaw = 90

[align]
points = [[1, 2], [3, 4], [5, 6], [7, 8]]
picture = "front"
width = 0.45

[env]
width = 512

[[stand_in]]
name = "room"
kind = "room"
points = [[669, 299.5], [360, 302], [87, 285.5]]
height_point = [669, 178]
outline = "rectangle"

[[object]]
name = "ball"
mesh = "sphere"
scale = [1, 2, 3]
material = { kind = "glass", color = [1, 0.5, 0], ior = 1.33 }

[[view]]
name = "main"
bracket = "plate"
points = [[1, 2], [3, 4], [5, 6], [7, 8]]

[render]
spp = 16
composite = "difference"
"""


def test_a_full_scene_is_read_with_its_types() -> None:
    scene = parse_scene(FULL)
    assert scene.folder == "made"
    assert scene.bracket[0].times == ["1/30", 0.5, 2]
    assert scene.bracket[0].emulate is not None
    assert scene.bracket[0].emulate.seed == 3
    assert scene.probe is not None
    assert scene.probe.shot[0].yaw == 90.0
    assert scene.probe.lens is not None
    assert scene.probe.lens.radius == 400.5
    assert scene.align is not None
    assert scene.align.points is not None
    assert scene.align.points[3] == (7.0, 8.0)
    assert scene.stand_in[0].height_point == (669.0, 178.0)
    assert scene.object[0].scale == (1.0, 2.0, 3.0)
    material = scene.object[0].material
    assert material is not None
    assert material.ior == 1.33
    assert scene.view[0].points is not None
    assert scene.render.composite == "difference"
    assert scene.find_bracket("plate").frames == ["plate/*.jpg"]


def test_defaults_stand_for_what_is_left_out() -> None:
    scene = parse_scene('name = "bare"')
    assert scene == Scene(name="bare")
    assert (scene.folder, scene.env.width, scene.render.spp) == ("build", 1024, 64)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.parent.name)
def test_the_examples_are_valid(path: Path) -> None:
    """They are templates: `chromeball new` fills {{name|default}}."""
    scene = parse_scene(re.sub(r"\{\{\w+\|(.*?)\}\}", r"\1", path.read_text()), path)
    assert scene.name


def test_memory_stays_whole() -> None:
    """Msgspec 0.22 corrupts memory on some unions; the collector is the first to stumble."""
    for _ in range(20):
        parse_scene(FULL)
        gc.collect()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "height_point",
            "heigth_point",
            r"'heigth_point' in \[stand_in\[0\]\]; did you mean 'height_p",
        ),
        ("[env]\nwidth", "[env]\nwith", r"unknown key 'with' in \[env\]; did you mean 'width'"),
        ("yaw = 90", "jaw = 90", r"'jaw' in \[probe.shot\[0\]\]; did you mean 'yaw'"),
        ("ior", "iro", r"'iro' in \[object\[0\].material\]; did you mean 'ior'"),
        ("[render]", "[rendr]", "'rendr' in the file; did you mean 'render'"),
        ("seed = 3", "zzz = 3", r"'zzz' in \[bracket\[0\].emulate\]; known: radiance, seed"),
        ('name = "full"', "", "missing required field `name`"),
        ("width = 512", 'width = "512"', "Expected `int`, got `str` - at `env.width`"),
        ("width = 512", "width = 8", "Expected `int` >= 16"),
        ("width = 0.45", "width = -1", "> 0.* at `align.width`"),
        ("width = 0.45", "width = nan", "align.width"),
        ("width = 0.45", "width = inf", "align.width is not a finite number"),
        ("yaw = 90", "yaw = -inf", r"probe.shot\[0\].yaw is not a finite number"),
        ("[7, 8]]\npicture", "[7]]\npicture", "Expected `array` of length 2"),
        ("scale = [1, 2, 3]", "scale = 0", "scale must be positive"),
        ("scale = [1, 2, 3]", "scale = [1, -2, 3]", "scale must be positive"),
        ("scale = [1, 2, 3]", "scale = inf", "scale must be positive"),
        ("color = [1, 0.5, 0]", "color = [1, 0.5, 2]", "color lies between 0 and 1"),
        ('"difference"', '"magic"', "Invalid enum value 'magic'"),
        ('name = "plate"', 'name = "front"', r"two \[\[bracket\]\] are named 'front'"),
        ('bracket = "plate"', 'bracket = "plat"', r"named 'plat'; did you mean 'plate'"),
        ('solve_from = ["front"]', 'solve_from = ["x y"]', "matching regex"),
        ('solve_from = ["front"]', 'solve_from = ["back"]', r"no \[\[bracket\]\] named 'back'"),
        ('"1/30"', '"1/0"', "'1/0' is no exposure time"),
        ('"1/30"', "-1", "-1.* is no exposure time"),
        ('name = "full"', "name = ", "not valid TOML"),
        ('name = "full"', 'name = "full"\nname = "again"', "not valid TOML"),
        ('name = "full"', "a = " + "[" * 5000, "not valid TOML"),
    ],
)
def test_a_mistake_is_one_line_that_says_where(old: str, new: str, message: str) -> None:
    assert old in FULL
    with pytest.raises(UserError, match=message) as caught:
        parse_scene(FULL.replace(old, new, 1), "my.toml")
    assert str(caught.value).startswith("my.toml: ")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(FULL, encoding="utf-8")
    assert read_scene(tmp_path / "a.toml") == parse_scene(FULL)
    with pytest.raises(UserError, match="no such scene file"):
        read_scene(tmp_path / "none.toml")
    (tmp_path / "b.toml").write_bytes(b'name = "\xff"')
    with pytest.raises(UserError, match="not a readable text file"):
        read_scene(tmp_path / "b.toml")
    with pytest.raises(UserError, match="not a readable text file"):
        read_scene(tmp_path)


@settings(deadline=None, max_examples=400)
@given(st.data())
def test_any_text_gives_a_scene_or_one_line(data: st.DataObject) -> None:
    words = sorted(set(FULL.replace("=", " ").replace("\n", " ").split()))
    if data.draw(st.integers(0, 9)) == 0:
        text = data.draw(st.text())
    else:
        lines = [str(line) for line in FULL.split("\n")]
        for _ in range(data.draw(st.integers(1, 4))):
            at = data.draw(st.integers(0, len(lines) - 1))
            match data.draw(st.sampled_from(["drop", "double", "swap", "word", "value"])):
                case "drop":
                    lines[at] = ""
                case "double":
                    lines.insert(at, lines[at])
                case "swap":
                    other = data.draw(st.integers(0, len(lines) - 1))
                    lines[at], lines[other] = lines[other], lines[at]
                case "word":
                    lines[at] = lines[at].replace(
                        data.draw(st.sampled_from(words)), data.draw(st.sampled_from(words))
                    )
                case _:
                    values = st.sampled_from(
                        ["nan", "-inf", "1e308", "0", "-1", "true", '""', "[]", "{}", "[[]]",
                         "1979-05-27", "07:32:00", "99999999999999999999", "[1, [2]]"]
                    ) | st.text(max_size=6)  # fmt: skip
                    lines[at] = lines[at].partition("=")[0] + "= " + data.draw(values)
        text = "\n".join(lines)
    message = None
    try:
        scene = parse_scene(text, "fuzzed.toml")
    except UserError as error:
        message = str(error)
    else:
        assert isinstance(scene, Scene)
    if message is not None:
        assert "\n" not in message
        assert message.startswith("fuzzed.toml: ")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("1/30", 1 / 30),
        ("0.5", 0.5),
        ("2", 2.0),
        (13.0, 13.0),
        ("1e-4", 1e-4),
        (" 1/8 ", 0.125),
    ],
)
def test_times_are_decimals_or_fractions(text: float | str, seconds: float) -> None:
    assert parse_time(text) == pytest.approx(seconds, rel=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1/",
        "/30",
        "1/0",
        "0",
        "-1/30",
        "nan",
        "inf",
        "1/2/3",
        "fast",
        "1e9",
        math.nan,
        math.inf,
        0.0,
        "1e-999999999",
        "9" * 5000,
    ],
)
def test_what_is_no_time_is_refused(text: float | str) -> None:
    with pytest.raises(UserError, match="is no exposure time") as caught:
        parse_time(text)
    assert "\n" not in str(caught.value)


@settings(deadline=None)
@given(st.text(max_size=12) | st.floats())
def test_any_time_is_positive_or_one_line(value: str | float) -> None:
    try:
        seconds = parse_time(value)
    except UserError:
        return
    assert 0 < seconds < 1e6


def _object(text: str) -> str:
    return f'name = "s"\n[[object]]\nname = "o"\nmesh = "a.glb"\n{text}\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('material = { kind = "mirror", roughness = 0.2 }', "roughness is not for mirror"),
        ('material = { kind = "diffuse", clearcoat = 1 }', "clearcoat is not for diffuse"),
        ('material = { kind = "glass", roughness = 2 }', "roughness lies between 0 and 1"),
        ("material = { emission = [1, -1, 0] }", "emission is 0 or more"),
        ('material = { wrap = "clamp" }', "wrap is for textures"),
        ("material = { normal_scale = 2 }", "normal_scale is for normal_texture"),
        ("material = { alpha_cutoff = 0.5 }", 'alpha_cutoff is for alpha_mode = "mask"'),
        ('material = { alpha = 0.5, alpha_mode = "opaque" }', "alpha is for alpha_mode"),
        ('material = { kind = "glas" }', "Invalid enum value 'glas'"),
        ("smooth = 200", "smooth is an angle between 0 and 180"),
        ("instances = [{ position = [0, 0, 1], scale = 0 }]", "scale must be positive"),
        ("instances = [{ place = [0, 0, 1] }]", r"'place' in \[object\[0\].instances\[0\]\]"),
    ],
)
def test_mistakes_in_objects(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        parse_scene(_object(text), "my.toml")
    assert "\n" not in str(caught.value)


POINT = 'kind = "point"\nposition = [0, 1, 0]\nintensity = [1, 1, 1]'
SPOT = POINT.replace("point", "spot") + "\nangle = 30\ndirection = [0, -1, 0]"
AREA = (
    'kind = "area"\nposition = [0, 1, 0]\nlook_at = [0, 0, 0]\nsize = [1, 2]\n'
    "radiance = [1, 1, 1]"
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "point"\nposition = [0, 1, 0]', "point light needs intensity"),
        (POINT + "\nradius = 1", "point light has no radius; it has"),
        (SPOT + "\nlook_at = [0, 0, 0]", "spot light needs one of direction and look_at"),
        (SPOT + "\ninner_angle = 40", "0 <= inner_angle <= angle"),
        ('kind = "sun"\nirradiance = [1, 1, 1]', "a sun needs direction"),
        ('kind = "sun"\nirradiance = [1, 1, 1]\ndirection = [0, 0, 0]', "direction is zero"),
        (AREA + "\nradius = 1", "area light needs one of size and radius"),
        (AREA + "\npower = [1, 1, 1]", "area light needs one of radiance and power"),
        (AREA.replace("[1, 2]", "[1, 0]"), "size must be positive"),
        (
            AREA.replace("look_at = [0, 0, 0]", "look_at = [0, 1, 0]"),
            "the light's own position",
        ),
        (AREA.replace("radiance = [1", "radiance = [-1"), "radiance is 0 or more"),
        (POINT + "\ncolour = 2", "unknown key 'colour'"),
    ],
)
def test_mistakes_in_lights(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        parse_scene(f'name = "s"\n[[light]]\nname = "l"\n{text}\n')


def test_lights_are_read() -> None:
    text = "".join(
        f'[[light]]\nname = "l{i}"\n{light}\n' for i, light in enumerate((POINT, SPOT, AREA))
    )
    lights = parse_scene('name = "s"\n' + text).light
    assert [light.kind for light in lights] == ["point", "spot", "area"]
    assert lights[1].angle == 30
    with pytest.raises(UserError, match=r"two \[\[light\]\] are named 'l0'"):
        parse_scene('name = "s"\n' + text.replace("l1", "l0"))
