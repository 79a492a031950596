"""Encodes and parses userdata: system status lists (SZL), the clock, information about blocks.

No I/O.

Userdata (ROSCTR 7) are requests for information about the CPU itself, and their answers. Names
follow Wireshark's S7 dissector. An answer that does not fit into a PDU comes in parts, and each part
after the first must be requested. Siemens describes SZLs in System Software for S7-300/400,
A5E00739858, chapter 33.

Every parser in this module raises only ConnectorError, for any input.
"""

from __future__ import annotations

import struct
from datetime import datetime
from typing import Final, NamedTuple

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.explain import ITEM_OK, RefusedError
from shmio.errors import ConnectorError


class Service(NamedTuple):
    """A function that a CPU offers by userdata."""

    group: int
    function: int
    name: str


READ_SZL: Final = Service(4, 1, "read SZL")
READ_CLOCK: Final = Service(7, 1, "read clock")
BLOCK_INFO: Final = Service(3, 3, "read block information")

_PARAMETERS = struct.Struct(">3s 5B BBH")  # head; length, kind, group, function, sequence; unit, last unit, error
_PARAMETERS_HEAD = b"\x00\x01\x12"
_REQUEST, _ANSWER = 0x11, 0x12
_ITEM = struct.Struct(">BBH")  # return code, transport size, length in bytes
_OCTETS = 0x09
_SZL_HEAD = struct.Struct(">HHHH")  # SZL and index; size and number of records
_BLOCK = struct.Struct(">12xHI 4x IHIH 2x2x2x H 24x2xH")
"""Information about a block.

Fields: number; bytes in load memory; ms and day of the last change of the code, and of the
interface; bytes in work memory; checksum.
"""
_DATA_BLOCK_CODE = b"0A"
_ACTIVE = b"A"  # asks for the block in the work memory


class Part(NamedTuple):
    """An answer, or one of its parts."""

    data: bytes
    sequence: int
    """The number that a request for the next part must contain."""
    more: bool
    """True if another part follows."""


def request(reference: int, service: Service, data: bytes = b"") -> bytes:
    """Return a request for a service, with its data."""
    parameters = _PARAMETERS_HEAD + bytes((4, _REQUEST, 0x40 | service.group, service.function, 0))
    item = _ITEM.pack(ITEM_OK, _OCTETS, len(data)) if data else _ITEM.pack(0x0A, 0, 0)
    return pdu.request(reference, parameters, item + data, pdu.USERDATA)


def next_request(reference: int, service: Service, sequence: int) -> bytes:
    """Return a request for the part of an answer that follows the part with the number ``sequence``."""
    parameters = _PARAMETERS.pack(
        _PARAMETERS_HEAD, 8, _ANSWER, 0x40 | service.group, service.function, sequence, 0, 0, 0
    )
    return pdu.request(reference, parameters, _ITEM.pack(0x0A, 0, 0), pdu.USERDATA)


def parse_answer(frame: memoryview, service: Service) -> Part:
    """Parse an answer to a request, or one of its parts.

    Raises:
        RefusedError: The controller refused the request.
        ConnectorError: The answer is malformed.

    """
    kind, parameters_size, data_size = pdu.check_envelope(frame)
    what = f"the controller's reply is not an answer to '{service.name}'"
    if kind != pdu.USERDATA:
        try:
            pdu.check_answer(frame)
        except RefusedError:
            raise _refused(service, f"error 0x{frame[17] << 8 | frame[18]:04X}") from None
        raise ConnectorError(what)
    begin = pdu.USERDATA_END + _PARAMETERS.size
    if parameters_size != _PARAMETERS.size or begin + data_size != len(frame) or data_size < _ITEM.size:
        raise ConnectorError(f"{what}: its lengths are inconsistent")
    head, size, method, group, function, sequence, _, last, error = _PARAMETERS.unpack_from(frame, pdu.USERDATA_END)
    if (head, size, method) != (_PARAMETERS_HEAD, 8, _ANSWER):
        raise ConnectorError(what)
    code, _, length = _ITEM.unpack_from(frame, begin)
    if error:
        raise _refused(service, f"error 0x{error:04X}")
    if code != ITEM_OK:  # in a refusal, some servers name another service
        raise _refused(service, f"item code 0x{code:02X}", code)
    if (group, function) != (0x80 | service.group, service.function):
        raise ConnectorError(what)
    if length != data_size - _ITEM.size:
        raise ConnectorError(f"{what}: it has {data_size - _ITEM.size} bytes of data, but its header says {length}")
    return Part(bytes(frame[begin + _ITEM.size :]), sequence, bool(last))


def _refused(service: Service, number: str, code: int = 0) -> RefusedError:
    return RefusedError(f"the CPU refuses the request '{service.name}' ({number})", code)


def szl_data(szl: int) -> bytes:
    """Return the data of a request for all records of a system status list."""
    return struct.pack(">HH", szl, 0)


def szl_records(data: bytes, szl: int) -> list[bytes]:
    """Return the complete records of a system status list in the data of an answer.

    Raises:
        ConnectorError: The answer is about another list, or its head is missing.

    """
    if len(data) < _SZL_HEAD.size:
        raise ConnectorError(f"the controller's answer to '{READ_SZL.name}' has no header")
    found, _, size, count = _SZL_HEAD.unpack_from(data)
    if found != szl:
        raise ConnectorError(
            f"the controller's reply is not an answer to '{READ_SZL.name}' 0x{szl:04X}, but to 0x{found:04X}"
        )
    if not size:
        return []
    starts = range(_SZL_HEAD.size, len(data) - size + 1, size)
    return [data[start : start + size] for start in starts[:count]]


def parse_clock(data: bytes) -> datetime | None:
    """Return the time of a CPU's clock, without a time zone; None if the data are not a valid time."""
    digits = (
        data[2:9].hex() + data[9:10].hex()[:1]
    )  # after a reserved byte and the century, which CPUs fill in differently
    if len(digits) != 15 or not digits.isdecimal():
        return None
    year = int(digits[:2])
    month, day, hour, minute, second = (int(digits[at : at + 2]) for at in range(2, 12, 2))
    try:
        return datetime(
            (1900 if year >= 90 else 2000) + year, month, day, hour, minute, second, 1000 * int(digits[12:])
        )
    except ValueError:
        return None


class BlockInfo(NamedTuple):
    """The CPU's description of a data block. Loading a changed block changes this description."""

    load_size: int
    """The block's size in load memory, in bytes."""
    code_changed: tuple[int, int]
    """Time of the block's last change: days since 1984-01-01, and ms within the day."""
    interface_changed: tuple[int, int]
    size: int
    """Length of the data in bytes."""
    checksum: int


def block_data(db_number: int) -> bytes:
    """Return the data of a request for information about a data block."""
    return _DATA_BLOCK_CODE + f"{db_number:05d}".encode() + _ACTIVE


def parse_block(data: bytes, db_number: int) -> BlockInfo:
    """Return the information about a data block in an answer.

    Raises:
        ConnectorError: The information is about another block, or is too short.

    """
    if len(data) < _BLOCK.size:
        raise ConnectorError(f"the controller's answer to '{BLOCK_INFO.name}' is too short ({len(data)} bytes)")
    number, load_size, code_ms, code_day, interface_ms, interface_day, size, checksum = _BLOCK.unpack_from(data)
    if number != db_number:
        raise ConnectorError(
            f"the controller's reply is not an answer to '{BLOCK_INFO.name}' of DB{db_number}, but of DB{number}"
        )
    return BlockInfo(load_size, (code_day, code_ms), (interface_day, interface_ms), size, checksum)
