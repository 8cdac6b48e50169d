"""Pictures: what is written is read back, what is damaged is refused in one line."""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.scene.errors import UserError
from chromeball.scene.image import (
    Exposure,
    read_exposure,
    read_header,
    read_image,
    read_rgb,
    read_size,
    to_display,
    write_exr,
    write_picture,
)

DNG = Path(__file__).parents[2].parent / "shared/data/hdr/raw/colorchart.dng"
WIDTH, HEIGHT = 37, 23
EXPOSURE = Exposure(time=1 / 60, aperture=2.8, iso=400.0, camera="Maker 5", lens="8 mm")


def radiance(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)


def codes(dtype: type = np.uint8) -> np.ndarray:
    top = np.iinfo(dtype).max
    shape = (HEIGHT, WIDTH, 3)
    return np.random.default_rng(1).integers(0, top, shape, dtype, endpoint=True)


def write_any(path: Path, pixels: np.ndarray, tile: int = 0, **attributes: Any) -> None:
    """Through OpenImageIO alone: formats that we read and do not write."""
    import OpenImageIO as oiio

    kind = {"float32": "float", "float16": "half"}.get(str(pixels.dtype), str(pixels.dtype))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    if tile:
        spec.tile_width = spec.tile_height = tile
    for name, value in attributes.items():
        spec.attribute(name, value)
    target = oiio.ImageOutput.create(str(path))
    assert target is not None
    assert target.open(str(path), spec)
    assert target.write_image(np.ascontiguousarray(pixels))
    assert target.close()


def every_format(folder: Path) -> dict[str, Path]:
    """One file of each kind that `read_image` takes, RAW left out."""
    write_exr(folder / "zip.exr", radiance(), attributes={"origin": [1.0, 2.0, 3.0]})
    write_any(folder / "piz.exr", radiance().astype(np.float16), compression="piz")
    write_any(folder / "plain.exr", radiance(), compression="none")
    write_any(folder / "tiled.exr", radiance(), tile=16, compression="zip")
    write_any(folder / "float.hdr", radiance())
    write_any(folder / "lzw.tif", codes(), compression="lzw")
    write_any(folder / "float.tif", radiance())
    write_any(folder / "progressive.jpg", codes(), **{"jpeg:progressive": 1})
    write_picture(folder / "8.png", codes(), exposure=EXPOSURE)
    write_picture(folder / "16.png", codes(np.uint16))
    write_picture(folder / "8.tif", codes(), exposure=EXPOSURE)
    write_picture(folder / "16.tif", codes(np.uint16))
    write_picture(folder / "8.jpg", codes(), exposure=EXPOSURE)
    return {path.name: path for path in sorted(folder.iterdir())}


def test_every_format_is_read_as_it_was_stored(tmp_path: Path) -> None:
    files = every_format(tmp_path)
    for name, path in files.items():
        image = read_image(path)
        assert image.size == (WIDTH, HEIGHT) == read_size(path), name
        assert image.channels == ("R", "G", "B") == read_header(path).channels
        assert image.linear == (path.suffix in {".exr", ".hdr"} or "float" in name), name
        if name in {"zip.exr", "plain.exr", "tiled.exr", "float.tif"}:
            np.testing.assert_array_equal(image.pixels, radiance())
        elif name == "piz.exr":
            np.testing.assert_array_equal(image.pixels, radiance().astype(np.float16))
            assert image.pixels.dtype == np.float32
        elif name == "float.hdr":  # shared exponent: 1/256 of the largest channel
            error = np.abs(image.pixels - radiance()).max(axis=2)
            assert (error <= radiance().max(axis=2) / 128).all()
        elif path.suffix == ".jpg":
            assert image.pixels.dtype == np.uint8
        else:
            wanted = codes(np.uint16 if name.startswith("16") else np.uint8)
            np.testing.assert_array_equal(image.pixels, wanted)
            assert image.pixels.dtype == wanted.dtype


def test_a_smooth_jpeg_is_close(tmp_path: Path) -> None:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    smooth = np.stack([x * 5, y * 8, 200 - x], axis=-1).astype(np.uint8)
    write_picture(tmp_path / "a.jpg", smooth)
    read = read_image(tmp_path / "a.jpg").pixels.astype(int)
    assert np.abs(read - smooth).mean() < 2


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
def test_exposure_metadata_is_found_again(tmp_path: Path, name: str) -> None:
    write_picture(tmp_path / name, codes(), exposure=EXPOSURE)
    for found in (read_exposure(tmp_path / name), read_image(tmp_path / name).exposure):
        assert found.time == pytest.approx(1 / 60, rel=1e-4)
        assert found.aperture == pytest.approx(2.8, rel=1e-4)
        if not name.endswith(".tif"):  # OpenImageIO 3.2 does not write it there
            assert found.iso == 400
        assert (found.camera, found.lens) == ("Maker 5", "8 mm")
    write_picture(tmp_path / name, codes())
    assert read_exposure(tmp_path / name) == Exposure()


def test_exr_attributes_are_found_again(tmp_path: Path) -> None:
    given = {"origin": np.array([1.0, -2.5, 3.0]), "note": "a word", "count": 3, "scale": 0.5}
    write_exr(tmp_path / "a.exr", radiance(), attributes=given)
    found = read_header(tmp_path / "a.exr").attributes
    assert found["note"] == "a word"
    assert found["count"] == 3
    assert found["scale"] == 0.5
    assert tuple(found["origin"]) == (1.0, -2.5, 3.0)
    assert np.allclose(found["chromaticities"][:2], (0.64, 0.33))


def test_extra_channels_and_infinite_depth_survive(tmp_path: Path) -> None:
    pixels = np.concatenate([radiance(), radiance(3)[..., :1]], axis=2)
    pixels[2, 3, 3] = np.inf
    write_exr(tmp_path / "a.exr", pixels, channels=("R", "G", "B", "Z"))
    image = read_image(tmp_path / "a.exr")
    assert image.channels == ("R", "G", "B", "Z")
    np.testing.assert_array_equal(image.pixels, pixels)
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), pixels[..., :3])
    with pytest.raises(ValueError, match="4 channels of pixels, 3 names"):
        write_exr(tmp_path / "b.exr", pixels)


def test_grey_is_repeated_and_codes_are_not_radiance(tmp_path: Path) -> None:
    write_exr(tmp_path / "g.exr", radiance()[..., 0], channels=("Y",))
    grey = read_rgb(tmp_path / "g.exr")
    np.testing.assert_array_equal(grey, np.repeat(radiance()[..., :1], 3, axis=2))
    write_picture(tmp_path / "a.png", codes())
    with pytest.raises(UserError, match="not a scene-linear picture"):
        read_rgb(tmp_path / "a.png")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1e-6])
def test_pixels_that_are_no_radiance_are_named(tmp_path: Path, value: float) -> None:
    pixels = radiance()
    pixels[4, 5, 1] = pixels[4, 5, 2] = pixels[6, 7, 0] = value
    write_exr(tmp_path / "a.exr", pixels)
    with pytest.raises(UserError, match=r"2 pixels are NaN, .* the first at x 5, y 4"):
        read_rgb(tmp_path / "a.exr")


@pytest.mark.parametrize("name", sorted(["zip.exr", "piz.exr", "plain.exr", "tiled.exr",
    "float.hdr", "lzw.tif", "float.tif", "progressive.jpg", "8.png", "16.png", "8.tif",
    "16.tif", "8.jpg"]))  # fmt: skip
def test_a_truncation_anywhere_is_found(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = every_format(tmp_path)[name]
    whole, pixels = path.read_bytes(), read_image(path).pixels
    lengths = {*np.linspace(0, len(whole) - 1, 60).astype(int).tolist(), len(whole) - 2}
    for length in lengths:
        path.write_bytes(whole[:length])
        message = None
        try:
            cut = read_image(path)
        except UserError as error:
            message = str(error)
        else:  # a TIFF may end in a superseded directory that nothing points to
            assert path.suffix == ".tif", length
            np.testing.assert_array_equal(cut.pixels, pixels)
        assert message is None or ("\n" not in message and message.startswith(f"{path}: "))
    assert capfd.readouterr() == ("", "")


def test_a_damaged_png_is_found_before_libpng_complains(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_picture(tmp_path / "a.png", codes())
    whole = (tmp_path / "a.png").read_bytes()
    at = whole.index(b"IDAT") + 200
    (tmp_path / "a.png").write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(UserError, match="the PNG is not whole"):
        read_image(tmp_path / "a.png")
    assert capfd.readouterr().err == ""
    # trailing bytes after the end are none of our business
    (tmp_path / "a.png").write_bytes(whole + b"appended by a camera")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png").pixels, codes())
    assert zlib.crc32(b"IEND") == int.from_bytes(whole[-4:])


@settings(deadline=None, max_examples=200)
@given(st.sampled_from(["zip.exr", "tiled.exr", "float.hdr", "8.tif", "8.jpg"]), st.data())
def test_any_bytes_give_a_picture_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp() / "fuzzed pictures"
    if not folder.exists():
        folder.mkdir()
        every_format(folder)
    damaged = bytearray((folder / name).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(
            st.integers(0, min(len(damaged), data.draw(st.sampled_from([400, 10**6]))) - 1)
        )
        damaged[at] = data.draw(st.integers(0, 255))
    path = folder / f"damaged{Path(name).suffix}"
    path.write_bytes(damaged)
    for read in (read_image, read_header):
        message = None
        try:
            read(path)
        except UserError as error:
            message = str(error)
        if message is not None:
            assert "\n" not in message
            assert message.startswith(str(path))


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    for read in (read_image, read_header, read_size, read_exposure):
        with pytest.raises(UserError, match=r"none\.exr: no such picture"):
            read(tmp_path / "none.exr")
        (tmp_path / "text.png").write_text("not a picture")
        with pytest.raises(UserError, match=r"text\.png: "):
            read(tmp_path / "text.png")
        with pytest.raises(UserError, match="no such picture"):
            read(tmp_path)


def test_names_without_a_format_are_refused_and_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no picture format for this name"):
        write_picture(tmp_path / "a.nonsense", codes())
    assert list(tmp_path.iterdir()) == []


def test_display_encoding() -> None:
    linear = np.array([[[0, 0.0031308, 0.18], [1.0, 2.0, -1.0]]])
    assert to_display(linear).tolist() == [[[0, 10, 118], [255, 255, 0]]]
    assert to_display(linear, 0.5).tolist()[0][1] == [188, 255, 0]


def test_a_real_raw_picture_and_its_truncation(tmp_path: Path) -> None:
    if not DNG.exists():
        pytest.skip(f"no data at {DNG}")
    image = read_image(DNG)
    assert image.linear
    assert image.pixels.dtype == np.float32
    assert image.saturated is not None
    assert not image.saturated.any()
    assert image.size == read_size(DNG) == (1734, 1156)
    assert image.exposure.camera == "Canon EOS Kiss X4"
    assert image.exposure.time is None  # its EXIF says 0: unknown, not LibRaw's 1 s
    assert 0.02 < image.pixels.mean() < 0.6
    assert (image.pixels < 0).any()  # noise about black
    assert (read_rgb(DNG) >= 0).all()
    whole = DNG.read_bytes()
    for length in (0, 100, len(whole) // 2, len(whole) - 1000):
        (tmp_path / "t.dng").write_bytes(whole[:length])
        with pytest.raises(UserError, match="truncated or damaged RAW picture") as caught:
            read_image(tmp_path / "t.dng")
        assert "\n" not in str(caught.value)
