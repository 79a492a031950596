"""The link of a block whose registers a program elsewhere computes: what its source asks of that, and the answers.

The section is described in docs/reference/segment-format.md. The source's process asks; the process to which the
program is connected holds the link's lock, tells whose program it is, and writes the answers.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.errors import ConfigError, PathError
from shmio.layout.glob import select
from shmio.layout.model import Layout, Register
from shmio.layout.topic import near
from shmio.segment import _atomics
from shmio.segment.frame import Provenance, Quality
from shmio.segment.header import cut, text
from shmio.segment.shm import SharedObject

SLOTS: Final = 4
MAX_NAME_BYTES: Final = 103

_SIZE: Final = struct.Struct("<Q")
_JOINED_AT: Final = 64
_JOINED: Final = struct.Struct("<IIQ104s")
_RINGS_AT: Final = 192
_COMPUTED: Final = 1  # flag: a model has done a step


class ModelPorts(NamedTuple):
    """The registers of a block whose model is elsewhere. One that is in-out is among both: it has two ends."""

    inputs: tuple[Register, ...]
    """What the model is given."""
    outputs: tuple[Register, ...]
    """What it computes."""


class ConnectedModel(NamedTuple):
    """A model that is connected. ``number``: how many have been before, and this one; ``pid``: who writes for it."""

    number: int
    pid: int
    name: str


class ModelRequest(NamedTuple):
    """A step that the source asks for. ``number`` is the ask's own; the step's may be asked for again.

    ``time_ns``: of the instance's clock after the step, ``dt_ns`` before which it was that much less. ``until_ns``:
    CLOCK_MONOTONIC, when the source waits no more. ``doubt``: why inputs may not be right. ``commanded``: the image
    with what the model is given, ``shown``: the one with what it has computed.
    """

    number: int
    step: int
    time_ns: int
    dt_ns: int
    until_ns: int
    doubt: str
    commanded: bytes
    shown: bytes


class ModelAnswer(NamedTuple):
    """What came of an ask. ``image`` has the outputs; with ``failure`` none of it counts."""

    image: bytes
    failure: str | None


def model_ports(layout: Layout, outputs: Sequence[str], inouts: Sequence[str]) -> ModelPorts:
    """What the patterns of ``outputs`` and ``inouts`` say of a layout's registers.

    ConfigError, beginning with the key: a pattern names no register, or one is named in both.
    """
    computed, both = (_named(layout, *item) for item in (("outputs", outputs), ("inouts", inouts)))
    if twice := sorted(computed & both):
        path = layout.registers[twice[0]].path
        raise ConfigError(f"inouts: {path} is among outputs, too: what is both is named here alone")
    registers = list(enumerate(layout.registers))
    return ModelPorts(
        tuple(register for index, register in registers if index not in computed),
        tuple(register for index, register in registers if index in computed | both),
    )


def _named(layout: Layout, key: str, patterns: Sequence[str]) -> set[int]:
    found: set[int] = set()
    for pattern in patterns:
        try:
            some = select(layout, [pattern])
        except PathError as error:
            raise ConfigError(f"{key}: {error}") from None
        if not some:
            alike = "" if "*" in pattern else ", ".join(path for path in near(layout, pattern) if path != pattern)
            what = f"{key}: {pattern!r} names no register of {layout.name}; it takes whole registers"
            raise ConfigError(f"{what}; near: {alike}" if alike else what)
        found.update(some)
    return found


def section(ring_header: bytes, slot_bytes: int) -> tuple[int, bytes]:
    """Size and beginning of a new section, whose two rings have this header."""
    ring_size = _atomics.RING_HEADER_SIZE + SLOTS * slot_bytes
    begin = _SIZE.pack(ring_size).ljust(_RINGS_AT, b"\0") + ring_header.ljust(ring_size, b"\0") + ring_header
    return _RINGS_AT + 2 * ring_size, begin


class ModelChannel:
    """The section of one block."""

    def __init__(self, shared: SharedObject, memory: memoryview, offset: int, size: int, lock_byte: int) -> None:
        """ValueError: the section contradicts itself."""
        (ring_size,) = _SIZE.unpack_from(memory, offset) if size >= _RINGS_AT else (0,)
        if not 0 < ring_size <= (size - _RINGS_AT) // 2:
            raise ValueError("the link's rings do not fit in its section")
        self._shared = shared
        self._memory = memory
        self._offset = offset
        self._lock_byte = lock_byte
        first = offset + _RINGS_AT
        self.asked = _atomics.Ring(memory, first, ring_size)
        self.answered = _atomics.Ring(memory, first + ring_size, ring_size)
        if self.asked.frame_size != self.answered.frame_size:
            raise ValueError("the link's rings differ in size")

    @property
    def frame_size(self) -> int:
        """Bytes of one image."""
        return self.asked.frame_size

    def model(self) -> ConnectedModel | None:
        """The model that is connected, as other processes see it; None: there is none, or who had it is dead."""
        return self._read() if self._shared.locked(self._lock_byte) else None

    def _read(self) -> ConnectedModel:
        data = _atomics.cell_read(self._memory, self._offset + _JOINED_AT, _JOINED.size)
        if data is None:
            return ConnectedModel(0, 0, "")
        pid, _, number, name = _JOINED.unpack(data)
        return ConnectedModel(number, pid, text(name))

    def computed(self) -> bool:
        """Whether a model has done a step, this one or one before."""
        data = _atomics.cell_read(self._memory, self._offset + _JOINED_AT, _JOINED.size)
        return data is not None and _JOINED.unpack(data)[1] == _COMPUTED

    # ---- the source's part ---------------------------------------------------------------------------------------

    def ask(self, ask: ModelRequest, publish_ns: int) -> int:
        """Ask for a step; the ask's number, whatever it says. ``publish_ns``: the time of its frame."""
        return self.asked.publish(
            ask.commanded, ask.shown, ask.step, publish_ns, ask.time_ns, ask.until_ns,
            Quality.UNCERTAIN if ask.doubt else Quality.GOOD, Provenance.SIMULATED, ask.dt_ns, 0,
            cut(ask.doubt, _atomics.REASON_SIZE),
        )  # fmt: skip

    def answer_to(self, number: int) -> ModelAnswer | None:
        """The answer to an ask, if it is the newest one: no late answer is taken for it."""
        fields = self.answered.latest()
        if fields is None or fields[8] != number:
            return None
        failed = fields[6] != Quality.GOOD
        return ModelAnswer(fields[11], fields[10] if failed else None)

    # ---- the part of who writes for the model ----------------------------------------------------------------------

    def join(self, name: str) -> bool:
        """Take the link; False: another process has it."""
        if not self._shared.try_lock(self._lock_byte):
            return False
        self._tell(ConnectedModel(self._read().number + 1, os.getpid(), name), _COMPUTED if self.computed() else 0)
        self.answered.begin()
        return True

    def _tell(self, joined: ConnectedModel, flags: int) -> None:
        data = _JOINED.pack(joined.pid, flags, joined.number, cut(joined.name, MAX_NAME_BYTES))
        _atomics.cell_write(self._memory, self._offset + _JOINED_AT, data)

    def leave(self) -> None:
        """Give it back, and have a source look that waits for an answer."""
        self._shared.unlock(self._lock_byte)
        self.answered.wake()

    def newest(self) -> ModelRequest | None:
        """The step that was asked for last; None: none was yet."""
        fields = self.asked.latest()
        if fields is None:
            return None
        number, step, _, time_ns, until_ns, _, _, _, dt_ns, _, doubt, commanded, shown = fields
        return ModelRequest(
            number, step, time_ns, dt_ns, until_ns, doubt, commanded, commanded if shown is None else shown
        )

    def answer(self, ask: ModelRequest, now_ns: int, image: bytes | bytearray, failure: str | None = None) -> None:
        """Answer an ask; ``failure``: why it failed. ``now_ns``: CLOCK_MONOTONIC."""
        if failure is None and not self.computed():
            self._tell(self._read(), _COMPUTED)
        self.answered.publish(
            image, None, ask.step, now_ns, ask.time_ns, 0, Quality.GOOD if failure is None else Quality.BAD,
            Provenance.SIMULATED, ask.number, 0, cut(failure or "", _atomics.REASON_SIZE),
        )  # fmt: skip
