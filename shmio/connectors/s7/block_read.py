"""Reads a whole block by several requests in flight, and assembles the image. No I/O.

A block that does not fit one PDU takes several reads. Round trips take nearly all the time of a
cycle. So as many requests as the controller granted are kept in flight (``window``).
"""

from __future__ import annotations

import struct

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.explain import ITEM_OK, RefusedError, explain_read
from shmio.errors import ConnectorError

_REFERENCE = struct.Struct(">H")


class BlockRead:
    """The requests for one block, and the state of one pass over them.

    It is reused for later passes.
    """

    def __init__(self, db_number: int, size: int, chunk: int) -> None:
        """Plan reads of at most ``chunk`` bytes."""
        self._db_number = db_number
        self._size = size
        self._chunk = chunk
        starts = range(0, size, chunk)
        self._requests = bytearray().join(
            pdu.read_request(0, [pdu.address(db_number, 8 * start, min(chunk, size - start))]) for start in starts
        )
        self._requests_view = memoryview(self._requests)
        self._block = bytearray(size)
        self._block_view = memoryview(self._block)
        self.count = len(starts)
        self.begin(0)

    def begin(self, deadline_ns: int) -> None:
        """Start a pass that must be complete by ``deadline_ns``."""
        self.deadline_ns = deadline_ns
        self.refusal: RefusedError | None = None
        """Why the controller refused the block; there is no image then."""
        self.sent = self._answered = 0

    @property
    def complete(self) -> bool:
        """Whether every part of the block has come, or the block was refused."""
        return self._answered == self.count or self.refusal is not None

    @property
    def data(self) -> bytes:
        """A copy of the block.

        It is consistent only if the pass is complete and was not refused.
        """
        return bytes(self._block)

    def take(self, count: int, first: int) -> memoryview:
        """Return the next requests, with references from ``first`` on (16 bits, wrapping)."""
        size = pdu.READ_REQUEST_SIZE
        begin, self.sent = self.sent, self.sent + count
        for place in range(count):
            offset = (begin + place) * size + pdu.REFERENCE_OFFSET
            _REFERENCE.pack_into(self._requests, offset, (first + place) & 0xFFFF)
        return self._requests_view[begin * size : self.sent * size]

    def accept(self, index: int, frame: memoryview) -> None:
        """Take the answer to request ``index``, in any order.

        ConnectorError if it does not match.
        """
        try:
            answer = pdu.parse_read_answer(frame)
            if answer.code != ITEM_OK:
                raise RefusedError(explain_read(answer.code, self._db_number, self._size), answer.code)
        except RefusedError as refusal:
            self.refusal = refusal
            return
        start = index * self._chunk
        due = min(self._chunk, self._size - start)
        if len(answer.data) != due:
            raise ConnectorError(f"answer has {len(answer.data)} bytes of data, {due} were asked for")
        self._block_view[start : start + due] = answer.data
        self._answered += 1
