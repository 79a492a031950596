"""Accepts or rejects the commands toward a source, and keeps accepted ones until the next cycle.

A separate thread takes the commands, so that a device that does not answer delays no decision. The
loop's thread carries them out before it reads, so that the next frame shows them.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.commands.batch import End, Item, coalesce, ends, one_each, records
from shmio.connectors.commands.finite import FiniteCheck
from shmio.connectors.injection.declared_injections import Blocks
from shmio.connectors.injection.layers import Layer, uncovered
from shmio.connectors.injection.output import Output
from shmio.connectors.injection.processor import InjectionProcessor, OwnerOf
from shmio.connectors.injection.published import pieces
from shmio.layout.values.write import Write, cover
from shmio.segment import NO_WRITER, Command, CommandKind, EventKind, Record

MAX_WAITING: Final = 256
"""Most items that wait for a cycle.

A single command may have more; further commands stay in their queue.
"""
MAX_WAITING_BLOCKS: Final = 4
"""The same limit in bytes, as a multiple of the block's size."""
FAR_NS: Final = 1 << 62
"""Deadline of a write that a delay held: effectively none."""
TELL_NS: Final = 1_000_000_000
"""Shortest time between two events about garbage from the same writer."""

_UNARMED: Final = "an injection toward a device needs `armed = true` in the source's configuration"

log = logging.getLogger("shmio.source")


class CommandProcessor:
    """Processes the commands of one block.

    A thread of its own calls :meth:`run`; the loop's thread calls the other methods.
    """

    def __init__(
        self,
        output: Output,
        writable: Iterable[str] | None,
        now_ns: Callable[[], int],
        *,
        allow_nonfinite: Iterable[str] = (),
        armed: bool = False,
        owner_of: OwnerOf = lambda _: None,
        blocks: Blocks | None = None,
        accepted: Callable[[], None] = lambda: None,
    ) -> None:
        """Create the processor.

        Args:
            output: Publishes the source's images and events.
            writable: Patterns of writable registers; None if the device cannot be written.
            now_ns: The loop's clock.
            allow_nonfinite: Patterns of registers that may be written NaN and infinities.
            armed: Whether injections may reach the device.
            owner_of: Finds the process that has a command queue.
            blocks: Returns the blocks of all sources, for conditions; default: this source's alone.
            accepted: Called when items wait.

        """
        self._writer = output.writer
        self._output = output
        self._now_ns = now_ns
        self._accepted = accepted
        self._cannot = "this source's connector cannot write" if writable is None else ""
        layout = self._writer.block.layout
        self._writable = cover(layout, writable or ())
        self._finite = FiniteCheck(layout, allow_nonfinite)
        self._most_bytes = MAX_WAITING_BLOCKS * layout.size
        refuse_in = self._cannot or ("" if armed else _UNARMED)
        blocks = blocks or (lambda: {output.writer.block.source: output.writer.block})
        self._injections = InjectionProcessor(output, self._writable, refuse_in, owner_of, blocks)
        self._turn = threading.Lock()
        self._verdict = threading.Lock()  # held while acceptance is published and until the items wait
        self._closed = "the source is not connected yet"
        self._items: list[Item] = []
        self._held: Command | None = None  # taken from its queue, waits for room until the next cycle
        self._garbage_ns: dict[int, int] = {}
        self._stopped = False

    def open(self) -> None:
        """Start accepting: the device is connected and its block matches the layout."""
        with self._turn:
            self._closed = ""

    def close(self, reason: str) -> None:
        """Stop accepting: the device is gone. Waiting items expire."""
        with self._turn:
            self._closed = f"the source is not connected: {reason}"
            items, self._items = self._items, []
        self._end(items, [(EventKind.EXPIRED, reason)] * len(items))
        self._injections.declared.forget(reason)
        self._make_room()

    def settle(self) -> None:
        """Wait until every item whose acceptance was published is in :attr:`waiting`."""
        with self._verdict:
            pass

    def release(self, cycle: int) -> None:
        """Send on the writes whose delay over ``/in`` is over; call it before :meth:`carry_out`."""
        for layer, write in self._injections.declared.release(cycle):
            command = Command(NO_WRITER, layer.id, self._writer.incarnation, FAR_NS, (write,))
            self._accept(command, layer)

    @property
    def waiting(self) -> bool:
        """Whether items wait to be carried out."""
        return bool(self._items)

    def carry_out(self, write: Callable[[Sequence[Write]], list[str]]) -> None:
        """Write all waiting items in one batch and publish the outcome of each.

        The order of acceptance holds: of two values for a bit the later one is written. Exceptions
        from ``write`` pass through after the outcomes were published.
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
            outcomes = one_each(write(writes), writes)
        except WriteLostError as lost:
            error = str(lost)
            outcomes = one_each(lost.outcomes, writes)
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
                for writer in range(queues.writers):  # round robin
                    taken |= self._take_one(writer)
            self._expire(self._take(lambda item: self._now_ns() > item.command.deadline_ns))
            self._injections.look()
            self._output.flush()
            if not self._stopped:
                queues.wait(seen, self._patience_ns())

    def stop(self) -> None:
        """Make :meth:`run` return. Any thread may call it."""
        self._stopped = True
        self._writer.block.commands.wake()

    def _take(self, which: Callable[[Item], bool]) -> list[Item]:
        """Remove and return the waiting items that ``which`` selects."""
        with self._turn:
            kinds = [(item, which(item)) for item in self._items]
            self._items = [item for item, wanted in kinds if not wanted]
        return [item for item, wanted in kinds if wanted]

    def _expire(self, items: Sequence[Item]) -> None:
        self._end(items, [(EventKind.EXPIRED, "no cycle began before its deadline")] * len(items))

    def _patience_ns(self) -> int:
        """Return the time until the next deadline or regular check, in ns.

        Negative if there is none.
        """
        with self._turn:
            deadlines = [item.command.deadline_ns for item in self._items]
        waits = [max(0, min(deadlines) - self._now_ns()) + 1_000_000] if deadlines else []
        waits += [wait_ns for wait_ns in (self._injections.patience_ns, self._output.patience_ns) if wait_ns >= 0]
        return min(waits, default=-1)

    def _make_room(self) -> None:
        """Wake the command thread so that it judges the held command again."""
        if self._held is not None:
            self._writer.block.commands.wake()

    def _take_one(self, writer: int) -> bool:
        """Judge the oldest command of a writer; return whether there was one and room for it."""
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
        """Report a writer that sends malformed commands, at most once per ``TELL_NS``."""
        now_ns = time.monotonic_ns()
        if now_ns - self._garbage_ns.get(writer, -TELL_NS) >= TELL_NS:
            self._garbage_ns[writer] = now_ns
            log.warning("writer %d sent an invalid command: %s", writer, error)
            self._writer.event(Record(EventKind.REJECTED, f"invalid command: {error}", writer))

    def _judge(self, command: Command) -> bool:
        """Accept or reject a command; return False if it must wait for room."""
        layer = self._injections.toward_device(command)
        write = command.kind is CommandKind.WRITE or layer is not None
        reason = self._refusal(command)
        if not reason and command.kind is CommandKind.NOTE:
            self._writer.event(Record(EventKind.NOTED, command.name, command.writer, command.id, 0, 1))
            return True
        if not reason and layer is not None:
            reason = uncovered(layer, command.writes)
        if not reason:
            reason = self._unwritable(command) if write else self._injections.take(command)
        if not reason and write:
            reason = self._injections.declared.overload
        if reason:
            count = max(1, len(command.writes))
            record = Record(EventKind.REJECTED, reason, command.writer, command.id, 0, count)
            if write:
                offset, mask, data = command.writes[0]
                record = record._replace(offset=offset, mask=mask, size=len(data))
            self._writer.event(record)
        if reason or not write:
            return True
        if not self._has_room(command):
            self._held = command
            return False
        self._accept(command, layer)
        return True

    def _accept(self, command: Command, layer: Layer | None) -> None:
        """Apply the injections below ``layer`` to a command, and queue the rest for the cycle."""
        left, taken = _divert(self._output, command, layer)
        left = [pair for pair in left if not self._made_unfit(pair[0])]
        self._end(taken, [(EventKind.TAKEN, "")] * len(taken))  # every DIVERTED event was published before
        items = [item for item, _ in left]
        with self._verdict:
            for item, source in left:  # outside the other lock, which the loop takes
                for part in pieces(EventKind.ACCEPTED, command, item.place, item.parts(), source):
                    self._writer.event(part)
            with self._turn:
                closed = self._closed
                if not closed:
                    self._items += items
        if closed:
            self._end(items, [(EventKind.EXPIRED, closed)] * len(items))
        elif items:
            self._accepted()

    def _made_unfit(self, item: Item) -> bool:
        """Return whether injections made the item's value non-finite; if so, refuse it."""
        reason = "" if item.data is None else self._finite.refusal(item.parts())
        if reason:
            self._end([item], [(EventKind.REFUSED, f"the injection {item.changed_by!r} changes it: {reason}")])
        return bool(reason)

    def _has_room(self, command: Command) -> bool:
        with self._turn:
            items = list(self._items)
        if not items:
            return True
        size = sum(len(item.write.data) for item in items) + sum(len(write.data) for write in command.writes)
        return len(items) + len(command.writes) <= MAX_WAITING and size <= self._most_bytes

    def _refusal(self, command: Command) -> str:
        """Return why a command is not accepted; empty if it is."""
        if command.incarnation != self._writer.incarnation:
            return "it was for an earlier process of the source, which has ended: try again"
        late_ns = self._now_ns() - command.deadline_ns
        if late_ns > 0:
            return f"it came {late_ns / 1e6:.0f} ms after its deadline"
        return ""

    def _unwritable(self, command: Command) -> str:
        """Return why these bytes cannot be written to the device; empty if they can."""
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
        return self._finite.refusal(command.writes)

    def _end(self, items: Sequence[Item], ends: Sequence[End]) -> None:
        """Publish the ends of accepted items, one event for neighbours that ended alike."""
        for record in records(items, ends):
            self._writer.event(record)


def _divert(
    output: Output, command: Command, above: Layer | None
) -> tuple[list[tuple[Item, Layer | None]], list[Item]]:
    """Pass a command's items through the layers below ``above``, and publish what these change.

    Returns:
        The items with bits left for the device, each with the layer that sent or changed it last;
        and the items of which nothing is left.

    """
    left: list[tuple[Item, Layer | None]] = []
    taken: list[Item] = []
    for place, write in enumerate(command.writes):
        if not output.injections.layers:
            left.append((Item(command, place), None))
            continue
        with output.turn:
            met, bits, data, by = output.injections.divert(write, above)
        for layer, parts in met:
            for record in pieces(EventKind.DIVERTED, command, place, parts, layer):
                output.writer.event(record)
        if not met:
            left.append((Item(command, place), above))
        elif any(bits):
            changed_by = (by.name or str(by.id)) if by and data != write.data else ""
            left.append((Item(command, place, bits, data, changed_by), by or above))
        else:
            taken.append(Item(command, place))
    return left, taken
