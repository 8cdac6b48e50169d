"""Keyed objects and cameras: closed forms of what lies between the keys."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Object, Scene, View, parse_frames, parse_scene
from chromeball.scene.sequence import at, frames_of, missing_plates, moves, object_at, view_at


def ball(*keys: dict[str, Any], interpolation: str = "linear") -> Object:
    fields = {"name": "ball", "mesh": "sphere", "position": (9, 9, 9)}
    return msgspec.convert(
        {**fields, "key": keys, "interpolation": interpolation}, Object, strict=False
    )


def key(frame: float, **values: Any) -> dict[str, Any]:
    return {"frame": frame, **values}


def test_each_property_runs_between_its_own_keys() -> None:
    entry = ball(
        key(0, position=(0, 0, 0), scale=1.0),
        key(5, rotation=(0, 40, 0)),
        key(10, position=(10, 0, -20), scale=(4.0, 1.0, 0.25)),
    )
    middle = object_at(entry, 5)
    assert middle.position == (5, 0, -10)
    assert middle.scale == pytest.approx((2, 1, 0.5))  # the geometric mean
    assert middle.rotation == (0, 40, 0)
    assert middle.key == []
    assert object_at(entry, -3).position == (0, 0, 0)
    assert object_at(entry, 99).position == (10, 0, -20)


def test_what_has_no_key_stays() -> None:
    entry = ball(key(3, rotation=(0, 0, 10)))
    assert object_at(entry, 0).position == (9, 9, 9)
    assert object_at(entry, 0).scale == 1.0


@settings(deadline=None)
@given(st.floats(0, 20), st.lists(st.floats(-5, 5), min_size=2, max_size=6))
def test_a_cubic_path_follows_any_line_exactly_and_meets_its_keys(
    time: float, jumps: list[float]
) -> None:
    frames = np.cumsum([1.0, 3.0, 2.0, 5.0, 1.0, 4.0])[: len(jumps)].tolist()
    line = [key(float(t), position=(2 * t, 1.0, -t)) for t in frames]
    now = float(np.clip(time, frames[0], frames[-1]))
    np.testing.assert_allclose(
        object_at(ball(*line, interpolation="cubic"), time).position,
        (2 * now, 1, -now),
        atol=1e-9,
    )
    bent = [key(float(t), position=(p, 0, 0)) for t, p in zip(frames, jumps, strict=True)]
    entry = ball(*bent, interpolation="cubic")
    for there in bent:
        np.testing.assert_allclose(
            object_at(entry, there["frame"]).position, there["position"], atol=1e-12
        )


def test_a_cubic_path_has_one_velocity_at_a_key() -> None:
    places = [(0.0, 0, 0), (1.0, 2, 0), (4.0, 1, 0), (5.0, 5, 1)]
    entry = ball(
        *(key(f, position=p) for f, p in zip((0, 2, 3, 7), places, strict=True)),
        interpolation="cubic",
    )
    step = 1e-5
    for frame in (2, 3):
        before, here, after = (
            np.array(object_at(entry, frame + d).position) for d in (-step, 0, step)
        )
        np.testing.assert_allclose((after - here) / step, (here - before) / step, atol=1e-3)
    # Catmull-Rom: from the key before to the key after
    velocity = (np.array(object_at(entry, 2 + step).position) - places[1]) / step
    np.testing.assert_allclose(velocity, (np.array(places[2]) - places[0]) / 3, atol=1e-3)


def test_rotations_turn_at_constant_speed_about_one_axis() -> None:
    a, b = (10.0, -20.0, 30.0), (100.0, 50.0, -60.0)
    entry = ball(key(0, rotation=a), key(4, rotation=b))
    turns = [
        Rotation.from_euler("xyz", object_at(entry, t).rotation, degrees=True) for t in range(5)
    ]
    steps = [(turns[i].inv() * turns[i + 1]).as_rotvec() for i in range(4)]
    np.testing.assert_allclose(steps, [steps[0]] * 4, atol=1e-9)
    whole = (turns[0].inv() * turns[4]).magnitude()
    assert 4 * np.linalg.norm(steps[0]) == pytest.approx(whole)
    assert object_at(entry, 0).rotation == a
    assert object_at(entry, 4).rotation == b
    # straight up is where angles about axes lose one: the turn is still right
    up = ball(key(0, rotation=(0, 80, 0)), key(2, rotation=(0, 100, 0)))
    there = Rotation.from_euler("xyz", object_at(up, 1).rotation, degrees=True)
    np.testing.assert_allclose(there.as_rotvec(), [0, math.pi / 2, 0], atol=1e-9)


TEXT = """
name = "moving"
[[object]]
name = "ball"
mesh = "sphere"
[[object.key]]
frame = 1
position = [0, 0, 0]
[[object.key]]
frame = 3
position = [2, 0, 0]
[[view]]
name = "main"
plate = "plates/%04d.exr"
camera = "cameras/%d.cameramodel"
frames = "1-3"
[[view]]
name = "round"
[[view.key]]
frame = 1
look_at = [0, 0, 0]
fov = 40
[[view.key]]
frame = 3
look_at = [1, 0, 0]
fov = 60
[render]
seed = 7
"""


def test_a_frame_is_a_still_with_files_and_a_seed_of_its_own() -> None:
    scene = parse_scene(TEXT)
    assert all(moves(scene, view) for view in scene.view)
    still = at(scene, 2)
    assert still.object[0].position == (1, 0, 0)
    assert still.view[0].plate == "plates/0002.exr"
    assert still.view[0].camera == "cameras/2.cameramodel"
    assert still.view[1].look_at == (0.5, 0, 0)
    assert still.view[1].fov == 50
    assert still.render.seed == 9
    assert not any(moves(still, view) for view in still.view)
    assert frames_of(scene.view[0]) == [1, 2, 3]
    assert frames_of(scene.view[1]) == []
    assert not moves(Scene(name="s"), View(name="v"))
    assert view_at(View(name="v"), 4) == View(name="v")


def test_missing_plates_are_named(tmp_path: Path) -> None:
    view = parse_scene(TEXT).view[0]
    (tmp_path / "plates").mkdir()
    (tmp_path / "cameras").mkdir()
    for frame in (1, 3):
        (tmp_path / f"plates/{frame:04d}.exr").touch()
        (tmp_path / f"cameras/{frame}.cameramodel").touch()
    missing_plates(view, [1, 3], tmp_path)
    with pytest.raises(UserError, match=r"0002\.exr: the plate of frame 2 is missing"):
        missing_plates(view, [1, 2, 3], tmp_path)
    with pytest.raises(UserError, match=r"frame 2 \(and of 2 more\)"):
        missing_plates(view, [1, 2, 4, 5], tmp_path)


def test_frame_ranges() -> None:
    assert parse_frames("7") == [7]
    assert parse_frames("1-4") == [1, 2, 3, 4]
    assert parse_frames("1-9:4, 5,20") == [1, 5, 9, 20]
    for wrong in ("", "4-1", "1-4:0", "a", "1:2", "-3", "1-4:", "1-999999999"):
        with pytest.raises(UserError):
            parse_frames(wrong)


@settings(deadline=None)
@given(st.text(max_size=12))
def test_any_text_is_frames_or_a_mistake(text: str) -> None:
    try:
        frames = parse_frames(text)
    except UserError:
        return
    assert frames == sorted(set(frames))
    assert frames


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frame = 3\nposition", "frame = 1\nposition", "frames of its keys must rise"),
        ('frames = "1-3"', 'frames = "3-1"', "are no frames"),
        ("fov = 60", "fov = 0", "fov at frame 3"),
        ("fov = 60", "rotation = [0, 0, 0]", "not both"),
        ("look_at = [1, 0, 0]\nfov = 60", "rotation = [0, 0, 0]", "keep one of the two"),
        ("plates/%04d.exr", "%d/%04d.exr", "more than one number"),
        ('name = "round"', 'name = "round"\nplate = "p.exr"', "one file a frame"),
        ("position = [2, 0, 0]", "scale = 0", "scale must be positive"),
        ("position = [2, 0, 0]", "place = [2, 0, 0]", "unknown key 'place'"),
    ],
)
def test_mistakes_are_said(old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(UserError, match=message):
        parse_scene(TEXT.replace(old, new))
