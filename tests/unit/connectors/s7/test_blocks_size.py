"""The client finds the size of a block with few jobs."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from snap7.datatypes import S7Area

from shmio.connectors.s7.blocks import SizeProbe, parse_readable
from shmio.emulators.s7 import Jobs, Memory, ServerOptions
from shmio.errors import ConnectorError
from tests.unit.connectors.s7 import noise as frames

ANSWER = bytes.fromhex("03000025 02f080 32 03 0000 0007 0002 0010 0000 04 03 ff04000855 00 ff040008aa 00 05000000")


@example(sizes=(33209, 32945), pdu_size=240)
@given(sizes=st.integers(2, 65536).flatmap(lambda size: st.tuples(st.just(size), st.integers(0, size - 1))),
       pdu_size=st.sampled_from([100, 240, 480, 960]))  # fmt: skip
def test_finds_the_size(sizes: tuple[int, int], pdu_size: int) -> None:
    wanted, real = sizes
    jobs = Jobs(Memory({(S7Area.DB, 201): bytearray(wanted)}), ServerOptions(max_pdu_size=pdu_size, block_size=real))
    jobs.answer(memoryview(struct.pack(">BBHHHHBxHHH", 0x32, 1, 0, 0, 8, 0, 0xF0, 8, 8, 960)))
    probe = SizeProbe(201, wanted, pdu_size)
    rounds = 0
    while probe.found is None:
        probe.begin()
        request = probe.take(1, 9)
        assert len(request) <= pdu_size + 7
        answer = jobs.answer(memoryview(request)[7:])
        assert answer is not None
        probe.accept(0, memoryview(struct.pack(">BxH3s", 3, len(answer) + 7, b"\x02\xf0\x80") + answer))
        assert probe.complete
        rounds += 1
    assert probe.found == real
    assert rounds <= (4 if pdu_size >= 240 else 7)


def test_readable_bytes_are_recognised() -> None:
    assert parse_readable(memoryview(ANSWER), 3) == [True, True, False]


@pytest.mark.parametrize("count", [1, 2, 4])
def test_answer_with_another_number_of_items_is_refused(count: int) -> None:
    with pytest.raises(ConnectorError, match=f"not an answer to a read of {count} items"):
        parse_readable(memoryview(ANSWER), count)


@pytest.mark.parametrize("data", ["ff04000855 00 ff040008aa 00 0500", "ff04000855 00 ff040008aa 00 05000000 0000"])
def test_answer_of_a_wrong_length_is_refused(data: str) -> None:
    items = bytes.fromhex(data)
    head = struct.pack(">BxH3sBBHHHHHBB", 3, 21 + len(items), b"\x02\xf0\x80", 0x32, 3, 0, 7, 2, len(items), 0, 4, 3)
    with pytest.raises(ConnectorError, match=r"ends before item 3|belong to its items"):
        parse_readable(memoryview(head + items), 3)


@given(frames.answers(3, b"\x04\x03", ANSWER[21:]) |
       st.binary(min_size=7, max_size=60) | st.builds(lambda cut, tail: (ANSWER[:cut] + tail).ljust(7, b"\0"),
       st.integers(0, 35), st.binary(max_size=20)))  # fmt: skip
def test_noise_gives_an_answer_or_a_connector_error(noise: bytes) -> None:
    with contextlib.suppress(ConnectorError):
        assert len(parse_readable(memoryview(noise), 3)) == 3
