"""The clock page: the instance's time, the requested step, and the steps that processes delivered.

docs/reference/segment-format.md describes its bytes. Only the owner of time writes the instance's
time, the requested step, and requests to save or restore state. Each process writes the number of
the last step that it has delivered, and the number of the last request that it has answered. The
page has a doorbell for each process, which wakes the process when it must act on a change.

When a program releases time (``Coordinator.release``), the clock continues from the last virtual
time, and cycles continue from the number of the last step. So neither clock nor cycles ever
decrease. The page has ``offset_ns``, ``resumed_ns`` and the number of the last step. From these,
every process computes the same clock and cycles, even a process that starts later:

- clock = CLOCK_MONOTONIC - ``started`` + ``offset_ns``;
- cycle of a block = clock // period + lead, where lead = step - ``resumed_ns`` // period.

``offset_ns``, ``resumed_ns`` and the lead are 0 until time is released for the first time. Frames
of devices never use the offset.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from enum import IntEnum
from functools import partial
from typing import Final, NamedTuple

from shmio.errors import SegmentError
from shmio.model.clock import Clock, ClockMode
from shmio.segment import _atomics
from shmio.segment.doorbell import Doorbell
from shmio.segment.header import Header, cut, text

SIMULATED_UTC_NS: Final = 946_684_800_000_000_000
"""UTC in ns at clock 0 for an instance whose time is virtual from the start: 2000-01-01."""

_SLOTS_AT: Final = 8
_STEPPED_AT: Final = 12
_BELL_AT: Final = 0
_DELIVERED_BELL_AT: Final = 4
_COPIES_AT: Final = (64, 320)
_TABLE_AT: Final = 576
_ENTRY: Final = struct.Struct("<QII")  # delivered, bell, 0
_STATE: Final = struct.Struct("<IIQqqQqdI4x168s")
_TIME: Final = struct.Struct("<IIQqq")  # the first fields of _STATE
_NOTE_SIZE: Final = 167
_PLAYING: Final = 1
_STEPPING: Final = 2
_ATTEMPTS: Final = 4
_INVALID: Final = "the clock page is invalid; restart the instance with shmio-supervisor down and up"


_REQUEST: Final = struct.Struct("<QII32s64s")
_REQUEST_COPY: Final = 128
_REFUSED: Final = 1 << 63


class StepRequest(NamedTuple):
    """The part of the clock's state that a computed source needs in each turn of its loop.

    In virtual time, the attributes are those of :class:`shmio.model.clock.Clock`. In wall time,
    only ``virtual`` has a meaning.
    """

    virtual: bool
    stepping: bool
    step: int
    time_ns: int
    dt_ns: int


class StateAction(IntEnum):
    """What a :class:`StateRequest` asks processes to do with their state."""

    NONE = 0
    SAVE = 1
    CHECK = 2
    """Check, without any change, whether the state of a snapshot can be restored."""
    RESTORE = 3


class StateRequest(NamedTuple):
    """A request of the owner of time to all processes that take part in snapshots.

    ``folder`` is the name of the folder for their states, inside the instance's folder of snapshots.
    ``name`` is the name of the snapshot, and ``pid`` is the process that makes the request.
    """

    number: int = 0
    action: StateAction = StateAction.NONE
    folder: str = ""
    name: str = ""
    pid: int = 0


_ACTIONS: Final = frozenset(StateAction)


class DoubleBuffer:
    """A value in shared memory, stored in two copies (docs/reference/segment-format.md).

    Several threads may read it.
    """

    def __init__(self, memory: memoryview, copies: tuple[int, int], complaint: str) -> None:
        """Create the buffer.

        Args:
            memory: The mapped segment.
            copies: Offsets of the two copies.
            complaint: Message of the error that :meth:`read` raises if both copies are corrupt.
        """
        self._memory = memory
        self.write = partial(_atomics.cells_write, memory, copies)
        """Writes the value to one copy, then to the other. Only the value's owner may call this."""
        self._attempts = copies * _ATTEMPTS
        self._complaint = complaint

    def read(self, size: int) -> bytes:
        """Return the first ``size`` bytes of the value; raise SegmentError if both copies are corrupt."""
        for at in self._attempts:
            data = _atomics.cell_read(self._memory, at, size)
            if data is not None:
                return data
        raise SegmentError(self._complaint)


class ClockPage:
    """The clock page of a segment. Several threads may use it.

    Only the owner of time may call :meth:`write`.
    """

    def __init__(self, memory: memoryview, offset: int, size: int, head: Header, owned: Callable[[], bool]) -> None:
        """Open the page.

        Args:
            memory: The mapped segment.
            offset: Offset of the section.
            size: Size of the section in bytes.
            head: The segment's header.
            owned: Function that returns whether a living process owns time.

        Raises:
            ValueError: The section does not match the header.
        """
        slots = head.process_capacity
        if size < page_size(slots) or _word(memory, offset + _SLOTS_AT) != slots:
            raise ValueError("the clock page is too short, or has not as many slots as the process table")
        self._memory = memory
        self._offset = offset
        self._state = _cell(memory, offset)
        at = self._answers_at = offset + _TABLE_AT + slots * _ENTRY.size
        self._request = DoubleBuffer(memory, (at, at + _REQUEST_COPY), _INVALID)
        self._answers_at += 2 * _REQUEST_COPY
        self._owned = owned
        self._last = b"", Clock()  # the last state read
        self._stepped = bool(_word(memory, offset + _STEPPED_AT))
        self._started_ns, self._started_utc_ns = head.started_ns, head.started_utc_ns
        self.bell = Doorbell(memory, offset + _BELL_AT)
        """Doorbell that the owner of time rings after a change of the page."""
        self.delivered_bell = Doorbell(memory, offset + _DELIVERED_BELL_AT)
        """Doorbell that processes ring when they have delivered a step."""

    @staticmethod
    def write_new(memory: memoryview, offset: int, slots: int, *, virtual: bool, time_ns: int) -> None:
        """Write the page of a new segment, at ``offset`` in the memory, for ``slots`` process slots.

        With ``virtual``, the clock stays at ``time_ns`` until the first step.
        """
        struct.pack_into("<II", memory, offset + _SLOTS_AT, slots, virtual)
        state = Clock(ClockMode.VIRTUAL, time_ns=time_ns) if virtual else Clock()
        _cell(memory, offset).write(_pack(state))

    @property
    def stepped(self) -> bool:
        """True if time is virtual from the instance's start, as the configuration demands."""
        return self._stepped

    def read(self) -> Clock:
        """Return the present state of the clock. If the owner of time has died, ``playing`` is False.

        Raises:
            SegmentError: The page is corrupt.
        """
        state = self.last_written()
        if state.playing and not self._owned():
            state = state._replace(playing=False)
        if state.virtual:
            return state
        return state._replace(time_ns=time.monotonic_ns() - self._started_ns + state.offset_ns)

    def last_written(self) -> Clock:
        """Return the state of the clock as it was last written, even by a process that has died.

        Raises:
            SegmentError: The page is corrupt.
        """
        data = self._state.read(_STATE.size)
        before, state = self._last
        if data != before:
            state = _unpack(data)
            self._last = data, state
        return state

    def step_request(self) -> StepRequest:
        """Return the last requested step. This is faster than :meth:`read`.

        Raises:
            SegmentError: The page is corrupt.
        """
        mode, flags, step, time_ns, dt_ns = _TIME.unpack(self._state.read(_TIME.size))
        return StepRequest(mode != 0, flags & _STEPPING != 0, step, time_ns, dt_ns)

    def write(self, state: Clock, *, ring: bool = True) -> None:
        """Write the state of the clock, and ring the page's doorbell. Only the owner of time may call this.

        Pass ``ring=False`` if no waiting process has to act on the change yet.
        """
        data = _pack(state)
        self._state.write(data)
        self._last = data, _unpack(data) if state.note else state  # unpack, because a long note is cut
        if ring:
            self.bell.ring()

    def begin_step(self, before: Clock, step: int, time_ns: int, dt_ns: int, done: int) -> None:
        """Write that a step of virtual time has begun, faster than :meth:`write` does. No doorbell rings.

        Args:
            before: The state of the clock before, which was virtual. Its other fields remain.
            step: Number of the step.
            time_ns: The instance's clock after the step, in ns.
            dt_ns: Length of the step, in ns.
            done: Number of the last step that is done.
        """
        flags = _STEPPING | _PLAYING if before.playing else _STEPPING
        mode, step_size_ns, rate, owner = before.mode, before.step_size_ns, before.rate, before.owner
        self._state.write(_STATE.pack(mode, flags, step, time_ns, dt_ns, done, step_size_ns, rate, owner, b""))

    def end_step(self, before: Clock, step: int, time_ns: int, dt_ns: int, done: int, note: str) -> None:
        """Write that a step of virtual time has ended, and ring the page's doorbell.

        ``note`` is the new note of the clock. The other arguments are those of :meth:`begin_step`,
        but ``done`` is the number of the last step that is done now.
        """
        mode, _, _, _, _, step_size_ns, playing, rate, _, owner, *_ = before
        self.write(Clock(mode, step, time_ns, dt_ns, done, step_size_ns, playing, rate, False, owner, note))

    def now_ns(self) -> int:
        """Return the present publish time in ns, from which the age of frames on the instance clock is computed.

        It equals CLOCK_MONOTONIC until a program takes control of time for the first time. From
        then on, it moves with the instance's clock.
        """
        mode, flags, _, time_ns, dt_ns = _TIME.unpack(self._state.read(_TIME.size))  # not all: this is called often
        if not mode:
            offset_ns: int = time_ns - dt_ns
            return time.monotonic_ns() + offset_ns
        present_ns: int = time_ns - dt_ns if flags & _STEPPING else time_ns
        return self._started_ns + present_ns

    def present_ns(self) -> int:
        """Return the instance's clock in ns. During a step, this is the time before the step."""
        return self.now_ns() - self._started_ns

    def monotonic_ns(self, time_ns: int) -> int:
        """Convert a time of the instance's clock to the publish time that a frame gets then, in ns."""
        return self._started_ns + time_ns

    def utc_ns(self, monotonic_ns: int) -> int:
        """Convert a publish time of frames, such as :meth:`now_ns`, to UTC in ns.

        If time is virtual from the instance's start, UTC begins at ``SIMULATED_UTC_NS`` in each run.
        """
        since_ns = monotonic_ns - self._started_ns
        return (SIMULATED_UTC_NS if self._stepped else self._started_utc_ns) + since_ns

    def slot_bell(self, index: int) -> Doorbell:
        """Return the doorbell of the process in a slot. It wakes the process when it must act on a change."""
        return Doorbell(self._memory, self._entry(index) + 8)

    def delivered(self, index: int) -> int | None:
        """Return the number of the last step that the process in a slot has delivered to its clients.

        None: steps do not wait for this process.
        """
        count = _atomics.load64(self._memory, self._entry(index))
        return count - 1 if count else None

    def deliver(self, index: int, step: int) -> None:
        """Record that the process in a slot has delivered all frames and events up to this step.

        Only that process may call this. From the first call on, each step waits until the process
        has delivered the step or has died.
        """
        _atomics.store64(self._memory, self._entry(index), step + 1)
        self.delivered_bell.ring()

    def abstain(self, index: int) -> None:
        """Make steps no longer wait for the process in a slot, until it calls :meth:`deliver` again.

        Only that process may call this.
        """
        _atomics.store64(self._memory, self._entry(index), 0)
        self.delivered_bell.ring()

    def state_request(self) -> StateRequest:
        """Return the last request to save or restore state.

        Raises:
            SegmentError: The page is corrupt.
        """
        number, action, pid, folder, name = _REQUEST.unpack(self._request.read(_REQUEST.size))
        known = action if action in _ACTIONS else StateAction.NONE
        return StateRequest(number, StateAction(known), text(folder), text(name), pid)

    def request_state(self, request: StateRequest) -> None:
        """Write a request to save, check or restore state. Only the owner of time may call this.

        The caller must then ring the doorbells of the processes that take part.
        """
        folder, name = request.folder.encode(), request.name.encode()
        self._request.write(_REQUEST.pack(request.number, request.action, request.pid, folder, name))

    def state_answer(self, index: int) -> tuple[int, bool]:
        """Return (number, success) of the last request that the process in a slot has answered.

        The number is 0 if the process has answered none.
        """
        answer = _atomics.load64(self._memory, self._answers_at + 8 * index)
        return answer & ~_REFUSED, not answer & _REFUSED

    def answer_state(self, index: int, number: int, *, done: bool) -> None:
        """Record that the process in a slot has answered request ``number``. Only that process may call this.

        ``done`` is True if the process has carried out the request.
        """
        _atomics.store64(self._memory, self._answers_at + 8 * index, number if done else number | _REFUSED)
        self.delivered_bell.ring()

    def _entry(self, index: int) -> int:
        return self._offset + _TABLE_AT + index * _ENTRY.size


def time_lock(head: Header) -> int:
    """Return the number of the byte that the owner of time locks; the slots' lock bytes come before it."""
    return head.process_capacity + 1


def page_size(slots: int) -> int:
    """Return the size in bytes of a clock page for a process table with this many slots."""
    return _TABLE_AT + slots * (_ENTRY.size + 8) + 2 * _REQUEST_COPY


def _word(memory: memoryview, offset: int) -> int:
    return int.from_bytes(memory[offset : offset + 4], "little")


def _cell(memory: memoryview, offset: int) -> DoubleBuffer:
    first, second = _COPIES_AT
    return DoubleBuffer(memory, (offset + first, offset + second), _INVALID)


def _pack(state: Clock) -> bytes:
    (mode, step, time_ns, dt_ns, done, step_size_ns, playing, rate, stepping, owner, note, resumed_ns,
     offset_ns) = state  # fmt: skip
    flags = (_PLAYING if playing else 0) | (_STEPPING if stepping else 0)
    if not mode:
        time_ns, dt_ns = resumed_ns, resumed_ns - offset_ns
    return _STATE.pack(
        mode, flags, step, time_ns, dt_ns, done, step_size_ns, rate, owner, cut(note, _NOTE_SIZE) if note else b""
    )


def _unpack(data: bytes) -> Clock:
    mode, flags, step, time_ns, dt_ns, done, step_size_ns, rate, owner, note = _STATE.unpack(data)
    state = Clock(
        ClockMode.VIRTUAL if mode else ClockMode.WALL, step, time_ns, dt_ns, done, step_size_ns,
        bool(flags & _PLAYING), rate if math.isfinite(rate) and rate > 0 else 1.0, bool(flags & _STEPPING), owner,
        text(note),
    )  # fmt: skip
    return state if mode else state._replace(dt_ns=0, resumed_ns=time_ns, offset_ns=time_ns - dt_ns)
