"""A bracket's frames, their one scale, filters, and RAW."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from chromeball.bench.dng import Sensor, write_bracket, write_dng
from chromeball.hdr.bracket import mosaics, pictures, read_bracket
from chromeball.scene.errors import UserError
from chromeball.scene.image import Exposure, write_picture

TIMES = (1 / 100, 1 / 25, 1 / 6)


def quiet(message: str) -> None:
    assert "\n" not in message


def photograph(path: Path, time: float, aperture: float | None, iso: float | None) -> Path:
    exposure = Exposure(time=time, aperture=aperture, iso=iso)
    write_picture(path, np.zeros((8, 8, 3), np.uint8), exposure=exposure)
    return path


def test_brackets_with_other_settings_share_a_scale(tmp_path: Path) -> None:
    a = photograph(tmp_path / "a.jpg", 1 / 8, 4.0, 100.0)
    b = photograph(tmp_path / "b.jpg", 1 / 8, 8.0, 400.0)
    bracket = read_bracket([a, b])
    assert bracket.scale == "time * ISO/100 / N^2"
    np.testing.assert_allclose(bracket.exposures, [1 / 8 / 16, 1 / 8 / 16], rtol=1e-4)
    filtered = read_bracket([a, b], nd=[0.0, 3.0])
    assert filtered.scale == "time * ISO/100 / N^2"
    np.testing.assert_allclose(filtered.exposures, [1 / 128, 1 / 1024], rtol=1e-4)
    timed = read_bracket([a, b], [1.0, 2.0], [1.0])
    np.testing.assert_allclose(timed.exposures, [1 / 32, 1 / 16], rtol=1e-4)
    with pytest.raises(UserError, match="3 ND filters for 2 pictures"):
        read_bracket([a, b], nd=[1.0, 2.0, 3.0])


def test_half_known_settings_are_named(tmp_path: Path) -> None:
    a = photograph(tmp_path / "a.jpg", 1 / 8, 4.0, 100.0)
    b = photograph(tmp_path / "b.jpg", 1 / 8, 8.0, None)
    with pytest.raises(UserError, match=r"b\.jpg: the bracket changes its aperture"):
        read_bracket([a, b])
    c = photograph(tmp_path / "c.jpg", 1 / 4, 4.0, None)
    assert read_bracket([a, c]).scale == "time"


def test_raw_brackets_as_mosaics_and_as_pictures(tmp_path: Path) -> None:
    y, x = np.mgrid[0:64, 0:96] / 96
    radiance = np.stack([0.3 + 8 * x, 0.5 + 12 * y, 1 + x * y], axis=2)
    sensor = Sensor(pattern="GBRG")
    paths = write_bracket(tmp_path, radiance, TIMES, sensor)
    bracket = read_bracket(paths)
    assert bracket.raw
    assert bracket.notes == ()
    np.testing.assert_allclose(bracket.exposures, np.array(TIMES) / 16, rtol=1e-4)
    shot = list(mosaics(bracket, quiet))
    for mosaic, time in zip(shot, TIMES, strict=True):
        wanted = sensor.mosaic(radiance) * time
        clear = wanted < 0.95
        error = (mosaic.linear() - wanted)[clear]
        assert abs(error.mean()) < 1e-4
    seen = list(pictures(bracket, quiet))
    for mosaic, picture in zip(shot, seen, strict=True):
        assert picture.linear
        assert picture.white is not None
        assert (picture.pixels >= 0).all()
        full = picture.pixels >= 0.99 * picture.white
        assert (full.any(axis=2) >= mosaic.saturated()).all()
        assert full.any() == mosaic.saturated().any()
    assert seen[-1].pixels.max() == np.float32(seen[-1].white or 0)


def test_raw_brackets_of_two_cameras_are_refused(tmp_path: Path) -> None:
    codes = np.full((64, 64), 900, np.uint16)
    write_dng(tmp_path / "a.dng", codes, Sensor(), time=1.0)
    write_dng(tmp_path / "b.dng", codes, Sensor(pattern="BGGR"), time=2.0)
    write_dng(tmp_path / "c.dng", codes[:60], Sensor(), time=2.0)
    for other, message in (("b", "colour pattern"), ("c", "size")):
        bracket = read_bracket([tmp_path / "a.dng", tmp_path / f"{other}.dng"])
        with pytest.raises(UserError, match=message):
            list(mosaics(bracket, quiet))
