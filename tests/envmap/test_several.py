"""Light at a point from probes elsewhere, over a set that is known in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from chromeball.cli.main import build_app
from chromeball.envmap.complete import Source
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.several import LightAt, ProbeMap, fill, light_at
from chromeball.scene.errors import UserError
from chromeball.scene.image import read_image, write_exr
from chromeball.scene.record import read_json
from chromeball.stand_in.ply import write_stand_in
from tests.envmap.set import BEHIND, CAST, LEFT, MESH, RIGHT, panorama


def error(found: LightAt, truth: ProbeMap) -> float:
    return float(np.abs(found.radiance - truth.radiance).mean() / truth.radiance.mean())


def test_at_its_own_place_a_probe_shows_itself() -> None:
    probe = panorama(LEFT)
    found = light_at([probe], LEFT, CAST, 128)
    assert found.unseen == pytest.approx(0, abs=1e-6)
    assert error(found, probe) < 0.02  # bilinear


def test_one_probe_is_right_wherever_it_sees_the_set() -> None:
    near = LEFT + np.array([-0.6, -0.5, 0.7])
    found = light_at([panorama(LEFT)], near, CAST, 128)
    truth = panorama(near)
    wholly = found.seen == 1
    assert wholly.mean() > 0.8
    apart = np.abs(found.radiance - truth.radiance)[wholly].mean() / truth.radiance.mean()
    assert apart < 0.015
    # as it is, without its parallax put right
    plain = np.abs(panorama(LEFT).radiance - truth.radiance)[wholly].mean()
    assert plain / truth.radiance.mean() > 10 * apart


def test_what_one_probe_does_not_see_comes_from_another() -> None:
    left, right, truth = panorama(LEFT), panorama(RIGHT), panorama(BEHIND)
    alone, both = (light_at(probes, BEHIND, CAST, 128) for probes in ([left], [left, right]))
    assert alone.unseen > 0.5
    assert both.unseen < 0.03
    assert both.lone == pytest.approx(alone.unseen - both.unseen, abs=1e-3)
    assert both.shares[1] > both.lone > 0.5
    assert error(both, truth) < 0.02 < 0.2 < error(alone, truth)
    faded = np.abs((left.radiance + right.radiance) / 2 - truth.radiance).mean()
    nearest = np.abs(right.radiance - truth.radiance).mean()
    assert error(both, truth) < 0.2 * min(faded, nearest) / truth.radiance.mean()
    # completed, not black, and marked
    hidden = alone.seen == 0
    assert (alone.radiance[hidden].sum(axis=1) > 0).all()
    assert (alone.probe[hidden] == -1).all()
    assert (both.probe[both.seen > 0] >= 0).all()


def test_a_map_is_twice_there_no_brighter() -> None:
    """Weights share: two probes that see the same give its light once."""
    even = np.full((32, 64, 3), 2.0, np.float32)
    found = light_at(
        [ProbeMap(even, LEFT), ProbeMap(even, RIGHT)], np.array([0.0, 1.0, 1.0]), CAST, 64
    )
    np.testing.assert_allclose(found.radiance, 2, rtol=1e-5)
    assert found.shares.sum() == pytest.approx(1 - found.unseen)


def nothing_near(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A set without geometry: no ray meets anything."""
    return np.full(len(origins), np.inf), np.zeros_like(directions)


def test_what_a_probe_completed_is_anothers_to_show() -> None:
    """The near probe's completed half, a guess, comes from the far one that saw it."""
    near, far = (np.full((16, 32, 3), v, np.float32) for v in (1.0, 3.0))
    upper = np.zeros((16, 32), bool)
    upper[:8] = True
    probes = [ProbeMap(near, np.zeros(3), upper), ProbeMap(far, np.array([1e3, 0, 0]))]
    found = light_at(probes, np.zeros(3), nothing_near, 32)
    np.testing.assert_allclose(found.radiance[:7], 1, rtol=1e-5)
    np.testing.assert_allclose(found.radiance[9:], 3, rtol=1e-5)
    alone = light_at(probes[:1], np.zeros(3), nothing_near, 32)
    assert alone.unseen == pytest.approx(0.5, abs=1e-6)
    assert (alone.seen[9:] == 0).all()
    assert (alone.probe[9:] == -1).all()


def test_far_light_is_the_nearest_probes() -> None:
    one, two = (np.full((16, 32, 3), v, np.float32) for v in (1.0, 3.0))
    probes = [ProbeMap(one, np.zeros(3)), ProbeMap(two, np.array([10.0, 0, 0]))]
    found = light_at(probes, np.array([1.0, 0, 0]), nothing_near, 32)
    assert found.radiance.mean() == pytest.approx(1 + 2 / 82, rel=1e-3)  # 1 / 1 against 1 / 81


def test_a_small_lamp_keeps_its_light() -> None:
    """Seen from another place, a lamp's irradiance follows its solid angle."""
    dark = np.zeros((256, 512, 3), np.float32)
    mapping = LatLong((512, 256))
    at = np.array([-1.6, 2.5, 0.2])  # on the ceiling
    towards = (at - LEFT) / np.linalg.norm(at - LEFT)
    dark[mapping.directions() @ towards > np.cos(0.06)] = 1000
    moved = LEFT + np.array([0.3, -0.7, 0.3])
    found = light_at([ProbeMap(dark, LEFT)], moved, CAST, 256, samples=6)

    def energy(rgb: np.ndarray) -> float:
        solid = LatLong((rgb.shape[1], rgb.shape[0])).solid_angles()
        return float((rgb[..., 1] * solid).sum())

    def share(place: np.ndarray) -> float:
        v = at - place
        return float(v[1] / np.linalg.norm(v) ** 3)

    expected = energy(dark) * share(moved) / share(LEFT)
    assert energy(found.radiance) == pytest.approx(expected, rel=0.02)


def test_refusals() -> None:
    probe = panorama(LEFT, 32, 1)
    with pytest.raises(UserError, match="probes 1 and 2 are at one place"):
        light_at([probe, probe], RIGHT, CAST, 32)
    with pytest.raises(UserError, match="inside a piece of the stand-in"):
        light_at([probe], np.array([0.0, 1.0, -1.5]), CAST, 32)  # inside the screen


def test_fill_takes_what_is_near() -> None:
    rgb = np.zeros((32, 64, 3), np.float32)
    rgb[:, :32], rgb[:, 32:] = 1, 5
    known = np.ones((32, 64), bool)
    known[10:20, 40:50] = False
    known[10:20, :4] = False
    filled = fill(rgb, known)
    np.testing.assert_array_equal(filled[known], rgb[known])
    assert filled[10:20, 40:50].min() > 4.5  # around the seam 5 lies beside 1
    assert fill(rgb, np.zeros((32, 64), bool)) is not rgb


def test_command(tmp_path: Path) -> None:
    left, right = panorama(LEFT, 64), panorama(RIGHT, 64)
    for name, probe in (("a", left), ("b", right)):
        write_exr(tmp_path / f"{name}.exr", probe.radiance, attributes={"origin": probe.origin})
    write_exr(tmp_path / "lost.exr", left.radiance)
    write_stand_in(tmp_path / "set.ply", MESH)

    def run(*arguments: object) -> None:
        build_app()(
            [str(a) for a in ("envmap", "at", *arguments)],
            exit_on_error=False,
            result_action="return_value",
        )

    common = ("--stand-in", tmp_path / "set.ply", "-o", tmp_path / "at.exr")
    run("-1.6,1,-1.3", "--probes", tmp_path / "a.exr", tmp_path / "b.exr", *common)
    image = read_image(tmp_path / "at.exr")
    assert image.channels == ("R", "G", "B", "A", "completed", "probe")
    alpha, completed, number = np.moveaxis(image.pixels[..., 3:], -1, 0)
    assert ((alpha == 0) == (completed == Source.BORDER)).all()
    assert ((alpha == 0) == (number == 0)).all()
    assert (alpha > 0.99).mean() > 0.5
    np.testing.assert_allclose(np.ravel(image.attributes["origin"]), [-1.6, 1, -1.3], atol=1e-6)
    figures = read_json(tmp_path / "at.exr.record.json")["figures"]
    assert figures["shares_of_probes"][0] > 0.5
    assert (tmp_path / figures["probes_preview"]).is_file()
    with pytest.raises(UserError, match=r"lost.exr: no attribute `origin`"):
        run("0,1,1", "--probes", tmp_path / "lost.exr", *common)
    with pytest.raises(UserError, match="is an input"):
        run("0,1,1", "--probes", tmp_path / "at.exr", *common)
