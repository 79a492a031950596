"""PDUs, compared with bytes written by hand from the protocol's description, and noise."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.s7 import S7Options, pdu
from shmio.errors import ConnectorError
from tests.unit.connectors.s7 import noise as frames

GOOD_ANSWER = bytes.fromhex("0300001d 02f080 32 03 0000 1234 0002 0008 00 00 04 01 ff 04 0020 deadbeef")
CONFIRM = bytes.fromhex("03000016 11 d0 0001 0007 00 c0010a c1020100 c2020101")
GRANT = bytes.fromhex("0300001b 02f080 32 03 0000 0009 0008 0000 00 00 f0 00 0003 0004 01e0")


def changed(frame: bytes, **at: int) -> memoryview:
    data = bytearray(frame)
    for place, value in at.items():
        data[int(place[1:])] = value
    return memoryview(data)


def test_connect_request_carries_rack_and_slot() -> None:
    assert pdu.connect_request(0x0100, 0x0101).hex() == "0300001611e00000000100c1020100c2020101c0010a"
    options = S7Options(host="plc", rack=2, slot=3)
    assert options.called_tsap == 0x0100 | 2 << 5 | 3
    assert S7Options(host="plc", connection="op").called_tsap == 0x0201
    assert S7Options(host="logo", connection="basic", remote_tsap=0x2000).called_tsap == 0x2000


def test_setup_request() -> None:
    wanted = "03000019 02f080 32 01 0000 0007 0008 0000 f0 00 0008 0008 03c0"
    assert pdu.setup_request(7, 8, 960) == bytes.fromhex(wanted)


def test_read_request() -> None:
    request = pdu.read_request(7, [pdu.address(201, 8 * 462, 462)])
    wanted = "0300001f 02f080 32 01 0000 0007 000e 0000 04 01 12 0a 10 02 01ce 00c9 84 000e70"
    assert request == bytes.fromhex(wanted)
    assert len(request) == pdu.READ_REQUEST_SIZE


def test_reads_an_answer() -> None:
    answer = pdu.parse_read_answer(memoryview(GOOD_ANSWER))
    assert pdu.reference_of(memoryview(GOOD_ANSWER)) == 0x1234
    assert (answer.code, bytes(answer.data)) == (0xFF, bytes.fromhex("deadbeef"))


def test_reads_octets_and_a_padded_odd_length() -> None:
    octets = bytes.fromhex("0300001d 02f080 32 03 0000 0001 0002 0008 00 00 04 01 ff 09 0003 010203 00")
    assert bytes(pdu.parse_read_answer(memoryview(octets)).data) == b"\x01\x02\x03"


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (changed(GOOD_ANSWER, _4=3), "header 03 f0 80"),
        (changed(GOOD_ANSWER, _5=0x80), "ended the session"),
        (changed(GOOD_ANSWER, _5=0x70), "TPDU 0x70"),
        (changed(GOOD_ANSWER, _6=0), "header 02 f0 00"),
        (changed(GOOD_ANSWER, _7=0x72), "does not speak S7"),
        (changed(GOOD_ANSWER, _8=1), "ROSCTR 1"),
        (changed(GOOD_ANSWER, _8=2), "has no data"),
        (changed(GOOD_ANSWER, _14=3), "says 3 of parameters"),
        (changed(GOOD_ANSWER, _16=9), "says 2 of parameters and 9 of data"),
        (changed(GOOD_ANSWER, _17=0x81, _18=0x04), "PUT/GET"),
        (changed(GOOD_ANSWER, _17=0x85), "0x8500"),
        (changed(GOOD_ANSWER, _17=0xEE, _18=0xEE), "unknown error"),
        (changed(GOOD_ANSWER, _19=5), "not an answer to a read"),
        (changed(GOOD_ANSWER, _20=2), "not an answer to a read"),
        (changed(GOOD_ANSWER, _22=3), "transport size 0x03"),
        (changed(GOOD_ANSWER, _24=0x21), "transport size 0x04"),
        (changed(GOOD_ANSWER, _24=0x28), "4 bytes of data, but its header says 5"),
        (memoryview(GOOD_ANSWER[:18]), "too short"),
    ],
)
def test_refuses_a_wrong_answer(frame: memoryview, text: str) -> None:
    with pytest.raises(ConnectorError, match=text):
        pdu.parse_read_answer(frame)


def test_bare_error_pdu_of_an_s7_1200() -> None:
    with pytest.raises(ConnectorError, match="enable 'Permit access with PUT/GET"):
        pdu.parse_read_answer(memoryview(bytes.fromhex("03000013 02f080 32 02 0000 0001 0000 0000 81 04")))


def test_connect_confirm_names_the_tpdu_size() -> None:
    assert pdu.parse_connect_confirm(memoryview(CONFIRM)) == 1024
    assert pdu.parse_connect_confirm(memoryview(bytes.fromhex("0300000b 06 d0 0001 0007 00"))) == 65531


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (changed(CONFIRM, _5=0x80), "refused the session"),
        (changed(CONFIRM, _5=0xF0), "not an S7 controller"),
        (changed(CONFIRM, _4=5), "the wrong length"),
        (changed(CONFIRM, _13=40), "size code 40"),
        (memoryview(CONFIRM[:8]), "not an S7 controller"),
    ],
)
def test_refuses_a_wrong_confirm(frame: memoryview, text: str) -> None:
    with pytest.raises(ConnectorError, match=text):
        pdu.parse_connect_confirm(frame)


def test_session_has_the_lower_limits_of_both_sides() -> None:
    asked = pdu.Session(960, 8)
    assert pdu.parse_setup_answer(memoryview(GRANT), 9, asked) == pdu.Session(480, 3)
    assert pdu.parse_setup_answer(changed(GRANT, _25=0xFF, _22=0, _24=0), 9, asked) == pdu.Session(960, 1)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (changed(GRANT, _12=8), "not sent"),
        (changed(GRANT, _19=4), "not an answer to 'setup"),
        (changed(GRANT, _25=0, _26=20), "only 20 bytes"),
        (changed(GRANT, _17=0x81, _18=0x04), "PUT/GET"),
    ],
)
def test_refuses_a_wrong_grant(frame: memoryview, text: str) -> None:
    with pytest.raises(ConnectorError, match=text):
        pdu.parse_setup_answer(frame, 9, pdu.Session(960, 8))


def test_frame_length_is_bounded() -> None:
    assert pdu.frame_length(memoryview(GOOD_ANSWER), 0, 29) == 29
    with pytest.raises(ConnectorError, match="29 bytes, expected 7 to 28"):
        pdu.frame_length(memoryview(GOOD_ANSWER), 0, 28)
    with pytest.raises(ConnectorError, match=r"not an S7 controller.*HTTP"):
        pdu.frame_length(memoryview(b"..HTTP/1.1 400"), 2, 967)
    with pytest.raises(ConnectorError, match="frame of 6 bytes"):
        pdu.frame_length(memoryview(b"\x03\x00\x00\x06"), 0, 967)


NOISE = st.binary(min_size=7, max_size=80) | st.builds(
    lambda head, cut, tail: (head[:cut] + tail)[:80].ljust(7, b"\0"),
    st.sampled_from([GOOD_ANSWER, CONFIRM, GRANT]),
    st.integers(0, 29),
    st.binary(max_size=40),
)


@given(frames.answers(3, b"\x04\x01", b"\xff\x04\x00\x20\xde\xad\xbe\xef") | frames.answers(3, GRANT[-8:], b"") | NOISE)
def test_noise_gives_an_answer_or_a_connector_error(noise: bytes) -> None:
    frame = memoryview(noise)
    with contextlib.suppress(ConnectorError):
        assert 0 <= pdu.reference_of(frame) <= 0xFFFF
    with contextlib.suppress(ConnectorError):
        assert len(pdu.parse_read_answer(frame).data) <= len(noise)
    with contextlib.suppress(ConnectorError):
        assert 128 <= pdu.parse_connect_confirm(frame) <= 65531
    with contextlib.suppress(ConnectorError):
        session = pdu.parse_setup_answer(frame, 9, pdu.Session(960, 8))
        assert 64 <= session.pdu_size <= 960
        assert 1 <= session.jobs <= 8
    with contextlib.suppress(ConnectorError):
        assert 7 <= pdu.frame_length(frame, 0, 967) <= 967
