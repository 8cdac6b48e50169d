"""Every map: round trip, solid angles, handedness, the kernel against numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from chromeball.envmap.mapping import (
    MAPPINGS,
    SIX,
    Cube,
    Lens,
    Mapping,
    Radial,
    ball_distance,
    make_mapping,
    mirror_ball,
    of_camera,
    parse_lens,
    pixel_grid,
    sized,
)
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError

OPENCV8 = [200.0, 202, 160, 118, -0.2, 0.05, 0.001, -0.001, 0, 0, 0, 0]


def maps() -> dict[str, Mapping]:
    found = {name: make_mapping(name, sized(name, 96)) for name in MAPPINGS}
    found["cube-column"] = make_mapping("cube-column", (16, 96))
    found["ball at 3 radii"] = mirror_ball((96, 96), 3.0)
    found["ball at 40 radii"] = mirror_ball((96, 96), 40.0)
    size = (120, 100)
    for model, fov in (("equisolid", 190), ("equidistant", 360), ("stereographic", 200)):
        lens = CameraModel.fisheye(
            model, size, math.radians(fov), centre=(58.3, 49.0), radius=48.0
        )
        found[model] = of_camera(lens)
    found["orthographic"] = of_camera(CameraModel.fisheye("orthographic", (100, 100), 3.1))
    kb4 = np.array([40.0, 42, 60, 48, -0.02, 0.003, 0, 0])
    found["kb4"] = of_camera(CameraModel("kb4", kb4, size, max_angle=1.1))
    found["pinhole"] = of_camera(CameraModel.pinhole((160, 120), 1.2))
    found["opencv8"] = of_camera(
        CameraModel("LENSMODEL_OPENCV8", np.array(OPENCV8), (320, 240))
    )
    return found


MAPS = maps()
#: Total solid angle of the maps that have a closed one.
TOTALS = {
    **{name: entry.total for name, entry in MAPPINGS.items()},
    "ball at 3 radii": 2 * math.pi * (1 + math.sqrt(1 - 1 / 9)),
    "ball at 40 radii": 2 * math.pi * (1 + math.sqrt(1 - 1 / 1600)),
    "equidistant": 4 * math.pi,
    "equisolid": 2 * math.pi * (1 - math.cos(math.radians(95))),
    "stereographic": 2 * math.pi * (1 - math.cos(math.radians(100))),
    "orthographic": 2 * math.pi * (1 - math.cos(1.55)),
    "pinhole": 4
    * math.asin(
        math.tan(0.6)
        * math.tan(0.6)
        * 0.75
        / math.sqrt((1 + math.tan(0.6) ** 2) * (1 + (0.75 * math.tan(0.6)) ** 2))
    ),
}


def sphere(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("name", MAPS)
def test_round_trip(name: str) -> None:
    mapping, d = MAPS[name], sphere(4000)
    pixels = mapping.project(d)
    seen = np.isfinite(pixels).all(axis=1)
    assert seen.mean() > 0.02
    np.testing.assert_allclose(mapping.unproject(pixels[seen]), d[seen], atol=1e-9)
    if TOTALS.get(name) == 4 * math.pi:
        assert seen.all()


@pytest.mark.parametrize("name", TOTALS)
def test_solid_angles_sum_to_the_total(name: str) -> None:
    assert MAPS[name].solid_angles().sum() == pytest.approx(TOTALS[name], rel=1e-6)


MANY = sphere(150_000, seed=3)


@pytest.mark.parametrize("name", MAPS)
def test_solid_angle_of_a_pixel_by_sampling(name: str) -> None:
    """Two routes: the exact sum against counting uniform directions."""
    mapping = MAPS[name]
    d = MANY
    pixels = mapping.project(d)
    width, height = mapping.size
    with np.errstate(invalid="ignore"):
        inside = np.isfinite(pixels).all(axis=1) & (pixels > -0.5).all(axis=1)
        inside &= (pixels[:, 0] < width - 0.5) & (pixels[:, 1] < height - 0.5)
    where = np.floor((pixels[inside] + 0.5) / np.array([width / 4, height / 4])).astype(int)
    counts = np.zeros((4, 4))
    np.add.at(counts, (where[:, 1], where[:, 0]), 1)
    rows = (np.arange(height) * 4) // height
    columns = (np.arange(width) * 4) // width
    if width % 4 or height % 4:
        pytest.skip("blocks do not fit the pixels")
    blocks = np.zeros((4, 4))
    np.add.at(blocks, (rows[:, None], columns[None, :]), mapping.solid_angles())
    expected = blocks / (4 * math.pi) * len(d)
    # five standard deviations of a count, sixteen blocks, eleven maps
    assert (np.abs(counts - expected) <= 5 * np.sqrt(expected + 1)).all()


def test_large_disc_takes_the_fast_route_to_the_same_solid_angles() -> None:
    large = make_mapping("angular", (1024, 1024))
    assert isinstance(large, Radial)
    total = large.solid_angles()
    assert total.sum() == pytest.approx(4 * math.pi, rel=1e-7)
    small = make_mapping("angular", (256, 256)).solid_angles()
    blocks = total.reshape(256, 4, 256, 4).sum(axis=(1, 3))
    np.testing.assert_allclose(blocks, small, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("name", ["angular", "mirror", "paraboloid", "ball at 3 radii"])
def test_smooth_discs_take_the_fast_route_to_the_same_solid_angles(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapping = mirror_ball((161, 161), 3.0) if name not in MAPPINGS else MAPS[name]
    monkeypatch.setattr("chromeball.envmap.mapping.radial._MANY", 0)
    fast = mapping.solid_angles()
    monkeypatch.setattr("chromeball.envmap.mapping.radial._MANY", 1 << 30)
    slow = mapping.solid_angles()
    assert (fast != slow).any()
    np.testing.assert_allclose(fast, slow, rtol=2e-6)


def test_fine_octahedral_takes_the_fast_route_to_the_same_solid_angles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapping = make_mapping("octahedral", (400, 400))
    fast = mapping.solid_angles()
    monkeypatch.setattr("chromeball.envmap.mapping.octahedral._COARSE", 1000)
    slow = mapping.solid_angles()
    assert (fast != slow).any()
    np.testing.assert_allclose(fast, slow, rtol=1e-7)
    assert fast.sum() == pytest.approx(4 * math.pi, rel=1e-9)


@pytest.mark.parametrize("name", [n for n, m in MAPS.items() if not isinstance(m, Lens)])
def test_solid_angles_of_the_kernel_are_the_same(name: str) -> None:
    mapping = MAPS[name]
    np.testing.assert_array_equal(
        mapping.solid.rows(0, mapping.size[1]), mapping.solid_angles().astype(np.float32)
    )
    assert mapping.solid.total() == pytest.approx(mapping.solid_angles().sum(), rel=1e-6)


@pytest.mark.parametrize("name", MAPS)
def test_kernel_agrees_with_numpy(name: str) -> None:
    mapping, d = MAPS[name], sphere(5000, seed=1)
    slow, fast = mapping.project(d), mapping.kernel.project(d)
    both = np.isfinite(slow).all(axis=1) & np.isfinite(fast).all(axis=1)
    assert both.sum() >= 0.98 * np.isfinite(fast).all(axis=1).sum()
    np.testing.assert_allclose(fast[both], slow[both], atol=1e-3)
    pixels = pixel_grid(mapping.size, 0.17).reshape(-1, 2)
    pixels = pixels[(pixels < np.array(mapping.size) - 0.5).all(axis=1)]
    there, back = mapping.unproject(pixels), mapping.kernel.unproject(pixels)[:, :3]
    both = np.isfinite(there).all(axis=1) & np.isfinite(back).all(axis=1)
    assert both.mean() > 0.3
    # at the very rim of a mirror ball a float's pixel is 1e-4 rad
    assert np.abs(there[both] - back[both]).max() < 3e-4
    assert np.median(np.abs(there[both] - back[both])) < 5e-6


CENTRED = [name for name in MAPPINGS if name not in ("mirror", "cube-strip", "cube-column")]


@pytest.mark.parametrize("name", [*CENTRED, "equisolid"])
def test_orientation(name: str) -> None:
    """Centre +Z, image right -X, up +Y."""
    mapping = MAPS[name]
    centre, right, up = mapping.pixels_of([[0, 0, 1], [-0.1, 0, 1], [0, 0.1, 1]])
    assert right[0] > centre[0] + 0.5
    assert right[1] == pytest.approx(centre[1], abs=1e-9)
    assert up[1] < centre[1] - 0.5


def test_mirror_ball_is_a_photograph_of_a_reflection() -> None:
    """Against the law of reflection: camera far off on +Z, looking along -Z."""
    mapping = MAPS["mirror"]
    width, height = mapping.size
    for x, y in ((70.0, 30.0), (20.0, 60.0), (48.0, 12.0)):
        # camera right is +X, up +Y; the ball's outward normal at the pixel
        nx, ny = (x - (width - 1) / 2) / (width / 2), -(y - (height - 1) / 2) / (height / 2)
        n = np.array([nx, ny, math.sqrt(1 - nx * nx - ny * ny)])
        ray = np.array([0, 0, -1.0])
        reflected = ray - 2 * (ray @ n) * n
        np.testing.assert_allclose(mapping.pixels_of(reflected), [x, y], atol=1e-9)
    # and seeds.md P14: s = x / sqrt(2 (z + 1))
    d = sphere(50, seed=2)
    s = d[:, 0] / np.sqrt(2 * (d[:, 2] + 1))
    np.testing.assert_allclose(mapping.pixels_of(d)[:, 0], s * 48 + 47.5, atol=1e-9)


@pytest.mark.parametrize("distance", [1.2, 3.0, 40.0])
def test_ball_nearby_by_tracing_rays(distance: float) -> None:
    """A pinhole camera on +Z looks at the unit ball: rays, hits and reflections in space."""
    size = 200
    mapping = mirror_ball((size, size), distance)
    focal = size / 2 / math.tan(math.asin(1 / distance))
    assert ball_distance(focal, size / 2) == pytest.approx(distance, rel=1e-12)
    rng = np.random.default_rng(3)
    r, phi = 0.999 * np.sqrt(rng.random(200)), 2 * math.pi * rng.random(200)
    x, y = r * np.cos(phi), r * np.sin(phi)
    pixels = np.stack([x, y], axis=-1) * size / 2 + (size - 1) / 2
    # camera right is +X, up +Y (picture y is down)
    ray = np.stack([x * size / 2 / focal, -y * size / 2 / focal, -np.ones(200)], axis=-1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    eye = np.array([0, 0, distance])
    b = ray @ eye
    hit = eye + (-b - np.sqrt(b * b - distance**2 + 1))[:, None] * ray
    reflected = ray - 2 * np.sum(ray * hit, axis=1, keepdims=True) * hit
    np.testing.assert_allclose(mapping.pixels_of(reflected), pixels, atol=1e-7)
    back = mapping.unproject(pixels) @ mapping.rotation.T
    np.testing.assert_allclose(back, reflected, atol=1e-9)
    hidden = math.asin(1 / distance)
    edge = [[math.sin(hidden + t), 0, -math.cos(hidden + t)] for t in (-1e-4, 1e-4)]
    assert np.isnan(mapping.pixels_of(edge[0])).all()
    assert np.isfinite(mapping.pixels_of(edge[1])).all()


def test_ball_far_away_is_the_ideal_one() -> None:
    d = sphere(500, seed=6)
    d = d[d[:, 2] > -0.99]
    far = mirror_ball((96, 96), 1e7).pixels_of(d)
    np.testing.assert_allclose(far, MAPS["mirror"].pixels_of(d), atol=1e-4)
    assert mirror_ball((96, 96), math.inf).rim == 1


@pytest.mark.parametrize("distance", [1.0, 0.3, -2.0, math.nan])
def test_camera_inside_the_ball(distance: float) -> None:
    with pytest.raises(UserError, match="outside"):
        mirror_ball((96, 96), distance)


def test_octahedral_jacobian_and_corners() -> None:
    """seeds' 4 / |p|^3 per du dv in small pixels; the four corners are one point, -Z."""
    mapping = make_mapping("octahedral", (512, 512))
    uv = 2 * (pixel_grid((512, 512)) + 0.5) / 512 - 1
    p = np.abs(mapping.unproject(pixel_grid((512, 512))))
    p /= p.sum(axis=-1, keepdims=True)
    expected = 4 / np.linalg.norm(p, axis=-1) ** 3 / 512**2
    smooth = np.abs(np.abs(uv).sum(axis=-1) - 1) > 3 / 512  # not where it is folded
    solid = mapping.solid_angles()
    np.testing.assert_allclose(solid[smooth], expected[smooth], rtol=3e-5)
    np.testing.assert_allclose(solid[~smooth], expected[~smooth], rtol=5e-3)
    corners = mapping.unproject([[-0.5, -0.5], [511.5, -0.5], [-0.5, 511.5], [511.5, 511.5]])
    np.testing.assert_allclose(corners, [[0, 0, -1]] * 4, atol=1e-12)


@pytest.mark.parametrize("name", ["cube-vertical", "cube-strip", "cube-column"])
def test_cube_layouts_hold_the_same_faces(name: str) -> None:
    """Pixel for pixel the cross's, moved and (the vertical cross's back) turned by 180."""
    cross, other = MAPS["cube"], make_mapping(name, sized(name, MAPPINGS[name].step * 24))
    assert isinstance(other, Cube)
    assert other.face == 24
    d = sphere(2000, seed=9)
    a, b = (np.round(m.project(d)).astype(int) for m in (cross, other))
    assert len({(x // 24, y // 24) for x, y in b}) == 6
    for x, y in ((0, 0), (23, 5)):  # a corner of each face
        for face in other.layout:
            q = np.array([face.column * 24 + x, face.row * 24 + y])
            there = cross.project(other.unproject(q))
            np.testing.assert_allclose(there, np.round(there), atol=1e-9)
    assert len(np.unique(a, axis=0)) == len(np.unique(b, axis=0))


def test_strip_is_in_the_order_of_opengl() -> None:
    """OpenGL 4.6, table 8.19: s to the right, t down; its cube's x is image right."""
    mapping, n = make_mapping("cube-strip", (96, 16)), 16
    assert SIX == ("px", "nx", "py", "ny", "pz", "nz")
    for d in sphere(200, seed=10):
        # our world's +X is the cube's -X: seen from inside, unmirrored, as three.js turns it
        r = np.array([-d[0], d[1], d[2]])
        axis = int(np.abs(r).argmax())
        face = 2 * axis + (r[axis] < 0)
        s, t = {
            0: (-r[2], -r[1]),
            1: (r[2], -r[1]),
            2: (r[0], r[2]),
            3: (r[0], -r[2]),
            4: (r[0], -r[1]),
            5: (-r[0], -r[1]),
        }[face]
        a, b = (s / abs(r[axis]) + 1) / 2, (t / abs(r[axis]) + 1) / 2
        np.testing.assert_allclose(
            mapping.pixels_of(d), [face * n + a * n - 0.5, b * n - 0.5], atol=1e-9
        )


def test_names_of_the_command_line_are_the_table() -> None:
    from typing import get_args

    from chromeball.envmap.names import Name

    assert set(get_args(Name.__value__)) == set(MAPPINGS)


def test_angular_map_formula() -> None:
    d = sphere(50, seed=4)
    r = np.arccos(d[:, 2]) / (math.pi * np.hypot(d[:, 0], d[:, 1]))
    np.testing.assert_allclose(
        MAPS["angular"].pixels_of(d)[:, 0], -d[:, 0] * r * 48 + 47.5, atol=1e-6
    )


def test_lens_spec() -> None:
    lens = parse_lens("equisolid:186:10,12,9", (30, 20))
    assert lens.max_angle == pytest.approx(math.radians(93))
    np.testing.assert_allclose(lens.intrinsics[1:], [10, 12])
    rim = lens.project([[math.sin(math.radians(93)), 0, math.cos(math.radians(93))]])
    np.testing.assert_allclose(rim, [[19, 12]])
    only_radius = parse_lens("equidistant:180:,,8", (30, 20))
    np.testing.assert_allclose(only_radius.intrinsics[1:], [14.5, 9.5])


@pytest.mark.parametrize(
    "spec", ["equisolid", "equisolid:x", "equisolid:0", "equisolid:186:1,2", "nope:180"]
)
def test_bad_lens_spec(spec: str) -> None:
    with pytest.raises(UserError, match=r"--lens|unknown fisheye"):
        parse_lens(spec, (10, 10))


@pytest.mark.parametrize(
    ("name", "size"),
    [("latlong", (100, 100)), ("mirror", (10, 9)), ("cube", (12, 8)), ("octahedral", (5, 5))],
)
def test_wrong_shape(name: str, size: tuple[int, int]) -> None:
    with pytest.raises(UserError, match="must be"):
        make_mapping(name, size)
