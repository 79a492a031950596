"""The process table: the processes of the instance, with their states and counters.

The table has a slot for each process, which is the *worker* of the slot. The supervisor writes the
slot's name, kind and digest, and the cell :class:`Supervised`. The worker locks its slot, and writes
its heartbeat and the cell :class:`Report`. The kernel releases the lock when the worker dies, so
others always notice its death.
"""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Final

import msgspec

from shmio.errors import SegmentError
from shmio.model.values import WRITERS
from shmio.segment import _atomics
from shmio.segment.header import HEARTBEAT_OFFSET, SLOT_SIZE, Header, cut, text
from shmio.segment.shm import SharedObject

SUPERVISOR_LOCK: Final = 0  # lock byte of the instance; slot i has byte i + 1

_FIXED: Final = struct.Struct("<64s16sI")
_NAME_SIZE: Final = 64
_DIGEST_AT: Final = 96
_DIGEST_SIZE: Final = 32
_SUPERVISED_AT: Final = 128
_SUPERVISED: Final = struct.Struct("<IIq352s")
_HEARTBEAT_AT: Final = 512
_REPORT_AT: Final = 520
MOST_COUNTERS: Final = 16
"""Maximum number of counters of a worker."""
_REPORT: Final = struct.Struct(f"<IIq{MOST_COUNTERS}Q408s")

COUNTERS: Final[Mapping[str, tuple[str, ...]]] = {
    "source": ("polls", "overruns", "failures", "connects", "round_trip_us", "rate_mhz"),
    "emulator": ("cycles", "overruns"),
    "grpc": ("streams", "messages", "dropped", "published", "refused", "bytes", "waiting_bytes"),
    "mqtt": ("messages", "commands", "refused", "waiting", "backlog", "dropped", "connects", "missed", "bytes"),
    "fabric": ("messages", "late", "backlog", "dropped", "missed", "commands", "refused", "connects", "bytes"),
    "opcua": ("sessions", "items", "writes", "refused", "bytes", "messages"),
    "recorder": ("frames", "events", "missed", "bytes"),
    "web": ("requests", "refused", "connections", "pages", "messages", "bytes", "answer_bytes"),
    "alerts": ("active", "notices", "suppressed", "waiting", "failed", "missed"),
}
"""Names of a worker's counters by kind of process, in the order of :attr:`Report.counters`."""


EXTERNAL_SLOTS: Final = 4
"""Number of external slots: slots for programs that write but do not belong to the instance.

They are the last slots of the table. Their programs have the first command queues.
"""


class Phase(IntEnum):
    """State of a process, as the supervisor sees it."""

    STOPPED = 0
    STARTING = 1
    RUNNING = 2
    BACKOFF = 3
    FATAL = 4

    def __str__(self) -> str:
        return self.name.lower()


class Activity(IntEnum):
    """State of a worker, as the worker itself reports it."""

    NONE = 0
    STARTING = 1
    RUNNING = 2
    STOPPING = 3
    PAUSED = 4
    """The worker has stopped its loop, and waits until the supervisor has replaced the source's block."""


class ProcessSpec(msgspec.Struct, frozen=True):
    """A process of the instance. Its ``kind`` is a key of :data:`COUNTERS`."""

    name: str
    kind: str

    @property
    def writer(self) -> int | None:
        """Number of the process's command queue; None if it sends no commands."""
        return WRITERS.get(self.kind) if self.name == self.kind else None


class Supervised(msgspec.Struct, frozen=True):
    """The supervisor's part of a slot.

    ``note`` says why the process is not running; empty if it runs.
    """

    phase: Phase = Phase.STOPPED
    restarts: int = 0
    spawned_ns: int = 0
    note: str = ""


def program_name() -> str:
    """Return the name of this program, as the process table and the audit log have it."""
    return sys.argv[0].rpartition("/")[2] if sys.argv else ""  # not the arguments, which may be secret


class Report(msgspec.Struct, frozen=True):
    """The worker's part of a slot.

    :data:`COUNTERS` names the counters. ``note`` describes a problem of the worker; empty: there is
    none. In an external slot, the only counter is the user's number, and the note is the program's
    name.
    """

    pid: int = 0
    activity: Activity = Activity.NONE
    started_ns: int = 0
    counters: tuple[int, ...] = ()
    note: str = ""


class ProcessSlot:
    """The slot of one process in the table."""

    def __init__(self, shared: SharedObject, memory: memoryview, index: int, offset: int) -> None:
        self._shared = shared
        self._memory = memory
        self._offset = offset
        self.index = index
        """Index in the table; the slot's lock is byte ``index + 1``."""
        name, kind, writer = _FIXED.unpack_from(memory, offset)
        self.name = text(name)
        self.kind = text(kind)
        self.writer: int | None = writer - 1 if writer else None
        """Number of the process's command queue in every block; None: it sends no commands."""

    @property
    def digest(self) -> bytes:
        """SHA-256 of the settings of the process at its start; zeros before the first start."""
        at = self._offset + _DIGEST_AT
        return bytes(self._memory[at : at + _DIGEST_SIZE])

    @digest.setter
    def digest(self, value: bytes) -> None:
        at = self._offset + _DIGEST_AT
        self._memory[at : at + _DIGEST_SIZE] = value

    @property
    def supervised(self) -> Supervised:
        """The supervisor's part, as last written."""
        data = _atomics.cell_read(self._memory, self._offset + _SUPERVISED_AT, _SUPERVISED.size)
        if data is None:
            return Supervised()
        phase, restarts, spawned_ns, note = _SUPERVISED.unpack(data)
        return Supervised(Phase(min(phase, Phase.FATAL)), restarts, spawned_ns, text(note))

    @supervised.setter
    def supervised(self, value: Supervised) -> None:
        data = _SUPERVISED.pack(value.phase, value.restarts, value.spawned_ns, cut(value.note, 351))
        _atomics.cell_write(self._memory, self._offset + _SUPERVISED_AT, data)

    @property
    def report(self) -> Report:
        """The worker's part, as last written.

        After a restart, it is the part of the previous worker until the new worker's first report.
        """
        data = _atomics.cell_read(self._memory, self._offset + _REPORT_AT, _REPORT.size)
        if data is None:
            return Report()
        pid, activity, started_ns, *counters, note = _REPORT.unpack(data)
        return Report(pid, Activity(min(activity, Activity.PAUSED)), started_ns, tuple(counters), text(note))

    @report.setter
    def report(self, value: Report) -> None:
        counters = (*value.counters, *(0,) * (MOST_COUNTERS - len(value.counters)))
        data = _REPORT.pack(value.pid, value.activity, value.started_ns, *counters, cut(value.note, 407))
        _atomics.cell_write(self._memory, self._offset + _REPORT_AT, data)

    @property
    def counters(self) -> dict[str, int]:
        """The worker's counters by name."""
        return dict(zip(COUNTERS.get(self.kind, ()), self.report.counters, strict=False))

    @property
    def heartbeat_ns(self) -> int:
        """Time of the worker's last heartbeat, CLOCK_MONOTONIC in ns; 0 before the first heartbeat."""
        return _atomics.load64(self._memory, self._offset + _HEARTBEAT_AT)

    def beat(self) -> None:
        """Write the worker's heartbeat."""
        _atomics.store64(self._memory, self._offset + _HEARTBEAT_AT, time.monotonic_ns())

    def take(self) -> bool:
        """Lock the slot until this process ends; return False if another process has locked it."""
        return self._shared.try_lock(self.index + 1)

    def alive(self) -> bool:
        """Return whether the slot's process is alive, that is, whether it has locked the slot.

        A lock that this segment object itself holds does not count.
        """
        return self._shared.locked(self.index + 1)


class ProcessTable(Sequence[ProcessSlot]):
    """The slots of the instance's processes, in the order of the table.

    ``external`` has the slots for other programs.
    """

    def __init__(self, shared: SharedObject, memory: memoryview, header: Header) -> None:
        self._shared, self._memory, self._header = shared, memory, header
        named = [slot for slot in map(self._slot, range(header.process_capacity)) if slot.name]
        self._slots = [slot for slot in named if slot.kind != "guest"]
        self.external = [slot for slot in named if slot.kind == "guest"]

    def _slot(self, index: int) -> ProcessSlot:
        return ProcessSlot(self._shared, self._memory, index, self._header.processes_offset + index * SLOT_SIZE)

    @staticmethod
    def write(memory: memoryview, header: Header, specs: Sequence[ProcessSpec]) -> None:
        """Write the names of a new segment's slots, including the external slots."""
        first = header.process_capacity - EXTERNAL_SLOTS
        slots = [(index, spec.name, spec.kind, spec.writer) for index, spec in enumerate(specs)]
        slots += [(first + guest, f"guest-{guest + 1}", "guest", guest) for guest in range(EXTERNAL_SLOTS)]
        for index, name, kind, writer in slots:
            at = header.processes_offset + index * SLOT_SIZE
            _FIXED.pack_into(memory, at, name.encode(), kind.encode(), 0 if writer is None else writer + 1)

    def require(self, count: int) -> None:
        """Raise SegmentError unless the table has vacant slots for ``count`` more processes."""
        vacant = self._header.process_capacity - len(self.external) - len(self._slots)
        if count > vacant:
            raise SegmentError(
                f"segment {self._shared.name} has room for {vacant} more processes, not for {count}; "
                "restart the instance with shmio-supervisor down and up"
            )

    def add(self, spec: ProcessSpec) -> ProcessSlot:
        """Assign a vacant slot to a process.

        Only the supervisor may call this.

        Raises:
            SegmentError: No slot is vacant.
        """
        self.require(1)
        taken = {slot.index for slot in (*self._slots, *self.external)}
        index = next(i for i in range(self._header.process_capacity) if i not in taken)
        at = self._header.processes_offset + index * SLOT_SIZE
        writer = spec.writer
        fields = _FIXED.pack(spec.name.encode(), spec.kind.encode(), 0 if writer is None else writer + 1)
        self._memory[at + _NAME_SIZE : at + len(fields)] = fields[_NAME_SIZE:]
        self._memory[at : at + _NAME_SIZE] = fields[:_NAME_SIZE]  # last: a slot with a name is complete
        slot = self._slot(index)
        self._slots = sorted([*self._slots, slot], key=lambda slot: slot.index)
        return slot

    def remove(self, slot: ProcessSlot) -> None:
        """Vacate the slot of a process that has ended. Only the supervisor may call this."""
        at = self._header.processes_offset + slot.index * SLOT_SIZE
        self._memory[at : at + _NAME_SIZE] = bytes(_NAME_SIZE)  # first, because readers ignore a slot without a name
        slot.supervised, slot.report, slot.digest = Supervised(), Report(), bytes(_DIGEST_SIZE)
        _atomics.store64(self._memory, at + _HEARTBEAT_AT, 0)
        self._slots = [other for other in self._slots if other.index != slot.index]

    def __getitem__(self, index: int) -> ProcessSlot:  # type: ignore[override]  # no slices
        return self._slots[index]

    def __len__(self) -> int:
        return len(self._slots)

    def __iter__(self) -> Iterator[ProcessSlot]:
        return iter(self._slots)

    def find(self, name: str) -> ProcessSlot:
        """Return the slot with this name; raise KeyError if there is none."""
        for slot in self._slots:
            if slot.name == name:
                return slot
        raise KeyError(name)


def supervisor_beat(memory: memoryview) -> None:
    """Write the supervisor's heartbeat."""
    _atomics.store64(memory, HEARTBEAT_OFFSET, time.monotonic_ns())
