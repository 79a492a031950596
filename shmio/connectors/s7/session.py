"""A session with an S7 controller: its configuration keys, reads in flight, and writes.

``submit`` sends the requests of a read and returns at once; ``collect`` waits for the image. Up to
``depth`` reads may be in flight, and you may write at any time. Use a session in one thread only.
"""

from __future__ import annotations

import ipaddress
import re
import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Annotated, Literal, Protocol

import msgspec

from shmio.connectors import tcp
from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.s7 import pdu
from shmio.connectors.s7.blocks import BlockWrite, ends
from shmio.connectors.s7.explain import RefusedError
from shmio.connectors.s7.mode import ModeQuery
from shmio.connectors.s7.query import Query
from shmio.connectors.s7.transport import Operation, Transport, Window
from shmio.errors import ConnectorError
from shmio.layout.values.write import Write
from shmio.wording import unknown

MAX_DEPTH = 4  # largest number of reads in flight; with more, images would only be older
REGISTER_OPTIONS = frozenset({"dbNumber", "every", "packetSize"})
"""The keys that determine what is read, but not how to connect."""
LONGEST_WRITE_S = 20  # time limit for a whole batch, or ``timeout`` if that is longer

# The usual slot of the CPU in its rack, by family.
_CPU_SLOT = {"S7_300": 2, "S7_400": 3, "S7_1200": 1, "S7_1500": 1}


class S7Options(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The address of the controller and the parameters of the session, with the keys of ``plc.ini``.

    Raises:
        ValueError: The host or the model is invalid.

    """

    host: Annotated[str, msgspec.Meta(min_length=1, max_length=253)]
    model: str | None = None
    """``S7_300``, ``S7_400``, ``S7_1200`` or ``S7_1500``; it sets only the default of ``slot``."""
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 102
    rack: Annotated[int, msgspec.Meta(ge=0, le=7)] = 0
    slot: Annotated[int, msgspec.Meta(ge=0, le=31)] | None = None
    connection: Literal["pg", "op", "basic"] = "pg"
    """Type of the connection: programming device, operator panel, or any other (S7 basic)."""
    local_tsap: Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)] = 0x0100
    """TSAP of shmio."""
    remote_tsap: Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)] | None = None
    """TSAP of the controller; None: the one for ``connection``, ``rack`` and ``slot``."""
    timeout: Annotated[int, msgspec.Meta(ge=1, le=600_000)] = 5000
    """Time-out in ms for connecting, for reading the block, and for each answer to a write."""
    packetSize: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None  # noqa: N815 - a key of plc.ini
    """Maximum number of data bytes in one read; the PDU size that the controller grants may allow fewer."""
    dbNumber: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None  # noqa: N815 - a key of plc.ini
    """Number of the data block; None: the number in the layout's name."""
    every: Annotated[dict[str, Annotated[int, msgspec.Meta(ge=2, le=10_000)]], msgspec.Meta(max_length=8)] = {}
    """For a tag table: patterns of registers to read only in every n-th cycle, each with its n."""
    maxJobs: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None  # noqa: N815 - named like the other keys
    """Maximum number of requests in flight, for which shmio asks (None: 8); the controller may grant fewer."""

    def __post_init__(self) -> None:
        if not _is_host(self.host):
            raise ValueError(f"host: {self.host!r} is not a host name or address; give the port in the key port")
        if self.model is not None and _family(self.model) not in _CPU_SLOT:
            raise ValueError(f"model: {unknown('model', self.model, _CPU_SLOT)}")

    @property
    def cpu_slot(self) -> int:
        """The configured slot, or else the usual slot of the model."""
        if self.slot is not None:
            return self.slot
        return 1 if self.model is None else _CPU_SLOT[_family(self.model)]

    @property
    def called_tsap(self) -> int:
        """The configured TSAP of the controller, or else the one for connection type, rack and slot."""
        if self.remote_tsap is not None:
            return self.remote_tsap
        return pdu.CONNECTION_TYPES[self.connection] << 8 | self.rack << 5 | self.cpu_slot

    @property
    def peer(self) -> str:
        """``host:port`` for messages, with brackets around IPv6 addresses."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def _family(model: str) -> str:
    """Return the model as S7Options lists it, for example ``S7_1500`` for ``s7-1500``."""
    return model.strip().upper().replace("-", "_").replace(" ", "_")


def _is_host(text: str) -> bool:
    """Return whether the text is an IP address (IPv6 zones are allowed) or a valid host name."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return re.fullmatch(r"[^\s:/\[\]@]+", text) is not None and _is_name(text)
    return True


def _is_name(text: str) -> bool:
    """Return whether a host name can be looked up: whether each of its labels has 1 to 63 bytes."""
    try:
        text.encode("idna")
    except UnicodeError:
        return False
    return True


class Read(Operation, Protocol):
    """A read of all values of a cycle. The same object can read further cycles."""

    deadline_ns: int
    """Time by which the read must be complete, in ns of CLOCK_MONOTONIC."""
    refusal: RefusedError | None
    """The controller's refusal of the whole read; None if it did not refuse."""

    @property
    def data(self) -> bytes:
        """The image; valid only if the read is complete and was not refused."""

    def begin(self, deadline_ns: int) -> None:
        """Start a read that must be complete by ``deadline_ns``."""


class S7Session(ABC):
    """A session with one controller, in which several reads may be in flight.

    A subclass defines what is read and how writes are carried out. Any error closes the socket, so
    that a late answer is never matched to a later request. You may call ``connect`` again
    afterwards.
    """

    def __init__(self, options: S7Options) -> None:
        """Create a session without connecting."""
        self.options = options
        self._timeout_ns = options.timeout * 1_000_000
        self._transport: Transport | None = None
        self._session = pdu.Session(0, 0)
        # References continue after a reconnect, so that a late answer matches no new request.
        self._window = Window(0, 0)
        self._in_flight: deque[Read] = deque()
        self._idle: list[Read] = []
        self._mode = ModeQuery()
        self._queries: list[Query] = []
        self._answers = 0  # number in this session, without those of its set-up
        self._add_query(self._mode)
        self._close_on_error = _CloseOnError(self.close, options)

    @property
    def timeout_s(self) -> float:
        """The longest time that any method may block, in s: the longer of ``timeout`` and LONGEST_WRITE_S."""
        return max(self.options.timeout / 1000, LONGEST_WRITE_S)

    @property
    def connected(self) -> bool:
        """True if a session is open, as far as shmio knows; the controller may have closed it."""
        return self._transport is not None

    @property
    def pdu_size(self) -> int:
        """The largest PDU size that the controller has granted, in bytes; 0 before the first session."""
        return self._session.pdu_size

    @property
    def jobs(self) -> int:
        """Maximum number of requests in flight; 0 before the first session.

        The controller grants this number; it is at most ``maxJobs``.
        """
        return self._session.jobs

    @property
    def depth(self) -> int:
        """Largest number of reads in flight in this session, at least 1."""
        return max(1, len(self._idle) + len(self._in_flight))

    @property
    def doubt(self) -> str:
        """Why values may not change, for example because the PLC is in STOP; empty if there is no reason."""
        return self._mode.doubt

    def connect(self) -> None:
        """Open a session and ask for the operating mode.

        This takes at most ``timeout``, plus the time to look up the host name.

        Raises:
            ConnectorError: No controller answers, it does not speak S7, or it refuses the session.

        """
        self.close()
        with _CloseOnError(self.close, self.options, opening=True):
            self._transport = transport = Transport(self.options.host, self.options.port, self._timeout_ns)
            deadline_ns = transport.deadline_ns
            transport.send(pdu.connect_request(self.options.local_tsap, self.options.called_tsap), deadline_ns)
            tpdu_size = pdu.parse_connect_confirm(transport.next_frame(deadline_ns))
            asked = pdu.Session(min(pdu.WANTED_PDU_SIZE, tpdu_size - 3), self.options.maxJobs or pdu.WANTED_JOBS)
            reference = self._window.reference
            self._window.reference = (reference + 1) & 0xFFFF
            transport.send(pdu.setup_request(reference, asked.jobs, asked.pdu_size), deadline_ns)
            granted = pdu.parse_setup_answer(transport.next_frame(deadline_ns), reference, asked)
            self._use(granted, transport)
        self._begin(deadline_ns)

    def take_over(self, other: S7Session) -> bool:
        """Take over the open session of another object with the same options for the session.

        First wait until the controller has answered all questions of that object.

        Returns:
            Whether the session was taken over.

        Raises:
            ConnectorError: The session was lost.

        """
        if other._transport is None:
            return False
        deadline_ns = time.monotonic_ns() + self._timeout_ns
        with other._close_on_error:
            for query in other._queries:
                other._finish(query, deadline_ns)
        transport, window = other._transport, other._window
        if not window.idle or window.waiting:
            return False
        other._transport = None
        self._transport = transport
        self._window = Window(0, window.reference)
        self._use(other._session, transport)
        self._begin(deadline_ns)
        return True

    def _begin(self, deadline_ns: int) -> None:
        """Ask for the operating mode, which is the first question of a session."""
        with self._close_on_error:
            self._ask()
            self._flush()
            self._finish(self._mode, deadline_ns)

    def read(self) -> bytes:
        """Read the whole block within ``timeout``. No other read may be in flight.

        If the block needs several PDUs, its parts may be from different instants.

        Returns:
            ``size`` bytes as the controller sent them.

        Raises:
            ConnectorError: See :meth:`collect`.

        """
        self.submit()
        image = None
        while image is None:
            image = self.collect(self._in_flight[0].deadline_ns)
        return image

    def submit(self) -> None:
        """Send the requests of one read, without waiting for answers.

        At most ``depth`` reads may be in flight.

        Raises:
            ConnectorError: There is no session, or it was lost.

        """
        if self._transport is None:
            raise ConnectorError("shmio is not connected to the controller")
        if not self._idle:
            raise RuntimeError(f"no more than {self.depth} reads may be in flight")
        with self._close_on_error:
            read = self._idle.pop()
            read.begin(time.monotonic_ns() + self._timeout_ns)
            self._in_flight.append(read)
            self._window.add(read)
            self._ask()
            self._flush()

    def collect(self, until_ns: int) -> bytes | None:
        """Wait until the oldest read is complete.

        Args:
            until_ns: Time at which to stop waiting, in ns of CLOCK_MONOTONIC.

        Returns:
            ``size`` bytes; None if the read is not complete by ``until_ns``.

        Raises:
            ConnectorError: There is no session, an answer is wrong, the controller refused the
                read, or it did not answer within ``timeout`` after ``submit``. The session is
                closed.

        """
        if self._transport is None:
            raise ConnectorError("shmio is not connected to the controller")
        if not self._in_flight:
            raise RuntimeError("no read is in flight")
        read = self._in_flight[0]
        with self._close_on_error:
            if not self._advance(read, min(until_ns, read.deadline_ns)):
                if time.monotonic_ns() >= read.deadline_ns:
                    raise TimeoutError
                return None
            if read.refusal is not None:
                raise self._explained(read.refusal, read.deadline_ns)
            self._idle.append(self._in_flight.popleft())
            return read.data

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Write a batch, and wait until the controller has answered. Reads may be in flight.

        If several writes change the same bit, the last one counts. A batch that does not fit into
        one PDU needs several jobs, and is not atomic. The controller may carry out jobs in flight in
        any order. Each answer must come within ``timeout`` after the previous one.

        Returns:
            For each write, "" if the controller confirmed it, or else why it refused the write.

        Raises:
            WriteLostError: The session was lost, or the batch took longer than ``timeout_s``.

        """
        if self._transport is None:
            raise WriteLostError("shmio is not connected to the controller", [Lost.UNSENT] * len(writes))
        outcomes = [""] * len(writes)
        begun: list[BlockWrite] = []
        try:
            with self._close_on_error:
                begun_ns = time.monotonic_ns()
                end_ns = begun_ns + round(self.timeout_s * 1e9)
                for wave in self._waves(writes, outcomes):
                    begun.append(wave)
                    self._window.add(wave, urgent=True)
                    self._flush()
                    self._finish_wave(wave, end_ns)
                spent_ns = time.monotonic_ns() - begun_ns  # the writes delayed these answers
                for query in self._queries:
                    query.deadline_ns += spent_ns
                for read in self._in_flight:
                    read.deadline_ns += spent_ns
        except ConnectorError as error:
            raise WriteLostError(str(error), ends(outcomes, begun)) from None
        return outcomes

    def close(self) -> None:
        """Close the socket, if it is open."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._window = Window(0, self._window.reference)
        self._in_flight.clear()
        self._idle.clear()
        for query in self._queries:  # a controller that has just set up a session is alive, too
            query.lost(alive=not self._answers or self._answers > query.begun_after)
        self._answers = 0

    # -- session -------------------------------------------------------------------------------------------------------

    def _use(self, granted: pdu.Session, transport: Transport) -> None:
        """Start to use a new session: create the requests and buffers for its reads."""
        self._session = granted
        self._window = Window(granted.jobs, self._window.reference)
        transport.inbox.reserve(granted.jobs, granted.pdu_size + pdu.FRAME_OVERHEAD)
        self._idle = self._reads()

    @abstractmethod
    def _reads(self) -> list[Read]:
        """Return the reads that may be in flight at once in the new session; at least one."""

    @abstractmethod
    def _waves(self, writes: Sequence[Write], outcomes: list[str]) -> Iterator[BlockWrite]:
        """Divide a batch into waves. Each wave must be complete before the next one is sent.

        If the controller refuses a write, its wave stores the reason in ``outcomes``.
        """

    # -- requests and answers ------------------------------------------------------------------------------------------

    def _add_query(self, query: Query) -> None:
        """Add a question to those that the session asks; questions added earlier have precedence."""
        query.again = self._continue
        self._queries.append(query)

    def _continue(self, query: Query) -> None:
        self._window.add(query)

    def _ask(self) -> None:
        """Queue a question if one is due and none is open.

        Raises:
            TimeoutError: An open question was not answered in time.

        """
        now_ns = time.monotonic_ns()
        for query in self._queries:
            if not query.complete:  # after a long time between calls, the answer may already be in the socket
                self._advance(query, now_ns)
                if query.overdue(now_ns):
                    raise TimeoutError
                if not query.complete:
                    return
        for query in self._queries:
            if query.due(now_ns) and not (query.optional and self._mode.silent):
                query.begin(now_ns, now_ns + self._timeout_ns)
                query.begun_after = self._answers
                self._window.add(query)
                return

    def _flush(self) -> None:
        """Send waiting requests, as many as may be in flight."""
        assert self._transport is not None  # noqa: S101 - for the type checker
        if self._window.waiting and (requests := self._window.due()):
            try:
                self._transport.send(requests, time.monotonic_ns() + self._timeout_ns)
            except OSError:
                if not self._transport.taken:
                    self._window.take_back()
                raise

    def _advance(self, operation: Operation, until_ns: int) -> bool:
        """Send and receive until the operation is complete or ``until_ns`` has come.

        Return whether the operation is complete.
        """
        while not operation.complete:
            if self._step(until_ns) is None:
                return False
            if not operation.complete and time.monotonic_ns() >= until_ns:
                return False
        return True

    def _step(self, until_ns: int) -> int | None:
        """Receive once, then send waiting requests, as many as may be in flight.

        Returns:
            The number of answers; None if nothing was received by ``until_ns``.

        """
        transport, window = self._transport, self._window
        assert transport is not None  # noqa: S101 - for the type checker
        if not transport.receive(until_ns):
            return None
        answers = 0
        while (frame := transport.inbox.frame()) is not None:
            window.accept(frame)
            answers += 1
        self._answers += answers
        self._flush()
        return answers

    def _finish(self, operation: Operation, deadline_ns: int) -> None:
        if not self._advance(operation, deadline_ns):
            raise TimeoutError

    def _finish_wave(self, wave: BlockWrite, end_ns: int) -> None:
        """Wait until a wave is complete, at most ``timeout`` for each answer.

        Raises:
            TimeoutError: No answer came within ``timeout``.
            ConnectorError: The wave was not complete by ``end_ns``.

        """
        deadline_ns = time.monotonic_ns() + self._timeout_ns
        while not wave.complete:
            answers = self._step(min(deadline_ns, end_ns))
            now_ns = time.monotonic_ns()
            if answers:
                deadline_ns = now_ns + self._timeout_ns
            if now_ns >= deadline_ns:
                raise TimeoutError
            if now_ns >= end_ns and not wave.complete:
                raise ConnectorError(
                    f"{self.options.peer} has not answered all writes of a cycle within {self.timeout_s:g} s; "
                    "write fewer values at once"
                )

    def _explained(self, refusal: RefusedError, deadline_ns: int) -> RefusedError:  # noqa: ARG002
        """Return the refusal of a read; a subclass may first ask for details, until ``deadline_ns``."""
        return refusal


# -- connection errors -------------------------------------------------------------------------------------------------


def _named(error: BaseException, options: S7Options, *, opening: bool = False) -> ConnectorError | None:
    """Return a ConnectorError that explains ``error``; None if it is not a connection error."""
    peer = options.peer
    if isinstance(error, TimeoutError):
        return ConnectorError(f"no answer within {options.timeout} ms from {peer}")
    if isinstance(error, ConnectionRefusedError):
        return tcp.refused(peer)
    if isinstance(error, (EOFError, ConnectionError)):
        text = f"{peer} closed the connection"
        if opening:
            text += (
                f" during set-up: rack {options.rack}, slot {options.cpu_slot} may be wrong, all its connections may "
                "be in use, or it may not be an S7 controller"
            )
        return ConnectorError(text)
    if isinstance(error, socket.gaierror):
        return tcp.unresolved(options.host, error)
    if isinstance(error, OSError):
        return ConnectorError(f"{peer} cannot be reached: {error.strerror or error}")
    return None


class _CloseOnError:
    """Context manager that, on any error, closes the connection, and explains connection errors."""

    def __init__(self, close: Callable[[], None], options: S7Options, *, opening: bool = False) -> None:
        self._close = close
        self._options = options
        self._opening = opening

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is not None:
            self._close()
            if (clear := _named(error, self._options, opening=self._opening)) is not None:
                raise clear from None
