"""Reading a block from answers that arrive split and in any order: the block is complete, or refused."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.blocks import BlockRead
from shmio.errors import ConnectorError


def answer(request: bytes, block: bytes) -> memoryview:
    """Return the answer of a faultless controller."""
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
    first=st.integers(0, 65535),
    data=st.data(),
)
def test_answers_in_any_order_give_the_block(block: bytes, chunk: int, first: int, data: st.DataObject) -> None:
    reading = BlockRead(201, len(block), chunk)
    for _ in range(2):
        reading.begin(0)
        waiting: list[tuple[int, bytes]] = []
        while not reading.complete:
            left = reading.count - reading.sent
            if left and (not waiting or data.draw(st.booleans())):
                index = reading.sent
                requests = split(reading.take(data.draw(st.integers(1, left)), first + index & 0xFFFF))
                for request in requests:
                    assert pdu.reference_of(memoryview(request)) == first + index & 0xFFFF
                    waiting.append((index, request))
                    index += 1
            else:
                index, request = waiting.pop(data.draw(st.integers(0, len(waiting) - 1)))
                reading.accept(index, answer(request, block))
        assert not waiting
        assert reading.sent == reading.count
        assert reading.data == block
        first = first + reading.count & 0xFFFF


def test_answer_with_less_or_more_data_is_refused() -> None:
    reading = BlockRead(201, 10, 4)
    requests = split(reading.take(3, 0))
    for count in (3, 5):
        other = bytearray(requests[0])
        struct.pack_into(">H", other, 23, count)
        with pytest.raises(ConnectorError, match=rf"{count} bytes of data, but 4 were requested"):
            reading.accept(0, answer(bytes(other), bytes(range(10))))


def test_refusal_ends_only_the_current_read() -> None:
    reading = BlockRead(7, 10, 4)
    request = split(reading.take(3, 0))[0]
    frame = bytearray(answer(request, bytes(10)))
    frame[21] = 0x0A
    reading.accept(0, memoryview(frame))
    assert "DB7: the block does not exist" in str(reading.refusal)
    assert reading.complete
    reading.begin(0)
    for index, request in enumerate(split(reading.take(3, 3))):
        reading.accept(index, answer(request, bytes(range(10))))
    assert (reading.refusal, reading.data) == (None, bytes(range(10)))
