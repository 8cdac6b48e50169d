"""Between templates of the day: one sun on its way, against a sky known at all hours."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.cli.main import build_app
from chromeball.envmap.daytime import Template, arc_pole, at_hour, left_out, parse_clock
from chromeball.envmap.irradiance import irradiance
from chromeball.envmap.lights import NORMALS
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.sun import add_disc
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.record import read_json

MAP = LatLong((256, 128))
LATITUDE = math.radians(48)


def sun_at(hour: float) -> NDArray[np.float64]:
    """At an equinox: 15 degrees an hour about the celestial pole."""
    h = math.radians(15 * (hour - 12))
    south = np.array([0.0, math.cos(LATITUDE), math.sin(LATITUDE)])
    return math.cos(h) * south + math.sin(h) * np.array([1.0, 0, 0])


def day(hour: float, sun: bool = True) -> NDArray[np.float32]:
    """A blue sky with a glow about the sun, brown ground, both as bright as the sun is high."""
    s = sun_at(hour)
    d = MAP.directions()
    glow = np.exp(3 * (d @ s - 1))[..., None] * np.array([1.0, 0.9, 0.8])
    blue = np.array([0.3, 0.5, 1.0]) * (1.5 - d[..., 1:2])
    rgb = np.where(d[..., 1:2] > 0, blue + glow, [0.3, 0.25, 0.2]) * (0.2 + s[1])
    rgb = rgb.astype(np.float32)
    light = 30 * np.exp(-0.2 / max(s[1], 0.05)) * np.array([1.0, 0.95, 0.85])
    return add_disc(rgb, s, math.radians(0.6), light) if sun else rgb


def templates(*hours: float) -> list[Template]:
    return [Template.of(float(hour), day(hour)) for hour in hours]


def error(rgb: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
    """Of irradiance on six normals, relative to its mean."""
    made, wanted = irradiance(rgb, NORMALS), irradiance(truth, NORMALS)
    return float(np.sqrt(np.mean((made - wanted) ** 2)) / wanted.mean())


@pytest.mark.parametrize("hours", [(9.0, 12.0, 16.0), (10.0, 15.0)])
def test_a_held_out_hour(hours: tuple[float, ...]) -> None:
    made = at_hour(templates(*hours), 13.5)
    assert made.direction is not None
    # three suns give the circle; an equinox's is a great one, so that two do, too
    assert np.degrees(np.arccos(made.direction @ sun_at(13.5))) < 0.4
    assert error(made.radiance, day(13.5)) < 0.06
    u = made.share
    one, two = (day(h) for h in (made.earlier, made.later))
    faded = ((1 - u) * one + u * two).astype(np.float32)
    assert error(made.radiance, day(13.5)) < 0.5 * error(faded, day(13.5))
    # one sun stands in it, not two
    hot = made.radiance.max(axis=2) > 50
    assert (MAP.directions()[hot] @ sun_at(13.5) > math.cos(math.radians(4))).all()


def test_templates_come_back() -> None:
    for hour in (9.0, 12.0, 16.0):
        made = at_hour(templates(9, 12, 16), hour)
        assert error(made.radiance, day(hour)) < 0.01


def test_the_poles_of_arcs() -> None:
    """In winter the sun's circle is a small one."""
    pole = np.array([0.0, math.sin(LATITUDE), -math.cos(LATITUDE)])
    east = np.array([1.0, 0, 0])
    south = np.cross(pole, east)
    tilt = math.radians(-20)
    hours = np.radians(15 * np.array([-3.0, 0.0, 2.5]))
    suns = [
        math.sin(tilt) * pole + math.cos(tilt) * (math.cos(h) * south + math.sin(h) * east)
        for h in hours
    ]
    found = arc_pole(suns)
    assert abs(found @ pole) == pytest.approx(1, abs=1e-9)
    assert float(np.cross(suns[0], suns[1]) @ found) > 0


def test_a_sun_behind_clouds_fades() -> None:
    cloudy = Template.of(12.0, day(12, sun=False))
    assert cloudy.sun is None
    clear = Template.of(10.0, day(10))
    made = at_hour([clear, cloudy], 11.0)
    assert clear.sun is not None
    assert made.irradiance is not None
    np.testing.assert_allclose(made.irradiance, clear.sun.irradiance / 2)
    dark = at_hour([cloudy, Template.of(14.0, day(14, sun=False))], 13.0)
    assert dark.irradiance is None


def test_linear_and_logarithmic() -> None:
    flat = [np.full((16, 32, 3), v, np.float32) for v in (1.0, 4.0, 0.0)]
    a, b, black = (
        Template(h, rgb, None) for h, rgb in zip((8.0, 10.0, 12.0), flat, strict=True)
    )
    assert at_hour([a, b], 9.0).radiance.mean() == pytest.approx(2)
    assert at_hour([a, b], 9.0, "linear").radiance.mean() == pytest.approx(2.5)
    assert at_hour([b, black], 11.0).radiance.mean() == pytest.approx(2)


def test_left_out() -> None:
    errors = left_out(templates(9, 11, 13, 15))
    assert set(errors) == {11.0, 13.0}
    assert max(errors.values()) < 0.08


def test_refusals() -> None:
    two = templates(9, 12)
    with pytest.raises(UserError, match="13:00 is not between 09:00 and 12:00"):
        at_hour(two, 13.0)
    with pytest.raises(UserError, match="at least two"):
        at_hour(two[:1], 9.0)
    with pytest.raises(UserError, match="of the same hour"):
        at_hour([two[0], two[0]], 9.0)
    small = Template(12.0, np.ones((8, 16, 3), np.float32), None)
    with pytest.raises(UserError, match="differ in size"):
        at_hour([two[0], small], 10.0)
    for text in ("25:00", "noon", "9:70", "nan", "-1"):
        with pytest.raises(UserError, match="no time of a day"):
            parse_clock(text)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = []
    for hour in (9, 12, 16):
        path = tmp_path / f"h{hour}.exr"
        write_exr(path, day(hour), attributes={"origin": (0.0, 1.0, 0.0)})
        names.append(f"{path}@{hour:02}:00")

    def run(*arguments: object) -> None:
        build_app()(
            [str(a) for a in ("envmap", "daytime", *arguments)],
            exit_on_error=False,
            result_action="return_value",
        )

    out = tmp_path / "now.exr"
    run(*names, "--at", "13:30", "-o", out)
    image = read_image(out)
    assert error(image.pixels[..., :3], day(13.5)) < 0.06
    figures = read_json(tmp_path / "now.exr.record.json")["figures"]
    assert figures["between"] == ["12:00", "16:00"]
    assert figures["left_out_errors"]["12:00"] < 0.1
    assert "warnings" not in figures
    assert "warning" not in capsys.readouterr().err
    # the same maps said to be of hours too near each other
    hours = [name.split("@")[0] + f"@10:{k}0" for k, name in enumerate(names)]
    run(*hours, "--at", "10:05", "-o", out)
    assert "at most 15 an hour" in capsys.readouterr().err
    with pytest.raises(UserError, match="say its hour"):
        run(tmp_path / "h9.exr", "--at", "10:00", "-o", out)
