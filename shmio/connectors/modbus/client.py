"""A Modbus TCP client that sends one request at a time and checks its answer strictly.

Each answer must have the transaction, unit and function of the request, and exactly the requested
length. Any other answer ends the connection, and so does a time-out, so that the client never mistakes
a late answer for the answer to the next request. There is one exception: a caller of ``read`` may stop
waiting before the time-out. Then the client remembers the transaction, and discards the answer if it
comes late. shmio does not use the client of pymodbus, which skips all unexpected answers, and repeats
writes after a time-out.
"""

from __future__ import annotations

import socket
import time
from typing import Final

from shmio.connectors import tcp
from shmio.errors import ConnectorError
from shmio.layout.addresses.modbus import Table

READ: Final = {Table.COIL: 1, Table.DISCRETE: 2, Table.HOLDING: 3, Table.INPUT: 4}
WRITE_COIL, WRITE_WORD, WRITE_COILS, WRITE_WORDS, MASK_WORD = 5, 6, 15, 16, 22
MAX_WRITE_WORDS: Final = 123
MAX_WRITE_BITS: Final = 1968
_HEADER: Final = 7
_MAX_PDU: Final = 253
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

    def __init__(self, code: int) -> None:
        super().__init__(f"the device refuses the request: {_NAMES.get(code, 'unknown exception')} (exception {code})")
        self.code = code


class SilentError(ConnectorError):
    """The unit did not answer before ``until_ns``. The connection stays open."""


class ModbusClient:
    """The connection to one device or gateway. Use it from one thread."""

    def __init__(self, host: str, port: int, timeout_ms: int) -> None:
        self._host, self._port, self._timeout_ms = host, port, timeout_ms
        self.peer = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        """``host:port`` for messages, with IPv6 addresses in brackets."""
        self._socket: socket.socket | None = None
        self._transaction = 0  # continues after a reconnect, so that a late answer matches no new request
        self._deadline_ns = 0
        self._received = bytearray()  # the beginning of an answer that is not complete yet
        self._abandoned: dict[int, tuple[int, int]] = {}  # by transaction: unit and function; the oldest first
        self.sent = False
        """True if any byte of the last request may have left this host."""

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
        self.close()
        try:
            timeout_s = self._timeout_ms / 1000
            self._socket = tcp.connect(tcp.look_up(self._host, self._port, timeout_s), timeout_s)
        except OSError as error:
            raise self._explained(error) from None

    def close(self) -> None:
        """Close the connection. You may call this at any time and more than once."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._received.clear()
        self._abandoned.clear()

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
            raise self._failed(f"it answered with {answer[0]} bytes instead of {size}")
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
            raise self._failed("its confirmation does not match the write request")

    def call(self, unit: int, function: int, data: bytes, size: int, until_ns: int | None = None) -> bytes:
        """Send a request; return the data of the answer, which must have ``size`` bytes.

        Raises:
            RefusedError, SilentError, ConnectorError: As for :meth:`read`.

        """
        self.sent = False
        if self._socket is None:
            raise ConnectorError(f"not connected to {self.peer}")
        self._transaction = (self._transaction + 1) & 0xFFFF
        while self._transaction in self._abandoned:
            self._transaction = (self._transaction + 1) & 0xFFFF
        head = self._transaction.to_bytes(2, "big") + b"\0\0"
        request = head + (2 + len(data)).to_bytes(2, "big") + bytes((unit, function)) + data
        try:
            self._socket.settimeout(self._left_s(None))
            self.sent = True
            self._socket.sendall(request)
            while True:
                self._receive(_HEADER + 1, until_ns)
                got = bytes(self._received[: _HEADER + 1])
                length = int.from_bytes(got[4:6], "big") - 2
                transaction, code = int.from_bytes(got[:2], "big"), got[7] & ~_FAILED
                late = self._abandoned.get(transaction)
                if got[2:4] != head[2:] or (late is None and transaction != self._transaction):
                    raise self._failed("it answered a request that is not in flight")
                if (got[6], code) != (late or (unit, function)) or not 0 <= length < _MAX_PDU:
                    raise self._failed("its answer does not belong to the request")
                if got[7] & _FAILED and length != 1:
                    raise self._failed("its answer does not belong to the request")
                if late is None and not got[7] & _FAILED and length != size:
                    raise self._failed(f"it answered with {length} bytes instead of {size}")
                self._receive(_HEADER + 1 + length, until_ns)
                found = bytes(self._received[_HEADER + 1 : _HEADER + 1 + length])
                del self._received[: _HEADER + 1 + length]
                if late is None:
                    break
                del self._abandoned[transaction]
        except SilentError:
            self._abandoned[self._transaction] = unit, function
            if len(self._abandoned) > MAX_ABANDONED:
                del self._abandoned[next(iter(self._abandoned))]
            raise
        except OSError as error:
            self.close()
            raise self._explained(error) from None
        if got[7] & _FAILED:
            raise RefusedError(found[0])
        return found

    def _receive(self, size: int, until_ns: int | None) -> None:
        """Receive until ``size`` bytes of an answer are there, and never a byte of the next answer."""
        while len(self._received) < size:
            if self._socket is None:
                raise ConnectionResetError
            left_s = self._left_s(until_ns)
            self._socket.settimeout(left_s)
            try:
                part = self._socket.recv(size - len(self._received))
            except TimeoutError:
                self._left_s(until_ns)  # raises SilentError after until_ns
                raise
            if not part:
                raise ConnectionResetError
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

    def _failed(self, what: str) -> ConnectorError:
        """Close the connection, and return an error about a wrong answer."""
        self.close()
        return ConnectorError(f"{self.peer} does not answer as a Modbus device does: {what}")

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
