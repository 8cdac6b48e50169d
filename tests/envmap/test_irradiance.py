"""Irradiance, harmonics and prefiltered maps against brute force and closed forms."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from chromeball.cli.main import build_app
from chromeball.envmap.harmonics import cosine_factors, sh_basis
from chromeball.envmap.irradiance import (
    harmonics,
    irradiance,
    irradiance_map,
    spread_directions,
)
from chromeball.envmap.ktx import write_ktx2
from chromeball.envmap.mapping import LatLong
from chromeball.envmap.prefilter import (
    FACES,
    brdf_table,
    cube_directions,
    cube_solid_angles,
    prefilter_cube,
    prefilter_latlong,
    split_sum_error,
)
from chromeball.scene.errors import UserError
from chromeball.scene.image import write_exr
from chromeball.scene.record import read_json


def a_map(height: int = 64, suns: int = 2) -> np.ndarray:
    rng = np.random.default_rng(4)
    d = LatLong((2 * height, height)).directions()
    radiance = np.stack([1 + d[..., 1], 1.2 + d[..., 0] * 0.5, 0.8 - d[..., 2] * 0.4], axis=-1)
    for _ in range(suns):
        sun = rng.normal(size=3)
        radiance[d @ (sun / np.linalg.norm(sun)) > 0.998] = 2e4
    return radiance.astype(np.float32)


def energies(radiance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mapping = LatLong((radiance.shape[1], radiance.shape[0]))
    energy = radiance.astype(float) * mapping.solid_angles()[..., None]
    return mapping.directions().reshape(-1, 3), energy.reshape(-1, 3)


def test_irradiance_is_the_cosine_integral() -> None:
    radiance = a_map(256)
    d, energy = energies(radiance)
    normals = spread_directions(40)
    truth = np.stack([np.maximum(d @ n, 0) @ energy for n in normals])
    np.testing.assert_allclose(irradiance(radiance, normals), truth, rtol=1e-3)
    poles = [[0.0, 1, 0], [0, -1, 0], [1, 0, 0], [0, 0, -1]]
    np.testing.assert_allclose(
        irradiance(np.ones((7, 14, 3), np.float32), poles), math.pi, rtol=2e-4
    )


def test_irradiance_map_has_the_maps_axes() -> None:
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[10, 50] = 1e9  # a sun
    found = irradiance_map(radiance, 64)
    assert np.unravel_index(int(found[..., 0].argmax()), (32, 64)) == (10, 50)
    away = LatLong((64, 32)).directions() @ LatLong((64, 32)).directions()[10, 50]
    assert (found[away < -0.1] == 0).all()
    assert found.min() == 0


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_harmonics_are_orthonormal(order: int) -> None:
    mapping = LatLong((256, 128))
    basis, solid = sh_basis(mapping.directions(), order), mapping.solid_angles()
    gram = np.einsum("hwi,hwj,hw->ij", basis, basis, solid)
    np.testing.assert_allclose(gram, np.eye((order + 1) ** 2), atol=3e-3)


def test_cosine_factors() -> None:
    factors = cosine_factors(4)[[0, 1, 4, 9, 16]]
    expected = [math.pi, 2 * math.pi / 3, math.pi / 4, 0, -math.pi / 24]
    np.testing.assert_allclose(factors, expected)


def test_harmonics_of_a_map() -> None:
    smooth = a_map(64, suns=0)
    found = harmonics(smooth, 2)
    assert found.error < 1e-3
    normals = spread_directions(50)
    np.testing.assert_allclose(
        found.irradiance_on(normals), irradiance(smooth, normals), rtol=5e-3
    )
    errors = [harmonics(a_map(), order).error for order in range(5)]
    assert errors[0] > errors[1] > errors[2] == pytest.approx(errors[3])
    assert errors[3] > errors[4]
    with pytest.raises(UserError, match="from 0 to 4"):
        harmonics(smooth, 5)


def test_window_takes_the_negative_lobes() -> None:
    radiance = np.full((64, 128, 3), 0.001, np.float32)
    radiance[20, 30] = 1e5
    plain, damped = harmonics(radiance, 2), harmonics(radiance, 2, window=True)
    assert plain.lowest < -0.01
    assert damped.lowest >= 0
    assert damped.window > 0
    assert damped.error > plain.error  # its price, told
    np.testing.assert_allclose(damped.irradiance[0], plain.irradiance[0])  # no energy lost
    smooth = harmonics(a_map(suns=0), 2, window=True)
    assert smooth.window == 0


# ---- prefiltered


def lobe(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """D(h) G2 / (n.v) for n = v, without constants, from the textbook's forms."""
    alpha = roughness**2
    nh2 = (1 + cosine) / 2
    d = alpha**2 / (math.pi * (nh2 * (alpha**2 - 1) + 1) ** 2)
    tan2 = 1 / np.maximum(cosine, 1e-9) ** 2 - 1
    masking = (np.sqrt(1 + alpha**2 * tan2) - 1) / 2
    return np.where(cosine > 0, d / (1 + masking), 0)  # masking of the view is 0


@pytest.mark.parametrize("level", [2, 3])
def test_levels_are_the_convolution(level: int) -> None:
    radiance = a_map(64)
    found = prefilter_cube(radiance, 32, 4)
    d, energy = energies(radiance)
    _, solid = energies(np.ones_like(radiance))
    size = 32 >> level
    directions = cube_directions(size)[:, ::2, ::2, 0].reshape(-1, 3)
    k = lobe(directions @ d.T, found.roughness[level])
    truth = (k @ energy) / (k @ solid)
    own = found.levels[level][:, ::2, ::2].reshape(-1, 3)
    np.testing.assert_allclose(own, truth, rtol=0.02, atol=0.02 * truth.mean())
    assert own.mean() == pytest.approx(truth.mean(), rel=5e-3)


def test_energy_constant_and_suns() -> None:
    for found in (
        prefilter_cube(np.full((32, 64, 3), 3, np.float32), 32, 5),
        prefilter_latlong(np.full((32, 64, 3), 3, np.float32), 64, 5),
    ):
        assert [level.shape[-2] for level in found.levels][1:] == [
            level.shape[-2] // 2 for level in found.levels
        ][:-1]
        for level in found.levels:
            np.testing.assert_allclose(level, 3, rtol=1e-5)
    radiance = np.full((128, 256, 3), 0.1, np.float32)
    radiance[40, 60] = 1e9
    found = prefilter_cube(radiance, 64, 5)
    np.testing.assert_allclose(found.energy, 1, atol=0.02)
    # no fireflies: falling away from the sun, at each level that is blurred
    sun = LatLong((256, 128)).directions()[40, 60]
    for level in found.levels[2:]:
        directions = cube_directions(level.shape[1])[..., 0, :]
        order = np.argsort(-(directions @ sun).ravel())
        values = level[..., 0].ravel()[order]
        assert (np.diff(values) <= 1e-2 * values[:-1]).all()


def test_texel_directions() -> None:
    """As the Khronos data format specification's table of cube faces has it."""
    solid = cube_solid_angles(8)
    assert 6 * solid.sum() == pytest.approx(4 * math.pi)
    for face, (sc, tc, axis) in enumerate(
        [("-z", "-y", "+x"), ("+z", "-y", "-x"), ("+x", "+z", "+y"),
         ("+x", "-z", "-y"), ("+x", "-y", "+z"), ("-x", "-y", "-z")]
    ):  # fmt: skip
        for name, vector in zip((axis, sc, tc), FACES[face], strict=True):
            expected = [0, 0, 0]
            expected["xyz".index(name[1])] = 1 if name[0] == "+" else -1
            assert list(vector) == expected
    d = cube_directions(4, 3)
    assert d.shape == (6, 4, 4, 9, 3)
    # the first level shows what lies there
    where = LatLong((128, 64)).directions().astype(np.float32) + 1
    found = prefilter_cube(where, 16, 2).levels[0]
    np.testing.assert_allclose(found - 1, cube_directions(16)[..., 0, :], atol=0.03)


@pytest.mark.parametrize(("row", "column"), [(5, 3), (11, 9), (15, 15)])
def test_table_against_quadrature(row: int, column: int) -> None:
    from scipy.integrate import dblquad

    alpha, nv = ((row + 0.5) / 16) ** 2, (column + 0.5) / 16
    view = np.array([math.sqrt(1 - nv**2), 0, nv])

    def integrand(z: float, phi: float, fresnel: bool) -> float:
        r = math.sqrt(1 - z * z)
        light = np.array([r * math.cos(phi), r * math.sin(phi), z])
        h = (view + light) / np.linalg.norm(view + light)
        d = alpha**2 / (math.pi * (h[2] ** 2 * (alpha**2 - 1) + 1) ** 2)
        lv = z * math.sqrt(nv**2 * (1 - alpha**2) + alpha**2)
        ll = nv * math.sqrt(z**2 * (1 - alpha**2) + alpha**2)
        fc = (1 - float(view @ h)) ** 5
        return (fc if fresnel else 1 - fc) * d / (2 * (lv + ll)) * z

    for k in (0, 1):
        value = dblquad(
            integrand, 0, math.pi, 1e-9, 1, args=(bool(k),), epsabs=1e-4, epsrel=1e-4
        )[0]
        assert brdf_table(16)[row, column, k] == pytest.approx(2 * value, abs=3e-3)


def test_error_is_told() -> None:
    """Straight on the levels are the integral itself; an even world is exact at any angle."""
    errors = split_sum_error(a_map(64), [0.5, 1.0], [0.0, 60.0], count=8)
    assert [(e.roughness, e.angle) for e in errors] == [(0.5, 0), (0.5, 60), (1, 0), (1, 60)]
    assert all(max(e.error) < 0.02 for e in errors if e.angle == 0)
    assert all(min(e.error) > 0.05 for e in errors if e.angle == 60)
    for even in split_sum_error(np.ones((64, 128, 3), np.float32), [0.5, 1.0], [0.0, 60.0], 8):
        assert max(even.error) < 0.01


@pytest.mark.parametrize("top", [100.0, 1e6])
def test_ktx2(tmp_path: Path, top: float) -> None:
    """Read back with a reader written from the specification alone."""
    rng = np.random.default_rng(0)
    levels = [rng.random((6, n, n, 3)).astype(np.float32) for n in (8, 4, 2, 1)]
    levels[0][3, 2, 1] = top
    kind = write_ktx2(tmp_path / "a.ktx2", levels)
    data = (tmp_path / "a.ktx2").read_bytes()
    assert data[:12] == b"\xabKTX 20\xbb\r\n\x1a\n"
    form, size, width, height, depth, layers, faces, count, scheme = struct.unpack_from(
        "<9I", data, 12
    )
    assert (width, height, depth, layers, faces, count, scheme) == (8, 8, 0, 0, 6, 4, 0)
    assert (kind, form, size) == (("float16", 97, 2) if top < 65504 else ("float32", 109, 4))
    end = 0
    for i, level in reversed(list(enumerate(levels))):
        offset, length, whole = struct.unpack_from("<3Q", data, 80 + 24 * i)
        assert length == whole
        assert offset >= end
        assert offset % (4 * size) == 0
        end = offset + length
        texels = np.frombuffer(data, f"<f{size}", length // size, offset)
        texels = texels.reshape(6, 8 >> i, 8 >> i, 4)
        np.testing.assert_allclose(texels[..., :3], level, rtol=1e-3, atol=1e-6)
        assert (texels[..., 3] == 1).all()
    assert end == len(data)
    descriptor, length = struct.unpack_from("<2I", data, 48)
    assert struct.unpack_from("<I", data, descriptor)[0] == length == 4 + 24 + 4 * 16
    model, primaries, transfer, flags = data[descriptor + 12 : descriptor + 16]
    assert (model, primaries, transfer, flags) == (1, 1, 1, 0)


def run(*arguments: object) -> None:
    build_app()([str(a) for a in arguments], result_action="return_value")


def test_commands(tmp_path: Path) -> None:
    env = tmp_path / "env.exr"
    write_exr(env, a_map(32))
    run("envmap", "harmonics", env, "--map", tmp_path / "e.exr", "-o", tmp_path / "h.json")
    value = read_json(tmp_path / "h.json")
    assert np.array(value["irradiance"]).shape == (9, 3)
    figures = read_json(tmp_path / "h.json.record.json")["figures"]
    assert 0 < figures["irradiance_error"] < 0.3
    assert (tmp_path / "e.exr.record.json").is_file()
    run(
        *("envmap", "prefilter", env, "--size", 16, "--levels", 3, "-o", tmp_path / "g.exr"),
        *("-o", tmp_path / "g.ktx2", "--table", tmp_path / "brdf.exr"),
    )
    file = oiio.ImageInput.open(str(tmp_path / "g.exr"))
    assert file is not None
    sizes = []
    while file.seek_subimage(0, len(sizes)):
        sizes.append((file.spec().width, file.spec().height))
    assert sizes == [(32, 16), (16, 8), (8, 4), (4, 2), (2, 1), (1, 1)]  # the last are averages
    file.close()
    figures = read_json(tmp_path / "g.ktx2.record.json")["figures"]
    assert figures["roughness"] == [0, 0.5, 1]
    assert len(figures["split_sum_error"]) == 6
    for arguments, message in (
        (["--size", 15, "-o", "x.exr"], "halved"),
        (["-o", "x.dds"], "ktx2"),
        (["--levels", 1, "-o", "x.exr"], "2 levels"),
    ):
        with pytest.raises(UserError, match=message):
            run("envmap", "prefilter", env, *arguments)
    write_exr(tmp_path / "black.exr", np.zeros((8, 16, 3)))
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3)))
    for name, message in (("black.exr", "black"), ("square.exr", "2:1")):
        for command in ("harmonics", "prefilter"):
            with pytest.raises(UserError, match=message):
                run("envmap", command, tmp_path / name, "-o", tmp_path / "x.exr")
