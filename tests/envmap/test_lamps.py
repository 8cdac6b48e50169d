"""A8: lamps of known place, size and light, seen in a map."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.main import build_app
from chromeball.envmap.irradiance import irradiance, spread_directions
from chromeball.envmap.lamps import as_scene_lights, find_lamps
from chromeball.envmap.mapping import LatLong
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.manifest import Light
from chromeball.scene.record import read_json

PLACE = np.array([0.3, 1.2, -0.1])
SIZE = (512, 256)


def room() -> tuple[np.ndarray, np.ndarray]:
    """A window of 1.6 x 1 m in the wall x = 3, a panel of .6 x 1.2 m in the ceiling y = 3."""
    d = LatLong(SIZE).directions()
    with np.errstate(divide="ignore"):
        walls = np.stack(
            [(np.where(d[..., k] > 0, hi, lo) - PLACE[k]) / d[..., k]
             for k, (lo, hi) in enumerate([(-3, 3), (0, 3), (-3, 3)])], axis=-1
        )  # fmt: skip
    depth = walls.min(axis=-1)
    p = PLACE + d * depth[..., None]
    radiance = np.full((*p.shape[:2], 3), 0.2)
    window = (
        (p[..., 0] > 2.999) & (np.abs(p[..., 2] - 0.5) < 0.8) & (np.abs(p[..., 1] - 1.5) < 0.5)
    )
    panel = (p[..., 1] > 2.999) & (np.abs(p[..., 0] + 1) < 0.3) & (np.abs(p[..., 2]) < 0.6)
    radiance[window] += [20, 22, 25]
    radiance[panel] += [40, 35, 30]
    return radiance.astype(np.float32), depth.astype(np.float32)


def test_places_and_sizes() -> None:
    radiance, depth = room()
    lamps, rest = find_lamps(radiance, depth=depth, origin=PLACE)
    assert len(lamps) == 2
    window, panel = sorted(lamps, key=lambda lamp: lamp.radiance[0])
    assert window.position is not None
    assert window.size is not None
    assert window.normal is not None
    np.testing.assert_allclose(window.position, [3, 1.5, 0.5], atol=0.02)
    np.testing.assert_allclose(window.normal, [-1, 0, 0], atol=0.01)
    np.testing.assert_allclose(window.size, [1.6, 1], rtol=0.03)
    np.testing.assert_allclose(window.radiance, [20, 22, 25], rtol=1e-3)
    assert panel.position is not None
    assert panel.size is not None
    assert panel.normal is not None
    np.testing.assert_allclose(panel.position, [-1, 3, 0], atol=0.02)
    np.testing.assert_allclose(panel.normal, [0, -1, 0], atol=0.01)
    np.testing.assert_allclose(sorted(panel.size), [0.6, 1.2], rtol=0.03)
    np.testing.assert_allclose(rest, 0.2, rtol=1e-6)
    # together they are the map
    normals = spread_directions(20)
    lit = sum(
        np.maximum(normals @ lamp.direction, 0)[:, None] * lamp.radiance * lamp.solid_angle
        for lamp in lamps
    )
    np.testing.assert_allclose(
        irradiance(rest, normals) + lit, irradiance(radiance, normals), rtol=0.1, atol=0.3
    )


def test_across_the_seam_and_far_away() -> None:
    d = LatLong(SIZE).directions()
    radiance = np.full((*d.shape[:2], 3), 0.1, np.float32)
    centre = np.array([0.0, 0.3, -1]) / math.hypot(0.3, 1)  # the map's edge
    radiance[d @ centre > math.cos(0.1)] = 100
    lamps, rest = find_lamps(radiance, depth=np.full(SIZE[::-1], np.inf, np.float32))
    assert len(lamps) == 1
    assert lamps[0].position is None
    np.testing.assert_allclose(lamps[0].direction, centre, atol=1e-2)
    assert rest.max() == pytest.approx(0.1)
    light = tomllib.loads(as_scene_lights(lamps))["light"][0]
    assert light["kind"] == "sun"
    np.testing.assert_allclose(light["direction"], -centre, atol=1e-2)


def test_nothing_bright() -> None:
    lamps, rest = find_lamps(np.ones((16, 32, 3), np.float32))
    assert lamps == []
    np.testing.assert_array_equal(rest, 1)
    with pytest.raises(UserError, match="black"):
        find_lamps(np.zeros((16, 32, 3), np.float32))


def test_command(tmp_path: Path) -> None:
    radiance, depth = room()
    write_exr(tmp_path / "env.exr", radiance, attributes={"origin": PLACE})
    write_exr(tmp_path / "depth.exr", depth[..., None], channels=("Z",))
    arguments = [
        *("envmap", "lights", tmp_path / "env.exr", "--depth", tmp_path / "depth.exr"),
        *("--lamps", tmp_path / "lamps.toml", "--rest", tmp_path / "rest.exr"),
        *("-o", tmp_path / "lights.json"),
    ]
    build_app()([str(a) for a in arguments], result_action="return_value")
    entries = tomllib.loads((tmp_path / "lamps.toml").read_text())["light"]
    lights = [Light(**entry) for entry in entries]  # what a scene file allows
    assert [light.kind for light in lights] == ["area", "area"]
    assert len(read_json(tmp_path / "lights.json")["lamps"]) == 2
    assert read_image(tmp_path / "rest.exr").pixels.max() < 0.21
    with pytest.raises(UserError, match="--lamps"):
        build_app()(
            ["envmap", "lights", str(tmp_path / "env.exr"), "--rest", "r.exr", "-o", "l.json"],
            result_action="return_value",
        )
