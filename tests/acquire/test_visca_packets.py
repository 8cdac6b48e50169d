"""VISCA packets: the bytes of the manuals, and any bytes at all."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chromeball.acquire.visca_packets import (
    ADDRESS_SET,
    AE_INQUIRY,
    IF_CLEAR,
    MODELS,
    SHUTTER_INQUIRY,
    AutoExposure,
    Kind,
    Reply,
    Splitter,
    packet,
    parse_reply,
    set_ae,
    set_shutter,
    shutter_position,
)


@pytest.mark.parametrize(
    ("ours", "manual"),
    [
        (ADDRESS_SET, "88 30 01 FF"),
        (packet(1, IF_CLEAR), "81 01 00 01 FF"),
        (packet(1, set_ae(AutoExposure.MANUAL)), "81 01 04 39 03 FF"),
        (packet(2, set_ae(AutoExposure.SHUTTER)), "82 01 04 39 0A FF"),
        (packet(1, set_shutter(0x13)), "81 01 04 4A 00 00 01 03 FF"),
        (packet(1, AE_INQUIRY), "81 09 04 39 FF"),
        (packet(1, SHUTTER_INQUIRY), "81 09 04 4A FF"),
    ],
)
def test_packets_are_the_manuals(ours: bytes, manual: str):
    assert ours == bytes.fromhex(manual)


@pytest.mark.parametrize(
    ("reply", "meaning"),
    [
        ("88 30 02 FF", Reply(Kind.ADDRESS, 0, data=b"\x02")),
        ("88 01 00 01 FF", Reply(Kind.CLEARED, 0, data=b"\x01\x00\x01")),
        ("90 41 FF", Reply(Kind.ACK, 1, 1)),
        ("A0 42 FF", Reply(Kind.ACK, 2, 2)),
        ("90 52 FF", Reply(Kind.COMPLETION, 1, 2)),
        ("90 50 FF", Reply(Kind.INQUIRY, 1)),
        ("90 50 00 00 01 03 FF", Reply(Kind.INQUIRY, 1, data=b"\x00\x00\x01\x03")),
        ("90 60 02 FF", Reply(Kind.ERROR, 1, 0, b"\x02")),
        ("90 61 41 FF", Reply(Kind.ERROR, 1, 1, b"\x41")),
        ("90 38 FF", Reply(Kind.NETWORK, 1)),
        ("90 70 FF", Reply(Kind.UNKNOWN, 1, data=b"\x70")),
    ],
)
def test_replies_are_understood(reply: str, meaning: Reply):
    assert parse_reply(bytes.fromhex(reply)) == meaning


@pytest.mark.parametrize(
    ("model", "count", "samples"),
    [
        ("evi-d100p", 0x14, {0x00: 3, 0x03: 25, 0x05: 75, 0x0D: 1000, 0x13: 10000}),
        ("evi-d100", 0x14, {0x00: 4, 0x03: 30, 0x04: 60, 0x13: 10000}),
        ("evi-d70p", 0x16, {0x00: 1, 0x01: 2, 0x02: 3, 0x15: 10000}),
        ("evi-d70", 0x16, {0x00: 1, 0x05: 30, 0x06: 60, 0x15: 10000}),
    ],
)
def test_shutter_tables(model: str, count: int, samples: dict[int, int]):
    times = MODELS[model].times
    assert len(times) == count
    assert list(times) == sorted(times, reverse=True)
    for position, denominator in samples.items():
        assert times[position] == 1 / denominator


@given(st.integers(0, 255))
def test_shutter_positions_survive_the_wire(position: int):
    assert shutter_position(set_shutter(position)[3:]) == position


@given(st.binary(max_size=300), st.lists(st.integers(1, 40), max_size=40))
def test_packets_do_not_depend_on_how_the_bytes_are_cut(data: bytes, cuts: list[int]):
    whole, pieces = Splitter(), Splitter()
    expected = whole.feed(data)
    got: list[bytes] = []
    rest = data
    for cut in cuts:
        got += pieces.feed(rest[:cut])
        rest = rest[cut:]
    got += pieces.feed(rest)
    assert got == expected
    for one in got:
        assert 3 <= len(one) <= 16
        assert one[0] >= 0x80
        assert one.index(0xFF) == len(one) - 1
        parse_reply(one)
    for splitter in (whole, pieces):
        splitter.clear()
        assert splitter.dropped + sum(map(len, expected)) == len(data)


@given(st.binary(max_size=60))
def test_a_packet_after_any_noise_is_found(noise: bytes):
    splitter = Splitter()
    splitter.feed(noise + b"\xff")  # the end of whatever the noise began
    assert splitter.feed(bytes.fromhex("90 50 03 FF")) == [bytes.fromhex("90 50 03 FF")]
