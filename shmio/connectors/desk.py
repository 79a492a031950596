"""Where commands toward a source are taken, judged, and kept until the next cycle carries them out.

They are taken in a thread of its own, so that a device that does not answer delays no decision; the loop's thread
carries them out, before it reads, so that the next frame shows them.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Final

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.batch import End, Item, coalesce, ends
from shmio.layout.write import Write, cover
from shmio.segment import BlockWriter, Command, EventKind, Record
from shmio.segment.events import EVENT_DATA_SIZE

MAX_WAITING: Final = 256
"""Items that wait for the next cycle; what comes beyond stays in its queue. A command alone may have more."""
MAX_WAITING_BLOCKS: Final = 4
"""The same in bytes, as a multiple of the block's."""
TELL_NS: Final = 1_000_000_000
"""How often a writer that sends garbage is told."""

log = logging.getLogger("shmio.source")


class CommandDesk:
    """Judges the commands of one block. :meth:`run` is for a thread of its own, all else for the loop's."""

    def __init__(
        self,
        writer: BlockWriter,
        writable: Iterable[str] | None,
        now_ns: Callable[[], int],
        accepted: Callable[[], None] | None = None,
    ) -> None:
        """``writable``: patterns; None: the device cannot be written at all. ``accepted``: called when items wait."""
        self._writer = writer
        self._now_ns = now_ns
        self._accepted = accepted
        self._cannot = "this source's connector cannot write" if writable is None else ""
        self._writable = cover(writer.block.layout, writable or ())
        self._most_bytes = MAX_WAITING_BLOCKS * writer.block.layout.size
        self._turn = threading.Lock()
        self._closed = "the source is not connected yet"
        self._items: list[Item] = []
        self._held: Command | None = None  # taken from its queue, but there is no room for it before the next cycle
        self._garbage_ns: dict[int, int] = {}
        self._stopped = False

    def open(self) -> None:
        """The device is there, and its block is as it should be: accept."""
        with self._turn:
            self._closed = ""

    def close(self, reason: str) -> None:
        """The device is gone: what waits is not done later, and nothing more is accepted until it is back."""
        with self._turn:
            self._closed = f"the source is not connected: {reason}"
            items, self._items = self._items, []
        self._end(items, [(EventKind.EXPIRED, reason)] * len(items))
        self._make_room()

    @property
    def waiting(self) -> bool:
        """Whether there is something to carry out."""
        return bool(self._items)

    def carry_out(self, write: Callable[[Sequence[Write]], list[str]]) -> None:
        """Write all that waits, each byte and bit once, the last value wins; tell what became of each item.

        Commands go in the order in which they were accepted. Whatever ``write`` raises is raised, after it has been
        told of each item what is known.
        """
        items = self._take(lambda _: True)
        now_ns = self._now_ns()
        late = [item for item in items if now_ns > item.command.deadline_ns]
        self._expire(late)
        items = [item for item in items if now_ns <= item.command.deadline_ns]
        try:
            if items:
                self._write(items, write)
        finally:
            self._make_room()

    def _write(self, items: Sequence[Item], write: Callable[[Sequence[Write]], list[str]]) -> None:
        writes, superseded = coalesce(items, self._writer.block.layout.size)
        outcomes: Sequence[str | Lost] = [Lost.UNKNOWN] * len(writes)
        error = ""
        try:
            outcomes = write(writes)
        except WriteLostError as lost:
            outcomes, error = lost.outcomes, str(lost)
            raise
        except BaseException as unforeseen:
            error = str(unforeseen)
            raise
        finally:
            self._end(items, ends(items, writes, superseded, outcomes, error))

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
            self._expire(self._take(lambda item: self._now_ns() > item.command.deadline_ns))
            if not self._stopped:
                queues.wait(seen, self._patience_ns())

    def stop(self) -> None:
        """Make :meth:`run` return; from any thread."""
        self._stopped = True
        self._writer.block.commands.wake()

    def _take(self, which: Callable[[Item], bool]) -> list[Item]:
        """Take what waits and is of this kind."""
        with self._turn:
            kinds = [(item, which(item)) for item in self._items]
            self._items = [item for item, wanted in kinds if not wanted]
        return [item for item, wanted in kinds if wanted]

    def _expire(self, items: Sequence[Item]) -> None:
        self._end(items, [(EventKind.EXPIRED, "no cycle came before its deadline")] * len(items))

    def _patience_ns(self) -> int:
        """Until the first deadline of what waits."""
        with self._turn:
            deadlines = [item.command.deadline_ns for item in self._items]
        return max(0, min(deadlines) - self._now_ns()) + 1_000_000 if deadlines else -1

    def _make_room(self) -> None:
        """What was held for want of room can be judged."""
        if self._held is not None:
            self._writer.block.commands.wake()

    def _take_one(self, writer: int) -> bool:
        """Judge the oldest command of a writer; whether there was one, and room for it."""
        if self._held is not None:
            command, self._held = self._held, None
            return self._judge(command)
        try:
            record = self._writer.block.commands.pop(writer)
            if record is None:
                return False
            command = Command.unpack(writer, record)
        except ValueError as error:
            self._garbage(writer, error)
            return True
        return self._judge(command)

    def _garbage(self, writer: int, error: ValueError) -> None:
        """A writer that sends what is no command is told now and then, however much it sends."""
        now_ns = time.monotonic_ns()
        if now_ns - self._garbage_ns.get(writer, -TELL_NS) >= TELL_NS:
            self._garbage_ns[writer] = now_ns
            log.warning("writer %d sends what is no command: %s", writer, error)
            self._writer.event(Record(EventKind.REJECTED, f"not a command: {error}", writer))

    def _judge(self, command: Command) -> bool:
        """Accept or reject; False if there is no room before the next cycle, and the command is held."""
        reason = self._refusal(command)
        if reason:
            self._writer.event(_record(EventKind.REJECTED, Item(command, 0), len(command.writes), reason))
            return True
        if not self._has_room(command):
            self._held = command
            return False
        items = [Item(command, place) for place in range(len(command.writes))]
        for item in items:  # outside the lock, which the loop must never wait for long
            for part in _parts(item):
                self._writer.event(part)
        with self._turn:
            closed = self._closed
            if not closed:
                self._items += items
        if closed:
            self._end(items, [(EventKind.EXPIRED, closed)] * len(items))
        elif self._accepted is not None:
            self._accepted()
        return True

    def _has_room(self, command: Command) -> bool:
        with self._turn:
            items = list(self._items)
        if not items:
            return True
        size = sum(len(item.write.data) for item in items) + sum(len(write.data) for write in command.writes)
        return len(items) + len(command.writes) <= MAX_WAITING and size <= self._most_bytes

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
        for write in command.writes:
            stop = write.offset + len(write.data)
            if stop > len(self._writable):
                return f"byte {stop - 1} lies outside the block"
            allowed = self._writable[write.offset : stop]
            if not (allowed[0] & write.mask if write.mask else allowed == b"\xff" * len(allowed)):
                return f"bytes {write.offset} to {stop - 1} are not writable; name them in the source's `writable`"
        return ""

    def _end(self, items: Sequence[Item], ends: Sequence[End]) -> None:
        """Tell what became of accepted items: one event for neighbours in a command that ended alike."""
        both = zip(items, ends, strict=True)
        for (_, (kind, text)), group in groupby(both, key=lambda pair: (id(pair[0].command), pair[1])):
            for first, count in _runs([item for item, _ in group]):
                self._writer.event(_record(kind, first, count, text))


def _record(kind: EventKind, item: Item, count: int, text: str = "") -> Record:
    command, write = item.command, item.write
    return Record(
        kind, text, command.writer, command.id, item.place, count, write.offset, write.mask, len(write.data)
    )  # fmt: skip


def _parts(item: Item) -> Iterator[Record]:
    """The events that tell of an accepted item with its data; several if these are long."""
    command, (offset, mask, data) = item.command, item.write
    for start in range(0, len(data), EVENT_DATA_SIZE):
        part = data[start : start + EVENT_DATA_SIZE]
        yield Record(
            EventKind.ACCEPTED, "", command.writer, command.id, item.place, 1, offset + start, mask, len(part), part
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
