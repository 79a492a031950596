"""What a connector is, and the loop that runs one.

The loop owns time, quality and recovery, so that every connector behaves alike: an absolute schedule, overruns
counted, one bad frame when quality changes, the connection dropped on any error, back-off, recovery without a restart.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import msgspec

from shmio.connectors.schedule import Backoff, Schedule
from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.logs import fields
from shmio.segment import BlockWriter, Quality

STABLE_NS = 1_000_000_000
"""A connection that has lasted this long has put its failures behind it."""

_MEASURES = re.compile(r"\b[0-9]+(?= (?:ms|s|bytes)\b)")  # what varies in a reason; codes and addresses do not

log = logging.getLogger("shmio.source")


class Connector(ABC):
    """One device's protocol. All hooks run in one thread; none may block longer than ``timeout_s``.

    After a hook has raised, the loop calls :meth:`close` and later :meth:`connect` again: a late reply must never be
    taken for the next one.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """The connector's own keys of ``[[source]]``; refuses unknown ones."""

    @abstractmethod
    def __init__(self, options: Any, layout: Layout) -> None:
        """``options`` is an instance of ``Options``. ConfigError when layout and options do not go together."""

    @property
    @abstractmethod
    def timeout_s(self) -> float:
        """The longest time that any hook blocks."""

    @abstractmethod
    def connect(self) -> None:
        """Reach the device; ConnectorError says why not, in words for the person at the cell."""

    @abstractmethod
    def read(self) -> bytes:
        """One image of the whole block, ``layout.size`` bytes; ConnectorError, never a part or an old one."""

    @abstractmethod
    def close(self) -> None:
        """Drop the connection; allowed at any time, more than once."""

    def describe(self) -> str:
        """What was agreed with the device, for the log."""
        return ""


class Clock(Protocol):
    """Time as the loop sees it; tests bring their own."""

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC."""

    def wait_ns(self, duration_ns: int) -> bool:
        """Wait; True as soon as the loop is to stop."""


class WallClock:
    """The loop's clock in a live instance."""

    def __init__(self, stopping: threading.Event) -> None:
        self._stopping = stopping

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def wait_ns(self, duration_ns: int) -> bool:
        """Wait; True as soon as the process is to stop."""
        return self._stopping.wait(duration_ns / 1e9) if duration_ns > 0 else self._stopping.is_set()


@dataclass(slots=True)
class Counters:
    """What ``status`` shows of a source; one writer, the loop."""

    polls: int = 0
    overruns: int = 0
    failures: int = 0
    connects: int = 0
    round_trip_us: int = 0
    busy_since_ns: int = 0
    """When the hook that runs now was called; 0 between hooks."""


class SourceLoop:
    """Polls one connector on schedule and publishes every frame."""

    def __init__(self, connector: Connector, writer: BlockWriter, schedule: Schedule, clock: Clock) -> None:
        self._connector = connector
        self._writer = writer
        self._schedule = schedule
        self._clock = clock
        self._backoff = Backoff()
        self._connected_ns: int | None = None
        self._reason: str | None = None  # of the bad frame that stands, without its numbers; empty while good
        last = writer.block.latest()
        self._raw = last.raw if last else bytes(writer.block.layout.size)
        self._read_ns = last.source_ns if last else 0  # UTC of the last good image; 0: there was none
        self.counters = Counters()
        self.note = ""

    def run(self) -> None:
        """Poll until the clock says stop; then tell the readers."""
        try:
            while True:
                due = self._schedule.next(self._clock.now_ns())
                self.counters.overruns += due.skipped
                if self._clock.wait_ns(due.due_ns - self._clock.now_ns()) or not self.poll(due.cycle):
                    break
        finally:
            self._connector.close()
            self._bad(self._schedule.next(self._clock.now_ns()).cycle, "the source was stopped")

    def poll(self, cycle: int) -> bool:
        """One cycle: connect if need be, read, publish. False: told to stop while backing off."""
        try:
            if self._connected_ns is None:
                self._connect()
            read_ns = time.time_ns()  # the device had these values then, or later
            raw = self._timed_read()
        except ConnectorError as error:
            return self._fail(cycle, str(error) or "the connector gave no reason")
        self._raw, self._read_ns = raw, read_ns
        self._writer.publish(raw, cycle=cycle, source_ns=read_ns)
        self.counters.polls += 1
        if self._reason != "":
            log.info("quality good, connected %s", self._connector.describe(), extra=fields(cycle=cycle))
            self._reason = ""
        self.note = ""
        if self._connected_ns is not None and self._clock.now_ns() - self._connected_ns > STABLE_NS:
            self._backoff.reset()
        return True

    def _connect(self) -> None:
        self.counters.busy_since_ns = self._clock.now_ns()
        try:
            self._connector.connect()
        finally:
            self.counters.busy_since_ns = 0
        self._connected_ns = self._clock.now_ns()
        self.counters.connects += 1

    def _timed_read(self) -> bytes:
        """An image that is not stale already: nobody knows when, during a long wait, the device had it."""
        began_ns = self.counters.busy_since_ns = self._clock.now_ns()
        try:
            raw = self._connector.read()
        finally:
            self.counters.busy_since_ns = 0
        took_ns = self._clock.now_ns() - began_ns
        self.counters.round_trip_us = took_ns // 1000
        if took_ns > self._writer.block.stale_ns:
            limit_ms = self._writer.block.stale_ns / 1e6
            raise ConnectorError(f"the answer took {took_ns / 1e6:.0f} ms: older than stale_ms ({limit_ms:.0f}) allows")
        return raw

    def _fail(self, cycle: int, reason: str) -> bool:
        self.counters.failures += 1
        self._connected_ns = None
        self._connector.close()
        self._bad(cycle, reason)
        stop = self._clock.wait_ns(round(self._backoff.next_s() * 1e9))
        self._schedule.restart()
        return not stop

    def _bad(self, cycle: int, reason: str) -> None:
        """Publish one bad frame for each new reason, with the last bytes known; other measures are none."""
        self.note = reason
        kind = _MEASURES.sub("#", reason)
        if kind == self._reason:
            return
        self._reason = kind
        log.warning("quality bad: %s", reason, extra=fields(cycle=cycle))
        self._writer.publish(self._raw, cycle=cycle, source_ns=self._read_ns, quality=Quality.BAD, reason=reason)
