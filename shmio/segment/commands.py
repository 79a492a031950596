"""Commands toward a source: from each writer's process to the source's, through a queue of their own.

A block has one queue for each writer, so that no two of them meet, and one bell for all. The source alone decides what
is done, and in which order; what became of a command is in the block's events.
"""

from __future__ import annotations

import os
import secrets
import struct
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, TypedDict, Unpack

from shmio.errors import CommandError
from shmio.layout.values.write import Write
from shmio.segment import _atomics

if TYPE_CHECKING:
    from shmio.segment.block import Block

WRITERS: Final = 8
"""Queues toward a block; processes.py says whose they are."""
MIN_CAPACITY: Final = 1 << 14
MAX_WRITES: Final = 4096
"""Most items in one command."""

SECTION_HEADER_SIZE: Final = 64
_SECTION: Final = struct.Struct("<IIII")
_BELL_AT: Final = 16
MAX_NAME_BYTES: Final = 256

_COMMAND: Final = struct.Struct("<QIIqBBHiQ")
_WRITE: Final = struct.Struct("<IIB7x")
_KEEP: Final = 2  # flag beside the direction


class CommandKind(IntEnum):
    """What a command asks for, and what its items are."""

    WRITE = 1
    """Items are written to the device, or go to the injections on their way."""
    INJECT = 2
    """An injection is laid over the bits that the items' data set; the command's number is its own."""
    SHADOW = 3
    """An injection gives values: to consumers if it lies over ``/out``, to the device if over ``/in``."""
    LIFT = 4
    """An injection is lifted; there are no items."""
    DECLARE = 5
    """An injection is laid that the source runs by itself: its declaration, as JSON, is the one item's data."""
    NOTE = 6
    """The name is put into the events as a note; there are no items. Whatever the device does."""


EMPTY: Final = frozenset({CommandKind.LIFT, CommandKind.NOTE})
"""Kinds without items."""


class Direction(IntEnum):
    """Which way an injection stands in."""

    OUT = 0
    IN = 1


@dataclass(frozen=True, slots=True)
class Command:
    """What a writer wants done. ``deadline_ns``: CLOCK_MONOTONIC after which it must not be begun.

    ``injection``: the one to lift, or whose values these are. With INJECT: ``direction``, ``priority`` (the highest is
    outermost), ``keep`` (it outlives its client), ``name`` (at most MAX_NAME_BYTES in UTF-8). With NOTE:
    ``name`` is the note.
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

    def pack(self) -> bytes:
        """The record in a queue."""
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
        return b"".join(parts)

    @classmethod
    def unpack(cls, writer: int, record: bytes) -> Command:
        """Read a record; ValueError: it is none of ours."""
        try:
            head = _COMMAND.unpack_from(record)
            number, incarnation, count, deadline_ns, kind, flags, name_size, priority, injection = head
            if (count > 0) == (CommandKind(kind) in EMPTY) or count > MAX_WRITES:
                raise ValueError(f"kind {kind} with {count} items")
            name = record[_COMMAND.size : _COMMAND.size + name_size]
            if len(name) != name_size or name_size > MAX_NAME_BYTES or flags > Direction.IN | _KEEP:
                raise ValueError(f"flags {flags}, a name of {name_size} bytes")
            at, writes = _COMMAND.size + name_size + -name_size % 8, []
            for _ in range(count):
                offset, size, mask = _WRITE.unpack_from(record, at)
                at += _WRITE.size
                if size == 0 or size > len(record) - at or (mask and (size != 1 or mask & mask - 1)):
                    raise ValueError(f"item of {size} bytes, mask {mask}")
                writes.append(Write(offset, mask, record[at : at + size]))
                at += size + -size % 8
        except struct.error as error:
            raise ValueError(str(error)) from None
        return cls(
            writer, number, incarnation, deadline_ns, tuple(writes), CommandKind(kind), injection,
            Direction(flags & Direction.IN), priority, bool(flags & _KEEP), name.decode("utf-8", "replace"),
        )  # fmt: skip


def capacity_for(layout_size: int) -> int:
    """Bytes of a queue's data: any array, and the block as a whole if it is a few of them, has room more than once."""
    wanted = max(MIN_CAPACITY, 4 * layout_size)
    return 1 << (wanted - 1).bit_length()


def section_size(layout_size: int) -> int:
    """Bytes of a block's commands section."""
    return SECTION_HEADER_SIZE + WRITERS * (_atomics.QUEUE_HEADER_SIZE + capacity_for(layout_size))


def section_header(layout_size: int) -> bytes:
    """How a commands section begins."""
    capacity = capacity_for(layout_size)
    return _SECTION.pack(WRITERS, _atomics.QUEUE_HEADER_SIZE + capacity, capacity, 0)


class CommandQueues:
    """A block's commands section; geometry is checked once and kept."""

    def __init__(self, memory: memoryview, offset: int, size: int) -> None:
        """ValueError: the section contradicts itself."""
        self._memory = memory
        self._offset = offset
        if size < SECTION_HEADER_SIZE:
            raise ValueError("commands section is shorter than its header")
        geometry: tuple[int, int, int, int] = _SECTION.unpack_from(memory, offset)
        self.writers, self._stride, self.capacity, _ = geometry
        sound = (
            0 < self.writers <= 1024
            and self.capacity >= 64
            and self.capacity & (self.capacity - 1) == 0
            and self._stride % 8 == 0
            and self._stride >= _atomics.QUEUE_HEADER_SIZE + self.capacity
            and SECTION_HEADER_SIZE + self.writers * self._stride <= size
        )
        if not sound:
            raise ValueError("the queues do not fit in the commands section")

    def push(self, writer: int, record: bytes) -> bool:
        """Put a record into a writer's queue and ring the source's bell; False when there is no room."""
        taken = _atomics.queue_push(self._memory, self._queue(writer), self.capacity, record)
        self.wake()  # also of a full one: its last writer may have died before it could ring
        return taken

    def pop(self, writer: int) -> bytes | None:
        """The oldest record of a writer's queue; for the source alone. ValueError: it was broken, and is empty now."""
        return _atomics.queue_pop(self._memory, self._queue(writer), self.capacity)

    def bell(self) -> int:
        """Value of the source's bell; read it before looking into the queues."""
        return _atomics.bell(self._memory, self._offset + _BELL_AT)

    def wait(self, seen: int, timeout_ns: int = -1) -> None:
        """Wait until the bell differs from ``seen``, at most ``timeout_ns`` (negative: for ever)."""
        _atomics.bell_wait(self._memory, self._offset + _BELL_AT, seen, timeout_ns)

    def wake(self) -> None:
        """Ring the source's bell."""
        _atomics.bell_ring(self._memory, self._offset + _BELL_AT)

    def _queue(self, writer: int) -> int:
        if not 0 <= writer < self.writers:
            raise ValueError(f"writer {writer}; there are {self.writers}")
        return self._offset + SECTION_HEADER_SIZE + writer * self._stride


class InjectionOptions(TypedDict, total=False):
    """How an injection is laid; see :class:`Command`."""

    direction: Direction
    priority: int
    keep: bool
    name: str


class CommandSender:
    """A writer's end toward one block; the writer's process holds the role that has this queue."""

    def __init__(self, block: Block, writer: int) -> None:
        self.block = block
        self.writer = writer
        self._turn = threading.Lock()
        self._pid = os.getpid()  # two processes on one queue would overwrite each other's commands
        # Never the number of a predecessor's command, whose outcome may still come.
        self._next = secrets.randbits(62) + 1

    def submit(
        self,
        writes: Sequence[Write],
        deadline_ns: int,
        kind: CommandKind = CommandKind.WRITE,
        injection: int = 0,
        **laid: Unpack[InjectionOptions],
    ) -> int:
        """Send one command; its number. It is for the source's present process only, and for the time until then.

        CommandError: the queue is full, or can never hold that much. Never waits.
        """
        source = self.block.source
        if (len(writes) > 0) == (kind in EMPTY) or len(writes) > MAX_WRITES:
            raise CommandError(f"{source}: a command has 1 to {MAX_WRITES} items, this has {len(writes)}")
        with self._turn:
            number, self._next = self._next, self._next + 1
            incarnation = self.block.incarnation
            command = Command(self.writer, number, incarnation, deadline_ns, tuple(writes), kind, injection, **laid)
            record = command.pack()
            queues = self.block.commands
            if len(record) + 8 > queues.capacity:
                most = queues.capacity - 8
                raise CommandError(
                    f"{source}: a command of {len(record)} bytes, {most} are the most: write fewer at once"
                )
            if self._pid != os.getpid():
                raise CommandError("this process is a copy, made by fork, of the one that attached: attach anew in it")
            if not queues.push(self.writer, record):
                raise CommandError(f"{source}: its command queue is full: it takes none at present, or too many come")
            return number
