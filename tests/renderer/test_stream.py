"""The interactive session without a browser."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.renderer.save import edited
from chromeball.renderer.stream import (
    Eye,
    Pace,
    Picture,
    Session,
    Settings,
    letterbox,
    nearest_distance,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import to_display, write_exr
from chromeball.scene.manifest import Material, parse_scene, read_scene
from chromeball.scene.pose import Pose
from tests.renderer.scenes import SCENE, write_scene

COMMENTED = SCENE.replace(
    'mesh = "sphere"\n',
    'mesh = "sphere"   # of unit size\n# it stands here for now\n'
    'material = { kind = "diffuse", color = [0.5, 0.5, 0.5] } # grey\n',
)
SIZE = (40, 30)


class Window:
    """Takes the pictures that a session shows."""

    def __init__(self) -> None:
        self._pictures: queue.Queue[Picture] = queue.Queue()

    def __call__(self, picture: Picture) -> None:
        self._pictures.put(picture)

    def next(self, *, moving: bool | None = None, done: bool | None = None) -> Picture:
        """The next picture of a kind; a session that stands still fails the test."""
        while True:
            picture = self._pictures.get(timeout=20)
            if moving in (None, picture.moving) and done in (None, picture.done):
                return picture

    def is_quiet(self) -> bool:
        time.sleep(0.3)
        return self._pictures.empty()


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path, COMMENTED)


@pytest.fixture
def session(scene: Path) -> Iterator[Session]:
    made = Session(scene, settings=Settings(error=0.05))
    yield made
    made.stop()
    assert made.failure is None


def test_a_picture_moves_sharpens_and_is_then_left_alone(session: Session) -> None:
    window = Window()
    session.open(window, SIZE)
    first = window.next()
    assert first.moving
    assert first.samples == session.settings.samples
    assert first.codes.shape[1] < SIZE[0]
    rested = window.next(moving=False)
    assert rested.codes.shape == (30, 40, 3)
    assert rested.samples == 1
    last = window.next(done=True)
    assert last.error is not None
    assert last.error <= 0.05
    assert session.is_idle()
    assert window.is_quiet()
    session.set(error=last.error / 3)  # goes on where it was
    better = window.next(done=True)
    assert better.samples > last.samples
    assert (better.error or 1) <= last.error / 3
    session.set(stops=1.0)  # the same picture, brighter
    brighter = window.next(done=True)
    assert brighter.samples == better.samples
    assert brighter.codes.mean() > last.codes.mean() * 1.1


def test_what_was_moved_is_what_a_scene_made_so_shows(session: Session, scene: Path) -> None:
    window = Window()
    session.open(window, SIZE)
    before = window.next(done=True)
    session.change("ball", position=(0.4, 0, 0), rotation=(0, 20, 10), scale=(0.3, 0.6, 0.3))
    moved = window.next(done=True)
    session.change("ball", material={"kind": "mirror", "color": (0.9, 0.8, 0.7)})
    mirror = window.next(done=True)
    assert session.save(Path("copy.toml")) == 1
    other = Session(scene.with_name("copy.toml"), settings=session.settings)
    try:
        window = Window()
        other.open(window, SIZE)
        fresh = window.next(done=True)
        assert fresh.samples == mirror.samples
        assert np.array_equal(fresh.codes, mirror.codes)
    finally:
        other.stop()
    for a, b in ((before, moved), (moved, mirror)):
        assert (np.abs(a.codes.astype(int) - b.codes) > 20).any(axis=2).mean() > 0.02


def test_a_photograph_stays_bit_for_bit_and_only_behind_its_own_camera(tmp_path: Path) -> None:
    text = SCENE.replace("size = [40, 30]", 'plate = "p.exr"\ncamera = "c.cameramodel"')
    scene = write_scene(tmp_path, text + '[[view]]\nname = "free"\nsize = [20, 20]\n')
    pose = Pose.look_at(np.array([0.0, 1.0, 1.5]), np.array([0.0, 0.2, 0.0]))
    camera = CameraModel.pinhole(SIZE, 1.0, pose)
    camera.write(tmp_path / "c.cameramodel")
    rng = np.random.default_rng(0)
    plate = rng.uniform(0.1, 1, (30, 40, 3)).astype(np.float32)
    write_exr(tmp_path / "p.exr", plate)
    session = Session(scene, settings=Settings(error=0.05))
    try:
        window = Window()
        eye = session.open(window, SIZE)
        own = window.next(done=True).codes
        exposure = session.exposure
        same = (own == to_display(plate, exposure)).all(axis=2)
        assert 0.3 < same.mean() < 1
        session.look(eye, camera.posed(Pose(pose.rotation, pose.translation + [0, 0, 0.01])))
        away = window.next(done=True).codes
        assert (away == to_display(plate, exposure)).all(axis=2).mean() < 0.05
        session.choose(eye, "free")  # square, in a window that is not
        square = window.next(done=True).codes
        assert square.shape == (20, 27, 3)
        assert not square[:, 0].any()
        session.choose(eye, "main")
        again = window.next(done=True).codes
        assert np.array_equal(again, own)
        with pytest.raises(UserError, match=r"no .*view.* named 'x'"):
            session.choose(eye, "x")
    finally:
        session.stop()


def test_every_eye_is_served_and_a_closed_one_no_more(session: Session) -> None:
    windows = [Window(), Window()]
    eyes = [session.open(window, SIZE) for window in windows]
    for window in windows:
        window.next(done=True)
    session.close(eyes[0])
    session.change("ball", position=(0.2, 0, 0))
    windows[1].next(done=True)
    assert windows[0].is_quiet()
    session.close(eyes[1])
    session.change("ball", position=(0.3, 0, 0))
    assert windows[1].is_quiet()
    assert session.is_idle()


def test_cameras_stay_where_something_was_captured(scene: Path) -> None:
    session = Session(scene)
    try:
        # the probe is 1 m above the floor
        assert session.radius == pytest.approx(0.5)
        origin = session.captured.origin
        far = origin + [0.0, 3.0, 4.0]
        np.testing.assert_allclose(session.within(far), origin + [0.0, 0.3, 0.4])
        near = origin + [0.1, 0.1, 0.1]
        np.testing.assert_array_equal(session.within(near), near)
        eye = session.open(Window(), SIZE)
        held = session.look(eye, CameraModel.pinhole(SIZE, 1.0, Pose(np.eye(3), far)))
        np.testing.assert_allclose(held.world_from_camera.translation, session.within(far))
    finally:
        session.stop()
    for session in (Session(scene, travel=True), Session(scene, radius=100.0)):
        try:
            np.testing.assert_array_equal(session.within(far), far)
        finally:
            session.stop()
    with pytest.raises(UserError, match="--radius is -1"):
        Session(scene, radius=-1.0)


def test_mistakes_change_nothing(session: Session) -> None:
    for fields, message in (
        ({"scale": 0.0}, "scale must be positive"),
        ({"material": {"kind": "wood"}}, "wood"),
        ({"material": {"color": (2, 0, 0)}}, "lies between 0 and 1"),
    ):
        with pytest.raises(UserError, match=message):
            session.change("ball", **fields)
    with pytest.raises(UserError, match=r"no \[\[object\]\] named 'bull'"):
        session.change("bull", scale=1.0)
    assert session.changed() == []


def test_a_sequence_is_seen_at_a_frame_and_its_keys_are_left_alone(tmp_path: Path) -> None:
    keys = "key = [{ frame = 2, position = [-1, 0, 0] }, { frame = 4, position = [1, 0, 0] }]"
    scene = write_scene(tmp_path, SCENE.replace("scale = 0.5", f"scale = 0.5\n{keys}"))
    for frame, x in ((None, -1), (3, 0)):
        session = Session(scene, frame=frame)
        try:
            assert session.scene.object[0].position == (x, 0, 0)
            with pytest.raises(UserError, match="moved by its keys"):
                session.change("ball", position=(0, 0, 0))
        finally:
            session.stop()


# ---- the scene file


def test_saving_keeps_comments_and_what_was_not_changed(session: Session, scene: Path) -> None:
    session.change("ball", position=(0.25, 0, -0.5), material={"kind": "glass", "ior": 1.3})
    with pytest.raises(UserError, match="is there already; confirm"):
        session.save(scene)
    assert scene.read_text() == COMMENTED
    assert session.save(scene, overwrite=True) == 1
    text = scene.read_text()
    assert "# of unit size" in text
    assert "# it stands here for now" in text
    assert "# grey" in text
    assert text.count("\n") == COMMENTED.count("\n") + 1  # one line more: position
    entry = read_scene(scene).object[0]
    assert entry.position == (0.25, 0, -0.5)
    assert entry.material == Material(kind="glass", ior=1.3)
    assert entry.scale == 0.5
    assert session.changed() == []
    for place in ("../x.toml", "/elsewhere/x.toml", "x.txt", "sub/x.toml"):
        with pytest.raises(UserError, match="own folder"):
            session.save(Path(place))
    # edited by hand meanwhile: both changes stay
    scene.write_text(text.replace("scale = 0.5", "scale = 0.7"))
    session.change("ball", rotation=(0, 5, 0))
    session.save(Path(scene.name), overwrite=True)
    entry = read_scene(scene).object[0]
    assert (entry.rotation, entry.position) == ((0, 5, 0), (0.25, 0, -0.5))
    # the object is gone, or the file is broken: it is left as it is
    for wrong, message in (
        (text.replace('name = "ball"', 'name = "bull"'), "'ball' any more"),
        ("[[", "not valid TOML"),
    ):
        scene.write_text(wrong)
        session.change("ball", rotation=(0, 6, len(wrong)))
        with pytest.raises(UserError, match=message):
            session.save(Path(scene.name), overwrite=True)
        assert scene.read_text() == wrong


vector = st.tuples(*[st.floats(-1e6, 1e6)] * 3)


@settings(deadline=None, max_examples=60)
@given(vector, vector, st.floats(1e-3, 1e3), st.sampled_from(["diffuse", "mirror", "glass"]))
@pytest.mark.parametrize(
    "style",
    [
        SCENE,
        COMMENTED,
        SCENE.replace("= 0.5", "= 0.5\n[object.material]\nkind = 'glass' # clear\nior = 1.2"),
        'name="s"\nobject = [{ name = "ball", mesh = "sphere", scale = 0.5 }] # in one line\n',
    ],
)
def test_whatever_is_saved_is_read_again(
    style: str,
    position: tuple[float, float, float],
    rotation: tuple[float, float, float],
    scale: float,
    kind: str,
) -> None:
    import msgspec

    old = parse_scene(style).object[0]
    value = {**msgspec.to_builtins(old), "position": position, "rotation": rotation}
    value |= {"scale": scale, "material": {"kind": kind, "color": (0.1, 0.2, 1.0)}}
    new = msgspec.convert(value, type(old))
    text = edited(style, [new], "scene.toml")
    assert parse_scene(text).object == [new]
    for comment in (line.partition("#")[2] for line in style.splitlines()):
        assert comment in text


# ---- small things


def test_the_size_settles_where_a_frame_takes_the_time_that_is_wanted() -> None:
    pace = Pace()
    for _ in range(50):  # a frame of the whole picture takes 0.4 s
        pace.measured(0.4 * pace.scale**2, 1 / 15)
    assert 0.4 * pace.scale**2 == pytest.approx(1 / 15, rel=0.05)
    for _ in range(50):
        pace.measured(9.0, 1 / 15)
    assert pace.scale == 1 / 8
    for _ in range(50):
        pace.measured(0.0, 1 / 15)
    assert pace.scale == 1


def test_bars_give_a_picture_its_windows_shape() -> None:
    codes = np.full((30, 40, 3), 200, np.uint8)
    assert letterbox(codes, 4 / 3) is codes
    wide = letterbox(codes, 2.0)
    assert wide.shape == (30, 60, 3)
    assert (wide[:, 10:50] == 200).all()
    assert not wide[:, :10].any()
    assert letterbox(codes, 1.0).shape == (40, 40, 3)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_the_nearest_triangle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    triangles, point = rng.normal(size=(4, 3, 3)), rng.normal(size=3)
    u, v = np.meshgrid(np.linspace(0, 1, 300), np.linspace(0, 1, 300))
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=-1).reshape(-1, 3)
    cloud = np.einsum("nk,fki->fni", weights, triangles)
    sampled = np.linalg.norm(cloud - point, axis=2).min()
    exact = nearest_distance(point, triangles)
    assert exact <= sampled + 1e-9
    assert exact == pytest.approx(sampled, abs=0.03)
    flat = np.repeat(triangles[:, :1], 3, axis=1)  # without area: points
    expected = np.linalg.norm(flat[:, 0] - point, axis=1).min()
    assert nearest_distance(point, flat) == pytest.approx(expected)


def test_an_eye_is_what_is_given_to_it() -> None:
    camera = CameraModel.pinhole(SIZE, 1.0)
    assert Eye(Window(), SIZE, camera) != Eye(Window(), SIZE, camera)
