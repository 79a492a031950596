"""Answers a client's jobs like an S7 controller: set-up, read, write. No I/O.

Names and codes follow Wireshark's S7 dissector, behaviour follows an S7-1500. Items fail one by
one, each with its own return code. A job that is wrong as a whole, or whose answer does not fit the
PDU, fails with a header error. :class:`Traits` make it grant less, or refuse like a controller that
is not set up for such clients.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from snap7.datatypes import S7Area, S7WordLen

MAX_JOBS = 32
MAX_PDU_SIZE = 960

PROTOCOL = 0x32
JOB = 1
READ, WRITE, SETUP = 0x04, 0x05, 0xF0
NOT_AVAILABLE, BAD_JOB = 0x8104, 0x8500  # header errors: function not available, PDU of a wrong size

_OK, _DENIED, _OUT_OF_RANGE, _NO_SUCH_TYPE, _TYPE_MISMATCH, _NO_SUCH_OBJECT = 0xFF, 0x03, 0x05, 0x06, 0x07, 0x0A

_JOB = struct.Struct(">BB2xHHH")
_ANSWER = struct.Struct(">BBHHHHH")
_ITEM = struct.Struct(">BBBBHHI")  # specification, its length, syntax, type, count, DB, area and bit address
_ITEM_HEAD = struct.Struct(">BBH")
_BIT = S7WordLen.BIT

# Bytes of an element, transport size of an answer that holds it, and whether its length counts bits.
_TYPES = {
    _BIT: (1, 0x03, False),
    S7WordLen.BYTE: (1, 0x04, True),
    S7WordLen.CHAR: (1, 0x09, False),
    S7WordLen.WORD: (2, 0x04, True),
    S7WordLen.INT: (2, 0x05, True),
    S7WordLen.DWORD: (4, 0x04, True),
    S7WordLen.DINT: (4, 0x05, True),
    S7WordLen.REAL: (4, 0x07, False),
}
_LENGTH_IN_BITS = {0x04, 0x05}
_AREAS = {int(area): area for area in S7Area}


class Fault(Enum):
    """A setting that keeps clients from the data."""

    PUT_GET_OFF = "PUT/GET is not permitted"
    PROTECTED = "the protection level allows no access"
    WRITE_PROTECTED = "the protection level allows reading only"
    OPTIMIZED = "the blocks are optimized: they have no addresses"


@dataclass(frozen=True)
class Traits:
    """How an emulated controller differs from a permissive S7-1500."""

    max_pdu_size: int = MAX_PDU_SIZE
    """The largest PDU it grants, in bytes."""
    max_jobs: int = 8
    """The most jobs that it grants to be in flight at once."""
    fault: Fault | None = None
    block_size: int | None = None
    """The apparent size of data blocks in bytes, as in an older version; None: the real size."""

    def __post_init__(self) -> None:
        if not (100 <= self.max_pdu_size <= MAX_PDU_SIZE and 1 <= self.max_jobs <= MAX_JOBS):
            raise ValueError(f"a PDU has 100 to {MAX_PDU_SIZE} bytes, and 1 to {MAX_JOBS} jobs are granted: {self}")


class _MalformedJobError(Exception):
    """The job's lengths contradict each other."""


class _Item(NamedTuple):
    code: int  # _OK, or why this item cannot be served
    area: bytearray
    start: int
    size: int
    bit: int
    type: int


class Memory:
    """Memory areas that a client can access, with one lock for all of them.

    Because of the lock, answers and writes of several items happen between program cycles.
    """

    def __init__(self, areas: Mapping[tuple[S7Area, int], bytearray]) -> None:
        self.areas = areas
        self.lock = threading.Lock()


class Jobs:
    """Answers one client's jobs, and holds what was agreed with that client."""

    def __init__(self, memory: Memory, traits: Traits) -> None:
        self._memory = memory
        self._traits = traits
        self.pdu_size = 0  # until set up, no job fits

    def answer(self, pdu: memoryview) -> bytes | None:
        """Answer one S7 PDU of ten or more bytes; return None if it is not a known job."""
        protocol, kind, reference, parameter_size, data_size = _JOB.unpack_from(pdu)
        if protocol != PROTOCOL or kind != JOB or len(pdu) < 12:
            return None
        function = pdu[10]
        if function not in {READ, WRITE, SETUP}:
            return None
        longest = MAX_PDU_SIZE if function == SETUP else self.pdu_size
        if len(pdu) != 10 + parameter_size + data_size or parameter_size < 2 or len(pdu) > longest:
            return refusal(reference, BAD_JOB)
        if function != SETUP and self._traits.fault is Fault.PUT_GET_OFF:
            return refusal(reference, NOT_AVAILABLE)
        parameters, data = pdu[10 : 10 + parameter_size], pdu[10 + parameter_size :]
        try:
            if function == READ:
                return self._read(reference, parameters)
            if function == WRITE:
                return self._write(reference, parameters, data)
            return self._set_up(reference, parameters)
        except _MalformedJobError:
            return refusal(reference, BAD_JOB)

    def _set_up(self, reference: int, parameters: memoryview) -> bytes:
        if len(parameters) != 8:
            raise _MalformedJobError
        calling, called, pdu_size = struct.unpack_from(">HHH", parameters, 2)
        self.pdu_size = min(pdu_size, self._traits.max_pdu_size)
        jobs = self._traits.max_jobs
        granted = struct.pack(">BxHHH", SETUP, min(calling, jobs), min(called, jobs), self.pdu_size)
        return acknowledgement(reference, granted)

    def _read(self, reference: int, parameters: memoryview) -> bytes:
        parts = []
        size = 14  # of the answer's PDU
        with self._memory.lock:
            for item in self._items(parameters, Fault.PROTECTED):
                if size & 1:  # items begin at even places
                    parts.append(b"\0")
                    size += 1
                size += 4 + item.size
                if size > self.pdu_size:
                    raise _MalformedJobError
                parts.append(_read_item(item))
        return acknowledgement(reference, bytes((READ, parameters[1])), b"".join(parts))

    def _write(self, reference: int, parameters: memoryview, data: memoryview) -> bytes:
        codes = bytearray()
        with self._memory.lock:
            items = self._items(parameters, Fault.PROTECTED, Fault.WRITE_PROTECTED)
            values = _values(data, len(items))  # all of them, so that a malformed job stores nothing
            for item, value in zip(items, values, strict=True):
                codes.append(_write_item(item, value))
        return acknowledgement(reference, bytes((WRITE, len(items))), codes)

    def _items(self, parameters: memoryview, *denials: Fault) -> list[_Item]:
        if not parameters[1] or len(parameters) != 2 + _ITEM.size * parameters[1]:
            raise _MalformedJobError
        items = [self._item(_ITEM.unpack_from(parameters, at)) for at in range(2, len(parameters), _ITEM.size)]
        if self._traits.fault in denials:
            return [_Item(_DENIED, bytearray(), 0, 0, 0, item.type) for item in items]
        return items

    def _item(self, fields: tuple[int, ...]) -> _Item:
        specification, length, syntax, kind, count, number, place = fields
        nothing = bytearray()
        if (specification, length, syntax) != (0x12, 0x0A, 0x10) or kind not in _TYPES:
            return _Item(_NO_SUCH_TYPE, nothing, 0, 0, 0, kind)
        area_code, (start, bit) = place >> 24, divmod(place & 0xFFFFFF, 8)
        known = _AREAS.get(area_code)
        area = None if known is None else self._memory.areas.get((known, number))
        if area is None:
            return _Item(_NO_SUCH_OBJECT, nothing, 0, 0, 0, kind)
        size = count * _TYPES[S7WordLen(kind)][0]
        if not count or (kind == _BIT and count != 1):
            return _Item(_TYPE_MISMATCH, nothing, 0, 0, 0, kind)
        if start + size > self._size(known, area) or (bit and kind != _BIT):
            return _Item(_OUT_OF_RANGE, nothing, 0, 0, 0, kind)
        return _Item(_OK, area, start, size, bit, kind)

    def _size(self, kind: S7Area | None, area: bytearray) -> int:
        if kind is not S7Area.DB:
            return len(area)
        if self._traits.fault is Fault.OPTIMIZED:
            return 0
        return len(area) if self._traits.block_size is None else min(self._traits.block_size, len(area))


def refusal(reference: int, error: int) -> bytes:
    """Build an answer that holds only a header error: ROSCTR 2, as S7-1200 and S7-1500 send it."""
    return _ANSWER.pack(PROTOCOL, 2, 0, reference, 0, 0, error)


def acknowledgement(reference: int, parameters: bytes, data: bytes | bytearray = b"") -> bytes:
    """Build the answer to a job that succeeded as a whole."""
    return _ANSWER.pack(PROTOCOL, 3, 0, reference, len(parameters), len(data), 0) + parameters + data


def _read_item(item: _Item) -> bytes:
    if item.code != _OK:
        return _ITEM_HEAD.pack(item.code, 0, 0)
    _, transport, in_bits = _TYPES[S7WordLen(item.type)]
    data = bytes(item.area[item.start : item.start + item.size])
    if item.type == _BIT:
        data = bytes((data[0] >> item.bit & 1,))
    return _ITEM_HEAD.pack(_OK, transport, item.size * 8 if in_bits else item.size) + data


def _values(data: memoryview, count: int) -> list[memoryview]:
    """Cut the data part of a write into the values of its items."""
    values = []
    at = 0
    for _ in range(count):
        at += at & 1
        if at + 4 > len(data):
            raise _MalformedJobError
        _, transport, length = _ITEM_HEAD.unpack_from(data, at)
        size = (length + 7) // 8 if transport in _LENGTH_IN_BITS else length
        at += 4
        if at + size > len(data):
            raise _MalformedJobError
        values.append(data[at : at + size])
        at += size
    return values


def _write_item(item: _Item, value: memoryview) -> int:
    if item.code != _OK:
        return item.code
    if len(value) != item.size:
        return _TYPE_MISMATCH
    if item.type == _BIT:
        mask = 1 << item.bit
        item.area[item.start] = item.area[item.start] & ~mask | (mask if value[0] & 1 else 0)
    else:
        item.area[item.start : item.start + item.size] = value
    return _OK
