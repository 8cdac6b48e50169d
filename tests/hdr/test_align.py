from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from chromeball.hdr.align import Alignment, align, is_needed, warp
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image
from tests.hdr.camera import log_exposure, photograph

DATA = Path(__file__).parents[2].parent / "shared/data/hdr"
TIMES: NDArray[np.float64] = np.array([1 / 8, 1 / 2, 2.0])
type Float = NDArray[np.float64]
type Frame = NDArray[np.uint8]


def texture(height: int, width: int, seed: int = 0) -> Float:
    """Detail of all sizes over some six stops, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for k in range(3, 9):
        noise = rng.normal(size=(height // 2**k + 2, width // 2**k + 2))
        total += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    colour = np.array([1.2, 1.0, 0.8])
    return 0.15 * np.exp(0.6 * total)[..., None] * colour


def hand_held(
    moves: list[tuple[float, float, float]], height: int = 240, width: int = 320, seed: int = 0
) -> tuple[list[Float], Float]:
    """Views of one scene moved by (x, y, degrees), and the truth: view k to view 0."""
    fine, margin = 4, 200
    big = texture(height * fine + 2 * margin, width * fine + 2 * margin, seed)
    views: list[Float] = []
    poses: list[Float] = []
    for x, y, degrees in moves:
        c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        pose = np.eye(3)
        pose[:2, :2] = [[c, -s], [s, c]]
        pose[:2, 2] = centre - pose[:2, :2] @ centre + [x, y]
        to_big = np.array([[fine, 0, margin + 1.5], [0, fine, margin + 1.5], [0, 0, 1]])
        from_fine = np.array(
            [[1 / fine, 0, -1.5 / fine], [0, 1 / fine, -1.5 / fine], [0, 0, 1]]
        )
        moved = cv2.warpPerspective(
            big,
            to_big @ pose @ from_fine,
            (width * fine, height * fine),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        view = cv2.resize(moved, (width, height), interpolation=cv2.INTER_AREA)
        views.append(np.asarray(view, np.float64))
        poses.append(pose)
    return views, np.stack([np.linalg.inv(poses[0]) @ pose for pose in poses])


def exposed(views: list[Float], times: Float = TIMES) -> list[Frame]:
    return [
        photograph(view, np.array([t]), seed=k)[0]
        for k, (view, t) in enumerate(zip(views, times, strict=True))
    ]


def errors(found: Alignment, truth: Float, height: int, width: int) -> Float:
    """Rms distance in pixels over the picture, per frame."""
    x = np.array([[u * width, v * height, 1] for u in (0.1, 0.5, 0.9) for v in (0.1, 0.5, 0.9)])
    expected = np.linalg.inv(truth[found.reference]) @ truth
    distance: list[float] = []
    for have, want in zip(found.transforms, expected, strict=True):
        a, b = x @ have.T, x @ want.T
        gap = a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]
        distance.append(float(np.sqrt(np.mean((gap**2).sum(axis=1)))))
    return np.array(distance)


MOVES = [(0.0, 0.0, 0.0), (3.3, -7.6, 0.0), (-11.25, 5.5, 0.0)]
TURNED = [(0.0, 0.0, 0.0), (-21.3, 9.4, 1.4), (13.7, 30.2, -0.8)]


@pytest.mark.parametrize(
    ("moves", "model", "response"),
    [(MOVES, "shift", True), (MOVES, "shift", False), (TURNED, "rotation", False)],
)
def test_known_motion_is_found(
    moves: list[tuple[float, float, float]], model: str, response: bool
) -> None:
    views, truth = hand_held(moves)
    known = np.repeat(log_exposure()[None], 3, axis=0) if response else None
    found = align(exposed(views), TIMES, known)
    assert found.model == model
    assert found.flags == ("", "", "")
    error = errors(found, truth, 240, 320)
    assert error.max() < 0.03
    moved = np.arange(3) != found.reference
    assert np.all(error[moved] < 4 * found.sigma[moved])
    assert is_needed(found)


@pytest.mark.parametrize("kind", ["uint16", "float32"])
def test_linear_frames(kind: str) -> None:
    views, truth = hand_held(TURNED)
    white = 65535 if kind == "uint16" else 1
    frames = [
        (np.minimum(view * t, 1) * white).astype(kind)
        for view, t in zip(views, TIMES, strict=True)
    ]
    assert errors(align(frames, TIMES), truth, 240, 320).max() < 0.05


def test_sixteen_bit_codes_with_their_response() -> None:
    views, truth = hand_held(MOVES)
    frames = [
        np.round(4095 * np.minimum(view * t, 1) ** (1 / 2.2)).astype(np.uint16)
        for view, t in zip(views, TIMES, strict=True)
    ]
    g = 2.2 * np.log(np.maximum(np.arange(4096), 0.5) / 2048)
    found = align(frames, TIMES, np.repeat(g[None], 3, axis=0))
    assert errors(found, truth, 240, 320).max() < 0.05


def test_a_tripod_needs_none() -> None:
    views, truth = hand_held([(0.0, 0.0, 0.0)] * 3)
    found = align(exposed(views), TIMES)
    assert not is_needed(found)
    assert errors(found, truth, 240, 320).max() < 0.03
    assert found.confident.all()


def test_a_homography_is_found() -> None:
    views, _ = hand_held([(0.0, 0.0, 0.0)] * 3, 320, 480)
    frames = exposed(views)
    tilt = np.array([[1.004, 0.006, 3.0], [-0.002, 0.997, -4.0], [1.2e-5, -9e-6, 1.0]])
    frames[2] = warp(frames[2], tilt)[0]
    truth = np.stack([np.eye(3), np.eye(3), np.linalg.inv(tilt)])
    found = align(frames, TIMES)
    assert found.model == "homography"
    assert errors(found, truth, 320, 480).max() < 0.15


def test_order_changes_nothing() -> None:
    views, _ = hand_held(TURNED)
    frames = exposed(views)
    plain = align(frames, TIMES)
    other = align([frames[k] for k in (2, 0, 1)], TIMES[[2, 0, 1]])
    np.testing.assert_allclose(other.transforms, plain.transforms[[2, 0, 1]], atol=1e-9)


def test_black_surround_does_not_pin_the_picture() -> None:
    """A fisheye's circle stays where it is on the sensor; so does a letter-box."""
    views, truth = hand_held([(0.0, 0.0, 0.0), (6.5, -4.25, 0.0), (-8.0, 9.75, 0.0)])
    frames = exposed(views)
    y, x = np.mgrid[0:240, 0:320]
    outside = np.hypot(x - 159.5, y - 119.5) > 112
    for frame in frames:
        frame[outside] = np.random.default_rng(1).integers(0, 4, 3)
        frame[:20] = 0
    found = align(frames, TIMES)
    assert found.confident.all()
    assert errors(found, truth, 240, 320).max() < 0.1


def test_what_moves_by_itself_does_not_pull() -> None:
    views, truth = hand_held(MOVES)
    walker = 0.4 * views[0][90:210, 100:260][::-1]
    for k, view in enumerate(views):
        # a quarter of the picture walks on, well lit and full of detail
        view[60:180, 20 + 40 * k : 180 + 40 * k] = walker
    found = align(exposed(views), TIMES)
    assert errors(found, truth, 240, 320).max() < 0.1


def test_frames_that_show_nothing_are_flagged() -> None:
    views, truth = hand_held(MOVES)
    frames = [
        *exposed(views),
        np.zeros((240, 320, 3), np.uint8),
        np.full((240, 320, 3), 255, np.uint8),
    ]
    found = align(frames, np.append(TIMES, [1e-3, 1e3]))
    assert [bool(flag) for flag in found.flags] == [False, False, False, True, True]
    assert (
        errors(found, np.concatenate([truth, truth[:1], truth[2:]]), 240, 320)[:3].max() < 0.1
    )
    assert np.all(np.isinf(found.sigma[3:]))
    np.testing.assert_array_equal(found.transforms[3], found.transforms[0])


def test_frames_of_different_scenes_are_flagged() -> None:
    first, _ = hand_held([(0.0, 0.0, 0.0)] * 2, seed=1)
    second, _ = hand_held([(0.0, 0.0, 0.0)], seed=2)
    found = align(exposed([*first, *second]), TIMES)
    assert sum(bool(flag) for flag in found.flags) >= 1


def test_repeated_structure_is_ambiguous() -> None:
    """A chessboard moved by any number of squares looks alike."""
    y, x = np.mgrid[0:240, 0:320]
    board = np.where((x // 20 + y // 20) % 2 == 0, 0.3, 0.05)[..., None].repeat(3, 2)
    board = np.asarray(cv2.GaussianBlur(board, (0, 0), 1.0), np.float64)
    frames = exposed([board, np.roll(board, 6, axis=1), np.roll(board, 20, axis=0)])
    assert not align(frames, TIMES).confident.all()


def test_one_frame() -> None:
    found = align([np.zeros((40, 40, 1), np.uint8)], np.ones(1))
    np.testing.assert_array_equal(found.transforms, np.eye(3)[None])
    assert found.flags == ("",)
    assert not is_needed(found)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exposures": np.ones(2)}, "2 exposures for 3"),
        ({"exposures": np.array([1.0, -1.0, 2.0])}, "positive"),
        (
            {
                "frames": [np.zeros((40, 40, 3), np.uint8)] * 2
                + [np.zeros((40, 41, 3), np.uint8)]
            },
            "one size",
        ),
        ({"frames": [np.zeros((8, 8, 3), np.uint8)] * 3}, "too small"),
        ({"frames": [np.zeros((40, 40, 3), np.float64)] * 3}, "float64"),
        ({"log_exposure": np.zeros((1, 256))}, "channels"),
        ({"log_exposure": np.zeros((3, 1024))}, "1024 codes"),
        ({"reference": 3}, "no frame 3"),
        ({"models": ["affine"]}, "shift, rotation, homography"),
        ({"frames": [], "exposures": np.ones(0)}, "no pictures"),
    ],
)
def test_refusals(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {
        "frames": [np.zeros((40, 40, 3), np.uint8)] * 3,
        "exposures": TIMES,
    }
    with pytest.raises(UserError, match=message):
        align(**(arguments | change))


@pytest.mark.parametrize("stack", ["hdrtoolbox/stack", "memorial"])
def test_real_brackets_moved_by_known_shifts(stack: str) -> None:
    if not (DATA / stack).is_dir():
        pytest.skip("the shared brackets are not here")
    paths = sorted(p for p in (DATA / stack).iterdir() if p.suffix in (".png", ".jpg"))[1:4]
    frames = [read_image(path).pixels[30:330, 30:-30, :3] for path in paths]
    times = np.array([0.5, 1 / 8, 1 / 30]) if stack != "memorial" else np.exp2(-np.arange(3.0))
    still = align(frames, times)
    shifts = [(0, 0), (17, -9), (-21, 20)]
    height, width = (n - 48 for n in frames[0].shape[:2])
    moved = [
        np.ascontiguousarray(f[24 + y : 24 + y + height, 24 + x : 24 + x + width])
        for f, (x, y) in zip(frames, shifts, strict=True)
    ]
    found = align(moved, times, reference=still.reference)
    truth = np.repeat(np.eye(3)[None], 3, axis=0)
    for k, (x, y) in enumerate(shifts):
        crop = np.array([[1, 0, 24 + x], [0, 1, 24 + y], [0, 0, 1.0]])
        truth[k] = np.linalg.inv(np.array([[1, 0, 24], [0, 1, 24], [0, 0, 1.0]])) @ (
            still.transforms[k] @ crop
        )
    error = errors(found, truth, height, width)
    assert np.all((error < 0.5) | ~found.confident)
    assert found.confident.sum() >= 2


# resampling ----------------------------------------------------------------------------------


def keys(u: float) -> Float:
    """Weights of the four nearest samples (Keys 1981, a = -1/2), from its definition."""
    x = np.abs(np.array([u + 1, u, 1 - u, 2 - u]))
    near = 1.5 * x**3 - 2.5 * x**2 + 1
    far = -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return np.where(x <= 1, near, np.where(x < 2, far, 0))


def reference_warp(
    frame: NDArray[Any], T: Float, white: float
) -> tuple[Float, NDArray[np.bool_]]:
    height, width, channels = frame.shape
    out, valid = np.zeros(frame.shape), np.zeros((height, width), bool)
    inverse = np.linalg.inv(T)
    for y in range(height):
        for x in range(width):
            p = inverse @ [x, y, 1]
            sx, sy = np.round(p[:2] / p[2], 7)
            if not (0 <= sx <= width - 1 and 0 <= sy <= height - 1):
                continue
            valid[y, x] = True
            x0, y0 = int(sx), int(sy)
            columns = np.clip(np.arange(x0 - 1, x0 + 3), 0, width - 1)
            rows = np.clip(np.arange(y0 - 1, y0 + 3), 0, height - 1)
            block = frame[np.ix_(rows, columns)].astype(float)
            near = block[1 : 2 + (sy > y0), 1 : 2 + (sx > x0)].reshape(-1, channels)
            value = np.einsum("i,j,ijc->c", keys(sy - y0), keys(sx - x0), block)
            value = np.clip(value, near.min(0), near.max(0))
            value = np.where(near.min(0) <= 0, 0, value)
            out[y, x] = np.where(near.max(0) >= white, near.max(0), value)
    return out, valid


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("channels", [1, 3])
def test_warp_equals_its_reference(kind: str, channels: int) -> None:
    rng = np.random.default_rng(3)
    white = {"uint8": 255, "uint16": 65535, "float32": 1}[kind]
    values = rng.uniform(0.02, 1.1, (21, 34, channels)).clip(0, 1) * white
    values[4:6, 8] = 0
    frame = values.astype(kind)
    T = np.array([[1.02, 0.05, -1.3], [-0.03, 0.97, 2.2], [1e-4, -2e-4, 1.0]])
    have, valid = warp(frame, T, float(white))
    want, inside = reference_warp(frame, T, white)
    np.testing.assert_array_equal(valid, inside)
    tolerance = 0.51 if kind != "float32" else 2e-6
    np.testing.assert_allclose(have.astype(float), want, atol=tolerance)
    assert not have[~valid].any()


@settings(max_examples=25, deadline=None)
@given(st.integers(-9, 9), st.integers(-9, 9), st.integers(0, 2**32 - 1))
def test_whole_pixels_are_copied(x: int, y: int, seed: int) -> None:
    frame = np.random.default_rng(seed).integers(0, 256, (16, 20, 3)).astype(np.uint8)
    out, valid = warp(frame, np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]]))
    padded = np.pad(frame, ((9, 9), (9, 9), (0, 0)))
    inside = np.pad(np.ones((16, 20), bool), 9)
    box = np.s_[9 - y : 25 - y, 9 - x : 29 - x]
    np.testing.assert_array_equal(out, padded[box])
    np.testing.assert_array_equal(valid, inside[box])


def test_clipped_pixels_stay_clipped() -> None:
    frame = np.full((20, 20, 3), 100, np.uint8)
    frame[10, 10] = 255
    frame[4, 4] = 0
    out, _ = warp(frame, np.array([[1, 0, 0.4], [0, 1, 0.7], [0, 0, 1.0]]))
    assert np.all(out[10:12, 10:12] == 255)
    assert np.all(out[4:6, 4:6] == 0)
    out[10:12, 10:12] = out[4:6, 4:6] = 100
    assert np.all(out[1:, 1:] == 100)


def test_noise_after_resampling() -> None:
    """The variance that the docstring promises: 0.41 at half a pixel, 0.66 on average."""
    weight = np.mean([np.sum(keys(u) ** 2) for u in np.linspace(0, 1, 1001)])
    assert np.sum(keys(0.5) ** 2) ** 2 == pytest.approx(0.41, abs=0.005)
    assert weight**2 == pytest.approx(0.66, abs=0.01)
    frame = np.random.default_rng(2).normal(100, 1, (200, 200, 1)).astype(np.float32)
    out, valid = warp(frame, np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]]), 1e9)
    assert out[valid].var() == pytest.approx(0.41, abs=0.05)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.zeros((3, 3)), "singular"),
        (np.full((3, 3), np.nan), "finite"),
        (np.array([[1, 0, 0], [0, 1, 0], [0.2, 0, 1.0]]), "infinity"),
    ],
)
def test_warp_refuses(T: Float, message: str) -> None:
    with pytest.raises(UserError, match=message):
        warp(np.zeros((20, 20, 3), np.uint8), T)
