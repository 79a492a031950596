"""Test suite for connectors of shmio and of other packages. It needs pytest.

A subclass provides a :class:`Rig`: a real device behind a fault proxy. The suite breaks the connection
in all ways that occur in cells. It checks that the quality becomes bad with a reason, that the source
recovers without a restart, and that the source never shows a value that the device did not have.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from itertools import cycle
from typing import Any, ClassVar, Protocol

import pytest

from shmio.connectors.base import Connector
from shmio.connectors.poll_loop import Schedule, SourceLoop, WallClock
from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.segment import BlockSpec, Frame, ProcessSpec, Quality, Segment
from shmio.testing.proxy import FaultProxy

PATIENCE_S = 20.0
PERIOD_NS = 5_000_000
TIMEOUT_MS = 200
"""Time-out in ms of a rig's connectors, short for the tests in which a device does not answer."""
PATIENT_MS = 10_000
"""Time-out in ms for the tests in which a device always answers. A busy host keeps it."""
SLOW_S = 0.01
"""Delay in s of a slow connection in each direction: two periods, far below the time-out."""


_NEVER = threading.Event()


class Rig(Protocol):
    """A device behind a fault proxy. The values in the device's block change all the time."""

    proxy: FaultProxy
    layout: Layout
    timeout_ms: int
    """Time-out of new connectors in ms: ``TIMEOUT_MS`` at first. Some tests set a longer one."""

    def connector(self) -> Connector:
        """Return a new connector to the device through the proxy, with a time-out of ``timeout_ms``."""

    def changed(self) -> Rig:
        """Return a rig of the same device and proxy, in whose layout some registers are replaced.

        This method is needed only if the connector has ``register_options``.
        """

    def generation(self, raw: bytes) -> int:
        """Return a number for an image of the device. Later images never have a lower number.

        Raises:
            AssertionError: The device never had this image.

        """


class Run:
    """A source's loop that runs during a test. The test reads the frames in the source's block."""

    def __init__(self, segment: Segment, rig: Rig, writable: tuple[str, ...] = ()) -> None:
        self._segment = segment
        self._start(rig, writable)

    def _start(self, rig: Rig, writable: tuple[str, ...] = (), predecessor: SourceLoop | None = None) -> None:
        self.block = block = self._segment.blocks["device"]
        self.frames: list[Frame] = []
        self._rig = rig
        self._cursor = block.cursor()
        schedule = Schedule(self._segment.header.started_ns, block.period_ns)
        self._clock = WallClock()
        self.loop = SourceLoop(
            rig.connector(), self._segment.writer("device"), schedule, self._clock, writable, predecessor=predecessor
        )
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self.loop.run, self.loop.commands.run)]
        for thread in self._threads:
            thread.start()

    def until(self, condition: Callable[[Frame], bool]) -> Frame:
        """Follow the block until a frame satisfies ``condition``, and return that frame."""
        deadline = time.monotonic() + PATIENCE_S
        while (rest_s := deadline - time.monotonic()) > 0:
            frame = self._cursor.next(rest_s)
            if frame is not None:
                self.frames.append(frame)
                if condition(frame):
                    return frame
        raise AssertionError(f"no frame met the condition in time; last frame: {self.frames[-1:]}")

    def good(self) -> Frame:
        """Wait for the next good frame, and return it."""
        return self.until(lambda frame: frame.quality is Quality.GOOD)

    def bad(self) -> Frame:
        """Wait for the next bad frame, and return it."""
        return self.until(lambda frame: frame.quality is Quality.BAD)

    def newer(self, generation: int) -> Frame:
        """Wait for a frame whose image has a higher number than ``generation``, and return it."""
        return self.until(lambda frame: self._rig.generation(frame.raw) > generation)

    def wait_busy(self) -> None:
        """Wait until the loop is in a call of the connector."""
        deadline = time.monotonic() + PATIENCE_S
        while not self.loop.counters.busy_since_ns:
            assert time.monotonic() < deadline, "the loop has called nothing"
            _NEVER.wait(0.001)

    def reload(self, rig: Rig) -> None:
        """Replace the block and the loop, as a reload does if only registers have changed."""
        before = self.loop
        before.keep()
        self.stop()
        self._segment.change([block_of(rig)], ["device"])
        self._start(rig, predecessor=before)

    def stop(self) -> None:
        """Stop the loop, and check the rules that all its frames must obey."""
        self._clock.stop()
        self.loop.commands.stop()
        for thread in self._threads:
            thread.join(PATIENCE_S)
            assert not thread.is_alive(), "the loop did not end"
        while (frame := self._cursor.poll()) is not None:
            self.frames.append(frame)
        assert self._cursor.missed == 0
        assert (self.frames[-1].quality, self.frames[-1].reason) == (Quality.BAD, "the source was stopped")
        last = -1
        for frame in self.frames:
            if frame.quality is Quality.GOOD:
                generation = self._rig.generation(frame.raw)
                assert generation >= last, f"frame {frame.number} is older than the one before it"
                last = generation
            else:
                assert frame.reason, f"frame {frame.number} is bad without a reason"
        cycles = [frame.cycle for frame in self.frames]
        assert cycles == sorted(cycles)


def connect(connector: Connector) -> None:
    """Connect a connector. Try again if connecting takes longer than the time-out because the host is busy."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return connector.connect()
        except ConnectorError as error:
            if "no answer" not in str(error) or time.monotonic() > deadline:
                raise
            connector.close()


def _timeout_ms(rig: Rig) -> int:
    """Return the time-out of a rig, which may have been written for an earlier version of this suite."""
    return getattr(rig, "timeout_ms", TIMEOUT_MS)


def block_of(rig: Rig) -> BlockSpec:
    """Return the specification of the source's block."""
    stale_ns = max(10**9, 2_000_000 * _timeout_ms(rig))  # an answer within the time-out is never too old
    return BlockSpec("device", rig.layout, PERIOD_NS, stale_ns, 1 << 24)


class ConnectorConformance:
    """Tests of reading. Inherit from this class, and define a fixture ``rig``, a :class:`Rig`.

    For connectors that can write, use :class:`shmio.testing.write_conformance.WriteConformance`.
    """

    writable: ClassVar[tuple[str, ...]] = ()
    """Patterns of the registers that are writable."""

    repeats_reads: ClassVar[bool] = False
    """True if the connector repeats a read over a new connection within the cycle, when the peer has cut the old one.

    Then a cut costs no frame.
    """

    def connections(self, rig: Rig) -> int:
        """Return how many connections the source has made, for :meth:`wait_cut`, which may need it."""
        return rig.proxy.accepted if self.repeats_reads else 0

    def wait_cut(self, run: Run, rig: Rig, connections: int) -> None:
        """Wait until the source has noticed a cut of its last connection, of so many."""
        if not self.repeats_reads:
            run.bad()
            return
        deadline = time.monotonic() + PATIENCE_S
        while rig.proxy.accepted == connections:
            assert time.monotonic() < deadline, "the source has not connected again"
            run.good()

    @pytest.fixture
    def run(self, rig: Rig, instance: str) -> Iterator[Run]:
        """Provide a running loop; stop and check the loop after the test."""
        with Segment.create(instance, [block_of(rig)], [ProcessSpec("device", "source")]) as segment:
            run = Run(segment, rig, self.writable)
            try:
                yield run
            finally:
                try:
                    run.stop()
                finally:
                    segment.unlink()

    @pytest.fixture
    def patient(self, rig: Rig) -> None:
        """Give the loop a long time-out, so that the test does not depend on how busy the host is."""
        rig.timeout_ms = PATIENT_MS

    @pytest.fixture
    def frozen(self, rig: Rig) -> None:
        """Make the device silent before the loop starts."""
        rig.proxy.freeze()

    @pytest.fixture
    def absent(self, rig: Rig) -> None:
        """Make the device unreachable before the loop starts."""
        rig.proxy.refuse()

    def test_values_come_and_change(self, run: Run, rig: Rig) -> None:
        """The source reads a working device in every cycle."""
        first = rig.generation(run.good().raw)
        run.until(lambda frame: rig.generation(frame.raw) > first)

    def test_a_slow_device(self, run: Run, rig: Rig) -> None:
        """Answers that take several periods, but less than the time-out, are good."""
        last = rig.generation(run.good().raw)
        rig.proxy.delay(SLOW_S, SLOW_S)
        deadline = time.monotonic() + PATIENCE_S
        found: set[Quality] = set()
        while found != {Quality.GOOD}:  # on a busy host, an answer may take longer than the time-out
            assert time.monotonic() < deadline, "bad frames among the good ones, again and again"
            first = len(run.frames)
            for _ in range(3):
                last = rig.generation(run.newer(last).raw)
            found = {frame.quality for frame in run.frames[first:]}

    def test_absent_at_start(self, absent: None, run: Run, rig: Rig) -> None:
        """The source is bad, with a reason, until the device appears. Then it is good."""
        assert "refused" in run.bad().reason
        rig.proxy.admit()
        run.good()

    def test_lost_and_back(self, run: Run, rig: Rig) -> None:
        """The peer closes the connection and refuses new ones for a while. This happens twice."""
        for _ in range(2):
            run.good()
            rig.proxy.refuse()
            run.bad()
            rig.proxy.admit()
            run.good()

    def test_reset(self, run: Run, rig: Rig) -> None:
        """The peer resets the connection, as in a crash, and accepts a new one at once."""
        run.good()
        connections = self.connections(rig)
        rig.proxy.cut(reset=True)
        self.wait_cut(run, rig, connections)
        run.good()

    def test_cut_in_the_middle_of_an_answer(self, run: Run, rig: Rig) -> None:
        """The source never makes a frame from an incomplete answer."""
        run.good()
        connections = self.connections(rig)
        rig.proxy.cut_after(30)
        self.wait_cut(run, rig, connections)
        rig.proxy.pass_all()
        run.good()

    def test_half_open(self, run: Run, rig: Rig) -> None:
        """The connection stays open, but the peer is silent.

        The source is bad after the time-out, and good again when the peer answers.
        """
        run.good()
        rig.proxy.freeze()
        assert "answer" in run.bad().reason
        rig.proxy.thaw()
        run.good()

    @pytest.mark.parametrize("garbage", [b"\0" * 64, b"\xff" * 64, b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\x03"])
    def test_garbage(self, run: Run, rig: Rig, garbage: bytes) -> None:
        """Bytes that are not an answer never become a value."""
        run.good()
        rig.proxy.garble(garbage)
        run.bad()
        rig.proxy.pass_all()
        run.good()

    def test_a_late_answer_is_not_taken_for_the_next(self, run: Run, rig: Rig) -> None:
        """The source never takes a late answer for the answer to another request."""
        run.good()
        rig.proxy.hold(frames=1)
        run.bad()
        rig.proxy.release()
        run.good()

    def test_a_loop_ends_while_the_device_hangs(self, run: Run, rig: Rig) -> None:
        """Stopping never takes longer than the device's time-out.

        The fixture ``run`` checks this.
        """
        run.good()
        rig.proxy.freeze()

    def test_a_stop_in_the_middle_of_connecting(self, frozen: None, run: Run) -> None:
        """Stopping never takes longer than the device's time-out. The fixture ``run`` checks this."""
        run.wait_busy()

    @pytest.fixture
    def others(self, rig: Rig) -> Iterator[Rig]:
        """Provide an endless iterator over rigs for reloads, which alternates between two layouts.

        The test is skipped if a reload cannot change the registers of the connector.
        """
        if type(rig.connector()).register_options is None:
            pytest.skip("a reload restarts the sources of this connector")
        changed = rig.changed()
        changed.timeout_ms = _timeout_ms(rig)
        return cycle((changed, rig))

    @pytest.mark.usefixtures("patient")
    def test_a_reload_that_adds_and_removes_registers_without_reconnecting(
        self, others: Iterator[Rig], run: Run, rig: Rig
    ) -> None:
        """A reload that only adds and removes registers keeps the connection, even if answers take several periods."""
        last = rig.generation(run.good().raw)
        connections = rig.proxy.accepted
        rig.proxy.delay(SLOW_S, SLOW_S)
        for _ in range(4):
            run.reload(other := next(others))
            frame = run.good()
            assert len(run.frames) == 1, "the connection was lost"
            assert other.generation(frame.raw) >= last
            last = other.generation(run.good().raw)
        assert (rig.proxy.accepted, run.loop.counters.connects) == (connections, 1)

    @pytest.mark.parametrize("lost", ["before", "after", "frozen"])
    def test_a_device_lost_during_a_reload(self, others: Iterator[Rig], run: Run, rig: Rig, lost: str) -> None:
        """If the connection is lost during a reload, the new registers become good over a new connection."""
        run.good()
        if lost == "frozen":
            rig.proxy.freeze()
        elif lost == "before":
            rig.proxy.refuse()
        run.reload(next(others))
        if lost == "after":
            connections = self.connections(rig)
            rig.proxy.cut(reset=True)
            self.wait_cut(run, rig, connections)
        rig.proxy.pass_all()
        run.good()
        run.reload(next(others))
        run.good()

    def test_a_stop_in_the_middle_of_a_reload(self, others: Iterator[Rig], run: Run, rig: Rig) -> None:
        """Stopping never takes longer than the device's time-out. The fixture ``run`` checks this."""
        run.good()
        rig.proxy.freeze()
        run.reload(next(others))

    def test_close_may_come_at_any_time(self, rig: Rig) -> None:
        """A program may close the connector before the first connect, and may close it twice."""
        connector: Any = rig.connector()
        connector.close()
        connect(connector)
        connector.close()
        connector.close()
