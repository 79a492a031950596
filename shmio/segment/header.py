"""The fixed header of a segment and its section table (docs/reference/segment-format.md)."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Final

import msgspec

from shmio.errors import FormatError, UnfinishedError
from shmio.segment import _atomics
from shmio.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

MAGIC: Final = int.from_bytes(b"SHMIOSEG", "little")
ABI_VERSION: Final = 2
HEADER_SIZE: Final = 4096
SECTION_SIZE: Final = 128
SLOT_SIZE: Final = 1088
LIST_SIZE: Final = 32_768
LIST_CELL_SIZE: Final = 8 + LIST_SIZE
MAX_SECTIONS: Final = 4096
MAX_PROCESSES: Final = 256

# Offsets of the fields that change during the segment's life.
GENERATION_OFFSET: Final = 48  # u32 generation, u32 section count: one word, so that they change together
CONTROL_OFFSET: Final = 208
CONTROL_SIZE: Final = 256
SUPERVISED_SINCE_OFFSET: Final = 496
HEARTBEAT_OFFSET: Final = 504
SUPERVISOR_CELL: Final = 512
NOTE_CELL: Final = 528
NOTE_SIZE: Final = 488
CONFIG_OFFSET: Final = 1024
CONFIG_SIZE: Final = 3072

_HEADER: Final = struct.Struct("<QIIQQqqII QII QIII 4x 16s64s32s256s")
_SECTION: Final = struct.Struct("<IIQQII64s32s")
_SUPERVISOR: Final = struct.Struct("<II")
_RETIRED: Final = 1 << 32  # bit 0 of the flags, in one word with the kind


class State(IntEnum):
    """State of an instance."""

    STARTING = 0
    RUNNING = 1
    DEGRADED = 2
    STOPPING = 3
    STOPPED = 4

    def __str__(self) -> str:
        return self.name.lower()


class SectionKind(IntEnum):
    """Kind of a section's content. Readers skip sections of unknown kinds."""

    LAYOUT = 1
    FRAMES = 2
    EVENTS = 3
    COMMANDS = 4
    SOURCE = 5
    INJECTIONS = 6
    CLOCK = 7
    DECLARED = 8
    LINK = 9
    PLAYHEAD = 10
    READERS = 11


class Header(msgspec.Struct, frozen=True):
    """The fields of the header that are written at creation. Offsets and sizes are in bytes, times in ns."""

    epoch: int
    size: int
    started_utc_ns: int
    started_ns: int
    sections_offset: int
    section_capacity: int
    processes_offset: int
    process_capacity: int
    mode: str
    instance: str
    version: str
    control: str

    def write(self, memory: memoryview) -> None:
        """Write all fields but the magic number, which :func:`finish` writes last."""
        packed = _HEADER.pack(
            0, ABI_VERSION, HEADER_SIZE, self.epoch, self.size, self.started_utc_ns, self.started_ns,
            0, 0,  # generation and section count, see change_sections
            self.sections_offset, self.section_capacity, SECTION_SIZE,
            self.processes_offset, self.process_capacity, SLOT_SIZE, 0,
            self.mode.encode(), self.instance.encode(), self.version.encode(), self.control.encode(),
        )  # fmt: skip
        memory[: len(packed)] = packed

    @classmethod
    def read(cls, memory: memoryview, name: str) -> Header:
        """Read and check a header; ``name`` is the name of the segment, for messages.

        Raises:
            UnfinishedError: The segment is incomplete.
            FormatError: Another version made the segment, or the header is inconsistent.
        """
        if len(memory) < HEADER_SIZE or _atomics.load64(memory, 0) != MAGIC:
            raise UnfinishedError(f"{name} is not a complete shmio segment: it is being created, or its creator died")
        # fmt: off
        (_, abi, header_size, epoch, size, utc_ns, started_ns, _, _, sections, section_capacity, section_size,
         processes, process_capacity, slot_size, _, mode, instance, version, control) = _HEADER.unpack_from(memory)
        # fmt: on
        if abi != ABI_VERSION:
            raise FormatError(
                f"{name} has segment ABI {abi} (written by shmio {text(version)}), but this shmio {__version__} "
                f"knows only ABI {ABI_VERSION}; use the same version of shmio as the instance"
            )
        sound = (
            header_size == HEADER_SIZE
            and section_size == SECTION_SIZE
            and slot_size == SLOT_SIZE
            and section_capacity <= MAX_SECTIONS
            and process_capacity <= MAX_PROCESSES
            and sections % 8 == 0
            and processes % 64 == 0
            and HEADER_SIZE <= sections <= len(memory) - section_capacity * SECTION_SIZE
            and HEADER_SIZE <= processes <= len(memory) - process_capacity * SLOT_SIZE
        )
        if not sound:
            raise FormatError(f"{name}: the header is inconsistent; restart the instance")
        return cls(
            epoch, size, utc_ns, started_ns, sections, section_capacity, processes, process_capacity,
            text(mode), text(instance), text(version), text(control),
        )  # fmt: skip


class SectionEntry(msgspec.Struct, frozen=True):
    """An entry of the section table.

    If the section belongs to a block, ``layout`` is the index of the block's layout section.
    Otherwise, ``layout`` is the index of the section itself.
    """

    kind: int
    retired: bool
    offset: int
    size: int
    layout: int
    name: str
    digest: bytes


def change_sections(
    memory: memoryview, header: Header, append: Sequence[SectionEntry], retire: Sequence[int] = ()
) -> None:
    """Append entries to the section table, then retire the entries with the indices ``retire``.

    Readers see all new entries before any old entry is retired. In between, two blocks may have the
    same name; readers use the later one.

    Raises:
        FormatError: The table has no room.
    """
    generation, count = table_state(memory)
    if count + len(append) > header.section_capacity:
        raise FormatError(
            f"the section table has {count} of {header.section_capacity} entries, and no room for {len(append)} more"
        )
    for index, entry in enumerate(append, count):
        at = header.sections_offset + index * SECTION_SIZE
        fields = (entry.kind, int(entry.retired), entry.offset, entry.size, entry.layout, 0)
        _SECTION.pack_into(memory, at, *fields, entry.name.encode(), entry.digest)
    _set_table_state(memory, generation + 1, count + len(append))
    if not retire:
        return
    for index in retire:
        at = header.sections_offset + index * SECTION_SIZE
        _atomics.store64(memory, at, _atomics.load64(memory, at) | _RETIRED)
    _set_table_state(memory, generation + 2, count + len(append))


def table_state(memory: memoryview) -> tuple[int, int]:
    """Return (generation, number of entries) of the section table.

    Each change of the table increases the generation.
    """
    word = _atomics.load64(memory, GENERATION_OFFSET)
    return word & 0xFFFFFFFF, word >> 32


def generation(memory: memoryview) -> int:
    """Return the generation of the section table; see :func:`table_state`."""
    return _atomics.load64(memory, GENERATION_OFFSET) & 0xFFFFFFFF


def retired(memory: memoryview, header: Header, index: int) -> bool:
    """Return whether the entry of the section table with this index is retired."""
    return _atomics.load64(memory, header.sections_offset + index * SECTION_SIZE) & _RETIRED != 0


def read_sections(memory: memoryview, header: Header, count: int, name: str) -> list[SectionEntry]:
    """Return the first ``count`` entries of the section table; ``name`` is the segment's name, for messages.

    Raises:
        FormatError: A section is not within the segment.
    """
    if count > header.section_capacity:
        raise FormatError(
            f"{name}: the header counts {count} sections, but the section table has room for {header.section_capacity}"
        )
    entries = []
    for index in range(count):
        kind, flags, offset, size, layout, _, label, digest = _SECTION.unpack_from(
            memory, header.sections_offset + index * SECTION_SIZE
        )
        if offset % 64 or offset > len(memory) or size > len(memory) - offset:
            raise FormatError(f"{name}: section {index} lies outside the segment")
        entries.append(SectionEntry(kind, bool(flags & 1), offset, size, layout, text(label), digest))
    return entries


def finish(memory: memoryview) -> None:
    """Write the magic number. From then on, processes can open the segment."""
    _atomics.store64(memory, 0, MAGIC)


def write_control(memory: memoryview, path: str) -> None:
    """Write the path of the supervisor's control socket."""
    memory[CONTROL_OFFSET : CONTROL_OFFSET + CONTROL_SIZE] = path.encode().ljust(CONTROL_SIZE, b"\0")


def write_config(memory: memoryview, file: Path) -> None:
    """Write the path of the configuration file that the instance was started from."""
    memory[CONFIG_OFFSET : CONFIG_OFFSET + CONFIG_SIZE] = _config_field(file)


def read_config(memory: memoryview) -> Path | None:
    """Read the path of the configuration file that the instance was started from; None: unknown."""
    from pathlib import Path  # noqa: PLC0415  programs that attach need no path

    path = bytes(memory[CONFIG_OFFSET : CONFIG_OFFSET + CONFIG_SIZE]).split(b"\0", 1)[0]
    return Path(os.fsdecode(path)) if path else None


def has_config(memory: memoryview, file: Path) -> bool:
    """Return whether the instance was started from this configuration file."""
    return memory[CONFIG_OFFSET : CONFIG_OFFSET + CONFIG_SIZE] == _config_field(file)


def _config_field(file: Path) -> bytes:
    return os.fsencode(file)[: CONFIG_SIZE - 1].ljust(CONFIG_SIZE, b"\0")


def write_supervised_since(memory: memoryview, since_ns: int) -> None:
    """Write the time at which the supervisor started, CLOCK_MONOTONIC in ns.

    Call this only if the instance's clock was not 0 at that time. Without this call, readers take
    the start of the instance.
    """
    _atomics.store64(memory, SUPERVISED_SINCE_OFFSET, since_ns)


def write_supervisor(memory: memoryview, pid: int, state: State) -> None:
    """Write the supervisor's pid and the instance's state."""
    _atomics.cell_write(memory, SUPERVISOR_CELL, _SUPERVISOR.pack(pid, state))


def read_supervisor(memory: memoryview) -> tuple[int, State]:
    """Read the supervisor's pid and the instance's state."""
    data = _atomics.cell_read(memory, SUPERVISOR_CELL, _SUPERVISOR.size)
    if data is None:
        return 0, State.STARTING
    pid, state = _SUPERVISOR.unpack(data)
    return pid, State(state) if state <= State.STOPPED else State.STOPPED


def write_note(memory: memoryview, note: str) -> None:
    """Write a note about a problem of the instance itself; empty: there is no problem."""
    _atomics.cell_write(memory, NOTE_CELL, cut(note, NOTE_SIZE).ljust(NOTE_SIZE, b"\0"))


def read_note(memory: memoryview) -> str:
    """Read the note about a problem of the instance itself; empty: there is no problem."""
    return text(_atomics.cell_read(memory, NOTE_CELL, NOTE_SIZE) or b"")


def text(field: bytes) -> str:
    """Decode a zero-padded UTF-8 field."""
    return field.split(b"\0", 1)[0].decode("utf-8", "replace")


def cut(message: str, size: int) -> bytes:
    """Encode a text as UTF-8, cut after the last whole character within ``size`` bytes."""
    data = message.encode()
    return data if len(data) <= size else data[:size].decode("utf-8", "ignore").encode()


def _set_table_state(memory: memoryview, generation: int, count: int) -> None:
    _atomics.store64(memory, GENERATION_OFFSET, count << 32 | generation & 0xFFFFFFFF)
