"""Accepts or rejects the commands to a source, and carries out accepted ones in the next cycle.

The items of a command are writes. A separate thread accepts and rejects commands, so that a slow device
does not delay this decision. In each cycle, the loop's thread writes all accepted items to the device
in one batch, and derives the outcome of each item from the outcomes of the batch's writes. Then it
reads the device, so that the next frame shows the new values.
"""

from __future__ import annotations

import logging
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import accumulate, groupby
from typing import Final, NamedTuple, Protocol, TypeVar

import numpy as np

from shmio.connectors.base import TAKEN, Lost, WriteLostError
from shmio.connectors.injection_layers import DeclaredLayer, Layer, uncovered
from shmio.connectors.injections import Blocks, InjectionProcessor, OwnerOf
from shmio.connectors.output import Output, pieces
from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write, cover, merge, path_at, paths_outside
from shmio.model.values import NO_WRITER
from shmio.segment import Command, CommandKind, EventKind, Record
from shmio.wording import MAX_PATHS, not_writable

MAX_WAITING: Final = 256
"""The largest number of items that may wait for a cycle; further commands stay in their queues.

If no item waits, a single command with more items is accepted.
"""
MAX_WAITING_BLOCKS: Final = 4
"""The largest number of bytes that may wait for a cycle, as a multiple of the block's size."""
FAR_NS: Final = 1 << 62
"""Deadline of a write that an injection has delayed. The deadline is so late that the write never expires."""
TELL_NS: Final = 1_000_000_000
"""Minimum time in ns between two reports of malformed commands from the same writer."""

_SUPERSEDED: Final = "superseded by a later write of the same cycle"
_EXPONENTS: Final = {"REAL": b"\x7f\x80\0\0", "LREAL": b"\x7f\xf0\0\0\0\0\0\0"}
"""For each type of number, a mask of its exponent bits, with the most significant byte first.

A number is NaN or infinite if all its exponent bits are set.
"""

End = tuple[EventKind, str]
"""Kind and text of the last event about an item."""
_Outcome = TypeVar("_Outcome", str, str | Lost)

log = logging.getLogger("shmio.source")


# -- NaN and infinities ------------------------------------------------------------------------------------------------


class FiniteCheck:
    """Refuses writes of NaN and infinities to REAL and LREAL registers, except to exempt registers.

    Programs in devices seldom handle such values.
    """

    def __init__(self, layout: Layout, allowed: Iterable[str]) -> None:
        """Create the check. ``allowed`` are patterns of the exempt registers."""
        self._layout = layout
        allowed_bits = np.frombuffer(cover(layout, allowed), np.uint8)
        self._exponents = np.zeros(layout.size, np.uint8)
        self._starts = np.zeros(layout.size, np.int32)  # for each exponent byte, the offset of its number
        for kind, exponent in _EXPONENTS.items():
            starts = _starts_of(layout, kind)
            starts = starts[allowed_bits[starts] != 0xFF]
            for at, bits in enumerate(exponent[::-1] if layout.byte_order == "little" else exponent):
                if bits:
                    self._exponents[starts + at] = bits
                    self._starts[starts + at] = starts
        self._guarded = (self._exponents != 0).tobytes()
        over = (one for one in layout.registers[len(layout.own) :] if one.type in _EXPONENTS and not one.dims)
        self._names = {one.offset: one.path for one in over}  # by offset: numbers that are views of bytes

    def refusal(self, writes: Iterable[Write]) -> str:
        """Return why these writes are refused, with the name of a register; empty if they are allowed.

        A write of only some bytes of a number is refused if it sets all exponent bits in those
        bytes. Otherwise, several such writes together could make the number NaN or infinite.
        """
        for offset, mask, data in writes:
            stop = offset + len(data)
            if self._guarded.find(1, offset, stop) < 0:
                continue
            wanted = self._exponents[offset:stop] & (mask or 0xFF)
            zeros = np.flatnonzero(wanted & ~np.frombuffer(data, np.uint8))
            starts = self._starts[offset:stop]
            wrong = np.setdiff1d(starts[np.flatnonzero(wanted)], starts[zeros])
            if len(wrong):
                path = self._names.get(int(wrong[0])) or path_at(self._layout, int(wrong[0]))
                return (
                    f"{path}: NaN and infinities are written only if the source's `allow_nonfinite` names the register"
                )
        return ""


def _starts_of(layout: Layout, kind: str) -> np.ndarray[tuple[int], np.dtype[np.int32]]:
    """Return the offsets of all values of a type, including the elements of arrays."""
    found = [register for register in layout.registers if register.type == kind]
    arrays = (one.offset + np.arange(one.count) * one.element.stride for one in found if one.dims)
    scalars = np.array([one.offset for one in found if not one.dims], np.int32)
    return np.concatenate([scalars, *arrays]).astype(np.int32)


# -- batches -----------------------------------------------------------------------------------------------------------


class Item(NamedTuple):
    """An accepted write of a command; ``place`` is its index in the command."""

    command: Command
    place: int
    bits: bytes | None = None
    """Mask of the bits to send to the device; None: all bits of the write.

    Injections have taken or dropped the other bits.
    """
    data: bytes | None = None
    """The values after injections have changed them; None if they are unchanged."""
    changed_by: str = ""
    """Name or number of the last injection that changed the values; empty if none did."""

    @property
    def write(self) -> Write:
        """The write, after injections have changed its values."""
        write = self.command.writes[self.place]
        return write if self.data is None else write._replace(data=self.data)

    def parts(self) -> list[Write]:
        """Return the parts of the write to send to the device."""
        offset, _, data = self.write
        if self.bits is None:
            return [self.write]
        return [part._replace(offset=offset + part.offset) for part in merge(data, self.bits, [(0, len(data))])]


def coalesce(items: Sequence[Item], size: int) -> tuple[list[Write], set[int]]:
    """Merge items into writes. If several items write the same bit, the last item's value counts.

    Adjacent bytes become one write only if they belong to the same command. So a write that the
    device refuses affects only one command. The writes have the order of the items, because two
    registers of a tag table may lie over the same bytes of the device.

    Args:
        items: Accepted items, oldest first.
        size: Size of the block in bytes.

    Returns:
        The writes, and the indices of the superseded items, whose bits are all overwritten by later
        items.

    """
    taken = bytearray(size)
    kept: list[tuple[Item, bytes]] = []  # last item first, each with a mask of the bits that no later item writes
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
    runs: list[tuple[int, int, list[bytes]]] = []  # offset, mask and pieces of the data of each write
    for _, group in groupby(reversed(kept), key=lambda pair: id(pair[0].command)):
        end = -1  # offset after the last write of bytes; nothing is joined to a bit
        for item, own in group:
            offset, _, data = item.write
            for at, mask, part in merge(data, own, [(0, len(own))]):
                if mask or offset + at != end:
                    runs.append((offset + at, mask, [part]))
                else:
                    runs[-1][2].append(part)
                end = -1 if mask else offset + at + len(part)
    writes = [Write(offset, mask, b"".join(pieces)) for offset, mask, pieces in runs]
    return writes, superseded


def ends(
    items: Sequence[Item], writes: Sequence[Write], superseded: set[int], outcomes: Sequence[str | Lost], error: str
) -> list[End]:
    """Return the kind and text of each item's last event.

    Args:
        items: The items of the batch.
        writes: The writes from :func:`coalesce`.
        superseded: The indices of superseded items from :func:`coalesce`.
        outcomes: The outcome of each write.
        error: Why the outcomes of some writes are unknown; empty if all are known.

    """
    lost = any(isinstance(outcome, Lost) or outcome == TAKEN for outcome in outcomes)
    known = _WriteOutcomes((write, outcome) for write, outcome in zip(writes, outcomes, strict=True) if outcome or lost)
    found = [_end_of(known.about(item.write), error) for item in items]
    for place, item in enumerate(items):
        if found[place][0] is not EventKind.WRITTEN:
            continue
        if place in superseded:  # the later items were written
            found[place] = EventKind.WRITTEN, _SUPERSEDED
        elif item.changed_by:
            found[place] = EventKind.WRITTEN, f"after the injection {item.changed_by!r} changed the value"
    return found


class _WriteOutcomes:
    """Finds the outcomes of writes by byte range, with a binary search, because there may be many.

    If no write was lost or taken, the caller may leave out the confirmed writes.
    """

    def __init__(self, known: Iterable[tuple[Write, str | Lost]]) -> None:
        self._known = sorted(known, key=lambda pair: pair[0].offset)
        self._starts = [write.offset for write, _ in self._known]
        self._stops = list(accumulate((write.offset + len(write.data) for write, _ in self._known), max))

    def about(self, write: Write) -> list[str | Lost]:
        """Return the outcomes of all writes that contain bits of the given write."""
        first = bisect_right(self._stops, write.offset)
        last = bisect_left(self._starts, write.offset + len(write.data))
        return [outcome for other, outcome in self._known[first:last] if _share_bits(write, other)]


def _end_of(outcomes: Sequence[str | Lost], error: str) -> End:
    """Return the kind and text of an item's last event, from the outcomes of its writes."""
    if outcomes and all(outcome == TAKEN for outcome in outcomes):
        return EventKind.TAKEN, ""
    refusal = next((outcome for outcome in outcomes if outcome and outcome != TAKEN and isinstance(outcome, str)), "")
    lost = Lost.UNSENT in outcomes
    if Lost.UNKNOWN in outcomes or (lost and "" in outcomes):  # partly written
        return EventKind.UNKNOWN, f"the write was sent, but the device did not confirm it: {error}"
    if refusal:
        return EventKind.REFUSED, refusal
    return (EventKind.EXPIRED, f"the write was not sent: {error}") if lost else (EventKind.WRITTEN, "")


def _share_bits(one: Write, other: Write) -> bool:
    if one.mask and other.mask and one.mask != other.mask:
        return False
    return other.offset < one.offset + len(one.data) and one.offset < other.offset + len(other.data)


def one_each(outcomes: Sequence[_Outcome], writes: Sequence[Write]) -> Sequence[_Outcome]:
    """Return ``outcomes``, after a check that there is one for each write.

    Raises:
        ConnectorError: The connector returned fewer or more outcomes.

    """
    if len(outcomes) != len(writes):
        raise ConnectorError(f"the connector returned {len(outcomes)} outcomes for {len(writes)} writes")
    return outcomes


def records(items: Sequence[Item], ends: Sequence[End]) -> Iterator[Record]:
    """Yield the events that end items.

    Consecutive items of a command share one event if the kind and text of their events are equal.
    """
    both = zip(items, ends, strict=True)
    for (_, (kind, text)), group in groupby(both, key=lambda pair: (id(pair[0].command), pair[1])):
        for first, count in _runs([item for item, _ in group]):
            command, (offset, mask, data) = first.command, first.write
            yield Record(
                kind, text, command.writer, command.id, first.place, count, offset, mask, len(data), by=command.by
            )


def _runs(items: Sequence[Item]) -> Iterator[tuple[Item, int]]:
    """Group items that follow each other in a command; yield the first item and the length of each group."""
    first, count = items[0], 1
    for item in items[1:]:
        if item.place == first.place + count:
            count += 1
        else:
            yield first, count
            first, count = item, 1
    yield first, count


class _Batch(NamedTuple):
    """Items of a cycle, their writes, and the indices of superseded items, from :func:`coalesce`."""

    items: Sequence[Item]
    writes: Sequence[Write]
    superseded: set[int]

    def ends(self, outcomes: Sequence[str | Lost], error: str) -> list[End]:
        """Return the last events of the items; see :func:`ends`."""
        return ends(self.items, self.writes, self.superseded, outcomes, error)


# -- commands ----------------------------------------------------------------------------------------------------------


class Injections(Protocol):
    """Carries out the commands about injections of a source."""

    @property
    def patience_ns(self) -> int:
        """Time in ns until :meth:`follow_changes` must be called; negative if no call is needed."""

    @property
    def overload(self) -> str:
        """Why the source can accept no write at present; empty if it can accept writes."""

    def toward_device(self, command: Command) -> Layer | None:
        """Return the injection over ``/in`` by which a command sends values to the device; None if there is none."""

    def take(self, command: Command) -> str:
        """Carry out a command about an injection. Return "", or why the command is rejected."""

    def release(self, cycle: int) -> list[tuple[DeclaredLayer, Write]]:
        """Return the delayed writes that are due in ``cycle``, each with the injection that delayed it."""

    def forget(self, reason: str) -> None:
        """Discard all delayed writes, because the connection to the device was lost."""

    def follow_changes(self) -> None:
        """Follow changes of the configuration, and check the programs that have created injections."""


MakeInjections = Callable[[bytes, str], Injections]
"""Function that creates an object for injections.

Its arguments are the bits that commands may write, as an image of the block, and why injections over
``/in`` are refused (empty if they are allowed).
"""


def _unarmed(source: str) -> str:
    return f"an injection toward a device needs `armed = true` in the configuration of source {source!r}"


class CommandProcessor:
    """Processes the commands of one block.

    The command thread calls :meth:`run`. Any thread may call :meth:`stop`. Only the loop's thread
    calls the other methods.
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
        injections: MakeInjections | None = None,
    ) -> None:
        """Create the processor.

        Args:
            output: Publishes the source's images and events.
            writable: Patterns of writable registers; None if the connector cannot write.
            now_ns: The loop's clock.
            allow_nonfinite: Patterns of the registers to which NaN and infinities may be written.
            armed: True if injections may change what is written to the device.
            owner_of: Returns the process that uses a command queue.
            blocks: Returns the blocks of all sources, for conditions. Default: only this source.
            accepted: Called when newly accepted items wait for a cycle.
            injections: Creates the object that carries out commands about injections. None: this process applies
                injections to the source's images.

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
        refuse_in = self._cannot or ("" if armed else _unarmed(self._writer.block.source))
        blocks = blocks or (lambda: {output.writer.block.source: output.writer.block})
        if injections is None:
            self._injections: Injections = InjectionProcessor(output, self._writable, refuse_in, owner_of, blocks)
        else:
            self._injections = injections(self._writable, refuse_in)
        self._lock = threading.Lock()
        self._verdict = threading.Lock()  # locked while acceptances are published, until the items are in _items
        self._closed = "the source is not connected yet"
        self._items: list[Item] = []
        self._unconfirmed: _Batch | None = None
        self._held: Command | None = None  # already taken from its queue, but waits until there is room
        self._garbage_ns: dict[int, int] = {}
        self._stopped = False

    def open(self) -> None:
        """Start accepting commands. Call this once the device is connected and its data match the layout."""
        with self._lock:
            self._closed = ""

    def close(self, reason: str) -> None:
        """Stop accepting commands, because the connection was lost.

        Waiting items expire with the text ``reason``; the outcomes of unconfirmed items are unknown.
        """
        if (lost := self._unconfirmed) is not None:
            self._unconfirmed = None
            self._end(lost.items, lost.ends([Lost.UNKNOWN] * len(lost.writes), reason))
        with self._lock:
            self._closed = f"the source is not connected: {reason}"
            items, self._items = self._items, []
        self._end(items, [(EventKind.EXPIRED, reason)] * len(items))
        self._injections.forget(reason)
        self._make_room()

    def settle(self) -> bool:
        """Wait until all items whose acceptance was published also wait for :meth:`carry_out`.

        Return whether any items wait.
        """
        with self._verdict:
            return bool(self._items)

    def release(self, cycle: int) -> None:
        """Accept delayed writes: those whose delay by an injection ends in this cycle.

        Call this before :meth:`carry_out`.
        """
        for layer, write in self._injections.release(cycle):
            command = Command(NO_WRITER, layer.id, self._writer.incarnation, FAR_NS, (write,))
            self._accept(command, layer)

    @property
    def injections(self) -> InjectionProcessor:
        """The processor of the injections of a source that applies them itself."""
        assert isinstance(self._injections, InjectionProcessor)  # noqa: S101  a mirror has no snapshots
        return self._injections

    @property
    def waiting(self) -> bool:
        """True if items wait for :meth:`carry_out`."""
        return bool(self._items)

    @property
    def unconfirmed(self) -> bool:
        """True while the outcomes of the last batch are unknown, so that you must call :meth:`confirm`."""
        return self._unconfirmed is not None

    def carry_out(self, write: Callable[[Sequence[Write]], Sequence[str] | None]) -> None:
        """Write all waiting items in one batch, and publish the outcome of each.

        If two items write the same bit, the value of the item accepted later is written. If
        ``write`` raises an exception, this method publishes the outcomes, and then raises the
        exception again. If ``write`` returns None, call :meth:`confirm` until the batch is no
        longer ``unconfirmed``, and only then call this method again.
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

    def confirm(self, ask: Callable[[], Sequence[str] | None]) -> None:
        """Publish the outcomes of the unconfirmed batch, unless ``ask`` returns None.

        If ``ask`` raises an exception, this method publishes the outcomes, and then raises the
        exception again.
        """
        if self._unconfirmed is not None:
            self._ask(self._unconfirmed, ask)

    def _write(self, items: Sequence[Item], write: Callable[[Sequence[Write]], Sequence[str] | None]) -> None:
        writes, superseded = coalesce(items, self._writer.block.layout.size)
        self._ask(_Batch(items, writes, superseded), lambda: write(writes))

    def _ask(self, batch: _Batch, ask: Callable[[], Sequence[str] | None]) -> None:
        """Publish the outcomes that ``ask`` returns or raises; if it returns None, keep the batch as unconfirmed."""
        self._unconfirmed = None
        outcomes: Sequence[str | Lost] = [Lost.UNKNOWN] * len(batch.writes)
        error = ""
        try:
            found = ask()
            if found is None:
                self._unconfirmed = batch
            else:
                outcomes = one_each(found, batch.writes)
        except WriteLostError as lost:
            error = str(lost)
            outcomes = one_each(lost.outcomes, batch.writes)
            raise
        except BaseException as unforeseen:
            error = str(unforeseen)
            raise
        finally:
            if self._unconfirmed is None:
                self._end(batch.items, batch.ends(outcomes, error))

    def run(self) -> None:
        """Accept and reject commands until :meth:`stop` is called."""
        queues = self._writer.block.commands
        while not self._stopped:
            seen = queues.bell()
            taken = True
            while taken and not self._stopped:
                taken = False
                for writer in range(queues.writers):  # round robin
                    if self._take_one(writer):
                        taken = True
                        if self._injections.patience_ns == 0:  # each command may take long
                            self._injections.follow_changes()
            self._expire(self._take(lambda item: self._now_ns() > item.command.deadline_ns))
            self._injections.follow_changes()
            self._output.flush()
            if not self._stopped:
                queues.wait(seen, self._patience_ns())

    def stop(self) -> None:
        """Make :meth:`run` return. Any thread may call this."""
        self._stopped = True
        self._writer.block.commands.wake()

    def _take(self, which: Callable[[Item], bool]) -> list[Item]:
        """Remove and return the waiting items that ``which`` selects."""
        with self._lock:
            kinds = [(item, which(item)) for item in self._items]
            self._items = [item for item, wanted in kinds if not wanted]
        return [item for item, wanted in kinds if wanted]

    def _expire(self, items: Sequence[Item]) -> None:
        busy = self._unconfirmed is not None
        why = "the device had not confirmed earlier writes" if busy else "no cycle began"
        self._end(items, [(EventKind.EXPIRED, f"{why} before the command's deadline")] * len(items))

    def _patience_ns(self) -> int:
        """Return the time that :meth:`run` may wait for a command, in ns; negative: without limit."""
        with self._lock:
            deadlines = [item.command.deadline_ns for item in self._items]
        waits = [max(0, min(deadlines) - self._now_ns()) + 1_000_000] if deadlines else []
        waits += [wait_ns for wait_ns in (self._injections.patience_ns, self._output.patience_ns) if wait_ns >= 0]
        return min(waits, default=-1)

    def _make_room(self) -> None:
        """Wake the command thread, so that it retries a command that had to wait for room."""
        if self._held is not None:
            self._writer.block.commands.wake()

    def _take_one(self, writer: int) -> bool:
        """Accept or reject the command that waits for room, or else the oldest command of a writer.

        Return False if there is no command, or if it must wait for room.
        """
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
        """Report a malformed command, at most once in ``TELL_NS`` for each writer."""
        now_ns = time.monotonic_ns()
        if now_ns - self._garbage_ns.get(writer, -TELL_NS) >= TELL_NS:
            self._garbage_ns[writer] = now_ns
            log.warning("writer %d sent an invalid command: %s", writer, error)
            self._writer.event(Record(EventKind.REJECTED, f"invalid command: {error}", writer))

    def _judge(self, command: Command) -> bool:
        """Accept or reject a command. Return False if the command must wait for room."""
        layer = self._injections.toward_device(command)
        write = command.kind is CommandKind.WRITE or layer is not None
        reason = self._refusal(command)
        if not reason and command.kind is CommandKind.NOTE:
            self._writer.event(Record(EventKind.NOTED, command.name, command.writer, command.id, 0, 1, by=command.by))
            return True
        if not reason and layer is not None:
            reason = uncovered(layer, command.writes)
        if not reason:
            reason = self._unwritable(command) if write else self._injections.take(command)
        if not reason and write:
            reason = self._injections.overload
        if reason:
            count = max(1, len(command.writes))
            record = Record(EventKind.REJECTED, reason, command.writer, command.id, 0, count, by=command.by)
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
        """Apply the injections below ``layer`` to a command, and queue the remaining items."""
        left, taken = _divert(self._output, command, layer)
        left = [pair for pair in left if not self._made_unfit(pair[0])]
        self._end(taken, [(EventKind.TAKEN, "")] * len(taken))  # _divert has published every DIVERTED event
        items = [item for item, _ in left]
        with self._verdict:
            for item, source in left:  # not under _lock, which the loop's thread needs
                for part in pieces(EventKind.ACCEPTED, command, item.place, item.parts(), source):
                    self._writer.event(part)
            with self._lock:
                closed = self._closed
                if not closed:
                    self._items += items
        if closed:
            self._end(items, [(EventKind.EXPIRED, closed)] * len(items))
        elif items:
            self._accepted()

    def _made_unfit(self, item: Item) -> bool:
        """Refuse the item if injections made its value NaN or infinite; return whether they did."""
        reason = "" if item.data is None else self._finite.refusal(item.parts())
        if reason:
            self._end([item], [(EventKind.REFUSED, f"the injection {item.changed_by!r} changed the value: {reason}")])
        return bool(reason)

    def _has_room(self, command: Command) -> bool:
        with self._lock:
            items = list(self._items)
        if not items:
            return True
        size = sum(len(item.write.data) for item in items) + sum(len(write.data) for write in command.writes)
        return len(items) + len(command.writes) <= MAX_WAITING and size <= self._most_bytes

    def _refusal(self, command: Command) -> str:
        """Return why the command is too late, or for an earlier process; "" if it is neither."""
        if command.incarnation != self._writer.incarnation:
            return "the source was restarted after the command was sent; send it again"
        late_ns = self._now_ns() - command.deadline_ns
        if late_ns > 0:
            return f"the command came {late_ns / 1e6:.0f} ms after its deadline"
        return ""

    def _unwritable(self, command: Command) -> str:
        """Return why the command's bytes cannot be written to the device; empty if they can."""
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
                block = self._writer.block
                paths = paths_outside(block.layout, [write], self._writable, MAX_PATHS + 1)
                return not_writable([f"{block.source}/{path}" for path in paths] or [f"byte {write.offset}"])
        return self._finite.refusal(command.writes)

    def _end(self, items: Sequence[Item], ends: Sequence[End]) -> None:
        """Publish the last events of accepted items, as :func:`records` groups them."""
        for record in records(items, ends):
            self._writer.event(record)


def _divert(
    output: Output, command: Command, above: Layer | None
) -> tuple[list[tuple[Item, Layer | None]], list[Item]]:
    """Apply the layers below ``above`` to a command's items, and publish what the layers changed.

    Returns:
        Two lists. The first contains each item with bits left for the device, and the last layer
        that changed the item (``above`` if none did). The second contains the items with no bits
        left.

    """
    left: list[tuple[Item, Layer | None]] = []
    taken: list[Item] = []
    for place, write in enumerate(command.writes):
        if not output.injections.layers:
            left.append((Item(command, place), None))
            continue
        with output.lock:
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
