"""Reading a whole block as many requests in flight: what to send next, what has come. No I/O.

A block that does not fit one PDU takes several reads. Their round trips, one after the other, are where nearly all the
time of a cycle goes, so as many requests as the controller granted are kept under way.
"""

from __future__ import annotations

import struct

from shmio.connectors.s7 import pdu
from shmio.errors import ConnectorError

_REFERENCE = struct.Struct(">H")
_UNDER_WAY, _ANSWERED = 1, 2  # of a request; 0 until it is sent


class BlockRead:
    """The requests of one block, built once, and the state of one pass over them."""

    def __init__(self, db_number: int, size: int, chunk: int, depth: int) -> None:
        """Plan reads of at most ``chunk`` bytes, at most ``depth`` of them under way."""
        self._db_number = db_number
        self._size = size
        self._chunk = chunk
        self._depth = depth
        starts = range(0, size, chunk)
        self._requests = bytearray().join(
            pdu.read_request(db_number, start, min(chunk, size - start)) for start in starts
        )
        self._requests_view = memoryview(self._requests)
        self._block = bytearray(size)
        self._block_view = memoryview(self._block)
        self.count = len(starts)
        self._state = bytearray(self.count)
        self._first = 0  # reference of the first request in this pass
        self._sent = 0
        self._answered = 0

    @property
    def complete(self) -> bool:
        """Whether every part of the block has come."""
        return self._answered == self.count

    @property
    def data(self) -> bytes:
        """A copy of the block; of one pass only if complete."""
        return bytes(self._block)

    def begin(self, first: int) -> memoryview:
        """Start a pass whose references count from ``first`` (16 bits, wrapping); what to send now."""
        self._first = first
        self._sent = self._answered = 0
        self._state[:] = bytes(self.count)
        for index in range(self.count):
            offset = index * pdu.READ_REQUEST_SIZE + pdu.REFERENCE_OFFSET
            _REFERENCE.pack_into(self._requests, offset, (first + index) & 0xFFFF)
        return self.more()

    def more(self) -> memoryview:
        """Requests that may be sent now; empty if none may."""
        until = min(self.count, self._answered + self._depth)
        size = pdu.READ_REQUEST_SIZE
        requests = self._requests_view[self._sent * size : until * size]
        for index in range(self._sent, until):
            self._state[index] = _UNDER_WAY
        self._sent = until
        return requests

    def accept(self, frame: memoryview) -> None:
        """Take one answer, in whatever order they come; ConnectorError if it is not exactly one that is due."""
        answer = pdu.parse_read_answer(frame)
        index = (answer.reference - self._first) & 0xFFFF
        if index >= self._sent or self._state[index] != _UNDER_WAY:
            raise ConnectorError(f"answer to a request that is not under way (reference {answer.reference})")
        if answer.code != pdu.ITEM_OK:
            raise ConnectorError(pdu.explain_item(answer.code, self._db_number, self._size))
        start = index * self._chunk
        due = min(self._chunk, self._size - start)
        if len(answer.data) != due:
            raise ConnectorError(f"answer has {len(answer.data)} bytes of data, {due} were asked for")
        self._block_view[start : start + due] = answer.data
        self._state[index] = _ANSWERED
        self._answered += 1
