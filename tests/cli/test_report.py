"""The report: whole, self-contained, escaped, and nothing invented."""

from __future__ import annotations

import base64
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from chromeball.cli.report.figures import Row, show, sort_figures, summary
from chromeball.cli.report.page import seconds, write_report
from chromeball.cli.report.picture import WIDTH, data_uri
from chromeball.scene.errors import UserError
from tests.cli.records import plot, record_all, record_truth
from tests.cli.scenes import FULL, photograph

VOID = {"meta", "img", "br", "link", "hr", "input"}


class Page(HTMLParser):
    """Checks that tags nest; collects sources, links, anchors and text."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text += data


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "scene.toml").write_text(FULL)
    photograph(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """FULL with every record, made once."""
    place = tmp_path_factory.mktemp("recorded")
    (place / "scene.toml").write_text(FULL)
    photograph(place)
    record_all(place)
    return place


@pytest.fixture
def recorded(once: Path, tmp_path: Path) -> Path:
    """A copy of FULL with every record."""
    return shutil.copytree(once, tmp_path / "copy")


def page(root: Path) -> tuple[Page, str, str]:
    verdict = write_report(root / "scene.toml", root / "report.html")
    text = (root / "report.html").read_text()
    return Page(text), text, verdict


ERRORS: list[dict[str, Any]] = [
    {"stage": "response", "what": "RMS", "value": 1.2, "unit": "%", "bound": 3.0},
    {"stage": "camera", "what": "place", "value": 29.0, "unit": "mm", "bound": 30.0},
]


def test_a_whole_scene(recorded: Path) -> None:
    found, _, verdict = page(recorded)
    assert verdict == "all 16 stages are recorded"
    assert "full" in found.text
    assert "No record" not in found.text
    # one section a stage, in the order of the pipeline
    names = [value for name, value in found.attributes if name == "id"]
    order = ["take-front", "hdr-response", "hdr-merge-plate", "calibrate-lens", "envmap-align"]
    order += ["envmap-probe", "stand-in-build", "render-main", "render-wide"]
    assert [name for name in names if name in order] == order
    assert "calibrate-pose-wide" not in names
    assert "no photograph behind the view" in found.text
    links = [value[1:] for name, value in found.attributes if name == "href"]
    assert set(links) <= set(names)
    assert len(links) == 16


def test_it_is_self_contained(recorded: Path) -> None:
    record_truth(recorded, ERRORS)
    found, text, _ = page(recorded)
    assert not re.search(r"https?:|//[a-z]|@import|url\(|<script|javascript:", text, re.I)
    sources = [value for name, value in found.attributes if name == "src"]
    # two composites, the truth's picture, response, residuals and environment plots
    assert len(sources) == 6
    for source in sources:
        kind, data = source.split(",", 1)
        assert kind in ("data:image/png;base64", "data:image/jpeg;base64")
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), 1)
        assert pixels is not None
        assert pixels.shape[1] <= WIDTH


def test_figures_have_units_and_long_ones_are_folded(recorded: Path) -> None:
    found, _, _ = page(recorded)
    text = re.sub(r"\s+", " ", found.text)
    assert "rms0.183px" in text.replace(" ", "")
    assert "range17.3stops" in text.replace(" ", "")
    assert "views (9 rows)" in text
    assert "✗ Good to 0.3 px over 60 % of the picture." in text
    assert "Take 2 views with the board at the left edge." in text
    assert "noise\N{EN DASH}" in text.replace("noise ", "noise")
    assert found.tags.count("details") >= 16


def test_inputs_are_shown_with_their_hashes(recorded: Path) -> None:
    found, _, _ = page(recorded)
    record = json.loads((recorded / "build/plate.exr.record.json").read_text())
    for name, digest in record["inputs"].items():
        assert name in found.text
        assert digest in found.text


def test_missing_records_are_named_and_not_invented(root: Path) -> None:
    record_all(root, leave_out=("envmap lights", "render wide"))
    found, _, verdict = page(root)
    assert verdict == "2 of 16 stages have no record"
    assert found.text.count("No record: this stage has not run") == 2
    assert found.text.count("no record") >= 2


def test_an_empty_scene_folder(root: Path) -> None:
    found, _, verdict = page(root)
    assert verdict == "16 of 16 stages have no record"
    assert "img" not in found.tags


def test_a_missing_picture_is_said(recorded: Path) -> None:
    (recorded / "build/response.png").unlink()
    (recorded / "build/residuals.png").write_bytes(b"\x89PNG no picture")
    found, _, _ = page(recorded)
    assert "plot: response.png is not there, or no picture" in found.text
    assert "residuals.png is not there, or no picture" in found.text


def test_pictures_outside_the_scene_are_not_read(recorded: Path) -> None:
    plot(recorded.parent / "secret.png")
    path = recorded / "build/response.json.record.json"
    record = json.loads(path.read_text())
    record["figures"] = {
        "plot": "../../secret.png",
        "other": str(recorded.parent / "secret.png"),
    }
    path.write_text(json.dumps(record))
    found, _, _ = page(recorded)
    assert found.text.count("secret.png is not there, or no picture") == 1


def test_a_lost_output_is_said(recorded: Path) -> None:
    (recorded / "build/lights.json").unlink()
    found, _, _ = page(recorded)
    assert "build/lights.json is recorded but not there any more" in found.text


def test_hostile_names_and_values_are_escaped(root: Path) -> None:
    evil = "</style><script>alert(1)</script><img src=x onerror=alert(1)>"
    (root / "scene.toml").write_text(FULL.replace('name = "full"', f"name = '{evil}'"))
    record_all(root)
    path = root / "build/response.json.record.json"
    record = json.loads(path.read_text())
    record["figures"] = {evil: evil, "list": [{evil: evil}], "plot": f'"{evil}.png'}
    record["command"] = ["chromeball", evil]
    record["inputs"] = {evil: evil}
    record["options"] = {evil: evil}
    record["versions"] = {evil: evil}
    path.write_text(json.dumps(record))
    found, text, _ = page(root)
    assert "<script" not in text
    assert "<img src=x" not in text
    assert not any(name.startswith("on") for name, _ in found.attributes)
    assert "script" not in found.tags
    assert evil in found.text


def test_errors_against_the_truth(recorded: Path) -> None:
    record_truth(recorded, ERRORS)
    found, _, verdict = page(recorded)
    assert verdict == (
        "all 16 stages are recorded, all 2 errors against the truth keep their bounds"
    )
    assert "missed" not in found.text
    record_truth(recorded, [*ERRORS, {**ERRORS[0], "value": 3.1}, {**ERRORS[0], "value": None}])
    found, _, verdict = page(recorded)
    assert verdict.endswith("2 of 4 errors against the truth miss their bounds")
    assert found.text.count("✗ missed") == 2
    assert "nan" in found.text


def test_truth_waits_for_all_stages(root: Path) -> None:
    scene = root / "scene.toml"
    scene.write_text(FULL + '[truth]\nfolder = "truth"\n')
    record_all(root, leave_out=("render wide",))
    found, _, verdict = page(root)
    assert "Not compared with the truth: build/wide.exr is not there." in found.text
    assert verdict == "1 of 16 stages have no record"


def test_records_of_no_stage_are_set_apart(recorded: Path) -> None:
    text = FULL.replace('[[view]]\nname = "wide"\nmodel = "equisolid"', "")
    (recorded / "scene.toml").write_text(text)
    found, _, verdict = page(recorded)
    assert verdict == "all 15 stages are recorded"
    assert "Other records" in found.text
    assert "render wide: " in found.text


def test_a_broken_record_is_an_error_and_leaves_no_report(recorded: Path) -> None:
    (recorded / "build/lights.json.record.json").write_text('{"stage": "x"}')
    with pytest.raises(UserError, match=r"lights\.json\.record\.json: not a readable record"):
        page(recorded)
    assert not (recorded / "report.html").exists()


def test_the_report_has_a_record_itself(recorded: Path) -> None:
    record_truth(recorded, ERRORS)
    page(recorded)
    record = json.loads((recorded / "report.html.record.json").read_text())
    assert record["figures"]["stages_recorded"] == 16
    assert record["figures"]["errors_kept"] == 2
    assert any(name.endswith("env.exr.record.json") for name in record["inputs"])


def test_summary_says_where_things_are(recorded: Path) -> None:
    record_truth(recorded, [*ERRORS, {**ERRORS[0], "value": 3.1}])
    text = summary(recorded / "scene.toml")
    assert f"composite  {recorded}/build/main.png" in text
    assert f"report     {recorded}/report.html: all 16 stages" in text
    assert "response: RMS" in text
    assert text.count("missed") == 1


def test_sorting_figures() -> None:
    figures = sort_figures(
        {
            "residual_px": 0.25,
            "bad_pixels": 3,
            "median_pixels": 0.5,
            "peak_bytes": 3 * 2**20,
            "distance_min": 1.5,
            "size": [640, 480],
            "lens": {"focal_m": 0.05, "plot": "a.PNG"},
            "curve": list(range(20)),
            "pairs": [[1.0, 2.0]] * 9,
            "per_file": {f"{i}.jpg": i for i in range(20)},
            "more": ["b.png", "c.jpg"],
        }
    )
    assert figures.rows == (
        Row("residual", "0.25", "px"),
        Row("bad pixels", "3", ""),
        Row("median", "0.5", "px"),
        Row("peak", "3", "MB"),
        Row("distance min", "1.5", "m"),
        Row("size", "640 \u00d7 480", ""),
        Row("lens · focal", "0.05", "m"),
    )
    assert [(t.title, len(t.rows)) for t in figures.tables] == [
        ("curve", 3),
        ("pairs", 9),
        ("per file", 20),
    ]
    assert [name for _, name in figures.pictures] == ["a.PNG", "b.png", "c.jpg"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "\N{EN DASH}"),
        (True, "yes"),
        (12345678, "12\u202f345\u202f678"),
        (0.0, "0"),
        (0.123456, "0.1235"),
        (3.2e7, "3.2\u202f·\u202f10⁷"),
        (-4.5e-12, "-4.5\u202f·\u202f10⁻¹²"),
        ([1.0, 2], "1, 2"),
        ([], "none"),
        ({"a": 1}, "a 1"),
        ("x", "x"),
    ],
)
def test_values_as_text(value: Any, text: str) -> None:
    assert show(value) == text


def test_seconds_as_text() -> None:
    texts = [seconds(v) for v in (0.004, 0.2, 9.96, 99.9, 99.96, 125.4)]
    assert texts == ["4 ms", "0.20 s", "10.0 s", "99.9 s", "1 min 40 s", "2 min 05 s"]


def test_large_pictures_are_made_smaller(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    noise = np.random.default_rng(0).integers(0, 255, (900, 3000, 3), dtype=np.uint8)
    cv2.imwrite(str(path), noise)
    uri = data_uri(path)
    assert uri is not None
    assert len(uri) < path.stat().st_size / 4
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), 1)
    assert pixels is not None
    assert pixels.shape == (480, WIDTH, 3)
    assert abs(float(pixels.mean()) - float(noise.mean())) < 1


def test_sixteen_bits_and_alpha(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    deep = np.full((10, 2000, 4), 32768, np.uint16)
    cv2.imwrite(str(path), deep)
    uri = data_uri(path)
    assert uri is not None
    assert uri.startswith("data:image/png")
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), -1)
    assert pixels is not None
    assert pixels.shape[1:] == (WIDTH, 4)
    assert abs(int(pixels[0, 0, 0]) - 128) <= 1
