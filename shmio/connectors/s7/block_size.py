"""Probes how long a block really is when its end cannot be read. No I/O."""

from __future__ import annotations

import struct

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.explain import ITEM_OK
from shmio.errors import ConnectorError

_MOST_ITEMS = 19  # per job; request and answer fit the smallest known PDU, 240 bytes
_ITEM_HEAD = struct.Struct(">BBH")


class SizeProbe:
    """Searches for the first byte that cannot be read.

    Each job narrows the range by a factor of twenty.
    """

    count = 1

    def __init__(self, db_number: int, size: int, pdu_size: int) -> None:
        """Search below ``size``, whose last byte is known to be missing."""
        self._db_number = db_number
        self._most = max(1, min(_MOST_ITEMS, (pdu_size - 14) // 12))
        self._low, self._high = 0, size - 1  # the range of the first missing byte, both ends included

    def begin(self) -> None:
        """Plan the next job."""
        step = -(-(self._high - self._low + 1) // (self._most + 1))
        self._tried = list(range(self._low + step - 1, self._high, step))[: self._most]
        self.sent = 0
        self.complete = False

    @property
    def found(self) -> int | None:
        """Number of bytes that can be read; None while another job is needed."""
        return self._low if self._low == self._high else None

    def take(self, count: int, first: int) -> bytes:
        """Return the request."""
        self.sent = count
        return pdu.read_request(first & 0xFFFF, [pdu.address(self._db_number, 8 * at, 1) for at in self._tried])

    def accept(self, index: int, frame: memoryview) -> None:  # noqa: ARG002 - there is one request
        """Take the answer; ConnectorError if it does not match these items."""
        readable = parse_readable(frame, len(self._tried))
        for at, good in zip(self._tried, readable, strict=True):
            if not good:
                self._high = at
                break
            self._low = at + 1
        self.complete = True


def parse_readable(frame: memoryview, count: int) -> list[bool]:
    """Return which of ``count`` single bytes could be read.

    RefusedError if the whole job was refused.
    """
    pdu.check_answer(frame)
    if bytes(frame[pdu.HEADER_END : pdu.HEADER_END + 2]) != bytes((pdu.READ, count)):
        raise ConnectorError(f"not an answer to a read of {count} items")
    readable = []
    at = pdu.HEADER_END + 2
    for place in range(count):
        if at + 4 > len(frame):
            raise ConnectorError(f"answer that ends before item {place + 1} of {count}")
        code, _, _ = _ITEM_HEAD.unpack_from(frame, at)
        good = code == ITEM_OK
        readable.append(good)
        at += 6 if good else 4  # one byte, and one that makes it even
    if at - len(frame) not in {0, 1}:  # after the last item, none is needed
        raise ConnectorError(f"answer of {len(frame)} bytes, {at} belong to its items")
    return readable
