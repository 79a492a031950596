"""A client that reads one data block as fast as the controller answers. Blocking; for one thread."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.blockread import BlockRead
from shmio.connectors.s7.options import S7Options
from shmio.errors import ConfigError, ConnectorError

_TIMEVAL = struct.Struct("@ll")
_HANDSHAKE_FRAME = 512  # more than any connection confirm


class S7Client:
    """Reads one block of one controller.

    After any error the socket is closed: an answer that comes late must never be taken for the next one.
    ``connect`` may be called again at any time.
    """

    def __init__(self, options: S7Options, db_number: int, size: int) -> None:
        """Prepare to read bytes 0 to ``size - 1`` of DB ``db_number``; ConfigError if S7 cannot address that."""
        if not 1 <= size <= pdu.MAX_BLOCK_SIZE:
            raise ConfigError(f"DB{db_number} of {size} bytes: S7 reads blocks of 1 to {pdu.MAX_BLOCK_SIZE} bytes")
        if not 1 <= db_number <= 65535:
            raise ConfigError(f"DB{db_number}: data blocks are numbered 1 to 65535")
        self.options = options
        self.db_number = db_number
        self.size = size
        self._timeout_s = options.timeout / 1000
        self._socket: socket.socket | None = None
        self._session = pdu.Session(0, 0)
        self._reference = 0  # never begun again, not even by a reconnect: old answers stay unknown
        self._round_trip_ns = 0
        self._use(pdu.Session(0, 0))

    @property
    def connected(self) -> bool:
        """Whether a session is open, as far as is known."""
        return self._socket is not None

    @property
    def pdu_size(self) -> int:
        """Bytes in the largest PDU as granted; 0 before the first session."""
        return self._session.pdu_size

    @property
    def jobs(self) -> int:
        """Requests kept under way: as granted, capped by ``maxJobs``; 0 before the first session."""
        return self._session.jobs

    @property
    def round_trip_ns(self) -> int:
        """From sending the first request of the last read to its first answer; 0 before the first."""
        return self._round_trip_ns

    def connect(self) -> None:
        """Open a session, within ``timeout`` in all (looking up a host name excepted).

        ConnectorError: nobody there, not an S7 controller, session refused.
        """
        self.close()
        with self._dropping_on_error(opening=True):
            self._open()
            self._send(pdu.connect_request(self.options.rack, self.options.cpu_slot))
            tpdu_size = pdu.parse_connect_confirm(self._next_frame())
            asked = pdu.Session(min(pdu.WANTED_PDU_SIZE, tpdu_size - 3), pdu.WANTED_JOBS)
            reference = self._take_references(1)
            self._send(pdu.setup_request(reference, asked.jobs, asked.pdu_size))
            granted = pdu.parse_setup_answer(self._next_frame(), reference, asked)
            if self._start != self._end:
                raise ConnectorError("unexpected bytes after the session was set up")
            self._use(granted)

    def read(self) -> bytes:
        """Read the whole block, within ``timeout``.

        Returns ``size`` bytes as the controller sent them. A read of several PDUs is not one instant of the controller.
        ConnectorError: no session, no right answer, none in time; then the session is closed.
        """
        if self._socket is None:
            raise ConnectorError("not connected")
        with self._dropping_on_error():
            self._begin_operation()
            block = self._block
            begun_ns = time.monotonic_ns()
            self._send(block.begin(self._take_references(block.count)))
            self._receive()
            self._round_trip_ns = time.monotonic_ns() - begun_ns
            while True:
                while (frame := self._whole_frame()) is not None:
                    block.accept(frame)
                if block.complete:
                    break
                if requests := block.more():
                    self._send(requests)
                self._receive()
            if self._start != self._end:
                raise ConnectorError("unexpected bytes after the last answer")
            return block.data

    def close(self) -> None:
        """Close the socket, if open. In class 0 of the transport protocol, that alone ends the session."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    # -- session -------------------------------------------------------------------------------------------------------

    def _use(self, granted: pdu.Session) -> None:
        """Build for this session what every read uses again: the requests and a bounded place for the answers."""
        jobs = min(granted.jobs, self.options.maxJobs or granted.jobs)
        self._session = pdu.Session(granted.pdu_size, jobs)
        self._start = self._end = 0  # of the bytes received, but not yet taken
        if not granted.pdu_size:
            self._longest_frame = _HANDSHAKE_FRAME
            self._inbox = memoryview(bytearray(self._longest_frame))
            return
        self._longest_frame = granted.pdu_size + pdu.FRAME_OVERHEAD
        self._inbox = memoryview(bytearray(self._longest_frame * jobs))
        chunk = min(granted.pdu_size - pdu.READ_OVERHEAD, self.options.packetSize or self.size, self.size)
        self._block = BlockRead(self.db_number, self.size, chunk, jobs)

    def _take_references(self, count: int) -> int:
        first = self._reference
        self._reference = (first + count) & 0xFFFF
        return first

    @contextmanager
    def _dropping_on_error(self, *, opening: bool = False) -> Iterator[None]:
        """Close the socket on any way out but the good one, and name the error for people."""
        peer = self.options.peer
        try:
            yield
        except ConnectorError:
            self.close()
            raise
        except (BlockingIOError, TimeoutError):  # how an expired SO_RCVTIMEO and a slow connect show
            self.close()
            raise ConnectorError(f"no answer within {self.options.timeout} ms from {peer}") from None
        except ConnectionRefusedError:
            self.close()
            raise ConnectorError(f"connection refused by {peer}") from None
        except (EOFError, ConnectionError):
            self.close()
            text = f"{peer} closed the connection"
            if opening:
                text += (
                    f" during set-up: rack {self.options.rack}, slot {self.options.cpu_slot} may be wrong, all its "
                    "connections in use, or it is not an S7 controller"
                )
            raise ConnectorError(text) from None
        except socket.gaierror as error:
            self.close()
            raise ConnectorError(f"host name {self.options.host!r} cannot be resolved: {error.strerror}") from None
        except OSError as error:
            self.close()
            raise ConnectorError(f"{peer} cannot be reached: {error.strerror or error}") from None
        except BaseException:
            self.close()
            raise

    # -- socket --------------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._use(pdu.Session(0, 0))
        places = socket.getaddrinfo(self.options.host, self.options.port, type=socket.SOCK_STREAM)
        self._deadline = time.monotonic() + self._timeout_s
        for attempt, (family, kind, protocol, _, address) in enumerate(places, 1):
            self._socket = socket.socket(family, kind, protocol)
            try:
                self._socket.settimeout(max(0.001, self._deadline - time.monotonic()))
                self._socket.connect(address)
            except OSError:
                self.close()
                if attempt == len(places):
                    raise
            else:
                break
        assert self._socket is not None  # noqa: S101 - getaddrinfo returns no empty list
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # From here the kernel keeps the time: Python's own time-outs cost a poll() before each call.
        self._socket.setblocking(True)
        self._arm(max(0.001, self._deadline - time.monotonic()))

    def _begin_operation(self) -> None:
        self._deadline = time.monotonic() + self._timeout_s
        if self._armed_s != self._timeout_s:
            self._arm(self._timeout_s)

    def _arm(self, limit_s: float) -> None:
        """Bound every wait of the socket; not zero, which would mean forever."""
        assert self._socket is not None  # noqa: S101 - for the type checker
        self._armed_s = limit_s
        microseconds = max(1, round(limit_s * 1e6))
        limit = _TIMEVAL.pack(*divmod(microseconds, 1_000_000))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)

    def _send(self, frames: bytes | memoryview) -> None:
        assert self._socket is not None  # noqa: S101 - for the type checker
        self._socket.sendall(frames)

    def _receive(self) -> None:
        """Take what the socket has, at least one byte; all waits of an operation share its deadline."""
        assert self._socket is not None  # noqa: S101 - for the type checker
        left_s = self._deadline - time.monotonic()
        if left_s <= 0:
            raise TimeoutError
        if left_s < self._armed_s * 0.9:  # arming costs two system calls, so a fast cycle does without
            self._arm(left_s)
        if self._start:
            # Whole frames are taken before this, so what is left is less than one and there is always room.
            left = self._end - self._start
            self._inbox[:left] = self._inbox[self._start : self._end]
            self._start, self._end = 0, left
        received = self._socket.recv_into(self._inbox[self._end :])
        if not received:
            raise EOFError
        self._end += received

    def _whole_frame(self) -> memoryview | None:
        """Take the next frame out of what has come; None if it is not whole yet. Good until the next ``_receive``."""
        if self._end - self._start < 4:
            return None
        length = pdu.frame_length(self._inbox[self._start : self._end], self._longest_frame)
        if self._end - self._start < length:
            return None
        frame = self._inbox[self._start : self._start + length]
        self._start += length
        return frame

    def _next_frame(self) -> memoryview:
        while (frame := self._whole_frame()) is None:
            self._receive()
        return frame
