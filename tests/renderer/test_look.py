"""The camera's own faults on synthetic pixels, measured as equal to the plate's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage, stats

from chromeball.hdr.merge import merge_frames
from chromeball.hdr.response_file import Response, encode_response
from chromeball.renderer.composite import Composite
from chromeball.renderer.exposed import best_frame, expose
from chromeball.renderer.grain import LAGS, autocovariance, grain, measure_noise
from chromeball.renderer.look import CameraLook, apply_look, fall_off
from chromeball.renderer.sharpness import measure_softness, soften, softening
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.manifest import parse_scene
from tests.renderer.scenes import SCENE, run, write_scene

SHOT, READ = 2e-4, 1e-5


def composite(
    plate: NDArray[np.float32],
    kept: float | NDArray[np.float32],
    added: float | NDArray[np.float32],
) -> Composite:
    """What a renderer without noise would give."""
    k = np.broadcast_to(np.float32(kept), plate.shape).astype(np.float32)
    S = np.broadcast_to(np.float32(added), plate.shape).astype(np.float32)
    flat = np.zeros(plate.shape[:2], np.float32)
    changed = (k != 1).any(axis=2) | (S != 0).any(axis=2)
    return Composite(plate * k + S, flat, k, S, flat, flat, changed, 0, k, S)


def demosaiced(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise as bilinear demosaicing and a colour matrix leave it, of unit variance."""
    white = rng.standard_normal((*shape, 3))
    colour = np.array([[0.8, 0.3, 0.1], [0.2, 0.9, 0.2], [0.0, 0.3, 0.8]])
    kernels = [[[1, 2, 1], [2, 4, 2], [1, 2, 1]], [[0, 1, 0], [1, 4, 1], [0, 1, 0]]] * 2
    n = np.stack(
        [ndimage.correlate(white[..., c], np.array(kernels[c], float)) for c in range(3)], -1
    )
    n = np.roll(n @ colour.T, (0, 1), (0, 1))
    n[..., 2] = np.roll(n[..., 2], 1, axis=1)  # blue a pixel beside: the sign of lags is seen
    return n / n.std(axis=(0, 1))


def noisy(rng: np.random.Generator, size: tuple[int, int] = (480, 640)) -> NDArray[np.float32]:
    """A ramp from 0.2 to 1 whose upper third is textured."""
    ramp = np.linspace(0.2, 1, size[1])[None, :, None] * [1.0, 0.8, 0.6]
    texture = ndimage.gaussian_filter(rng.standard_normal((*size, 1)), (1.5, 1.5, 0))
    texture[size[0] // 3 :] = 0
    L = np.maximum(ramp + 0.2 * texture, 0.01)
    return (L + np.sqrt(SHOT * L + READ) * demosaiced(size, rng)).astype(np.float32)


def test_noise_is_measured_without_bias() -> None:
    rng = np.random.default_rng(0)
    found = measure_noise(noisy(rng))
    truth = SHOT * found.radiance + READ
    # 40 patches of some 60 degrees of freedom a level: 3 %
    np.testing.assert_allclose(found.variance / truth, 1, atol=0.12)
    assert (found.variance / truth).mean() == pytest.approx(1, abs=0.02)
    true = autocovariance(demosaiced((1000, 1000), rng))
    np.testing.assert_allclose(found.correlation, true, atol=0.025)
    # beyond the brightest patch it goes on as photons do
    np.testing.assert_allclose(found.at(np.full(3, 3.0)), SHOT * 3 + READ, rtol=0.25)


def test_stated_sigma_gives_the_variance_and_is_checked_against_the_picture() -> None:
    rng = np.random.default_rng(1)
    plate = noisy(rng)
    sigma = 2 * np.sqrt(SHOT * np.maximum(plate, 0) + READ)
    sigma[:20, :20] = np.inf
    found = measure_noise(plate, sigma=sigma)
    stated = found.variance / (4 * (SHOT * found.radiance + READ))
    assert np.median(stated) == pytest.approx(1, abs=5e-3)
    np.testing.assert_allclose(stated, 1, atol=0.15)  # the ends of the range are wide
    np.testing.assert_allclose(found.ratio, 0.5, rtol=0.05)


def blocks(field: NDArray[np.floating], side: int = 40) -> NDArray[np.float64]:
    """Autocovariances (N, 7 * 7 * 3 * 3) of independent blocks, their mean taken out."""
    height, width, _ = field.shape
    return np.array(
        [
            autocovariance(part - part.mean(axis=(0, 1))).ravel()
            for y in range(0, height - side + 1, side)
            for part in (
                field[y : y + side, x : x + side] for x in range(0, width - side + 1, side)
            )
        ]
    )


def assert_alike(one: NDArray[np.float64], other: NDArray[np.float64]) -> None:
    """Welch's test of each column; of n tests the least p is Bonferroni's 1e-4 / n."""
    # a lag of one channel pair is there twice
    test: Any = stats.ttest_ind(one, other, equal_var=False)
    p = test.pvalue
    assert p.min() > 1e-4 / one.shape[1]
    # and not one or two but as many as chance has them
    assert (p < 0.01).mean() < 0.05


@pytest.mark.parametrize(("kept", "added"), [(0.0, 0.5), (0.5, 0.25), (0.4, 0.0)])
def test_synthetic_pixels_have_the_noise_of_the_plate(kept: float, added: float) -> None:
    """An object, half-covered pixels and a shadow."""
    rng = np.random.default_rng(2)
    size = 400, 640
    n = demosaiced(size, rng)
    level = kept * 0.5 + added
    plate = np.full((*size, 3), 0.5) + np.sqrt(SHOT * 0.5 + READ) * n
    plate = np.concatenate([noisy(rng), plate]).astype(np.float32)
    noise = measure_noise(plate)
    part = np.zeros((len(plate), 1, 1), bool)
    part[-400:] = True
    made, _ = apply_look(
        composite(plate, np.where(part, kept, 1), np.where(part, added, 0)),
        plate,
        CameraLook(noise=noise),
    )
    synthetic = made.rgb[-400:]
    np.testing.assert_array_equal(made.rgb[:-400], plate[:-400])
    truth = level + np.sqrt(SHOT * level + READ) * demosaiced(size, rng)
    # the variance was measured to some percent: it is compared apart from the grain
    scale = np.std(truth, axis=(0, 1)) / np.std(synthetic, axis=(0, 1))
    np.testing.assert_allclose(scale, 1, atol=0.05)
    assert_alike(blocks(scale * (synthetic - level)), blocks(truth - level))


def test_power_spectra_are_alike() -> None:
    rng = np.random.default_rng(3)
    noise = measure_noise(noisy(rng, (800, 1000)))
    made = grain((640, 640), noise.correlation, rng)
    true = demosaiced((640, 640), rng)

    def power(field: NDArray[np.floating]) -> NDArray[np.float64]:
        tiles = (
            field[:640, :640].reshape(20, 32, 20, 32, 3).swapaxes(1, 2).reshape(-1, 32, 32, 3)
        )
        window = np.outer(np.hanning(32), np.hanning(32))[..., None]
        return np.log((np.abs(np.fft.rfft2(tiles * window, axes=(1, 2))) ** 2).mean(axis=0)[1:])

    # the mean of 400 exponential variables: ln of it has a deviation of 1 / 20. Below 5 % of
    # the largest power the measured correlation's own error shows.
    difference = power(made) - power(true)
    strong = power(true) > power(true).max() - 3
    assert strong.sum() > 300
    assert np.abs(difference[strong].mean()) < 0.03
    assert difference[strong].std() < 1.3 * np.sqrt(2 / 400)


DATA = Path(__file__).parents[2] / "../shared/data"


def test_the_grain_of_a_real_sensor_is_met() -> None:
    """Measured on the left half of a RAW picture, made anew, compared with its right half."""
    file = DATA / "hdr/raw/colorchart.dng"
    if not file.is_file():
        pytest.skip(f"no {file.name} in ../shared/data/hdr/raw")
    picture = read_image(file).pixels
    half = picture.shape[1] // 2 // 16 * 16
    left, right = measure_noise(picture[:, :half]), measure_noise(picture[:, half:])
    made = grain((800, 800), left.correlation, np.random.default_rng(0))
    # 2000 patches a half: standard error of a correlation about 0.01
    np.testing.assert_allclose(autocovariance(made), right.correlation, atol=0.04)
    level = picture[::16, ::16].clip(1e-3)
    ratio = np.sqrt(left.at(level) / right.at(level))
    np.testing.assert_allclose(np.median(ratio, axis=(0, 1)), 1, atol=0.05)


def test_grain_follows_the_seed() -> None:
    correlation = np.zeros((2 * LAGS + 1,) * 2 + (1, 1))
    correlation[LAGS, LAGS] = 1
    one, same, other = (
        grain((40, 50), correlation, np.random.default_rng(s)) for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
    assert grain((300, 300), correlation, np.random.default_rng(1)).std() == pytest.approx(
        1, abs=0.01
    )


def polygons(
    width: float | tuple[float, float, float], *, area: bool = True
) -> NDArray[np.float64]:
    """Rectangles in all directions, blurred by a Gaussian before the pixels' area is taken."""
    rng, K = np.random.default_rng(0), 8
    height, width_ = 300, 400
    fine = np.full((height * K, width_ * K, 3), 0.4, np.float32)
    for _ in range(40):
        centre = rng.uniform(0, 1, 2) * [width_ * K, height * K]
        box = cv2.boxPoints(
            (tuple(centre), tuple(rng.uniform(20, 60, 2) * K), rng.uniform(0, 180))
        )
        cv2.fillPoly(fine, [box.astype(np.int32)], rng.uniform(0.1, 1, 3).tolist())
    for c, w in enumerate(np.broadcast_to(width, 3)):
        if w > 0:
            fine[..., c] = cv2.GaussianBlur(fine[..., c], (0, 0), float(w) * K)
    return fine.reshape(height, K, width_, K, 3).mean(axis=(1, 3)).astype(float)


def test_softness_is_the_width_of_the_blur() -> None:
    widths = (0.8, 0.6, 1.0)
    found = measure_softness(polygons(widths))
    np.testing.assert_allclose(found.width, np.sqrt(np.square(widths) + 1 / 12), rtol=0.01)
    rng = np.random.default_rng(1)
    rough = polygons(0.5) + 0.005 * rng.standard_normal((300, 400, 3))
    np.testing.assert_allclose(measure_softness(rough).width, 0.5774, rtol=0.03)


@pytest.mark.parametrize("width", [0.5, 0.7, 1.2])
def test_synthetic_edges_become_as_soft_as_the_plate(width: float) -> None:
    plate = polygons(width).astype(np.float32)
    softness = measure_softness(plate)
    sharp = polygons(0).astype(np.float32)
    made, _ = apply_look(composite(plate, 0.0, sharp), plate, CameraLook(softness=softness))
    np.testing.assert_allclose(measure_softness(made.rgb).width, softness.width, rtol=0.05)


def test_softness_leaves_the_plate_beside_it_alone() -> None:
    rng = np.random.default_rng(4)
    plate = rng.uniform(0.1, 1, (60, 80, 3)).astype(np.float32)
    cover = np.zeros((60, 80, 1), np.float32)
    cover[20:40, 30:50] = 1
    kernel = softening(1.0)
    softness = measure_softness(polygons(1.0))
    made, _ = apply_look(
        composite(plate, 1 - cover, 0.3 * cover), plate, CameraLook(softness=softness)
    )
    reach = len(kernel) // 2 + 1
    away = np.ones((60, 80), bool)
    away[20 - reach : 40 + reach, 30 - reach : 50 + reach] = False
    np.testing.assert_array_equal(made.rgb[away], plate[away])
    # across the edge the plate shows through by the coverage, itself unblurred
    share = soften(cover[..., 0], softening(float(softness.width[1])))
    np.testing.assert_allclose(
        made.rgb[..., 1], plate[..., 1] * (1 - share) + 0.3 * share, rtol=1e-5
    )


def test_a_sharper_plate_than_pixels_can_be_sharpens_nothing() -> None:
    np.testing.assert_array_equal(softening(0.2), [1.0])


def test_vignetting_falls_on_what_is_synthetic() -> None:
    camera = CameraModel.pinhole((80, 60), 1.0)
    V = fall_off([-0.3, 0.1], camera)
    corner = (39.5**2 + 29.5**2) / 50**2
    assert V[0, 0] == pytest.approx(1 - 0.3 * corner + 0.1 * corner**2, rel=1e-5)
    plate = np.full((60, 80, 3), 0.5, np.float32)
    made, _ = apply_look(composite(plate, 0.5, 1.0), plate, CameraLook(falloff=V))
    np.testing.assert_allclose(made.rgb, 0.25 + np.repeat(V[..., None], 3, axis=2), rtol=1e-6)
    with pytest.raises(UserError, match="falls to zero"):
        fall_off([-2.0], camera)
    with pytest.raises(UserError, match="no lens"):
        fall_off([-0.1], CameraModel.latlong((8, 4)))


def test_too_little_to_measure_is_said() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(UserError, match=r"switch look\.noise off"):
        measure_noise(rng.uniform(0, 1, (40, 40, 3)))
    with pytest.raises(UserError, match=r"switch look\.softness off"):
        measure_softness(np.full((64, 64, 3), 0.5))


def curve(codes: int = 256) -> Response:
    z = np.arange(codes)[None] / (codes - 1)
    return Response.from_log_exposure(np.log((z + 0.02) ** np.array([[2.0], [2.2], [2.4]])))


def test_codes_come_back_as_they_were() -> None:
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, (60, 70, 3)).astype(np.uint8)
    response = curve()
    merged = merge_frames([frame], np.array([0.02]), response)
    np.testing.assert_array_equal(expose(merged.radiance, response, 0.02), frame)
    deep = expose(merged.radiance, curve(4096), 0.02)
    assert deep.dtype == np.uint16
    assert deep.max() > 65000
    assert best_frame(merged.radiance, response, [1e-4, 0.02, 5.0]) == 1


def test_the_view_of_a_scene_as_its_camera_shows_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(6)
    build = tmp_path / "build"
    response = curve()
    sharp = polygons(0.7)[:240, :320]
    frame = np.rint(sharp * 150 + rng.normal(0, 1.5, sharp.shape)).clip(0, 255).astype(np.uint8)
    merged = merge_frames([frame], np.array([0.5]), response, sigma=True)
    assert merged.sigma is not None
    build.mkdir()
    write_exr(
        build / "plate.exr",
        np.dstack([merged.radiance, merged.sigma, merged.clipped]),
        channels=[*"RGB", *(f"sigma.{c}" for c in "RGB"), "clipped"],
        attributes={"exposures": [0.5], "exposureScale": "seconds"},
    )
    (build / "response.json").write_bytes(encode_response(response))
    from chromeball.scene.pose import Pose

    pose = Pose.look_at(np.array([0.0, 1.0, 1.5]), np.array([0.0, 0.2, 0.0]))
    CameraModel.pinhole((320, 240), 0.8, pose).write(build / "main.cameramodel")
    look = (
        "look = { noise = true, softness = true, vignetting = [-0.1], "
        'response = "plate", jpeg = 90 }'
    )
    text = SCENE.replace("size = [40, 30]", f'bracket = "plate"\n{look}')
    scene = write_scene(tmp_path, text + '[[bracket]]\nname = "plate"\n')
    run("render", scene, "--json")
    figures = json.loads(capsys.readouterr().out)
    codes = read_image(build / "main.camera.png").pixels
    same = (codes == frame).all(axis=2)
    changed = figures["changed_pixels"] / same.size
    assert 0.01 < changed < 0.95
    assert 1 - changed <= same.mean() < 1
    assert figures["look"]["frame"] == 0
    assert figures["look"]["softness"]["width"][1] > 0.4
    assert read_image(build / "main.camera.jpg").size == (320, 240)
    first = read_image(build / "main.exr").pixels
    run("render", scene, "--json", "--force")
    np.testing.assert_array_equal(read_image(build / "main.exr").pixels, first)


def test_the_plan_merges_with_sigma_and_names_the_pictures(tmp_path: Path) -> None:
    from chromeball.cli.stages import stages

    text = """
    name = "s"
    [[bracket]]
    name = "plate"
    frames = ["a.png", "b.png"]
    times = [1, 2]
    [env]
    file = "env.exr"
    [[object]]
    name = "ball"
    mesh = "sphere"
    [[view]]
    name = "main"
    bracket = "plate"
    camera = "a.cameramodel"
    look = { noise = true, response = "plate" }
    """
    plan = {stage.name: stage for stage in stages(parse_scene(text), tmp_path / "scene.toml")}
    assert "--sigma" in plan["hdr merge plate"].command
    assert "build/main.camera.png" in plan["render main"].outputs
    assert "build/response.json" in plan["render main"].inputs
    with pytest.raises(UserError, match="say how `response` is applied"):
        parse_scene(text.replace(', response = "plate"', ", jpeg = 90"))
