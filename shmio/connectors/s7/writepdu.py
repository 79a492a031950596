"""The bytes of S7 jobs that write: several items in one PDU, and one return code for each. No I/O.

An item is an address (S7-Any: transport size BYTE with a count, or BIT) and, in the data part, a value with a transport
size and a length of its own; every value but the last is padded to an even length. Items are encoded by python-snap7,
which knows jobs of one item only; here they are put together.

Every function here raises ConnectorError, and nothing else, on whatever answer it is given.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from snap7.datatypes import S7Area, S7WordLen
from snap7.s7protocol import S7Protocol

from shmio.connectors.s7 import pdu
from shmio.errors import ConnectorError

MAX_ITEMS = 20  # in one job, as all known controllers take
JOB_OVERHEAD = 12  # of a request within its PDU: header 10, parameters 2
ITEM_OVERHEAD = 16  # address 12, head of the value 4
_WRITE = 0x05
_ONE_ITEM = slice(12, 24)  # the address in python-snap7's request for one item, of which the rest is the value


def byte_item(db_number: int, start: int, data: bytes) -> tuple[bytes, bytes]:
    """Encode address and value of bytes."""
    return _split(S7Protocol().build_write_request(S7Area.DB, db_number, start, S7WordLen.BYTE, data))


def bit_item(db_number: int, start: int, bit: int, value: bool) -> tuple[bytes, bytes]:
    """Encode address and value of a single bit, which leaves the others of its byte alone."""
    place = 8 * start + bit
    return _split(S7Protocol().build_write_request(S7Area.DB, db_number, place, S7WordLen.BIT, bytes((value,))))


def _split(request: bytes) -> tuple[bytes, bytes]:
    address, value = request[_ONE_ITEM], request[_ONE_ITEM.stop :]
    if address[:3] != b"\x12\x0a\x10" or request[10:12] != b"\x05\x01":
        raise AssertionError("python-snap7 encodes write requests in another way than shmio knows")
    return address, value


def write_request(reference: int, items: Sequence[tuple[bytes, bytes]]) -> bytes:
    """Build a job that writes these items, as ``byte_item`` and ``bit_item`` made them."""
    parameters = bytes((_WRITE, len(items))) + b"".join(address for address, _ in items)
    values = b"".join(value + b"\0" * (len(value) & 1) for _, value in items[:-1]) + items[-1][1]
    header = struct.pack(">BBHHHH", 0x32, 1, 0, reference, len(parameters), len(values))
    return pdu.data_frame(header + parameters + values)


def parse_write_answer(frame: memoryview, count: int) -> bytes:
    """Check the answer to a write of ``count`` items; the return code of each. RefusedError: the whole job was."""
    data_length = pdu.check_answer(frame)
    codes = frame[pdu.HEADER_END + 2 :]
    if len(frame) < pdu.HEADER_END + 2 or len(codes) != data_length or frame[pdu.HEADER_END] != _WRITE:
        raise ConnectorError("not an answer to a write")
    if frame[pdu.HEADER_END + 1] != count or data_length != count:
        raise ConnectorError(f"answer with {data_length} return codes, {count} items were written")
    return bytes(codes)
