"""Axes from any mix: exact on exact clicks, predicted noise, contradictions, open axes, sun."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.envmap import app
from chromeball.envmap.axes import (
    Axes,
    Bearing,
    Horizon,
    Observation,
    Rectangle,
    Vertical,
    direction,
    pairs,
    solve_axes,
)
from chromeball.envmap.sun_position import parse_time, sun_position
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import parse_scene
from chromeball.scene.pose import Pose

PANORAMA = CameraModel.latlong((2048, 1024))
FISHEYE = CameraModel.fisheye("equisolid", (1200, 1200), math.radians(190))
PINHOLE = CameraModel.pinhole((1600, 1200), math.radians(110))
SUN = (math.radians(25), math.radians(15))


def looking(yaw: float, pitch: float, roll: float, height: float = 1.5) -> Pose:
    """A camera over the origin that looks along -Z, then is turned."""

    def turn(*v: float) -> np.ndarray:
        return Pose.from_rotation_vector(np.array(v, float), np.zeros(3)).rotation

    level = turn(0, yaw, 0) @ np.diag([1.0, -1, -1])
    return Pose(level @ turn(pitch, 0, 0) @ turn(0, 0, roll), np.array([0, height, 0]))


def seen(camera: CameraModel, pose: Pose, world: object) -> np.ndarray:
    q = camera.posed(pose).project_world(np.asarray(world, float))
    assert np.isfinite(q).all()
    return q


def far(camera: CameraModel, pose: Pose, azimuth: float, elevation: float) -> np.ndarray:
    return seen(camera, pose, pose.translation + 1e8 * direction(azimuth, elevation))


def edges(camera: CameraModel, pose: Pose, *places: tuple[float, float]) -> list[Vertical]:
    return [Vertical(seen(camera, pose, [[x, 0.8, z], [x, 2.1, z]])) for x, z in places]


def rectangle(camera: CameraModel, pose: Pose, width: float | None = 1.2) -> Rectangle:
    corners = np.array([[-0.6, 0, 0.4], [0.6, 0, 0.4], [0.6, 0, -0.4], [-0.6, 0, -0.4]])
    return Rectangle(seen(camera, pose, corners + [0, 0, -2.5]), width=width)


def tilt(axes: Axes, truth: Pose) -> float:
    up = axes.world_from_camera.rotation[1] @ truth.rotation[1]
    return float(np.arccos(np.clip(up, -1, 1)))


MIXES = ["verticals sun", "horizon north", "vertical horizon sun", "verticals north", "all"]


@pytest.mark.parametrize("camera", [PANORAMA, FISHEYE, PINHOLE], ids=lambda c: c.model)
@pytest.mark.parametrize("mix", MIXES)
def test_exact_clicks_give_the_attitude_back(camera: CameraModel, mix: str) -> None:
    rng = np.random.default_rng(len(mix) + 1)
    for _ in range(3):
        pose = looking(*rng.uniform(-0.25, 0.25, 3))
        observed: list[Observation] = []
        observed += edges(camera, pose, (-1.2, -3), (1.4, -2.5))[: 1 if "al h" in mix else 2]
        if "vert" not in mix and mix != "all":
            observed = []
        if "horizon" in mix or mix == "all":
            observed += [Horizon(far(camera, pose, a, 0.0)) for a in (-0.4, 0.1, 0.4)]
        if "sun" in mix or mix == "all":
            observed.append(Bearing(far(camera, pose, *SUN), *SUN))
        if "north" in mix or mix == "all":
            observed.append(Bearing(far(camera, pose, 0.2, -0.1), 0.2))
        found = solve_axes(camera, observed, camera_height=1.5)
        np.testing.assert_allclose(found.world_from_camera.matrix(), pose.matrix(), atol=1e-7)
        assert not found.warnings
        assert found.north == 0
        assert found.scaled
        assert found.chi_square < 1e-6


@pytest.mark.parametrize("camera", [PANORAMA, FISHEYE], ids=lambda c: c.model)
def test_a_rectangle_with_verticals_and_the_sun(camera: CameraModel) -> None:
    """+X is the rectangle's; the sun says where north is in these axes."""
    pose = looking(0.2, 0.3, 0.1)
    heading = 0.7
    azimuth = SUN[0] + heading  # from true north; the world's -Z is at `heading`
    observed = [
        rectangle(camera, pose),
        *edges(camera, pose, (-1.2, -3), (1.4, -2.5)),
        Bearing(far(camera, pose, *SUN), azimuth, SUN[1]),
    ]
    found = solve_axes(camera, observed, camera_height=1.5)
    truth = pose.matrix()
    truth[2, 3] += 2.5  # the origin is the rectangle's middle
    np.testing.assert_allclose(found.world_from_camera.matrix(), truth, atol=1e-6)
    assert found.north == pytest.approx(heading)
    assert found.width == pytest.approx(1.2)
    assert found.depth == pytest.approx(0.8)
    assert found.camera_height == pytest.approx(1.5)


def test_the_mix_is_better_than_the_rectangle_alone() -> None:
    pose = looking(0.2, 0.3, 0.1)
    small = rectangle(PANORAMA, pose)
    alone = solve_axes(PANORAMA, [small])
    mixed = solve_axes(PANORAMA, [small, *edges(PANORAMA, pose, (-1.2, -3), (2.4, 1))])
    assert mixed.sigma_tilt < 0.5 * alone.sigma_tilt


def test_a_wall_and_a_ceiling() -> None:
    pose = looking(0.1, 0.05, -0.1)
    wall = np.array([[-1, 0.5, -3], [1, 0.5, -3], [1, 2.5, -3], [-1, 2.5, -3.0]])
    for corners in (wall, wall[[3, 2, 1, 0]]):  # along its lower edge or its upper one
        q = seen(FISHEYE, pose, corners)
        found = solve_axes(FISHEYE, [Rectangle(q, "wall", width=2.0)])
        truth = pose.matrix()
        truth[:3, 3] -= [0, 1.5, -3]
        np.testing.assert_allclose(found.world_from_camera.matrix(), truth, atol=1e-6)
    ceiling = np.array([[-1, 3, -1], [1, 3, -1], [1, 3, -3], [-1, 3, -3.0]])
    found = solve_axes(FISHEYE, [Rectangle(seen(FISHEYE, pose, ceiling), "ceiling", width=2.0)])
    np.testing.assert_allclose(found.world_from_camera.rotation, pose.rotation, atol=1e-6)
    assert found.world_from_camera.translation[1] == pytest.approx(-1.5)


def test_noise_has_the_predicted_covariance() -> None:
    """80 noisy solutions: the mean square over the predicted lies within 0.4 .. 1.9 at 99.99 %.

    The predicted errors hold clicks and the world's own unevenness; both are drawn.
    """
    rng = np.random.default_rng(8)
    pose = looking(0.1, 0.15, -0.1)
    truth = [
        *edges(PANORAMA, pose, (-1.2, -3), (2.4, 1)),
        Bearing(far(PANORAMA, pose, *SUN), *SUN),
    ]
    predicted = solve_axes(PANORAMA, truth, camera_height=1.5)
    squares: list[tuple[float, float]] = []
    for _ in range(80):
        noisy: list[Observation] = []
        for x, z in ((-1.2, -3.0), (2.4, 1.0)):
            lean = np.tan(rng.normal(scale=math.radians(0.15), size=2))
            ends = [[x, 0.8, z], [x + 1.3 * lean[0], 2.1, z + 1.3 * lean[1]]]
            noisy.append(Vertical(seen(PANORAMA, pose, ends) + rng.normal(size=(2, 2))))
        off = rng.normal(scale=math.radians(0.1), size=2) + [SUN[0], SUN[1]]
        sun = far(PANORAMA, pose, float(off[0]), float(off[1])) + rng.normal(size=2)
        noisy.append(Bearing(sun, *SUN))
        got = solve_axes(PANORAMA, noisy, camera_height=1.5)
        assert not got.warnings
        error = got.world_from_camera.rotation @ pose.rotation.T
        squares.append((tilt(got, pose) ** 2, ((error[0, 2] - error[2, 0]) / 2) ** 2))
    tilts, yaws = np.mean(squares, axis=0)
    assert 0.4 < tilts / predicted.sigma_tilt**2 < 1.9
    assert 0.4 < yaws / predicted.sigma_yaw**2 < 1.9


def test_a_contradiction_is_named_and_left_out() -> None:
    pose = looking(0.1, 0.15, -0.1)
    observed: list[Observation] = [
        *edges(PANORAMA, pose, (-1.2, -3), (2.4, 1), (-2, 2), (1, -2)),
        Bearing(far(PANORAMA, pose, *SUN), *SUN),
    ]
    third = observed[2]
    assert isinstance(third, Vertical)
    bad = third.points + [[0, 0], [60, 0]]
    observed[2] = Vertical(bad)
    found = solve_axes(PANORAMA, observed, camera_height=1.5)
    assert [t.name for t in found.terms if not t.used] == ["vertical 3"]
    assert "vertical 3 contradicts the others by" in found.warnings[0]
    assert tilt(found, pose) < 1e-6
    # two that cannot be told apart are both named, and both kept
    few = [*edges(PANORAMA, pose, (-1.2, -3)), Vertical(bad), observed[4]]
    found = solve_axes(PANORAMA, few, camera_height=1.5)
    assert all(t.used for t in found.terms)
    assert " or " in found.warnings[0]


def test_open_axes_are_refused_by_name() -> None:
    pose = looking(0.1, 0.15, -0.1)
    both = edges(PANORAMA, pose, (-1.2, -3), (2.4, 1))
    with pytest.raises(UserError, match="heading about the vertical is fixed by nothing"):
        solve_axes(PANORAMA, both)
    north = Bearing(far(PANORAMA, pose, 0.2, -0.1), 0.2)
    with pytest.raises(UserError, match="tilt is fixed"):
        solve_axes(PANORAMA, [north, both[0]])
    with pytest.raises(UserError, match="tilt is fixed"):
        solve_axes(PANORAMA, [Bearing(far(PANORAMA, pose, *SUN), *SUN)])
    close = [Horizon(far(PANORAMA, pose, a, 0.0)) for a in (0.1, 0.101)]
    with pytest.raises(UserError, match="tilt is fixed to"):
        solve_axes(PANORAMA, [north, *close])


@pytest.mark.parametrize(
    ("observed", "message"),
    [
        ([Vertical(np.array([[5.0, 5], [5, 5]]))], "its two points are one"),
        ([Horizon(np.array([5000.0, 5]))], "outside what the lens sees"),
        ([Bearing(np.array([5.0, 500]), 0.3, -0.1)], "below the horizon"),
        ([Vertical(np.array([[5.0, 5]]))], "needs 2 points"),
    ],
)
def test_bad_observations(observed: list[Observation], message: str) -> None:
    with pytest.raises(UserError, match=message):
        solve_axes(PANORAMA, observed)


def test_edges_clicked_downwards_are_told() -> None:
    pose = looking(0.1, 0.15, -0.1)
    good = edges(PANORAMA, pose, (-1.2, -3), (2.4, 1))
    mixed = [good[0], Vertical(good[1].points[::-1])]
    with pytest.raises(UserError, match="vertical 2: its first point is the upper one"):
        solve_axes(PANORAMA, [*mixed, Bearing(far(PANORAMA, pose, *SUN), *SUN)])
    with pytest.raises(UserError, match="pairs"):
        pairs([[1, 2], [3, 4], [5, 6]])


# ---- the sun


def test_the_sun_of_the_published_example() -> None:
    """Reda and Andreas 2004, appendix A.5: 17 October 2003, Golden, Colorado."""
    when = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_position(when, 39.742476, -105.1786)
    assert math.degrees(sun.azimuth) == pytest.approx(194.34024, abs=0.01)
    assert 90 - math.degrees(sun.elevation) == pytest.approx(50.11162, abs=0.01)


@pytest.mark.parametrize(
    ("when", "longitude", "latitude"),
    [("2025-03-20T09:01+00:00", 0.0, 0.0), ("2025-09-22T18:19+00:00", 0.0, 0.0)],
)
def test_the_sun_at_the_equinoxes_stands_over_the_equator(
    when: str, longitude: float, latitude: float
) -> None:
    """Published instants of the equinoxes: declination 0, so that noon is overhead."""
    moment = parse_time(when)
    # from east and west alike, the sun's path crosses the zenith: its azimuth is 90 or 270
    sun = sun_position(moment, latitude, longitude)
    assert abs(math.cos(sun.azimuth) * math.cos(sun.elevation)) < math.radians(0.02)


def test_the_sun_beside_pysolar() -> None:
    pysolar = pytest.importorskip("pysolar.solar", reason="pysolar is not installed")
    rng = np.random.default_rng(5)
    for _ in range(100):
        when = datetime(2015, 1, 1, tzinfo=UTC) + timedelta(days=float(rng.uniform(0, 4000)))
        place = float(rng.uniform(-66, 66)), float(rng.uniform(-180, 180))
        sun = sun_position(when, *place)
        if sun.elevation < 0.1:
            continue
        azimuth = math.radians(pysolar.get_azimuth(*place, when)) - sun.azimuth
        off = (azimuth + math.pi) % (2 * math.pi) - math.pi
        assert abs(off) * math.cos(sun.elevation) < math.radians(0.03)


def test_times_and_places() -> None:
    with pytest.raises(UserError, match="zone"):
        parse_time("2026-06-21T14:30")
    with pytest.raises(UserError, match="write it as"):
        parse_time("yesterday")
    with pytest.raises(UserError, match="latitude"):
        sun_position(parse_time("2026-06-21T14:30+02:00"), 95.0, 0.0)
    with pytest.raises(UserError, match="zone"):
        sun_position(datetime(2026, 6, 21), 45.0, 0.0)


# ---- the command and the scene


def test_the_command_and_its_overlay(tmp_path: Path) -> None:
    from chromeball.scene.image import write_picture

    pose = looking(0.3, 0.15, -0.1)
    when, place = "2026-06-21T09:30+02:00", (47.4, 8.5)
    stands = sun_position(parse_time(when), *place)
    # the sun must lie in the picture: any panorama shows it
    sun = far(PANORAMA, pose, stands.azimuth, stands.elevation)
    uprights = np.concatenate([e.points for e in edges(PANORAMA, pose, (-1.2, -3), (2.4, 1))])
    picture = tmp_path / "front.png"
    write_picture(picture, np.full((1024, 2048, 3), 90, np.uint8))

    def text(points: np.ndarray) -> str:
        return " ".join(f"{x:.9g},{y:.9g}" for x, y in np.atleast_2d(points))

    output = tmp_path / "align.json"
    arguments = [
        *("align", "--picture", str(picture), "--lens", "latlong"),
        *("--verticals", text(uprights), "--sun", text(sun), "--time", when),
        *("--latitude", "47.4", "--longitude", "8.5", "--camera-height", "1.5"),
        *("-o", str(output)),
    ]
    app(arguments, result_action="return_value", exit_on_error=False)
    value = json.loads(output.read_text())
    np.testing.assert_allclose(value["world_from_camera"], pose.matrix(), atol=1e-5)
    assert value["corners"] is None
    assert [u["name"] for u in value["used"]] == ["vertical 1", "vertical 2", "sun"]
    from chromeball.scene.image import read_image

    drawn = read_image(tmp_path / "align.overlay.png").pixels.astype(int)
    x, y = np.round(sun).astype(int)
    assert (drawn[y - 20 : y + 20, x - 20 : x + 20].min(axis=2) > 200).any()  # a white ring
    x, y = np.round(uprights[:2].mean(axis=0)).astype(int)
    near = drawn[y - 3 : y + 4, x - 3 : x + 4]
    assert ((near[..., 1] > 180) & (near[..., 0] < 120)).any()  # a true vertical


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--verticals", "1,2 3,4 5,6"], "two by two"),
        (["--sun", "100,100"], "given together"),
        (["--north", "1,2", "--any-plane"], "--any-plane is for a rectangle alone"),
        (["--horizon", "1,2", "--bearing", "4"], "--bearing is for --north"),
        (["--horizon", "10,500 900,500"], "points, sun or north"),
    ],
)
def test_the_command_refuses(more: list[str], message: str, tmp_path: Path) -> None:
    base = ["align", "--size", "2048x1024", "--lens", "latlong", "-o", str(tmp_path / "a.json")]
    with pytest.raises(UserError, match=message):
        app([*base, *more], result_action="return_value", exit_on_error=False)


SCENE = """
name = "s"
env.file = "pano.exr"
[align]
picture = "env"
camera_height = 1.6
verticals = [[[100, 600], [101, 400]], [[900, 600], [905, 380]]]
sun = [700, 200]
time = "2026-06-21T14:30+02:00"
latitude = 47.4
longitude = 8.5
"""


def test_the_scene_file() -> None:
    from chromeball.cli.stages import stages

    scene = parse_scene(SCENE)
    assert scene.align is not None
    plan = {stage.name: stage for stage in stages(scene, Path("scene.toml"))}
    assert "2 verticals, the sun of env" in plan["envmap align"].reason
    with pytest.raises(UserError, match="given together"):
        parse_scene(SCENE.replace("latitude = 47.4\n", ""))
    with pytest.raises(UserError, match="gives the heading"):
        parse_scene(SCENE[: SCENE.index("sun =")])
