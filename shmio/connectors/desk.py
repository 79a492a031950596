"""Where commands toward a source are taken, judged, and kept until the next cycle carries them out.

They are taken in a thread of its own, so that a device that does not answer delays no decision; the loop's thread
carries them out, before it reads, so that the next frame shows them.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Final, NamedTuple

from shmio.errors import ConnectorError
from shmio.layout.write import Write, cover, merge
from shmio.segment import BlockWriter, Command, EventKind, Record
from shmio.segment.events import EVENT_DATA_SIZE

MAX_WAITING: Final = 16_384
"""Most items that wait for the next cycle."""

log = logging.getLogger("shmio.source")


class _Item(NamedTuple):
    """One accepted write of a command."""

    command: Command
    place: int

    @property
    def write(self) -> Write:
        return self.command.writes[self.place]


class CommandDesk:
    """Judges the commands of one block. :meth:`run` is for a thread of its own, all else for the loop's."""

    def __init__(self, writer: BlockWriter, writable: Iterable[str] | None, now_ns: Callable[[], int]) -> None:
        """``writable``: patterns; None: the device cannot be written at all."""
        self._writer = writer
        self._now_ns = now_ns
        self._cannot = "this source's connector cannot write" if writable is None else ""
        self._writable = cover(writer.block.layout, writable or ())
        self._turn = threading.Lock()
        self._closed = "the source is not connected yet"
        self._items: list[_Item] = []
        self._stopped = False

    def open(self) -> None:
        """The device is there: accept."""
        with self._turn:
            self._closed = ""

    def close(self, reason: str) -> None:
        """The device is gone: what waits is not done later, and nothing more is accepted until it is back."""
        with self._turn:
            self._closed = f"the source is not connected: {reason}"
            items, self._items = self._items, []
        self._end(items, [(EventKind.EXPIRED, reason)] * len(items))

    @property
    def waiting(self) -> bool:
        """Whether there is something to carry out."""
        return bool(self._items)

    def carry_out(self, write: Callable[[Sequence[Write]], list[str]]) -> None:
        """Write all that waits, each byte and bit once, the last value wins; tell what became of each item.

        ConnectorError: raised by ``write``, after it has been told that nobody knows.
        """
        with self._turn:
            items, self._items = self._items, []
        now_ns = self._now_ns()
        late = [item for item in items if now_ns > item.command.deadline_ns]
        self._end(late, [(EventKind.EXPIRED, "no cycle came before its deadline")] * len(late))
        items = [item for item in items if now_ns <= item.command.deadline_ns]
        if not items:
            return
        writes, superseded = _coalesce([item.write for item in items], self._writer.block.layout.size)
        try:
            refusals = write(writes)
        except ConnectorError as error:
            self._end(items, [(EventKind.UNKNOWN, f"sent, but not confirmed: {error}")] * len(items))
            raise
        refused = [(write, text) for write, text in zip(writes, refusals, strict=True) if text]
        ends = [
            _end(item.write, refused) if place not in superseded else (EventKind.WRITTEN, _SUPERSEDED)
            for place, item in enumerate(items)
        ]
        self._end(items, ends)

    def run(self) -> None:
        """Take commands until :meth:`stop`."""
        queues = self._writer.block.commands
        while not self._stopped:
            seen = queues.bell()
            taken = True
            while taken and not self._stopped:
                taken = False
                for writer in range(queues.writers):  # one of each in turn
                    taken |= self._take_one(writer)
            if not self._stopped:
                queues.wait(seen)

    def stop(self) -> None:
        """Make :meth:`run` return; from any thread."""
        self._stopped = True
        self._writer.block.commands.wake()

    def _take_one(self, writer: int) -> bool:
        """Judge the oldest command of a writer; whether there was one."""
        try:
            record = self._writer.block.commands.pop(writer)
            if record is None:
                return False
            command = Command.unpack(writer, record)
        except ValueError as error:
            log.warning("writer %d sent what is no command: %s", writer, error)
            self._writer.event(Record(EventKind.REJECTED, f"not a command: {error}", writer))
            return True
        self._judge(command)
        return True

    def _judge(self, command: Command) -> None:
        reason = self._refusal(command)
        if reason:
            self._writer.event(_record(EventKind.REJECTED, _Item(command, 0), len(command.writes), reason))
            return
        items = [_Item(command, place) for place in range(len(command.writes))]
        for item in items:  # outside the lock, which the loop must never wait for long
            for part in _parts(item):
                self._writer.event(part)
        with self._turn:
            closed = self._closed
            if not closed:
                self._items += items
        if closed:
            self._end(items, [(EventKind.EXPIRED, closed)] * len(items))

    def _refusal(self, command: Command) -> str:
        """Why a command is not accepted; empty if it is."""
        if command.incarnation != self._writer.incarnation:
            return "it was meant for the source's process before this one, which ended"
        late_ns = self._now_ns() - command.deadline_ns
        if late_ns > 0:
            return f"it came {late_ns / 1e6:.0f} ms after its deadline"
        if self._cannot:
            return self._cannot
        if self._closed:
            return self._closed
        if len(self._items) + len(command.writes) > MAX_WAITING:
            return f"{len(self._items)} writes wait already"
        for write in command.writes:
            stop = write.offset + len(write.data)
            if stop > len(self._writable):
                return f"byte {stop - 1} lies outside the block"
            allowed = self._writable[write.offset : stop]
            if not (allowed[0] & write.mask if write.mask else allowed == b"\xff" * len(allowed)):
                return f"bytes {write.offset} to {stop - 1} are not writable; name them in the source's `writable`"
        return ""

    def _end(self, items: Sequence[_Item], ends: Sequence[tuple[EventKind, str]]) -> None:
        """Tell what became of accepted items: one event for neighbours in a command that ended alike."""
        both = zip(items, ends, strict=True)
        for (_, (kind, text)), group in groupby(both, key=lambda pair: (id(pair[0].command), pair[1])):
            for first, count in _runs([item for item, _ in group]):
                self._writer.event(_record(kind, first, count, text))


_SUPERSEDED: Final = "superseded by a later write of the same cycle"


def _coalesce(writes: Sequence[Write], size: int) -> tuple[list[Write], set[int]]:
    """What has to be written so that the last value of each bit wins, and the places of those that left nothing."""
    image, mask = bytearray(size), bytearray(size)
    superseded = set()
    for place in reversed(range(len(writes))):
        offset, bit, data = writes[place]
        fresh = False
        for at, byte in enumerate(data, offset):
            free = (bit or 0xFF) & ~mask[at]
            if free:
                image[at] |= byte & free
                mask[at] |= free
                fresh = True
        if not fresh:
            superseded.add(place)
    return merge(image, mask, [(write.offset, write.offset + len(write.data)) for write in writes]), superseded


def _end(write: Write, refused: Sequence[tuple[Write, str]]) -> tuple[EventKind, str]:
    """The end of an item, from the merged writes that the device refused."""
    start, stop = write.offset, write.offset + len(write.data)
    for other, text in refused:
        same_bits = not write.mask or not other.mask or write.mask == other.mask
        if same_bits and other.offset < stop and start < other.offset + len(other.data):
            return EventKind.REFUSED, text
    return EventKind.WRITTEN, ""


def _record(kind: EventKind, item: _Item, count: int, text: str = "") -> Record:
    command, write = item.command, item.write
    return Record(
        kind, text, command.writer, command.id, item.place, count, write.offset, write.mask, len(write.data)
    )  # fmt: skip


def _parts(item: _Item) -> Iterator[Record]:
    """The events that tell of an accepted item with its data; several if these are long."""
    command, (offset, mask, data) = item.command, item.write
    for start in range(0, len(data), EVENT_DATA_SIZE):
        part = data[start : start + EVENT_DATA_SIZE]
        yield Record(
            EventKind.ACCEPTED, "", command.writer, command.id, item.place, 1, offset + start, mask, len(part), part
        )  # fmt: skip


def _runs(items: Sequence[_Item]) -> Iterator[tuple[_Item, int]]:
    """Consecutive places of one command as (first, count)."""
    first, count = items[0], 1
    for item in items[1:]:
        if item.place == first.place + count:
            count += 1
        else:
            yield first, count
            first, count = item, 1
    yield first, count
