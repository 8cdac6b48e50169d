from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chromeball.hdr import kernel
from chromeball.hdr.ghost import Ghosts, find_ghosts, replace
from chromeball.hdr.merge import merge_frames
from chromeball.hdr.response import sample, solve
from chromeball.hdr.response_file import Response
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image
from tests.hdr.camera import TIMES as ALL
from tests.hdr.camera import log_exposure, photograph, scene

DATA = Path(__file__).parents[2].parent / "shared/data/hdr"
TIMES: NDArray[np.float64] = ALL[::2]
G: NDArray[np.float64] = np.repeat(log_exposure()[None], 3, axis=0)
NOISE: NDArray[np.float64] = np.full(3, 1.0)
type Float = NDArray[np.float64]
type Frames = list[NDArray[np.uint8]]


def static() -> Float:
    return scene(180, 240)


def moving(factor: float = 6.0) -> tuple[Frames, list[NDArray[np.bool_]], list[Float]]:
    """A square `factor` brighter than the scene walks along; where it is in each frame."""
    views: list[Float] = []
    where: list[NDArray[np.bool_]] = []
    for k in range(len(TIMES)):
        here = np.zeros((180, 240), bool)
        here[70:110, 30 + 45 * k : 65 + 45 * k] = True
        views.append(np.where(here[..., None], factor * static(), static()))
        where.append(here)
    frames = [
        photograph(view, np.array([t]), seed=k)[0]
        for k, (view, t) in enumerate(zip(views, TIMES, strict=True))
    ]
    return frames, where, views


def merged(frames: Frames) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    result = merge_frames(frames, TIMES, Response.from_log_exposure(G))
    return result.radiance, result.clipped


def reference_score(
    frames: Frames, table: Float, ranges: NDArray[np.int32], misaligned: float
) -> Float:
    """The kernel's score, pixel by pixel as its description says."""
    P, (height, width, channels) = len(frames), frames[0].shape
    padded = [np.pad(f, ((1, 1), (1, 1), (0, 0)), mode="edge").astype(int) for f in frames]
    score = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            z = np.array([f[y, x] for f in frames]).astype(int)
            bent = (z > ranges[:, :, 1]).any(axis=1)
            worst = np.zeros(channels)
            for c in range(channels):
                value, variance, kind = np.zeros(P), np.zeros(P), np.zeros(P)
                for j in range(P):
                    low, high = ranges[j, c]
                    entry = table[j, c, np.clip(z[j, c], low, high)]
                    block = padded[j][y : y + 3, x : x + 3, c]
                    value[j] = entry[0]
                    variance[j] = entry[1] + (0.5 * misaligned * np.ptp(block)) ** 2 * entry[2]
                    kind[j] = (
                        1 if z[j, c] > high else 9 if bent[j] else -1 if z[j, c] < low else 0
                    )
                measured = np.flatnonzero(kind == 0)
                deviations = [0.0]
                for j in measured:
                    rest = measured[measured != j]
                    if len(rest):
                        w = 1 / variance[rest]
                        d = value[j] - w @ value[rest] / w.sum()
                        deviations.append(d**2 / (variance[j] + len(rest) / w.sum()))
                above = [j for j in range(P) if kind[j] == 1]
                below = [j for j in range(P) if kind[j] == -1]
                most = min(below, key=lambda j: value[j], default=None)
                least = max(above, key=lambda j: value[j], default=None)
                if len(measured):
                    w = 1 / variance[measured]
                    mean, spread = w @ value[measured] / w.sum(), len(measured) / w.sum()
                    if least is not None and value[least] > mean:
                        deviations.append(
                            (value[least] - mean) ** 2 / (spread + variance[least])
                        )
                    if most is not None and mean > value[most]:
                        deviations.append((mean - value[most]) ** 2 / (spread + variance[most]))
                elif least is not None and most is not None and value[least] > value[most]:
                    both = variance[least] + variance[most]
                    deviations.append((value[least] - value[most]) ** 2 / both)
                worst[c] = min(max(deviations), 1000)
            score[y, x] = np.floor(min(8 * np.sqrt(worst.mean()), 255))
    return score


@pytest.mark.parametrize("channels", [1, 3])
def test_scores_equal_their_reference(channels: int) -> None:
    rng = np.random.default_rng(0)
    P = 4
    frames = [rng.integers(0, 256, (12, 17, channels)).astype(np.uint8) for _ in range(P)]
    frames[1][:6] = frames[0][:6]
    frames[2][6:] = 255
    value = np.cumsum(rng.uniform(0.005, 0.03, (P, channels, 256)), axis=2)
    table = np.stack(
        [value, rng.uniform(0.01, 0.1, value.shape), rng.uniform(0, 1e-3, value.shape)], 3
    )
    ranges = np.broadcast_to(np.array([10, 240], np.int32), (P, channels, 2)).copy()
    have = kernel.ghost_scores(frames, table, ranges, [], 0.5)
    want = reference_score(frames, table, ranges, 0.5)
    assert np.abs(have - want).max() <= 1  # rounding of float32
    assert np.mean(have == want) > 0.97


def test_masked_pixels_say_nothing() -> None:
    frames, _, _ = moving()
    inside = [np.ones((180, 240), bool) for _ in frames]
    for mask in inside[1:]:
        mask[:, :120] = False
    found = find_ghosts(frames, TIMES, G, NOISE, valid=inside)
    assert not found.score[:, :120].any()
    assert found.mask[:, 125:].any()


def test_nothing_is_found_where_nothing_moves() -> None:
    frames = photograph(static(), TIMES)
    found = find_ghosts(frames, TIMES, G, NOISE)
    assert found.regions == ()
    assert found.pixels == 0
    radiance, clipped = merged(frames)
    same, marks = replace(radiance, clipped, frames, TIMES, G, found)
    np.testing.assert_array_equal(same, radiance)
    np.testing.assert_array_equal(marks, clipped)


@pytest.mark.parametrize("factor", [6.0, 1 / 6])
def test_what_moves_is_found_and_replaced(factor: float) -> None:
    frames, where, views = moving(factor)
    found = find_ghosts(frames, TIMES, G, NOISE)
    anywhere = np.any(where, axis=0)
    assert found.mask[anywhere].mean() > 0.85  # what is brighter than clipped is not seen
    assert (found.mask & ~anywhere).mean() < 0.05  # the rim
    assert sum(region.area for region in found.regions) == found.pixels == found.mask.sum()
    radiance, clipped = merged(frames)
    better, marks = replace(radiance, clipped, frames, TIMES, G, found)
    for number, region in enumerate(found.regions):
        inside = found.labels == number + 1
        truth = views[region.frame][inside] * (255 / 128) ** 2.2
        shown = marks[inside] == 0
        assert shown.mean() > 0.9
        error = np.log(better[inside][shown] / truth[shown])
        assert abs(np.median(error)) < 0.02
        assert np.sqrt(np.mean(error**2)) < 0.2  # one exposure's noise, dark codes too
        x, y, w, h = region.box
        rows, columns = np.nonzero(inside)
        assert (x, y, x + w, y + h) == (
            columns.min(),
            rows.min(),
            columns.max() + 1,
            rows.max() + 1,
        )
        assert region.area == inside.sum()
    far = np.abs(np.arange(180) - 90) > 40
    np.testing.assert_array_equal(better[far], radiance[far])


def test_one_exposure_is_preferred() -> None:
    frames, _, _ = moving(3.0)
    found = find_ghosts(frames, TIMES, G, NOISE, reference=1)
    assert found.reference == 1
    assert len(found.regions) >= 3
    shown = ((frames[1] >= 4) & (frames[1] <= 250)).all(axis=2)
    for number, region in enumerate(found.regions):
        # another exposure only where this one is clipped
        assert region.frame == 1 or shown[found.labels == number + 1].mean() < 0.9


def test_clipped_where_the_exposure_is() -> None:
    """A region that no exposure shows wholly keeps its marks."""
    frames, _, _ = moving()
    for frame in frames:
        frame[80:84, 20:220] = 255
    radiance, clipped = merged(frames)
    found = find_ghosts(frames, TIMES, G, NOISE)
    inside = found.mask.copy()
    inside[:80] = inside[84:] = False
    assert inside.any()
    better, marks = replace(radiance, clipped, frames, TIMES, G, found)
    assert np.all(marks[inside] == 1)
    assert np.all(np.isfinite(better))


def test_borders_are_feathered() -> None:
    labels = np.zeros((40, 60), np.int32)
    labels[10:30, 20:40] = 1
    from chromeball.hdr.ghost import Region

    ghosts = Ghosts(
        labels,
        (Region((20, 10, 20, 20), 400, 0, 0),),
        0,
        np.zeros((40, 60), np.uint8),
        np.ones((1, 1)),
    )
    frames = [np.full((40, 60, 1), 0.5, np.float32), np.full((40, 60, 1), 1.0, np.float32)]
    radiance, clipped = np.ones((40, 60, 1), np.float32), np.zeros((40, 60), np.int8)
    out, _ = replace(radiance, clipped, frames, np.array([0.25, 1.0]), None, ghosts, white=4.0)
    line = out[20, :, 0]
    assert np.all(line[20:40] == 2)
    assert line[0] == line[-1] == 1
    assert np.all(np.diff(line[:21]) >= 0)
    assert np.abs(np.diff(line)).max() < 0.3


@pytest.mark.parametrize("kind", ["uint16", "float32"])
def test_linear_frames(kind: str) -> None:
    _, where, views = moving()
    rng = np.random.default_rng(5)
    white = 65535 if kind == "uint16" else 1
    frames = [
        (np.clip(view * t + rng.normal(0, 1e-3, view.shape), 0, 1) * white).astype(kind)
        for view, t in zip(views, TIMES, strict=True)
    ]
    found = find_ghosts(frames, TIMES, None, NOISE)
    anywhere = np.any(where, axis=0)
    assert found.mask[anywhere].mean() > 0.85  # what is brighter than clipped is not seen
    assert (found.mask & ~anywhere).mean() < 0.05


def test_sixteen_bit_codes() -> None:
    frames, where, _ = moving()
    wide = [frame.astype(np.uint16) * 16 for frame in frames]
    g = np.repeat(2.2 * np.log(np.maximum(np.arange(4096), 8) / 2048)[None], 3, axis=0)
    found = find_ghosts(wide, TIMES, g, 16 * NOISE)
    assert found.mask[np.any(where, axis=0)].mean() > 0.85


def test_a_small_misalignment_is_no_motion() -> None:
    sharp = static()
    sharp[40:140, 60:180] *= 8
    frames = photograph(sharp, TIMES)
    frames[1] = np.roll(frames[1], 1, axis=1)  # one pixel: twice what is allowed for
    found = find_ghosts(frames, TIMES, G, NOISE, misaligned=1.0)
    assert found.mask[:, 4:-4].mean() < 0.001


@pytest.mark.parametrize("stack", ["hdrtoolbox/stack", "memorial"])
def test_static_real_brackets(stack: str) -> None:
    """False positives under 0.1 % where a tripod held the camera and nothing moved."""
    if not (DATA / stack).is_dir():
        pytest.skip("the shared brackets are not here")
    paths = sorted(p for p in (DATA / stack).iterdir() if p.suffix in (".png", ".jpg"))
    frames = [read_image(p).pixels[..., :3] for p in paths]
    if stack == "memorial":  # the painted borders differ
        frames = [np.ascontiguousarray(f[40:-60, 14:-14]) for f in frames[:10]]
        times = np.exp2(-np.arange(10.0))
    else:
        times = np.array([2, 0.5, 1 / 8, 1 / 30, 1 / 125, 1 / 1000, 1 / 4000])
    solved = solve([sample(f) for f in frames], times)
    found = find_ghosts(frames, times, solved.g, solved.code_noise, sigma=solved.sigma)
    assert found.mask.mean() < 0.001


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": [np.zeros((40, 40, 3), np.uint8)]}, "two pictures"),
        ({"exposures": np.ones(3)}, "3 exposures for 2"),
        ({"exposures": np.array([1.0, np.nan])}, "positive"),
        ({"log_exposure": None}, "need a response"),
        ({"log_exposure": G[:1]}, "channels"),
        ({"code_noise": np.full(3, np.nan)}, "noise"),
        ({"misaligned": -1.0}, "pixels"),
        ({"frames": [np.zeros((40, 40, 3), np.float32)] * 2}, "not for pictures of float32"),
        (
            {"frames": [np.zeros((40, 40, 3), np.uint8), np.zeros((40, 41, 3), np.uint8)]},
            "one size",
        ),
    ],
)
def test_refusals(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {
        "frames": [np.zeros((40, 40, 3), np.uint8)] * 2,
        "exposures": np.array([1.0, 2.0]),
        "log_exposure": G,
        "code_noise": NOISE,
    }
    with pytest.raises(UserError, match=message):
        find_ghosts(**(arguments | change))
