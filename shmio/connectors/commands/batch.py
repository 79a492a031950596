"""Combines the accepted items of a cycle into one batch of writes, and derives each item's outcome.

No I/O.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, groupby
from typing import Final, NamedTuple, TypeVar

from shmio.connectors.base import Lost
from shmio.errors import ConnectorError
from shmio.layout.values.write import Write, apply, merge
from shmio.segment import Command, EventKind, Record

End = tuple[EventKind, str]
"""The event that ends an item, and its text."""

_Outcome = TypeVar("_Outcome", str, str | Lost)

_SUPERSEDED: Final = "superseded by a later write of the same cycle"


class Item(NamedTuple):
    """One accepted write of a command."""

    command: Command
    place: int
    bits: bytes | None = None
    """The write's bits that go to the device, if injections took the others."""
    data: bytes | None = None
    """The item's values, if injections have changed some."""
    changed_by: str = ""
    """The injection that changed the values last."""

    @property
    def write(self) -> Write:
        """The write, with the values that injections have changed."""
        write = self.command.writes[self.place]
        return write if self.data is None else write._replace(data=self.data)

    def parts(self) -> list[Write]:
        """Return the parts of the write that go to the device."""
        offset, _, data = self.write
        if self.bits is None:
            return [self.write]
        return [part._replace(offset=offset + part.offset) for part in merge(data, self.bits, [(0, len(data))])]


def coalesce(items: Sequence[Item], size: int) -> tuple[list[Write], set[int]]:
    """Merge items into writes so that the last value of each bit wins.

    Neighbours are joined only within a command, because its client wanted all of it or nothing.

    Args:
        items: Accepted items, oldest first.
        size: Size of the block in bytes.

    Returns:
        The writes, and the indices of items that later ones superseded completely.

    """
    taken = bytearray(size)
    kept: list[tuple[Item, bytes]] = []  # last first, with the bits that no later item writes
    superseded = set()
    for place in reversed(range(len(items))):
        offset, mask, data = items[place].write
        wanted = items[place].bits or bytes([mask or 0xFF]) * len(data)
        own = bytes(~later & bits for later, bits in zip(taken[offset : offset + len(data)], wanted, strict=True))
        if not any(own):
            superseded.add(place)
            continue
        for at, bits in enumerate(own, offset):
            taken[at] |= bits
        kept.append((items[place], own))
    writes: list[Write] = []
    image, bits_kept = bytearray(size), bytearray(size)
    for _, group in groupby(reversed(kept), key=lambda pair: id(pair[0].command)):
        ranges = []
        for item, own in group:
            offset, stop = item.write.offset, item.write.offset + len(own)
            ranges.append((offset, stop))
            for part in item.parts():
                apply(part, image)
            for at, bits in enumerate(own, offset):
                bits_kept[at] |= bits
        writes += merge(image, bits_kept, ranges)
        for start, stop in ranges:
            bits_kept[start:stop] = bytes(stop - start)
    return writes, superseded


def ends(
    items: Sequence[Item], writes: Sequence[Write], superseded: set[int], outcomes: Sequence[str | Lost], error: str
) -> list[End]:
    """Return the end of each item.

    Args:
        items: The items of the batch.
        writes: The writes from :func:`coalesce`.
        superseded: The superseded indices from :func:`coalesce`.
        outcomes: The outcome of each write.
        error: Why some outcomes were lost.

    """
    lost = any(isinstance(outcome, Lost) for outcome in outcomes)
    known = _WriteOutcomes((write, outcome) for write, outcome in zip(writes, outcomes, strict=True) if outcome or lost)
    found = [_end(known.about(item.write), error) for item in items]
    for place, item in enumerate(items):
        if found[place][0] is not EventKind.WRITTEN:
            continue
        if place in superseded:  # the later write was written
            found[place] = EventKind.WRITTEN, _SUPERSEDED
        elif item.changed_by:
            found[place] = EventKind.WRITTEN, f"with what the injection {item.changed_by!r} made of it"
    return found


class _WriteOutcomes:
    """Finds the outcomes of writes by their place in the block; thousands may have been refused.

    Confirmed writes may be left out unless some were lost.
    """

    def __init__(self, known: Iterable[tuple[Write, str | Lost]]) -> None:
        self._known = sorted(known, key=lambda pair: pair[0].offset)
        self._starts = [write.offset for write, _ in self._known]
        self._stops = list(accumulate((write.offset + len(write.data) for write, _ in self._known), max))

    def about(self, write: Write) -> list[str | Lost]:
        """Return the outcomes of all writes that share bits with this one."""
        first = bisect_right(self._stops, write.offset)
        last = bisect_left(self._starts, write.offset + len(write.data))
        return [outcome for other, outcome in self._known[first:last] if _share_bits(write, other)]


def _end(outcomes: Sequence[str | Lost], error: str) -> End:
    """Return the end of an item from the outcomes of its writes."""
    refusal = next((outcome for outcome in outcomes if outcome and isinstance(outcome, str)), "")
    lost = Lost.UNSENT in outcomes
    if Lost.UNKNOWN in outcomes or (lost and "" in outcomes):  # partly written
        return EventKind.UNKNOWN, f"sent, but not confirmed: {error}"
    if refusal:
        return EventKind.REFUSED, refusal
    return (EventKind.EXPIRED, f"not sent: {error}") if lost else (EventKind.WRITTEN, "")


def _share_bits(one: Write, other: Write) -> bool:
    if one.mask and other.mask and one.mask != other.mask:
        return False
    return other.offset < one.offset + len(one.data) and one.offset < other.offset + len(other.data)


def one_each(outcomes: Sequence[_Outcome], writes: Sequence[Write]) -> Sequence[_Outcome]:
    """Check that a connector returned one outcome for each write.

    Raises:
        ConnectorError: Their numbers differ.

    """
    if len(outcomes) != len(writes):
        raise ConnectorError(f"the connector returned {len(outcomes)} outcomes for {len(writes)} writes")
    return outcomes


def records(items: Sequence[Item], ends: Sequence[End]) -> Iterator[Record]:
    """Yield the events about the ends of items; neighbours that ended alike share one."""
    both = zip(items, ends, strict=True)
    for (_, (kind, text)), group in groupby(both, key=lambda pair: (id(pair[0].command), pair[1])):
        for first, count in _runs([item for item, _ in group]):
            yield _record(kind, first, count, text)


def _record(kind: EventKind, item: Item, count: int, text: str = "") -> Record:
    command, write = item.command, item.write
    return Record(
        kind, text, command.writer, command.id, item.place, count, write.offset, write.mask, len(write.data)
    )  # fmt: skip


def _runs(items: Sequence[Item]) -> Iterator[tuple[Item, int]]:
    """Consecutive places of one command as (first, count)."""
    first, count = items[0], 1
    for item in items[1:]:
        if item.place == first.place + count:
            count += 1
        else:
            yield first, count
            first, count = item, 1
    yield first, count
