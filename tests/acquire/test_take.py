"""The contract of take.json and the importer, good and bad."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chromeball.acquire.files import import_take, open_frames, photographs
from chromeball.acquire.take import Settle, TakeFrame, encode_take, parse_take, read_take
from chromeball.scene.errors import UserError
from chromeball.scene.image import Exposure, write_picture

LUMILAB = Path(__file__).parents[2].parent / "shared/data/hdr/fisheye_lumilab/JPEG"


def picture(
    path: Path, time: float | None, size: tuple[int, int] = (8, 6), **more: Any
) -> Path:
    pixels = np.full((size[1], size[0], 3), 90, np.uint8)
    write_picture(path, pixels, exposure=Exposure(time=time, **more))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, time in (("a.jpg", 0.5), ("b.jpg", 1 / 30), ("c.jpg", 1 / 4)):
        (tmp_path / "shots").mkdir(exist_ok=True)
        picture(tmp_path / "shots" / name, time, aperture=5.6, iso=100.0, camera="X100")
    return tmp_path / "shots"


def test_import_reads_the_metadata_and_sorts_by_time(folder: Path, tmp_path: Path):
    take = import_take([folder], tmp_path / "takes/plate")
    assert [p.name for p in take.paths] == ["b.jpg", "c.jpg", "a.jpg"]
    assert take.times == pytest.approx([1 / 30, 1 / 4, 1 / 2], rel=1e-3)
    assert take.size == (8, 6)
    assert take.frames[0].row.aperture == pytest.approx(5.6)
    assert take.frames[0].row.iso == 100
    assert take.frames[0].row.device == "X100"
    stored = json.loads((tmp_path / "takes/plate/take.json").read_text())
    assert stored["frames"][0]["file"] == "../../shots/b.jpg"
    record = json.loads((tmp_path / "takes/plate/take.json.record.json").read_text())
    assert record["figures"]["frames"] == 3
    assert len(record["inputs"]) == 3


def test_a_take_survives_its_folder_being_moved(folder: Path, tmp_path: Path):
    import_take([folder], folder)
    moved = folder.rename(tmp_path / "elsewhere")
    assert read_take(moved).paths[0] == moved / "b.jpg"


def test_given_times_win_over_metadata(folder: Path):
    take = open_frames([folder / "a.jpg", folder / "b.jpg"], [0.1, 0.2])
    assert take.times == [0.1, 0.2]
    assert take.frames[0].row.requested_time == 0.1
    assert take.frames[0].row.read_back_time is None


def test_a_take_is_opened_by_folder_and_by_file(folder: Path, tmp_path: Path):
    import_take([folder], tmp_path / "t")
    for source in (tmp_path / "t", tmp_path / "t/take.json"):
        assert len(open_frames([source]).frames) == 3
        with pytest.raises(UserError, match="leave --times out"):
            open_frames([source], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("make", "times", "message"),
    [
        (lambda d: [d / "a.jpg", d / "none.jpg"], [], "no such picture"),
        (lambda d: [d / "a.jpg", picture(d / "p.png", None)], [], "p.png: no exposure time"),
        (lambda d: [d / "a.jpg", picture(d / "p.png", 1.0, (9, 6))], [], "9x6 pixels"),
        (
            lambda d: [d / "a.jpg", picture(d / "p.png", 0.5)],
            [],
            "all 2 exposure times are 0.5",
        ),
        (lambda d: [d / "a.jpg", d / "b.jpg"], [1.0], "2 pictures, but 1 exposure times"),
        (lambda d: [d / "a.jpg", d / "b.jpg"], [1.0, 1.0], "all 2 exposure times"),
        (lambda d: [d / "a.jpg"], [], "at least two"),
        (lambda d: [d / "a.jpg", d / "a.jpg"], [], "given twice"),
        (lambda d: [d / "a.jpg", picture(d / "p.jpg", 1.0, iso=200.0)], [], "iso 200"),
        (lambda d: [d / "a.jpg", d.parent], [], "no pictures in this folder"),
    ],
)
def test_bad_photographs_are_named(
    folder: Path, tmp_path: Path, make: Any, times: list[float], message: str
):
    with pytest.raises(UserError, match=message):
        import_take(make(folder), tmp_path / "t", times)
    assert not (tmp_path / "t").exists()


def test_a_file_that_is_no_picture(folder: Path):
    (folder / "x.png").write_bytes(b"not a picture")
    with pytest.raises(UserError, match=r"x\.png: not a readable picture"):
        photographs([folder])


def good() -> dict[str, Any]:
    rows = [TakeFrame(file=f"{i}.png", requested_time=t) for i, t in enumerate((0.1, 0.2))]
    return json.loads(encode_take(rows, (4, 3)))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("frames", 0, "requested_time"), "0.1", "requested_time"),
        (("frames", 0, "requested_time"), -1, r"> 0"),
        (("frames", 0, "requested_time"), None, "0.png has no exposure time"),
        (("frames", 0, "shutter"), 1, "unknown field `shutter`"),
        (("frames", 1, "file"), "./0.png", "listed twice"),
        (("frames",), [], "length >= 1"),
        (("size",), [4], "length 2"),
        (("version",), 2, "Invalid enum value 2"),
    ],
)
def test_a_broken_take_is_explained(path: tuple[Any, ...], value: Any, message: str):
    content: Any = good()
    where = content
    for key in path[:-1]:
        where = where[key]
    where[path[-1]] = value
    with pytest.raises(UserError, match=message):
        parse_take(json.dumps(content).encode())


def test_a_missing_picture_or_take_is_named(tmp_path: Path):
    with pytest.raises(UserError, match="no such take"):
        read_take(tmp_path)
    (tmp_path / "take.json").write_text(json.dumps(good()))
    with pytest.raises(UserError, match=r"the picture 0\.png is missing"):
        read_take(tmp_path)


def test_a_plateau_counts_with_its_measured_time():
    row = TakeFrame(file="a", requested_time=1 / 50, read_back_time=1 / 50, measured_time=0.03)
    assert row.time == 1 / 50
    flagged = TakeFrame(
        file="a",
        read_back_time=1 / 50,
        measured_time=0.03,
        settle=Settle(verdict="plateau", frames_waited=9, ratio=1.5, method="response"),
    )
    assert flagged.time == 0.03


@given(st.binary(max_size=200))
def test_any_bytes_give_a_take_or_one_clear_error(data: bytes):
    with pytest.raises(UserError):
        parse_take(data)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
)


@given(JSON, st.sampled_from(["frames", "size", "version", "device"]), st.booleans())
def test_any_json_in_any_place_gives_a_take_or_one_clear_error(
    value: Any, key: str, in_frame: bool
):
    content = good()
    if in_frame:
        content["frames"][0][{"frames": "file", "size": "settle"}.get(key, "gain")] = value
    else:
        content[key] = value
    try:
        take = parse_take(json.dumps(content).encode())
    except UserError:
        return
    assert len(take.frames) == len(take.times) >= 1


def test_deep_nesting_is_no_crash():
    with pytest.raises(UserError, match=r"not valid JSON|unknown field"):
        parse_take(b'{"x":' + b"[" * 100_000)


@pytest.mark.skipif(not LUMILAB.is_dir(), reason="the shared data is not here")
def test_a_real_bracket():
    take = photographs([LUMILAB])
    assert len(take.frames) == 18
    assert take.size == (5616, 3744)
    assert take.times[0] == pytest.approx(1 / 8000)
    assert take.times[-1] == 13
