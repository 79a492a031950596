"""What the sections of a segment hold: the clock page, and blocks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import msgspec

from shmio.errors import FormatError, LayoutError
from shmio.layout.model import Layout
from shmio.segment import _atomics, header
from shmio.segment.block import Attributes, Block
from shmio.segment.clock import ClockPage, time_lock
from shmio.segment.commands import CommandQueues
from shmio.segment.events import EVENT_SIZE
from shmio.segment.header import Header, SectionEntry, SectionKind
from shmio.segment.link import Link
from shmio.segment.playhead import Playhead
from shmio.segment.shm import SharedObject
from shmio.segment.standing import declared_cell, standing_cell

FIRST_LINK = 2
"""The lock of a block's link or playhead: so many bytes, and its layout's index, after those of the process table."""

_ATTRIBUTES = msgspec.json.Decoder(Attributes)  # as in layout/document.py: built before there are threads


def read_clock(shared: SharedObject, head: Header, entries: Sequence[SectionEntry]) -> ClockPage:
    """The clock page; FormatError."""
    for entry in entries:
        if entry.kind == SectionKind.CLOCK:
            try:  # on memory of its own: what has been read is still judged by it when the segment is closed
                own = memoryview(shared.map())
                return ClockPage(own, entry.offset, entry.size, head, partial(shared.taken, time_lock(head)))
            except ValueError as error:
                raise FormatError(f"{shared.name}: {error}") from None
    raise FormatError(
        f"{shared.name} has no clock page, so shmio {head.version} that made it is older: use one version for both"
    )


def read_block(
    shared: SharedObject,
    memory: memoryview,
    head: Header,
    entries: Sequence[SectionEntry],
    layout_at: int,
    clock: ClockPage,
) -> Block:
    """The block whose layout is the section of this index. FormatError."""
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
        layout = Layout.from_json(bytes(memory[described.offset : described.offset + described.size]))
        at, size = part(SectionKind.SOURCE)
        attributes = _ATTRIBUTES.decode(bytes(memory[at : at + size]))
        frames = _atomics.Ring(memory, *part(SectionKind.FRAMES))
        events = _atomics.Ring(memory, *part(SectionKind.EVENTS))
        queues = CommandQueues(memory, *part(SectionKind.COMMANDS))
        standing = standing_cell(memory, *part(SectionKind.STANDING))
        declared = declared_cell(memory, *part(SectionKind.DECLARED))
        lock_byte = head.process_capacity + FIRST_LINK + layout_at
        link = Link(shared, memory, *part(SectionKind.LINK), lock_byte) if attributes.remote else None
        playhead = (
            Playhead(shared, memory, *part(SectionKind.PLAYHEAD), lock_byte, clock) if attributes.replay else None
        )
    except (LayoutError, ValueError, msgspec.MsgspecError) as error:
        raise FormatError(f"{name}: block {described.name}: {error}") from None
    linked_size = layout.size if link is None else link.frame_size
    if not frames.frame_size == linked_size == layout.size or events.frame_size != EVENT_SIZE:
        raise FormatError(f"{name}: block {described.name}: rings and layout differ in size")
    return Block(
        described.name, layout, frames, events, queues, standing, declared, attributes,
        lambda: header.retired(memory, head, layout_at), layout_at, clock, link, playhead,
    )  # fmt: skip
