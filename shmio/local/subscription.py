"""Follow registers of a local instance: their present values, then each change.

This module also has :class:`Following`, the base class of iterators over several blocks.
"""

from __future__ import annotations

import math
import select
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Final, Generic, Self, TypeVar

import msgspec

from shmio.errors import PathError, SegmentError, ShmioError, ValueRangeError
from shmio.layout.glob import choose
from shmio.layout.model import Register
from shmio.layout.topic import parse_topic
from shmio.local.reading import reading
from shmio.model.values import Provenance, Quality, Reading
from shmio.segment.block import Block, Frame, FrameFollower, Layouts
from shmio.segment.changed_registers import ChangeScan
from shmio.segment.doorbell import Relay
from shmio.segment.segment import Segment

TURN_S: Final = 0.2
"""Interval in s at which a waiting iterator checks whether it was closed or the instance has stopped."""

Item = TypeVar("Item")


class Following(Generic[Item]):
    """Base of iterators over frames or events of several blocks.

    One thread may iterate; any thread may close the iterator. For each block that the iterator
    follows, a :class:`Relay` wakes it at each frame and each event. The relays' threads start with the
    first item that the program asks for.
    """

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._lock = threading.Lock()  # locked while the mapped memory is read: close waits for it
        self._relays: dict[int, Relay] = {}  # by section of the block
        self._unheard: dict[int, Block] = {}  # the blocks without a relay yet, by section
        self._stop = weakref.finalize(self, _stop, self._relays)  # also if the program does not close it
        self._closed = False
        self._due_s = math.inf
        """Time of the next check if nothing wakes the iterator, in s of the monotonic clock."""
        self._checked_s = time.monotonic()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Item:
        while True:
            with self._lock:
                if self._closed:
                    raise StopIteration
                while self._unheard:
                    section, block = self._unheard.popitem()
                    self._relays[section] = Relay(block.ring, f"following-{block.source}", round(TURN_S * 1e9))
                for relay in self._relays.values():
                    relay.acknowledge()  # before reading
                found = self._take()
                now_s = time.monotonic()
                if found is None and now_s > self._checked_s + TURN_S:
                    self._segment.require_running()  # within the lock: end() comes before the segment is closed
                    self._checked_s = now_s
                poll = select.poll()
                for relay in self._relays.values():
                    poll.register(relay.descriptor, select.POLLIN)
            if found is not None:
                return found
            poll.poll(1000 * max(0.0, min(TURN_S, self._due_s - now_s)))

    def _take(self) -> Item | None:
        """Return the next item; None if there is none yet.

        Raises:
            StopIteration: No further item can come.
        """
        raise NotImplementedError

    def _follow(self, block: Block) -> None:
        """Make the frames and events of a block wake this iterator."""
        self._unheard[block.section] = block

    def _leave(self, block: Block) -> None:
        """Stop a block from waking this iterator."""
        if self._unheard.pop(block.section, None) is None:
            self._relays.pop(block.section).join()

    def end(self) -> None:
        """End the iteration, and wait until no thread reads the mapped memory any more."""
        self._closed = True
        with self._lock:
            self._stop()

    def close(self) -> None:
        """End the iteration."""
        self.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _stop(relays: dict[int, Relay]) -> None:
    """Stop relays, and wait until their threads have ended."""
    for relay in relays.values():
        relay.stop()
    for relay in relays.values():
        relay.join()
    relays.clear()


class Update(msgspec.Struct, frozen=True):
    """One frame of a source with its readings. Implements :class:`shmio.model.cell.Update`."""

    source: str
    frame: int
    cycle: int
    incarnation: int
    clock_ns: int
    source_ns: int
    quality: Quality
    reason: str
    provenance: Provenance
    missed: int
    ended: bool
    readings: tuple[Reading, ...]


class Subscription(Following[Update]):
    """Iterator over updates of registers of a local instance.

    Implements :class:`shmio.model.cell.Subscription`.
    """

    def __init__(
        self,
        segment: Segment,
        blocks: Callable[[], Mapping[str, Block]],
        patterns: Sequence[str],
        *,
        every_frame: bool,
        max_rate_hz: float,
    ) -> None:
        """Prepare the subscription; the first update starts it.

        Args:
            segment: The instance's segment.
            blocks: Returns the instance's present blocks, by source.
            patterns: Names of the registers to follow.
            every_frame: Whether each frame gives an update, even if no register has changed.
            max_rate_hz: Maximum number of updates per second of each source; 0: no limit.
        """
        super().__init__(segment)
        self._blocks = blocks
        self._patterns = patterns
        self._wanted: dict[str, list[str]] = {}  # patterns by source, including the source's name
        self._every_frame = every_frame
        self._interval_s = 1 / max_rate_hz if max_rate_hz > 0 else 0.0
        self._followers: list[_Follower] = []
        self._refusal: ShmioError | None = None
        try:
            _check(patterns, max_rate_hz, every_frame=every_frame)
            self._begin()
        except (PathError, ValueRangeError) as error:  # raised by the first update, as for a remote cell
            self._refusal = error

    def _take(self) -> Update | None:
        if self._refusal is not None:
            raise self._refusal
        for follower in list(self._followers):
            retired = follower.block.retired  # before reading, so that no frame published before the end is missed
            if (update := follower.take()) is not None:
                self._followers.remove(follower)  # so that the other followers come first next time
                self._followers.append(follower)
                return update
            if retired and (update := self._succeed(follower)) is not None:
                return update
        self._due_s = min((follower.due_s for follower in self._followers), default=math.inf)
        return None

    def _begin(self) -> None:
        """Start to follow the blocks that the patterns name; raise PathError if a pattern names nothing."""
        blocks = self._blocks()
        layouts = Layouts(blocks)
        wanted: dict[str, list[str]] = {}
        for pattern in self._patterns:
            choose([pattern], layouts)
            topic = parse_topic(pattern, layouts, next(iter(layouts)) if len(layouts) == 1 else None)
            wanted.setdefault(topic.source, []).append(f"{topic.source}/{topic.path}".removesuffix("/"))
        for source, patterns in wanted.items():
            self._add(blocks[source], patterns)
        self._wanted = wanted

    def _add(self, block: Block, patterns: Sequence[str]) -> None:
        """Start to follow a block; raise PathError if a pattern names nothing in it."""
        registers = [register for _, register in choose(patterns, {block.source: block.layout})]
        self._followers.append(_Follower(block, registers, every_frame=self._every_frame, interval_s=self._interval_s))
        self._follow(block)

    def _succeed(self, old: _Follower) -> Update | None:
        """Follow the block that has replaced a retired block.

        If a reload has removed the source, return the source's last update.
        """
        self._segment.require_running()
        self._followers.remove(old)
        self._leave(old.block)
        blocks, source = self._blocks(), old.block.source
        if source in blocks:
            try:
                self._add(blocks[source], self._wanted[source])
            except PathError as error:
                return old.end(str(error))
            return None
        gone = sorted(self._wanted.keys() - blocks.keys())
        named = f"source {gone[0]!r} was" if len(gone) == 1 else f"sources {', '.join(gone)} were"
        return old.end(f"{named} removed from instance {self._segment.instance!r} by a reload")


def _check(patterns: Sequence[str], max_rate_hz: float, *, every_frame: bool) -> None:
    """Raise ValueRangeError for invalid arguments, as the endpoints do."""
    if not patterns:
        raise ValueRangeError("no pattern is given; name a path, a structure, a glob, or a source")
    if not 0 <= max_rate_hz < math.inf:
        raise ValueRangeError(f"max_rate_hz must be 0 or a positive number, not {max_rate_hz}")
    if max_rate_hz and every_frame:
        raise ValueRangeError("max_rate_hz and every_frame cannot be used together; give only one of them")


class _Follower:
    """Returns updates of the registers of one block.

    For this, it compares each frame with the frame of the last update.
    """

    def __init__(self, block: Block, registers: Sequence[Register], *, every_frame: bool, interval_s: float) -> None:
        self.block = block
        self.due_s = math.inf
        """Earliest time of the next update if ``max_rate_hz`` delays it: monotonic clock, in s."""
        self._registers = registers
        self._scan = ChangeScan(registers, block.statuses)
        self._frames = FrameFollower(block)
        self._every_frame = every_frame
        self._interval_s = interval_s
        self._last_s = -math.inf
        self._state: object = None

    def take(self) -> Update | None:
        """Return the next update; None if there is none yet."""
        frames, shown = self._frames, self._frames.frame
        frame = self._next()
        missed = 0 if frame is None else frames.take_missed()
        if frame is None:
            if shown is None or frames.behind:  # if a newer frame waits until it is due, the last one is not stale
                return None
            frame = shown
        aged = not frames.behind  # only the newest frame can be stale, not an older one that a slow reader gets late
        frames.take(frame, aged=aged)
        # The reason of a stale frame contains its age. A change of the age alone is ignored.
        reason = frames.reason.partition(":")[0]
        state = frames.quality, reason, frame.provenance, frame.incarnation, self.block.injections.sequence
        if shown is None or state != self._state:
            changed: Sequence[int] = range(len(self._registers))
        elif frame is shown:
            return None
        else:
            changed = self._scan.changed(shown.image, frame.image)
        self._state = state
        if not changed and not self._every_frame:
            return None
        if frame is not shown:
            self._last_s = time.monotonic()
        readings = tuple(reading(self.block, self._registers[index], frame, aged=aged) for index in changed)
        return Update(
            self.block.source, frame.number, frame.cycle, frame.incarnation, frame.clock_ns, frame.source_ns,
            frames.quality, frames.reason, frame.provenance, missed, ended=False, readings=readings,
        )  # fmt: skip

    def _next(self) -> Frame | None:
        """Return the next frame; None if there is none yet, or if ``max_rate_hz`` delays it."""
        frames = self._frames
        if self._every_frame:
            return frames.poll()
        self.due_s = math.inf
        if frames.frame is not None and not frames.behind:
            return None
        if time.monotonic() < self._last_s + self._interval_s:
            self.due_s = self._last_s + self._interval_s
            return None
        try:
            return frames.newest()
        except SegmentError:  # overwritten while it was read: there will be another frame
            return None

    def end(self, what: str) -> Update:
        """Return the last update, for a source that a reload has removed."""
        frame = self._frames.frame
        times = (0, 0, 0, 0, 0) if frame is None else (
            frame.number, frame.cycle, frame.incarnation, frame.clock_ns, frame.source_ns,
        )  # fmt: skip
        provenance = Provenance.LIVE if frame is None else frame.provenance
        return Update(self.block.source, *times, Quality.BAD, what, provenance, 0, ended=True, readings=())
