"""Histograms of each source's timing, measured from the frames and events that the source publishes.

The sources do not measure anything. A thread of this process reads their rings, which costs the
sources no time.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections import OrderedDict, deque
from collections.abc import Iterator
from itertools import accumulate
from typing import Final

from shmio.model.values import Quality
from shmio.segment import Block, Segment
from shmio.segment.events import ENDS, Event, EventKind

INTERVAL_S: Final = 0.5
"""Interval in s at which the rings are read. A ring has room for several seconds at least."""
BOUNDS_S: Final = (
    0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.025, 0.03, 0.05, 0.075,
    0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0,
)  # fmt: skip
"""Upper bounds of the buckets of all histograms, in s."""
MAX_CHANGES: Final = 4096
"""Maximum number of changes of quality that are stored for each source."""
MAX_COMMANDS: Final = 4096
"""Maximum number of a source's commands that wait for their outcome. If there are more, the oldest are forgotten."""


class Histogram:
    """Counts durations in buckets."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self.sum_s = 0.0
        """Sum of all durations, in s."""

    def add(self, duration_ns: int) -> None:
        """Count a duration. A negative duration, which a change of the clock may cause, counts as 0."""
        duration_s = max(0, duration_ns) / 1e9
        self._counts[bisect_left(BOUNDS_S, duration_s)] += 1
        self.sum_s += duration_s

    @property
    def buckets(self) -> list[tuple[str, float]]:
        """For each bucket, its upper bound as text, and the number of durations up to this bound."""
        names = [*(f"{bound:g}" for bound in BOUNDS_S), "+Inf"]
        return list(zip(names, map(float, accumulate(self._counts)), strict=True))


class SourceTiming:
    """The histograms of one source. Only one thread may use it; others may read the histograms."""

    def __init__(self, block: Block, started_ns: int) -> None:
        """Start with the next frame and event.

        Args:
            block: The source's block.
            started_ns: Start of the instance by CLOCK_MONOTONIC, in ns. Cycles are counted from it.

        """
        self.block = block
        self.period = Histogram()
        """Times from the frame of one cycle to the frame of the next."""
        self.lateness = Histogram()
        """Times from the moment at which a cycle was due to the publication of its frame."""
        self.round_trip = Histogram()
        """Times that the device took to answer."""
        self.wake_up = Histogram()
        """Times from the publication of a frame until this process, which was waiting for the frame, woke up."""
        self.command = Histogram()
        """Times from the acceptance of a command by the source until its outcome was known."""
        self.connections: deque[tuple[float, bool]] = deque(maxlen=MAX_CHANGES)
        """The newest changes from or to bad quality: the time by CLOCK_MONOTONIC in s, and True if it became bad."""
        self._bad = False
        self._started_ns = started_ns
        self._frames = block.cursor()
        self._events = block.events.cursor()
        self._before: tuple[int, int, int] | None = None
        self._accepted: OrderedDict[tuple[int, int], int] = OrderedDict()

    def follow(self) -> None:
        """Evaluate all new frames and events."""
        while (frame := self._frames.poll()) is not None:
            place = (frame.incarnation, frame.cycle, frame.publish_ns)
            before, self._before = self._before, place
            if before is not None and before[:2] == place[:2]:
                continue  # the cycle's image again, because an injection has changed
            if frame.delay_us:
                self.round_trip.add(1000 * frame.delay_us)
            if self.block.attributes.stepped:
                continue  # its cycles are steps, which are never late
            self.lateness.add(frame.publish_ns - self._started_ns - frame.cycle * self.block.period_ns)
            if before is not None and (before[0], before[1] + 1) == place[:2]:
                self.period.add(frame.publish_ns - before[2])
        while (event := self._events.poll()) is not None:
            if event.kind == EventKind.QUALITY:
                self._changed(event, bad=event.quality is Quality.BAD)
            elif event.kind == EventKind.STARTED and event.frame:  # the killed process before could not report its end
                self._changed(event, bad=True)
            command = (event.writer, event.command)
            if event.kind == EventKind.ACCEPTED:
                self._accepted.setdefault(command, event.publish_ns)
                if len(self._accepted) > MAX_COMMANDS:
                    self._accepted.popitem(last=False)
            elif event.kind in ENDS and (accepted_ns := self._accepted.pop(command, None)) is not None:
                self.command.add(event.publish_ns - accepted_ns)

    def _changed(self, event: Event, *, bad: bool) -> None:
        if bad != self._bad:
            self._bad = bad
            self.connections.append((event.publish_ns / 1e9, bad))

    def wait(self) -> None:
        """Wait for the next frame, and count the time from its publication until this process has woken up."""
        frame = self.block.cursor().next(INTERVAL_S)
        if frame is not None and not self.block.attributes.stepped:
            self.wake_up.add(time.monotonic_ns() - frame.publish_ns)


class Measurements:
    """Measures the timing of all sources, in a thread."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._timings: dict[int, SourceTiming] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="measurements", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._thread.join()

    def __iter__(self) -> Iterator[SourceTiming]:
        """Iterate over the histograms of the present sources."""
        return iter(list(self._timings.values()))

    def _run(self) -> None:
        turn = 0
        while not self._stopping.wait(INTERVAL_S):
            self._segment.refresh()
            blocks = {block.section: block for block in self._segment.blocks.values()}
            self._timings = {
                section: self._timings.get(section) or SourceTiming(block, self._segment.header.started_ns)
                for section, block in blocks.items()
            }
            timings = list(self._timings.values())
            for timing in timings:
                timing.follow()
            if timings:
                timings[turn % len(timings)].wait()  # of one source in each turn
                turn += 1
