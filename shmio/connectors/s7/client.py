"""An S7 client that reads and writes one data block at the controller's pace. For one thread.

``submit`` sends the requests of a read and returns; ``collect`` waits for the image. In between,
more reads may be submitted, up to ``depth``, and writes may be sent at any time. ``window`` matches
the answers.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.s7 import pdu
from shmio.connectors.s7.block_read import BlockRead
from shmio.connectors.s7.block_size import SizeProbe
from shmio.connectors.s7.block_write import BlockWrite, ends, waves
from shmio.connectors.s7.explain import OUT_OF_RANGE, RefusedError, explain_size
from shmio.connectors.s7.mode import ModeQuery
from shmio.connectors.s7.options import S7Options
from shmio.connectors.s7.transport import CloseOnError, Transport
from shmio.connectors.s7.window import Operation, Window
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.values.write import Write

MAX_DEPTH = 4  # reads in flight at once; with more, images would only be older
LONGEST_WRITE_S = 20  # limit for a whole batch; ``timeout`` if that is longer


class S7Client:
    """Reads and writes one block of one controller.

    Any error closes the socket, so that a late answer is never taken for the next one. ``connect``
    may then be called again.
    """

    def __init__(self, options: S7Options, db_number: int, size: int) -> None:
        """Prepare to read ``size`` bytes of DB ``db_number``.

        Raises:
            ConfigError: S7 cannot address the block.

        """
        if not 1 <= size <= pdu.MAX_BLOCK_SIZE:
            raise ConfigError(f"DB{db_number} of {size} bytes: S7 reads blocks of 1 to {pdu.MAX_BLOCK_SIZE} bytes")
        if not 1 <= db_number <= 65535:
            raise ConfigError(f"DB{db_number}: data blocks are numbered 1 to 65535")
        self.options = options
        self.db_number = db_number
        self.size = size
        self._timeout_ns = options.timeout * 1_000_000
        self._transport: Transport | None = None
        self._session = pdu.Session(0, 0)
        # A reconnect does not reset the references, so that old answers stay unknown.
        self._window = Window(0, 0)
        self._under_way: deque[BlockRead] = deque()
        self._idle: list[BlockRead] = []
        self._mode = ModeQuery()
        self._close_on_error = CloseOnError(self.close, options)

    @property
    def connected(self) -> bool:
        """Whether a session is open, as far as is known."""
        return self._transport is not None

    @property
    def pdu_size(self) -> int:
        """Size of the largest PDU as granted, in bytes; 0 before the first session."""
        return self._session.pdu_size

    @property
    def jobs(self) -> int:
        """Requests kept in flight: as granted, at most ``maxJobs``; 0 before the first session."""
        return self._session.jobs

    @property
    def depth(self) -> int:
        """Reads that may be in flight at once in this session, at least 1."""
        return max(1, len(self._idle) + len(self._under_way))

    @property
    def doubt(self) -> str:
        """Why values may not change (the PLC is in STOP); empty if there is no reason."""
        return self._mode.doubt

    def connect(self) -> None:
        """Open a session and query the operating mode.

        It takes at most ``timeout``, plus the host name lookup.

        Raises:
            ConnectorError: No controller answers, it does not speak S7, or it refuses the session.

        """
        self.close()
        with CloseOnError(self.close, self.options, opening=True):
            self._transport = transport = Transport(self.options.host, self.options.port, self._timeout_ns)
            deadline_ns = transport.deadline_ns
            transport.send(pdu.connect_request(self.options.rack, self.options.cpu_slot), deadline_ns)
            tpdu_size = pdu.parse_connect_confirm(transport.next_frame(deadline_ns))
            asked = pdu.Session(min(pdu.WANTED_PDU_SIZE, tpdu_size - 3), pdu.WANTED_JOBS)
            reference = self._window.reference
            self._window.reference = (reference + 1) & 0xFFFF
            transport.send(pdu.setup_request(reference, asked.jobs, asked.pdu_size), deadline_ns)
            granted = pdu.parse_setup_answer(transport.next_frame(deadline_ns), reference, asked)
            if transport.left:
                raise ConnectorError("unexpected bytes after the session was set up")
            self._use(granted, transport)
        with self._close_on_error:
            self._ask_mode()
            self._flush()
            self._finish(self._mode, deadline_ns)

    def read(self) -> bytes:
        """Read the whole block within ``timeout``; for use while no read is in flight.

        A read of several PDUs does not show a single instant of the controller.

        Returns:
            ``size`` bytes as the controller sent them.

        Raises:
            ConnectorError: See :meth:`collect`.

        """
        self.submit()
        image = None
        while image is None:
            image = self.collect(self._under_way[0].deadline_ns)
        return image

    def submit(self) -> None:
        """Send the requests of one read without waiting. At most ``depth`` reads may be in flight.

        Raises:
            ConnectorError: There is no session, or it was lost.

        """
        if self._transport is None:
            raise ConnectorError("not connected")
        if not self._idle:
            raise RuntimeError(f"no more than {self.depth} reads may be under way")
        with self._close_on_error:
            read = self._idle.pop()
            read.begin(time.monotonic_ns() + self._timeout_ns)
            self._under_way.append(read)
            self._window.add(read)
            self._ask_mode()
            self._flush()

    def collect(self, until_ns: int) -> bytes | None:
        """Wait for the oldest read.

        Args:
            until_ns: When to stop waiting, ns of CLOCK_MONOTONIC.

        Returns:
            ``size`` bytes; None if the read is not complete by ``until_ns``.

        Raises:
            ConnectorError: There is no session, a wrong answer, a refusal, or no answer within
                ``timeout`` of ``submit``. The session is closed then.

        """
        if self._transport is None:
            raise ConnectorError("not connected")
        if not self._under_way:
            raise RuntimeError("no read is under way")
        read = self._under_way[0]
        with self._close_on_error:
            if not self._advance(read, min(until_ns, read.deadline_ns)):
                if time.monotonic_ns() >= read.deadline_ns:
                    raise TimeoutError
                return None
            if read.refusal is not None:
                raise self._explained(read.refusal, read.deadline_ns)
            self._idle.append(self._under_way.popleft())
            return read.data

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Write in this order; reads may be in flight.

        A batch that does not fit one PDU takes several jobs. It is not atomic and may be done in
        part, and the controller may serve jobs in flight in any order. Each answer must come within
        ``timeout`` of the one before.

        Returns:
            For each write "" if the controller confirmed it, else why it refused it.

        Raises:
            WriteLostError: The session was lost, or the batch took longer than LONGEST_WRITE_S and
                ``timeout``.

        """
        if self._transport is None:
            raise WriteLostError("not connected", [Lost.UNSENT] * len(writes))
        outcomes = [""] * len(writes)
        begun: list[BlockWrite] = []
        try:
            with self._close_on_error:
                begun_ns = time.monotonic_ns()
                end_ns = begun_ns + max(self._timeout_ns, LONGEST_WRITE_S * 1_000_000_000)
                for wave in waves(self.db_number, self.pdu_size, writes, outcomes):
                    begun.append(wave)
                    self._window.add(wave, urgent=True)
                    self._flush()
                    self._finish_wave(wave, end_ns)
                spent_ns = time.monotonic_ns() - begun_ns  # the writes delayed these answers
                self._mode.deadline_ns += spent_ns
                for read in self._under_way:
                    read.deadline_ns += spent_ns
        except ConnectorError as error:
            raise WriteLostError(str(error), ends(outcomes, begun)) from None
        return outcomes

    def close(self) -> None:
        """Close the socket, if open."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._window = Window(0, self._window.reference)
        self._under_way.clear()
        self._idle.clear()
        self._mode.lost()

    # -- session -------------------------------------------------------------------------------------------------------

    def _use(self, granted: pdu.Session, transport: Transport) -> None:
        """Create the requests and buffers that all reads of this session use."""
        jobs = min(granted.jobs, self.options.maxJobs or granted.jobs)
        self._session = pdu.Session(granted.pdu_size, jobs)
        self._window = Window(jobs, self._window.reference)
        transport.reserve(jobs, granted.pdu_size + pdu.FRAME_OVERHEAD)
        chunk = min(granted.pdu_size - pdu.READ_OVERHEAD, self.options.packetSize or self.size, self.size)
        first = BlockRead(self.db_number, self.size, chunk)
        depth = min(max(1, jobs // first.count), MAX_DEPTH)
        self._idle = [first, *(BlockRead(self.db_number, self.size, chunk) for _ in range(depth - 1))]

    # -- requests and answers ------------------------------------------------------------------------------------------

    def _ask_mode(self) -> None:
        """Queue a mode query if one is due; TimeoutError if the answer to the last one is late."""
        now_ns = time.monotonic_ns()
        if not self._mode.complete:  # after a long period the answer may be in the socket
            self._advance(self._mode, now_ns)
        if self._mode.due(now_ns):
            self._mode.begin(now_ns, now_ns + self._timeout_ns)
            self._window.add(self._mode)
        elif self._mode.overdue(now_ns):
            raise TimeoutError

    def _flush(self) -> None:
        """Send the requests that may be sent."""
        assert self._transport is not None  # noqa: S101 - for the type checker
        if self._window.waiting and (requests := self._window.due()):
            try:
                self._transport.send(requests, time.monotonic_ns() + self._timeout_ns)
            except OSError:
                if not self._transport.taken:
                    self._window.take_back()
                raise

    def _advance(self, operation: Operation, until_ns: int) -> bool:
        """Send and receive until the operation is complete.

        Return False if it is not by ``until_ns``.
        """
        while not operation.complete:
            if self._step(until_ns) is None:
                return False
            if not operation.complete and time.monotonic_ns() >= until_ns:
                return False
        return True

    def _step(self, until_ns: int) -> int | None:
        """Receive once, then send what may be sent.

        Returns:
            The number of answers; None if nothing came until ``until_ns``.

        """
        transport, window = self._transport, self._window
        assert transport is not None  # noqa: S101 - for the type checker
        if not transport.receive(until_ns):
            return None
        answers = 0
        while (frame := transport.frame()) is not None:
            window.accept(frame)
            answers += 1
        if window.idle and transport.left:
            raise ConnectorError("unexpected bytes after the last answer")
        self._flush()
        return answers

    def _finish(self, operation: Operation, deadline_ns: int) -> None:
        if not self._advance(operation, deadline_ns):
            raise TimeoutError

    def _finish_wave(self, wave: BlockWrite, end_ns: int) -> None:
        """Wait for all jobs of a wave: ``timeout`` between answers, until ``end_ns`` at most."""
        deadline_ns = time.monotonic_ns() + self._timeout_ns
        while not wave.complete:
            answers = self._step(min(deadline_ns, end_ns))
            now_ns = time.monotonic_ns()
            if answers:
                deadline_ns = now_ns + self._timeout_ns
            if now_ns >= deadline_ns:
                raise TimeoutError
            if now_ns >= end_ns and not wave.complete:
                limit_s = max(self.options.timeout / 1000, LONGEST_WRITE_S)
                raise ConnectorError(
                    f"{self.options.peer} has not served all writes of a cycle within {limit_s:g} s: write less at once"
                )

    def _explained(self, refusal: RefusedError, deadline_ns: int) -> RefusedError:
        """If the block is too short, probe its real length, and return a refusal that names it."""
        if refusal.code != OUT_OF_RANGE:
            return refusal
        probe = SizeProbe(self.db_number, self.size, self.pdu_size)
        try:
            while probe.found is None:
                probe.begin()
                self._window.add(probe, urgent=True)
                self._flush()
                self._finish(probe, deadline_ns)
        except (ConnectorError, OSError, EOFError):
            return refusal
        return RefusedError(explain_size(self.db_number, self.size, probe.found), OUT_OF_RANGE)
