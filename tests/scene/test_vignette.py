"""The file of a lens's fall-off and the ways to say one."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chromeball.scene.errors import UserError
from chromeball.scene.vignette import LATTICE, Edge, Vignette, lattice, read_vignette
from chromeball.scene.vignette_option import parse_cal, read_given, read_known

COVARIANCE = np.array([[4e-4, -2e-4], [-2e-4, 3e-4]])
CAL = """sq(x)=x*x;
r=sqrt(sq(x-500)+sq(y-500))/500;
sf=(1/(((-0.25)*(r^4))+((0.00000000000000005)*(r^3))+((0.125)*(r^2))+((0.0000000000002)*r)+1));
ro=sf*ri(1);
"""


def measured() -> Vignette:
    rng = np.random.default_rng(0)
    found = Vignette.of([-0.3, 0.1], (120, 80), (61.0, 38.0), None, COVARIANCE)
    grid = rng.normal(0, 0.01, LATTICE)
    return replace(found, map=grid, covered=0.8, source="board", record={"views": 3})


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "vignette.json"
    for known in (measured(), replace(measured(), map=None, edge=Edge((60.0, 40.0), 45.0))):
        path.write_bytes(known.encode())
        again = read_vignette(path)
        assert again.encode() == known.encode()
        q = np.random.default_rng(1).uniform([0, 0], [119, 79], (50, 2))
        np.testing.assert_allclose(again.at(q), known.at(q), rtol=1e-6)
        np.testing.assert_allclose(again.sigma_at(q), known.sigma_at(q), atol=1e-6)


def test_picture_is_the_formula() -> None:
    """Polynomial, map between nodes, bands, and a picture of twice the pixels."""
    known = measured()
    V = known.picture()
    x, y = 17, 66
    r2 = ((x - 61) ** 2 + (y - 38) ** 2) / (120**2 + 80**2) * 4
    assert known.map is not None
    u, v = x / 119 * 8, y / 79 * 6
    cell = known.map[int(v) : int(v) + 2, int(u) : int(u) + 2]
    a, b = u % 1, v % 1
    m = np.array([1 - b, b]) @ cell @ np.array([1 - a, a])
    assert V[y, x] == pytest.approx((1 - 0.3 * r2 + 0.1 * r2**2) * np.exp(m), rel=1e-6)
    bands = [known.picture(rows=(k, min(k + 33, 80))) for k in range(0, 80, 33)]
    np.testing.assert_array_equal(np.concatenate(bands), V)
    doubled = known.picture((240, 160))
    np.testing.assert_allclose(doubled.reshape(80, 2, 120, 2).mean(axis=(1, 3)), V, rtol=1e-3)
    with pytest.raises(UserError, match="a crop needs"):
        known.picture((100, 80))


def test_sigma_is_propagated() -> None:
    """The lattice of errors against coefficients drawn from their covariance."""
    known = Vignette.of([-0.3, 0.1], (120, 80), covariance=COVARIANCE)
    drawn = np.random.default_rng(0).multivariate_normal([-0.3, 0.1], COVARIANCE, 4000)
    q = lattice(known.size)
    values = np.array([np.log(Vignette.of(c.tolist(), known.size).at(q)) for c in drawn])
    spread = values.std(axis=0)
    far = spread > 1e-3
    np.testing.assert_allclose(known.sigma[far], spread[far], rtol=0.05)


def test_beyond_an_edge_the_value_of_the_edge() -> None:
    known = replace(Vignette.of([-1.5], (100, 100)), edge=Edge((49.5, 49.5), 40.0))
    V = known.picture()
    assert V.min() == pytest.approx(1 - 1.5 * 40**2 / 5000, rel=1e-6)
    assert known.beyond() == 0
    with pytest.raises(UserError, match="below 1 %"):
        Vignette.of([-1.5], (100, 100)).picture()


def test_what_is_measured_up_to() -> None:
    known = replace(Vignette.of([-0.3], (101, 101)), covered=0.5)
    assert known.beyond() == pytest.approx(1 - np.pi * 0.125, abs=0.02)


def test_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "v.json"
    whole = json.loads(measured().encode())
    for key, value, message in (
        ("version", 2, "version 2"),
        ("covariance", [[1.0]], "covariance needs 2 x 2"),
        ("sigma", [[0.1]], "lattice"),
        ("map", [[0.0] * 9], "map needs 7 x 9"),
        ("map", [[30.0] * 9] * 7, "beyond e"),
        ("radius", -1, "radius"),
        ("colour", 1, "unknown field `colour`"),
    ):
        path.write_text(json.dumps(whole | {key: value}))
        with pytest.raises(UserError, match=message):
            read_vignette(path)
    with pytest.raises(UserError, match="calibrate vignette"):
        read_vignette(tmp_path / "none.json")


@given(st.binary(max_size=200))
@settings(max_examples=50, deadline=None)
def test_any_bytes_are_a_fall_off_or_a_sentence(data: bytes) -> None:
    with contextlib.suppress(UserError):
        Vignette.decode(data)


@given(st.text("sf=(1/)*r^0.5+-; \n", max_size=80))
@settings(max_examples=100, deadline=None)
def test_any_cal_is_a_polynomial_or_a_sentence(text: str) -> None:
    with contextlib.suppress(UserError):
        assert all(np.isfinite(parse_cal(text)))


def test_what_options_say(tmp_path: Path) -> None:
    assert read_given("-0.3,.1") == (-0.3, 0.1)
    path = tmp_path / "tool.cal"
    path.write_text(CAL)
    assert read_given(str(path)) == (0.125, -0.25)
    with pytest.raises(UserError, match="rim of an image circle"):
        read_known(str(path))
    for text, message in (
        (
            CAL.replace("5)*(r^3)", "5)*(r^5)").replace("0.00000000000000005", "0.1"),
            "odd powers",
        ),
        (CAL.replace("+1))", "+2))"), "1 at r = 0"),
        (CAL.replace("sf=", "sg="), "no line sf"),
    ):
        with pytest.raises(UserError, match=message):
            parse_cal(text)
    for wrong in ("0.1;2", "nan"):
        with pytest.raises(UserError, match="--vignetting"):
            read_given(wrong)
    json_path = tmp_path / "lens.json"
    json_path.write_bytes(measured().encode())
    assert isinstance(read_given(str(json_path)), Vignette)
