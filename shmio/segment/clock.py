"""The clock page: what time it is in an instance, which step was asked for, who has delivered which.

The section is described in docs/reference/segment-format.md. The owner of time writes it (``coordinator``), anybody
reads it, and each process has a bell there that is rung when the page has something for it to do.

Real time that is given back (``Coordinator.release``) goes on from where virtual time stood, and cycles from the last
step's number, so that neither ever goes back. What both count from is kept in the page, which has no other use for
time and step while time is real; so every process, also one that starts later, counts alike:

- clock = CLOCK_MONOTONIC - ``started`` + ``offset_ns``;
- cycle of a block = clock // period + lead, lead = step - ``resumed_ns`` // period.

All three are 0 until time is released for the first time. Devices' frames are stamped without the offset, always.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from shmio.segment import _atomics
from shmio.segment.double_buffer import DoubleBuffer
from shmio.segment.header import Header, cut, text

STEP_SIZE_NS: Final = 50_000_000
"""The size of a step unless somebody has set another."""

_SLOTS_AT: Final = 8
_STEPPED_AT: Final = 12
_BELL_AT: Final = 0
_DELIVERED_BELL_AT: Final = 4
_COPIES_AT: Final = (64, 320)
_TABLE_AT: Final = 576
_ENTRY: Final = struct.Struct("<QII")  # delivered, bell, 0
_STATE: Final = struct.Struct("<IIQqqQqdI4x168s")
_TIME: Final = struct.Struct("<IIQqq")  # how it begins
_NOTE_SIZE: Final = 167
_PLAYING: Final = 1
_STEPPING: Final = 2


class ClockMode(IntEnum):
    """What moves time."""

    WALL = 0
    VIRTUAL = 1
    """Only steps do, from the moment when a program took time over until one releases it, or the instance ends."""

    def __str__(self) -> str:
        return self.name.lower()


class ClockState(NamedTuple):
    """The page at one moment.

    ``step``: number of the last step asked for; ``time_ns``: the instance's clock after it, ``dt_ns`` before which it
    was that much less; in wall time ``time_ns`` is now. ``stepping``: that step is under way. ``done``: number of the
    last one that all participants have finished. ``owner``: pid of who moves time; 0: nobody. ``note``: whom a step
    waits for, why the last one failed, or what it did not move. ``resumed_ns``, ``offset_ns``: in wall time the clock
    at which it was released, and how far it is ahead of the real time since the instance's start.
    """

    mode: ClockMode = ClockMode.WALL
    step: int = 0
    time_ns: int = 0
    dt_ns: int = 0
    done: int = 0
    step_size_ns: int = STEP_SIZE_NS
    playing: bool = False
    rate: float = 1.0
    stepping: bool = False
    owner: int = 0
    note: str = ""
    resumed_ns: int = 0
    offset_ns: int = 0

    @property
    def virtual(self) -> bool:
        """Whether only steps move time."""
        return self.mode is ClockMode.VIRTUAL

    @property
    def present_ns(self) -> int:
        """The instance's clock: while a step is under way still what it was before that."""
        return self.time_ns - self.dt_ns if self.stepping else self.time_ns

    @property
    def basis(self) -> tuple[ClockMode, int, int, int]:
        """What clock and cycles are counted from in wall time: it changes whenever time is taken over or released."""
        return self.mode, self.step, self.resumed_ns, self.offset_ns

    def lead(self, period_ns: int) -> int:
        """In wall time: how far cycles of this period are ahead of the clock."""
        return self.step - self.resumed_ns // period_ns


class Doorbell:
    """A futex word in shared memory: who waits is woken when it is rung. Works on a read-only mapping, but to ring."""

    def __init__(self, memory: memoryview, offset: int) -> None:
        self._memory = memory
        self._offset = offset

    def value(self) -> int:
        """To be read before looking for news."""
        return _atomics.bell(self._memory, self._offset)

    def ring(self) -> None:
        """Wake all who wait."""
        _atomics.bell_ring(self._memory, self._offset)

    def wait(self, seen: int, timeout_ns: int = -1) -> int:
        """Wait until the value differs from ``seen``, or for so long (negative: for ever); the value then."""
        return _atomics.bell_wait(self._memory, self._offset, seen, timeout_ns)

    def relay(self, shared: bytearray, descriptor: int, turn_ns: int) -> None:
        """What the thread of a :class:`~shmio.segment.relay.Relay` does."""
        _atomics.bell_relay(self._memory, self._offset, shared, descriptor, turn_ns)


SIMULATED_UTC_NS: Final = 946_684_800_000_000_000
"""UTC at which time that was virtual from the start begins: 2000-01-01."""


class ClockPage:
    """The section of one segment; several threads may use it, to write it is the owner of time's alone."""

    def __init__(self, memory: memoryview, offset: int, size: int, head: Header, owned: Callable[[], bool]) -> None:
        """``head``: the segment's. ``owned``: whether anybody owns time. ValueError: it is none of this geometry."""
        slots = head.process_capacity
        if size < page_size(slots) or _word(memory, offset + _SLOTS_AT) != slots:
            raise ValueError("the clock page is too short, or has not a place for each process")
        self._memory = memory
        self._offset = offset
        self._state = _cell(memory, offset)
        self._owned = owned
        self._last = b"", ClockState()  # what was read last
        self._started_ns, self._started_utc_ns = head.started_ns, head.started_utc_ns
        self.bell = Doorbell(memory, offset + _BELL_AT)
        """Rung at every change of the page."""
        self.delivered_bell = Doorbell(memory, offset + _DELIVERED_BELL_AT)
        """Rung by those who deliver steps."""

    @staticmethod
    def write_new(memory: memoryview, offset: int, slots: int, *, virtual: bool, time_ns: int = 0) -> None:
        """The page of a new segment; ``virtual``: time stands at ``time_ns`` until somebody steps."""
        struct.pack_into("<II", memory, offset + _SLOTS_AT, slots, virtual)
        state = ClockState(ClockMode.VIRTUAL, time_ns=time_ns) if virtual else ClockState()
        _cell(memory, offset).write(_pack(state))

    @property
    def stepped(self) -> bool:
        """Whether time was virtual from the start, as the configuration says."""
        return bool(_word(self._memory, self._offset + _STEPPED_AT))

    def read(self) -> ClockState:
        """How time stands now. SegmentError: it cannot be read, which no writer of ours brings about.

        Nobody plays it when who did has died.
        """
        state = self.told()
        if state.playing and not self._owned():
            state = state._replace(playing=False)
        if state.virtual:
            return state
        return state._replace(time_ns=time.monotonic_ns() - self._started_ns + state.offset_ns)

    def told(self) -> ClockState:
        """The page as its writer has left it, dead or alive. SegmentError."""
        data = self._state.read(_STATE.size)
        before, state = self._last
        if data != before:
            state = _unpack(data)
            self._last = data, state
        return state

    def write(self, state: ClockState, *, ring: bool = True) -> None:
        """Write the page and ring its bell; the owner of time alone. ``ring`` False: there is nothing to do yet."""
        self._state.write(_pack(state))
        if ring:
            self.bell.ring()

    def now_ns(self) -> int:
        """What ages of frames that live on this clock are taken against, comparable to CLOCK_MONOTONIC.

        In wall time it is CLOCK_MONOTONIC, as long as nobody has moved and released time.
        """
        mode, flags, _, time_ns, dt_ns = _TIME.unpack(self._state.read(_TIME.size))  # not all of it: each age asks
        if not mode:
            offset_ns: int = time_ns - dt_ns
            return time.monotonic_ns() + offset_ns
        present_ns: int = time_ns - dt_ns if flags & _STEPPING else time_ns
        return self._started_ns + present_ns

    def present_ns(self) -> int:
        """The instance's clock at present; while a step is under way still what it was before that."""
        return self.now_ns() - self._started_ns

    def monotonic_ns(self, time_ns: int) -> int:
        """A time of the instance's clock as one that is comparable to CLOCK_MONOTONIC."""
        return self._started_ns + time_ns

    def utc_ns(self, monotonic_ns: int) -> int:
        """Such a time as UTC; of an instance whose time was virtual from the start it is the same in each run."""
        since_ns = monotonic_ns - self._started_ns
        return (SIMULATED_UTC_NS if self.stepped else self._started_utc_ns) + since_ns

    def slot_bell(self, index: int) -> Doorbell:
        """The bell of the process in this slot of the table: rung when the page has something for it to do."""
        return Doorbell(self._memory, self._entry(index) + 8)

    def delivered(self, index: int) -> int | None:
        """The last step that the process in this slot has delivered; None: it delivers none."""
        count = _atomics.load64(self._memory, self._entry(index))
        return count - 1 if count else None

    def deliver(self, index: int, step: int) -> None:
        """Tell that every change up to this step, and its marker, have been delivered; the process's alone.

        From the first call on each step waits for this process as long as it lives.
        """
        _atomics.store64(self._memory, self._entry(index), step + 1)
        self.delivered_bell.ring()

    def abstain(self, index: int) -> None:
        """Have no step wait for this process, until it delivers one; the process's alone."""
        _atomics.store64(self._memory, self._entry(index), 0)
        self.delivered_bell.ring()

    def _entry(self, index: int) -> int:
        return self._offset + _TABLE_AT + index * _ENTRY.size


def time_lock(head: Header) -> int:
    """The byte of the segment that who owns time has locked: the one after those of the process table."""
    return head.process_capacity + 1


def page_size(slots: int) -> int:
    """Bytes of the section for a process table of so many slots."""
    return _TABLE_AT + slots * _ENTRY.size


def _word(memory: memoryview, offset: int) -> int:
    return int.from_bytes(memory[offset : offset + 4], "little")


def _cell(memory: memoryview, offset: int) -> DoubleBuffer:
    first, second = _COPIES_AT
    complaint = "the clock page makes no sense: restart the instance: shmio-supervisor down, up"
    return DoubleBuffer(memory, (offset + first, offset + second), complaint)


def _pack(state: ClockState) -> bytes:
    flags = (_PLAYING if state.playing else 0) | (_STEPPING if state.stepping else 0)
    time_ns, dt_ns = state.time_ns, state.dt_ns
    if not state.virtual:
        time_ns, dt_ns = state.resumed_ns, state.resumed_ns - state.offset_ns
    return _STATE.pack(
        state.mode, flags, state.step, time_ns, dt_ns, state.done, state.step_size_ns, state.rate, state.owner,
        cut(state.note, _NOTE_SIZE),
    )  # fmt: skip


def _unpack(data: bytes) -> ClockState:
    mode, flags, step, time_ns, dt_ns, done, step_size_ns, rate, owner, note = _STATE.unpack(data)
    state = ClockState(
        ClockMode.VIRTUAL if mode else ClockMode.WALL, step, time_ns, dt_ns, done, step_size_ns,
        bool(flags & _PLAYING), rate if math.isfinite(rate) and rate > 0 else 1.0, bool(flags & _STEPPING), owner,
        text(note),
    )  # fmt: skip
    return state if mode else state._replace(dt_ns=0, resumed_ns=time_ns, offset_ns=time_ns - dt_ns)
