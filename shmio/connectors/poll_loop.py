"""The loop that polls a device and publishes what its connector reads, cycle by cycle.

The loop handles time, quality and recovery in the same way for all connectors. It keeps an absolute
schedule and counts overruns. When quality turns bad, it publishes one bad frame. After any error,
it closes the connection, and connects again after a back-off.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, TypeVar

from shmio.backoff import Backoff
from shmio.connectors.base import Connector, UnconfirmedError
from shmio.connectors.commands import CommandProcessor
from shmio.connectors.injections import Blocks, OwnerOf
from shmio.connectors.output import Image, Output
from shmio.errors import ConnectorError
from shmio.layout.values.write import Write
from shmio.logs import fields
from shmio.segment import BlockWriter, EventKind, Provenance, Quality, Record

RECONNECT: Final = Backoff(0.1, 2.0)
"""The waiting times between attempts to connect again."""
STABLE_NS: Final = 1_000_000_000
"""Duration in ns after which a connection counts as stable, so that the next back-off starts anew."""
CONFIRM_NS: Final = 10_000_000
"""Maximum time in ns that a cycle waits for the confirmation of its writes; half a period if that is less.

A confirmation that comes later is handled in a later cycle.
"""
_MEASURES: Final = re.compile(r"\b[0-9]+(?= (?:ms|s|bytes)\b)")
"""Matches the numbers, such as times and sizes, in which two texts of the same reason may differ."""

_Result = TypeVar("_Result")

log = logging.getLogger("shmio.source")


class Due(NamedTuple):
    """The next cycle.

    ``due_ns`` is its due time, which may have passed. ``skipped`` is the number of cycles skipped
    before it.
    """

    cycle: int
    due_ns: int
    skipped: int


class Schedule:
    """Numbers the cycles since the start of the instance, so that cycles lost in a restart are visible as a gap.

    A cycle that begins late still runs. A cycle whose whole period has passed is skipped, and
    counts as an overrun.
    """

    def __init__(self, start_ns: int, period_ns: int) -> None:
        self._start_ns = start_ns
        self._period_ns = period_ns
        self._last: int | None = None

    def moved(self, ahead_ns: int, lead: int) -> Schedule:
        """Return the schedule for a clock that is ``ahead_ns`` ahead of this schedule's clock.

        Its cycle numbers are higher by ``lead``.
        """
        return Schedule(self._start_ns - ahead_ns - lead * self._period_ns, self._period_ns)

    def next(self, now_ns: int) -> Due:
        """Return the next cycle; skip cycles whose whole period has passed."""
        current = self.at(now_ns)
        if self._last is None:
            cycle, skipped = current + 1, 0
        else:
            cycle = max(self._last + 1, current)
            skipped = cycle - self._last - 1
        self._last = cycle
        return Due(cycle, self.due_ns(cycle), skipped)

    def due_ns(self, cycle: int) -> int:
        """Return the time at which a cycle is due, in ns."""
        return self._start_ns + cycle * self._period_ns

    def at(self, now_ns: int) -> int:
        """Return the number of the cycle that was due last. A later process begins with a higher number."""
        return (now_ns - self._start_ns) // self._period_ns

    def restart(self) -> None:
        """Forget the last cycle, so that the time until the next one counts as an outage, not as an overrun."""
        self._last = None


@dataclass(slots=True)
class Counters:
    """The counters that ``status`` shows for a source. Only the loop changes them."""

    polls: int = 0
    overruns: int = 0
    failures: int = 0
    connects: int = 0
    round_trip_us: int = 0
    busy_since_ns: int = 0
    """Time in ns when the loop called the method of the source that is running now; 0 if none is running."""

    def watch(self, now_ns: Callable[[], int], hook: Callable[[], _Result]) -> _Result:
        """Call a method of the source, and record when the call began, so that others detect a hang."""
        self.busy_since_ns = now_ns()
        try:
            return hook()
        finally:
            self.busy_since_ns = 0


class QualityLog:
    """Reports each change of a source's quality once, in the log and as an event."""

    def __init__(self, writer: BlockWriter) -> None:
        self._writer = writer
        self._last: tuple[Quality, str] | None = None
        self._state: tuple[Quality, str] | None = None  # the reason without its numbers
        self.note = ""
        """Why quality is not good, for the process table; empty if quality is good."""

    def update(self, quality: Quality, reason: str, cycle: int, well: str = "") -> bool:
        """Report the quality if the quality or its reason has changed.

        A reason whose text differs only in times and sizes counts as unchanged.

        Args:
            quality: The present quality.
            reason: Why quality is not good; empty if it is good.
            cycle: The present cycle, for the log.
            well: Text to append to the log line if quality is good.

        Returns:
            Whether there was a change.

        """
        if (quality, reason) == self._last:
            return False
        self.note, self._last = reason, (quality, reason)
        state = quality, _MEASURES.sub("#", reason)
        if state == self._state:
            return False
        self._state = state
        self._writer.event(Record(EventKind.QUALITY, reason), quality=quality)
        if quality is Quality.GOOD:
            log.info("the quality is good%s", well, extra=fields(cycle=cycle))
        else:
            log.warning("the quality is %s: %s", quality, reason, extra=fields(cycle=cycle))
        return True


class Clock(Protocol):
    """The clock of the loop. Tests provide their own."""

    def now_ns(self) -> int:
        """Return the time of CLOCK_MONOTONIC in ns."""

    def wait_ns(self, duration_ns: int) -> bool:
        """Wait for ``duration_ns``, or until the loop must stop.

        Return whether the loop must stop.
        """


class WallClock:
    """The loop's clock in a running instance."""

    def __init__(self) -> None:
        self._stopped = threading.Event()

    now_ns = staticmethod(time.monotonic_ns)
    """Returns the time of CLOCK_MONOTONIC in ns."""

    def wait_ns(self, duration_ns: int) -> bool:
        """Wait for ``duration_ns``, or until the loop must stop.

        Return whether the loop must stop.
        """
        return self._stopped.wait(max(0, duration_ns) / 1e9)

    def stop(self) -> None:
        """Stop the loop. Any thread may call this."""
        self._stopped.set()


class _Submitted(NamedTuple):
    """A cycle for which the loop has requested an image from the device."""

    cycle: int
    asked_ns: int
    """Time of the request on the loop's clock, in ns."""
    monotonic_ns: int
    utc_ns: int
    """Time of the request in UTC, in ns since 1970.

    The values in the answer are at least as new as this time and ``monotonic_ns``.
    """


class SourceLoop:
    """Polls one connector on schedule, publishes a frame for each image, and carries out writes."""

    def __init__(
        self,
        connector: Connector,
        writer: BlockWriter,
        schedule: Schedule,
        clock: Clock,
        writable: Iterable[str] = (),
        *,
        allow_nonfinite: Iterable[str] = (),
        armed: bool = False,
        owner_of: OwnerOf = lambda _: None,
        blocks: Blocks | None = None,
        predecessor: SourceLoop | None = None,
    ) -> None:
        """Create the loop.

        Args:
            connector: The connector to the device.
            writer: Writes the source's block.
            schedule: The times at which cycles are due.
            clock: The loop's clock.
            writable: Patterns of the registers that commands may write.
            allow_nonfinite: Patterns of the registers to which NaN and infinities may be written.
            armed: Whether injections may change what is written to the device.
            owner_of: Returns the process that uses a command queue.
            blocks: Returns the blocks of all sources.
            predecessor: A loop that has ended. This loop continues the counters of that loop, and
                takes over its connection if it was kept.

        """
        self._connector = connector
        self._offered = None if predecessor is None else predecessor.kept
        self.kept: Connector | None = None
        """After the end of the loop, the connector with its open connection, if :meth:`keep` was called."""
        self.unkept = ""
        """After the end of the loop, why the connection was not kept although :meth:`keep` was called."""
        self.attempted = threading.Event()
        """Set when the first attempt to take over a connection, or to connect, has ended."""
        self._keep = False
        self._writer = writer
        self._schedule = schedule
        self._clock = clock
        self._output = Output(writer, clock.now_ns)
        self.commands = CommandProcessor(
            self._output,
            writable if connector.can_write else None,
            clock.now_ns,
            allow_nonfinite=allow_nonfinite,
            armed=armed or connector.provenance is not Provenance.LIVE,
            owner_of=owner_of,
            blocks=blocks,
        )
        self._retries = 0
        self._connected_ns: int | None = None
        self._accepting = False
        self._in_flight: deque[_Submitted] = deque()
        self._quality_log = QualityLog(writer)
        self.counters: Counters = Counters() if predecessor is None else predecessor.counters

    @property
    def note(self) -> str:
        """Why quality is not good; empty if it is good."""
        return self._quality_log.note

    def keep(self) -> None:
        """Let the loop leave the connection open when it ends, unless a read or write is in flight.

        Call this before you stop the clock.
        """
        self._keep = True

    def run(self) -> None:
        """Poll until the clock stops the loop, then publish that the source has stopped."""
        try:
            while True:
                due = self._schedule.next(self._clock.now_ns())
                self.counters.overruns += due.skipped
                if self._clock.wait_ns(due.due_ns - self._clock.now_ns()):
                    break
                if self._clock.now_ns() >= self._schedule.due_ns(due.cycle + 1):  # delayed while it waited
                    self.counters.overruns += 1
                elif not self.poll(due.cycle):
                    break
            if self._keep and self._settled():
                self.kept = self._connector
        finally:
            self.commands.stop()
            self._confirm_last()
            if self._offered is not None:
                self._offered.close()
            if self.kept is None:
                self._connector.close()
            self._writer.cycle = max(self._writer.cycle, self._schedule.at(self._clock.now_ns()))
            self._disconnected(self._writer.cycle, "the source was stopped")
            self._writer.event(Record(EventKind.STOPPED))
            self.attempted.set()

    def poll(self, cycle: int) -> bool:
        """Run one cycle: connect if necessary, write, request an image, publish images.

        An answer that comes after the end of its cycle is still published, with the number of the
        cycle that requested it. While ``depth`` requests are in flight, a cycle requests nothing
        and counts as an overrun. If an answer takes longer than ``stale_ms`` or the connector's
        time-out, the loop publishes a bad frame, closes the connection and connects again; it
        publishes no more answers from the old connection.

        Returns:
            False if the loop was stopped during back-off.

        """
        self._writer.cycle = cycle
        try:
            if self._connected_ns is None:
                self._connect()
            self.commands.release(cycle)
            self._write()
            end_ns = self._schedule.due_ns(cycle + 1)
            self._collect(end_ns, leave=self._connector.depth - 1)  # late answers make room
            if len(self._in_flight) < self._connector.depth:
                self._in_flight.append(self._asked(cycle))
                self._call(self._connector.submit)
                self._collect(end_ns)
            else:
                self.counters.overruns += 1  # no further request may be in flight
        except ConnectorError as error:
            return self._fail(cycle, str(error) or "the connector gave no reason")
        return True

    def _asked(self, cycle: int) -> _Submitted:
        return _Submitted(cycle, self._clock.now_ns(), time.monotonic_ns(), time.time_ns())

    def _write(self) -> None:
        """Carry out waiting commands, unless the device still has to confirm those of an earlier cycle."""
        try:
            self._confirm()
            if self.commands.waiting and not self.commands.unconfirmed:
                self._drain()
                self._call(lambda: self.commands.carry_out(self._sent))
        except UnconfirmedError as error:
            log.warning("%s", error)

    def _sent(self, writes: Sequence[Write]) -> Sequence[str] | None:
        self._connector.send(writes)
        patience_ns = min(CONFIRM_NS, self._writer.block.period_ns // 2)
        return self._connector.confirm(time.monotonic_ns() + patience_ns)

    def _confirm(self) -> None:
        """Publish the outcomes of unconfirmed writes, if they have come since the last cycle."""
        if self.commands.unconfirmed:
            self._call(lambda: self.commands.confirm(lambda: self._connector.confirm(0)))

    def _drain(self) -> None:
        """Publish all requested images before a write, whose event must not precede older frames."""
        while self._in_flight:
            self._collect(self._clock.now_ns() + round(self._connector.timeout_s * 1e9))

    def _collect(self, until_ns: int, leave: int = 0) -> None:
        """Publish the images that arrive by ``until_ns``; ``leave`` requests may stay in flight."""
        while len(self._in_flight) > leave:
            raw = self._call(lambda: self._connector.collect(until_ns))
            if raw is None:
                return
            asked = self._in_flight.popleft()
            took_ns = self._clock.now_ns() - asked.asked_ns
            self.counters.round_trip_us = took_ns // 1000
            if took_ns > self._writer.block.stale_ns:  # the age of the image is unknown
                limit_ms = self._writer.block.stale_ns / 1e6
                raise ConnectorError(
                    f"the answer took {took_ns / 1e6:.0f} ms, longer than stale_ms ({limit_ms:.0f}) allows"
                )
            self._publish(asked, raw)
            if self._clock.now_ns() >= until_ns:
                return

    def _publish(self, asked: _Submitted, raw: bytes) -> None:
        doubt = self._connector.doubt
        quality = Quality.UNCERTAIN if doubt else Quality.GOOD
        self._quality_log.update(quality, doubt, asked.cycle, f", connected {self._connector.describe()}")
        # Not before an image has confirmed the layout, but before consumers see that it is good.
        if not self._accepting:
            self._accepting = True
            self.commands.open()
        self._output.publish(
            Image(raw, asked.cycle, asked.utc_ns, quality, self._connector.provenance, doubt, asked.monotonic_ns)
        )
        self.counters.polls += 1
        if self._connected_ns is not None and self._clock.now_ns() - self._connected_ns > STABLE_NS:
            self._retries = 0

    def _connect(self) -> None:
        if not self._taken_over():
            self._call(self._connector.connect)
            self.counters.connects += 1
        self._connected_ns = self._clock.now_ns()
        self._accepting = False
        self.attempted.set()

    def _taken_over(self) -> bool:
        """Take over the connection that the predecessor has kept, if any; return whether this succeeded."""
        if (other := self._offered) is None:
            return False
        self._offered = None
        try:
            return self._call(lambda: self._connector.take_over(other))
        finally:
            other.close()

    def _settled(self) -> bool:
        """Wait until nothing is in flight; return whether this succeeded and the connection is open."""
        if self._connected_ns is None:
            self.unkept = "the device was not connected"
            return False
        try:
            self._drain()
            if self.commands.unconfirmed:
                until_ns = time.monotonic_ns() + round(self._connector.timeout_s * 1e9)
                self._call(lambda: self.commands.confirm(lambda: self._connector.confirm(until_ns)))
        except ConnectorError as error:
            log.warning("the connection cannot be kept over the reload: %s", error)
            self.unkept = str(error)
            return False
        if self._in_flight or self.commands.unconfirmed:
            self.unkept = f"the device did not confirm its {'reads' if self._in_flight else 'writes'} in time"
            return False
        return True

    def _call(self, hook: Callable[[], _Result]) -> _Result:
        return self.counters.watch(self._clock.now_ns, hook)

    def _fail(self, cycle: int, reason: str) -> bool:
        self.counters.failures += 1
        self.attempted.set()
        self._connected_ns = None
        self._in_flight.clear()
        self._confirm_last()
        self._disconnected(cycle, reason)  # first, because it may take time to close the connection
        self._connector.close()
        stop = self._clock.wait_ns(round(RECONNECT.wait_s(self._retries) * 1e9))
        self._retries += 1
        self._schedule.restart()
        return not stop

    def _confirm_last(self) -> None:
        """Before the connection ends, publish what is known of unconfirmed writes."""
        with suppress(ConnectorError):
            self._confirm()

    def _disconnected(self, cycle: int, reason: str) -> None:
        """Stop accepting commands; if the reason is new, publish a bad frame with the last image."""
        self.commands.close(reason)
        if self._quality_log.update(Quality.BAD, reason, cycle):
            provenance = self._connector.provenance
            raw, source_ns = self._output.raw, self._output.source_ns
            self._output.publish(Image(raw, cycle, source_ns, Quality.BAD, provenance, reason))
