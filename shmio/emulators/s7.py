"""An S7 server for emulated controllers, based on python-snap7's server.

python-snap7 3.3 provides the memory areas, system status lists, block lists, the clock, and the
start and stop of the emulated CPU. This module adds the status list with the operating mode, cuts
answers that do not fit a PDU into parts, and replaces:

- the connection, which joins requests that come in several TPDUs, skips empty ones (Siemens' own
  clients send one after nearly every answer), and can send answers as late as a real CPU;

- the status lists that describe the CPU, which lack the head of the records in python-snap7, and the
  information about blocks, which lacks the checksum there;
- jobs (set-up, read, write), which ``Jobs`` answers: python-snap7 grants one job and 480 bytes,
  writes a bit as a whole byte, stores only the first item of a write, stores part of a write past
  the end of a block, and reads several times slower;
- listening: python-snap7 shares its port silently with a second server (SO_REUSEPORT);
- threads: python-snap7 takes seconds to stop, and leaves its clients' threads behind;
- block upload and download, which are refused: they would write without the lock.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import struct
import threading
import time
import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, Self

from snap7.datatypes import S7Area, S7WordLen
from snap7.s7protocol import S7Function, S7PDUType
from snap7.server import CPUState, Server, ServerState
from snap7.type import SrvArea

from shmio.config.address import Address
from shmio.emulators.s7_profiles import PROFILES, Delays, Kind, Profile
from shmio.errors import ConfigError, EndpointError, ShmioError
from shmio.wording import brief, cannot_listen, did_you_mean, listed, near

MAX_JOBS = 32
MAX_PDU_SIZE = 960

_PROTOCOL = 0x32
_JOB = 1
_READ, _WRITE, _SETUP = 0x04, 0x05, 0xF0
_NOT_AVAILABLE, _BAD_JOB = 0x8104, 0x8500  # header errors: function not available, PDU of a wrong size

_OK, _DENIED, _OUT_OF_RANGE, _NO_SUCH_TYPE, _TYPE_MISMATCH, _NO_SUCH_OBJECT = 0xFF, 0x03, 0x05, 0x06, 0x07, 0x0A

_JOB_HEAD = struct.Struct(">BB2xHHH")
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
    S7WordLen.COUNTER: (2, 0x09, False),
    S7WordLen.TIMER: (2, 0x09, False),
}
_LENGTH_IN_BITS = {0x04, 0x05}
_PERIPHERAL = 0x80
_AREAS = {int(area): area for area in S7Area} | {_PERIPHERAL: S7Area.PE}  # peripheral access reaches only inputs
_NUMBERED = {S7Area.CT: S7WordLen.COUNTER, S7Area.TM: S7WordLen.TIMER}
"""Areas that are addressed by number, with the type that they need."""
_DB_READ = 0xB0
"""Syntax of an item that reads parts of data blocks; it stands here for the type of the item, too."""
_PART = struct.Struct(">BHH")  # bytes, DB and offset of such a part
_ANSWERS: Mapping[int, tuple[int, int, bool]] = _TYPES | {_DB_READ: (1, 0x09, False)}
_READ_ONLY = frozenset({*_NUMBERED.values(), _DB_READ})
"""Types of items that real CPUs do not let clients write."""

_TPKT = struct.Struct(">BxH")
_DT = b"\x02\xf0\x80"  # COTP data, and the end of the message
_EOT = 0x80
_CONNECT, _CONFIRM = 0xE0, 0xD0  # COTP TPDUs that open a connection
_TPDU_SIZE, _CALLING_TSAP, _CALLED_TSAP = 0xC0, 0xC1, 0xC2  # their parameters, in the order of real CPUs
_TPDU_CODE = 0x0A  # 1024 bytes, which real CPUs confirm; clients may ask for less
_FRAME_OVERHEAD = 7
_LONGEST_FRAME = MAX_PDU_SIZE + _FRAME_OVERHEAD
_INBOX_SIZE = 8 * _LONGEST_FRAME
_ANSWERS_AT_ONCE = 8  # maximum number of answers sent together, even if more requests are waiting
_SEND_TIMEOUT_S = 5
_CONNECT_TIMEOUT_S = 5
_KEEPALIVE = {socket.TCP_KEEPIDLE: 30, socket.TCP_KEEPINTVL: 10, socket.TCP_KEEPCNT: 3}
"""Socket options, in s: a client whose host is down is disconnected within a minute."""
_SERVICES = (b"P_PROGRAM", b"_MODU", b"_GARB")  # the first starts the CPU; the others need no action
_SERVICE_ARGUMENT = 8  # offset, in the parameters, of the length of the service's argument
_MODE_LIST, _MODULE_LIST, _COMPONENT_LIST = 0x0424, 0x0011, 0x001C
_RUN, _STOP = 0x08, 0x04  # operating modes in that list
_ORDER_CODE = b"SHMIO EMULATED S7"
_VERSIONS = {0x0001: b"\0\1\0\0", 0x0006: b"\0\1\0\0", 0x0007: b"V\0\1\0"}
"""Versions of the module, its hardware and its firmware, by index in the list."""
_COMPONENTS = {
    0x0001: b"shmio",
    0x0002: b"Emulated S7",
    0x0003: b"",
    0x0004: b"not by Siemens",
    0x0005: b"0",
    0x0007: b"Emulated S7",
}
"""The names of the system, the module and the plant; the copyright, the serial number, the module's type."""
_BLOCK_HEAD = 36
"""Bytes of a block in load memory besides its data."""
_USERDATA_DATA = 22
"""Offset of the data in an answer to userdata, and in a request for the next part of one."""
_NEXT_PART = 0x12
_SENT_TO_CPU = 4  # high half of the byte with the group in requests; 0: a push, 8: an answer
_NO_LIST, _NO_BLOCK, _NO_SERVICE = 0xD402, 0xD209, 0x8104
_REFUSALS = {(4, 1): _NO_LIST, (3, 3): _NO_BLOCK}
"""Errors by which a CPU refuses requests by userdata, by group and function; others: ``_NO_SERVICE``."""
_EMPTY_PARAMETERS = bytes.fromhex("000112 08 12 84 01 00 00 00 0000")
_IS_IT_RUNNING = bytes((0, 1, 0, 0, _READ))
"""Sizes and parameters of a read without items, which ``get_cpu_state()`` of python-snap7 3 sends.

That client takes any acknowledgement for RUN, so the server refuses this read in STOP.
"""
_JOIN_TIMEOUT_S = 10

logger = logging.getLogger(__name__)


# -- jobs --------------------------------------------------------------------------------------------------------------


class Fault(Enum):
    """A setting of the controller by which it refuses access to the data."""

    PUT_GET_OFF = "PUT/GET is not permitted"
    PROTECTED = "the protection level allows no access"
    WRITE_PROTECTED = "the protection level allows reading only"
    OPTIMIZED = "the blocks are optimized: they have no addresses"


@dataclass(frozen=True)
class ServerOptions:
    """Differences between an emulated controller and a permissive S7-1500."""

    max_pdu_size: int = MAX_PDU_SIZE
    """Size of the largest PDU that the server grants, in bytes."""
    max_jobs: int = 8
    """Maximum number of jobs in flight that the server grants."""
    fault: Fault | None = None
    profile: Profile | None = None
    """How long the answers take; None: they are sent at once."""
    block_size: int | None = None
    """Number of bytes of a data block that clients see at most, as if it were an older, shorter one; None: all."""

    def __post_init__(self) -> None:
        if not (100 <= self.max_pdu_size <= MAX_PDU_SIZE and 1 <= self.max_jobs <= MAX_JOBS):
            raise ValueError(f"a PDU has 100 to {MAX_PDU_SIZE} bytes, and 1 to {MAX_JOBS} jobs are granted: {self}")

    @classmethod
    def of(cls, profile: str) -> ServerOptions:
        """Return the options of a kind of CPU.

        Raises:
            ConfigError: There is no profile with this name.

        """
        found = PROFILES.get(profile)
        if found is None:
            meant = did_you_mean(near(profile, PROFILES))
            raise ConfigError(
                f"profile: unknown profile {brief(profile)}; {f'{meant} ' * bool(meant)}{listed(PROFILES)}"
            )
        return cls(found.pdu_size, found.jobs, profile=found)


class _MalformedJobError(Exception):
    """The job's lengths contradict each other."""


class _Item(NamedTuple):
    code: int  # _OK, or the reason for a refusal
    area: bytearray
    start: int
    size: int
    bit: int
    type: int


class Memory:
    """Memory areas that a client can access, with one lock for all of them.

    The lock keeps reads and writes of several items from overlapping with a program cycle.
    """

    def __init__(self, areas: Mapping[tuple[S7Area, int], bytearray]) -> None:
        self.areas = areas
        self.lock = threading.Lock()

    @staticmethod
    def size_of(block: bytearray, options: ServerOptions) -> int:
        """Return the length of a data block in bytes, as a client sees it."""
        return len(block) if options.block_size is None else min(options.block_size, len(block))


class Jobs:
    """Answers one client's jobs, and keeps the parameters agreed with that client. No I/O.

    Names and codes follow Wireshark's S7 dissector; the behaviour follows an S7-1500. Each item has
    its own return code, and may fail alone. A job that is wrong as a whole, or whose answer does not
    fit the PDU, fails with a header error.
    """

    def __init__(self, memory: Memory, options: ServerOptions, longest: int = MAX_PDU_SIZE) -> None:
        """Begin with a client whose TPDUs hold at most ``longest`` bytes of a PDU."""
        self._memory = memory
        self._options = options
        self._most = min(longest, options.max_pdu_size)
        self.pdu_size = 0  # before the set-up, every job is too large

    @property
    def longest(self) -> int:
        """Size in bytes of the largest PDU for this client, also before the set-up."""
        return self.pdu_size or self._most

    def answer(self, pdu: memoryview) -> bytes | None:
        """Answer one S7 PDU of ten or more bytes; return None if it is not a known job."""
        protocol, kind, reference, parameter_size, data_size = _JOB_HEAD.unpack_from(pdu)
        if protocol != _PROTOCOL or kind != _JOB or len(pdu) < 12:
            return None
        function = pdu[10]
        if function not in {_READ, _WRITE, _SETUP}:
            return None
        longest = MAX_PDU_SIZE if function == _SETUP else self.pdu_size
        if len(pdu) != 10 + parameter_size + data_size or parameter_size < 2 or len(pdu) > longest:
            return _refusal(reference, _BAD_JOB)
        if function != _SETUP and self._options.fault is Fault.PUT_GET_OFF:
            return _refusal(reference, _NOT_AVAILABLE)
        parameters, data = pdu[10 : 10 + parameter_size], pdu[10 + parameter_size :]
        try:
            if function == _READ:
                return self._read(reference, parameters)
            if function == _WRITE:
                return self._write(reference, parameters, data)
            return self._set_up(reference, parameters)
        except _MalformedJobError:
            return _refusal(reference, _BAD_JOB)

    def _set_up(self, reference: int, parameters: memoryview) -> bytes:
        if len(parameters) != 8:
            raise _MalformedJobError
        calling, called, pdu_size = struct.unpack_from(">HHH", parameters, 2)
        self.pdu_size = min(pdu_size, self._most)
        # Real CPUs return the number for the calling side as it is, and limit the other one.
        granted = struct.pack(">BxHHH", _SETUP, calling, min(called, self._options.max_jobs), self.pdu_size)
        return _acknowledgement(reference, granted)

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
        return _acknowledgement(reference, bytes((_READ, parameters[1])), b"".join(parts))

    def _write(self, reference: int, parameters: memoryview, data: memoryview) -> bytes:
        codes = bytearray()
        with self._memory.lock:
            items = self._items(parameters, Fault.PROTECTED, Fault.WRITE_PROTECTED)
            values = _values(data, len(items))  # all of them, so that a malformed job stores nothing
            for item, value in zip(items, values, strict=True):
                codes.append(_write_item(item, value))
        return _acknowledgement(reference, bytes((_WRITE, len(items))), codes)

    def _items(self, parameters: memoryview, *denials: Fault) -> list[_Item]:
        items: list[_Item] = []
        at = 2
        while at + 4 <= len(parameters):
            if parameters[at + 2] == _DB_READ:
                end = at + 2 + parameters[at + 1]
                items.append(self._several(parameters[at + 4 : end], parameters[at + 3]))
            elif (end := at + _ITEM.size) <= len(parameters):
                items.append(self._item(_ITEM.unpack_from(parameters, at)))
            at = end
        if not items or len(items) != parameters[1] or at != len(parameters):
            raise _MalformedJobError
        if self._options.fault in denials:
            return [_Item(_DENIED, bytearray(), 0, 0, 0, item.type) for item in items]
        return items

    def _several(self, addresses: memoryview, count: int) -> _Item:
        """Return an item of parts of data blocks, as WinCC reads them from an S7-400: each with its own return code.

        Here the item as a whole is refused if one of its parts does not exist.
        """
        if not count or len(addresses) != count * _PART.size:
            raise _MalformedJobError
        values = bytearray()
        for size, number, start in _PART.iter_unpack(addresses):
            place = int(S7Area.DB) << 24 | start * 8
            part = self._item((0x12, 0x0A, 0x10, int(S7WordLen.BYTE), size, number, place))
            if part.code != _OK:
                return part._replace(type=_DB_READ)
            values.append(_OK)
            values += part.area[start : start + size]
        return _Item(_OK, values, 0, len(values), 0, _DB_READ)

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
        if kind in _NUMBERED.values() or known in _NUMBERED:
            if known is None or _NUMBERED.get(known) != kind:
                return _Item(_NO_SUCH_TYPE, nothing, 0, 0, 0, kind)
            start, bit = 2 * (place & 0xFFFF), 0
        if not count or (kind == _BIT and count != 1):
            return _Item(_TYPE_MISMATCH, nothing, 0, 0, 0, kind)
        if start + size > self._size(known, area) or (bit and kind != _BIT):
            return _Item(_OUT_OF_RANGE, nothing, 0, 0, 0, kind)
        return _Item(_OK, area, start, size, bit, kind)

    def _size(self, kind: S7Area | None, area: bytearray) -> int:
        if kind is not S7Area.DB:
            return len(area)
        return 0 if self._options.fault is Fault.OPTIMIZED else self._memory.size_of(area, self._options)


def _refusal(reference: int, error: int) -> bytes:
    """Build an answer with only a header error: ROSCTR 2, as S7-1200 and S7-1500 send it."""
    return _ANSWER.pack(_PROTOCOL, 2, 0, reference, 0, 0, error)


def _acknowledgement(reference: int, parameters: bytes, data: bytes | bytearray = b"") -> bytes:
    """Build the answer to a job that succeeded as a whole."""
    return _ANSWER.pack(_PROTOCOL, 3, 0, reference, len(parameters), len(data), 0) + parameters + data


def _read_item(item: _Item) -> bytes:
    if item.code != _OK:
        return _ITEM_HEAD.pack(item.code, 0, 0)
    _, transport, in_bits = _ANSWERS[item.type]
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
    if item.type in _READ_ONLY:
        return _DENIED
    if len(value) != item.size:
        return _TYPE_MISMATCH
    if item.type == _BIT:
        mask = 1 << item.bit
        item.area[item.start] = item.area[item.start] & ~mask | (mask if value[0] & 1 else 0)
    else:
        item.area[item.start : item.start + item.size] = value
    return _OK


# -- answers in parts ------------------------------------------------------------------------------------------------


class _Parts:
    """Cuts answers to userdata that do not fit a client's PDU into parts, which the client requests one by one."""

    def __init__(self) -> None:
        self._head, self._left = b"", b""
        self._sequence = 0

    def requested(self, request: bytes, size: int) -> bytes | None:
        """Return the next part if this is a request for one; None if it is not."""
        if len(request) < _USERDATA_DATA or request[1] != S7PDUType.USERDATA or request[14] != _NEXT_PART:
            return None
        if not self._left or request[17] != self._sequence:
            return self._part(request, b"", 0, code=_NO_SUCH_OBJECT)
        return self._next(request, size)

    def cut(self, request: bytes, answer: bytes, size: int) -> bytes:
        """Return an answer, or its first part of at most ``size`` bytes."""
        self._left = b""
        if len(answer) <= size or answer[1] != S7PDUType.USERDATA:
            return answer
        self._head, self._left = answer[:_USERDATA_DATA], answer[_USERDATA_DATA + _ITEM_HEAD.size :]
        self._sequence = self._sequence % 255 + 1
        return self._next(request, size)

    def _next(self, request: bytes, size: int) -> bytes:
        most = size - _USERDATA_DATA - _ITEM_HEAD.size
        part, self._left = self._left[:most], self._left[most:]
        return self._part(request, part, self._sequence)

    def _part(self, request: bytes, data: bytes, sequence: int, code: int = _OK) -> bytes:
        head = bytearray(self._head or request[:10] + _EMPTY_PARAMETERS)
        head[4:6] = request[4:6]
        head[8:10] = (len(data) + _ITEM_HEAD.size).to_bytes(2, "big")
        head[17], head[19] = sequence, bool(self._left)
        return bytes(head) + _ITEM_HEAD.pack(code, 0x09 if data else 0, len(data)) + data


# -- connections -------------------------------------------------------------------------------------------------------


class ViolationError(Exception):
    """The client breaks the protocol; the connection ends."""


class Inbox:
    """What a client sends, in a buffer of fixed size, as frames or as whole PDUs."""

    def __init__(self, client: socket.socket) -> None:
        self._client = client
        self._data = memoryview(bytearray(_INBOX_SIZE))
        self._start = self._end = 0
        self._parts = bytearray()  # of a PDU whose last TPDU has not come yet

    def receive(self) -> bool:
        """Wait for data. Return False if the client has left. Take all complete frames before."""
        left = self._end - self._start
        if self._start and left:
            self._data[:left] = self._data[self._start : self._end]
        self._start, self._end = 0, left
        received = self._client.recv_into(self._data[left:])
        self._end += received
        return received > 0

    def frame(self) -> memoryview | None:
        """Return the next frame, valid until the next ``receive``; None if it is not complete."""
        left = self._end - self._start
        if left < _FRAME_OVERHEAD:
            return None
        version, length = _TPKT.unpack_from(self._data, self._start)
        if version != 3 or not _FRAME_OVERHEAD <= length <= _LONGEST_FRAME:
            raise ViolationError
        if left < length:
            return None
        frame = self._data[self._start : self._start + length]
        self._start += length
        return frame

    def pdu(self) -> memoryview | None:
        """Return the next PDU, joined from its TPDUs, as :meth:`frame` does; skip empty TPDUs."""
        while (frame := self.frame()) is not None:
            if frame[4:6] != _DT[:2]:
                raise ViolationError
            pdu = frame[_FRAME_OVERHEAD:]
            if self._parts or not frame[6] & _EOT:
                self._parts += pdu
                if len(self._parts) > MAX_PDU_SIZE:
                    raise ViolationError
                if not frame[6] & _EOT:
                    continue
                pdu = memoryview(bytes(self._parts))
                self._parts.clear()
            if pdu:
                return pdu
        return None


class _Outbox:
    """The answers to a client: sent together at once or, with a profile, each when it is due."""

    def __init__(self, client: socket.socket, delays: Delays | None, stopping: threading.Event) -> None:
        self._client = client
        self._delays = delays
        self._stopping = stopping
        self._waiting: deque[tuple[int, bytes]] = deque()

    def put(self, kind: Kind, frame: bytes) -> None:
        """Add an answer."""
        due_ns = 0 if self._delays is None else self._delays.due_ns(kind, time.monotonic_ns())
        self._waiting.append((due_ns, frame))
        if self._delays is None and len(self._waiting) >= _ANSWERS_AT_ONCE:
            self.send()

    def send(self) -> None:
        """Send the answers that are due."""
        waiting = self._waiting
        if self._delays is None:
            if waiting:
                self._client.sendall(b"".join(frame for _, frame in waiting))
                waiting.clear()
            return
        while waiting and waiting[0][0] <= time.monotonic_ns():
            self._client.sendall(waiting.popleft()[1])

    def wait(self) -> bool:
        """Wait until the client sends, or an answer is due. Return whether there may be something to receive.

        If many answers wait, receive nothing more before the next one is sent.
        """
        if not self._waiting:
            return True
        full = len(self._waiting) >= MAX_JOBS
        ready, _, _ = select.select(() if full else (self._client,), (), (), self._left_s())
        return bool(ready)

    def finish(self) -> None:
        """Send what still waits when it is due: the client sends no more. The end of the server ends this."""
        while self._waiting and not self._stopping.wait(self._left_s()):
            self.send()

    def _left_s(self) -> float:
        return max(0, self._waiting[0][0] - time.monotonic_ns()) / 1e9


def _confirmed(request: memoryview) -> tuple[bytes, int]:
    """Return the frame that confirms a connection, and the number of bytes of a PDU that fit into a TPDU."""
    if request[5] & 0xF0 != _CONNECT or len(request) < 11:
        raise ViolationError
    given: dict[int, bytes] = {}
    at = 11
    while at + 2 <= len(request):
        end = at + 2 + request[at + 1]
        given[request[at]] = bytes(request[at + 2 : end])
        at = end
    asked = given.get(_TPDU_SIZE, b"")
    code = min(asked[0], _TPDU_CODE) if len(asked) == 1 and asked[0] >= 7 else _TPDU_CODE
    given[_TPDU_SIZE] = bytes((code,))
    parameters = b"".join(
        bytes((key, len(given[key]))) + given[key] for key in (_TPDU_SIZE, _CALLING_TSAP, _CALLED_TSAP) if key in given
    )
    head = struct.pack(">BB2sHB", 6 + len(parameters), _CONFIRM, bytes(request[8:10]), 1, 0)
    frame = _TPKT.pack(3, 4 + len(head) + len(parameters)) + head + parameters
    return frame, (1 << code) - 3


def _kind_of(pdu: memoryview) -> Kind:
    kinds: dict[int, Kind] = {_READ: "read", _WRITE: "write", _SETUP: "setup"}
    return kinds.get(pdu[10], "other") if pdu[1] == _JOB and len(pdu) > 10 else "other"


# -- the server --------------------------------------------------------------------------------------------------------


class S7Server(Server):
    """Serves data blocks to S7 clients on one address. Start and stop it once, or use ``with``.

    The server holds ``lock`` during each job. To change a block between two jobs, hold this lock.
    """

    def __init__(self, address: Address, *, max_clients: int = 16, options: ServerOptions | None = None) -> None:
        logging.getLogger("snap7.server").setLevel(logging.WARNING)  # the library logs each area
        super().__init__(log=False, max_clients=max_clients)
        self._options = options or ServerOptions()
        self.host, self.port = address.host, address.port
        self._memory = Memory(self.memory_areas)
        self.lock = self._memory.lock
        self._client_sockets: set[socket.socket] = set()
        self._beginners: dict[socket.socket, threading.Thread] = {}
        """The clients that have not set up communication yet, the oldest first."""
        self._stopping = threading.Event()
        self._checksums: dict[int, int] = {}
        self._accepted = 0  # number of clients so far

    def add_block(self, number: int, data: bytearray) -> None:
        """Serve ``data`` itself, not a copy, as data block ``number``.

        Raises:
            ConfigError: The number is in use or invalid.

        """
        if not 1 <= number <= 65535:
            raise ConfigError(f"DB{number}: data blocks are numbered 1 to 65535")
        if (S7Area.DB, number) in self.memory_areas:
            raise ConfigError(f"DB{number} is served already")
        self.register_area(SrvArea.DB, number, data)
        self._checksums[number] = zlib.crc32(data) & 0xFFFF
        self.area_locks[(S7Area.DB, number)] = self.lock  # for python-snap7's own code

    def add_area(self, area: SrvArea, data: bytearray) -> None:
        """Serve ``data`` itself, not a copy, as the inputs, outputs, markers, timers or counters."""
        self.register_area(area, 0, data)
        for kind, number in self.memory_areas:
            if number == 0:
                self.area_locks[(kind, number)] = self.lock  # for python-snap7's own code

    def replace(self, area: SrvArea, number: int, data: bytearray) -> None:
        """Serve ``data`` in place of the present data of an area or block. The caller holds ``lock``.

        Clients see the same block, with the same checksum, although it may be longer or shorter.
        """
        self.memory_areas[(S7Area[area.name], number)] = data

    def remove(self, area: SrvArea, number: int) -> None:
        """Stop serving an area or a block. The caller holds ``lock``."""
        self.unregister_area(area, number)
        if area is SrvArea.DB:
            self._checksums.pop(number, None)

    @property
    def address(self) -> Address:
        """Address on which the server listens, with the actual port if port 0 was requested.

        Raises:
            ShmioError: The server is not started.

        """
        if self.server_socket is None:
            raise ShmioError("the S7 server is not started")
        host, port = self.server_socket.getsockname()[:2]
        return Address(host, port)

    def start(self, tcp_port: int | None = None) -> int:
        """Listen on ``tcp_port`` (None: the configured port), and serve clients in threads.

        No other socket can share the port: SO_REUSEADDR, unlike SO_REUSEPORT, only ignores closed
        connections.

        Raises:
            EndpointError: The address is not available.

        """
        if self.running or self._stopping.is_set():
            raise ShmioError("an S7 server can be started only once")
        wanted = Address(self.host, self.port if tcp_port is None else tcp_port)
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(
                wanted.host, wanted.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            listener = socket.socket(family, kind, protocol)
        except OSError as error:
            raise EndpointError(cannot_listen(wanted, error)) from None
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(place)
            listener.listen()  # the largest backlog, so that excess clients are refused at once
        except OSError as error:
            listener.close()
            raise EndpointError(cannot_listen(wanted, error)) from None
        self.server_socket = listener
        self.running = True
        self.state = ServerState.RUNNING
        self.cpu_state = CPUState.RUN
        self.server_thread = threading.Thread(target=self._server_loop, name=f"s7-listen-{wanted}", daemon=True)
        self.server_thread.start()
        return 0

    def stop(self) -> int:
        """Close all sockets and wait for all threads.

        Raises:
            ShmioError: A thread does not end, which would be a defect.

        """
        if not self.running:
            return 0
        self.running = False
        self._stopping.set()
        self.state = ServerState.STOPPED
        self.cpu_state = CPUState.STOP
        assert self.server_socket is not None  # noqa: S101 - start() set both
        assert self.server_thread is not None  # noqa: S101
        # On Linux this wakes a thread that waits in accept() or recv(); closing alone does not.
        with contextlib.suppress(OSError):
            self.server_socket.shutdown(socket.SHUT_RDWR)
        self.server_thread.join(_JOIN_TIMEOUT_S)
        self.server_socket.close()
        self.server_socket = None
        with self.client_lock:
            threads = self.clients[:]
            for client in self._client_sockets:
                with contextlib.suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join(_JOIN_TIMEOUT_S)
        if self.server_thread.is_alive() or any(thread.is_alive() for thread in threads):
            raise ShmioError("a thread of the S7 server does not end")
        return 0

    def __enter__(self) -> Self:
        return self

    # -- threads -------------------------------------------------------------------------------------------------------

    def _server_loop(self) -> None:
        listener = self.server_socket
        assert listener is not None  # noqa: S101 - start() set it
        while not self._stopping.is_set():
            try:
                client, _ = listener.accept()
            except OSError as error:
                if not self._stopping.is_set():  # the client has left, or no descriptor is free
                    logger.warning("the emulator cannot accept a connection: %s", error)
                    self._stopping.wait(0.1)
                continue
            try:
                self._admit(client)
            except (OSError, RuntimeError) as error:  # the client has gone, or no thread can start
                logger.warning("the emulator refused a client: %s", error)
                client.close()

    def _admit(self, client: socket.socket) -> None:
        """Start a thread for the client, if there is room: clients that never set up communication make room."""
        address = client.getpeername()
        self._make_room()
        with self.client_lock:
            if self.client_count >= self.max_clients:
                raise RuntimeError(f"{address[0]}: there are {self.max_clients} clients already")
            thread = threading.Thread(
                target=self._handle_client, args=(client, address), name=f"s7-client-{address[1]}", daemon=True
            )
            thread.start()
            self.clients.append(thread)
            self._client_sockets.add(client)
            self._beginners[client] = thread
            self.client_count += 1

    def _make_room(self) -> None:
        """If there is no room, disconnect the oldest client that has not set up communication."""
        with self.client_lock:
            if self.client_count < self.max_clients or not self._beginners:
                return
            oldest, thread = next(iter(self._beginners.items()))
            with contextlib.suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)
        thread.join(_JOIN_TIMEOUT_S)

    def _handle_client(self, client_socket: socket.socket, address: tuple[str, int]) -> None:
        try:
            with contextlib.suppress(OSError):  # the client has gone
                self._serve(client_socket, address)
        finally:
            with self.client_lock:  # waits until _admit has registered the client
                self.clients.remove(threading.current_thread())
                self._client_sockets.discard(client_socket)
                self._beginners.pop(client_socket, None)
                self.client_count -= 1
                client_socket.close()

    def _serve(self, client: socket.socket, address: tuple[str, int]) -> None:
        """Answer one client, with a buffer of fixed size, until the client leaves or breaks the protocol."""
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE.items():
            client.setsockopt(socket.IPPROTO_TCP, option, value)
        inbox = Inbox(client)
        with self.client_lock:
            self._accepted += 1
            seed = self._accepted
        delays = None if self._options.profile is None else Delays(self._options.profile, seed)
        outbox = _Outbox(client, delays, self._stopping)
        with contextlib.suppress(ViolationError):
            self._answer(client, inbox, outbox, address, self._connect(client, inbox, outbox))

    @staticmethod
    def _connect(client: socket.socket, inbox: Inbox, outbox: _Outbox) -> int:
        """Open the ISO-on-TCP connection in time; return the number of bytes of a PDU that fit into a TPDU."""
        deadline = time.monotonic() + _CONNECT_TIMEOUT_S
        while (request := inbox.frame()) is None:
            client.settimeout(max(0.001, deadline - time.monotonic()))
            if not inbox.receive() or time.monotonic() > deadline:
                raise ViolationError
        confirm, longest = _confirmed(request)
        client.setblocking(True)  # only sends time out, so a silent client may stay
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", _SEND_TIMEOUT_S, 0))
        outbox.put("confirm", confirm)
        return longest

    def _answer(
        self, client: socket.socket, inbox: Inbox, outbox: _Outbox, address: tuple[str, int], longest: int
    ) -> None:
        jobs, parts = Jobs(self._memory, self._options, longest), _Parts()
        while True:
            while (pdu := inbox.pdu()) is not None:
                if len(pdu) < _JOB_HEAD.size:
                    raise ViolationError
                answer = jobs.answer(pdu)
                if answer is None:
                    answer = self._process_in_parts(bytes(pdu), address, jobs, parts)
                if answer:
                    outbox.put(_kind_of(pdu), _TPKT.pack(3, len(answer) + _FRAME_OVERHEAD) + _DT + answer)
            if jobs.pdu_size and client in self._beginners:
                with self.client_lock:
                    self._beginners.pop(client, None)
            outbox.send()
            if outbox.wait() and not inbox.receive():
                break
        outbox.finish()

    def _process_in_parts(self, request: bytes, address: tuple[str, int], jobs: Jobs, parts: _Parts) -> bytes:
        """Answer what is no job to read, to write or to set up; return no bytes if no answer is due.

        Raises:
            ViolationError: The client does not speak S7.

        """
        size = jobs.longest
        if _needs_no_answer(request):
            return b""
        part = parts.requested(request, size)
        if part is not None:
            return part
        answer = self._process_request(request, address)
        if answer is None:
            raise ViolationError
        return parts.cut(request, answer, size)

    def _process_request(self, request_data: bytes, client_address: tuple[str, int]) -> bytes | None:
        """Answer a request other than a job to read, to write or to set up.

        python-snap7 answers the requests that are safe; all others are refused.
        """
        protocol, kind, function = request_data[0], request_data[1], request_data[10] if len(request_data) > 10 else 0
        if protocol != _PROTOCOL:  # such as S7comm-plus
            return None
        if (
            kind == S7PDUType.USERDATA
            or (kind, function) == (S7PDUType.REQUEST, S7Function.PLC_STOP)
            or ((kind, function) == (S7PDUType.REQUEST, S7Function.PLC_CONTROL) and _is_served(request_data))
        ):
            return super()._process_request(request_data, client_address)
        if request_data[6:] == _IS_IT_RUNNING and kind == S7PDUType.REQUEST and self.cpu_state == CPUState.RUN:
            return _acknowledgement(int.from_bytes(request_data[4:6], "big"), bytes((_READ, 0)))
        if kind == S7PDUType.REQUEST:
            return _refusal(int.from_bytes(request_data[4:6], "big"), _NOT_AVAILABLE)
        return None

    def load_block(self, number: int, data: bytearray) -> None:
        """Replace the data block ``number``, as when the programming tool loads a changed block."""
        with self.lock:
            self.memory_areas[(S7Area.DB, number)] = data
            self._checksums[number] = zlib.crc32(data) & 0xFFFF

    def _handle_get_block_info(
        self,
        request: dict[str, Any],
        userdata_params: dict[str, Any],
        client_address: tuple[str, int],  # noqa: ARG002
    ) -> bytes:
        """Answer with a block's length, as limited by the options, and the checksum of its data when loaded."""
        asked = request.get("data", {}).get("data", b"")
        digits = bytes(asked[2:7])
        number = int(digits) if digits.isdigit() else 0
        area = self.memory_areas.get((S7Area.DB, number))
        if bytes(asked[:2]) != b"0A" or area is None or self._options.fault is Fault.OPTIMIZED:
            return self._build_userdata_error_response(request, 0)
        size = self._memory.size_of(area, self._options)
        checksum = self._checksums.get(number, 0)
        head = struct.pack(">2s9sBHI16x", b"0A", b"", 0x0A, number, size + _BLOCK_HEAD)
        info = head + struct.pack(">6xH8s8s8sBxH8x", size & 0xFFFF, b"shmio", b"", b"", 1, checksum)
        answer: bytes = self._build_userdata_success_response(request, userdata_params, info)
        return answer

    def _build_userdata_error_response(self, request: dict[str, Any], error_code: int) -> bytes:  # noqa: ARG002
        """Refuse a request as a CPU does: with an error in the parameters, and without data."""
        raw = request.get("raw_parameters", b"").ljust(8, b"\0")
        group, function, sequence = raw[5] & 0x0F, raw[6], raw[7]
        parameters = struct.pack(
            ">3s5BxxH", b"\0\1\x12", 8, 0x12, 0x80 | group, function, sequence,
            _REFUSALS.get((group, function), _NO_SERVICE),
        )  # fmt: skip
        head = _JOB_HEAD.pack(
            _PROTOCOL, S7PDUType.USERDATA, request.get("sequence", 0), len(parameters), _ITEM_HEAD.size
        )
        return head + parameters + _ITEM_HEAD.pack(_NO_SUCH_OBJECT, 0, 0)

    def _get_szl_data(self, szl_id: int, szl_index: int) -> bytes | None:
        """Return a system status list with its head, as in the manual of S7-300/400.

        For the lists of this module, ``szl_index`` has no effect: the list is always whole. The list
        with the operating mode lacks the previous mode, which shares its byte: with it, Snap7's
        ``Cli_GetPlcStatus`` would report STOP for a CPU in RUN that was in STOP before.
        """
        if szl_id == _MODE_LIST:
            mode = _RUN if self.cpu_state == CPUState.RUN else _STOP
            records = [struct.pack(">HBB16x", 0x4302 if mode == _RUN else 0x4303, 0xFF, mode)]
        elif szl_id == _MODULE_LIST:
            records = [struct.pack(">H20sH4s", index, _ORDER_CODE, 0, version) for index, version in _VERSIONS.items()]
        elif szl_id == _COMPONENT_LIST:
            records = [struct.pack(">H32s", index, text) for index, text in _COMPONENTS.items()]
        else:
            found: bytes | None = super()._get_szl_data(szl_id, szl_index)
            return found
        return struct.pack(">HH", len(records[0]), len(records)) + b"".join(records)


def _needs_no_answer(pdu: bytes) -> bool:
    """Return whether a PDU only acknowledges or informs: an Ack, or userdata that is no request."""
    if pdu[1] == S7PDUType.USERDATA:
        return len(pdu) > 15 and pdu[0] == _PROTOCOL and pdu[15] >> 4 != _SENT_TO_CPU
    return pdu[0] == _PROTOCOL and pdu[1] in {S7PDUType.ACK, S7PDUType.ACK_DATA}


def _is_served(job: bytes) -> bool:
    """Return whether a PLC control job is for one of ``_SERVICES``.

    The parameters of the job, as in Wireshark's S7 dissector, are: the function and 7 bytes; the
    argument after its length (2 bytes); the name of the service after its length (1 byte).
    python-snap7 searches all of them for a name, and treats a job without one as a start.
    Therefore this function accepts a job only if exactly one name occurs.
    """
    parameters = job[10 : 10 + int.from_bytes(job[6:8], "big")]
    argument_size = int.from_bytes(parameters[_SERVICE_ARGUMENT : _SERVICE_ARGUMENT + 2], "big")
    name = parameters[_SERVICE_ARGUMENT + 2 + argument_size :]
    return any(name == bytes((len(service),)) + service for service in _SERVICES) and (
        sum(service in parameters for service in _SERVICES) == 1
    )
