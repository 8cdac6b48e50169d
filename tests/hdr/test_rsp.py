"""Responses of Radiance's hdrgen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chromeball.hdr.response_file import read_response
from chromeball.hdr.rsp import parse_rsp
from chromeball.scene.errors import UserError


def test_a_square_is_a_square(tmp_path: Path) -> None:
    file = tmp_path / "camera.rsp"
    file.write_text("2 1 0 0\n2 0.5 0.5 0\n1 1 0\n")
    found = read_response(file)
    assert found.channels == ("R", "G", "B")
    z = (np.arange(256) + 0.5) / 256
    for curve, expected in zip(found.log_exposure, (z**2, z * (z + 1) / 2, z), strict=True):
        np.testing.assert_allclose(curve, np.log(expected / expected[128]), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "order of red"),
        ("2 1 0", "red needs 3"),
        ("1 1 0\n1 1 0\n", "order of blue"),
        ("1 1 0\n1 1 0\n1 1 0\n7", "1 numbers too many"),
        ("1 -1 1\n1 1 0\n1 1 0", "rise at code 1"),
        ("1 1 -0.5\n1 1 0\n1 1 0", "rise at code 0"),
        ("1.5 1 0\n1 1 0\n1 1 0", "order of red"),
        ("1 nan 0\n1 1 0\n1 1 0", "does not rise"),
        ("hello", "no .rsp"),
    ],
)
def test_what_is_wrong_is_said(text: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        parse_rsp(text)


@given(st.text(alphabet="0123456789.-+e \nx", max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        found = parse_rsp(text)
    except UserError:
        return
    assert (np.diff(found) > 0).all()
