"""Fall-off from boards and flat fields: truth, honest errors, what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.calibrate.target import Charuco, Chessboard, Target, parse_target
from chromeball.calibrate.vignette import solve
from chromeball.calibrate.vignette_board import board_samples
from chromeball.calibrate.vignette_data import Picture, Samples, apertures_agree
from chromeball.calibrate.vignette_field import check_gradient, flat_samples
from chromeball.calibrate.virtual import board_poses, project
from chromeball.cli.main import build_app
from chromeball.cli.stages import stages
from chromeball.renderer.composite import Composite
from chromeball.renderer.look import CameraLook, apply_look, fall_off
from chromeball.scene.camera import CameraModel
from chromeball.scene.color import srgb_decode, srgb_encode
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr, write_picture
from chromeball.scene.manifest import read_scene
from chromeball.scene.pose import Pose
from chromeball.scene.record import read_json
from chromeball.scene.vignette import Vignette, read_vignette
from tests.cli.scenes import FULL, PHOTOS

type Float = NDArray[np.float64]

SIZE = (420, 300)
CAMERA = CameraModel(
    "LENSMODEL_OPENCV4",
    np.array([330.0, 332, 208, 152, -0.2, 0.06, 0.0005, -0.0006]),
    SIZE,
)
RAYS = CAMERA.unproject(CAMERA.pixel_grid())
BOARD = Chessboard(9, 6, 0.03)
TRUTH = Vignette.of([-0.35, 0.05], SIZE, (214.0, 146.0))


def run(*words: object) -> None:
    build_app()(
        ["calibrate", "vignette", *(str(word) for word in words)], result_action="return_value"
    )


def errors_at(found: Vignette, q: Float, truth: Vignette = TRUTH) -> Float:
    """Relative, against the found centre."""
    c = np.array(found.centre)
    return found.at(q) / truth.at(q) / found.at(c) * truth.at(c) - 1


def poses(target: Target, count: int, seed: int) -> list[Pose]:
    return board_poses(target, CAMERA, count, seed=seed, size=0.75)


def on_board(pose: Pose) -> Float:
    """Where each pixel's ray meets the board's plane, (H, W, 2) metres."""
    d = pose.inverse().rotate(RAYS)
    o = pose.inverse().translation
    return o[:2] - (o[2] / d[..., 2])[..., None] * d[..., :2]


def sheet(target: Target, pose: Pose) -> Float:
    """Reflectance that the lens shows, blurred, (H, W)."""
    n = target.cells_per_square
    board = np.pad(target.cells(), n, constant_values=255)
    cell = np.floor((on_board(pose) / target.square + 2) * n)
    hit = ((cell >= 0) & (cell < board.shape[::-1])).all(axis=-1)
    column, row = (np.where(hit, cell[..., i], 0).astype(int) for i in range(2))
    shade = np.where(hit, 0.08 + 0.72 * (board[row, column] / 255), 0.3)
    return np.asarray(cv2.GaussianBlur(shade, (0, 0), 0.9), float)


def light(target: Target, pose: Pose, rng: np.random.Generator, uneven: float) -> Float:
    """Smooth light on a board, (H, W)."""
    place = on_board(pose)
    middle = target.points().reshape(-1, 3).mean(axis=0)[:2]
    u, v = np.moveaxis((place - middle) / (4 * target.square), -1, 0)
    a, b = rng.normal(0, uneven, 2), rng.normal(0, uneven / 3, 3)
    bent = a[0] * u + a[1] * v + b[0] * u * u + b[1] * v * v + b[2] * u * v
    return rng.uniform(0.6, 1) * np.exp(np.clip(bent, -0.5, 0.2))


def views(
    target: Target, count: int, seed: int, uneven: float, truth: Vignette = TRUTH
) -> list[NDArray[np.uint8]]:
    """Codes of boards under uneven light through a lens with a fall-off."""
    rng = np.random.default_rng(seed)
    pictures: list[NDArray[np.uint8]] = []
    for pose in poses(target, count, seed):
        linear = sheet(target, pose) * light(target, pose, rng, uneven) * truth.picture()
        noisy = 255 * srgb_encode(linear) + rng.normal(0, 1, linear.shape)
        pictures.append(np.clip(np.round(noisy), 0, 255).astype(np.uint8))
    return pictures


def measured(
    codes: list[NDArray[np.uint8]], target: Target, seed: int, start: int = 0
) -> Samples:
    """White of pictures number `start` and on of a session of `seed`."""
    corners = list(project(target, CAMERA, poses(target, start + len(codes), seed)[start:]))
    pictures = [
        Picture(str(k), srgb_decode(c / 255).astype(np.float32), c >= 250)
        for k, c in enumerate(codes)
    ]
    return board_samples(pictures, corners, target, [0.9] * len(codes)).samples


@pytest.mark.parametrize(
    ("target", "count"),
    [(BOARD, 16), (Charuco(9, 6, 0.04, 0.02, "4X4_50"), 20)],
    ids=["chessboard", "charuco"],
)
def test_rendered_boards(target: Target, count: int) -> None:
    """Response, noise and uneven light: half a per cent of truth where boards were."""
    samples = measured(views(target, count, 1, 0.01), target, 1)
    found = solve(samples, SIZE, source="board", centre=(208.0, 152.0))
    off = errors_at(found.vignette, samples.pixels)
    assert float(np.sqrt((off**2).mean())) < 0.005
    assert float(np.abs(off).max()) < 0.015
    assert found.scatter[1] < 0.9 * found.scatter[0]
    assert found.vignette.map is None


def test_held_out_views_are_flatter() -> None:
    codes = views(BOARD, 24, 5, 0.02)
    found = solve(measured(codes[:16], BOARD, 5), SIZE, source="board").vignette
    held = measured(codes[16:], BOARD, 5, 16)

    def spread(log: Float) -> float:
        return float(np.mean([log[held.group == g].std() for g in range(held.group.max() + 1)]))

    assert spread(held.log - np.log(found.at(held.pixels))) < 0.6 * spread(held.log)


def drawn(seed: int, count: int, uneven: float, noise: float = 0.004) -> Samples:
    """As boards would give, without their pictures."""
    rng = np.random.default_rng(seed)
    corners = project(BOARD, CAMERA, poses(BOARD, count, seed))
    middle = (corners[:, :-1, :-1] + corners[:, 1:, 1:]) / 2
    j, i = np.indices(middle.shape[1:3])
    white = (i + j) % 2 == 0
    pixels = middle[:, white]
    u, v = (i[white] - 3.5) / 4, (j[white] - 2) / 2.5
    shapes = np.stack([u, v, u * u, v * v, u * v], axis=1)
    lights = rng.normal(0, 1, (count, 5)) * (uneven * np.array([1, 1, 0.3, 0.3, 0.3]))
    log = np.log(TRUTH.at(pixels)) + lights @ shapes.T + rng.normal(0, 1, (count, 1))
    log = log + rng.normal(0, noise, log.shape)
    group = np.repeat(np.arange(count), pixels.shape[1])
    return Samples(
        pixels.reshape(-1, 2), log.ravel(), np.full(log.size, 0.01), group, group,
        np.tile(shapes, (count, 1)), (0, 0, 1, 1, 1), np.zeros((log.size, 0)),
    )  # fmt: skip


@pytest.mark.parametrize("uneven", [0.0, 0.03])
def test_standard_errors_are_honest(uneven: float) -> None:
    """Predicted over measured, 24 sessions of 16 views; its own error is about 0.1."""
    q = np.stack(np.meshgrid(np.linspace(60, 360, 7), np.linspace(50, 250, 5)), axis=-1)
    z: list[Float] = []
    for seed in range(24):
        found = solve(drawn(seed, 16, uneven), SIZE, source="board").vignette
        sigma = found.sigma_at(q)
        far = sigma > 0.2 * sigma.max()
        z.append((errors_at(found, q)[far] / sigma[far]).ravel())
    ratio = 1 / float(np.sqrt(np.mean([np.mean(one**2) for one in z])))
    assert 0.8 < ratio < 1.25


def test_outliers_are_left_out() -> None:
    samples = drawn(3, 16, 0.01)
    log = samples.log.copy()
    bad = np.random.default_rng(0).random(len(log)) < 0.1
    log[bad] += 0.3
    found = solve(
        Samples(
            samples.pixels, log, samples.sigma, samples.group, samples.cluster,
            samples.light, samples.kinds, samples.shared,
        ),
        SIZE, source="board",
    )  # fmt: skip
    assert np.isnan(found.residuals[bad]).mean() > 0.95
    assert float(np.abs(errors_at(found.vignette, samples.pixels)).max()) < 0.02


def test_a_map_where_the_residuals_ask_for_it() -> None:
    samples = drawn(4, 40, 0.0, noise=0.001)
    bump = 0.03 * np.exp(-(((samples.pixels - [330, 90]) / 60) ** 2).sum(axis=1))
    bent = Samples(
        samples.pixels, samples.log + bump, samples.sigma, samples.group, samples.cluster,
        samples.light, samples.kinds, samples.shared,
    )  # fmt: skip
    with_map, without = (
        solve(bent, SIZE, source="board", with_map=wish) for wish in (None, False)
    )
    assert with_map.vignette.map is not None
    assert with_map.scatter[1] < 0.7 * without.scatter[1]


def test_refusals() -> None:
    samples = drawn(0, 16, 0.0)
    near = np.linalg.norm(samples.pixels - [210, 150], axis=1) < 110
    with pytest.raises(UserError, match="only the middle was seen"):
        solve(samples.of(near), SIZE, source="board")
    with pytest.raises(UserError, match="needs 30"):
        solve(samples.of(samples.group < 1), SIZE, source="board")
    with pytest.raises(UserError, match="leave the fall-off open"):
        solve(drawn(0, 4, 0.4, noise=0.03), SIZE, source="board")
    bright = [np.where(c > 120, 255, c).astype(np.uint8) for c in views(BOARD, 4, 1, 0.0)]
    with pytest.raises(UserError, match=r"white is saturated in \d+ of"):
        measured(bright, BOARD, 1)
    for spec in ("aprilgrid:6x6:0.088:0.3", "acircles:4x11:0.02"):
        with pytest.raises(UserError, match="symmetric grid of circles"):
            board_samples([], [], parse_target(spec), [])
    assert apertures_agree([5.6, None, 5.6]) == 5.6
    with pytest.raises(UserError, match="several apertures"):
        apertures_agree([5.6, 8.0])


# ---- flat fields

W, H = 600, 400
FIELD = Vignette.of([-0.4, 0.1, -0.05], (W, H), (306.0, 194.0))


def field(
    seed: int,
    turn: float = 0.0,
    gradient: float = 0.0,
    cut: tuple[float, float, float] | None = None,
) -> Picture:
    """A flat field, not quite flat, through a lens and perhaps a hood."""
    y, x = np.mgrid[0:H, 0:W].astype(float)
    half = math.hypot(W, H) / 2
    a, b = (x - (W - 1) / 2) / half, (y - (H - 1) / 2) / half
    u, v = math.cos(turn) * a - math.sin(turn) * b, math.sin(turn) * a + math.cos(turn) * b
    value = 0.7 * FIELD.picture() * np.exp(gradient * (u + 0.4 * v + 0.3 * (u * u - v * v)))
    if cut is not None:
        value = value / (1 + np.exp((np.hypot(x - cut[0], y - cut[1]) - cut[2]) / 2))
    noise = np.random.default_rng(seed).normal(0, 0.01, value.shape)
    return Picture(f"{seed}.exr", (value * (1 + noise)).astype(np.float32), value > 1)


def off_by(found: Vignette, q: Float) -> float:
    return float(np.abs(errors_at(found, q, FIELD)).max())


def test_flat_field() -> None:
    samples = flat_samples([field(0)], None).samples
    assert check_gradient(samples, (W, H), np.array([299.5, 199.5])) < 0.05
    found = solve(samples, (W, H), source="flat").vignette
    assert off_by(found, samples.pixels) < 0.003
    np.testing.assert_allclose(found.centre, FIELD.centre, atol=1)


def test_a_gradient_needs_turned_pictures() -> None:
    one = flat_samples([field(0, gradient=0.1)], None).samples
    with pytest.raises(UserError, match="--turns 0,90,180"):
        check_gradient(one, (W, H), np.array([299.5, 199.5]))
    turns = [0.0, math.pi / 2, math.pi]
    several = flat_samples([field(k, t, 0.1) for k, t in enumerate(turns)], turns).samples
    found = solve(several, (W, H), source="flat")
    assert off_by(found.vignette, several.pixels) < 0.003
    np.testing.assert_allclose(found.shared[:3], [0.1, 0.04, 0.03], atol=0.003)


@pytest.mark.parametrize("cut", [(290.0, 208.0, 310.0), (303.0, 201.0, 180.0)])
def test_a_hard_edge_is_no_optical_fall_off(cut: tuple[float, float, float]) -> None:
    """A hood that cuts corners, and an image circle."""
    seen = flat_samples([field(0, cut=cut)], None)
    assert seen.edge is not None
    np.testing.assert_allclose([*seen.edge.centre, seen.edge.radius], cut, atol=5)
    whole = cut[2] < H / 2
    found = solve(
        seen.samples,
        (W, H),
        source="flat",
        edge=seen.edge,
        centre=cut[:2] if whole else None,
        radius=cut[2] if whole else None,
    ).vignette
    assert off_by(found, seen.samples.pixels) < 0.01
    assert flat_samples([field(0)], None).edge is None


# ---- commands


def test_board_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [tmp_path / f"{k}.png" for k in range(10)]
    for file, codes in zip(files, views(BOARD, 10, 2, 0.0), strict=True):
        write_picture(file, codes)
    lens = tmp_path / "lens.cameramodel"
    CAMERA.write(lens)
    out = tmp_path / "vignette.json"
    run("board", *files, "--target", BOARD.spec, "--camera", lens, "-o", out, "--json")
    told = capsys.readouterr()
    assert "taken to be sRGB" in told.err
    figures: dict[str, Any] = json.loads(told.out)
    found = read_vignette(out)
    assert found.source == "board"
    assert figures["coefficients"] == pytest.approx(found.coefficients.tolist())
    q = np.stack(np.meshgrid(np.linspace(80, 340, 5), np.linspace(60, 240, 5)), axis=-1)
    assert float(np.abs(errors_at(found, q)).max()) < 0.01
    assert read_image(tmp_path / figures["plot"]).size[0] > 800
    assert read_json(f"{out}.record.json")["stage"] == "calibrate vignette board"
    with pytest.raises(UserError, match="4 or more"):
        run("board", *files[:2], "--target", BOARD.spec, "-o", out)


def test_flat_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [tmp_path / f"{k}.exr" for k in range(3)]
    for k, file in enumerate(files):
        write_exr(file, np.repeat(field(k, k * math.pi / 2, 0.1).radiance[..., None], 3, 2))
    out = tmp_path / "v.json"
    run("flat", *files, "--turns", "0,90,180", "-o", out)
    assert "of the light at the darkest place" in capsys.readouterr().out
    assert off_by(read_vignette(out), np.array([[20.0, 20.0], [580.0, 380.0]])) < 0.005
    for words, message in (
        (["--turns", "0,90"], "3 angles"),
        (["--turns", "0,1,2"], "45 degrees"),
    ):
        with pytest.raises(UserError, match=message):
            run("flat", *files, *words, "-o", out)


# ---- applied


def test_merge_divides_by_it_once(tmp_path: Path) -> None:
    """Flat again, standard errors with it; told in the file, and not done twice."""
    truth = Vignette.of([-0.4, 0.1], (60, 40), (31.0, 18.0))
    (tmp_path / "v.json").write_bytes(truth.encode())
    V = truth.picture()[..., None].repeat(3, axis=2)
    files = [tmp_path / f"{k}.exr" for k in range(2)]
    for file, time in zip(files, (0.5, 1.0), strict=True):
        write_exr(file, 0.6 * V * np.float32(time))
    common = ("merge", *files, "--times", "0.5,1", "--white", "1", "--sigma")
    app = build_app()
    for extra, name in (((), "plain"), (("--vignetting", tmp_path / "v.json"), "even")):
        words = [
            "hdr",
            *common,
            *extra,
            "--noise",
            "1e-4",
            "1e-6",
            "-o",
            tmp_path / f"{name}.exr",
        ]
        app([str(w) for w in words], result_action="return_value")
    plain, even = (read_image(tmp_path / f"{n}.exr") for n in ("plain", "even"))
    np.testing.assert_allclose(even.pixels[..., :3], 0.6, rtol=1e-5)
    np.testing.assert_allclose(even.pixels[..., 3:6], plain.pixels[..., 3:6] / V, rtol=1e-5)
    assert "v.json" in even.attributes["vignettingRemoved"]
    lens = ("--lens", "equisolid:180", "--from", "fisheye", "--to", "latlong")
    words = [
        "envmap",
        "warp",
        tmp_path / "even.exr",
        *lens,
        "--vignetting",
        tmp_path / "v.json",
    ]
    with pytest.raises(UserError, match="divided out already"):
        app([str(w) for w in [*words, "-o", tmp_path / "x.exr"]], result_action="return_value")
    write_exr(tmp_path / "small.exr", 0.6 * V[:20])
    small = ["hdr", "merge", tmp_path / "small.exr", "--times", "1", "--vignetting"]
    small += [tmp_path / "v.json", "-o", tmp_path / "y.exr"]
    with pytest.raises(UserError, match="a crop needs"):
        app([str(w) for w in small], result_action="return_value")


def test_maps_divide_by_it(tmp_path: Path) -> None:
    """A file and the coefficients it holds give one map, by warp and by probe."""
    size = (64, 64)
    rim = Vignette.of([-0.4, 0.1], size, (31.5, 31.5), 32.0)
    (tmp_path / "v.json").write_bytes(rim.encode())
    r2 = ((CameraModel.pinhole(size, 1.0).pixel_grid() - 31.5) ** 2).sum(axis=2) / 32**2
    dim = np.maximum(1 - 0.4 * r2 + 0.1 * r2**2, 0.1)
    write_exr(tmp_path / "dim.exr", dim[..., None].repeat(3, 2).astype(np.float32))
    app = build_app()
    for command in (["warp", "--from", "fisheye", "--to", "latlong"], ["probe"]):
        maps: list[Any] = []
        for how in ("--vignetting=-0.4,0.1", f"--vignetting={tmp_path / 'v.json'}"):
            words = ["envmap", command[0], tmp_path / "dim.exr", *command[1:], how]
            words += ["--lens", "equisolid:180", "--width", "64", "-o", tmp_path / "m.exr"]
            app([str(w) for w in words], result_action="return_value")
            maps.append(read_image(tmp_path / "m.exr").pixels)
        seen = maps[0][..., 3] == 1
        np.testing.assert_allclose(maps[1][seen], maps[0][seen], rtol=2e-3)
        np.testing.assert_allclose(maps[1][seen][:, :3], 1, atol=5e-3)


def test_the_renderer_gives_it_back() -> None:
    """On what is synthetic; on all where it was divided out of the plate."""
    truth = Vignette.of([-0.3, 0.1], (80, 60), (37.0, 31.0))
    V = fall_off(truth, CameraModel.pinhole((80, 60), 1.0))
    np.testing.assert_array_equal(V, truth.picture())
    plate = np.full((60, 80, 3), 0.5, np.float32)
    ones, flat = np.ones_like(plate), np.zeros((60, 80), np.float32)
    made = Composite(
        plate + 1, flat, ones, ones, flat, flat, np.ones((60, 80), bool), 0, ones, ones
    )
    for flattened, expected in ((False, 0.5 + V), (True, 1.5 * V)):
        seen, _ = apply_look(made, plate, CameraLook(falloff=V, flattened=flattened))
        np.testing.assert_allclose(seen.rgb[..., 0], expected, rtol=1e-6)


def test_scene_keys(tmp_path: Path) -> None:
    """A file of bracket, probe or look is an option and an input of its stage."""
    text = FULL.replace('name = "plate"\n', 'name = "plate"\nvignetting = "tele.json"\n')
    text = text.replace("shot = [", 'vignetting = "fish.json"\nshot = [')
    text = text.replace(
        'bracket = "plate"\npoints',
        'bracket = "plate"\nlook = { vignetting = "tele.json" }\npoints',
    )
    (tmp_path / "photos").mkdir()
    for name in PHOTOS:
        write_picture(tmp_path / "photos" / name, np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "scene.toml").write_text(text)
    plan = stages(read_scene(tmp_path / "scene.toml"), tmp_path / "scene.toml")
    by_name = {stage.name: stage for stage in plan}
    for name, file in (
        ("hdr merge plate", "tele.json"),
        ("envmap probe", "fish.json"),
        ("render main", "tele.json"),
    ):
        assert file in by_name[name].inputs, name
    assert "tele.json" in by_name["hdr merge plate"].command
    assert "tele.json" not in by_name["hdr merge front"].command
