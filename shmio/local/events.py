"""Follow the events of the sources of a local instance."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from shmio.local.subscription import Following
from shmio.model.event import Event, EventKind
from shmio.model.values import Quality
from shmio.segment import events as segment_events
from shmio.segment.block import Block
from shmio.segment.segment import Segment

MAX_PATHS: Final = 2048
"""Maximum number of paths in an event, which is the number of bits in the data of an event.

If an injection covers more registers, its events have only the first of their paths.
"""
_KINDS: Final = {int(kind): EventKind(str(kind)) for kind in segment_events.EventKind}


class EventReader:
    """Reads a block's events in order, with the registers and values that they are about.

    Use it from one thread.
    """

    def __init__(self, block: Block, *, after: int | None = None) -> None:
        """Start after event ``after`` (default: the newest one)."""
        from shmio.segment.explain import Explainer  # noqa: PLC0415  loads numpy, which nothing else here needs

        self.block = block
        self._cursor = block.events.cursor(after=after)
        self._explainer = Explainer(block.source, block.layout, MAX_PATHS)
        self._explainer.know(block.injections.read())
        self._missed = 0  # number of events lost before the next one
        self._last: segment_events.Event | None = None

    @property
    def behind(self) -> bool:
        """True if there are unread events."""
        return self._cursor.behind > 0

    @property
    def ended(self) -> bool:
        """True if a reload has retired the block, and all its events have been read."""
        return self._cursor.ended

    def next(self) -> Event | None:
        """Return the next event without waiting; None if there is none yet."""
        while (event := self._cursor.poll()) is not None:
            if missed := self._cursor.take_missed():
                self._missed += missed
                self._explainer.resume(self.block.injections.read(), self.block.events.head())
            self._last = event
            explained = self._explainer.explain(event)
            if explained.partial:
                continue  # return only the last of the events that define an injection
            missed, self._missed = self._missed, 0
            return Event(
                self.block.source, _KINDS.get(event.kind, EventKind.OTHER), event.number, event.frame, event.cycle,
                event.incarnation, event.clock_ns, event.utc_ns, event.quality, event.text, event.injection,
                event.command, explained.by, explained.direction, tuple(place.path for place in explained.places),
                {place.path: place.value for place in explained.places if place.valued}, missed,
            )  # fmt: skip
        return None

    def removed(self, instance: str) -> Event:
        """Return the REMOVED event, which comes last for a source that a reload has removed."""
        last, source = self._last, self.block.source
        times = (0, 0, 0) if last is None else (last.frame, last.cycle, last.incarnation)
        reason = f"source {source!r} was removed from instance {instance!r} by a reload"
        return Event(
            source,
            EventKind.REMOVED,
            0,
            *times,
            self.block.clock.read().present_ns,
            time.time_ns(),
            Quality.BAD,
            reason,
        )


class Events(Following[Event]):
    """Iterator over events of a local instance. Implements :class:`shmio.model.cell.Events`."""

    def __init__(self, segment: Segment, blocks: Callable[[], Mapping[str, Block]], followed: Iterable[Block]) -> None:
        """Start to follow the events of blocks.

        Args:
            segment: The instance's segment.
            blocks: Returns the instance's present blocks, by source.
            followed: The blocks to follow.
        """
        super().__init__(segment)
        self._blocks = blocks
        self._readers = [EventReader(block) for block in followed]
        for reader in self._readers:
            self._follow(reader.block)

    def _take(self) -> Event | None:
        for reader in list(self._readers):
            event = reader.next()
            if event is None and reader.ended:
                event = self._succeed(reader)
            if event is not None:
                if reader in self._readers:  # so that the other readers come first next time
                    self._readers.remove(reader)
                    self._readers.append(reader)
                return event
        return None

    def _succeed(self, old: EventReader) -> Event | None:
        """Follow the block that has replaced a retired block.

        If a reload has removed the source, return its REMOVED event.
        """
        self._segment.require_running()
        block = self._blocks().get(old.block.source)
        if block is old.block:
            return None  # the reload is not complete yet
        self._leave(old.block)
        if block is None:
            self._readers.remove(old)
            return old.removed(self._segment.instance)
        new = self._readers[self._readers.index(old)] = EventReader(block, after=0)
        self._follow(block)
        return new.next()
