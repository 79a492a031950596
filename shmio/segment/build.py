"""Build a segment: lay out its tables, blocks and sections, and write them."""

from __future__ import annotations

import os
import secrets
import struct
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from shmio.layout.model import Layout
from shmio.segment import _atomics, commands, header, model_channel, playhead
from shmio.segment.block import Attributes
from shmio.segment.clock import ClockPage, page_size
from shmio.segment.events import EVENT_SIZE, EVENT_SLOTS
from shmio.segment.header import HEADER_SIZE, SECTION_SIZE, SLOT_SIZE, Header, SectionEntry, SectionKind, State
from shmio.segment.processes import GUEST_SLOTS, ProcessSpec, ProcessTable, supervisor_beat
from shmio.segment.shm import SharedObject
from shmio.segment.standing_injections import CELL_SIZE
from shmio.version import __version__

RING_SECONDS = 8
SECTIONS_PER_BLOCK = 8  # of a block that has every kind
SPARE_SECTIONS = 40 * SECTIONS_PER_BLOCK
OWN_SECTIONS = 1  # sections of the instance: the clock page
SPARE_PROCESSES = 16 + GUEST_SLOTS
EVENT_STRIDE = -(-(_atomics.RAW_OFFSET + EVENT_SIZE) // 64) * 64

_RING = struct.Struct("<8Iqq")


@dataclass(frozen=True, slots=True)
class Origin:
    """The time with which an instance starts that replays a recording.

    ``clock_ns``: the clock at the start. ``started_utc_ns``: UTC of clock 0.
    """

    clock_ns: int
    started_utc_ns: int


@dataclass(frozen=True, slots=True)
class BlockSpec:
    """Specification of a source's block."""

    source: str
    layout: Layout
    period_ns: int
    stale_ns: int
    ring_bytes: int
    """Maximum size of the frame ring."""
    attributes: Attributes = field(default_factory=Attributes)
    declared: bytes = b""
    """The declared injections, as a JSON document of at most STANDING_SIZE bytes."""

    @property
    def slot_bytes(self) -> int:
        """Bytes of one slot: header, reason, raw image and effective image."""
        return align(_atomics.RAW_OFFSET + 2 * align(self.layout.size, 8), 64)

    @property
    def slots(self) -> int:
        """Number of frames in the ring: 8 s, rounded up to a power of two, within the memory limit; at least 8."""
        wanted = max(8, RING_SECONDS * 1_000_000_000 // self.period_ns)
        slots: int = 1 << (wanted - 1).bit_length()
        while slots > 8 and slots * self.slot_bytes > self.ring_bytes:
            slots //= 2
        return slots

    @property
    def size(self) -> int:
        """Bytes of all sections of the block."""
        return sum(align(size, 64) for _, size, _ in self.sections())

    def sections(self) -> list[tuple[SectionKind, int, bytes]]:
        """Return kind, size in bytes and first bytes of each section; the rest is zeros."""
        layout, attributes = self.layout.to_json(), msgspec.json.encode(self.attributes)
        effective = _atomics.RAW_OFFSET + align(self.layout.size, 8)
        frames = _RING.pack(
            self.slots, self.slot_bytes, self.layout.size, 0, _atomics.RAW_OFFSET, effective, 0, 0,
            self.period_ns, self.stale_ns,
        )  # fmt: skip
        linked = _RING.pack(
            model_channel.SLOTS, self.slot_bytes, self.layout.size, 0, _atomics.RAW_OFFSET, effective, 0, 0, 0, 0
        )
        events = _RING.pack(EVENT_SLOTS, EVENT_STRIDE, EVENT_SIZE, 0, _atomics.RAW_OFFSET, 0, 0, 0, 0, 0)
        queues = commands.section_header(self.layout.size)
        return [
            (SectionKind.LAYOUT, len(layout), layout),
            (SectionKind.FRAMES, _atomics.RING_HEADER_SIZE + self.slots * self.slot_bytes, frames),
            (SectionKind.EVENTS, _atomics.RING_HEADER_SIZE + EVENT_SLOTS * EVENT_STRIDE, events),
            (SectionKind.COMMANDS, commands.section_size(self.layout.size), queues),
            (SectionKind.SOURCE, len(attributes), attributes),
            (SectionKind.STANDING, CELL_SIZE, b""),
            (SectionKind.DECLARED, CELL_SIZE, bytes(8) + self.declared),
            *([(SectionKind.LINK, *model_channel.section(linked, self.slot_bytes))] if self.attributes.remote else []),
            *([(SectionKind.PLAYHEAD, playhead.SECTION_SIZE, b"")] if self.attributes.replay else []),
        ]


def write_blocks(memory: memoryview, at: int, first: int, blocks: Sequence[BlockSpec]) -> list[SectionEntry]:
    """Write the sections of blocks from offset ``at`` on; returns their table entries.

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
            at += align(size, 64)
    return entries


def wake(memory: memoryview, entries: Iterable[SectionEntry]) -> None:
    """Wake everybody who waits at these sections. A needless wake-up is harmless."""
    for entry in entries:
        with suppress(ValueError):  # nobody waits at an inconsistent section
            if entry.kind in (SectionKind.FRAMES, SectionKind.EVENTS):
                _atomics.Ring(memory, entry.offset, entry.size).wake()
            elif entry.kind == SectionKind.COMMANDS:
                commands.CommandQueues(memory, entry.offset, entry.size).wake()


def segment_size(blocks: Sequence[BlockSpec], processes: int) -> int:
    """Return the size in bytes of a segment with these blocks and processes; ``check`` prints it."""
    tables = sum(_table_sizes(len(blocks), processes))
    return HEADER_SIZE + tables + sum(block.size for block in blocks) + _clock_size(processes)


def _clock_size(processes: int) -> int:
    return align(page_size(processes + SPARE_PROCESSES), 64)


def _table_sizes(blocks: int, processes: int) -> tuple[int, int]:
    sections = SECTIONS_PER_BLOCK * blocks + SPARE_SECTIONS + OWN_SECTIONS
    return align(sections * SECTION_SIZE, 64), (processes + SPARE_PROCESSES) * SLOT_SIZE


def build_segment(
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
    """Allocate a new shared-memory object and write the whole segment, the magic last."""
    now_ns, begin_ns = time.monotonic_ns(), origin.clock_ns if origin else 0
    size = segment_size(blocks, len(processes))
    sections_size, processes_size = _table_sizes(len(blocks), len(processes))
    shared.allocate(size)
    with memoryview(shared.map()) as memory:
        head = Header(
            epoch=secrets.randbits(64) | 1,
            size=size,
            started_utc_ns=origin.started_utc_ns if origin else time.time_ns(),
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
        entries = write_blocks(memory, HEADER_SIZE + sections_size + processes_size, 0, blocks)
        clock_size = _clock_size(len(processes))
        clock_at = size - clock_size
        ClockPage.write_new(memory, clock_at, head.process_capacity, virtual=stepped, time_ns=begin_ns)
        own = len(entries)
        entries.append(SectionEntry(SectionKind.CLOCK, False, clock_at, clock_size, own, "clock", bytes(32)))
        header.change_sections(memory, head, entries)
        header.finish(memory)


def align(size: int, to: int) -> int:
    """Round ``size`` up to a multiple of ``to``."""
    return -(-size // to) * to
