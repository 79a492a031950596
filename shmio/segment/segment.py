"""The segment of an instance, which the supervisor creates and changes, and other processes open."""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import msgspec

from shmio.errors import (
    AlreadyRunningError,
    FormatError,
    LayoutError,
    NotRunningError,
    SegmentError,
    UnfinishedError,
    WrongInstanceError,
)
from shmio.layout.document import load_layout, load_part
from shmio.layout.model import Layout
from shmio.segment import _atomics, commands, header, model_channel, shm
from shmio.segment.block import Attributes, Block, BlockWriter, Stamp
from shmio.segment.clock import ClockPage, page_size, time_lock
from shmio.segment.commands import CommandQueues
from shmio.segment.events import EVENT_SIZE, EVENT_SLOTS
from shmio.segment.header import (
    HEADER_SIZE,
    LIST_CELL_SIZE,
    SECTION_SIZE,
    SLOT_SIZE,
    Header,
    SectionEntry,
    SectionKind,
    State,
)
from shmio.segment.model_channel import ModelChannel
from shmio.segment.playhead import PLAYHEAD_SIZE, Playhead
from shmio.segment.processes import EXTERNAL_SLOTS, SUPERVISOR_LOCK, ProcessSpec, ProcessTable, supervisor_beat
from shmio.segment.reader_lag import TABLE_SIZE, ReaderTable
from shmio.segment.shm import SharedObject
from shmio.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

PREFIX = "shmio-"
"""Prefix of the name of each segment; the name of the instance follows."""


def _align(size: int, to: int) -> int:
    """Round ``size`` up to a multiple of ``to``."""
    return -(-size // to) * to


def _clocks() -> tuple[int, int]:
    """Return CLOCK_MONOTONIC and UTC at the same moment, both in ns.

    Other processes may interrupt this one between two readings, so the closest of some readings counts.
    """
    readings = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(5)]
    before_ns, utc_ns, after_ns = min(readings, key=lambda reading: reading[2] - reading[0])
    return (before_ns + after_ns) // 2, utc_ns


_DAMAGED = "; the segment is damaged; restart the instance"
_RING_SECONDS = 8
_SECTIONS_PER_BLOCK = 9  # at most: one of every kind
_SPARE_SECTIONS = 40 * _SECTIONS_PER_BLOCK
_OWN_SECTIONS = 1  # sections of no block: the clock page
_SPARE_PROCESSES = 16 + EXTERNAL_SLOTS
_EVENT_STRIDE = _align(_atomics.RAW_OFFSET + EVENT_SIZE, 64)
_FIRST_LINK = 2
"""Determines which byte to lock for a block's model channel or playhead.

Its number is the number of process slots + this number + the index of the block's layout section.
"""

_RING = struct.Struct("<8Iqq")
_ATTRIBUTES = msgspec.json.Decoder(Attributes)  # created before there are threads, as in layout/document.py


class Origin(msgspec.Struct, frozen=True):
    """Start time of an instance that replays a recording.

    ``clock_ns`` is the instance's clock at the start of the instance. ``started_utc_ns`` is the UTC
    in ns at which that clock would have been 0.
    """

    clock_ns: int
    started_utc_ns: int


class BlockSpec(msgspec.Struct, frozen=True):
    """Parameters of a source's new block."""

    source: str
    layout: Layout
    period_ns: int
    stale_ns: int
    ring_bytes: int
    """Maximum size of the frame ring, in bytes."""
    attributes: Attributes = Attributes()
    declared: bytes = b""
    """The declared injections, as a JSON document of at most LIST_SIZE bytes."""

    @property
    def slot_bytes(self) -> int:
        """Size of one slot in bytes: header, reason, raw image and effective image."""
        return _align(_atomics.RAW_OFFSET + 2 * _align(self.layout.size, 8), 64)

    @property
    def slots(self) -> int:
        """Number of frames that the ring can hold: a power of two, at least 8.

        The ring holds the frames of at least 8 s, unless ``ring_bytes`` is too small for that.
        """
        wanted = max(8, _RING_SECONDS * 1_000_000_000 // self.period_ns)
        slots: int = 1 << (wanted - 1).bit_length()
        while slots > 8 and slots * self.slot_bytes > self.ring_bytes:
            slots //= 2
        return slots

    @property
    def size(self) -> int:
        """Size of all sections of the block, in bytes."""
        return sum(_align(size, 64) for _, size, _ in self.sections())

    def sections(self) -> list[tuple[SectionKind, int, bytes]]:
        """Return (kind, size in bytes, first bytes) of each section; the other bytes of a section are zero."""
        layout, attributes = self.layout.to_json(), msgspec.json.encode(self.attributes)
        effective = _atomics.RAW_OFFSET + _align(self.layout.size, 8)
        slot = self.slot_bytes, self.layout.size, 0, _atomics.RAW_OFFSET, effective, 0, 0
        frames = _RING.pack(self.slots, *slot, self.period_ns, self.stale_ns)
        linked = _RING.pack(model_channel.SLOTS, *slot, 0, 0)
        events = _RING.pack(EVENT_SLOTS, _EVENT_STRIDE, EVENT_SIZE, 0, _atomics.RAW_OFFSET, 0, 0, 0, 0, 0)
        queues = commands.section_header(self.layout.size)
        return [
            (SectionKind.LAYOUT, len(layout), layout),
            (SectionKind.FRAMES, _atomics.RING_HEADER_SIZE + self.slots * self.slot_bytes, frames),
            (SectionKind.EVENTS, _atomics.RING_HEADER_SIZE + EVENT_SLOTS * _EVENT_STRIDE, events),
            (SectionKind.COMMANDS, commands.section_size(self.layout.size), queues),
            (SectionKind.SOURCE, len(attributes), attributes),
            (SectionKind.INJECTIONS, LIST_CELL_SIZE, b""),
            (SectionKind.DECLARED, LIST_CELL_SIZE, bytes(8) + self.declared),
            (SectionKind.READERS, TABLE_SIZE, b""),
            *([(SectionKind.LINK, *model_channel.section(linked, self.slot_bytes))] if self.attributes.remote else []),
            *([(SectionKind.PLAYHEAD, PLAYHEAD_SIZE, b"")] if self.attributes.replay else []),
        ]


def _write_blocks(memory: memoryview, at: int, first: int, blocks: Sequence[BlockSpec]) -> list[SectionEntry]:
    """Write the sections of blocks from offset ``at`` on, and return their table entries.

    ``first`` is the table index of the first entry.
    """
    entries: list[SectionEntry] = []
    for block in blocks:
        layout = first + len(entries)
        for kind, size, begin in block.sections():
            memory[at : at + len(begin)] = begin
            digest = block.layout.hash if kind is SectionKind.LAYOUT else bytes(32)
            of = 0 if kind is SectionKind.LAYOUT else layout
            entries.append(SectionEntry(kind, False, at, size, of, block.source, digest))
            at += _align(size, 64)
    return entries


def read_block(
    shared: SharedObject,
    memory: memoryview,
    head: Header,
    entries: Sequence[SectionEntry],
    layout_at: int,
    clock: ClockPage,
) -> Block:
    """Open the block whose layout is in section ``layout_at``, without reading the layout yet.

    Raises:
        FormatError: The block is inconsistent.
    """
    name = shared.name
    described = entries[layout_at]
    parts = {
        entry.kind: entry for index, entry in enumerate(entries) if entry.layout == layout_at and index != layout_at
    }

    def part(kind: SectionKind) -> tuple[int, int]:
        if kind not in parts:
            raise FormatError(f"{name}: block {described.name} has no {kind.name.lower()}")
        return parts[kind].offset, parts[kind].size

    try:
        at, size = part(SectionKind.SOURCE)
        attributes = _ATTRIBUTES.decode(bytes(memory[at : at + size]))
        frames = _atomics.Ring(memory, *part(SectionKind.FRAMES), private=shared.is_private)
        events = _atomics.Ring(memory, *part(SectionKind.EVENTS), private=shared.is_private)
        queues = CommandQueues(memory, *part(SectionKind.COMMANDS))
        injections, size = part(SectionKind.INJECTIONS)
        declared, declared_size = part(SectionKind.DECLARED)
        if min(size, declared_size) < LIST_CELL_SIZE:
            raise ValueError("the section of the source's injections is too short")
        readers = ReaderTable(memory, *part(SectionKind.READERS))
        lock_byte = head.process_capacity + _FIRST_LINK + layout_at
        channel = ModelChannel(shared, memory, *part(SectionKind.LINK), lock_byte) if attributes.remote else None
        playhead = (
            Playhead(shared, memory, *part(SectionKind.PLAYHEAD), lock_byte, clock) if attributes.replay else None
        )
    except (ValueError, msgspec.MsgspecError) as error:
        raise FormatError(f"{name}: block {described.name}: {error}") from None
    linked_size = frames.frame_size if channel is None else channel.frame_size
    if frames.frame_size != linked_size or events.frame_size != EVENT_SIZE:
        raise FormatError(f"{name}: block {described.name}: its rings have wrong frame sizes{_DAMAGED}")

    def document() -> bytes:
        return bytes(memory[described.offset : described.offset + described.size])

    def part_with(path: str) -> Layout | None:
        found = load_part(document(), path)
        return None if found is None or found.size != frames.frame_size else found

    def layout() -> Layout:
        try:
            found = load_layout(document(), described.digest)
        except LayoutError as error:
            raise FormatError(f"{name}: block {described.name}: {error}") from None
        if found.size != frames.frame_size:
            raise FormatError(
                f"{name}: block {described.name}: its layout describes {found.size} bytes, but its frames have "
                f"{frames.frame_size}{_DAMAGED}"
            )
        return found

    return Block(
        described.name, layout, part_with, frames, events, queues, (memory, injections, declared), readers, attributes,
        partial(header.retired, memory, head, layout_at), layout_at, clock, channel, playhead,
    )  # fmt: skip


def wake(memory: memoryview, entries: Iterable[SectionEntry]) -> None:
    """Wake all processes that wait at doorbells in these sections.

    Processes that are woken for no reason continue to wait.
    """
    for entry in entries:
        with suppress(ValueError):  # no process waits at an inconsistent section
            if entry.kind in (SectionKind.FRAMES, SectionKind.EVENTS):
                _atomics.Ring(memory, entry.offset, entry.size).wake()
            elif entry.kind == SectionKind.COMMANDS:
                CommandQueues(memory, entry.offset, entry.size).wake()


def segment_size(blocks: Sequence[BlockSpec], processes: int) -> int:
    """Return the size in bytes of a segment with these blocks and this number of processes."""
    tables = sum(_table_sizes(len(blocks), processes))
    return HEADER_SIZE + tables + sum(block.size for block in blocks) + _clock_size(processes)


def _clock_size(processes: int) -> int:
    return _align(page_size(processes + _SPARE_PROCESSES), 64)


def _table_sizes(blocks: int, processes: int) -> tuple[int, int]:
    sections = _SECTIONS_PER_BLOCK * blocks + _SPARE_SECTIONS + _OWN_SECTIONS
    return _align(sections * SECTION_SIZE, 64), (processes + _SPARE_PROCESSES) * SLOT_SIZE


def _build_segment(
    shared: SharedObject,
    instance: str,
    blocks: Sequence[BlockSpec],
    processes: Sequence[ProcessSpec],
    mode: str,
    control: str,
    *,
    config: Path | None = None,
    stepped: bool,
    origin: Origin | None = None,
) -> None:
    """Allocate a new shared-memory object, and write the whole segment; the magic number last."""
    import secrets  # noqa: PLC0415  programs that only read need no random numbers, and it loads OpenSSL

    (now_ns, utc_ns), begin_ns = _clocks(), origin.clock_ns if origin else 0
    size = segment_size(blocks, len(processes))
    sections_size, processes_size = _table_sizes(len(blocks), len(processes))
    shared.allocate(size)
    with memoryview(shared.map()) as memory:
        head = Header(
            epoch=secrets.randbits(64) | 1,
            size=size,
            started_utc_ns=origin.started_utc_ns if origin else utc_ns,
            started_ns=now_ns - begin_ns,
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
        if config:
            header.write_config(memory, config)
        ProcessTable.write(memory, head, processes)
        header.write_supervisor(memory, os.getpid(), State.STARTING)
        if origin:
            header.write_supervised_since(memory, now_ns)
        supervisor_beat(memory)
        entries = _write_blocks(memory, HEADER_SIZE + sections_size + processes_size, 0, blocks)
        clock_size = _clock_size(len(processes))
        clock_at = size - clock_size
        ClockPage.write_new(memory, clock_at, head.process_capacity, virtual=stepped, time_ns=begin_ns)
        own = len(entries)
        entries.append(SectionEntry(SectionKind.CLOCK, False, clock_at, clock_size, own, "clock", bytes(32)))
        header.change_sections(memory, head, entries)
        header.finish(memory)


def _read_clock(shared: SharedObject, head: Header, entries: Sequence[SectionEntry]) -> ClockPage:
    """Open the clock page; raise FormatError if it is missing or inconsistent."""
    for entry in entries:
        if entry.kind == SectionKind.CLOCK:
            try:  # use another mapping, so that frames still age after the segment is closed
                own = memoryview(shared.map())
                return ClockPage(own, entry.offset, entry.size, head, partial(shared.taken, time_lock(head)))
            except ValueError as error:
                raise FormatError(f"{shared.name}: {error}") from None
    raise FormatError(
        f"{shared.name} has no clock page: shmio {head.version}, an older version, made it; use the same version"
    )


class Segment:
    """The mapped shared memory of an instance.

    A supervisor calls :meth:`create`. Other processes call :meth:`open`; workers do so with
    ``writable``.
    """

    def __init__(self, shared: SharedObject, instance: str) -> None:
        self.shared = shared
        self.instance = instance
        self.memory = memoryview(shared.map())
        self.header = Header.read(self.memory, shared.name)
        self.processes = ProcessTable(shared, self.memory, self.header)
        self._lock = threading.RLock()
        """Lock for changes of ``blocks``, because several threads may call :meth:`refresh`."""
        self.clock = _read_clock(shared, self.header, self._sections())
        self._known: dict[int, Block] = {}  # by index of the layout section
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
        config: Path | None = None,
        group: str | None = None,
        stepped: bool = False,
        origin: Origin | None = None,
    ) -> Segment:
        """Create a new segment, and lock it as its supervisor.

        Args:
            instance: Name of the instance.
            blocks: The blocks of its sources.
            processes: The instance's processes.
            mode: Mode of the instance.
            control: Path of the control socket.
            config: Resolved path of the configuration file; None: there is none.
            group: Group whose members may read the segment; None: only this user may.
            stepped: Whether time is virtual from the start.
            origin: Start time of an instance that replays a recording; None: the clock starts at 0
                now.

        Raises:
            AlreadyRunningError: A segment of this name exists, with or without a living supervisor
                (see :func:`shmio.segment.stale_segment.clear`).
            SegmentError: There is no room in shared memory.
        """
        name = PREFIX + instance
        try:
            shared = SharedObject.create(name, group)
        except FileExistsError:
            refuse_second(instance)
            raise AlreadyRunningError(f"a segment of instance {instance!r} is left over or being created") from None
        try:
            # A process that opens the segment before this lock finds no magic number, so takes it as unfinished.
            if not shared.try_lock(SUPERVISOR_LOCK) or not shared.current():
                raise AlreadyRunningError(f"another supervisor is starting instance {instance}")
            try:
                _build_segment(
                    shared, instance, blocks, processes, mode, control, config=config, stepped=stepped, origin=origin
                )
                return cls(shared, instance)
            except BaseException:
                shm.unlink(name)
                raise
        except BaseException:
            shared.close()
            raise

    @classmethod
    def private(
        cls, instance: str, blocks: Sequence[BlockSpec], processes: Sequence[ProcessSpec], *, mode: str = "live"
    ) -> Segment:
        """Create a segment that only this process can use, and whose time is virtual from the start.

        Raises:
            SegmentError: There is not enough memory.
        """
        shared = SharedObject.private(PREFIX + instance)
        try:
            shared.try_lock(SUPERVISOR_LOCK)
            _build_segment(shared, instance, blocks, processes, mode, "", stepped=True)
            segment = cls(shared, instance)
            for block in blocks:
                segment.blocks[block.source].layout = block.layout  # the same as in the segment, and already checked
            return segment
        except BaseException:
            shared.close()
            raise

    def again(self) -> Segment:
        """Open a private segment once more, as another process would open the segment of an instance."""
        shared = self.shared.again()
        try:
            segment = Segment(shared, self.instance)
            for source, block in segment.blocks.items():
                block.layout = self.blocks[source].layout
            return segment
        except BaseException:
            shared.close()
            raise

    @classmethod
    def open(cls, instance: str, *, writable: bool = False, config: Path | None = None) -> Segment:
        """Open the segment of a running instance.

        Args:
            instance: Name of the instance.
            writable: Whether to map the segment writable.
            config: Configuration file from which the instance must have been started; None: any.

        Raises:
            NotRunningError: The instance has no segment.
            FormatError: Another version of shmio made the segment, or it is inconsistent.
            SegmentError: This user may not open the segment.
            WrongInstanceError: The instance was started from another configuration file.
        """
        name = PREFIX + instance
        try:
            shared = SharedObject.open(name, writable=writable)
        except FileNotFoundError:
            running = ", ".join(running_instances()) or "none"
            raise NotRunningError(
                f"no instance {instance!r} is running (running: {running}); start it with shmio-supervisor up, "
                "and -c FILE if its configuration is not ./supervisor.toml"
            ) from None
        try:
            if shared.size < HEADER_SIZE:
                raise UnfinishedError(f"instance {instance!r} is starting, or died during its start")
            segment = cls(shared, instance)
            if config is not None:
                segment.require_config(config)
        except BaseException:
            shared.close()
            raise
        return segment

    @property
    def config(self) -> Path | None:
        """The configuration file that the instance was started from; None: unknown."""
        return header.read_config(self.memory)

    def require_config(self, file: Path) -> None:
        """Raise WrongInstanceError unless the instance was started from this file.

        Configurations in different folders may have the same ``instance.name``. Only the resolved
        paths are compared, not the contents.
        """
        if header.has_config(self.memory, file.resolve()):
            return
        used = "an unknown file (its version of shmio does not record the file)" if self.config is None else self.config
        raise WrongInstanceError(
            f"the running instance {self.instance!r} was started from {used}, not from {file.resolve()}; "
            f"to use that instance anyway, add --instance {self.instance}"
        )

    def _find_blocks(self) -> dict[str, Block]:
        self._entries = entries = self._sections()
        layouts = [index for index, entry in enumerate(entries) if entry.kind == SectionKind.LAYOUT]
        return {entries[index].name: self._found(index) for index in layouts if not entries[index].retired}

    def _found(self, layout: int) -> Block:
        """Return the block whose layout is in this section. All calls return the same object."""
        if layout not in self._known:
            self._known[layout] = read_block(self.shared, self.memory, self.header, self._entries, layout, self.clock)
        return self._known[layout]

    @property
    def ended(self) -> list[Block]:
        """Blocks that reloads have retired, the oldest first, as of the last :meth:`refresh`.

        The rings of these blocks can still be read.

        Raises:
            FormatError: A block is inconsistent.
        """
        with self._lock:
            entries = enumerate(self._entries)
            layouts = [index for index, entry in entries if entry.kind == SectionKind.LAYOUT and entry.retired]
            return [self._found(index) for index in layouts]

    def _sections(self) -> list[SectionEntry]:
        """Read the section table. If it changes meanwhile, read it again."""
        while True:
            self._generation, count = header.table_state(self.memory)
            if len(self.memory) < self.shared.size:  # the segment has grown; blocks keep their old mapping
                self.memory = memoryview(self.shared.map())
            entries = header.read_sections(self.memory, self.header, count, self.shared.name)
            if self.generation == self._generation:  # otherwise, the table changed meanwhile
                return entries

    @property
    def generation(self) -> int:
        """Generation of the section table, which changes when a reload adds or retires blocks."""
        return header.generation(self.memory)

    @property
    def outdated(self) -> bool:
        """True if a reload has changed the segment since the last :meth:`refresh`."""
        return header.generation(self.memory) != self._generation

    def refresh(self) -> bool:
        """Update the blocks and the process table after a reload.

        Remaining blocks stay the same objects. Several threads may call this method.

        Returns:
            Whether anything has changed.

        Raises:
            FormatError: A block is inconsistent.
            SegmentError: :meth:`close` was called.
        """
        self._require_open()
        with self._lock:
            if not self.outdated:
                return False
            blocks = self._find_blocks()
            self.processes = ProcessTable(self.shared, self.memory, self.header)
            self.blocks = blocks  # last: whoever sees new blocks also sees their processes
            return True

    def require_blocks(self, count: int) -> None:
        """Raise SegmentError unless the section table has room for ``count`` more blocks."""
        vacant = (self.header.section_capacity - len(self._sections())) // _SECTIONS_PER_BLOCK
        if count > vacant:
            raise SegmentError(
                f"segment {self.shared.name} has room for {vacant} more blocks, not for {count} (each new or "
                "changed source takes one, until the instance ends); restart the instance with shmio-supervisor "
                "down and up"
            )

    def reserve(self, add: Sequence[BlockSpec]) -> int:
        """Reserve room for the blocks ``add``, so that :meth:`change` cannot fail for lack of room.

        Returns:
            The offset of the reserved room.

        Raises:
            SegmentError: There is no room in shared memory or in the section table.
        """
        self.require_blocks(len(add))
        entries = self._sections()
        head = self.header
        tables = head.processes_offset + head.process_capacity * SLOT_SIZE
        at = _align(max([tables, *(entry.offset + entry.size for entry in entries)]), 64)
        size = at + sum(block.size for block in add)
        before = self.shared.size
        self.shared.allocate(size)
        with memoryview(self.shared.map()) as memory:  # a supervisor that died may have written there
            memory[at : min(before, size)] = bytes(max(0, min(before, size) - at))
        return at

    def change(self, add: Sequence[BlockSpec] = (), retire: Sequence[str] = ()) -> None:
        """Add blocks, then retire blocks. Only the supervisor may call this.

        Readers see the changes in this order. If a source is in both ``add`` and ``retire``, its new
        block replaces its old block.

        Raises:
            SegmentError: There is no room; nothing has changed.
        """
        at = self.reserve(add)
        first = len(self._sections())  # this also maps the reserved room
        self._change(_write_blocks(self.memory, at, first, add), {self.blocks[name].section for name in retire})

    def end_replaced(self) -> None:
        """Finish a :meth:`change` during which the supervisor died.

        Then wake the processes that wait at retired blocks.
        """
        replaced = {block.section for block in self._known.values() if block not in self.blocks.values()}
        parts = enumerate(self._sections())
        ended = {index for index, part in parts if part.kind == SectionKind.LAYOUT and part.retired}
        self._change((), replaced | ended)  # even if empty: the generation may not be up to date

    def _change(self, add: Sequence[SectionEntry], ending: Collection[int]) -> None:
        """Append entries, and retire the blocks whose layouts are in the sections ``ending``."""
        parts = list(enumerate(self._sections()))
        ended = {i: part for i, part in parts if (i if part.kind == SectionKind.LAYOUT else part.layout) in ending}
        header.change_sections(self.memory, self.header, add, list(ended))
        self.refresh()
        wake(self.memory, ended.values())

    def clock_ns(self, now_ns: int) -> int:
        """Convert a publish time, as frames have it, to a time of the instance's clock, in ns."""
        return now_ns - self.header.started_ns

    def writer(self, source: str, at: Stamp | None = None) -> BlockWriter:
        """Open a source's block for writing. Only the process in the source's slot may call this.

        ``at`` are the times of the STARTED event; None: now.
        """
        block = self.blocks[source]
        return BlockWriter(block, self.clock_ns if block.playhead is None else block.playhead.clock_ns, at)

    @property
    def supervisor(self) -> tuple[int, State]:
        """The supervisor's pid and the instance's state, as last written."""
        return header.read_supervisor(self.memory)

    @property
    def note(self) -> str:
        """The supervisor's last note about a problem of the instance itself; empty: there is no problem."""
        return header.read_note(self.memory)

    @property
    def supervisor_heartbeat_ns(self) -> int:
        """Time of the supervisor's last heartbeat, CLOCK_MONOTONIC in ns."""
        return _atomics.load64(self.memory, header.HEARTBEAT_OFFSET)

    @property
    def supervised_since_ns(self) -> int:
        """Time at which the present supervisor started, CLOCK_MONOTONIC in ns."""
        return _atomics.load64(self.memory, header.SUPERVISED_SINCE_OFFSET) or self.header.started_ns

    @property
    def supervised(self) -> bool:
        """True if a supervisor is alive."""
        return self.shared.locked(SUPERVISOR_LOCK)

    def require_running(self) -> None:
        """Raise NotRunningError if the instance has stopped, and SegmentError if :meth:`close` was called."""
        self._require_open()
        if not self.shared.current():
            raise NotRunningError(f"instance {self.instance!r} has stopped")

    def _require_open(self) -> None:
        if self.shared.closed:
            raise SegmentError(f"detached from instance {self.instance!r}")

    def set_state(self, pid: int, state: State, note: str = "") -> None:
        """Write the supervisor's pid, the instance's state and a note.

        Only the supervisor may call this.
        """
        header.write_supervisor(self.memory, pid, state)
        header.write_note(self.memory, note)
        supervisor_beat(self.memory)

    def lead_to(self, control: str, config: Path) -> None:
        """Write the start time, control socket and configuration of a supervisor that takes over.

        Only that supervisor may call this. Processes that have opened the segment before still have
        the old paths.
        """
        header.write_supervised_since(self.memory, time.monotonic_ns())
        header.write_control(self.memory, control)
        header.write_config(self.memory, config)
        self.header = Header.read(self.memory, self.shared.name)

    def unlink(self) -> None:
        """Remove the segment's name, unless the name belongs to another segment by now.

        Call this only when the instance stops cleanly.
        """
        if self.shared.current():
            shm.unlink(self.shared.name)

    @property
    def closed(self) -> bool:
        """True if :meth:`close` was called."""
        return self.shared.closed

    def close(self) -> None:
        """Release the mapping and the locks. Blocks that are still in use keep the mapping."""
        self.blocks, self._known = {}, {}
        with suppress(BufferError):  # a Ring is still referenced
            self.memory.release()
        self.shared.close()

    def __enter__(self) -> Segment:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def instances() -> list[str]:
    """Return the names of all instances that have a segment, running or stale."""
    return [name.removeprefix(PREFIX) for name in shm.names(PREFIX)]


def running_instances() -> list[str]:
    """Return the names of the instances that have a living supervisor or process."""
    found = []
    for name in instances():
        with suppress(SegmentError), Segment.open(name) as segment:
            if segment.supervised or any(slot.alive() for slot in segment.processes):
                found.append(name)
    return found


def refuse_second(instance: str) -> None:
    """Raise AlreadyRunningError if the instance has a living supervisor."""
    try:
        segment = Segment.open(instance)
    except SegmentError:
        return
    with segment:
        if segment.supervised:
            raise AlreadyRunningError(
                f"instance {instance!r} is already running, supervisor pid {segment.supervisor[0]}"
            )
