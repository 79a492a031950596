"""A Modbus client over TCP that sends one request at a time and checks its answer strictly.

Each answer must have the transaction, unit and function of the request, and exactly the requested
length. Any other answer ends the connection, and so does a time-out, so that the client never mistakes
a late answer for the answer to the next request. There is one exception: a caller of ``read`` may stop
waiting before the time-out. Then the client remembers the transaction, and discards the answer if it
comes late. Frames of RTU have no transaction. There, the client opens a new connection instead, and
discards what has come before each request.

Some devices close the connection after each answer, or after a short silence. So the client repeats a
read once on a new connection if the device has closed the old one. It never repeats a write: it only
looks before each write whether the device has closed the connection already, and then opens a new one.

shmio does not use the client of pymodbus, which skips all unexpected answers, and repeats writes after
a time-out.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import time
from collections.abc import Iterator
from typing import Final, Literal

from shmio.connectors import tcp
from shmio.errors import ConnectorError
from shmio.layout.addresses.modbus import Table

READ: Final = {Table.COIL: 1, Table.DISCRETE: 2, Table.HOLDING: 3, Table.INPUT: 4}
WRITE_COIL, WRITE_WORD, WRITE_COILS, WRITE_WORDS, MASK_WORD = 5, 6, 15, 16, 22
MAX_WRITE_WORDS: Final = 123
MAX_WRITE_BITS: Final = 1968
log = logging.getLogger("shmio.source")

Framing = Literal["tcp", "rtu"]
_READS: Final = frozenset(READ.values())
_HEADER: Final = 7
_MAX_PDU: Final = 253
_RTU_EXCEPTION: Final = 5
"""Length of an exception in RTU: unit, function, exception, and two bytes of the checksum."""
_FAILED: Final = 0x80
MAX_ABANDONED: Final = 256
"""Maximum number of requests without an answer whose late answers are still recognized and discarded."""

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE, ACKNOWLEDGE, BUSY = 1, 2, 3, 4, 5, 6
PARITY, NO_PATH, NO_ANSWER = 8, 10, 11
_NAMES: Final = {
    ILLEGAL_FUNCTION: "illegal function", ILLEGAL_ADDRESS: "illegal data address", ILLEGAL_VALUE: "illegal data value",
    DEVICE_FAILURE: "device failure", BUSY: "device busy",
    ACKNOWLEDGE: "acknowledged, but not done yet; it may still be done",
    PARITY: "memory parity error", NO_PATH: "gateway path unavailable",
    NO_ANSWER: "no answer from the unit behind the gateway",
}  # fmt: skip


class RefusedError(ConnectorError):
    """The device answered with an exception; ``code`` is its number (specification, section 7)."""

    def __init__(self, code: int, *functions: int) -> None:
        named = " and ".join(map(str, functions))
        what = f"function{'s' if len(functions) > 1 else ''} {named}"
        super().__init__(f"the device refuses {what}: {_NAMES.get(code, 'unknown exception')} (exception {code})")
        self.code, self.functions = code, functions


class SilentError(ConnectorError):
    """The unit did not answer before ``until_ns``. The connection stays open."""


class _ClosedError(Exception):
    """The device has closed the connection."""


class ModbusClient:
    """The connection to one device or gateway. Use it from one thread."""

    def __init__(self, host: str, port: int, timeout_ms: int, framing: Framing = "tcp") -> None:
        self._host, self._port, self._timeout_ms, self._rtu = host, port, timeout_ms, framing == "rtu"
        self.peer = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        """``host:port`` for messages, with IPv6 addresses in brackets."""
        self._socket: socket.socket | None = None
        self._transaction = 0  # continues after a reconnect, so that a late answer matches no new request
        self._deadline_ns = 0
        self._received = bytearray()  # the beginning of an answer that is not complete yet
        self._abandoned: dict[int, tuple[int, int]] = {}  # by transaction: unit and function; the oldest first
        self._answers = 0  # on the present connection
        self._answered = False  # at least once, on any connection
        self._closed_after = 0  # number of answers after which the device has closed a connection; 0: unknown
        self._reconnected = False
        self.sent = False
        """True if any byte of the last write request may have left this host."""

    def begin(self) -> None:
        """Start the time-out for the requests that follow."""
        self._deadline_ns = time.monotonic_ns() + self._timeout_ms * 1_000_000

    @property
    def left_ns(self) -> int:
        """The time in ns until the time-out; 0 if it has passed."""
        return max(0, self._deadline_ns - time.monotonic_ns())

    @property
    def connected(self) -> bool:
        """True if the connection is open, as far as the client knows."""
        return self._socket is not None

    def connect(self) -> None:
        """Look up the host name and connect. The time-out applies to each of these two steps.

        Raises:
            ConnectorError: The device cannot be reached.

        """
        self._connect(self._timeout_ms / 1000)

    def _connect(self, timeout_s: float) -> None:
        self.close()
        try:
            self._socket = tcp.connect(tcp.look_up(self._host, self._port, timeout_s), timeout_s)
        except OSError as error:
            raise self._explained(error) from None

    def _connect_again(self) -> None:
        """Connect again, within the time-out of the present requests; say so once in the log."""
        if not self._reconnected:
            self._reconnected = True
            log.info("%s closes its connections; shmio opens a new one each time", self.peer)
        try:
            left_s = self._left_s(None)
        except TimeoutError as error:
            self.close()
            raise self._explained(error) from None
        self._connect(left_s)

    def close(self) -> None:
        """Close the connection. You may call this at any time and more than once."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._received.clear()
        self._abandoned.clear()
        self._answers = 0

    def read(self, unit: int, table: Table, start: int, count: int, until_ns: int | None = None) -> bytes:
        """Read entries of a table; return the device's bytes. Bits are packed into bytes from the lowest bit on.

        Args:
            unit: Unit id.
            table: The table.
            start: First entry.
            count: Number of entries.
            until_ns: Time at which to raise SilentError, in ns of CLOCK_MONOTONIC; the connection
                then stays open. None: wait until the time-out, which closes the connection.

        Raises:
            RefusedError: The device refuses the request. The connection stays open.
            SilentError: There is no answer by ``until_ns``. The connection stays open.
            ConnectorError: The connection is lost, the answer is wrong, or none came within the
                time-out. The connection is closed.

        """
        size = -(-count // 8) if table.of_bits else 2 * count
        answer = self.call(unit, READ[table], start.to_bytes(2, "big") + count.to_bytes(2, "big"), 1 + size, until_ns)
        if answer[0] != size:
            raise self._failed(unit, READ[table], f"it answered with {answer[0]} bytes instead of {size}")
        return answer[1:]

    def write(self, unit: int, function: int, data: bytes) -> None:
        """Send a write request, and check the confirmation, which repeats the beginning of the request.

        Args:
            unit: Unit id.
            function: Function code.
            data: The request after the function code.

        Raises:
            RefusedError: The device refuses the request. The connection stays open.
            ConnectorError: The connection is lost.

        """
        echo = 6 if function == MASK_WORD else 4
        if self.call(unit, function, data, echo) != data[:echo]:
            raise self._failed(unit, function, "its confirmation does not match the write request")

    def call(self, unit: int, function: int, data: bytes, size: int, until_ns: int | None = None) -> bytes:
        """Send a request; return the data of the answer, which must have ``size`` bytes.

        Raises:
            RefusedError, SilentError, ConnectorError: As for :meth:`read`.

        """
        self.sent = False
        if self._socket is None:
            raise ConnectorError(f"not connected to {self.peer}")
        if self._gone(function):
            self._connect_again()
        exchange = self._exchange_rtu if self._rtu else self._exchange_tcp
        try:
            try:
                code, found = exchange(unit, function, data, size, until_ns)
            except _ClosedError:
                self._closed_after = self._answers
                if function not in _READS:
                    raise
                self._connect_again()
                code, found = exchange(unit, function, data, size, until_ns)
        except _ClosedError:
            self.close()
            raise ConnectorError(f"{self.peer} closed the connection") from None
        except OSError as error:
            hint = self._rtu_hint(unit, function)
            if isinstance(error, TimeoutError) and not (hint or self._rtu or self._answered):
                hint = '; if the device speaks Modbus RTU over TCP, write framing = "rtu"'
            self.close()
            raise ConnectorError(f"{self._explained(error)}{hint}") from None
        self._answers += 1
        self._answered = True
        if self._answers > self._closed_after:
            self._closed_after = 0
        if code & _FAILED:
            raise RefusedError(found[0], function)
        return found

    def _gone(self, function: int) -> bool:
        """Return whether the device has closed the connection, or is about to; in RTU, also discard what came late."""
        assert self._socket is not None  # noqa: S101  the caller has checked it
        if self._answers and self._answers == self._closed_after and function not in _READS:
            return True  # a read may meet the end of the connection, because it can be repeated
        self._socket.settimeout(0)
        try:
            for _ in range(_MAX_PDU):
                found = self._socket.recv(_MAX_PDU, 0 if self._rtu else socket.MSG_PEEK)
                if found and not self._rtu:
                    return False
                if not found:
                    break
        except BlockingIOError:
            return False
        except OSError:
            pass
        self._closed_after = self._answers
        return True

    def _send(self, request: bytes, function: int) -> None:
        assert self._socket is not None  # noqa: S101  call() has checked it
        self._socket.settimeout(self._left_s(None))
        self.sent = function not in _READS
        try:
            self._socket.sendall(request)
        except ConnectionError:
            raise _ClosedError from None

    def _exchange_tcp(
        self, unit: int, function: int, data: bytes, size: int, until_ns: int | None
    ) -> tuple[int, bytes]:
        """Send a request; return the function code and the data of its answer."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        while self._transaction in self._abandoned:
            self._transaction = (self._transaction + 1) & 0xFFFF
        head = self._transaction.to_bytes(2, "big") + b"\0\0"
        request = head + (2 + len(data)).to_bytes(2, "big") + bytes((unit, function)) + data
        self._send(request, function)
        try:
            while True:
                self._receive(_HEADER + 1, until_ns)
                got = bytes(self._received[: _HEADER + 1])
                length = int.from_bytes(got[4:6], "big") - 2
                transaction, code = int.from_bytes(got[:2], "big"), got[7] & ~_FAILED
                late = self._abandoned.get(transaction)
                if got[2:4] != head[2:]:
                    raise self._failed(unit, function, f"its answer names protocol {int.from_bytes(got[2:4], 'big')}")
                if late is None and transaction != self._transaction:
                    what = f"it answered transaction {transaction}, a request that is not in flight; transaction "
                    raise self._failed(unit, function, f"{what}{self._transaction} is")
                if (got[6], code) != (late or (unit, function)) or not 0 <= length < _MAX_PDU:
                    raise self._foreign(late or (unit, function), (got[6], code))
                if got[7] & _FAILED and length != 1:
                    raise self._failed(unit, function, f"its exception has {length} bytes instead of 1")
                if late is None and not got[7] & _FAILED and length != size:
                    raise self._failed(unit, function, f"it answered with {length} bytes instead of {size}")
                self._receive(_HEADER + 1 + length, until_ns)
                found = bytes(self._received[_HEADER + 1 : _HEADER + 1 + length])
                del self._received[: _HEADER + 1 + length]
                if late is None:
                    return got[7], found
                del self._abandoned[transaction]
        except SilentError:
            self._abandoned[self._transaction] = unit, function
            if len(self._abandoned) > MAX_ABANDONED:
                del self._abandoned[next(iter(self._abandoned))]
            raise

    def _exchange_rtu(
        self, unit: int, function: int, data: bytes, size: int, until_ns: int | None
    ) -> tuple[int, bytes]:
        """Send a request as a frame of RTU; return the function code and the data of its answer."""
        request = bytes((unit, function)) + data
        self._send(request + crc(request), function)
        try:
            self._receive(_RTU_EXCEPTION, until_ns)
            code = self._received[1]
            length = _RTU_EXCEPTION if code & _FAILED else size + 4
            if (self._received[0], code & ~_FAILED) != (unit, function):
                raise self._foreign((unit, function), (self._received[0], code & ~_FAILED))
            if function in _READS and not code & _FAILED and self._received[2] != size - 1:
                raise self._failed(
                    unit, function, f"it answered with {self._received[2]} bytes of data instead of {size - 1}"
                )
            self._receive(length, until_ns)
        except SilentError:
            self._connect_again()  # an answer that comes late on the old connection is lost
            raise
        frame = bytes(self._received)
        self._received.clear()
        if crc(frame[:-2]) != frame[-2:]:
            raise self._failed(unit, function, "its answer has a wrong checksum")
        return code, frame[2:-2]

    def _receive(self, size: int, until_ns: int | None) -> None:
        """Receive until ``size`` bytes of an answer are there, and never a byte of the next answer."""
        while len(self._received) < size:
            if self._socket is None:
                raise _ClosedError
            left_s = self._left_s(until_ns)
            self._socket.settimeout(left_s)
            try:
                part = self._socket.recv(size - len(self._received))
            except TimeoutError:
                self._left_s(until_ns)  # raises SilentError after until_ns
                raise
            except ConnectionError:
                raise _ClosedError from None
            if not part:
                raise _ClosedError
            self._received += part

    def _left_s(self, until_ns: int | None) -> float:
        now_ns = time.monotonic_ns()
        left_ns = self._deadline_ns - now_ns
        if until_ns is not None:
            left_ns = min(left_ns, until_ns - now_ns)
            if left_ns <= 0:
                raise SilentError(f"no answer in time from a unit at {self.peer}")
        if left_ns <= 0:
            raise TimeoutError
        return left_ns / 1e9

    def _foreign(self, wanted: tuple[int, int], found: tuple[int, int]) -> ConnectorError:
        """Return the error for an answer of another unit, or to another function. Both are (unit, function)."""
        name, place = ("unit", 0) if wanted[0] != found[0] else ("function", 1)
        what = f"its answer does not belong to the request: {name} {found[place]} instead of {wanted[place]}"
        return self._failed(*wanted, what)

    def _failed(self, unit: int, function: int, what: str) -> ConnectorError:
        """Close the connection, and return an error about a wrong answer."""
        rtu = self._rtu_hint(unit, function)
        self.close()
        return ConnectorError(f"{self.peer} does not answer as a Modbus device does: {what}{rtu}")

    def _rtu_hint(self, unit: int, function: int) -> str:
        """Return a remedy if the answer, or its beginning, is a frame of RTU."""
        if self._rtu or self._socket is None or len(self._received) < 2 or self._answered:
            return ""
        self._socket.settimeout(0)
        with contextlib.suppress(OSError):
            self._received += self._socket.recv(_MAX_PDU)
        frame = bytes(self._received)
        sizes = (_RTU_EXCEPTION, 8, 5 + frame[2] if len(frame) > 2 else 0)
        if (
            frame[0] == unit
            and frame[1] & ~_FAILED == function
            and any(size <= len(frame) and crc(frame[: size - 2]) == frame[size - 2 : size] for size in sizes if size)
        ):
            return '; the answer is a frame of Modbus RTU: write framing = "rtu"'
        return ""

    def _explained(self, error: OSError) -> ConnectorError:
        if isinstance(error, TimeoutError):
            return ConnectorError(f"no answer within {self._timeout_ms} ms from {self.peer}")
        if isinstance(error, ConnectionRefusedError):
            return tcp.refused(self.peer)
        if isinstance(error, socket.gaierror):
            return tcp.unresolved(self._host, error)
        if isinstance(error, ConnectionError):
            return ConnectorError(f"{self.peer} closed the connection")
        return ConnectorError(f"{self.peer} cannot be reached: {error.strerror or error}")


def _table() -> Iterator[int]:
    for number in range(256):
        for _ in range(8):
            number = number >> 1 ^ (0xA001 if number & 1 else 0)  # noqa: PLW2901
        yield number


_CRC: Final = tuple(_table())


def crc(data: bytes) -> bytes:
    """Return the checksum of a frame of RTU, as it is sent ("MODBUS over Serial Line", section 6.2.2)."""
    found = 0xFFFF
    for byte in data:
        found = found >> 8 ^ _CRC[(found ^ byte) & 0xFF]
    return found.to_bytes(2, "little")
