"""Any order of answers, any depth, any size: the block comes out whole, or not at all."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.blockread import BlockRead
from shmio.errors import ConnectorError


def answer(request: bytes, block: bytes) -> memoryview:
    """What a faultless controller answers."""
    reference, count, place = struct.unpack_from(">11xH10xH2xI", request)
    start = (place & 0xFFFFFF) // 8
    data = block[start : start + count]
    head = struct.pack(">BxH3s BBHHHHH BB BBH", 3, 25 + count, b"\x02\xf0\x80", 0x32, 3, 0, reference, 2, 4 + count, 0,
                       4, 1, 0xFF, 4, 8 * count)  # fmt: skip
    return memoryview(head + data)


def split(requests: memoryview) -> list[bytes]:
    size = pdu.READ_REQUEST_SIZE
    return [bytes(requests[at : at + size]) for at in range(0, len(requests), size)]


@given(
    block=st.binary(min_size=1, max_size=600),
    chunk=st.integers(1, 222),
    depth=st.integers(1, 9),
    first=st.integers(0, 65535),
    data=st.data(),
)
def test_answers_in_any_order_make_the_block(
    block: bytes, chunk: int, depth: int, first: int, data: st.DataObject
) -> None:
    reading = BlockRead(201, len(block), chunk, depth)
    for _ in range(2):
        waiting = split(reading.begin(first))
        while not reading.complete:
            assert len(waiting) <= depth
            reading.accept(answer(waiting.pop(data.draw(st.integers(0, len(waiting) - 1))), block))
            waiting += split(reading.more())
        assert not waiting
        assert reading.data == block
        first = first + reading.count & 0xFFFF


def test_keeps_as_many_under_way_as_allowed() -> None:
    reading = BlockRead(201, 10, 1, 4)
    waiting = split(reading.begin(0))
    assert len(waiting) == 4
    assert not reading.more()
    reading.accept(answer(waiting[2], bytes(10)))
    assert len(split(reading.more())) == 1
    assert not reading.complete


def test_refuses_references_that_are_not_under_way() -> None:
    block = bytes(range(10))
    reading = BlockRead(201, 10, 4, 2)
    old = split(reading.begin(100))
    reading.accept(answer(old[0], block))
    with pytest.raises(ConnectorError, match="not under way"):  # twice
        reading.accept(answer(old[0], block))
    fresh = split(reading.begin(103))
    with pytest.raises(ConnectorError, match="not under way"):  # of the pass before
        reading.accept(answer(old[1], block))
    third = bytearray(fresh[1])
    third[pdu.REFERENCE_OFFSET + 1] += 1
    with pytest.raises(ConnectorError, match="not under way"):  # not sent yet
        reading.accept(answer(bytes(third), block))


def test_refuses_less_or_more_data_than_asked() -> None:
    reading = BlockRead(201, 10, 4, 8)
    requests = split(reading.begin(0))
    for count in (3, 5):
        other = bytearray(requests[0])
        struct.pack_into(">H", other, 23, count)
        with pytest.raises(ConnectorError, match=rf"{count} bytes of data, 4 were asked for"):
            reading.accept(answer(bytes(other), bytes(range(10))))


def test_explains_an_item_error() -> None:
    reading = BlockRead(7, 10, 4, 8)
    request = split(reading.begin(0))[0]
    frame = bytearray(answer(request, bytes(10)))
    frame[21] = 0x0A
    with pytest.raises(ConnectorError, match="DB7 is shorter than 10 bytes or does not exist"):
        reading.accept(memoryview(frame))
