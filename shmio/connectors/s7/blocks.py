"""Reads and writes data of a controller with several requests in flight, and finds a block's length.

Nothing here does I/O. Each operation builds its requests (``take``) and checks the answers
(``accept``). ``transport`` sends and receives them. Round trips take nearly all the time of a cycle, so
``transport`` keeps as many requests in flight as the controller granted.
"""

from __future__ import annotations

import struct
from bisect import bisect_right, insort
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from shmio.connectors.base import Lost
from shmio.connectors.s7 import pdu
from shmio.connectors.s7.explain import ITEM_OK, RefusedError, explain_read, explain_write
from shmio.errors import ConnectorError
from shmio.layout.values.write import Write, merge

MAX_ITEMS = 20  # per job; all known controllers accept that many
JOB_OVERHEAD = 12  # bytes of a request's PDU: header 10, parameters 2
ITEM_OVERHEAD = 16  # bytes of an item: address 12, header of the value 4
_MOST_PROBED = 19  # items per job; request and answer fit the smallest known PDU, 240 bytes
_REFERENCE = struct.Struct(">H")
_ITEM_HEAD = struct.Struct(">BBH")  # return code (reserved in a request), transport size, length
_SIZE_BIT, _SIZE_BITS = 0x03, 0x04  # transport sizes: a single bit; bytes, whose length counts bits


# -- reading -----------------------------------------------------------------------------------------------------------


class BlockRead:
    """Reads a whole block: builds the requests, and assembles the image from the answers.

    :meth:`begin` starts another read with the same buffers.
    """

    def __init__(self, db_number: int, size: int, chunk: int) -> None:
        """Prepare requests that read at most ``chunk`` bytes each."""
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
        """Start a read that must be complete by ``deadline_ns``."""
        self.deadline_ns = deadline_ns
        self.refusal: RefusedError | None = None
        """The controller's refusal to read the block; None if it did not refuse."""
        self.sent = self._answered = 0

    @property
    def complete(self) -> bool:
        """True if all parts of the block were received, or the controller refused to read it."""
        return self._answered == self.count or self.refusal is not None

    @property
    def data(self) -> bytes:
        """A copy of the image; valid only if the read is complete and was not refused."""
        return bytes(self._block)

    def take(self, count: int, first: int) -> memoryview:
        """Return the next ``count`` requests. Their references are 16-bit numbers from ``first`` on, which wrap."""
        size = pdu.READ_REQUEST_SIZE
        begin, self.sent = self.sent, self.sent + count
        for place in range(count):
            offset = (begin + place) * size + pdu.REFERENCE_OFFSET
            _REFERENCE.pack_into(self._requests, offset, (first + place) & 0xFFFF)
        return self._requests_view[begin * size : self.sent * size]

    def accept(self, index: int, frame: memoryview) -> None:
        """Process the answer to request number ``index``; answers may come in any order.

        Raises:
            ConnectorError: The answer does not match the request.

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
            raise ConnectorError(
                f"the controller's answer has {len(answer.data)} bytes of data, but {due} were requested"
            )
        self._block_view[start : start + due] = answer.data
        self._answered += 1


# -- writing -----------------------------------------------------------------------------------------------------------


def byte_item(db_number: int, start: int, data: bytes, area: int = pdu.DATA_BLOCK) -> tuple[bytes, bytes]:
    """Return an item that writes bytes: its encoded address, and its encoded value."""
    return pdu.address(db_number, 8 * start, len(data), area=area), _ITEM_HEAD.pack(0, _SIZE_BITS, 8 * len(data)) + data


def bit_item(db_number: int, start: int, bit: int, value: bool, area: int = pdu.DATA_BLOCK) -> tuple[bytes, bytes]:
    """Return an item that writes one bit: its encoded address, and its encoded value.

    The controller does not change the other bits of the byte.
    """
    place = 8 * start + bit
    head = _ITEM_HEAD.pack(0, _SIZE_BIT, 1)
    return pdu.address(db_number, place, 1, pdu.TYPE_BIT, area), head + bytes((value,))


def write_request(reference: int, items: Sequence[tuple[bytes, bytes]]) -> bytes:
    """Return a job that writes items, encoded by ``byte_item`` and ``bit_item``."""
    parameters = bytes((pdu.WRITE, len(items))) + b"".join(address for address, _ in items)
    values = b"".join(value + b"\0" * (len(value) & 1) for _, value in items[:-1]) + items[-1][1]
    return pdu.request(reference, parameters, values)


def parse_write_answer(frame: memoryview, count: int) -> bytes:
    """Return the return codes of ``count`` written items, one byte each.

    Raises:
        RefusedError: The controller refused the whole job.
        ConnectorError: The answer is malformed.

    """
    data_length = pdu.check_answer(frame)
    codes = frame[pdu.HEADER_END + 2 :]
    if len(frame) < pdu.HEADER_END + 2 or len(codes) != data_length or frame[pdu.HEADER_END] != pdu.WRITE:
        raise ConnectorError("the controller's reply is not an answer to a write")
    if frame[pdu.HEADER_END + 1] != count or data_length != count:
        raise ConnectorError(f"the controller's answer has {data_length} return codes, but {count} items were written")
    return bytes(codes)


class WriteItem(NamedTuple):
    """An item of a job, which carries out a write or a part of it."""

    write: int
    """Index of the write to which the item belongs."""
    last: int
    """Offset of the last byte that the item writes."""
    encoded: tuple[bytes, bytes]


class BlockWrite:
    """One wave of writes: jobs that may all be in flight at once.

    The jobs contain the items in the order of the writes, and are sent in this order. If the
    controller refuses a write, the reason is stored in ``outcomes``.
    """

    def __init__(self, db_number: int, pdu_size: int, items: Sequence[WriteItem], outcomes: list[str]) -> None:
        self._db_number = db_number
        self._outcomes = outcomes
        self._jobs = list(_fill(items, pdu_size))
        self.count = len(self._jobs)
        self.sent = 0
        self._answered: set[int] = set()

    @property
    def complete(self) -> bool:
        """True if the controller has answered every job."""
        return len(self._answered) == self.count

    def take(self, count: int, first: int) -> bytes:
        """Return the next ``count`` requests. Their references are 16-bit numbers from ``first`` on, which wrap."""
        begin, self.sent = self.sent, self.sent + count
        return b"".join(
            write_request((first + place) & 0xFFFF, [item.encoded for item in job])
            for place, job in enumerate(self._jobs[begin : self.sent])
        )

    def accept(self, index: int, frame: memoryview) -> None:
        """Process the answer to request number ``index``.

        Raises:
            ConnectorError: The answer does not match the request.

        """
        job = self._jobs[index]
        try:
            codes = parse_write_answer(frame, len(job))
        except RefusedError as refusal:
            for item in job:
                self._refuse(item, str(refusal))
        else:
            for item, code in zip(job, codes, strict=True):
                if code != ITEM_OK:
                    self._refuse(item, self._reason(item, code))
        self._answered.add(index)

    def unanswered(self) -> Iterator[tuple[int, Lost | None]]:
        """Yield, for each item, the index of its write, and the item's state if the session is lost now.

        The state is None if the controller has answered the item.
        """
        for index, job in enumerate(self._jobs):
            known = None if index in self._answered else Lost.UNKNOWN if index < self.sent else Lost.UNSENT
            for item in job:
                yield item.write, known

    def _reason(self, item: WriteItem, code: int) -> str:
        """Return why an item with this return code was refused."""
        return explain_write(code, self._db_number, item.last)

    def _refuse(self, item: WriteItem, reason: str) -> None:
        self._outcomes[item.write] = self._outcomes[item.write] or reason


def waves(
    db_number: int, pdu_size: int, writes: Sequence[Write], outcomes: list[str], bits: bytes | None = None
) -> Iterator[BlockWrite]:
    """Divide writes into waves, in order. Each wave must be complete before the next one is sent.

    The controller may execute jobs in flight in any order, so writes to the same bits must be in
    different waves. If the controller refuses a write, its wave stores the reason in ``outcomes``.
    ``bits`` is a mask of the block with the bits that registers have; the others, which are
    padding, are not written. None: write all bits.
    """
    wave: list[WriteItem] = []
    spans: list[tuple[int, int]] = []  # sorted ranges of bits that the wave writes
    for place, write in enumerate(writes):
        span = _span(write)
        if wave and touches(spans, span):
            yield BlockWrite(db_number, pdu_size, wave, outcomes)
            wave, spans = [], []
        insort(spans, span)
        wave += _items(db_number, pdu_size, place, write, bits)
    if wave:
        yield BlockWrite(db_number, pdu_size, wave, outcomes)


def ends(outcomes: Sequence[str], begun: Iterable[BlockWrite]) -> list[str | Lost]:
    """Return the outcome of each write after the session was lost.

    Args:
        outcomes: For each write, why the controller refused it, or "".
        begun: The waves of which at least a part was sent.

    """
    parts: list[set[Lost | None]] = [set() for _ in outcomes]
    for wave in begun:
        for write, known in wave.unanswered():
            parts[write].add(known)
    return [_end(text, known) for text, known in zip(outcomes, parts, strict=True)]


def _end(text: str, parts: set[Lost | None]) -> str | Lost:
    if Lost.UNKNOWN in parts:
        return Lost.UNKNOWN
    if not text and None in parts and Lost.UNSENT in parts:  # partly written
        return Lost.UNKNOWN
    return text if None in parts else Lost.UNSENT


def _span(write: Write) -> tuple[int, int]:
    if write.mask:
        bit = 8 * write.offset + write.mask.bit_length() - 1
        return bit, bit + 1
    return 8 * write.offset, 8 * (write.offset + len(write.data))


def touches(spans: list[tuple[int, int]], span: tuple[int, int]) -> bool:
    """Return whether a span overlaps any of ``spans``, which are disjoint and sorted."""
    after = bisect_right(spans, span)
    return (after > 0 and spans[after - 1][1] > span[0]) or (after < len(spans) and spans[after][0] < span[1])


def _items(db_number: int, pdu_size: int, place: int, write: Write, bits: bytes | None) -> Iterator[WriteItem]:
    most = pdu_size - JOB_OVERHEAD - ITEM_OVERHEAD
    for first, mask, data in [write] if write.mask or bits is None else _without_padding(write, bits):
        if mask:
            bit = mask.bit_length() - 1
            yield WriteItem(place, first, bit_item(db_number, first, bit, bool(data[0] & mask)))
            continue
        for start in range(0, len(data), most):
            part = data[start : start + most]
            yield WriteItem(place, first + start + len(part) - 1, byte_item(db_number, first + start, part))


def _without_padding(write: Write, bits: bytes) -> Iterator[Write]:
    """Yield writes of those bits of a write of bytes that registers have, or that lie outside the layout."""
    own = bits[write.offset : write.offset + len(write.data)].ljust(len(write.data), b"\xff")
    for part in merge(write.data, own, [(0, len(own))]):
        yield part._replace(offset=write.offset + part.offset)


def _fill(items: Sequence[WriteItem], pdu_size: int) -> Iterator[list[WriteItem]]:
    """Group items into jobs, in order; each job has as many items as fit into a PDU."""
    job: list[WriteItem] = []
    size = JOB_OVERHEAD
    for item in items:
        address, value = item.encoded
        size += size & 1  # values begin at even offsets
        if job and (size + len(address) + len(value) > pdu_size or len(job) == MAX_ITEMS):
            yield job
            job, size = [], JOB_OVERHEAD
        job.append(item)
        size += len(address) + len(value)
    if job:
        yield job


# -- finding the length ------------------------------------------------------------------------------------------------


class SizeProbe:
    """Finds the real length of a block that is shorter than its layout.

    Each job reads single bytes at several places, and so narrows the range of possible lengths by a
    factor of about twenty.
    """

    count = 1

    def __init__(self, db_number: int, size: int, pdu_size: int) -> None:
        """Prepare the search for a length below ``size`` bytes."""
        self._db_number = db_number
        self._most = max(1, min(_MOST_PROBED, (pdu_size - 14) // 12))
        self._low, self._high = 0, size - 1  # inclusive bounds of the first missing byte's offset

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
        """Process the answer.

        Raises:
            ConnectorError: The answer does not match the request.

        """
        readable = parse_readable(frame, len(self._tried))
        for at, good in zip(self._tried, readable, strict=True):
            if not good:
                self._high = at
                break
            self._low = at + 1
        self.complete = True


def parse_readable(frame: memoryview, count: int) -> list[bool]:
    """Return for each of ``count`` single bytes whether the controller could read it.

    Raises:
        RefusedError: The controller refused the whole job.
        ConnectorError: The answer is malformed.

    """
    pdu.check_answer(frame)
    if bytes(frame[pdu.HEADER_END : pdu.HEADER_END + 2]) != bytes((pdu.READ, count)):
        raise ConnectorError(f"the controller's reply is not an answer to a read of {count} items")
    readable = []
    at = pdu.HEADER_END + 2
    for place in range(count):
        if at + 4 > len(frame):
            raise ConnectorError(f"the controller's answer ends before item {place + 1} of {count}")
        code, _, _ = _ITEM_HEAD.unpack_from(frame, at)
        good = code == ITEM_OK
        readable.append(good)
        at += 6 if good else 4  # with one byte of data and one of padding
    if at - len(frame) not in {0, 1}:  # the last item may have no padding
        raise ConnectorError(f"the controller's answer has {len(frame)} bytes, but only {at} belong to its items")
    return readable
