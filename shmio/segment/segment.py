"""The segment as a whole: built by the supervisor, opened by workers and readers."""

from __future__ import annotations

import os
import secrets
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from shmio import __version__
from shmio.errors import AlreadyRunningError, FormatError, LayoutError, NotRunningError, SegmentError, UnfinishedError
from shmio.layout.model import Layout
from shmio.segment import _atomics, header, shm
from shmio.segment.block import Block, BlockWriter
from shmio.segment.header import HEADER_SIZE, SECTION_SIZE, SLOT_SIZE, Header, SectionEntry, SectionKind, State
from shmio.segment.processes import SUPERVISOR_LOCK, ProcessSpec, ProcessTable, supervisor_beat
from shmio.segment.shm import SharedObject

PREFIX = "shmio-"
RING_SECONDS = 8
SPARE_SECTIONS = 32
SPARE_PROCESSES = 16

_RING = struct.Struct("<8Iqq")


@dataclass(frozen=True, slots=True)
class BlockSpec:
    """What a source's block is built from."""

    source: str
    layout: Layout
    period_ns: int
    stale_ns: int
    ring_bytes: int
    """The most memory its frame ring may take."""

    @property
    def slot_bytes(self) -> int:
        """Bytes of one slot: header, reason, room for raw and effective."""
        return _align(_atomics.RAW_OFFSET + 2 * _align(self.layout.size, 8), 64)

    @property
    def slots(self) -> int:
        """Frames in the ring: 8 s of them, rounded up to a power of two, at least 8, as far as the memory allows."""
        wanted = max(8, RING_SECONDS * 1_000_000_000 // self.period_ns)
        slots: int = 1 << (wanted - 1).bit_length()
        while slots > 8 and slots * self.slot_bytes > self.ring_bytes:
            slots //= 2
        return slots

    @property
    def size(self) -> int:
        """Bytes of the ring's section."""
        return _atomics.RING_HEADER_SIZE + self.slots * self.slot_bytes


class Segment:
    """One instance's shared memory, mapped.

    A supervisor makes it with :meth:`create`; workers :meth:`open` it writable, readers read-only.
    """

    def __init__(self, shared: SharedObject, instance: str) -> None:
        self.shared = shared
        self.instance = instance
        self.memory = memoryview(shared.map())
        self.header = Header.read(self.memory, shared.name)
        self.processes = ProcessTable(shared, self.memory, self.header)
        self.blocks = self._find_blocks()

    @classmethod
    def create(
        cls,
        instance: str,
        blocks: Sequence[BlockSpec],
        processes: Sequence[ProcessSpec],
        *,
        mode: str = "live",
        control: str = "",
        group: str | None = None,
    ) -> Segment:
        """Build a new segment and hold its supervisor's lock.

        AlreadyRunningError: there is a segment of this name, with or without a living supervisor (see
        :func:`shmio.segment.leftover.clear` for the latter). SegmentError: there is no room.
        """
        name = PREFIX + instance
        try:
            shared = SharedObject.create(name, group)
        except FileExistsError:
            refuse_second(instance)
            raise AlreadyRunningError(f"a segment of instance {instance!r} is left over or just being made") from None
        try:
            # Whoever opens the name between creation and this lock sees no magic, and takes it for half-made.
            if not shared.try_lock(SUPERVISOR_LOCK) or not shared.current():
                raise AlreadyRunningError(f"another supervisor is just starting instance {instance}")
            try:
                _build(shared, instance, blocks, processes, mode, control)
                return cls(shared, instance)
            except BaseException:
                shm.unlink(name)
                raise
        except BaseException:
            shared.close()
            raise

    @classmethod
    def open(cls, instance: str, *, writable: bool = False) -> Segment:
        """Open a running instance's segment; NotRunningError, FormatError, SegmentError (permission)."""
        name = PREFIX + instance
        try:
            shared = SharedObject.open(name, writable=writable)
        except FileNotFoundError:
            running = ", ".join(running_instances()) or "none"
            raise NotRunningError(
                f"no instance {instance!r} is running (running: {running}); start it with shmio-supervisor up"
            ) from None
        try:
            if shared.size < HEADER_SIZE:
                raise UnfinishedError(f"instance {instance!r} is just starting, or died while it did")
            return cls(shared, instance)
        except BaseException:
            shared.close()
            raise

    def _find_blocks(self) -> dict[str, Block]:
        entries = header.read_sections(self.memory, self.header, self.shared.name)
        blocks = {}
        for entry in entries:
            if entry.kind != SectionKind.FRAMES or entry.retired:
                continue
            if entry.layout >= len(entries) or entries[entry.layout].kind != SectionKind.LAYOUT:
                raise FormatError(f"{self.shared.name}: the ring of {entry.name} names no layout")
            described = entries[entry.layout]
            try:
                layout = Layout.from_json(bytes(self.memory[described.offset : described.offset + described.size]))
                ring = _atomics.Ring(self.memory, entry.offset, entry.size)
            except (LayoutError, ValueError) as error:
                raise FormatError(f"{self.shared.name}: block {entry.name}: {error}") from None
            if ring.frame_size != layout.size:
                raise FormatError(f"{self.shared.name}: block {entry.name}: ring and layout differ in size")
            blocks[entry.name] = Block(entry.name, layout, ring)
        return blocks

    def clock_ns(self, now_ns: int) -> int:
        """The instance's clock, ns since its start, at a time of CLOCK_MONOTONIC."""
        return now_ns - self.header.started_ns

    def writer(self, source: str) -> BlockWriter:
        """The writing side of a source's block; for its process alone, which holds the role's lock."""
        return BlockWriter(self.blocks[source], self.clock_ns)

    @property
    def supervisor(self) -> tuple[int, State]:
        """(pid, state of the instance) as the supervisor last wrote them."""
        return header.read_supervisor(self.memory)

    @property
    def supervisor_heartbeat_ns(self) -> int:
        """CLOCK_MONOTONIC of the supervisor's last beat."""
        return _atomics.load64(self.memory, header.HEARTBEAT_OFFSET)

    @property
    def supervised(self) -> bool:
        """Whether a supervisor is alive."""
        return self.shared.locked(SUPERVISOR_LOCK)

    def set_state(self, pid: int, state: State) -> None:
        """Tell supervisor and state; the supervisor's alone."""
        header.write_supervisor(self.memory, pid, state)
        supervisor_beat(self.memory)

    def unlink(self) -> None:
        """Remove the name, if it is still this segment's. Only a clean stop does this."""
        if self.shared.current():
            shm.unlink(self.shared.name)

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called."""
        return self.shared.closed

    def close(self) -> None:
        """Give up mapping and locks; blocks taken from here keep the mapping as long as they are held."""
        self.blocks = {}
        with suppress(BufferError):  # a Ring is still held somewhere
            self.memory.release()
        self.shared.close()

    def __enter__(self) -> Segment:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def instances() -> list[str]:
    """Names of the instances that have a segment, whole or left over."""
    return [name.removeprefix(PREFIX) for name in shm.names(PREFIX)]


def running_instances() -> list[str]:
    """Names of the instances that live: a supervisor, or at least one of its processes, is there."""
    found = []
    for name in instances():
        with suppress(SegmentError), Segment.open(name) as segment:
            if segment.supervised or any(slot.alive() for slot in segment.processes):
                found.append(name)
    return found


def segment_size(blocks: Sequence[BlockSpec], processes: int) -> int:
    """Bytes of a segment built from these; what ``check`` prints."""
    sections, process_table = _table_sizes(len(blocks), processes)
    data = sum(_align(len(block.layout.to_json()), 64) + _align(block.size, 64) for block in blocks)
    return HEADER_SIZE + sections + process_table + data


def _table_sizes(blocks: int, processes: int) -> tuple[int, int]:
    return (2 * blocks + SPARE_SECTIONS) * SECTION_SIZE, (processes + SPARE_PROCESSES) * SLOT_SIZE


def _build(
    shared: SharedObject,
    instance: str,
    blocks: Sequence[BlockSpec],
    processes: Sequence[ProcessSpec],
    mode: str,
    control: str,
) -> None:
    size = segment_size(blocks, len(processes))
    sections_size, processes_size = _table_sizes(len(blocks), len(processes))
    shared.allocate(size)
    with memoryview(shared.map()) as memory:
        head = Header(
            epoch=secrets.randbits(64) | 1,
            size=size,
            started_utc_ns=time.time_ns(),
            started_ns=time.monotonic_ns(),
            sections_offset=HEADER_SIZE,
            section_capacity=sections_size // SECTION_SIZE,
            processes_offset=HEADER_SIZE + sections_size,
            process_capacity=processes_size // SLOT_SIZE,
            mode=mode,
            instance=instance,
            version=__version__,
            control=control,
        )
        head.write(memory)
        ProcessTable.write(memory, head, processes)
        header.write_supervisor(memory, os.getpid(), State.STARTING)
        supervisor_beat(memory)
        at = HEADER_SIZE + sections_size + processes_size
        for block in blocks:
            described = block.layout.to_json()
            memory[at : at + len(described)] = described
            entry = SectionEntry(SectionKind.LAYOUT, False, at, len(described), 0, block.source, block.layout.hash)
            layout = header.write_section(memory, head, entry)
            at += _align(len(described), 64)
            write_ring_header(memory, at, block)
            entry = SectionEntry(SectionKind.FRAMES, False, at, block.size, layout, block.source, bytes(32))
            header.write_section(memory, head, entry)
            at += _align(block.size, 64)
        header.finish(memory)


def write_ring_header(memory: memoryview, offset: int, block: BlockSpec) -> None:
    """Write the fixed line of a ring's header (ring.h: ring_header)."""
    effective = _atomics.RAW_OFFSET + _align(block.layout.size, 8)
    _RING.pack_into(
        memory, offset, block.slots, block.slot_bytes, block.layout.size, 0, _atomics.RAW_OFFSET, effective, 0, 0,
        block.period_ns, block.stale_ns,
    )  # fmt: skip


def refuse_second(instance: str) -> None:
    """AlreadyRunningError, with the supervisor's pid, if the instance has a living one."""
    try:
        segment = Segment.open(instance)
    except SegmentError:
        return
    with segment:
        if segment.supervised:
            raise AlreadyRunningError(
                f"instance {instance!r} is already running, supervisor pid {segment.supervisor[0]}"
            )


def _align(size: int, to: int) -> int:
    return -(-size // to) * to
