"""Commands to a source, which each writer sends through its own queue.

A block has one queue for each writer, so that writers never compete, and one doorbell for all
queues. The source decides whether and in which order to execute commands, and reports the outcomes
as events. Readers of the events collect the outcomes of a command with :class:`CommandOutcomes`, and
its writes with :class:`CommandAssembler`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Final, NamedTuple, TypedDict

import msgspec

from shmio.layout.model import Layout, Register
from shmio.layout.topic import find_each
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write, bits_of, merge, paths_of
from shmio.layout.values.write import apply as write_to
from shmio.model.values import PID_SHIFT
from shmio.segment import _atomics
from shmio.segment.events import DONE, ENDS, MAX_BY_BYTES, Event, EventKind, sender_text

WRITERS: Final = 8
"""Number of command queues of a block; ``processes.py`` assigns each queue to a writer."""
_MIN_CAPACITY: Final = 1 << 15
MAX_WRITES: Final = 4096
"""Maximum number of items in a command."""

_SECTION_HEADER_SIZE: Final = 64
_SECTION: Final = struct.Struct("<IIII")
_BELL_AT: Final = 16
MAX_NAME_BYTES: Final = 256

_COMMAND: Final = struct.Struct("<QIIqBBHiQ")
_WRITE: Final = struct.Struct("<IIB7x")
_BY: Final = struct.Struct("<I4x")
_KEEP: Final = 2  # flag in the byte of the direction


def first_number(pid: int) -> int:
    """Return the number of the first command of a writer in a process.

    The number contains the pid, so that the events of a command show which process sent it. The rest
    is random, to differ from the numbers of the queue's previous owner, whose outcomes may still
    follow.
    """
    import secrets  # noqa: PLC0415  programs that only read need no random numbers, and it loads OpenSSL

    return pid << PID_SHIFT | secrets.randbits(PID_SHIFT - 1) | 1


class CommandKind(IntEnum):
    """Kind of a command, which determines what the items of the command mean."""

    WRITE = 1
    """Write the items to the device; injections over ``/in`` take the items that they cover."""
    INJECT = 2
    """Create an injection over the bits that are set in the items' data.

    The injection gets the command's number.
    """
    SHADOW = 3
    """Give values to an injection.

    If the injection covers ``/out``, consumers see the values. If it covers ``/in``, the device
    gets them.
    """
    LIFT = 4
    """Remove an injection. The command has no items."""
    DECLARE = 5
    """Create a declared injection, which the source runs.

    The only item is the declaration in JSON.
    """
    NOTE = 6
    """Add a note to the events. The command's ``name`` is the note; there are no items."""


EMPTY: Final = frozenset({CommandKind.LIFT, CommandKind.NOTE})
"""Kinds of commands that have no items."""


class Direction(IntEnum):
    """Direction of the data that an injection covers."""

    OUT = 0
    IN = 1


class InjectionOptions(TypedDict, total=False):
    """Options of an injection; see :class:`Command`."""

    direction: Direction
    priority: int
    keep: bool
    name: str


class Command(msgspec.Struct, frozen=True):
    """A command from a writer to a source.

    Attributes:
        writer: Number of the writer's queue.
        id: Number that the writer gave the command.
        incarnation: Incarnation of the source's process for which the command is meant. Any other
            incarnation rejects the command.
        deadline_ns: Time after which the source must not start the command, CLOCK_MONOTONIC.
        writes: The items.
        kind: Kind of command.
        injection: Number of the injection to lift, or to give values to; 0: none.
        direction: With INJECT: the direction.
        priority: With INJECT: the priority; the injection with the highest priority is outermost.
        keep: With INJECT: whether the injection stays when the program that created it ends.
        name: With INJECT: the name of the injection. With NOTE: the note. At most MAX_NAME_BYTES in
            UTF-8.
        by: Who sends the command, such as ``web: anonymous (127.0.0.1)``; empty: not known.
    """

    writer: int
    id: int
    incarnation: int
    deadline_ns: int
    writes: tuple[Write, ...]
    kind: CommandKind = CommandKind.WRITE
    injection: int = 0
    direction: Direction = Direction.OUT
    priority: int = 0
    keep: bool = False
    name: str = ""
    by: str = ""

    def pack(self) -> bytes:
        """Encode the command as a record of a queue."""
        name = self.name.encode()
        flags = self.direction | (_KEEP if self.keep else 0)
        parts = [
            _COMMAND.pack(
                self.id, self.incarnation, len(self.writes), self.deadline_ns, self.kind, flags, len(name),
                self.priority, self.injection,
            ),
            name,
            bytes(-len(name) % 8),
        ]  # fmt: skip
        for write in self.writes:
            parts += (_WRITE.pack(write.offset, len(write.data), write.mask), write.data, bytes(-len(write.data) % 8))
        if by := sender_text(self.by).encode():
            parts += (_BY.pack(len(by)), by, bytes(-len(by) % 8))
        return b"".join(parts)

    @classmethod
    def unpack(cls, writer: int, record: bytes) -> Command:
        """Decode a record of a queue; raise ValueError if it is malformed."""
        try:
            head = _COMMAND.unpack_from(record)
            number, incarnation, count, deadline_ns, kind, flags, name_size, priority, injection = head
            if (count > 0) == (CommandKind(kind) in EMPTY) or count > MAX_WRITES:
                raise ValueError(f"a command of kind {kind} cannot have {count} items")
            name = record[_COMMAND.size : _COMMAND.size + name_size]
            if len(name) != name_size or name_size > MAX_NAME_BYTES or flags > Direction.IN | _KEEP:
                raise ValueError(f"the command has invalid flags ({flags}) or an invalid name size ({name_size} bytes)")
            at, writes = _COMMAND.size + name_size + -name_size % 8, []
            for _ in range(count):
                offset, size, mask = _WRITE.unpack_from(record, at)
                at += _WRITE.size
                if size == 0 or size > len(record) - at or (mask and (size != 1 or mask & mask - 1)):
                    raise ValueError(f"an item has an invalid size ({size} bytes) or mask ({mask})")
                writes.append(Write(offset, mask, record[at : at + size]))
                at += size + -size % 8
            by_size = _BY.unpack_from(record, at)[0] if at + _BY.size <= len(record) else 0
            by = record[at + _BY.size :][: min(by_size, MAX_BY_BYTES)]
        except struct.error as error:
            raise ValueError(str(error)) from None
        return cls(
            writer, number, incarnation, deadline_ns, tuple(writes), CommandKind(kind), injection,
            Direction(flags & Direction.IN), priority, bool(flags & _KEEP), name.decode("utf-8", "replace"),
            sender_text(by.decode("utf-8", "replace")),
        )  # fmt: skip


def capacity_for(layout_size: int) -> int:
    """Return the capacity of a queue in bytes: a power of two, at least 4 times the layout's size in bytes."""
    wanted = max(_MIN_CAPACITY, 4 * layout_size)
    return 1 << (wanted - 1).bit_length()


def section_size(layout_size: int) -> int:
    """Return the size in bytes of the commands section of a block whose layout has ``layout_size`` bytes."""
    return _SECTION_HEADER_SIZE + WRITERS * (_atomics.QUEUE_HEADER_SIZE + capacity_for(layout_size))


def section_header(layout_size: int) -> bytes:
    """Return the first bytes of a new commands section; all others are zero."""
    capacity = capacity_for(layout_size)
    return _SECTION.pack(WRITERS, _atomics.QUEUE_HEADER_SIZE + capacity, capacity, 0)


class CommandQueues:
    """The commands section of a block, with one queue for each writer."""

    def __init__(self, memory: memoryview, offset: int, size: int) -> None:
        """Open the section; raise ValueError if its sizes and offsets are inconsistent."""
        self._memory = memory
        self._offset = offset
        if size < _SECTION_HEADER_SIZE:
            raise ValueError("the commands section is shorter than its header")
        geometry: tuple[int, int, int, int] = _SECTION.unpack_from(memory, offset)
        self.writers, self._stride, self.capacity, _ = geometry
        sound = (
            0 < self.writers <= 1024
            and self.capacity >= 64
            and self.capacity & (self.capacity - 1) == 0
            and self._stride % 8 == 0
            and self._stride >= _atomics.QUEUE_HEADER_SIZE + self.capacity
            and _SECTION_HEADER_SIZE + self.writers * self._stride <= size
        )
        if not sound:
            raise ValueError("the queues do not fit in the commands section")

    def push(self, writer: int, record: bytes) -> bool:
        """Append a record to a writer's queue, and ring the doorbell; return False if the queue has no room."""
        taken = _atomics.queue_push(self._memory, self._queue(writer), self.capacity, record)
        self.wake()  # even if the queue is full: a writer may have died before it rang
        return taken

    def pop(self, writer: int) -> bytes | None:
        """Remove and return the oldest record of a writer's queue; None if the queue is empty.

        Only the source may call this.

        Raises:
            ValueError: The queue was corrupt, and has been emptied.
        """
        return _atomics.queue_pop(self._memory, self._queue(writer), self.capacity)

    def bell(self) -> int:
        """Return the doorbell's value. Read it before you check the queues."""
        return _atomics.bell(self._memory, self._offset + _BELL_AT)

    def wait(self, seen: int, timeout_ns: int = -1) -> None:
        """Wait until the doorbell's value differs from ``seen``, for at most ``timeout_ns`` (negative: forever)."""
        _atomics.bell_wait(self._memory, self._offset + _BELL_AT, seen, timeout_ns)

    def wake(self) -> None:
        """Ring the source's doorbell."""
        _atomics.bell_ring(self._memory, self._offset + _BELL_AT)

    def _queue(self, writer: int) -> int:
        if not 0 <= writer < self.writers:
            raise ValueError(f"there is no writer {writer}: the section has {self.writers} queues")
        return self._offset + _SECTION_HEADER_SIZE + writer * self._stride


NO_COMMAND: Final = (0, 0, 0)
"""The ``Event.command_key`` of an event that is not about a command."""


class CommandWrites(NamedTuple):
    """The writes of one command to one injection or to the device, in the order of their events."""

    injection: int
    event: Event
    """The last event about these writes, which has their time and writer."""
    writes: tuple[Write, ...]


class CommandAssembler:
    """Collects the writes of each command from events of one kind (default: DIVERTED).

    Pass all events of a block in order to :meth:`follow`. The writes of a command are complete when
    an event of another kind, or about another command, follows. Writes without a command (number 0)
    are complete with their last item.
    """

    def __init__(self, kind: EventKind = EventKind.DIVERTED) -> None:
        self._kind = kind
        self._command = NO_COMMAND
        self._parts: dict[int, list[Event]] = {}

    def follow(self, event: Event) -> list[CommandWrites]:
        """Process the next event, and return the commands that it completes."""
        command = event.command_key
        if event.kind != self._kind:
            return self._whole() if command == self._command or event.kind == EventKind.STARTED else []
        whole = [] if command == self._command else self._whole()
        self._command = command
        self._parts.setdefault(event.injection, []).append(event)
        if not event.command and event.item + 1 >= event.items:
            whole += self._whole()
        return whole

    def _whole(self) -> list[CommandWrites]:
        whole = [
            CommandWrites(injection, parts[-1], tuple(Write(part.offset, part.mask, part.data) for part in parts))
            for injection, parts in self._parts.items()
        ]
        self._command, self._parts = NO_COMMAND, {}
        return whole


End = tuple[EventKind, str]
"""Outcome of an item (one of ``ENDS``, or ACCEPTED if the caller waits only for that), and the reason."""


def worst(ends: Sequence[End]) -> End:
    """Return the first outcome that is not a success; if all are successes, the first outcome."""
    return next((end for end in ends if end[0] not in DONE), ends[0])


class CommandOutcomes:
    """Collects the outcomes of one command's items."""

    def __init__(self, items: int, *, until_accepted: bool = False) -> None:
        """Start without outcomes.

        Args:
            items: Number of the command's items.
            until_accepted: Whether ACCEPTED already counts as the outcome of an item.
        """
        self._items = items
        self._until_accepted = until_accepted
        self._ends: dict[int, End] = {}

    def follow(self, event: Event) -> bool:
        """Process the command's next event; return whether all outcomes are known."""
        if event.kind == EventKind.REJECTED:
            self._ends = dict.fromkeys(range(self._items), (EventKind.REJECTED, event.text))
        elif event.kind in ENDS or (self._until_accepted and event.kind == EventKind.ACCEPTED):
            kind = EventKind(event.kind)
            end = kind, event.text if kind is not EventKind.ACCEPTED else ""
            for item in range(event.item, min(event.item + max(1, event.items), self._items)):
                self._ends[item] = end
        return len(self._ends) == self._items

    def of(self, items: Iterable[int], missing: str) -> End:
        """Return the outcome of a value that consists of these items.

        ``missing`` is the reason to give for an item whose outcome is not known.
        """
        return worst([self._ends.get(item, (EventKind.UNKNOWN, missing)) for item in items])


def apply(image: bytearray, writes: Iterable[Write]) -> None:
    """Apply writes to an image; ignore writes outside the image, which only a faulty process sends."""
    for write in writes:
        if write.data and write.offset + len(write.data) <= len(image):
            write_to(write, image)


def decode_writes(
    layout: Layout, image: bytes, writes: Iterable[Write], names: Sequence[Register] = ()
) -> dict[str, Value]:
    """Decode the values that writes set in an image, by path.

    If a write covers only a part of a register, the paths are those of its elements or bits.
    ``names`` are registers of tag tables over the block. If writes set bits of such a register, the
    result has that register's path and value, and no other path for these bits.
    """
    found: dict[str, Value] = {}
    if names:
        mask = bytearray(layout.size)
        for write in writes:
            for at in range(write.offset, write.offset + len(write.data)):
                mask[at] |= write.mask or 0xFF
        named = bytearray(layout.size)
        for register in names:
            bits = bits_of(register)
            if any(mask[at] & own for at, own in enumerate(bits, register.offset)):
                found[register.path] = codec(register, layout.byte_order).decode(image)
                for at, own in enumerate(bits, register.offset):
                    named[at] |= own
        rest = bytes(there & ~taken for there, taken in zip(mask, named, strict=True))
        writes = merge(image, rest, [(0, layout.size)])
    parts = (part for path in paths_of(layout, writes) for part in find_each(layout, path))
    return found | {part.path: codec(part, layout.byte_order).decode(image) for part in parts}
