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
from typing import TYPE_CHECKING, Final

from shmio.errors import CommandError
from shmio.layout.write import Write
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
_COMMAND: Final = struct.Struct("<QIIqB7x")
_WRITE: Final = struct.Struct("<IIB7x")
_KIND_WRITE: Final = 1


@dataclass(frozen=True, slots=True)
class Command:
    """What a writer wants done. ``deadline_ns``: CLOCK_MONOTONIC after which it must not be begun."""

    writer: int
    id: int
    incarnation: int
    deadline_ns: int
    writes: tuple[Write, ...]

    def pack(self) -> bytes:
        """The record in a queue."""
        parts = [_COMMAND.pack(self.id, self.incarnation, len(self.writes), self.deadline_ns, _KIND_WRITE)]
        for write in self.writes:
            parts += (_WRITE.pack(write.offset, len(write.data), write.mask), write.data, bytes(-len(write.data) % 8))
        return b"".join(parts)

    @classmethod
    def unpack(cls, writer: int, record: bytes) -> Command:
        """Read a record; ValueError: it is none of ours."""
        try:
            number, incarnation, count, deadline_ns, kind = _COMMAND.unpack_from(record)
            if kind != _KIND_WRITE or not 0 < count <= MAX_WRITES:
                raise ValueError(f"kind {kind} with {count} items")
            at, writes = _COMMAND.size, []
            for _ in range(count):
                offset, size, mask = _WRITE.unpack_from(record, at)
                at += _WRITE.size
                if size == 0 or size > len(record) - at or (mask and (size != 1 or mask & mask - 1)):
                    raise ValueError(f"item of {size} bytes, mask {mask}")
                writes.append(Write(offset, mask, record[at : at + size]))
                at += size + -size % 8
        except struct.error as error:
            raise ValueError(str(error)) from None
        return cls(writer, number, incarnation, deadline_ns, tuple(writes))


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


class CommandSender:
    """A writer's end toward one block; the writer's process holds the role that has this queue."""

    def __init__(self, block: Block, writer: int) -> None:
        self.block = block
        self.writer = writer
        self._turn = threading.Lock()
        self._pid = os.getpid()  # two processes on one queue would overwrite each other's commands
        # Never the number of a predecessor's command, whose outcome may still come.
        self._next = secrets.randbits(62) + 1

    def submit(self, writes: Sequence[Write], deadline_ns: int) -> int:
        """Send one command; its number. It is for the source's present process only, and for the time until then.

        CommandError: the queue is full, or can never hold that much. Never waits.
        """
        source = self.block.source
        if not 0 < len(writes) <= MAX_WRITES:
            raise CommandError(f"{source}: a command has 1 to {MAX_WRITES} items, this has {len(writes)}")
        with self._turn:
            number, self._next = self._next, self._next + 1
            record = Command(self.writer, number, self.block.incarnation, deadline_ns, tuple(writes)).pack()
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
