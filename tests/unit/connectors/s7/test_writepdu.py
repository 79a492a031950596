"""Against bytes written down by hand from the protocol's description, and against noise."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shmio.connectors.s7 import block_write
from shmio.connectors.s7.explain import RefusedError
from shmio.errors import ConnectorError
from tests.unit.connectors.s7 import noise as frames

ANSWER = bytes.fromhex("03000018 02f080 32 03 0000 0007 0002 0003 00 00 05 03 ff 0a ff")


def test_one_job_of_bytes_and_a_bit() -> None:
    """The odd value in the middle is padded; the last one is not."""
    items = [
        block_write.byte_item(201, 462, b"abc"),
        block_write.bit_item(201, 7, 5, True),
        block_write.byte_item(201, 0, b"z"),
    ]
    wanted = """0300004a 02f080 32 01 0000 1234 0026 0013 05 03
        12 0a 10 02 0003 00c9 84 000e70
        12 0a 10 01 0001 00c9 84 00003d
        12 0a 10 02 0001 00c9 84 000000
        00 04 0018 616263 00
        00 03 0001 01 00
        00 04 0008 7a"""
    assert block_write.write_request(0x1234, items).hex() == bytes.fromhex(wanted).hex()


def test_an_answer_has_a_code_for_each_item() -> None:
    assert block_write.parse_write_answer(memoryview(ANSWER), 3) == b"\xff\x0a\xff"


def changed(**at: int) -> memoryview:
    data = bytearray(ANSWER)
    for place, value in at.items():
        data[int(place[1:])] = value
    return memoryview(data)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (changed(_5=0x80), "ended the session"),
        (changed(_7=0x72), "does not speak S7"),
        (changed(_8=7), "ROSCTR 7"),
        (changed(_14=3), "names 3 of parameters"),
        (changed(_16=2), "names 2 of parameters and 2"),
        (changed(_14=1, _16=4), "not an answer to a write"),
        (changed(_19=4), "not an answer to a write"),
        (changed(_20=2), "3 return codes, 3 items"),
        (memoryview(ANSWER[:18]), "too short"),
        (memoryview(frames.answer(3, b"", b"")), "not an answer to a write"),
        (memoryview(frames.answer(3, b"\x05", b"")), "not an answer to a write"),
        (memoryview(frames.answer(3, b"", b"\x05\x03\xff")), "not an answer to a write"),
    ],
)
def test_refuses_a_wrong_answer(frame: memoryview, text: str) -> None:
    with pytest.raises(ConnectorError, match=text):
        block_write.parse_write_answer(frame, 3)


def test_codes_for_other_items_than_written() -> None:
    with pytest.raises(ConnectorError, match="3 return codes, 2 items were written"):
        block_write.parse_write_answer(memoryview(ANSWER), 2)


@pytest.mark.parametrize("head", ["32 02 0000 0007 0000 0000", "32 03 0000 0007 0000 0000"])
def test_a_job_that_is_refused_as_a_whole(head: str) -> None:
    frame = bytes.fromhex("03000013 02f080" + head + "83 04")
    with pytest.raises(RefusedError, match=r"0x8304.*PUT/GET"):
        block_write.parse_write_answer(memoryview(frame), 3)


@example(frames.answer(3, b"", b""), 1)
@example(frames.answer(3, b"\x05", b""), 1)
@given(frames.answers(3, b"\x05\x03", b"\xff\x0a\xff") |
       st.binary(min_size=7, max_size=60) | st.builds(lambda cut, tail: (ANSWER[:cut] + tail).ljust(7, b"\0"),
       st.integers(0, 24), st.binary(max_size=20)), st.integers(1, 20))  # fmt: skip
def test_noise_gives_codes_or_a_connector_error(noise: bytes, count: int) -> None:
    with contextlib.suppress(ConnectorError):
        assert len(block_write.parse_write_answer(memoryview(noise), count)) == count
