from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.hdr.plots import plot_comparagrams, plot_response
from chromeball.hdr.response import sample, solve
from chromeball.hdr.response_file import (
    Exposed,
    Response,
    encode_response,
    exposures_for,
    parse_response,
    read_response,
)
from chromeball.scene.errors import UserError
from tests.hdr.camera import TIMES, log_exposure, photograph, scene


def curve() -> Response:
    known = Response.from_log_exposure(np.stack([log_exposure(g) for g in (1.8, 2.0, 2.2)]))
    return Response(
        known.channels,
        known.log_exposure,
        np.full((3, 256), 0.01),
        np.array([1.0, 1.1, 1.2]),
        refined=True,
        exposures=(Exposed("a.jpg", 1.0, 1.05), Exposed("b.jpg", 0.5, 0.5)),
        record={"residual_rms": [0.1, 0.1, 0.1]},
    )


def strict() -> Response:
    """As `curve`, its codes 0 and 1 told apart."""
    response = curve()
    response.log_exposure[:, 0] -= 1
    return response


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "response.json"
    path.write_bytes(encode_response(strict()))
    again = read_response(path)
    np.testing.assert_array_equal(again.log_exposure, strict().log_exposure)
    np.testing.assert_array_equal(again.sigma, strict().sigma)
    assert again.channels == ("R", "G", "B")
    assert again.exposures == strict().exposures
    assert json.loads(path.read_text())["codes"] == 256


def test_refined_exposures_serve_frames_of_the_same_nominal_one() -> None:
    used, found = exposures_for(strict(), np.array([0.5, 0.25, 1.0]))
    assert found == 2
    np.testing.assert_allclose(used, [0.5, 0.25, 1.05])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"codes": 1000}, "1000 codes"),
        ({"codes": 1024}, "needs 3 x 1024"),
        ({"log_exposure": [[0.0] * 256] * 3}, "does not rise at code 1"),
        ({"log_exposure": [list(np.arange(256.0))] * 3}, "not zero at code 128"),
        ({"log_exposure": [list(np.arange(256.0) - 128)] * 3}, "spans"),
        ({"log_exposure": [[0.0] * 255] * 3}, "needs 3 x 256"),
        ({"sigma": [[-1.0] * 256] * 3}, "negative"),
        ({"channels": ["R", "R", "B"]}, "one name"),
        ({"version": 1}, "version 1"),
        ({"surprise": 1}, "surprise"),
        ({"channels": 3}, "channels"),
    ],
)
def test_wrong_files_are_refused(change: dict[str, Any], message: str) -> None:
    content = json.loads(encode_response(strict())) | change
    with pytest.raises(UserError, match=message):
        parse_response(json.dumps(content).encode())


def test_missing_and_broken_files(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such response"):
        read_response(tmp_path / "no.json")
    with pytest.raises(UserError, match="not valid JSON"):
        parse_response(b"{")


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_give_one_error(data: bytes) -> None:
    with pytest.raises(UserError):
        parse_response(data)


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from(sorted(json.loads(encode_response(strict())))),
    st.recursive(
        st.none() | st.booleans() | st.floats(allow_nan=False) | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=4),
        max_leaves=8,
    ),
)
def test_any_value_for_any_key_is_read_or_refused(key: str, value: object) -> None:
    content = json.loads(encode_response(strict())) | {key: value}
    try:
        response = parse_response(json.dumps(content).encode())
    except UserError:
        return
    assert np.all(np.diff(response.log_exposure, axis=1) > 0)


def test_two_frames_of_one_nominal_exposure_are_told_apart_by_name() -> None:
    response = curve()
    rows = (Exposed("a.jpg", 1.0, 1.05), Exposed("b.jpg", 1.0, 2.1))
    response = dataclasses.replace(response, exposures=rows)
    used, found = exposures_for(
        response, np.array([1.0, 1.0, 1.0]), ["b.jpg", "a.jpg", "c.jpg"]
    )
    assert found == 3  # what was wrong of b.jpg is its own, what was rounded of a.jpg is not
    np.testing.assert_allclose(used, [2.1, 1.05, 1.05])


def test_a_response_of_16_bits_goes_round(tmp_path: Path) -> None:
    z = np.maximum(np.arange(65536), 0.5)
    known = Response.from_log_exposure(2.2 * np.log(z / 32768)[None])
    path = tmp_path / "response.json"
    path.write_bytes(encode_response(known))
    again = read_response(path)
    assert again.codes == 65536
    np.testing.assert_array_equal(again.log_exposure, known.log_exposure)
    assert path.stat().st_size < 4e6


def test_plots_are_pictures(tmp_path: Path) -> None:
    frames = photograph(scene(96, 128))
    samples = [sample(f) for f in frames]
    found = solve(samples, TIMES)
    paths = [Path(f"{t}.png") for t in TIMES]
    plot_comparagrams(samples, found, paths, tmp_path / "pairs.png")
    plot_response(strict(), tmp_path / "plot.png")
    for name in ("pairs.png", "plot.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
