"""Cameras by metadata: real pictures of known focal length, and metadata that contradict."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chromeball.calibrate.exif_camera import FORMATS, MODELS, camera_from_exif, from_attributes
from chromeball.cli.main import build_app
from chromeball.scene.camera import CameraModel
from chromeball.scene.errors import UserError
from chromeball.scene.record import read_json

DATA = Path(__file__).resolve().parents[3] / "shared/data"
SCEAUX = DATA / "stand_in/sceaux/images/100_7100.JPG"
PANORAMA = DATA / "envmap/pano25/P1060369.JPG"
BODY: dict[str, Any] = {"Model": "Canon EOS 5D Mark II", "Exif:FocalLength": 50.0}


def test_known_body() -> None:
    found = from_attributes(BODY, (5616, 3744))
    assert found.camera.intrinsics[0] == pytest.approx(50 / 36 * 5616)
    np.testing.assert_allclose(found.camera.intrinsics[2:], [2807.5, 1871.5])
    # marking 2 %, focus 3 % over sqrt 3, rounding 0.6 %, sensor 1 %
    expected = math.hypot(0.02, 50 / 950 / math.sqrt(3), 1 / math.sqrt(12) / 50, 0.01)
    assert found.focal_error == pytest.approx(expected, rel=1e-6)
    assert found.notes == ()


def test_typed_numbers_are_no_better_than_marked_ones() -> None:
    """A focal length is engraved to 2 %, whoever reads it; a sensor's width is nominal."""
    read = from_attributes(BODY, (5616, 3744))
    for sensor in (None, "36"):
        typed = from_attributes({"Model": BODY["Model"]}, (5616, 3744), sensor, 50.0)
        assert typed.camera.intrinsics[0] == pytest.approx(read.camera.intrinsics[0])
        assert typed.focal_error == pytest.approx(read.focal_error)
    other = from_attributes(BODY, (5616, 3744), focal=35.0)
    assert other.notes == ("its metadata tell 50 mm: --focal 35 goes before them",)
    assert from_attributes(BODY, (5616, 3744), focal=50.4).notes == ()


def test_smaller_and_turned_pictures_see_the_same() -> None:
    whole = from_attributes(BODY, (5616, 3744))
    small = from_attributes(BODY, (1404, 936))
    upright = from_attributes(BODY, (936, 1404))
    assert small.fov == pytest.approx(whole.fov)
    assert upright.camera.intrinsics[0] == pytest.approx(small.camera.intrinsics[0])


def test_crops_are_told() -> None:
    found = from_attributes(BODY, (1600, 900))
    assert any("it was cropped" in note for note in found.notes)
    assert found.focal_error > 0.04
    assert found.centre_error == pytest.approx(160)


def test_ways_that_contradict() -> None:
    odd = BODY | {"Exif:FocalLengthIn35mmFilm": 80}
    found = from_attributes(odd, (5616, 3744))
    assert any("one is wrong" in note for note in found.notes)
    assert found.focal_error > 0.4
    resized = BODY | {"Exif:FocalPlaneXResolution": 3849.2, "Exif:PixelXDimension": 100}
    assert any("not used" in n for n in from_attributes(resized, (100, 67)).notes)


def test_focal_plane_resolution_and_zoom() -> None:
    attributes = {
        "Model": "Nameless 1",
        "Exif:FocalLength": 50.0,
        "Exif:FocalPlaneXResolution": 100.0,
        "Exif:FocalPlaneResolutionUnit": 4,
        "Exif:PixelXDimension": 3000,
        "Exif:PixelYDimension": 2000,
    }
    found = from_attributes(attributes, (1500, 1000))
    assert found.camera.intrinsics[0] == pytest.approx(50 / 30 * 1500)
    zoomed = from_attributes(attributes | {"Exif:DigitalZoomRatio": 2.0}, (1500, 1000))
    assert zoomed.camera.intrinsics[0] == pytest.approx(2 * 50 / 30 * 1500)


@pytest.mark.parametrize(
    ("change", "words", "message"),
    [
        ({"Exif:FocalLength": 8.0}, {}, "fisheye's"),
        ({"Exif:LensModel": "AF DX Fisheye 10.5mm"}, {}, "lens is a fisheye"),
        ({"Exif:FocalLength": 0.0}, {}, "no focal length"),
        ({"Model": "Nameless"}, {}, "not the sensor: give --sensor, one of medium"),
        ({}, {"sensor": "huge"}, "a width in mm, or one of"),
        ({}, {"sensor": "900"}, "no sensor is 900 mm wide"),
        ({}, {"focal": -1.0}, "--focal says -1 mm: no lens has that"),
        ({}, {"focal": 50000.0}, "no lens has that, the longest is one of 5200 mm"),
        ({"Exif:FocalLength": 50000.0}, {}, "its metadata tell 50000 mm: no lens has that"),
    ],
)
def test_refusals(change: dict[str, Any], words: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        from_attributes(BODY | change, (5616, 3744), **words)


def test_every_family_has_a_format() -> None:
    assert {name for _, name in MODELS} <= set(FORMATS)
    for model, width in (
        ("Canon EOS 550D", 22.3),
        ("Canon EOS REBEL T2i", 22.3),
        ("Canon EOS 6D", 36.0),
        ("NIKON D850", 36.0),
        ("NIKON D7000", 23.5),
        ("NIKON D90", 23.5),
        ("ILCE-7M3", 36.0),
        ("ILCE-6400", 23.5),
        ("DMC-GH5", 17.3),
    ):
        found = from_attributes({"Model": model, "FocalLength": 50.0}, (3000, 2000))
        assert found.camera.intrinsics[0] == pytest.approx(50 / width * 3000), model


@pytest.mark.skipif(not SCEAUX.is_file(), reason="the photographs are not here")
@pytest.mark.parametrize("sensor", [None, "1/2.5in"])
def test_a_real_picture(sensor: str | None) -> None:
    """Sceaux castle, calibrated by others: 2905.88 px."""
    found = camera_from_exif(SCEAUX, sensor)
    off = math.log(found.camera.intrinsics[0] / 2905.88)
    assert abs(off) < 2 * found.focal_error < 0.09


@pytest.mark.skipif(not PANORAMA.is_file(), reason="the photographs are not here")
@pytest.mark.parametrize("sensor", [None, "1/2.3in"])
def test_a_picture_of_a_panorama(sensor: str | None) -> None:
    """`envmap stitch` on the first eight of pano25: 972 px (its frames moved a little)."""
    found = camera_from_exif(PANORAMA, sensor)
    for clue in found.clues:
        assert abs(math.log(clue.focal / 972)) < 2 * clue.error < 0.12


@pytest.mark.skipif(not SCEAUX.is_file(), reason="the photographs are not here")
def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "sceaux.cameramodel"
    words = ["calibrate", "exif", SCEAUX, "--sensor", "1/2.5in", "-o", output]
    build_app()([str(w) for w in words], result_action="return_value")
    assert "by 35 mm at 36 x 24 mm" in capsys.readouterr().out
    assert CameraModel.read(output).size == (2832, 2128)
    figures = read_json(f"{output}.record.json")["figures"]
    assert len(figures["clues"]) == 2
    assert 1 < figures["sigma_focal_percent"] < 4
    with pytest.raises(UserError, match=r"ends in \.cameramodel"):
        build_app()(
            ["calibrate", "exif", str(SCEAUX), "-o", "a.txt"], result_action="return_value"
        )
