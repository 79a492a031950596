"""Reads the frames and events of one block in the order in which its source published them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import repeat
from typing import Final, Generic, NamedTuple, TypeVar

from shmio.recording.format.encoding import BlockPosition, Gap, Reason
from shmio.recording.selection import RecordedRegisters
from shmio.segment import Block, Cursor, Event, Frame
from shmio.segment.block import read_frames

Item = TypeVar("Item", bound=Frame | Event)


class BlockEntry(NamedTuple):
    """A frame, an event or a gap of a block, with its log time."""

    log_ns: int
    follower: BlockFollower
    item: Frame | Event | Gap


_ENTRY: Final = partial(tuple.__new__, BlockEntry)
"""Makes an entry of a tuple, faster than BlockEntry() of three arguments."""


class _Stream(Generic[Item]):
    """The frames or the events of a block, with the position up to which they were read."""

    def __init__(self, what: str, cursor: Cursor[Item], log_ns: int, reason: Reason) -> None:
        self.what = what
        self.cursor = cursor
        self.last = cursor.last
        self.reason = reason
        self.log_ns = log_ns
        self.held: Item | None = None

    def peek(self) -> Item | None:
        if self.held is None:
            self.held = self.cursor.poll()
        return self.held


class BlockFollower:
    """Reads the frames and events of one block in order.

    ``done`` is True if a reload has retired the block, and all its entries have been read.
    """

    def __init__(
        self,
        block: Block,
        number: int,
        place: BlockPosition,
        reason: Reason,
        started_utc_ns: int,
        *,
        over: bool = False,
        part: RecordedRegisters | None = None,
    ) -> None:
        """Start to follow a block.

        Args:
            block: The block.
            number: Number of the block in the recording.
            place: The position after which to start.
            reason: Reason for a gap at the start.
            started_utc_ns: Log time when the instance's clock was 0, in ns.
            over: True if a reload has already retired the block.
            part: The registers to record; None for all.
        """
        self.block = block
        self.number = number
        self.begin = place
        self.over = over
        self.part = part or RecordedRegisters(block.layout)
        self.done = False
        self._started_utc_ns = started_utc_ns
        self._log_ns = place.log_ns
        self._frames = _Stream("frames", block.cursor(after=place.frame), place.log_ns, reason)
        self._events = _Stream("events", block.events.cursor(after=place.event), place.log_ns, reason)

    @property
    def last(self) -> int:
        """Number of the last frame that was read or counted as missed."""
        return self._frames.cursor.last

    def restart_time(self) -> None:
        """Let the log time go back: give the next entries their own times, even if earlier ones have later times."""
        self._log_ns = 0

    def take(self, limit: int) -> list[BlockEntry]:
        """Return unread entries that were published so far: about ``limit`` at most."""
        retired = self.block.retired  # before the read, so that the last entries are read, too
        entries: list[BlockEntry] = []
        while limit > 0:
            if frames := self._frames_before_event(limit):
                limit -= len(frames)
                entries += self._consecutive(frames)
                continue
            side = self._next()
            if side is None:
                self.done = retired
                self._frames.reason = self._events.reason = Reason.OVERTAKEN  # later entries are new
                break
            limit -= 1
            entries += self._entries(side)
        return entries

    def _frames_before_event(self, limit: int) -> list[Frame]:
        """Return up to ``limit`` unread frames without gaps that come before the next event.

        The list is empty if the next entry is not such a frame, or if it is not known.
        """
        side = self._frames
        if side.held is not None or side.cursor.last != side.last:
            return []
        newest = self.block.ring.head()  # before the events: an event that is published now comes after these frames
        event = self._events.peek()
        until = newest if event is None else min(newest, event.frame)
        frames = read_frames(self.block.ring, side.last + 1, min(limit, until - side.last))
        if frames:
            side.cursor.resume(after=frames[-1].number)
        return frames

    def _consecutive(self, frames: Sequence[Frame]) -> list[BlockEntry]:
        """Return the entries for frames that follow the last one without a gap."""
        log_ns, utc_ns = self._log_ns, self._started_utc_ns
        times = []
        for frame in frames:
            log_ns = max(log_ns, utc_ns + frame.clock_ns)  # as in _entries()
            times.append(log_ns)
        entries = list(map(_ENTRY, zip(times, repeat(self), frames)))
        side = self._frames
        side.last, side.log_ns, side.reason = frames[-1].number, log_ns, Reason.OVERTAKEN
        self._log_ns = log_ns
        return entries

    def pack(self, limit: int) -> bytearray:
        """Read frames as entries of a message of the fabric: ``limit`` at most, up to the next event.

        Returns:
            The entries. They are empty if the next entry is not a good frame that follows the last
            one without a gap: then call :meth:`take`, which also finds out whether there is none.
        """
        frames, events = self._frames, self._events
        if frames.held is not None or events.held is not None:
            return bytearray()
        entries, last, clock_ns = self.block.ring.pack(frames.last, events.last, limit)
        if entries:
            self._log_ns = max(self._log_ns, self._started_utc_ns + clock_ns)
            frames.last, frames.log_ns, frames.reason = last, self._log_ns, Reason.OVERTAKEN
            frames.cursor.resume(after=last)
        return entries

    @property
    def behind(self) -> bool:
        """True if there are unread entries."""
        return bool(self._frames.cursor.behind or self._events.cursor.behind)

    def remaining(self) -> Iterator[BlockEntry]:
        """Yield gaps for the frames and events that were overwritten after the last entry that was read."""
        for side in (self._frames, self._events):
            if side.cursor.last > side.last and side.held is None:
                yield BlockEntry(self._log_ns, self, self._gap(side, side.cursor.last, 0))

    def _next(self) -> _Stream[Frame] | _Stream[Event] | None:
        """Return the stream that has the next entry; None if there is no new entry."""
        frame = self._frames.peek()
        event = self._events.peek()
        if event is None:
            return None if frame is None else self._frames
        if frame is None and event.frame > self._frames.cursor.last:
            frame = self._frames.peek()  # it was published between the two reads
        return self._events if frame is None or event.frame < frame.number else self._frames

    def _entries(self, side: _Stream[Frame] | _Stream[Event]) -> Iterator[BlockEntry]:
        item = side.held
        assert item is not None  # noqa: S101  _next has polled it
        # The time never decreases, so that entries stay in order even if the block's clock goes back.
        self._log_ns = log_ns = max(self._log_ns, self._started_utc_ns + item.clock_ns)
        if item.number > side.last + 1:
            yield BlockEntry(log_ns, self, self._gap(side, item.number - 1, log_ns))
        side.held, side.last, side.log_ns, side.reason = None, item.number, log_ns, Reason.OVERTAKEN
        yield BlockEntry(log_ns, self, item)

    def _gap(self, side: _Stream[Frame] | _Stream[Event], last: int, before_ns: int) -> Gap:
        first = side.last + 1
        return Gap(
            self.block.source,
            self.number,
            side.what,
            first,
            last,
            last - first + 1,
            side.reason,
            side.log_ns,
            before_ns,
        )
