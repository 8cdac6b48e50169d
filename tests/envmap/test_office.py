"""A real fisheye probe against what another tool made of the same photographs."""

from __future__ import annotations

import pytest

from chromeball.bench import envmap_probe as office


@pytest.mark.skipif(
    not office.DATA.is_dir(), reason="no shared/data/hdr/fisheye_lumilab beside the repository"
)
def test_the_difference_to_the_reference_tool_is_explained() -> None:
    bracket = office.read(4)  # quarter size, compared after means over 4 x 4 pixels
    steps = office.causes(bracket, office.merged(bracket), office.FOUND)
    tool = office.reference()
    left = {one.name: office.compare(tool, one.picture, bracket.step) for one in steps}
    # the same geometry, our own curve, times and weights; then all that it does otherwise
    ours, last = left["+ vignetting after it, not before"], left[steps[-1].name]
    assert ours.median < 0.035
    assert last.median < 0.4 * ours.median
    assert last.most < office.BAR
    # nothing is off as a whole, in the dark or in the bright
    for median, _ in last.classes:
        assert median < 0.03
