"""Follows one block: reads its frames and events, and leaves out what the rules do not publish."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from itertools import islice, pairwise
from typing import Final, NamedTuple

import numpy as np

from shmio.config.model import FabricRule
from shmio.fabric.messages import MAX_ENTRY_BYTES, PREFERRED_BYTES, Entry, encode_entries
from shmio.layout.model import Layout
from shmio.layout.values.write import Write, covering
from shmio.recording.block_follower import BlockFollower
from shmio.recording.format.encoding import BlockPosition, Gap, Reason
from shmio.recording.selection import Selection
from shmio.segment import Block, Event, EventKind, Frame
from shmio.segment.doorbell import TURN_NS

MAX_RANGES: Final = 256
"""Maximum number of ranges that are published of an injection if only some registers are published."""
MAX_ENTRIES: Final = 32
"""Maximum number of entries that are read before the uplink does other work."""
FIRST_RULE: Final = FabricRule(match="*")
"""The rule for sources that no rule of the configuration matches: publish all frames."""

Ranges = Sequence[tuple[int, int, int]]


def rule_for(rules: Sequence[FabricRule], source: str) -> FabricRule:
    """Return the first rule that matches a source."""
    return next((rule for rule in rules if any(fnmatchcase(source, one) for one in rule.patterns)), FIRST_RULE)


class Batch(NamedTuple):
    """Entries of one message.

    Attributes:
        entries: The frames, events and gaps, encoded.
        left_out: Number of frames that the rule has left out between the last frame of the previous
            batches and the last frame of this one.

    """

    entries: bytearray
    left_out: int


class Feed:
    """Follows one block. After its creation, use it only in the event loop's thread."""

    def __init__(
        self,
        block: Block,
        rule: FabricRule,
        sources: Collection[str],
        started_utc_ns: int,
        place: BlockPosition,
        writer: int,
    ) -> None:
        """Create the feed. For a large layout this takes seconds.

        Args:
            block: The block to follow.
            rule: What to publish.
            sources: Names of all sources of the instance.
            started_utc_ns: Time of messages when the instance's clock was 0, in ns.
            place: Position after which to begin.
            writer: Number of the command queue for the commands of other cells.

        """
        self.block, self._writer = block, writer
        part = Selection(None, rule.registers).part(block, sources)
        self.empty = part is None
        """True if the rule publishes no register of the source."""
        self._keep = None if part is None else part.keep
        self._all = part is not None and part.whole and rule.send == "frames" and rule.max_rate_hz is None
        """True if the rule publishes each frame as it is."""
        self._limit = max(1, min(MAX_ENTRIES, PREFERRED_BYTES // max(1, block.ring.frame_size)))
        self.layout: Layout = block.layout if part is None else part.layout
        """The layout of the published frames: the registers that the rule names."""
        self.digest = self.layout.hash
        self._visible = covering(self.layout.registers, self.layout.size) if rule.registers else None
        self.turn_ns = min(TURN_NS, block.stale_ns)
        self._rule = rule
        self._changes = rule.send == "changes"
        self._pause_ns = 0 if rule.max_rate_hz is None else round(1e9 / rule.max_rate_hz)
        self._follower = BlockFollower(block, 1, place, Reason.OVERTAKEN, started_utc_ns, part=part)
        self._last: Frame | None = None
        self._published_ns = 0
        self._held: Frame | None = None
        """The newest frame, if ``max_rate_hz`` has left it out."""
        self.left_out = 0
        """Number of frames that the rule has left out."""
        self._counted = 0  # of these, those before the last frame of a batch
        self._before = 0  # of these, those before the last published frame
        self.missed = 0
        """Number of frames and events that the source overwrote before they were read."""

    @property
    def last(self) -> int:
        """Number of the last frame that was read."""
        return self._follower.last

    @property
    def ended(self) -> bool:
        """True if a reload has retired the block, and all its entries have been read."""
        return self._follower.done

    def publishes(self, writes: Iterable[Write]) -> bool:
        """Return whether writes stay within the registers that are published."""
        for offset, mask, data in writes:
            if offset + len(data) > self.block.layout.size:
                return False
            if self._visible is None:
                continue
            visible = self._visible[offset : offset + len(data)]
            if len(visible) != len(data) or any((mask or 0xFF) & ~bits for bits in visible):
                return False
        return True

    @property
    def partial(self) -> bool:
        """True if only some registers are published."""
        return self._visible is not None

    def published(self, ranges: Ranges) -> Ranges:
        """Return the bits of these that are published. A range is (offset, size in bytes, mask).

        These are at most the first ``MAX_RANGES`` ranges.
        """
        if self._visible is None:
            return ranges
        bits = np.zeros(len(self._visible), np.uint8)
        for offset, size, mask in ranges:
            bits[offset : offset + size] |= mask
        bits &= np.frombuffer(self._visible, np.uint8)
        places = [0, *map(int, np.flatnonzero(np.diff(bits)) + 1), len(bits)]
        found = ((start, stop - start, int(bits[start])) for start, stop in pairwise(places))
        return tuple(islice((one for one in found if one[2]), MAX_RANGES))

    def covers(self, ranges: Ranges) -> bool:
        """Return whether all of these bits are published."""
        return all(self.publishes([Write(offset, mask, bytes(size))]) for offset, size, mask in ranges)

    def _cleared(self, event: Event) -> Event:
        """Return an event without what it says about registers that are not published.

        Other cells know the data and the reasons of their own commands.
        """
        if self._visible is None or event.writer == self._writer:
            return event
        if event.kind == EventKind.INJECTED:  # its data describe the injection; the state has what is published
            return event._replace(data=b"", size=0)
        shown = not event.size or self.covers([(event.offset, event.size, event.mask or 0xFF)])
        return event if shown else event._replace(data=b"", text="", by="")

    def read(self) -> tuple[list[Batch], bool]:
        """Read new entries; return them in batches, and whether more are waiting."""
        if self._all and (packed := self._follower.pack(self._limit)):
            return [Batch(packed, 0)], self._follower.behind
        taken = self._follower.take(MAX_ENTRIES)
        if self._follower.done:
            taken += self._follower.remaining()
        entries: list[tuple[Entry, int]] = []
        for _, _, item in taken:
            if isinstance(item, Frame):
                chosen = self._chosen(item if self._keep is None else self._keep(item))
                entries += ((frame, self._before) for frame in chosen)
            else:
                if isinstance(item, Gap):
                    self.missed += item.count
                else:
                    item = self._cleared(item)  # noqa: PLW2901
                entries.append((item, self._before))
        if not taken and self._held is not None and time.monotonic_ns() - self._published_ns >= self._pause_ns:
            entries += ((frame, self._before) for frame in self._publish(self._held))
        return list(self._batches(entries)), len(taken) >= MAX_ENTRIES

    def _batches(self, entries: list[tuple[Entry, int]]) -> Iterator[Batch]:
        """Group entries so that no message becomes too large.

        With each entry comes the number of frames that the rule had left out before the last frame.
        """
        group: list[Entry] = []
        size = left_out = 0
        for entry, before in entries:
            own = _size(entry)
            if group and (size >= PREFERRED_BYTES or size + own > MAX_ENTRY_BYTES):
                yield self._batch(group, left_out)
                group, size = [], 0
            group.append(entry)
            size += own
            left_out = before
        if group:
            yield self._batch(group, left_out)

    def _batch(self, entries: list[Entry], left_out: int) -> Batch:
        more, self._counted = left_out - self._counted, left_out
        return Batch(encode_entries(entries), more)

    def _chosen(self, frame: Frame) -> Iterator[Frame]:
        """Yield the frame, unless the rule leaves it out."""
        now_ns = time.monotonic_ns()
        if not self._changes and not self._pause_ns:
            yield frame
            return
        if self._held is not None:
            self._held = None
            self.left_out += 1
        last = self._last
        if last is None or _state(last) != _state(frame):
            yield from self._publish(frame)
        elif self._changes and now_ns - self._published_ns < self.block.stale_ns // 2 and _same(last, frame):
            self.left_out += 1
        elif now_ns - self._published_ns < self._pause_ns:
            self._held = frame
        else:
            yield from self._publish(frame)

    def _publish(self, frame: Frame) -> Iterator[Frame]:
        self._last, self._held, self._published_ns = frame, None, time.monotonic_ns()
        self._before = self.left_out
        yield frame


def _state(frame: Frame) -> tuple[object, ...]:
    """Return what a frame says apart from its values and times. A change is always published."""
    return frame.quality, frame.provenance, frame.reason, frame.incarnation, frame.effective is None


def _same(one: Frame, other: Frame) -> bool:
    return one.raw == other.raw and one.effective == other.effective


def _size(entry: Entry) -> int:
    """Return an upper bound of the size of an encoded entry."""
    if isinstance(entry, Frame):
        return 512 + len(entry.raw) + len(entry.effective or b"")
    return 512
